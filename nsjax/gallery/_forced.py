"""The forced systems with dry friction of sections 6.8 and 6.9."""

import jax.numpy as jnp
from jaxtyping import Array, Float

from .._types import Number, Scalar
from ..system._sgn import sgn
from ..system._system import SwitchValues, System
from ._motion import Motion


class ForcedFriction(System):
    """Forced vibration with dry friction, friction law (c); section 6.8, eq. (6.25), (6.26).

        m x'' + c x' + k x = f_fric + f_0 cos(ω t),   F_ex = k x - f_0 cos(ω t)
        f_fric = -F_slip sgn(x')  in slip,   f_fric = min(|F_ex|, F_stick) sgn(F_ex)  in stick

    Values of Appendix C.4; ω = 0.65 is ours: between B and C in Fig. 6.18, where the stable orbit is asymmetric
    (branch II; -x(t + T/2) is the other one) and sticks once in a period.
    """

    m: float = 1.0  # mass [kg]
    c: float = 0.01  # damping [N s/m]
    k: float = 1.0  # stiffness [N/m]
    f_0: float = 2.5  # amplitude of the forcing [N]
    F_slip: float = 1.0  # friction force in slip [N]
    F_stick: float = 2.0  # maximum static friction force [N]
    omega: float = 0.65  # angular frequency of the forcing [rad/s]

    def vector_field(self, t: Scalar, y: Motion, s: SwitchValues) -> Motion:
        force = self.f_0 * jnp.cos(self.omega * t) - self.F_slip * s.friction
        return Motion(y.v, (force - self.c * y.v - self.k * y.x) / self.m)

    @sgn
    def friction(self, t: Scalar, y: Motion) -> Number:
        return y.v

    @friction.breakaway
    def friction(self) -> Float[Array, ""] | float:
        return self.F_stick / self.F_slip

    @property
    def period(self) -> Float[Array, ""] | float:
        return 2 * jnp.pi / self.omega


class ForcedStickSlip(System):
    """Forced mass on a driving belt, friction law (b); section 6.9, eq. (6.27), (6.28).

        m x'' + k x = f_fric + f_0 cos(ω t),   v_rel = x' - v_dr,   F_ex = k x - f_0 cos(ω t)
        f_fric = -α_0 sgn(v_rel) + α_1 v_rel - α_3 v_rel³  in slip
        f_fric = min(|F_ex|, α_0) sgn(F_ex)                in stick

    Values of Appendix C.5 (which lists c = 0); ω = 1.65 is ours: on the stable branch I of Fig. 6.20, whose orbits
    have twice the period of the forcing and stick once in it.
    """

    m: float = 1.0  # mass [kg]
    k: float = 1.0  # stiffness [N/m]
    v_dr: float = 1.0  # belt velocity [m/s]
    alpha_0: float = 1.5  # friction force at rest [N]
    alpha_1: float = 1.5  # fall of the friction force with velocity [N s/m]
    alpha_3: float = 0.45  # rise of the friction force with the cube of velocity [N s³/m³]
    f_0: float = 0.1  # amplitude of the forcing [N]
    omega: float = 1.65  # angular frequency of the forcing [rad/s]

    def vector_field(self, t: Scalar, y: Motion, s: SwitchValues) -> Motion:
        v_rel = self.belt(t, y)
        friction = -self.alpha_0 * s.belt + self.alpha_1 * v_rel - self.alpha_3 * v_rel**3
        return Motion(y.v, (friction + self.f_0 * jnp.cos(self.omega * t) - self.k * y.x) / self.m)

    @sgn
    def belt(self, t: Scalar, y: Motion) -> Number:
        return y.v - self.v_dr

    @property
    def period(self) -> Float[Array, ""] | float:
        return 2 * jnp.pi / self.omega
