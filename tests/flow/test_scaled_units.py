"""The same models in other units of state, time and surface: the same events, and the same statuses."""

import functools as ft

import diffrax
import equinox as eqx
import jax
import jax.flatten_util as jfu
import jax.numpy as jnp
import numpy as np
import pytest
from rescaled import rescaled, UNITS

import nsjax
from nsjax import gallery


QUICK = ("1.1(3)",)
ERROR = 1e-5  # of times of events and derivatives, relative to the largest, at the tolerance 1e-8
FORGOTTEN = 5e-7  # the error of a derivative, which is 1 at the start, where hardly anything of it is left


def start_of(key):
    return jax.tree.map(jnp.asarray, gallery.entry(key).y0)


@ft.cache
def program(key):
    """Of a gallery entry in some units: the solution in these, and the times of its events and its derivative by the
    start in those of the model."""
    entry = gallery.entry(key)

    @eqx.filter_jit  # numbers of a model are not traced: one may be that of its masses
    def run(system):
        controller = diffrax.PIDController(1e-8, 1e-8 * ft.reduce(jnp.minimum, jax.tree.leaves(system.state)))

        def end(y0):
            sol = nsjax.solve(
                system, entry.t0 * system.time, entry.t1 * system.time, y0, throw=False,
                stepsize_controller=controller, max_steps=2**15, max_events=2**11,
            )  # fmt: skip
            return jfu.ravel_pytree(sol.y1)[0], sol

        y0, unflatten = jfu.ravel_pytree(system.outside(start_of(key)))
        unit = jfu.ravel_pytree(system.outside(jax.tree.map(jnp.ones_like, start_of(key))))[0]
        matrix, sol = jax.jacfwd(lambda y0: end(unflatten(y0)), has_aux=True)(y0)
        return sol, sol.events.t / system.time, matrix * unit / unit[:, None]

    return run


@ft.cache
def solved(key, case=None):
    return program(key)(rescaled(gallery.entry(key).system(), start_of(key), case))


def differences(key, case):
    """Compares the solution in other units with that in the model's: whether status, itinerary and `unique` are the
    same; the difference of the times of events, relative to the last time; and that of the derivative, relative to
    what may be expected of its largest entry."""
    want, times, matrix = map(jax.device_get, solved(key))
    sol, other_times, other_matrix = map(jax.device_get, solved(key, case))
    num = int(want.events.num)
    alike = sol.result == want.result, bool(sol.itinerary.same_as(want.itinerary)), bool(sol.unique == want.unique)
    late = np.max(np.abs(other_times[:num] - times[:num]), initial=0.0) / np.max(np.abs(times[:num]), initial=1.0)
    expected = ERROR * np.max(np.abs(matrix)) + FORGOTTEN
    return alike, late, np.max(np.abs(other_matrix - matrix)) / expected


@pytest.mark.parametrize("case", UNITS)
@pytest.mark.parametrize("key", QUICK)
def test_other_units(key, case):
    """Pitfalls 27, 51."""
    alike, late, off = differences(key, case)
    assert all(alike), alike
    assert late < ERROR and off < 1, (late, off)


@pytest.mark.slow
@pytest.mark.parametrize("case", UNITS)
@pytest.mark.parametrize("key", [key for key in gallery.SYSTEMS if key not in QUICK])
def test_other_units_of_the_gallery(key, case):
    alike, late, off = differences(key, case)
    assert all(alike), alike
    assert late < ERROR and off < 1, (late, off)
