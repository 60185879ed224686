"""The modes of y' = p + M s, s_k in Sgn(y_k), by trying every assignment: an oracle that shares nothing with nsjax."""

import itertools
from typing import NamedTuple

import numpy as np


EDGE = 1e-6  # how near to the edge of a law a case may come before it is left out


MANY = 10  # events; solutions that spiral into a corner have infinitely many


class Linear(NamedTuple):
    """Everything is constant within a mode, so that solutions are polygons, and multipliers jump at events only."""

    p: np.ndarray  # (m,)
    M: np.ndarray  # (m, m)
    b: np.ndarray  # (m,) bounds >= 1
    y0: np.ndarray  # (m,)


class Path(NamedTuple):
    mode0: tuple[int, ...]
    modes: list[tuple[int, ...]]  # after each event
    times: list[float]
    unique: bool
    result: str  # "", "repulsive" (a start that must be told a side), "open" (no assignment, or no one to prefer)


class Edge(Exception):
    """A law is neither clearly kept nor clearly broken."""


def multipliers(case: Linear, mode: tuple[int, ...]) -> np.ndarray:
    s, held = np.array(mode, float), np.array(mode) == 0
    if held.any():
        inside = case.M[np.ix_(held, held)]
        if np.linalg.cond(inside) > 1e6:
            raise Edge
        s[held] = np.linalg.solve(inside, -(case.p + case.M @ s)[held])
    return s


def velocity(case: Linear, mode: tuple[int, ...]) -> np.ndarray:
    v = case.p + case.M @ multipliers(case, mode)
    v[np.array(mode) == 0] = 0
    return v


def valid(case: Linear, mode: tuple[int, ...], at: list[int]) -> bool:
    """Whether every switch at its surface obeys its law."""
    s, v = multipliers(case, mode), velocity(case, mode)
    slack = [1 - abs(s[k]) / case.b[k] if mode[k] == 0 else mode[k] * v[k] / np.abs(case.M[k]).sum() for k in at]
    if min(map(abs, slack)) < EDGE:
        raise Edge
    return min(slack) > 0


def repels(case: Linear, mode: tuple[int, ...], k: int) -> bool:
    """Whether dh_k'/ds_k > 0 while everything else that is held stays so: by letting s_k vary, not by a formula."""
    rest = [j for j in range(len(mode)) if mode[j] == 0 and j != k]
    if not rest:
        return case.M[k, k] > 0
    follow = -np.linalg.solve(case.M[np.ix_(rest, rest)], case.M[rest, k])
    return case.M[k, k] + case.M[k, rest] @ follow > 0


def choose(case: Linear, came: list[int], at: list[int], fresh: list[int]) -> tuple[tuple[int, ...] | None, set[int]]:
    """The assignment to take for the switches `at` their surfaces, of which `fresh` came to them only now; and which of
    them have another mode in another one. `came`: the modes before, 0 for a side that is unknown."""
    found = []
    for values in itertools.product((0, 1, -1), repeat=len(at)):
        mode = list(came)
        for k, value in zip(at, values):
            mode[k] = value
        if valid(case, tuple(mode), at):
            found.append(tuple(mode))
    if not found:
        return None, set()

    def rank(mode: tuple[int, ...]) -> tuple:
        held = [k for k in at if mode[k] == 0]
        crossed = [k for k in at if mode[k] * came[k] == -1]
        kept = [k for k in held if k not in fresh]
        return not any(came[k] and repels(case, mode, k) for k in held), len(held), len(kept), len(crossed)

    best = sorted(found, key=rank)[::-1]
    if len(best) > 1 and rank(best[0]) == rank(best[1]):
        return None, set(at)
    s = multipliers(case, best[0])

    def sticks(k: int) -> bool:
        """Static friction that held before, and holds on."""
        return k not in fresh and best[0][k] == 0 and abs(s[k]) > 1

    differ = [{k for k in at if mode[k] != best[0][k] and not sticks(k)} for mode in best[1:]]
    return best[0], set().union(*differ)


def follow(case: Linear, t1: float) -> Path:
    """The solution from y0 until t1."""
    y, t = case.y0.copy(), 0.0
    mode = [int(np.sign(v)) for v in y]
    at = [k for k in range(len(y)) if y[k] == 0]
    modes, times, unique = [], [], True
    chosen, mode0 = tuple(mode), tuple(mode)
    if at:
        chosen, others = choose(case, mode, at, at)
        unique = not others
        if chosen is None:
            return Path(mode0, [], [], unique, "open")
        if any(chosen[k] == 0 and repels(case, chosen, k) for k in others):
            return Path(chosen, [], [], unique, "repulsive")
        mode0 = chosen
    while True:
        v = velocity(case, chosen)
        left = [-y[k] / v[k] if chosen[k] and y[k] * v[k] < 0 else np.inf for k in range(len(y))]
        k = int(np.argmin(left))
        if t + left[k] >= t1:
            if t + left[k] < t1 + EDGE:
                raise Edge
            return Path(mode0, modes, times, unique, "")
        if sum(other - left[k] < EDGE for other in left) > 1 or len(times) > MANY:
            raise Edge
        y, t = y + left[k] * v, t + left[k]
        y[k] = 0
        at = sorted({k} | {j for j in range(len(y)) if chosen[j] == 0})
        chosen, others = choose(case, list(chosen), at, [k])
        unique &= not others
        times.append(t)
        if chosen is None:
            return Path(mode0, modes, times, unique, "open")
        modes.append(chosen)


def generate(rng: np.random.Generator, m: int) -> Linear:
    """Friction, a few surfaces that repel alone, weak and strong coupling; static points for half of them."""
    M = rng.normal(size=(m, m)) * rng.choice([0.3, 1.0, 2.0])
    diagonal = rng.uniform(0.3, 2, m) * np.where(rng.random(m) < 0.8, -1, 1)
    M[np.diag_indices(m)] = diagonal
    if rng.random() < 0.3:
        M = -(M @ M.T) - 0.1 * np.eye(m)
    b = np.where(rng.random(m) < 0.5, 1.0, rng.uniform(1.05, 2.5, m))
    y0 = np.where(rng.random(m) < 0.5, 0.0, 0.3 * rng.normal(size=m))
    if rng.random() < 0.3:
        y0[:] = 0
    p = -M @ rng.uniform(-1.8, 1.8, m) if rng.random() < 0.6 else rng.normal(size=m)
    return Linear(p, M, b, y0)
