"""A rotor in a stator filled with fluid: the forces on the drillstring of Appendix A, in Cartesian coordinates."""

from collections.abc import Mapping
from typing import Any, ClassVar

import equinox as eqx
import jax.numpy as jnp

from .._types import Number
from ..system._system import SwitchValues
from ._contact import Contact, ContactLaw
from ._direction import Direction, direction, Function, Velocity
from ._effect import Effect
from ._friction import Friction
from ._friction_law import FrictionLaw
from ._state import State


class FluidForce(Effect):
    """What a fluid does to a rotor that turns in it with the angular velocity Ω, (A.2); with ψ_i(r) = B_i r², (A.4).

        F_x = -m_f (x'' + Ω y' - Ω²/4 x) - (D + ψ_2)(x' + Ω/2 y) - ψ_1 x
        F_y = -m_f (y'' - Ω x' - Ω²/4 y) - (D + ψ_2)(y' - Ω/2 x) - ψ_1 y

    The added mass goes into the mass matrix. With `spin`, Ω = ω + spin', and the torque -F_α r, (A.12), acts on the
    rotation, the part of the added mass too.

    **Arguments:**

    - `x`, `y`: the coordinates of the rotor's middle, from that of the stator.
    - `m_f`: added mass [kg].
    - `D`: fluid friction [N s/m].
    - `omega`: ω, the angular velocity of the rotor, or of the frame of `spin` [rad/s].
    - `B_1`, `B_2`: nonlinear parts [N/m³], [N s/m³]; none if left out.
    - `spin`: the coordinate of the rotor's rotation, if it does not turn uniformly [rad].
    """

    formula: ClassVar[str] = "fluid forces (A.2)"

    x: str = eqx.field(static=True)
    y: str = eqx.field(static=True)
    m_f: float = 1.0
    D: float = 0.1
    omega: float = 1.0
    B_1: float | None = None
    B_2: float | None = None
    spin: str | None = eqx.field(default=None, static=True)

    def __check_init__(self):
        if not all(isinstance(name, str) for name in (self.x, self.y, self.spin or "")):
            raise TypeError("Arguments `x`, `y` and `spin` of `FluidForce` must be names of coordinates.")

    def forces(self, t: Any, y: State, s: SwitchValues) -> Mapping[str, Number]:
        x, z = getattr(y.q, self.x), getattr(y.q, self.y)
        v, w = getattr(y.v, self.x), getattr(y.v, self.y)
        turning = self.omega if self.spin is None else self.omega + getattr(y.v, self.spin)
        square = x**2 + z**2
        drag = self.D if self.B_2 is None else self.D + self.B_2 * square
        stiff = self.m_f * turning**2 / 4
        stiff = stiff if self.B_1 is None else stiff - self.B_1 * square
        f_x = stiff * x - self.m_f * turning * w - drag * (v + turning / 2 * z)
        f_z = stiff * z + self.m_f * turning * v - drag * (w - turning / 2 * x)
        found = {self.x: f_x, self.y: f_z}
        return found if self.spin is None else found | {self.spin: z * f_x - x * f_z}

    def mass(self, q: Any) -> Mapping[Any, Number]:
        return {self.x: self.m_f, self.y: self.m_f}

    def reaction(self, q: Any) -> Mapping[tuple[str, str], Number]:
        if self.spin is None:
            return {}
        x, z = getattr(q, self.x), getattr(q, self.y)
        return {(self.spin, self.x): self.m_f * z, (self.spin, self.y): -self.m_f * x}


class _Radius(eqx.Module):
    """The distance of the rotor's middle from that of the stator, with a derivative, zero, at zero too."""

    x: str = eqx.field(static=True)
    y: str = eqx.field(static=True)

    def __call__(self, q: Any) -> Number:
        square = getattr(q, self.x) ** 2 + getattr(q, self.y) ** 2
        there = square > 0
        return jnp.where(there, jnp.sqrt(jnp.where(there, square, 1.0)), 0.0)


class _Rolling(eqx.Module):
    """The velocity with which the rotor's surface moves along that of the stator, r α' + R spin'."""

    radius: _Radius
    spin: Direction | None
    R: float

    def __call__(self, q: Any, v: Any) -> Number:
        (x, y), r = (self.radius.x, self.radius.y), self.radius(q)
        around = getattr(q, x) * getattr(v, y) - getattr(q, y) * getattr(v, x)
        w = around / jnp.where(r > 0, r, 1.0)
        return w if self.spin is None else w + self.R * self.spin.velocity(q, v)


def stator_contact(
    x: str,
    y: str,
    law: ContactLaw,
    *,
    R_c: Any,
    R: Any = 1.0,
    friction: FrictionLaw | None = None,
    omega: Any = None,
    spin: str | None = None,
) -> Contact:
    """The contact of a rotor with its stator, where the distance r of their middles reaches the clearance, (A.5)-(A.8).

    The normal force acts along r. Friction, with that as its normal force, acts along the velocity
    v_rel = r α' + (ω + spin') R of the rotor's surface, (A.6), and so also turns the rotor, (A.10); in stick the rotor
    rolls, (A.7). (A.5) as it is printed is `Viscoelastic(k_b)`; with c_b of Appendix C.6, `Viscoelastic(k_b, c_b)`.

    **Arguments:**

    - `x`, `y`: the coordinates of the rotor's middle, from that of the stator.
    - `law`: how it is pushed back.
    - `R_c`: the clearance [m], the parameter `gap`.
    - `R`: radius of the rotor [m].
    - `friction`: the law of friction, in units of the normal force, as `Coulomb(mu_b)`; none if left out.
    - `omega`: the angular velocity of the rotor, or of the frame of `spin` [rad/s]; zero if left out.
    - `spin`: the coordinate of the rotor's rotation, if it does not turn uniformly [rad].

    **Returns:** a `Contact`.
    """
    radius = _Radius(x, y)
    rubs = None
    if friction is not None:
        along = _Rolling(radius, None if spin is None else direction(spin), float(R) if isinstance(R, int) else R)
        rubs = Friction(Velocity(along), friction, v=None if omega is None else -omega * R)
    return Contact(Function(radius, -1), law, gap=R_c, friction=rubs)
