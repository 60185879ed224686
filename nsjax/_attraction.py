"""Whether a surface attracts the solution that it holds, or repels it: alone, and while others hold it too."""

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float

from ._filippov import Model
from ._linear import linear_solve, parallel
from ._types import Scalar


Pairs = dict[tuple[int, int], tuple[Bool[Array, ""], Float[Array, ""]]]
"""Of two positions in `Model.holdable`: whether their surfaces coincide, and the sign of the ratio of their h."""


def reach(model: Model, matrix: Float[Array, "m m"]) -> Float[Array, " m"]:
    """How much the values of all `sgn` switches together may change dh/dt of each surface."""
    return jnp.sum(jnp.where(np.array([k not in model.contacts for k in model.holdable]), jnp.abs(matrix), 0), axis=1)


def negligible(rate: Scalar, span: Scalar) -> Bool[Array, ""]:
    """Whether a rate counts as none beside that which switches may add: forces that cancel leave their rounding."""
    return jnp.abs(rate) <= float(jnp.finfo(rate.dtype).eps) ** 0.5 * span


def coinciding(model: Model, rates: Float[Array, " m"], matrix: Float[Array, "m m"]) -> Pairs:
    """Which surfaces are one: at any values of the switches their h change in proportion. `rates` and `matrix` are
    `Model.linear` at some of these values."""
    size = reach(model, matrix)
    out = {}
    for i, j in model.pairs:
        ratio = jnp.sign(matrix[i] @ matrix[j])
        alike = negligible(rates[i] * size[j] - ratio * rates[j] * size[i], size[i] * size[j])
        out[i, j] = alike & parallel(matrix[i], matrix[j]) & (ratio != 0), ratio
    return out


def attraction(matrix: Float[Array, "m m"], held: Bool[Array, " m"], pairs: Pairs) -> Float[Array, " m"]:
    """dh_k'/ds_k for each holdable switch while the others that are `held` stay on their surfaces.

    That is the Schur complement of M_ij = dh_i'/ds_j over these others. Where it is negative surface k attracts, where
    it is positive it repels (2.25): its diagonal entry M_kk says so only if nothing else is slid on.
    """
    m = len(held)
    if m == 1:
        return matrix[0]
    # Surfaces that coincide are left together, each to its side, and held as one.
    whole, first = matrix, held
    for (i, j), (same, ratio) in pairs.items():
        swap = np.arange(m)
        swap[[i, j]] = j, i
        whole = whole + jnp.where(same & (swap != np.arange(m)), ratio, 0) * matrix[:, swap]
        first = first & ~(same & held[i] & (np.arange(m) == j))
    both = first[:, None] & first[None, :]
    eye = jnp.eye(m, dtype=matrix.dtype)
    inverse = jax.vmap(linear_solve, in_axes=(None, 0), out_axes=1)(jnp.where(both, whole, eye), eye)
    inner = jnp.where(both, inverse, 0)
    free = jnp.diag(whole) - jnp.sum((whole @ inner) * whole.T, axis=1)
    out = jnp.where(first, 1 / jnp.diag(inverse), free)
    for (i, j), (same, _) in pairs.items():
        out = jnp.where(same & (np.arange(m) == j), out[i], out)
    return out
