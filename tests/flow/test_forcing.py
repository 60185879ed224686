"""Forcing as users write it: windows, tables, square waves, several frequencies; against closed forms, and random
forcings against scipy restarted at the times at which they jump."""

import functools
from typing import NamedTuple

import diffrax as dfx
import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from jax import Array
from scipy.integrate import solve_ivp
from scipy.optimize import brentq

import nsjax
from nsjax import RESULTS


class Motion(NamedTuple):
    x: Array | float
    v: Array | float


SOLVERS = {"Tsit5": dfx.Tsit5(), "Dopri8": dfx.Dopri8(), "Taylor": nsjax.Taylor(), "Exponential": nsjax.Exponential()}
KNOTS, VALUES = np.array([0.0, 2.0, 3.0, 4.0, 20.0]), np.array([0.0, 0.0, 3.0, 0.0, 0.0])


class Block(nsjax.System):
    """A block on the ground, pushed by a square wave or by a table."""

    mu: Array | float

    def force(self, t):
        return jnp.where(t % 1.0 < 0.5, 1.0, -1.0)

    def vector_field(self, t, y, s):
        return Motion(y.v, self.force(t) - self.mu * s.ground)

    @nsjax.sgn
    def ground(self, t, y):
        return y.v


class BlockByTable(Block):
    def force(self, t):
        return jnp.interp(t, jnp.asarray(KNOTS), jnp.asarray(VALUES))


@pytest.mark.parametrize("model, want", [(Block, [1.625, 1.0]), (BlockByTable, [4.375, 3.75])])
def test_a_sweep_does_not_step_over_jumps_and_kinks_of_the_forcing(model, want):
    mus = jnp.array([0.1, 0.2])
    y1 = nsjax.sweep(lambda mu: nsjax.solve(model(mu), 0.0, 6.25, Motion(0.0, 2.0), throw=False).y1, mus)
    np.testing.assert_allclose(y1.v, want, atol=1e-7)


class Dose(nsjax.System):
    """y' = -y/10 and a dose between two times."""

    begin: Array | float = 290.0
    end: Array | float = 290.5

    def vector_field(self, t, y, s):
        return -0.1 * y + jnp.where((t >= self.begin) & (t < self.end), 3000.0, 0.0)


@pytest.mark.parametrize("solver", SOLVERS)
def test_a_narrow_window_is_met(solver):
    y1 = nsjax.solve(Dose(), 0.0, 300.0, 0.0, solver=SOLVERS[solver]).y1
    np.testing.assert_allclose(y1, 3e4 * (np.exp(-0.95) - np.exp(-1.0)), rtol=1e-8)  # 565.847468


def test_the_derivative_by_the_times_of_a_window():
    jacobian = jax.jacfwd(lambda at: nsjax.solve(Dose(*at), 0.0, 300.0, 0.0).y1)(jnp.array([290.0, 290.5]))
    np.testing.assert_allclose(jacobian, [-3000 * np.exp(-1.0), 3000 * np.exp(-0.95)], rtol=1e-8)


class Written(nsjax.System):
    """y' = f(t)."""

    form: str = eqx.field(static=True)

    def vector_field(self, t, y, s):
        return FORMS[self.form](t) + 0 * y


# A name: f, and the times at which it jumps or bends between 0 and 10.
TENTHS = jnp.asarray([0.3, 1.0, -2.0, 0.5])
FORMS = {
    "floor": lambda t: jnp.floor(t / 0.7),
    "an index": lambda t: TENTHS[(t / 1.3).astype(int) % 4],
    "two windows": lambda t: jnp.where((t > 1) & (t < 1.01), 2.0, 0.0) - jnp.where(jnp.abs(t - 6) < 0.02, 1.0, 0.0),
    "the sign of a sine": lambda t: jnp.sign(jnp.sin(2 * t + 0.3)),
    "half a wave": lambda t: jnp.maximum(jnp.cos(3 * t), 0.2),
    "a table repeated": lambda t: jnp.interp(t % 3.0, jnp.array([0.0, 0.1, 0.2, 3.0]), jnp.array([0.0, 5.0, 0.0, 0.0])),
    "a triangle": lambda t: jnp.abs(t % 2 - 1),
    "a negative rate": lambda t: jnp.floor((5 - t) / 0.9) + (2 - t) % 1.1,
    "a limited ramp": lambda t: jnp.clip(0.7 * t - 1, 0.0, 1.0),
    "cases": lambda t: jnp.piecewise(t, [t < 1, t > 7.77], [0.5, lambda t: t, 2.0]),
    "a branch": lambda t: jax.lax.cond(t < 3.3, jnp.sin, lambda t: 2.0 * t, t),
    "a step": lambda t: jnp.heaviside(t - 4.321, 0.5),
    "rounded": lambda t: jnp.round(t * 0.8),
}


