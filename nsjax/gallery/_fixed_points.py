"""Bifurcations of fixed points: chapter 5.

The non-smooth ones are continuous and piecewise smooth: their absolute values are |h| = h sgn(h), with a switch for
each kink h = 0, so that the smoothing (2.32) of the same text is that of the thesis. μ is the bifurcation parameter, λ
an eigenvalue, q the place on the way from the lower to the upper side of a kink (5.6); all values of parameters are
ours.
"""

from typing import NamedTuple

import jax.numpy as jnp

from .._numerics._select import select
from .._types import Number, Scalar
from ..system._sgn import sgn
from ..system._system import SwitchValues, System
from ._examples import Line, Plane


class Space(NamedTuple):
    """State of the three-dimensional example."""

    x1: Number
    x2: Number
    x3: Number


class Polar(NamedTuple):
    """State in polar coordinates (5.26)."""

    r: Number
    theta: Number  # [rad]


def _smooth_abs(h: Scalar, epsilon: Scalar) -> Scalar:
    """(2/π) arctan(ε h) h, of the slope ±1 far from h = 0 and (2/π) (arctan(ε h) + ε h/(1 + ε² h²)) anywhere."""
    return 2 / jnp.pi * jnp.arctan(epsilon * h) * h


# Section 5.2.


class NoCrossing(System):
    """A jump of the Jacobian that crosses nothing; ours, for section 5.2, eq. (5.6).

        x1' = x2
        x2' = μ - 3 x1 - 2 |x1| - 2.5 x2

    A damped mass under the load μ, with a support that it just touches at μ = 0. The only fixed point is x1 = μ for
    μ < 0, a stable node with λ = -0.5, -2, and x1 = μ/5 for μ > 0, a stable focus with λ = -1.25 ± 1.85i. In between
    λ² + 2.5 λ + 1 + 4q = 0, whose roots stay on the left: there is no bifurcation.
    """

    mu: float = 1.0  # bifurcation parameter; ours

    def vector_field(self, t: Scalar, y: Plane, s: SwitchValues) -> Plane:
        return Plane(y.x2, self.mu - 3 * y.x1 - 2 * s.kink * y.x1 - 2.5 * y.x2)

    @sgn
    def kink(self, t: Scalar, y: Plane) -> Number:
        return y.x1


class DoubleHopfCrossing(System):
    """A jump at which one pair of eigenvalues crosses the imaginary axis twice, as in Fig. 5.3b; ours, eq. (5.6).

        x1' = x2 - 2 x1 + |x1|
        x2' = x3 - 2 x1 - |x1|
        x3' = μ - 3.36 x1

    The only fixed point is x1 = μ/3.36, x2 = 2 x1 - |x1|, x3 = 2 x1 + |x1|. With s = sgn(x1) its eigenvalues solve
    λ³ + (2 - s) λ² + (2 + s) λ + 3.36 = 0: it is an unstable focus with λ = 0.018 ± 1.052i, -3.035 for μ < 0 and with
    λ = 0.043 ± 1.758i, -1.086 for μ > 0. In between, s = 2q - 1, the pair is on the imaginary axis where
    (2 - s)(2 + s) = 3.36: at q = 0.1, λ = ±i √1.2, and at q = 0.9, λ = ±i √2.8; between these it is on the left. (In
    the plane the trace is affine in q, and a pair crosses once.)

    As of two Hopf bifurcations, there is a stable periodic orbit for μ < 0, of period 5.632 s, and another for μ > 0,
    of period 3.872 s. Both grow with |μ|; between them, at μ = 0, the origin is stable.
    """

    mu: float = 1.0  # bifurcation parameter; ours

    def vector_field(self, t: Scalar, y: Space, s: SwitchValues) -> Space:
        size = s.kink * y.x1
        return Space(y.x2 - 2 * y.x1 + size, y.x3 - 2 * y.x1 - size, self.mu - 3.36 * y.x1)

    @sgn
    def kink(self, t: Scalar, y: Space) -> Number:
        return y.x1


# Section 5.3.


class SaddleNode(System):
    """Saddle-node bifurcation; eq. (5.7).

        x' = μ - x²

    For μ > 0 there are two fixed points, x = √μ with λ = -2 √μ and x = -√μ with λ = 2 √μ; for μ < 0 there is none.
    """

    mu: float = 1.0  # bifurcation parameter; ours

    def vector_field(self, t: Scalar, y: Line, s: SwitchValues) -> Line:
        return Line(self.mu - y.x**2)


