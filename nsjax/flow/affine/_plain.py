"""Events at which there is nothing to choose: one switch crosses, begins to hold or lets go, or rebounds, and all
others go on as before, as what is crossed acts on no surface that holds, and no other on the surface of another one.
All that is not plainly so is left to `transition`.
"""

import functools as ft
from typing import Any, NamedTuple

import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int

from ..._numerics._autodiff import frozen
from ..._numerics._select import select
from ._arc import dot, Rows
from ._plan import Problem


Lanes = Float[Array, " lanes"]
Truths = Bool[Array, " lanes"]
Numbers = Int[Array, " lanes"]


class Meeting(NamedTuple):
    """One guard that falls to zero, and where."""

    t: Lanes
    z: Rows
    matrix: list[Rows]  # z' as rows times z, but for the last component, which does not change
    fires: list[Truths]  # of each guard
    rate: Lanes  # of the guard that does
    guards: list[Rows]  # as rows times z
    modes: tuple[Numbers, ...]
    parts: tuple[Numbers | None, ...]


class Plain(NamedTuple):
    """What it leads to, if it is plain."""

    sure: Truths
    x: Rows
    modes: tuple[Numbers, ...]
    parts: tuple[Numbers | None, ...]
    known: list[Numbers]  # how many roots each guard has there
    slot: Numbers
    forked: Truths


def small(like: Array) -> float:
    """Relative to the size of its terms, what is not told from zero here."""
    return max(1e-7, 1e3 * float(jnp.finfo(like.dtype).eps))


def magnitude(row: Rows, z: Rows) -> Any:
    """The size of the terms of a row times z."""
    return dot([None if a is None else jnp.abs(a) for a in row], [None if x is None else jnp.abs(x) for x in z])


def plain(problem: Problem, m: Meeting) -> Plain:
    model, plan, none = problem.model, problem.plan, jnp.zeros_like(m.modes[0])
    yes = jnp.ones_like(m.fires[0])
    out = Plain(yes, m.z[: plan.size], m.modes, m.parts, [none] * len(plan.rows), none, ~yes)
    for k, switch in enumerate(model.switches):
        rows = plan.of(k)
        now = ft.reduce(jnp.logical_or, [m.fires[r] for r in rows])
        if switch.unilateral:
            new = _rebound(problem, m, k)
        elif switch.levels:
            new = _change(problem, m, k)
        elif k in plan.crossed:
            new = _crossing(problem, m, k)
        else:
            new = _sign(problem, m, k)
        sure = new.sure & (not switch.ends)
        out = Plain(
            select(now, sure, out.sure),
            [select(now, a, b) for a, b in zip(new.x, out.x)] if new.x is not m.z else out.x,
            tuple(select(now, a, b) if i == k else b for i, (a, b) in enumerate(zip(new.modes, out.modes))),
            tuple(a if a is b else select(now, a, b) for a, b in zip(new.parts, out.parts)),
            [select(now, a, b) if r in rows else b for r, (a, b) in enumerate(zip(new.known, out.known))],
            select(now, new.slot, out.slot),
            select(now, new.forked, out.forked),
        )
    return out


def _slot(problem: Problem, slot: Any) -> int:
    """Its number in the log."""
    return problem.flow.model.slots.index(slot)


def _crossing(problem: Problem, m: Meeting, k: int) -> Plain:
    """A switch that is only crossed: the field on the other side of its surface leads away from that."""
    model, plan, mode, tiny = problem.model, problem.plan, m.modes[k], small(m.rate)
    rows, sign = plan.of(k), m.modes[k].astype(m.rate.dtype)
    z, guards = frozen((m.z, m.guards))
    pull = [dot(list(row), z) for row in frozen(problem.constants.pull[k])]
    f = [dot(frozen(row), z) for row in m.matrix]
    beyond = [a - 2 * sign * b for a, b in zip(f, pull)] + f[plan.size :]
    sure = m.rate == m.rate
    for r in rows:
        moves = guards[r][:-1]
        falls = dot(moves, beyond) < -1e2 * tiny * magnitude(moves, beyond)
        # The other components are above zero, as h is the least of them.
        above = sign * dot(guards[r], z) > tiny * magnitude(guards[r], z)
        sure = sure & select(m.fires[r], falls, above)
    for j in plan.crossed[k]:
        sure = sure & ~model.held(j, m.modes[j])
    one, zero = jnp.ones_like(mode), jnp.zeros_like(mode)
    known: list[Any] = [zero] * len(plan.rows)
    first = _slot(problem, plan.rows[rows[0]].free)
    slot, part = first * one, zero
    for n, r in enumerate(rows):
        known[r] = select(m.fires[r], one, zero)
        if n:  # those below a corner belong to the slot of its first component
            slot = select(m.fires[r] & (mode > 0), _slot(problem, plan.rows[r].free), slot).astype(mode.dtype)
            part = select(m.fires[r], n, part).astype(mode.dtype)
    parts = tuple(part if i == k and old is not None else old for i, old in enumerate(m.parts))
    modes = tuple(-mode if i == k else other for i, other in enumerate(m.modes))
    return Plain(sure, m.z, modes, parts, known, slot, ~(m.rate == m.rate))


