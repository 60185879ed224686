"""The three systems of Table 1.1: non-smooth continuous, of Filippov type, impulsive."""

import jax.numpy as jnp
from jaxtyping import Array, Float

from .._types import Number, Scalar
from ..system._impact import impact
from ..system._sgn import sgn
from ..system._system import SwitchValues, System
from ._motion import Motion


class ElasticSupport(System):
    """Mass on a spring with a one-sided elastic support, a non-smooth continuous system; Table 1.1 (1).

        m x'' + k x = f_0 cos(ω t) - f(x),   f(x) = 0 for x <= 0,  k_f x for x > 0.

    The table gives no values; these are ours. There is no damping: the forced orbit is stable, not attracting.
    """

    m: float = 1.0  # mass [kg]
    k: float = 1.0  # stiffness [N/m]
    k_f: float = 4.0  # stiffness of the support [N/m]
    f_0: float = 1.0  # amplitude of the forcing [N]
    omega: float = 1.0  # angular frequency of the forcing [rad/s]

    def vector_field(self, t: Scalar, y: Motion, s: SwitchValues) -> Motion:
        support = self.k_f * y.x * (1 + s.support) / 2
        return Motion(y.v, (self.f_0 * jnp.cos(self.omega * t) - self.k * y.x - support) / self.m)

    @sgn
    def support(self, t: Scalar, y: Motion) -> Number:
        return y.x

    @property
    def period(self) -> Float[Array, ""] | float:
        return 2 * jnp.pi / self.omega


class DryFriction(System):
    """Mass on a spring with a dry friction damper, a system of Filippov type; Table 1.1 (2).

        m x'' + k x = f_0 cos(ω t) - f(x'),   f(x') in μ Sgn(x').

    The table gives no values; these are ours, and the orbit stops twice in a period.
    """

    m: float = 1.0  # mass [kg]
    k: float = 1.0  # stiffness [N/m]
    mu: float = 1.0  # friction force [N]
    f_0: float = 2.0  # amplitude of the forcing [N]
    omega: float = 0.5  # angular frequency of the forcing [rad/s]

    def vector_field(self, t: Scalar, y: Motion, s: SwitchValues) -> Motion:
        return Motion(y.v, (self.f_0 * jnp.cos(self.omega * t) - self.k * y.x - self.mu * s.friction) / self.m)

    @sgn
    def friction(self, t: Scalar, y: Motion) -> Number:
        return y.v

    @property
    def period(self) -> Float[Array, ""] | float:
        return 2 * jnp.pi / self.omega


class BouncingBall(System):
    """Ball on a floor, an impulsive system; Table 1.1 (3).

        m x'' = -m g + f,   x >= 0,  f >= 0,  x f = 0;      x'(t+) = -e x'(t-) where x = 0.

    (The table prints -g for -m g.) It gives no values; these are ours. Impacts accumulate at
    t = (1 + e)/(1 - e) √(2 x/g) after release from rest at height x, and the ball stays on the floor.
    """

    m: float = 1.0  # mass [kg]
    g: float = 9.81  # gravity [m/s²]
    e: float = 0.8  # coefficient of restitution [-]

    def vector_field(self, t: Scalar, y: Motion, s: SwitchValues) -> Motion:
        return Motion(y.v, -self.g + s.floor / self.m)

    @impact
    def floor(self, t: Scalar, y: Motion) -> Number:
        return y.x

    @floor.restitution
    def floor(self) -> Float[Array, ""] | float:
        return self.e
