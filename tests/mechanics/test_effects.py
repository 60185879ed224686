"""Each effect against its formula, written out: the vector field of a scene that has it alone."""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

import nsjax
from nsjax.mechanics import (
    Backlash,
    Characteristic,
    Constant,
    Contact,
    Coulomb,
    Cubic,
    Damper,
    Effect,
    Falling,
    ForceElement,
    Forcing,
    Friction,
    Harmonic,
    PolynomialSpring,
    Relay,
    Rigid,
    Scene,
    SmoothFalling,
    Spring,
    SquareWave,
    State,
    StaticPoint,
    Stribeck,
    TrilinearSpring,
    Velocity,
    Viscoelastic,
)


X, V, T = 1.3, -0.7, 0.4  # displacement, velocity, time of the scenes with one coordinate
MASS = 2.0


def accelerations(scene, y, t=T, **s):
    """Of the coordinates, for given values of the switches."""
    names = [k.name for k in scene.switches]
    assert set(s) == set(names)
    y = jax.tree.map(jnp.asarray, y)
    out = scene.vector_field(jnp.asarray(t), y, scene.values(tuple(jnp.asarray(s[n]) for n in names)))
    assert type(out) is State and out.v._fields == scene.coordinates
    np.testing.assert_array_equal(out.q, y.v)
    return np.array(out.v)


def force(effect, **s):
    """On a mass at X that moves with V; the switches by their names within the effect."""
    scene = Scene({"x": MASS}, it=effect)
    names = [k.name for k in scene.switches]
    s = {names[0] if len(names) == 1 else f"it.{k}": v for k, v in s.items()}
    return MASS * accelerations(scene, scene.state({"x": X}, {"x": V}), **s)[0]


W = V - 0.2  # sliding velocity on a belt
TABLE = {
    "spring": (Spring("x", k=3.0), {}, -3 * X),
    "spring with rest": (Spring("x", k=3.0, rest=0.5), {}, -3 * (X - 0.5)),
    "polynomial": (PolynomialSpring("x", k1=3.0, k2=0.5, k3=2.0), {}, -3 * X - 0.5 * X**2 - 2 * X**3),
    "cubic spring": (PolynomialSpring("x", k3=2.0), {}, -2 * X**3),
    "damper": (Damper("x", c=0.3), {}, -0.3 * V),
    "constant": (Constant("x", f=-9.81), {}, -9.81),
    "harmonic": (Harmonic("x", f_0=0.5, omega=3.0), {}, 0.5 * np.cos(3 * T)),
    "sine": (Harmonic("x", f_0=0.5, omega=3.0, phase=-np.pi / 2), {}, 0.5 * np.sin(3 * T)),
    "forcing": (Forcing("x", lambda t: t**2), {}, T**2),
    "square wave, first half": (SquareWave("x", f_0=2.0, T=1.0), dict(wave=4.0), 2.0),
    "square wave, second half": (SquareWave("x", f_0=2.0, T=1.0), dict(wave=-1.0), -2.0),
    "relay": (Relay("x", f=2.0), dict(relay=1.0), -2.0),
    "relay with hysteresis": (Relay("x", f=2.0, width=0.1), dict(relay=0.0), 2.0),
    "static point": (Friction("x", v=0.2, slip=1.5, stick=2.0), dict(slip=-0.4), 0.6),
    "Coulomb": (Friction("x", Coulomb(0.3)), dict(slip=-1.0), 0.3),
    "(2.28)": (Friction("x", Falling(2.0, 3.0, 0.5), v=0.2), dict(slip=-1.0), 1.5 / (1 - 3 * W) + 0.5),
    "(2.31)": (Friction("x", Falling(2.0, 3.0), v=0.2), dict(slip=-1.0), 2 / (1 - 3 * W)),
    "(2.27)": (
        Friction("x", SmoothFalling(2.0, 3.0, 0.5, 50.0), v=0.2),
        {},
        -2 / np.pi * np.arctan(50 * W) * (1.5 / (1 - 3 * W) + 0.5),
    ),
    "Stribeck": (Friction("x", Stribeck(1.5, 1.0, 0.4)), dict(slip=-1.0), 1 + 0.5 * np.exp(-((V / 0.4) ** 2))),
    "viscous Stribeck": (
        Friction("x", Stribeck(1.5, 1.0, 0.4, c=0.1)),
        dict(slip=-1.0),
        1 + 0.5 * np.exp(-((V / 0.4) ** 2)) - 0.1 * V,
    ),
    "(6.28)": (Friction("x", Cubic(1.5, 1.4, 0.45), v=0.2), dict(slip=-1.0), 1.5 + 1.4 * W - 0.45 * W**3),
    "a law of one's own": (Friction("x", Characteristic(lambda w: 1 + w**2), v=0.2), dict(slip=-1.0), 1 + W**2),
    "rigid": (Contact({"x": -1}, Rigid(), gap=4.0), dict(contact=1.7), -1.7),
    "support": (Contact({"x": -1}, Viscoelastic(4.0, 0.5), gap=1.0), dict(contact=1.0), -4 * (X - 1) - 0.5 * V),
    "elastic support": (Contact("x", Viscoelastic(4.0)), dict(contact=1.0), -4 * X),
    "open support": (Contact("x", Viscoelastic(4.0)), dict(contact=-1.0), 0),
    "backlash": (Backlash("x", 4.0, 1.0, 0.5), dict(upper=1.0, lower=-1.0), -4 * (X - 1) - 0.5 * V),
    "backlash, other side": (Backlash("x", 4.0, 1.0), dict(upper=-1.0, lower=1.0), -4 * (X + 1)),
    "trilinear": (TrilinearSpring("x", 4.0, 1.0, k=3.0), dict(upper=1.0, lower=-1.0), -3 * X - 4 * (X - 1)),
}


