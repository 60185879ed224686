"""Branches of equilibria."""

import dataclasses

import jax
import numpy as np
from jaxtyping import Bool, Complex, Float, Int

from ..._numerics._text import shown
from ..._types import Y
from ...setvalued._crossing import EigenvalueCrossing
from ...system._system import System
from .._archive import table
from .._branch import AbstractBranch, descends
from ._bifurcation import Bifurcation, HalfBranch, unstable_number
from ._equations import Record


CLOSED = "the start: it is closed"


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

    def _headline(self) -> str:
        return f"{len(self.branches)} {'branches' if self.others else 'branch'} of {type(self.system).__name__}"


Branch.saved = table(Branch, Bifurcation, HalfBranch, EigenvalueCrossing)


@dataclasses.dataclass
class BranchSegment:
    """Points one after the other, and the special ones among them, while they are found."""

    records: list[Record] = dataclasses.field(default_factory=list)
    modes: list[np.ndarray] = dataclasses.field(default_factory=list)
    special: list[tuple[int, Bifurcation]] = dataclasses.field(default_factory=list)
    end: str = ""

    def add(self, record: Record, mode: np.ndarray) -> None:
        self.records.append(record)
        self.modes.append(mode)

    def note(self, bifurcation: Bifurcation) -> None:
        self.special.append((len(self.records) - 1, bifurcation))

    def reversed(self) -> "BranchSegment":
        last = len(self.records) - 1
        return BranchSegment(
            self.records[::-1], self.modes[::-1], [(last - i, b) for i, b in self.special[::-1]], self.end
        )

    def closed(self) -> bool:
        return self.end == CLOSED


def branch_of(system: System, parameter: str, back: BranchSegment, ahead: BranchSegment) -> Branch:
    """Two segments that set out from one point as one branch: upwards, if there is a choice."""
    ends = (back.end, ahead.end)
    back = back.reversed()
    # The common point is there once, or, where eigenvalues jump, from both sides.
    corner = bool(back.special) and back.special[-1][0] == len(back.records) - 1 and back.special[-1][1].discontinuous
    keep = len(back.records) - (0 if corner else 1)
    segment = BranchSegment(back.records[: max(keep, 0)] + ahead.records, back.modes[: max(keep, 0)] + ahead.modes)
    segment.special = [(i, b) for i, b in back.special if i < keep]
    last = segment.special[-1][1] if corner and segment.special else None
    segment.special += [(i + max(keep, 0), b) for i, b in ahead.special if b is not last or i > 0]
    if descends([record.parameter for record in segment.records]):
        segment, ends = segment.reversed(), ends[::-1]
    tree = jax.tree.map(lambda *leaves: np.stack([np.asarray(x) for x in leaves]), *segment.records)
    return Branch(
        system=system,
        parameter=parameter,
        values=tree.parameter,
        ys=tree.y,
        modes=np.stack([mode[0] for mode in segment.modes]),
        multipliers=tree.multipliers,
        eigenvalues=tree.eigenvalues,
        unstable=unstable_number(tree.eigenvalues),
        stable=tree.stable,
        special=tuple(b for _, b in segment.special),
        indices=tuple(i for i, _ in segment.special),
        ends=ends,
    )
