"""Periodic orbits in segments: cut at their events, with the states and times of the cuts as unknowns.

Each segment is a smooth flow in a mode that is given. So the equations stay well-posed where the flow is not: on a
surface that repels, and for orbits that no solution follows for a whole period.
"""

from typing import Any

import equinox as eqx
import jax
import jax.flatten_util as jfu
import jax.lax as lax
import jax.numpy as jnp
import optimistix as optx
from jaxtyping import Array, Int

from ._arcs import Arcs, Flows, model_of, SAMPLES
from ._cuts import Cuts, landing, where
from ._event import cosine
from ._filippov import Model, State
from ._floquet import floquet, forwards, structural_zeros
from ._orbit import fractions, judge, Orbit, ravel
from ._saltation import fired, saltation_matrices
from ._solution import Events, is_okay, RESULTS
from ._system import frozen, System
from ._types import Scalar, Y


def _guard(model: Model, k: Array, t: Scalar, y: Y, state: State) -> Scalar:
    out = jnp.zeros_like(t)
    for i in range(len(model.switches)):
        out = jnp.where(k == i, fired(model, i, t, y, state), out)
    return out


def _tangency(model: Model, k: Array, t: Scalar, y: Y, state: State) -> Scalar:
    """|λ| - 1: zero where the field beside the surface becomes parallel to it."""
    values, out = model.values(t, y, state), jnp.zeros_like(t)
    for i in model.holdable:
        out = jnp.where(k == i, jnp.abs(values[i]) - 1, out)
    return out


