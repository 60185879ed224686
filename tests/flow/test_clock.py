"""Functions of time that jump (pitfalls 12 and 36): ticks of a clock are met exactly, and what is not
declared is found."""

import functools
from typing import NamedTuple

import diffrax as dfx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from jaxtyping import Array
from models import flat, Motion, pid
from scipy.linalg import expm
from scipy.optimize import brentq

import nsjax
from nsjax import RESULTS
from nsjax._numerics._jaxpr import is_affine, jumps
from nsjax.gallery import BuckConverter as Buck, Charge


class Undeclared(Buck):
    """The same, without a word of its carrier."""

    carrier = None


@functools.cache
def buck(y0: tuple[float, float], periods: int) -> tuple[list[float], np.ndarray]:
    """Times of the comparator's changes within the periods, and the state at the end, by matrix exponentials."""
    p = Buck()
    m = np.array([[-1 / (p.R * p.C), 1 / p.C, 0], [-1 / p.L, 0, 0], [0, 0, 0]])
    on = m.copy()
    on[1, 2] = p.V_in / p.L
    z, times = np.append(y0, 1.0), []
    for n in range(periods):

        def h(t, z, n=n):
            return p.gain * (z[0] - p.V_ref) - p.V_low - (p.V_high - p.V_low) * (t / p.T - n)

        t = n * p.T
        conducts = h(t, z) < 0
        while True:
            a = on if conducts else m
            # The signal is slow against its ramp: a hundred samples of a period hide no change.
            ts = np.linspace(t, (n + 1) * p.T, 101)
            step, path = expm(a * (ts[1] - t)), [z]
            while len(path) < len(ts):
                path.append(step @ path[-1])
            hs = [h(s, x) for s, x in zip(ts, path)]
            hs[0] = -1.0 if conducts else 1.0
            change = next((i for i in range(100) if (hs[i + 1] < 0) != conducts), None)
            if change is None:
                z = expm(a * (ts[-1] - t)) @ z
                break
            e = brentq(
                lambda s: h(s, expm(a * (s - t)) @ z), ts[change] + 1e-15, ts[change + 1], xtol=1e-18, rtol=1e-15
            )
            z, t, conducts = expm(a * (e - t)) @ z, e, not conducts
            times.append(e)
    return times, z[:2]


SOLVERS = {"Tsit5": dfx.Tsit5(), "Taylor": nsjax.Taylor(), "Exponential": nsjax.Exponential()}


@pytest.mark.parametrize(
    "solver",
    [pytest.param("Tsit5", marks=pytest.mark.slow), "Taylor", pytest.param("Exponential", marks=pytest.mark.slow)],
)
def test_buck_converter(solver):
    """Many periods of the clock, against piecewise exponentials."""
    n = 60
    want, end = buck((12.0, 0.55), n)
    sol = nsjax.solve(
        Buck(), 0.0, n * Buck().T, Charge(12.0, 0.55), solver=SOLVERS[solver], stepsize_controller=pid(1e-11)
    )
    assert sol.result == RESULTS.successful and bool(sol.unique)
    ticks = np.array([e.t for e in sol.events if e.switch == "carrier"])
    np.testing.assert_array_equal(ticks, [(i + 1) * Buck().T for i in range(n)])
    changes = [e.t for e in sol.events if e.switch == "comparator"]
    assert len(changes) == len(want)
    np.testing.assert_allclose(changes, want, atol=2e-9 * Buck().T)
    np.testing.assert_allclose(flat(sol.y1), end, rtol=1e-8)


