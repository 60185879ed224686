"""Forces of time: constant, harmonic, a user's own, a square wave; and feedback by a relay."""

from typing import Any, ClassVar

import equinox as eqx
import jax.numpy as jnp

from .._types import Number
from ..system._clock import clock
from ..system._relay import relay
from ..system._sgn import sgn
from ..system._switch import AbstractSwitch
from ..system._system import SwitchValues
from ._direction import function
from ._effect import ForceElement, Stretch
from ._state import State


class Constant(ForceElement):
    """A constant force F = f.

    **Arguments:**

    - `along`: see `ForceElement`.
    - `f`: force [N].
    """

    formula: ClassVar[str] = "f"
    symbol: ClassVar[str] = "force"

    f: float = 1.0

    def force(self, t: Any, at: Stretch, s: SwitchValues) -> Number:
        return self.f


class Harmonic(ForceElement):
    """A harmonic force F = f_0 cos(ω t + phase). Its period is that of the scene.

    **Arguments:**

    - `along`: see `ForceElement`.
    - `f_0`: amplitude [N].
    - `omega`: angular frequency [rad/s].
    - `phase`: [rad]; -π/2 makes it a sine. Zero if left out.
    """

    formula: ClassVar[str] = "f_0 cos(omega t)"
    symbol: ClassVar[str] = "force"

    f_0: float = 1.0
    omega: float = 1.0
    phase: float | None = None

    def force(self, t: Any, at: Stretch, s: SwitchValues) -> Number:
        angle = self.omega * t
        return self.f_0 * jnp.cos(angle if self.phase is None else angle + self.phase)

    @property
    def period(self) -> Any:
        return 2 * jnp.pi / self.omega

    def laws(self) -> list[tuple[str, str, Any, Any]]:
        return [("omega", "above zero", jnp.asarray(self.omega) > 0, self.omega)]


class Forcing(ForceElement):
    """A force that is a smooth function of time, F = fn(t).

    **Arguments:**

    - `along`: see `ForceElement`.
    - `fn`: a function of t [N]; one that has parameters is an `equinox.Module`. Where it jumps a `clock` is needed:
        write an `Effect` with one.
    - `T`: its period [s]; without it no orbits are found, as for any model that depends on time.
    """

    formula: ClassVar[str] = "fn(t)"
    symbol: ClassVar[str] = "force"

    fn: Any = eqx.field(converter=function, default=jnp.cos)
    T: float | None = None

    def force(self, t: Any, at: Stretch, s: SwitchValues) -> Number:
        return self.fn(t)

    @property
    def period(self) -> Any:
        return self.T


class SquareWave(ForceElement):
    """A force that jumps between f_0 and -f_0: f_0 in the first half of each period, -f_0 in the second. Its clock
    meets the jumps exactly.

    **Arguments:**

    - `along`: see `ForceElement`.
    - `f_0`: amplitude [N].
    - `T`: period [s].
    """

    formula: ClassVar[str] = "f_0 sgn(sin(2π t/T))"
    symbol: ClassVar[str] = "force"

    f_0: float = 1.0
    T: float = 1.0

    def force(self, t: Any, at: Stretch, s: SwitchValues) -> Number:
        return self.f_0 * (1 - 2 * (s.wave % 2))  # the value of a clock is the number of its ticks

    @clock
    def wave(self) -> Any:
        return self.T / 2

    @property
    def period(self) -> Any:
        return self.T


def _given(of: Any) -> Any:
    return None if of is None else function(of)


def _error(self: "Relay", t: Any, y: State) -> Number:
    return self.error(y)


def _late(self: "Relay", t: Any, y: State) -> Number:
    assert self.width is not None
    return self.error(y) - self.width


def _early(self: "Relay", t: Any, y: State) -> Number:
    assert self.width is not None
    return -self.error(y) - self.width


_IDEAL = sgn(_error, name="relay")
_HYSTERESIS = relay(_late, name="relay").off(_early)


class Relay(ForceElement):
    """Feedback by a relay, F = -f sgn(σ), as in a servo. The ideal one slides where the motion stays on σ = 0; with
    hysteresis it switches to -f where σ rises to `width`, and to f where it falls to -`width`.

    **Arguments:**

    - `along`: see `ForceElement`; may be a `Velocity` if `of` is given.
    - `f`: force [N].
    - `of`: σ(q, v), what is fed back, as `lambda q, v: q.x + 0.2 * v.x`; by default the distance d.
    - `width`: half of the hysteresis, in units of σ; an ideal relay if left out.
    """

    formula: ClassVar[str] = "-f sgn(σ)"
    symbol: ClassVar[str] = "force"
    resists: ClassVar[bool] = True

    f: float = 1.0
    of: Any = eqx.field(converter=_given, default=None)
    width: float | None = None

    @property
    def switches(self) -> tuple[AbstractSwitch, ...]:
        return (_IDEAL if self.width is None else _HYSTERESIS,)

    def error(self, y: State) -> Number:
        """σ."""
        return self.at(y).d if self.of is None else self.of(y.q, y.v)

    def force(self, t: Any, at: Stretch, s: SwitchValues) -> Number:
        return self.f * (s.relay if self.width is None else 2 * s.relay - 1)
