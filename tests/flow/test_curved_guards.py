"""Runge-Kutta steps are as long as polynomials can stand for the guards, and few are taken twice to find that out."""

import diffrax as dfx
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.optimize import brentq

import nsjax


class Wave(nsjax.System):
    """Nothing but the guard asks for short steps."""

    rate: float = 10.0

    def vector_field(self, t, y, s):
        return self.rate + 0 * y * s.crossed

    @nsjax.sgn
    def crossed(self, t, y):
        return jnp.sin(jnp.pi * y)


class Kinked(nsjax.System):
    """A kink of the guard off its zeros, at sin y = 0.3, which no polynomial stands for."""

    def vector_field(self, t, y, s):
        return 1.0 + 0 * y * s.crossed

    @nsjax.sgn
    def crossed(self, t, y):
        return jnp.abs(jnp.sin(y) - 0.3) - 0.2


class Packet(nsjax.System):
    """A guard that is smooth but for a short wave of many zeros, about y = 1."""

    def vector_field(self, t, y, s):
        return 1.0 + 0 * y * s.crossed

    @nsjax.sgn
    def crossed(self, t, y):
        return packet(y)


def packet(y):
    return 1.5 - 0.5 * y + 2 * jnp.exp(-((8 * (y - 1)) ** 2)) * jnp.sin(100 * y)


def solved(system, t1, y0, solver):
    return nsjax.solve(system, 0.0, t1, y0, solver=solver, rtol=1e-8, atol=1e-8, max_steps=4096, max_events=64)


def times(sol):
    return np.array([float(event.t) for event in sol.events])


@pytest.mark.parametrize("solver, most", [(dfx.Tsit5(), 65), (dfx.Dopri8(), 45)], ids=["Tsit5", "Dopri8"])
def test_steps_follow_the_guard(solver, most):
    """Without a step that is taken twice, from a first one that is far too short."""
    sol = solved(Wave(), 2.0, 0.5, solver)
    np.testing.assert_allclose(times(sol), (np.arange(1, 21) - 0.5) / 10, atol=1e-12)
    assert sol.stats["num_rejected_steps"] == 0
    assert sol.stats["num_steps"] <= most


def test_steps_grow_again_after_a_kink():
    sol = solved(Kinked(), 40.0, 0.0, dfx.Tsit5())
    low, high = np.arcsin(0.1), np.arcsin(0.5)
    want = np.sort([2 * np.pi * k + x for k in range(7) for x in (low, high, np.pi - high, np.pi - low)])
    np.testing.assert_allclose(times(sol), want[want < 40.0], atol=1e-11)
    assert sol.stats["num_steps"] < 62 * 13  # kinks, each of which takes steps down to rounding


def test_from_long_steps_to_short_ones():
    """What long steps resolved says nothing of what comes: no zero is missed."""
    sol = solved(Packet(), 2.0, 0.0, dfx.Tsit5())
    fine = np.linspace(0.0, 2.0, 20_001)
    changes = np.flatnonzero(np.diff(np.sign(packet(fine))))
    want = [brentq(packet, *fine[[i, i + 1]], xtol=1e-14) for i in changes]
    assert len(want) == 6
    np.testing.assert_allclose(times(sol), want, atol=1e-11)


def test_steps_of_a_given_length():
    """Stay as they are as long as they are resolved, be it only just; an event begins a new one."""
    sol = nsjax.solve(
        Wave(1.0), 0.0, 7.0, 0.5, solver=dfx.Tsit5(), dt0=0.35, stepsize_controller=dfx.ConstantStepSize(), max_events=8
    )
    np.testing.assert_allclose(times(sol), np.arange(7) + 0.5, atol=1e-12)
    # Two up to the first event, three from one to the next, two to the end.
    assert (sol.stats["num_steps"], sol.stats["num_rejected_steps"]) == (2 + 6 * 3 + 2, 0)
