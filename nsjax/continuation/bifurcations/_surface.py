"""The surface of periodic orbits of one itinerary over two parameters, and curves of special points on it: where a test
function is zero."""

import abc
import dataclasses
from typing import Any, Self

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array

from ..._numerics._compile import interactive, on_host
from ...derivatives._floquet import trivial
from ...orbits.segments._corrector import Plane
from ...orbits.segments._equations import linearised, OrbitCurve
from ...orbits.segments._guard_minima import along_segment, zeros_at_begin
from ...orbits.segments._itinerary import capacity_for, EVENT, GRAZING, OrbitItinerary, Start
from ...orbits.segments._point import correct, PointData
from ...system._parameter import FreeParameters, get_parameter
from ..orbits._bifurcation import Origin
from ..orbits._test_functions import branch_value, CIRCLE, CORNERS, of_circle, of_corners, Test
from ..orbits._tracer import OrbitPoint, spot_of


DELTA = 1e-4  # of the differences that give the gradient of a test function, in units of the surface
EXACT = 1e-12  # a step of the secant method that is shorter is its last
ALWAYS = 1e-8  # a test function that is smaller at several points of a curve is zero all along it
CUSP = Test("cusp")
RESONANCES = {Test("1:1 resonance"): -1.0, Test("1:2 resonance"): 1.0, Test("1:3 resonance"): 0.5,
              Test("1:4 resonance"): 0.0}  # fmt: skip


@dataclasses.dataclass
class Place:
    """A point of a curve on the surface.

    `tangent`: of length one. `across`, `slope`: the direction across it on the surface, and the derivative of
    the test function in it. `heading`: the direction in which the projection of the surface on the plane of the
    parameters is not singular, the same way along the whole curve.
    """

    spot: OrbitPoint
    tangent: np.ndarray
    across: np.ndarray
    slope: float
    heading: np.ndarray

    @property
    def u(self) -> Any:
        return self.spot.look.u

    @property
    def turned(self) -> "Place":
        return dataclasses.replace(self, tangent=-self.tangent)


def lift(
    origin: Origin, path: tuple[str, ...], low: np.ndarray, high: np.ndarray
) -> tuple[OrbitCurve, OrbitPoint, Test]:
    """A special point of a branch as one of the surface over its parameter and another one, in these intervals."""
    test, spot, curve = untouched(origin)
    other = float(get_parameter(curve.model.system, path))
    both = FreeParameters.of(curve.model.system, *curve.free.paths, path)
    surface = dataclasses.replace(curve, free=both, low=low, width=high - low)
    parameters = (np.array([spot.parameter, other]) - low) / (high - low)
    u = np.append(spot.look.u[:-1], parameters)
    tangent = np.append(spot.look.tangent[:-1], [spot.look.tangent[-1] * float(curve.width) / (high - low)[0], 0.0])
    # The tangent plane is spanned by that of the branch, and by a direction in which the other parameter moves.
    border = np.stack([tangent / np.linalg.norm(tangent), np.eye(len(u))[-1]])
    newton = test.kind != "branch"  # where the equations are singular it is as exact as it gets
    found = correct(surface, spot.itinerary, Plane(u, border), newton=newton)
    return surface, spot_of(surface, found, spot.itinerary), test


def touches(itinerary: OrbitItinerary, row: int) -> bool:
    """Whether without a segment the orbit would only touch the surface at which it begins."""
    before, after = (row - 1) % int(itinerary.num), (row + 1) % int(itinerary.num)
    same = np.array_equal(itinerary.mode[before], itinerary.mode[after])
    return same and before != row and itinerary.ends[before] == itinerary.ends[row] == EVENT


def untouched(origin: Origin) -> Origin:
    """Where segments vanish because the orbit only just touches a surface, the orbit without them, cut where it
    touches: with two such segments, as symmetric orbits have them, the equations are singular, without they are not."""
    test, spot, curve = origin
    itinerary, look, n = spot.itinerary, spot.look, int(spot.itinerary.num)
    length = (look.end - look.begin) / float(curve.time)
    if test.kind != "duration" or not touches(itinerary, test.row):
        return origin
    gone = [i for i in range(n) if touches(itinerary, i) and abs(length[i]) < 1e-5]
    kept = [i for i in range(n) if i not in gone]
    ends, xs = np.array(itinerary.ends), np.array(look.x)
    ends[[(i - 1) % n for i in gone]] = GRAZING
    shorter = itinerary._replace(ends=ends).take(kept, capacity_for(len(kept)))
    start = Start(shorter, look.begin[kept], look.end[kept], xs[kept])
    u = curve.pack(start, spot.parameter)
    border = np.linalg.svd(linearised(curve, shorter, u))[2][-1]
    found = correct(curve, shorter, Plane(u, border))
    if not bool(found.good):
        return origin
    row = kept.index((test.row - 1) % n)
    return Origin(Test("grazing", row), spot_of(curve, found, shorter), curve)


