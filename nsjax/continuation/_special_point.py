"""What special points of branches have in common, be the branches of equilibria or of periodic orbits."""

import abc
from typing import ClassVar

import equinox as eqx


class AbstractHalfBranch(eqx.Module):
    """A branch on one side of a special point: -1 below its parameter value, +1 above it, 0 where it stays there."""

    side: eqx.AbstractVar[int]
    stable: eqx.AbstractVar[bool]

    @property
    def place(self) -> str:
        return f"{'stable' if self.stable else 'unstable'} half-branch {('at the point', 'above', 'below')[self.side]}"


class AbstractSpecialPoint(eqx.Module):
    """A bifurcation, or a place that only looks like one; see `Bifurcation` and `OrbitBifurcation`."""

    plain: ClassVar[dict[str, str]]  # kinds that have a name of their own

    kind: eqx.AbstractVar[str]
    discontinuous: eqx.AbstractVar[bool]
    criticality: eqx.AbstractVar[str | None]
    value: eqx.AbstractVar[float]

    @property
    def is_bifurcation(self) -> bool:
        """Whether it is one: not where the branch crosses a surface and nothing else happens, where it is vertical
        without turning back, or where it ends. An "unresolved" point counts: there is at least one beside it."""
        return self.kind not in ("none", "hysteresis point", "end")

    @property
    def name(self) -> str:
        """As the thesis says it: "discontinuous pitchfork bifurcation, supercritical"."""
        if self.kind == "none":
            return f"no bifurcation: {self._what_happens()}"
        if self.kind in self.plain:
            return self.plain[self.kind]
        words = ["discontinuous"] * self.discontinuous + [self.kind, "bifurcation"]
        return " ".join(words) + (f", {self.criticality}" if self.criticality else "")

    @abc.abstractmethod
    def _what_happens(self) -> str:
        """At a point that is no bifurcation."""
