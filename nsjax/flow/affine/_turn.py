"""One turn of the exact flow: each lane goes to the end of its arc, or to the first event on it if that is plain."""

import functools as ft
from typing import Any, NamedTuple

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int

from ..._numerics._autodiff import frozen
from ..._numerics._barrier import once, stored
from ..._numerics._bernstein import binomials
from ..._numerics._select import select
from .._loop import Flow
from .._save import Log, Saved
from ..steppers._exponential import _N
from ..steppers._stepper import stack
from ._arc import arrived, dot, full, matrix_rows, Rows, series, TERMS
from ._isolate import Corner, isolate, last, SOON
from ._lane import found_in, Lane, logged, state_of
from ._plain import magnitude, Meeting, Plain, plain, small
from ._plan import Plan, Problem
from ._table import by_lane, economised, Table


Lanes = Float[Array, " lanes"]
Truths = Bool[Array, " lanes"]
LATE = 1e-8  # how near to the end an event, as a part of what is left, is looked at by the general flow
MOST_ARCS = 1024  # of a mode; for one that would take more the general flow is asked how long its steps are


class Arc(NamedTuple):
    """How far a lane goes."""

    tau: Lanes
    event: Truths
    fires: Bool[Array, "rows lanes"]
    final: Truths  # whether to the end of the solution
    doubtful: Truths
    length: Lanes  # that a whole arc would have


class There(NamedTuple):
    """Where it is then."""

    z: Rows
    shift: Lanes  # by how much the time of the event differs from `Arc.tau`
    rate: Lanes  # of the guard that falls
    sure: Truths
    transversality: Lanes
    terms: list[Rows]


def picked(table: Any, index: Int[Array, " lanes"]) -> Any:
    """What belongs to the mode of each lane."""
    return ft.reduce(lambda found, i: select(index == i, table[i], found), range(1, len(table)), table[0])


def look(plan: Plan, table: Table, lane: Lane, flow: Flow, live: Truths) -> Arc:
    """To where the arc goes. None of it has a derivative, but for the length of the last one."""
    length = picked(table.length, lane.index)
    z = frozen([*lane.x, *lane.clock, jnp.ones_like(lane.t)])
    span = flow.t1 - lane.t
    nothing = jnp.zeros((0, lane.t.shape[0]), bool)
    share, event, at, fires, doubtful = jnp.ones_like(lane.t), ~live, jnp.zeros_like(lane.t), nothing, ~live
    if plan.rows:
        a = once(sum(picked(table.polynomials[..., q, :], lane.index) * x for q, x in enumerate(z)))
        missed = once(sum(picked(table.missed[..., q, :], lane.index) * jnp.abs(x) for q, x in enumerate(z)))
        known = jnp.stack(lane.known)
        corners = [Corner(plan.of(k), lane.modes[k] < 0) for k in plan.crossed if len(plan.of(k)) > 1]
        found = isolate(a, known, missed, live, corners)
        fires = found.fires & live
        event, share, doubtful = jnp.any(fires, axis=0), found.share, found.doubtful
        at, fires, tip = last(found, fires, known, corners)
        doubtful = doubtful | tip
    left, ahead = frozen(span), share * length
    tau = at * ahead
    slack = LATE * left + 2 * float(jnp.finfo(left.dtype).eps) * jnp.abs(flow.t1)
    doubtful = doubtful | (event & ((at * share < SOON) | (jnp.abs(tau - left) <= slack)))
    event = event & (tau <= left)
    final = ~event & (ahead >= left) & live
    tau = select(final, span, frozen(select(live, select(event, tau, ahead), 0)))
    return Arc(once(tau), event, fires & event, final, doubtful, length)


