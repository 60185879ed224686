"""Along a branch of periodic orbits in one itinerary, to the next point at which others may meet it."""

import dataclasses
from collections.abc import Iterable
from typing import Any

import numpy as np

from ..._numerics._bracket import bracketed
from ..._numerics._compile import on_host
from ...orbits.segments._corrector import Plane
from ...orbits.segments._equations import OrbitCurve
from ...orbits.segments._itinerary import OrbitItinerary, returning
from ...orbits.segments._point import correct, PointData, state_at
from .._tracer import AbstractTracer, Zero
from .._zeros import interpolated
from ._test_functions import BRANCH, complex_pair, CORNERS, PASSED, Test, test_values


UNSEEN = 1e-6  # steps that are not shortened any more for the sake of a branch point
NEAR = 1e-5  # zeros that are nearer to each other, in steps, are one
ON = 1e-11  # an orbit of which a test function is smaller in size is on the corner, on whichever side of it by rounding
VANISHES = 1e-6  # a test function that is smaller, where another one vanishes
SAME = 1e-6  # two orbits at one parameter that are nearer are one
SINGULAR = 1e-3  # the test function of branch points, over its value a step before, where another zero is that of one
ASIDE = 1e-2  # from a branch point, in steps: a fold that is nearer is the branch point's own
RANK = {kind: i for i, kind in enumerate((*CORNERS, "branch", "low", "high"))}  # what vanishes together is the first


@dataclasses.dataclass
class OrbitPoint:
    """A point of a branch: the data of its orbit, its itinerary, and its multipliers."""

    look: PointData
    itinerary: OrbitItinerary
    multipliers: np.ndarray
    stable: bool
    monodromy: np.ndarray

    @property
    def u(self) -> Any:
        return self.look.u

    @property
    def tangent(self) -> Any:
        return self.look.tangent

    @property
    def parameter(self) -> float:
        return float(self.look.parameter)

    @property
    def turned(self) -> "OrbitPoint":
        look = self.look
        branch = look.branch * np.array([-1, 1])  # the sign of a determinant of which the tangent is a row
        return dataclasses.replace(self, look=look._replace(tangent=-look.tangent, branch=branch))


def begins_on(test: Test, before: float, after: float) -> bool:
    """Whether a step sets out on a corner."""
    return test.kind in CORNERS and abs(before) < ON < -after


def spot_of(curve: OrbitCurve, look: PointData, itinerary: OrbitItinerary) -> OrbitPoint:
    look = on_host(look)
    return OrbitPoint(look, itinerary, look.multipliers, bool(look.stable), look.monodromy)


def found_out(curve: OrbitCurve, look: PointData, itinerary: OrbitItinerary) -> OrbitPoint | None:
    """None if there is no orbit, or none of which it is known whether it is stable: without derivatives."""
    spot = spot_of(curve, look, itinerary) if bool(look.good) else None
    return None if spot is None or np.isnan(spot.monodromy).any() else spot


def midpoint(curve: OrbitCurve, spot: OrbitPoint, rows: Iterable[int]) -> tuple[float, np.ndarray, np.ndarray]:
    """Time, state and mode in the middle of the longest of some segments, if possible one that no surface holds: beside
    it orbits are near each other, as they need not be beside an event or where static friction holds."""
    look, itinerary = spot.look, spot.itinerary
    length = {}
    for i in rows:
        length[i] = (look.end[i] - look.begin[i]) * (1e-6 if curve.model.holds(itinerary.mode[i]) else 1.0)
    longest = max(length.values())
    best = next(i for i in length if length[i] >= longest - 1e-6 * abs(longest))
    t = float(look.begin[best] + look.end[best]) / 2
    return t, state_at(curve, itinerary, look, best, t), np.asarray(itinerary.mode[best])


