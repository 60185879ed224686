"""Many solutions on their way to attractors: all a window of iterates further, then those that have not settled."""

import os
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.flatten_util as jfu
import jax.lax as lax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int

from .._numerics._progress import Counting
from .._numerics._select import select
from .._types import Scalar, Y
from ..flow._results import is_okay, RESULTS
from ..flow._solution import Events
from ..sweeps._devices import Devices
from ..sweeps._long_sweep import sweep_again
from ..system._parameter import Path, put_parameter
from ..system._system import System
from ._iterate import PoincareMap
from ._itinerary_class import ItineraryClasses, mode_row, NONE
from ._lyapunov import standard_errors
from ._settled import settled


KEPT = 128  # events of one time around
PARTS = 8  # of a window: by them exponents have their errors
GROWN = 0.7  # log 2: a perturbation that has doubled over half a window is not one of an orbit that attracts
SIGMAS = 3  # standard errors, by which an exponent that is positive lies above zero


class Here(NamedTuple):
    """Where a solution is."""

    t: Scalar
    x: Float[Array, " n"]
    mode: Int[Array, " switches"]
    direction: Float[Array, " n"]  # in which a perturbation points
    new: Bool[Array, ""]  # whether it is the start, whose mode is still to be found


class Seen(NamedTuple):
    """What a window has shown."""

    here: Here
    period: Int[Array, ""]  # 0 where it has not settled
    rate: Scalar  # at which the perturbation grew over whole times around [1/time]
    growth: Float[Array, " parts"]  # logarithms of the growth of the perturbation
    times: Float[Array, " parts"]
    events: Int[Array, "kept switches+1"]  # of one time around, in their order
    count: Int[Array, ""]  # of these: more may have happened than were kept
    result: RESULTS


