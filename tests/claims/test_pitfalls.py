"""What breaks event-driven codes elsewhere, in small: chains and stacks of rubbing blocks, steep and duplicate
surfaces, restarts exactly on a surface, events next to the end or to a tangency."""

import functools
import itertools
from typing import NamedTuple

import diffrax as dfx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
import reference
from jax import Array
from models import CHEAP, flat, itinerary, Motion, Point, times, Toggle
from programs import count
from scipy.linalg import expm
from scipy.optimize import brentq

import nsjax
from nsjax import gallery, RESULTS, solve


# Chains of blocks on a belt.


class Blocks(NamedTuple):
    x: Array
    v: Array
    work: Array  # done by friction


class Chain(nsjax.System):
    """x'' = -K x - F Sgn(v - v_dr), one friction contact for each block. K is a parameter, so that a permutation of
    the blocks is no other program."""

    K: Array
    F: float = 1.0
    v_dr: float = 0.2
    b: float = 1.0  # F_stick / F

    @property
    def switches(self):
        def contact(i):
            return nsjax.sgn(lambda self, t, y: y.v[i] - self.v_dr, name=f"b{i}").breakaway(lambda self: self.b)

        return tuple(contact(i) for i in range(self.K.shape[0]))

    def vector_field(self, t, y, s):
        friction = self.F * jnp.stack([s[f"b{i}"] for i in range(self.K.shape[0])])
        return Blocks(y.v, -self.K @ y.x - friction, -(friction @ y.v))


def springs(n):
    return 2 * np.eye(n) - np.eye(n, k=1) - np.eye(n, k=-1)


def run_chain(x, v, t1=20.0, b=1.0, order=slice(None), K=None):
    """The solution with the blocks (and so their switches) in another order."""
    x, v = (np.broadcast_to(np.asarray(a, float), (len(x),))[order] for a in (x, v))
    K = (springs(len(x)) if K is None else K)[order][:, order]
    y0 = Blocks(jnp.asarray(x), jnp.asarray(v), jnp.asarray(0.0))
    return solve(Chain(K=jnp.asarray(K), b=b), 0.0, t1, y0, max_steps=8192), y0, K


def chain_exactly(x, v, t1, v_dr=0.2, b=1.0, dt=2e-3):
    """The same by matrix exponentials (F = 1): (time, block, its mode afterwards) of every event, and the end.

    The friction forces of blocks that stick do not depend on one another, so each block is looked at alone."""
    n = len(x)
    K, z, t, events = springs(n), np.array([*x, *v, 1.0]), 0.0, []

    def settled(i, side):
        pull = -K[i] @ z[:n]
        return 0 if abs(pull) <= b else int(np.sign(pull)) if side is None else -side

    mode = [int(np.sign(z[n + i] - v_dr)) or settled(i, None) for i in range(n)]
    while True:
        A = np.zeros((2 * n + 1, 2 * n + 1))
        A[:n, n : 2 * n] = np.eye(n)
        for i in range(n):
            if mode[i]:
                A[n + i, :n], A[n + i, -1] = -K[i], -mode[i]
        step, path = expm(A * dt), [z]
        rows = []  # guards, positive while the mode lasts
        for i in range(n):
            here = np.zeros((1 if mode[i] else 2, 2 * n + 1))
            if mode[i]:
                here[0, n + i], here[0, -1] = mode[i], -mode[i] * v_dr
            else:
                here[:, :n], here[:, -1] = [K[i], -K[i]], b
            rows += [(i, row) for row in here]
        G = np.array([row for _, row in rows])
        # Where a mode began in this very instant its guard is zero, and positive one step later.
        while t + len(path) * dt < t1 + dt:
            path.append(step @ path[-1])
            if (G @ path[-1]).min() < 0:
                break
        else:
            return events, expm(A * (t1 - t)) @ z
        last = path[-2]
        fired = [
            (brentq(lambda u, row=row: row @ expm(A * u) @ last, 0, dt, xtol=1e-15), i)
            for i, row in rows
            if row @ path[-1] < 0 and row @ last > 0
        ]
        tau = min(fired)[0]
        z, t = expm(A * tau) @ last, t + (len(path) - 2) * dt + tau
        if t > t1:
            return events, expm(A * (t1 - t)) @ z
        for i in sorted({i for u, i in fired if u < tau + 1e-11}):
            if mode[i]:
                z[n + i] = v_dr
                mode[i] = settled(i, mode[i])
            else:
                mode[i] = int(np.sign(-K[i] @ z[:n]))
            events.append((t, i, mode[i]))


