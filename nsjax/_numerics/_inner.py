"""What primitives that carry functions need of them: their jaxprs with all that they close over as arguments, which
results a batch of arguments reaches, and their derivatives."""

from collections.abc import Callable, Sequence
from typing import Any

import jax
import jax.core
import jax.extend.core as jex
import jax.numpy as jnp
from jax.interpreters import ad, partial_eval as pe


Flat = Callable[..., list[Any]]  # of arrays, to arrays


def opened(closed: jex.ClosedJaxpr) -> jex.ClosedJaxpr:
    """The jaxpr with its constants as its first arguments."""
    jaxpr = closed.jaxpr
    names = (*[""] * len(jaxpr.constvars), *jaxpr.debug_info.arg_names)
    free = jaxpr.replace(
        constvars=[], invars=[*jaxpr.constvars, *jaxpr.invars], debug_info=jaxpr.debug_info._replace(arg_names=names)
    )
    return jex.ClosedJaxpr(free, ())


def batched_outputs(jaxpr: jex.ClosedJaxpr, batched: Sequence[bool]) -> list[bool]:
    """Which outputs depend on the inputs that are batched."""
    outs = jaxpr.jaxpr.outvars
    found = []
    for i in range(len(outs)):
        _, used = pe.dce_jaxpr(jaxpr.jaxpr, [i == j for j in range(len(outs))])
        found.append(any(u and b for u, b in zip(used, batched)))
    return found


def spread(x: Any, size: int) -> Any:
    """The same for all lanes."""
    return jnp.broadcast_to(x, (size, *x.shape))


def mapped(fn: Flat, size: int, batched: Sequence[bool], wide: Sequence[bool]) -> Flat:
    """`fn` of batched arguments. Results that do not depend on these (the primals, under `jacfwd`) stay without the
    axis, where `wide` says so."""

    def many(*xs: Any) -> list[Any]:
        if not any(batched):
            return [spread(x, size) if w else x for x, w in zip(fn(*xs), wide)]
        results = jax.vmap(fn, in_axes=tuple(0 if b else None for b in batched))(*xs)
        return [x if w else x[0] for x, w in zip(results, wide)]

    return many


def moving(tangents: Sequence[Any]) -> list[int]:
    """Which arguments have a tangent. What has none must not get one: loops on it would have to carry it."""
    return [i for i, move in enumerate(tangents) if type(move) is not ad.Zero]


def pushed_forward(fn: Flat, count: int, smooth: Sequence[int], kept: Sequence[int]) -> Flat:
    """Of `count` arguments and the tangents of those in `smooth`: results, and tangents of those in `kept`."""

    def both(*xs: Any) -> list[Any]:
        inputs, moves = xs[:count], xs[count:]

        def inexact(*own: Any) -> list[Any]:
            full = list(inputs)
            for i, x in zip(smooth, own):
                full[i] = x
            return list(fn(*full))

        out, change = jax.jvp(inexact, tuple(inputs[i] for i in smooth), moves)
        return [*out, *[change[i] for i in kept]]

    return both


def with_zeros(out: Sequence[Any], kept: Sequence[int], change: Sequence[Any]) -> list[Any]:
    """Tangents of all results."""
    full: list[Any] = [ad.Zero(jax.core.ShapedArray(x.shape, jax.dtypes.float0)) for x in out]
    for i, c in zip(kept, change, strict=True):
        full[i] = c
    return full
