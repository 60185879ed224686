"""What is worked out of a mode once, when a lane first comes to it: its matrix, its guards as rows times z, and their
polynomials on one arc as linear maps of z.

The polynomials only find where an event is, so that they carry no derivatives.
"""

import functools as ft
import math
from collections.abc import Callable
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.lax as lax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from ..._numerics._autodiff import frozen
from ..._types import Scalar, Y
from ...system._mode import ModeState
from ...system._model import SwitchedSystem
from ._plan import columns, of_mode, Plan, Problem


DEGREE = 14  # of the polynomials
THETA = 5.0  # the phase that an arc may pass through: its length times the spectral size of the mode
PHASE = 1.75  # where states on the way are asked for, of which polynomials of degree 10 are made
_TERMS = DEGREE + 16  # of the power series from which they are made

Lanes = Float[Array, " lanes"]


class Table(NamedTuple):
    """Of a mode, with lanes along the last axis; for some modes with these along the first."""

    matrix: Float[Array, "n m lanes"]  # y' as rows times z
    guards: Float[Array, "rows m lanes"]
    projection: Float[Array, "n m lanes"] | None  # the state without its drift off the surfaces that hold it
    polynomials: Float[Array, "rows coefficients m lanes"]  # scaled Bernstein coefficients on an arc, see `_bernstein`
    missed: Float[Array, "rows m lanes"]  # of these polynomials
    length: Lanes  # of an arc
    key: Lanes  # of the mode; -1: none yet


def power(j: int) -> np.ndarray:
    """The Chebyshev coefficients of u^j on [0, 1]."""
    c = np.array([math.comb(2 * j, j - k) * 2.0 ** (1 - 2 * j) for k in range(j + 1)])
    c[0] /= 2
    return c


@ft.lru_cache
def economised(degree: int, terms: int) -> tuple[np.ndarray, np.ndarray]:
    """The matrix from coefficients of u^j, j <= `terms`, to scaled Bernstein coefficients of the truncated Chebyshev
    series; and what each power loses in this."""
    at = 0.5 - 0.5 * np.cos(np.pi * (np.arange(degree + 1) + 0.5) / (degree + 1))
    basis = np.array([[math.comb(degree, i) * u**i * (1 - u) ** (degree - i) for i in range(degree + 1)] for u in at])
    columns, lost = [], []
    for j in range(terms + 1):
        c = power(j)
        values = np.polynomial.chebyshev.chebval(2 * at - 1, c[: degree + 1])
        columns.append(np.linalg.solve(basis, values) * [math.comb(degree, i) for i in range(degree + 1)])
        lost.append(np.abs(c[degree + 1 :]).sum())
    return np.stack(columns, axis=1), np.array(lost)


def by_lane(fn: Callable[..., Any], *args: Any) -> Any:
    """A function of one lane for all of them."""
    dynamic, static = eqx.partition(args, eqx.is_array)
    rest: list[Any] = []

    def one(dynamic: Any) -> Any:
        found, other = eqx.partition(fn(*eqx.combine(dynamic, static)), eqx.is_array)
        rest.append(other)
        return found

    found = jax.vmap(one, in_axes=-1, out_axes=-1)(dynamic)
    return eqx.combine(found, rest[-1])


def maps(model: SwitchedSystem, plan: Plan, t: Scalar, y: Y, state: ModeState) -> tuple[Array, Array, Array | None]:
    """Matrix, guards and projection of a mode, for one lane."""
    found = columns(of_mode(model, plan, y, state), plan, t)
    n, count = plan.size, len(plan.rows)
    return found[:n], found[n : n + count], found[n + count :] if model.holdable else None


def spectral_size(matrix: Float[Array, "n n lanes"]) -> Lanes:
    """A bound of the growth of the powers of a matrix from the second on, |M^k| <= size^k (Al-Mohy & Higham 2009). It
    vanishes for the matrices of bodies that stick or fly, which are nilpotent."""

    def norm(p: Array) -> Lanes:
        return jnp.max(jnp.sum(jnp.abs(p), axis=1), axis=0)

    squared = _product(matrix, matrix)
    return jnp.maximum(norm(squared) ** (1 / 2), norm(_product(squared, matrix)) ** (1 / 3))


def _product(a: Float[Array, "k n lanes"], b: Float[Array, "n m lanes"]) -> Float[Array, "k m lanes"]:
    return sum((a[:, i, None] * b[None, i] for i in range(1, len(b))), a[:, 0, None] * b[None, 0])


def whole(plan: Plan, matrix: Float[Array, "n m lanes"], squared: Lanes) -> Float[Array, "m m lanes"]:
    """The matrix of z' = X z."""
    below = jnp.zeros((plan.width - plan.size, *matrix.shape[1:]), matrix.dtype)
    if plan.timed:  # S' = 1 - ω² C, C' = S
        below = below.at[0, -1].set(1).at[0, -2].set(-squared).at[1, -3].set(1)
    return jnp.concatenate([matrix, below])


def tabulate(problem: Problem, state: ModeState, key: Lanes) -> Table:
    """The tables of the modes of all lanes."""
    flow, model, plan, constants, y, theta = problem
    matrix, guards, projection = by_lane(
        lambda model, t, y, state: maps(model, plan, t, y, state), model, flow.t0, y, state
    )
    squared = frozen(constants.squared)
    size = spectral_size(frozen(matrix)[:, : plan.size])
    if plan.timed:
        size = jnp.maximum(size, jnp.sqrt(squared))
    span = frozen(flow.t1 - flow.t0)
    length = jnp.minimum(theta / jnp.maximum(size, float(jnp.finfo(size.dtype).tiny) ** 0.5), span)
    x, rows = whole(plan, frozen(matrix), squared) * length, frozen(guards)

    def step(row: Array, j: Array) -> tuple[Array, Array]:
        return _product(row, x) / j, row

    counts = jnp.arange(1, _TERMS + 2, dtype=x.dtype)
    powers = lax.scan(step, rows, counts)[1]  # (terms, rows, m, lanes)
    weights, lost = economised(DEGREE, _TERMS)
    polynomials = jnp.tensordot(jnp.asarray(weights, x.dtype), powers, axes=1)
    missed = jnp.tensordot(jnp.asarray(lost[DEGREE + 1 :], x.dtype), jnp.abs(powers[DEGREE + 1 :]), axes=1)
    return Table(matrix, guards, projection, jnp.moveaxis(polynomials, 0, 1), missed, length, key)


def key_of(mode: tuple) -> Scalar:
    """The number of a mode: in base three."""
    return sum((m + 1) * 3**k for k, m in enumerate(mode))  # type: ignore[return-value]
