"""What an orbit passes through: its segments, each in a mode, and what ends them."""

import math
from functools import partial
from typing import Any, NamedTuple

import jax
import jax.flatten_util as jfu
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int

from ..._numerics._compile import interactive, on_host
from ..._numerics._select import select
from ..._types import Scalar, Y
from ...flow._solution import Events
from ...system._model import SwitchedSystem
from ...system._system import arrays_of, System
from .._orbit import Orbit


# What ends a segment: a guard falls to zero; a period has passed (of an orbit without events); a guard is least there
# (a cut that changes nothing, at which its value is watched); or nothing does: it slides on a surface that repels, onto
# which it came tangentially (section 6.7). In multiple shooting nothing happens at the end of a piece but the last of a
# segment: the next is as long.
EVENT, TIME, GRAZING, REPELLING_EXIT, PIECE = range(5)


class OrbitItinerary(NamedTuple):
    """The segments of an orbit in the order of time, cyclic: each begins where the one before it ends.

    Rows beyond the last are there to fill up, so that orbits with different itineraries are one program's.
    """

    mode: Int[np.ndarray, "rows switches"]
    part: Int[np.ndarray, "rows switches"]  # of a surface that holds the segment and has several components: which
    ends: Int[np.ndarray, " rows"]  # EVENT, TIME, GRAZING, REPELLING_EXIT or PIECE
    slot: Int[np.ndarray, " rows"]  # the guard that ends it
    entry: Int[np.ndarray, " rows"]  # and its component
    num: Int[np.ndarray, ""]

    @property
    def rows(self) -> range:
        return range(int(self.num))

    def key(self) -> tuple:
        """The same for equal itineraries, whatever segment is their first."""
        n = int(self.num)
        columns = zip(*(np.asarray(column)[:n].tolist() for column in self[:5]))
        rows = [tuple(map(str, row)) for row in columns]
        return min(tuple(rows[i:] + rows[:i]) for i in range(n))

    def take(self, rows: list[int], capacity: int) -> "OrbitItinerary":
        """These rows (which may occur several times), filled up."""
        index = np.array(rows + [rows[-1]] * (capacity - len(rows)))
        mode, part, ends, slot, entry = (np.asarray(column)[index] for column in self[:5])
        return OrbitItinerary(mode, part, ends, slot, entry, np.asarray(len(rows), np.int32))


def same_itinerary(a: OrbitItinerary, b: OrbitItinerary) -> bool:
    """Whether they are equal row by row."""
    n = int(a.num)
    return n == int(b.num) and all(np.array_equal(x[:n], y[:n]) for x, y in zip(a[:5], b[:5]))


class Start(NamedTuple):
    """An orbit with the itinerary that it takes: times and states at the beginnings and ends of its segments."""

    itinerary: OrbitItinerary
    begin: np.ndarray
    end: np.ndarray
    x: np.ndarray

    def filled(self) -> "Start":
        """With as many rows as programs are compiled for."""
        return self._replace(
            itinerary=self.itinerary.take(list(self.itinerary.rows), capacity_for(int(self.itinerary.num)))
        )


def capacity_for(segments: int) -> int:
    """Rows for a number of segments: few different capacities, because each is a program to compile."""
    return next(c for c in (4, 8, 16, 32, 64, 128, 256, 512) if c >= segments)


def slot_of(model: SwitchedSystem, k: int, holding: bool, part: int) -> int:
    return next(i for i, s in enumerate(model.slots) if (s.switch, s.holding, s.part) == (k, holding, part))


def ticks(model: SwitchedSystem, itinerary: OrbitItinerary) -> Int[np.ndarray, " switches"]:
    """Returns how often each clock ticks in one passage through an orbit, and 0 for other switches."""
    count = np.zeros(len(model.switches), np.int32)
    for i in itinerary.rows:
        if itinerary.ends[i] == EVENT and (k := model.slots[int(itinerary.slot[i])].switch) in model.clocks:
            count[k] += 1
    return count


def returning(model: SwitchedSystem, itinerary: OrbitItinerary) -> list[int]:
    """The segments that leave a surface and end on it again. Each of them may stay there for no time at all, which
    solves the equations too: where its duration vanishes the curve crosses that of such orbits, which are none."""
    found, n = [], int(itinerary.num)
    for i in range(n if model.slots and n > 1 else 0):
        end, before = (model.slots[int(itinerary.slot[j])] for j in (i, i - 1 if i else n - 1))
        free = itinerary.ends[i] == itinerary.ends[i - 1 if i else n - 1] == EVENT and not end.holding
        if free and end.switch == before.switch and (before.holding or end.part == before.part):
            found.append(i)
    return found


def nearest_parts(model: SwitchedSystem, t: Scalar, y: Y) -> Int[Array, " switches"]:
    """The component of every h that is nearest to zero."""
    each = [model.h(k, t, y) for k in range(len(model.switches))]
    nearest = [jnp.argmin(jnp.abs(jnp.stack(h))) if len(h) > 1 else jnp.zeros((), int) for h in each]
    return jnp.stack(nearest).astype(jnp.int32)


