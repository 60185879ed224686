"""What `solve` returns: saved states, the event log, dense output, and why it ended."""

import os
from collections.abc import Iterator
from typing import Any, Generic, NamedTuple, overload

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int

from .._numerics._compile import interactive
from .._numerics._select import select
from .._numerics._tables import frame, lanes_of
from .._numerics._text import between, components, known, shown, written
from .._types import Scalar, StateT, Y
from ..system._mode import change_words, mode_words
from ..system._system import System
from ._archive import Archive, save, table
from ._dataset import dataset_of
from ._results import is_okay, outcomes, RESULTS
from .steppers._stepper import bernstein


@shown
class Event(NamedTuple, Generic[StateT]):
    """One event of a solution, as `for event in sol.events` yields it."""

    t: Any
    switch: str
    mode_before: dict[str, int]
    mode_after: dict[str, int]
    y_before: StateT
    y_after: StateT
    transversality: Any

    def __str__(self) -> str:
        changes = change_words(self.mode_before, self.mode_after) or "reset"
        state = ", ".join(f"{x:.6g}" for x in np.concatenate([np.ravel(l) for l in jax.tree.leaves(self.y_after)]))
        return f"t = {float(self.t):<18.12g} {self.switch}: {changes}   y = ({state})"


@shown
class Events(eqx.Module, Generic[StateT]):
    """The event log, in order of time, padded to `max_events` rows (time infinite, switch -1).

    **Attributes:**

    - `t`: times, shape `(max_events,)`.
    - `switch`: which switch, as its position in `names`.
    - `mode_before`, `mode_after`: shape `(max_events, number of switches)`; for `sgn` +1, -1, or 0
      while sliding; `relay` 0 or 1; `impact` 1 while resting in contact.
    - `y_before`, `y_after`: the state on either side, leaves with a leading axis of length `max_events`.
    - `transversality`: how squarely each met its surface: |nᵀf⁻ + h_t| / sqrt((|n|² + h_t²) (|f⁻|² + 1)), the cosine
      between the surface's normal and the trajectory in time and state (without the 1 where h_t = 0), from 0 (tangency,
      where derivatives do not exist) to 1, in the units of the state. It is set to 0 where h would fall, without the
      event, by less than ten times what the relative tolerance (of exact methods, rounding) makes of its size; the
      solution's result is `RESULTS.tangential_event` then.
    - `num`: how many there were.
    """

    t: Float[Array, " events"]
    switch: Int[Array, " events"]
    mode_before: Int[Array, "events switches"]
    mode_after: Int[Array, "events switches"]
    y_before: Y
    y_after: Y
    transversality: Float[Array, " events"]
    num: Int[Array, ""]
    names: tuple[str, ...] = eqx.field(static=True)

    def _single(self) -> None:
        if jnp.ndim(self.num):
            raise TypeError(
                f"These are the event logs of a batch of {np.shape(self.num)} solutions, `num` has their lengths: take "
                "one out, `jax.tree.map(lambda x: x[i], events)`, or use the arrays `t`, `switch`, `mode_after`, ..."
            )

    def __len__(self) -> int:
        self._single()
        return int(self.num)

    @overload
    def __getitem__(self, i: int) -> Event[StateT]: ...

    @overload
    def __getitem__(self, i: slice) -> list[Event[StateT]]: ...

    def __getitem__(self, i: int | slice) -> Event[StateT] | list[Event[StateT]]:
        n = len(self)
        if isinstance(i, slice):
            return [self[k] for k in range(*i.indices(n))]
        if not -n <= i < n:
            raise IndexError(f"There are {n} events.")
        # (As NumPy's arrays, of which taking an entry out compiles nothing.)
        log, i = jax.tree.map(np.asarray, self), i % n

        def named(mode: np.ndarray) -> dict[str, int]:
            return {name: int(m) for name, m in zip(self.names, mode)}

        t, *rest = jax.tree.map(lambda x: x[i], (log.t, log.y_before, log.y_after, log.transversality))
        modes = named(log.mode_before[i]), named(log.mode_after[i])
        return Event(t, self.names[int(log.switch[i])], *modes, *rest)

    def __iter__(self) -> Iterator[Event[StateT]]:
        return (self[i] for i in range(len(self)))

    def to_dataframe(self) -> Any:
        """A row for each event: `t`, the `switch`, the modes before and after (`mode_before.belt`), the states before
        and after (`y_before.x`), and `transversality`. Of a batch the column `lane` says whose it is.

        **Returns:** a `pandas.DataFrame`: `pip install nsjax[data]`.
        """
        log = jax.tree.map(np.asarray, self)
        happened = np.arange(log.t.shape[-1]) < log.num[..., None]
        columns = lanes_of(log.t.shape) + [("t", log.t.ravel())]
        columns.append(("switch", np.array([*self.names, ""], dtype=object)[log.switch].ravel()))
        for name in ("mode_before", "mode_after"):
            rows = getattr(log, name)
            columns += [(f"{name}.{switch}", rows[..., k].ravel()) for k, switch in enumerate(self.names)]
        for name in ("y_before", "y_after"):
            parts = components(getattr(log, name), log.t.ndim)
            columns += [(f"{name}.{part}", values.ravel()) for part, values in parts.items()]
        columns.append(("transversality", log.transversality.ravel()))
        return frame("Events.to_dataframe", [(name, values[happened.ravel()]) for name, values in columns])

    def __str__(self) -> str:
        if jnp.ndim(self.num):
            return f"event logs of {self.num.size} solutions, {between(self.num)} events each"
        return "\n".join(map(str, self)) or "no events"