class Square(nsjax.System):
    """x' = v, v' = -x + a w(t - delay), w a square wave: written as one would, or as a switch of time."""

    T: float = 1.7
    duty: float = 0.4
    delay: float = 0.0
    a: float = 1.0

    def vector_field(self, t, y, s):
        high = (t - self.delay) / self.T % 1.0 < self.duty
        return Motion(y.v, -y.x - 0.1 * y.v + self.a * jnp.where(high, 1.0, -1.0))

    @nsjax.clock
    def rises(self):
        return self.T

    @rises.offset
    def rises(self):
        return self.delay

    @nsjax.clock
    def falls(self):
        return self.T

    @falls.offset
    def falls(self):
        return self.delay + self.duty * self.T

    @property
    def period(self):
        return self.T


def square(
    t1: float, y0: np.ndarray, T: float = 1.7, duty: float = 0.4, delay: float = 0.0, a: float = 1.0
) -> np.ndarray:
    """By matrix exponentials."""
    m = np.array([[0, 1, 0], [-1, -0.1, 1], [0, 0, 0]])
    edges = sorted({delay + (n + d) * T for n in range(-5, 50) for d in (0, duty)} | {0.0, t1})
    edges = [e for e in edges if min(0, t1) <= e <= max(0, t1)]
    edges = edges if t1 > 0 else edges[::-1]
    y = np.asarray(y0, float)
    for b, e in zip(edges, edges[1:]):
        high = ((b + e) / 2 - delay) / T % 1.0 < duty
        y = (expm(m * (e - b)) @ np.append(y, a if high else -a))[:2]
    return y


@pytest.mark.parametrize(
    "solver, t1",
    [
        pytest.param(solver, t1, marks=[pytest.mark.slow] * (t1 > 0 or solver == "Taylor"))
        for solver in SOLVERS
        for t1 in (20.0, -3.0)
    ],
)
def test_square_wave(solver, t1):
    sol = nsjax.solve(
        Square(delay=0.3), 0.0, t1, Motion(0.5, 0.0), solver=SOLVERS[solver], stepsize_controller=pid(1e-12)
    )
    np.testing.assert_allclose(flat(sol.y1), square(t1, np.array([0.5, 0.0]), delay=0.3), atol=1e-10)


def test_derivatives_by_the_times_of_jumps():
    """Of the state at the end by period, duty, delay and amplitude; against differences of the closed form."""
    names, at = ("T", "duty", "delay", "a"), (1.7, 0.4, 0.3, 1.0)

    def end(values):
        system = Square(**dict(zip(names, values)))
        return jnp.stack(nsjax.solve(system, 0.0, 20.0, Motion(0.5, 0.0), stepsize_controller=pid(1e-11)).y1)

    got = jax.jacfwd(end)(jnp.asarray(at))
    y0 = np.array([0.5, 0.0])
    for i, step in enumerate(1e-5 * np.eye(4)):
        up, down = (square(20.0, y0, **dict(zip(names, at + sign * step))) for sign in (1, -1))
        np.testing.assert_allclose(got[:, i], (up - down) / 2e-5, atol=3e-8)


@pytest.mark.slow
def test_orbits():
    """Forced by a square wave: the orbit in closed form, its multipliers those of the free oscillator; by shooting and
    in segments."""
    m = np.array([[0, 1], [-1, -0.1]])
    phi = expm(m * 1.7)
    free = square(1.7, np.zeros(2))
    want = np.linalg.solve(np.eye(2) - phi, free)
    for method in ("shooting", "segments"):
        orbit = nsjax.find_orbit(Square(), Motion(0.1, 0.2), method=method, solver=dfx.Tsit5())
        np.testing.assert_allclose(flat(orbit.y0), want, atol=1e-10)
        np.testing.assert_allclose(np.abs(orbit.multipliers), np.exp(-0.05 * 1.7), atol=1e-10)