class Window(eqx.Module):
    """The program: so many iterates of one solution, with a perturbation of it and the events."""

    system: System
    paths: tuple[Path, ...] = eqx.field(static=True)
    step: PoincareMap
    t0: Scalar
    like: Y
    iterates: int = eqx.field(static=True)
    tol: Scalar

    def __call__(self, values: Float[Array, " parameters"], here: Here) -> Seen:
        system = self.system
        for path, value in zip(self.paths, values):
            system = put_parameter(system, path, value)
        unravel = jfu.ravel_pytree(self.like)[1]
        begin = self.step.start(system, self.t0, unravel(here.x), {})
        mode = select(here.new, begin.mode, here.mode)
        result = RESULTS.where(here.new, begin.result, RESULTS.successful)
        watched = self.step.flow_of(system)

        def turn(now: tuple, _: None) -> tuple[tuple, tuple]:
            t, x, mode, w, result, log, total = now

            def flow(x: Array) -> tuple[Array, tuple]:
                way = (self.t0, t, unravel(x))
                later, y, result, sol = self.step.passage(watched, way, begin.given(watched, mode), still=True)
                return jfu.ravel_pytree(y)[0], (later, result, sol.mode1, sol.events)

            x1, w1, (later, new, mode1, events) = jax.jvp(flow, (x,), (w,), has_aux=True)
            # What has failed stays failed; it goes on from NaN, which takes no step.
            result = RESULTS.where(is_okay(result) & ~is_okay(new), new, result)
            x1 = x1 + select(is_okay(result), 0, jnp.nan).astype(x.dtype)
            w1, grown = _scaled(w1)
            log, number = _logged(system, events, log, total)
            return (later, x1, mode1, w1, result, log, total + number), (x1, grown, later - t, number)

        kept = jnp.zeros((KEPT, 1 + len(system.switches)), jnp.int8)
        zero = jnp.zeros((), jnp.int32)
        carry = here.t, here.x, mode, here.direction, result, kept, zero
        carry, (points, grown, times, numbers) = lax.scan(turn, carry, None, length=self.iterates)
        t, x, mode, w, result, log, total = carry
        # An orbit that repels may be followed for a while too, by a start that lies on it.
        period = select(jnp.sum(grown[-self.iterates // 2 :]) > GROWN, 0, settled(points, self.tol))
        ago = jnp.arange(self.iterates - 1, -1, -1, dtype=period.dtype)
        last, half = ago < period, self.iterates // 2
        around = ago < half - half % jnp.maximum(period, 1)
        rate = jnp.sum(select(around, grown, 0)) / jnp.sum(select(around, times, 0))
        count = jnp.sum(select(last, numbers, 0)).astype(jnp.int32)
        log = jnp.roll(log, jnp.minimum(count, KEPT) - total, axis=0)
        nothing = jnp.concatenate([jnp.full((1,), -1, jnp.int8), mode_row(system, mode)])
        log = select(count > 0, log, log.at[0].set(nothing))

        def by_part(x: Array) -> Array:
            return jnp.sum(x.reshape(PARTS, -1), axis=1)

        here = Here(t, x, mode, w, jnp.zeros((), bool))
        return Seen(here, period, rate, by_part(grown), by_part(times), log, count, result)


def direction_of(n: int) -> np.ndarray:
    """Of a perturbation: none of the coordinates, as one of these may never turn into that which grows most."""
    found = np.random.default_rng(0).standard_normal(n)
    return found / np.linalg.norm(found)


def _scaled(w: Array) -> tuple[Array, Scalar]:
    """A perturbation that was of length one, and the logarithm of its length. Where nothing but rounding is left of it,
    the system has forgotten it: minus infinity, and another one sets out."""
    size = jnp.linalg.norm(w)
    forgotten = size <= 32 * len(w) * jnp.finfo(w.dtype).eps
    grown = select(forgotten, -jnp.inf, jnp.log(select(forgotten, 1, size)))
    return select(forgotten, jnp.asarray(direction_of(len(w)), w.dtype), w / select(forgotten, 1, size)), grown


def _logged(system: System, events: Events, log: Array, total: Array) -> tuple[Array, Array]:
    """The events of an iterate written behind those before, and how many there were. Crossings of a section, whose
    switch comes last, are none."""
    rows = jnp.arange(KEPT, dtype=total.dtype)[:, None]

    def write(i: Array, now: tuple[Array, Array]) -> tuple[Array, Array]:
        log, number = now
        row = jnp.concatenate([events.switch[i][None].astype(jnp.int8), mode_row(system, events.mode_after[i])])
        own = events.switch[i] < len(system.switches)
        log = select(own & (rows == (total + number) % KEPT), row, log)
        return log, number + own.astype(number.dtype)

    if not (system.switches and events.t.size):
        return log, jnp.zeros_like(total)
    return lax.fori_loop(0, events.num, write, (log, jnp.zeros_like(total)))


class Labels(NamedTuple):
    """What was found of each lane; see `AttractorChart`."""

    periods: np.ndarray
    classes: np.ndarray
    chaotic: np.ndarray
    exponents: np.ndarray
    errors: np.ndarray
    iterates: np.ndarray
    x: np.ndarray
    result: np.ndarray

    @classmethod
    def blank(cls, lanes: int, n: int, dtype: Any) -> "Labels":
        nan, zero = np.full(lanes, np.nan, dtype), np.zeros(lanes, int)
        none = np.full(lanes, NONE)
        return cls(zero, none, zero > 0, nan, nan.copy(), zero.copy(), np.full((lanes, n), np.nan, dtype), zero.copy())


class Found(NamedTuple):
    lanes: Labels
    itineraries: tuple[str, ...]


class Pursuit(NamedTuple):
    """Each round is a sweep over the lanes that are left, in a folder of its own if they are kept."""

    window: Window
    values: Float[np.ndarray, "lanes parameters"]
    chunk: int
    devices: Devices | None
    path: str | os.PathLike | None
    counting: Counting

    def followed(self, rounds: int) -> Found:
        left, here = np.arange(len(self.values)), self._start()
        out, classes = Labels.blank(len(left), here.x.shape[1], here.x.dtype), ItineraryClasses(self.window.system)
        late: list[tuple[np.ndarray, np.ndarray]] = []  # growth and times in the second half
        for k in range(rounds):
            folder = None if self.path is None else os.path.join(self.path, f"{k:04d}")
            self._tell(k, len(left), 0)
            seen: Seen = sweep_again(
                folder, self.window, self.values[left], here, chunk=self.chunk, devices=self.devices,
                tell=lambda done, k=k, left=left: self._tell(k, len(left), done),
            )  # fmt: skip
            good, codes = np.asarray(is_okay(seen.result)), seen.result._value
            done = ~good | (seen.period > 0)
            out.iterates[left] = (k + 1) * self.window.iterates
            out.x[left], out.result[left] = seen.here.x, codes
            out.periods[left] = np.where(good, seen.period, -1)
            each = good & done
            out.exponents[left[each]] = seen.rate[each]
            out.classes[left[each]] = classes.of(seen.events[each], seen.count[each])
            late = [(g[~done], t[~done]) for g, t in [*late, (seen.growth, seen.times)]][-max(1, (k + 2) // 2) :]
            left, here = left[~done], jax.tree.map(lambda a, keep=~done: np.asarray(a)[keep], seen.here)
            if not len(left):
                break
        if len(left):
            growth, times = (np.concatenate([part[i] for part in late], axis=1).T for i in (0, 1))
            mean = np.sum(growth, axis=0) / np.sum(times, axis=0)
            with np.errstate(invalid="ignore"):  # infinite ones have no error
                rates = (growth - mean * times) / np.mean(times, axis=0)
            out.exponents[left] = mean
            out.errors[left] = np.where(np.isfinite(mean), np.asarray(standard_errors(jnp.asarray(rates))), np.nan)
            out.chaotic[left] = mean > SIGMAS * out.errors[left]
        return self._sorted(out, classes)

    def _tell(self, k: int, left: int, done: int) -> None:
        """Only those that have settled count: how often the others are to be gone on with, nobody knows."""
        stage = f"{done:,} of {left:,} followed to iterate {(k + 1) * self.window.iterates:,}"
        self.counting.at(len(self.values) - left, stage)

    def _start(self) -> Here:
        window, lanes = self.window, len(self.values)
        x = np.asarray(jfu.ravel_pytree(window.like)[0])
        switches = len(window.step.flow_of(window.system).switches)
        one = Here(window.t0, x, np.zeros(switches, np.int32), direction_of(len(x)).astype(x.dtype), np.True_)
        return jax.tree.map(lambda a: np.repeat(np.asarray(a)[None], lanes, axis=0), one)

    def _sorted(self, out: Labels, classes: ItineraryClasses) -> Found:
        """The classes by how many lanes each has."""
        counts = np.bincount(out.classes[out.classes >= 0], minlength=len(classes.words))
        order = np.argsort(-counts, kind="stable")
        place = np.argsort(order)
        if len(place):
            out = out._replace(classes=np.where(out.classes >= 0, place[out.classes], NONE))
        return Found(out, tuple(classes.words[k] for k in order))
