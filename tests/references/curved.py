"""Random systems whose guards and fields are not affine, and their solutions by Taylor series on integers that stand for
numbers of 36 decimal places: an oracle that shares nothing with nsjax.

Fields and guards are combinations of features: 1, the state, products, cubes and sines of it, and cos ωt, sin ωt. The
series of a feature follow from that of the state by recurrences, and so, order by order, does that of the multipliers
that keep h at zero while the solution slides. Steps are a tenth of the radius of convergence, and the first root of the
guards on a step is isolated on their polynomials.
"""

import functools
import itertools
from operator import mul
from typing import NamedTuple

import mpmath
import numpy as np
from trajectory import CROWDED, EDGE, first_roots, GAIN, Sensitive, Trajectory, Unsolvable, until_sensitive


ORDER = 28  # of the series
BITS = 120  # behind the point
ONE = 1 << BITS
LEFT = 1e-26  # the size of the last terms of a series, on the step that is taken
STEP = 0.25  # the longest
SINES = 3
NEAR = 1e-6  # differences for derivatives, of which a per mille will do

_mp = mpmath.mp.clone()
_mp.prec = 200


class Shape(NamedTuple):
    n: int  # states
    sgn: int
    forced: bool  # whether the field depends on time
    moving: bool  # whether the surfaces do

    @property
    def features(self) -> int:
        """1, y, products of neighbours, y |y|², sines, cos ωt, sin ωt."""
        return 1 + 3 * self.n + SINES + 2


class Case(NamedTuple):
    """With z the features: y' = (F + Σ s_k D_k) z and h = G z."""

    F: np.ndarray  # (n, features)
    D: np.ndarray  # (sgn, n, features)
    G: np.ndarray  # (sgn, features)
    W: np.ndarray  # (SINES, n): wave vectors of the sines
    phase: np.ndarray  # (SINES,)
    bound: np.ndarray  # (sgn,)
    omega: np.ndarray
    y0: np.ndarray
    t1: np.ndarray


def generate(rng: np.random.Generator, shape: Shape) -> Case:
    """A random case. What bends is of the size of what does not; cubic damping keeps the state bounded."""
    n, m, width = shape.n, shape.sgn, shape.features
    linear, product, cubic = slice(1, 1 + n), slice(1 + n, 1 + 2 * n), slice(1 + 2 * n, 1 + 3 * n)
    sine, wave = slice(1 + 3 * n, 1 + 3 * n + SINES), slice(width - 2, width)

    def sparse(*size: int) -> np.ndarray:
        return rng.normal(size=size) * (rng.random(size) < 0.4)

    F, D, G = np.zeros((n, width)), np.zeros((m, n, width)), np.zeros((m, width))
    F[:, 0] = 0.5 * rng.normal(size=n)
    F[:, linear] = 0.5 * rng.normal(size=(n, n)) / np.sqrt(n)
    F[0, 2] += rng.uniform(1, 4)
    F[1, 1] -= rng.uniform(1, 4)
    F[:, product] = sparse(n, n)
    F[:, cubic] = -np.diag(rng.uniform(0.1, 0.5, n))
    F[:, sine] = sparse(n, SINES)
    if shape.forced:
        F[:, wave] = rng.normal(size=(n, 2)) * rng.uniform(0.2, 2)
    coupling = rng.choice([0.2, 0.7])
    for k in range(m):
        normal = rng.normal(size=n) * (rng.random(n) < 0.6)
        normal[rng.integers(n)] = rng.choice([-1, 1]) * rng.uniform(0.5, 2)
        G[k, 0], G[k, linear] = 0.4 * rng.normal(), normal
        G[k, product], G[k, cubic], G[k, sine] = 0.3 * sparse(n), 0.1 * sparse(n), 0.3 * sparse(SINES)
        if shape.moving:
            G[k, wave] = 0.3 * rng.normal(size=2)
        push = coupling * rng.normal(size=n) - rng.uniform(0.7, 2.5) * normal / (normal @ normal)
        if normal @ push > 0 and rng.random() < 0.9:
            push = -push
        D[k, :, 0] = push
        D[k][:, product], D[k][:, sine] = 0.15 * sparse(n, n), 0.15 * sparse(n, SINES)
    bound = np.where(rng.random(m) < 0.4, rng.uniform(1.05, 2, m), 1.0)
    W, phase = rng.normal(size=(SINES, n)), rng.uniform(0, 2 * np.pi, SINES)
    t1 = rng.uniform(2, 5)
    return Case(F, D, G, W, phase, bound, np.array(rng.uniform(0.5, 4)), rng.normal(size=n), np.array(t1))


