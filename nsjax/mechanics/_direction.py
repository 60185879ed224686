"""Geometry apart from law: along which distance, or velocity, a force acts.

A force F along a distance d(q) does the power F d', so that the generalised forces are F ∂d/∂q; along a velocity
w(q, v), linear in v, that is no derivative of a distance (rolling), they are F ∂w/∂v. Parts that are zero whatever the
state are left out, and factors 1 and -1 are signs: a force along a coordinate costs what it costs written by hand.
"""

import abc
import functools as ft
from collections.abc import Callable, Mapping
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
from jax.core import Tracer

from .._numerics._jaxpr import is_constant, touched
from .._numerics._text import did_you_mean
from .._types import Number, Scalar
from ._state import coordinates_type, State


Term = tuple[str, int, Any]
"""A summand of the equation of motion of a coordinate: its name, the sign, and the value."""


class Direction(eqx.Module):
    """A distance d(q), or a velocity w(q, v), along which a force acts."""

    @abc.abstractmethod
    def distance(self, q: Any) -> Number:
        """d(q), of the unit of the coordinates."""

    @abc.abstractmethod
    def velocity(self, q: Any, v: Any) -> Number:
        """d' = ∂d/∂q v, in units of d per unit of time."""

    @abc.abstractmethod
    def terms(self, y: State, force: Number, sign: int) -> list[Term]:
        """The generalised forces of `sign * force` along it."""

    @abc.abstractmethod
    def check(self, owner: str, names: tuple[str, ...]) -> None:
        """Raises `ValueError` for what does not fit a scene with these coordinates; `owner` is the effect's name."""

    @property
    @abc.abstractmethod
    def opposite(self) -> "Direction":
        """The direction of -d."""

    @property
    def slopes(self) -> dict[str, int] | None:
        """The coordinates of which it is a sum or difference, with their signs; None for anything else."""
        return None


class Coordinate(Direction):
    """d = q.name."""

    name: str = eqx.field(static=True)

    def distance(self, q: Any) -> Number:
        return getattr(q, self.name)

    def velocity(self, q: Any, v: Any) -> Number:
        return getattr(v, self.name)

    def terms(self, y: State, force: Number, sign: int) -> list[Term]:
        return [(self.name, sign, force)]

    def check(self, owner: str, names: tuple[str, ...]) -> None:
        check_name(owner, self.name, names)

    @property
    def opposite(self) -> Direction:
        return Combination({self.name: -1})

    @property
    def slopes(self) -> dict[str, int]:
        return {self.name: 1}

    def __str__(self) -> str:
        return self.name


class Combination(Direction):
    """d = Σ factor q.name. Integer factors are geometry and fixed, others are numbers with derivatives."""

    names: tuple[str, ...] = eqx.field(static=True)
    whole: tuple[int | None, ...] = eqx.field(static=True)  # the factors that are integers
    factors: tuple[Any, ...]  # the others

    def __init__(self, factors: Mapping[str, Any]):
        if not factors:
            raise ValueError("Argument `along` must name a coordinate, but is an empty combination.")
        self.names = tuple(factors)
        given = factors.values()
        self.whole = tuple(f if isinstance(f, int) else None for f in given)
        self.factors = tuple(None if isinstance(f, int) else f for f in given)

    def _sum(self, q: Any) -> Number:
        return signed_sum(product(w, f, getattr(q, n)) for n, w, f in zip(self.names, self.whole, self.factors))

    def distance(self, q: Any) -> Number:
        return self._sum(q)

    def velocity(self, q: Any, v: Any) -> Number:
        return self._sum(v)

    def terms(self, y: State, force: Number, sign: int) -> list[Term]:
        found = []
        for name, whole, factor in zip(self.names, self.whole, self.factors):
            own, value = product(whole, factor, force)
            found.append((name, sign * own, value))
        return found

    def check(self, owner: str, names: tuple[str, ...]) -> None:
        for name in self.names:
            check_name(owner, name, names)

    @property
    def opposite(self) -> Direction:
        given = [f if w is None else w for w, f in zip(self.whole, self.factors)]
        return Combination({n: -f for n, f in zip(self.names, given)})

    @property
    def slopes(self) -> dict[str, int] | None:
        signs = {n: w for n, w in zip(self.names, self.whole) if w in (1, -1)}
        return signs if len(signs) == len(self.names) else None

    def __str__(self) -> str:
        text = ""
        for name, w, f in zip(self.names, self.whole, self.factors):
            factor = w if f is None else float(f) if not isinstance(f, Tracer) else "?"
            sign = "-" if isinstance(factor, int | float) and factor < 0 else "+"
            size = abs(factor) if isinstance(factor, int | float) else factor
            term = name if size == 1 else f"{size:g} {name}" if isinstance(size, int | float) else f"{size} {name}"
            text += f" {sign} {term}" if text else f"-{term}" if sign == "-" else term
        return text


