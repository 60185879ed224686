"""What references for random systems share: their trajectories, roots of guards of which none can be missed, the end of
the interval before the solution gets sensitive, and what counts as wrong in a solution that is compared with them."""

import collections
import functools
from collections.abc import Callable
from typing import NamedTuple

import numpy as np
from models import pid

from nsjax import RESULTS, solve


EPS = 1e-7  # how near to a tangency, or to another event, a guard may come before the case is called sensitive
CROWDED = 1e-6  # the shortest time between events
EDGE = 1e-5  # how near to a change of mode the laws of an event may be
GAIN = 1e6  # the largest amplification of errors
TOLERANCE = 1e-8  # of what is compared, times what errors grow by


class Trajectory(NamedTuple):
    t1: float
    t: np.ndarray  # (events,)
    switch: np.ndarray  # (events,)
    modes: np.ndarray  # (events, switches), after each
    y1: np.ndarray
    mode1: np.ndarray
    jacobian: np.ndarray
    gain: float  # how much an error made on the way, or in an event time, may grow until t1
    gains: np.ndarray  # the same for the time of each event
    ends: str  # "" at t1; else "no mode": no assignment of stick and slip satisfies the laws at the last event
    cut: str  # why t1 was moved before an event that is too sensitive

    @classmethod
    def of(cls, t1, times, switches, modes, y1, mode1, growth, gains, ends, cut):
        """From lists of what happened; `growth` holds the derivatives from the start and from each event on."""
        return cls(
            t1,
            np.array(times),
            np.array(switches, int),
            np.array(modes, int).reshape(len(times), len(mode1)),
            np.array(y1),
            np.array(mode1),
            growth[0],
            float(np.sum(np.linalg.norm(growth, axis=(1, 2)))),
            np.array(gains),
            ends,
            cut,
        )


class Sensitive(Exception):
    """The solution here depends on digits that a numerical method does not have: why, and at what time."""


class Unsolvable(Exception):
    """No assignment of stick and slip is consistent."""


def until_sensitive(run: Callable[[float, str], Trajectory], t1: float) -> Trajectory | None:
    """The solution up to a time before it gets sensitive, or nothing if that is at once."""
    cut = ""
    for _ in range(8):
        try:
            return run(t1, cut)
        except Sensitive as problem:
            cut = problem.args[0]
            t1 = problem.args[1] - 10**-1.5
            if t1 < 0.1:
                return None
    return None


class _Look(NamedTuple):
    """Weights of the first look at polynomials on [0, 1]."""

    values: np.ndarray
    slopes: np.ndarray
    bend: np.ndarray


# Nodes of the first look, and the half width of the interval that each stands for.
_HALF = 1 / 16
_NODES = _HALF * (2 * np.arange(8) + 1)


@functools.cache
def _look(degree: int) -> _Look:
    j = np.arange(degree + 1)
    return _Look(_NODES[:, None] ** j, j * _NODES[:, None] ** np.maximum(j - 1, 0), j * (j - 1.0))


def first_roots(c: np.ndarray, before: float = np.inf) -> np.ndarray:
    """The first root of each row's polynomial Σ c_j u^j, j = 0 to d, on [0, 1]; infinite where there is none, or none
    that needs to be looked for `before` some u. Each is positive at the start.

    **Arguments:**

    - `c`: coefficients, of shape (guards, d + 1).

    **Raises:** `Sensitive`, with the u from where on, if a root is too near to another one.
    """
    look = _look(c.shape[1] - 1)
    bend = abs(c) @ look.bend
    low = c @ look.values.T - abs(c @ look.slopes.T) * _HALF - 0.5 * bend[:, None] * _HALF**2
    roots = np.full(len(c), np.inf)
    for i in np.flatnonzero(low.min(1) <= EPS):
        begin = 2 * _HALF * np.argmax(low[i] <= EPS)
        if begin < before:
            try:
                roots[i] = _root(c[i], begin, bend[i])
            except Sensitive as problem:
                raise Sensitive(problem.args[0], begin) from None
    return roots


def _root(c: np.ndarray, begin: float, bend: float) -> float:
    """The first root on [begin, 1] of Σ c_j u^j, which is positive before; infinite if there is none.

    An interval is left behind only if midpoint value, slope and curvature bound exclude that p <= EPS on it.
    """
    power = c[::-1]
    slope = np.polyder(power)
    stack = [(begin, 1.0)]
    while stack:
        a, b = stack.pop()
        middle, half = 0.5 * (a + b), 0.5 * (b - a)
        value, rate = np.polyval(power, middle) - EPS, np.polyval(slope, middle)
        if value - abs(rate) * half - 0.5 * bend * half**2 > 0:
            continue
        if abs(rate) <= bend * half:
            if half < 1e-9:
                raise Sensitive("tangency")
            stack += [(middle, b), (a, middle)]
        elif rate > 0:  # rises all along: so it was below EPS before
            if np.polyval(power, a) < EPS:
                raise Sensitive("tangency")
        elif np.polyval(power, b) <= EPS:  # falls all along: Newton's method from where the root certainly is ahead
            u = a
            for _ in range(60):
                step = np.polyval(power, u) / np.polyval(slope, u)
                u = min(max(u - step, a), b + half)
                if abs(step) < 1e-16:
                    break
            # The root is simple enough for the next one not to matter: p > EPS / 2 until here, and p < 0 soon after.
            if np.polyval(slope, u) ** 2 < 4 * bend * EPS or abs(np.polyval(power, u)) > 1e-13 * (1 + sum(abs(c))):
                raise Sensitive("tangency")
            return u
    return np.inf


