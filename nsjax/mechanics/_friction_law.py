"""Friction laws: the friction force as a function of the sliding velocity, whatever rubs.

A law gives the force that resists, for a value s in Sgn(w) and the sliding velocity w; it is affine in s, so that in
stick, w = 0, it is anything between its values for s = -1 and s = 1. Its numbers are forces, or, where friction is
that of a contact, coefficients of the normal force.
"""

import abc
from typing import Any, ClassVar

import equinox as eqx
import jax.numpy as jnp
from jaxtyping import Array, Float

from .._types import Number
from ._direction import Direction, direction, function


def falling(s: Float[Array, ""], v_rel: Float[Array, ""], delta: Float[Array, ""]) -> Float[Array, ""]:
    """s / (1 + δ|v_rel|) with s in Sgn(v_rel), as a function that is affine in s and smooth at v_rel = 0 for fixed s.

    It is ½(1 + s) g(v_rel) - ½(1 - s) g(-v_rel) with g(w) = 1 / (1 + δ w): each region's own characteristic, weighted
    by s, hence exact for s = ±1, and s itself while sticking at v_rel = 0; the falling characteristic of (2.28) and
    (2.31).

    **Arguments:**

    - `s`: the value of the switch.
    - `v_rel`: relative velocity of the rubbing bodies [m/s].
    - `delta`: δ > 0, how fast friction falls [s/m].

    **Returns:** the friction force over its value at v_rel = 0 (dimensionless).
    """

    # |v_rel| itself would not do: at an event v_rel is zero up to rounding, so that its derivative would be that of
    # the region which rounding chose and not that of the region s. The g of one region continues smoothly to the
    # other side, where stages of an overshooting step ask for it; it is held constant from δ w = -1/2, before its pole
    # at δ w = -1. Only s of the wrong sign gives weight to values there.
    def g(w: Float[Array, ""]) -> Float[Array, ""]:
        return 1 / (1 + jnp.maximum(delta * w, -0.5))

    return (1 + s) / 2 * g(v_rel) - (1 - s) / 2 * g(-v_rel)


class FrictionLaw(eqx.Module):
    """What resists sliding, by the sliding velocity; see `Characteristic` for one of your own."""

    formula: ClassVar[str] = ""
    smooth: ClassVar[bool] = False  # whether it is a smooth function of w, without stick and without a switch
    varies: ClassVar[bool] = True  # whether it depends on w apart from its sign

    @abc.abstractmethod
    def force(self, s: Any, w: Any) -> Number:
        """The friction force against the sliding velocity `w` [m/s], affine in `s`, the value in Sgn(w)."""

    @property
    def static(self) -> bool:
        """Whether friction at rest is stronger than in slip."""
        return False

    @property
    def bound(self) -> Any:
        """F_stick / F_slip, the largest |s| in stick."""
        return 1.0

    def laws(self) -> list[tuple[str, str, Any, Any]]:
        """As of `Effect.laws`."""
        return []


class Coulomb(FrictionLaw):
    """Coulomb's law, F = μ s: with the normal force of a contact as its unit, else in newtons.

    **Arguments:**

    - `mu`: the coefficient of friction in slip.
    - `mu_stick`: that at rest, at least `mu`; the same if left out.
    - `along`: for a law that is given to a `Contact` as it is: the direction in which its bodies rub.
    """

    formula: ClassVar[str] = "mu s"
    varies: ClassVar[bool] = False

    mu: float = 0.3
    mu_stick: float | None = None
    along: Direction | None = eqx.field(
        default=None, kw_only=True, converter=lambda along: None if along is None else direction(along)
    )

    def force(self, s: Any, w: Any) -> Number:
        return self.mu * s

    @property
    def static(self) -> bool:
        return self.mu_stick is not None

    @property
    def bound(self) -> Any:
        return 1.0 if self.mu_stick is None else self.mu_stick / self.mu


class StaticPoint(FrictionLaw):
    """The static friction point, friction law (c) of Fig. 2.5, (2.29), (3.34): F = slip s, and in stick up to `stick`.

    **Arguments:**

    - `slip`: friction force in slip [N].
    - `stick`: maximum friction force at rest [N]; the same if left out.
    """

    formula: ClassVar[str] = "slip s"
    varies: ClassVar[bool] = False

    slip: float = 1.0
    stick: float | None = None

    def force(self, s: Any, w: Any) -> Number:
        return self.slip * s

    @property
    def static(self) -> bool:
        return self.stick is not None

    @property
    def bound(self) -> Any:
        return 1.0 if self.stick is None else self.stick / self.slip


