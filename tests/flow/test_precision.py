"""Single precision, long times, very large and very small states: the same solutions, within what the numbers hold."""

import diffrax as dfx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
import reference
from models import flat, Hammer, itinerary, Motion, pid, Point, times

import nsjax
from nsjax import find_orbit, gallery, RESULTS, solve


def single(tree):
    """The same with every number in single precision."""
    return jax.tree.map(lambda x: jnp.asarray(x, jnp.float32), tree)


def slow_but(quick):
    return [key if key == quick else pytest.param(key, marks=pytest.mark.slow) for key in gallery.THESIS]


@pytest.mark.parametrize("key", slow_but("5.7"))  # with an event that is nearly tangential
def test_gallery_in_single_precision(key):
    """Pitfalls 1, 3: every system has the same events as in double precision, none twice, and nothing falls through."""
    entry = gallery.THESIS[key]
    t1 = min(entry.t1, 40.0)
    exact = solve(entry.system(), entry.t0, t1, entry.y0, throw=False)
    sol = solve(single(entry.system()), entry.t0, t1, single(entry.y0), throw=False)
    assert jax.tree.leaves(sol.y1)[0].dtype == sol.events.t.dtype == jnp.float32
    assert sol.result == exact.result
    scale = 1 + np.abs(flat(exact.y1)).max()
    np.testing.assert_allclose(sol.t1, exact.t1, rtol=1e-4)
    # (A limit cycle keeps every error of its phase: with other first steps (5.40) gives errors from 3e-3 to 2e-2.)
    np.testing.assert_allclose(flat(sol.y1), flat(exact.y1), atol=(2e-2 if key == "(5.40)" else 2e-3) * scale)
    if key == "1.1(3)":
        # Impacts accumulate: fewer flights are told from zero, but the rest begins at the same time.
        assert flat(sol.events.y_before)[: len(sol.events), 0].min() > -1e-6
        n = len(sol.events) - 1
        np.testing.assert_allclose(times(sol), [*times(exact)[:n], times(exact)[-1]], atol=4e-4)  # as for the ball
    else:
        assert itinerary(sol) == itinerary(exact)
        np.testing.assert_allclose(times(sol), times(exact), atol=2e-3)
    for switch in {e.switch for e in sol.events}:
        at = np.array([float(e.t) for e in sol.events if e.switch == switch])
        assert np.all(np.diff(at) > 4 * np.spacing(np.float32(at[1:])))


@pytest.mark.parametrize("dt0", [1e-2, 2e-2])
def test_ball_in_single_precision(dt0):
    """Pitfall 4: it does not fall through the floor, between events either. (Each flight keeps what rounding made of
    its speed: of 25 first steps the errors of the times lay between 2e-6 and 4e-5.)"""
    ball = reference.bouncing_ball(3.5)
    assert len(ball.impact_times) == 9
    system, y0 = single(gallery.BouncingBall()), single(Motion(1.0, 0.0))
    sol = solve(system, 0.0, 3.5, y0, dt0=dt0, saveat=dfx.SaveAt(dense=True))
    np.testing.assert_allclose(times(sol), ball.impact_times, atol=1e-4)
    t = jnp.linspace(0, 3.5, 2001, dtype=jnp.float32)
    assert jax.vmap(sol)(t).x.min() > -1e-6


@pytest.mark.parametrize("solver", [nsjax.Exponential(), pytest.param(nsjax.Affine(), marks=pytest.mark.slow)])
def test_forced_for_long_in_single_precision(solver):
    """Forcing is of a known kind at late times too, where its phase is rounded."""
    model, y0 = Hammer(b=0.0, c=0.2, x_w=-0.5, omega=2.8), Motion(0.5, -1.0)
    parameters = {name: float(getattr(model, name)) for name in ("b", "c", "x_w", "omega")}
    exact = reference.simulate(reference.ImpactOscillator(**parameters), 100.0, tuple(y0))
    sol = solve(single(model), 0.0, 100.0, single(y0), solver=solver)
    assert sol.y1.x.dtype == jnp.float32 and len(exact.events) > 5
    assert itinerary(sol) == [("wall", 0, 0)] * len(exact.events)
    np.testing.assert_allclose(times(sol), [float(e.t) for e in exact.events], atol=1e-4)
    np.testing.assert_allclose(flat(sol.y1), reference.floats(exact.y), atol=1e-4)


