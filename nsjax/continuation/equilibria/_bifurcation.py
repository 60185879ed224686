"""Special points of branches, and what makes them so."""

import dataclasses
from collections.abc import Sequence
from typing import Any

import jax.flatten_util as jfu
import numpy as np

from ..._numerics._text import listed, shown
from ..._types import Y
from ...setvalued._crossing import EigenvalueCrossing
from .._special_point import AbstractHalfBranch, AbstractSpecialPoint


@shown
class HalfBranch(AbstractHalfBranch):
    """A branch on one side of a special point.

    **Attributes:**

    - `side`: -1 if it lies below the point's parameter value, +1 above it, 0 if it stays there: a continuum of
        equilibria at one value.
    - `mode`: of the switches, on it.
    - `tangent`: of the branch, away from the point: the state's part, and the parameter's; of length one in the units
        of the continuation.
    - `eigenvalues`: on it, next to the point.
    - `unstable`: how many of them have positive real parts.
    - `stable`: whether the equilibria on it are.
    - `index`: the sign of the determinant of the equations: that changes where an eigenvalue passes zero.
    """

    side: int
    mode: np.ndarray
    tangent: tuple[Y, float]
    eigenvalues: np.ndarray
    unstable: int
    stable: bool
    index: int

    def __str__(self) -> str:
        mode = f"mode ({listed(self.mode)}), " if len(self.mode) else ""
        return f"{self.place}: {mode}eigenvalues {listed(self.eigenvalues, 6, 4)}"


@shown
class Bifurcation(AbstractSpecialPoint):
    """A special point of a branch: a bifurcation, or a place that only looks like one.

    **Attributes:**

    - `kind`: "saddle-node", "transcritical", "pitchfork", "Hopf", or several of them at once, as "Hopf-pitchfork".
        "none" where the branch crosses a surface without bifurcation, "hysteresis point" where it is vertical without
        turning back (Fig. 5.1), "end" where there is no equilibrium beyond, "continuum" where there is one at this very
        value of the parameter, "3 to 2" (the numbers below and above) for what has no name.
    - `discontinuous`: whether eigenvalues jump there: the point lies on surfaces of switches.
    - `criticality`: "supercritical", "subcritical", or None if the kind knows no such thing, or it is not known.
    - `evidence`: what supports the kind: "count" of the equilibria (Definition 5.1), "crossing" of the imaginary axis
        by set-valued eigenvalues (Conjecture 5.2; at a smooth point by eigenvalues), or "both".
    - `by_count`: the kind that the number of equilibria on each side suggests; it knows nothing of Hopf bifurcations.
    - `by_crossing`: the kinds that the crossings suggest, "branch point" being a transcritical or a pitchfork
        bifurcation; None at a surface where the field jumps, which has no generalized Jacobian.
    - `parameter`, `value`: its name, and the value at the point.
    - `y`: the state there.
    - `count`: how many equilibria there are nearby below this value, and above it.
    - `surfaces`: the switches on whose surfaces the point lies, or at whose bounds their values are.
    - `crossings`: of the axis on the way J(q) from the one-sided Jacobian of one half-branch to that of its
        continuation (4.19), (4.21); none at a smooth point.
    - `places`: for each crossing, where it is between the sides of each surface: {name: q}, q = 0 where h < 0.
    - `halves`: the half-branches that meet there.
    - `period`: of the periodic orbits born there, at the point; None if there are none.
    - `orbits`: how many of them were found below and above; None if they were not looked for. See `hopf_orbits`.
    """

    plain = {"hysteresis point": "hysteresis point", "end": "end", "continuum": "continuum of equilibria"}

    kind: str
    discontinuous: bool
    criticality: str | None
    evidence: str
    by_count: str
    by_crossing: tuple[str, ...] | None
    parameter: str
    value: float
    y: Y
    count: tuple[int, int]
    surfaces: tuple[str, ...]
    crossings: Sequence[EigenvalueCrossing]
    places: Sequence[dict[str, float]]
    halves: Sequence[HalfBranch]
    period: float | None
    orbits: tuple[int, int] | None = None

    def _what_happens(self) -> str:
        return "the eigenvalues jump" if self.crossings == [] else "corner"

    def with_orbits(self, below: Sequence[Sequence[Any]], above: Sequence[Sequence[Any]]) -> "Bifurcation":
        """The same, with the count of periodic orbits that `hopf_orbits` finds for further evidence (Definition 5.1). A
        Hopf bifurcation is supercritical where they attract, subcritical where they repel."""
        if "Hopf" not in self.kind or len(below) == len(above) == 0:
            return self
        criticality = self.criticality
        stable = {bool(family[0].stable) for family in [*below, *above]}
        if self.kind == "Hopf" and len(stable) == 1:
            criticality = "supercritical" if stable.pop() else "subcritical"
        evidence = "both" if self.by_count == "none" else self.evidence
        return dataclasses.replace(self, orbits=(len(below), len(above)), evidence=evidence, criticality=criticality)

    def __str__(self) -> str:
        state = ", ".join(f"{_plain(x)}" for x in np.asarray(jfu.ravel_pytree(self.y)[0]))
        lines = [f"{self.name} at {self.parameter} = {_plain(self.value)}, y = ({state})"]
        if self.surfaces:
            lines.append(f"  surfaces   {', '.join(self.surfaces)}")
        lines.append(f"  evidence   {self.evidence}: equilibria {self.count[0]} -> {self.count[1]} ({self.by_count})")
        if self.orbits is not None:
            lines.append(f"             periodic orbits {self.orbits[0]} -> {self.orbits[1]}")
        if self.by_crossing is None:
            lines.append("             the field jumps there: no generalized Jacobian")
        for crossing, place in zip(self.crossings, self.places):
            where = ", ".join(f"q_{name} = {q:.10g}" for name, q in place.items() if 0 < q < 1)
            lines.append(f"  crossing   {crossing}" + (f" ({where})" if len(place) > 1 and where else ""))
        if self.period is not None:
            lines.append(f"  period     {self.period:.12g}")
        return "\n".join(lines)


