"""Continuations that are under way, be they of equilibria or of periodic orbits."""

import abc
import dataclasses
import inspect
import os
import warnings
from collections.abc import Callable
from typing import Any, ClassVar, Generic, ParamSpec, Self, TypeVar

import jax.numpy as jnp

from .._numerics._progress import Told
from ..flow._archive import Archive, save, table, Types
from ..system._model import SwitchedSystem
from ..system._parameter import parameter_path, Path
from ._branch import AbstractBranch, BranchSegment
from ._explorer import AbstractExplorer, Tree
from ._tracer import P, Trace, Zero


BranchT = TypeVar("BranchT", bound=AbstractBranch)
Arguments = ParamSpec("Arguments")
GIVEN = ("model", "path", "free", "like", "integrator", "curve", "tracer", "recorder")  # what follows from the rest


class AbstractContinuation(abc.ABC, Generic[P, BranchT]):
    """Iterates over the points of branches as they are found; see `EquilibriumContinuation` and `OrbitContinuation`."""

    _parts: ClassVar[tuple[type, type, type]]  # of the curve, of what follows it, and of what explores all branches
    _types: ClassVar[Types]  # of what a file holds
    _join: ClassVar[Callable[..., Any]]  # two segments that set out from one point, as one branch

    _explorer: AbstractExplorer
    _tree: Tree
    _told: Told

    def _begin(self, explorer: AbstractExplorer, tree: Tree, told: Told) -> Self:
        self._explorer, self._tree, self._told = explorer, tree, told
        return self

    def __iter__(self) -> Self:
        return self

    def __next__(self) -> P:
        while self._tree.trace is not None:
            self._tree, point = self._explorer.further(self._tree)
            if self._tree.trace is None and next(self._tree.places(), None) is not None:
                warnings.warn(
                    f"There are more than `max_branches` = {self._explorer.max_branches} branches.", stacklevel=3
                )
            if point is not None:
                self._told.show(self)
                return point
        raise StopIteration

    def run(self) -> BranchT:
        """Goes on to the end, and returns the branch."""
        with self._told:
            for _ in self:
                pass
        return self.branch

    @property
    def branch(self) -> BranchT:
        """What was found so far."""
        curve, name = self._explorer.tracer.curve, self._explorer.name
        first, *others = (self._join(curve, name, *pair) for pair in self._tree.branches)
        return dataclasses.replace(first, others=tuple(others))

    def __str__(self) -> str:
        segments = [segment for pair in self._tree.branches for segment in pair]
        special = {id(found) for segment in segments for _, found in segment.special}
        value = next(segment.points[-1].parameter for segment in self._tree.branches[-1] if segment.points)
        return (
            f"branch {len(self._tree.branches)}, {sum(len(segment.points) for segment in segments)} points, "
            f"{self._explorer.name} = {value:.6g}, {len(special)} special points"
        )

    def save(self, path: str | os.PathLike) -> None:
        """Writes all that is known so far to a file, an `.npz` of plain arrays with a description in JSON: at any time,
        also after an interrupt."""
        tracer, curve = self._explorer.tracer, self._explorer.tracer.curve
        parts = dict(curve=_given(curve), tracer=_given(tracer), explorer=_given(self._explorer), tree=self._tree)
        save(path, type(self).__name__, self._types, curve.model.system, curve.like, parts | self._more(), curve=curve)

    def _more(self) -> dict[str, Any]:
        """Further parts of a file."""
        return {}

    @classmethod
    def _loaded(
        cls,
        archive: Archive,
        told: Told,
        for_curve: Callable[[Path], dict[str, Any]],
        for_explorer: dict[str, Any],
        smooth: bool = False,
    ) -> Self:
        """From a file, with what that does not hold: of the curve, given the path of its parameter. `smooth`: see
        `SwitchedSystem`."""
        curve_type, tracer_type, explorer_type = cls._parts
        given, time = archive.part("explorer"), jnp.zeros(())  # of which the model takes the shape only
        curve = curve_type(
            model=SwitchedSystem.forwards(archive.system, time, archive.y, smooth),
            like=archive.y,
            **archive.part("curve"),
            **for_curve(parameter_path(archive.system, given["name"])),
        )
        explorer = explorer_type(tracer_type(curve, **archive.part("tracer")), **given, **for_explorer)
        return cls.__new__(cls)._begin(explorer, archive.part("tree", curve=curve), told)


def _given(part: Any) -> dict[str, Any]:
    return {f.name: getattr(part, f.name) for f in dataclasses.fields(part) if f.name not in GIVEN}


def growth_types(branch: type[AbstractBranch], *own: type) -> Types:
    return {**branch.saved, **table(Tree, Trace, Zero, BranchSegment, *own)}


def with_arguments_of(
    begin: Callable[Arguments, AbstractContinuation[Any, BranchT]], fn: Callable[..., Any], returns: type
) -> Callable[Arguments, BranchT]:
    """A function that hands its arguments on shows them to people and to type checkers: with both given at once, as
    otherwise those lose the type of the state."""
    vars(fn)["__signature__"] = inspect.signature(begin).replace(return_annotation=returns)
    return fn
