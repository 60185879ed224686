"""Random piecewise-affine systems with functions of time that jump: `exact.py` with square waves, sawteeth and tables as
further components of z, which are affine between the ticks of their clocks and set anew at each of them."""

import bisect
from typing import NamedTuple

import exact
import numpy as np
from exact import Exact
from trajectory import Trajectory, until_sensitive


LISTED = 6  # ticks of a clock that is a list of times


class Shape(NamedTuple):
    """`plain.forced` and `plain.moving` are True: functions of time are known by more than their structure."""

    plain: exact.Shape
    clocks: tuple[str, ...]  # "periodic" or "listed"


class Clocks(NamedTuple):
    """The signals of clock i: a level, that of `levels[i]` in turn (a square wave if there are two periodic ones), and a
    ramp: the time since the last tick, over the period of a periodic clock."""

    period: np.ndarray  # (clocks,)
    offset: np.ndarray  # (clocks,)
    times: np.ndarray  # (clocks, LISTED)
    levels: np.ndarray  # (clocks, LISTED + 1)


class Case(NamedTuple):
    plain: exact.Case  # of z = (y, 1, cos ωt, sin ωt, level and ramp of each clock)
    clocks: Clocks


def generate(rng: np.random.Generator, shape: Shape) -> Case:
    """A random case; half of the surfaces jump, those of contacts never."""
    plain, n, m = shape.plain, len(shape.clocks), shape.plain.sgn + shape.plain.relay
    case, free = exact.generate(rng, plain), slice(plain.positions, plain.n)
    F, G = np.zeros((plain.n, 2 * n)), np.zeros((plain.switches, 2 * n))
    F[free] = rng.normal(size=F[free].shape) * rng.uniform(0.3, 2)
    G[:m] = 0.5 * rng.normal(size=(m, 2 * n)) * (rng.random((m, 1)) < 0.5)
    case = case._replace(
        F=np.concatenate([case.F, F], 1),
        G=np.concatenate([case.G, G], 1),
        off=np.concatenate([case.off, -G[plain.sgn : m]], 1),
        t1=np.array(rng.uniform(2, 5)),
    )
    clocks = Clocks(
        rng.uniform(0.3, 1.5, n),
        rng.uniform(-2, 2, n),
        np.cumsum(rng.uniform(0.1, 1.5, (n, LISTED)), 1) - 1,
        rng.uniform(-1, 1, (n, LISTED + 1)),
    )
    return Case(case, clocks)


class Clocked(Exact):
    """One case. Backwards, time is that of the mirrored system: y' = -f(-t, y)."""

    def __init__(self, case: Case, shape: Shape, direction: int):
        plain = case.plain
        mirrored = plain._replace(F=plain.F * direction, D=plain.D * direction, omega=plain.omega * direction)
        super().__init__(mirrored, shape.plain)
        self.kind, self.clocks, self.direction = shape.clocks, case.clocks, direction
        self.first = shape.plain.n + 3
        for i, kind in enumerate(self.kind):
            unit = self.clocks.period[i] if kind == "periodic" else 1.0
            self.base[self.first + 2 * i + 1, shape.plain.n] = direction / unit

    def span(self, i: int) -> tuple[float, float]:
        """The last and the next tick, in the time of the user."""
        period, offset, times, _ = (x[i] for x in self.clocks)
        if self.kind[i] == "periodic":
            return offset + self.count[i] * period, offset + (self.count[i] + 1) * period
        ends = [-np.inf, *times, np.inf]
        return ends[self.count[i]], ends[self.count[i] + 1]

    def next_tick(self) -> tuple[float, int]:
        spans = [self.span(i) for i in range(len(self.kind))]
        ticks = [high if self.direction > 0 else -low for low, high in spans]
        clock = int(np.argmin(ticks))
        return ticks[clock], clock

    def signal(self, i: int, t: float) -> np.ndarray:
        low, count = self.span(i)[0], self.count[i]
        if self.kind[i] == "periodic":
            return np.array([self.clocks.levels[i, count % 2], (t - low) / self.clocks.period[i]])
        return np.array([self.clocks.levels[i, count], t - (low if count else 0.0)])

    def signals(self) -> np.ndarray:
        self.count = [
            int(np.floor(-self.clocks.offset[i] / self.clocks.period[i]))
            if kind == "periodic"
            else bisect.bisect_right(self.clocks.times[i], 0.0)
            for i, kind in enumerate(self.kind)
        ]
        return np.concatenate([self.signal(i, 0.0) for i in range(len(self.kind))])

    def tick(self, z: np.ndarray, clock: int) -> np.ndarray:
        at = self.next_tick()[0] * self.direction
        self.count[clock] += self.direction
        after, first = z.copy(), self.first + 2 * clock
        after[first : first + 2] = self.signal(clock, at)
        return after

    def counts(self) -> tuple[int, ...]:
        return tuple(self.count)


def solve(case: Case, shape: Shape, direction: int = 1, max_events: int = 40) -> Trajectory | None:
    """The exact solution from time 0, up to a time before it gets sensitive, or nothing if that is at once."""
    oracle = Clocked(case, shape, direction)
    found = until_sensitive(lambda t1, cut: oracle.run(t1, max_events, cut), float(case.plain.t1))
    return None if found is None else found._replace(t1=direction * found.t1, t=direction * found.t)