class Falling(FrictionLaw):
    """Falling friction, law (b) of Fig. 2.5: F = [(F_s - F_d)/(1 + δ|w|) + F_d] s, (2.28); without F_d it is (2.31),
    and the torque on bit (A.9).

    **Arguments:**

    - `F_s`: friction force at rest [N].
    - `delta`: how fast it falls [s/m].
    - `F_d`: friction force at high velocity [N]; zero if left out.
    """

    formula: ClassVar[str] = "[(F_s - F_d)/(1 + delta |w|) + F_d] s"

    F_s: float = 1.0
    delta: float = 3.0
    F_d: float | None = None

    def force(self, s: Any, w: Any) -> Number:
        if self.F_d is None:
            return self.F_s * falling(s, w, self.delta)
        return (self.F_s - self.F_d) * falling(s, w, self.delta) + self.F_d * s


class SmoothFalling(FrictionLaw):
    """Falling friction smoothed, law (a) of Fig. 2.5: F = (2/π) arctan(ε w) [(F_s - F_d)/(1 + δ|w|) + F_d], (2.27). It
    has no switch and no stick.

    **Arguments:**

    - `F_s`, `delta`, `F_d`: as of `Falling`; `F_d` is 0 by default.
    - `epsilon`: steepness [s/m].
    """

    formula: ClassVar[str] = "2/π arctan(epsilon w) [(F_s - F_d)/(1 + delta |w|) + F_d]"
    smooth: ClassVar[bool] = True

    F_s: float = 1.0
    delta: float = 3.0
    F_d: float = 0.0
    epsilon: float = 1e3

    def force(self, s: Any, w: Any) -> Number:
        # |w| has no kink that matters here: arctan(ε w)|w| is continuously differentiable.
        size = (self.F_s - self.F_d) / (1 + self.delta * jnp.abs(w)) + self.F_d
        return 2 / jnp.pi * jnp.arctan(self.epsilon * w) * size


class Stribeck(FrictionLaw):
    """Stribeck's curve, F = [F_d + (F_s - F_d) exp(-(w/v_s)²)] s + c w.

    **Arguments:**

    - `F_s`: friction force at rest [N].
    - `F_d`: Coulomb's part, at high velocity [N].
    - `v_s`: Stribeck's velocity [m/s].
    - `c`: viscous part [N s/m]; none if left out.
    """

    formula: ClassVar[str] = "[F_d + (F_s - F_d) exp(-(w/v_s)²)] s + c w"

    F_s: float = 1.5
    F_d: float = 1.0
    v_s: float = 0.1
    c: float | None = None

    def force(self, s: Any, w: Any) -> Number:
        dry = (self.F_d + (self.F_s - self.F_d) * jnp.exp(-((w / self.v_s) ** 2))) * s
        return dry if self.c is None else dry + self.c * w

    def laws(self) -> list[tuple[str, str, Any, Any]]:
        return [("v_s", "above zero", jnp.asarray(self.v_s) > 0, self.v_s)]


class Cubic(FrictionLaw):
    """Friction that falls and rises again, F = α_0 s - α_1 w + α_3 w³, (6.28).

    **Arguments:**

    - `alpha_0`: friction force at rest [N].
    - `alpha_1`: its fall [N s/m].
    - `alpha_3`: its rise [N s³/m³].
    """

    formula: ClassVar[str] = "alpha_0 s - alpha_1 w + alpha_3 w³"

    alpha_0: float = 1.5
    alpha_1: float = 1.5
    alpha_3: float = 0.45

    def force(self, s: Any, w: Any) -> Number:
        return self.alpha_0 * s - self.alpha_1 * w + self.alpha_3 * w**3


class Characteristic(FrictionLaw):
    """A law of your own, F = g(|w|) s.

    ```python
    Friction("x", Characteristic(lambda w: 0.8 + 0.4 * jnp.exp(-5 * w)), v=0.2)
    ```

    **Arguments:**

    - `fn`: the friction force g(w) at a sliding speed w >= 0 [N]; one that has parameters is an `equinox.Module`. It
        must be finite and smooth a little below w = 0 too, where steps that end in stick look.
    - `stick`: the maximum friction force at rest [N], at least g(0); the same if left out.
    """

    formula: ClassVar[str] = "g(|w|) s"

    fn: Any = eqx.field(converter=function)
    stick: float | None = None

    def force(self, s: Any, w: Any) -> Number:
        # Each region has its own characteristic, see `falling`.
        return (1 + s) / 2 * self.fn(w) - (1 - s) / 2 * self.fn(-w)

    @property
    def static(self) -> bool:
        return self.stick is not None

    @property
    def bound(self) -> Any:
        return 1.0 if self.stick is None else self.stick / self.fn(jnp.zeros_like(jnp.asarray(self.stick)))
