"""The curve on which two sheets of periodic orbits cross, over two parameters: where orbits lose a symmetry.

There the equations F of the orbits are singular. With one more unknown β they are regular: F(u) + β w = 0, with w what
their derivatives do not reach, has a solution for every value of three coordinates, and the orbits are those at which β
is zero. β(s) is like a product of two coordinates where sheets cross: its critical points that are zeros are the points
looked for. They are a curve only if something, as a symmetry, makes them one: of a function of three variables zero is
a critical value at single values of a further parameter else.
"""

import dataclasses
from typing import Any

import numpy as np

from ...orbits.segments._equations import equations, OrbitCurve
from ...orbits.segments._itinerary import OrbitItinerary
from ..orbits._test_functions import of_circle, of_corners, Test
from ..orbits._tracer import OrbitPoint
from ._surface import AbstractBifurcationTracer, DELTA, interval_tests, Place, seen_at


ISOLATED = 1e-2  # curvature of β along the curve, over that across it: zero where there is a curve
EXACT = 1e-11


@dataclasses.dataclass
class _Frame:
    """The three coordinates around a point, and the regular equations."""

    curve: OrbitCurve
    itinerary: OrbitItinerary
    u: np.ndarray
    sizes: np.ndarray  # of the equations
    missing: np.ndarray  # w
    plane: np.ndarray  # (3, N)

    @classmethod
    def at(cls, curve: OrbitCurve, itinerary: OrbitItinerary, u: np.ndarray) -> "_Frame":
        _, df, sizes = equations(curve, itinerary, u, u)
        left, _, right = np.linalg.svd(df / sizes[:, None])
        return cls(curve, itinerary, u, sizes, left[:, -1], right[-3:])

    def solved(self, s: np.ndarray, guess: np.ndarray) -> tuple[np.ndarray, float, np.ndarray]:
        """The unknowns, β, and its gradient, at these coordinates."""
        n, u, beta = len(guess), guess, 0.0
        zeros = np.zeros((3, 1))
        for _ in range(12):
            f, df, _ = equations(self.curve, self.itinerary, u, self.u)
            rest = np.concatenate([f / self.sizes + beta * self.missing, self.plane @ (u - self.u) - s])
            whole = np.block([[df / self.sizes[:, None], self.missing[:, None]], [self.plane, zeros]])
            inverse = np.linalg.inv(whole)
            move = inverse @ rest
            if not np.isfinite(move).all():
                break
            u, beta = u - move[:n], beta - float(move[n])
            if np.max(np.abs(move)) < EXACT:
                return u, beta, inverse[n, -3:]
        raise ArithmeticError("there is no orbit")

    def curvature(self, s: np.ndarray, guess: np.ndarray) -> np.ndarray:
        """The second derivatives of β."""
        sides = [[self.solved(s + sign * DELTA * e, guess)[2] for sign in (1, -1)] for e in np.eye(3)]
        rows = np.array([(a - b) / (2 * DELTA) for a, b in sides])
        return (rows + rows.T) / 2

    def critical(self, ahead: np.ndarray | None = None, length: float = 0.0) -> np.ndarray:
        """The unknowns at the critical point of β that lies so far ahead, or nearest."""
        s, u = np.zeros(3), self.u
        if ahead is not None:
            s = length * ahead
        for _ in range(12):
            u, beta, gradient = self.solved(s, u)
            bend = self.curvature(s, u)
            if ahead is None:
                move = -np.linalg.pinv(bend, rcond=ISOLATED) @ gradient
            else:
                rows, rest = np.vstack([bend, ahead]), np.append(-gradient, length - ahead @ s)
                move = np.linalg.lstsq(rows, rest)[0]
            s = s + move
            if not np.linalg.norm(s) < 2 * abs(length) + 0.1:
                break
            if np.linalg.norm(move) < 10 * EXACT:
                if abs(beta) > 1e-8:
                    break
                return self.solved(s, u)[0]
        raise ArithmeticError("no point at which sheets of orbits cross was found")


@dataclasses.dataclass
class BranchLocus(AbstractBifurcationTracer):
    """The curve of the branch points, followed on no surface of regular points."""

    def place(self, spot: OrbitPoint, along: np.ndarray | None = None, heading: np.ndarray | None = None) -> Place:
        frame = _Frame.at(self.curve, spot.itinerary, spot.look.u)
        if along is None:  # where the branch was is known by interpolation
            u = frame.critical()
            spot = self._seen(spot.itinerary, u, frame)
            frame = _Frame.at(self.curve, spot.itinerary, u)
        values, vectors = np.linalg.eigh(frame.curvature(np.zeros(3), frame.u))
        flat, *others = np.argsort(np.abs(values))
        if abs(values[flat]) > ISOLATED * abs(values[others]).min():
            raise ArithmeticError("it is a single point, as no symmetry makes it another")
        tangent = vectors[:, flat] @ frame.plane
        if along is not None and tangent @ along < 0:
            tangent = -tangent
        slope = float(abs(values[others]).min())
        return Place(spot, tangent, vectors[:, others[0]] @ frame.plane, slope, tangent[-2:])

    def step(self, place: Place, length: float) -> OrbitPoint:
        frame = _Frame.at(self.curve, place.spot.itinerary, place.spot.look.u)
        ahead = frame.plane @ place.tangent
        return self._seen(place.spot.itinerary, frame.critical(ahead / np.linalg.norm(ahead), length), frame)

    def _seen(self, itinerary: OrbitItinerary, u: np.ndarray, frame: _Frame) -> OrbitPoint:
        spot = seen_at(self.curve, itinerary, u, frame.plane[:2])
        # At a point where the equations are singular there is no tangent plane.
        return dataclasses.replace(spot, look=spot.look._replace(tangent=frame.plane[:2]))

    def watched(self, place: Place) -> dict[Test, float]:
        spot = place.spot
        out: dict[Test, Any] = interval_tests(spot) | of_corners(self.curve, spot) | of_circle(self.curve, spot)
        return self.counting(out)
