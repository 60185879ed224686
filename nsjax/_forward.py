"""An identity that can be differentiated in forward mode only, and says so."""

from typing import Any, NoReturn

import equinox as eqx
import jax
import jax.extend.core as jex
from jax.interpreters import ad, batching, mlir


try:
    from jax._src.interpreters.ad import primitive_linearizations
except ImportError:  # then JAX's own, less helpful message is seen
    primitive_linearizations = {}


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
