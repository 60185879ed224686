"""What every switch of a model has: an indicator function, modes, and guards that tell when the mode ends."""

import abc
import copy
import functools as ft
import math
from collections.abc import Callable
from functools import partial
from typing import Any, ClassVar, Self, TYPE_CHECKING

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Int

from .._numerics._jaxpr import never_negative
from .._numerics._select import select
from .._types import Guard, Scalar, Y
from ._mode import ModeState, pick, Slot


if TYPE_CHECKING:
    from ._model import SwitchedSystem
    from ._system import System


class AbstractSwitch(abc.ABC):
    """One nonsmooth element of a model. Made by the decorators `sgn`, `relay`, `impact` and `clock`.

    `guard(system, t, y)` is the indicator function h of the thesis (2.8). It returns a scalar, or a tuple of scalars
    which means their minimum (a surface with a corner, such as the support of section 3.5).
    """

    modes: ClassVar[tuple[int, ...]] = ()  # those that a user may name, in the order of the colours of their lines
    order: ClassVar[int] = 0  # which derivative of h its value can keep at zero, and so hold the solution; 0: none
    holding: ClassVar[int] = 0  # the mode in which it does so
    # What its mode says; of these only one is true.
    signed: ClassVar[bool] = False  # on which side of its surface the state is, by the sign of h; 0 where it is held
    unilateral: ClassVar[bool] = False  # whether the contact that keeps h >= 0 is closed
    ticking: ClassVar[bool] = False  # how many of its events, which happen at given times, have passed
    levels: ClassVar[bool] = False  # which of several levels the state has passed, see `LevelSwitch`

    # `(system, t, y, sign)`: its value in a smoothed system, in which `sign` is a smooth function in place of the sign.
    # Where it is None, the switch remains.
    smoothed_value: ClassVar[Callable[..., Scalar] | None] = None

    guard: Guard
    name: str
    restitution_fn: Callable[[Any], Any] | None = None  # Newton's coefficient of restitution, if it has this law
    condition: str = ""  # the name of the switch with whose closed contact alone it is there, see `sgn.while_`
    ends: tuple[int, ...] = ()  # where an event of this switch leads to one of these modes the solution ends

    def __init__(self, guard: Guard, *, name: str | None = None):
        if not callable(guard):
            raise TypeError(f"`{type(self).__name__}` must decorate a method `h(self, t, y)`, but got {guard!r}.")
        self.guard = guard
        self.name = name or getattr(guard, "__name__", "")
        if not self.name.isidentifier() or self.name == "<lambda>":
            raise ValueError(
                f"`{type(self).__name__}` needs a name that is an identifier, but got {self.name!r}; pass `name=...`."
            )

    def __set_name__(self, owner: type, name: str) -> None:
        self.name = name

    def __get__(self, instance: Any, owner: type | None = None) -> Any:
        """On an instance: the indicator function h(t, y) bound to it. On the class: the switch itself."""
        return self if instance is None else partial(self.guard, instance)

    def _with(self, **parts: Any) -> Self:
        new = copy.copy(self)
        vars(new).update(parts)
        return new

    def components(self, system: "System", t: Scalar, y: Y) -> tuple[Scalar, ...]:
        """h as a tuple of scalars, whose minimum is the indicator function."""
        h = self.guard(system, t, y)
        return h if isinstance(h, tuple) else (h,)

    def least(self, system: "System", t: Scalar, y: Y) -> Scalar:
        """The indicator function: the minimum of its components."""
        return ft.reduce(jnp.minimum, self.components(system, t, y))

    def surfaces(self, system: "System", t: Scalar, y: Y) -> tuple[Scalar, ...]:
        """All indicator functions at whose zeros its mode may change."""
        return self.components(system, t, y)

    @property
    def jumps(self) -> bool:
        """Whether its events change the state."""
        return False

    def value(self, mode: Int[Array, ""], dtype: Any) -> Scalar:
        """What `vector_field` is given for it in a mode, unless it holds the solution."""
        return mode.astype(dtype)

    @property
    def static(self) -> bool:
        """Whether it can hold with a larger |value| than it has off its surface."""
        return False

    def bound(self, system: "System") -> Any:
        """The largest |value| with which it can hold the solution."""
        return math.inf

    def closed(self, mode: Int[Array, ""]) -> Bool[Array, ""]:
        """Whether it is a contact that is closed in this mode."""
        return mode == 1

    def modes_after(self, direction: int) -> tuple[int, ...]:
        """The modes to which its event leads where h rises (`direction` 1), falls (-1), or either (0)."""
        return self.modes

    def words(self, mode: int) -> str:
        """The mode as a legend names it, if it needs to be named."""
        return ""

    def symbol(self, mode: int) -> str:
        """The mode in the words of an itinerary, as `belt+`; empty if it goes without saying."""
        return ""

    def event_symbol(self, before: int, after: int) -> str:
        """What happens at an event, in the words of an itinerary."""
        return self.symbol(after) or self.name

    def drawn(self, system: "System", t: Scalar, y: Y) -> dict[str, Scalar]:
        """The functions whose zeros are its surfaces in a phase plane, by their labels."""
        return {f"{self.name}: h = 0": self.least(system, t, y)}

    # Its guards, positive while the mode lasts, as `SwitchedSystem.guards` puts them together.

    def surface(self, model: "SwitchedSystem", k: int, t: Scalar, y: Y, state: ModeState) -> Scalar:
        """The indicator function that is zero at its next event, unless that is a bound of its value."""
        return pick(model.h(k, t, y), state.part[k])

    @abc.abstractmethod
    def guard_row(self, model: "SwitchedSystem", slot: Slot, t: Scalar, y: Y, state: ModeState) -> list[Scalar]:
        """The guard of a slot, whose event is the instant at which the last of its entries falls to zero."""

    def bound_guard(self, model: "SwitchedSystem", slot: Slot, value: Scalar, state: ModeState) -> Scalar:
        """How far its value is from the bound at which it ceases to hold."""
        return model.bound(slot.switch) - slot.part * value

    def known_row(self, model: "SwitchedSystem", slot: Slot, roots: Any, state: ModeState) -> list[Int[Array, ""]]:
        """How many roots each entry of `guard_row` has at the present instant, of `roots` that its surface has."""
        part = state.part[slot.switch]
        return [roots] if part is None else [select(part == slot.part, roots, 0)]

    # Mistakes.

    @abc.abstractmethod
    def check(self, system: "System", t: Scalar, y: Y, along: Callable[[Scalar], Y]) -> None:
        """Raises for mistakes that need no numbers to be seen; `along` is the vector field as a function of the value
        of this switch."""

    def laws(self, system: "System") -> list[tuple[str, str, Any, Any]]:
        """What must hold for its numbers: the name of its method, the law, whether it holds, the number."""
        return []

    def one_way(self, owner: str) -> str | None:
        """What keeps a system that has it from being run backwards, if anything does."""
        return None

    def _check_guard(self, system: "System", name: str, guard: Any, t: Scalar, y: Y) -> None:
        h = jax.eval_shape(lambda: guard(system, t, y))
        for part in h if isinstance(h, tuple) and not hasattr(h, "_fields") else (h,):
            if not isinstance(part, jax.ShapeDtypeStruct) or part.shape != () or part.dtype != t.dtype:
                got = part if not isinstance(part, jax.ShapeDtypeStruct) else f"{part.dtype}{list(part.shape)}"
                raise ValueError(
                    f"`{type(system).__name__}.{name}` must return a scalar of dtype {t.dtype} (or a tuple of them, "
                    f"meaning their minimum), but returned {got}. For many surfaces define a switch for each, or "
                    "override `switches`."
                )

    def __repr__(self) -> str:
        return f"{type(self).__name__}({self.name})"


