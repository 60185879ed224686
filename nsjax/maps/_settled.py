"""When a sequence of points has settled on an attractor that repeats itself."""

from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Float, Int


SURE = 0.05  # of `tol`: so far at most from where it tends to is what counts as a solution that has settled


def settled(points: Float[Any, "*lanes iterates n"], tol: float) -> Int[Any, "*lanes"]:
    """After how many iterates each sequence repeats itself, if what is left of its way is known to be short: it comes
    nearer by the same factor each time, as far as can be seen. 0 otherwise. At most a quarter of the iterates. For
    arrays of NumPy, and for those of JAX."""
    xp: Any = jnp if isinstance(points, jax.Array) else np
    half = points.shape[-2] // 2
    rounding = 64 * float(np.finfo(points.dtype).eps) * abs(points).max(axis=(-2, -1))
    found, near = xp.zeros(points.shape[:-2], np.int32), []  # of each order, whether it is one as far as `tol` tells
    for order in range(1, half // 2 + 1):
        gaps = abs(points[..., order:, :] - points[..., :-order, :]).max(axis=-1)
        early, late = gaps[..., -half : -half // 2].max(axis=-1), gaps[..., -half // 2 :].max(axis=-1)
        near.append(late <= tol)
        nearer = late < early
        # From one time around to the next; where it does not come nearer, nothing is known.
        factor = xp.where(nearer, late / xp.where(nearer, early, 1.0), 0.0) ** (order / max(1, half // 2))
        short = near[-1] & nearer & (late * factor < SURE * tol * (1 - factor))
        least = xp.full_like(found, order)
        for divisor in [k for k in range(order - 1, 0, -1) if order % k == 0]:
            # Several times around counts as once.
            least = xp.where(near[divisor - 1], np.int32(divisor), least)
        found = xp.where((found == 0) & (short | (late <= rounding)), least, found)
    return found
