"""The switch of unilateral contact: the state jumps where the gap closes, and may come to rest on the surface."""

from collections.abc import Callable
from typing import Any, Self, TYPE_CHECKING

import jax.numpy as jnp
from jaxtyping import Array, Int

from .._numerics._jaxpr import is_constant
from .._numerics._select import select
from .._types import Guard, Scalar, Y
from ._mode import ModeState, Slot
from ._switch import ResettingSwitch


if TYPE_CHECKING:
    from ._model import SwitchedSystem
    from ._system import System


class impact(ResettingSwitch):
    """A unilateral contact h >= 0 at which the state jumps (Table 1.1 (3)).

    ```python
    @nsjax.impact
    def floor(self, t, y):         # gap
        return y.x

    @floor.restitution             # Newton: h'(t+) = -e h'(t-)
    def floor(self):
        return self.e
    ```

    With `restitution` the impulse acts along ∂f/∂s, the direction in which the contact force enters the equations of
    motion, so `vector_field` must contain it: `v' = -g + s.floor / m`. Between impacts the value `s.floor` is 0. Where
    impacts accumulate (at once if e = 0) the solution comes to rest on the surface: `s.floor` >= 0 is the force that
    keeps it there, and when it has fallen to zero the solution lifts off. (A tuple-valued h has no such state: impacts
    that accumulate end the solution.) With `@floor.reset`, `y_after = reset(self, t, y_before)` is the user's own; it
    is run backwards in time only if `@floor.inverse`, `y_before = inverse(self, t, y_after)`, is given too.
    """

    modes = (0, 1)
    order = 2
    holding = 1
    unilateral = True

    if TYPE_CHECKING:

        def __new__(cls, guard: Guard, *, name: str | None = None) -> "_Impact": ...

    def restitution(self, fn: Callable[[Any], Any]) -> Self:
        """Decorates `e(self)`, Newton's coefficient of restitution (dimensionless, 0 <= e <= 1)."""
        return self._with(restitution_fn=fn)

    @property
    def jumps(self) -> bool:
        return True

    def value(self, mode: Int[Array, ""], dtype: Any) -> Scalar:
        return jnp.zeros((), dtype)  # the contact force of a flight

    def modes_after(self, direction: int) -> tuple[int, ...]:
        return (1, 0)

    def words(self, mode: int) -> str:
        return f"{self.name}: rests" if mode else ""

    def symbol(self, mode: int) -> str:
        return f"{self.name}:rests" if mode else ""

    def event_symbol(self, before: int, after: int) -> str:
        return f"{self.name}:rests" if after else f"{self.name}:leaves" if before else self.name

    def guard_row(self, model: "SwitchedSystem", slot: Slot, t: Scalar, y: Y, state: ModeState) -> list[Scalar]:
        k = slot.switch
        gap = model.h(k, t, y)[slot.part]
        if k not in model.contacts:
            return [gap]
        closed = state.mode[k] == 1
        for friction in [model.holdable[j] for i, j in model.normal if model.holdable[i] == k]:
            closed = closed | model.gap_is_held(k, friction, t, y, state)
        return [select(closed, jnp.ones((), t.dtype), gap)]

    def bound_guard(self, model: "SwitchedSystem", slot: Slot, value: Scalar, state: ModeState) -> Scalar:
        return value

    def check(self, system: "System", t: Scalar, y: Y, along: Callable[[Scalar], Y]) -> None:
        owner, name = type(system).__name__, self.name
        self._check_guard(system, name, self.guard, t, y)
        if (self.reset_fn is None) == (self.restitution_fn is None):
            raise ValueError(
                f"`{owner}.{name}` is an impact: give it either `@{name}.reset` (the state after it) or "
                f"`@{name}.restitution` (Newton's coefficient e)."
            )
        self._check_sign(system, t, y)
        self._check_reset(system, t, y)
        if self.reset_fn is None and is_constant(along, jnp.zeros_like(t)):
            raise ValueError(
                f"`{owner}.{name}.restitution` needs the direction of the impulse, which is that of the contact force "
                f"`s.{name}` in `vector_field`, but it does not occur there. Add it to the equation of motion "
                f"(`+ s.{name} / m`), or write the jump out with `@{name}.reset`."
            )

    def laws(self, system: "System") -> list[tuple[str, str, Any, Any]]:
        if self.restitution_fn is None:
            return []
        e = jnp.asarray(self.restitution_fn(system))
        return [(".restitution", "a number from 0 to 1", (e >= 0) & (e <= 1), e)]


if TYPE_CHECKING:

    class _Impact(impact, property): ...  # see `sgn`
