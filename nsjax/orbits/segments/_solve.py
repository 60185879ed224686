"""Periodic orbits in segments: cut at their events, with the states and times of the cuts as unknowns.

Each segment is a smooth flow in a mode that is given. So the equations stay well-posed where the flow is not: on a
surface that repels, and for orbits that no solution follows for a whole period.
"""

import dataclasses

import equinox as eqx
import jax
import jax.lax as lax
import jax.numpy as jnp
from jaxtyping import Array, Float

from ..._numerics._autodiff import frozen
from ..._numerics._compile import interactive
from ..._numerics._lapack import inv
from ..._numerics._root import Newton
from ..._numerics._select import select
from ..._types import Scalar
from ...derivatives._floquet import floquet, forwards, structural_zeros
from ...derivatives._saltation import saltation_matrices
from ...flow._integrator import Integrator
from ...flow._results import is_okay, RESULTS
from ...flow._solution import Events
from ...flow.events._locate import cosine
from ...system._model import SwitchedSystem
from ...system._parameter import FreeParameters
from ...system._system import System
from .._orbit import fractions, judge, Orbit, ravel
from ._arcs import Arcs
from ._corrector import isolated_orbit, Linear
from ._equations import guard_sizes_at, OrbitCurve
from ._guard_minima import along_segment
from ._guess import SegmentGuess, where
from ._itinerary import EVENT, OrbitItinerary, PIECE
from ._point import factors_of
from ._segment_flow import NEVER


@interactive
def by_segments(
    system: System,
    guess: SegmentGuess,
    t0: Scalar,
    order: int,
    pieces: int,
    integrator: Integrator,
    newton: Newton,
) -> Orbit:
    """Newton's method on the equations of all segments, and what is said of the orbit."""
    guess = frozen(guess)
    curve, itinerary, start = _problem(system, guess, t0, order, pieces, integrator)
    u, linear, converged = isolated_orbit(curve, itinerary, start.at[0].set(t0 / curve.time), start, newton)
    begin, end, x, _ = curve.parts(u)
    error = jnp.max(jnp.abs(linear.f))
    good = converged & (error <= 1e3 * newton.tol)
    autonomous, num = curve.autonomous, itinerary.num
    period = end[num - 1] - t0 if autonomous else jnp.asarray(system.period, t0.dtype) * order
    still, here = frozen((curve, u))
    _, shares = fractions(autonomous, order)
    later = _states_at(still, itinerary, here, t0 + lax.stop_gradient(period) * jnp.asarray(shares, t0.dtype))
    result = judge(good, x[0], later, autonomous, order, integrator.smallest_size(t0.dtype))

    events = _log(curve, itinerary, u, linear)
    index = jnp.arange(len(begin), dtype=num.dtype)
    mode = itinerary.mode
    zeros = structural_zeros(system, select((index < num)[:, None], mode, mode[:1]))
    if any(guess.free):
        monodromy, multipliers, stable = _backwards(curve, itinerary, u, linear, events, guess.free)
    else:
        monodromy, multipliers, stable = floquet(
            factors_of(curve, itinerary, u, linear.df, linear.closing), zeros, autonomous
        )
    # Where a free segment begins it is tangential that it must be.
    meant = jnp.roll(jnp.asarray(guess.free), -1)
    happened = jnp.isfinite(events.t)
    grazes = jnp.any(happened & ~meant & (events.transversality == 0))
    violation, violation_t = _violation(still, itinerary, here)
    admissible = (violation == 0) & jnp.all(end - begin >= -1e3 * newton.tol * jnp.abs(period))
    result = RESULTS.where((result == RESULTS.successful) & grazes, RESULTS.tangential_event, result)
    result = RESULTS.where(is_okay(result) & ~admissible, RESULTS.orbit_not_admissible, result)
    every = slice(None, None, pieces)
    states = jax.vmap(jax.vmap(curve.unravel))(x.reshape(-1, pieces, x.shape[1]))
    return Orbit(
        system=system,
        t0=t0,
        y0=curve.unravel(x[0]),
        mode=mode[0],
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
        arcs=Arcs(begin[every], end[pieces - 1 :: pieces], mode[every], states),
        integrator=integrator,
    )


