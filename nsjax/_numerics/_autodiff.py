"""Derivatives that are ruled by hand: none at all, forward mode only, or by the whole Jacobian."""

from collections.abc import Callable
from typing import Any, NoReturn

import equinox as eqx
import jax
import jax.flatten_util as jfu
import jax.numpy as jnp

from ._operation import Operation


def frozen(tree: Any) -> Any:
    """The same with no derivative; `lax.stop_gradient` alone would turn static integers into tracers."""
    return jax.tree.map(lambda x: jax.lax.stop_gradient(x) if eqx.is_array(x) else x, tree)


def forward_only(tree: Any, message: str) -> Any:
    """`tree`, on whose arrays reverse-mode differentiation raises an error with `message`.

    Put around the inputs of a loop: JAX gives up on a `while_loop` before it would reach anything behind it.
    """
    arrays, rest = eqx.partition(tree, eqx.is_inexact_array)
    flat, form = jax.tree.flatten(arrays)
    if not flat:
        return tree
    return eqx.combine(jax.tree.unflatten(form, FORWARD_ONLY.bind(*flat, message=message)), rest)


def _refuse(message: str) -> NoReturn:
    raise TypeError(message)


FORWARD_ONLY = Operation(
    "forward_only",
    run=lambda *xs, message: list(xs),
    shapes=lambda *xs, message: list(xs),
    batch=lambda xs, dims, message: (FORWARD_ONLY.bind(*xs, message=message), list(dims)),
    jvp=lambda xs, tangents, message: (FORWARD_ONLY.bind(*xs, message=message), list(tangents)),
    reached=lambda have, message: have,
    refuse=_refuse,
)


def dense_jacobian(fn: Callable[..., Any], *args: Any) -> Any:
    """`fn(*args)`, whose derivative is its Jacobian, found in forward mode and then multiplied.

    So `jax.linearize`, which optimistix's Newton method uses, and transposition work for a `fn` that contains a
    `while_loop`. Costs one forward derivative for each perturbed number among `args` and what `fn` closes over.
    """
    kept: list[Any] = []

    def arrays(*args: Any) -> Any:  # a result may hold functions, as models with neural networks do
        found, rest = eqx.partition(fn(*args), eqx.is_array)
        kept.append(rest)
        return found

    return eqx.combine(_call((eqx.filter_closure_convert(arrays, *args), args)), kept[0])


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
        smooth, rest = eqx.partition(fn(*args), eqx.is_inexact_array)
        return smooth, (smooth, rest)

    # Leaf by leaf: the Jacobian of a result that is not used is never computed.
    matrices, (smooth, rest) = jax.jacfwd(flat, has_aux=True)(x)
    return eqx.combine(smooth, rest), jax.tree.map(lambda m: jnp.dot(m, dx.astype(m.dtype)), matrices)
