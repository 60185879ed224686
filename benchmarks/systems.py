"""Small systems whose one parameter sets what is measured: events, blocks, parameters, switches."""

from typing import NamedTuple

import jax.numpy as jnp
from jax import Array

import nsjax
from nsjax.gallery import Motion


class Free(nsjax.System):
    """x'' = -k x: no switch."""

    k: float = 1.0

    def vector_field(self, t, y, s):
        return Motion(y.v, -self.k * y.x)


class Rubbing(Free):
    """x'' = -k x - F sgn(v - v_dr): it sticks and slips, the friction at rest being twice as strong."""

    F: float = 1.0
    v_dr: float = 0.2

    def vector_field(self, t, y, s):
        return Motion(y.v, -self.k * y.x - self.F * s.belt)

    @nsjax.sgn
    def belt(self, t, y):
        return y.v - self.v_dr

    @belt.breakaway
    def belt(self):
        return 2.0


class Hitting(Rubbing):
    """The same with a wall at x = gap, against which the belt carries it."""

    gap: float = 1.5

    def vector_field(self, t, y, s):
        return Motion(y.v, -self.k * y.x - self.F * s.belt - s.wall)

    @nsjax.impact
    def wall(self, t, y):
        return self.gap - y.x

    @wall.restitution
    def wall(self):
        return 0.8


class Falling(nsjax.System):
    """A mass on a belt whose friction falls with the sliding velocity, and on a spring that hardens."""

    v_dr: float = 0.2
    k_3: float = 0.3
    delta: float = 3.0

    def vector_field(self, t, y, s):
        friction = s.belt / (1 + self.delta * jnp.abs(y.v - self.v_dr))
        return Motion(y.v, -y.x - self.k_3 * y.x**3 + friction)

    @nsjax.sgn
    def belt(self, t, y):
        return self.v_dr - y.v


class ThreeSurfaces(nsjax.System):
    """A forced oscillator with three switches, one of which has a surface with a corner."""

    k: float = 1.0

    def vector_field(self, t, y, s):
        return Motion(y.v, -self.k * y.x - s.belt - 0.3 * s.corner - 0.2 * s.place + jnp.cos(t))

    @nsjax.sgn
    def belt(self, t, y):
        return y.v - 0.2

    @belt.breakaway
    def belt(self):
        return 1.5

    @nsjax.sgn
    def corner(self, t, y):
        return y.x - 1.0, y.x + y.v - 1.0

    @nsjax.sgn
    def place(self, t, y):
        return y.x + 2.0

    @property
    def period(self):
        return 2 * jnp.pi


class Toggle(nsjax.System):
    """x'' = -2 rate sgn(x): from (0, 1) it crosses x = 0 `rate` times a unit of time."""

    rate: float = 10.0

    def vector_field(self, t, y, s):
        return Motion(y.v, -2 * self.rate * s.side)

    @nsjax.sgn
    def side(self, t, y):
        return y.x


class Ticks(nsjax.System):
    """Crosses a surface that is not affine `rate` times a unit of time, with nothing else to do."""

    rate: float = 10.0

    def vector_field(self, t, y, s):
        return self.rate + 0 * y * s.tick

    @nsjax.sgn
    def tick(self, t, y):
        return jnp.sin(jnp.pi * y)


class Blocks(NamedTuple):
    x: Array  # (n,)
    v: Array


class Chain(nsjax.System):
    """n blocks on a belt, each tied by springs to its neighbours, the outer ones to walls."""

    n: int
    v_dr: float = 0.2

    @property
    def switches(self):
        def contact(i):
            return nsjax.sgn(lambda self, t, y: y.v[i] - self.v_dr, name=f"belt{i}")

        return tuple(contact(i) for i in range(self.n))

    def vector_field(self, t, y, s):
        friction = jnp.stack([s[f"belt{i}"] for i in range(self.n)])
        return Blocks(y.v, jnp.diff(jnp.pad(y.x, 1), 2) - friction)


class Shaken(Rubbing):
    """The block on the belt under a sum of harmonics, whose amplitudes `a` are the parameters."""

    a: Array | None = None  # (parameters,)

    def vector_field(self, t, y, s):
        slow = jnp.arange(1, len(self.a) + 1) / len(self.a)
        rubbing = super().vector_field(t, y, s)
        return Motion(y.v, rubbing.v + self.a @ jnp.cos(slow * t))
