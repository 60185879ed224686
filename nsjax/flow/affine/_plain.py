"""Events at which there is nothing to choose: one switch crosses, begins to hold or lets go, or rebounds, and all
others go on as before, as no switch acts on the surface of another one. All that is not plainly so is left to
`transition`.
"""

from typing import Any, NamedTuple

import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int

from ..._numerics._autodiff import frozen
from ..._numerics._select import select
from ...system._impact import impact
from .._loop import Flow
from ._arc import dot, Rows
from ._plan import Constants, Plan


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


class Plain(NamedTuple):
    """What it leads to, if it is plain."""

    sure: Truths
    x: Rows
    modes: tuple[Numbers, ...]
    known: list[Numbers]  # how many roots each guard has there
    slot: Numbers
    forked: Truths


def small(like: Array) -> float:
    """Relative to the size of its terms, what is not told from zero here."""
    return max(1e-7, 1e3 * float(jnp.finfo(like.dtype).eps))


def magnitude(row: Rows, z: Rows) -> Any:
    """The size of the terms of a row times z."""
    return dot([None if a is None else jnp.abs(a) for a in row], [None if x is None else jnp.abs(x) for x in z])


def plain(flow: Flow, plan: Plan, constants: Constants, m: Meeting) -> Plain:
    model, none = flow.model, jnp.zeros_like(m.modes[0])
    yes = jnp.ones_like(m.fires[0])
    out = Plain(yes, m.z[: plan.size], m.modes, [none] * len(plan.rows), none, ~yes)
    for k, switch in enumerate(model.switches):
        rows = [r for r, row in enumerate(plan.rows) if row.switch == k]
        now = m.fires[rows[0]] | m.fires[rows[-1]]
        if isinstance(switch, impact):
            new = _rebound(flow, plan, constants, m, k)
        else:
            new = _sign(flow, plan, constants, m, k, rows)
        sure = new.sure & (not switch.ends)
        out = Plain(
            select(now, sure, out.sure),
            [select(now, a, b) for a, b in zip(new.x, out.x)] if new.x is not m.z else out.x,
            tuple(select(now, a, b) if i == k else b for i, (a, b) in enumerate(zip(new.modes, out.modes))),
            [select(now, a, b) if r in rows else b for r, (a, b) in enumerate(zip(new.known, out.known))],
            select(now, new.slot, out.slot),
            select(now, new.forked, out.forked),
        )
    return out


def _sign(flow: Flow, plan: Plan, constants: Constants, m: Meeting, k: int, rows: list[int]) -> Plain:
    """A `sgn` switch at its surface, or at a bound of its λ."""
    model, mode, tiny = flow.model, m.modes[k], small(m.rate)
    one, row = jnp.ones_like(mode), plan.rows[rows[0]]
    known: list[Any] = [0 * one] * len(plan.rows)
    crossed = tuple(-mode if i == k else other for i, other in enumerate(m.modes))
    if k not in model.holdable:
        known[rows[0]] = one
        return Plain(m.rate == m.rate, m.z, crossed, known, row.free * one, m.rate != m.rate)  # type: ignore
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
    slot = select(held, select(side > 0, plan.rows[rows[0]].held, plan.rows[rows[1]].held), row.free)  # type: ignore
    sure = select(held, attracts & (smooth | jumps), clear) & (model.direction > 0)
    modes = tuple(after if i == k else other for i, other in enumerate(m.modes))
    return Plain(sure, m.z, modes, known, slot.astype(mode.dtype), forked)


def _rebound(flow: Flow, plan: Plan, constants: Constants, m: Meeting, k: int) -> Plain:
    """An impact by Newton's law, that is followed by a flight which is not brief."""
    model, n, one = flow.model, plan.size, jnp.ones_like(m.modes[k])
    tiny, eps = small(m.rate), float(jnp.finfo(m.rate.dtype).eps)
    row = next(r for r, row in enumerate(plan.rows) if row.switch == k)
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
    for r, others in enumerate(m.guards):
        if r != row:
            sure = sure & (dot(frozen(others), z) > tiny * magnitude(frozen(others), z))
    return Plain(sure, x, m.modes, known, plan.rows[row].free * one, rise != rise)  # type: ignore
