"""Reverse mode: wherever forward mode works, by the whole Jacobian and by going back through the steps."""

import functools

import diffrax as dfx
import equinox as eqx
import jax
import jax.numpy as jnp
import models
import numpy as np
import pytest
from models import Hammer, Motion, pid

import nsjax
from nsjax import gallery, solve


ADJOINTS = {"jacobian": dfx.DirectAdjoint(), "checkpoint": dfx.RecursiveCheckpointAdjoint()}
CHEAP = dict(solver=dfx.Bosh3(), stepsize_controller=pid(1e-6), max_steps=256, max_events=16)


def stick_slip(p, adjoint, **kwargs):
    """Through slip, stick and slip again: the state at the end and the times of the events."""
    system = gallery.StickSlip(k=p[2], v_dr=p[3], F_slip=p[4])
    sol = solve(system, 0.0, 14.0, Motion(p[0], p[1]), adjoint=adjoint, **(CHEAP | kwargs))
    return jnp.concatenate([jnp.stack(sol.y1), sol.events.t[:2]])


POINT = np.array([2.0, 0.0, 1.1, 0.2, 0.9])


@pytest.fixture(scope="module")
def forward():
    return jax.jit(jax.jacfwd(lambda p: stick_slip(p, dfx.ForwardMode())))(POINT)


@pytest.mark.slow
@pytest.mark.parametrize("adjoint", ADJOINTS)
def test_reverse_is_forward_for_stick_slip(forward, adjoint):
    """By initial state and three parameters of section 3.4."""
    backward = jax.jit(jax.jacrev(lambda p: stick_slip(p, ADJOINTS[adjoint])))(POINT)
    np.testing.assert_allclose(backward, forward, rtol=1e-10, atol=1e-10)


class Learned(nsjax.System):
    """A mass on a belt whose friction force over the relative velocity is a small network."""

    law: eqx.nn.MLP
    v_dr: float = 0.3
    ratio: float = 1.5

    def vector_field(self, t, y, s):
        relative = y.v - self.v_dr
        return Motion(y.v, -y.x - s.belt * jax.nn.softplus(self.law(relative**2)))

    @nsjax.sgn
    def belt(self, t, y):
        return y.v - self.v_dr

    @belt.breakaway
    def belt(self):
        return self.ratio


@functools.cache
def network():
    """Its numbers, and its structure."""
    return eqx.partition(eqx.nn.MLP("scalar", "scalar", 2, 1, key=jax.random.key(0)), eqx.is_inexact_array)


# In forward mode the error of the derivatives has a say in the choice of steps, and not with checkpoints.
FIXED = dict(solver=dfx.Heun(), stepsize_controller=dfx.ConstantStepSize(), dt0=0.05)


def learned(p, adjoint):
    """Through slip, stick and slip again: the state at the end and the times of the events."""
    law, x, v_dr, ratio = p
    system = Learned(eqx.combine(law, network()[1]), v_dr, ratio)
    sol = solve(system, 0.0, 10.0, Motion(x, 0.0), adjoint=adjoint, **FIXED, max_steps=512, max_events=16)
    return sol.y1.x, sol.y1.v, sol.events.t[:2]


def learned_point():
    return network()[0], *jnp.array([1.4, 0.3, 1.5])


@pytest.fixture(scope="module")
def learned_forward():
    return jax.jit(jax.jacfwd(lambda p: learned(p, dfx.ForwardMode())))(learned_point())


@pytest.mark.slow  # (by default against closed forms, below)
@pytest.mark.parametrize("adjoint", ADJOINTS)
def test_reverse_is_forward(learned_forward, adjoint):
    """Sliding entry, static breakaway, event times; by initial state, parameters, and the numbers of a network, whose
    activation is a function that comes back with the solution's system."""
    backward = jax.jit(jax.jacrev(lambda p: learned(p, ADJOINTS[adjoint])))(learned_point())
    for law, *others in learned_forward:
        assert max(float(jnp.max(jnp.abs(x))) for x in jax.tree.leaves(law)) > 0.01
        assert all(np.any(np.abs(x) > 0.01) for x in others)
    jax.tree.map(lambda a, b: np.testing.assert_allclose(a, b, rtol=1e-10, atol=1e-10), backward, learned_forward)


class Near(nsjax.System):
    """x'' = -x below a surface that it all but reaches."""

    def vector_field(self, t, y, s):
        return Motion(y.v, -y.x + 0 * s.edge)

    @nsjax.sgn
    def edge(self, t, y):
        return y.x - 1.0


@pytest.mark.slow
def test_surface_that_is_all_but_reached():
    """Pitfall 18: a lane that looks for a root on its step and finds none has a gradient all the same."""

    @jax.jit
    @jax.vmap
    @jax.grad
    def slope(v):
        return solve(Near(), 0.0, 4.0, Motion(0.0, v), adjoint=ADJOINTS["checkpoint"], **CHEAP).y1.x

    lanes = 1 - jnp.geomspace(1e-9, 0.3, 40)
    np.testing.assert_allclose(slope(lanes), np.sin(4.0), atol=1e-4)


