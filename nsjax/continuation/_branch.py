"""What branches have in common, be they of equilibria or of periodic orbits."""

import abc
import dataclasses
import os
from collections.abc import Sequence
from typing import Any, ClassVar, Generic, Self, TypeVar

import equinox as eqx
import jax
import numpy as np
from jaxtyping import Bool, Float

from .._numerics._tables import frame
from .._types import Y
from ..flow._archive import Archive, save, Types
from ..system._system import System
from ._special_point import AbstractSpecialPoint


SpecialT = TypeVar("SpecialT", bound=AbstractSpecialPoint)
CLOSED = "the start: it is closed"  # why a branch ends


class AbstractBranch(eqx.Module, Generic[SpecialT]):
    """A curve of solutions over a parameter; see `Branch` and `OrbitBranch`."""

    saved: ClassVar[Types]  # the types of what a file holds
    not_saved: ClassVar[tuple[type, ...]] = ()

    system: eqx.AbstractVar[System]
    parameter: eqx.AbstractVar[str]
    values: eqx.AbstractVar[Float[np.ndarray, " points"]]
    ys: eqx.AbstractVar[Y]
    stable: eqx.AbstractVar[Bool[np.ndarray, " points"]]
    special: eqx.AbstractVar[tuple[SpecialT, ...]]
    indices: eqx.AbstractVar[tuple[int, ...]]
    ends: eqx.AbstractVar[tuple[str, str]]
    others: eqx.AbstractVar[tuple[Any, ...]]

    @property
    def branches(self) -> tuple[Self, ...]:
        """This one and the others."""
        return (self, *self.others)

    @property
    def special_points(self) -> tuple[SpecialT, ...]:
        """Those of all branches, each once, in the order of the parameter."""
        found: dict[int, SpecialT] = {}
        for branch in self.branches:
            found |= {id(b): b for b in branch.special}
        return tuple(sorted(found.values(), key=lambda b: b.value))

    @property
    def bifurcations(self) -> tuple[SpecialT, ...]:
        """Those of them that are bifurcations."""
        return tuple(b for b in self.special_points if b.is_bifurcation)

    def save(self, path: str | os.PathLike) -> None:
        """Writes the branch and the others to a file, an `.npz` of plain arrays with a description in JSON."""
        y = jax.tree.map(lambda x: x[0], self.ys)
        save(path, type(self).__name__, self.saved, self.system, y, {"branch": self}, self.not_saved)

    @classmethod
    def load(cls, path: str | os.PathLike, system: System, y: Y | None = None) -> Self:
        """Reads what `save` wrote. Nothing in the file is executed.

        **Arguments:**

        - `path`: the file.
        - `system`: a model of the same class and shapes; the values of its parameters are taken from the file.
        - `y`: a state, to tell what states look like; needed where they are neither arrays, dictionaries, tuples nor
            NamedTuples.

        **Raises:** `ValueError` for a file that is damaged, was not written by `save`, or is of another model.
        """
        return Archive(path, cls.__name__, cls.saved, system, y).part("branch")

    def to_dataframe(self) -> Any:
        """A row for each point of this branch and the others, in their order: `branch` (0 is this one), `point`, the
        parameter by its name, the components of the state by theirs, what else is known of each point, and the name of
        the special point there (`special`; empty where there is none).

        **Returns:** a `pandas.DataFrame`: `pip install nsjax[data]`.
        """
        tables = [one._columns(k) for k, one in enumerate(self.branches)]
        names = list(dict.fromkeys(name for columns in tables for name in columns))
        return frame(
            f"{type(self).__name__}.to_dataframe",
            [(name, np.concatenate([columns[name] for columns in tables])) for name in names],
        )

    def _columns(self, number: int) -> dict[str, np.ndarray]:
        special = np.full(len(self), "", dtype=object)
        for point, i in zip(self.special, self.indices):
            special[min(max(i, 0), len(self) - 1)] = point.name
        columns = dict(branch=np.full(len(self), number), point=np.arange(len(self)))
        parts = {self.parameter: self.values} | self._further() | dict(stable=self.stable, special=special)
        for name, values in parts.items():
            columns[f"{name}_" if name in columns else name] = np.asarray(values)
        return columns

    @abc.abstractmethod
    def _further(self) -> dict[str, np.ndarray]:
        """Columns of a table, by name: what is known of each point, apart from the parameter and stability."""

    def __len__(self) -> int:
        return len(self.values)

    def __str__(self) -> str:
        lines, seen = [self._headline()], []
        for branch in self.branches:
            low, high = float(np.min(branch.values)), float(np.max(branch.values))
            what = f"{branch._period()}{self.parameter} in [{low:.6g}, {high:.6g}]"
            lines.append(f"  {what}: {len(branch)} points, {branch._stability()}")
            lines.append(f"    from {branch.ends[0]} to {branch.ends[1]}")
            for special in branch.special:
                known = any(special is other for other in seen)
                lines += [f"    {line}" for line in str(special).splitlines()[: 1 if known else None]]
                seen.append(special)
        return "\n".join(lines)

    @abc.abstractmethod
    def _headline(self) -> str:
        """How many branches of what."""

    def _period(self) -> str:
        """What tells this branch from others over the same interval."""
        return ""

    def _words(self) -> list[str]:
        """What each point is."""
        return ["stable" if s else "unstable" for s in self.stable]

    def _stability(self) -> str:
        """ "stable, then unstable": runs along the branch."""
        words = self._words()
        runs = [word for i, word in enumerate(words) if i == 0 or words[i - 1] != word]
        return ", then ".join(runs) if len(runs) <= 6 else f"{len(runs) - 1} changes of stability"


@dataclasses.dataclass(frozen=True)
class BranchSegment:
    """Points one after the other, and the special ones among them, while they are found."""

    points: tuple[Any, ...] = ()
    special: tuple[tuple[int, Any], ...] = ()
    end: str = "here, so far"

    def then(self, point: Any) -> "BranchSegment":
        return dataclasses.replace(self, points=(*self.points, point))

    def ending(self, point: Any) -> "BranchSegment":
        """With another last point."""
        return dataclasses.replace(self, points=(*self.points[:-1], point))

    def noting(self, special: Any) -> "BranchSegment":
        """With the last point as a special one."""
        return dataclasses.replace(self, special=(*self.special, (len(self.points) - 1, special)))

    def join(self, other: "BranchSegment", keep: int, known: Any = None) -> "BranchSegment":
        """The first points of this one, and then the other; `known` is there already, if the other begins with it."""
        before = tuple((i, s) for i, s in self.special if i < keep)
        after = tuple((i + keep, s) for i, s in other.special if i or s is not known)
        return BranchSegment(self.points[:keep] + other.points, before + after)

    def reversed(self) -> "BranchSegment":
        last = len(self.points) - 1
        return BranchSegment(self.points[::-1], tuple((last - i, s) for i, s in self.special[::-1]), self.end)


def descends(values: Sequence[Any]) -> bool:
    """Whether a branch ends lower than it begins. Where both ends are one end of the interval, rounding must not
    choose its direction."""
    parameters = np.asarray(values, float)
    return bool(parameters[0] - parameters[-1] > 1e-9 * np.ptp(parameters))


def named_apart(parts: dict[str, np.ndarray], parameter: str) -> dict[str, np.ndarray]:
    """The components of a state, of which one may be called as the parameter is: `x_` then."""
    return {f"{name}_" if name == parameter else name: values for name, values in parts.items()}