class Solved(NamedTuple):
    """What is compared, of one solution, or a batch of them."""

    t: np.ndarray
    switch: np.ndarray
    modes: np.ndarray
    y1: np.ndarray
    mode1: np.ndarray
    jacobian: np.ndarray | None
    solved: np.ndarray
    ambiguous: np.ndarray

    @classmethod
    def of(cls, sol, jacobian=None):
        events = sol.events
        solved, ambiguous = (sol.result == what for what in (RESULTS.successful, RESULTS.ambiguous_event))
        return cls(events.t, events.switch, events.mode_after, sol.y1, sol.mode1, jacobian, solved, ambiguous)


def tightly(system, t1, y0, solver, max_events: int):
    """The solution that is compared with a reference of at most `max_events` events: with room for a few more."""
    return solve(
        system,
        0.0,
        t1,
        y0,
        solver=solver,
        stepsize_controller=pid(1e-10),
        max_events=max_events + 8,
        throw=False,
    )


def compare(truth: Trajectory, got: Solved) -> str:
    """Empty if they agree, else in what they do not. What may be off grows with what errors grow by."""
    t, switch, modes, y1, mode1, jacobian, solved, _ = got
    if not solved:
        return ""
    if truth.ends:
        return truth.ends
    number = int(np.sum(np.isfinite(t)))
    t, switch, modes = t[:number], switch[:number], modes[:number]
    if number != len(truth.t) or np.any(switch != truth.switch):
        return "events"
    # Of events at one instant only the last leaves a mode that lasts.
    lasts = np.append(np.diff(truth.t) != 0, True)[:number]
    if np.any((modes != truth.modes)[lasts]) or np.any(mode1 != truth.mode1):
        return "modes"
    if not np.all(abs(t - truth.t) <= TOLERANCE * (1 + truth.gains)):
        return "times"
    if not np.max(abs(y1 - truth.y1)) <= TOLERANCE * (1 + truth.gain):
        return "state"
    if jacobian is not None and not np.max(abs(jacobian - truth.jacobian)) <= TOLERANCE * (1 + truth.gain) ** 2:
        return "derivative"
    return ""


def count(truths: list[Trajectory | None], batch: Solved, label: tuple) -> tuple[collections.Counter, list]:
    """How many cases agree, are told by a status, are too sensitive to compare; and those that are wrong."""
    tally, wrong = collections.Counter(), []
    for i, truth in enumerate(truths):
        if truth is None:
            tally["sensitive"] += 1
            continue
        got = Solved(*(None if x is None else x[i] for x in batch))
        difference = compare(truth, got)
        kind = "wrong" if difference else "agreed" if got.solved else "told"
        tally[kind] += 1
        if kind == "told" and not truth.ends:
            tally["needlessly told"] += 1
            tally["needlessly told ambiguous"] += bool(got.ambiguous)
        tally["cut short"] += truth.cut != ""
        tally["events"] += len(truth.t)
        if difference:
            wrong.append((*label, i, difference))
    return tally, wrong


def share(tally: collections.Counter, key: str) -> float:
    return tally[key] / sum(tally[kind] for kind in ("agreed", "told", "sensitive", "wrong"))


def told_but_ambiguous(tally: collections.Counter) -> int:
    """How many that have a solution were not solved, for another reason than that no mode was found. (With strong
    coupling of switches the search for one may fail, but says so.)"""
    return tally["needlessly told"] - tally["needlessly told ambiguous"]


def assert_slopes_agree(generate, solve, number: int, least: int) -> None:
    """The derivatives of a reference, from saltation matrices, are those of its solutions: of so many cases, at least
    so many of which can be compared."""
    rng, compared = np.random.default_rng(0), 0
    for _ in range(number):
        case = generate(rng)
        truth = solve(case)
        if truth is None or truth.ends or truth.gain > 1e3:
            continue
        step = 1e-5 * rng.normal(size=len(case.y0)) / truth.gain
        ends = [solve(case._replace(y0=case.y0 + s * step, t1=truth.t1)) for s in (1, -1)]
        if all(end is not None and not end.cut and len(end.t) == len(truth.t) for end in ends):
            slope = (ends[0].y1 - ends[1].y1) / 2
            np.testing.assert_allclose(slope, truth.jacobian @ step, atol=1e-3 * np.linalg.norm(step), rtol=1e-3)
            compared += 1
    assert compared >= least
