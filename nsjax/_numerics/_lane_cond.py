"""Work that only a few lanes of a batch need: a `cond` whose branch is run for these lanes alone.

Under `vmap` a `lax.cond` becomes a `select`, and every lane pays for the branch; a branch on `any(...)` is skipped only
while no lane at all has work. Here the lanes that do have work are gathered into groups, so that the cost is that of
the work done. The rule survives `jvp` and nested `vmap` in any order.
"""

from collections.abc import Callable
from typing import Any

import jax
import jax.extend.core as jex
import jax.lax as lax
import jax.numpy as jnp
from jax.interpreters import ad

from ._inner import batched_outputs, mapped, moving, opened, pushed_forward, spread, with_zeros
from ._operation import Operation
from ._select import select


GROUP = 32  # lanes worked on together, at least; a kernel costs as much to start as for some hundred lanes


def compact_cond(pred: Any, branch: Callable[..., Any], args: Any, default: Any, group: int = GROUP) -> Any:
    """`branch(*args)` if `pred`, else `default`, both pytrees of arrays of the same structure. `group`: how many lanes
    are worked on together, at least."""
    flat, tree = jax.tree.flatten(args)
    closed, out = jax.make_jaxpr(lambda *xs: branch(*jax.tree.unflatten(tree, xs)), return_shape=True)(*flat)
    other = [jnp.asarray(d, o.dtype) for d, o in zip(jax.tree.leaves(default), jax.tree.leaves(out), strict=True)]
    results = COMPACT_COND.bind(pred, *closed.consts, *flat, *other, jaxpr=opened(closed), group=group)
    return jax.tree.unflatten(jax.tree.structure(out), results)


def _split(args: Any, jaxpr: jex.ClosedJaxpr) -> tuple[list, list]:
    n = len(jaxpr.in_avals)
    return list(args[:n]), list(args[n:])


def _run(pred: Any, *args: Any, jaxpr: jex.ClosedJaxpr, group: int) -> list[Any]:
    inputs, default = _split(args, jaxpr)
    return lax.cond(pred, lambda: list(jex.jaxpr_as_fun(jaxpr)(*inputs)), lambda: default)


def _gathered(pred: Any, inputs: list, axes: list, default: list, branch: Callable[..., Any], least: int) -> list[Any]:
    """Runs the branch for the lanes where `pred` holds, group by group."""
    lanes = pred.shape[0]
    # All lanes with work in one group would be an array whose length is not known; groups of one lane a loop as long as
    # their number. An eighth of all lanes makes eight turns where every lane has work, and one where few do.
    group = min(max(least, lanes // 8), lanes)
    # The lanes with work, in order, and then `lanes`, which is dropped.
    rank = jnp.cumsum(pred.astype(jnp.int32))
    total = rank[-1]
    order = jnp.full(lanes + group, lanes, jnp.int32)
    order = order.at[select(pred, rank - 1, lanes + group)].set(jnp.arange(lanes, dtype=jnp.int32), mode="drop")

    def work(carry: tuple) -> tuple:
        start, results = carry
        place = lax.dynamic_slice(order, (start,), (group,))
        part = [x if a is None else x.at[place].get(mode="clip") for x, a in zip(inputs, axes)]
        new = jax.vmap(branch, in_axes=tuple(axes))(*part)
        return start + group, [r.at[place].set(n, mode="drop") for r, n in zip(results, new)]

    return lax.while_loop(lambda carry: carry[0] < total, work, (jnp.zeros((), jnp.int32), default))[1]


def _batch(args: Any, dims: Any, *, jaxpr: jex.ClosedJaxpr, group: int) -> tuple[list[Any], list[int | None]]:
    size = next(x.shape[d] for x, d in zip(args, dims) if d is not None)
    front = [x if d is None else jnp.moveaxis(x, d, 0) for x, d in zip(args, dims)]
    batched = [d is not None for d in dims]
    pred, (inputs, default) = front[0], _split(front[1:], jaxpr)
    many, many_default = _split(batched[1:], jaxpr)
    branch = jex.jaxpr_as_fun(jaxpr)
    if batched[0]:
        if not any(many):
            inputs, many = [spread(x, size) for x in inputs], [True] * len(inputs)
        axes = [0 if m else None for m in many]
        default = [x if m else spread(x, size) for x, m in zip(default, many_default)]
        out = _gathered(pred, inputs, axes, default, branch, group)
        return out, [0] * len(out)
    # All of this axis has work, or none: the branch becomes a batched one.
    wide = [a or b for a, b in zip(batched_outputs(jaxpr, many), many_default)]
    default = [spread(x, size) if w and not m else x for x, m, w in zip(default, many_default, wide)]
    found = compact_cond(pred, mapped(branch, size, many, wide), inputs, default, group)
    return found, [0 if w else None for w in wide]


def _jvp(primals: Any, tangents: Any, *, jaxpr: jex.ClosedJaxpr, group: int) -> tuple[list[Any], list[Any]]:
    pred, (inputs, default) = primals[0], _split(primals[1:], jaxpr)
    moves, default_moves = _split(tangents[1:], jaxpr)
    smooth = moving(moves)
    kept = [i for i, d in enumerate(default) if jnp.issubdtype(d.dtype, jnp.inexact)]
    both = pushed_forward(jex.jaxpr_as_fun(jaxpr), len(inputs), smooth, kept)
    still = [*default, *[ad.instantiate_zeros(default_moves[i]) for i in kept]]
    results = compact_cond(pred, both, [*inputs, *[moves[i] for i in smooth]], still, group)
    out, change = results[: len(default)], results[len(default) :]
    return out, with_zeros(out, kept, change)


def _reached(have: list[bool], *, jaxpr: jex.ClosedJaxpr, group: int) -> list[bool]:
    inputs, default = _split(have[1:], jaxpr)
    return [have[0] or a or b for a, b in zip(batched_outputs(jaxpr, inputs), default)]


def _shapes(pred: Any, *args: Any, jaxpr: jex.ClosedJaxpr, group: int) -> list[Any]:
    return list(jaxpr.out_avals)


COMPACT_COND = Operation("compact_cond", run=_run, shapes=_shapes, batch=_batch, jvp=_jvp, reached=_reached)
