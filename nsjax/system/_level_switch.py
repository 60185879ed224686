"""The base of switches whose mode follows from the state and from the mode before."""

import abc
from typing import Any, TYPE_CHECKING

import jax.numpy as jnp
from jaxtyping import Array, Int

from .._types import Scalar, Y
from ._mode import ModeState, Slot
from ._switch import AbstractSwitch


if TYPE_CHECKING:
    from ._model import SwitchedSystem
    from ._system import System


class LevelSwitch(AbstractSwitch):
    """A switch whose mode follows from the state, and from the mode before where several are possible.

    `relay` is one. A model may define kinds of its own by a subclass with `modes`, which lists the integers that its
    modes are, and with the three methods below. Its value in `vector_field` is the mode, unless `value` is overridden.
    A solution never slides on its surfaces, and its events do not change the state. The guide to modelling has a dead
    zone as an example.

    **Arguments:**

    - `guard`: the method `h(self, t, y)` that it decorates, from which its subclass makes `margin`.
    - `name`: needed only when the switch is made outside a class body.
    """

    levels = True

    @abc.abstractmethod
    def margin(self, system: Any, t: Scalar, y: Y, mode: Int[Array, ""]) -> Scalar:
        """Returns a function that is positive while the mode lasts, and falls through zero where it ends. In each mode
        it is smooth in time and state."""

    @abc.abstractmethod
    def mode_at(self, system: Any, t: Scalar, y: Y, before: Any) -> Int[Array, ""]:
        """Returns the mode at a state that does not lie on a surface, if it was `before`."""

    @abc.abstractmethod
    def next_mode(self, system: Any, t: Scalar, y: Y, mode: Int[Array, ""]) -> Int[Array, ""]:
        """Returns the mode that follows `mode` at a state at which its margin has fallen to zero."""

    def symbol(self, mode: int) -> str:
        return f"{self.name}:{mode:+d}"

    def words(self, mode: int) -> str:
        return f"{self.name} {mode:+d}"

    def surface(self, model: "SwitchedSystem", k: int, t: Scalar, y: Y, state: ModeState) -> Scalar:
        return -self.margin(model.system, model.time(t), y, state.mode[k])

    def guard_row(self, model: "SwitchedSystem", slot: Slot, t: Scalar, y: Y, state: ModeState) -> list[Scalar]:
        return [self.margin(model.system, model.time(t), y, state.mode[slot.switch])]

    def drawn(self, system: "System", t: Scalar, y: Y) -> dict[str, Scalar]:
        return {f"{self.words(m)} ends": h for m, h in zip(self.modes, self.surfaces(system, t, y))}

    def surfaces(self, system: "System", t: Scalar, y: Y) -> tuple[Scalar, ...]:
        return tuple(self.margin(system, t, y, jnp.asarray(mode, jnp.int32)) for mode in self.modes)

    def check(self, system: "System", t: Scalar, y: Y, along: Any) -> None:
        self._check_guard(system, self.name, self.guard, t, y)
        if not self.modes:
            raise ValueError(f"`{type(self).__name__}` must list its modes: `modes = (0, 1)`.")

    def one_way(self, owner: str) -> str | None:
        return (
            f"`{owner}.{self.name}` is a {type(self).__name__}, whose mode depends on the one before it, so that it "
            "cannot be run backwards in time."
        )
