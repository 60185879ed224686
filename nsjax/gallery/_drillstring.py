"""The drillstring of Appendix A: a rotor that whirls in a stator filled with fluid, twists, and both.

In polar coordinates a whirl is an equilibrium; in Cartesian ones the rotor may pass through the middle of the stator.
"""

from typing import NamedTuple

from .._types import Number, Scalar
from ..mechanics._contact import Viscoelastic
from ..mechanics._friction import Friction
from ..mechanics._friction_law import Coulomb, Falling, falling
from ..mechanics._model import SceneModel
from ..mechanics._rotor import FluidForce, stator_contact
from ..mechanics._scene import Scene
from ..mechanics._spring import Damper, Spring
from ..system._sgn import sgn
from ..system._system import SwitchValues, System


class Whirl(NamedTuple):
    """State of the rotor in polar coordinates, without its angle, on which nothing depends."""

    r: Number  # displacement of its middle [m]
    u: Number  # r' [m/s]
    Omega: Number  # whirl velocity α' [rad/s]


class TwistedWhirl(NamedTuple):
    """The same, of a rotor on a shaft that twists."""

    r: Number  # displacement of its middle [m]
    u: Number  # r' [m/s]
    Omega: Number  # whirl velocity α' [rad/s]
    phi: Number  # twist of the shaft [rad]
    w: Number  # φ' [rad/s]


class _Rotor(System):
    """The lateral motion of a rotor, with the angular velocity θ' with which it turns."""

    m: float = 1.0  # mass [kg]
    c: float = 0.3  # damping of the shaft [N s/m]
    k: float = 1.0  # bending stiffness of the shaft [N/m]
    m_f: float = 1.0  # added mass of the fluid [kg]
    D: float = 0.1  # fluid friction [N s/m]
    B_1: float = 0.1  # nonlinear part of the fluid's stiffness [N/m^3]
    B_2: float = 0.0  # nonlinear part of the fluid's friction [N s/m^3]
    R: float = 2.0  # radius of the rotor [m]
    R_c: float = 1.0  # clearance between rotor and stator [m]
    k_b: float = 50.0  # stiffness of the stator [N/m]
    c_b: float = 30.0  # damping of the stator [N s/m]
    mu_b: float = 0.5  # friction coefficient of rotor and stator
    omega: float = 2.0  # angular velocity of the drive [rad/s]; ours

    def _contact(self, y: Whirl | TwistedWhirl) -> tuple[Number, Number]:
        """Penetration and normal force; contact where both are positive."""
        depth = y.r - self.R_c
        return depth, self.k_b * depth + self.c_b * y.u

    def _accelerations(self, y: Whirl | TwistedWhirl, turning: Number, N: Number, T: Number) -> tuple[Number, Number]:
        """r'' and Ω' by (A.15), under the contact forces."""
        r, u, Omega = y.r, y.u, y.Omega
        mass, drag = self.m + self.m_f, self.D + self.B_2 * r**2
        stiff = self.k - turning**2 / 4 * self.m_f + self.m_f * turning * Omega + self.B_1 * r**2
        radial = (-(self.c + drag) * u - stiff * r - N) / mass + r * Omega**2
        along = (self.m_f * turning * u + drag * turning / 2 * r - (self.c + drag) * Omega * r + T) / mass
        return radial, (along - 2 * u * Omega) / r


class PolarWhirl(_Rotor):
    def vector_field(self, t: Scalar, y: Whirl, s: SwitchValues) -> Whirl:
        N = self._contact(y)[1] * (1 + s.wall) / 2
        return Whirl(y.u, *self._accelerations(y, self.omega, N, -self.mu_b * s.roll * N))

    @sgn
    def wall(self, t: Scalar, y: Whirl) -> tuple[Number, Number]:
        return self._contact(y)

    @sgn
    def roll(self, t: Scalar, y: Whirl) -> Number:
        return y.r * y.Omega + self.omega * self.R

    roll = roll.while_("wall")


class PolarDrillstring(_Rotor):
    J: float = 1.0  # moment of inertia [kg m^2]
    k_phi: float = 1.0  # torsional stiffness of the shaft [N m/rad]
    T_0: float = 0.2  # static friction torque on the bit [N m]
    delta: float = 0.3  # fall of that torque with velocity [s/rad]

    def vector_field(self, t: Scalar, y: TwistedWhirl, s: SwitchValues) -> TwistedWhirl:
        turning = self.omega + y.w
        N = self._contact(y)[1] * (1 + s.wall) / 2
        T = -self.mu_b * s.roll * N
        radial, around = self._accelerations(y, turning, N, T)
        F_alpha = self.m * (y.r * around + 2 * y.u * y.Omega) + self.c * y.r * y.Omega - T
        bit = -self.T_0 * falling(s.bit, turning, self.delta)
        w = (-self.k_phi * y.phi + bit + T * self.R - F_alpha * y.r) / self.J
        return TwistedWhirl(y.u, radial, around, y.w, w)

    @sgn
    def wall(self, t: Scalar, y: TwistedWhirl) -> tuple[Number, Number]:
        return self._contact(y)

    @sgn
    def roll(self, t: Scalar, y: TwistedWhirl) -> Number:
        return y.r * y.Omega + (self.omega + y.w) * self.R

    roll = roll.while_("wall")

    @sgn
    def bit(self, t: Scalar, y: TwistedWhirl) -> Number:
        return self.omega + y.w