class ResettingSwitch(AbstractSwitch):
    """A switch whose events may change the state by a function of the user's."""

    reset_fn: Guard = None
    inverse_fn: Guard = None

    def reset(self, fn: Guard) -> Self:
        """Decorates `reset(self, t, y) -> y_after`, of the structure of the state."""
        return self._with(reset_fn=fn)

    def inverse(self, fn: Guard) -> Self:
        """Decorates `inverse(self, t, y) -> y_before`, which undoes `reset`: for solutions backwards in time."""
        return self._with(inverse_fn=fn)

    @property
    def jumps(self) -> bool:
        return self.reset_fn is not None

    def _check_sign(self, system: "System", t: Scalar, y: Y) -> None:
        """Raises if the indicator function cannot be negative, so that it has no crossing."""
        if all(never_negative(lambda at: self.components(system, *at), (t, y))):
            raise ValueError(
                f"`{type(system).__name__}.{self.name}` is never negative (a square, an absolute value), so that a "
                "solution touches its zero without crossing it, and no event is found there. Return the gap with its "
                "sign. For a jump where a surface is crossed from either side write `@nsjax.sgn` with "
                f"`@{self.name}.reset`."
            )

    def _check_reset(self, system: "System", t: Scalar, y: Y) -> None:
        """Raises if the reset or its inverse does not return a state of the model's structure and shapes."""
        owner, name = type(system).__name__, self.name
        if self.inverse_fn is not None and self.reset_fn is None:
            raise ValueError(f"`{owner}.{name}.inverse` undoes a reset, but there is no `@{name}.reset`.")
        for part, fn in (("reset", self.reset_fn), ("inverse", self.inverse_fn)):
            if fn is None:
                continue
            after, want = jax.eval_shape(partial(fn, system, t, y)), jax.eval_shape(lambda: y)
            if jax.tree.structure(after) != jax.tree.structure(want) or _shapes(after) != _shapes(want):
                raise ValueError(
                    f"`{owner}.{name}.{part}` must return a state of the structure {_shapes(want)}, but returned "
                    f"{_shapes(after)}."
                )

    def one_way(self, owner: str) -> str | None:
        if self.reset_fn is None or self.inverse_fn is not None:
            return None
        return (
            f"`{owner}.{self.name}` has a reset, which does not tell the state before it from the one after it; to run "
            f"it backwards in time, give the state before it by `@{self.name}.inverse`."
        )


def _shapes(tree: Any) -> Any:
    return jax.tree.map(lambda x: f"{x.dtype.name}{list(x.shape)}", tree)


@ft.cache  # switches are told apart by identity
def within(switch: AbstractSwitch, path: tuple[str, ...], name: str, condition: str = "") -> Any:
    """The switch for a system in which the owner of the switch is found by the attributes of `path`; with the name that
    the switch of its `condition` has there."""

    def forward(fn: Callable[..., Any]) -> Callable[..., Any]:
        return lambda self, *args: fn(ft.reduce(getattr, path, self), *args)

    new: Any = switch._with(name=name, **{part: forward(fn) for part, fn in vars(switch).items() if callable(fn)})
    return new.while_(condition) if condition else new


def forwarded(switch: AbstractSwitch) -> Any:
    """The switch for a system that has the switch's own system as its field `system`."""
    return within(switch, ("system",), switch.name)


def declared(cls: type) -> tuple[AbstractSwitch, ...]:
    """The decorated methods of a class in order of definition, base classes first."""
    found: dict[str, Any] = {}
    for base in reversed(cls.__mro__):
        for name, value in vars(base).items():
            if isinstance(value, AbstractSwitch):
                found[name] = value
            elif name in found:
                del found[name]
    return tuple(found.values())