class _Plain(eqx.Module):
    """A function that holds no numbers of its own, so that derivatives and `jit` need not look at it."""

    fn: Callable[..., Any] = eqx.field(static=True)

    def __call__(self, *args: Any) -> Any:
        return self.fn(*args)


def function(fn: Callable[..., Any]) -> Any:
    """A user's function as a part of a module: one with parameters is a module itself."""
    return fn if isinstance(fn, eqx.Module | jax.tree_util.Partial) else _Plain(fn)


class Function(Direction):
    """d = fn(q), a smooth function; with `sign` -1 its negative."""

    fn: Any
    sign: int = eqx.field(static=True, default=1)

    def distance(self, q: Any) -> Number:
        d = self.fn(q)
        return d if self.sign == 1 else -d

    def velocity(self, q: Any, v: Any) -> Number:
        slopes = {n: slope for n, slope in self.slopes_at(q).items() if slope is not None}
        if len(slopes) < len(self.slopes_at(q)):
            w = jax.jvp(self.fn, (q,), (v,))[1]
            return w if self.sign == 1 else -w
        return signed_sum(product(None, self.sign * slope, getattr(v, n)) for n, slope in slopes.items())

    def terms(self, y: State, force: Number, sign: int) -> list[Term]:
        found, sign, slopes = [], sign * self.sign, self.slopes_at(y.q)
        for name, slope in slopes.items():
            if slope is not None:
                own, value = product(None, slope, force)
                found.append((name, sign * own, value))
        curved = [name for name, slope in slopes.items() if slope is None]
        if curved:
            pulled = pulls(lambda part: self.fn(y.q._replace(**part)), {n: getattr(y.q, n) for n in curved}, force)
            found += [(name, sign, value) for name, value in pulled.items()]
        return found

    def check(self, owner: str, names: tuple[str, ...]) -> None:
        _check_function(owner, self.fn, (coordinates_type(names),))

    @property
    def opposite(self) -> Direction:
        return Function(self.fn, -self.sign)

    def slopes_at(self, q: Any) -> dict[str, float | None]:
        """∂d/∂q by coordinate, where it is not zero: the number if it is constant, else None."""
        if isinstance(self.fn, _Plain):
            return _slopes_of(self.fn.fn, type(q), jnp.result_type(float))
        return {name: None for name in _touching(self.fn, q)}

    def __str__(self) -> str:
        return ("" if self.sign == 1 else "-") + _name(self.fn) + "(q)"


class Velocity(Direction):
    """w = fn(q, v), linear in v, which need not be the derivative of a distance: of a wheel that rolls, of a rotor in
    its stator, (A.6). For dampers and friction; what asks for a distance along it raises `ValueError`.

    ```python
    Friction(Velocity(lambda q, v: (q.x * v.y - q.y * v.x) / jnp.hypot(q.x, q.y) + R * v.phi), ...)
    ```
    """

    fn: Any
    sign: int = eqx.field(static=True, default=1)

    def __init__(self, fn: Callable[[Any, Any], Any], sign: int = 1):
        self.fn, self.sign = function(fn), sign

    def distance(self, q: Any) -> Number:
        raise ValueError("A `Velocity` is no derivative of a distance: give `along` a function of q, or a coordinate.")

    def velocity(self, q: Any, v: Any) -> Number:
        w = self.fn(q, v)
        return w if self.sign == 1 else -w

    def terms(self, y: State, force: Number, sign: int) -> list[Term]:
        there = _touching(lambda v: self.fn(y.q, v), y.v)
        part = {name: getattr(y.v, name) for name in there}
        pulled = pulls(lambda part: self.fn(y.q, y.v._replace(**part)), part, force)
        return [(name, sign * self.sign, value) for name, value in pulled.items()]

    def check(self, owner: str, names: tuple[str, ...]) -> None:
        _check_function(owner, self.fn, (coordinates_type(names),) * 2)

    @property
    def opposite(self) -> Direction:
        return Velocity(self.fn, -self.sign)

    def __str__(self) -> str:
        return ("" if self.sign == 1 else "-") + _name(self.fn) + "(q, v)"