# Where several leave stick at one instant, each event puts the others back to stick, until the flow gives up.
STARTS = {
    "slipping": ((2.3, -1.1), 0.0),
    "both sides": ((1.5, 0.4), (2.0, -1.0)),
    "sticking": ((0.3, -0.2), 0.2),
    "alike": ((2.5, 2.5), -0.5),
    "opposite": ((2.0, -2.0), 0.2),
}


@pytest.mark.parametrize("b", [1.0, 1.4])
@pytest.mark.parametrize("start", STARTS)
def test_two_blocks(start, b):
    """Pitfalls 2, 6, 7, 13, 15: against matrix exponentials. Two alike stick and slip at the same instants. (A third
    one rides on the belt, held by no spring, so that the program is that of three.)"""
    x, v = STARTS[start]
    v = np.broadcast_to(v, 2)
    events, end = chain_exactly(x, v, 20.0, b=b)
    sol, *_ = run_chain([*x, 0.0], [*v, 0.2], b=b, K=np.pad(springs(2), (0, 1)))
    np.testing.assert_allclose(np.concatenate([sol.y1.x[:2], sol.y1.v[:2]]), end[:4], atol=1e-6)
    # Events of several blocks at one instant are one or more rows of the log.
    changes = [
        (float(e.t), i, e.mode_after[f"b{i}"]) for e in sol.events for i in (0, 1)
        if e.mode_after[f"b{i}"] != e.mode_before[f"b{i}"]
    ]  # fmt: skip
    assert [c[1:] for c in changes] == [c[1:] for c in events]
    np.testing.assert_allclose([c[0] for c in changes], [c[0] for c in events], atol=1e-6)
    assert len(events) >= 2


