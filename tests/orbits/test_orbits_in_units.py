"""The same periodic orbits in other units of state, time and surface, by every formulation."""

import functools as ft

import jax
import jax.flatten_util as jfu
import jax.numpy as jnp
import numpy as np
import pytest
from rescaled import is_forced, rescaled, UNITS

import nsjax
from nsjax import gallery
from nsjax.flow._results import is_okay


QUICK = ("3.4", "1.1(2)")  # autonomous and forced
ORBITS = [key for key in gallery.SYSTEMS if gallery.entry(key).orbit is not None]
CASES = ["mixed", *[pytest.param(case, marks=pytest.mark.slow) for case in UNITS if case != "mixed"]]
ERROR = 1e-9  # of periods, states and multipliers, relative to the largest


@ft.cache
def found(key, case=None, method="shooting"):
    """The orbit in some units; its period, base point and multipliers in those of the model."""
    entry, guess = gallery.entry(key), gallery.entry(key).orbit
    system = rescaled(entry.system(), jax.tree.map(jnp.asarray, guess.y0), case)
    least = min(1.0, *map(float, jax.tree.leaves(system.state)))
    options = dict(order=guess.order, t0=entry.t0 * system.time, rtol=1e-12, atol=1e-12 * least, throw=False)
    if method != "nothing":
        options |= dict(method=method)
        options |= {} if system.period is not None else dict(period=guess.period * system.time)
    orbit = nsjax.find_orbit(system, system.outside(guess.y0), **options)
    state = jax.tree.map(jnp.divide, orbit.y0, system.state)
    multipliers = np.sort(np.abs(orbit.multipliers))
    return orbit, float(orbit.period / system.time), np.asarray(jfu.ravel_pytree(state)[0]), multipliers


def check(key, case, method):
    orbit, period, state, multipliers = found(key, case, method)
    model, period_of_model, state_of_model, multipliers_of_model = found(key, None, method)
    assert is_okay(model.result) and is_okay(orbit.result), (model.result, orbit.result)
    assert orbit.itinerary.same_as(model.itinerary)
    assert abs(period - period_of_model) < ERROR * period_of_model
    assert np.max(np.abs(multipliers - multipliers_of_model)) < ERROR * max(1, multipliers_of_model.max())
    # A base point of an autonomous orbit depends on the guess.
    if model.system.period is not None:
        assert np.max(np.abs(state - state_of_model)) < ERROR * np.max(np.abs(state_of_model))
    path = orbit.path()
    assert all(np.all(np.isfinite(leaf)) for leaf in jax.tree.leaves(path.y))


@pytest.mark.parametrize("case", CASES)
@pytest.mark.parametrize("key", QUICK)
def test_orbits(key, case):
    """Pitfalls 27, 51."""
    check(key, case, "shooting")


@pytest.mark.slow
def test_segments():
    check("1.1(2)", "large numbers", "segments")


@pytest.mark.parametrize("case", CASES)
def test_without_a_period(case):
    check("3.4", case, "nothing")


@ft.cache
def reduced(case=None):
    """The reduced map of x, and the velocity that repeats itself, in the units of the model."""
    entry = gallery.entry("1.1(1)")
    system = rescaled(entry.system(), jax.tree.map(jnp.asarray, entry.orbit.y0), case)
    start, least = system.outside(entry.orbit.y0), min(1.0, *map(float, jax.tree.leaves(system.state)))
    image = nsjax.reduced_map(system, 1.02 * start.x, "x", guess=start, rtol=1e-12, atol=1e-12 * least)
    return float(image.value / system.state.x), float(image.y.v / system.state.v)


@pytest.mark.parametrize("case", CASES)
def test_reduced_map(case):
    np.testing.assert_allclose(reduced(case), reduced(), rtol=1e-10)


@pytest.mark.slow
@pytest.mark.parametrize("case", UNITS)
def test_within_a_program(case):
    """Newton's method of optimistix, as under `jit` and `vmap`."""
    want, period, *_ = found("3.4", case)
    orbit = searched(want.integrator)(want.system, want.system.outside(gallery.entry("3.4").orbit.y0))
    assert is_okay(orbit.result)
    assert abs(orbit.period / want.system.time - period) < ERROR * period


@ft.cache
def searched(integrator):
    controller = integrator.stepsize_controller

    @jax.jit
    def run(system, y0):
        period = 13.54 * system.time
        return nsjax.find_orbit(system, y0, period=period, stepsize_controller=controller, throw=False)

    return run


@pytest.mark.slow
@pytest.mark.parametrize("method", ["shooting", "segments"])
@pytest.mark.parametrize("case", UNITS)
@pytest.mark.parametrize("key", ORBITS)
def test_the_gallery(key, case, method):
    check(key, case, method)


@pytest.mark.slow
@pytest.mark.parametrize("case", UNITS)
@pytest.mark.parametrize("key", [key for key in ORBITS if not is_forced(key)])
def test_the_gallery_without_periods(key, case):
    check(key, case, "nothing")
