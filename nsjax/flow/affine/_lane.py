"""What the exact flow hands from turn to turn, with lanes along the last axis, and how it is put back into the `Carry`
of the general flow."""

import dataclasses
import functools as ft
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int

from ..._numerics._select import select
from ..._types import Y
from ...system._mode import ModeState
from ...system._model import SwitchedSystem
from .._loop import Carry
from .._save import Log, Saved
from ._arc import Rows
from ._plan import clock, Problem
from ._table import by_lane, key_of, Table


Lanes = Float[Array, " lanes"]
Truths = Bool[Array, " lanes"]
Numbers = Int[Array, " lanes"]

MISSING = -1


class Lane(NamedTuple):
    """All lanes."""

    t: Lanes
    x: Rows  # the state
    clock: Rows  # S and C, if time enters
    modes: tuple[Numbers, ...]
    parts: tuple[Numbers | None, ...]  # of each switch with several components the one that is active
    known: list[Numbers]  # how many roots each guard has at this instant
    index: Numbers  # of the table of the mode; MISSING where there is none
    active: Truths
    slow: Truths  # whether it waits for a turn of the general flow
    wait: Lanes  # as long as it goes, the general flow's last step, of a mode with many arcs
    moved: Truths  # whether it has moved since the general flow had it
    steps: Numbers
    accepted: Numbers
    events: Numbers
    forked: Truths
    log: Log | None
    saved: Saved


def rows_of(y: Y) -> Rows:
    """The numbers of a state."""
    return [row for leaf in jax.tree.leaves(y) for row in leaf.reshape(-1, leaf.shape[-1])]


def state_of(x: Rows, like: Y) -> Y:
    """The state with these numbers."""
    leaves, tree = jax.tree.flatten(like)
    out, start = [], 0
    for leaf in leaves:
        count = leaf.size // leaf.shape[-1]
        part = x[start : start + count]
        out.append(part[0] if leaf.ndim == 1 else jnp.stack(part).reshape(leaf.shape))
        start += count
    return jax.tree.unflatten(tree, out)


def found_in(table: Table, modes: tuple[Numbers, ...], like: Numbers) -> Numbers:
    """The index of the table of a mode, for each lane."""
    key = jnp.zeros_like(like) if not modes else key_of(modes)
    index = jnp.full_like(like, MISSING)
    for i, other in enumerate(table.key):
        index = select(other == key, i, index)
    return index


def entered(problem: Problem, table: Table, c: Carry, wait: Lanes) -> Lane:
    """From the general flow."""
    flow, model, plan, constants, _, _ = problem
    known = [jnp.zeros_like(c.steps)] * len(plan.rows)
    if model.slots:

        def roots(model: SwitchedSystem, state: ModeState) -> list[Array]:
            found, out = dict(zip(model.slots, model.known_roots(state))), []
            for k, free, held in plan.rows:
                if free and held:
                    out.append(select(model.held(k, state.mode[k]), found[held][0], found[free][0]))
                elif free and model.parts[k] > 1:  # those below a corner belong to the slot of its first component
                    below = found[plan.rows[plan.of(k)[0]].free][free.part]
                    out.append(select(state.mode[k] < 0, below, found[free][0]))
                else:
                    out.append(found[free or held][0])
            return out

        known = by_lane(roots, model, c.state)
    since = clock(c.t - flow.t0, constants.squared) if plan.timed else ()
    return Lane(
        t=c.t,
        x=rows_of(c.y),
        clock=list(since),
        modes=c.state.mode,
        parts=c.state.part,
        known=[k.astype(jnp.int32) for k in known],
        index=found_in(table, c.state.mode, c.steps),
        active=c.active,
        slow=strange(problem, c.state.mode, jnp.zeros_like(c.active)),
        wait=wait,
        moved=jnp.zeros_like(c.active),
        steps=c.steps,
        accepted=c.accepted,
        events=c.events,
        forked=c.forked,
        log=c.log,
        saved=c.saved,
    )


