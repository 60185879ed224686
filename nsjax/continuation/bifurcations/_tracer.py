"""Along a curve of special points of periodic orbits in two parameters, to where the orbits are none any more."""

import dataclasses
from collections.abc import Callable

import numpy as np

from ..._numerics._bracket import bracketed
from ...orbits.segments._equations import linearised
from .._tracer import AbstractTracer, Trace, Zero
from .._zeros import FAILED, interpolated
from ..orbits._collapse import floquet
from ..orbits._test_functions import BRANCH, complex_pair, CORNERS, Test
from ..orbits._tracer import OrbitPoint, OrbitTracer
from ..orbits.corners._grazing import cut_itinerary
from ._surface import AbstractBifurcationTracer, BifurcationTracer, cleared, CUSP, DELTA, Place, RESONANCES, seen_at


TOGETHER = 1e-3  # zeros that are nearer to each other, in steps, are one
DEGENERATE = 1e-2  # of the slope of the test function: where it is less, two branches of its zeros cross
# What vanishes together is told by the first. (At a resonance multipliers also pass 1 or -1.)
RANK = (*CORNERS, *(test.kind for test in RESONANCES), "cusp", "branch", "fold", "flip", "Neimark-Sacker")
LAST = (*CORNERS, "grazing", "low", "high", "1:1 resonance", "1:2 resonance")  # where the curve ends


@dataclasses.dataclass
class CurveTracer(AbstractTracer[Place]):
    """Follows a curve of special points."""

    curve: AbstractBifurcationTracer

    lost = OrbitTracer.lost
    failures = FAILED

    def at(self, point: Place, s: float) -> Place:
        return self.curve.place(self.curve.step(point, s), point.tangent, point.heading)

    def passes(self, zero: Zero) -> bool:
        return zero.test.kind not in LAST

    def closes(self, begin: Place, before: Place, after: Place, length: float) -> bool:
        s = float(before.tangent @ (begin.u - before.u))
        if not 0 < s <= length or before.tangent @ begin.tangent < 0.5:
            return False
        return bool(np.max(np.abs(self.curve.step(before, s).u - begin.u)) < 1e-6)

    def zeros(self, place: Place, after: Place, length: float, turned: bool) -> list[Zero] | None:
        """With all that vanishes together."""
        if turned:
            return None
        old, new = self.curve.watched(place), self.curve.watched(after)
        found = []
        for test, value in old.items():
            if test not in new or new[test] == 0 or value * new[test] > 0:
                continue
            if test.kind in (*CORNERS, "low", "high") and new[test] > 0:
                continue  # it comes from where it could not be: a start on the point itself
            found.append(self.locate(place, after, length, test))
        found = [zero for zero in found if self.bifurcates(zero)]
        rank = {kind: i for i, kind in enumerate(RANK)}
        found.sort(key=lambda zero: zero.s)
        out: list[Zero] = []
        while found:
            near = [zero for zero in found if zero.s - found[0].s <= TOGETHER * length]
            found = found[len(near) :]
            first, *others = sorted(near, key=lambda zero: rank.get(zero.test.kind, 99))
            out.append(first._replace(others=tuple(zero.test for zero in others)))
            if first.test.kind in LAST:
                break
        return out

    def bifurcates(self, zero: Zero) -> bool:
        """Two real multipliers with the product 1 bifurcate only where both are 1, or -1."""
        if zero.test.kind != "Neimark-Sacker":
            return True
        rho = zero.point.spot.multipliers
        at = {"fold": 1.0, "branch": 1.0, "flip": -1.0}.get(self.curve.test.kind)
        double = at is not None and np.sum(np.abs(rho - at) < 1e-3) >= 2 + (self.curve.curve.autonomous and at == 1)
        return bool(complex_pair(rho) or double)

    def locate(self, place: Place, after: Place, length: float, test: Test) -> Zero:
        locus, seen = self.curve, {0.0: place.spot, length: after.spot}

        def step(s: float) -> OrbitPoint:
            return locus.step(place, s)

        def there(spot: OrbitPoint) -> Place:
            return dataclasses.replace(place, spot=spot)

        def value(spot: OrbitPoint) -> float:
            here = locus.place(spot, place.tangent, place.heading) if test == CUSP else there(spot)
            return locus.watched(here)[test]

        s, regular = length / 2, test != BRANCH
        try:
            if regular:
                rough = test.kind == "guard"  # the least of samples
                s = bracketed(seen, step, value, 1e-5 * length if rough else 1e-14)
                # Where the zeros of the test function cross others of its own, as at a corner at which the orbits turn
                # round with it, points of the curve are known less and less well.
                regular = locus.place(seen[s], place.tangent).slope > DEGENERATE * place.slope
        except FAILED:
            regular = False
        if not regular:
            near = min(seen, key=lambda t: abs(t - s))
            return self.interpolate(place, max(near, 0.1 * length), length, test, value)
        spot = seen[s]
        if test.kind == "guard" and isinstance(locus, BifurcationTracer):
            exact = _cut(locus, spot, test)
            if exact is not None:
                return Zero(s, Test("grazing", test.row, test.slot), there(exact))
        return Zero(s, test, there(spot))

    def interpolate(
        self, place: Place, s: float, length: float, test: Test, value: Callable[[OrbitPoint], float]
    ) -> Zero:
        """A point at which the equations are singular, from points of the curve on both sides of it."""
        found = interpolated(s, 0.5 * length, lambda s: self.curve.step(place, s), value)
        u = found.at(lambda here: here.look.u)
        spot = seen_at(self.curve.curve, place.spot.itinerary, u, place.spot.look.tangent)
        # So are the multipliers there a limit, of saltation matrices that are none.
        spot = dataclasses.replace(spot, **floquet(found.at(lambda here: here.monodromy)))
        return Zero(found.s, test, dataclasses.replace(place, spot=spot))

    def trace(self, place: Place) -> tuple[Trace[Place], list[tuple[int, Zero]]]:
        """The curve from a point in the direction that it has there, and its zeros, each at which of its points."""
        trace, met = Trace((place,), begin=place), []
        while not trace.over:
            trace = self.further(trace)
            met += [] if trace.at is None else [(len(trace.points) - 1, trace.at)]
        end = trace.end
        if end is not None and end.test.kind == "grazing":
            # Samples show late that a surface is touched: what lies beyond the exact point, in the plane of the
            # parameters, is no orbit.
            points = trace.points[:-1]
            while len(points) > 1 and (points[-1].u[-2:] - end.point.u[-2:]) @ end.point.tangent[-2:] > 0:
                points = points[:-1]
            trace = dataclasses.replace(trace, points=(*points, end.point))
            met[-1] = len(points), end
        return trace, met