def buck_orbit(V_in: float) -> tuple[np.ndarray, np.ndarray]:
    """The state at a tick of the orbit that conducts once a period, and its multipliers."""
    p = Buck()
    m = np.array([[-1 / (p.R * p.C), 1 / p.C], [-1 / p.L, 0]])
    rest = np.linalg.solve(m, np.array([0, -V_in / p.L]))  # while it conducts

    def state(d):
        """At the tick, if it conducts from d to T."""
        on, whole = expm(m * (p.T - d)), expm(m * p.T)
        return np.linalg.solve(np.eye(2) - whole, rest - on @ rest)

    def h(d):
        ramp = p.V_low + (p.V_high - p.V_low) * d / p.T
        return p.gain * ((expm(m * d) @ state(d))[0] - p.V_ref) - ramp

    d = brentq(h, 0.3 * p.T, 0.7 * p.T, xtol=1e-18, rtol=1e-15)
    y = expm(m * d) @ state(d)
    n, h_t, jump = np.array([p.gain, 0]), -(p.V_high - p.V_low) / p.T, np.array([0, V_in / p.L])
    saltation = np.eye(2) + np.outer(jump, n) / (n @ (m @ y) + h_t)
    return state(d), np.linalg.eigvals(expm(m * (p.T - d)) @ saltation @ expm(m * d))


@pytest.fixture(scope="module")
def buck_at_20():
    return nsjax.find_orbit(Buck(V_in=20.0), Charge(12.0, 0.55), solver=dfx.Tsit5())


@pytest.mark.slow
def test_orbit_of_the_buck_converter(buck_at_20):
    state, multipliers = buck_orbit(20.0)
    np.testing.assert_allclose(flat(buck_at_20.y0), state, rtol=1e-9)
    np.testing.assert_allclose(np.sort_complex(buck_at_20.multipliers), np.sort_complex(multipliers), atol=1e-8)
    assert bool(buck_at_20.stable)


@pytest.mark.slow
def test_flip_of_the_buck_converter(buck_at_20):
    """Continuation through the period doubling that opens its way to chaos, near 24.5 V."""
    branch = nsjax.continue_orbit(Buck(V_in=20.0), buck_at_20, "V_in", (20.0, 25.0), max_branches=1)
    (flip,) = [b for b in branch.bifurcations if "flip" in b.kind]
    want = brentq(lambda V: buck_orbit(V)[1].real.min() + 1, 24.0, 25.0, xtol=1e-13)
    np.testing.assert_allclose(flip.value, want, rtol=1e-9)


TABLE = np.asarray([0.0, 2.0, -2.0, 1.5])
EDGES = np.asarray([0.37, 0.9, 1.4])
STAIRS = {
    "floor": lambda t: jnp.floor(t / 0.37),
    "table": lambda t: jnp.take(TABLE, (t / 0.37).astype(int), mode="clip"),
    "integers": lambda t: (t / 0.37).astype(int).astype(float),
    "one of several": lambda t: jnp.asarray(TABLE)[jnp.argmax(jnp.stack([jnp.cos(t), jnp.sin(t)]))],
    "search": lambda t: jnp.asarray(TABLE)[jnp.searchsorted(EDGES, t)],
    "digitize": lambda t: jnp.asarray(TABLE)[jnp.digitize(t, EDGES)],
    "piecewise": lambda t: jnp.piecewise(t, [t < 0.7, t >= 0.7], [0.0, 2.0]),
    "select": lambda t: jnp.select([t < 0.7, t < 1.4], [0.0, 2.0], -2.0),
    "order": lambda t: jnp.asarray(TABLE)[jnp.argsort(jnp.stack([t, 1.0 - t]))[0]],
    "rounded": lambda t: jnp.round(t),
    "sawtooth": lambda t: t % 0.37,
    "loop": lambda t: jax.lax.while_loop(lambda c: c[0] > 0.4, lambda c: (c[0] - 0.4, c[1] + 1), (t, 0 * t))[1],
}


