"""The model: a differential inclusion y' = f(t, y, s) with s_k in Sgn(h_k(t, y)).

The vector field takes the switch values `s` as an argument; what is put for them decides the method
(a sign: the smooth field of one region; a multiplier: Filippov's sliding field (2.19); an arctangent: the smoothing
method (2.32)).
"""

import abc
import dataclasses
import inspect
from typing import Any, ClassVar, Self

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from .._numerics._text import did_you_mean
from .._types import Scalar, Y
from ._switch import AbstractSwitch, declared


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
        return declared(type(self))

    @property
    def period(self) -> Float[Array, ""] | float | None:
        """Period of the explicit time dependence [time], to be overridden: `return 2 * jnp.pi / self.omega`. `None`,
        the default, is for an autonomous model."""
        return None

    jumps_in_time: ClassVar[str] = "refused"
    """What is done about functions of the time that jump or have kinks. The times at which they do are read off the
    program and met exactly, as by a `clock`; a model that jumps at other times, and has no clock, is "refused" by
    default, or these are "missed": the control of the step size alone sees them, and may step over them. "ignored":
    no times are sought at all."""

    @property
    def members(self) -> dict[str, Any]:
        """What parameters are found in, by name: the fields. A system that is assembled at run time names its parts."""
        return {field.name: getattr(self, field.name) for field in dataclasses.fields(self)}

    @property
    def laws(self) -> list[tuple[str, str, Any, Any]]:
        """What must hold for the parameters, beside what the switches ask for, checked where they are known: the name
        of a parameter, the law, whether it holds, and the value."""
        return []

    def assembled(self) -> "System":
        """The same, put together once to be evaluated many times: by default the system itself."""
        return self

    @property
    def owner(self) -> "System":
        """The system of the user, of one that is `assembled`."""
        return self

    def values(self, s: tuple[Any, ...]) -> SwitchValues:
        """The argument `s` of `vector_field` from a tuple of values in the order of `switches`."""
        return SwitchValues(type(self).__name__, dict(zip([k.name for k in self.switches], s)))


def is_number(field: dataclasses.Field) -> bool:
    """Whether a field is declared to be a number, which may be left out."""
    return field.type in (float, "float", float | None, "float | None")


def _with_floats(x: Any) -> Any:
    """The integers given for fields that are numbers as floats, in modules within modules too."""
    if type(x) is tuple:
        parts = tuple(map(_with_floats, x))
        return x if all(new is old for new, old in zip(parts, x)) else parts
    if not isinstance(x, eqx.Module):
        return x
    changed: dict[str, Any] = {}
    for field in dataclasses.fields(x):
        value = getattr(x, field.name)
        whole = is_number(field) and isinstance(value, int) and not isinstance(value, bool)
        new = float(value) if whole else _with_floats(value)
        if new is not value:
            changed[field.name] = new
    for name, new in changed.items():
        x = eqx.tree_at(lambda m, name=name: getattr(m, name), x, new, is_leaf=lambda leaf: leaf is None)
    return x


def arrays_of(system: System, dtype: Any) -> System:
    """Turns the Python numbers among the parameters into arrays, so that a new value does not retrace.

    A field annotated `float` but given an `int` counts as a number; other `int` and `bool` fields stay static, as they
    may decide shapes.
    """

    def convert(x: Any) -> Any:
        if isinstance(x, float):
            return jnp.asarray(x, dtype)
        # A weakly typed array, such as `jnp.asarray(0.2)`, would be one more program to compile.
        return jnp.asarray(x, x.dtype) if isinstance(x, jax.Array) else x

    return jax.tree.map(convert, _with_floats(system))