def fixed(x: float) -> int:
    above, below = float(x).as_integer_ratio()
    return (above << BITS) // below


class _Jet:
    """The series of all features along a solution, of which that of the state is given order by order."""

    def __init__(self, oracle: "Curved", t: int):
        self.n, self.W, self.phase = oracle.shape.n, oracle.W, oracle.phase
        n, forced = self.n, oracle.timed
        self.z: list[list[int]] = [[] for _ in range(oracle.shape.features)]
        self.z[0] = [ONE, *[0] * ORDER]
        self.square: list[int] = []
        self.slope: list[list[int]] = [[] for _ in range(SINES + forced)]  # of the arguments of the sines
        self.cosine: list[list[int]] = [[] for _ in range(SINES)]
        self.angle = (oracle.omega * t >> BITS, oracle.omega) if forced else None
        # Arguments, sines, cosines.
        sines = self.z[1 + 3 * n : 1 + 3 * n + SINES]
        self.turns = list(zip(self.slope, sines, self.cosine))
        if forced:
            self.turns.append((self.slope[-1], self.z[-1], self.z[-2]))
        self.all = [*self.z[1:], self.square, *self.slope, *self.cosine]

    def extend(self, y: list[int]) -> None:
        """The next order of everything."""
        n, z, k = self.n, self.z, len(self.z[1])
        state = z[1 : 1 + n]
        for series, x in zip(state, y):
            series.append(x)
        back = [x[::-1] for x in state]
        for i in range(n):
            z[1 + n + i].append(sum(map(mul, state[i], back[(i + 1) % n])) >> BITS)
        self.square.append(sum(sum(map(mul, *pair)) for pair in zip(state, back)) >> BITS)
        for i in range(n):
            z[1 + 2 * n + i].append(sum(map(mul, self.square, back[i])) >> BITS)
        angles = [sum(map(mul, w, y)) >> BITS for w in self.W]
        if k == 0:
            angles = [a + p for a, p in zip(angles, self.phase)]
        if self.angle:
            angles.append(self.angle[k] if k < 2 else 0)
        for angle, (slope, sine, cosine) in zip(angles, self.turns):
            if k == 0:
                pair = _mp.cos_sin(_mp.mpf(angle) / ONE)
                cosine.append(int(_mp.ldexp(pair[0], BITS)))
                sine.append(int(_mp.ldexp(pair[1], BITS)))
            else:
                slope.append(k * angle)
                up, down = (sum(map(mul, slope, reversed(x))) for x in (cosine, sine))
                sine.append((up >> BITS) // k)
                cosine.append((-down >> BITS) // k)
        if not self.angle:
            z[-1].append(0)
            z[-2].append(0)

    def drop(self) -> None:
        for series in self.all:
            if series:
                series.pop()

    def of_order(self, k: int, rows: list[list[int]]) -> list[int]:
        """The coefficients of order k of combinations of features."""
        z = [series[k] for series in self.z]
        return [sum(map(mul, row, z)) >> BITS for row in rows]


def _value(series: list[int], t: int) -> int:
    total = 0
    for c in reversed(series):
        total = c + (total * t >> BITS)
    return total


class _Arc(NamedTuple):
    """A step: series of the state and of the guards, and how far they are good."""

    y: list[list[int]]
    guards: list[list[int]]
    names: list[tuple[int, int]]  # (switch, sign of the bound of λ or 0 for its surface)
    h: float


class Curved:
    """One case. `exactly` gathers the times of events and in the end the state, in units of 1 / ONE."""

    def __init__(self, case: Case, shape: Shape):
        self.case, self.shape = case, shape
        self.timed = shape.forced or shape.moving
        exact = np.vectorize(fixed, otypes=[object])
        self.F, self.D, self.W = exact(case.F), exact(case.D), exact(case.W).tolist()
        self.phase, self.omega = exact(case.phase).tolist(), fixed(case.omega)
        self.G, self.push = exact(case.G).tolist(), self.D.tolist()
        self.bound = [fixed(b) for b in case.bound]
        self.exactly: list[int] = []
        self.rows = functools.cache(self.free_field)

    def free_field(self, mode: tuple) -> list[list[int]]:
        """The rows of F + Σ s_k D_k, with 0 for those that slide."""
        return (self.F + sum(s * d for s, d in zip(mode, self.D))).tolist()

    def expand(self, t: int, y: list[int], mode: tuple) -> _Arc:
        """The series from here. While it slides every next order of the state is affine in that of the multipliers, with
        the same matrix ∇h · d at all orders."""
        n, rows, jet = self.shape.n, self.rows(mode), _Jet(self, t)
        held = [k for k in range(len(mode)) if mode[k] == 0]
        lam: list[list[int]] = [[] for _ in held]
        push: list[list[list[int]]] = [[[] for _ in range(n)] for _ in held]
        surfaces, inverse = [self.G[k] for k in held], []
        jet.extend(y)
        for k in range(ORDER):
            rate = jet.of_order(k, rows)
            if held:
                for j, which in enumerate(held):
                    for i, d in enumerate(jet.of_order(k, self.push[which])):
                        push[j][i].append(d)
                        rate[i] += sum(map(mul, lam[j], push[j][i][:0:-1])) >> BITS
                jet.extend([r // (k + 1) for r in rate])
                off = jet.of_order(k + 1, surfaces)
                jet.drop()
                if k == 0:
                    inverse = self.inverse(jet, rate, off, [[d[0] for d in p] for p in push], held)
                for j, row in enumerate(inverse):
                    lam[j].append(-(k + 1) * sum(map(mul, row, off)) >> BITS)
                    for i in range(n):
                        rate[i] += lam[j][-1] * push[j][i][0] >> BITS
            jet.extend([r // (k + 1) for r in rate])
        state = jet.z[1 : 1 + n]
        h = STEP
        for series in [*state, *lam]:
            for c, j in zip(series[:-4:-1], range(len(series) - 1, 0, -1)):
                if c:
                    h = min(h, (LEFT * ONE / abs(c)) ** (1 / j))
        guards, names, surface = [], [], [jet.of_order(j, self.G) for j in range(ORDER + 1)]
        for k, s in enumerate(mode):
            if s:
                guards.append([s * row[k] for row in surface])
                names.append((k, 0))
            else:
                series = lam[held.index(k)]
                for sign in (1, -1):
                    guards.append([self.bound[k] - sign * series[0], *[-sign * c for c in series[1:]], 0])
                    names.append((k, sign))
        return _Arc(state, guards, names, h)

    def inverse(self, jet: _Jet, rate: list[int], off: list[int], pushes: list[list[int]], held: list[int]) -> list:
        """Of the matrix ∇h_i · d_j, whose columns are what d_j changes dh/dt by."""
        matrix = _mp.matrix(len(held))
        for j, push in enumerate(pushes):
            jet.extend([r + d for r, d in zip(rate, push)])
            for i, changed in enumerate(jet.of_order(1, [self.G[k] for k in held])):
                matrix[i, j] = _mp.mpf(changed - off[i]) / ONE
            jet.drop()
        inverse = matrix**-1
        return [[int(_mp.ldexp(inverse[i, j], BITS)) for j in range(len(held))] for i in range(len(held))]

    # The same in floating point, for batches of states: what laws and the growth of errors need.

    def features(self, t: float, y: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Of states of shape (batch, n): the features; their derivatives by y, and by t."""
        n, case = self.shape.n, self.case
        batch, eye = len(y), np.eye(n)
        following, square = np.roll(y, -1, 1), np.sum(y**2, 1)[:, None]
        angle = y @ case.W.T + case.phase
        wave = np.array([np.cos(case.omega * t), np.sin(case.omega * t)]) * self.timed
        turned = case.omega * np.array([-wave[1], wave[0]])
        z = np.concatenate(
            [np.ones((batch, 1)), y, y * following, y * square, np.sin(angle), np.tile(wave, (batch, 1))], 1
        )
        by_y = np.zeros((batch, self.shape.features, n))
        by_y[:, 1 : 1 + n] = eye
        by_y[:, 1 + n : 1 + 2 * n] = following[:, :, None] * eye + y[:, :, None] * np.roll(eye, 1, 1)
        by_y[:, 1 + 2 * n : 1 + 3 * n] = square[:, :, None] * eye + 2 * y[:, :, None] * y[:, None, :]
        by_y[:, 1 + 3 * n : -2] = np.cos(angle)[:, :, None] * case.W
        by_t = np.zeros(self.shape.features)
        by_t[-2:] = turned
        return z, by_y, by_t

    def law(self, t: float, y: np.ndarray, mode: tuple) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
        """The field, the values of the switches, dh/dt and the matrix ∇h_i · d_j of those which slide."""
        z, by_y, by_t = self.features(t, y)
        held = [k for k in range(len(mode)) if mode[k] == 0]
        f = z @ (self.case.F + np.tensordot(np.array(mode, float), self.case.D, 1)).T
        normal = self.case.G @ by_y  # (batch, sgn, n)
        s = np.tile(np.array(mode, float), (len(y), 1))
        matrix = np.zeros((len(y), len(held), len(held)))
        if held:
            push = self.case.D[held] @ z[:, None, :, None]
            push = push[..., 0]  # (batch, held, n)
            matrix = normal[:, held] @ np.swapaxes(push, 1, 2)
            off = (normal[:, held] @ f[:, :, None])[..., 0] + self.case.G[held] @ by_t
            s[:, held] = np.linalg.solve(matrix, -off[:, :, None])[..., 0]
            f = f + np.sum(s[:, held, None] * push, 1)
        return f, s, (normal @ f[:, :, None])[..., 0] + self.case.G @ by_t, matrix

    def growth(self, t: float, y: np.ndarray, mode: tuple, h: float) -> np.ndarray:
        """∂y(t + h)/∂y, by a Runge-Kutta step of neighbours (a step is a tenth of the radius of convergence)."""
        near = y + NEAR * np.concatenate([np.eye(self.shape.n), -np.eye(self.shape.n)])

        def f(t: float, y: np.ndarray) -> np.ndarray:
            return self.law(t, y, mode)[0]

        a = f(t, near)
        b = f(t + h / 2, near + h / 2 * a)
        c = f(t + h / 2, near + h / 2 * b)
        end = near + h / 6 * (a + 2 * b + 2 * c + f(t + h, near + h * c))
        up, down = np.split(end, 2)
        return (up - down).T / (2 * NEAR)

    def normal(self, t: float, y: np.ndarray, mode: tuple, name: tuple[int, int]) -> np.ndarray:
        """∂g/∂y of the guard of this name."""
        k, sign = name
        if not sign:
            return mode[k] * (self.case.G[k] @ self.features(t, y[None])[1][0])
        near = y + NEAR * np.concatenate([np.eye(self.shape.n), -np.eye(self.shape.n)])
        up, down = np.split(self.law(t, near, mode)[1][:, k], 2)
        return -sign * (up - down) / (2 * NEAR)

    def settle(self, t: float, y: np.ndarray, mode: tuple, at: list[int], leaves: dict[int, int]) -> tuple:
        """The assignment of stick and slip to the switches at their surfaces that satisfies all laws, by trying all; of
        several the one that holds most. One that holds a surface which repels would be chosen by rule only."""
        valid = []
        all_held = tuple(0 if k in at else s for k, s in enumerate(mode))
        repels = dict(zip(at, np.diag(self.law(t, y[None], all_held)[3][0]) >= 0))
        for choice in itertools.product(*[(leaves[k],) if k in leaves else (0, 1, -1) for k in at]):
            trial = list(mode)
            for k, s in zip(at, choice):
                trial[k] = s
            s, rates = (x[0] for x in self.checked(t, y, tuple(trial))[1:3])
            slack = []
            for k, side in zip(at, choice):
                if side == 0:
                    slack.append(1 - abs(s[k]) / self.case.bound[k])
                elif k not in leaves or self.case.bound[k] > 1:  # else dh/dt = 0 at this instant
                    slack.append(side * rates[k])
            least = min(slack, default=1.0)
            if abs(least) < EDGE:
                raise Sensitive("at the edge of sliding")
            if least > 0:
                if any(side == 0 and repels[k] for k, side in zip(at, choice)):
                    raise Sensitive("repels")
                valid.append(tuple(trial))
        if not valid:
            raise Unsolvable
        stuck = [sum(v[k] == 0 for k in at) for v in valid]
        best = [v for v, s in zip(valid, stuck) if s == max(stuck)]
        if len(best) > 1:
            raise Sensitive("not unique")
        return best[0]

    def checked(self, t: float, y: np.ndarray, mode: tuple) -> tuple:
        """The law, where its equations for the multipliers are well posed: the surfaces attract, and one alone does."""
        law = self.law(t, y[None], mode)
        if 0 in mode and np.linalg.cond(law[3][0]) > 1e4:
            raise Sensitive("singular")
        return law

    def attracted(self, t: float, y: np.ndarray, mode: tuple) -> None:
        """Sliding that goes on where a surface begins to repel is one of several solutions."""
        matrix = self.checked(t, y, mode)[3][0]
        if np.any(np.diag(matrix) > -1e-2) or np.any(np.linalg.eigvals(matrix).real > -1e-2):
            raise Sensitive("repels")

    def next_event(self, arc: _Arc, limit: float, known: dict) -> tuple[float, tuple[int, int], int]:
        """The first root on a step no longer than `limit`: after how long (also to the last digit), of which guard."""
        h = min(arc.h, limit)
        scale = h ** np.arange(ORDER + 1)
        c = np.array([[x / ONE for x in row] for row in arc.guards]) * scale
        for i, name in enumerate(arc.names):
            if name in known:
                c[i] = np.concatenate([c[i, known[name] :], np.zeros(known[name])])
        try:
            roots = h * first_roots(c)
        except Sensitive as problem:
            raise Sensitive(problem.args[0], problem.args[1] * h) from None
        first = np.sort(roots)
        if first[0] == np.inf:
            return np.inf, (-1, 0), fixed(h)
        if len(first) > 1 and first[1] - first[0] < CROWDED:
            raise Sensitive("simultaneous", first[0])
        i = int(np.argmin(roots))
        series, u = arc.guards[i], fixed(first[0])
        slope = [j * x for j, x in enumerate(series)][1:]
        for _ in range(2):  # Newton's method doubles the digits
            u -= (_value(series, u) << BITS) // _value(slope, u)
        return float(first[0]), arc.names[i], u

    def run(self, t1: float, max_events: int, cut: str) -> Trajectory:
        n, y, t, known = self.shape.n, [fixed(x) for x in self.case.y0], 0, {}
        h0 = self.case.G @ self.features(0.0, self.case.y0[None])[0][0]
        if np.min(abs(h0)) < 1e-6:
            raise Sensitive("start", 0.0)
        mode, end = tuple(np.sign(h0).astype(int).tolist()), fixed(t1)
        times, switches, modes, gains = [], [], [], []
        # From the start, and from every event, until now: how errors made there have grown.
        growth = np.eye(n)[None]
        while t < end:
            now, here = t / ONE, np.array([x / ONE for x in y])
            try:
                if 0 in mode:
                    self.attracted(now, here, mode)
                arc = self.expand(t, y, mode)
                length, (k, sign), u = self.next_event(arc, (end - t) / ONE + CROWDED, known)
            except Sensitive as problem:
                raise Sensitive(problem.args[0], now + sum(problem.args[1:])) from None
            if length < np.inf and abs(now + length - t1) < CROWDED:
                raise Sensitive("at the end", t1)
            u, known = min(u, end - t), {}
            growth = self.growth(now, here, mode, u / ONE) @ growth
            y, t = [_value(series, u) for series in arc.y], t + u
            now, here = t / ONE, np.array([x / ONE for x in y])
            if length == np.inf:
                continue
            at = sorted({j for j in range(len(mode)) if mode[j] == 0} | {k})
            row, before = self.normal(now, here, mode, (k, sign)), self.law(now, here[None], mode)[0][0]
            i = arc.names.index((k, sign))
            slope = _value([j * x for j, x in enumerate(arc.guards[i])][1:], u) / ONE
            gains.append(np.sum(np.linalg.norm(row @ growth, axis=-1)) / abs(slope))
            try:
                if times and now - times[-1] < CROWDED:
                    raise Sensitive("crowded")
                if len(times) >= max_events:
                    raise Sensitive("many events")
                after = self.settle(now, here, mode, at, {k: sign} if sign else {})
            except Sensitive as problem:
                raise Sensitive(problem.args[0], now) from None
            except Unsolvable:
                times, switches, modes = [*times, now], [*switches, k], [*modes, mode]
                return Trajectory.of(now, times, switches, modes, here, mode, growth, gains, "no mode", cut)
            known = {(j, 0): 1 for j in at if after[j] != 0}
            if sign and self.case.bound[k] == 1:
                known[k, 0] = 2
            f = self.law(now, here[None], after)[0][0]
            growth = np.concatenate([(np.eye(n) + np.outer(f - before, row) / slope) @ growth, np.eye(n)[None]])
            mode = after
            self.exactly.append(t)
            times, switches, modes = [*times, now], [*switches, k], [*modes, mode]
            if np.max(np.linalg.norm(growth, axis=(1, 2))) > GAIN:
                raise Sensitive("chaos", now)
        if np.max(np.linalg.norm(growth, axis=(1, 2))) > GAIN:
            raise Sensitive("chaos", t1)
        self.exactly += y
        last = [x / ONE for x in y]
        return Trajectory.of(t1, times, switches, modes, last, mode, growth, gains, "", cut)


def solve(case: Case, shape: Shape, max_events: int = 40) -> Trajectory | None:
    """The solution; up to a time before it gets sensitive, or nothing if that is at once."""
    oracle = Curved(case, shape)
    return until_sensitive(lambda t1, cut: oracle.run(t1, max_events, cut), float(case.t1))