def test_spellings_of_a_jump():
    """Pitfall 36: all ways to write a function of time that jumps are seen, and what is smooth is not taken for one."""
    for name, fn in STAIRS.items():
        assert any(jumps(fn, jnp.asarray(0.5))), name
        assert not is_affine(fn, jnp.asarray(0.5)), name
    for fn in (
        jnp.sin,
        jnp.abs,
        lambda t: jnp.max(jnp.stack([t, t**2])),
        lambda t: jnp.linalg.solve(jnp.eye(2), t + jnp.asarray(TABLE)[:2])[0],
    ):
        assert not any(jumps(fn, jnp.asarray(0.5)))


class Jumpy(nsjax.System):
    """A gate that moves by functions each of which has a weight: so all are one program."""

    floor: float = 0.0
    table: float = 0.0
    state: float = 0.0
    kink: float = 0.0

    def vector_field(self, t, y, s):
        return Motion(y.v, -y.x - 0.3 * s.gate)

    @nsjax.sgn
    def gate(self, t, y):
        jumps = self.floor * STAIRS["floor"](t) + self.table * STAIRS["table"](t)
        jumps = jumps + self.state * jnp.where(y.v > 0.2, 1.0, -1.0)
        return y.x - jumps - self.kink * jnp.abs(t % 0.5 - 0.25)


class Announced(Jumpy):
    """The same with a clock."""

    @nsjax.clock
    def step(self):
        return 0.37

    @property
    def switches(self):
        return (Announced.step, Jumpy.gate)


@pytest.mark.parametrize(
    "solver", ["Tsit5", *[pytest.param(name, marks=pytest.mark.slow) for name in ("Taylor", "Exponential")]]
)
def test_undeclared(solver):
    """A surface that jumps with the state, where nothing tells of it, is found."""
    with pytest.raises(nsjax.SolveError, match="`Jumpy.gate`|`gate`"):
        nsjax.solve(Jumpy(state=0.2), 0.0, 5.0, Motion(1.0, 0.0), solver=SOLVERS[solver])


@pytest.mark.parametrize("at", ["floor", "table"])
def test_a_surface_that_jumps_in_time(at):
    """The times at which it does are read off the program: the solution is that of the model with a clock."""
    one, two = (
        nsjax.solve(system(**{at: 0.2}), 0.0, 5.0, Motion(1.0, 0.0), solver=SOLVERS["Tsit5"])
        for system in (Jumpy, Announced)
    )
    np.testing.assert_allclose(flat(one.y1), flat(two.y1), atol=1e-7)
    gates = [(float(e.t), e.switch) for e in one.events]
    declared = [(float(e.t), e) for e in two.events if e.mode_before["gate"] != e.mode_after["gate"]]
    assert len(gates) == len(declared) > 0 and {name for _, name in gates} == {"gate"}
    np.testing.assert_allclose([t for t, _ in gates], [t for t, _ in declared], atol=1e-7)


def test_too_fast_a_clock():
    """Time has too few digits for its ticks, or there are too many to be counted: told, and not as something else."""
    for t0, T, dtype, tol, told in (
        (1e3, 1.7, jnp.float64, 1e-8, False),
        (3e9, 1.7, jnp.float64, 1e-8, True),
        (5e3, 1.7, jnp.float32, 1e-5, True),
    ):
        t0, T, *start = (jnp.asarray(x, dtype) for x in (t0, T, 0.1, 0.2))
        sol = nsjax.solve(Square(T=T), t0, t0 + 2, Motion(*start), stepsize_controller=pid(tol), throw=False)
        assert (sol.result == RESULTS.clock_too_fast) == told and (told or sol.result == RESULTS.successful)


class Ramp(NamedTuple):
    x: Array
    tau: Array


