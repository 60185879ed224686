"""Buffers filled while the flow runs: the states `saveat` asks for, dense output, and the event log."""

from collections.abc import Callable
from typing import Any, NamedTuple

import diffrax as dfx
import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int

from .._numerics._barrier import once
from .._numerics._select import select
from .._numerics._while_any import while_any
from .._types import Scalar, Y
from ..system._model import SwitchedSystem
from .steppers._stepper import bernstein


NO_MODE = -128  # padding of saved modes


class Request(NamedTuple):
    """The contents of a `SaveAt`, which may ask for dense output alone."""

    t0: bool
    t1: bool
    ts: Float[Array, " times"] | None
    steps: int
    fn: Callable[..., Any]

    @classmethod
    def of(cls, saveat: dfx.SaveAt) -> "Request":
        sub = saveat.subs
        if sub is None:
            return cls(False, False, None, 0, lambda t, y, system: y)
        return cls(sub.t0, sub.t1, sub.ts, sub.steps, sub.fn)


def times_in_order(ts: Any, t0: Any, t1: Any) -> Any:
    """Whether times can be saved on the way from `t0` to `t1`: they follow one another, and lie between them."""
    forwards, backwards = ts[1:] >= ts[:-1], ts[1:] <= ts[:-1]
    ahead = (ts >= t0) & (ts <= t1) & forwards.all()
    back = (ts <= t0) & (ts >= t1) & backwards.all()
    return ahead.all() | back.all()


def times_between(a: Scalar, b: Scalar, shares: Any) -> tuple[Scalar, Scalar, Array]:
    """The two times, and those at rising shares of the way from one to the other, none of which lies outside by
    rounding. (A compiled program may compute a time twice, rounded in two ways.)"""
    a, b = once((a, b))
    return a, b, jnp.clip(a + (b - a) * jnp.asarray(shares, b.dtype), jnp.minimum(a, b), jnp.maximum(a, b))


def _put(buffer: Any, index: Any, value: Any, when: Any) -> Any:
    """Writes a row; one that is not wanted goes past the end, where it is dropped."""

    def put(b: Array, v: Any) -> Array:
        return b.at[select(when, index, b.shape[0])].set(v, mode="drop")

    return jax.tree.map(put, buffer, value)


class Log(eqx.Module):
    """The event log: one row of floats and one of integers an event."""

    t: Float[Array, " events"]
    before: Y
    after: Y
    slot: Int[Array, " events"]
    modes: Int[Array, "events switches"]  # after the event
    transversality: Float[Array, " events"]

    def __init__(self, capacity: int, y: Y, switches: int):
        dtype = jnp.result_type(*jax.tree.leaves(y))
        blank = jax.tree.map(lambda x: jnp.full((capacity, *x.shape), jnp.nan, x.dtype), y)
        self.t = jnp.full(capacity, jnp.inf, dtype)
        self.before = blank
        self.after = blank
        self.slot = jnp.full(capacity, -1, jnp.int32)
        self.modes = jnp.full((capacity, switches), NO_MODE, jnp.int32)
        self.transversality = jnp.full(capacity, jnp.nan, dtype)

    def write(self, index: Any, when: Any, row: tuple) -> "Log":
        """Writes a row, which has an entry for each column, if `when`."""

        def columns(log: Log) -> tuple:
            return log.t, log.before, log.after, log.slot, log.modes, log.transversality

        return eqx.tree_at(columns, self, _put(columns(self), index, row, when))


class Saved(eqx.Module):
    """What `SaveAt` asks for. `count` rows are filled; `next` is the next of the requested times."""

    ts: Float[Array, " times"] | None
    ys: Any
    modes: Int[Array, "times switches"] | None
    count: Any
    next: Any
    dense: Any  # (start times, end times, control points) of every accepted step
    request: Request

    def __init__(
        self,
        saveat: dfx.SaveAt,
        most: tuple[int, int],
        t: Scalar,
        y: Y,
        mode: tuple,
        degree: int,
        model: SwitchedSystem,
    ):
        max_steps, max_events = most
        request = Request.of(saveat)
        self.request = request
        self.count = jnp.zeros((), jnp.int32)
        self.next = jnp.zeros((), jnp.int32)
        times = 0 if request.ts is None else len(request.ts)
        steps = (max_steps + 2 * max_events) // request.steps if request.steps else 0
        size = int(request.t0) + times + int(request.t1) + steps
        out = jax.eval_shape(lambda: request.fn(t, y, model.system.owner))
        self.ts = jnp.full(size, jnp.inf, t.dtype)
        self.ys = jax.tree.map(
            lambda x: jnp.full((size, *x.shape), jnp.inf if jnp.issubdtype(x.dtype, jnp.inexact) else 0, x.dtype), out
        )
        self.modes = jnp.full((size, len(mode)), NO_MODE, jnp.int32)
        self.dense = None
        if saveat.dense:
            points = jax.tree.map(lambda x: jnp.zeros((max_steps, degree + 1, *x.shape), x.dtype), y)
            self.dense = (jnp.zeros(max_steps, t.dtype), jnp.full(max_steps, jnp.inf, t.dtype), points)

    def write(self, when: Any, t: Scalar, y: Y, mode: tuple, model: SwitchedSystem) -> "Saved":
        mode_row = jnp.stack(mode) if mode else jnp.zeros(0, jnp.int32)
        t = t * model.direction
        row = (t, self.request.fn(t, y, model.system.owner), mode_row)
        new = _put((self.ts, self.ys, self.modes), self.count, row, when)
        return eqx.tree_at(
            lambda s: (s.ts, s.ys, s.modes, s.count), self, (*new, self.count + jnp.asarray(when, jnp.int32))
        )

    def write_times(
        self,
        when: Bool[Array, ""],
        step: tuple[Scalar, Scalar],
        points: Y,
        mode: tuple,
        model: SwitchedSystem,
        reverse: bool,
    ) -> "Saved":
        """Saves every requested time up to the end of a step, from its dense output."""
        t0, t1 = step
        times = self.request.ts
        if times is None:
            return self
        times = times.astype(t0.dtype) * model.direction
        last = len(times) - 1

        def due(saved: Saved) -> Bool[Array, ""]:
            # A time that rounding puts past the last step must not be lost: the caller ends exactly at t1.
            return when & (saved.next <= last) & (times[jnp.minimum(saved.next, last)] <= t1)

        def save(saved: Saved) -> Saved:
            now, t = due(saved), times[jnp.minimum(saved.next, last)]
            length = t1 - t0
            u = select(length > 0, (t - t0) / select(length > 0, length, 1), 1)
            saved = saved.write(now, t, bernstein(points, u), mode, model)
            return eqx.tree_at(lambda s: s.next, saved, saved.next + now.astype(jnp.int32))

        return while_any(due, save, self, dict(max_steps=len(times)) if reverse else None)

    def write_step(self, when: Any, index: Any, t0: Scalar, t1: Scalar, points: Y) -> "Saved":
        if self.dense is None:
            return self
        new = _put(self.dense, index, (t0, t1, points), when)
        return eqx.tree_at(lambda s: s.dense, self, new)
