"""A rotor in a stator filled with fluid: the forces on the drillstring of Appendix A, in Cartesian coordinates."""

import dataclasses
from collections.abc import Mapping
from typing import Any, ClassVar

import equinox as eqx
import jax.numpy as jnp

from .._types import Number
from ..system._system import SwitchValues
from ._contact import Contact, ContactLaw
from ._direction import check_name, Direction, Term
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


class TurningForce(Effect):
    """A force in the plane of the rotor's middle that turns, as that of an eccentric mass:
    F_x = f_0 cos(ω t), F_y = f_0 sin(ω t). Its period is that of the scene.

    **Arguments:**

    - `x`, `y`: the coordinates of the rotor's middle.
    - `f_0`: force [N].
    - `omega`: angular velocity [rad/s].
    """

    formula: ClassVar[str] = "f_0 (cos(omega t), sin(omega t))"

    x: str = eqx.field(static=True)
    y: str = eqx.field(static=True)
    f_0: float = 1.0
    omega: float = 1.0

    def forces(self, t: Any, y: State, s: SwitchValues) -> Mapping[str, Number]:
        return {self.x: self.f_0 * jnp.cos(self.omega * t), self.y: self.f_0 * jnp.sin(self.omega * t)}

    @property
    def period(self) -> Any:
        return 2 * jnp.pi / self.omega

    def laws(self) -> list[tuple[str, str, Any, Any]]:
        return [("omega", "above zero", jnp.asarray(self.omega) > 0, self.omega)]


class _Polar(Direction):
    """A direction in the plane of the rotor's middle. In the middle of the stator, where there is none, it is zero."""

    x: str = eqx.field(static=True)
    y: str = eqx.field(static=True)
    sign: int = eqx.field(static=True, default=1, kw_only=True)

    def check(self, owner: str, names: tuple[str, ...]) -> None:
        for name in (self.x, self.y):
            check_name(owner, name, names)

    @property
    def opposite(self) -> Direction:
        return dataclasses.replace(self, sign=-self.sign)

    def _signed(self, value: Number) -> Number:
        return value if self.sign == 1 else -value

    def _middle(self, q: Any) -> tuple[Number, Number, Number]:
        """x, y and r."""
        x, y = getattr(q, self.x), getattr(q, self.y)
        # Below rounding, but not zero, so that it can be divided by and has derivatives; told apart by a comparison,
        # the middle of the stator would be a place where the guards may jump, which they would be searched for.
        return x, y, jnp.sqrt(x**2 + y**2 + jnp.finfo(jnp.result_type(float, x, y)).eps ** 3)


class _Radial(_Polar):
    """The distance r of the rotor's middle from that of the stator."""

    def distance(self, q: Any) -> Number:
        return self._signed(self._middle(q)[2])

    def velocity(self, q: Any, v: Any) -> Number:
        x, y, r = self._middle(q)
        return self._signed((x * getattr(v, self.x) + y * getattr(v, self.y)) / r)

    def terms(self, y: State, force: Number, sign: int) -> list[Term]:
        x, z, r = self._middle(y.q)
        pull = force / r
        return [(self.x, sign * self.sign, pull * x), (self.y, sign * self.sign, pull * z)]

    def __str__(self) -> str:
        return f"{'-' * (self.sign < 0)}hypot({self.x}, {self.y})"


class _Around(_Polar):
    """The velocity r α' + R spin' of the rotor's surface along that of the stator."""

    spin: str | None = eqx.field(static=True)
    R: float

    def distance(self, q: Any) -> Number:
        raise ValueError("The velocity of a rotor's surface is no derivative of a distance.")

    def velocity(self, q: Any, v: Any) -> Number:
        x, y, r = self._middle(q)
        w = (x * getattr(v, self.y) - y * getattr(v, self.x)) / r
        return self._signed(w if self.spin is None else w + self.R * getattr(v, self.spin))

    def terms(self, y: State, force: Number, sign: int) -> list[Term]:
        x, z, r = self._middle(y.q)
        push = force / r
        found = [(self.x, -sign * self.sign, push * z), (self.y, sign * self.sign, push * x)]
        return found if self.spin is None else [*found, (self.spin, sign * self.sign, self.R * force)]

    def check(self, owner: str, names: tuple[str, ...]) -> None:
        super().check(owner, names)
        if self.spin is not None:
            check_name(owner, self.spin, names)

    def __str__(self) -> str:
        turn = "" if self.spin is None else f" + R {self.spin}'"
        return f"{'-(' * (self.sign < 0)}r alpha'{turn}{')' * (self.sign < 0)}"


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
    rubs = None
    if friction is not None:
        around = _Around(x, y, spin, float(R) if isinstance(R, int) else R)
        rubs = Friction(around, friction, v=None if omega is None else -omega * R)
    return Contact(_Radial(x, y, sign=-1), law, gap=R_c, friction=rubs)
