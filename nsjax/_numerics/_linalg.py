"""Small matrices: their products, and systems of linear equations."""

import itertools
from collections.abc import Sequence
from typing import Any, TypeAlias

import jax.lax as lax
import jax.numpy as jnp
import numpy as np
from jax.custom_batching import custom_vmap
from jaxtyping import Array, Bool, Float

from .._types import Scalar
from ._autodiff import frozen
from ._select import select


WRITTEN_OUT = 3

Row: TypeAlias = list[Scalar] | Float[Array, " m"]
"""Up to `WRITTEN_OUT` numbers are scalars, of which XLA makes fewer kernels; more are an array."""


def row(numbers: Sequence[Any]) -> Any:
    return jnp.stack(list(numbers)) if len(numbers) > WRITTEN_OUT else list(numbers)


def coloured(touches: Bool[np.ndarray, "rows columns"]) -> list[list[int]]:
    """Columns of a sparse matrix that share no row, together: a derivative in the sum of their directions has the
    entries of all of them."""
    colours: list[list[int]] = []
    for j in range(touches.shape[1]):
        mine = next((c for c in colours if not (touches[:, [j]] & touches[:, c]).any()), None)
        if mine is None:
            colours.append([j])
        else:
            mine.append(j)
    return colours


def product(a: Float[Array, "n k"], b: Float[Array, "k m"]) -> Float[Array, "n m"]:
    """a b, for small matrices written out: of batches of five rows that takes a sixth of the time of XLA's product."""
    if a.shape[1] > 8:
        return a @ b
    return sum((a[:, i : i + 1] * b[i : i + 1] for i in range(1, a.shape[1])), a[:, :1] * b[:1])


def linear_solve(a: Float[Array, "m m"], b: Float[Array, " m"]) -> Float[Array, " m"]:
    """x with a x = b; see `solve_rows`."""
    m = len(b)
    if m > WRITTEN_OUT:
        return solve_rows(list(a), b)
    return jnp.stack(solve_rows([[a[i, j] for j in range(m)] for i in range(m)], [b[i] for i in range(m)]))


def solve_rows(rows: list[Any], right: Any) -> Any:
    """x with a x = b, by the rows of a; b and x are rows, too.

    Up to three unknowns by Cramer's rule, which XLA vectorises over the lanes of a batch. (Sweeps with two multipliers
    take a fourteenth of the time that LAPACK takes for each lane, with three a sixth.) More by LAPACK, and in batches
    by an elimination. Scaling rows or columns is no matter.
    """
    m = len(right)
    if m > WRITTEN_OUT:
        a = jnp.stack(rows)
        by_row, by_column = _scales(lax.stop_gradient(a))
        a, b = by_row[:, None] * a * by_column, by_row * right

        def solve(_: Any, b: Array) -> Array:
            return _solved(a, b)

        def transposed(_: Any, b: Array) -> Array:
            return _solved(a.T, b)

        return by_column * lax.custom_linear_solve(lambda x: a @ x, b, solve, transposed)
    columns = [[row[j] for row in rows] for j in range(m)]
    whole = _determinant(columns)
    return [_determinant([*columns[:j], right, *columns[j + 1 :]]) / whole for j in range(m)]


@custom_vmap
def _solved(a: Float[Array, "m m"], b: Float[Array, " m"]) -> Float[Array, " m"]:
    return jnp.linalg.solve(a, b)


@_solved.def_vmap
def _solved_in_lanes(lanes: int, batched: list[bool], a: Array, b: Array) -> tuple[Array, bool]:
    """A batch is not LAPACK's: its LU decompositions wait, in XLA's pool of threads, for tasks that stand behind them
    in the same pool, and so may come to a standstill (jaxlib 0.10)."""
    a, b = (x if here else jnp.broadcast_to(x, (lanes, *x.shape)) for x, here in zip((a, b), batched))
    return jnp.moveaxis(_eliminate(jnp.moveaxis(a, 0, -1), b.T), -1, 0), True


