"""The drillstring of Appendix A: a rotor that whirls in a stator filled with fluid, twists, and both.

In polar coordinates a whirl is an equilibrium; the Cartesian models, which are scenes, also see the rotor pass through
the middle of its stator.
"""

from typing import NamedTuple

from .._types import Number, Scalar
from ..mechanics._contact import Viscoelastic
from ..mechanics._effect import Effect
from ..mechanics._friction import Friction
from ..mechanics._friction_law import Coulomb, Falling, falling
from ..mechanics._model import SceneModel
from ..mechanics._rotor import FluidForce, stator_contact, TurningForce
from ..mechanics._scene import Scene
from ..mechanics._spring import Damper, Spring
from ..system._sgn import sgn
from ..system._system import SwitchValues, System


class Whirl(NamedTuple):
    """State of a rotor in polar coordinates; on the angle of its middle nothing depends."""

    r: Number  # displacement of the middle [m]
    u: Number  # r' [m/s]
    Omega: Number  # whirl velocity α' [rad/s]


class Twist(NamedTuple):
    """State of a shaft that twists."""

    phi: Number  # twist [rad]
    w: Number  # φ' [rad/s]


class TwistedWhirl(NamedTuple):
    """State of a rotor on a shaft that twists."""

    r: Number  # displacement of the middle [m]
    u: Number  # r' [m/s]
    Omega: Number  # whirl velocity α' [rad/s]
    phi: Number  # twist [rad]
    w: Number  # φ' [rad/s]


class _Rotor(System):
    """The parameters of a rotor, and its lateral motion."""

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
    c_b: float | None = 30.0  # damping of the stator [N s/m]
    mu_b: float = 0.5  # friction coefficient of rotor and stator [-]
    omega: float = 2.6  # angular velocity of the drive [rad/s]

    def _wall(self, y: Whirl | TwistedWhirl) -> tuple[Number, ...]:
        """What is positive in contact: the penetration and the normal force."""
        depth = y.r - self.R_c
        return (depth,) if self.c_b is None else (depth, self.k_b * depth + self.c_b * y.u)

    def _normal_force(self, y: Whirl | TwistedWhirl, s: SwitchValues) -> Number:
        depth, *force = self._wall(y)
        return (force[0] if force else self.k_b * depth) * (1 + s.wall) / 2

    def _accelerations(self, y: Whirl | TwistedWhirl, theta: Number, F_N: Number, F_T: Number) -> tuple[Number, Number]:
        """r'' and α'' by (A.15) of a rotor that turns with the angular velocity `theta`, under the contact forces."""
        r, u, Omega = y.r, y.u, y.Omega
        mass, drag = self.m + self.m_f, self.D + self.B_2 * r**2
        stiff = self.k - theta**2 / 4 * self.m_f + self.m_f * theta * Omega + self.B_1 * r**2
        radial = (-(self.c + drag) * u - stiff * r - F_N) / mass + r * Omega**2
        along = (self.m_f * theta * u + drag * theta / 2 * r - (self.c + drag) * Omega * r + F_T) / mass
        return radial, (along - 2 * u * Omega) / r


class WhirlModel(_Rotor):
    """Rotor that turns uniformly in a stator filled with fluid, in polar coordinates; section A.7, eq. (A.15), (A.16).

        m_a (r'' - r Ω²) = -(c + D + B_2 r²) r' - (k - ω² m_f/4 + m_f ω Ω + B_1 r²) r - F_bN,   m_a = m + m_f
        m_a (r Ω' + 2 r' Ω) = m_f ω r' + (D + B_2 r²) ω r/2 - (c + D + B_2 r²) Ω r + F_bT
        F_bN = k_b (r - R_c) + c_b r'   where r > R_c and that is positive, else 0
        F_bT = -μ_b F_bN Sgn(v_rel),    v_rel = r Ω + ω R;  rolling is v_rel = 0

    Values of Appendix C.6; ω is ours. (A.5) as it is printed has no damping of the stator: that is `c_b=None`. But the
    figures of the thesis come out with its c_b, with the contact law of section 3.5. Friction has its switch, `roll`,
    only while there is contact. The middle of the stator, r = 0, is a singularity of these coordinates.
    """

    def vector_field(self, t: Scalar, y: Whirl, s: SwitchValues) -> Whirl:
        F_N = self._normal_force(y, s)
        return Whirl(y.u, *self._accelerations(y, self.omega, F_N, -self.mu_b * s.roll * F_N))

    @sgn
    def wall(self, t: Scalar, y: Whirl) -> tuple[Number, ...]:
        return self._wall(y)

    @sgn
    def roll(self, t: Scalar, y: Whirl) -> Number:
        return y.r * y.Omega + self.omega * self.R

    roll = roll.while_("wall")


class TorsionModel(System):
    """Rotor on a shaft that twists, with friction on its bit; section A.8, eq. (A.50), (A.9).

        J φ'' = -k_φ φ + T_f,   T_f = -T_0 Sgn(θ')/(1 + δ |θ'|),   θ' = φ' + ω

    Values of Appendix C.6, and ω of Fig. A.7a. (There is no stick phase any more at that ω.)
    """

    J: float = 1.0  # moment of inertia [kg m^2]
    k_phi: float = 1.0  # torsional stiffness of the shaft [N m/rad]
    T_0: float = 0.2  # static friction torque on the bit [N m]
    delta: float = 0.3  # fall of that torque with the velocity [s/rad]
    omega: float = 2.0  # angular velocity of the drive [rad/s]

    def vector_field(self, t: Scalar, y: Twist, s: SwitchValues) -> Twist:
        T_f = -self.T_0 * falling(s.bit, y.w + self.omega, self.delta)
        return Twist(y.w, (-self.k_phi * y.phi + T_f) / self.J)

    @sgn
    def bit(self, t: Scalar, y: Twist) -> Number:
        return y.w + self.omega


