"""What is seen of a point of a curve of orbits: its direction, its multipliers, what its guards do along the way."""

import functools as ft
from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import jax.flatten_util as jfu
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float

from ..._numerics._lapack import slogdet, solve
from ..._numerics._repeated import Repeated, Same
from ..._numerics._root import Newton
from ..._numerics._select import select
from ..._types import Scalar
from ...derivatives._floquet import floquet, structural_zeros
from ...system._model import SwitchedSystem
from ._corrector import newton_turns, Plane, Turn
from ._equations import OrbitCurve, row_sizes
from ._guard_minima import along_orbit
from ._itinerary import EVENT, OrbitItinerary, REPELLING_EXIT, TIME
from ._segment_flow import states_along


TOLERANCE = 1e-12  # of Newton's method, in units of the unknowns


class PointData(NamedTuple):
    """All that is seen of a point of the curve.

    - `u`, `tangent`: the unknowns, and the direction of the curve (of a surface, several); `good`: whether it is a
        point of the curve.
    - `parameter`, `period`; `begin`, `end`, `x`, `last`: of the segments: times, and states at beginnings and ends.
    - `factors`: the derivatives from the beginning of each segment to that of the next, at the same time; `monodromy`,
        `multipliers`, `stable`: what follows.
    - `rates`: of the guard that ends each segment, there: negative unless it comes to its surface tangentially.
    - `ends`: value of that guard there.
    - `margins`: |λ| - b at events that cross a surface which could hold.
    - `least`, `where`, `most`, `spots`: of each segment and guard the least value, without the zeros that it has at the
        ends; at which share of the segment; how large it is elsewhere; and the state where it is least.
    - `low`, `high`: the least and the largest value of each component of the state; `mean`, `square`: its mean and that
        of its square over time.
    - `ts`, `xs`: times and states along each segment; `turns_t`, `turns_x`: where in each segment each component of the
        state is least, and where it is largest.
    - `branch`: sign and logarithm of the determinant of the equations bordered by the tangent.
    - `residual`: the largest of the equations.
    """

    u: Array
    tangent: Array
    good: Bool[Array, ""]
    parameter: Array
    period: Scalar
    begin: Array
    end: Array
    x: Array
    last: Array
    factors: Array
    monodromy: Array
    multipliers: Array
    stable: Bool[Array, ""]
    rates: Array
    ends: Array
    margins: Array
    least: Array
    where: Array
    most: Array
    spots: Array
    low: Array
    high: Array
    mean: Array
    square: Array
    ts: Array
    xs: Array
    turns_t: Array
    turns_x: Array
    branch: Array
    residual: Scalar


def state_at(curve: OrbitCurve, itinerary: OrbitItinerary, look: PointData, i: int, t: float) -> np.ndarray:
    """The state at a time in segment i. (Between steps the states of a `PointData` are those of the solver's dense
    output, less exact than the steps.)"""
    state = curve.state(itinerary.mode[i], itinerary.part[i])
    flow = curve.on(itinerary).flow(jnp.asarray(look.parameter))
    return np.asarray(states_along(flow, look.begin[i], np.asarray(t), look.x[i], state))[-1]


def correct(
    curve: OrbitCurve, itinerary: OrbitItinerary, plane: Plane, guess: Any = None, newton: bool = True
) -> PointData:
    """The corrector: the point of the curve on a plane, by Newton's method from a `guess` (by
    default straight ahead), and all that is seen of it; or, without `newton`, of the guess itself."""
    plane = plane.filled()
    guess = plane.origin + np.dot(plane.distance, plane.normal) if guess is None else guess
    which, rest = (Same(curve), Same(itinerary)), (plane, guess, np.asarray(newton))
    found, spoilt = _at(*which)(*rest)
    return _at(*which, fixed=True)(*rest)[0] if spoilt else found


@ft.lru_cache(maxsize=16)  # for branches that are followed in turn
def _at(curve: Same, itinerary: Same, fixed: bool = False) -> Callable[..., Any]:
    given = curve.it.on(itinerary.it)
    return _correct.at(given.fixed if fixed else given, itinerary.it)


@Repeated
def _correct(
    curve: OrbitCurve, itinerary: OrbitItinerary, plane: Plane, guess: Array, newton: Array
) -> tuple[PointData, Bool[Array, ""]]:
    """Also whether a parameter that does not vary spoils it, see `OrbitCurve.fixed`."""
    last = newton_turns(curve, itinerary, plane, guess, Newton(TOLERANCE, 10), newton)
    return _seen(curve, itinerary, last, plane, turns=True), last.spoilt


