"""Dry friction: on the ground, on a moving belt, between two masses, or in a contact."""

from collections.abc import Mapping
from typing import Any, ClassVar

import equinox as eqx

from .._numerics._text import did_you_mean
from .._types import Number
from ..system._sgn import sgn
from ..system._switch import AbstractSwitch
from ..system._system import SwitchValues
from ._effect import Effect, ForceElement, Stretch
from ._friction_law import FrictionLaw, StaticPoint
from ._state import State


def _sliding(self: "Friction", t: Any, y: State) -> Number:
    return self.sliding(self.at(y))


def _bound(self: "Friction") -> Any:
    return self.law.bound


_SLIP = sgn(_sliding, name="slip")
_STATIC = _SLIP.breakaway(_bound)


class Friction(ForceElement):
    """Dry friction along a direction, by a `FrictionLaw` of the sliding velocity w = d' - v.

    `Friction("x", v=0.2, slip=1.0, stick=2.0)` has a static friction point (3.34); other laws are `Coulomb`, `Falling`,
    `SmoothFalling`, `Stribeck`, `Cubic` and, of your own, `Characteristic`. With `normal` the law's numbers are
    coefficients of the normal force of a contact of the scene. Several elements on one velocity share what holds it in
    proportion to their strength.

    **Arguments:**

    - `along`: see `ForceElement`; the distance between two masses for friction between them; may be a `Velocity`.
    - `law`: the friction law; a static friction point of `slip` and `stick` if left out.
    - `v`: velocity of the belt [m/s]; at rest if left out.
    - `slip`, `stick`: see `StaticPoint`.
    - `normal`: the name of the `Contact` whose normal force it needs.

    **Raises:** `TypeError`, `ValueError` if both a law and forces are given, or none.
    """

    symbol: ClassVar[str] = "friction"
    resists: ClassVar[bool] = True

    law: FrictionLaw
    v: float | None
    normal: str | None = eqx.field(static=True)

    def __init__(
        self,
        along: Any,
        law: FrictionLaw | None = None,
        *,
        v: Any = None,
        slip: Any = None,
        stick: Any = None,
        normal: str | None = None,
    ):
        if law is None and slip is None:
            raise ValueError("Argument `law` of `Friction` must be a friction law, or `slip` the force in slip.")
        if law is not None and not isinstance(law, FrictionLaw):
            raise TypeError(
                f"Argument `law` of `Friction` must be a `FrictionLaw`, such as `Coulomb(0.3)`, but got {law!r}."
            )
        if law is not None and (slip is not None or stick is not None):
            raise ValueError(
                "Arguments `slip` and `stick` of `Friction` are those of a static friction point: give no `law`."
            )
        self.along = along
        self.law = StaticPoint(slip, stick) if law is None else law
        self.v, self.normal = v, normal

    @property
    def formula(self) -> str:
        law = self.law.formula
        return f"-N ({law})" if self.normal else f"-({law})" if " + " in law or " - " in law else f"-{law}"

    @property
    def switches(self) -> tuple[AbstractSwitch, ...]:
        return () if self.law.smooth else (_STATIC if self.law.static else _SLIP,)

    @property
    def needs(self) -> dict[str, str]:
        return {} if self.normal is None else {"normal": self.normal}

    def sliding(self, at: Stretch) -> Number:
        """The sliding velocity w."""
        return at.v if self.v is None else at.v - self.v

    def force(self, t: Any, at: Stretch, s: SwitchValues) -> Number:
        w = self.sliding(at) if self.law.varies else None
        force = self.law.force(None if self.law.smooth else s.slip, w)
        return force if self.normal is None else force * s.normal

    def check(self, owner: str, names: tuple[str, ...], others: Mapping[str, Effect]) -> None:
        super().check(owner, names, others)
        if self.normal not in (None, ".."):
            if self.normal not in others:
                raise ValueError(
                    f"Effect `{owner}` must take its normal force from a contact of the scene, but there is no effect "
                    f"`{self.normal}` (there are {', '.join(others)})." + did_you_mean(self.normal, others)
                )
            if not others[self.normal].presses:
                raise ValueError(
                    f"Effect `{owner}` must take its normal force from a `Contact`, but `{self.normal}` is a "
                    f"`{type(others[self.normal]).__name__}`."
                )

    def laws(self) -> list[tuple[str, str, Any, Any]]:
        return [(f"law.{name}", law, good, value) for name, law, good, value in self.law.laws()]