def _quadrature(fn) -> float:
    """∫ f from 0 to 10, by many Gauss points between each two of many points (of which jumps are some, to 1e-7)."""
    grid = np.linspace(0, 10, 200_001)
    nodes, weights = np.polynomial.legendre.leggauss(4)
    t = grid[:-1, None] + 2.5e-5 * (nodes + 1)
    return float(2.5e-5 * np.sum(np.asarray(jax.vmap(jax.vmap(fn))(jnp.asarray(t)), float) * weights))


@functools.partial(jax.jit, static_argnames="form")
def written(form, t0, t1, tol):
    return nsjax.solve(Written(form), t0, t1, 0.0, rtol=tol, atol=tol, throw=False)


OFTEN = ("floor", "two windows", "the sign of a sine", "a table repeated", "a negative rate", "cases")


@pytest.mark.parametrize("form", [pytest.param(f, marks=[pytest.mark.slow] * (f not in OFTEN)) for f in FORMS])
def test_every_way_to_write_a_jump(form):
    sol = written(form, 0.0, 10.0, 1e-8)
    assert sol.result == RESULTS.successful
    np.testing.assert_allclose(sol.y1, _quadrature(FORMS[form]), atol=2e-4)
    np.testing.assert_allclose(sol.y1, written(form, 0.0, 10.0, 1e-11).y1, atol=1e-6)
    np.testing.assert_allclose(sol.y1, -written(form, 10.0, 0.0, 1e-8).y1, atol=1e-6)


def test_jumps_at_times_that_are_not_known_are_refused():
    class Unknown(nsjax.System):
        def vector_field(self, t, y, s):
            return jnp.where(jnp.exp(0.3 * t) > 2, 1.0, 0.0) + 0 * y

    class Insisted(Unknown):
        jumps_in_time = "missed"

    with pytest.raises(ValueError, match="`Unknown` jumps at certain times .by `gt`.*`nsjax.clock`.*jumps_in_time"):
        nsjax.solve(Unknown(), 0.0, 4.0, 0.0)
    np.testing.assert_allclose(nsjax.solve(Insisted(), 0.0, 4.0, 0.0).y1, 4 - np.log(2) / 0.3, atol=1e-3)


def test_a_jump_that_makes_friction_let_go_is_an_event_of_that():
    class Pushed(Block):
        def force(self, t):
            return jnp.where(t < 2.0, 0.0, 0.5)

    sol = nsjax.solve(Pushed(0.2), 0.0, 3.0, Motion(0.0, 0.0))
    assert [(e.switch, float(e.t), e.mode_after["ground"]) for e in sol.events] == [("ground", 2.0, 1)]
    np.testing.assert_allclose(sol.y1.v, 0.3, atol=1e-12)


class TwoWaves(nsjax.System):
    """v' = F cos 2t + G cos 3t - 0.1 sgn v."""

    F: Array | float
    G: Array | float

    def vector_field(self, t, y, s):
        return self.F * jnp.cos(2 * t) + self.G * jnp.cos(3 * t) - 0.1 * s.ground

    @nsjax.sgn
    def ground(self, t, y):
        return y


class OneWave(TwoWaves):
    def vector_field(self, t, y, s):
        return self.F * jnp.cos(2 * t + self.G) - 0.1 * s.ground


AMPLITUDES = jnp.array([[0.0, 0.0], [0.2, 0.0], [0.0, 0.2], [0.3, 0.4]])


@functools.partial(jax.jit, static_argnames=("model", "solver"))
def slopes(model, solver, amplitudes):
    def end(a):
        return nsjax.solve(model(*a), 0.0, 5.0, 3.0, solver=solver, throw=False).y1

    return jax.vmap(jax.jacfwd(end))(amplitudes)


