"""Solvers and step size controllers of diffrax; single precision; programs that are not compiled again."""

import diffrax as dfx
import jax
import jax.numpy as jnp
import numpy as np
import optimistix as optx
import pytest
import reference
from models import flat, Heat, Motion, pid, Thermostat, times

import nsjax
from nsjax import gallery, RESULTS, saltation_matrix, solve


DEFAULT = [dfx.Euler, dfx.Kvaerno5]
OTHERS = [dfx.Heun, dfx.Bosh3, dfx.ImplicitEuler, dfx.Midpoint, dfx.Ralston, dfx.Dopri5, dfx.Kvaerno3, dfx.Kvaerno4]
ELSEWHERE = [dfx.Tsit5, dfx.Dopri8]  # next to this, and in most other tests


def final(v_dr=0.5, t1=30.0):
    return reference.stick_slip_final(np.array([v_dr]), t1)[0]


@pytest.mark.parametrize("solver", DEFAULT + [pytest.param(s, marks=pytest.mark.slow) for s in OTHERS + ELSEWHERE])
def test_every_runge_kutta_solver(solver):
    """Seven events of section 3.4; pitfalls 5, 11 (coarse steps are rejected that saw an event)."""
    first_order = solver in (dfx.Euler, dfx.ImplicitEuler)
    kwargs = (
        dict(stepsize_controller=dfx.ConstantStepSize(), dt0=1e-3)
        if first_order
        else dict(stepsize_controller=pid(1e-6))
    )
    method = solver()
    if solver is dfx.ImplicitEuler:
        method = solver(root_finder=dfx.VeryChord(rtol=1e-10, atol=1e-10, norm=optx.max_norm))
    sol = solve(gallery.StickSlip(v_dr=0.5), 0.0, 30.0, Motion(2.5, -0.5), solver=method, max_steps=100_000, **kwargs)
    error = np.abs(flat(sol.y1) - final()).max()
    assert [e.mode_after["belt"] for e in sol.events] == [0, -1] * 3 + [0] * (len(sol.events) % 2)
    assert error < (2e-2 if first_order else 2e-4)


@pytest.mark.parametrize(
    "solver, order",
    [
        (dfx.Tsit5(), 5),
        *(pytest.param(s, n, marks=pytest.mark.slow) for s, n in ((dfx.Dopri5(), 5), (dfx.Dopri8(), 8))),
    ],
)
def test_order_through_events_with_constant_steps(solver, order):
    """The error falls with the order of the method although events lie anywhere within the steps (pitfall 9)."""

    @jax.jit
    def run(dt):
        sol = solve(
            gallery.StickSlip(v_dr=0.5), 0.0, 60.0, Motion(2.5, -0.5), solver=solver,
            stepsize_controller=dfx.ConstantStepSize(), dt0=dt, max_steps=10_000,
        )  # fmt: skip
        return jnp.stack(sol.y1), sol.events.num

    steps = 2.0 ** -np.arange(0.5, 7, 0.5)
    out = [run(jnp.asarray(dt)) for dt in steps]
    errors = np.array([np.abs(y - final(t1=60.0)).max() for y, _ in out])
    clean = (errors > 3e-12) & (errors < 1e-3)
    slope, _ = np.polyfit(np.log(steps[clean]), np.log(errors[clean]), 1)
    assert clean.sum() >= 4 and -0.5 < slope - order < 1.5  # Dopri8 does better on linear fields


class Contact(nsjax.System):
    """x'' = -1 above a support with k_f = 1e8 and little less than critical damping."""

    k_f: float = 1e8
    c_f: float = 2e4

    def vector_field(self, t, y, s):
        force = -(self.k_f * y.x + self.c_f * y.v) * (1 - s.gap) / 2
        return Motion(y.v, force - 1.0)

    @nsjax.sgn
    def gap(self, t, y):
        return y.x


@pytest.mark.slow
def test_stiff_contact():
    """Pitfall 29: rests on a support with a time constant of 1e-4 for a time of 20."""
    run = dict(solver=dfx.Kvaerno5(), stepsize_controller=pid(1e-8), throw=False)
    sol = solve(Contact(), 0.0, 20.0, Motion(0.5, 0.0), **run)
    assert sol.result == RESULTS.successful
    np.testing.assert_allclose(float(sol.events.t[0]), 1.0, atol=1e-9)
    np.testing.assert_allclose(flat(sol.y1), [-1e-8, 0], atol=1e-10)
    assert sol.stats["num_steps"] < 300


