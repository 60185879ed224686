"""What a sweep tells the functions that it traces: that the model decides the method, and that a first, smaller program
may leave lanes over for a second one, which is compiled only if there are any.

What is traced within `first_pass` may say of a lane that it has not worked it out (`left_over`). Whoever calls it takes
what it returns by `told`, which returns beside it whether anything in the lane was left over, and computes such lanes
again, within `whole_pass`.
"""

import functools as ft
from collections.abc import Callable, Sequence
from contextlib import AbstractContextManager
from typing import Any

import equinox as eqx
import jax
import jax.extend.core as jex
import jax.lax as lax
import jax.numpy as jnp
from jaxtyping import Array, Bool

from ._evaluation import applied, called, Evaluation, within
from ._inner import scan_counts
from ._operation import Operation


# (JAX keeps what is traced in one such context apart from what is traced in another.)
_pass = jax.make_user_context(default_value="none")


class UnreachableError(Exception):
    """Something was left over where nobody can tell, or where it could keep a loop from coming to its end."""


def first_pass() -> AbstractContextManager[None]:
    """Returns a context for the first program of a sweep."""
    return _pass("first")


def whole_pass() -> AbstractContextManager[None]:
    """Returns a context for a program of a sweep that leaves no lane over."""
    return _pass("whole")


def is_first_pass() -> bool:
    return _pass.value == "first"


def is_sweep() -> bool:
    """Whether a function is traced by `nsjax.sweep`."""
    return _pass.value != "none"


def left_over(when: Bool[Array, ""], tree: Any) -> Any:
    """`tree`, on whose arrays whatever is made of them depends, so that what is said of it is not lost."""
    dynamic, static = eqx.partition(tree, eqx.is_array)
    flat, form = jax.tree.flatten(dynamic)
    return eqx.combine(jax.tree.unflatten(form, LEFT_OVER.bind(when, *flat)), static)


def _batch(args: Any, dims: Any) -> tuple[list[Any], list[Any]]:
    when, dim = args[0], dims[0]
    if dim is not None:  # a batch within the lane
        when = jnp.any(when, axis=dim)
    return LEFT_OVER.bind(when, *args[1:]), list(dims[1:])


def _jvp(primals: Any, tangents: Any) -> tuple[list[Any], list[Any]]:
    return LEFT_OVER.bind(*primals), list(tangents[1:])


LEFT_OVER = Operation(
    "left_over",
    run=lambda when, *xs: list(xs),
    shapes=lambda when, *xs: list(xs),
    batch=_batch,
    jvp=_jvp,
    reached=lambda have: have[1:],
)


def told(fn: Callable[..., Any]) -> Callable[..., tuple[Any, Bool[Array, ""] | None]]:
    """What `fn` returns, and whether anything was left over; None if nothing could be. Raises `UnreachableError`."""

    def call(*args: Any) -> tuple[Any, Any]:
        dynamic, static = eqx.partition(args, eqx.is_array)
        flat, tree = jax.tree.flatten(dynamic)
        closed, form = jax.make_jaxpr(
            lambda *xs: fn(*eqx.combine(jax.tree.unflatten(tree, xs), static)), return_shape=True
        )(*flat)
        said: list[Any] = []
        out = _evaluated(closed, flat, said)
        return jax.tree.unflatten(jax.tree.structure(form), out), ft.reduce(jnp.logical_or, said) if said else None

    return call


def _says(e: Any) -> bool:
    """Whether an operation leaves something over."""
    return LEFT_OVER.is_in(e)


def _called(e: Any, x: list[Any], said: list[Any]) -> list[Any]:
    """What an operation with programs of its own returns, some of which say something."""

    def of(closed: jex.ClosedJaxpr, *x: Any) -> tuple[list[Any], Any]:
        own: list[Any] = [jnp.zeros((), bool)]
        out = _evaluated(closed, x, own)
        return out, ft.reduce(jnp.logical_or, own)

    inner = called(e)
    if inner is not None:
        out, own = of(inner, *x)
    elif e.primitive.name == "cond":
        out, own = lax.switch(x[0], [ft.partial(of, branch) for branch in e.params["branches"]], *x[1:])
    elif e.primitive.name == "scan":
        consts, carried = scan_counts(e.params)
        begin, rows = x[consts : consts + carried], x[consts + carried :]

        def turn(carry: list[Any], row: list[Any]) -> tuple[list[Any], tuple[list[Any], Any]]:
            out, own = of(e.params["jaxpr"], *x[:consts], *carry, *row)
            return out[:carried], (out[carried:], own)

        keep = {name: e.params[name] for name in ("length", "reverse", "unroll")}
        end, (more, each) = lax.scan(turn, begin, rows, **keep)
        out, own = [*end, *more], jnp.any(each)
    else:
        raise UnreachableError
    said.append(own)
    return out


def _evaluated(closed: jex.ClosedJaxpr, values: Sequence[Any], said: list[Any]) -> list[Any]:
    program = Evaluation(closed, values, lambda x, aval: x)
    for e, x in program:
        if _says(e):
            said.append(x[0])
            program.put(e, x[1:])
        else:
            program.put(e, _called(e, x, said) if within(e, _says) else applied(e, x))
    return program.results
