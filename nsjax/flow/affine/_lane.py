"""What the exact flow hands from turn to turn, with lanes along the last axis, and how it is put back into the `Carry`
of the general flow."""

import dataclasses
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int

from ..._numerics._select import select
from ..._types import Y
from ...system._mode import ModeState
from .._loop import Carry, Flow
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
    flow, plan, constants, _, _ = problem
    known = [jnp.zeros_like(c.steps)] * len(plan.rows)
    if flow.model.slots:

        def roots(flow: Flow, state: ModeState) -> list[Array]:
            found, out = flow.model.known_roots(state), []
            for row in plan.rows:
                free, held = ([None] if i is None else found[i] for i in (row.free, row.held))
                if free[0] is not None and held[0] is not None:
                    out.append(select(flow.model.held(row.switch, state.mode[row.switch]), held[0], free[0]))
                else:
                    out.append(held[0] if free[0] is None else free[0])
            return out

        known = by_lane(roots, flow, c.state)
    since = clock(c.t - flow.t0, constants.frequency) if plan.timed else ()
    no = jnp.zeros_like(c.active)
    return Lane(
        t=c.t,
        x=rows_of(c.y),
        clock=list(since),
        modes=c.state.mode,
        known=[k.astype(jnp.int32) for k in known],
        index=found_in(table, c.state.mode, c.steps),
        active=c.active,
        slow=no,
        wait=wait,
        moved=no,
        steps=c.steps,
        accepted=c.accepted,
        events=c.events,
        forked=c.forked,
        log=c.log,
        saved=c.saved,
    )


def left(problem: Problem, lane: Lane, c: Carry, dt: Lanes) -> Carry:
    """To the general flow: `c` is what it had last, `dt` the step that it is to take."""
    flow, plan = problem.flow, problem.plan
    y, roots = state_of(lane.x, c.y), []
    for k in range(len(lane.modes)):
        own = [(row, known) for row, known in zip(plan.rows, lane.known) if row.switch == k]
        if k in flow.model.holdable:
            held = flow.model.held(k, lane.modes[k])
            edge = own[0][1] - (own[1][1] if len(own) > 1 else 0)
            roots.append(select(held, edge, own[0][1]))
        else:
            roots.append(own[0][1])
    kept = [select(lane.moved, new, old).astype(jnp.int32) for new, old in zip(roots, c.state.roots)]
    state = ModeState(lane.modes, c.state.part, tuple(kept))
    f = by_lane(lambda flow, t, y, state: flow.model.flow(t, y, state), flow, lane.t, y, state)
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
        place = select(when, index, buffer.shape[0])
        if buffer.ndim == 2:
            return _put(buffer, place, value)
        values = value.reshape(-1, value.shape[-1])
        flat = buffer.reshape(buffer.shape[0], *values.shape)
        return jnp.stack([_put(flat[:, j], place, x) for j, x in enumerate(values)], axis=1).reshape(buffer.shape)

    def columns(log: Log) -> tuple:
        return log.t, log.before, log.after, log.slot, log.modes, log.transversality

    return eqx.tree_at(columns, log, jax.tree.map(put, columns(log), row))
