"""Functions written for a batch as a whole, whose arrays have the lanes along their last axis.

`vmap` puts the lanes first, and XLA's CPU code for arrays whose last axis is a short one (a state, the coefficients of
a polynomial) is not vectorised over them. A loop that is written for lanes can also be run for some hundred of them at
a time, whose numbers stay in the cache, and does not wait for the slowest of all.
"""

import itertools
from collections.abc import Callable
from typing import Any

import jax
import jax.core
import jax.lax as lax
import jax.numpy as jnp

from ._inner import Flat, mapped, moving, pushed_forward, spread, with_zeros
from ._operation import Operation
from ._products import full_products


Levels = tuple[tuple[int, int], ...]
"""How many arguments and results there are: of the function itself, with its first tangents, and so on."""


def in_lanes(fn: Callable[..., Any], chunk: int, *args: Any) -> Any:
    """`fn(*args)` for a function of pytrees of arrays that have a further, last axis of lanes, as its results have.
    Under `vmap` it is called for up to `chunk` lanes at a time."""
    flat, tree = jax.tree.flatten(args)
    form = jax.eval_shape(lambda *xs: fn(*jax.tree.unflatten(tree, xs)), *[_one(x) for x in flat])

    @full_products  # it may be traced later
    def listed(*xs: Any) -> list[Any]:
        return jax.tree.leaves(fn(*jax.tree.unflatten(tree, xs)))

    shapes = tuple((o.shape[:-1], o.dtype) for o in jax.tree.leaves(form))
    flat = [jnp.asarray(x) for x in flat]
    results = IN_LANES.bind(*flat, fn=listed, shapes=shapes, levels=((len(flat), len(shapes)),), chunk=chunk)
    return jax.tree.unflatten(jax.tree.structure(form), results)


def _one(x: Any) -> jax.ShapeDtypeStruct:
    return jax.ShapeDtypeStruct((*jnp.shape(x), 1), jnp.result_type(x))


def _run(*args: Any, fn: Flat, shapes: Any, levels: Levels, chunk: int) -> list[Any]:
    return [x[..., 0] for x in fn(*[jnp.asarray(x)[..., None] for x in args])]


def _chunked(fn: Flat, chunk: int, args: list[Any]) -> list[Any]:
    """`fn` for all lanes, some at a time."""
    lanes = args[0].shape[-1]
    count = -(-lanes // chunk)
    if count == 1:
        return fn(*args)
    size = -(-lanes // count)
    short = count * size - lanes

    def split(x: Any) -> Any:
        full = jnp.concatenate([x, *[x[..., -1:]] * short], axis=-1) if short else x
        return jnp.moveaxis(full.reshape(*x.shape[:-1], count, size), -2, 0)

    def join(x: Any) -> Any:
        return jnp.moveaxis(x, 0, -2).reshape(*x.shape[1:-1], count * size)[..., :lanes]

    return [join(x) for x in lax.map(lambda xs: fn(*xs), [split(x) for x in args])]


def _batch(
    args: Any, dims: Any, *, fn: Flat, shapes: Any, levels: Levels, chunk: int
) -> tuple[list[Any], list[int | None]]:
    size = next(x.shape[d] for x, d in zip(args, dims) if d is not None)
    batched = [d is not None for d in dims]
    if any(batched[: levels[0][0]]):
        last = [
            jnp.moveaxis(spread(jnp.asarray(x), size) if d is None else x, 0 if d is None else d, -1)
            for x, d in zip(args, dims)
        ]
        results = _chunked(fn, chunk, last)
        return results, [x.ndim - 1 for x in results]
    # A batch of tangents alone (`jacfwd`) is none of lanes: what is differentiated stays as it is.
    front = [x if d is None else jnp.moveaxis(x, d, 0) for x, d in zip(args, dims)]
    count = next(outs for (_, outs), (inputs, _) in zip(levels, levels[1:]) if any(batched[:inputs]))
    wide = [i >= count for i in range(len(shapes))]
    new = tuple(((size, *s) if w else s, d) for (s, d), w in zip(shapes, wide))
    results = IN_LANES.bind(*front, fn=mapped(fn, size, batched, wide), shapes=new, levels=levels, chunk=chunk)
    return results, [0 if w else None for w in wide]


def _jvp(
    primals: Any, tangents: Any, *, fn: Flat, shapes: Any, levels: Levels, chunk: int
) -> tuple[list[Any], list[Any]]:
    smooth = moving(tangents)
    kept = [i for i, (_, dtype) in enumerate(shapes) if jnp.issubdtype(dtype, jnp.inexact)]
    both = pushed_forward(fn, len(primals), smooth, kept)
    moves = [tangents[i] for i in smooth]
    wider = (*shapes, *[shapes[i] for i in kept])
    levels = (*levels, (len(primals) + len(moves), len(wider)))
    results = IN_LANES.bind(*primals, *moves, fn=both, shapes=wider, levels=levels, chunk=chunk)
    count = len(shapes)
    return results[:count], with_zeros(results[:count], kept, results[count:])


def _shapes(*args: Any, fn: Flat, shapes: Any, levels: Levels, chunk: int) -> list[Any]:
    return list(itertools.starmap(jax.core.ShapedArray, shapes))


IN_LANES = Operation("in_lanes", run=_run, shapes=_shapes, batch=_batch, jvp=_jvp)
