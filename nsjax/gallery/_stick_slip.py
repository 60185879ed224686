"""The mass on a driving belt of sections 2.4, 3.4 and 6.7."""

from jaxtyping import Array, Float

from .._types import Number, Scalar
from ..mechanics._friction_law import falling
from ..system._sgn import sgn
from ..system._system import SwitchValues, System
from ._motion import Motion


class FallingStickSlip(System):
    """Mass on a driving belt with falling friction, friction law (b); section 2.4, eq. (2.30), (2.31).

        m x'' = -k x + F,   v_rel = x' - v_dr
        F = -F_s sgn(v_rel)/(1 + δ|v_rel|)  in slip,   F = min(|k x|, F_s) sgn(k x)  in stick

    Values of Appendix C.1.
    """

    m: float = 1.0  # mass [kg]
    k: float = 1.0  # stiffness [N/m]
    v_dr: float = 0.2  # belt velocity [m/s]
    F_s: float = 1.0  # maximum static friction force [N]
    delta: float = 3.0  # fall of the friction force with velocity [s/m]

    def vector_field(self, t: Scalar, y: Motion, s: SwitchValues) -> Motion:
        friction = self.F_s * falling(s.belt, y.v - self.v_dr, self.delta)
        return Motion(y.v, (-self.k * y.x - friction) / self.m)

    @sgn
    def belt(self, t: Scalar, y: Motion) -> Number:
        return y.v - self.v_dr


class StickSlip(System):
    """Mass on a driving belt with a static friction point, friction law (c); sections 3.4, 6.7, eq. (3.33), (3.34).

        m x'' = -k x - c x' + F,   v_rel = x' - v_dr,   F_ex = k x + c x'
        F = -F_slip sgn(v_rel)  in slip,   F = min(|F_ex|, F_stick) sgn(F_ex)  in stick

    Stick ends only when |F_ex| exceeds F_stick. Values of Appendix C.2: c = 0 in section 3.4, c = 0.1 N s/m in 6.7.
    For c = 0 the stable orbit has, with ΔF = F_stick - F_slip, the period

        2 ΔF / (k v_dr) + (π + 2 arctan(√(k m) v_dr / ΔF)) √(m/k) = 13.536 s.
    """

    m: float = 1.0  # mass [kg]
    c: float = 0.0  # damping [N s/m]
    k: float = 1.0  # stiffness [N/m]
    v_dr: float = 0.2  # belt velocity [m/s]
    F_slip: float = 1.0  # friction force in slip [N]
    F_stick: float = 2.0  # maximum static friction force [N]

    def vector_field(self, t: Scalar, y: Motion, s: SwitchValues) -> Motion:
        return Motion(y.v, (-self.k * y.x - self.c * y.v - self.F_slip * s.belt) / self.m)

    @sgn
    def belt(self, t: Scalar, y: Motion) -> Number:
        return y.v - self.v_dr

    @belt.breakaway
    def belt(self) -> Float[Array, ""] | float:
        return self.F_stick / self.F_slip