@pytest.mark.slow
def test_margin_at_a_tick():
    """A comparator whose carrier falls back just before it is reached, or just beyond, as it may be."""

    class Comparator(nsjax.System):
        def vector_field(self, t, y, s):
            return Ramp(0 * y.x + 0 * s.gate, jnp.ones_like(y.tau))

        @nsjax.clock
        def carrier(self):
            return 1.0

        @nsjax.sgn
        def gate(self, t, y):
            return y.x - t % 1.0

    for gap in (1e-10, 1e-5):
        sol = nsjax.solve(Comparator(), 0.2, 1.6, Ramp(1 + gap, 0.0), solver=dfx.Heun(), stepsize_controller=pid(1e-8))
        np.testing.assert_allclose(sol.margin, gap / 2e-8, rtol=1e-3)


@pytest.mark.slow
def test_exponential_refuses_beyond_an_event_too():
    """What it cannot step exactly it refuses, also where an event cuts the step short."""

    class Kick(nsjax.System):
        def vector_field(self, t, y, s):
            return Ramp(jnp.where(t < 0.5, 1.0, -3.0) + 0 * y.x + 0 * s.gate, jnp.ones_like(y.tau))

        @nsjax.sgn
        def gate(self, t, y):
            return 0.55 - y.tau

    class Bent(nsjax.System):
        def vector_field(self, t, y, s):
            return Ramp(1 + s.gate, y.x - (1 + 0.2 * y.x) * s.gate)

        @nsjax.sgn
        def gate(self, t, y):
            return y.tau

    for system, t1, start in ((Kick(), 1.0, Ramp(0.0, 0.0)), (Bent(), 3.0, Ramp(0.0, 0.3))):
        sol = nsjax.solve(system, 0.0, t1, start, solver=nsjax.Exponential(), throw=False)
        assert sol.result == RESULTS.mode_not_affine


def test_periods_of_clocks():
    """An orbit is sought over periods in which every clock ticks alike."""

    class Slow(Square):
        @property
        def period(self):
            return 1.5 * self.T

    with pytest.raises(
        ValueError, match="must be a multiple of that of the clock `Slow.rises`, but they are 2.55 and 1.7"
    ):
        nsjax.find_orbit(Slow(), Motion(0.1, 0.2))

    class Free(Square):
        period = None

    with pytest.raises(ValueError, match="has no `period`"):
        nsjax.find_orbit(Free(), Motion(0.1, 0.2))


class Steps(nsjax.System):
    """Set points from a table, and a wall that is moved at a tick."""

    times: Array
    points: Array
    heights: Array  # of the wall, before and after

    def vector_field(self, t, y, s):
        point = self.points[jnp.searchsorted(self.times, t, side="right")]
        return Motion(y.v, point - y.x - 0.2 * y.v + s.wall)

    @nsjax.clock
    def changes(self):
        return self.times

    @nsjax.impact
    def wall(self, t, y):
        return y.x - jnp.where(t < self.times[1], *self.heights)

    @wall.restitution
    def wall(self):
        return 0.0


@pytest.mark.slow
def test_table_and_a_wall_that_opens():
    """A list of ticks; a mass pressed against a wall that is gone from one of them on moves off at once; and a wall that
    closes upon it is refused."""
    system = Steps(jnp.asarray([1.0, 2.5]), jnp.asarray([-0.5, -0.5, -0.5]), jnp.asarray([0.0, -1.0]))
    sol = nsjax.solve(system, 0.0, 4.0, Motion(0.0, 0.0), stepsize_controller=pid(1e-11))
    assert [(e.switch, e.mode_after["wall"], float(e.t)) for e in sol.events] == [
        ("changes", 1, 1.0),
        ("changes", 0, 2.5),
    ]
    m = np.array([[0, 1, 0], [-1, -0.2, -0.5], [0, 0, 0]])
    np.testing.assert_allclose(flat(sol.y1), (expm(m * 1.5) @ [0, 0, 1])[:2], atol=1e-9)

    closing = Steps(system.times, system.points, system.heights[::-1])
    sol = nsjax.solve(closing, 0.0, 4.0, Motion(-0.5, 0.0), throw=False)
    assert sol.result == RESULTS.jump_penetrates and sol.t1 == 2.5


