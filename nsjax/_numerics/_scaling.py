"""The sizes of the unknowns and of the equations of a root, from the matrix of its derivatives."""

import jax.lax as lax
import jax.numpy as jnp
from jaxtyping import Array, Float

from ._lapack import pinv
from ._root import Sizes
from ._select import select


SINGULAR = 1e-3  # singular values of the scaled matrix below this, relative, do not pass a size on


def sizes_near(matrix: Float[Array, "m n"], z: Float[Array, " n"]) -> Sizes:
    """The sizes of the unknowns near z, and of the equations, in any units.

    An unknown is as large as its value; or, where it is small or zero, as large as the other unknowns make it through
    the equations: |A⁺| |A| |z|, the componentwise condition of Skeel (1979). Where nothing has a size it is 1.
    """
    matrix = select(jnp.isfinite(matrix), matrix, 0)
    rows, columns = equilibrated(matrix)
    scaled, z = rows[:, None] * matrix * columns, jnp.abs(z)
    passed = columns * (jnp.abs(pinv(scaled, SINGULAR)) @ (jnp.abs(scaled) @ (z / columns)))
    unknowns = jnp.maximum(z, passed)
    unknowns = select(unknowns > 0, unknowns, 1)
    return Sizes(unknowns, jnp.abs(matrix) @ unknowns)


def equilibrated(matrix: Float[Array, "m n"]) -> tuple[Float[Array, " m"], Float[Array, " n"]]:
    """Factors of rows and columns by which the largest entry of each row and of each column becomes 1, by the iteration
    of Ruiz (2001); those of zeros have the factor 1."""

    def turn(_: int, factors: tuple[Array, Array]) -> tuple[Array, Array]:
        rows, columns = factors
        entries = rows[:, None] * jnp.abs(matrix) * columns
        row, column = jnp.max(entries, axis=1), jnp.max(entries, axis=0)
        return rows / jnp.sqrt(select(row > 0, row, 1)), columns / jnp.sqrt(select(column > 0, column, 1))

    return lax.fori_loop(0, 12, turn, (jnp.ones_like(matrix[:, 0]), jnp.ones_like(matrix[0])))
