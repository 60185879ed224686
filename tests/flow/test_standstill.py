"""Derivatives where the state stands still: its error says nothing of theirs."""

import functools as ft

import diffrax as dfx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

import nsjax


class Pendulum(nsjax.System):
    """x'' + 2ζx' + sin x = F cos 10t."""

    force: float = 0.0
    damping: float = 0.0

    def vector_field(self, t, y, s):
        push = self.force * jnp.cos(10 * t) - 2 * self.damping * y[1]
        return jnp.stack([y[1], push - jnp.sin(y[0])])


SOLVERS = [dfx.Tsit5(), dfx.Dopri8(), nsjax.Taylor(), dfx.Kvaerno5()]
T = 6.0
TURNED = np.array([[np.cos(T), np.sin(T)], [-np.sin(T), np.cos(T)]])


def end(y0, force=0.0, unit=1.0, **how):
    sol = nsjax.solve(Pendulum(force * unit), 0.0, T, y0, **how)
    return sol.y1, sol.stats["num_steps"]


@ft.partial(jax.jit, static_argnums=2)
@ft.partial(jax.vmap, in_axes=(0, None, None))
def derivatives(y0, force, solver):
    """By start and force, with the number of steps."""
    return jax.jacfwd(lambda y, force: end(y, force, solver=solver), (0, 1), has_aux=True)(y0, force)


@pytest.mark.parametrize(
    "solver",
    [*SOLVERS[:2], *(pytest.param(s, marks=pytest.mark.slow) for s in SOLVERS[2:])],
    ids=lambda s: type(s).__name__,
)
def test_at_and_near_an_equilibrium(solver):
    """At rest, within the tolerance of rest, and far from it: lanes of one batch, each with steps of its own."""
    starts = jnp.array([[0.0, 0.0], [1e-12, 0.0], [1e-6, 0.0], [1.0, 0.5]])
    (by_start, by_force), steps = derivatives(starts, 0.0, solver)
    np.testing.assert_allclose(by_start[:3], np.broadcast_to(TURNED, (3, 2, 2)), atol=1e-8)
    np.testing.assert_allclose(by_force[:3, 0], (np.cos(T) - np.cos(10 * T)) / 99, atol=1e-7)  # ten times as fast
    (alone, _), alone_steps = derivatives(starts[3:], 0.0, solver)
    np.testing.assert_array_equal(steps[3], alone_steps[0])
    np.testing.assert_allclose(by_start[3], alone[0], rtol=1e-10)


def test_the_unit_of_a_parameter_is_no_matter():
    def steps(unit):
        by = jax.jacfwd(lambda force: end(jnp.zeros(2), force, unit, solver=dfx.Tsit5()), has_aux=True)
        slope, steps = by(0.0)
        return slope / unit, steps

    slopes, counts = jax.vmap(steps)(jnp.array([1e-6, 1.0, 1e6]))
    np.testing.assert_allclose(slopes, np.broadcast_to(slopes[1], slopes.shape), rtol=1e-12)
    assert len(set(counts.tolist())) == 1


def test_steps_are_those_that_the_derivatives_at_hand_ask_for():
    """By the start alone fewer than for an excitation ten times as fast; without derivatives next to none."""
    turned, steps = jax.jacfwd(end, has_aux=True)(jnp.zeros(2))
    np.testing.assert_allclose(turned, TURNED, atol=3e-6)
    assert end(jnp.zeros(2))[1] < 10 < steps < 40


def test_what_has_been_forgotten_is_not_resolved():
    """Where the derivative has fallen below the tolerance of what it was, steps need only be stable."""

    def steps(span):
        def of(y):
            sol = nsjax.solve(Pendulum(0.0, 0.5), 0.0, span, y, solver=dfx.Dopri8())
            return sol.y1, sol.stats["num_steps"]

        slope, steps = jax.jacfwd(of, has_aux=True)(jnp.zeros(2))
        assert np.all(np.abs(slope) < 1e-5)
        return steps

    assert steps(4000.0) < 50 * steps(40.0)


class Rooted(nsjax.System):
    p: float = 0.0

    def vector_field(self, t, y, s):
        return -y + jnp.sqrt(jnp.abs(self.p))


def test_a_derivative_that_does_not_exist_does_not_end_the_solution():
    def of(p):
        sol = nsjax.solve(Rooted(p), 0.0, 2.0, 1.0, throw=False)
        return sol.y1, (sol.y1, nsjax.is_okay(sol.result))

    slope, (y1, okay) = jax.jacfwd(of, has_aux=True)(0.0)
    assert okay and not np.isfinite(slope)
    np.testing.assert_allclose(y1, np.exp(-2.0), rtol=1e-6)


class Hanging(nsjax.System):
    """x' = -ax + bx² at rest in x = 0: the second derivative by the start is 2b/a · (e^-at - e^-2at)."""

    def vector_field(self, t, y, s):
        return -3 * y + 2 * y**2


def test_second_derivatives():
    second = jax.jacfwd(jax.jacfwd(lambda y: nsjax.solve(Hanging(), 0.0, 1.5, y, solver=dfx.Dopri8()).y1))(0.0)
    np.testing.assert_allclose(second, 4 / 3 * (np.exp(-4.5) - np.exp(-9.0)), rtol=1e-5)


def test_lyapunov_exponents_of_an_equilibrium():
    """Both are the real part of the eigenvalues, -ζ."""
    found = nsjax.lyapunov_spectrum(Pendulum(0.0, 0.1), jnp.zeros(2), transient=0, span=64, interval=20.0)
    np.testing.assert_allclose(found.exponents, [-0.1, -0.1], atol=1e-4)
