"""A field that is smooth on both sides of its surfaces in each mode, where it is written with |h|.

Friction that depends on the sliding velocity is written with |v_rel|, and v_rel = 0 is the surface of its switch. In a
mode |h| is h or -h. On the surface itself, where every mode begins or ends, rounding chooses which of them a program
takes, and beside it a search that has not converged is on the other side. A solution takes no notice; the equations of
a periodic orbit, and their derivatives, are those of the mode only if it is told which one to take.
"""

import functools as ft
import itertools
from collections.abc import Callable
from typing import Any, NamedTuple, TYPE_CHECKING

import equinox as eqx
import jax
import jax.lax as lax
import jax.numpy as jnp
from jaxtyping import Array

from .._numerics._kinks import evaluate, has_kinks, is_partial, Seen
from .._numerics._origins import Entry, Origins, Way
from .._numerics._select import select
from .._types import Scalar, Y
from ._sgn import sgn
from ._system import arrays_of, System


if TYPE_CHECKING:
    from ._model import SwitchedSystem


class Side(NamedTuple):
    """A kink on the surface of a switch."""

    kink: int  # its number, as they are met in the program of the field
    at: int  # which entry of it, where it is one of several numbers
    switch: int
    way: Way  # from its h to that of the switch, but for factors that are written there
    sign: int  # of these
    idle: bool  # whether the switch may be off, with value 0 wherever its h is


class Sides(NamedTuple):
    """All of them."""

    kinks: tuple[Side, ...]
    partial: bool  # whether beyond a surface the field may not be defined: h**1.5


def sides_of(model: "SwitchedSystem", t: Scalar, y: Y) -> Sides | None:
    """The kinks of a model's field on surfaces of its own `sgn` switches, as the operations tell that they are there:
    of the same difference, of its negative or a multiple, among several or alone. None of a field with a kink within a
    loop."""
    own = [k for k, switch in enumerate(model.switches) if isinstance(switch, sgn) and model.parts[k] == 1]
    args, system = _arguments(model.system, t, y, tuple(0.0 for _ in model.switches))

    def field(args: tuple) -> Y:
        return _field(system(args), *args[1:])

    if not own or not has_kinks(field, args):
        return None
    found: list[Side] = []

    def both(args: Any) -> tuple[Y, list[Scalar]]:
        whole, (_, t, y, _) = system(args), args
        return _field(whole, *args[1:]), [whole.switches[k].components(whole, t, y)[0] for k in own]

    def look(args: Any) -> None:
        seen: Seen = {}
        walk, kinks = evaluate(both, args, seen=seen), []
        try:
            while True:
                kinks.append(next(walk)[1])
        except StopIteration as end:
            surfaces = end.value[1]
        except ValueError:
            return
        origins = Origins(seen)
        cores = [origins.core(Entry(level)) for level in surfaces]
        for i, h in enumerate(kinks):
            for at, (k, (core, sign)) in itertools.product(range(h.size), zip(own, cores)):
                way = origins.way(Entry(h, at), core)
                if way is not None:
                    found.append(Side(i, at, k, way, sign, model.conditional(k)))

    jax.eval_shape(look, args)  # of which nothing stays in a program that is being traced
    return Sides(tuple(found), is_partial(field, args)) if found else None


def one_sided(system: System, sides: Sides, t: Scalar, y: Y, s: tuple[Any, ...]) -> Y:
    """The vector field, with the signs of some kinks taken from the switches (zero for the value 0, about which the
    field is linearised where one holds); as it is written where it is not defined so."""
    args, whole = _arguments(system, t, y, s)
    f = _told(lambda args: _field(whole(args), *args[1:]), sides, s, args)
    if not sides.partial:
        return f
    good = ft.reduce(jnp.logical_and, [jnp.all(jnp.isfinite(x)) for x in jax.tree.leaves(f)])
    return jax.tree.map(lambda x, plain: select(good, x, plain), f, _field(system, t, y, s))


def _told(field: Callable[[tuple], Y], sides: Sides, s: tuple[Any, ...], args: tuple) -> Y:
    at = {(side.kink, side.at): side for side in sides.kinks}
    seen: Seen = {}
    walk, sent = evaluate(field, args, seen=seen), None
    for i in itertools.count():
        try:
            _, h = walk.send(sent)
        except StopIteration as end:
            return end.value
        here = [at.get((i, n)) for n in range(h.size)]
        sent = lax.stop_gradient(_signs(h, here, s, Origins(seen))) if any(here) else None


def _signs(h: Array, sides: list[Side | None], s: tuple[Any, ...], origins: Origins) -> Array:
    """Of the entries of h; without a switch as JAX differentiates |h|."""
    signs = list(jnp.ravel(select(h < 0, -1, 1).astype(h.dtype)))
    for n, side in enumerate(sides):
        if side is not None:
            told = side.sign * origins.sign(Entry(h, n), side.way) * jnp.sign(s[side.switch])
            signs[n] = select(s[side.switch] == 0, signs[n], told) if side.idle else told
    return jnp.stack(signs).reshape(h.shape)


def _field(system: System, t: Scalar, y: Y, s: tuple[Any, ...]) -> Y:
    return system.vector_field(t, y, system.values(s))


def _arguments(system: System, t: Scalar, y: Y, s: tuple[Any, ...]) -> tuple[tuple, Callable[[tuple], System]]:
    """As arrays, the numbers of the system first (not within the program, where equal numbers would be the same one);
    and how they make the system again."""
    dtype = jnp.result_type(*jax.tree.leaves(y))
    numbers, rest = eqx.partition(arrays_of(system, dtype), eqx.is_array)
    args = (numbers, *jax.tree.map(lambda x: jnp.asarray(x, dtype), (t, y, s)))
    return args, lambda args: eqx.combine(args[0], rest)
