"""Random piecewise-affine systems, and their solutions by matrix exponentials: an oracle that shares nothing with nsjax.

With z = (y, 1, cos ωt, sin ωt) every mode is z' = M z, multipliers are rows times z, and so is every guard. Its first
root is found from Taylor polynomials with a bound on their curvature, so that none can be missed. Functions of time that
jump (`clocked.py`) are further components of z, affine between the ticks.
"""

import itertools
from typing import NamedTuple

import numpy as np
from scipy.linalg import expm
from trajectory import CROWDED, EDGE, first_roots, GAIN, Sensitive, Trajectory, Unsolvable, until_sensitive


DEGREE = 26  # of the Taylor polynomials, on steps with |M| h = 1.5: the remainder is below 1e-23
FLIGHT = 1e-4  # the shortest flight between impacts


class Shape(NamedTuple):
    n: int  # states; with impacts the first are positions, then as many velocities
    sgn: int
    relay: int
    impact: int
    forced: bool  # whether the field depends on time
    moving: bool  # whether the surfaces do
    rest: bool = False  # whether most impacts are plastic, so that they lead to rest at once

    @property
    def switches(self) -> int:
        return self.sgn + self.relay + self.impact

    @property
    def positions(self) -> int:
        return self.n // 2 if self.impact else 0


class Case(NamedTuple):
    """y' = F z + D s with s in the order sgn, relay, impact; h = G z, and `off` z for the way back of the relays."""

    F: np.ndarray  # (n, n + 3)
    D: np.ndarray  # (n, switches)
    G: np.ndarray  # (switches, n + 3)
    off: np.ndarray  # (relays, n + 3)
    bound: np.ndarray  # (sgn,)
    e: np.ndarray  # (impacts,)
    omega: np.ndarray
    y0: np.ndarray
    t1: np.ndarray


def generate(rng: np.random.Generator, shape: Shape) -> Case:
    """A random case: half of them with little coupling of the switches, a few surfaces repulsive, b > 1 for half."""
    n, (m, r, c) = shape.n, shape[1:4]
    width = n + 3
    F, D, G = np.zeros((n, width)), np.zeros((n, m + r + c)), np.zeros((m + r + c, width))
    pairs = shape.positions
    free = slice(pairs, n)  # equations of motion are second order: what acts, acts on velocities
    A = rng.normal(size=(n, n)) * rng.choice([0.3, 1.0]) / np.sqrt(n) - rng.uniform(0.1, 1) * np.eye(n)
    if pairs:
        A[free, :pairs] -= np.diag(rng.uniform(0.5, 8, pairs))[: n - pairs]
        A[:pairs] = 0
        A[:pairs, pairs : 2 * pairs] = np.eye(pairs)
    elif n > 1 and rng.random() < 0.7:  # something that turns
        A[0, 1] += rng.uniform(1, 4)
        A[1, 0] -= rng.uniform(1, 4)
    F[:, :n] = A
    F[free, n] = rng.normal(size=n - pairs)
    if shape.forced:
        F[free, n + 1 :] = rng.normal(size=(n - pairs, 2)) * rng.uniform(0.2, 3)
    coupling = rng.choice([0.2, 1.0])
    for k in range(m + r):
        normal = rng.normal(size=n) * (rng.random(n) < 0.6)
        normal[pairs + rng.integers(n - pairs)] = rng.choice([-1, 1]) * rng.uniform(0.5, 2)
        G[k, :n], G[k, n] = normal, 0.5 * rng.normal()
        if shape.moving:
            G[k, n + 1 :] = 0.5 * rng.normal(size=2)
        push = coupling * rng.normal(size=n)
        if k < m:
            push -= rng.uniform(0.5, 2) * normal / (normal[free] @ normal[free])
            if normal[free] @ push[free] > 0 and rng.random() < 0.8:
                push = -push
        D[free, k] = push[free] * (1 if k < m else 3)
    off = -G[m : m + r].copy()
    off[:, n] -= rng.uniform(0.3, 1.5, r)
    weight = rng.uniform(0.5, 2, pairs)
    for k in range(m + r, m + r + c):
        normal = np.zeros(pairs)
        normal[(k - m - r) % pairs] = rng.choice([-1, 1])
        if rng.random() < 0.3 and pairs > 1:
            normal[(k - m - r + 1) % pairs] = rng.choice([-1, 1]) * rng.uniform(0.3, 1)
        G[k, :pairs], G[k, n] = normal, rng.uniform(0.2, 1)
        if shape.moving:
            G[k, n + 1 :] = 0.15 * rng.normal(size=2)
        D[pairs : 2 * pairs, k] = normal * weight
    e = rng.uniform(0.3, 0.9, c) * (rng.random(c) < 0.2 if shape.rest else 1)
    y0 = rng.normal(size=n)
    if pairs:
        y0[:pairs] *= 0.1
        for k in range(m + r, m + r + c):  # inside, with room
            G[k, n] = max(G[k, n], 0.1 - G[k] @ np.concatenate([y0, [0, 1, 0]]))
    bound = np.where((rng.random(m) < 0.5) & (np.sum(G[:m, :n].T * D[:, :m], 0) < 0), rng.uniform(1.05, 2, m), 1.0)
    return Case(F, D, G, off, bound, e, np.array(rng.uniform(0.5, 4)), y0, np.array(rng.uniform(3, 8)))


