"""Orbits of autonomous models with impacts and resets, without a guess of the period."""

from typing import Any, NamedTuple

import jax.numpy as jnp
import numpy as np
import pytest
from models import Motion
from scipy.integrate import solve_ivp
from scipy.optimize import fsolve

import nsjax
from nsjax import RESULTS, SolveError


class RimlessWheel(nsjax.System):
    """A wheel of spokes that rolls down a slope: θ'' = sin θ, and the next spoke at θ = γ + α."""

    alpha: Any
    gamma: Any

    def vector_field(self, t, y, s):
        return Motion(y.v, jnp.sin(y.x))

    @nsjax.impact
    def step(self, t, y):
        return self.gamma + self.alpha - y.x

    @step.reset
    def step(self, t, y):
        return Motion(y.x - 2 * self.alpha, jnp.cos(2 * self.alpha) * y.v)


def rolling(alpha, gamma):
    """Period and multiplier: between two steps ω² grows by 2 (cos(γ - α) - cos(γ + α)), and falls to cos² 2α of it."""
    keep = np.cos(2 * alpha) ** 2
    first = keep * 2 * (np.cos(gamma - alpha) - np.cos(gamma + alpha)) / (1 - keep)

    def field(t, y):
        return [y[1], np.sin(y[0])]

    def step(t, y):
        return y[0] - gamma - alpha

    step.terminal = True
    start = [gamma - alpha, np.sqrt(first)]
    return solve_ivp(field, (0, 50), start, events=step, rtol=1e-12, atol=1e-13).t_events[0][0], keep


@pytest.mark.parametrize("alpha, gamma", [(0.4, 0.08), (0.3, 0.15)])
def test_rimless_wheel(alpha, gamma):
    """A solution that ends in an event returns to the state after it, which no point between two events is near to."""
    period, keep = rolling(alpha, gamma)
    orbit = nsjax.find_orbit(RimlessWheel(alpha, gamma), Motion(0.0, 0.9))
    np.testing.assert_allclose(orbit.period, period, rtol=1e-9)
    np.testing.assert_allclose(sorted(np.abs(orbit.multipliers)), [keep, 1.0], rtol=1e-7)


class Driven(nsjax.System):
    """A damped oscillator that gains speed at a wall."""

    def vector_field(self, t, y, s):
        return Motion(y.v, -y.x - 0.1 * y.v)

    @nsjax.impact
    def wall(self, t, y):
        return y.x + 0.2

    @wall.reset
    def wall(self, t, y):
        return Motion(y.x, 0.3 - y.v)


def test_a_wall_that_drives():
    orbit = nsjax.find_orbit(Driven(), Motion(0.5, 0.0))
    np.testing.assert_allclose(orbit.period, 3.3914, atol=5e-5)
    # By Liouville's formula, with the determinant (v - 0.3) / v of the saltation matrix.
    v = float(orbit.events.y_before.v[0])
    want = np.exp(-0.1 * float(orbit.period)) * (v - 0.3) / v
    np.testing.assert_allclose(np.prod(np.real(orbit.multipliers)), want, rtol=1e-7)


def test_a_guess_beyond_the_wall():
    """There is no solution from it, which is an error only where errors are wanted."""
    orbit = nsjax.find_orbit(Driven(), Motion(-3.0, 0.5), period=3.0, throw=False)
    assert orbit.result == RESULTS.orbit_not_found and 0 < float(orbit.period) < np.inf
    with pytest.raises(SolveError, match="The solution from the guess fails: The start .*x = -3"):
        nsjax.find_orbit(Driven(), Motion(-3.0, 0.5), period=3.0)


class Legs(NamedTuple):
    theta: Any
    dtheta: Any
    phi: Any
    dphi: Any


class SimplestWalker(nsjax.System):
    """Garcia, Chatterjee, Ruina and Coleman (1998); the swinging foot does not scuff."""

    gamma: Any = 0.01

    def vector_field(self, t, y, s):
        pull = jnp.sin(y.theta - self.gamma)
        swing = pull + (y.dtheta**2 - jnp.cos(y.theta - self.gamma)) * jnp.sin(y.phi)
        return Legs(y.dtheta, pull, y.dphi, swing)

    @nsjax.impact
    def heel(self, t, y):
        return jnp.maximum(2 * y.theta - y.phi, y.theta + 0.05)

    @heel.reset
    def heel(self, t, y):
        keep = jnp.cos(2 * y.theta)
        return Legs(-y.theta, keep * y.dtheta, -2 * y.theta, keep * (1 - keep) * y.dtheta)


def walking(gamma):
    """The gait by scipy: period, and the state after the heel's strike."""

    def field(t, y):
        pull = np.sin(y[0] - gamma)
        return [y[1], pull, y[3], pull + (y[1] ** 2 - np.cos(y[0] - gamma)) * np.sin(y[2])]

    def heel(t, y):
        return max(2 * y[0] - y[2], y[0] + 0.05)

    heel.terminal, heel.direction = True, -1

    def step(z):
        args = dict(events=heel, rtol=1e-12, atol=1e-12, method="DOP853")
        sol = solve_ivp(field, (0, 10), [z[0], z[1], 2 * z[0], z[2]], **args)
        (theta, dtheta, _, _), keep = sol.y_events[0][0], np.cos(2 * sol.y_events[0][0][0])
        return np.array([-theta, keep * dtheta, keep * (1 - keep) * dtheta]), sol.t_events[0][0]

    z = fsolve(lambda z: step(z)[0] - z, [0.2003109, -0.19983247, -0.015823], xtol=1e-13)
    return step(z)[1], z


def test_simplest_walker():
    period, _ = walking(0.01)
    orbit = nsjax.find_orbit(SimplestWalker(), Legs(0.2, -0.2, 0.4, -0.015))
    np.testing.assert_allclose(orbit.period, period, rtol=1e-9)
    assert bool(orbit.stable)


class Toppling(nsjax.System):
    def vector_field(self, t, y, s):
        return Motion(y.v, jnp.sinh(y.x))


def test_a_search_says_why_the_solution_from_the_guess_ends():
    with pytest.raises(SolveError, match="The solution from the guess fails: .* t = 4.379.* beyond all bounds"):
        nsjax.find_orbit(Toppling(), Motion(0.1, 0.0))