def test_jax_as_it_comes():
    """Where nobody has called for 64 bits there are not even integers of them."""
    exact = reference.simulate(reference.StickSlip(), 20.0, (2.5, -0.5))
    with jax.enable_x64(False):

        def end(v):
            sol = solve(gallery.StickSlip(v_dr=v), 0.0, 20.0, Motion(2.5, -0.5))
            return sol.y1.x, sol

        _, slope, sol = jax.jvp(end, (jnp.asarray(0.2),), (jnp.ones(()),), has_aux=True)
    np.testing.assert_allclose(times(sol), [float(e.t) for e in exact.events], atol=1e-3)
    np.testing.assert_allclose(flat(sol.y1), reference.floats(exact.y), atol=1e-3)
    known = reference.solution(reference.StickSlip, 20.0, (2.5, -0.5), wrt=("v_dr",), v_dr=0.2).derivative
    np.testing.assert_allclose(slope, float(known[0, 2]), rtol=1e-3)


@pytest.mark.slow
def test_orbit_with_jax_as_it_comes():
    with jax.enable_x64(False):
        orbit = find_orbit(gallery.StickSlip(), Motion(2.5, -0.5), period=12.0)
    np.testing.assert_allclose(orbit.period, reference.stick_slip_period(0.2), rtol=1e-4)


@pytest.mark.parametrize("rtol", [1e-8, 5e-7, np.float32(1e-7), np.float64(1e-10)])
def test_tolerance_below_single_precision(rtol):
    y0 = single(Motion(2.5, -0.5))
    control = dfx.PIDController(rtol=rtol, atol=1e-6)
    with pytest.raises(ValueError, match="`stepsize_controller` must .*float32 can hold.*, but .*jax_enable_x64"):
        solve(gallery.StickSlip(), 0.0, 10.0, y0, stepsize_controller=control)


def test_smallest_tolerance_of_single_precision():
    """The one that is just allowed works."""
    sol = solve(single(gallery.StickSlip()), 0.0, 40.0, single(Motion(2.5, -0.5)), stepsize_controller=pid(1e-6))
    exact = reference.simulate(reference.StickSlip(), 40.0, (2.5, -0.5))
    np.testing.assert_allclose(flat(sol.y1), reference.floats(exact.y), atol=1e-3)
    assert sol.stats["num_steps"] < 1000


# Long times.


LONG = dict(stepsize_controller=pid(1e-10), max_steps=200_000, max_events=2048)


def test_late_start():
    """Pitfall 28: from t = 1e6 as from 0, where a unit in the last place is 1e-10."""
    exact = reference.simulate(reference.StickSlip(), 60.0, (2.5, -0.5))
    sol = solve(gallery.StickSlip(), 1e6, 1e6 + 60, Motion(2.5, -0.5), **LONG)
    np.testing.assert_allclose(times(sol) - 1e6, [float(e.t) for e in exact.events], atol=1e-7)
    np.testing.assert_allclose(flat(sol.y1), reference.floats(exact.y), atol=1e-7)
    exact = reference.simulate(reference.ImpactOscillator(e=0.9), 1e6 + 20, (1.0, 0.0), t0=1e6)
    sol = solve(Hammer(e=0.9), 1e6, 1e6 + 20, Motion(1.0, 0.0), **LONG)
    assert len(exact.events) >= 4
    np.testing.assert_allclose(times(sol) - 1e6, [float(e.t - 10**6) for e in exact.events], atol=1e-7)
    np.testing.assert_allclose(flat(sol.y1), reference.floats(exact.y), atol=1e-6)