def test_derivatives_by_an_amplitude_of_zero_in_a_sweep():
    want = np.broadcast_to([np.sin(10.0) / 2, np.sin(15.0) / 3], (4, 2))  # -0.27201, 0.21676

    def slope(a):
        return jax.jacfwd(lambda a: nsjax.solve(TwoWaves(*a), 0.0, 5.0, 3.0, throw=False).y1)(a)

    np.testing.assert_allclose(nsjax.sweep(slope, AMPLITUDES), want, atol=1e-6)


@pytest.mark.parametrize("solver", [dfx.Tsit5(), dfx.Dopri8(), nsjax.Taylor()])
def test_derivatives_by_an_amplitude_of_zero(solver):
    """A rigid model has no time scale of its own: its steps have that of what drives the derivative."""
    want = np.broadcast_to([np.sin(10.0) / 2, np.sin(15.0) / 3], (4, 2))
    np.testing.assert_allclose(slopes(TwoWaves, solver, AMPLITUDES), want, atol=1e-6)


@pytest.mark.parametrize("solver", [nsjax.Exponential(), nsjax.Affine()])
def test_derivatives_by_an_amplitude_of_zero_in_exact_flows(solver):
    F, phase = np.asarray(AMPLITUDES).T
    want = [(np.sin(10 + phase) - np.sin(phase)) / 2, F * (np.cos(10 + phase) - np.cos(phase)) / 2]
    np.testing.assert_allclose(slopes(OneWave, solver, AMPLITUDES), np.transpose(want), atol=1e-12)


class Loaded(nsjax.System):
    """Two frequencies beside a static load, and a stop that is never met."""

    load: Array | float

    def vector_field(self, t, y, s):
        waves = 1e-3 * jnp.cos(0.3 * t) + 1e-3 * jnp.cos(t)
        return Motion(y.v, self.load - y.x + waves + s.stop)

    @nsjax.impact
    def stop(self, t, y):
        return y.x + 1e5

    @stop.restitution
    def stop(self):
        return 0.5


def test_two_frequencies_beside_a_static_load():
    loads = jnp.array([1.0, 3e3])

    def end(load):
        return nsjax.solve(Loaded(load), 0.0, 200.0, Motion(load, 0 * load), throw=False).y1.x - load

    np.testing.assert_allclose(nsjax.sweep(end, loads), -0.08891, atol=2e-5)


class Stribeck(nsjax.System):
    """A pendulum on a belt whose friction falls with |v_rel|, shaken."""

    mu: Array | float = 0.2898
    delta: Array | float = 1.8297
    v_b: Array | float = 0.09053
    F: Array | float = 1.0971
    omega: Array | float = 2.29

    def vector_field(self, t, y, s):
        friction = self.mu * s.belt / (1 + self.delta * jnp.abs(y.v - self.v_b))
        return Motion(y.v, -jnp.sin(y.x) + self.F * jnp.cos(self.omega * t) - friction)

    @nsjax.sgn
    def belt(self, t, y):
        return y.v - self.v_b


def test_friction_in_the_sliding_velocity_is_caught_where_it_should_be():
    """The step that ends in the event looks beyond the surface, where |v_rel| is that of the mode."""
    start, stop = Motion(-1.09655, 0.020415), 2.2
    runs = [
        jax.jit(lambda m, s=s: nsjax.solve(m, 0.0, stop, start, solver=s, throw=False))(Stribeck())
        for s in (nsjax.Taylor(), dfx.Dopri8())
    ]
    for sol in runs:
        np.testing.assert_allclose(sol.events.t[2], 2.0851, atol=1e-4)
    np.testing.assert_allclose(runs[0].events.t[:3], runs[1].events.t[:3], atol=1e-7)
    assert runs[0].stats["num_steps"] < 20


# Random forcings, against scipy restarted at the times at which they jump.

KINDS = ("harmonics", "product", "table", "windows", "square", "chirp")