def test_stiff_friction():
    """Pitfall 29: a slip whose velocity dies in a time of 1e-6, then sticks."""
    run = dict(solver=dfx.Kvaerno5(), stepsize_controller=pid(1e-8), max_steps=100_000)
    sol = solve(gallery.StickSlip(c=1e6, v_dr=-1e-7), 0.0, 5.0, Motion(1.0, 3.0), **run)
    assert sol.mode1[0] == 0 and sol.stats["num_steps"] < 200
    np.testing.assert_allclose(times(sol), [1e-6 * np.log((3 + 2e-6) / 1.9e-6)], rtol=5e-4)


def test_single_precision():
    """Pitfall 3: the residual at an event is 1e-6 of either sign, and no arc starts on the wrong side."""
    y0 = Motion(jnp.float32(2.5), jnp.float32(-0.5))
    sol = solve(gallery.StickSlip(v_dr=0.5), 0.0, 100.0, y0)
    assert sol.y1.x.dtype == jnp.float32 and sol.events.t.dtype == jnp.float32
    exact = reference.solution(reference.StickSlip, 100.0, (2.5, -0.5), v_dr=0.5)
    assert [e.mode_after["belt"] for e in sol.events] == [{"stick": 0, "slip": -1}[e[1]] for e in exact.events]
    np.testing.assert_allclose(times(sol), [e[0] for e in exact.events], atol=3e-3)
    np.testing.assert_allclose(flat(sol.y1), exact.y, atol=3e-3)
    assert np.abs(np.asarray(sol.events.y_after.v)[: len(sol.events)] - 0.5).max() < 1e-5
    met = Motion(jnp.float32(0.0), jnp.float32(0.2))
    matrix = jax.jit(lambda y: saltation_matrix(gallery.StickSlip(), 0.0, y, "belt", -1, 0))(met)
    assert matrix.dtype == jnp.float32


def test_tolerance_that_single_precision_cannot_hold():
    y0 = Motion(jnp.float32(2.5), jnp.float32(-0.5))
    with pytest.raises(ValueError, match="float32 can hold.*jax.config.update.'jax_enable_x64', True."):
        solve(gallery.StickSlip(), 0.0, 10.0, y0, stepsize_controller=pid(1e-9))
    with pytest.raises(ValueError, match="float64 can hold .*Loosen the tolerance"):
        solve(gallery.StickSlip(), 0.0, 10.0, Motion(2.5, -0.5), stepsize_controller=pid(1e-17))


def test_implicit_solver_without_tolerances():
    with pytest.raises(ValueError, match="must be adaptive for an implicit solver.*VeryChord"):
        solve(
            gallery.StickSlip(),
            0.0,
            1.0,
            Motion(1.0, 0.0),
            solver=dfx.ImplicitEuler(),
            stepsize_controller=dfx.ConstantStepSize(),
            dt0=0.1,
        )


class Counted(nsjax.System):
    """A relay heater that counts how often it is traced."""

    a: float = 1.0
    goal: float = 20.0

    def vector_field(self, t, y, s):
        Counted.traced += 1
        return Heat(self.a * (5.0 + 30.0 * s.heater - y.T))

    @nsjax.relay
    def heater(self, t, y):
        return self.goal - 1 - y.T

    @heater.off
    def heater(self, t, y):
        return y.T - self.goal - 1


Counted.traced = 0


def test_new_values_are_not_traced_again():
    """Pitfall 31: parameters, states, times, modes and tolerances are numbers, not constants."""
    cheap = dict(solver=dfx.Heun(), mode={"heater": 0})

    def run(a, T, t1, tol, **kwargs):
        return solve(Counted(a=a), 0.0, t1, Heat(T), stepsize_controller=pid(tol), **(cheap | kwargs))

    run(1.0, 20.0, 2.0, 1e-4)
    first = Counted.traced
    run(0.5, 19.5, 3.0, 1e-5)
    run(2, 20.5, 3, 1e-4, mode={"heater": 1})  # integers where numbers are meant
    run(jnp.asarray(0.7), jnp.asarray(19.5), jnp.asarray(3.0), 1e-5)
    assert Counted.traced == first


def test_the_defaults_are_in_force():
    """Tsit5 at 1e-8."""
    sol = solve(Thermostat(), 0.0, 1.0, Heat(20.0))
    same = solve(Thermostat(), 0.0, 1.0, Heat(20.0), solver=dfx.Tsit5(), stepsize_controller=pid(1e-8))
    assert sol.y1.T == same.y1.T and sol.stats["num_steps"] == same.stats["num_steps"]
