"""One program follows the orbits of a model, whichever of its parameters vary: see test_continue_bifurcation."""

import jax.numpy as jnp
import numpy as np
import pytest
from branches import continue_orbit, orbit_of
from models import Duffing, Motion

import nsjax
from nsjax.orbits.segments import _point
from nsjax.system._parameter import FreeParameters


class Power(nsjax.System):
    """`Duffing` with any power of x. Its derivative by n, x^n log x, is not a number where x < 0."""

    n: float = 3.0
    c: float = 0.2
    F: float = 1.0
    omega: float = 1.0

    def vector_field(self, t, y, s):
        return Motion(y.v, self.F * jnp.cos(self.omega * t) - self.c * y.v - y.x - y.x**self.n)

    @property
    def period(self):
        return 2 * jnp.pi / self.omega


class Stiff(nsjax.System):
    """A linear oscillator. The derivative of its stiffness by a is infinite."""

    a: float = 0.0
    c: float = 0.2
    omega: float = 1.0

    def vector_field(self, t, y, s):
        return Motion(y.v, jnp.cos(self.omega * t) - self.c * y.v - (1 + jnp.sqrt(self.a)) * y.x)

    @property
    def period(self):
        return 2 * jnp.pi / self.omega


START = Motion(0.5, 0.5)


@pytest.fixture
def heard(monkeypatch):
    """Whether parameters are fixed in the program, call by call."""
    calls, program = [], _point._correct

    class Heard:
        def at(self, curve, *args):
            calls.append(isinstance(curve.free.free, tuple))
            return program.at(curve, *args)

    monkeypatch.setattr(_point, "_correct", Heard())
    return calls


def test_a_parameter_that_is_not_free_may_have_no_derivative(heard):
    """Zero times an infinite derivative is no part of an answer: another program finds it. A linear field goes by
    exponentials, of which programs are small."""
    system = Stiff()
    branch = continue_orbit(system, orbit_of(system, START), "omega", (0.9, 1.1), max_step=0.1)
    assert set(heard) == {False, True}
    omega = branch.values
    response = np.exp(1j * omega * branch.ts) / (1 - omega**2 + 0.2j * omega)
    np.testing.assert_allclose(branch.ys.x, response.real, atol=1e-9)
    np.testing.assert_allclose(np.prod(branch.multipliers, axis=1), np.exp(-0.2 * branch.periods), rtol=1e-9)
    heard.clear()
    system = Stiff(a=1.0)  # at which the derivative is finite
    continue_orbit(system, orbit_of(system, START), "omega", (0.9, 1.1), max_step=0.1)
    assert set(heard) == {False}


@pytest.mark.slow
def test_the_same_by_steps_of_the_solver(heard):
    """A derivative that is NaN is no part of an answer either."""
    branches = []
    for system in (Duffing(), Power()):
        heard.clear()
        branches.append(continue_orbit(system, orbit_of(system, START), "omega", (0.9, 1.1), max_step=0.1))
        assert any(heard) == isinstance(system, Power)
    plain, power = branches
    np.testing.assert_allclose(power.values, plain.values, rtol=1e-9)
    np.testing.assert_allclose(power.multipliers, plain.multipliers, rtol=1e-7)
    np.testing.assert_allclose(power.ys.x, plain.ys.x, rtol=1e-8)


def test_paths_of_free_parameters():
    system = Duffing()
    both = FreeParameters.of(system, ("omega",), ("c",))
    assert both.paths == both.fixed.paths == (("omega",), ("c",))
    for free in (both, both.fixed):
        moved = free.put(system, np.array([1.5, 0.25]))
        assert (float(moved.omega), float(moved.c), moved.F) == (1.5, 0.25, 1.0)
    assert FreeParameters.of(system).put(system, np.zeros(0)) is system