@dataclasses.dataclass
class AbstractBifurcationTracer(abc.ABC):
    """A curve of special points over two parameters."""

    curve: OrbitCurve
    test: Test
    scale: float = 0.0
    silent: frozenset[Test] = frozenset()  # test functions that are zero all along it, or NaN

    @abc.abstractmethod
    def place(self, spot: OrbitPoint, along: np.ndarray | None = None, heading: np.ndarray | None = None) -> Place:
        """A point of the curve with its direction: that which is nearer to `along`."""

    @abc.abstractmethod
    def step(self, place: Place, length: float) -> OrbitPoint:
        """The point of the curve at a distance along its tangent.

        **Raises:** `ArithmeticError` if none was found.
        """

    @abc.abstractmethod
    def watched(self, place: Place) -> dict[Test, float]:
        """What may vanish at a point of the curve besides its own test function."""

    def counting(self, tests: dict[Test, float]) -> dict[Test, float]:
        return {t: v for t, v in tests.items() if t != self.test and t not in self.silent and np.isfinite(v)}

    def with_silent(self, places: list[Place]) -> Self:
        """Without what is zero at all of these points of it, as it is by symmetry, or where it belongs to the test."""
        rows = [self.watched(place) for place in places]
        names = {t for row in rows for t in row}
        silent = {t for t in names if all(abs(row.get(t, 0.0)) < ALWAYS for row in rows)}
        if "rate" in {t.kind for t in (self.test, *silent)}:
            silent |= {*CIRCLE}  # saltation matrices that are limits make them NaN
        return dataclasses.replace(self, silent=frozenset(silent))


@dataclasses.dataclass
class BifurcationTracer(AbstractBifurcationTracer):
    """The curve on which a test function is zero, on the surface over two parameters."""

    def at(self, spot: OrbitPoint, s: np.ndarray, guess: np.ndarray | None = None) -> OrbitPoint:
        """The point of the surface at these distances along the frame of the tangent plane at another."""
        found = correct(self.curve, spot.itinerary, Plane(spot.look.u, spot.look.tangent, s), guess)
        if not bool(found.good):
            raise ArithmeticError("there is no orbit")
        return spot_of(self.curve, found, spot.itinerary)

    def value(self, spot: OrbitPoint) -> float:
        test, look = self.test, spot.look
        if test.kind == "fold":
            return projection(spot)
        if test.kind == "grazing":
            return float(look.ends[test.row] / self.curve.guard_sizes[spot.itinerary.slot[test.row]])
        return (of_corners if test.kind in CORNERS else of_circle)(self.curve, spot)[test]

    def place(self, spot: OrbitPoint, along: np.ndarray | None = None, heading: np.ndarray | None = None) -> Place:
        frame = spot.look.tangent
        ends = [[self.value(self.at(spot, sign * DELTA * e)) for sign in (1, -1)] for e in np.eye(2)]
        gradient = np.array([(a - b) / (2 * DELTA) for a, b in ends])
        slope = float(np.linalg.norm(gradient))
        if not slope > 0:
            raise ArithmeticError("the test function has no direction")
        across = gradient / slope
        direction = np.array([-across[1], across[0]]) @ frame
        if along is not None and direction @ along < 0:
            direction = -direction
        found = np.linalg.svd(frame[:, -2:])[2][0]
        if heading is not None and found @ heading < 0:
            found = -found
        return Place(spot, direction, across @ frame, slope, found)

    def step(self, place: Place, length: float) -> OrbitPoint:
        """By the secant method across the tangent."""
        frame = place.spot.look.tangent
        ahead, across = frame @ place.tangent, frame @ place.across
        c, slope = 0.0, place.slope
        spot = self.at(place.spot, length * ahead)
        value = self.value(spot)
        for _ in range(12):
            move = -value / slope
            if not abs(c + move) <= 0.5 * abs(length) + 1e-6:
                raise ArithmeticError("the curve bends too much for the step")
            c += move
            spot = self.at(place.spot, length * ahead + c * across, spot.look.u + move * place.across)
            before, value = value, self.value(spot)
            if abs(move) < EXACT or value == 0:
                return spot
            if abs(move) > 1e3 * EXACT:
                slope = (value - before) / move
                if slope == 0:
                    break
        raise ArithmeticError("no point of the curve was found")

    def watched(self, place: Place) -> dict[Test, float]:
        spot, test = place.spot, self.test
        out = interval_tests(spot) | of_corners(self.curve, cleared(self.curve, spot))
        out[Test("fold")] = projection(spot)
        out[Test("branch")] = float(branch_value(spot.look, self.scale))
        out |= of_circle(self.curve, spot)
        if test.kind == "fold":
            frame = spot.look.tangent
            out[CUSP] = float((frame @ place.tangent) @ frame[:, -2:] @ place.heading)
        if test.kind == "Neimark-Sacker":
            rho = spot.multipliers[~(trivial(spot.multipliers) & self.curve.autonomous)]
            pairs = [(abs(a * b - 1), (a + b).real / 2) for i, a in enumerate(rho) for b in rho[:i]]
            out |= {name: min(pairs)[1] + off for name, off in RESONANCES.items()}
        return self.counting(out)


