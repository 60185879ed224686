"""`jnp.where`, as one operation."""

from typing import Any

import jax.lax as lax
import jax.numpy as jnp
import numpy as np
from jax import Array


def select(condition: Any, x: Any, y: Any) -> Array:
    """`jnp.where(condition, x, y)`, with the same rules for shapes and types.

    That is a function of its own in a program, which is differentiated, batched and lowered by itself, wherever it is
    called: some four hundred times in `solve`.
    """
    arrays = [a for a in (x, y) if isinstance(a, Array)]
    if not arrays or not isinstance(condition, Array) or condition.dtype != bool:
        return jnp.where(condition, x, y)
    dtype = jnp.result_type(x, y)
    # Arrays of Python's numbers give way to other types later on; beside such a number they still do.
    weak = all(a.weak_type for a in arrays)
    numbers = [a for a in (x, y) if not isinstance(a, Array)]
    alike = not weak or all(type(a) in (int, float) and jnp.result_type(a) == dtype for a in numbers)
    if not alike or any(a.dtype != dtype for a in arrays):
        return jnp.where(condition, x, y)
    shape = np.broadcast_shapes(condition.shape, np.shape(x), np.shape(y))

    def filled(a: Any) -> Any:
        a = a if weak or isinstance(a, Array) else np.asarray(a, dtype)
        return a if np.shape(a) == shape else jnp.broadcast_to(a, shape)

    whole = condition if condition.ndim == 0 else jnp.broadcast_to(condition, shape)
    return lax.select(whole, filled(x), filled(y))
