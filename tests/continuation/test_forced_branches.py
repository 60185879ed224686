"""Branches of forced orbits: of a model with a clock through its flips, and of orbits that slide all along."""

from typing import Any, NamedTuple

import jax.numpy as jnp
import numpy as np

import nsjax


class Current(NamedTuple):
    v: Any  # [V]
    i: Any  # [A]


class BuckConverter(nsjax.System):
    """The voltage-controlled DC/DC buck converter, with time in ms."""

    V_in: Any = 18.0

    def vector_field(self, t, y, s):
        return Current((y.i - y.v / 22) / 0.047, (self.V_in * 0.5 * (1 - s.comparator) - y.v) / 20)

    @nsjax.clock
    def ramp(self):
        return 0.4

    @nsjax.sgn
    def comparator(self, t, y):
        return 8.4 * (y.v - 11.3) - (3.8 + 4.4 * ((t % 0.4) / 0.4))

    @property
    def period(self):
        return 0.4


def test_the_flips_of_a_model_with_a_clock():
    """On an orbit that is passed twice its clock has gone on in the second lap."""
    orbit = nsjax.find_orbit(BuckConverter(), Current(12.0, 0.5), order=None)
    branch = nsjax.continue_orbit(orbit.system, orbit, "V_in", (18.0, 31.5), max_laps=2)
    np.testing.assert_allclose([b.value for b in branch.bifurcations], [24.51657282856, 31.1179020], rtol=1e-8)
    (doubled,) = branch.others
    np.testing.assert_allclose(doubled.periods[1:], 0.8)  # (it begins at the flip)
    # The flow finds the same orbit again.
    again = doubled.orbit(len(doubled.values) // 2)
    end = nsjax.solve(again.system, again.t0, again.t0 + 0.8, again.y0, mode=None, rtol=1e-10, atol=1e-10)
    np.testing.assert_allclose(end.y1, again.y0, rtol=1e-7)


class Held(NamedTuple):
    x: Any
    v: Any
    u: Any


class HeldThroughout(nsjax.System):
    """A driven oscillator whose position acts on a switch that holds u = 0, as long as |2x| <= 3."""

    V: Any = 1.0

    def vector_field(self, t, y, s):
        return Held(y.v, -y.x - 0.1 * y.v + self.V * jnp.cos(2 * t), -3 * s.hold - 2 * y.x)

    @nsjax.sgn
    def hold(self, t, y):
        return y.u

    @property
    def period(self):
        return jnp.pi


def test_an_orbit_that_slides_all_along():
    """|x| = V / |(i2)² + 0.2i + 1|; at 3/2 the switch lets go, and the orbit goes on with four events."""
    orbit = nsjax.find_orbit(HeldThroughout(), Held(0.0, 0.0, 0.0))
    branch = nsjax.continue_orbit(orbit.system, orbit, "V", (0.5, 6.0))
    (transition,) = branch.special_points
    assert "no bifurcation: sliding-mode transition" in str(branch) and not branch.bifurcations
    np.testing.assert_allclose(transition.value, 1.5 * abs(1 + 0.2j - 4), rtol=1e-9)
    assert branch.values[-1] == 6.0 and np.all(branch.stable)
    assert int(branch.orbit(len(branch.values) - 1).events.num) == 4