def cleared(curve: OrbitCurve, spot: OrbitPoint) -> OrbitPoint:
    """With the least values of guards beside cuts at which they are zero, and least, divided by that double zero."""
    itinerary, look, n = spot.itinerary, spot.look, int(spot.itinerary.num)
    cuts = np.flatnonzero(itinerary.ends[:n] == GRAZING).tolist()
    if not cuts:
        return spot
    zeros = np.asarray(zeros_at_begin(curve, itinerary))
    least, where, spots = np.array(look.least), np.array(look.where), np.array(look.spots)
    for cut in cuts:
        slot = int(itinerary.slot[cut])
        for row in {cut, (cut + 1) % n}:
            before = row - 1 if row else n - 1
            orders = np.zeros((2, least.shape[1]))
            orders[0, slot] = (
                2 if (itinerary.ends[before], itinerary.slot[before]) == (GRAZING, slot) else zeros[row, slot]
            )
            ends = {GRAZING: 2, EVENT: 1}
            orders[1, slot] = ends.get(int(itinerary.ends[row]), 0) if itinerary.slot[row] == slot else 0
            found = on_host(_guards_along(curve, look, itinerary, np.asarray(row), orders))
            least[row, slot], where[row, slot], spots[row, slot] = (part[slot] for part in found)
    return dataclasses.replace(spot, look=look._replace(least=least, where=where, spots=spots))


@interactive
def _guards_along(
    curve: OrbitCurve, look: PointData, itinerary: OrbitItinerary, row: Array, orders: Array
) -> tuple[Array, Array, Array]:
    """The least values of the guards along a segment, divided by zeros of these orders at its ends; where; and the
    states there."""
    n = len(curve.sizes)
    orders = jnp.concatenate([jnp.zeros((2, 2 * n), orders.dtype), orders], axis=1)
    columns = (look.begin, look.end, look.x, itinerary.mode, itinerary.part)
    segment = tuple(jnp.asarray(column)[row] for column in columns)
    found = along_segment(curve, jnp.asarray(look.parameter), segment, orders, turns=False)
    return found.least[2 * n :], found.share[2 * n :], found.x[2 * n :]


def interval_tests(spot: OrbitPoint) -> dict[Test, float]:
    """Of the first and the second parameter."""
    low = {Test("low", k): float(spot.look.u[k - 2]) for k in (0, 1)}
    return low | {Test("high", k): 1 - float(spot.look.u[k - 2]) for k in (0, 1)}


def projection(spot: OrbitPoint) -> float:
    """Of the tangent plane on the plane of the parameters: what becomes of an area of one."""
    return float(np.linalg.det(spot.look.tangent[:, -2:]))


def surfaces_of(curve: OrbitCurve, spot: OrbitPoint, test: Test) -> tuple[str, ...]:
    """The switches whose surfaces are touched where a test function of `CORNERS` vanishes."""
    itinerary, n = spot.itinerary, int(spot.itinerary.num)
    slots = [test.slot] if test.kind == "guard" else [int(itinerary.slot[test.row])]
    if test.kind == "duration" and itinerary.ends[test.row - 1 if test.row else n - 1] == EVENT:
        slots.insert(0, int(itinerary.slot[test.row - 1 if test.row else n - 1]))
    names = [curve.model.switches[curve.model.slots[slot].switch].name for slot in slots]
    return tuple(dict.fromkeys(names))


def seen_at(curve: OrbitCurve, itinerary: OrbitItinerary, u: np.ndarray, border: np.ndarray) -> OrbitPoint:
    """What is seen of a point that is known to be one of the surface."""
    found = correct(curve, itinerary, Plane(u, border), newton=False)
    return spot_of(curve, on_host(found), itinerary)