def test_kinks_are_no_jumps():
    """A surface that is a continuous function of a sawtooth needs no clock (but steps)."""
    sol = nsjax.solve(Jumpy(kink=1.0), 0.0, 2.0, Motion(1.0, 0.0), solver=SOLVERS["Tsit5"], throw=False)
    assert sol.result == RESULTS.successful and len(sol.events) == 1
    event = sol.events[0]
    np.testing.assert_allclose(event.y_after.x, abs(float(event.t) % 0.5 - 0.25), atol=1e-9)


class Belt(nsjax.System):
    """A block that sticks to a belt whose speed changes smoothly, pushed by a square wave."""

    T: float = 0.65

    def vector_field(self, t, y, s):
        return Motion(y.v, -y.x - 3 * s.belt + 0.05 * jnp.where(t / self.T % 2 < 1, 1.0, -1.0))

    @nsjax.clock
    def edges(self):
        return self.T

    @nsjax.clock
    def twice(self):
        return self.T / 2

    @nsjax.sgn
    def belt(self, t, y):
        return y.v - 0.3 * jnp.cos(2 * t)


def test_ticks_while_sticking():
    """A surface that moves but does not jump holds on over a tick; every tick is met, whatever rounding makes of the time
    that is left until it (a product and a difference rounded as one), and so are two at one instant."""
    sol = nsjax.solve(Belt(), 0.0, 12.0, Motion(0.2, 1.0), stepsize_controller=pid(1e-10))
    assert sol.result == RESULTS.successful
    met = {name: [float(e.t) for e in sol.events if e.switch == name] for name in ("belt", "edges", "twice")}
    assert len(met["belt"]) == 1
    np.testing.assert_array_equal(met["edges"], 0.65 * np.arange(1, 19))
    np.testing.assert_array_equal(met["twice"], 0.325 * np.arange(1, 37))
    start = met["belt"][0]
    np.testing.assert_allclose(sol.y1.v, 0.3 * np.cos(24.0), atol=1e-12)
    x = sol.events[0].y_after.x + 0.15 * (np.sin(24.0) - np.sin(2 * start))
    np.testing.assert_allclose(sol.y1.x, x, atol=1e-9)


class Forced(nsjax.System):
    """By a staircase and by a triangle wave, each written as a function of time."""

    jump: float
    kink: float

    def vector_field(self, t, y, s):
        return Motion(y.v, -y.x + self.jump * jnp.floor(t / 0.7) + self.kink * jnp.abs(t % 0.7 - 0.35))


@pytest.mark.parametrize("solver", SOLVERS)
@pytest.mark.parametrize("forcing", ["jump", "kink"])
def test_field_that_jumps_unannounced(forcing, solver):
    """The times at which it does are read off the program and met exactly; they are no events of the solution."""
    system = Forced(float(forcing == "jump"), float(forcing == "kink"))
    sol = nsjax.solve(system, 0.0, 5.0, Motion(0.0, 0.0), solver=SOLVERS[solver])
    edges = np.append(np.arange(0, 5, 0.35), 5.0)
    y = np.zeros(2)
    for b, e in zip(edges, edges[1:]):  # x'' = -x + p + q (t - b)
        p, q = (np.floor((b + e) / 1.4), 0.0) if forcing == "jump" else _triangle(b, e)
        x, v = y - np.array([p, q])
        c, s, h = np.cos(e - b), np.sin(e - b), e - b
        y = np.array([p + q * h + x * c + v * s, q - x * s + v * c])
    np.testing.assert_allclose(flat(sol.y1), y, atol=1e-12 if solver == "Exponential" else 2e-7)
    assert sol.result == RESULTS.successful and len(sol.events) == 0


def _triangle(b, e):
    middle = (b + e) / 2
    q = 1.0 if middle % 0.7 > 0.35 else -1.0
    return abs(middle % 0.7 - 0.35) + q * (b - middle), q
