"""The loop of the exact flow: arcs of all lanes, as long as they are plain; then a turn of the general flow for those
lanes that wait for it."""

import dataclasses
from typing import Any

import equinox as eqx
import jax
import jax.lax as lax
import jax.numpy as jnp
from jaxtyping import Array

from ..._numerics._lane_cond import compact_cond
from ..._numerics._lanes import in_lanes
from ..._numerics._select import select
from ...system._mode import ModeState
from ...system._model import SwitchedSystem
from .._loop import Carry, Flow
from ._lane import entered, Lane, Lanes, left, logged, MISSING, Row, strange
from ._plan import constants, numbers, Plan, Problem
from ._table import by_lane, DEGREE, key_of, PHASE, Table, tabulate, THETA
from ._turn import many, picked, saves, turn


_KEPT = 3  # tables a lane, at most
_IN_CACHE = 256, 2**20  # lanes that are run together, at most, and bytes of their tables, on a CPU
_IN_MEMORY = 65_536, 2**30  # and on other devices, which want many lanes at once


def exactly(flow: Flow, planned: tuple[SwitchedSystem, Plan], carry: Carry, plain: bool = False) -> Carry:
    """The end of the loop, as `_solve._looped` finds it, for a model as it is `_plan.planned`; or if only what is
    `plain` is wanted, the end of that."""
    model, plan = planned
    kept = min(numbers(model), _KEPT)
    lanes, room = _IN_CACHE if jax.default_backend() == "cpu" else _IN_MEMORY
    size = kept * max(1, len(plan.rows)) * (DEGREE + 1) * plan.width * carry.t.dtype.itemsize
    chunk = max(32, min(lanes, room // size))
    dynamic, static = eqx.partition((flow, carry), eqx.is_array)

    def run(dynamic: Any) -> Any:
        flow, carry = eqx.combine(dynamic, static)
        own = jax.tree.unflatten(jax.tree.structure(model), jax.tree.leaves(flow.model))
        return eqx.filter(_run(flow, own, plan, kept, carry, plain), eqx.is_array)

    return eqx.combine(in_lanes(run, chunk, dynamic), static[1])


def _run(flow: Flow, model: SwitchedSystem, plan: Plan, kept: int, carry: Carry, plain: bool) -> Carry:
    found = by_lane(lambda model, t, y: constants(model, plan, t, y), model, flow.t0, carry.y)
    problem = Problem(flow, model, plan, found, carry.y, PHASE if saves(flow) else THETA)
    table = _blank(problem, kept, carry)
    lane = entered(problem, table, carry, jnp.full_like(carry.t, jnp.inf))
    used = jnp.zeros_like(carry.steps)
    dynamic, static = eqx.partition((carry, lane, table, used), eqx.is_array)

    def busy(dynamic: Any) -> Array:
        _, lane, _, _ = eqx.combine(dynamic, static)
        return jnp.any(lane.active)

    def body(dynamic: Any) -> Any:
        carry, lane, table, used = eqx.combine(dynamic, static)
        table, used, lane = _tabulated(problem, table, used, lane)
        lane = _arcs(problem, table, lane)
        if plain:
            lane = lane._replace(active=lane.active & ~lane.slow)
        else:
            carry, lane = _general(problem, table, carry, lane)
        return eqx.filter((carry, lane, table, used), eqx.is_array)

    carry, lane, table, _ = eqx.combine(lax.while_loop(busy, body, dynamic), static)
    return left(problem, lane, carry, carry.dt)


def _blank(problem: Problem, kept: int, carry: Carry) -> Table:
    """Room for tables."""
    form = jax.eval_shape(lambda state: _table_of(problem, state), carry.state)
    table = jax.tree.map(lambda x: jnp.zeros((kept, *x.shape), x.dtype), form)
    return table._replace(key=jnp.full_like(table.key, MISSING), length=jnp.ones_like(table.length))


def _table_of(problem: Problem, state: ModeState) -> Table:
    key = key_of(state.mode) if state.mode else jnp.zeros(problem.constants.squared.shape, jnp.int32)
    return tabulate(problem, state, key)


def _tabulated(problem: Problem, table: Table, used: Lanes, lane: Lane) -> tuple[Table, Lanes, Lane]:
    """With tables for the modes that are new to a lane, in place of the oldest."""
    wanted = lane.active & ~lane.slow & (lane.index == MISSING)
    kept = len(table.key)

    def build(args: tuple) -> tuple:
        table, used, index = args
        parts = tuple(None for _ in lane.modes)
        new = _table_of(
            problem, ModeState.of(lane.modes, parts)._replace(roots=tuple(jnp.zeros_like(m) for m in lane.modes))
        )
        place = used % kept
        table = jax.tree.map(
            lambda old, x: jnp.stack([select(wanted & (place == i), x, old[i]) for i in range(kept)]), table, new
        )
        return table, used + wanted.astype(used.dtype), select(wanted, place, index)

    table, used, index = lax.cond(jnp.any(wanted), build, lambda args: args, (table, used, lane.index))
    return table, used, lane._replace(index=index)


def _arcs(problem: Problem, table: Table, lane: Lane) -> Lane:
    """On, until every lane has ended, comes to a new mode, or waits for the general flow."""
    dynamic, static = eqx.partition(lane, eqx.is_array)

    def ready(dynamic: Any) -> Array:
        lane = eqx.combine(dynamic, static)
        return jnp.any(lane.active & ~lane.slow & (lane.index != MISSING))

    def body(dynamic: Any) -> Any:
        new = turn(problem, table, eqx.combine(dynamic, static))
        return eqx.filter(new, eqx.is_array)

    return eqx.combine(lax.while_loop(ready, body, dynamic), static)


def _general(problem: Problem, table: Table, carry: Carry, lane: Lane) -> tuple[Carry, Lane]:
    """A turn of the general flow for the lanes that wait for one."""
    flow = problem.flow
    waits = lane.active & lane.slow

    def go(args: tuple) -> tuple:
        carry, lane = args
        length = picked(table.length, lane.index)
        before = left(problem, lane, carry, select(many(flow, length), carry.dt, 0.3 * length))
        if before.log is None:
            after = by_lane(_one_turn, flow, waits, before)
        else:  # not with the log itself, which is long
            turned = dataclasses.replace(before, log=Row.blank(before.log))
            after = by_lane(_one_turn, flow, waits, turned)
            row: Any = after.log
            log = logged(before.log, before.events, row.when & waits, row.row)
            after = dataclasses.replace(after, log=log)
        return after, back(after, lane)

    def back(after: Carry, lane: Lane) -> Lane:
        new = entered(problem, table, after, select(waits, after.dt, lane.wait))
        stays = waits & (after.accepted == lane.accepted)
        return new._replace(slow=strange(problem, new.modes, stays) & after.active)

    dynamic, static = eqx.partition((carry, lane), eqx.is_array)

    def branch(dynamic: Any) -> Any:
        return eqx.filter(go(eqx.combine(dynamic, static)), eqx.is_array)

    return eqx.combine(lax.cond(jnp.any(waits), branch, lambda d: d, dynamic), static)


def _one_turn(flow: Flow, wanted: Array, carry: Carry) -> Carry:
    dynamic, static = eqx.partition(carry, eqx.is_array)
    moving, still = eqx.partition(flow, eqx.is_array)

    def branch(moving: Any, dynamic: Any) -> Any:
        new = eqx.filter(eqx.combine(moving, still).body(eqx.combine(dynamic, static)), eqx.is_array)
        return jax.tree.map(lambda old, x: x.astype(old.dtype), dynamic, new)

    return eqx.combine(compact_cond(wanted, branch, (moving, dynamic), dynamic), static)
