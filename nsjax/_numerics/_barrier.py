"""Values that a compiled program must compute once."""

from typing import Any

import jax
import jax.lax as lax
from jaxtyping import Array

from ._select import select


def once(tree: Any) -> Any:
    """The same numbers, computed once and stored.

    XLA's CPU compiler copies elementwise arithmetic into every kernel that uses its result: without this each stage of
    a Runge-Kutta step would be computed anew for every later stage, and again for every coefficient of a guard. It
    never copies a division, so the values are divided by a one that it cannot know to be one (x == x fails for NaN).
    """

    def leaf(x: Array) -> Array:
        return x / select(x == x, 1, lax.stop_gradient(x))

    return jax.tree.map(leaf, tree)


@jax.custom_jvp
def stored(x: Array) -> Array:
    """`once`, and the same of derivatives. (Those of a batch of directions all have one divisor, of which XLA makes a
    factor: a product, which it copies.)"""
    return once(x)


@stored.defjvp
def _stored_jvp(primals: tuple[Array], tangents: tuple[Array]) -> tuple[Array, Array]:
    return stored(*primals), stored(*tangents)
