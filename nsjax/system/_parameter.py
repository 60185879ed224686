"""A parameter of a system, by its name."""

import dataclasses
import functools as ft
from typing import Any

import equinox as eqx
import jax.numpy as jnp

from .._numerics._text import did_you_mean
from ._system import is_number, System


Path = tuple[str, ...] | tuple[tuple[str, ...], ...]  # of one parameter, or of several


def parameter_path(system: System, name: Any) -> tuple[str, ...]:
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


def get_parameter(system: System, path: tuple[str, ...]) -> Any:
    return ft.reduce(getattr, path, system)


def put_parameter(system: System, path: Path, value: Any) -> System:
    """With another value of a parameter; or of several, from a vector."""
    if path and not isinstance(path[0], str):
        for i, one in enumerate(path):
            system = put_parameter(system, one, value[i])
        return system
    return eqx.tree_at(lambda m: get_parameter(m, path), system, value)