def strange(problem: Problem, modes: tuple[Numbers, ...], also: Truths) -> Truths:
    """Where a mode is none of those with a table, as it holds what is only crossed here; and `also` others."""
    own = [k for k in problem.plan.crossed if problem.model.switches[k].signed]
    return ft.reduce(jnp.logical_or, [modes[k] == 0 for k in own], also)


def left(problem: Problem, lane: Lane, c: Carry, dt: Lanes) -> Carry:
    """To the general flow: `c` is what it had last, `dt` the step that it is to take."""
    flow, plan = problem.flow, problem.plan
    y, roots = state_of(lane.x, c.y), []
    for k in range(len(lane.modes)):
        own = [lane.known[r] for r in plan.of(k)]
        if k in problem.model.holdable:
            held = flow.model.held(k, lane.modes[k])
            edge = own[0] - (own[1] if len(own) > 1 else 0)
            roots.append(select(held, edge, own[0]))
        else:
            roots.append(ft.reduce(jnp.maximum, own))
    kept = [select(lane.moved, new, old).astype(jnp.int32) for new, old in zip(roots, c.state.roots)]
    state = ModeState(lane.modes, lane.parts, tuple(kept))
    f = by_lane(lambda model, t, y, state: model.flow(t, y, state), flow.model, lane.t, y, state)
    moved, zero = lane.moved, jnp.zeros_like(c.halted)
    return dataclasses.replace(
        c,
        t=lane.t,
        y=y,
        f=jax.tree.map(lambda a, b: select(moved, a, b), f, c.f),
        state=state,
        dt=select(moved, dt, c.dt),
        active=lane.active,
        steps=lane.steps,
        accepted=lane.accepted,
        events=lane.events,
        halted=select(moved, zero, c.halted),
        halvings=select(moved, zero, c.halvings),
        crawled=select(moved, zero, c.crawled),
        forked=lane.forked,
        log=lane.log,
        saved=lane.saved,
    )


@jax.custom_jvp
def _put(buffer: Float[Array, "rows lanes"], place: Numbers, value: Lanes) -> Float[Array, "rows lanes"]:
    """A number into a row of each lane. (Its derivative is the same; JAX does not know that no two go to one place.)"""
    lanes = jnp.arange(place.shape[0], dtype=jnp.int32)
    return buffer.at[place, lanes].set(value, mode="drop")


@_put.defjvp
def _put_jvp(primals: tuple, tangents: tuple) -> tuple[Array, Any]:
    (buffer, place, value), (dbuffer, _, dvalue) = primals, tangents
    out = _put(buffer, place, value)
    smooth = jnp.issubdtype(out.dtype, jnp.inexact)
    return out, _put(dbuffer, place, dvalue) if smooth else np.zeros(out.shape, jax.dtypes.float0)


class Row(eqx.Module):
    """In place of a `Log` for one turn of one lane: what is written, and whether anything is."""

    when: Any
    row: tuple

    @classmethod
    def blank(cls, log: Log) -> "Row":
        columns = log.t, log.before, log.after, log.slot, log.modes, log.transversality
        return cls(jnp.zeros(log.t.shape[-1], bool), jax.tree.map(lambda x: x[0], columns))

    def write(self, index: Any, when: Any, row: tuple) -> "Row":
        return Row(when, jax.tree.map(lambda new, old: jnp.asarray(new, old.dtype), row, self.row))


def logged(log: Log, index: Numbers, when: Truths, row: tuple[Any, ...]) -> Log:
    """`Log.write` for all lanes."""

    def put(buffer: Array, value: Array) -> Array:
        # Each number of a state or mode by itself: to stack them would copy the whole log.
        values, rows = (x.reshape(-1, x.shape[-1]) for x in (value, buffer))
        for j, x in enumerate(values):
            rows = _put(rows, select(when, index * len(values) + j, len(rows)), x)
        return rows.reshape(buffer.shape)

    def columns(log: Log) -> tuple:
        return log.t, log.before, log.after, log.slot, log.modes, log.transversality

    return eqx.tree_at(columns, log, jax.tree.map(put, columns(log), row))