def go(plan: Plan, rows: list[Rows], guards: list[Rows], projection: Any, z: Rows, arc: Arc, theta: float) -> There:
    """To its end. At an event one Newton step on the guard itself corrects what the polynomial misses; the state
    follows to second order."""
    like, event = arc.tau, arc.event
    z, terms = series(rows, z, arc.tau, theta)
    nought = jnp.zeros_like(like)
    if not guards:
        return There(z, nought, nought, ~arc.doubtful, nought, terms)
    w = [
        stored(sum(select(arc.fires[r], full(row[q], like), 0) for r, row in enumerate(guards))) for q in range(len(z))
    ]
    f = [full(dot(row, z), like) for row in rows]
    bend = [full(dot(row, [*f, None]), like) for row in rows]
    value, rate = frozen((dot(w, z), dot(w[:-1], f)))
    shift = select(event, -value / select(rate == 0, 1, rate), 0)
    z = [*[stored(x + shift * (a + 0.5 * shift * b)) for x, a, b in zip(z, f, bend)], z[-1]]
    if projection is not None:
        z = [*[stored(dot(row, z)) for row in projection], *z[plan.size :]]
    # Of steps of Newton's method that small the error is below rounding.
    close = jnp.abs(shift) <= float(jnp.finfo(like.dtype).eps) ** (1 / 3) * 0.2 * arc.length
    w0, f0 = frozen((w, f))
    size = magnitude(w0[:-1], f0)
    drift = dot(w0[plan.size : -1], f0[plan.size :]) if plan.timed else nought
    normal, speed = sum(x * x for x in w0[: plan.size]), sum(x * x for x in f0[: plan.size])
    cosine = jnp.abs(rate) / jnp.sqrt((normal + drift**2) * (speed + select(drift == 0, 0, 1)))
    # What is nearly tangential, by a measure that does not depend on units, is for the general flow to judge.
    turns = frozen(dot(w0[:-1], bend))
    clear = (rate < -1e2 * small(like) * size) & (-rate > 1e2 * small(like) * jnp.abs(turns) * arc.length)
    delay, moved = arrived(z, rows, w, event)
    z = [*[stored(x) for x in moved[:-1]], z[-1]]
    return There(z, shift + delay, rate, ~event | (close & clear), cosine, terms)


def turn(problem: Problem, table: Table, lane: Lane) -> Lane:
    """All lanes one arc on; those for which that is not plain are marked as slow and stay where they are."""
    flow, model, plan, constants, like, theta = problem
    live = lane.active & (lane.index >= 0) & ~lane.slow
    arc = look(plan, table, lane, flow, live)
    n, m = plan.size, plan.width
    matrix = [[picked(table.matrix[:, i, j], lane.index) for j in range(m)] for i in range(n)]
    rows = matrix_rows(plan, matrix, constants.squared)
    guards = [[stored(picked(table.guards[:, r, q], lane.index)) for q in range(m)] for r in range(len(plan.rows))]
    projection = table.projection
    if projection is not None:
        projection = [[picked(projection[:, i, j], lane.index) for j in range(m)] for i in range(n)]
    there = go(plan, rows, guards, projection, [*lane.x, *lane.clock, jnp.ones_like(lane.t)], arc, theta)
    t = select(arc.final, flow.t1, lane.t + arc.tau + there.shift)
    sure = ~arc.doubtful & there.sure
    none = jnp.zeros_like(lane.steps)
    after = Plain(sure, there.z[:n], lane.modes, lane.parts, [none] * len(plan.rows), none, ~live)
    if plan.rows:
        met = Meeting(frozen(t), there.z, rows, [*arc.fires], there.rate, guards, lane.modes, lane.parts)
        after = plain(problem, met)
        sure = sure & (~arc.event | (after.sure & (frozen(t) < flow.t1)))
    # Of a stiff mode an arc is as short as what decays fast is, whether that is still there or not.
    sure = sure & ~(many(flow, arc.length) & (lane.wait > 3 * arc.length))
    # The general flow has the last word on limits.
    sure = sure & (lane.steps + 1 < flow.max_steps)
    if model.slots:
        sure = sure & (lane.events + 1 < flow.max_events)
    sure = sure & (sum(0 * frozen(v) for v in [*after.x, t]) == 0)
    moved, event = live & sure, live & sure & arc.event
    end = End(t, there, after._replace(x=[select(event, a, b) for a, b in zip(after.x, there.z)]), moved, event)
    new = _moved(plan, table, lane, end)
    if lane.log is not None:
        new = new._replace(log=_written(problem, lane, end))
    if saves(flow):
        new = new._replace(saved=_saved(problem, lane, arc, end, new))
    active = lane.active & ~(moved & (new.t >= flow.t1))
    return new._replace(active=active, slow=lane.slow | (live & ~sure))


