"""Periodic orbits in segments: cut at their events, with the states and times of the cuts as unknowns.

Each segment is a smooth flow in a mode that is given. So the equations stay well-posed where the flow is not: on a
surface that repels, and for orbits that no solution follows for a whole period.
"""

import equinox as eqx
import jax
import jax.flatten_util as jfu
import jax.lax as lax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Int

from ..._numerics._autodiff import frozen
from ..._numerics._compile import interactive
from ..._numerics._root import find_root, Newton
from ..._types import Scalar, Y
from ...derivatives._floquet import floquet, forwards, structural_zeros
from ...derivatives._saltation import event_function, saltation_matrices
from ...flow._integrator import Integrator
from ...flow._results import is_okay, RESULTS
from ...flow._solution import Events
from ...flow.events._locate import cosine
from ...system._mode import ModeState
from ...system._model import SwitchedSystem
from ...system._system import System
from .._orbit import fractions, judge, Orbit, ravel
from ._arcs import Arcs, Flows, SAMPLES
from ._guess import landing, SegmentGuess, where


def _guard(model: SwitchedSystem, k: Array, t: Scalar, y: Y, state: ModeState) -> Scalar:
    out = jnp.zeros_like(t)
    for i in range(len(model.switches)):
        out = jnp.where(k == i, event_function(model, i, t, y, state), out)
    return out


def _tangency(model: SwitchedSystem, k: Array, t: Scalar, y: Y, state: ModeState) -> Scalar:
    """|λ| - 1: zero where the field beside the surface becomes parallel to it."""
    values, out = model.values(t, y, state), jnp.zeros_like(t)
    for i in model.holdable:
        out = jnp.where(k == i, jnp.abs(values[i]) - 1, out)
    return out


