"""Periodic orbits in segments: cut at their events, with the states and times of the cuts as unknowns.

Each segment is a smooth flow in a mode that is given. So the equations stay well-posed where the flow is not: on a
surface that repels, and for orbits that no solution follows for a whole period.
"""

from typing import Any

import diffrax as dfx
import equinox as eqx
import jax
import jax.flatten_util as jfu
import jax.lax as lax
import jax.numpy as jnp
import optimistix as optx
from jaxtyping import Array, Float, Int

from ._cuts import Cuts, landing, model_of, Smooth, where
from ._event import cosine
from ._filippov import Model, State
from ._jacobian import dense_jacobian
from ._orbit import floquet, fractions, judge, Orbit, ravel, structural_zeros
from ._saltation import fired, saltation_matrices
from ._solution import Events, is_okay, RESULTS
from ._solve import solve
from ._system import frozen, System
from ._types import Scalar, Y


SAMPLES = 65  # of a segment, between which the guards are not looked at


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


class _Flows(eqx.Module):
    """The smooth flows of all segments of a system, each divided into `pieces` of equal length."""

    system: System
    within: State
    t0: Scalar
    y0: Y
    pieces: int = eqx.field(static=True)
    how: tuple[tuple[str, Any], ...] = eqx.field(static=True)

    def piece(self, a: Scalar, b: Scalar, x: Array, state: State, saveat: dfx.SaveAt) -> Any:
        unravel = jfu.ravel_pytree(self.y0)[1]
        smooth = Smooth(model_of(self.system, self.t0, self.y0), state)
        sol = solve(smooth, a, b, unravel(x), saveat=saveat, throw=False, **dict(self.how))
        return jax.tree.map(lambda y: jnp.where(is_okay(sol.result), y, jnp.nan), jax.vmap(ravel)(sol.ys))

    def rows(self, fn: Any, begin: Array, end: Array, x: Array) -> Any:
        """`fn(a, b, x, state)` for every piece of every segment."""

        def row(a: Scalar, b: Scalar, x: Array, state: State) -> Any:
            starts = a + (b - a) * jnp.arange(self.pieces, dtype=a.dtype) / self.pieces
            return jax.vmap(lambda a, b, x: fn(a, b, x, state))(starts, jnp.append(starts[1:], b), x)

        return jax.vmap(row)(begin, end, x, self.within)

    def ends(self, begin: Array, end: Array, x: Array) -> Float[Array, "rows pieces n"]:
        def last(flows: _Flows, a: Scalar, b: Scalar, x: Array, state: State) -> Array:
            return flows.piece(a, b, x, state, dfx.SaveAt(t1=True))[0]

        return self.rows(lambda *args: dense_jacobian(last, self, *args), begin, end, x)

    def paths(self, begin: Array, end: Array, x: Array) -> tuple[Array, Array, Array]:
        """Times and states along every segment, and the derivative of its end by its beginning."""

        def along(a: Scalar, b: Scalar, x: Array, state: State) -> tuple[Array, Array, Array]:
            ts = jnp.linspace(a, b, SAMPLES)

            def path(x: Array) -> tuple[Array, Array]:
                xs = self.piece(a, b, x, state, dfx.SaveAt(ts=ts, t1=True))
                return xs[-1], xs[:-1]

            (phi, _), (_, xs) = jax.jacfwd(path)(x), path(x)
            return ts, xs, phi

        ts, xs, phis = self.rows(along, begin, end, x)
        eye = jnp.eye(x.shape[-1], dtype=x.dtype)
        phi = jax.vmap(lambda each: lax.scan(lambda m, phi: (phi @ m, None), eye, each)[0])(phis)
        return ts.reshape(len(begin), -1), xs.reshape(len(begin), -1, x.shape[-1]), phi

    def at(self, times: Array, begin: Array, end: Array, x: Array) -> Float[Array, "times n"]:
        """States at given times of the orbit."""
        starts = (
            begin[:, None] + (end - begin)[:, None] * jnp.arange(self.pieces, dtype=end.dtype) / self.pieces
        ).ravel()

        def one(t: Scalar) -> Array:
            i = jnp.maximum(jnp.searchsorted(starts, t, side="right") - 1, 0)
            state = jax.tree.map(lambda s: s[i // self.pieces], self.within)
            return self.piece(starts[i], t, x.reshape(-1, x.shape[-1])[i], state, dfx.SaveAt(t1=True))[0]

        return jax.vmap(one)(times)


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

    def flows(system: System) -> _Flows:
        return _Flows(system, cuts.within, t0, y0, pieces, tuple(how.items()))

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
    whole = _Flows(still, cuts.within, t0, y0, 1, tuple(how.items()))
    ts, xs, _ = whole.paths(begin, end, first[:, None])
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

    ts, xs, phi = flows(system).paths(begin, end, x)
    events = _log(system, cuts, following, end, xs[:, -1], jumps(system, end, xs[:, -1]), unravel)
    monodromy, multipliers, stable, zeros = _floquet(system, cuts, events, happened, phi, autonomous)
    violation, violation_t = _violation(model_of(still, t0, y0), cuts, ts, xs, unravel)
    admissible = (violation == 0) & jnp.all(end - begin >= -1e3 * tol * (1 + jnp.abs(period)))
    result = RESULTS.where((result == RESULTS.successful) & ~admissible, RESULTS.orbit_not_admissible, result)
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
    n = phi.shape[-1]
    eye = jnp.eye(n, dtype=phi.dtype)
    zeros = structural_zeros(system, _modes(cuts.within.mode, happened))
    if not any(cuts.free):
        jumps = where(happened, saltation_matrices(system, events), jnp.broadcast_to(eye, phi.shape))
        monodromy = lax.scan(lambda m, row: (row[1] @ row[0] @ m, None), eye, (phi, jumps))[0]
        return monodromy, *floquet(monodromy, zeros, autonomous), zeros
    # Backwards in time a surface that repels attracts, and the multipliers are the reciprocals: what leaves the surface
    # freely comes onto it there, and has a saltation matrix. Where it comes onto the surface, tangentially, none is.
    free = jnp.asarray(cuts.free)
    before, after = (
        jnp.where(free[:, None], *pair)
        for pair in ((events.mode_after, events.mode_before), (events.mode_before, events.mode_after))
    )
    swapped = eqx.tree_at(lambda e: (e.mode_before, e.mode_after), events, (before, after))
    jumps = saltation_matrices(system, swapped)
    tangent = jnp.roll(free, -1)
    ordinary = happened & ~free & ~tangent
    back = jnp.where(free[:, None, None], jumps, eye)
    back = where(ordinary, jnp.linalg.inv(where(ordinary, jumps, jnp.broadcast_to(eye, phi.shape))), back)
    backwards = lax.scan(lambda m, row: (m @ jnp.linalg.solve(row[0], row[1]), None), eye, (phi, back))[0]
    infinite = sum(cuts.free)
    multipliers, _ = floquet(backwards, jnp.asarray(infinite, jnp.int32), autonomous)
    multipliers = jnp.where(multipliers == 0, jnp.inf, 1 / jnp.where(multipliers == 0, 1, multipliers))[::-1]
    return jnp.full_like(eye, jnp.inf), multipliers, jnp.zeros((), bool), zeros


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
