"""What can be read off a function's jaxpr: on which inputs a result (or its derivative) depends.

Used to leave out work which a model does not need, and to check models, without evaluating anything.
"""

from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
from jax.interpreters import partial_eval as pe


def depends(fn: Callable[..., Any], args: tuple[Any, ...], on: int) -> bool:
    """Whether any output of `fn(*args)` uses any leaf of `args[on]`, after dead code is removed."""
    closed = jax.make_jaxpr(fn)(*args)
    _, used = pe.dce_jaxpr(closed.jaxpr, [True] * len(closed.jaxpr.outvars))
    sizes = [len(jax.tree.leaves(a)) for a in args]
    start = sum(sizes[:on])
    return any(used[start : start + sizes[on]])


def is_affine(fn: Callable[[Any], Any], x: Any) -> bool:
    """Whether `fn` is structurally affine in `x`: its derivative does not depend on where it is taken."""

    def tangent(x: Any, dx: Any) -> Any:
        return jax.jvp(fn, (x,), (dx,))[1]

    return not depends(tangent, (x, jax.tree.map(jnp.ones_like, x)), 0)


def is_constant(fn: Callable[[Any], Any], x: Any) -> bool:
    """Whether `fn` is structurally independent of `x`."""
    return not depends(fn, (x,), 0)
