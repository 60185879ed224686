"""The time of a model with clocks: at a tick, functions of time are taken from the side on which the mode is."""

import functools as ft
from typing import Any, Literal, Self

import equinox as eqx
import jax.numpy as jnp
from jaxtyping import Array, Bool, Int

from .._numerics._autodiff import frozen
from .._numerics._select import select
from .._types import Mode, Scalar, Y
from ._clock import clock
from ._level_switch import LevelSwitch
from ._mode import ModeState
from ._switch import AbstractSwitch
from ._system import System


class Clocked(eqx.Module):
    """A system in a time that always increases, and is kept between two ticks."""

    system: System
    direction: Any  # +1 or -1
    switches: tuple[AbstractSwitch, ...] = eqx.field(static=True)
    clocks: tuple[int, ...] = eqx.field(static=True)  # switches that tick
    window: tuple[Scalar, Scalar] | None  # the ticks between which time is kept

    def __init__(self, system: System, direction: Any):
        self.system = system
        self.direction = direction
        self.window = None
        self.switches = system.switches
        self.clocks = self.which("ticking")

    @property
    def jumping(self) -> tuple[int, ...]:
        """The switches whose events change the state."""
        return tuple(k for k, switch in enumerate(self.switches) if switch.jumps)

    def which(self, what: Literal["signed", "unilateral", "ticking", "levels"]) -> tuple[int, ...]:
        """The switches whose modes say this, see `AbstractSwitch`."""
        return tuple(k for k, switch in enumerate(self.switches) if getattr(switch, what))

    @property
    def declared(self) -> int:
        """How many of its switches are the user's: the first ones. Those behind them are derived clocks."""
        return len(self.switches) - sum(self._clock(k).derived for k in self.clocks)

    def _clock(self, k: int) -> clock:
        switch = self.switches[k]
        assert isinstance(switch, clock)
        return switch

    def within(self, mode: Mode) -> Self:
        """The same for a mode, that tells between which ticks it is."""
        if not self.clocks:
            return self
        spans = [self.span(k, mode) for k in self.clocks]
        low, high = (ft.reduce(pick, ends) for pick, ends in zip((jnp.maximum, jnp.minimum), zip(*spans)))
        return eqx.tree_at(
            lambda m: m.window, self, frozen((low, high)), is_leaf=lambda x: x is None or x is self.window
        )

    def at(self, t: Scalar) -> Self:
        """The same for what sets out at time `t`."""
        zero, counts = jnp.zeros((), jnp.int32), self.counts(t)
        return self.within(tuple(counts.get(k, zero) for k in range(len(self.switches))))

    def next_mode(self, k: int, t: Scalar, y: Y, mode: Int[Array, ""]) -> Int[Array, ""]:
        """The mode of a switch after its event, as far as that follows from the mode before: of clocks, and of those
        whose modes are levels."""
        switch = self.switches[k]
        if isinstance(switch, clock):
            return switch.ticked(mode, self.direction)
        assert isinstance(switch, LevelSwitch)
        return switch.next_mode(self.system, self.time(t), y, mode)

    def level_at(self, k: int, t: Scalar, y: Y, before: Int[Array, ""]) -> Int[Array, ""]:
        """The mode of a switch whose modes are levels, at a state that is reached in the mode `before`."""
        switch = self.switches[k]
        assert isinstance(switch, LevelSwitch)
        return switch.mode_at(self.system, self.time(t), y, before)

    def _in(self, state: ModeState) -> Self:
        return self if self.window is not None else self.within(state.mode)

    def span(self, k: int, mode: Mode) -> tuple[Scalar, Scalar]:
        """The last and the next tick of clock k, in the time of the user."""
        switch = self._clock(k)
        return switch.span(self.system, mode[k], jnp.ones((), jnp.result_type(self.direction)))

    def countable(self, t: Scalar) -> Bool[Array, ""]:
        """Whether the ticks of all clocks can be told apart and counted up to `t`, in the time of the user."""
        good = jnp.ones((), bool)
        for k in self.clocks:
            good = good & self._clock(k).countable(self.system, t)
        return good

    def counts(self, t: Scalar) -> dict[int, Int[Array, ""]]:
        """How often each clock has ticked."""
        passed = {}
        for k in self.clocks:
            passed[k] = self._clock(k).count(self.system, frozen(t * self.direction), self.direction > 0)
        return passed

    def tick(self, k: int, mode: Mode) -> Scalar:
        """When time, increasing as the flow sees it, meets the next tick of clock k."""
        low, high = self.span(k, mode)
        return select(self.direction > 0, high, -low)

    def next_tick(self, mode: Mode) -> Scalar:
        """The same of the clock that ticks first."""
        return ft.reduce(jnp.minimum, [self.tick(k, mode) for k in self.clocks])

    def time(self, t: Scalar) -> Scalar:
        """The time of the user, kept between the ticks of the mode.

        As near to a tick as rounding takes it (and `t % T` or `floor(t / T)` with it) it is put on the right side;
        beyond, where only a search that has not converged yet goes, it stands still. (By comparisons: to a power series
        in t a shift is a number, but a maximum of t and the tick is the one or the other.)
        """
        t = t * self.direction
        if self.window is None:
            return t
        (low, high), margin = self.window, self.margin(t)
        shift = select(t < low + margin, 2 * margin, 0) - select(t > high - margin, 2 * margin, 0)
        kept = select(t < low - margin, low + margin, t + shift)
        return select(t > high + margin, high - margin, kept)

    def margin(self, t: Scalar) -> Scalar:
        """How near to a tick time is within rounding of it; there it is shifted by twice as much."""
        assert self.window is not None
        ends = (*self.window, frozen(t))
        size = ft.reduce(jnp.maximum, [select(jnp.isfinite(x), jnp.abs(x), 0) for x in ends])
        return 100 * float(jnp.finfo(t.dtype).eps) * size + float(jnp.finfo(t.dtype).tiny) ** 0.75