def corrected(
    curve: OrbitCurve,
    itinerary: OrbitItinerary,
    plane: Plane,
    guess: Array,
    newton: Array | bool = True,
    turns: bool = True,
) -> PointData:
    """`correct`, within a program; without `turns` the largest and least states are those at the nodes."""
    last = newton_turns(curve, itinerary, plane, guess, Newton(TOLERANCE, 10), newton)
    return _seen(curve, itinerary, last, plane, turns)


def _orthonormal(rows: Float[Array, "m n"]) -> Float[Array, "m n"]:
    """Rows that span the same, in the same order, by the method of Gram and Schmidt."""
    found: list[Array] = []
    for row in rows:
        for _ in range(2 if found else 0):  # the second time, what rounding has left
            row = row - sum((row @ other) * other for other in found)
        found.append(row / jnp.linalg.norm(row))
    return jnp.stack(found)


def _seen(curve: OrbitCurve, itinerary: OrbitItinerary, turn: Turn, plane: Plane, turns: bool) -> PointData:
    """All that is seen of a point, at which Newton's method has ended."""
    u, linear, good = turn.u, turn.linear, turn.good
    begin, end, x, value = curve.parts(u)
    n, rows, m = len(curve.sizes), len(begin), curve.dimension
    model = curve.model_at(value)
    border, (f, last, df, closing) = plane.normal, linear
    scaled = df / row_sizes(df)[:, None]
    whole = jnp.concatenate([scaled, jnp.atleast_2d(border)])
    along = solve(whole, jnp.eye(len(u), m, m - len(u), dtype=u.dtype)).T
    along = _orthonormal(along)
    branch = jnp.stack(slogdet(jnp.concatenate([df, along])))
    tangent = along.reshape(jnp.shape(border))

    factors = factors_of(curve, itinerary, u, df, closing)
    index = jnp.arange(rows, dtype=itinerary.num.dtype)
    mode = jnp.asarray(itinerary.mode)
    zeros = structural_zeros(model.system, select((index < itinerary.num)[:, None], mode, mode[:1]))
    found = floquet(factors, zeros, curve.autonomous)
    free = jnp.any((itinerary.ends == REPELLING_EXIT) & (index < itinerary.num))
    either = zip(_infinitely_unstable(n, curve.autonomous), found)
    monodromy, multipliers, stable = (select(free, x, y) for x, y in either)

    # Along the way.
    inside = (index < itinerary.num)[:, None]
    along = along_orbit(curve, itinerary, u, turns)
    least = along.least[:, 2 * n :]
    low, high = jnp.min(select(inside, along.least[:, : 2 * n], jnp.inf), axis=0).reshape(2, n)
    length = jnp.sum(select(inside[:, 0], end - begin, 0))
    mean, square = jnp.sum(select(inside[..., None], along.sums, 0), axis=0) / length
    period = end[itinerary.num - 1] - begin[0]
    if not curve.autonomous:
        period = jnp.asarray(model.system.period, u.dtype) * curve.order.astype(u.dtype)
    turns_t = begin[:, None] + (end - begin)[:, None] * along.share[:, : 2 * n]
    rates, values, margins = _at_ends(curve, model, end, last, itinerary)
    # Beside a branch point rounding moves the root by more than Newton's method is to find it to.
    wrong = jnp.max(jnp.abs(f))
    good = (good | (wrong < TOLERANCE)) & jnp.all(jnp.isfinite(tangent))
    return PointData(
        u=u, tangent=tangent, good=good, parameter=value, period=period, begin=begin, end=end, x=x, last=last,
        factors=factors, monodromy=monodromy, multipliers=multipliers, stable=stable, rates=rates, ends=values,
        margins=margins, least=least, where=along.share[:, 2 * n :], most=along.most[:, 2 * n :],
        spots=along.x[:, 2 * n :], low=low, high=-high, mean=mean, square=square, ts=along.ts, xs=along.xs,
        turns_t=turns_t, turns_x=along.x[:, : 2 * n], branch=branch, residual=wrong,
    )  # fmt: skip