class RandomForcing(nsjax.System):
    """A block with friction, a spring and a wall, forced in one of several ways by random numbers."""

    kind: str = eqx.field(static=True)
    p: Array  # eight numbers from 0 to 1

    def force(self, t, np_):
        p = self.p
        if self.kind == "harmonics":
            return p[0] * np_.cos((1 + p[1]) * t) + p[2] * np_.cos((2 + 3 * p[3]) * t + p[4])
        if self.kind == "product":
            return 2 * p[0] * np_.cos((1 + p[1]) * t) * np_.cos((0.2 + p[2]) * t + p[3])
        if self.kind == "table":
            return np_.interp(t, self.knots, 4 * p - 2)
        if self.kind == "windows":
            return sum(
                (2 * p[i] - 1.2) * np_.where((t >= self.knots[i]) & (t < self.knots[i + 1]), 2.0, 0.0)
                for i in (0, 2, 5)
            )
        if self.kind == "square":
            return np_.where((t + p[3]) % (0.5 + p[0]) < (0.1 + 0.3 * p[1]), 1.5, -0.8 * p[2])
        return 1.5 * p[0] * np_.sin(p[1] * t + 0.2 * p[2] * t**2)

    @property
    def knots(self):
        return jnp.cumsum(0.05 + self.p)

    def breaks(self, end):
        knots, p = np.asarray(self.knots), np.asarray(self.p)
        if self.kind in ("table", "windows"):
            return knots
        if self.kind != "square":
            return np.zeros(0)
        n = np.arange(0, 60)
        return np.concatenate([n * (0.5 + p[0]) - p[3], n * (0.5 + p[0]) + 0.1 + 0.3 * p[1] - p[3]])

    def vector_field(self, t, y, s):
        return Motion(y.v, self.force(t, jnp) - 0.5 * self.p[5] * y.x - 0.8 * self.p[6] * s.ground - s.wall)

    @nsjax.sgn
    def ground(self, t, y):
        return y.v

    @nsjax.impact
    def wall(self, t, y):
        return 0.6 - y.x

    @wall.restitution
    def wall(self):
        return 0.6


END = 4.0


class _Reference:
    """Piece by piece between the times at which the force jumps, through sticking and impacts."""

    def __init__(self, model):
        self.p = np.asarray(model.p)
        self.numbers = _Numbers(model.kind, self.p, np.cumsum(0.05 + self.p))
        self.friction, self.stiffness = 0.8 * self.p[6], 0.5 * self.p[5]
        self.cuts = np.unique([*(c for c in model.breaks(END) if 0 < c < END), END])

    def load(self, t, x):
        """All forces but friction, at a time within the present piece whatever rounding makes of its ends."""
        return RandomForcing.force(self.numbers, np.clip(t, *self.piece), np) - self.stiffness * x

    def run(self, x, v):
        """The end time and the state there, before an impact that may be one of infinitely many."""
        self.y, self.t, self.sense, events = np.array([x, v]), 0.0, 1.0, 0
        for cut in self.cuts:
            self.piece = self.t + 1e-12, np.nextafter(np.nextafter(cut, 0), 0) - 1e-12
            if self.y[1] == 0:
                self.let_go()
            while self.t < cut:
                if self.sense == 0:
                    self.stick(cut)
                elif self.slide(cut):
                    events += 1
                    if events > 20 or not self.meet():
                        return self.t, self.y
        return self.t, self.y

    def let_go(self):
        load = self.load(self.t, self.y[0])
        self.sense = np.sign(load) if abs(load) > self.friction else 0.0

    def stick(self, cut):
        def left(t):
            return self.friction - abs(self.load(t, self.y[0]))

        ts = np.linspace(self.t, cut, 400)
        fallen = [left(t) < 0 for t in ts]
        if not any(fallen):
            self.t = cut
            return
        at = fallen.index(True)
        self.t = brentq(left, ts[at - 1], ts[at], xtol=1e-14) if at else self.t
        self.sense = np.sign(self.load(ts[at], self.y[0]))

    def slide(self, cut):
        """Whether it is stopped or meets the wall before the end of the piece."""

        def field(t, y, sense=self.sense):
            return [y[1], self.load(t, y[0]) - self.friction * sense]

        # Of two zeros within a step, at whose end the sign is the old one again, `solve_ivp` knows nothing: the speed
        # is looked at where it is least, and the gap where the mass stops.
        falls = (lambda t, y: y[1] * self.sense), (lambda t, y: 0.6 - y[0]), (lambda t, y: -field(t, y)[1] * self.sense)
        for fall, terminal in zip(falls, (True, True, False)):
            fall.terminal, fall.direction = terminal, -1
        out = solve_ivp(
            field, (self.t, cut), self.y, rtol=1e-11, atol=1e-12, method="DOP853", events=falls, max_step=0.5,
            dense_output=True,
        )  # fmt: skip
        end, ended, self.at_wall = out.t[-1], out.status == 1, len(out.t_events[1]) > 0
        for fall, ends in ((falls[0], out.t_events[2]), (falls[1], [end])):
            for last in ends:
                if self.t < last <= end and fall(last, out.sol(last)) < -1e-12:
                    before = max(t for t in out.t if t < last)
                    end = brentq(lambda t, fall=fall: fall(t, out.sol(t)), before, last, xtol=1e-14)
                    ended, self.at_wall = True, fall is falls[1]
        self.y, self.t = out.sol(end), end
        return ended

    def meet(self):
        """What follows a stop or an impact; False where impacts may accumulate."""
        if not self.at_wall:
            self.y[1] = 0.0
            self.let_go()
            return True
        if self.y[1] < 0.1:
            return False
        self.y = np.array([0.6, -0.6 * self.y[1]])
        self.sense = -1.0
        return True


