"""A non-smooth continuous system made of absolute values: section 5.7."""

from .._system import sgn, SwitchValues, System
from .._types import Scalar
from ._examples import Plane


class HopfPitchfork(System):
    """Hopf-pitchfork bifurcation of a fixed point; section 5.7, eq. (5.32). The absolute values are h sgn(h).

        x1' = x2
        x2' = -x1 + |x1 + μ| - |x1 - μ| - x2 - |x2 + μ| + |x2 - μ|

    For μ < 0 a stable periodic orbit of period 4.03 s, whose size grows with -μ, surrounds the unstable focus at the
    origin; for μ > 0 there are the saddle at the origin and two stable nodes at x1 = ±2 μ.
    """

    mu: float = -1.0  # bifurcation parameter; ours

    def vector_field(self, t: Scalar, y: Plane, s: SwitchValues) -> Plane:
        at_x1 = s.left * (y.x1 + self.mu) - s.right * (y.x1 - self.mu)
        at_x2 = s.below * (y.x2 + self.mu) - s.above * (y.x2 - self.mu)
        return Plane(y.x2, -y.x1 + at_x1 - y.x2 - at_x2)

    @sgn
    def left(self, t: Scalar, y: Plane) -> Scalar:
        return y.x1 + self.mu

    @sgn
    def right(self, t: Scalar, y: Plane) -> Scalar:
        return y.x1 - self.mu

    @sgn
    def below(self, t: Scalar, y: Plane) -> Scalar:
        return y.x2 + self.mu

    @sgn
    def above(self, t: Scalar, y: Plane) -> Scalar:
        return y.x2 - self.mu
