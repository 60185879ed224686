"""The mode of a system: one small integer for each switch."""

from collections.abc import Iterable, Mapping, Sequence
from typing import Any, NamedTuple

import jax.numpy as jnp
from jaxtyping import Array, Int

from .._numerics._select import select
from .._types import Mode


OFF = 2  # the mode of friction whose contact is open
BEYOND = 4  # added, with its sign, to the roots of a switch that is held with |λ| > 1 in backward time


class Slot(NamedTuple):
    """One guard: a function that is positive while the mode lasts."""

    switch: int  # position of its switch
    part: int  # component of h, or the sign of the bound that λ reaches
    holding: bool  # whether it watches λ


class ModeState(NamedTuple):
    """A mode, with the component of h that is active on the surface of each switch (None for a smooth surface) and
    the number of roots at the present instant, to be left out when the next one is sought; of a switch that is held the
    sign of the bound that its value is at, or 0, and see `SwitchedSystem.edge`."""

    mode: Mode
    part: tuple[Int[Array, ""] | None, ...]
    roots: tuple[Int[Array, ""], ...]

    @classmethod
    def of(cls, mode: Any, part: Any) -> "ModeState":
        """Of switches none of which has just left its surface."""
        return cls(tuple(mode), tuple(part), tuple(jnp.zeros((), jnp.int32) for _ in mode))


def pick(values: tuple[Any, ...], index: Any) -> Any:
    """One of several, by an index that may be traced, or None if there is only one."""
    found = values[0]
    for i, value in enumerate(values[1:], 1):
        found = select(index == i, value, found)
    return found


def put(values: tuple[Any, ...], which: Sequence[int], new: Sequence[Any]) -> tuple[Any, ...]:
    """The same values, with others in some places."""
    found = dict(zip(which, new))
    return tuple(found.get(i, v) for i, v in enumerate(values))


def mode_words(names: Iterable[str], mode: Iterable[Any]) -> str:
    """A mode as it is printed."""
    return ", ".join(f"{name} {_word(m)}" for name, m in zip(names, mode))


def change_words(before: Mapping[str, int], after: Mapping[str, int]) -> str:
    """What changes in a mode, as it is printed; empty if nothing does."""
    return ", ".join(f"{n} {_word(m)} -> {_word(after[n])}" for n, m in before.items() if m != after[n])


def _word(mode: Any) -> str:
    return "off" if int(mode) == OFF else f"{int(mode):+d}"