def _by_scipy(model):
    """The end time, the state there, and by how much a disturbance of the start grows."""
    (t, y), (other_t, other_y) = (_Reference(model).run(x, 1.0) for x in (0.3, 0.3 + 1e-7))
    return t, y, np.inf if abs(other_t - t) > 1e-5 else np.max(np.abs(other_y - y)) / 1e-7


@functools.cache
def _truths(kind, count, seed):
    numbers = np.random.default_rng(seed).random((count, 8))
    return numbers, [_by_scipy(RandomForcing(kind, jnp.asarray(p))) for p in numbers]


class _Numbers(NamedTuple):
    kind: str
    p: np.ndarray
    knots: np.ndarray


@functools.partial(jax.jit, static_argnames=("kind", "solver"))
def _by_nsjax(kind, solver, numbers, ends):
    def one(p, end):
        return nsjax.solve(RandomForcing(kind, p), 0.0, end, Motion(0.3, 1.0), solver=solver, throw=False)

    return jax.vmap(one)(numbers, ends)


def _failures_and_errors(kind, solver, count, seed, swept=False):
    """Which solutions report a failure, and how far the others are from scipy's, of those that a disturbance of the
    start does not change by much."""
    numbers, truths = _truths(kind, count, seed)
    sound = np.array([growth < 1e3 for _, _, growth in truths])
    ends = jnp.asarray([t - (1e-6 if t < END else 0) for t, _, _ in truths])  # before an impact

    def one(args):
        p, end = args
        return nsjax.solve(RandomForcing(kind, p), 0.0, end, Motion(0.3, 1.0), throw=False)

    sol = (
        nsjax.sweep(one, (jnp.asarray(numbers), ends)) if swept else _by_nsjax(kind, solver, jnp.asarray(numbers), ends)
    )
    told = np.asarray(sol.result != RESULTS.successful)
    error = np.maximum(*(abs(np.asarray(a) - b) for a, b in zip(sol.y1, np.array([y for _, y, _ in truths]).T)))
    assert sound.mean() > 0.9
    return told[sound], error[sound]


WITHIN = 2e-5  # of which 1e-6 of time make some


@pytest.mark.parametrize("kind", [pytest.param("table", marks=pytest.mark.slow), "square"])
def test_random_forcings_in_a_sweep(kind):
    told, error = _failures_and_errors(kind, None, 40, 1, swept=True)
    assert not told.any()
    assert error.max() < WITHIN, (int(error.argmax()), error.max())


@pytest.mark.slow
@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.parametrize("solver", ["swept", "Taylor"])
def test_many_random_forcings(kind, solver):
    """3,000 of them, with friction that sticks and impacts, and none that is wrong without a word."""
    told, error = _failures_and_errors(kind, nsjax.Taylor(), 250, 2, swept=solver == "swept")
    assert told.mean() < 0.01
    assert error[~told].max() < WITHIN, (int(error.argmax()), error.max())


STEP = 1e-4  # of the amplitudes, in difference quotients


