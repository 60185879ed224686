"""What an orbit passes through: its segments, each in a mode, and what ends them."""

from typing import Any, NamedTuple

import jax.flatten_util as jfu
import jax.numpy as jnp
import numpy as np
from jaxtyping import Int

from ._arcs import model_of
from ._filippov import Model
from ._orbit import Orbit
from ._saltation import states
from ._system import relay, sgn, System
from ._types import Y


# What ends a segment: a guard falls to zero; a period has passed (of an orbit without events); a guard is least there
# (a cut that changes nothing, at which its value is watched); or nothing does: it slides on a surface that repels, onto
# which it came tangentially (section 6.7).
EVENT, TIME, LEAST, FREE = range(4)


class Course(NamedTuple):
    """The segments of an orbit in the order of time, cyclic: each begins where the one before it ends.

    Rows beyond the last are there to fill up, so that orbits with different courses are one program's.
    """

    mode: Int[np.ndarray, "rows switches"]
    part: Int[np.ndarray, "rows switches"]  # of a surface that holds the segment and has several components: which
    ends: Int[np.ndarray, " rows"]  # EVENT, TIME, LEAST or FREE
    slot: Int[np.ndarray, " rows"]  # the guard that ends it
    entry: Int[np.ndarray, " rows"]  # and its component
    num: Int[np.ndarray, ""]

    @property
    def rows(self) -> range:
        return range(int(self.num))

    def key(self) -> tuple:
        """The same for equal courses, whatever segment is their first."""
        n = int(self.num)
        columns = zip(*(np.asarray(column)[:n].tolist() for column in self[:5]))
        rows = [tuple(map(str, row)) for row in columns]
        return min(tuple(rows[i:] + rows[:i]) for i in range(n))

    def take(self, rows: list[int], capacity: int) -> "Course":
        """These rows (which may occur several times), filled up."""
        index = np.array(rows + [rows[-1]] * (capacity - len(rows)))
        mode, part, ends, slot, entry = (np.asarray(column)[index] for column in self[:5])
        return Course(mode, part, ends, slot, entry, np.asarray(len(rows), np.int32))


def same_course(a: Course, b: Course) -> bool:
    """Whether they are equal row by row."""
    n = int(a.num)
    return n == int(b.num) and all(np.array_equal(x[:n], y[:n]) for x, y in zip(a[:5], b[:5]))


class Start(NamedTuple):
    """An orbit with the course that it takes: times and states at the beginnings and ends of its segments."""

    course: Course
    begin: np.ndarray
    end: np.ndarray
    x: np.ndarray

    def filled(self) -> "Start":
        """With as many rows as programs are compiled for."""
        return self._replace(course=self.course.take(list(self.course.rows), capacity_for(int(self.course.num))))


def capacity_for(segments: int) -> int:
    """Rows for so many segments: few different numbers, as each is a program to be compiled."""
    return next(c for c in (4, 8, 16, 32, 64, 128, 256, 512) if c >= segments)


def slot_of(model: Model, k: int, holding: bool, part: int) -> int:
    return next(i for i, s in enumerate(model.slots) if (s.switch, s.holding, s.part) == (k, holding, part))


def event_slot(model: Model, k: int, mode: Any, part: int, multiplier: float) -> tuple[int, int]:
    """The guard, and its component, at whose zero switch k has its event in `mode`: `part` is the component of h that
    is at zero, `multiplier` the value of the switch if it holds."""
    if k in model.holdable and mode == (1 if k in model.contacts else 0):
        return slot_of(model, k, True, 1 if k in model.contacts or multiplier > 0 else -1), 0
    if isinstance(model.switches[k], sgn) and model.parts[k] > 1 and mode < 0:
        return slot_of(model, k, False, 0), part
    return slot_of(model, k, False, 0 if isinstance(model.switches[k], relay) else part), 0


def start_of(system: System, orbit: Orbit) -> Start:
    """The course of an orbit, from its events: the segments between them."""
    log = orbit.events
    rows = [
        (float(e.t), e.switch, tuple(e.mode_before.values()), tuple(e.mode_after.values()), e.y_before, e.y_after)
        for e in log
    ]
    flat = np.asarray(jfu.ravel_pytree(orbit.y0)[0])
    return start_from(system, orbit.y0, rows, float(orbit.t0), float(orbit.period), flat, np.asarray(orbit.mode))


def start_from(
    system: System, like: Y, events: list[tuple], t0: float, period: float, x0: np.ndarray, mode: np.ndarray
) -> Start:
    """The same from rows (time, switch, mode before, mode after, state before, state after) of a whole period."""
    model = model_of(system, jnp.asarray(t0), like)
    names = [k.name for k in model.switches]
    if not events:
        none = np.zeros((1, len(names)), np.int32)
        one = np.zeros(1, np.int32)
        course = Course(np.asarray(mode, np.int32)[None], none, one + TIME, one, one, np.asarray(1, np.int32))
        return Start(course, np.array([t0]), np.array([t0 + period]), x0[None])

    def part_at(t: float, y: Y) -> list[int]:
        """The component of h nearest to zero, of each surface."""
        return [
            0 if isinstance(s, relay) else int(np.argmin(np.abs([float(h) for h in model.h(k, jnp.asarray(t), y)])))
            for k, s in enumerate(model.switches)
        ]

    modes, parts, slots, entries, begin, end, x = [], [], [], [], [], [], []
    for i, (t, _, _, after, _, y) in enumerate(events):
        last = i + 1 == len(events)
        t_next, name, before, _, y_before, _ = events[0 if last else i + 1]
        k = names.index(name)
        modes.append(after)
        parts.append(part_at(t, y))
        here = parts[-1]
        multiplier = 0.0
        if k in model.holdable:
            state = states(model, jnp.asarray(t_next), y_before, tuple(jnp.asarray(m, jnp.int32) for m in before))
            multiplier = float(model.values(jnp.asarray(t_next), y_before, state)[k])
        slot, entry = event_slot(model, k, before[k], part_at(t_next, y_before)[k], multiplier)
        slots.append(slot)
        entries.append(entry)
        parts[-1] = here
        begin.append(t)
        end.append(t_next + (period if last else 0.0))
        x.append(np.asarray(jfu.ravel_pytree(y)[0]))
    course = Course(
        np.array(modes, np.int32).reshape(len(modes), -1),
        np.array(parts, np.int32).reshape(len(modes), -1),
        np.full(len(modes), EVENT, np.int32),
        np.array(slots, np.int32),
        np.array(entries, np.int32),
        np.asarray(len(modes), np.int32),
    )
    return Start(course, np.array(begin), np.array(end), np.array(x))
