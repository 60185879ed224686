"""A derivative rule by the whole Jacobian, for functions of few variables whose loops know only forward mode."""

from collections.abc import Callable
from typing import Any

import equinox as eqx
import jax
import jax.flatten_util as jfu
import jax.numpy as jnp


def dense_jacobian(fn: Callable[..., Any], *args: Any) -> Any:
    """`fn(*args)`, whose derivative is its Jacobian, found in forward mode and then multiplied.

    So `jax.linearize`, which optimistix's Newton method uses, and transposition work for a `fn` that contains a
    `while_loop`. Costs one forward derivative for each perturbed number among `args` and what `fn` closes over.
    """
    return _call((eqx.filter_closure_convert(fn, *args), args))


@eqx.filter_custom_jvp
def _call(fn_and_args: Any) -> Any:
    fn, args = fn_and_args
    return fn(*args)


@_call.def_jvp
def _call_jvp(primals: Any, tangents: Any) -> tuple[Any, Any]:
    # `None` marks leaves that are not perturbed.
    leaves, tree = jax.tree.flatten(primals[0], is_leaf=lambda x: x is None)
    dots = jax.tree.leaves(tangents[0], is_leaf=lambda x: x is None)
    moved = [i for i, d in enumerate(dots) if d is not None]
    x, unravel = jfu.ravel_pytree([leaves[i] for i in moved])
    dx, _ = jfu.ravel_pytree([dots[i] for i in moved])

    def flat(x: Any) -> tuple[Any, Any]:
        full = list(leaves)
        for i, value in zip(moved, unravel(x)):
            full[i] = value
        fn, args = jax.tree.unflatten(tree, full)
        out = fn(*args)
        smooth, rest = eqx.partition(out, eqx.is_inexact_array)
        arrays, static = eqx.partition(rest, eqx.is_array)
        kept.append(static)
        return smooth, (smooth, arrays)

    kept: list[Any] = []
    # Leaf by leaf: the Jacobian of a result that nobody uses is never computed.
    matrices, (smooth, arrays) = jax.jacfwd(flat, has_aux=True)(x)
    return eqx.combine(smooth, arrays, kept[0]), jax.tree.map(lambda m: jnp.dot(m, dx.astype(m.dtype)), matrices)