def event_slot(
    model: SwitchedSystem, k: Array, t: Scalar, y: Y, mode: Int[Array, " switches"]
) -> tuple[Int[Array, ""], Int[Array, ""]]:
    """The guard, and its component, at whose zero switch k (-1: none) has its event in `mode`: that of the component of
    h that is nearest to zero, or of the bound that the value of a switch which holds is at."""
    slot = entry = jnp.zeros((), jnp.int32)
    if not model.switches:
        return slot, entry
    parts, values = nearest_parts(model, t, y), model.values(t, y, model.state_at(t, y, tuple(mode)))
    for i, switch in enumerate(model.switches):
        first, inside = slot_of(model, i, False, 0), jnp.zeros_like(entry)
        here = first + parts[i]
        if switch.signed and model.parts[i] > 1:  # below its components are one guard
            below = mode[i] < 0
            here, inside = select(below, first, here), select(below, parts[i], 0)
        if i in model.holdable:
            up = slot_of(model, i, True, 1)
            bound = up if i in model.contacts else select(values[i] > 0, up, slot_of(model, i, True, -1))
            held = model.held(i, mode[i])
            here, inside = select(held, bound, here), select(held, 0, inside)
        slot, entry = (select(k == i, now, old).astype(jnp.int32) for now, old in ((here, slot), (inside, entry)))
    return slot, entry


class EventRecord(NamedTuple):
    """What happens to an orbit in one period: its events, with modes and states before and after each."""

    t: Float[np.ndarray, " events"]
    switch: Int[np.ndarray, " events"]
    modes: tuple[Int[np.ndarray, "events switches"], Int[np.ndarray, "events switches"]]
    states: tuple[Float[np.ndarray, "events n"], Float[np.ndarray, "events n"]]

    @classmethod
    def of(cls, log: Events) -> "EventRecord":
        n = int(log.num)
        modes, states = (log.mode_before, log.mode_after), (log.y_before, log.y_after)
        t, switch, modes, states = jax.tree.map(lambda x: np.asarray(x)[:n], (log.t, log.switch, modes, states))

        def flat(y: Y) -> np.ndarray:
            return np.concatenate([x.reshape(n, math.prod(x.shape[1:])) for x in jax.tree.leaves(y)], axis=1)

        return cls(t, switch, modes, (flat(states[0]), flat(states[1])))

    def joined(self, other: "EventRecord") -> "EventRecord":
        return jax.tree.map(lambda *rows: np.concatenate(rows), self, other)


@interactive
def _looked_at(model: SwitchedSystem, like: Y, systems: System, diaries: EventRecord) -> tuple[Array, Array, Array]:
    """At each event of each orbit its guard and the component of that; and the component of every h that is nearest to
    zero after it."""
    unravel = jfu.ravel_pytree(like)[1]

    def event(system: System, t: Scalar, switch: Array, modes: Any, rows: Any) -> tuple[Array, Array, Array]:
        here = model.with_system(system)
        before, after = map(unravel, rows)
        return *event_slot(here, switch, t, before, modes[0]), nearest_parts(here, t, after)

    return jax.vmap(lambda system, diary: jax.vmap(partial(event, system))(*diary))(systems, diaries)


def starts_of(model: SwitchedSystem, orbits: list[Orbit]) -> list[Start]:
    """The itineraries of orbits of one model that differ in its parameters, from their events."""
    diaries = [EventRecord.of(orbit.events) for orbit in orbits]
    systems = [arrays_of(orbit.system, jnp.float64) for orbit in orbits]
    at = [(float(orbit.t0), float(orbit.period), np.asarray(orbit.mode, np.int32)) for orbit in orbits]
    x0 = [np.concatenate([np.ravel(x) for x in jax.tree.leaves(orbit.y0)]) for orbit in orbits]
    return starts_from(model, orbits[0].y0, systems, diaries, [(*one, x) for one, x in zip(at, x0)])


def starts_from(
    model: SwitchedSystem, like: Y, systems: list[System], diaries: list[EventRecord], at: list[tuple]
) -> list[Start]:
    """The same from what happens in a period that begins `at` (time, period, mode, state)."""
    capacity = capacity_for(max(len(diary.t) for diary in diaries))
    eventful = [i for i, diary in enumerate(diaries) if len(diary.t)]
    seen = {}
    if eventful:

        def filled(x: np.ndarray) -> np.ndarray:
            return np.concatenate([x, np.repeat(x[-1:], capacity - len(x), axis=0)])

        rows = jax.tree.map(lambda *xs: np.stack([filled(x) for x in xs]), *[diaries[i] for i in eventful])
        stacked = jax.tree.map(lambda *xs: np.stack(xs), *[systems[i] for i in eventful])
        found = on_host(_looked_at(model, like, stacked, rows))
        seen = {i: jax.tree.map(lambda x: x[j], found) for j, i in enumerate(eventful)}
    return [
        _start(diary, seen[i], period) if i in seen else _uneventful(*at[i])
        for i, (diary, (_, period, _, _)) in enumerate(zip(diaries, at))
    ]


def _uneventful(t0: float, period: float, mode: np.ndarray, x0: np.ndarray) -> Start:
    none, one = np.zeros((1, len(mode)), np.int32), np.zeros(1, np.int32)
    itinerary = OrbitItinerary(mode[None], none, one + TIME, one, one, np.asarray(1, np.int32))
    return Start(itinerary, np.array([t0]), np.array([t0 + period]), x0[None])


def _start(diary: EventRecord, seen: tuple, period: float) -> Start:
    """From each event to the next."""
    n = len(diary.t)
    slot, entry, parts_after = (column[:n] for column in seen)
    itinerary = OrbitItinerary(
        diary.modes[1].astype(np.int32),
        parts_after,
        np.full(n, EVENT, np.int32),
        np.roll(slot, -1),
        np.roll(entry, -1),
        np.asarray(n, np.int32),
    )
    return Start(itinerary, diary.t, np.append(diary.t[1:], diary.t[0] + period), diary.states[1])
