"""A periodic orbit cut at its events: what is given of its segments, and guesses of the rest."""

from collections.abc import Mapping, Sequence
from typing import Any, NamedTuple

import jax
import jax.lax as lax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float

from ..._numerics._compile import interactive
from ..._numerics._select import select
from ..._types import Scalar, Y
from ...derivatives._saltation import after_event
from ...derivatives._variational import arcs
from ...flow._integrator import Integrator
from ...flow._mode_flow import ModeFlow
from ...flow._results import is_okay
from ...flow._solution import Solution
from ...flow._solve import integrate
from ...system._mode import ModeState
from ...system._model import SwitchedSystem
from ...system._system import System
from .._guess import base_point
from ._itinerary import EVENT, event_slot, OrbitItinerary, REPELLING_EXIT, TIME


class Segment(NamedTuple):
    """One segment of an orbit that is sought: a guess, for `find_orbit(segments=...)`.

    **Attributes:**

    - `mode`: `{"name": value}` for each switch, or one value each; for a single switch its value.
    - `duration`: about how long it lasts [time].
    - `ends`: the name of the switch whose event ends it; not needed where the next segment differs in one mode only.
    - `free`: for a segment that slides on a surface that repels: it may be left at any point. What determines the
        orbit is that it comes onto the surface tangentially, where |λ| = 1 (section 6.7).
    """

    mode: Any
    duration: float
    ends: str | None = None
    free: bool = False


class SegmentGuess(NamedTuple):
    """What is given of an orbit: the rows are its segments. Those beyond the last are there to fill up."""

    begin: Float[Array, " rows"]  # guesses
    end: Float[Array, " rows"]
    y: Y  # at the beginnings
    itinerary: OrbitItinerary  # the last segment ends where the first begins
    free: tuple[bool, ...]  # whether it slides on a surface that repels

    def first(self, rows: int) -> "SegmentGuess":
        num, free = self.itinerary.num, self.free[:rows]
        itinerary = self.itinerary._replace(num=())
        cut = jax.tree.map(lambda x: x[:rows], self._replace(itinerary=itinerary, free=()))
        return cut._replace(itinerary=cut.itinerary._replace(num=num), free=free)


def where(rows: Array, a: Any, b: Any) -> Any:
    """Row by row."""
    return jax.tree.map(lambda a, b: select(rows.reshape((-1,) + (1,) * (a.ndim - 1)), a, b), a, b)


def cuts_of(system: System, sol: Solution, t0: Scalar, y0: Y) -> SegmentGuess:
    """The segments of a solution, up to where it was last in the mode in which it begins."""
    begin, end, y, modes = arcs(sol, t0, y0)
    model = SwitchedSystem.forwards(system, t0, y0)
    events = sol.events
    index = jnp.arange(len(begin), dtype=events.num.dtype)
    steady = modes
    if model.clocks:  # which have gone on
        steady = modes[:, np.array([k for k in range(modes.shape[1]) if k not in model.clocks], int)]
    closes = (index <= events.num) & jnp.all(steady == steady[0], axis=1)
    num = jnp.max(select(closes, index, 0))
    last = jax.tree.map(lambda a, b: jnp.concatenate([a, b[None]]), events.y_before, sol.y1)
    last = where(index < events.num, last, jax.tree.map(lambda x: jnp.broadcast_to(x, (len(begin), *x.shape)), sol.y1))

    def fill(rows: Any, value: Any) -> Any:
        return where(index <= num, rows, jax.tree.map(lambda r, v: jnp.broadcast_to(v[num], r.shape), rows, value))

    begin, end, y, modes, last = fill(begin, end), fill(end, end), fill(y, last), fill(modes, modes), fill(last, last)
    switch = jnp.append(events.switch, jnp.asarray(-1, events.switch.dtype))
    switch, free = select(index < num, switch, -1), (False,) * len(begin)
    itinerary = _itinerary(model, (begin, y), (end, last), modes, switch, num + 1, free)
    return SegmentGuess(begin, end, y, itinerary, free)


def _itinerary(
    model: SwitchedSystem,
    first: tuple[Array, Y],
    last: tuple[Array, Y],
    mode: Array,
    switch: Array,
    num: Array,
    free: tuple[bool, ...],
) -> OrbitItinerary:
    """From times and states at beginnings and ends of the segments, their modes, and the switches that end them."""
    states = jax.vmap(lambda t, y, mode: model.state_at(t, y, tuple(mode)))(*first, mode)
    zero = jnp.zeros(len(mode), jnp.int32)
    part = [zero if p is None else p for p in states.part]
    slides = jnp.asarray(free)
    # What slides on a surface that repels is at its bound where it comes onto it.
    t, y = where(slides, first, last)
    slot, entry = jax.vmap(lambda k, t, y, mode: event_slot(model, k, t, y, mode))(switch, t, y, mode)
    ends = select(slides, REPELLING_EXIT, EVENT)
    ends = select(jnp.arange(len(mode), dtype=num.dtype) == num - 1, TIME, ends).astype(jnp.int32)
    parts = jnp.stack(part, axis=1) if part else jnp.zeros((len(mode), 0), jnp.int32)
    return OrbitItinerary(mode.astype(jnp.int32), parts, ends, slot, entry, num)