@pytest.mark.parametrize("name", TABLE)
def test_the_force_of_an_effect_is_that_of_its_formula(name):
    effect, s, expected = TABLE[name]
    np.testing.assert_allclose(force(effect, **s), expected, rtol=1e-13, atol=1e-13)


GUARDS = {
    "belt": (Friction("x", v=0.2, slip=1.0), W),
    "ground": (Friction("x", Coulomb(0.3)), V),
    "stop": (Contact({"x": -1}, Rigid(), gap=4.0), 4 - X),
    "stop by a function": (Contact(lambda q: 4.0 - q.x, Rigid()), 4 - X),
    "support": (Contact({"x": -1}, Viscoelastic(4.0, 0.5), gap=1.0), (X - 1, 4 * (X - 1) + 0.5 * V)),
    "elastic support": (Contact({"x": -1}, Viscoelastic(4.0), gap=1.0), X - 1),
    "relay": (Relay("x", of=lambda q, v: q.x + 0.5 * v.x), X + 0.5 * V),
    "relay with hysteresis": (Relay("x", width=0.25), X - 0.25),
}


@pytest.mark.parametrize("name", GUARDS)
def test_the_surface_of_an_effect(name):
    effect, expected = GUARDS[name]
    scene = Scene({"x": MASS}, it=effect)
    (switch,) = scene.switches
    assert switch.name == "it"
    y = jax.tree.map(jnp.asarray, scene.state({"x": X}, {"x": V}))
    np.testing.assert_allclose(switch.guard(scene, jnp.asarray(T), y), expected, rtol=1e-14)


def test_switches_are_the_same_objects_each_time():
    """Programs are kept by the identity of switches: a scene made anew must not be compiled anew."""
    one, other = (Scene({"x": m}, belt=Friction("x", slip=m), play=Backlash("x")) for m in (1.0, 2.0))
    assert one.switches == other.switches
    assert [k.name for k in one.switches] == ["belt", "play.upper", "play.lower"]
    assert jax.tree.structure(one) == jax.tree.structure(other)
    assert jax.tree.structure(one.state()) == jax.tree.structure(other.state())


# Geometry: along what a force acts.

Q, U = {"x": 0.3, "z": 0.8}, {"x": -1.1, "z": 0.4}


def pair(effect, **s):
    scene = Scene({"x": 1.0, "z": 1.0}, it=effect)
    return accelerations(scene, scene.state(Q, U), **s)


def length(q):
    return jnp.sqrt(q.x**2 + q.z**2)


def rolling(q, v):
    return (q.x * v.z - q.z * v.x) / length(q)


R = np.hypot(0.3, 0.8)
RATE = (0.3 * -1.1 + 0.8 * 0.4) / R
TURN = (0.3 * 0.4 - 0.8 * -1.1) / R
GEOMETRY = {
    "difference": (Spring({"x": 1, "z": -1}, k=2.0), {}, -2 * (0.3 - 0.8) * np.array([1, -1])),
    "opposite": (Damper({"x": -1}, c=2.0), {}, [2.2, 0]),
    "factors": (Spring({"x": 0.5, "z": 2}, k=2.0), {}, -2 * (0.15 + 1.6) * np.array([0.5, 2])),
    "function": (Spring(length, k=2.0, rest=0.5), {}, -2 * (R - 0.5) / R * np.array([0.3, 0.8])),
    "damper along a function": (Damper(length, c=2.0), {}, -2 * RATE / R * np.array([0.3, 0.8])),
    "affine function": (Damper(lambda q: 1.0 - q.x + 3.0 * q.z, c=2.0), {}, -2 * (1.1 + 1.2) * np.array([-1, 3])),
    "partly affine": (Spring(lambda q: q.x + q.z**2, k=2.0), {}, -2 * (0.3 + 0.64) * np.array([1, 1.6])),
    "contact": (Contact(lambda q: 1.0 - length(q), Rigid()), dict(it=2.0), -2 / R * np.array([0.3, 0.8])),
    "support": (
        Contact(lambda q: 0.5 - length(q), Viscoelastic(4.0, 0.5)),
        dict(it=1.0),
        -(4 * (R - 0.5) + 0.5 * RATE) / R * np.array([0.3, 0.8]),
    ),
    "velocity": (Damper(Velocity(rolling), c=2.0), {}, -2 * TURN / R * np.array([-0.8, 0.3])),
    "friction that rolls": (Friction(Velocity(rolling), Coulomb(0.3), v=0.1), dict(it=1.0), [0.24 / R, -0.09 / R]),
}


