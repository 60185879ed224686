"""Along a curve of equilibria in one mode, to the next point at which others may meet it."""

import dataclasses
from typing import Any

import numpy as np

from .._tracer import AbstractTracer, Zero
from ._bifurcation import unstable_number
from ._corner import active, EquilibriumPoint, fold_at, hopf_at
from ._corrector import branch_point, Chord, kept, on_surface, step_along
from ._equations import EITHER, EquilibriumCurve, Record
from ._test_functions import BRANCH, FOLD, GUARDS, HIGH, LOW, MARK, PAIR, PASSED


SIDE = 1e-11  # distance from a surface that counts as on its wrong side
DOUBLE = 1e-9  # value of a test function, relative to that at the ends of a step, that counts as a double zero
UNSEEN = 1e-6  # steps that are not shortened any more for the sake of what a step might hide
SAME = 1e-7  # a branch point is located to about so much before it is improved


@dataclasses.dataclass
class EquilibriumTracer(AbstractTracer[EquilibriumPoint]):
    """Follows equilibria in one mode."""

    curve: EquilibriumCurve
    name: str  # of the parameter

    aim = 0.1

    def at(self, point: EquilibriumPoint, s: float) -> EquilibriumPoint | None:
        step = step_along(self.curve, point.u, point.tangent, s, point.mode)
        return EquilibriumPoint(step.u, step.tangent, point.mode, step.record, step) if step.good else None

    def zeros(
        self, before: EquilibriumPoint, after: EquilibriumPoint, length: float, turned: bool
    ) -> list[Zero] | None:
        zeros = self.between(before, after, length)
        if turned and zeros is not None:
            # Beyond a surface the equations may have a kink that no switch tells of; up to it they are smooth.
            zeros = zeros if zeros and zeros[-1].test >= GUARDS else None
        hidden = zeros == [] and length > UNSEEN and self.changed(before.record, after.record)
        return None if hidden else zeros

    def passes(self, zero: Zero) -> bool:
        return zero.test in PASSED

    def closes(self, begin: EquilibriumPoint, before: EquilibriumPoint, after: EquilibriumPoint, length: float) -> bool:
        start, tangent, u, end = begin.u, begin.tangent, before.u, after.u
        near = np.linalg.norm(end - start) < 2 * np.linalg.norm(end - u)
        there = near & (tangent @ (u - start) < 0) & (tangent @ (end - start) >= 0)
        return np.array_equal(after.mode, begin.mode) and bool(there)

    def select(self, point: EquilibriumPoint, zeros: list[Zero], length: float) -> tuple[Zero, ...]:
        """With what bifurcates at those that are passed; without those where nothing does."""
        found, last = [], point
        for zero in zeros:
            here = zero.point
            if zero.test in (FOLD, PAIR):
                described = fold_at if zero.test == FOLD else hopf_at
                special = described(self.curve, self.name, here.u, here.mode, here.tangent, length / 10)
                if special is None:
                    continue
                zero = zero._replace(point=self.point_at(here.u, here), special=special)
                last = zero.point
            elif zero.test != MARK:
                end = self.branch_point(here, point, last) if zero.test == BRANCH else self.point_at(here.u, here)
                zero = zero._replace(point=end, marks=zero.s == 0)
                if zero.test in (LOW, HIGH) and abs(float(end.u[-1] - self.curve.mark)) < 1e-9:
                    found.append(Zero(zero.s, MARK, end, marks=True))
            found.append(zero)
        return tuple(found)

    def branch_point(
        self, here: EquilibriumPoint, before: EquilibriumPoint, last: EquilibriumPoint
    ) -> EquilibriumPoint:
        """Improved; an eigenvalue is zero there, whose sign would be that of rounding."""
        u, good = branch_point(self.curve, here.u, here.mode)
        found = self.point_at(u if good and float(np.max(np.abs(u - here.u))) < 1e-5 else here.u, here)
        record = found.record._replace(eigenvalues=last.record.eigenvalues, stable=last.record.stable)
        return found._replace(tangent=before.tangent, record=record)

    def point_at(self, u: Any, like: EquilibriumPoint) -> EquilibriumPoint:
        return like._replace(u=u, record=kept(self.curve, u, like.mode))

    def dead_end(self, point: EquilibriumPoint) -> Zero | None:
        """Where there is no way past a surface with this side's equations, one ends on it."""
        on = np.flatnonzero(active(self.curve, point.u, point.mode))
        if not len(on):
            return None
        u = on_surface(self.curve, point.u, point.mode, np.asarray(on[0]))
        return Zero(0.0, GUARDS + int(on[0]), self.point_at(u, point))

    def changed(self, before: Record, after: Record) -> bool:
        """Whether the number of unstable eigenvalues differs beyond doubt."""
        roots = [np.asarray(record.eigenvalues) for record in (before, after)]
        clear = all(
            np.nanmin(np.abs(np.real(r)), initial=np.inf) > 1e-9 * np.nanmax(np.abs(r), initial=0) for r in roots
        )
        return clear and unstable_number(roots[0]) != unstable_number(roots[1])

    def between(self, before: EquilibriumPoint, after: EquilibriumPoint, length: float) -> list[Zero] | None:
        """The zeros within a step, by values and slopes of the test functions at its ends."""
        u, tangent, mode, step = before.u, before.tangent, before.mode, after.step
        assert step is not None
        signs = np.concatenate([[1, 1], np.full(GUARDS - 2, EITHER), self.curve.armed(mode)])
        old, new = np.asarray(step.here.values), np.asarray(step.there.values)
        falls, rises = np.asarray(step.here.slopes), np.asarray(step.there.slopes)
        found: list[Zero] = []

        chord = Chord(self.curve, step, u, tangent, mode)

        def located(ends: tuple[float, float], which: int, slope: bool = False) -> tuple[Zero, float]:
            place = chord.zero(*ends, lambda probe: probe.slopes[which] if slope else probe.values[which])
            point = EquilibriumPoint(place.u, place.tangent, mode, before.record)
            return Zero(place.s, which, point, marks=which == MARK), place.value

        for i in map(int, np.flatnonzero(signs)):
            sign = signs[i] if signs[i] != EITHER else np.sign(old[i])
            v, w, fall, rise = sign * old[i], sign * new[i], sign * falls[i], sign * rises[i]
            one_sided = signs[i] != EITHER
            if not np.isfinite(v) or (not one_sided and abs(v) <= 1e-6 * abs(w)):
                continue  # it sets out from there
            if length > UNSEEN and abs(w) <= max(1e-6 * abs(v), 10 * SIDE * one_sided) and v > 1e-8 * one_sided:
                return None  # no step ends where a zero might be, which neither it nor the next would see
            if one_sided and v <= SIDE:
                if w < -SIDE and i in (LOW, HIGH) and fall < 0:
                    return [Zero(0.0, i, before)]
                if w < -SIDE:
                    return None
            elif w < (-SIDE if one_sided else 0):
                zero, value = located((0.0, length), i)
                # A determinant may jump instead, where the field has a kink that no switch tells of.
                found += [zero] if one_sided or abs(value) <= 1e-3 * max(v, -w) else []
            elif v > SIDE and fall < 0 < rise and _dips(v, w, fall, rise, length):
                # Two zeros, or a double one, of which the ends of the step tell nothing.
                least, value = located((0.0, length), i, True)
                value *= sign
                if value < -DOUBLE * max(v, w):
                    found += [located((0.0, least.s), i)[0], located((least.s, length), i)[0]]
                elif value < DOUBLE * max(v, w):
                    found.append(least)
        found.sort(key=lambda zero: zero.s)
        ends = [zero for zero in found if not self.passes(zero)]
        if not ends:
            return found
        # Where determinants jump on a surface, on account of a kink that no switch tells of, that is no branch point.
        first = next((zero for zero in ends if zero.test >= GUARDS and zero.s < ends[0].s + SAME), ends[0])
        # At a branch point, which is not located as well as the others, the curve itself may be vertical.
        slack = SAME if first.test == BRANCH else 1e-10
        return [zero for zero in found if zero.s < first.s - slack and self.passes(zero)] + [first]


def _dips(v: float, w: float, fall: float, rise: float, length: float) -> bool:
    """Whether the cubic with these values and slopes at its ends comes near to zero between."""
    x = np.linspace(0, 1, 33)
    cubic = (1 + 2 * x) * (1 - x) ** 2 * v + x**2 * (3 - 2 * x) * w
    cubic += length * (x * (1 - x) ** 2 * fall - x**2 * (1 - x) * rise)
    return bool(cubic.min() < 0.3 * min(v, w))
