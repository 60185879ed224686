"""Tangential contact from both sides: the value stands, the derivative is right or said not to exist."""

import diffrax as dfx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from models import impact, Motion, pid, Touch

import nsjax
from nsjax import RESULTS, solve


class Graze(Touch):
    """The same with a surface that changes the field: twice the stiffness beyond it."""

    def vector_field(self, t, y, s):
        return Motion(y.v, -y.x - 0.5 * (1 - s.wall) * (y.x - 1 - self.gap))

    @nsjax.sgn
    def wall(self, t, y):
        return 1 + self.gap - y.x


def run(system):
    sol = solve(system, -np.pi, 3.0, Motion(-1.0, 0.0), stepsize_controller=pid(1e-12), throw=False)
    return jnp.stack(sol.y1), sol.result, sol.events


@pytest.mark.parametrize("gap", [1e-3, 1e-9])
def test_just_missing(gap):
    """Pitfall 10: no event, and no status."""
    for system in (Touch(gap), Graze(gap)):
        y, result, events = run(system)
        assert result == RESULTS.successful and events.num == 0
        np.testing.assert_allclose(y, [np.cos(3), -np.sin(3)], atol=1e-10)


@pytest.mark.parametrize("gap", [pytest.param(-1e-4, marks=pytest.mark.slow), -1e-8])
def test_just_touching(gap):
    """Pitfall 10: an impact with a speed of 1.4e-2 or 1.4e-4, and its derivative of 60 or 6000."""
    y, result, events = run(Touch(gap))
    assert result == RESULTS.successful and events.num == 1
    speed = np.sqrt(-2 * gap - gap**2)
    np.testing.assert_allclose(y, impact(gap), atol=1e-11 / speed)
    np.testing.assert_allclose(events.transversality[0], speed / np.hypot(speed, 1 + gap), rtol=1e-10 / speed**2)
    derivative = jax.jacfwd(lambda gap: run(Touch(gap))[0])(gap)
    np.testing.assert_allclose(derivative, jax.jacfwd(impact)(gap), rtol=1e-10 / speed**2)


@pytest.mark.parametrize("gap", [0.0, -1e-13])
def test_tangential(gap):
    """Pitfall 10: told by the status, which is no failure; the value has the square root of the accuracy."""
    for system in (Touch(gap), Graze(gap)):
        y, result, events = run(system)
        met = events.num > 0
        assert result == (RESULTS.tangential_event if met else RESULTS.successful) and nsjax.is_okay(result)
        assert not met or events.transversality[0] < 6e-6
        np.testing.assert_allclose(y, [np.cos(3), -np.sin(3)], atol=2e-5)
    assert run(Touch(-1e-12))[1] == RESULTS.tangential_event
    solve(Touch(-1e-12), -np.pi, 1.0, Motion(-1.0, 0.0), stepsize_controller=pid(1e-12))  # does not raise


def test_square_root_is_not_floored():
    """The derivative grows as the grazing is approached, like the inverse of the speed."""
    slopes = [jax.jacfwd(lambda gap: run(Touch(gap))[0])(gap)[1] * np.sqrt(-gap) for gap in (-1e-5, -1e-7, -1e-9)]
    np.testing.assert_allclose(slopes, 1.5 / np.sqrt(2) * np.cos(3), rtol=2e-2)


@pytest.mark.parametrize("method", ["variational", pytest.param("autodiff", marks=pytest.mark.slow)])
def test_fundamental_matrix_through_grazing(method):
    """Not defined beyond a tangential event, and said so; defined before it."""
    args = dict(method=method, solver=dfx.Tsit5(), stepsize_controller=pid(1e-12))
    with pytest.raises(Exception, match="met tangentially"):
        nsjax.fundamental_matrix(Touch(-1e-12), -np.pi, 3.0, Motion(-1.0, 0.0), ts=[-1.0, 3.0], **args)
    phi = nsjax.fundamental_matrix(Touch(-1e-12), -np.pi, 3.0, Motion(-1.0, 0.0), ts=[-1.0, 1.0], throw=False, **args)
    turned = np.pi - 1.0
    np.testing.assert_allclose(phi[0], [[np.cos(turned), np.sin(turned)], [-np.sin(turned), np.cos(turned)]], atol=1e-9)
    assert np.all(np.isnan(phi[1]))


def test_saltation_at_a_tangency_is_infinite():
    """In the entries that depend on when the surface is met; the others stay as they are."""

    class Push(Touch):
        def vector_field(self, t, y, s):
            return Motion(y.v, -y.x - 0.25 * (1 - s.wall))

        @nsjax.sgn
        def wall(self, t, y):
            return 1.0 - y.x

    start = Motion(jnp.asarray(1.0), jnp.asarray(0.0))
    matrix = jax.jit(lambda y: nsjax.saltation_matrix(Push(), 0.0, y, "wall", 1, -1, throw=False))(start)
    np.testing.assert_array_equal(matrix, [[1, 0], [np.inf, 1]])


@pytest.mark.slow
@pytest.mark.parametrize("solver", ["swept", dfx.Tsit5(), dfx.Dopri8(), nsjax.Taylor()])
def test_uncertain_derivatives_say_so(solver):
    """At the default tolerance, from clear impacts to touches: where the derivative is off by a tenth, the status or the
    margin says so."""

    def end(gap):
        how = {} if solver == "swept" else dict(solver=solver)
        sol = solve(Touch(gap), -np.pi, 3.0, Motion(-1.0, 0.0), throw=False, **how)
        return jnp.stack(sol.y1), (sol.result, sol.margin)

    gaps = -(10.0 ** np.random.default_rng(0).uniform(-13, -2, 500))
    slope = jax.jacfwd(end, has_aux=True)
    found, (result, margin) = (
        nsjax.sweep(slope, jnp.asarray(gaps)) if solver == "swept" else jax.jit(jax.vmap(slope))(gaps)
    )
    want = jax.vmap(jax.jacfwd(impact))(jnp.asarray(gaps))
    off = np.max(np.abs(np.asarray(found - want)), axis=1) > 0.1 * np.max(np.abs(np.asarray(want)), axis=1)
    told = np.asarray(result != RESULTS.successful) | (np.asarray(margin) < 100)
    assert not (off & ~told).any(), gaps[off & ~told]
    assert off.any() == (solver != "swept")  # sweeps solve this model exactly
    assert np.mean(told[gaps < -1e-4]) == 0