def unstable_number(roots: Any) -> Any:
    """How many eigenvalues have positive real parts, beyond rounding; over the last axis."""
    roots = np.asarray(roots)
    size = np.nanmax(np.abs(roots), axis=-1, keepdims=True, initial=1e-300)
    return np.sum(np.real(roots) > 1e-10 * size, axis=-1)


def _plain(x: float) -> str:
    """What is rounding of zero is printed so."""
    return f"{0.0 if abs(x) < 1e-13 else x:.10g}"


def kind_by_count(halves: Sequence[HalfBranch]) -> tuple[str, str | None]:
    """The kind that the number of equilibria suggests, and its criticality."""
    below, above = ([half for half in halves if half.side == side] for side in (-1, 1))
    numbers = len(below), len(above)
    if any(half.side == 0 for half in halves):
        return "continuum", None
    if sorted(numbers) == [0, 2]:
        return "saddle-node", None
    if numbers == (1, 1):
        return "none", None
    if numbers == (2, 2):
        return "transcritical", None
    if sorted(numbers) == [1, 3]:
        three = below if len(below) == 3 else above
        middle = odd_one(three)
        outer = [half for half in three if half is not middle]
        if middle is None or outer[0].unstable == middle.unstable:
            return "pitchfork", None
        return "pitchfork", "supercritical" if middle.unstable > outer[0].unstable else "subcritical"
    if 0 in numbers and sum(numbers) == 1:
        return "end", None
    return f"{numbers[0]} to {numbers[1]}", None


def odd_one(three: Sequence[HalfBranch]) -> HalfBranch | None:
    """That whose index the two others do not have: the middle branch of a pitchfork."""
    for half in three:
        others = [other for other in three if other is not half]
        if all(other.index == -half.index for other in others):
            return half
    return None


def classify(by_count: str, by_crossing: tuple[str, ...] | None) -> tuple[str, str]:
    """The kind, and what supports it. Definition 5.1 says what a static bifurcation is, and so the count decides where
    the two disagree: an eigenvalue may pass zero twice, and nothing happen (section 5.8)."""
    static = by_count if by_count != "none" else ""
    if by_crossing is None:
        return static or "none", "count"
    hopf = [kind for kind in by_crossing if kind == "Hopf"]
    zeros = [kind for kind in by_crossing if kind != "Hopf"]
    expected = {"": [], "saddle-node": ["saddle-node"]}.get(static, ["branch point"])
    agree = zeros == expected
    kind = "-".join(hopf + [static] * bool(static)) or "none"
    if not static and hopf:
        return kind, "crossing"
    return kind, "both" if agree else "count"
