"""The ways in which a periodic orbit is searched for, one after the other."""

import itertools
from collections.abc import Callable, Iterator, Sequence
from typing import Any, NamedTuple

import equinox as eqx
import jax.lax as lax
import jax.numpy as jnp
from jaxtyping import Array, Bool

from .._numerics._autodiff import frozen
from .._numerics._compile import interactive
from .._numerics._root import Newton
from .._numerics._select import select
from .._types import Scalar, Y
from ..flow._integrator import Integrator
from ..flow._results import is_okay, RESULTS
from ..system._system import System
from ._guess import of_relays, undecided
from ._orbit import Orbit
from ._settle import failure, held_throughout, repeats, repeats_held, settle_down, Settled, sticks_anywhere
from ._shooting import Shooting
from .segments._guess import cuts_from, cuts_near, Segment
from .segments._solve import by_segments


MORE_PIECES = 16  # in the last try by segments
MOST_RELAYS = 4  # up to this many within their hysteresis are tried in all modes; more are off unless `mode` says so


class Search(NamedTuple):
    """How to search; the arguments of `find_orbit`, checked."""

    t0: Scalar
    order: int | None
    mode: Any
    method: str | None
    symmetry: Callable[[Y], Y] | None
    backward: bool
    segments: Sequence[Segment] | None
    pieces: int
    concrete: bool  # whether all numbers are known, so that one try may follow another
    integrator: Integrator
    newton: Newton

    @property
    def sign(self) -> float:
        return -1.0 if self.backward else 1.0

    def run(self, system: System, y0: Y, period: Any) -> Orbit:
        """The orbit that is found from what is known; one of a continuum is named as such."""
        orbit = self._found(system, y0, period)
        if self.concrete and system.period is not None and orbit.result == RESULTS.successful:
            sticks = RESULTS.where(_neutral(orbit), RESULTS.orbit_sticks_for_ever, orbit.result)
            orbit = eqx.tree_at(lambda o: o.result, orbit, sticks)
        return orbit

    def _found(self, system: System, y0: Y, period: Any) -> Orbit:
        if self.segments is not None:
            cuts = cuts_from(frozen(system), self.segments, self.t0, lax.stop_gradient(y0), self.integrator)
            return by_segments(system, cuts, self.t0, self.order or 1, self.pieces, self.integrator, self.newton)
        if system.period is None and period is None:
            return self._from_nothing(system, y0)
        if self.order is None and system.period is not None:
            start, _, _, mode, _ = self._settled(system, y0)
            order = repeats(system, self.t0, start, self.sign, mode, self.integrator)
            return self._tries(system, start, jnp.ones_like(self.t0), order, mode)
        period = jnp.asarray(1.0 if period is None else period, self.t0.dtype)
        if self.concrete and not period > 0:
            raise ValueError(f"Argument `period` must be positive, but got {period}.")
        order = self.order or 1
        for mode in self._modes(system, y0):
            orbit = self._once(system, y0, period, order, mode, None)
            if bool(is_okay(orbit.result)):
                return orbit
        orbit = self._tries(system, y0, period, order, self.mode)
        if self.concrete and not bool(is_okay(orbit.result) | (orbit.result == RESULTS.orbit_is_multiple_cover)):
            start, period, rests, mode, _ = self._settled(system, y0)
            if rests:
                orbit = eqx.tree_at(lambda o: o.result, orbit, self._at_rest(system, start))
            if period > 0:
                # A state that repeats itself, and is not found as a root: it is not isolated.
                forced = system.period is not None and not self.backward
                if forced and repeats_held(frozen(system), self.t0, start, period * order, mode, self.integrator):
                    return eqx.tree_at(lambda o: o.result, orbit, RESULTS.orbit_sticks_for_ever)
                second = self._tries(system, start, period, order, mode)
                orbit = second if bool(is_okay(second.result)) else orbit
        return orbit

    def _modes(self, system: System, y0: Y) -> Iterator[dict[str, Any]]:
        """Where `mode` says nothing of relays that are within their hysteresis, all modes in which they may be."""
        if not self.concrete or self.method == "segments" or self.pieces != 1 or not of_relays(system, system.switches):
            return
        given = self.mode or {}
        names = [k for k, open_ in undecided(system, self.t0, y0).items() if open_ and k not in given]
        for values in itertools.product((0, 1), repeat=len(names)) if 0 < len(names) <= MOST_RELAYS else ():
            yield given | {name: jnp.asarray(value, jnp.int32) for name, value in zip(names, values)}

    def failure(self, system: System, y0: Y) -> str | None:
        """Returns why and where the solution from the guess fails, or None if it does not."""
        return failure(frozen(system), self.t0, lax.stop_gradient(y0), self.sign, self.mode, self.integrator)

    def _at_rest(self, system: System, y: Y) -> RESULTS:
        sticks = sticks_anywhere(frozen(system), self.t0, y)
        return RESULTS.where(sticks, RESULTS.orbit_sticks_for_ever, RESULTS.orbit_is_equilibrium)

    def _settled(self, system: System, y0: Y) -> Settled:
        y0 = lax.stop_gradient(y0)
        return settle_down(frozen(system), self.t0, y0, self.sign, self.mode, self.integrator, self.concrete)

    def _from_nothing(self, system: System, y0: Y) -> Orbit:
        """Of an autonomous system, without a guess of the period."""
        start, period, rests, mode, failed = self._settled(system, y0)
        lost = ~(period > 0)
        # Where the solution itself fails, other formulations do so too.
        search = self._replace(method="shooting") if self.concrete and self.method is None and bool(failed) else self
        orbit = search._tries(system, start, select(lost, 1, period), 1, mode)
        at_rest = self._at_rest(system, start) if self.concrete else RESULTS.orbit_is_equilibrium
        end = RESULTS.where(rests, at_rest, RESULTS.orbit_not_found)
        return eqx.tree_at(lambda o: o.result, orbit, RESULTS.where(lost & ~is_okay(orbit.result), end, orbit.result))

    def _tries(self, system: System, y0: Y, period: Scalar, order: int, mode: Any) -> Orbit:
        """In the formulation asked for, or in one after the other until one finds it."""
        shoots = self.method != "segments" and self.pieces == 1
        orbit = self._once(system, y0, period, order, mode, None if shoots else self.pieces)
        if self.concrete and shoots and self.method is None and self.symmetry is None and not self.backward:
            for pieces in (1, MORE_PIECES):
                if orbit.result == RESULTS.orbit_not_found:
                    other = self._once(system, y0, period, order, mode, pieces)
                    orbit = other if is_okay(other.result) else orbit
        return orbit

    def _once(self, system: System, y0: Y, period: Scalar, order: int, mode: Any, pieces: int | None) -> Orbit:
        """By shooting, or by segments, each in `pieces` pieces."""
        t0, integrator = self.t0, self.integrator
        if pieces is None:
            shooting = Shooting(order, self.symmetry, self.backward, integrator, self.newton)
            return shooting.orbit(system, t0, y0, period, mode, self.concrete)
        cuts, closes = cuts_near(frozen(system), t0, lax.stop_gradient(y0), period, order, mode, integrator)
        if self.concrete:  # without the rows that are only there to fill up
            cuts = cuts.first(int(cuts.itinerary.num))
        orbit = by_segments(system, cuts, t0, order, pieces, integrator, self.newton)
        result = RESULTS.where(closes, orbit.result, RESULTS.orbit_not_found)
        return eqx.tree_at(lambda o: o.result, orbit, result)


@interactive
def _neutral(orbit: Orbit) -> Bool[Array, ""]:
    """Whether friction holds a forced orbit for all of its period, and lets others beside it repeat themselves too."""
    held = held_throughout(orbit.system, orbit.arcs.begin, orbit.arcs.end, orbit.arcs.mode)
    return held & jnp.any(jnp.abs(orbit.multipliers - 1) <= 1e-6)