class DiscontinuousSaddleNode(System):
    """Discontinuous saddle-node bifurcation; eq. (5.8).

        x' = μ - |x|

    For μ > 0 there are two fixed points, x = μ with λ = -1 and x = -μ with λ = 1; for μ < 0 there is none. At the
    bifurcation J = 1 - 2q (5.9), which vanishes at q = 1/2.
    """

    mu: float = 1.0  # bifurcation parameter; ours

    def vector_field(self, t: Scalar, y: Line, s: SwitchValues) -> Line:
        return Line(self.mu - s.kink * y.x)

    @sgn
    def kink(self, t: Scalar, y: Line) -> Number:
        return y.x


# Section 5.4.


class Transcritical(System):
    """Transcritical bifurcation; eq. (5.10).

        x' = μ x - x²

    The fixed points are x = 0 with λ = μ and x = μ with λ = -μ: they exchange stability at μ = 0.
    """

    mu: float = 1.0  # bifurcation parameter; ours

    def vector_field(self, t: Scalar, y: Line, s: SwitchValues) -> Line:
        return Line(self.mu * y.x - y.x**2)


class DiscontinuousTranscritical(System):
    """Discontinuous transcritical bifurcation; eq. (5.11).

        x' = |μ/2| - |x - μ/2|

    The fixed points are x = 0 with λ = sgn(μ) and x = μ with λ = -sgn(μ). At the bifurcation J = 1 - 2q₁ (5.12) and
    ∂f/∂μ = q₁ + q₂ - 1 (5.14), which both vanish at q₁ = q₂ = 1/2.

    |μ/2| has a switch too, though its surface μ = 0 is never met: smoothed with the other it makes a transcritical
    bifurcation again, smoothed alone the fixed points at μ/2 ± √(π |μ|/(4ε)).
    """

    mu: float = 1.0  # bifurcation parameter; ours

    def vector_field(self, t: Scalar, y: Line, s: SwitchValues) -> Line:
        return Line(s.parameter * self.mu / 2 - s.kink * self.kink(t, y))

    @sgn
    def kink(self, t: Scalar, y: Line) -> Number:
        return y.x - self.mu / 2

    @sgn
    def parameter(self, t: Scalar, y: Line) -> Number:
        return jnp.asarray(self.mu / 2)


class ImperfectTranscritical(System):
    """The non-symmetric smoothing of the discontinuous transcritical bifurcation; eq. (5.15).

        x' = (2/π) arctan(ε μ/2) μ/2 + 1/ε - (2/π) arctan(ε (x - μ/2)) (x - μ/2)

    Near the origin that is (2/π) ε (μ x - x²) + 1/ε, eq. (5.16) with the factor of 1/ε put right. For every μ there
    are two fixed points, symmetric to μ/2, the upper one stable and the lower one unstable: no bifurcation.
    """

    mu: float = 1.0  # bifurcation parameter; ours
    epsilon: float = 10.0  # steepness; ours

    def vector_field(self, t: Scalar, y: Line, s: SwitchValues) -> Line:
        rise = _smooth_abs(self.mu / 2, self.epsilon) + 1 / self.epsilon
        return Line(rise - _smooth_abs(y.x - self.mu / 2, self.epsilon))


# Section 5.5.


class Pitchfork(System):
    """Pitchfork bifurcation; eq. (5.17).

        x' = μ x + α x³

    The fixed points are x = 0 with λ = μ and, where μ/α < 0, x = ±√(-μ/α) with λ = -2μ. α = -1 is the supercritical
    bifurcation (Fig. 5.8a), α = 1 the subcritical one (Fig. 5.8b), whose solutions leave for ever.
    """

    mu: float = 1.0  # bifurcation parameter; ours
    alpha: float = -1.0  # -1 or 1

    def vector_field(self, t: Scalar, y: Line, s: SwitchValues) -> Line:
        return Line(self.mu * y.x + self.alpha * y.x**3)


