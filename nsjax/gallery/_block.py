"""A rigid block on a floor under the friction laws (a), (b), (c) of Fig. 2.5."""

from typing import NamedTuple

import jax.numpy as jnp
from jaxtyping import Array, Float

from .._types import Number, Scalar
from ..mechanics._friction_law import falling
from ..system._sgn import sgn
from ..system._system import SwitchValues, System


class Slip(NamedTuple):
    """State of the block."""

    v: Number  # velocity relative to the floor [m/s]


class _Block(System):
    """m v' = F_ex - F(v), eq. (2.26). The thesis gives no values; these are ours, except δ, which is that of
    section 2.4. F_d < F_ex < F_s: the block is brought to rest from v < 0 and cannot start again."""

    m: float = 1.0  # mass [kg]
    F_ex: float = 0.75  # external force [N]
    F_s: float = 1.0  # maximum static friction force [N]
    F_d: float = 0.5  # dynamic friction force [N]


class SmoothBlock(_Block):
    """Block on a floor with friction law (a), a stiff smooth system; eq. (2.26), (2.27).

        m v' = F_ex - (2/π) arctan(ε v) [(F_s - F_d)/(1 + δ|v|) + F_d]

    It has no stick: the block creeps at about v = tan(π F_ex/(2 F_s))/ε.
    """

    delta: float = 3.0  # fall of the friction force with velocity [s/m]
    epsilon: float = 1e3  # steepness [s/m]

    def vector_field(self, t: Scalar, y: Slip, s: SwitchValues) -> Slip:
        sign = 2 / jnp.pi * jnp.arctan(self.epsilon * y.v)
        # |v| has no kink that matters here: arctan(ε v)|v| is continuously differentiable.
        friction = sign * ((self.F_s - self.F_d) / (1 + self.delta * jnp.abs(y.v)) + self.F_d)
        return Slip((self.F_ex - friction) / self.m)


class _StickingBlock(_Block):
    """A block that sticks at v = 0."""

    @sgn
    def floor(self, t: Scalar, y: Slip) -> Number:
        return y.v


class FallingFrictionBlock(_StickingBlock):
    """Block on a floor with friction law (b), set-valued at rest and falling; eq. (2.28).

        m v' in F_ex - [(F_s - F_d)/(1 + δ|v|) + F_d] Sgn(v)

    At v = 0 the friction force is anything in [-F_s, F_s].
    """

    delta: float = 3.0  # fall of the friction force with velocity [s/m]

    def vector_field(self, t: Scalar, y: Slip, s: SwitchValues) -> Slip:
        friction = (self.F_s - self.F_d) * falling(s.floor, y.v, self.delta) + self.F_d * s.floor
        return Slip((self.F_ex - friction) / self.m)


class StaticPointBlock(_StickingBlock):
    """Block on a floor with friction law (c), the signum model with static friction point; eq. (2.29).

        m v' in F_ex - F_d Sgn(v) for v != 0,      m v' in F_ex + [-F_s, F_s] for v = 0

    Read mechanically: the block leaves stick only when |F_ex| > F_s. (As an inclusion it could also start to slip at
    any time while F_d < |F_ex| < F_s.)
    """

    def vector_field(self, t: Scalar, y: Slip, s: SwitchValues) -> Slip:
        return Slip((self.F_ex - self.F_d * s.floor) / self.m)

    @_StickingBlock.floor.breakaway
    def floor(self) -> Float[Array, ""] | float:
        return self.F_s / self.F_d