class _Drillstring(_Rotor):
    """The parameters of a rotor that whirls on a shaft that twists."""

    J: float = 1.0  # moment of inertia [kg m^2]
    k_phi: float = 1.0  # torsional stiffness of the shaft [N m/rad]
    T_0: float = 0.2  # static friction torque on the bit [N m]
    delta: float = 0.3  # fall of that torque with the velocity [s/rad]
    omega: float = 3.05  # angular velocity of the drive [rad/s]


class DrillstringModel(_Drillstring):
    """Rotor that whirls on a shaft that twists, in polar coordinates; section A.9, eq. (A.51).

    The equations of `WhirlModel` with θ' = ω + φ' in the place of ω, and

        J φ'' = -k_φ φ + T_f + T_b + T_d
        T_f = -T_0 Sgn(θ')/(1 + δ |θ'|),   T_b = F_bT R,   T_d = -F_fα r

    where F_fα is what the fluid does along α, its added mass too. Values of Appendix C.6; ω is ours: on the stable
    part of branch P4 (Fig. A.10), beside which rolling (E4) is stable too.
    """

    def vector_field(self, t: Scalar, y: TwistedWhirl, s: SwitchValues) -> TwistedWhirl:
        theta, F_N = self.omega + y.w, self._normal_force(y, s)
        F_T = -self.mu_b * s.roll * F_N
        radial, around = self._accelerations(y, theta, F_N, F_T)
        # (A.14) says what the fluid's force is, from the motion.
        fluid = self.m * (y.r * around + 2 * y.u * y.Omega) + self.c * y.r * y.Omega - F_T
        T_f = -self.T_0 * falling(s.bit, theta, self.delta)
        return TwistedWhirl(y.u, radial, around, y.w, (-self.k_phi * y.phi + T_f + F_T * self.R - fluid * y.r) / self.J)

    @sgn
    def wall(self, t: Scalar, y: TwistedWhirl) -> tuple[Number, ...]:
        return self._wall(y)

    @sgn
    def roll(self, t: Scalar, y: TwistedWhirl) -> Number:
        return y.r * y.Omega + (self.omega + y.w) * self.R

    roll = roll.while_("wall")

    @sgn
    def bit(self, t: Scalar, y: TwistedWhirl) -> Number:
        return self.omega + y.w


# The same in Cartesian coordinates.


def _lateral(of: _Rotor, spin: str | None = None) -> dict[str, Effect]:
    """What acts on the middle of a rotor."""
    turns = dict(omega=of.omega, spin=spin)
    law = Viscoelastic(of.k_b) if of.c_b is None else Viscoelastic(of.k_b, of.c_b)
    return dict(
        k_x=Spring("x", k=of.k),
        k_y=Spring("y", k=of.k),
        c_x=Damper("x", c=of.c),
        c_y=Damper("y", c=of.c),
        fluid=FluidForce("x", "y", of.m_f, of.D, B_1=of.B_1, B_2=of.B_2, **turns),
        wall=stator_contact("x", "y", law, R_c=of.R_c, R=of.R, friction=Coulomb(of.mu_b), **turns),
    )


class WhirlScene(_Rotor, SceneModel):
    """`WhirlModel` in Cartesian coordinates; eq. (A.13) with the forces (A.2), (A.8). A steady whirl is a periodic
    orbit of period 2π/|Ω|, and the middle of the stator an equilibrium."""

    @property
    def scene(self) -> Scene:
        return Scene(dict(x=self.m, y=self.m), units=dict(x="m", y="m"), **_lateral(self))


class DrillstringScene(_Drillstring, SceneModel):
    """`DrillstringModel` in Cartesian coordinates; eq. (A.13) and (A.51). With x = y = 0 it is `TorsionModel`."""

    @property
    def scene(self) -> Scene:
        return Scene(
            dict(x=self.m, y=self.m, phi=self.J),
            units=dict(x="m", y="m", phi="rad"),
            **_lateral(self, "phi"),
            shaft=Spring("phi", k=self.k_phi),
            bit=Friction("phi", Falling(self.T_0, self.delta), v=-self.omega),
        )


class FreeDrillstringScene(DrillstringScene):
    """`DrillstringScene` without its stator, for motions in the middle, which do not meet it: the branch P1. Its
    programs are a fifth of the size."""

    @property
    def scene(self) -> Scene:
        return super().scene.without("wall")


class EccentricDrillstringScene(DrillstringScene):
    """`DrillstringScene` with a small force that turns with the drive, as that of an eccentric mass.

    Without it a rotor that is exactly in the middle of its stator stays there, stable or not. With it a slow sweep of ω
    shows the hysteresis of section A.10:

    ```python
    system = nsjax.gallery.EccentricDrillstringScene(f_0=1e-3)
    up = [2.1, 2.2, 2.24, 2.3, 2.36, 2.4, 3.0, 3.45, 3.45, 3.45]
    down = [3.0, 2.6, 2.2, 2.2, 1.5, 1.0, 0.7, 0.5, 0.46, 0.42]
    swept = nsjax.brute_force(system, "omega", jnp.array(up + down), system.state(), carry=True, transient=30, keep=10)
    ```
    """

    f_0: float = 1e-4  # the force [N]

    @property
    def scene(self) -> Scene:
        plain = super().scene
        turning = TurningForce("x", "y", self.f_0, self.omega)
        return Scene(dict(zip(plain.coordinates, plain.mass)), units=plain.units, **plain.effects, eccentric=turning)
