"""Springs and dampers: forces of a distance or its rate, smooth or with kinks."""

from typing import Any, ClassVar

import equinox as eqx

from .._types import Number
from ..system._sgn import sgn
from ..system._system import SwitchValues
from ._effect import ForceElement, Stretch
from ._state import State


class Spring(ForceElement):
    """A linear spring, F = -k (d - rest).

    **Arguments:**

    - `along`: see `ForceElement`.
    - `k`: stiffness [N/m].
    - `rest`: the distance at which it is slack [m]; zero if left out.
    """

    formula: ClassVar[str] = "-k d"
    symbol: ClassVar[str] = "spring"
    resists: ClassVar[bool] = True

    k: float = 1.0
    rest: float | None = None

    def force(self, t: Any, at: Stretch, s: SwitchValues) -> Number:
        return self.k * (at.d if self.rest is None else at.d - self.rest)


class PolynomialSpring(ForceElement):
    """A spring with a force that is a polynomial, F = -(k1 d + k2 d² + k3 d³); what is left out is not there.

    **Arguments:**

    - `along`: see `ForceElement`.
    - `k1`, `k2`, `k3`: stiffnesses [N/m], [N/m²], [N/m³].

    **Raises:** `ValueError` if none is given.
    """

    formula: ClassVar[str] = "-(k1 d + k2 d² + k3 d³)"
    symbol: ClassVar[str] = "spring"
    resists: ClassVar[bool] = True

    k1: float | None = None
    k2: float | None = None
    k3: float | None = None

    def __check_init__(self):
        if self.k1 is None and self.k2 is None and self.k3 is None:
            raise ValueError("A `PolynomialSpring` must have one of `k1`, `k2`, `k3`, but has none.")

    def force(self, t: Any, at: Stretch, s: SwitchValues) -> Number:
        terms = [
            k * (at.d if n == 1 else at.d**n) for n, k in enumerate((self.k1, self.k2, self.k3), 1) if k is not None
        ]
        return sum(terms[1:], terms[0])


class Damper(ForceElement):
    """A linear damper, F = -c d'.

    **Arguments:**

    - `along`: see `ForceElement`; may be a `Velocity`.
    - `c`: damping [N s/m].
    """

    formula: ClassVar[str] = "-c d'"
    symbol: ClassVar[str] = "damper"
    resists: ClassVar[bool] = True

    c: float = 0.1

    def force(self, t: Any, at: Stretch, s: SwitchValues) -> Number:
        return self.c * at.v


class Backlash(ForceElement):
    """Two visco-elastic stops with play between them, as gear teeth have: no force while |d| < x_c, section 6.6,
    (6.14)-(6.20).

        F = -(k_f (d - x_c) + c_f d')    in contact at d > x_c, until this force vanishes
        F = -(k_f (d + x_c) + c_f d')    in contact at d < -x_c, until this force vanishes

    Its switches are `upper` and `lower`.

    **Arguments:**

    - `along`: see `ForceElement`.
    - `k_f`: stiffness of a stop [N/m].
    - `x_c`: half of the play [m].
    - `c_f`: damping of a stop [N s/m]; none if left out.
    """

    formula: ClassVar[str] = "-(k_f (|d| - x_c) + c_f |d|') sgn d  where |d| > x_c"
    symbol: ClassVar[str] = "backlash"
    resists: ClassVar[bool] = True

    k_f: float = 1.0
    x_c: float = 1.0
    c_f: float | None = None

    def force(self, t: Any, at: Stretch, s: SwitchValues) -> Number:
        upper, lower = (contact[-1] for contact in (self._contact(at.d, at), self._opposite(at)))
        return (upper * (1 + s.upper) - lower * (1 + s.lower)) / 2

    def _contact(self, d: Any, at: Stretch) -> tuple[Number, ...]:
        """Penetration and contact force, both positive in contact; without damping the force is no other condition."""
        depth = d - self.x_c
        return depth, self.k_f * depth + self.c_f * at.v if self.c_f is not None else self.k_f * depth

    def _opposite(self, at: Stretch) -> tuple[Number, ...]:
        depth = -at.d - self.x_c
        return depth, self.k_f * depth - self.c_f * at.v if self.c_f is not None else self.k_f * depth

    def _surface(self, contact: tuple[Number, ...]) -> Any:
        return contact[0] if self.c_f is None else contact

    @sgn
    def upper(self, t: Any, y: State) -> Any:
        at = self.at(y)
        return self._surface(self._contact(at.d, at))

    @sgn
    def lower(self, t: Any, y: State) -> Any:
        return self._surface(self._opposite(self.at(y)))


class TrilinearSpring(Backlash):
    """A spring that stiffens at |d| = x_c, K(d) of (6.16): F = -k d within, F = -k d - k_f (|d| - x_c) sgn d beyond;
    with `c_f` the stiff part is damped, (6.14)-(6.20).

    **Arguments:**

    - `along`, `k_f`, `x_c`, `c_f`: see `Backlash`.
    - `k`: stiffness of the spring within [N/m].
    """

    formula: ClassVar[str] = "-k d,  and -(k_f (|d| - x_c) + c_f |d|') sgn d  where |d| > x_c"

    k: float = eqx.field(default=1.0, kw_only=True)

    def force(self, t: Any, at: Stretch, s: SwitchValues) -> Number:
        return super().force(t, at, s) + self.k * at.d