@shown
class Itinerary(eqx.Module):
    """The modes that a solution passes through, with the switches whose events lead from one to the next.

    Iterating yields each mode as a dictionary. (A reset leads from a mode to itself.)
    """

    first: Int[Array, " switches"]
    switch: Int[Array, " events"]
    modes: Int[Array, "events switches"]  # after each event
    num: Int[Array, ""]
    names: tuple[str, ...] = eqx.field(static=True)

    def same_as(self, other: "Itinerary") -> Bool[Array, ""]:
        """Whether two solutions have the same events in the same order (for batches lane by lane)."""
        if self.names != other.names:
            raise ValueError(f"Itineraries of different systems: switches {self.names} and {other.names}.")
        n = min(self.switch.shape[-1], other.switch.shape[-1])
        equal = (self.switch[..., :n] == other.switch[..., :n]) & jnp.all(
            self.modes[..., :n, :] == other.modes[..., :n, :], axis=-1
        )
        padding = jnp.arange(n, dtype=self.num.dtype) >= self.num[..., None]
        same = (self.num == other.num) & jnp.all(self.first == other.first, axis=-1)
        return same & jnp.all(equal | padding, axis=-1)

    def __iter__(self) -> Iterator[dict[str, int]]:
        for row in [self.first, *self.modes[: int(self.num)]]:
            yield {n: int(m) for n, m in zip(self.names, row)}

    def __str__(self) -> str:
        if jnp.ndim(self.num):
            return f"itineraries of {self.num.size} solutions, {between(self.num)} events each"
        return " -> ".join(mode_words(row, row.values()) for row in self)


def _clipped(x: Array, low: Any, high: Any) -> Array:
    """Within the bounds, and still with the derivative of `x` on them."""
    return x + jax.lax.stop_gradient(jnp.clip(x, low, high) - x)


def _shortened(text: str, most: int = 8) -> str:
    """The first and the last lines of many, under each other."""
    lines = text.splitlines()
    if len(lines) > most:
        half = most // 2
        lines = [*lines[:half], f"... {len(lines) - most} more ...", *lines[-half:]]
    return "\n          ".join(lines)