def _cut(locus: BifurcationTracer, spot: OrbitPoint, test: Test) -> OrbitPoint | None:
    """The point of the curve at which the least value of a guard is zero exactly: the orbit cut there."""
    start, rows = cut_itinerary(locus.curve, cleared(locus.curve, spot), [(test.row, test.slot)])
    row = rows[test.row, test.slot]
    own = locus.test
    if own.kind in (*CORNERS, "grazing") and row <= own.row:
        own = own._replace(row=own.row + 1)
    u = locus.curve.pack(start, spot.look.parameter)
    border = np.linalg.svd(linearised(locus.curve, start.itinerary, u))[2][-2:]
    try:
        first, second = (dataclasses.replace(locus, test=t) for t in (own, Test("grazing", row)))
        rough = seen_at(locus.curve, start.itinerary, u, border)
        return meet(first, second, first.at(rough, np.zeros(2)))
    except FAILED:
        return None


def meet(first: BifurcationTracer, second: BifurcationTracer, spot: OrbitPoint) -> OrbitPoint:
    """Where two test functions vanish, by Newton's method on the surface."""
    for _ in range(12):
        here = np.array([first.value(spot), second.value(spot)])
        sides = [[first.at(spot, sign * DELTA * e) for sign in (1, -1)] for e in np.eye(2)]
        slopes = [[(f.value(a) - f.value(b)) / (2 * DELTA) for a, b in sides] for f in (first, second)]
        move = np.linalg.solve(np.array(slopes), -here)
        if not np.linalg.norm(move) < 0.3:
            break
        spot = first.at(spot, move)
        if np.linalg.norm(move) < 1e-10:
            return spot
    raise ArithmeticError("the curves do not meet there")
