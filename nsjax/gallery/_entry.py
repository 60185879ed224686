"""A system of the gallery, with a start that shows what it does."""

import dataclasses
from collections.abc import Callable

from .._types import Y
from ..system._system import System


@dataclasses.dataclass(frozen=True)
class OrbitGuess:
    """Where shooting finds the stable periodic orbit, for the default parameters."""

    y0: Y  # state at t0 of the entry, away from events
    period: float | None = None  # [s]; `None` for a forced system, where it is `order * system.period`
    order: int = 1  # of a subharmonic orbit


@dataclasses.dataclass(frozen=True)
class Entry:
    """A system of the gallery with a start that shows what it does."""

    key: str
    title: str
    system: Callable[..., System]  # keyword arguments are parameters
    y0: Y
    t1: float  # end time [s]
    t0: float = 0.0  # start time [s]
    orbit: OrbitGuess | None = None
    also: tuple[str, ...] = ()  # other numbers of the system in the thesis
    cartesian: Callable[..., System] | None = None  # of a system in polar coordinates: the same in Cartesian ones