@shown
class Solution(eqx.Module, Generic[StateT]):
    """The solution of a piecewise-smooth system.

    **Attributes:**

    - `t0`, `t1`: where it starts and where it ended (before the requested end if it failed or accumulated).
    - `mode0`: the mode in which it sets out.
    - `y1`, `mode1`: the state and the mode at `t1`.
    - `ts`, `ys`, `modes`: what `saveat` asked for, in order of time, padded with infinities (modes with -128, which may
        also be a clock's: `ts` tells).
    - `events`: the event log.
    - `stats`: `num_steps`, `num_accepted_steps`, `num_rejected_steps`, `num_events`.
    - `result`: `RESULTS`; why it ended.
    - `unique`: whether it is known to be the only solution of the inclusion with static friction (|λ| <= b while it
        holds) that sets out from its start and from each of its events: of all assignments of {hold, +1, -1} to the
        `sgn` switches at their surfaces (contacts: {rest, lift off}) it took the only one in which each that holds has
        |λ| <= b and each other one moves to its side. So it is False after a start or an arrival where a surface may
        hold as well as let go (repulsion sliding, chosen by `mode`, example 2.5; static friction that holds with
        |λ| > 1), behind a two-fold (where the surface that it slides on has come to repel), and if it runs backwards
        and slides or rests. That static friction which holds goes on doing so until |λ| = b is its law, no choice; how
        elements on coinciding surfaces share their load does not count: the motion is the same. Where five or more
        switches are at their surfaces, only assignments are looked at that differ in one of them. It is False, too,
        after impacts on several contacts at one instant of which one changes the velocity at which another closes:
        they rebound in the order of their declaration. Derivatives are those among solutions of the same choice.

    - `margin`: how near it came to an event that did not happen: the least value of an indicator function (or of a
        multiplier's distance from its bound) that fell and rose again, over what an error of the state by the
        tolerance of a step makes of it. Or how nearly an event did not happen: by how much an indicator function
        would have fallen without it, h'²/(2h''), in the same units; derivatives through it are uncertain by about
        1/(2 margin) of themselves. Up to some tens the itinerary is a matter of the tolerance. Infinite where
        nothing came nearer than a tenth of its own size on a step (of `Affine`: a ten-thousandth, on an arc, and of
        events only those that its general loop works out); a surface of several components is not looked at. NaN for
        steps of a given length.

    With `SaveAt(dense=True)`, `sol(t)` is the state at a time, or at each of an array of times; see `evaluate`.
    """

    system: System
    t0: Scalar
    t1: Scalar
    mode0: Int[Array, " switches"]
    y1: StateT
    mode1: Int[Array, " switches"]
    ts: Float[Array, " times"] | None
    ys: Any
    modes: Int[Array, "times switches"] | None
    events: Events[StateT]
    stats: dict[str, Any]
    result: RESULTS
    unique: Bool[Array, ""]
    margin: Scalar
    dense: Any = None  # (end times of steps, control points) in internal time, and its direction

    def __str__(self) -> str:
        owner, stats, many = type(self.system).__name__, self.stats, jnp.ndim(self.events.num) > 0
        if many:
            count = self.events.num.size
            return (
                f"{count} solutions of {owner} from t = {between(self.t0)} to {between(self.t1)}\n"
                f"  result  {outcomes(self.result)}\n"
                f"  steps   {between(stats['num_steps'])}, events {between(stats['num_events'])}"
                + f"\n  {np.sum(~np.asarray(self.unique))} not unique"
                * (not np.all(self.unique))
            )
        modes = mode_words(self.events.names, self.mode1)
        text = (
            f"solution of {owner} from t = {float(self.t0):.10g} to {float(self.t1):.10g}\n"
            f"  result  {RESULTS[self.result]}\n"
            f"  end     {written(self.y1)}" + f"; {modes}" * bool(modes) + "\n"
            f"  steps   {int(stats['num_steps'])}, of which {int(stats['num_rejected_steps'])} rejected\n"
            f"  events  {_shortened(str(self.events)) if int(self.events.num) else 'none'}"
        )
        near = f"\n  margin  {float(self.margin):.2g} tolerances: whether a surface was met is a matter of these"
        return text + near * bool(self.margin < 100) + "\n  not the only solution: see `unique`" * (not self.unique)

    def within(self, max_events: int) -> "Solution[StateT]":
        """The same with room for `max_events` events; one that has more has failed."""
        events, num = self.events, jnp.minimum(self.events.num, max_events)
        rows = jax.tree.map(lambda x: x[:max_events], eqx.tree_at(lambda e: e.num, events, None))
        full = (events.num > max_events) & is_okay(self.result)
        result = RESULTS.where(full, RESULTS.max_events_reached, self.result)
        short = eqx.tree_at(lambda e: e.num, rows, num, is_leaf=lambda x: x is None)
        return eqx.tree_at(lambda s: (s.events, s.result), self, (short, result))

    def save(self, path: str | os.PathLike) -> None:
        """Writes the solution to a file, an `.npz` of plain arrays with a description in JSON; a batch of them too."""
        save(path, "Solution", SAVED, self.system, self.y1, {"solution": self}, result=self.result)

    @classmethod
    def load(cls, path: str | os.PathLike, system: System, y: StateT | None = None) -> "Solution[StateT]":
        """Reads what `save` wrote. Nothing in the file is executed.

        **Arguments:**

        - `path`: the file.
        - `system`: a model of the same class and shapes; the values of its parameters are taken from the file.
        - `y`: a state, to tell what states look like; needed where they are neither arrays, dictionaries, tuples nor
            NamedTuples. (The numbers do not matter, the shapes do.)

        **Raises:** `ValueError` for a file that is damaged, was not written by `save`, or is of another model.
        """
        return Archive(path, "Solution", SAVED, system, y).part("solution", result=RESULTS.successful)

    def to_xarray(self) -> Any:
        """The saved states over the dimension `time`, and the events over `event`.

        Components of the state are variables by their names, those after events `x_after`, modes `mode_belt`; the time
        of events is the coordinate `t_event`. Of a batch each has the dimension `lane` in front; rows that are there to
        fill up are NaN, and in modes -128.

        **Returns:** an `xarray.Dataset`: `pip install nsjax[data]`.
        """
        return dataset_of(self)

    @property
    def itinerary(self) -> Itinerary:
        """The modes it passes through."""
        e = self.events
        return Itinerary(self.mode0, e.switch, e.mode_after, e.num, e.names)

    def evaluate(self, t: Any, left: bool = True) -> StateT:
        """The state at any time between `t0` and `t1`.

        **Arguments:**

        - `t`: a time, or an array of them [time].
        - `left`: at an event, whether the state before it is wanted (the default) or the one after it.

        **Returns:** the state; its leaves have the shape of `t` in front. Where a time lies outside of the solution
        they are NaN.

        **Raises:** `ValueError` for a solution without dense output, and for concrete times outside of the solution.
        """
        if self.dense is None:
            raise ValueError("Dense output was not kept; call `solve` with `saveat=SaveAt(dense=True)`.")
        starts, stops, _, direction, _ = self.dense
        if stops.ndim != 1:
            raise ValueError(
                "This is a batch of solutions: evaluate them lane by lane, `jax.vmap(lambda sol: sol(t))(solutions)`."
            )
        span = self.t0, self.t1
        if not known((t, span, self.dense)):
            return _evaluated(self.dense, span, jnp.asarray(t, starts.dtype), left)
        times = np.asarray(t, starts.dtype)
        outside = _outside(*(np.asarray(x) * np.asarray(direction) for x in (times, *span)))
        if outside.any():
            wrong = np.ravel(times)[np.ravel(outside)]
            raise ValueError(
                f"Argument `t` must lie between t0 = {float(self.t0):.10g} and t1 = {float(self.t1):.10g}, but got "
                f"{wrong[0]:.10g}" + (f" and {len(wrong) - 1} other times outside." if len(wrong) > 1 else ".")
            )
        return _evaluated_alone(self.dense, span, jnp.asarray(times), left)

    def __call__(self, t: Any, left: bool = True) -> StateT:
        return self.evaluate(t, left)


