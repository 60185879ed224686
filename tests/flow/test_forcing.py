"""Forcing as users write it: windows, tables, square waves, several frequencies; against closed forms."""

import functools

import diffrax as dfx
import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from jax import Array
from sliding import Stribeck

import nsjax
from nsjax import RESULTS
from nsjax.gallery import Motion


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


@pytest.mark.parametrize(
    "model, want", [(Block, [1.625, 1.0]), pytest.param(BlockByTable, [4.375, 3.75], marks=pytest.mark.slow)]
)
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
    """Pitfall 49."""
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
TENTHS = np.asarray([0.3, 1.0, -2.0, 0.5])
FORMS = {
    "floor": lambda t: jnp.floor(t / 0.7),
    "an index": lambda t: jnp.asarray(TENTHS)[(t / 1.3).astype(int) % 4],
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


AMPLITUDES = np.array([[0.0, 0.0], [0.2, 0.0], [0.0, 0.2], [0.3, 0.4]])


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


@pytest.mark.parametrize(
    "solver",
    [
        dfx.Tsit5(),
        pytest.param(dfx.Dopri8(), marks=pytest.mark.slow),
        pytest.param(nsjax.Taylor(), marks=pytest.mark.slow),
    ],
)
def test_derivatives_by_an_amplitude_of_zero(solver):
    """Pitfall 50: a rigid model has no time scale of its own: its steps have that of what drives the derivative."""
    want = np.broadcast_to([np.sin(10.0) / 2, np.sin(15.0) / 3], (4, 2))
    np.testing.assert_allclose(slopes(TwoWaves, solver, AMPLITUDES), want, atol=1e-6)


@pytest.mark.parametrize("solver", [nsjax.Exponential(), pytest.param(nsjax.Affine(), marks=pytest.mark.slow)])
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
    """Pitfall 48."""
    loads = jnp.array([1.0, 3e3])

    def end(load):
        return nsjax.solve(Loaded(load), 0.0, 200.0, Motion(load, 0 * load), throw=False).y1.x - load

    np.testing.assert_allclose(nsjax.sweep(end, loads), -0.08891, atol=2e-5)


def test_friction_in_the_sliding_velocity_is_caught_where_it_should_be():
    """Pitfall 52: the step that ends in the event looks beyond the surface, where |v_rel| is that of the mode."""
    start, stop = Motion(-1.09655, 0.020415), 2.2
    runs = [
        jax.jit(lambda m, s=s: nsjax.solve(m, 0.0, stop, start, solver=s, throw=False))(Stribeck())
        for s in (nsjax.Taylor(), dfx.Dopri8())
    ]
    for sol in runs:
        np.testing.assert_allclose(sol.events.t[2], 2.0851, atol=1e-4)
    np.testing.assert_allclose(runs[0].events.t[:3], runs[1].events.t[:3], atol=1e-7)
    assert runs[0].stats["num_steps"] < 20


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
    """Pitfall 57."""

    class Wrong(nsjax.System):
        def vector_field(self, t, y, s):
            return Motion(y.v, -y.x - 0.1 * y.v + jnp.cos(t))

        @property
        def period(self):
            return 3.0

    with pytest.raises(ValueError, match="`Wrong.period` is 3, but `vector_field` is not the same one period later"):
        nsjax.find_orbit(Wrong(), Motion(0.0, 0.0))
