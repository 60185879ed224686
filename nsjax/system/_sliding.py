"""Sliding and resting: the multipliers λ of the switches that hold a solution on their surfaces, the field for them,
and what removes the drift off the surfaces."""

from typing import Any, TYPE_CHECKING

import jax
import jax.lax as lax
import jax.numpy as jnp
import numpy as np

from .._numerics._linalg import parallel, Row, row, solve_rows, WRITTEN_OUT
from .._numerics._select import select
from .._types import Scalar, Y
from ._coupling import Block, members, taken
from ._linearisation import Linearisation, linearise
from ._mode import ModeState, put


if TYPE_CHECKING:
    from ._model import SwitchedSystem


def linearised(model: "SwitchedSystem", t: Scalar, y: Y, state: ModeState, s: tuple) -> Linearisation:
    """The field and the rates of the holdable surfaces at `s`, and how they change with the holdable values."""
    tree = jax.tree.structure(y)

    def field(*values: Scalar) -> list[Any]:
        return jax.tree.leaves(model.field(t, y, put(s, model.holdable, values)))

    def levels(t: Scalar, *leaves: Any) -> list[Scalar]:
        return model.levels(model.holdable, t, jax.tree.unflatten(tree, leaves), state)

    near = linearise(field, tuple(s[k] for k in model.holdable), levels, t, y, model.acts, model.coupling)
    if model.contacts and len(model.holdable) > 1:
        # Friction along a contact that holds already is free, and so is that of a contact without force: a trace of
        # compliance gives it the value 0.
        least = jnp.sqrt(jnp.finfo(t.dtype).tiny)
        for i in [i for i, k in enumerate(model.holdable) if k not in model.contacts]:
            total = sum(jnp.sum(jnp.abs(x)) for x in jax.tree.leaves(near.slope[i]))
            trace = select(total == 0, least, 4 * jnp.finfo(t.dtype).eps * total)
            own = model.coupling.colour[i]
            if isinstance(near.slope[i], list):
                near.slope[i][own] = near.slope[i][own] - trace
            else:
                near.slope[i] = near.slope[i].at[own].add(-trace)
    return near


def multipliers(model: "SwitchedSystem", slope: list[Any], right: Row, held: Any) -> Any:
    """σ with slope σ = right over the holdable switches that are `held`, and 0 for the others; each block of those that
    act on each other's surfaces apart."""
    return model.coupling.joined([_of_blocks(model, group, slope, right, held) for group in model.coupling.groups])


def _of_blocks(model: "SwitchedSystem", group: tuple[Block, ...], slope: list[Any], right: Row, held: Any) -> Any:
    """Of blocks of one size, member by member.

    Where surfaces coincide (friction elements on one velocity) slope is singular: it determines only the sum of what
    they do. They share it in proportion to their bounds, |λ_i| / b_i = |λ_j| / b_j, as elastic elements do that yield
    at the same deflection. No other split holds for longer: all of them reach their bounds together, each in the
    direction in which it resists, and so when the sum of their strengths is spent.
    """
    which, coupling = members(group), model.coupling
    m = len(which)
    if m > WRITTEN_OUT:
        index = np.array(which)
        slope = [coupling.entries(slope, i, index) for i in which]
        right, held = taken(right, index), taken(held, index)
    else:
        slope = [[coupling.entries(slope, i, j) for j in which] for i in which]
        right, held = ([taken(numbers, i) for i in which] for numbers in (right, held))
    zero, one = jnp.zeros_like(right[0]), jnp.ones_like(right[0])
    # Off the surface a slope may vanish, and must not matter; on it the quotient is infinite, and so is noticed.
    units = [row([one if i == j else zero for j in range(m)]) for i in range(m)]
    rows = [jax.tree.map(lambda x, h, u, i=i: select(held[i] & h, x, u), slope[i], held, units[i]) for i in range(m)]
    right, matrix = jax.tree.map(lambda r, h: select(h, r, 0), right, held), list(rows)
    for i, j in [(which.index(i), which.index(j)) for i, j in model.pairs if len(group) == 1 and i in which]:
        same = held[i] & held[j] & parallel(rows[i], rows[j])
        # The row tells in which direction each of them pushes the surface, and either of the two rows will do.
        bounds = {i: model.bound(model.holdable[which[j]]), j: -model.bound(model.holdable[which[i]])}
        weights = row([jnp.asarray(bounds.get(n, zero), zero.dtype) for n in range(m)])
        share = jax.tree.map(lambda x, w: select(x < 0, -w, w), rows[i], weights)
        matrix[j] = jax.tree.map(lambda a, b, same=same: select(same, a, b), share, matrix[j])
        one_of = row([same if n == j else jnp.zeros_like(same) for n in range(m)])
        right = jax.tree.map(lambda r, gone: select(gone, 0, r), right, one_of)
    for i, j in [(which.index(i), which.index(j)) for i, j in model.normal if len(group) == 1 and i in which]:
        # Friction along the normal of a contact that rests: the contact alone holds, as their shares are open.
        same = held[i] & held[j] & parallel(rows[i], rows[j])
        matrix[j] = jax.tree.map(lambda a, b, same=same: select(same, a, b), units[j], matrix[j])
        one_of = row([same if n == j else jnp.zeros_like(same) for n in range(m)])
        right = jax.tree.map(lambda r, gone: select(gone, 0, r), right, one_of)
    return solve_rows(matrix, right)


