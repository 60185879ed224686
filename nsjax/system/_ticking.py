"""The times at which a model jumps or has kinks, as clocks that it need not declare."""

import functools as ft
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int

from .._numerics._autodiff import frozen
from .._numerics._select import select
from .._numerics._time_dependence import Constant, Cycle, time_dependence, TimeDependence
from .._types import Scalar, Y
from ._clock import clock
from ._switch import AbstractSwitch, forwarded
from ._system import SwitchValues, System


class Ticking(System):
    """A system with clocks that tick where its program jumps in time."""

    system: System
    times: Float[Array, " times"] | None  # single ones, increasing, and then infinity
    cycles: tuple["Ticks", ...]

    def vector_field(self, t: Scalar, y: Y, s: SwitchValues) -> Y:
        return self.system.vector_field(t, y, s)

    @property
    def switches(self) -> tuple[AbstractSwitch, ...]:
        listed = () if self.times is None else (_listed(),)
        return (*map(forwarded, self.system.switches), *listed, *map(_cyclic, range(len(self.cycles))))

    @property
    def period(self) -> Any:
        return self.system.period

    @property
    def owner(self) -> System:
        return self.system.owner


class Ticks(eqx.Module):
    """The times start + n period + offsets."""

    start: Scalar
    period: Scalar
    offsets: Float[Array, " offsets"]  # increasing, from zero to less than the period, and then infinity

    @property
    def count(self) -> Int[Array, ""]:
        """How many there are in a period."""
        return jnp.sum(jnp.isfinite(self.offsets)).astype(jnp.int32)

    def time(self, number: Int[Array, ""]) -> Scalar:
        """The time of a tick."""
        many = jnp.maximum(self.count, 1)
        cycle, place = jnp.floor_divide(number, many), jnp.mod(number, many)
        return self.start + cycle.astype(self.period.dtype) * self.period + self.offsets[place]


class DerivedClock(clock):
    """A clock whose ticks were found in the program of a model. They are no events of the solution."""

    derived = True

    def laws(self, system: System) -> list[tuple[str, str, Any, Any]]:
        return []

    def countable(self, system: Ticking, t: Scalar) -> Bool[Array, ""]:
        return jnp.ones((), bool)


class _ListedClock(DerivedClock):
    """Single times."""


class _CyclicClock(DerivedClock):
    """Times that repeat themselves. Its mode is the number of ticks up to the present."""

    number: int

    def _ticks(self, system: Ticking) -> Ticks:
        return system.cycles[self.number]

    def span(self, system: Ticking, count: Int[Array, ""], like: Scalar) -> tuple[Scalar, Scalar]:
        ticks = self._ticks(system)
        none = ticks.count == 0
        return select(none, -jnp.inf, ticks.time(count - 1)), select(none, jnp.inf, ticks.time(count))

    def countable(self, system: Ticking, t: Scalar) -> Bool[Array, ""]:
        ticks = self._ticks(system)
        digits = ticks.period >= 6400 * float(jnp.finfo(t.dtype).eps) * (jnp.abs(t) + jnp.abs(ticks.start))
        many = jnp.abs(t - ticks.start) * jnp.maximum(ticks.count, 1).astype(t.dtype) < 2.0**30 * ticks.period
        return (ticks.count == 0) | (digits & many)

    def count(self, system: Ticking, t: Scalar, forwards: Any) -> Int[Array, ""]:
        ticks = self._ticks(system)
        blur = 8 * float(jnp.finfo(t.dtype).eps) * (jnp.abs(t) + jnp.abs(ticks.start)) * select(forwards, 1, -1)
        since = select(ticks.count == 0, 0, t - ticks.start + blur)
        cycle = jnp.floor(since / ticks.period)
        place = jnp.searchsorted(ticks.offsets, since - cycle * ticks.period, side="right")
        return cycle.astype(jnp.int32) * ticks.count + jnp.minimum(place, ticks.count).astype(jnp.int32)


@ft.cache  # switches are told apart by identity
def _listed() -> AbstractSwitch:
    return _ListedClock(lambda system: system.times, name="jumps_in_time")


@ft.cache
def _cyclic(number: int) -> AbstractSwitch:
    new = _CyclicClock(lambda system: system.cycles[number].period, name=f"jumps_in_time_{number}")
    return new._with(number=number)