class DiscontinuousPitchfork(System):
    """Discontinuous pitchfork bifurcation; eq. (5.18) for α = -1, supercritical, and (5.22) for α = 1, subcritical.

        x' = α x + |x + μ/2| - |x - μ/2|

    The fixed point x = 0 has λ = α - 2 for μ < 0 and λ = α + 2 for μ > 0; where μ/α < 0 there are x = ±μ too, with
    λ = α. At the bifurcation J = α + 2 (q_left - q_right), where the thesis counts q from the upper side, (5.19), and
    ∂f/∂μ = q_left + q_right - 1 (5.21): for α = -1 both vanish at q_left = 3/4, q_right = 1/4.

    Smoothed by an arctangent the bifurcation of (5.18) is at μ = 0.8832/ε; the thesis's π/(4ε) is that of its series.
    """

    mu: float = 1.0  # bifurcation parameter; ours
    alpha: float = -1.0  # -1 or 1

    def vector_field(self, t: Scalar, y: Line, s: SwitchValues) -> Line:
        return Line(self.alpha * y.x + s.left * self.left(t, y) - s.right * self.right(t, y))

    @sgn
    def left(self, t: Scalar, y: Line) -> Number:
        return y.x + self.mu / 2

    @sgn
    def right(self, t: Scalar, y: Line) -> Number:
        return y.x - self.mu / 2


class ImperfectPitchfork(System):
    """The non-symmetric smoothing of the discontinuous pitchfork bifurcation; eq. (5.23).

        x' = -x + (2/π) arctan(ε (x + μ/2)) (x + μ/2) + 1/ε - (2/π) arctan(ε (x - μ/2)) (x - μ/2)

    The upper branch of stable fixed points passes the origin by. The lower two are born in a saddle-node bifurcation at
    μ = 3.2348/ε, x = -1.6085/ε.
    """

    mu: float = 1.0  # bifurcation parameter; ours
    epsilon: float = 10.0  # steepness; ours

    def vector_field(self, t: Scalar, y: Line, s: SwitchValues) -> Line:
        left = _smooth_abs(y.x + self.mu / 2, self.epsilon) + 1 / self.epsilon
        return Line(-y.x + left - _smooth_abs(y.x - self.mu / 2, self.epsilon))


# Section 5.6.


class Hopf(System):
    """Hopf bifurcation; eq. (5.25).

        x1' = μ x1 - ω x2 + (α x1 - β x2) (x1² + x2²)
        x2' = ω x1 + μ x2 + (β x1 + α x2) (x1² + x2²)

    The origin has λ = μ ± iω. In polar coordinates r' = μ r + α r³, θ' = ω + β r² (5.27), (5.28): where μ/α < 0 there
    is a periodic orbit of radius r = √(-μ/α) and period 2π/(ω + β r²), stable for α < 0 (supercritical).
    """

    mu: float = 1.0  # bifurcation parameter; ours
    omega: float = 1.0  # angular velocity at the origin; ours [rad/s]
    alpha: float = -1.0  # ours
    beta: float = 1.0  # ours

    def vector_field(self, t: Scalar, y: Plane, s: SwitchValues) -> Plane:
        square = y.x1**2 + y.x2**2
        growth, turn = self.mu + self.alpha * square, self.omega + self.beta * square
        return Plane(growth * y.x1 - turn * y.x2, turn * y.x1 + growth * y.x2)


class DiscontinuousHopf(System):
    """Discontinuous Hopf bifurcation; eq. (5.29).

        x1' = -x1 - ω x2 + (x1/r) (|r + μ/2| - |r - μ/2|),    r = √(x1² + x2²)
        x2' =  ω x1 - x2 + (x2/r) (|r + μ/2| - |r - μ/2|)

    The origin has λ = -3 ± iω for μ < 0 and λ = 1 ± iω for μ > 0; then there is a stable periodic orbit of radius μ and
    period 2π/ω too, with the multiplier exp(-2π/ω). At the bifurcation λ = -3 + 4q ± iω, on the imaginary axis at
    q = 3/4.

    The surfaces r = ∓μ/2 are written r² = ∓μ|μ|/4, smooth at the origin. A smoothed system, with these for the
    indicator functions, has its Hopf bifurcation at μ = 2/√ε; that of (5.30), where they are r ± μ/2, at 0.8832/ε.
    """

    mu: float = 1.0  # bifurcation parameter; ours
    omega: float = 1.0  # angular velocity; ours [rad/s]

    def vector_field(self, t: Scalar, y: Plane, s: SwitchValues) -> Plane:
        square = y.x1**2 + y.x2**2
        # At the origin r / r is told apart from μ / r, whose factor s.plus + s.minus vanishes there.
        away = square > 0
        per_r = select(away, 1 / jnp.sqrt(select(away, square, 1)), 0)
        growth = -1 + s.plus - s.minus + self.mu / 2 * (s.plus + s.minus) * per_r
        return Plane(growth * y.x1 - self.omega * y.x2, self.omega * y.x1 + growth * y.x2)

    @sgn
    def plus(self, t: Scalar, y: Plane) -> Number:
        return y.x1**2 + y.x2**2 + self.mu * jnp.abs(self.mu) / 4

    @sgn
    def minus(self, t: Scalar, y: Plane) -> Number:
        return y.x1**2 + y.x2**2 - self.mu * jnp.abs(self.mu) / 4