def resolved(model: "SwitchedSystem", t: Scalar, y: Y, state: ModeState) -> tuple[tuple[Any, ...], Y]:
    """The value of every switch in a mode, those that hold by (2.20), and the field for them (2.19)."""
    s, which = model.signs(t, state), model.holdable
    if not which:
        return s, model.field(t, y, s)
    held = row([model.held(k, state.mode[k]) for k in which])

    def moves(s: tuple) -> tuple[Row, Linearisation]:
        near = linearised(model, t, y, state, s)
        return multipliers(model, near.slope, jax.tree.map(jnp.negative, near.rates), held), near

    def after(s: tuple, move: Row) -> tuple:
        return put(s, which, [s[k] + d for k, d in zip(which, move)])

    if model.jointly_affine:
        move, near = moves(s)
        return after(s, move), near.pulled(near.field, move)
    # Newton's method for a multi-affine field, in a fixed number of steps: such a loop can be transposed. Friction
    # proportional to a contact force has no effect where that is zero: the search sets out from another value.
    begin = [select(h, 1, s[k]) if k in model.contacts else s[k] for k, h in zip(which, held)]
    s = lax.fori_loop(0, 6, lambda _, s: after(s, moves(s)[0]), put(s, which, begin))
    return s, model.field(t, y, s)


def project(model: "SwitchedSystem", t: Scalar, y: Y, state: ModeState, s: tuple[Any, ...] | None = None) -> Y:
    """Removes the drift off the surfaces that hold the solution.

    The state moves along ∂f/∂s, the direction in which the switch acts, so that the result does not depend on the units
    of the state; positions move along what this is in a unit of time. One Newton step: exact when h is affine, else
    quadratic in a drift that is itself of the order of the local error.
    """
    which = model.holdable
    if model.jointly_affine and not model.contacts:
        s = model.signs(t, state)
    elif s is None:
        s = model.values(t, y, state)
    held = row([model.held(k, state.mode[k]) for k in which])
    near = linearised(model, t, y, state, s)

    def closing(gaps: list[Scalar]) -> Row:
        """The values which close the gaps."""
        found = multipliers(model, near.slope, row([-g for g in gaps]), held)
        return jax.tree.map(lambda h, d: select(h, d, 0), held, found)

    if model.contacts:
        gaps = [model.h(k, t, y)[0] if k in model.contacts else jnp.zeros_like(t) for k in which]
        push = near.pulled(jax.tree.map(jnp.zeros_like, y), closing(gaps))
        dq = jax.jvp(lambda y: model.field(t, y, s), (y,), (push,))[1]
        y = jax.tree.map(jnp.add, y, dq)
    return near.pulled(y, closing(model.levels(which, t, y, state)))
