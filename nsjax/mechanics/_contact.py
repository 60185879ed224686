"""Unilateral contact: rigid with restitution, or visco-elastic; with friction in it."""

import abc
from functools import cached_property
from typing import Any, ClassVar

import equinox as eqx

from .._types import Number
from ..system._impact import impact
from ..system._sgn import sgn
from ..system._switch import AbstractSwitch
from ..system._system import SwitchValues
from ._direction import Direction
from ._effect import Effect, ForceElement, Stretch
from ._friction import Friction
from ._friction_law import Coulomb, FrictionLaw
from ._state import State


class ContactLaw(eqx.Module):
    """How two bodies that touch push each other apart."""

    formula: ClassVar[str] = ""

    @property
    @abc.abstractmethod
    def switch(self) -> AbstractSwitch:
        """The switch, for a system that is the `Contact`."""

    @abc.abstractmethod
    def force(self, at: Stretch, s: Any) -> Number:
        """The normal force, by the penetration `at.d`, its rate `at.v`, and the value of the switch."""


def _gap(self: "Contact", t: Any, y: State) -> Number:
    return self.distance(y)


def _restitution(self: "Contact") -> Any:
    assert isinstance(self.law, Rigid)
    return self.law.e


def _touching(self: "Contact", t: Any, y: State) -> Any:
    assert isinstance(self.law, Viscoelastic)
    at = self.at(y)
    return at.d if self.law.c is None else (at.d, self.law.pressure(at))


_IMPACT = impact(_gap, name="contact").restitution(_restitution)
_SUPPORT = sgn(_touching, name="contact")


class Rigid(ContactLaw):
    """Newton's law of impact, g'(t+) = -e g'(t-), and a contact force >= 0 that keeps the gap closed at rest.

    **Arguments:**

    - `e`: coefficient of restitution (dimensionless, 0 <= e <= 1).
    """

    formula: ClassVar[str] = "N >= 0,  g' -> -e g'"

    e: float = 0.5

    @property
    def switch(self) -> AbstractSwitch:
        return _IMPACT

    def force(self, at: Stretch, s: Any) -> Number:
        return s


class Viscoelastic(ContactLaw):
    """A spring and a damper side by side, N = -(k g + c g'), section 3.5: contact begins where the gap closes, and ends
    where this force vanishes, (3.44)-(3.47), so that it never pulls.

    **Arguments:**

    - `k`: stiffness [N/m].
    - `c`: damping [N s/m]; none if left out.
    """

    formula: ClassVar[str] = "N = -(k g + c g')"

    k: float = 1.0
    c: float | None = None

    @property
    def switch(self) -> AbstractSwitch:
        return _SUPPORT

    def pressure(self, at: Stretch) -> Number:
        """The force in contact."""
        return self.k * at.d if self.c is None else self.k * at.d + self.c * at.v

    def force(self, at: Stretch, s: Any) -> Number:
        return self.pressure(at) * (1 + s) / 2


class _Penetration(Stretch):
    """How deep a contact is, -g, and the rate of that."""

    def __init__(self, along: Direction, y: State, gap: Number | None):
        super().__init__(along.opposite, y)
        self._gap = gap

    @cached_property
    def d(self) -> Any:
        return super().d if self._gap is None else super().d - self._gap


class Contact(ForceElement):
    """A gap g(q) that does not close beyond zero: a stop, a floor, two masses that may meet.

    ```python
    Contact(lambda q: 4.0 - q.x, Rigid(e=0.5))                       # a wall at x = 4
    Contact("z", Rigid(), friction=Coulomb(mu=0.3, along="x"))       # a floor at z = 0 with friction
    Contact({"x": -1}, Viscoelastic(k=4.0, c=0.5), gap=1.0)          # a soft support that x meets at 1
    ```

    Its normal force acts along ∂g/∂q. The switch of its friction is `name.friction`.

    **Arguments:**

    - `along`: the gap as a coordinate, a combination, or a function of q, positive while it is open.
    - `law`: `Rigid` or `Viscoelastic`.
    - `gap`: what is added to it [m], as a parameter: the gap at d = 0.
    - `friction`: a `Friction` along the contact, or a law that says `along` which direction, `Coulomb(0.3, along="x")`.
        Its numbers are coefficients of the normal force.

    **Raises:** `TypeError` for another law, `ValueError` for friction without a
        direction or with another's normal force.
    """

    symbol: ClassVar[str] = "contact"
    presses: ClassVar[bool] = True

    law: ContactLaw
    gap: float | None
    friction: Friction | None

    def __init__(self, along: Any, law: ContactLaw, *, gap: Any = None, friction: Friction | FrictionLaw | None = None):
        if not isinstance(law, ContactLaw):
            raise TypeError(
                f"Argument `law` of `Contact` must be `Rigid(...)` or `Viscoelastic(...)`, but got {law!r}."
            )
        self.along, self.law, self.gap = along, law, gap
        self.friction = None if friction is None else _rubbing(friction)

    @property
    def formula(self) -> str:
        return self.law.formula

    @property
    def switches(self) -> tuple[AbstractSwitch, ...]:
        return (self.law.switch,)

    @property
    def parts(self) -> dict[str, Effect]:
        return {} if self.friction is None else {"friction": self.friction}

    def distance(self, y: State) -> Number:
        """The gap."""
        if self.gap is not None and set((self.along.slopes or {}).values()) == {-1}:
            return self.gap - self.along.opposite.distance(y.q)
        d = self.along.distance(y.q)
        return d if self.gap is None else self.gap + d

    def at(self, y: State) -> Stretch:
        return _Penetration(self.along, y, self.gap)

    def force(self, t: Any, at: Stretch, s: SwitchValues) -> Number:
        return self.law.force(at, s.contact)


def _rubbing(friction: Any) -> Friction:
    """Friction as a part of a contact, whose normal force it takes."""
    if isinstance(friction, Coulomb) and friction.along is not None:
        return Friction(friction.along, Coulomb(friction.mu, friction.mu_stick), normal="..")
    if not isinstance(friction, Friction):
        raise ValueError(
            "Argument `friction` of `Contact` must say in which direction its bodies rub, as `Coulomb(0.3, along='x')` "
            f"or `Friction('x', law)`, but got {friction!r}."
        )
    if friction.normal is not None:
        raise ValueError(
            f"Argument `friction` of `Contact` takes the normal force of this contact, but names `{friction.normal}`."
        )
    return Friction(friction.along, friction.law, v=friction.v, normal="..")
