"""The solution on an arc: exp(X τ) z by its series, and the derivative of the time at which it meets a surface."""

import math
from typing import Any

import jax
import jax.lax as lax
import jax.numpy as jnp
from jaxtyping import Array, Float

from ..._numerics._barrier import stored
from ..._numerics._select import select
from ._plan import Plan


TERMS = 24  # of the series for a phase of up to 2.5
_PHASE = 2.5
_WRITTEN_OUT = 24  # entries of a matrix; of larger ones the terms are a loop

Lanes = Float[Array, " lanes"]
Rows = list[Any]
"""The components of z, one array for each; or of a matrix its rows, with None for what is zero."""


def dot(row: Rows, z: Rows) -> Any:
    """A row times z, or None."""
    found = [a * x for a, x in zip(row, z) if a is not None and x is not None]
    return sum(found[1:], found[0]) if found else None


def full(x: Any, like: Lanes) -> Lanes:
    return jnp.zeros_like(like) if x is None else x


def matrix_rows(plan: Plan, matrix: Float[Array, "n m lanes"], squared: Lanes) -> list[Rows]:
    """The rows of z' = X z, but for the last, which is zero."""
    rows: list[Rows] = [
        [stored(x) if there else None for x, there in zip(row, pattern)] for row, pattern in zip(matrix, plan.pattern)
    ]
    if plan.timed:  # S' = 1 - ω² C, C' = S
        one, none = jnp.ones_like(squared), [None] * plan.size
        rows += [[*none, None, -squared, one], [*none, one, None, None]]
    return rows


def series(rows: list[Rows], z: Rows, tau: Lanes, theta: float) -> tuple[Rows, list[Rows]]:
    """exp(X τ) z, and if it is made in one part the terms of its series."""
    parts = math.ceil(theta / _PHASE)
    h = tau / parts
    if len(rows) * len(z) > _WRITTEN_OUT:
        return _looped(rows, z, h, parts)
    scaled = [[None if a is None else a * h for a in row] for row in rows]
    terms: list[Rows] = []
    for _ in range(parts):
        term = [dot(row, z) for row in scaled]
        terms, total = [z, [*term, None]], [x if w is None else x + w for x, w in zip(z, term)]
        for j in range(2, TERMS + 1):
            term = [None if x is None else x * (1 / j) for x in (dot(row, term) for row in scaled)]
            terms.append([*term, None])
            total = [x if w is None else x + w for x, w in zip(total, term)]
        z = [*[stored(x) for x in total], z[-1]]
    return z, terms


def _looped(rows: list[Rows], z: Rows, h: Lanes, parts: int) -> tuple[Rows, list[Rows]]:
    """The same with the terms in a loop."""
    x = jnp.stack([jnp.stack([full(a, h) for a in row]) for row in rows]) * h
    count = len(rows)

    def step(carry: tuple, j: Array) -> tuple[tuple, Array]:
        term, total = carry
        term = jnp.sum(x[:, :count] * term, axis=1) / j
        return (term, total + term), term

    terms: list[Rows] = []
    for _ in range(parts):
        start = jnp.stack(z)
        first = jnp.sum(x * start, axis=1)
        indices = jnp.arange(2, TERMS + 1).astype(h.dtype)
        (_, total), later = lax.scan(step, (first, start[:-1] + first), indices)
        terms = [z, [*first, None], *[[*term, None] for term in later]] if parts == 1 else []
        z = [*total, z[-1]]
    return z, terms


def _shifted(z: Rows, rows: list[Rows], by: Lanes) -> Rows:
    """exp(X τ) z for a time that is zero and has derivatives: right to the fourth order in these."""
    term, out = z, z[:-1]
    for j in (1, 2, 3):
        term = [*[full(dot(row, term), by) * (by * (1 / j)) for row in rows], None]
        out = [x + w for x, w in zip(out, term)]
    return [*out, z[-1]]


@jax.custom_jvp
def arrived(z: Rows, rows: list[Rows], guard: Rows, meets: Array) -> tuple[Lanes, Rows]:
    """The time (zero) from z to the surface guard · z = 0 on which it is, and z there: their derivatives are those of a
    solution of z' = X z that ends on the surface, where it `meets` one.

    With the change dg of the guard at fixed time, dt = -dg / (dg/dt), and the state moves along the flow by dt. The
    rule refers to this function again, for derivatives of higher orders.
    """
    return jnp.zeros_like(z[0]), z


@arrived.defjvp
def _arrived_jvp(primals: Any, tangents: Any) -> tuple[Any, Any]:
    z, rows, guard, meets = primals
    dz, drows, dguard, _ = tangents
    shift, there = arrived(z, rows, guard, meets)
    # The change at the time of the event, which in derivatives of higher orders is another one.
    moves = jax.jvp(lambda z, rows: _shifted(z, rows, shift), (z, rows), (dz, drows))[1]
    f = [*[full(dot(row, there), shift) for row in rows], jnp.zeros_like(shift)]
    slope, change = dot(guard, f), dot(guard, moves) + dot(dguard, there)
    moved = select(meets, -change / select(meets, slope, 1), 0)
    return (shift, there), (moved, [d + a * moved for d, a in zip(moves, f)])
