"""Work that stands in a program once, in a loop, or written out where it runs for the lanes of a batch.

A loop compiles faster; written out, each number is its own array, and a batch runs up to three times as fast. Which of
the two it is to be is known when a program is transformed, and not before: a batch of *arguments* is one of lanes, a
batch of tangents alone (`jacfwd`) is not.
"""

import functools as ft
from collections.abc import Callable
from typing import Any

import jax
import jax.extend.core as jex
import jax.numpy as jnp
from jax.interpreters import partial_eval as pe

from ._inner import batched_outputs, Flat, mapped, moving, opened, pushed_forward, with_zeros
from ._operation import Operation
from ._products import full_products


def rolled(
    loop: Callable[..., Any], written_out: Callable[..., Any], fn: Callable[..., Any], at: tuple, *args: Any
) -> Any:
    """`loop(fn, *args)`; in lanes `written_out(fn, *args)`, the same numbers. `fn` is traced once, at the arguments
    `at`, and is all that the two may need beside `args`."""
    inner, form = jax.make_jaxpr(fn, return_shape=True)(*at)
    flat, tree = jax.tree.flatten(args)
    count, structure, call = len(inner.consts), jax.tree.structure(form), jex.jaxpr_as_fun(opened(inner))

    def of(way: Callable[..., Any], *inputs: Any) -> Any:
        def known(*at: Any) -> Any:
            return jax.tree.unflatten(structure, call(*inputs[:count], *jax.tree.leaves(at)))

        return way(known, *jax.tree.unflatten(tree, inputs[count:]))

    @full_products  # it may be traced later
    def lanes(*inputs: Any) -> list[Any]:
        return jax.tree.leaves(of(written_out, *inputs))

    inputs = [*inner.consts, *flat]
    return bound(inputs, ft.partial(of, loop), lanes, (True,) * len(inputs))


def bound(inputs: list[Any], loop: Callable[..., Any], written_out: Flat, own: tuple[bool, ...]) -> Any:
    """`own` says which inputs are arguments, and no tangents."""
    jaxpr, form = jax.make_jaxpr(loop, return_shape=True)(*inputs)
    results = ROLLED.bind(*inputs, jaxpr=jaxpr, written_out=written_out, own=own)
    return jax.tree.unflatten(jax.tree.structure(form), results)


def _run(*inputs: Any, jaxpr: jex.ClosedJaxpr, written_out: Flat, own: tuple[bool, ...]) -> list[Any]:
    return jex.jaxpr_as_fun(jaxpr)(*inputs)


def _batch(
    inputs: Any, dims: Any, *, jaxpr: jex.ClosedJaxpr, written_out: Flat, own: tuple[bool, ...]
) -> tuple[list[Any], list[int | None]]:
    size = next(x.shape[d] for x, d in zip(inputs, dims) if d is not None)
    front = [x if d is None else jnp.moveaxis(x, d, 0) for x, d in zip(inputs, dims)]
    batched = [d is not None for d in dims]
    wide = batched_outputs(jaxpr, batched)
    if any(b and o for b, o in zip(batched, own)):
        results = mapped(written_out, size, batched, wide)(*front)
    else:
        loop, other = (mapped(fn, size, batched, wide) for fn in (jex.jaxpr_as_fun(jaxpr), written_out))
        results = bound(front, loop, other, own)
    return results, [0 if w else None for w in wide]


def _jvp(
    inputs: Any, tangents: Any, *, jaxpr: jex.ClosedJaxpr, written_out: Flat, own: tuple[bool, ...]
) -> tuple[list[Any], list[Any]]:
    smooth = moving(tangents)
    kept = [i for i, a in enumerate(jaxpr.out_avals) if jnp.issubdtype(a.dtype, jnp.inexact)]
    loop, other = (pushed_forward(fn, len(inputs), smooth, kept) for fn in (jex.jaxpr_as_fun(jaxpr), written_out))
    results = bound([*inputs, *[tangents[i] for i in smooth]], loop, other, own + (False,) * len(smooth))
    count = len(jaxpr.out_avals)
    return results[:count], with_zeros(results[:count], kept, results[count:])


def _pruned(used: list[bool], eqn: Any) -> tuple[list[bool], Any]:
    """Without the results that nobody uses, and what only they need: else primals would seem to depend on tangents."""
    params = eqn.params
    closed, written_out, avals = params["jaxpr"], params["written_out"], params["jaxpr"].in_avals
    jaxpr, needed = pe.dce_jaxpr(closed.jaxpr, used)

    def part(*xs: Any) -> list[Any]:
        given = iter(xs)
        full = [next(given) if n else jnp.zeros(a.shape, a.dtype) for n, a in zip(needed, avals)]
        return [x for x, u in zip(written_out(*full), used) if u]

    new = eqn.replace(
        invars=[v for v, n in zip(eqn.invars, needed) if n],
        outvars=[v for v, u in zip(eqn.outvars, used) if u],
        params=dict(
            jaxpr=jex.ClosedJaxpr(jaxpr, closed.consts),
            written_out=part,
            own=tuple(o for o, n in zip(params["own"], needed) if n),
        ),
    )
    return needed, new


ROLLED = Operation(
    "rolled",
    run=_run,
    shapes=lambda *_, jaxpr, written_out, own: list(jaxpr.out_avals),
    batch=_batch,
    jvp=_jvp,
    reached=lambda have, jaxpr, written_out, own: batched_outputs(jaxpr, have),
    prune=_pruned,
)