class _Field(NamedTuple):
    """One mode: z' = M z, the guards that watch it, and what is needed to look for their roots."""

    M: np.ndarray
    L: np.ndarray  # multipliers: rows of the switches that hold, zero for the others
    guards: tuple[tuple[int, int], ...]  # (switch, sign of the bound of λ or 0 for its surface)
    rows: np.ndarray
    h: float
    step: np.ndarray  # exp(M h)
    taylor: np.ndarray  # (guards, DEGREE + 1, n + 3): coefficients per component of z


class Exact:
    """One case, and its modes as they are met."""

    def __init__(self, case: Case, shape: Shape):
        self.case, self.shape = case, shape
        self.size = case.F.shape[1]
        self.kinds = ["sgn"] * shape.sgn + ["relay"] * shape.relay + ["impact"] * shape.impact
        self.base = np.zeros((self.size, self.size))
        self.base[: shape.n] = case.F
        self.base[shape.n + 1, shape.n + 2], self.base[shape.n + 2, shape.n + 1] = -case.omega, case.omega
        self.D = np.zeros((self.size, shape.switches))
        self.D[: shape.n] = case.D
        # What a multiplier keeps constant: h of a sliding switch, dh/dt of a contact (nothing but velocities).
        self.level = np.stack([g @ self.base if kind == "impact" else g for kind, g in zip(self.kinds, case.G)])
        self.fields: dict[tuple, _Field] = {}
        self.laws: dict[tuple, tuple] = {}

    def law(self, mode: tuple) -> tuple[np.ndarray, np.ndarray]:
        """M and the rows of the multipliers, from n_i . (F z + Σ s d + Σ λ d) = 0 for those that slide or rest."""
        if mode in self.laws:
            return self.laws[mode]
        M, L = self.base.copy(), np.zeros((len(mode), self.size))
        values = [0 if kind == "impact" else s for kind, s in zip(self.kinds, mode)]
        M[:, self.shape.n] += self.D @ np.array(values, float)
        holds = [k for k in range(len(mode)) if self.holds(k, mode)]
        if holds:
            matrix = self.level[holds] @ self.D[:, holds]
            if np.linalg.cond(matrix) > 1e4:
                raise Sensitive("singular")
            L[holds] = np.linalg.solve(matrix, -self.level[holds] @ M)
            M = M + self.D @ L
        self.laws[mode] = M, L
        return M, L

    def holds(self, k: int, mode: tuple | list) -> bool:
        return mode[k] == {"sgn": 0, "relay": None, "impact": 1}[self.kinds[k]]

    def field(self, mode: tuple) -> _Field:
        if mode in self.fields:
            return self.fields[mode]
        M, L = self.law(mode)
        guards, rows = [], []
        for k, kind in enumerate(self.kinds):
            if kind == "sgn" and mode[k] == 0:
                for sign in (1, -1):
                    row = -sign * L[k]
                    row[self.shape.n] += self.case.bound[k]
                    guards.append((k, sign))
                    rows.append(row)
                continue
            if kind == "impact" and mode[k]:
                guards.append((k, 1))
                rows.append(L[k])
                continue
            guards.append((k, 0))
            if kind == "sgn":
                rows.append(mode[k] * self.case.G[k])
            elif kind == "relay":
                rows.append(-self.case.off[k - self.shape.sgn] if mode[k] else -self.case.G[k])
            else:
                rows.append(self.case.G[k])
        rows = np.stack(rows)
        h = 1.5 / np.linalg.norm(M, 2)
        taylor = [rows]
        for j in range(1, DEGREE + 1):
            taylor.append(taylor[-1] @ M * (h / j))
        self.fields[mode] = _Field(M, L, tuple(guards), rows, h, expm(M * h), np.stack(taylor, 1))
        return self.fields[mode]

    def settle(self, z: np.ndarray, mode: tuple, here: set[int], leaves: dict[int, int]) -> tuple:
        """The assignment of stick and slip to the switches at their surfaces that satisfies all laws, by trying all."""
        valid = []
        at = sorted(here)
        options = []
        for k in at:
            if self.kinds[k] == "impact":
                options.append((0,) if k in leaves else (1, 0))
                continue
            options.append((1, -1) if k in leaves else (0, 1, -1))
        for choice in itertools.product(*options):
            trial = list(mode)
            for k, s in zip(at, choice):
                trial[k] = s
            M, L = self.law(tuple(trial))
            slack = []
            for k, s in zip(at, choice):
                if self.kinds[k] == "impact":
                    if k not in leaves:  # it pushes, or h'' > 0
                        slack.append(L[k] @ z if s else self.level[k] @ M @ z)
                elif s == 0:
                    slack.append(1 - abs(L[k] @ z) / self.case.bound[k])
                elif k in leaves and self.pull(k, tuple(trial)) < 0 and self.case.bound[k] == 1:
                    slack.append(1.0 if s == leaves[k] else -1.0)  # dh/dt = 0 at this instant
                else:
                    slack.append(s * (self.case.G[k] @ M @ z))
            least = min(slack, default=1.0)
            if abs(least) < EDGE:
                raise Sensitive("at the edge of sliding")
            if least > 0:
                valid.append(tuple(trial))
        if not valid:
            raise Unsolvable

        # With b > 1, or where a surface repels, stick and slip may both be possible; then it sticks, but for what
        # arrives at a surface that repels; and of others it keeps what stuck, and crosses.
        def rank(trial: tuple) -> tuple:
            arrived = [k for k in at if self.kinds[k] == "sgn" and mode[k] != 0]
            stuck = [k for k in at if self.holds(k, trial)]
            repelled = any(trial[k] == 0 and self.pull(k, trial) > 0 for k in arrived)
            kept, crossed = (
                sum(test) for test in ([self.holds(k, mode) for k in stuck], [trial[k] == -mode[k] for k in arrived])
            )
            return not repelled, len(stuck), kept, crossed

        best = sorted(valid, key=rank)
        if len(best) > 1 and rank(best[-1]) == rank(best[-2]):
            raise Sensitive("not unique")
        return best[-1]

    def pull(self, k: int, mode: tuple) -> float:
        """What the value of a switch adds to dh/dt while all others that hold do so: below 0 if its surface attracts."""
        others = [j for j in range(len(mode)) if self.holds(j, mode) and j != k]
        effect = self.level[[k, *others]] @ self.D[:, [k, *others]]
        if not others:
            return effect[0, 0]
        return effect[0, 0] - effect[0, 1:] @ np.linalg.solve(effect[1:, 1:], effect[1:, 0])

    def next_root(self, field: _Field, z: np.ndarray, limit: float, known: dict) -> tuple[float, tuple[int, int]]:
        """The first event of an arc no longer than `limit`: after how long, and of which guard."""
        gone = 0.0
        while gone < limit:
            c = field.taylor @ z
            if gone == 0:
                for i, guard in enumerate(field.guards):
                    if guard in known:
                        c[i] = np.concatenate([c[i, known[guard] :], np.zeros(known[guard])])
            try:
                roots = gone + field.h * first_roots(c, (limit - gone) / field.h)
            except Sensitive as problem:
                raise Sensitive(problem.args[0], gone + problem.args[1] * field.h) from None
            first = np.sort(roots)
            if first[0] < np.inf:
                if len(first) > 1 and first[1] - first[0] < CROWDED:
                    raise Sensitive("simultaneous", first[0])
                return first[0], field.guards[int(np.argmin(roots))]
            z = field.step @ z
            gone += field.h
        return np.inf, (-1, 0)

    def start(self) -> tuple[np.ndarray, tuple]:
        z = np.concatenate([self.case.y0, [1, 1, 0], self.signals()])
        h = self.case.G @ z
        mode = [0] * len(h)
        for k, kind in enumerate(self.kinds):
            if kind == "sgn":
                mode[k] = int(np.sign(h[k]))
            elif kind == "relay":
                mode[k] = int(h[k] > 0)
        return z, tuple(mode)

    def jump(self, z: np.ndarray, mode: list, k: int, at: set[int]) -> tuple[np.ndarray, list[int]]:
        """Newton's law at impact k, h'(t+) = -e h'(t-), as a matrix, and the relays that it switches; `mode` and `at`
        are brought up to date."""
        rate, push = self.level[k], self.D[:, k]
        R = np.eye(self.size) - (1 + self.case.e[k - self.shape.sgn - self.shape.relay]) * np.outer(push, rate) / (
            rate @ push
        )
        for j, kind in enumerate(self.kinds):
            if kind == "impact" and mode[j] == 1 and self.level[j] @ push != 0:
                raise Sensitive("impact on what rests")
        return R, self.carried(R @ z, push, mode, at)

    def carried(self, after: np.ndarray, push: np.ndarray, mode: list, at: set[int]) -> list[int]:
        """The relays that switch where z jumps in the components in which `push` is not zero; `mode` and `at` are
        brought up to date: what is carried off a surface, or across it, is on the side where it then is."""
        toggled = []
        for j, kind in enumerate(self.kinds):
            if not np.any(self.case.G[j] * push):
                continue
            if kind == "sgn":
                h = self.case.G[j] @ after
                if abs(h) < 1e-6:
                    raise Sensitive("simultaneous")
                mode[j] = int(np.sign(h))
                at.discard(j)
            elif kind == "relay":
                h = (self.case.off[j - self.shape.sgn] if mode[j] else self.case.G[j]) @ after
                if abs(h) < 1e-6:
                    raise Sensitive("simultaneous")
                if h > 0:
                    mode[j] = 1 - mode[j]
                    toggled.append(j)
        return toggled

    def signals(self) -> np.ndarray:
        """The functions of time that jump, at the start."""
        return np.zeros(0)

    def next_tick(self) -> tuple[float, int]:
        """When functions of time jump next, and which clock does it."""
        return np.inf, -1

    def tick(self, z: np.ndarray, clock: int) -> np.ndarray:
        """z after it."""
        raise NotImplementedError

    def counts(self) -> tuple[int, ...]:
        """How often each clock has ticked."""
        return ()

    def run(self, t1: float, max_events: int, cut: str) -> Trajectory:
        z, mode = self.start()
        n = self.shape.n
        t, last_hit, known = 0.0, {}, {}
        times, switches, modes, gains = [], [], [], []
        # From the start, and from every event, until now: how errors made there have grown.
        growth = np.eye(self.size)[None]
        if np.min(abs(self.case.G @ z)) < 1e-6:
            raise Sensitive("start", 0.0)
        ends = ""
        while True:
            field, (tick, clock) = self.field(mode), self.next_tick()
            stop = min(t1, tick)
            try:
                length, (k, sign) = self.next_root(field, z, stop + CROWDED - t, known)
            except Sensitive as problem:
                raise Sensitive(problem.args[0], t + (problem.args[1] if len(problem.args) > 1 else 0)) from None
            if t + length < stop + CROWDED and t + length >= stop or abs(tick - t1) < CROWDED:
                raise Sensitive("at the end", stop)
            ticks = t + length > stop
            length = stop - t if ticks else length
            flow = expm(field.M * length)
            z, growth, t = flow @ z, flow @ growth, stop if ticks else t + length
            if t == t1:
                if np.max(np.linalg.norm(growth[:, :n, :n], axis=(1, 2))) > GAIN:
                    raise Sensitive("chaos", t)
                break
            at = {j for j in range(len(mode)) if self.holds(j, mode)}
            leaves, R, toggled, new = {}, np.eye(self.size), [], list(mode)
            if ticks:
                k, sign, row = self.shape.switches + clock, 0, np.zeros(self.size)
                gains.append(0.0)
            else:
                row, before = field.rows[field.guards.index((k, sign))], field.M @ z
                gains.append(np.sum(np.linalg.norm(row @ growth, axis=-1)) / abs(row @ before))
            try:
                if length < CROWDED and times:
                    raise Sensitive("crowded")
                if len(times) >= max_events:
                    raise Sensitive("many events")
                if ticks:
                    jumped = self.tick(z, clock)
                    toggled = self.carried(jumped, jumped != z, new, at)
                    R[:, n] += jumped - z  # (its value is 1)
                elif sign:
                    leaves[k] = sign  # (what rests leaves whatever that is)
                elif self.kinds[k] == "sgn":
                    at.add(k)
                elif self.kinds[k] == "relay":
                    new[k] = 1 - mode[k]
                else:
                    if t - last_hit.get(k, -1) < FLIGHT:
                        raise Sensitive("accumulation")
                    last_hit[k] = t
                    R, toggled = self.jump(z, new, k, at)
                    if self.case.e[k - self.shape.sgn - self.shape.relay] == 0:
                        at.add(k)
                after = self.settle(R @ z, tuple(new), at, leaves)
            except Sensitive as problem:
                raise Sensitive(problem.args[0], t) from None
            except Unsolvable:
                times, switches, modes = [*times, t], [*switches, k], [*modes, (*mode, *self.counts())]
                ends = "no mode"
                break
            known = {(j, 0): 1 for j in at if self.kinds[j] == "sgn" and after[j] != 0}
            if not ticks and self.kinds[k] == "impact":
                known[k, 0] = 3 if sign else 2 if k in at else 1
            elif sign and self.case.bound[k] == 1:
                known[k, 0] = 2
            S = R if ticks else R + np.outer(self.law(after)[0] @ R @ z - R @ before, row) / (row @ before)
            z, mode = R @ z, after
            growth = np.concatenate([S @ growth, np.eye(self.size)[None]])
            if np.max(np.linalg.norm(growth[:, :n, :n], axis=(1, 2))) > GAIN:
                raise Sensitive("chaos", t)
            for j in (k, *toggled):
                times, switches, modes = [*times, t], [*switches, j], [*modes, (*mode, *self.counts())]
            gains += [gains[-1]] * len(toggled)
        counts = self.counts()
        return Trajectory.of(t, times, switches, modes, z[:n], (*mode, *counts), growth[:, :n, :n], gains, ends, cut)


def solve(case: Case, shape: Shape, max_events: int = 40) -> Trajectory | None:
    """The exact solution; up to a time before it gets sensitive, or nothing if that is at once."""
    exact = Exact(case, shape)
    return until_sensitive(lambda t1, cut: exact.run(t1, max_events, cut), float(case.t1))
