"""Models in other units of state, time and surface."""

import functools as ft
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

import nsjax
from nsjax import gallery
from nsjax.system._clock import clock


class Rescaled(nsjax.System):
    """A model whose time is counted in `1 / time` of its unit, and whose states and surfaces in `1 / state` and
    `1 / surface` of theirs. A `state` is a structure like the model's, so that each component may have another unit."""

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

    def outside(self, y):
        """A state of the model in the other units."""
        return jax.tree.map(jnp.multiply, y, self.state)

    @property
    def period(self):
        return None if self.system.period is None else self.system.period * self.time

    @property
    def switches(self):
        return tuple(_rescaled(switch) for switch in self.system.switches)

    @property
    def jumps_in_time(self):
        return self.system.jumps_in_time

    def values(self, s):
        return self.system.values(s)


UNITS = {  # of the state (None: of each component another one), of the time, and of surfaces
    "large numbers": (1e9, 1.0, 1e9),
    "small numbers": (1e-9, 1e-3, 1e-9),
    "fast": (1.0, 1e-9, 1.0),
    "slow": (1e6, 1e9, 1e-6),
    "mixed": (None, 1e3, 1e-3),
}


def is_forced(key):
    """Whether a gallery entry declares a period, which is not worked out for this."""
    return type(gallery.entry(key).system()).period is not nsjax.System.period


def rescaled(system, like, case=None):
    """Returns a model, whose states are like `like`, in some `UNITS`, or in its own."""
    rng, (state, time, surface) = np.random.default_rng(1), UNITS.get(case, (1.0, 1.0, 1.0))
    states = jax.tree.map(lambda leaf: jnp.asarray(state or 10.0 ** rng.uniform(-2, 2)), like)
    return Rescaled(system, states, jnp.asarray(time), jnp.asarray(surface))


@ft.cache  # switches are told apart by identity
def _rescaled(switch):
    def parameter(fn):
        return lambda self: fn(self.system) * (self.time if isinstance(switch, clock) else 1.0)

    def surface(fn):
        def guard(self, t, y):
            h = fn(self.system, *self.inside(t, y))
            return tuple(part * self.surface for part in h) if isinstance(h, tuple) else h * self.surface

        return guard

    def jump(fn):
        return lambda self, t, y: self.outside(fn(self.system, *self.inside(t, y)))

    kinds = {"reset_fn": jump, "inverse_fn": jump}
    if not isinstance(switch, clock):
        kinds |= {"guard": surface, "off_guard": surface}
    functions = {name: fn for name, fn in vars(switch).items() if callable(fn)}
    return switch._with(**{name: kinds.get(name, parameter)(fn) for name, fn in functions.items()})