def many(flow: Flow, length: Lanes) -> Truths:
    """Whether all the time would take very many arcs of that length."""
    return MOST_ARCS * length < frozen(flow.t1 - flow.t0)


class End(NamedTuple):
    """The end of an arc, and what follows there."""

    t: Lanes
    there: There
    after: Plain
    moved: Truths
    event: Truths


def _moved(plan: Plan, table: Table, lane: Lane, end: End) -> Lane:
    """The lanes where they are now."""
    t, there, after, moved, event = end
    none, one = jnp.zeros_like(lane.steps), jnp.ones_like(lane.steps)

    def choose(which: Truths, new: Rows, old: Rows) -> Rows:
        return [select(which, a, b) for a, b in zip(new, old)]

    modes = tuple(choose(event, [*after.modes], [*lane.modes]))
    return lane._replace(
        t=select(moved, t, lane.t),
        x=choose(moved, after.x, lane.x),
        clock=choose(moved, there.z[plan.size : -1], lane.clock),
        modes=modes,
        parts=tuple(old if old is None else select(event, new, old) for new, old in zip(after.parts, lane.parts)),
        known=[select(event, a, select(moved, none, b)) for a, b in zip(after.known, lane.known)],
        index=select(event, found_in(table, modes, none), lane.index),
        wait=select(moved, 1.26 * lane.wait, lane.wait),
        moved=lane.moved | moved,
        steps=lane.steps + select(moved, one, none),
        accepted=lane.accepted + select(moved, one, none),
        events=lane.events + select(event, one, none),
        forked=lane.forked | (event & after.forked),
    )


def _written(problem: Problem, lane: Lane, end: End) -> Log:
    """The log with the events of this turn."""
    flow, _, plan, _, like, _ = problem
    before, after = (state_of(x, like) for x in (end.there.z[: plan.size], end.after.x))
    row = (
        end.t * flow.model.direction,
        before,
        after,
        end.after.slot,
        jnp.stack(end.after.modes),
        end.there.transversality,
    )
    assert lane.log is not None
    return logged(lane.log, lane.events, end.event, frozen(row) if flow.still else row)


def saves(flow: Flow) -> bool:
    """Whether anything on the way is asked for."""
    return flow.want_points or flow.keep_steps > 0


def _saved(problem: Problem, lane: Lane, arc: Arc, end: End, new: Lane) -> Saved:
    """What `saveat` asks for of this turn."""
    flow, _, plan, _, like, _ = problem
    t, there, after, moved, event = end
    points = _points(plan, arc, there, like) if flow.want_points else None
    if flow.record is not None:
        points = flow.record(points)
    before, then = (state_of(x, like) for x in (there.z[: plan.size], after.x))

    def save(flow: Flow, saved: Saved, modes: tuple, here: tuple, there: tuple, counts: tuple) -> Saved:
        (t0, moved, event, points), (t, before, after, then) = here, there
        accepted, now = counts
        if saved.request.ts is not None:
            saved = saved.write_times(moved, (t0, t), points, modes, flow.model, False)
        saved = saved.write_step(moved, accepted, t0, t, points)
        if flow.keep_steps:
            due = moved & ((now % flow.keep_steps == 0) | event)
            saved = saved.write(due, t, before, modes, flow.model)
            saved = saved.write(due & event, t, after, then, flow.model)
        return saved

    here, now = (lane.t, moved, event, points), (t, before, then, after.modes)
    return by_lane(save, flow, lane.saved, lane.modes, here, now, (lane.accepted, new.accepted))


def _points(plan: Plan, arc: Arc, there: There, like: Any) -> Any:
    """Control points of the arc, from the terms of its series."""
    weights, _ = economised(_N, TERMS)
    weights = weights / np.array(binomials(_N))[:, None]
    longer = 1 + there.shift / select(arc.event, arc.tau, 1)
    x = jnp.stack([jnp.stack([full(v, longer) for v in term[: plan.size]]) for term in there.terms])
    powers = jnp.stack([longer**j for j in range(len(there.terms))])
    points = jnp.tensordot(jnp.asarray(weights, x.dtype), x * powers[:, None], axes=1)
    points = points.at[0].set(x[0])
    rows = [state_of([*point], like) for point in points]
    return stack(rows)
