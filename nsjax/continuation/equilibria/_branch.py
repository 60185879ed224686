"""Branches of equilibria."""

import jax
import numpy as np
from jaxtyping import Bool, Complex, Float, Int

from ..._numerics._text import components, shown
from ..._types import Y
from ...flow._archive import table
from ...setvalued._crossing import EigenvalueCrossing
from ...system._system import System
from .._branch import AbstractBranch, BranchSegment, descends, named_apart
from ._bifurcation import Bifurcation, HalfBranch, unstable_number
from ._equations import EquilibriumCurve


@shown
class Branch(AbstractBranch[Bifurcation]):
    """A curve of equilibria over a parameter.

    **Attributes:**

    - `system`, `parameter`: the model, and the name of the parameter.
    - `values`: of the parameter, at each point.
    - `ys`: the states, leaves with a leading axis.
    - `modes`, `multipliers`: of the switches; shape `(points, switches)`.
    - `eigenvalues`: shape `(points, n)`; NaN for the directions that surfaces take.
    - `unstable`: how many eigenvalues have positive real parts.
    - `stable`: whether all have negative ones, and surfaces that hold the point attract.
    - `special`: the special points on it, in their order: bifurcations, and what looks like one.
    - `indices`: at which point of the branch each is. A corner is there twice, with the eigenvalues of both sides.
    - `ends`: why it begins and ends where it does.
    - `others`: the other branches that were found at bifurcations, on the one that `continue_equilibrium` returns.
    """

    system: System
    parameter: str
    values: Float[np.ndarray, " points"]
    ys: Y
    modes: Int[np.ndarray, "points switches"]
    multipliers: Float[np.ndarray, "points switches"]
    eigenvalues: Complex[np.ndarray, "points n"]
    unstable: Int[np.ndarray, " points"]
    stable: Bool[np.ndarray, " points"]
    special: tuple[Bifurcation, ...]
    indices: tuple[int, ...]
    ends: tuple[str, str]
    others: "tuple[Branch, ...]" = ()

    def _further(self) -> dict[str, np.ndarray]:
        names = [switch.name for switch in self.system.switches]
        columns = named_apart(components(self.ys, 1), self.parameter)
        columns |= {f"mode.{name}": self.modes[:, k] for k, name in enumerate(names)}
        columns |= {f"multiplier.{name}": self.multipliers[:, k] for k, name in enumerate(names)}
        return columns | dict(eigenvalue=self.eigenvalues, unstable=self.unstable)

    def _headline(self) -> str:
        return f"{len(self.branches)} {'branches' if self.others else 'branch'} of {type(self.system).__name__}"


Branch.saved = table(Branch, Bifurcation, HalfBranch, EigenvalueCrossing)


def branch_of(curve: EquilibriumCurve, parameter: str, back: BranchSegment, ahead: BranchSegment) -> Branch:
    """Two segments that set out from one point as one branch: upwards, if there is a choice."""
    ends = (back.end, ahead.end)
    back, keep = back.reversed(), len(back.points)
    # The common point is there once, or, where eigenvalues jump, from both sides.
    corner = bool(back.special) and back.special[-1][0] == keep - 1 and back.special[-1][1].discontinuous
    keep = max(keep - (0 if corner else 1), 0)
    last = next((b for i, b in back.special[::-1] if corner and i < keep), None)
    segment = back.join(ahead, keep, last)
    if descends([point.parameter for point in segment.points]):
        segment, ends = segment.reversed(), ends[::-1]
    records = [point.record for point in segment.points]
    tree = jax.tree.map(lambda *leaves: np.stack([np.asarray(x) for x in leaves]), *records)
    return Branch(
        system=curve.model.system,
        parameter=parameter,
        values=tree.parameter,
        ys=tree.y,
        modes=np.stack([point.mode[0] for point in segment.points]),
        multipliers=tree.multipliers,
        eigenvalues=tree.eigenvalues,
        unstable=unstable_number(tree.eigenvalues),
        stable=tree.stable,
        special=tuple(b for _, b in segment.special),
        indices=tuple(i for i, _ in segment.special),
        ends=ends,
    )