def cuts_from(system: System, segments: Sequence[Segment], t0: Scalar, y0: Y, integrator: Integrator) -> SegmentGuess:
    """The segments that a user wrote down, each followed in its mode for as long as was said."""
    names = [k.name for k in system.switches]
    ticking = [k for k, switch in enumerate(system.switches) if switch.ticking]
    # What a clock has counted follows from the time and its ticks.
    modes = [tuple(0 if k in ticking else m for k, m in enumerate(_mode(names, s.mode, ticking))) for s in segments]
    if not segments:
        raise ValueError("Argument `segments` must have at least one segment.")
    if modes[0] != modes[-1]:
        raise ValueError("Argument `segments` must end in the mode in which it begins: divide the segment in which the "
                         f"orbit closes in two; but the modes are {modes[0]} and {modes[-1]}.")  # fmt: skip
    switch = []
    for i, segment in enumerate(segments[:-1]):
        changed = [n for n, a, b in zip(names, modes[i], modes[i + 1]) if a != b]
        ends = segment.ends or (changed[0] if len(changed) == 1 else None)
        if ends not in names:
            raise ValueError(
                f"Argument `segments` must say by `ends=` which switch ends segment {i} (one of {', '.join(names)}), "
                f"as the modes of {len(changed)} switches change there; but got {segment.ends!r}."
            )
        switch.append(names.index(ends))
    model = SwitchedSystem.forwards(system, t0, y0)
    for i, segment in enumerate(segments):
        slides = i < len(switch) and switch[i] in model.holdable and switch[i] not in model.contacts
        if segment.free and not (slides and modes[i][switch[i]] == 0):
            raise ValueError(f"Argument `segments` has `free=True` in segment {i}, which must slide on what it leaves.")
    mode = jnp.asarray(modes, jnp.int32)
    for k, count in model.counts(t0).items():
        passed = np.cumsum([0, *(which == k for which in switch)])
        mode = mode.at[:, k].set(count + passed.astype(np.int32))
    switch = jnp.asarray([*switch, -1], jnp.int32)
    durations = jnp.asarray([s.duration for s in segments], t0.dtype)

    def follow(carry: tuple, row: tuple) -> tuple[tuple, tuple]:
        t, y = carry
        mode, after, k, duration = row
        within = model.state_at(t, y, tuple(mode))
        y = model.project(t, y, within)
        end = t + duration
        y1 = integrate(ModeFlow(model, within), t, end, y, integrator).y1
        ending = model.state_at(end, y1, tuple(mode))
        y_next, rest = landing(model, k, end, y1, ending, tuple(after))
        return (end + rest, y_next), (t, end, y, y1)

    rows = (mode, jnp.roll(mode, -1, axis=0), switch, durations)
    _, (begin, end, y, last) = lax.scan(follow, (t0, y0), rows)
    free, num = tuple(s.free for s in segments), jnp.asarray(len(segments), jnp.int32)
    itinerary = _itinerary(model, (begin, y), (end, last), mode, switch, num, free)
    return SegmentGuess(begin, end, y, itinerary, free)


def _mode(names: list[str], mode: Any, ticking: list[int]) -> tuple[int, ...]:
    if isinstance(mode, Mapping):
        mode = {names[k]: 0 for k in ticking} | dict(mode)
        if set(mode) != set(names):
            raise ValueError(f"The mode of a segment must name each of the switches {names}, but got {dict(mode)}.")
        return tuple(int(mode[n]) for n in names)
    values = tuple(int(m) for m in mode) if isinstance(mode, Sequence) else (int(mode),)
    if len(values) != len(names):
        raise ValueError(f"The mode of a segment must have a value for each of the switches {names}, but got {mode}.")
    return values


@interactive
def cuts_near(
    system: System, t0: Scalar, y0: Y, period: Scalar, order: int, mode: Any, integrator: Integrator
) -> tuple[SegmentGuess, Bool[Array, ""]]:
    """The segments of the solution from a guess, and whether it came back to the mode in which it begins."""
    if system.period is None:
        y0, period, mode = base_point(system, t0, y0, period, 1.0, mode, integrator)
    else:
        period = jnp.asarray(system.period, t0.dtype) * order
    sol = integrate(system, t0, t0 + period, y0, integrator, mode=mode)
    cuts = cuts_of(system, sol, t0, y0)
    return cuts, is_okay(sol.result) & ((cuts.itinerary.num > 1) | (sol.events.num == 0))


def landing(model: SwitchedSystem, k: Array, t: Scalar, y: Y, ending: ModeState, after: tuple) -> tuple[Y, Scalar]:
    """The state after the event of switch k (-1: none), and the time up to the state of rest."""
    out = (y, jnp.zeros_like(t))
    for i in range(len(model.switches)):
        hit = after_event(model, i, t, y, ending, after)
        out = jax.tree.map(lambda a, b, now=k == i: select(now, a, b), hit, out)
    return out