SAVED = table(Solution, Events)


def _outside(s: Any, first: Any, last: Any) -> Any:
    """Which times lie outside of a solution, apart from rounding: times such as 0.1 + 0.2 are off by that."""
    slack = 4 * float(jnp.finfo(s.dtype).eps) * (abs(first) + abs(last))
    return ~((s >= first - slack) & (s <= last + slack))


def _evaluated(dense: Any, span: tuple[Scalar, Scalar], t: Array, left: bool) -> Y:
    """The states at times, from `Solution.dense` and the ends of the solution; NaN outside."""
    starts, stops, points, direction, steps = dense
    first, last = (end * direction for end in span)
    outside = _outside(t * direction, first, last)

    def at(s: Scalar) -> Y:
        i = jnp.searchsorted(stops, s, side="left" if left else "right")
        i = jnp.clip(i, 0, jnp.maximum(steps - 1, 0))
        length = stops[i] - starts[i]
        # (While impacts accumulate no step is under way: the state is the one after them.)
        u = select(length > 0, (s - starts[i]) / select(length > 0, length, 1), 1.0)
        return bernstein(jax.tree.map(lambda p: p[i], points), _clipped(u, 0, 1))

    ys = jax.vmap(at)(jnp.ravel(_clipped(t * direction, first, last)))

    def shaped(y: Array) -> Array:
        y = y.reshape(t.shape + y.shape[1:])
        # A factor makes its derivative NaN too.
        return y * select(outside.reshape(t.shape + (1,) * (y.ndim - t.ndim)), jnp.nan, 1)

    return jax.tree.map(shaped, ys)


# Called directly it is one small program: each of its operations by itself would be compiled too.
_evaluated_alone = interactive(_evaluated)
