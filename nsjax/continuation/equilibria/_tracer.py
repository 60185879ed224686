"""Along a curve in one mode, step by step, to the next point where others meet it."""

import dataclasses
from typing import Any

import jax.numpy as jnp
import numpy as np

from .._step_length import FIRST, next_length, shortened, turn_between, TURNED
from ._bifurcation import unstable_number
from ._branch import BranchSegment, CLOSED
from ._corner import active, fold_at, hopf_at
from ._corrector import (
    BRANCH,
    branch_point,
    FOLD,
    GUARDS,
    HIGH,
    kept,
    locate,
    LOW,
    MARK,
    on_surface,
    PAIR,
    Place,
    Step,
    step_along,
)
from ._equations import EITHER, EquilibriumCurve, Record


TURN = 0.1  # the angle between tangents that is aimed at
SIDE = 1e-11  # distance from a surface that counts as on its wrong side
DOUBLE = 1e-9  # value of a test function, relative to that at the ends of a step, that counts as a double zero
UNSEEN = 1e-6  # steps that are not shortened any more for the sake of what a step might hide
SAME = 1e-7  # a branch point is located to about so much before it is improved


@dataclasses.dataclass
class Zero:
    """A zero of the test function `which`."""

    s: float
    which: int
    place: Place


@dataclasses.dataclass
class Tracer:
    """Traces arcs of a curve. `marks` are the points passed at the start's value of the parameter."""

    curve: EquilibriumCurve
    name: str
    max_step: float
    max_points: int
    begin: tuple[Any, Any, np.ndarray] | None = None
    marks: list[Any] = dataclasses.field(default_factory=list)

    def value(self, u: Any) -> float:
        return float(self.curve.parts(u)[2])

    def arc(self, segment: BranchSegment, u: Any, tangent: Any, mode: np.ndarray) -> tuple[Any, Any]:
        """Adds points to `segment` up to one where other branches may meet, and returns it with the tangent there; or
        to the end of the branch, which `segment.end` then names."""
        length, traced = FIRST, jnp.asarray(mode)
        while len(segment.records) < self.max_points:

            def attempt(length: float, u: Any = u, tangent: Any = tangent) -> tuple[Step, float, list[Zero]] | None:
                step = step_along(self.curve, u, tangent, jnp.asarray(length), traced)
                turn = float(turn_between(*map(np.asarray, (tangent, step.tangent)))) if step.good else np.inf
                zeros = self.zeros(step, u, tangent, mode, length) if step.good else None
                if turn > TURNED and zeros is not None:
                    # Beyond a surface the equations may have a kink that no switch tells of; up to it they are smooth.
                    zeros = zeros if zeros and zeros[-1].which >= GUARDS else None
                if zeros == [] and length > UNSEEN and self.changed(segment.records[-1], step.record):
                    zeros = None
                return None if zeros is None else (step, turn, zeros)

            found = shortened(length, attempt)
            if found is None:
                return self.stuck(segment, u, tangent, mode)
            length, (step, turn, zeros) = found
            for zero in zeros:
                if zero.which not in (FOLD, PAIR, MARK):
                    return self.stop(segment, zero, tangent, mode)
                self.pass_by(segment, zero, mode, length)
            if self.closes(u, step.u, mode, len(segment.records)):
                segment.end = CLOSED
                segment.add(segment.records[0], segment.modes[0])
                return step.u, step.tangent
            u, tangent = step.u, step.tangent
            segment.add(step.record, mode)
            length = float(next_length(length, turn, *map(np.asarray, (tangent, u)), self.max_step, TURN))
        segment.end = f"max_points = {self.max_points}, {self.name} = {self.value(u):.6g}"
        return u, tangent

    def stuck(self, segment: BranchSegment, u: Any, tangent: Any, mode: np.ndarray) -> tuple[Any, Any]:
        """Where no step goes on."""
        on, traced = np.flatnonzero(active(self.curve, u, mode)), jnp.asarray(mode)
        if len(on):
            # There is no way past the surface with this side's equations: one ends on it.
            u = on_surface(self.curve, u, traced, jnp.asarray(on[0]))
            segment.add(kept(self.curve, u, traced), mode)
        else:
            segment.end = f"the last point that could be found, {self.name} = {self.value(u):.6g}"
        return u, tangent

    def stop(self, segment: BranchSegment, zero: Zero, tangent: Any, mode: np.ndarray) -> tuple[Any, Any]:
        u, record = zero.place.u, kept(self.curve, zero.place.u, jnp.asarray(mode))
        if zero.which == BRANCH:
            point, good = branch_point(self.curve, u, jnp.asarray(mode))
            u = point if good and float(jnp.max(jnp.abs(point - u))) < 1e-5 else u
            # There an eigenvalue is zero, whose sign would be that of rounding.
            before = segment.records[-1]
            record = kept(self.curve, u, jnp.asarray(mode))
            record = record._replace(eigenvalues=before.eigenvalues, stable=before.stable)
        if zero.s > 0:
            segment.add(record, mode)
        if zero.which in (LOW, HIGH):
            segment.end = f"{self.name} = {self.value(u):.6g}"
            if float(jnp.abs(u[-1] - self.curve.mark)) < 1e-9:
                self.marks.append(self.curve.parts(u)[0])
        return u, tangent if zero.which == BRANCH else zero.place.tangent

    def changed(self, before: Record, after: Record) -> bool:
        """Whether the number of unstable eigenvalues differs beyond doubt."""
        roots = [np.asarray(record.eigenvalues) for record in (before, after)]
        clear = all(
            np.nanmin(np.abs(np.real(r)), initial=np.inf) > 1e-9 * np.nanmax(np.abs(r), initial=0) for r in roots
        )
        return clear and unstable_number(roots[0]) != unstable_number(roots[1])

    def pass_by(self, segment: BranchSegment, zero: Zero, mode: np.ndarray, length: float) -> None:
        u, tangent = zero.place.u, zero.place.tangent
        if zero.which == MARK:
            self.marks.append(self.curve.parts(u)[0])
            return
        described = fold_at if zero.which == FOLD else hopf_at
        bifurcation = described(self.curve, self.name, u, mode, tangent, length / 10)
        if bifurcation is not None:
            segment.add(kept(self.curve, u, jnp.asarray(mode)), mode)
            segment.note(bifurcation)

    def closes(self, u: Any, end: Any, mode: np.ndarray, points: int) -> bool:
        if self.begin is None or points < 4 or not np.array_equal(mode, self.begin[2]):
            return False
        start, tangent, _ = self.begin
        near = jnp.linalg.norm(end - start) < 2 * jnp.linalg.norm(end - u)
        return bool(near & (tangent @ (u - start) < 0) & (tangent @ (end - start) >= 0))

    def zeros(self, step: Step, u: Any, tangent: Any, mode: np.ndarray, length: float) -> list[Zero] | None:
        """The zeros of test functions within a step up to the first that ends the arc, in their order; None if the step
        must be shorter for them to be told."""
        signs = np.concatenate([[1, 1], np.full(GUARDS - 2, EITHER), self.curve.armed(mode)])
        before, after = np.asarray(step.here.values), np.asarray(step.there.values)
        falls, rises = np.asarray(step.here.slopes), np.asarray(step.there.slopes)
        found: list[Zero] = []

        def located(ends: tuple[float, float], which: int, slope: bool = False) -> Zero:
            number, flag = jnp.asarray(which), jnp.asarray(slope)
            place = locate(self.curve, step, u, tangent, jnp.asarray(ends), jnp.asarray(mode), number, slope=flag)
            return Zero(float(place.s), which, place)

        for i in map(int, np.flatnonzero(signs)):
            sign = signs[i] if signs[i] != EITHER else np.sign(before[i])
            v, w, fall, rise = sign * before[i], sign * after[i], sign * falls[i], sign * rises[i]
            one_sided = signs[i] != EITHER
            if not np.isfinite(v) or (not one_sided and abs(v) <= 1e-6 * abs(w)):
                continue  # it sets out from there
            if length > UNSEEN and abs(w) <= max(1e-6 * abs(v), 10 * SIDE * one_sided) and v > 1e-8 * one_sided:
                return None  # no step ends where a zero might be, which neither it nor the next would see
            if one_sided and v <= SIDE:
                if w < -SIDE and i in (LOW, HIGH) and fall < 0:
                    return [Zero(0.0, i, Place(u[0] * 0, u, tangent, u[0] * 0, step.good))]
                if w < -SIDE:
                    return None
            elif w < (-SIDE if one_sided else 0):
                zero = located((0.0, length), i)
                # A determinant may jump instead, where the field has a kink that no switch tells of.
                found += [zero] if one_sided or abs(zero.place.value) <= 1e-3 * max(v, -w) else []
            elif v > SIDE and fall < 0 < rise and _dips(v, w, fall, rise, length):
                # Two zeros, or a double one, of which the ends of the step tell nothing.
                least = located((0.0, length), i, True)
                value = sign * float(least.place.value)
                if value < -DOUBLE * max(v, w):
                    found += [located((0.0, least.s), i), located((least.s, length), i)]
                elif value < DOUBLE * max(v, w):
                    found.append(least)
        found.sort(key=lambda zero: zero.s)
        ends = [zero for zero in found if zero.which not in (FOLD, PAIR, MARK)]
        if not ends:
            return found
        # Where determinants jump on a surface, on account of a kink that no switch tells of, that is no branch point.
        first = next((zero for zero in ends if zero.which >= GUARDS and zero.s < ends[0].s + SAME), ends[0])
        # At a branch point, which is not located as well as the others, the curve itself may be vertical.
        slack = SAME if first.which == BRANCH else 1e-10
        return [zero for zero in found if zero.s < first.s - slack and zero.which in (FOLD, PAIR, MARK)] + [first]


def _dips(v: float, w: float, fall: float, rise: float, length: float) -> bool:
    """Whether the cubic with these values and slopes at its ends comes near to zero between."""
    x = np.linspace(0, 1, 33)
    cubic = (1 + 2 * x) * (1 - x) ** 2 * v + x**2 * (3 - 2 * x) * w
    cubic += length * (x * (1 - x) ** 2 * fall - x**2 * (1 - x) * rise)
    return bool(cubic.min() < 0.3 * min(v, w))
