"""The mass with one (section 3.5) and with two (section 6.6) visco-elastic supports."""

import jax.numpy as jnp
from jaxtyping import Array, Float

from .._types import Number, Scalar
from ..system._sgn import sgn
from ..system._system import SwitchValues, System
from ._motion import Motion


class DiscontinuousSupport(System):
    """Mass on a spring with a one-sided visco-elastic support; section 3.5, eq. (3.44)-(3.47).

        m x'' + k x = f_0 cos(ω t)                           no contact
        m x'' + c_f x' + (k + k_f) x = f_0 cos(ω t)          contact

    Contact begins at h_α = x = 0 and ends where the contact force h_β = k_f x + c_f x' vanishes: there is contact
    where both are positive, min(h_α, h_β) > 0, and the surface has a corner at the origin. The only damping is that
    of the support. The thesis gives no values; k, k_f and c_f are those of section 6.6, f_0 and ω are ours. With
    x_c != 0, not in the thesis, x in h_α, h_β and in the contact force is x - x_c.
    """

    m: float = 1.0  # mass [kg]
    k: float = 1.0  # stiffness [N/m]
    x_c: float = 0.0  # contact distance [m]
    k_f: float = 4.0  # stiffness of the support [N/m]
    c_f: float = 0.5  # damping of the support [N s/m]
    f_0: float = 1.0  # amplitude of the forcing [N]
    omega: float = 1.2  # angular frequency of the forcing [rad/s]

    def vector_field(self, t: Scalar, y: Motion, s: SwitchValues) -> Motion:
        _, contact_force = self.support(t, y)
        force = self.f_0 * jnp.cos(self.omega * t) - contact_force * (1 + s.support) / 2
        return Motion(y.v, (force - self.k * y.x) / self.m)

    @sgn
    def support(self, t: Scalar, y: Motion) -> tuple[Number, Number]:
        penetration = y.x - self.x_c
        return penetration, self.k_f * penetration + self.c_f * y.v

    @property
    def period(self) -> Float[Array, ""] | float:
        return 2 * jnp.pi / self.omega


class Trilinear(System):
    """Mass on a spring between two visco-elastic supports; section 6.6, eq. (6.14)-(6.20).

        m x'' + C(x') + K(x) = f_0 sin(ω t)
        C = c x',          K = k x                        in V-, no contact
        C = (c + c_f) x',  K = k x + k_f (x - x_c)        in V+1:  x > x_c,   k_f (x - x_c) + c_f x' >= 0
        C = (c + c_f) x',  K = k x + k_f (x + x_c)        in V+2:  x < -x_c,  k_f (x + x_c) + c_f x' <= 0

    Values of Appendix C.3; ω = 1.15 is ours: to the right of ω_B in Fig. 6.12, where a stable orbit with contact
    (the default guess) and a stable one without coexist with an unstable one.
    """

    m: float = 1.0  # mass [kg]
    c: float = 0.05  # damping [N s/m]
    k: float = 1.0  # stiffness [N/m]
    x_c: float = 1.0  # contact distance [m]
    k_f: float = 4.0  # stiffness of a support [N/m]
    c_f: float = 0.5  # damping of a support [N s/m]
    f_0: float = 0.2  # amplitude of the forcing [N]
    omega: float = 1.15  # angular frequency of the forcing [rad/s]

    def vector_field(self, t: Scalar, y: Motion, s: SwitchValues) -> Motion:
        _, lower_force = self.lower(t, y)
        _, upper_force = self.upper(t, y)
        contact = (upper_force * (1 + s.upper) - lower_force * (1 + s.lower)) / 2
        force = self.f_0 * jnp.sin(self.omega * t) + contact
        return Motion(y.v, (force - self.c * y.v - self.k * y.x) / self.m)

    def _penetration(self, x: Scalar, v: Scalar) -> tuple[Number, Number]:
        """Penetration of a support and its contact force, (6.17); contact where both are positive."""
        return x - self.x_c, self.k_f * (x - self.x_c) + self.c_f * v

    @sgn
    def lower(self, t: Scalar, y: Motion) -> tuple[Number, Number]:
        return self._penetration(y.x, y.v)

    @sgn
    def upper(self, t: Scalar, y: Motion) -> tuple[Number, Number]:
        return self._penetration(-y.x, -y.v)

    @property
    def period(self) -> Float[Array, ""] | float:
        return 2 * jnp.pi / self.omega
