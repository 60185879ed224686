"""The model: a differential inclusion y' = f(t, y, s) with s_k in Sgn(h_k(t, y)).

The vector field takes the switch values `s` as an argument; what is put for them decides the method
(a sign: the smooth field of one region; a multiplier: Filippov's sliding field (2.19); an arctangent: the smoothing
method (2.32)).
"""

import abc
import dataclasses
import functools as ft
import inspect
from collections.abc import Callable
from functools import partial
from typing import Any, Self, TYPE_CHECKING

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int

from .._numerics._text import did_you_mean
from .._types import Guard, Scalar, Y


class AbstractSwitch:
    """One nonsmooth element of a model. Made by the decorators `sgn`, `relay` and `impact`.

    `guard(system, t, y)` is the indicator function h of the thesis (2.8). It returns a scalar, or a tuple of scalars
    which means their minimum (a surface with a corner, such as the support of section 3.5).
    """

    guard: Guard
    name: str
    ends: tuple[int, ...] = ()  # where an event of this switch leads to one of these modes the solution ends

    def __init__(self, guard: Guard, *, name: str | None = None):
        if not callable(guard):
            raise TypeError(f"A `{type(self).__name__}` must decorate a method `h(self, t, y)`, but got {guard!r}.")
        self.guard = guard
        self.name = name or getattr(guard, "__name__", "")
        if not self.name.isidentifier() or self.name == "<lambda>":
            raise ValueError(
                f"A `{type(self).__name__}` needs a name that is an identifier, but got {self.name!r}; pass `name=...`."
            )

    def __set_name__(self, owner: type, name: str) -> None:
        self.name = name

    def __get__(self, instance: Any, owner: type | None = None) -> Any:
        """On an instance: the indicator function h(t, y) bound to it. On the class: the switch itself."""
        return self if instance is None else partial(self.guard, instance)

    def _with(self, **parts: Any) -> Self:
        new = object.__new__(type(self))
        new.__dict__.update(self.__dict__ | parts)
        return new

    def components(self, system: "System", t: Scalar, y: Y) -> tuple[Scalar, ...]:
        """h as a tuple of scalars, whose minimum is the indicator function."""
        h = self.guard(system, t, y)
        return h if isinstance(h, tuple) else (h,)

    def __repr__(self) -> str:
        return f"{type(self).__name__}({self.name})"


class sgn(AbstractSwitch):
    """A switch whose value lies in Sgn(h): +1 where h > 0, -1 where h < 0, and anything between on the surface h = 0.

    ```python
    @nsjax.sgn
    def belt(self, t, y):
        return y.v - self.v_dr
    ```

    A solution may cross the surface or slide on it. During sliding the value is the multiplier λ which keeps h = 0,
    eq. (2.19)-(2.20); `vector_field` must be affine in it. `@belt.breakaway` gives the bound b >= 1 which |λ| must
    reach before sliding ends: b = F_stick / F_slip is the static friction point of friction model (c), Fig. 2.5.

    **Arguments:**

    - `guard`: the method `h(self, t, y)`, returning a scalar or a tuple of scalars that means their minimum.
    - `name`: needed only when the switch is made outside a class body.
    """

    breakaway_fn: Callable[[Any], Any] | None = None

    if TYPE_CHECKING:

        def __new__(cls, guard: Guard, *, name: str | None = None) -> "_Sgn": ...

    def breakaway(self, fn: Callable[[Any], Any]) -> Self:
        """Decorates `b(self)`, the bound >= 1 (dimensionless) which |λ| reaches before sliding ends."""
        return self._with(breakaway_fn=fn)

    def bound(self, system: "System") -> Any:
        return 1.0 if self.breakaway_fn is None else self.breakaway_fn(system)


class relay(AbstractSwitch):
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

    off_guard: Guard = None

    if TYPE_CHECKING:

        def __new__(cls, guard: Guard, *, name: str | None = None) -> "_Relay": ...

    def off(self, fn: Guard) -> Self:
        """Decorates `h_off(self, t, y)`: the relay switches off where it rises through zero."""
        return self._with(off_guard=fn)