@functools.cache
def _slopes_at_zero():
    """Random harmonics of which one or both amplitudes are zero, with the derivatives of the end by both amplitudes, of
    those that a disturbance of the start or of an amplitude does not change by much."""
    rng = np.random.default_rng(3)
    numbers, slopes = [], []
    for i in range(60):
        p = rng.random(8)
        p[[[0], [2], [0, 2]][i % 3]] = 0.0
        ends = []
        for amplitude in (0, 2):
            for sign in (1, -1):
                moved = p.copy()
                moved[amplitude] += sign * STEP
                ends.append(_by_scipy(RandomForcing("harmonics", jnp.asarray(moved))))
        if all(t == END and growth < 1e2 for t, _, growth in ends):
            states = [y for _, y, _ in ends]
            numbers.append(p)
            slopes.append([(states[0] - states[1]) / (2 * STEP), (states[2] - states[3]) / (2 * STEP)])
    return np.array(numbers), np.array(slopes)


@pytest.mark.slow
@pytest.mark.parametrize("solver", [None, dfx.Tsit5(), dfx.Dopri8(), nsjax.Taylor()])
def test_random_derivatives_by_an_amplitude_of_zero(solver):
    """Through sticking and impacts: by default in a sweep, and by each solver."""
    numbers, want = _slopes_at_zero()
    assert len(numbers) > 30

    def end(amplitudes, p):
        p = p.at[np.array([0, 2])].set(amplitudes)
        sol = nsjax.solve(RandomForcing("harmonics", p), 0.0, END, Motion(0.3, 1.0), solver=solver, throw=False)
        return jnp.stack(sol.y1)

    def slope(p):
        return jax.jacfwd(end)(p[np.array([0, 2])], p).T

    points = jnp.asarray(numbers)
    slopes = nsjax.sweep(slope, points) if solver is None else jax.jit(jax.vmap(slope))(points)
    np.testing.assert_allclose(slopes, want, atol=1e-4, rtol=1e-4)


class SquareWave(nsjax.System):
    """A damped oscillator with dry friction, pushed by a square wave."""

    T: Array | float = 2.0

    def vector_field(self, t, y, s):
        push = jnp.where(t % self.T < 0.5 * self.T, 1.0, -1.0)
        return Motion(y.v, -y.x - 0.2 * y.v + push - 0.05 * s.friction)

    @nsjax.sgn
    def friction(self, t, y):
        return y.v

    @property
    def period(self):
        return self.T


class ClockedSquareWave(SquareWave):
    @nsjax.clock
    def tick(self):
        return self.T / 2

    @property
    def switches(self):
        return (SquareWave.friction, ClockedSquareWave.tick)


@pytest.fixture(scope="module")
def square_orbit():
    return nsjax.find_orbit(SquareWave(), Motion(0.0, 0.0), order=1)


def test_branches_of_a_square_wave_need_a_clock(square_orbit):
    with pytest.raises(ValueError, match="`SquareWave` jumps .* declare them as ticks of a `nsjax.clock`"):
        nsjax.continue_orbit(SquareWave(), square_orbit, "T", (1.8, 2.2))


def test_orbits_of_a_square_wave_need_no_clock(square_orbit):
    phi = jax.jit(lambda y0: nsjax.fundamental_matrix(SquareWave(), 0.0, 2.0, y0))(square_orbit.y0)
    np.testing.assert_allclose(phi, square_orbit.monodromy, atol=1e-7)


@pytest.mark.slow
def test_orbits_of_a_square_wave_with_and_without_a_clock(square_orbit):
    orbit = nsjax.find_orbit(ClockedSquareWave(), Motion(0.0, 0.0), order=1)
    np.testing.assert_allclose(square_orbit.y0, orbit.y0, atol=1e-10)
    np.testing.assert_allclose(square_orbit.multipliers, orbit.multipliers, atol=1e-10)
    phi = nsjax.fundamental_matrix(orbit.system, 0.0, 2.0, orbit.y0)
    np.testing.assert_allclose(phi, orbit.monodromy, atol=1e-7)


def test_a_period_that_is_not_the_period_of_the_forcing():
    class Wrong(nsjax.System):
        def vector_field(self, t, y, s):
            return Motion(y.v, -y.x - 0.1 * y.v + jnp.cos(t))

        @property
        def period(self):
            return 3.0

    with pytest.raises(ValueError, match="`Wrong.period` is 3, but `vector_field` is not the same one period later"):
        nsjax.find_orbit(Wrong(), Motion(0.0, 0.0))