class _Cycle(eqx.Module):
    """The equations of all segments of an orbit.

    The unknowns of a segment are its times of beginning and end, and its states at the beginning of each of its pieces.
    """

    cuts: SegmentGuess
    t0: Scalar
    y0: Y
    order: int = eqx.field(static=True)
    pieces: int = eqx.field(static=True)
    integrator: Integrator = eqx.field(static=True)

    @property
    def index(self) -> Int[Array, " rows"]:
        return jnp.arange(len(self.cuts.begin), dtype=self.cuts.num.dtype)

    @property
    def happened(self) -> Bool[Array, " rows"]:
        """Which segments end with an event."""
        return self.index < self.cuts.num

    @property
    def following(self) -> tuple[Array, ...]:
        return tuple(jnp.where(self.happened, jnp.roll(m, -1), m) for m in self.cuts.within.mode)

    def unravel(self, x: Array) -> Y:
        return jfu.ravel_pytree(self.y0)[1](x)

    def flows(self, system: System, pieces: int | None = None) -> Flows:
        return Flows(system, self.cuts.within, self.t0, self.y0, pieces or self.pieces, self.integrator)

    def conditions(self, system: System, begin: Array, end: Array, first: Array, last: Array) -> tuple[Array, Array]:
        """What vanishes at the end of every segment, and what does at the beginning of those that are free."""
        model, cuts = SwitchedSystem.forwards(system, self.t0, self.y0), self.cuts
        at_end = jax.vmap(lambda k, t, x, s: _guard(model, k, t, self.unravel(x), s))
        at_end = at_end(cuts.switch, end, last, cuts.ending)
        if not any(cuts.free):
            return at_end, at_end
        at_begin = jax.vmap(lambda k, t, x, s: _tangency(model, k, t, self.unravel(x), s))
        return at_end, at_begin(cuts.switch, begin, first, cuts.within)

    def jumps(self, system: System, end: Array, last: Array) -> tuple[Array, Array]:
        """The states after the events, and the times up to where impacts have come to rest."""
        model = SwitchedSystem.forwards(system, self.t0, self.y0)

        def row(k: Array, t: Scalar, x: Array, ending: ModeState, after: tuple) -> tuple[Array, Scalar]:
            y, rest = landing(model, k, t, self.unravel(x), ending, after)
            return ravel(y), rest

        return jax.vmap(row)(self.cuts.switch, end, last, self.cuts.ending, self.following)

    def first_look(self, system: System) -> tuple[tuple, tuple, Array]:
        """A guess of the unknowns; how fast the conditions change there (divided by that they are times, whatever the
        units of h); and the normal of the section on which an autonomous orbit begins."""
        cuts = self.cuts
        begin, end, first = cuts.begin, cuts.end, jax.vmap(ravel)(cuts.y)
        _, xs = self.flows(system, 1).paths(begin, end, first[:, None])
        x = xs[:, :: SAMPLES // self.pieces][:, : self.pieces] if self.pieces > 1 else first[:, None]
        model = SwitchedSystem.forwards(system, self.t0, self.y0)
        field = jax.vmap(lambda t, x, s: ravel(model.flow(t, self.unravel(x), s)))
        now = (begin, end, first, xs[:, -1])
        one = jnp.ones_like(begin)
        moves = (one, one, field(begin, first, cuts.within), field(end, xs[:, -1], cuts.ending))
        _, rates = jax.jvp(lambda *a: self.conditions(system, *a), now, moves)
        # What comes onto a surface tangentially, to be left freely, has none there: the better the guess, the less.
        tangential = jnp.asarray(cuts.free[1:] + cuts.free[:1])
        rates = (jnp.where(tangential, 1, rates[0]), rates[1])
        rates = jax.tree.map(lambda r: jnp.where((r == 0) | ~jnp.isfinite(r), 1, r), rates)
        normal = moves[2][0]
        return (begin, end, x), rates, normal / jnp.where(normal @ normal == 0, 1, normal @ normal)

    def residual(self, z: tuple, system: System, rates: tuple, normal: Array) -> tuple:
        """The states at the cuts, what ends each segment (or begins it), and when it begins."""
        begin, end, x = z
        ends = self.flows(system).ends(begin, end, x)
        last = ends[:, -1]
        after, rest = self.jumps(system, end, last)
        at_end, at_begin = self.conditions(system, begin, end, x[:, 0], last)
        ended = jnp.where(jnp.asarray(self.cuts.free), at_begin / rates[1], at_end / rates[0])
        if system.period is None:
            closing = jnp.broadcast_to(normal @ (x[0, 0] - ravel(self.y0)), end.shape)
        else:
            closing = end - self.t0 - self.order * jnp.asarray(system.period, end.dtype)
        ended = jnp.where(self.happened, ended, jnp.where(self.index == self.cuts.num, closing, end - begin))
        return (
            x[:, 0] - jnp.roll(after, 1, axis=0),
            x[:, 1:] - ends[:, :-1],
            ended,
            begin - jnp.append(self.t0, (end + rest)[:-1]),
        )


@interactive
def by_segments(
    system: System,
    cuts: SegmentGuess,
    t0: Scalar,
    order: int,
    pieces: int,
    integrator: Integrator,
    newton: Newton,
) -> Orbit:
    """Newton's method on the equations of all segments, and what is said of the orbit."""
    autonomous = system.period is None
    still = frozen(system)
    cuts = frozen(cuts)
    y0 = jax.tree.map(lambda x: x[0], cuts.y)
    cycle = _Cycle(cuts, t0, y0, order, pieces, integrator)
    guess, rates, normal = frozen(cycle).first_look(still)

    def residual(z: tuple, parameters: tuple) -> tuple:
        system, cycle = parameters
        return cycle.residual(z, system, rates, normal)

    z, converged = find_root(residual, guess, (system, cycle), newton)
    begin, end, x = z
    error = jnp.max(jnp.abs(jnp.concatenate([r.ravel() for r in residual(frozen(z), (still, cycle))])))
    size = 1 + jnp.max(jnp.abs(x))
    good = converged & (error <= 1e3 * newton.tol * size)
    period = end[-1] - t0 if autonomous else jnp.asarray(system.period, t0.dtype) * order
    _, shares = fractions(autonomous, order)
    here = lax.stop_gradient((begin, end, x))
    later = cycle.flows(still).at(t0 + lax.stop_gradient(period) * jnp.asarray(shares, t0.dtype), *here)
    result = judge(good, x[0, 0], later, autonomous, order)

    ends, phi = cycle.flows(system).derivatives(begin, end, x)
    events = _log(system, cycle, end, ends[:, -1])
    monodromy, multipliers, stable, zeros = _floquet(system, cycle, events, phi)
    # Where a free segment begins it is tangential that it must be.
    meant = jnp.roll(jnp.asarray(cuts.free), -1)
    grazes = jnp.any(cycle.happened & ~meant & (events.transversality < jnp.cbrt(jnp.finfo(end.dtype).eps)))
    violation, violation_t = _violation(still, cycle, *here)
    admissible = (violation == 0) & jnp.all(end - begin >= -1e3 * newton.tol * (1 + jnp.abs(period)))
    result = RESULTS.where((result == RESULTS.successful) & grazes, RESULTS.tangential_event, result)
    result = RESULTS.where(is_okay(result) & ~admissible, RESULTS.orbit_not_admissible, result)
    return Orbit(
        system=system,
        t0=t0,
        y0=cycle.unravel(x[0, 0]),
        mode=_modes(cuts.within.mode, begin)[0],
        period=period,
        events=events,
        monodromy=monodromy,
        multipliers=multipliers,
        structural_zeros=zeros,
        stable=stable,
        residual=error,
        admissible=admissible,
        violation=violation,
        violation_t=violation_t,
        result=result,
        arcs=Arcs(begin, end, _modes(cuts.within.mode, begin), jax.vmap(jax.vmap(cycle.unravel))(x)),
        integrator=integrator,
    )


def _modes(mode: tuple[Array, ...], rows: Array) -> Int[Array, "rows switches"]:
    return jnp.stack(mode, axis=1) if mode else jnp.zeros((len(rows), 0), jnp.int32)


def _log(system: System, cycle: _Cycle, end: Array, last: Array) -> Events:
    """The events between the segments."""
    cuts, happened, following, unravel = cycle.cuts, cycle.happened, cycle.following, cycle.unravel
    after, rest = cycle.jumps(system, end, last)
    model = SwitchedSystem.forwards(system, end[0], unravel(last[0]))

    def square(k: Array, t: Scalar, x: Array, s: ModeState) -> Scalar:
        h_t, n = jax.grad(lambda t, x: _guard(model, k, t, unravel(x), s), argnums=(0, 1))(t, x)
        return cosine(h_t, n, ravel(model.flow(t, unravel(x), s)))

    columns = dict(
        t=end + rest,
        switch=cuts.switch,
        mode_before=_modes(cuts.within.mode, end),
        mode_after=_modes(following, end),
        y_before=jax.vmap(unravel)(last),
        y_after=jax.vmap(unravel)(after),
        transversality=lax.stop_gradient(jax.vmap(square)(cuts.switch, end, last, cuts.ending)),
    )
    empty = {k: jax.tree.map(jnp.zeros_like, v) for k, v in columns.items()}
    empty |= dict(t=jnp.full_like(end, jnp.inf), switch=jnp.full_like(cuts.switch, -1))
    names = tuple(k.name for k in system.switches)
    return Events(**where(happened, columns, empty), num=cuts.num, names=names)


def _floquet(system: System, cycle: _Cycle, events: Events, phi: Array) -> tuple[Array, Array, Array, Array]:
    """Monodromy matrix, multipliers, stability and structural zeros, from the derivatives along the segments."""
    cuts, happened, autonomous = cycle.cuts, cycle.happened, system.period is None
    eye = jnp.eye(phi.shape[-1], dtype=phi.dtype)
    none = jnp.broadcast_to(eye, (len(phi), *eye.shape))
    zeros = structural_zeros(system, _modes(cuts.within.mode, happened))
    if not any(cuts.free):
        jumps = where(happened, saltation_matrices(system, events), none)
        factors = jnp.concatenate([phi, jumps[:, None]], axis=1).reshape(-1, *eye.shape)
        return *floquet(factors, zeros, autonomous), zeros
    # Backwards in time a surface that repels attracts: what leaves the surface freely comes onto it there, and has a
    # saltation matrix. Where it comes onto the surface, tangentially, none is.
    free = jnp.asarray(cuts.free)
    before, after = (
        jnp.where(free[:, None], *pair)
        for pair in ((events.mode_after, events.mode_before), (events.mode_before, events.mode_after))
    )
    swapped = eqx.tree_at(lambda e: (e.mode_before, e.mode_after), events, (before, after))
    jumps = saltation_matrices(system, swapped)
    tangent = jnp.roll(free, -1)
    ordinary = happened & ~free & ~tangent
    back = where(free, jumps, none)
    back = where(ordinary, jnp.linalg.inv(where(ordinary, jumps, none)), back)
    factors = jnp.concatenate([jnp.linalg.inv(phi), back[:, None]], axis=1).reshape(-1, *eye.shape)
    infinite = jnp.asarray(sum(cuts.free), jnp.int32)
    return *forwards(floquet(factors[::-1], infinite, autonomous), infinite, autonomous), zeros


def _violation(system: System, cycle: _Cycle, begin: Array, end: Array, x: Array) -> tuple[Scalar, Scalar]:
    """By how much the guards of the modes are violated, and when: beyond what the tolerance makes of them."""
    model, cuts, flows = SwitchedSystem.forwards(system, cycle.t0, cycle.y0), cycle.cuts, cycle.flows(system)
    if not model.slots:
        return jnp.zeros_like(begin[0]), begin[0]
    starts = begin[:, None] + (end - begin)[:, None] * jnp.arange(cycle.pieces, dtype=end.dtype) / cycle.pieces
    stops = jnp.concatenate([starts[:, 1:], end[:, None]], axis=1)

    def piece(a: Scalar, b: Scalar, x: Array, within: ModeState, ending: ModeState) -> tuple[Array, Array, Array]:
        def guards(t: Scalar, x: Array) -> list[list[Scalar]]:
            return [row for state in (within, ending) for row in model.guards(t, cycle.unravel(x), state)]

        # What is far from zero is of no interest.
        found = flows.minima(a, b, x, within, guards, lambda most: 0.1 * most)
        return found.least, found.most, a + found.share * (b - a)

    rows = jax.vmap(jax.vmap(piece, (0, 0, 0, None, None)))
    least, most, t = rows(starts, stops, x, cuts.within, cuts.ending)  # arcs, pieces, guards
    size = jnp.max(jnp.maximum(jnp.abs(least), jnp.abs(most)), axis=(0, 1))
    late = cuts.num < jnp.arange(len(begin), dtype=cuts.num.dtype)
    short = jnp.where((least < -1e-7 * size) & ~late[:, None, None], -least, 0)
    worst = jnp.argmax(short)
    return short.ravel()[worst], t.ravel()[worst]