class impact(AbstractSwitch):
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

    reset_fn: Guard = None
    inverse_fn: Guard = None
    restitution_fn: Callable[[Any], Any] | None = None

    if TYPE_CHECKING:

        def __new__(cls, guard: Guard, *, name: str | None = None) -> "_Impact": ...

    def reset(self, fn: Guard) -> Self:
        """Decorates `reset(self, t, y) -> y_after`, of the structure of the state."""
        return self._with(reset_fn=fn)

    def inverse(self, fn: Guard) -> Self:
        """Decorates `inverse(self, t, y) -> y_before`, which undoes `reset`: for solutions backwards in time."""
        return self._with(inverse_fn=fn)

    def restitution(self, fn: Callable[[Any], Any]) -> Self:
        """Decorates `e(self)`, Newton's coefficient of restitution (dimensionless, 0 <= e <= 1)."""
        return self._with(restitution_fn=fn)


class clock(AbstractSwitch):
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

    Its mode is the number of ticks that have passed, counted from time 0 (or from the first of a list), and so is its
    value in `vector_field`.

    **Arguments:**

    - `guard`: the method `ticks(self)`, which returns the time T > 0 between two ticks, or a vector of increasing
        times, which are all ticks there are [time].
    - `name`: needed only when the switch is made outside a class body.
    """

    offset_fn: Callable[[Any], Any] | None = None

    if TYPE_CHECKING:

        def __new__(cls, guard: Guard, *, name: str | None = None) -> "_Clock": ...

    def offset(self, fn: Callable[[Any], Any]) -> Self:
        """Decorates `t_0(self)`: the ticks are at t_0 + n T [time]."""
        return self._with(offset_fn=fn)

    def components(self, system: "System", t: Scalar, y: Y) -> tuple[Scalar, ...]:
        return (jnp.zeros_like(t),)  # it has no surface

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
        blur = 8 * float(jnp.finfo(t.dtype).eps) * (jnp.abs(t) + jnp.abs(start)) * jnp.where(forwards, 1, -1)
        if times.ndim == 0:
            return jnp.floor((t - start + blur) / times).astype(jnp.int32)
        return jnp.searchsorted(start + times, t + blur, side="right").astype(jnp.int32)


if TYPE_CHECKING:
    # A switch is completed by a method of its own name (`@belt.breakaway def belt`), as a property is by its setter.
    # To pyright that is a mistake, "obscured by a declaration of the same name", unless both declarations are of one
    # class that derives from `property`. The decorators themselves must not: the type of `self.belt` would be that of a
    # value of h. So they make instances of these, which exist for type checkers alone.
    class _Sgn(sgn, property): ...

    class _Relay(relay, property): ...

    class _Impact(impact, property): ...

    class _Clock(clock, property): ...


@ft.cache  # switches are told apart by identity
def forwarded(switch: AbstractSwitch) -> Any:
    """The switch for a system that has the switch's own system as its field `system`."""

    def forward(fn: Callable[..., Any]) -> Callable[..., Any]:
        return lambda self, *args: fn(self.system, *args)

    return switch._with(**{name: forward(part) for name, part in vars(switch).items() if callable(part)})


class SwitchValues:
    """The values `s` handed to `vector_field`: `s.belt`, or `s["belt"]` for a name known only at run time."""

    def __init__(self, owner: str, values: dict[str, Any]):
        self._owner = owner
        self._values = values

    def __getitem__(self, name: str) -> Any:
        return self.__getattr__(name)

    def __getattr__(self, name: str) -> Any:
        if name.startswith("_"):
            raise AttributeError(name)
        try:
            return self._values[name]
        except KeyError:
            known = ", ".join(f"`{n}`" for n in self._values) or "none"
            raise AttributeError(
                f"`{self._owner}.vector_field` asks for `s.{name}`, but the system has no switch of that name. "
                f"Its switches are: {known}."
            ) from None


