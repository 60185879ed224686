"""Solutions of scenes against models by hand, closed forms and an outside integrator."""

import functools

import diffrax as dfx
import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scenes import TWINS
from scipy.integrate import solve_ivp

import nsjax
from nsjax.mechanics import (
    Constant,
    Contact,
    Coulomb,
    Damper,
    Friction,
    Harmonic,
    Relay,
    Rigid,
    Scene,
    Spring,
    SquareWave,
    TrilinearSpring,
)
from nsjax.system._system import arrays_of


TIGHT = dict(solver=dfx.Dopri8(), stepsize_controller=dfx.PIDController(rtol=1e-11, atol=1e-12))
BELT, HAND, START = TWINS["belt"]


@pytest.mark.parametrize("name", [pytest.param(n, marks=[pytest.mark.slow] * (n != "belt")) for n in TWINS])
def test_a_scene_moves_as_the_model_by_hand(name):
    scene, hand, y = TWINS[name]
    start = jax.tree.unflatten(jax.tree.structure(scene.state()), jax.tree.leaves(y))
    sols = [nsjax.solve(system, 0.0, 20.0, y0) for system, y0 in ((scene, start), (hand, y))]
    ours, theirs = (np.array(jax.tree.leaves(sol.y1)) for sol in sols)
    np.testing.assert_allclose(ours, theirs, rtol=1e-12, atol=1e-12)
    events, others = (sol.events.t[: len(sol.events)] for sol in sols)
    np.testing.assert_allclose(events, others, rtol=1e-12)
    assert len(events) >= 2


@pytest.mark.slow
def test_derivatives_by_a_parameter_of_an_effect():
    """By the velocity of the belt, through stick and slip, as by the field of the model written by hand."""

    def end(system, where, y0):
        def of(v):
            return jnp.stack(jax.tree.leaves(nsjax.solve(eqx.tree_at(where, system, v), 0.0, 18.0, y0).y1))

        return np.array(jax.jacfwd(of)(jnp.asarray(0.2)))

    ours = end(BELT, lambda scene: scene.belt.v, BELT.state({"x": 2.5}))
    theirs = end(HAND, lambda hand: hand.v_dr, START)
    assert np.abs(theirs).max() > 0.1
    np.testing.assert_allclose(ours, theirs, rtol=1e-10, atol=1e-12)


def test_stick_slip_has_its_period_in_closed_form():
    orbit = nsjax.find_orbit(BELT, BELT.state({"x": 2.0}), period=13.5, solver=dfx.Tsit5())
    np.testing.assert_allclose(orbit.period, 10 + np.pi + 2 * np.arctan(0.2), rtol=1e-12)
    np.testing.assert_allclose(np.sort(orbit.multipliers.real), [0, 1], atol=1e-9)


def stitched(fields, guards, y, t1):
    """A solution by scipy: in mode i by fields[i], until guards[i] falls to zero, then the next mode."""
    t, mode, y = 0.0, 0, np.array(y)
    while t < t1:
        stop = lambda t, y, g=guards[mode]: g(y)  # noqa: E731
        stop.terminal, stop.direction = True, -1
        found = solve_ivp(fields[mode], (t, t1), y, "DOP853", rtol=1e-12, atol=1e-13, events=stop)
        t, y, mode = found.t[-1], found.y[:, -1], (mode + 1) % len(fields)
    return y


@pytest.mark.slow
def test_a_one_sided_support_against_scipy():
    """Contact begins at the gap, and ends where the force vanishes, before the gap opens (section 3.5)."""
    scene, _, _ = TWINS["support"]
    k_f, c_f = 4.0, 0.5

    def field(contact):
        def rate(t, y):
            return [y[1], np.cos(1.2 * t) - y[0] - contact * (k_f * y[0] + c_f * y[1])]

        return rate

    guards = (lambda y: -y[0], lambda y: k_f * y[0] + c_f * y[1])
    expected = stitched((field(0), field(1)), guards, [-0.3, 0.2], 20.0)
    sol = nsjax.solve(scene, 0.0, 20.0, scene.state({"x": -0.3}, {"x": 0.2}), **TIGHT)
    np.testing.assert_allclose([sol.y1.q.x, sol.y1.v.x], expected, rtol=1e-8, atol=1e-9)