@dataclasses.dataclass
class OrbitTracer(AbstractTracer[OrbitPoint]):
    """Follows branches; virtual ones to the ends of the interval, whatever they meet."""

    curve: OrbitCurve
    virtual: bool = False

    lost = "the last orbit that could be found"

    def at(self, spot: OrbitPoint, s: float, guess: Any = None) -> OrbitPoint | None:
        found = correct(self.curve, spot.itinerary, Plane(spot.look.u, spot.look.tangent, s), guess)
        return found_out(self.curve, found, spot.itinerary)

    def between(self, a: OrbitPoint, b: OrbitPoint, value: float) -> OrbitPoint | None:
        """The point between two others at which the parameter has this value."""
        length = float(a.look.tangent @ (b.look.u - a.look.u))
        seen = {0.0: a, length: b}

        def at(s: float) -> OrbitPoint | None:
            return self.at(a, s, a.look.u + s / length * (b.look.u - a.look.u))

        try:
            return seen[bracketed(seen, at, lambda spot: spot.parameter - value)]
        except (ArithmeticError, ValueError):
            return None

    def orbit_near(self, itinerary: OrbitItinerary, guess: Any, border: Any = None) -> OrbitPoint | None:
        """The orbit of an itinerary next to a guess, at the same parameter (or on another plane)."""
        border = np.eye(len(guess))[-1] if border is None else border
        found = correct(self.curve, itinerary, Plane(guess, border))
        return found_out(self.curve, found, itinerary)

    def passes(self, zero: Zero) -> bool:
        return zero.test.kind in PASSED

    def select(self, point: OrbitPoint, zeros: list[Zero], length: float) -> tuple[Zero, ...]:
        return tuple(
            zero for zero in zeros if zero.test.kind != "Neimark-Sacker" or complex_pair(zero.point.multipliers)
        )

    def closes(self, begin: OrbitPoint, spot: OrbitPoint, step: OrbitPoint, length: float) -> bool:
        value, upwards = begin.parameter, step.parameter > spot.parameter
        if not min(spot.parameter, step.parameter) <= value < max(spot.parameter, step.parameter):
            return False
        if begin.itinerary.key() != spot.itinerary.key() or (begin.look.tangent[-1] > 0) != upwards:
            return False
        here = self.between(spot, step, value)
        return here is not None and alike(here, begin, self.curve, SAME)

    def zeros(self, spot: OrbitPoint, step: OrbitPoint, length: float, turned: bool) -> list[Zero] | None:
        """Up to the first at which the itinerary ends."""
        back = returning(self.curve.model, spot.itinerary)
        if turned or any(abs(step.look.end[i] - step.look.begin[i]) < ON for i in back):
            return None
        scale = float(spot.look.branch[1])
        found, lost = self.sign_changes(spot, step, length, scale)
        for test in lost:
            # Beside a singular point, which another test function may know.
            small = SINGULAR if test == BRANCH else VANISHES
            at = next(
                (z for z in found if abs(test_values(self.curve, z.point, scale).get(test, np.inf)) < small), None
            )
            if at is None and (test != BRANCH or length > UNSEEN):
                return None
            found += [] if at is None else [at._replace(test=test)]
        # What turns round at a branch point that it crosses is no fold.
        branching = [z.s for z in found if z.test == BRANCH]
        found = [z for z in found if z.test.kind != "fold" or all(abs(z.s - s) > ASIDE * length for s in branching)]
        found.sort(key=lambda zero: zero.s)
        near = NEAR * length + 1e-9
        final = next((z for z in found if z.test.kind not in PASSED), None)
        if final is None:
            return found
        return self.up_to_end(spot, self.with_those_before(spot, final, found, near, scale), near)

    def sign_changes(
        self, spot: OrbitPoint, step: OrbitPoint, length: float, scale: float
    ) -> tuple[list[Zero], list[Test]]:
        """The zeros of the test functions that change their sign between two points, and those whose zero is not to be
        found."""
        before, after = (test_values(self.curve, p, scale) for p in (spot, step))
        found, lost, seen = [], [], {0.0: spot, length: step}
        changing = [t for t, v in before.items() if t in after and self.changes(t, v, after[t])]
        for test in sorted(changing, key=lambda test: RANK.get(test.kind, 99)):
            if begins_on(test, before[test], after[test]):
                found.append(Zero(0.0, test, spot))
                continue
            zero = self.shared(seen, found, test, scale) or self.locate(seen, test, scale)
            found += [] if zero is None else [zero]
            lost += [test] if zero is None else []
        return found, lost

    def changes(self, test: Test, before: float, after: float) -> bool:
        """Whether a test function has a zero between two values that is to be looked for."""
        if after == 0 or (self.virtual and test.kind not in ("low", "high")):
            return False
        if begins_on(test, before, after):
            return True
        if before * after > 0:  # (one that is not a number may have changed its sign)
            return False
        # What rises at a corner comes from where it could not be: a start on the point itself.
        return not (test.kind in (*CORNERS, "low", "high") and after > 0)

    def shared(self, seen: dict[float, OrbitPoint], found: list[Zero], test: Test, scale: float) -> Zero | None:
        """The zero of another test function, if this one too changes its sign where zeros are one: at a corner ten of
        them may vanish."""
        length = max(seen)
        for zero in found:
            sides = [zero.s + side * NEAR / 2 * length for side in (-1, 1)]
            if sides[0] <= 0 or sides[1] >= length:
                continue
            for s in sides:
                here = seen.get(s) or self.on_chord(seen, s)
                seen |= {} if here is None else {s: here}
            values = [test_values(self.curve, seen[s], scale).get(test, np.nan) for s in sides if s in seen]
            if len(values) == 2 and values[0] * values[1] < 0:
                return zero._replace(test=test)
        return None

    def on_chord(self, seen: dict[float, OrbitPoint], s: float) -> OrbitPoint | None:
        """The point at a distance from the first, between it and the last."""
        spot, length = seen[0.0], max(seen)
        return self.at(spot, s, spot.look.u + s / length * (seen[length].look.u - spot.look.u))

    def with_those_before(
        self, spot: OrbitPoint, final: Zero, found: list[Zero], near: float, scale: float
    ) -> list[Zero]:
        """What lies before the end of the itinerary may have changed back beyond it, or at the end itself: a place a
        little before that tells. (At a branch point it may turn.)"""
        s, last = self.short_of(spot, final, 2 * near)
        before, there = (test_values(self.curve, p, scale) for p in (spot, last))
        for test in (t for t in before if t.kind in PASSED and before[t] * there[t] < 0):
            if test.kind == "fold" and final.test == BRANCH:
                continue
            if any(z.test == test and z.s <= final.s for z in found):
                continue
            zero = self.locate({0.0: spot, s: last}, test, scale)
            found = found if zero is None else [*found, zero]
        return sorted(found, key=lambda zero: zero.s)

    def up_to_end(self, spot: OrbitPoint, found: list[Zero], near: float) -> list[Zero]:
        """The zeros up to the first at which the itinerary ends, with all that vanishes there."""
        end = next(i for i, zero in enumerate(found) if zero.test.kind not in PASSED)
        others = [z for z in found if z is not found[end] and self.together(found[end], z, near)]
        last = self.with_others(spot, found[end], others)
        out = found[:end]
        if last.test.kind in (*CORNERS, "branch"):
            # A test function may pass its zero together with the corner's; it is the corner's then.
            out = [z for z in out if last.s - z.s > near]
        return [*out, last]

    def together(self, zero: Zero, other: Zero, near: float) -> bool:
        """Whether two zeros are one. Beside a segment that vanishes a guard does so with a power of its duration, and
        where is known the less: what is zero at the other one too was found too soon."""
        if abs(other.s - zero.s) < near:
            return True
        least = other.point.look.least[zero.test.row, zero.test.slot]
        return zero.test.kind == "guard" and other.test.kind in CORNERS and abs(float(least)) < ON

    def short_of(self, spot: OrbitPoint, zero: Zero, off: float) -> tuple[float, OrbitPoint]:
        """The point a given distance before a zero on the way from another point; or the zero."""
        s = zero.s - off
        here = None if s <= 0 else self.at(spot, s, spot.look.u + s / zero.s * (zero.point.look.u - spot.look.u))
        return (zero.s, zero.point) if here is None else (s, here)

    def with_others(self, before: OrbitPoint, zero: Zero, together: list[Zero]) -> Zero:
        """What vanishes at one point, by the first of `CORNERS`."""
        several = sorted([zero, *together], key=lambda z: RANK.get(z.test.kind, 99))
        first = several[0]
        others = tuple(dict.fromkeys(z.test for z in several[1:]))
        off = before.parameter - first.point.parameter
        side = int(np.sign(off if off else -before.look.tangent[-1]))
        return first._replace(others=others, side=side)

    def locate(self, seen: dict[float, OrbitPoint], test: Test, scale: float) -> Zero | None:
        """By bracketing, between points by their distance from the first: the curve is smooth there, and so is the test
        function, except the least value of a guard."""
        length = max(seen)
        spot, step = seen[0.0], seen[length]
        chord = step.look.u - spot.look.u
        if test.kind == "duration" and test.row in returning(self.curve.model, spot.itinerary):
            begin, end = (test_values(self.curve, p, scale)[test] for p in (spot, step))
            return self.interpolate(spot, length * begin / (begin - end), length, chord, scale, test)

        # (At the beginning of a segment the least value of a guard is smooth.)
        inside = any(p.look.where[test.row, test.slot] > 0 for p in (spot, step)) if test.kind == "guard" else False
        s, rough = None, inside
        try:
            xtol = 1e-5 * length if rough else 1e-14
            s = bracketed(
                seen, lambda s: self.on_chord(seen, s), lambda here: test_values(self.curve, here, scale)[test], xtol
            )
        except (ArithmeticError, KeyError):  # beyond where the test function is a number
            pass
        if s is None or test == BRANCH:
            # Beside its zero the equations are singular: the last that could be solved tells about where.
            s = min(
                (s for s in seen if s > 0), key=lambda s: abs(test_values(self.curve, seen[s], scale).get(test, np.inf))
            )
            return self.interpolate(spot, s, length, chord, scale, test)
        return Zero(s, test, seen[s])

    def interpolate(
        self, spot: OrbitPoint, s: float, length: float, chord: Any, scale: float, test: Test
    ) -> Zero | None:
        """A point at which the equations are singular, from points beside it. Where a duration vanishes, from points
        so near at last that the polynomial has no error: orbits on which the segment has none anyway are none."""
        found, place, along = None, spot.look.u + s / length * chord, chord / length

        def value(here: OrbitPoint) -> float:
            size = test_values(self.curve, here, scale)[test]
            if test.kind == "duration" and abs(size) < ON:
                raise ArithmeticError("this is an orbit on which the segment has no duration anyway")
            return size

        for reach in (0.5, 0.05) if test.kind == "duration" else (0.5,):

            def at(x: float, s: float = s, place: Any = place, along: Any = along) -> OrbitPoint | None:
                return self.at(spot, x, place + (x - s) * along)

            try:
                found = interpolated(s, reach * length, at, value)
            except ArithmeticError:
                break
            s, place = found.s, found.at(lambda here: here.look.u)
            along = found.points[-1].look.u - place
            along = along / float(along @ spot.look.tangent)
        if found is None:
            return None
        look = correct(self.curve, spot.itinerary, Plane(place, spot.look.tangent), newton=False)
        point = spot_of(self.curve, look, spot.itinerary)
        return None if test.kind in ("low", "high") and np.isnan(point.monodromy).any() else Zero(s, test, point)


def alike(a: OrbitPoint, b: OrbitPoint, curve: OrbitCurve, tolerance: float) -> bool:
    """Whether two orbits of one parameter are the same, or one of them the other several times."""
    sizes = np.asarray(curve.sizes)
    pairs = ((a.look.mean, b.look.mean, sizes), (a.look.square, b.look.square, sizes**2))
    return all(float(np.max(np.abs(x - y) / size)) < tolerance for x, y, size in pairs)