@pytest.mark.slow
@pytest.mark.parametrize("adjoint", ["jacobian", "checkpoint"])
def test_lanes(forward, adjoint):
    """Pitfall 18: under `vmap` the event's branch is run by lanes that have no event."""
    points = POINT + jnp.arange(3.0)[:, None] * jnp.array([0.0, 0.01, 0.0, 0.1, 0.0])
    run = jax.jit(jax.vmap(jax.grad(lambda p: jnp.sum(stick_slip(p, ADJOINTS[adjoint])))))
    gradient = run(points)
    np.testing.assert_allclose(gradient[0], jnp.sum(forward, 0), rtol=1e-10)
    assert np.isfinite(gradient).all()


@pytest.mark.parametrize("adjoint", ["jacobian", pytest.param("checkpoint", marks=pytest.mark.slow)])
def test_lanes_that_have_ended(adjoint):
    """Pitfall 18: a lane that has ended goes on with steps of no length, whose NaN must not reach the gradient."""

    def end(x, t1):
        options = models.CHEAP | dict(max_steps=16, max_events=2, adjoint=ADJOINTS[adjoint])
        return solve(gallery.SlidingPoint(), 0.0, t1, type(gallery.THESIS["(2.3)"].y0)(x), **options).y1.x

    x, t1 = jnp.asarray([2.0, 3.0, 1.0]), jnp.asarray([1e-4, 2.0, 2.0])
    dx, dt = jax.jit(jax.vmap(jax.grad(end, argnums=(0, 1))))(x, t1)
    np.testing.assert_allclose(dx, [1, 1, 0], atol=1e-12)
    np.testing.assert_allclose(dt, [-1, -1, 0], atol=1e-12)


@pytest.mark.slow
@pytest.mark.parametrize("adjoint", ADJOINTS)
def test_impacts_and_saved_states(adjoint):
    """Restitution, states between steps, and the end time."""

    def squares(z, adjoint):
        system = Hammer(omega=z[0], e=z[1])
        saveat = dfx.SaveAt(ts=jnp.linspace(0.5, 5.5, 7), t1=True)
        sol = solve(system, 0.0, z[2], Motion(1.0, 0.0), saveat=saveat, adjoint=adjoint, **FIXED, max_steps=1024)
        return jnp.sum(sol.ys.x**2 + sol.ys.v**2)

    z = jnp.array([2.8, 0.8, 6.0])
    want = jax.jit(jax.jacfwd(lambda z: squares(z, dfx.ForwardMode())))(z)
    got = jax.jit(jax.grad(lambda z: squares(z, ADJOINTS[adjoint])))(z)
    np.testing.assert_allclose(got, want, rtol=1e-9)


@pytest.mark.slow
def test_hessian():
    """Forward over reverse, against forward over forward."""

    def energy(p, adjoint):
        return jnp.sum(stick_slip(p, adjoint)[:2] ** 2)

    want = jax.jit(jax.jacfwd(jax.jacfwd(lambda p: energy(p, dfx.ForwardMode()))))(POINT)
    got = jax.jit(jax.hessian(lambda p: energy(p, dfx.DirectAdjoint())))(POINT)
    np.testing.assert_allclose(got, want, rtol=1e-8, atol=1e-8)


def test_default_says_what_to_do():
    with pytest.raises(Exception, match="DirectAdjoint.*RecursiveCheckpointAdjoint"):
        jax.grad(lambda p: stick_slip(p, dfx.ForwardMode())[0])(POINT)


@pytest.mark.slow
def test_many_parameters():
    """A network's friction law is fitted to a trajectory with stick phases: the loss falls a hundredfold."""
    ts = jnp.linspace(0.5, 10.0, 20)

    def path(system):
        saveat = dfx.SaveAt(ts=ts)
        sol = solve(
            system, 0.0, 10.0, Motion(1.5, 0.0), saveat=saveat, adjoint=dfx.RecursiveCheckpointAdjoint(), **CHEAP
        )
        return sol.ys.x, sol.modes

    class Truth(Learned):
        def vector_field(self, t, y, s):
            relative = y.v - self.v_dr
            return Motion(y.v, -y.x - s.belt * (0.4 + 0.6 / (1 + 3 * relative**2)))

    law = eqx.nn.MLP("scalar", "scalar", 8, 1, jax.nn.tanh, key=jax.random.key(1))
    data, modes = eqx.filter_jit(path)(Truth(law))
    assert np.any(modes == 0) and np.any(modes == -1)

    def loss(law):
        return jnp.mean((path(Learned(law))[0] - data) ** 2)

    @eqx.filter_jit
    def step(law, m, v, i):
        value, g = eqx.filter_value_and_grad(loss)(law)
        m = jax.tree.map(lambda m, g: 0.8 * m + 0.2 * g, m, g)
        v = jax.tree.map(lambda v, g: 0.95 * v + 0.05 * g**2, v, g)
        rate = 0.05 / (1 + 0.02 * i)
        law = eqx.apply_updates(law, jax.tree.map(lambda m, v: -rate * m / (jnp.sqrt(v) + 1e-9), m, v))
        return value, law, m, v

    zeros = jax.tree.map(jnp.zeros_like, eqx.filter(law, eqx.is_inexact_array))
    m = v = zeros
    values = []
    for i in range(150):
        value, law, m, v = step(law, m, v, jnp.asarray(float(i)))
        values.append(float(value))
    assert len(jax.tree.leaves(zeros)) == 4 and min(values) < 1e-2 * values[0], values