def _problem(
    system: System, guess: SegmentGuess, t0: Scalar, order: int, pieces: int, integrator: Integrator
) -> tuple[OrbitCurve, OrbitItinerary, Float[Array, " unknowns"]]:
    """The curve of one point, without a parameter, the itinerary with a row for each piece, and a guess of the
    unknowns."""
    y0 = jax.tree.map(lambda y: y[0], guess.y)
    model = SwitchedSystem.forwards(system, t0, y0, smooth=True)
    x = jax.vmap(ravel)(guess.y)
    n, none = x.shape[1], jnp.zeros(0, t0.dtype)
    rows, still = guess.itinerary, frozen(model)
    period = jnp.max(select(jnp.arange(len(x), dtype=rows.num.dtype) < rows.num, guess.end, t0)) - t0
    blank = OrbitCurve(
        model=model,
        free=FreeParameters.of(system),
        like=y0,
        low=none,
        width=none,
        sizes=jnp.ones(n, t0.dtype),
        time=select(period > 0, period, 1),
        guard_sizes=jnp.ones(len(model.slots), t0.dtype),
        order=jnp.asarray(order, jnp.int32),
        normal=jnp.zeros(n, t0.dtype),
        reference=x[0],
        integrator=integrator,
        exact=NEVER,
        slides=bool(model.holdable),
        pieces=pieces,
    )
    f = ravel(still.flow(guess.begin[0], y0, blank.state(rows.mode[0], rows.part[0])))
    normal = f / select(f @ f == 0, 1, f @ f)
    sizes = integrator.sizes_of(jnp.max(jnp.abs(x), axis=0), f, blank.time)
    curve = dataclasses.replace(blank, normal=frozen(normal), sizes=frozen(sizes))
    curve = dataclasses.replace(curve, guard_sizes=guard_sizes_at(curve, rows, guess.begin, x))
    units = jnp.concatenate([jnp.stack([curve.time, curve.time]), sizes])
    if pieces == 1:
        start = jnp.concatenate([guess.begin[:, None], guess.end[:, None], x], axis=1)
        return curve, rows, (start / units).ravel()
    flow, shares = dataclasses.replace(curve, model=still).flow(none), jnp.arange(pieces, dtype=t0.dtype) / pieces

    def cut(a: Scalar, b: Scalar, x: Array, mode: Array, part: Array) -> Array:
        starts = a + (b - a) * shares
        states = jax.vmap(lambda t: flow.arrive(a, t, x, curve.state(mode, part)))(starts[1:])
        states = jnp.concatenate([x[None], states])
        return jnp.concatenate([starts[:, None], jnp.append(starts[1:], b)[:, None], states], axis=1)

    start = jax.vmap(cut)(guess.begin, guess.end, x, rows.mode, rows.part) / units
    mode, part, ends, slot, entry = (jnp.repeat(column, pieces, axis=0) for column in rows[:5])
    last = jnp.arange(len(ends), dtype=rows.num.dtype) % pieces == pieces - 1
    ends = select(last, ends, PIECE)
    return curve, OrbitItinerary(mode, part, ends, slot, entry, rows.num * pieces), start.ravel()


def _states_at(
    curve: OrbitCurve, itinerary: OrbitItinerary, u: Array, times: Float[Array, " times"]
) -> Float[Array, "times n"]:
    """States at given times of the orbit."""
    begin, _, x, _ = curve.parts(u)
    index = jnp.arange(len(begin), dtype=itinerary.num.dtype)
    starts, flow = select(index < itinerary.num, begin, jnp.inf), curve.flow(curve.model)

    def one(t: Scalar) -> Array:
        i = jnp.maximum(jnp.searchsorted(starts, t, side="right") - 1, 0)
        return flow.arrive(begin[i], t, x[i], curve.state(itinerary.mode[i], itinerary.part[i]))

    return jax.vmap(one)(times)