@pytest.mark.parametrize("name", GEOMETRY)
def test_a_force_acts_along_the_gradient_of_its_distance(name):
    effect, s, expected = GEOMETRY[name]
    np.testing.assert_allclose(pair(effect, **s), expected, rtol=1e-13, atol=1e-14)


class Arm(eqx.Module):
    """A distance with a parameter."""

    l: float = 2.0

    def __call__(self, q):
        return self.l * jnp.sin(q.x)


def test_a_distance_may_have_parameters():
    scene = Scene({"x": 1.0}, it=Spring(Arm(), k=2.0))

    def acceleration(l):
        there = eqx.tree_at(lambda scene: scene.it.along.fn.l, scene, l)
        y = jax.tree.map(jnp.asarray, there.state({"x": 0.3}))
        return there.vector_field(jnp.asarray(0.0), y, there.values(())).v.x

    value, slope = jax.value_and_grad(acceleration)(jnp.asarray(2.0))
    np.testing.assert_allclose(value, -2 * 4 * np.sin(0.3) * np.cos(0.3), rtol=1e-14)
    np.testing.assert_allclose(slope, -2 * 4 * np.sin(0.3) * np.cos(0.3), rtol=1e-14)
    assert nsjax.system._parameter.parameter_path(scene, "it.l") == ("it", "along", "fn", "l")


# Friction of a contact: its numbers are coefficients of the normal force.


@pytest.mark.parametrize(
    "friction", [Coulomb(0.3, along="x"), Friction("x", Coulomb(0.3)), Friction("x", StaticPoint(0.3, 0.4))]
)
def test_friction_takes_the_normal_force_of_its_contact(friction):
    scene = Scene({"x": 1.0, "z": 1.0}, floor=Contact("z", Rigid(), friction=friction))
    assert [k.name for k in scene.switches] == ["floor", "floor.friction"]
    found = accelerations(scene, scene.state(Q, U), floor=5.0, **{"floor.friction": -1.0})
    np.testing.assert_allclose(found, [1.5, 5.0], rtol=1e-14)


def test_friction_takes_the_normal_force_of_another_effect():
    floor = Contact({"z": 1}, Viscoelastic(4.0), gap=-1.0)
    scene = Scene({"x": 1.0, "z": 1.0}, rub=Friction("x", Coulomb(0.3), normal="floor"), floor=floor)
    found = accelerations(scene, scene.state(Q, U), rub=-1.0, floor=1.0)
    np.testing.assert_allclose(found, [0.3 * 0.8, 0.8], rtol=1e-14)


# Effects of one's own.


class Magnet(Effect):
    strength: float = 1.0

    def forces(self, t, y, s):
        return {"x": -self.strength / y.q.x**2}


class Hardening(ForceElement):
    k: float = 1.0

    def force(self, t, at, s):
        return -self.k * at.d**3


class Snap(Effect):
    """A switch and a mass of its own, and a force that another one needs."""

    k: float = 1.0

    @nsjax.sgn
    def side(self, t, y):
        return y.q.x

    def forces(self, t, y, s):
        return {"x": self.k * s.side, "z": s.pull}

    def mass(self, q):
        return {"z": 1.0}

    @property
    def needs(self):
        return {"pull": "spring"}


def test_an_effect_of_ones_own_takes_ten_lines():
    np.testing.assert_allclose(pair(Magnet(2.0)), [-2 / 0.09, 0], rtol=1e-14)
    np.testing.assert_allclose(pair(Hardening("z", 2.0)), [0, -2 * 0.8**3], rtol=1e-14)
    scene = Scene({"x": 1.0, "z": 1.0}, snap=Snap(3.0), spring=Spring("x", k=2.0))
    found = accelerations(scene, scene.state(Q, U), snap=1.0)
    np.testing.assert_allclose(found, [3 - 0.6, -0.6 / 2], rtol=1e-14)