def test_long_run():
    """Pitfall 28: 1500 events."""
    sol = solve(gallery.StickSlip(), 0.0, 1e4, Motion(2.5, -0.5), **LONG)
    assert 1470 < len(sol.events) < 1480
    exact = reference.stick_slip_final(np.array([0.2]), 1e4)[0]
    np.testing.assert_allclose(flat(sol.y1), exact, atol=1e-5)
    gaps = np.diff(times(sol)[2::2])
    np.testing.assert_allclose(gaps, reference.stick_slip_period(0.2), atol=1e-7)


def test_time_that_cannot_advance():
    """Pitfall 28: at t = 1e8 a unit in the last place of single precision is 8: told, not looped on."""
    system, y0 = single(gallery.StickSlip()), single(Motion(2.5, -0.5))
    sol = solve(system, 1e8, 1e8 + 64, y0, stepsize_controller=pid(1e-5), throw=False)
    assert sol.result == RESULTS.dt_min_reached and sol.stats["num_steps"] < 500


class Singular(nsjax.System):
    """x' = x^p."""

    p: float

    def vector_field(self, t, y, s):
        return Point(y.x**self.p)


@pytest.mark.parametrize("p, end", [(2.0, 1.0), (3.0, 0.5)])
def test_end_of_a_solution(p, end):
    """Pitfall 30: where it grows without bound in finite time the steps become as short as the digits of t."""
    sol = solve(Singular(p), 0.0, 2.0, Point(1.0), throw=False, max_steps=20_000)
    assert sol.result in (RESULTS.dt_min_reached, RESULTS.nonfinite_field)
    np.testing.assert_allclose(sol.t1, end, rtol=1e-5)
    assert sol.stats["num_steps"] < 5000


def long_stick(k, adjoint=dfx.ForwardMode()):
    system = gallery.ForcedStickSlip(v_dr=1e-3, f_0=0.0, k=k)
    return solve(system, 0.0, 4000.0, Motion(0.0, 1e-3), throw=False, max_events=64, adjoint=adjoint)


def test_step_that_overflows():
    """Pitfalls 11, 28: after a stick of 1500 the first step is tried with a length of thousands, in which a cubic field
    overflows; it is to be rejected like any other."""
    sol = long_stick(1.0)
    assert sol.result == RESULTS.successful and len(sol.events) >= 2
    np.testing.assert_allclose(times(sol)[0], 1500.0, rtol=1e-6)


@pytest.mark.slow
def test_gradient_after_a_step_that_overflows():
    """Pitfall 18: what it has been rejected for does not reach the gradient."""
    back = jax.grad(lambda k: long_stick(k, dfx.RecursiveCheckpointAdjoint()).y1.x)(1.0)
    np.testing.assert_allclose(back, jax.jacfwd(lambda k: long_stick(k).y1.x)(1.0), rtol=1e-6)


# Units.


@pytest.mark.parametrize("length, time", [(1e-9, 1.0), (1e9, 1.0), (1.0, 1e-6), (1.0, 1e6), (1e-6, 1e-3)])
def test_units_do_not_matter(length, time):
    """Pitfall 27: states of 1e-9 and 1e9, times of microseconds and of weeks, tolerances in the same units."""
    force = length / time**2
    system = gallery.StickSlip(
        k=time**-2, v_dr=0.2 * length / time, F_slip=force, F_stick=2 * force, c=0.05 / time
    )  # fmt: skip
    y0 = Motion(2.5 * length, -0.5 * length / time)
    control = dfx.PIDController(rtol=1e-10, atol=1e-12 * length * min(1, 1 / time))
    sol = solve(system, 0.0, 60.0 * time, y0, **LONG | dict(stepsize_controller=control))
    exact = reference.simulate(reference.StickSlip(c=0.05), 60.0, (2.5, -0.5))
    np.testing.assert_allclose(times(sol) / time, [float(e.t) for e in exact.events], atol=1e-7)
    np.testing.assert_allclose(flat(sol.y1) / [length, length / time], reference.floats(exact.y), atol=1e-7)
