"""The state of a scene: its coordinates and their velocities, by name."""

import collections
import functools as ft
import keyword
from collections.abc import Iterable
from typing import Any, NamedTuple


class State(NamedTuple):
    """Of a scene with coordinates x, z: `y.q.x`, `y.q.z` are displacements, `y.v.x`, `y.v.z` velocities."""

    q: Any
    v: Any


@ft.cache  # scenes with the same coordinates have states of the same structure
def _type_of(names: tuple[str, ...]) -> Any:
    return collections.namedtuple("Coordinates", names)


def coordinates_type(names: Iterable[str]) -> Any:
    """The `NamedTuple` with a field for each coordinate.

    **Raises:** `ValueError` for names that no field can have.
    """
    names = tuple(names)
    if not names:
        raise ValueError("Argument `coordinates` must name at least one coordinate, but is empty.")
    for name in names:
        if not isinstance(name, str) or not name.isidentifier() or keyword.iskeyword(name) or name.startswith("_"):
            raise ValueError(
                f"Argument `coordinates` must hold names that can stand in `y.q.name`, such as `x`, but got {name!r}."
            )
    if len(set(names)) < len(names):
        raise ValueError(f"Argument `coordinates` must name each coordinate once, but got {', '.join(names)}.")
    return _type_of(names)