def _change(problem: Problem, m: Meeting, k: int) -> Plain:
    """A relay that changes, and does not change back at once."""
    plan, mode, (row,) = problem.plan, m.modes[k], problem.plan.of(k)
    z, (on, off) = frozen((m.z, [list(row) for row in problem.constants.levels[k]]))
    back = [select(mode == 0, a, b) for a, b in zip(off, on)]  # the indicator function by which it would
    sure = dot(back, z) < -small(m.rate) * magnitude(back, z)
    for j in plan.crossed[k]:
        sure = sure & ~problem.model.held(j, m.modes[j])
    none = jnp.zeros_like(mode)
    modes = tuple(1 - mode if i == k else other for i, other in enumerate(m.modes))
    slot = none + _slot(problem, plan.rows[row].free)
    return Plain(sure, m.z, modes, m.parts, [none] * len(plan.rows), slot, ~(m.rate == m.rate))


def _sign(problem: Problem, m: Meeting, k: int) -> Plain:
    """A `sgn` switch at its surface, or at a bound of its λ."""
    model, plan, constants, mode, tiny = problem.model, problem.plan, problem.constants, m.modes[k], small(m.rate)
    rows = plan.of(k)
    one, (free, *bounds) = jnp.ones_like(mode), [_slot(problem, s) for r in rows for s in plan.rows[r][1:] if s]
    known: list[Any] = [0 * one] * len(plan.rows)
    crossed = tuple(-mode if i == k else other for i, other in enumerate(m.modes))
    if k not in model.holdable:
        known[rows[0]] = one
        return Plain(m.rate == m.rate, m.z, crossed, m.parts, known, free * one, m.rate != m.rate)
    gain, bound, rate = frozen(constants.gain[k]), frozen(constants.bound[k]), frozen(m.rate)
    held, attracts = mode == 0, gain < 0
    # With h' = gain (s - λ) on the side from which it comes, this is 1 - λ times the sign of that side.
    way = rate / select(gain == 0, 1, gain)
    holds = attracts & (way <= 1 + bound)
    clear = (jnp.abs(way) > tiny) & (jnp.abs(jnp.abs(way - 1) - bound) > tiny * (1 + bound)) & (gain != 0)
    # With 1 < |λ| <= b it might hold or cross; what repels is crossed.
    forked = ~held & select(attracts, holds & (way > 2), 1 - way <= bound)
    if model.static(k):
        clear = clear & (~attracts | (jnp.abs(way - 2) > tiny))
    side = select(m.fires[rows[0]], 1, -1)
    after = select(held, side, select(holds, 0, -mode)).astype(mode.dtype)
    # With b = 1 dh/dt is zero where λ reaches it.
    smooth, jumps = bound - 1 <= 1e-13, bound - 1 > tiny
    fresh = select(held & smooth, 2, 1).astype(mode.dtype)
    known[rows[0]] = select(after == 0, 0, fresh).astype(mode.dtype)
    slot = select(held, select(side > 0, *bounds), free)
    sure = select(held, attracts & (smooth | jumps), clear) & (model.direction > 0)
    modes = tuple(after if i == k else other for i, other in enumerate(m.modes))
    return Plain(sure, m.z, modes, m.parts, known, slot.astype(mode.dtype), forked)


def _rebound(problem: Problem, m: Meeting, k: int) -> Plain:
    """An impact by Newton's law, that is followed by a flight which is not brief."""
    flow, model, plan, constants, *_ = problem
    n, one, row = plan.size, jnp.ones_like(m.modes[k]), plan.of(k)[0]
    tiny, eps = small(m.rate), float(jnp.finfo(m.rate.dtype).eps)
    known: list[Any] = [0 * one] * len(plan.rows)
    known[row] = one
    level, push = list(constants.level[k]), list(constants.push[k])
    rate, gain, e = dot(level, m.z), constants.gain[k], constants.restitution[k]
    impulse = -(1 + e) * rate / select(gain == 0, 1, gain)
    x = [a + impulse * b for a, b in zip(m.z, push)]
    z = frozen([*x, *m.z[n:]])
    rise, size = dot(frozen(level), z), magnitude(frozen(level), z)
    pull = dot(frozen(level), [dot(frozen(row), z) for row in m.matrix])
    flight = 2 * rise / select(pull < 0, -pull, 1)
    brief = jnp.maximum(eps**0.5 * (m.t - flow.t0), 1e4 * eps * jnp.abs(m.t))
    guard = frozen(m.guards[row])
    # What ends in rest is for `events/_impact` to tell: four times its margins are asked for.
    drift = dot(guard[n:-1], [dot(row, z) for row in m.matrix[n:]])
    noise = 8 * eps * (magnitude(guard, z) + (0 if drift is None else jnp.abs(m.t * drift)))
    long = (pull >= 0) | ((flight > 4 * frozen(brief)) & (0.25 * flight * rise > 4e3 * noise))
    sure = (frozen(m.rate) < 0) & (rise > tiny * size) & long & (gain != 0) & (model.direction > 0) & (m.modes[k] == 0)
    clear = [dot(g, z) > tiny * magnitude(g, z) for g in frozen(m.guards)]
    for other in {plan.rows[r].switch for r in range(len(clear)) if r != row}:
        rows = [clear[r] for r in plan.of(other) if r != row]
        above = ft.reduce(jnp.logical_and, rows)
        if len(rows) > 1 and other in plan.crossed:
            above = select(m.modes[other] < 0, ft.reduce(jnp.logical_or, rows), above)
        sure = sure & above
    return Plain(sure, x, m.modes, m.parts, known, _slot(problem, plan.rows[row].free) * one, rise != rise)
