"""A parameter of a system, by its name."""

import dataclasses
import functools as ft
from typing import Any

import equinox as eqx
import jax.numpy as jnp

from .._numerics._text import did_you_mean
from ._system import System


Path = tuple[str, ...] | tuple[tuple[str, ...], ...]  # of one parameter, or of several


def parameter_path(system: System, name: Any) -> tuple[str, ...]:
    """Where the parameter is: its own name, or, for one of a system that another one wraps, as `smoothed` does, with
    those of the fields that lead there. `system.mu` says so expressly.

    **Raises:** `TypeError` for what is no name, `ValueError` for one that is unknown, occurs twice, or is of something
    else than a number.
    """
    if not isinstance(name, str):
        raise TypeError(f"Argument `parameter` must be the name of a field, but got {name!r}.")
    owner = type(system).__name__
    known = _paths(system)
    found = [path for path in known if ".".join(path) == name]
    found = found or [path for path in known if path[-1] == name]
    names = ", ".join(".".join(path) for path in known) or "none"
    if not found:
        text = f"Argument `parameter` must be one of {names}, the parameters of `{owner}`, but got {name!r}."
        raise ValueError(text + did_you_mean(name, [".".join(path) for path in known]))
    if len(found) > 1:
        many = ", ".join(".".join(path) for path in found)
        raise ValueError(f"Argument `parameter` must name one of {many}, but {name!r} may mean any of them.")
    return found[0]


def _paths(system: System) -> list[tuple[str, ...]]:
    """Those of the system itself, then those of systems within."""
    own, inner = [], []
    for field in dataclasses.fields(system):
        value = getattr(system, field.name)
        if isinstance(value, System):
            inner += [(field.name, *path) for path in _paths(value)]
        elif eqx.is_inexact_array_like(value) and not isinstance(value, bool) and jnp.ndim(value) == 0:
            own.append((field.name,))
        elif isinstance(value, int) and field.type in (float, "float"):
            own.append((field.name,))
    return own + inner


def get_parameter(system: System, path: tuple[str, ...]) -> Any:
    return ft.reduce(getattr, path, system)


def put_parameter(system: System, path: Path, value: Any) -> System:
    """With another value of a parameter; or of several, from a vector."""
    if path and not isinstance(path[0], str):
        for i, one in enumerate(path):
            system = put_parameter(system, one, value[i])
        return system
    return eqx.tree_at(lambda m: get_parameter(m, path), system, value)
