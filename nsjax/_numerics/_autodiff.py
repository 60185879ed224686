"""Derivatives that are ruled by hand: none at all, forward mode only, or by the whole Jacobian."""

from collections.abc import Callable
from typing import Any, NoReturn

import equinox as eqx
import jax
import jax.extend.core as jex
import jax.flatten_util as jfu
import jax.numpy as jnp
from jax.interpreters import ad, batching, mlir

from ._undocumented import primitive_linearizations


def frozen(tree: Any) -> Any:
    """The same with no derivative; `lax.stop_gradient` alone would turn static integers into tracers."""
    return jax.tree.map(lambda x: jax.lax.stop_gradient(x) if eqx.is_array(x) else x, tree)


forward_only_p = jex.Primitive("forward_only")


def forward_only(tree: Any, message: str) -> Any:
    """`tree`, on whose arrays reverse-mode differentiation raises an error with `message`.

    Put around the inputs of a loop: JAX gives up on a `while_loop` before it would reach anything behind it.
    """
    return jax.tree.map(lambda x: forward_only_p.bind(x, message=message) if eqx.is_inexact_array(x) else x, tree)


def _refuse(*args: Any, message: str, **kwargs: Any) -> NoReturn:
    raise TypeError(message)


forward_only_p.def_impl(lambda x, message: x)
forward_only_p.def_abstract_eval(lambda x, message: x)
ad.primitive_jvps[forward_only_p] = lambda primals, tangents, message: (
    forward_only_p.bind(*primals, message=message),
    *tangents,
)
primitive_linearizations[forward_only_p] = _refuse
batching.primitive_batchers[forward_only_p] = lambda args, dims, message: (
    forward_only_p.bind(*args, message=message),
    *dims,
)
mlir.register_lowering(forward_only_p, lambda ctx, x, message: [x])


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