def ticking(system: System, t: Scalar, y: Y) -> System:
    """The system with clocks for the times at which it jumps or has kinks, as far as its own do not tick there; the
    system itself if there are none.

    **Raises:** `ValueError` if it jumps at times that its program does not tell, and it declares no clock.
    """
    if system.jumps_in_time == "ignored":
        return system
    clocks = [k for k in system.switches if isinstance(k, clock)]

    def read(numbers: Any, t: Scalar, y: Y, s: tuple) -> TimeDependence:
        def program(t: Scalar, numbers: Any, y: Y, s: tuple) -> Any:
            whole = eqx.combine(numbers, static)
            surfaces = [switch.surfaces(whole, t, y) for switch in whole.switches]
            ticks = [switch.guard(whole) for switch in clocks]
            return ticks, whole.vector_field(t, y, whole.values(s)), surfaces

        return _undeclared(time_dependence(program, t, numbers, y, s, state=2), len(clocks))

    numbers, static = eqx.partition(system, eqx.is_array)
    s = tuple(jnp.zeros_like(t) for _ in system.switches)
    kept: list[TimeDependence] = []
    jax.eval_shape(lambda *args: kept.append(read(*args)), numbers, t, y, s)  # nothing of it stays in the program
    if kept[0].unknown and not clocks and system.jumps_in_time == "refused":
        owner, operations = type(system.owner).__name__, " and ".join(dict.fromkeys(f"`{n}`" for n in kept[0].unknown))
        raise ValueError(
            f"`{owner}` jumps at certain times (by {operations} of a function of the time), but which these are cannot "
            'be read off its program. Declare them as ticks of a `nsjax.clock`; or set `jumps_in_time = "missed"` in '
            f"`{owner}`, if its steps are to be trusted all the same."
        )
    if not kept[0].jumps:
        return system
    found = read(numbers, jnp.zeros_like(t), y, s)
    regular = [(jnp.asarray(k.guard(system), t.dtype), k._times(system, t)[1]) for k in clocks]
    times = None
    if found.times:
        times = _sorted(jnp.concatenate([jnp.ravel(x).astype(t.dtype) for x in found.times]), regular)
    cycles = tuple(_ticks(cycle, t.dtype, regular) for cycle in found.cycles)
    return Ticking(system, times, cycles)


def check_jumps_declared(system: System, t: Scalar, y: Y) -> None:
    """Raises for a system that jumps in time where none of its clocks ticks: for what needs to know these times as
    events."""
    if ticking(system, t, y) is not system:
        owner = type(system.owner).__name__
        raise ValueError(
            f"`{owner}` jumps or has kinks at certain times, which branches of its orbits need as events: declare them "
            "as ticks of a `nsjax.clock`."
        )


def _undeclared(found: TimeDependence, clocks: int) -> TimeDependence:
    """Without the times of t % T where a clock ticks after each T."""
    moduli = [v for v in found.results[:clocks] if isinstance(v, Constant)]
    cycles = [c for c in found.cycles if c.offsets or not any(c.modulus is v for v in moduli)]
    return found._replace(cycles=tuple(cycles))


def _ticks(cycle: Cycle, dtype: Any, regular: list[tuple[Array, Scalar]]) -> Ticks:
    start, period = jnp.asarray(cycle.start, dtype), jnp.asarray(cycle.period, dtype)
    offsets = jnp.concatenate([jnp.zeros(1, dtype), *[jnp.ravel(x).astype(dtype) for x in cycle.offsets]])
    real = jnp.isfinite(start) & jnp.isfinite(period) & (period > 0)
    offsets = select(real & (offsets >= 0) & (offsets < period), offsets, jnp.inf)
    start, period = select(real, start, 0), select(real, period, 1)
    offsets = _sorted(offsets, regular, (start, period))
    # One that comes with the next period's first is that.
    close = 256 * float(jnp.finfo(dtype).eps) * (period + jnp.abs(start))
    wraps = jnp.isfinite(offsets[0]) & (offsets > frozen(offsets[0] + period - close)) & jnp.isfinite(offsets)
    return Ticks(start, period, select(wraps, jnp.inf, offsets))


def _sorted(times: Array, regular: list[tuple[Array, Scalar]], cycle: tuple[Scalar, Scalar] | None = None) -> Array:
    """Times in order, each once and infinity at the end, without those at which one of some clocks ticks. Of a `cycle`,
    which has a start and a period, they count from its start, and such a clock must tick at all of their repetitions.
    """
    eps = float(jnp.finfo(times.dtype).eps)
    start, period = (0.0, 0.0) if cycle is None else frozen(cycle)
    for ticks, offset in regular:
        if ticks.ndim == 0:
            gap = 1e-9 + 256 * eps * (jnp.abs(times) + jnp.abs(start)) / ticks
            since = [(start + times - offset) / ticks, period / ticks]
            declared = [jnp.abs(x - jnp.round(x)) <= gap for x in frozen(since)]
            times = select(declared[0] & declared[1], jnp.inf, times)
        elif cycle is None:
            near = jnp.abs(frozen(times[:, None] - offset - ticks[None])) <= 256 * eps * jnp.abs(frozen(times))[:, None]
            times = select(jnp.any(near, axis=1), jnp.inf, times)
    times = jnp.sort(select(jnp.isfinite(times), times, jnp.inf))
    at = frozen(times)
    # What comes within rounding of the one before is passed together with it, see `Clocked.time`.
    size = jnp.maximum(jnp.abs(at[1:]), jnp.abs(at[:-1])) + jnp.abs(start) + period
    again = at[1:] - at[:-1] <= 100 * eps * size
    again = jnp.concatenate([jnp.zeros(1, bool), again & jnp.isfinite(at[1:])])
    return jnp.sort(select(again, jnp.inf, times))