def direction(along: Any) -> Direction:
    """The direction that a user means by a coordinate's name, a combination of names, or a function of q."""
    if isinstance(along, Direction):
        return along
    if isinstance(along, str):
        return Coordinate(along)
    if isinstance(along, Mapping):
        return Combination(along)
    if callable(along):
        return Function(function(along))
    raise TypeError(
        "Argument `along` must be the name of a coordinate, a combination such as {'x1': 1, 'x2': -1}, or a function "
        f"of q, but got {along!r}."
    )


def product(whole: int | None, factor: Any, x: Any) -> tuple[int, Any]:
    """The sign and the size of a product by an integer, or by a factor; by 1 and -1 it is no product."""
    factor = whole if factor is None else factor
    if isinstance(factor, int | float) and factor in (1, -1):
        return int(factor), x
    return 1, factor * x


def signed_sum(terms: Any) -> Any:
    """The sum of values with signs, in as few operations as by hand; None if there is none."""
    terms = list(terms)
    first = [x for sign, x in terms if sign > 0]
    rest = [x for sign, x in terms if sign < 0]
    if not terms:
        return None
    total = first.pop(0) if first else -rest.pop(0)
    for x in first:
        total = total + x
    for x in rest:
        total = total - x
    return total


def pulls(fn: Callable[[Any], Any], x: dict[str, Any], force: Any) -> dict[str, Any]:
    """`force` times the derivatives of `fn`, a scalar, by each of the numbers `x`."""
    d, pull = jax.vjp(fn, {name: jnp.asarray(value) for name, value in x.items()})
    return pull(jnp.asarray(force, d.dtype))[0]


def _touching(fn: Callable[[Any], Any], q: Any) -> list[str]:
    """The coordinates on which a function depends."""
    return [n for n in q._fields if any(touched(lambda x, n=n: fn(q._replace(**{n: x})), jnp.asarray(getattr(q, n))))]


@ft.lru_cache(maxsize=1024)
def _slopes_of(fn: Callable[[Any], Any], kind: Any, dtype: Any) -> dict[str, float | None]:
    """See `Function.slopes_at`. The function is looked at once for each set of coordinates."""
    with jax.ensure_compile_time_eval():
        q = kind(*[jnp.zeros((), dtype) for _ in kind._fields])
    found: dict[str, float | None] = {}
    for name in _touching(fn, q):

        def slope(q: Any, name: str = name) -> Scalar:
            one = kind(*[jnp.full((), float(n == name), dtype) for n in kind._fields])
            return jax.jvp(fn, (q,), (one,))[1]

        found[name] = None
        if is_constant(slope, q):
            with jax.ensure_compile_time_eval():
                value = slope(q)
            found[name] = None if isinstance(value, Tracer) else float(value)
    return found


def check_name(owner: str, name: str, names: tuple[str, ...]) -> None:
    """Raises `ValueError` for a coordinate that the scene does not have."""
    if name not in names:
        raise ValueError(
            f"Effect `{owner}` must act along coordinates of the scene ({', '.join(names)}), but asks for `{name}`."
            + did_you_mean(str(name), names)
        )


def _check_function(owner: str, fn: Any, kinds: tuple[Any, ...]) -> None:
    """Checks that a function of coordinates is a scalar of theirs."""
    zeros = [kind(*[jax.ShapeDtypeStruct((), jnp.result_type(float)) for _ in kind._fields]) for kind in kinds]
    names = ", ".join(kinds[0]._fields)
    try:
        out = jax.eval_shape(fn, *zeros)
    except AttributeError as error:
        text = f"The function of effect `{owner}` must ask for coordinates of the scene ({names}): {error}."
        raise ValueError(text) from error
    if not isinstance(out, jax.ShapeDtypeStruct) or out.shape != () or not jnp.issubdtype(out.dtype, jnp.floating):
        raise ValueError(f"The function of effect `{owner}` must return a scalar, but returned {out}.")


def _name(fn: Any) -> str:
    fn = fn.fn if isinstance(fn, _Plain) else fn
    name = getattr(fn, "__name__", type(fn).__name__)
    return "d" if name == "<lambda>" else name