@pytest.mark.slow
def test_a_trilinear_spring_against_scipy():
    """Section 6.6 without damping in the stiff part, where the force is continuous."""
    scene = Scene(
        {"x": 1.0},
        spring=TrilinearSpring("x", 4.0, 1.0, k=1.0),
        damper=Damper("x", c=0.05),
        drive=Harmonic("x", f_0=0.6, omega=1.15),
    )

    def field(t, y):
        stiff = 4 * np.sign(y[0]) * max(abs(y[0]) - 1, 0)
        return [y[1], 0.6 * np.cos(1.15 * t) - y[0] - stiff - 0.05 * y[1]]

    expected = solve_ivp(field, (0, 20), [0.5, 1.5], "DOP853", rtol=1e-12, atol=1e-13, max_step=0.01).y[:, -1]
    sol = nsjax.solve(scene, 0.0, 20.0, scene.state({"x": 0.5}, {"x": 1.5}), **TIGHT)
    assert len(sol.events) > 5
    np.testing.assert_allclose([sol.y1.q.x, sol.y1.v.x], expected, rtol=1e-6, atol=1e-6)


# A pendulum (mass m, length l) on a cart (mass M), without friction: x and phi are coupled by the mass matrix.

M, MP, L, G = 2.0, 0.7, 0.9, 9.81


def cart_mass(q):
    return {"x": M + MP, "phi": MP * L**2, ("x", "phi"): MP * L * jnp.cos(q.phi)}


def height(q):
    return -L * jnp.cos(q.phi)


@functools.cache
def cart():
    return Scene(["x", "phi"], mass=cart_mass, gravity=Constant(height, f=-MP * G))


def by_hand(t, y):
    """From Lagrange's equations, solved for the accelerations by hand."""
    _, phi, v, w = y
    s, c = np.sin(phi), np.cos(phi)
    a = (MP * L * w**2 * s + MP * G * s * c) / (M + MP * s**2)
    b = -(MP * L * w**2 * s * c + (M + MP) * G * s) / (L * (M + MP * s**2))
    return np.array([v, w, a, b])


def test_a_mass_matrix_that_depends_on_the_state():
    for y in np.random.default_rng(0).uniform(-2, 2, (5, 4)):
        state = jax.tree.map(jnp.asarray, cart().state(dict(x=y[0], phi=y[1]), dict(x=y[2], phi=y[3])))
        found = cart().vector_field(jnp.asarray(0.0), state, cart().values(()))
        np.testing.assert_allclose(jax.tree.leaves(found), by_hand(0.0, y), rtol=1e-12, atol=1e-13)


@pytest.mark.parametrize("solver", [dfx.Dopri8(), pytest.param(nsjax.Taylor(), marks=pytest.mark.slow)])
def test_a_pendulum_on_a_cart_keeps_its_energy(solver):
    y0 = cart().state({"phi": 2.0}, {"x": 0.5, "phi": 1.0})
    tight = TIGHT | dict(solver=solver)
    y1 = nsjax.solve(cart(), 0.0, 10.0, y0, **tight).y1

    def energy(y):
        (x, w), phi = y.v, y.q.phi
        return (M + MP) / 2 * x**2 + MP * L * x * w * np.cos(phi) + MP * L**2 / 2 * w**2 - MP * G * L * np.cos(phi)

    np.testing.assert_allclose(energy(y1), energy(y0), rtol=1e-9)
    expected = solve_ivp(by_hand, (0, 10), jax.tree.leaves(y0), "DOP853", rtol=1e-12, atol=1e-12).y[:, -1]
    np.testing.assert_allclose(jax.tree.leaves(y1), expected, rtol=1e-7, atol=1e-7)


def full_rank(n, seed=1):
    a = np.random.default_rng(seed).normal(size=(n, n))
    return a @ a.T + n * np.eye(n)


