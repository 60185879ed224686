"""Parameters of a system, by their names."""

import dataclasses
import functools as ft
from typing import Any

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jax.core import Tracer
from jaxtyping import Array, Bool

from .._numerics._select import select
from .._numerics._text import did_you_mean
from ._system import is_number, System


Path = tuple[str, ...]


def parameter_path(system: System, name: Any) -> Path:
    """Where the parameter is. It is called by its own name, for one of a system that another one wraps, as `smoothed`
    does, or of an effect of a scene, too; or by that after some or all of the names that lead there, as `system.mu`,
    `belt.v`.

    **Raises:** `TypeError` for what is no name, `ValueError` for one that is unknown, occurs twice, or is of something
    else than a number.
    """
    if not isinstance(name, str):
        raise TypeError(f"Argument `parameter` must be the name of a field, but got {name!r}.")
    owner = type(system).__name__
    known = _paths(system)
    found = [path for path in known if ".".join(path) == name]
    found = found or [path for path in known if _leads(name.split("."), path)]
    names = ", ".join(".".join(path) for path in known) or "none"
    if not found:
        text = f"Argument `parameter` must be one of {names}, the parameters of `{owner}`, but got {name!r}."
        raise ValueError(text + did_you_mean(name, [".".join(path) for path in known]))
    if len(found) > 1:
        many = ", ".join(".".join(path) for path in found)
        raise ValueError(f"Argument `parameter` must name one of {many}, but {name!r} may mean any of them.")
    return found[0]


def _leads(names: list[str], path: tuple[str, ...]) -> bool:
    """Whether the names are those of a path, some on the way left out."""
    way = iter(path)
    return names[-1] == path[-1] and all(name in way for name in names)


def _paths(node: Any) -> list[tuple[str, ...]]:
    """Those of the system itself, then those of systems and other modules within."""
    fields = {field.name: field for field in dataclasses.fields(node)} if dataclasses.is_dataclass(node) else {}
    own, inner = [], []
    for name, value in (node.members if isinstance(node, System) else _members(node)).items():
        whole = isinstance(value, int) and not isinstance(value, bool)
        if isinstance(value, eqx.Module) or hasattr(value, "_fields"):
            inner += [(name, *path) for path in _paths(value)]
        elif eqx.is_inexact_array_like(value) and not isinstance(value, bool) and jnp.ndim(value) == 0:
            own.append((name,))
        elif whole and name in fields and is_number(fields[name]):
            own.append((name,))
    return own + inner


def _members(node: Any) -> dict[str, Any]:
    """The fields of a module, or of a `NamedTuple`."""
    names = [field.name for field in dataclasses.fields(node)] if isinstance(node, eqx.Module) else node._fields
    return {name: getattr(node, name) for name in names}


def get_parameter(system: System, path: Path) -> Any:
    return ft.reduce(getattr, path, system)


def put_parameter(system: System, path: Path, value: Any) -> System:
    """With another value of a parameter."""
    return eqx.tree_at(lambda m: get_parameter(m, path), system, value)


class FreeParameters(eqx.Module):
    """Which parameters of a system vary. That is an array, so that one program serves for all of them.

    `every`: all that it has. `free`: for each free one a row, which is true at its place; a tuple where it is `fixed`.
    """

    every: tuple[Path, ...] = eqx.field(static=True)
    free: Bool[Array, "number every"] | tuple[tuple[bool, ...], ...]

    @classmethod
    def of(cls, system: System, *paths: Path) -> "FreeParameters":
        every = tuple(_paths(system)) if paths else ()
        rows = [[path == one for one in every] for path in paths]
        return cls(every, np.array(rows, bool).reshape(len(paths), len(every)))

    @property
    def fixed(self) -> "FreeParameters":
        """The same for programs of their own."""
        return FreeParameters(self.every, tuple(tuple(map(bool, row)) for row in self.free))

    @property
    def paths(self) -> tuple[Path, ...]:
        """Those of the free ones, where they are known."""
        return tuple(self.every[list(row).index(True)] for row in self.free)

    def put(self, system: System, values: Any) -> System:
        """With these values: a number if one is free, else a vector."""
        if not len(self.free):
            return system
        values = jnp.reshape(values, (len(self.free),))
        if not isinstance(self.free, Tracer):
            for path, value in zip(self.paths, values):
                system = put_parameter(system, path, value)
            return system
        for i, path in enumerate(self.every):
            value = get_parameter(system, path)
            for row, new in zip(self.free, values):
                value = select(row[i], new, value)
            system = put_parameter(system, path, value)
        return system
