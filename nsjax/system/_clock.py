"""The switch of time: the instants at which functions of time in a model jump."""

from collections.abc import Callable
from typing import Any, ClassVar, Self, TYPE_CHECKING

import jax.numpy as jnp
from jaxtyping import Array, Bool, Int

from .._numerics._select import select
from .._types import Guard, Scalar, Y
from ._mode import ModeState, Slot
from ._switch import ResettingSwitch


if TYPE_CHECKING:
    from ._model import SwitchedSystem
    from ._system import System


class clock(ResettingSwitch):
    """The times at which functions of time in the model jump: a carrier, a square wave, a table of set points.

    ```python
    @nsjax.clock                       # ticks at 0, T, 2T, ...: where t % T falls back to zero
    def carrier(self):
        return self.T

    @nsjax.sgn
    def comparator(self, t, y):
        return y.v - self.V_low - self.slope * (t % self.T)
    ```

    Time is a function like any other in `vector_field`, guards and resets, and may be put into `%`, `jnp.floor`,
    `jnp.where` or a table, if the instants at which this jumps (or has a kink) are ticks of a clock. They are met
    exactly: a step ends there, the model is taken from before the tick and from after it, and the modes of all switches
    are decided anew. Derivatives by the times of the ticks are those of the flow.

    With `@carrier.reset`, `y_after = reset(self, t, y_before)`, the state jumps at each tick: a dose, a kick, the
    sample of a controller. Functions of time in the reset are those after the tick. A tick at the time at which a
    solution starts has passed before it, in either direction of time; one at its end belongs to it. Backwards in time
    `@carrier.inverse` is needed.

    Its mode is the number of ticks that have passed, counted from time 0 (or from the first of a list), and so is its
    value in `vector_field`.

    **Arguments:**

    - `guard`: the method `ticks(self)`, which returns the time T > 0 between two ticks, or a vector of increasing
        times, which are all ticks there are [time].
    - `name`: needed only when the switch is made outside a class body.
    """

    ticking = True
    offset_fn: Callable[[Any], Any] | None = None
    derived: ClassVar[bool] = False  # whether it was not declared but found in the program of a model

    if TYPE_CHECKING:

        def __new__(cls, guard: Guard, *, name: str | None = None) -> "_Clock": ...

    def offset(self, fn: Callable[[Any], Any]) -> Self:
        """Decorates `t_0(self)`: the ticks are at t_0 + n T [time]."""
        return self._with(offset_fn=fn)

    def components(self, system: "System", t: Scalar, y: Y) -> tuple[Scalar, ...]:
        return (jnp.zeros_like(t),)  # it has no surface

    def surfaces(self, system: "System", t: Scalar, y: Y) -> tuple[Scalar, ...]:
        return ()

    def drawn(self, system: "System", t: Scalar, y: Y) -> dict[str, Scalar]:
        return {}

    def ticked(self, count: Int[Array, ""], direction: Any) -> Int[Array, ""]:
        """Its mode after a tick, in time that runs forwards (`direction` > 0) or backwards."""
        return count + select(direction > 0, 1, -1)

    def surface(self, model: "SwitchedSystem", k: int, t: Scalar, y: Y, state: ModeState) -> Scalar:
        return model.span(k, state.mode)[1] - t

    def guard_row(self, model: "SwitchedSystem", slot: Slot, t: Scalar, y: Y, state: ModeState) -> list[Scalar]:
        low, high = model.span(slot.switch, state.mode)
        ahead = model.direction > 0
        left = select(ahead, high - t * model.direction, t * model.direction - low)
        return [select(jnp.isfinite(select(ahead, high, low)), left, jnp.ones((), t.dtype))]

    def _times(self, system: "System", like: Scalar) -> tuple[Array, Scalar]:
        start = 0.0 if self.offset_fn is None else self.offset_fn(system)
        return jnp.asarray(self.guard(system), like.dtype), jnp.asarray(start, like.dtype)

    def span(self, system: "System", count: Int[Array, ""], like: Scalar) -> tuple[Scalar, Scalar]:
        """The last tick and the next one, when `count` have passed; infinite where there is none."""
        times, start = self._times(system, like)
        if times.ndim == 0:
            return start + count.astype(like.dtype) * times, start + (count + 1).astype(like.dtype) * times
        ends = jnp.concatenate([jnp.asarray([-jnp.inf], like.dtype), start + times, jnp.asarray([jnp.inf], like.dtype)])
        return ends[count], ends[count + 1]

    def countable(self, system: "System", t: Scalar) -> Bool[Array, ""]:
        """Whether its ticks can be told apart and counted, up to time `t`."""
        times, start = self._times(system, t)
        gap = times if times.ndim == 0 else jnp.min(jnp.diff(times), initial=jnp.inf)
        digits = gap >= 6400 * float(jnp.finfo(t.dtype).eps) * (jnp.abs(t) + jnp.abs(start))
        return digits & (jnp.abs(t - start) < 2.0**30 * (gap if times.ndim == 0 else jnp.inf))

    def count(self, system: "System", t: Scalar, forwards: Any) -> Int[Array, ""]:
        """How many ticks have passed at time `t`; at a tick those after it, or before it if time runs backwards."""
        times, start = self._times(system, t)
        blur = 8 * float(jnp.finfo(t.dtype).eps) * (jnp.abs(t) + jnp.abs(start)) * select(forwards, 1, -1)
        if times.ndim == 0:
            return jnp.floor((t - start + blur) / times).astype(jnp.int32)
        return jnp.searchsorted(start + times, t + blur, side="right").astype(jnp.int32)

    def check(self, system: "System", t: Scalar, y: Y, along: Callable[[Scalar], Y]) -> None:
        owner = type(system).__name__
        self._check_reset(system, t, y)
        ticks = jnp.asarray(self.guard(system))
        if ticks.ndim > 1 or ticks.size == 0 or not jnp.issubdtype(ticks.dtype, jnp.floating):
            raise ValueError(
                f"`{owner}.{self.name}` is a clock: it must return the time between two ticks, or a vector of times, "
                f"but returned {ticks.dtype}{list(ticks.shape)}."
            )
        start = 0.0 if self.offset_fn is None else self.offset_fn(system)
        if jnp.shape(start) != ():
            raise ValueError(f"`{owner}.{self.name}.offset` must return a scalar, but its shape is {jnp.shape(start)}.")

    def laws(self, system: "System") -> list[tuple[str, str, Any, Any]]:
        ticks = jnp.asarray(self.guard(system))
        start = jnp.asarray(0.0 if self.offset_fn is None else self.offset_fn(system))
        found = [(".offset", "a finite time", jnp.isfinite(start), start)]
        if ticks.ndim == 0:
            return [("", "a time above zero", ticks > 0, ticks), *found]
        return [("", "a vector of increasing times", jnp.all(ticks[1:] > ticks[:-1]), ticks), *found]


if TYPE_CHECKING:

    class _Clock(clock, property): ...  # see `sgn`
