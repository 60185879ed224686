"""The switch with memory: on, or off, with hysteresis between its two surfaces."""

from collections.abc import Callable
from typing import Any, Self, TYPE_CHECKING

import jax.numpy as jnp
from jaxtyping import Array, Int

from .._numerics._select import select
from .._types import Guard, Scalar, Y
from ._level_switch import LevelSwitch


if TYPE_CHECKING:
    from ._system import System


class relay(LevelSwitch):
    """A switch with memory: its value is 0 or 1, with a surface of its own for each change.

    Both surfaces are levels and not edges: a relay that is on while its `off` indicator function is above zero switches
    off at once, wherever that came from (a start, an impact, a tick of a clock). Where both are above zero it chatters.

    ```python
    @nsjax.relay
    def heater(self, t, y):        # switches on where this rises through zero
        return self.T_low - y.T

    @heater.off
    def heater(self, t, y):        # switches off where this rises through zero
        return y.T - self.T_high
    ```
    """

    modes = (0, 1)
    off_guard: Guard = None

    if TYPE_CHECKING:

        def __new__(cls, guard: Guard, *, name: str | None = None) -> "_Relay": ...

    def off(self, fn: Guard) -> Self:
        """Decorates `h_off(self, t, y)`: the relay switches off where it rises through zero."""
        return self._with(off_guard=fn)

    def surfaces(self, system: "System", t: Scalar, y: Y) -> tuple[Scalar, ...]:
        return self.guard(system, t, y), self.off_guard(system, t, y)

    def margin(self, system: "System", t: Scalar, y: Y, mode: Int[Array, ""]) -> Scalar:
        on, off = self.surfaces(system, t, y)
        return -select(mode == 1, off, on)

    def mode_at(self, system: "System", t: Scalar, y: Y, before: Any) -> Int[Array, ""]:
        on, off = (h > 0 for h in self.surfaces(system, t, y))
        return select(on & ~off, 1, select(off, 0, before)).astype(jnp.int32)

    def next_mode(self, system: "System", t: Scalar, y: Y, mode: Int[Array, ""]) -> Int[Array, ""]:
        return 1 - mode

    def modes_after(self, direction: int) -> tuple[int, ...]:
        return ((1 + direction) // 2,) if direction else (1, 0)

    def words(self, mode: int) -> str:
        return f"{self.name} {'on' if mode else 'off'}"

    def symbol(self, mode: int) -> str:
        return f"{self.name}:{'on' if mode else 'off'}"

    def drawn(self, system: "System", t: Scalar, y: Y) -> dict[str, Scalar]:
        on, off = self.surfaces(system, t, y)
        return {f"{self.name} on: h = 0": on, f"{self.name} off: h = 0": off}

    def check(self, system: "System", t: Scalar, y: Y, along: Callable[[Scalar], Y]) -> None:
        owner = type(system).__name__
        self._check_guard(system, self.name, self.guard, t, y)
        if self.off_guard is None:
            raise ValueError(
                f"`{owner}.{self.name}` is a relay without the surface on which it switches off; add one with "
                f"`@{self.name}.off`."
            )
        self._check_guard(system, f"{self.name}.off", self.off_guard, t, y)
        if any(isinstance(h, tuple) for h in self.surfaces(system, t, y)):
            raise ValueError(f"`{owner}.{self.name}` is a relay: its surfaces must be scalars, not tuples.")

    def one_way(self, owner: str) -> str | None:
        return f"`{owner}.{self.name}` is a relay, whose memory cannot be run backwards in time."


if TYPE_CHECKING:

    class _Relay(relay, property): ...  # see `sgn`
