"""The same models in other units of state, time and surface: the same events, and the same statuses."""

import functools as ft
from typing import Any

import diffrax
import jax
import jax.flatten_util as jfu
import jax.numpy as jnp
import numpy as np
import pytest

import nsjax
from nsjax import gallery
from nsjax.system._clock import clock


QUICK = ("1.1(3)", "6.6")
CASES = {  # units of the state (None: of each component another one), of the time, and of surfaces
    "large numbers": (1e9, 1.0, 1e9),
    "small numbers": (1e-9, 1e-3, 1e-9),
    "fast": (1.0, 1e-9, 1.0),
    "slow": (1e6, 1e9, 1e-6),
    "mixed": (None, 1e3, 1e-3),
}
FORGOTTEN = 1e-9  # the derivative of an end that the start has no effect on
ERROR = 1e-5  # of times of events and derivatives, relative to the largest, at the tolerance 1e-8


class Rescaled(nsjax.System):
    """A model whose time is counted in `1 / time` of its unit, and whose states and surfaces in `1 / state` and
    `1 / surface` of theirs."""

    system: nsjax.System
    state: Any
    time: Any
    surface: Any

    def vector_field(self, t, y, s):
        inner = self.system.vector_field(*self.inside(t, y), s)
        return jax.tree.map(lambda rate, unit: rate * unit / self.time, inner, self.state)

    def inside(self, t, y):
        """The time and the state in the units of the model."""
        return t / self.time, jax.tree.map(jnp.divide, y, self.state)

    @property
    def switches(self):
        return tuple(rescaled(switch) for switch in self.system.switches)

    @property
    def jumps_in_time(self):
        return self.system.jumps_in_time

    def values(self, s):
        return self.system.values(s)


@ft.cache  # switches are told apart by identity
def rescaled(switch):
    def parameter(fn):
        return lambda self: fn(self.system) * (self.time if isinstance(switch, clock) else 1.0)

    def surface(fn):
        def guard(self, t, y):
            h = fn(self.system, *self.inside(t, y))
            return tuple(part * self.surface for part in h) if isinstance(h, tuple) else h * self.surface

        return guard

    def jump(fn):
        return lambda self, t, y: jax.tree.map(jnp.multiply, fn(self.system, *self.inside(t, y)), self.state)

    kinds = {"reset_fn": jump, "inverse_fn": jump}
    if not isinstance(switch, clock):
        kinds |= {"guard": surface, "off_guard": surface}
    functions = {name: fn for name, fn in vars(switch).items() if callable(fn)}
    return switch._with(**{name: kinds.get(name, parameter)(fn) for name, fn in functions.items()})


def start_of(key):
    return jax.tree.map(jnp.asarray, gallery.entry(key).y0)


@ft.cache
def program(key):
    """Of the units of the state, the time and surfaces: the solution in these, and the times of its events and its
    derivative by the start in those of the model."""
    entry = gallery.entry(key)

    @jax.jit
    def run(state, time, surface):
        system = Rescaled(entry.system(), state, time, surface)
        controller = diffrax.PIDController(1e-8, 1e-8 * ft.reduce(jnp.minimum, jax.tree.leaves(state)))

        def end(y0):
            sol = nsjax.solve(
                system, entry.t0 * time, entry.t1 * time, y0, throw=False, stepsize_controller=controller,
                max_steps=2**15, max_events=2**11,
            )  # fmt: skip
            return jfu.ravel_pytree(sol.y1)[0], sol

        y0, unflatten = jfu.ravel_pytree(jax.tree.map(jnp.multiply, start_of(key), state))
        unit = jfu.ravel_pytree(jax.tree.map(lambda leaf, unit: jnp.full_like(leaf, unit), start_of(key), state))[0]
        matrix, sol = jax.jacfwd(lambda y0: end(unflatten(y0)), has_aux=True)(y0)
        return sol, sol.events.t / time, matrix * unit / unit[:, None]

    return run


@ft.cache
def solved(key, units=(1.0, 1.0, 1.0)):
    rng, (state, time, surface) = np.random.default_rng(1), units
    states = jax.tree.map(lambda leaf: jnp.asarray(state or 10.0 ** rng.uniform(-2, 2)), start_of(key))
    return program(key)(states, jnp.asarray(time), jnp.asarray(surface))


def differences(key, case):
    """Of the solution in other units from that in the model's: whether status, itinerary and `unique` are the same, and
    by how much the times of events and the derivative differ, relative to the last time and the largest derivative."""
    want, times, matrix = map(jax.device_get, solved(key))
    sol, other_times, other_matrix = map(jax.device_get, solved(key, CASES[case]))
    num = int(want.events.num)
    alike = sol.result == want.result, bool(sol.itinerary.same_as(want.itinerary)), bool(sol.unique == want.unique)
    late = np.max(np.abs(other_times[:num] - times[:num]), initial=0.0) / np.max(np.abs(times[:num]), initial=1.0)
    size = np.max(np.abs(matrix))  # zero where all solutions come to rest
    return alike, late, np.max(np.abs(other_matrix - matrix)) / (size if size > FORGOTTEN else 1.0)


@pytest.mark.parametrize("case", CASES)
@pytest.mark.parametrize("key", QUICK)
def test_other_units(key, case):
    alike, late, off = differences(key, case)
    assert all(alike), alike
    assert late < ERROR and off < ERROR, (late, off)


@pytest.mark.slow
@pytest.mark.parametrize("case", CASES)
@pytest.mark.parametrize("key", [key for key in gallery.SYSTEMS if key not in QUICK])
def test_other_units_of_the_gallery(key, case):
    alike, late, off = differences(key, case)
    assert all(alike), alike
    assert late < ERROR and off < ERROR, (late, off)