def _eliminate(a: Float[Array, "m m lanes"], b: Float[Array, "m lanes"]) -> Float[Array, "m lanes"]:
    """x with a x = b, by Gauss and Jordan's elimination with partial pivoting. Rows stay where they are, as each lane
    has its own pivots."""
    index = np.arange(len(b), dtype=np.int32)[:, None]

    def column(j: Array, carry: tuple[Array, Array, Array]) -> tuple[Array, Array, Array]:
        rows, free, x_of = carry  # which rows were no pivots yet, and of which unknown the others are
        here = rows[:, j]
        pivot = jnp.argmax(select(free, jnp.abs(here), -1), axis=0).astype(jnp.int32) == index
        line = jnp.sum(select(pivot[:, None], rows, 0), axis=0)
        line = line / line[j]
        rows = select(pivot[:, None], line, rows - here[:, None] * line)
        return rows, free & ~pivot, select(pivot, j, x_of)

    rows = jnp.concatenate([a, b[:, None]], axis=1)
    start = rows, jnp.ones(b.shape, bool), jnp.zeros(b.shape, jnp.int32)
    rows, _, x_of = lax.fori_loop(0, len(b), column, start)
    return jnp.sum(select(x_of == index[:, None], rows[:, -1], 0), axis=1)


def parallel(a: Any, b: Any) -> Bool[Array, ""]:
    """Whether two rows are multiples of one another apart from rounding, whatever the units of rows and columns: all
    minors a_i b_j - a_j b_i vanish beside their two terms."""
    a, b = frozen((a, b))
    if len(a) > WRITTEN_OUT:
        outer = a[:, None] * b[None, :]
        size = jnp.abs(outer)
        return jnp.all(jnp.abs(outer - outer.T) <= nearly(outer) * (size + size.T))
    out = jnp.ones((), bool)
    for i, j in itertools.combinations(range(len(a)), 2):
        p, q = a[i] * b[j], a[j] * b[i]
        out = out & (jnp.abs(p - q) <= nearly(p) * (jnp.abs(p) + jnp.abs(q)))
    return out


def nearly(like: Array) -> float:
    """How closely two numbers must agree to count as equal, of those that are computed from several others."""
    return max(1e-10, 64 * float(jnp.finfo(like.dtype).eps))


def _scales(a: Float[Array, "m m"]) -> tuple[Float[Array, " m"], Float[Array, " m"]]:
    """Powers of two for rows and columns, with which entries that are not zero are of size one on (geometric) average.

    Elimination chooses its pivots among the entries of a column, and so by the units of the rows: with units 24 orders
    of magnitude apart the error is up to 200 eps cond, and 6 eps cond with these scales (170 with those of the largest
    entries).
    """
    there = (a != 0).astype(a.dtype)
    size = there * jnp.log2(select(a == 0, 1, jnp.abs(a)))
    by_row, by_column = (jnp.maximum(jnp.sum(there, axis), 1) for axis in (1, 0))
    rows, columns = jnp.zeros_like(a[0]), jnp.zeros_like(a[0])
    for _ in range(4):
        rows = -jnp.sum(size + there * columns, 1) / by_row
        columns = -jnp.sum(size + there * rows[:, None], 0) / by_column
    return jnp.exp2(jnp.round(rows)), jnp.exp2(jnp.round(columns))


def _determinant(columns: list[list[Array]]) -> Scalar:
    first, *others = columns
    if not others:
        return first[0]
    minors = [_determinant([c[:i] + c[i + 1 :] for c in others]) for i in range(len(first))]
    return sum((x * m * (-1) ** i for i, (x, m) in enumerate(zip(first[1:], minors[1:]), 1)), first[0] * minors[0])


def bialternate(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    """The bialternate product A ⊙ B. Sums of two eigenvalues of A are the eigenvalues of 2 A ⊙ I, their products those
    of A ⊙ A (half the Kronecker sum and product, without what is there twice); Guckenheimer, Myers & Sturmfels (1997).
    """
    i, j = np.triu_indices(len(a), 1)

    def minors(a: np.ndarray, b: np.ndarray) -> np.ndarray:
        return a[np.ix_(i, i)] * b[np.ix_(j, j)] - a[np.ix_(i, j)] * b[np.ix_(j, i)]

    return (minors(a, b) + minors(b, a)) / 2