@eqx.filter_jit
def by_segments(
    system: System, cuts: Cuts, t0: Scalar, order: int, pieces: int, how: dict, tol: float, max_iterations: int
) -> Orbit:
    """Newton's method on the equations of all segments.

    The unknowns of a segment are its times of beginning and end, and its state at the beginning (with `pieces`, also
    the states in between). Equations: the states at the cuts, what ends the segment, and when it begins.
    """
    autonomous = system.period is None
    y0 = jax.tree.map(lambda x: x[0], cuts.y)
    x0, unravel = jfu.ravel_pytree(lax.stop_gradient(y0))
    index = jnp.arange(len(cuts.begin), dtype=cuts.num.dtype)
    happened, repels = index < cuts.num, jnp.asarray(cuts.free)
    following = tuple(jnp.where(happened, jnp.roll(m, -1), m) for m in cuts.within.mode)

    def flows(system: System) -> Flows:
        return Flows(system, cuts.within, t0, y0, pieces, tuple(how.items()))

    def conditions(system: System, begin: Array, end: Array, first: Array, last: Array) -> tuple[Array, Array]:
        model = model_of(system, t0, y0)
        at_end = jax.vmap(lambda k, t, x, s: _guard(model, k, t, unravel(x), s))(cuts.switch, end, last, cuts.ending)
        if not any(cuts.free):
            return at_end, at_end
        at_begin = jax.vmap(lambda k, t, x, s: _tangency(model, k, t, unravel(x), s))
        return at_end, at_begin(cuts.switch, begin, first, cuts.within)

    def jumps(system: System, end: Array, last: Array) -> tuple[Array, Array]:
        model = model_of(system, t0, y0)

        def row(k: Array, t: Scalar, x: Array, ending: State, after: tuple) -> tuple[Array, Scalar]:
            y, rest = landing(model, k, t, unravel(x), ending, after)
            return ravel(y), rest

        return jax.vmap(row)(cuts.switch, end, last, cuts.ending, following)

    # A first look: the states between the pieces, and how fast the conditions change (divided by that they are times,
    # whatever the units of h).
    still = frozen(system)
    begin, end, y = lax.stop_gradient((cuts.begin, cuts.end, cuts.y))
    first = jax.vmap(ravel)(y)
    whole = Flows(still, cuts.within, t0, y0, 1, tuple(how.items()))
    ts, xs = whole.paths(begin, end, first[:, None])
    x = xs[:, :: SAMPLES // pieces][:, :pieces] if pieces > 1 else first[:, None]
    field = jax.vmap(lambda t, x, s: ravel(model_of(still, t0, y0).flow(t, unravel(x), s)))
    last = xs[:, -1]
    now = (begin, end, first, last)
    moves = (jnp.ones_like(begin), jnp.ones_like(end), field(begin, first, cuts.within), field(end, last, cuts.ending))
    _, rates = jax.jvp(lambda *a: conditions(still, *a), now, moves)
    rates = jax.tree.map(lambda r: lax.stop_gradient(jnp.where((r == 0) | ~jnp.isfinite(r), 1, r)), rates)
    normal = lax.stop_gradient(moves[2][0])
    normal = normal / jnp.where(normal @ normal == 0, 1, normal @ normal)

    def residual(z: tuple, system: System) -> tuple:
        begin, end, x = z
        ends = flows(system).ends(begin, end, x)
        last = ends[:, -1]
        after, rest = jumps(system, end, last)
        at_end, at_begin = conditions(system, begin, end, x[:, 0], last)
        ended = jnp.where(repels, at_begin / rates[1], at_end / rates[0])
        if autonomous:
            closing = jnp.broadcast_to(normal @ (x[0, 0] - x0), end.shape)
        else:
            closing = end - t0 - order * jnp.asarray(system.period, t0.dtype)
        ended = jnp.where(happened, ended, jnp.where(index == cuts.num, closing, end - begin))
        return (
            x[:, 0] - jnp.roll(after, 1, axis=0),
            x[:, 1:] - ends[:, :-1],
            ended,
            begin - jnp.append(t0, (end + rest)[:-1]),
        )

    found = optx.root_find(
        residual, optx.Newton(rtol=tol, atol=tol), (begin, end, x), args=system, max_steps=max_iterations, throw=False
    )
    begin, end, x = found.value
    error = jnp.max(jnp.abs(jnp.concatenate([r.ravel() for r in residual(found.value, still)])))
    size = 1 + jnp.max(jnp.abs(x))
    good = (found.result == optx.RESULTS.successful) & (error <= 1e3 * tol * size)
    period = end[-1] - t0 if autonomous else jnp.asarray(system.period, t0.dtype) * order
    _, shares = fractions(autonomous, order)
    later = flows(still).at(
        t0 + lax.stop_gradient(period) * jnp.asarray(shares, t0.dtype), *lax.stop_gradient((begin, end, x))
    )
    result = judge(good, x[0, 0], later, autonomous, order)

    ts, xs = flows(still).paths(*lax.stop_gradient((begin, end, x)))
    last = flows(system).ends(begin, end, x)[:, -1]
    phi = flows(system).derivatives(begin, end, x)
    events = _log(system, cuts, following, end, last, jumps(system, end, last), unravel)
    monodromy, multipliers, stable, zeros = _floquet(system, cuts, events, happened, phi, autonomous)
    # Where a free segment begins it is tangential that it must be.
    meant = jnp.roll(repels, -1)
    grazes = jnp.any(happened & ~meant & (events.transversality < jnp.cbrt(jnp.finfo(end.dtype).eps)))
    violation, violation_t = _violation(model_of(still, t0, y0), cuts, ts, xs, unravel)
    admissible = (violation == 0) & jnp.all(end - begin >= -1e3 * tol * (1 + jnp.abs(period)))
    result = RESULTS.where((result == RESULTS.successful) & grazes, RESULTS.tangential_event, result)
    result = RESULTS.where(is_okay(result) & ~admissible, RESULTS.orbit_not_admissible, result)
    return Orbit(
        system=system,
        t0=t0,
        y0=unravel(x[0, 0]),
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
        arcs=Arcs(begin, end, _modes(cuts.within.mode, begin), jax.vmap(jax.vmap(unravel))(x)),
        options=tuple(how.items()),
    )


def _modes(mode: tuple[Array, ...], rows: Array) -> Int[Array, "rows switches"]:
    return jnp.stack(mode, axis=1) if mode else jnp.zeros((len(rows), 0), jnp.int32)


def _log(
    system: System, cuts: Cuts, following: tuple, end: Array, last: Array, jump: tuple[Array, Array], unravel: Any
) -> Events:
    """The events between the segments."""
    after, rest = jump
    happened = jnp.arange(len(end), dtype=cuts.num.dtype) < cuts.num
    model = model_of(system, end[0], unravel(last[0]))

    def square(k: Array, t: Scalar, x: Array, s: State) -> Scalar:
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


def _floquet(
    system: System, cuts: Cuts, events: Events, happened: Array, phi: Array, autonomous: bool
) -> tuple[Array, Array, Array, Array]:
    """Monodromy matrix, multipliers, stability and structural zeros, from the derivatives along the segments."""
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


def _violation(model: Model, cuts: Cuts, ts: Array, xs: Array, unravel: Any) -> tuple[Scalar, Scalar]:
    """By how much the guards of the modes are violated, and when: beyond what the tolerance makes of them."""
    if not model.slots:
        return jnp.zeros_like(ts[0, 0]), ts[0, 0]

    def row(ts: Array, xs: Array, within: State, ending: State) -> Array:
        def guards(t: Scalar, x: Array) -> Array:
            def by(state: State) -> Array:
                return jnp.max(model.stacked(model.guards(t, unravel(x), state), -jnp.inf), axis=-1)

            return jnp.maximum(by(within), by(ending))

        return jax.vmap(guards)(ts, xs)

    values = jax.vmap(row)(ts, xs, cuts.within, cuts.ending)
    size = jnp.max(jnp.abs(values), axis=(0, 1))
    late = cuts.num < jnp.arange(len(ts), dtype=cuts.num.dtype)
    short = jnp.where((values < -1e-7 * size) & ~late[:, None, None], -values, 0).max(-1)
    worst = jnp.argmax(short)
    return short.ravel()[worst], ts.ravel()[worst]