@functools.cache
def chain_starts(n):
    rng = np.random.default_rng(n)
    x, v = 2 * rng.normal(size=n), rng.normal(size=n)
    v[::3] = 0.2
    half = 2 * rng.normal(size=(n + 1) // 2)
    mirrored = np.concatenate([half, half[::-1][n % 2 :]])
    return {
        "mixed": (x, v),
        "sticking": (np.zeros(n), np.full(n, 0.2)),  # both ends leave first
        "slipping": (x, np.zeros(n)),
        "mirrored": (mirrored, np.zeros(n)),
    }


@pytest.mark.parametrize("n", [3, *(pytest.param(n, marks=pytest.mark.slow) for n in (5, 10))])
@pytest.mark.parametrize("start", [pytest.param("mixed", marks=pytest.mark.slow), "slipping", "sticking", "mirrored"])
def test_many_blocks(start, n):
    """Pitfalls 6, 7, 32: against matrix exponentials; the order of blocks and switches does not matter; and energy is
    what the work of friction leaves of it."""
    x, v = chain_starts(n)[start]
    t1 = 30.0 if start == "sticking" else 12.0
    sol, y0, K = run_chain(x, v, t1=t1)
    order = np.random.default_rng(1).permutation(n)
    other, *_ = run_chain(x, v, t1=t1, order=order)
    events, end = chain_exactly(x, v, t1)
    assert len(events) >= n
    np.testing.assert_allclose(np.concatenate([sol.y1.x, sol.y1.v]), end[:-1], atol=1e-5)
    for a, b in ((sol.y1.x, other.y1.x), (sol.y1.v, other.y1.v), (sol.mode1, other.mode1)):
        np.testing.assert_allclose(np.asarray(a)[order], b, atol=1e-5)

    def energy(y):
        return (y.v @ y.v + y.x @ K @ y.x) / 2 - y.work

    np.testing.assert_allclose(energy(sol.y1), energy(y0), atol=1e-6)


@pytest.mark.slow
def test_blocks_cost_no_combinations():
    """No 3^m, and nothing else that grows faster than their number: blocks that act on no other's surface are solved
    for, and their modes chosen, apart."""

    def size(n):
        y0 = Blocks(jnp.zeros(n), jnp.zeros(n), jnp.asarray(0.0))
        system = Chain(K=jnp.asarray(springs(n)))
        return sum(count(jax.make_jaxpr(lambda y: solve(system, 0.0, 1.0, y, throw=False).y1)(y0).jaxpr).values())

    four, five, ten = size(4), size(5), size(10)
    assert five < 1.25 * four and ten < 2 * five


# Stacks: the friction forces on several surfaces depend on one another.


class Stack(nsjax.System):
    """v' = p + q t - A Sgn(v): all surfaces are met at v = 0. With A a P-matrix exactly one assignment is consistent."""

    A: Array
    p: Array
    q: Array

    @property
    def switches(self):
        return tuple(nsjax.sgn(lambda self, t, y, i=i: y.x[i], name=f"s{i}") for i in range(self.p.shape[0]))

    def vector_field(self, t, y, s):
        return Point(self.p + self.q * t - self.A @ jnp.stack([s[f"s{i}"] for i in range(self.p.shape[0])]))


def run_stack(A, p, q, t1):
    """(Bosh3 is exact on its parabolas.)"""
    y0 = Point(jnp.zeros(len(p)))
    return solve(Stack(*map(jnp.asarray, (A, p, q))), 0.0, t1, y0, solver=dfx.Bosh3(), throw=False)


def consistent(A, p):
    """All consistent assignments, by trying all 3^m, with the slack by which they are."""
    found = []
    for mode in itertools.product((-1, 0, 1), repeat=len(p)):
        s, stick = np.array(mode, float), np.array(mode) == 0
        s[stick] = np.linalg.solve(A[np.ix_(stick, stick)], p[stick] - A[np.ix_(stick, ~stick)] @ s[~stick])
        slack = np.where(stick, 1 - abs(s), (p - A @ s) * s)
        if slack.min() >= 0:
            found.append((mode, slack.min()))
    return found


def greedy(A, p):
    """The worst multiplier is released, and none is ever taken back."""
    s = np.zeros(len(p))
    while True:
        stick = s == 0
        lam = s.copy()
        lam[stick] = np.linalg.solve(A[np.ix_(stick, stick)], p[stick] - A[np.ix_(stick, ~stick)] @ s[~stick])
        worst = np.argmax(np.where(stick, abs(lam), 0))
        if not stick.any() or abs(lam[worst]) <= 1:
            return tuple(s.astype(int))
        s[worst] = np.sign(lam[worst])


@pytest.mark.slow
def test_stack_of_surfaces():
    """Pitfall 34: 300 stacks on which three surfaces are met at once; on some, releasing alone gives a wrong mode."""
    rng = np.random.default_rng(3)
    W = rng.normal(size=(300, 3, 3))
    A = (W @ W.transpose(0, 2, 1) + 0.1 * np.eye(3)) * rng.uniform(0.3, 3, (300, 1, 3))  # Delassus matrix × forces
    p = np.einsum("kij,kj->ki", A, rng.uniform(-1.6, 1.6, (300, 3)))

    harder = 0
    for i in range(300):
        ((exact, slack),) = consistent(A[i], p[i])
        harder += greedy(A[i], p[i]) != exact
        sol = run_stack(A[i], p[i], np.zeros(3), 1e-3)
        assert sol.result == RESULTS.successful
        assert slack < 1e-8 or tuple(sol.mode1.tolist()) == exact, (i, A[i], p[i])
    assert harder >= 5


@pytest.mark.slow
def test_stack_of_more_surfaces():
    """Pitfall 34: of five surfaces not every assignment is tried; where releasing alone gives a wrong mode one is taken
    back."""
    rng = np.random.default_rng(5)
    W = rng.normal(size=(100, 5, 5))
    A = (W @ W.transpose(0, 2, 1) + 0.1 * np.eye(5)) * rng.uniform(0.3, 3, (100, 1, 5))
    p = np.einsum("kij,kj->ki", A, rng.uniform(-1.6, 1.6, (100, 5)))
    cases = [(a, b, consistent(a, b)) for a, b in zip(A, p)]
    cases = [(a, b, found[0][0]) for a, b, found in cases if len(found) == 1 and found[0][1] > 1e-6]
    harder = [case for case in cases if greedy(*case[:2]) != case[2]]
    assert len(harder) >= 5
    for a, b, exact in harder:
        sol = run_stack(a, b, np.zeros(5), 1e-3)
        assert sol.result == RESULTS.successful and tuple(sol.mode1.tolist()) == exact, (a, b)


@pytest.mark.parametrize("unit", [1e-12, 1e12])
def test_stack_in_other_units(unit):
    """Pitfall 27: which of the surfaces are left does not depend on the unit of the state."""
    A = np.array([[2, 0.5, 0], [0.5, 1.5, 0.3], [0, 0.3, 1]])
    for p in ([1.0, 0.5, -0.4], [3.0, 0.5, -0.4], [3.0, -2.5, 0.4], [-3.0, 2.5, 2.0]):
        ((exact, _),) = consistent(A, np.array(p))
        sol = run_stack(unit * A, unit * np.array(p), np.zeros(3), 1e-3)
        assert sol.result == RESULTS.successful and tuple(sol.mode1.tolist()) == exact


def test_two_surfaces_left_at_one_instant():
    """Pitfalls 7, 13: also where the friction forces depend on one another. From rest λ = t (1, side, 0), so that two
    surfaces are left at t = 1; then v = q (t - 1)² / 2."""
    for c, side in itertools.product((0.0, 0.5, -0.5, 0.9, -0.9), (1.0, -1.0)):
        A = np.array([[2, c, 0], [c, 1.5, 0], [0, 0, 1]])
        q = A @ [1, side, 0]
        sol = run_stack(A, np.zeros(3), q, 2.0)
        assert sol.result == RESULTS.successful and len(sol.events) <= 2
        np.testing.assert_allclose(sol.y1.x, q / 2, atol=1e-12)


# One surface.


class Steep(nsjax.System):
    """`gallery.StickSlip` with h = arctan(steepness (v - v_dr))."""

    v_dr: float = 0.2
    steepness: float = 50.0

    def vector_field(self, t, y, s):
        return Motion(y.v, -y.x - s.belt)

    @nsjax.sgn
    def belt(self, t, y):
        return jnp.arctan(self.steepness * (y.v - self.v_dr))

    @belt.breakaway
    def belt(self):
        return 2.0


@pytest.mark.parametrize("steepness", [50.0, 1e4])
def test_steep_surface(steepness):
    """Pitfall 8: Newton's method on arctan(50 h) leaves the bracket from everywhere but next to the root."""
    ref = reference.simulate(reference.StickSlip(), 30.0, (2.5, -0.5))
    sol = solve(Steep(steepness=steepness), 0.0, 30.0, Motion(2.5, -0.5), max_steps=20_000)
    np.testing.assert_allclose(times(sol), [float(e.t) for e in ref.events], atol=1e-6)
    np.testing.assert_allclose(flat(sol.y1), reference.floats(ref.y), atol=1e-6)


@functools.cache
def toggle():
    """(a, v, c) -> event times from a start on the surface, and their derivatives."""

    def run(p, t1):
        sol = solve(Toggle(a=p[0], c=p[2]), 0.0, t1, Motion(p[2], p[1]), max_events=32)
        out = jnp.concatenate([sol.events.t, flat_jax(sol.y1)])
        return out, (out, sol.events.num)

    return jax.jit(jax.jacfwd(run, has_aux=True))


def flat_jax(y):
    return jnp.stack(jax.tree.leaves(y))


@pytest.mark.parametrize("a, v, c", [(1.0, 1.0, 0.0), (0.5, -2.0, 0.0), (1.3, 0.7, 0.1)])
def test_every_restart_is_on_the_surface(a, v, c):
    """Pitfalls 1, 2: h is exactly zero at the start and (apart from c = 0.1) at every restart; no root is lost and none
    comes twice, and the derivatives of event times by parameters in field and surface are there."""
    flight = 2 * abs(v) / a
    jacobian, (out, num) = toggle()(jnp.asarray([a, v, c]), jnp.asarray(20.5 * flight))
    k = np.arange(1, 21)
    assert num == 20
    late = 5e-13 * 20 * flight
    np.testing.assert_allclose(out[:20], k * flight, atol=late)
    exact = np.stack([-k * flight / a, k * flight / v, 0 * k], -1)
    np.testing.assert_allclose(jacobian[:20], exact, atol=1e-10 * np.abs(exact).max())
    top = a * (flight / 2) ** 2 / 2 * np.sign(v)
    # What is late by so much has at the top a velocity of a times that.
    np.testing.assert_allclose(out[-2:], [c + top, 0], atol=a * late)


@pytest.mark.parametrize("unit", [1e-12, 1e12])
def test_restarts_in_other_units(unit):
    """Pitfall 27: a simple root at the restart is not taken for a double one because h is small."""
    jacobian, (out, num) = toggle()(unit * jnp.asarray([1.0, 1.0, 0.0]), jnp.asarray(20.5))
    k = np.arange(1, 11)
    assert num == 10
    np.testing.assert_allclose(out[:10], 2 * k, rtol=1e-11)
    exact = np.stack([-2 * k / unit, 2 * k / unit], -1)
    np.testing.assert_allclose(jacobian[:10, :2], exact, atol=1e-10 * np.abs(exact).max())


class Clock(nsjax.System):
    """x' = sgn(t - t_c)."""

    t_c: float

    def vector_field(self, t, y, s):
        return Point(s.clock + 0 * y.x)

    @nsjax.sgn
    def clock(self, t, y):
        return t - self.t_c


def test_event_on_a_step_boundary():
    """Pitfall 9: at the very end of a step, or an ulp before or after it, the event comes once, at its time, and its
    derivative is not lost to the next step."""

    @jax.jit
    @jax.vmap
    def run(t_c, dt):
        def end(t_c):
            sol = solve(
                Clock(t_c=t_c), 0.0, 2.0, Point(0.0), max_events=4, throw=False,
                solver=dfx.Heun(), stepsize_controller=dfx.ConstantStepSize(), dt0=dt,
            )  # fmt: skip
            return (sol.y1.x, sol.events.t[0]), (sol.y1.x, sol.events.num)

        return jax.jacfwd(end, has_aux=True)(t_c)

    dt = np.array([0.1, 0.25, 0.3, 1 / 3])
    t = np.concatenate([np.cumsum(np.full((5, 4), dt), 0) + ulps * 2.0**-52 for ulps in (-1, 0, 1)])
    (dx, dte), (x, num) = run(jnp.asarray(t.ravel()), jnp.asarray(np.tile(dt, 15)))
    assert np.all(num == 1)
    np.testing.assert_allclose(x, 2 - 2 * t.ravel(), atol=1e-14)
    np.testing.assert_allclose(dx, -2, atol=1e-12)
    np.testing.assert_allclose(dte, 1, atol=1e-12)


def test_end_next_to_an_event():
    """Pitfall 9: the second event lies on the end time or some ulps before or after it."""
    p = jnp.asarray([1.0, 1.0, 0.0])
    event = float(toggle()(p, jnp.asarray(5.0))[1][0][1])
    for ulps in (-64, -2, -1, 0, 1, 2, 64):
        t1 = event + ulps * float(np.spacing(4.0))
        _, (out, num) = toggle()(p, jnp.asarray(t1))
        assert num in ((1,) if ulps < -4 else (2,) if ulps > 4 else (1, 2)), ulps
        np.testing.assert_allclose(out[-2:], [t1 - 4, 1], atol=1e-12)


def test_there_and_back():
    """Pitfalls 9, 33: values saved at the very instants of events; and from the end back to the start."""
    ts = jnp.linspace(0.0, 10.0, 11)
    sol = solve(Toggle(), 0.0, 10.0, Motion(0.0, 1.0), saveat=dfx.SaveAt(ts=ts))
    x = np.where(np.arange(11) % 2, np.where(np.arange(11) % 4 == 1, 0.5, -0.5), 0.0)
    np.testing.assert_allclose(sol.ys.x, x, atol=1e-11)
    np.testing.assert_allclose(sol.ys.v, np.where(np.arange(11) % 2, 0, (-1.0) ** (np.arange(11) // 2)), atol=1e-11)
    early = jnp.append(ts[:10], 9.0)  # one twice: as many as before are no other program
    back = solve(Toggle(), 9.0, 0.0, Motion(0.5, 0.0), saveat=dfx.SaveAt(ts=early[::-1]))
    np.testing.assert_allclose(
        np.stack([back.ys.x, back.ys.v])[:, :0:-1], np.stack([sol.ys.x, sol.ys.v])[:, :10], atol=1e-11
    )
    np.testing.assert_allclose(times(back), [8, 6, 4, 2], atol=1e-11)


class Arch(nsjax.System):
    """x = t - t²/2 and twice the switch on h = x - c, whose top is at 1/2; z is the time above less that below."""

    c: float = 0.5

    def vector_field(self, t, y, s):
        return Blocks(y.v, jnp.full_like(y.v, -1.0), (s.one + s.two) / 2)

    @nsjax.sgn
    def one(self, t, y):
        return y.x - self.c

    @nsjax.sgn
    def two(self, t, y):
        return y.x - self.c


def test_near_a_tangency_with_duplicate_switches():
    """Pitfalls 5, 7, 10: a top above the surface by 1e-4 ... 1e-14 is two events of each switch, one below it none."""
    depth = np.array([1e-4, 1e-6, 1e-8, 1e-10, 1e-12, 1e-14, -1e-14, -1e-12, -1e-8])
    y0 = Blocks(jnp.asarray(0.0), jnp.asarray(1.0), jnp.asarray(0.0))
    sol = jax.jit(jax.vmap(lambda c: solve(Arch(c=c), 0.0, 2.0, y0, throw=False)))(jnp.asarray(0.5 - depth))
    assert np.all(nsjax.is_okay(sol.result))
    above = np.sqrt(8 * np.maximum(depth, 0))
    slack = 2e-14 / np.sqrt(np.abs(depth))
    assert np.all(np.abs((sol.y1.work + 2) / 2 - above) < slack)
    assert np.all((np.asarray(sol.events.num) > 0) == (depth > 0))
    for lane in np.flatnonzero(depth > 0):
        rows = slice(0, int(sol.events.num[lane]))
        after = np.asarray(sol.events.mode_after[lane][rows])
        assert after[-1].tolist() == [-1, -1] and [1, 1] in after.tolist()


@pytest.mark.parametrize("off", [0.0, 1e-13, -1e-13, 1e-9, -1e-9])
def test_stick_of_no_duration(off):
    """Pitfall 13: arrives at the belt where stick ends (k x = F_stick): it may stick there for an instant or not at
    all, and slips on; no chatter."""
    # Backwards in time from (2 + off, 0.2) along the circle of v > v_dr about x = -1, for a time of 1; then forwards
    # about x = 1.
    x, v = 3 + off, 0.2
    y0 = Motion(-1 + x * np.cos(1.0) - v * np.sin(1.0), v * np.cos(1.0) + x * np.sin(1.0))
    sol = solve(gallery.StickSlip(), 0.0, 3.0, y0)
    assert itinerary(sol)[-1][-1] == -1 and len(sol.events) <= 2
    np.testing.assert_allclose(times(sol), 1, atol=1e-7)
    x = 1 + off
    np.testing.assert_allclose(
        flat(sol.y1), [1 + x * np.cos(2) + v * np.sin(2), v * np.cos(2) - x * np.sin(2)], atol=1e-7
    )


class Root(nsjax.System):
    """x' = -1, and a surface that ceases to be a number at x = 0, where it is not zero."""

    def vector_field(self, t, y, s):
        return Point(-1.0 - 0.1 * s.edge)

    @nsjax.sgn
    def edge(self, t, y):
        return 1 + jnp.sqrt(y.x)


def test_surface_that_is_not_a_number():
    """Pitfall 30: told, not looped on."""
    sol = solve(Root(), 0.0, 5.0, Point(1.0), throw=False, **CHEAP)
    assert sol.result in (RESULTS.nonfinite_field, RESULTS.dt_min_reached)


@pytest.mark.parametrize("case", ["complex", "boolean", "empty"])
def test_states_that_are_not_real_numbers(case):
    """Pitfall 30. (Integers are real numbers: see tests/flow/test_tolerances.)"""
    y0 = {"complex": Point(jnp.asarray(1j)), "boolean": Point(jnp.asarray(True)), "empty": ()}[case]
    with pytest.raises((TypeError, ValueError), match="Argument `y0` must"):
        solve(Root(), 0.0, 1.0, y0)


# Two changes of a periodic orbit between two values of a parameter.


class Galloping(gallery.DiscontinuousSupport):
    """The mass of section 3.5 in a wind whose damping c is negative beyond a certain speed."""

    c: float = 0.0

    def vector_field(self, t, y, s):
        still = super().vector_field(t, y, s)
        return Motion(y.v, still.v - self.c * y.v / self.m)


@pytest.mark.slow
def test_bifurcation_and_corner_in_one_step():
    """Pitfall 25, for as long as there is no continuation: a Neimark-Sacker bifurcation at wind speed 1 and a corner at
    1.2, where the growing orbit reaches the tip of the support. Bisection on what an orbit reports finds both."""
    omega, corner = 1.2, 1.2

    def damping(speed):
        return (1 - speed) / 2

    def free(speed):
        """Complex amplitude of the motion without contact, under a force of amplitude speed²."""
        return speed**2 / (1 - omega**2 + 1j * damping(speed) * omega)

    def at(speed):
        system = Galloping(c=damping(speed), f_0=speed**2, omega=omega, x_c=abs(free(corner)))
        amplitude, tight = free(speed), dfx.PIDController(rtol=1e-12, atol=1e-12)
        guess = Motion(amplitude.real, -omega * amplitude.imag)
        limits = dict(solver=dfx.Tsit5(), stepsize_controller=tight, max_events=8)
        return speed, nsjax.find_orbit(system, guess, **limits)

    def changes(low, high):
        """(the orbits on both sides, whether it is a corner) of every change that the ends of an interval tell of."""
        (a, before), (b, after) = low, high
        same = bool(before.itinerary.same_as(after.itinerary))
        if same and before.stable == after.stable:
            return []
        if b - a < 1e-8:
            return [(low, high, not same)]
        middle = at((a + b) / 2)
        return changes(low, middle) + changes(middle, high)

    smooth, tip = changes(at(0.95), at(1.201))

    (a, before), (b, after), is_corner = smooth
    assert not is_corner and a < 1 + 1e-9 and b > 1 - 1e-9
    assert before.stable and not after.stable and len(after.events) == 0
    np.testing.assert_allclose(before.multipliers, after.multipliers, atol=1e-6)

    (a, before), (b, after), is_corner = tip
    assert is_corner and a < corner + 1e-9 and b > corner - 1e-9
    assert not before.stable and not after.stable
    assert list(before.itinerary) == [{"support": -1}]
    assert list(after.itinerary) == [{"support": -1}, {"support": 1}, {"support": -1}]
    # At the tip the damper c_f sets in: the saltation matrix (3.30) of entering, while leaving adds nothing. Its
    # determinant is 1, so that the multipliers jump along a circle, of which `stable` says nothing.
    period = expm(np.array([[0, 1], [-1, -damping(corner)]]) * 2 * np.pi / omega)
    entering = np.array([[1, 0], [-after.system.c_f, 1]])
    for orbit, monodromy in ((before, period), (after, period @ entering)):
        found, exact = (np.sort_complex(np.asarray(m)) for m in (orbit.multipliers, np.linalg.eigvals(monodromy)))
        np.testing.assert_allclose(found, exact, atol=1e-3)
    assert abs(before.multipliers[0] - after.multipliers[0]) > 0.3