@pytest.mark.parametrize("n", [2, 3, 5, 13])
def test_a_constant_mass_matrix_is_solved_for(n):
    """Written out, and, from 64 entries beside the diagonal on, by LAPACK; zeros are left out."""
    m, names = full_rank(n), [f"x{i}" for i in range(n)]
    f = np.arange(1.0, n + 1)

    def accelerations(m):
        scene = Scene(names, mass=m, **{f"f{i}": Constant(name, f=f[i]) for i, name in enumerate(names)})
        scene, y = arrays_of(scene, float), jax.tree.map(jnp.asarray, scene.state())
        program = jax.make_jaxpr(lambda y, scene: scene.vector_field(0.0, y, scene.values(())).v)
        return np.array(scene.vector_field(0.0, y, scene.values(())).v), len(program(y, scene).eqns)

    found, dense = accelerations(m)
    np.testing.assert_allclose(found, np.linalg.solve(m, f), rtol=1e-12)
    found, diagonal = accelerations(np.diag(np.diag(m)))
    np.testing.assert_allclose(found, f / np.diag(m), rtol=1e-14)
    assert diagonal == n < dense


def test_two_frictions_on_one_velocity_are_solved_together():
    """They share what holds the mass: it lets go where both are spent, at k x = 1 + 2."""
    scene = Scene({"x": 1.0}, spring=Spring("x"), one=Friction("x", slip=1.0), two=Friction("x", slip=2.0))
    at_rest = nsjax.solve(scene, 0.0, 5.0, scene.state({"x": 2.9}))
    assert at_rest.y1.q.x == 2.9 and list(at_rest.mode1) == [0, 0]
    sliding = nsjax.solve(scene, 0.0, 1.0, scene.state({"x": 3.1}))
    np.testing.assert_allclose(sliding.y1.q.x, 3 + 0.1 * np.cos(1.0), rtol=1e-7)
    shares = [scene.force(name, 0.0, scene.state({"x": 1.5}), [0, 0]) for name in ("one", "two")]
    np.testing.assert_allclose(shares, [0.5, 1.0], rtol=1e-9)


@pytest.mark.slow
def test_a_stop_that_is_at_rest_at_the_start():
    """A ball on the floor stays there; with friction in the contact it slows down by μ g."""
    scene = Scene(
        {"x": 1.0, "z": 2.0},
        gravity=Constant("z", f=-2 * 9.81),
        floor=Contact("z", Rigid(e=0.5), friction=Coulomb(mu=0.1, along="x")),
    )
    sol = nsjax.solve(scene, 0.0, 0.5, scene.state(v={"x": 2.0}))
    np.testing.assert_allclose(sol.y1.q.z, 0, atol=1e-12)
    np.testing.assert_allclose(sol.y1.v.x, 2 - 0.1 * 2 * 9.81 * 0.5, rtol=1e-9)


@pytest.mark.slow
def test_a_bouncing_ball_on_a_floor_with_friction():
    """At an impact the tangential impulse is μ times the normal one: v_x falls by μ (1 + e) v_z."""
    scene = Scene(
        {"x": 1.0, "z": 1.0},
        gravity=Constant("z", f=-9.81),
        floor=Contact("z", Rigid(e=0.5), friction=Coulomb(mu=0.1, along="x")),
    )
    sol = nsjax.solve(scene, 0.0, 0.5, scene.state({"z": 1.0}, {"x": 3.0}))
    fall = np.sqrt(2 / 9.81)
    assert fall < 0.5
    np.testing.assert_allclose(sol.y1.v.x, 3 - 0.1 * 1.5 * 9.81 * fall, rtol=1e-8)


def test_a_square_wave_in_closed_form():
    scene = Scene({"x": 1.0}, push=SquareWave("x", f_0=2.0, T=1.0))
    sol = nsjax.solve(scene, 0.0, 2.25, scene.state())
    np.testing.assert_allclose([sol.y1.q.x, sol.y1.v.x], [2 * 0.5 + 0.25**2, 0.5], rtol=1e-9)


@pytest.mark.slow
def test_a_relay_with_hysteresis_has_a_limit_cycle():
    """A double integrator behind a relay of width w: on each side the same parabola, and σ = x + τ v of period T."""
    scene = Scene({"x": 1.0}, servo=Relay("x", f=1.0, of=lambda q, v: q.x + 0.5 * v.x, width=0.1))
    sol = nsjax.solve(scene, 0.0, 60.0, scene.state({"x": 1.0}))
    t = np.array(sol.events.t[: len(sol.events)])
    gaps = np.diff(t)[-4:]
    # Half a period h between switchings at σ = ±w: v runs from -h/2 to h/2 and x is the same at both ends, so that
    # 2 w = τ h + 0: h = 2 w / τ.
    np.testing.assert_allclose(gaps, 0.4, rtol=1e-3)