jax.tree_util.register_pytree_with_keys(
    SwitchValues,
    lambda s: (
        [(jax.tree_util.GetAttrKey(n), v) for n, v in s._values.items()],
        (s._owner, tuple(s._values)),
    ),
    lambda aux, values: SwitchValues(aux[0], dict(zip(aux[1], values))),
)


class System(eqx.Module):
    """A piecewise-smooth dynamical system.

    Parameters are the fields of the (equinox) module, switches its methods decorated by `nsjax.sgn`, `nsjax.relay`
    or `nsjax.impact`, and `vector_field(t, y, s)` its right-hand side, where `s.name` is the value of a switch. The
    state `y` is any pytree of floating point arrays; a `NamedTuple` of named scalars reads best and is the fastest
    under `vmap`.

    A model into which the time enters periodically says so by a property `period` [time]: orbits, maps and branches
    are those of that period. Where a function of time jumps, the times are declared by an `nsjax.clock`.
    """

    def __new__(cls, *args: Any, **parameters: Any) -> Self:
        taken = inspect.signature(cls.__init__).parameters
        if not any(p.kind == p.VAR_KEYWORD for p in taken.values()):
            for name in parameters:
                if name not in taken:
                    names = [n for n in taken if n != "self"]
                    raise TypeError(
                        f"`{cls.__name__}` has no parameter `{name}` ({', '.join(names) or 'it has none'})."
                        + did_you_mean(name, names)
                    )
        return super().__new__(cls)

    @abc.abstractmethod
    def vector_field(self, t: Scalar, y: Y, s: SwitchValues) -> Y:
        """The right-hand side y' = f(t, y, s) [state units per unit of time], of the structure of `y`."""

    @property
    def switches(self) -> tuple[AbstractSwitch, ...]:
        """The switches, by default the decorated methods in order of definition, base classes first. Override it for
        a system that is assembled at run time."""
        found: dict[str, Any] = {}
        for cls in reversed(type(self).__mro__):
            for name, value in vars(cls).items():
                if isinstance(value, AbstractSwitch):
                    found[name] = value
                elif name in found:
                    del found[name]
        return tuple(found.values())

    @property
    def period(self) -> Float[Array, ""] | float | None:
        """Period of the explicit time dependence [time], to be overridden: `return 2 * jnp.pi / self.omega`. `None`,
        the default, is for an autonomous model."""
        return None

    def values(self, s: tuple[Any, ...]) -> SwitchValues:
        """The argument `s` of `vector_field` from a tuple of values in the order of `switches`."""
        return SwitchValues(type(self).__name__, dict(zip([k.name for k in self.switches], s)))


def arrays_of(system: System, dtype: Any) -> System:
    """Turns the Python numbers among the parameters into arrays, so that a new value does not retrace.

    A field annotated `float` but given an `int` counts as a number; other `int` and `bool` fields stay static, as they
    may decide shapes.
    """

    def is_float_field(field: dataclasses.Field) -> bool:
        return field.type in (float, "float")

    def convert(x: Any) -> Any:
        if isinstance(x, float):
            return jnp.asarray(x, dtype)
        # A weakly typed array, such as `jnp.asarray(0.2)`, would be one more program to compile.
        return jnp.asarray(x, x.dtype) if isinstance(x, jax.Array) else x

    for field in dataclasses.fields(system):
        value = getattr(system, field.name)
        if isinstance(value, System):
            system = eqx.tree_at(lambda m, n=field.name: getattr(m, n), system, arrays_of(value, dtype))
        if is_float_field(field) and isinstance(value, int) and not isinstance(value, bool):
            system = eqx.tree_at(
                lambda m, n=field.name: getattr(m, n), system, float(value), is_leaf=lambda x: x is None
            )
    return jax.tree.map(convert, system)
