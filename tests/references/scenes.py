"""Scenes, and the same systems written by hand."""

from typing import NamedTuple

import jax.numpy as jnp
from jax import Array

import nsjax
from nsjax.gallery import DiscontinuousSupport, Motion, StickSlip
from nsjax.mechanics import Contact, Damper, Friction, Harmonic, Rigid, Scene, Spring, Viscoelastic


class Chain(NamedTuple):
    x1: Array | float
    x2: Array | float
    v1: Array | float
    v2: Array | float


class TwoMasses(nsjax.System):
    """Two masses on springs, the second of them on a belt."""

    m1: float = 1.0
    m2: float = 2.0
    k: float = 1.0
    k_12: float = 3.0
    c: float = 0.1
    v_dr: float = 0.3
    F_slip: float = 1.0
    F_stick: float = 1.5

    def vector_field(self, t, y, s):
        pull = self.k_12 * (y.x1 - y.x2) + self.c * (y.v1 - y.v2)
        a1 = (-self.k * y.x1 - pull) / self.m1
        a2 = (pull - self.F_slip * s.belt) / self.m2
        return Chain(y.v1, y.v2, a1, a2)

    @nsjax.sgn
    def belt(self, t, y):
        return y.v2 - self.v_dr

    @belt.breakaway
    def belt(self):
        return self.F_stick / self.F_slip


class ImpactOscillator(nsjax.System):
    """A forced mass that hits a wall."""

    m: float = 1.0
    k: float = 1.0
    c: float = 0.05
    f_0: float = 0.8
    omega: float = 1.7
    e: float = 0.6
    x_w: float = 0.3

    def vector_field(self, t, y, s):
        force = self.f_0 * jnp.cos(self.omega * t) - s.wall
        return Motion(y.v, (force - self.k * y.x - self.c * y.v) / self.m)

    @nsjax.impact
    def wall(self, t, y):
        return self.x_w - y.x

    @wall.restitution
    def wall(self):
        return self.e

    @property
    def period(self):
        return 2 * jnp.pi / self.omega


def chain():
    apart = {"x1": 1, "x2": -1}
    return Scene(
        {"x1": 1.0, "x2": 2.0},
        wall=Spring("x1", k=1.0),
        spring=Spring(apart, k=3.0),
        damper=Damper(apart, c=0.1),
        belt=Friction("x2", v=0.3, slip=1.0, stick=1.5),
    )


def impact_oscillator():
    return Scene(
        {"x": 1.0},
        spring=Spring("x", k=1.0),
        damper=Damper("x", c=0.05),
        drive=Harmonic("x", f_0=0.8, omega=1.7),
        wall=Contact({"x": -1}, Rigid(e=0.6), gap=0.3),
    )


# By name: a scene, the same by hand, and starts of both, numbers in the order of the leaves.
TWINS = {
    "belt": (
        Scene({"x": 1.0}, spring=Spring("x", k=1.0), belt=Friction("x", v=0.2, slip=1.0, stick=2.0)),
        StickSlip(),
        Motion(2.5, 0.0),
    ),
    "chain": (chain(), TwoMasses(), Chain(1.0, 0.5, 0.0, 0.0)),
    "impact": (impact_oscillator(), ImpactOscillator(), Motion(0.2, 0.5)),
    "support": (
        Scene(
            {"x": 1.0},
            spring=Spring("x", k=1.0),
            drive=Harmonic("x", f_0=1.0, omega=1.2),
            support=Contact({"x": -1}, Viscoelastic(k=4.0, c=0.5), gap=0.0),
        ),
        DiscontinuousSupport(),
        Motion(-0.3, 0.2),
    ),
}