def _log(curve: OrbitCurve, itinerary: OrbitItinerary, u: Array, linear: Linear) -> Events:
    """The events between the segments; the transversality of one that is a grazing, as `solve` counts it, is zero."""
    begin, end, x, _ = curve.parts(u)
    model, last, pieces = curve.model, slice(curve.pieces - 1, None, curve.pieces), curve.pieces
    num = (itinerary.num - 1) // pieces
    rows = jax.tree.map(lambda column: column[last], itinerary._replace(num=()))
    happened = jnp.arange(len(rows.slot), dtype=num.dtype) < num

    largest = jnp.max(jnp.abs(frozen(x)), axis=0)

    def transversality(
        t: Scalar, x: Array, mode: Array, part: Array, slot: Array, entry: Array, length: Scalar
    ) -> Scalar:
        state = curve.state(mode, part)

        def guard(t: Scalar, x: Array) -> Scalar:
            return curve.guard(model, t, x, state, slot, entry)

        def rate(t: Scalar, x: Array) -> tuple[Scalar, Array]:
            f = ravel(model.flow(t, curve.unravel(x), state))
            return jax.jvp(guard, (t, x), (jnp.ones_like(t), f))[1], f

        h_t, n = jax.grad(guard, argnums=(0, 1))(t, x)
        speed, f = rate(t, x)
        bend = jax.jvp(lambda t, x: rate(t, x)[0], (t, x), (jnp.ones_like(t), f))[1]
        # Whether rounding decides that there is an event: how deep the guard would fall below zero without it, against
        # its size. (The size of a guard that is zero at all events is that of its bend.)
        depth = speed**2 / (2 * select(bend > 0, bend, 1))
        size = jnp.abs(n) @ largest + 0.5 * jnp.abs(bend) * length**2
        grazes = (bend > 0) & (depth < 1e5 * float(jnp.finfo(t.dtype).eps) * size)
        return select(grazes, 0, cosine(h_t, n, f))

    switch = jnp.asarray([slot.switch for slot in model.slots] or [-1], jnp.int32)[rows.slot]
    t, y = frozen((end[last], linear.last[last]))
    lengths = frozen(end.reshape(-1, pieces)[:, -1] - begin.reshape(-1, pieces)[:, 0])
    cosines = jax.vmap(transversality)(t, y, rows.mode, rows.part, rows.slot, rows.entry, lengths)
    # (Where impacts accumulate the next segment begins later than this one ends.)
    columns = dict(
        t=jnp.roll(begin[::pieces], -1),
        switch=switch,
        mode_before=rows.mode,
        mode_after=jnp.roll(rows.mode, -1, axis=0),
        y_before=jax.vmap(curve.unravel)(linear.last[last]),
        y_after=jax.vmap(curve.unravel)(jnp.roll(x[::pieces], -1, axis=0)),
        transversality=lax.stop_gradient(cosines),
    )
    empty = {k: jax.tree.map(jnp.zeros_like, v) for k, v in columns.items()}
    empty |= dict(t=jnp.full_like(end[last], jnp.inf), switch=jnp.full_like(switch, -1))
    names = tuple(k.name for k in model.switches)
    return Events(**where(happened, columns, empty), num=num, names=names)


def _backwards(
    curve: OrbitCurve, itinerary: OrbitItinerary, u: Array, linear: Linear, events: Events, free: tuple[bool, ...]
) -> tuple[Array, Array, Array]:
    """Monodromy matrix, multipliers and stability of an orbit that slides on surfaces that repel.

    Backwards in time such a surface attracts: what leaves it freely comes onto it there, and has a saltation matrix.
    Where it comes onto the surface, tangentially, none is.
    """
    leaves = jnp.asarray(free)
    # All but the last piece of a segment end in the middle of it.
    onto = jnp.repeat(jnp.roll(leaves, -1), curve.pieces) & (itinerary.ends == EVENT)
    smooth = itinerary._replace(ends=select(onto, PIECE, itinerary.ends))
    factors = jax.vmap(inv)(factors_of(curve, smooth, u, linear.df, linear.closing))
    before, after = (
        select(leaves[:, None], *pair)
        for pair in ((events.mode_after, events.mode_before), (events.mode_before, events.mode_after))
    )
    swapped = eqx.tree_at(lambda e: (e.mode_before, e.mode_after), events, (before, after))
    jumps = select(leaves[:, None, None], saltation_matrices(curve.model.system, swapped), 0)
    last = slice(curve.pieces - 1, None, curve.pieces)
    factors = factors.at[last].set(select(leaves[:, None, None], factors[last] @ jumps, factors[last]))
    infinite = jnp.asarray(sum(free), jnp.int32)
    return forwards(floquet(factors[::-1], infinite, curve.autonomous), infinite, curve.autonomous)


def _violation(curve: OrbitCurve, itinerary: OrbitItinerary, u: Array) -> tuple[Scalar, Scalar]:
    """By how much the guards of the modes are violated, and when: beyond what the tolerance makes of them."""
    begin, end, x, value = curve.parts(u)
    slots, n = len(curve.model.slots), x.shape[1]
    if not slots:
        return jnp.zeros_like(begin[0]), begin[0]
    orders = jnp.zeros((2, 2 * n + slots), x.dtype)
    segments = begin, end, x, itinerary.mode, itinerary.part
    found = jax.vmap(lambda *segment: along_segment(curve, value, segment, orders, turns=False))(*segments)
    least, most, share = (part[:, 2 * n :] for part in (found.least, found.most, found.share))
    t = begin[:, None] + share * (end - begin)[:, None]
    size = jnp.max(jnp.maximum(jnp.abs(least), jnp.abs(most)), axis=0)
    late = jnp.arange(len(begin), dtype=itinerary.num.dtype) >= itinerary.num
    short = select((least < -1e-7 * size) & ~late[:, None], -least, 0)
    worst = jnp.argmax(short)
    return short.ravel()[worst], t.ravel()[worst]
