"""The same equilibria in other units of state, time and surface."""

import functools as ft

import jax
import jax.flatten_util as jfu
import jax.numpy as jnp
import numpy as np
import pytest
from rescaled import is_forced, rescaled, UNITS

import nsjax
from nsjax import gallery


QUICK = ("3.4", "5.2", "neuron")  # held by a surface, in a region, virtual
REST = {"relay servo", "example 2.1", "example 2.2", "example 2.3"}  # without one
KEYS = [key for key in gallery.SYSTEMS if not is_forced(key) and key not in REST]


@ft.cache
def found(key, case=None):
    """The equilibrium near the start, and its state, eigenvalues and slopes in the units of the model."""
    entry = gallery.entry(key)
    start = jax.tree.map(lambda leaf: jnp.asarray(leaf) + 0.1, entry.y0)
    system = rescaled(entry.system(), start, case)
    place = nsjax.find_equilibrium(system, system.outside(start), throw=False)
    state = jfu.ravel_pytree(jax.tree.map(jnp.divide, place.y, system.state))[0]
    return place, np.asarray(state), np.asarray(place.eigenvalues * system.time)


def check(key, case):
    (model, state_of_model, roots_of_model), (place, state, roots) = found(key), found(key, case)
    for name in ("result", "stable", "admissible", "boundary", "isolated"):
        assert bool(getattr(place, name) == getattr(model, name)), name
    assert np.array_equal(place.mode, model.mode)
    assert np.max(np.abs(state - state_of_model)) < 1e-8 * max(1, np.max(np.abs(state_of_model)))
    free = np.isfinite(roots_of_model)
    assert np.array_equal(free, np.isfinite(roots))
    size = max(1, np.max(np.abs(roots_of_model[free]), initial=0))
    assert np.max(np.abs(roots - roots_of_model)[free], initial=0) < 1e-6 * size


@pytest.mark.parametrize("case", UNITS)
@pytest.mark.parametrize("key", QUICK)
def test_other_units(key, case):
    check(key, case)


@pytest.mark.slow
@pytest.mark.parametrize("case", UNITS)
@pytest.mark.parametrize("key", KEYS)
def test_other_units_of_the_gallery(key, case):
    check(key, case)


class Valley(nsjax.System):
    """A mass with two equilibria, at rest on either side."""

    unit: float = 1.0

    def vector_field(self, t, y, s):
        x = y["x"] / self.unit
        return {"x": y["v"], "v": self.unit * (x - x**3) - 0.1 * y["v"]}


@pytest.mark.parametrize("unit", [1e-9, 1.0, 1e9])
def test_distinct_equilibria(unit):
    starts = {"x": unit * jnp.linspace(-1.3, 1.3, 14), "v": jnp.zeros(14)}
    places = nsjax.find_equilibria(Valley(unit), starts)
    assert np.allclose(sorted(float(place.y["x"]) / unit for place in places), [-1, 0, 1], atol=1e-9)


@pytest.mark.parametrize("omega", [2.5298221281347035, 2.6])
def test_a_guess_within_rounding_of_an_equilibrium_at_zero(omega):
    """Neither the guess nor what Newton's method leaves of it is a size: all that the equations add to it is rounding."""
    scene = gallery.thesis("A.7", omega=omega, coordinates="cartesian")
    random = np.random.default_rng(1)
    guesses = 10 ** random.uniform(-15, -3, (200, 1)) * random.uniform(-1, 1, (200, 4))
    unravel = jfu.ravel_pytree(scene.state())[1]
    places = jax.vmap(lambda x: nsjax.find_equilibrium(scene, unravel(x), throw=False))(guesses)
    assert np.all(places.result == nsjax.RESULTS.successful) and np.all(places.admissible)
    assert np.all(np.abs(jax.vmap(lambda y: jfu.ravel_pytree(y)[0])(places.y)) < 1e-20)