class PolarHopf(System):
    """The discontinuous Hopf bifurcation in polar coordinates; eq. (5.30), (5.31).

        r' = -r + |r + μ/2| - |r - μ/2|
        θ' = ω

    The first is the discontinuous pitchfork bifurcation (5.18). r < 0 is the point opposite to -r.
    """

    mu: float = 1.0  # bifurcation parameter; ours
    omega: float = 1.0  # angular velocity; ours [rad/s]

    def vector_field(self, t: Scalar, y: Polar, s: SwitchValues) -> Polar:
        growth = -y.r + s.plus * self.plus(t, y) - s.minus * self.minus(t, y)
        return Polar(growth, jnp.full_like(y.theta, self.omega))

    @sgn
    def plus(self, t: Scalar, y: Polar) -> Number:
        return y.r + self.mu / 2

    @sgn
    def minus(self, t: Scalar, y: Polar) -> Number:
        return y.r - self.mu / 2


# Section 5.7.


class HopfPitchfork(System):
    """Hopf-pitchfork bifurcation of a fixed point; section 5.7, eq. (5.32).

        x1' = x2
        x2' = -x1 + |x1 + μ| - |x1 - μ| - x2 - |x2 + μ| + |x2 - μ|

    For μ < 0 the origin is an unstable focus, λ = (1 ± i√11)/2 (5.33), and a stable periodic orbit of period 4.03 s,
    whose size grows with -μ, surrounds it. For μ > 0 it is a saddle, λ = -3/2 ± √13/2 (5.34), and there are two stable
    nodes at x1 = ±2μ, λ = -3/2 ± √5/2 (5.35). In between λ² + (4q - 1) λ + 3 - 4q = 0 (5.36): a pair crosses the
    imaginary axis at q = 1/4, an eigenvalue at q = 3/4. For μ = ∓1 these are (5.38) and (5.39).
    """

    mu: float = -1.0  # bifurcation parameter; ours

    def vector_field(self, t: Scalar, y: Plane, s: SwitchValues) -> Plane:
        at_x1 = s.left * self.left(t, y) - s.right * self.right(t, y)
        at_x2 = s.below * self.below(t, y) - s.above * self.above(t, y)
        return Plane(y.x2, -y.x1 + at_x1 - y.x2 - at_x2)

    @sgn
    def left(self, t: Scalar, y: Plane) -> Number:
        return y.x1 + self.mu

    @sgn
    def right(self, t: Scalar, y: Plane) -> Number:
        return y.x1 - self.mu

    @sgn
    def below(self, t: Scalar, y: Plane) -> Number:
        return y.x2 + self.mu

    @sgn
    def above(self, t: Scalar, y: Plane) -> Number:
        return y.x2 - self.mu


class SmoothHopfPitchfork(System):
    """The smooth approximation of the Hopf-pitchfork bifurcation; eq. (5.40): `smoothed(HopfPitchfork(mu), epsilon)`.

        x1' = x2
        x2' = -x1 + a(x1 + μ) - a(x1 - μ) - x2 - a(x2 + μ) + a(x2 - μ),    a(h) = (2/π) arctan(ε h) h

    The origin has λ² + (1 + g) λ + 1 - g = 0 with g = 2 a'(μ). There is a Hopf bifurcation at μ = -0.4416/ε, λ = ±i√2,
    and a pitchfork bifurcation at μ = 0.4416/ε, where a'(μ) = ∓1/2; the thesis's ∓π/(8ε) is that of its series (5.41).
    """

    mu: float = -1.0  # bifurcation parameter; ours
    epsilon: float = 10.0  # steepness

    def vector_field(self, t: Scalar, y: Plane, s: SwitchValues) -> Plane:
        at_x1 = _smooth_abs(y.x1 + self.mu, self.epsilon) - _smooth_abs(y.x1 - self.mu, self.epsilon)
        at_x2 = _smooth_abs(y.x2 + self.mu, self.epsilon) - _smooth_abs(y.x2 - self.mu, self.epsilon)
        return Plane(y.x2, -y.x1 + at_x1 - y.x2 - at_x2)
