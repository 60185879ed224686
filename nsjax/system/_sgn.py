"""The switch of dry friction and of Filippov systems: a sign, or while sliding the multiplier λ between the signs."""

from collections.abc import Callable
from typing import Any, Self, TYPE_CHECKING

import jax.numpy as jnp
from jaxtyping import Array, Bool, Int

from .._numerics._jaxpr import is_affine
from .._numerics._select import select
from .._types import Guard, Scalar, Y
from ._mode import BEYOND, ModeState, OFF, Slot
from ._switch import ResettingSwitch


if TYPE_CHECKING:
    from ._model import SwitchedSystem
    from ._system import System


class sgn(ResettingSwitch):
    """A switch whose value lies in Sgn(h): +1 where h > 0, -1 where h < 0, and anything between on the surface h = 0.

    ```python
    @nsjax.sgn
    def belt(self, t, y):
        return y.v - self.v_dr
    ```

    A solution may cross the surface or slide on it. During sliding the value is the multiplier λ which keeps h = 0,
    eq. (2.19)-(2.20); `vector_field` must be affine in it. `@belt.breakaway` gives the bound b >= 1 which |λ| must
    reach before sliding ends: b = F_stick / F_slip is the static friction point of friction model (c), Fig. 2.5.

    With `@middle.reset`, `y_after = reset(self, t, y_before)`, the state jumps where h changes its sign, from either
    side: a block that rocks over its two edges, play in a gear, the reset of a phase.

    ```python
    @nsjax.sgn
    def middle(self, t, y):        # on which edge the block stands
        return y.theta

    @middle.reset
    def middle(self, t, y):
        return State(y.theta, self.r * y.omega)
    ```

    Nothing slides on such a surface: after the jump the value is the sign of h, or on the surface that of dh/dt, so
    that the state may go on or turn back. Where its events accumulate, the solution ends with
    `RESULTS.accumulation_reached`. `@middle.inverse` undoes the reset, for solutions backwards in time.

    **Arguments:**

    - `guard`: the method `h(self, t, y)`, returning a scalar or a tuple of scalars that means their minimum.
    - `name`: needed only when the switch is made outside a class body.
    """

    modes = (-1, 1, 0)
    order = 1
    signed = True
    breakaway_fn: Callable[[Any], Any] | None = None

    if TYPE_CHECKING:

        def __new__(cls, guard: Guard, *, name: str | None = None) -> "_Sgn": ...

    def breakaway(self, fn: Callable[[Any], Any]) -> Self:
        """Decorates `b(self)`, the bound >= 1 (dimensionless) which |λ| reaches before sliding ends."""
        return self._with(breakaway_fn=fn)

    def while_(self, name: str) -> Self:
        """The same switch, there only while a contact is closed: for friction that has the force of the contact as its
        normal force.

        ```python
        @nsjax.sgn
        def roll(self, t, y):          # sliding velocity
            return y.v - self.R * y.omega

        roll = roll.while_("wall")     # `wall` is another switch
        ```

        While the contact is open `s.roll` is 0, its mode is 2, and it has neither events nor multiplier. Where the
        contact closes, its mode is decided anew: by the sign of h, or, on the surface, by the fields.

        **Arguments:**

        - `name`: of the switch that is the contact, closed while it rests if it is an `impact` (friction takes part
            in each of its impacts too, up to where it stops the sliding), while its mode is not that of the open side
            if it is a `sgn` (-1) or a `relay` (0).
        """
        return self._with(condition=name, modes=(*sgn.modes, OFF))

    def closed(self, mode: Int[Array, ""]) -> Bool[Array, ""]:
        return mode >= 0

    def value(self, mode: Int[Array, ""], dtype: Any) -> Scalar:
        return super().value(select(mode == OFF, 0, mode) if self.condition else mode, dtype)

    def smoothed_value(  # pyright: ignore[reportIncompatibleVariableOverride]
        self, system: "System", t: Scalar, y: Y, sign: Callable[[Scalar], Scalar]
    ) -> Scalar:
        return sign(self.least(system, t, y))

    def symbol(self, mode: int) -> str:
        return f"{self.name}{('0', '+', ':off', '-')[mode]}"

    @property
    def static(self) -> bool:
        return self.breakaway_fn is not None

    def bound(self, system: "System") -> Any:
        return 1.0 if self.breakaway_fn is None else self.breakaway_fn(system)

    def modes_after(self, direction: int) -> tuple[int, ...]:
        return (direction,) if direction else self.modes

    def words(self, mode: int) -> str:
        return f"{self.name} {('= 0, slides', '> 0', 'off', '< 0')[mode]}"

    def guard_row(self, model: "SwitchedSystem", slot: Slot, t: Scalar, y: Y, state: ModeState) -> list[Scalar]:
        k, j = slot.switch, slot.part
        h, mode, part = model.h(k, t, y), state.mode[k], state.part[k]
        one = jnp.ones((), t.dtype)
        if self.condition:
            h = tuple(select(mode == OFF, one, hi) for hi in h)
        if len(h) == 1:
            return [select(mode == 0, one, mode.astype(t.dtype) * h[0])]
        # h = min(h_1, ..., h_J). Where h > 0 each component is watched alone; where h < 0 the event is the instant at
        # which the last of them becomes positive; while sliding on one, the others end the surface at its tip.
        alone = select((mode == 0) & (part == j), one, h[j])
        if j == 0:
            return [select(mode < 0, -h[0], alone)] + [select(mode < 0, -hi, -one) for hi in h[1:]]
        return [select(mode < 0, one, alone)]

    def bound_guard(self, model: "SwitchedSystem", slot: Slot, value: Scalar, state: ModeState) -> Scalar:
        left = super().bound_guard(model, slot, value, state)
        if not self.static:
            return left
        # Held backwards with |λ| > 1 it is let go where |λ| falls to 1, see `SwitchedSystem.edge`.
        return select(state.roots[slot.switch] * slot.part <= -BEYOND, -slot.part * value - 1, left)

    def known_row(self, model: "SwitchedSystem", slot: Slot, roots: Any, state: ModeState) -> list[Int[Array, ""]]:
        k, j = slot.switch, slot.part
        mode, part, none = state.mode[k], state.part[k], jnp.zeros((), jnp.int32)
        if part is None:
            return [roots]
        if j == 0:
            row = [select((part == 0) | (mode < 0) & (part == i), roots, none) for i in range(model.parts[k])]
            return [row[0], *[select(mode < 0, r, none) for r in row[1:]]]
        return [select((mode >= 0) & (part == j), roots, none)]

    def check(self, system: "System", t: Scalar, y: Y, along: Callable[[Scalar], Y]) -> None:
        owner = type(system).__name__
        self._check_guard(system, self.name, self.guard, t, y)
        self._check_reset(system, t, y)
        if self.jumps:
            self._check_sign(system, t, y)
            # What acts beside a surface that cannot hold the solution need not be affine in the value.
            if self.breakaway_fn or self.condition or len(self.components(system, t, y)) > 1:
                raise ValueError(
                    f"`{owner}.{self.name}` has a `reset`: its surface must be one scalar, without `breakaway` and "
                    "`while_`."
                )
            return
        if not is_affine(along, jnp.zeros_like(t)):
            raise ValueError(
                f"`{owner}.vector_field` must be affine in `s.{self.name}`, because the sliding field (2.19) is the "
                "convex combination of the fields on both sides, but it is not. Use it as a factor of a term: not "
                "inside a function, in a power, in `jnp.where`, or in a denominator. For two different laws write "
                f"`0.5 * (1 + s.{self.name}) * plus + 0.5 * (1 - s.{self.name}) * minus`."
            )
        bound = self.bound(system)
        if jnp.shape(bound) != ():
            raise ValueError(
                f"`{owner}.{self.name}.breakaway` must return a scalar, but its shape is {jnp.shape(bound)}."
            )

    def laws(self, system: "System") -> list[tuple[str, str, Any, Any]]:
        if not self.static:
            return []
        b = jnp.asarray(self.bound(system))
        least = 1 - 64 * float(jnp.finfo(jnp.result_type(b, 0.0)).eps)  # a quotient of equal forces may be rounded
        return [(".breakaway", "at least 1, because friction at rest is no weaker than in slip", b >= least, b)]


if TYPE_CHECKING:
    # A switch is completed by a method of its own name (`@belt.breakaway def belt`), as a property is by its setter.
    # To pyright that is a mistake, "obscured by a declaration of the same name", unless both declarations are of one
    # class that derives from `property`. The decorator itself must not: the type of `self.belt` would be that of a
    # value of h. So it makes instances of this class, which exists for type checkers alone.
    class _Sgn(sgn, property): ...