def factors_of(curve: OrbitCurve, itinerary: OrbitItinerary, u: Array, df: Array, closing: Array) -> Array:
    """The derivatives from the beginning of each segment to that of the next, at the same time: the blocks of `df`, the
    Jacobian of the equations, from which the moved times are eliminated. `closing`: the derivative of the time at which
    the last segment ends."""
    begin, _, x, value = curve.parts(u)
    n, rows = len(curve.sizes), len(begin)
    model = curve.model_at(value)
    index = jnp.arange(rows, dtype=itinerary.num.dtype)
    after = select(index >= itinerary.num - 1, 0, index + 1)
    mode, part = jnp.asarray(itinerary.mode), jnp.asarray(itinerary.part)
    field = (
        jax.vmap(lambda t, x, m, p: jfu.ravel_pytree(model.flow(t, curve.unravel(x), curve.state(m, p)))[0])(
            begin, x, mode, part
        )
        * curve.time
        / curve.sizes
    )
    blocks = df[:, : len(df)].reshape(rows, n + 2, rows, n + 2)
    own, on = blocks[index, :, index], blocks[after, :, index]
    # The next segment of the last one begins where it ends; of a single one it is the same.
    itself = jnp.zeros(n + 2, u.dtype).at[2:].set(1)
    on = select(itinerary.num == 1, on - jnp.diag(itself), on)
    final = (index == itinerary.num - 1)[:, None]
    on = on.at[:, 0].set(select(final, -closing[: len(df)].reshape(rows, n + 2), on[:, 0]))
    on = select((itinerary.ends == TIME)[:, None, None], on.at[:, 0].set(0), on)

    def factor(own: Array, on: Array, ends: Array, last_field: Array) -> Array:
        # Unknown of a segment: begin, end, x. Its equations: started, finished, continued.
        by_x, by_end = own[1, 2:], own[1, 1]
        slope = select(ends == EVENT, by_end, 1)
        move = select(ends == EVENT, -by_x / slope, 0)  # of the end of the segment
        shift = -(on[0, 1] * move + on[0, 2:])  # of the beginning of the next
        plain = -(on[2:, 2:] + jnp.outer(on[2:, 1], move))
        return plain - jnp.outer(last_field, shift)

    factors = jax.vmap(factor)(own, on, itinerary.ends, field[after])
    factors = factors * curve.sizes[:, None] / curve.sizes[None, :]
    return select((index < itinerary.num)[:, None, None], factors, jnp.eye(n, dtype=u.dtype))


def _infinitely_unstable(n: int, autonomous: bool) -> tuple[Array, Array, Array]:
    """Monodromy matrix, multipliers, and whether it is stable, of an orbit that slides on a surface that repels."""
    rest = [1.0] * autonomous + [jnp.nan] * (n - 1 - autonomous)
    return jnp.full((n, n), jnp.inf), jnp.array([jnp.inf, *rest][:n], complex), jnp.array(False)


def _at_ends(
    curve: OrbitCurve, model: SwitchedSystem, end: Array, last: Array, itinerary: OrbitItinerary
) -> tuple[Array, Array, Array]:
    """Rate and value of the guard that ends each segment, and |λ| - b where it crosses what could hold it."""
    if not model.slots:
        return -jnp.ones_like(end), jnp.zeros_like(end), jnp.ones_like(end)
    mode, part = jnp.asarray(itinerary.mode), jnp.asarray(itinerary.part)
    final = jnp.arange(len(end), dtype=itinerary.num.dtype) == itinerary.num - 1
    following = select(final[:, None], mode[:1], jnp.roll(mode, -1, axis=0))

    def row(t: Scalar, x: Array, m: Array, p: Array, after: Array, slot: Array, entry: Array) -> tuple:
        state = curve.state(m, p)
        margin = jnp.full_like(t, jnp.inf)
        for k in model.holdable:
            if k in model.contacts:
                continue
            here = jnp.asarray([s.switch == k for s in model.slots])[slot] & (m[k] != 0) & (after[k] != 0)
            held = state._replace(mode=tuple(select(i == k, 0, mi) for i, mi in enumerate(state.mode)))
            if model.parts[k] > 1:
                touched = select(entry > 0, entry, jnp.asarray([s.part for s in model.slots], jnp.int32)[slot])
                held = held._replace(part=tuple(touched if i == k else q for i, q in enumerate(held.part)))
            value = model.values(t, curve.unravel(x), held)[k]
            margin = select(here, jnp.abs(value) - model.bound(k), margin)
        rate = curve.rate(model, t, x, state, slot, entry)
        return rate, curve.guard(model, t, x, state, slot, entry), margin

    return jax.vmap(row)(end, last, mode, part, following, itinerary.slot, itinerary.entry)
