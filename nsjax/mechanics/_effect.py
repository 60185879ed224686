"""What a scene lists: an effect brings forces, and the switches, masses and period that these need."""

import abc
from collections.abc import Mapping
from functools import cached_property
from typing import Any, ClassVar

import equinox as eqx

from .._types import Number
from ..system._switch import AbstractSwitch, declared
from ..system._system import SwitchValues
from ._direction import Direction, direction, Term
from ._state import State


class Effect(eqx.Module):
    """One thing that acts in a scene. Its parameters are its fields, its switches methods decorated by `nsjax.sgn`,
    `nsjax.relay`, `nsjax.impact` or `nsjax.clock`, as those of a `System`.

    ```python
    class Magnet(nsjax.mechanics.Effect):
        strength: float = 1.0  # [N m²]

        def forces(self, t, y, s):
            return {"x": -self.strength / y.q.x**2}
    ```

    A switch is called as the effect is in the scene: `belt`; if an effect has several: `belt.upper`, `belt.lower`.
    Its guard is `h(self, t, y)` with the state y of the scene. For one force along one direction, see `ForceElement`.
    """

    formula: ClassVar[str] = ""  # the force as it is printed
    symbol: ClassVar[str] = ""  # what stands for it in a sketch
    presses: ClassVar[bool] = False  # whether its force is a normal force, which friction can take

    @property
    def switches(self) -> tuple[AbstractSwitch, ...]:
        """Its switches, by default the decorated methods. What they are is up to the structure of the effect, not to
        its numbers."""
        return declared(type(self))

    @abc.abstractmethod
    def forces(self, t: Any, y: State, s: SwitchValues) -> Mapping[str, Number]:
        """The generalised forces by coordinate, for the values `s` of its own switches. Coordinates on which it does
        not act are left out; an effect that brings mass alone returns `{}`."""

    def mass(self, q: Any) -> Mapping[Any, Number]:
        """What it adds to the mass matrix: `{"x": m}` on the diagonal, `{("x", "z"): m}` beside it, once."""
        return {}

    def reaction(self, q: Any) -> Mapping[tuple[str, str], Number]:
        """What accelerations of other coordinates do to one: `{("phi", "x"): m}` for m x'' on the left side of the
        equation of phi. For inertia that is not symmetric, as where the torque of a force with added mass acts."""
        return {}

    @property
    def adds_mass(self) -> bool:
        """Whether it has a `mass`."""
        return type(self).mass is not Effect.mass

    @property
    def period(self) -> Any:
        """The period of its explicit dependence on time [time], or None."""
        return None

    @property
    def parts(self) -> dict[str, "Effect"]:
        """Effects within it, by the names of their fields."""
        return {}

    @property
    def needs(self) -> dict[str, str]:
        """Forces of other effects that its own depend on, by the names under which `s` has them: the name of the
        effect, or ".." for the one of which this is a part."""
        return {}

    def terms(self, t: Any, y: State, s: SwitchValues) -> list[Term]:
        """The generalised forces as the scene sums them."""
        return [(name, 1, value) for name, value in self.forces(t, y, s).items()]

    def check(self, owner: str, names: tuple[str, ...], others: Mapping[str, "Effect"]) -> None:
        """Raises `ValueError` if it, called `owner`, does not fit a scene with these coordinates and effects."""

    def laws(self) -> list[tuple[str, str, Any, Any]]:
        """What must hold for its numbers: the parameter, the law, whether it holds, the number."""
        return []

    @property
    def directions(self) -> tuple[Direction, ...]:
        """Those in which it acts, for sketches."""
        return ()


class Stretch:
    """The distance `d` along a direction, and its rate `v`, worked out when they are asked for."""

    def __init__(self, along: Direction, y: State):
        self._along, self._y = along, y

    @cached_property
    def d(self) -> Any:
        """Distance [m]."""
        return self._along.distance(self._y.q)

    @cached_property
    def v(self) -> Any:
        """Velocity [m/s]."""
        return self._along.velocity(self._y.q, self._y.v)


class ForceElement(Effect):
    """One force along one direction: geometry apart from law.

    ```python
    class Hardening(nsjax.mechanics.ForceElement):
        k: float = 1.0  # [N/m³]

        def force(self, t, at, s):
            return -self.k * at.d**3
    ```

    **Arguments:**

    - `along`: the name of a coordinate; a combination, `{"x1": 1, "x2": -1}` for the distance between two masses; a
        smooth function d(q), as `lambda q: jnp.hypot(q.x, q.y)`; or a `Velocity`.
    """

    resists: ClassVar[bool] = False  # whether `force` is counted positive against the direction

    along: Direction = eqx.field(converter=direction)

    @abc.abstractmethod
    def force(self, t: Any, at: Stretch, s: SwitchValues) -> Number:
        """The force [N], positive where it drives d up, by the distance `at.d` and its rate `at.v`; if `resists` is
        true, positive where it drives d down."""

    def forces(self, t: Any, y: State, s: SwitchValues) -> dict[str, Number]:
        found: dict[str, Number] = {}
        for name, sign, value in self.terms(t, y, s):
            value = value if sign > 0 else -value
            found[name] = found[name] + value if name in found else value
        return found

    def terms(self, t: Any, y: State, s: SwitchValues) -> list[Term]:
        return self.along.terms(y, self.force(t, self.at(y), s), -1 if self.resists else 1)

    def at(self, y: State) -> Stretch:
        """Where it is."""
        return Stretch(self.along, y)

    def check(self, owner: str, names: tuple[str, ...], others: Mapping[str, Effect]) -> None:
        self.along.check(owner, names)

    @property
    def directions(self) -> tuple[Direction, ...]:
        return (self.along,)
