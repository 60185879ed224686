"""The examples of section 2.1: how the vector field can meet a surface of discontinuity."""

from typing import NamedTuple

from .._types import Number, Scalar
from ..system._sgn import sgn
from ..system._system import SwitchValues, System


class Line(NamedTuple):
    """State of the one-dimensional examples."""

    x: Number


class Plane(NamedTuple):
    """State of the two-dimensional examples."""

    x1: Number
    x2: Number


class _OnLine(System):
    """The surface x = 0."""

    @sgn
    def surface(self, t: Scalar, y: Line) -> Number:
        return y.x


class _InPlane(System):
    """The surface x2 = c. (The thesis names its sides by h = c - x2; here s = sgn(x2 - c), as in its equations.)"""

    c: float = 1.0  # position of the surface; ours

    @sgn
    def surface(self, t: Scalar, y: Plane) -> Number:
        return y.x2 - self.c


class SlidingPoint(_OnLine):
    """x' in 1 - 2 Sgn(x), eq. (2.3), (2.7): every solution reaches x = 0 and stays there."""

    def vector_field(self, t: Scalar, y: Line, s: SwitchValues) -> Line:
        return Line(1 - 2 * s.surface)


class TransversalIntersection(_InPlane):
    """x1' = 4 + 2 sgn(x2 - c), x2' = -4 + 2 sgn(x2 - c), eq. (2.16), example 2.1: solutions cross the surface."""

    def vector_field(self, t: Scalar, y: Plane, s: SwitchValues) -> Plane:
        return Plane(4 + 2 * s.surface, -4 + 2 * s.surface)


class AttractionSliding(_InPlane):
    """x1' = 4 + 2 sgn(x2 - c), x2' = 2 - 4 sgn(x2 - c), eq. (2.18), example 2.2: solutions slide along the surface
    with s = 1/2, at x1' = 5, eq. (2.19)-(2.20)."""

    def vector_field(self, t: Scalar, y: Plane, s: SwitchValues) -> Plane:
        return Plane(4 + 2 * s.surface, 2 - 4 * s.surface)


class RepulsionSliding(_InPlane):
    """x1' = -4 - 2 sgn(x2 - c), x2' = -2 + 4 sgn(x2 - c), eq. (2.22), example 2.3: (2.18) in reverse time. From a
    point of the surface there are infinitely many solutions, since they may leave it at any later time."""

    def vector_field(self, t: Scalar, y: Plane, s: SwitchValues) -> Plane:
        return Plane(-4 - 2 * s.surface, -2 + 4 * s.surface)


class RepellingPoint(_OnLine):
    """x' in Sgn(x), eq. (2.23), example 2.4: from x = 0 one may leave to either side, at any time."""

    def vector_field(self, t: Scalar, y: Line, s: SwitchValues) -> Line:
        return Line(s.surface)


class StickingPoint(_OnLine):
    """x' = 2 + sgn(x) for x != 0, x' in [-1, 4] at x = 0, example 2.5: though both sides push the same way, x = 0 is a
    solution next to x = 3 t, as 0 is in F(0), which is not the smallest convex set.

    F(0) is written 2 + s with |s| <= 3, which is [-1, 5] and not the thesis's [-1, 4]: a breakaway bound is
    symmetric. Only that s = -2 is allowed matters; the upper end is never reached.
    """

    def vector_field(self, t: Scalar, y: Line, s: SwitchValues) -> Line:
        return Line(2 + s.surface)

    # Extends the inherited surface; `_OnLine.surface` stays as it is for the others.
    @_OnLine.surface.breakaway
    def surface(self) -> float:
        return 3.0
