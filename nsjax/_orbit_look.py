"""What is seen of a point of a curve of orbits: its direction, its multipliers, what its guards do along the way."""

from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.flatten_util as jfu
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int

from ._course import Course, EVENT, FREE, TIME
from ._filippov import Model
from ._floquet import floquet, structural_zeros
from ._implicit import find_root
from ._orbit_curve import OrbitCurve, row_sizes
from ._segment_flow import NODES, THETA, with_parameter
from ._system import relay
from ._types import Scalar


TOLERANCE = 1e-12  # of Newton's method, in units of the unknowns


class Look(NamedTuple):
    """All that is seen of a point of the curve.

    - `u`, `tangent`: the unknowns, and the direction of the curve (of a surface, several); `good`: whether it is a
        point of the curve.
    - `parameter`, `period`; `begin`, `end`, `x`, `last`: of the segments: times, and states at beginnings and ends.
    - `factors`: the derivatives from the beginning of each segment to that of the next, at the same time; `monodromy`,
        `multipliers`, `stable`: what follows.
    - `rates`: of the guard that ends each segment, there: negative unless it comes to its surface tangentially.
    - `ends`: value of that guard there.
    - `margins`: |λ| - b at events that cross a surface which could hold.
    - `least`, `where`, `most`, `spots`: of each segment and guard the least value at the nodes, without the zeros that
        it has at the ends; at which share of the segment; the largest value; and the state where it is least.
    - `between`: the least value by parabolas between nodes. `rise`: by how much it is larger at a node beside that
        one; `orders`: of its zeros at both ends.
    - `low`, `high`: the least and the largest value of each component of the state; `mean`, `square`: its mean and that
        of its square over time.
    - `ts`, `xs`: times and states along each segment.
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
    between: Array
    rise: Array
    orders: Array
    low: Array
    high: Array
    mean: Array
    square: Array
    ts: Array
    xs: Array
    branch: Array
    residual: Scalar


def advance(
    curve: OrbitCurve, course: Course, origin: Array, border: Array, s: Array, guess: Array, newton: Array | bool = True
) -> Look:
    """The point of the curve at the distance `s` from `origin` along `border` (of a surface, at several distances along
    as many directions), and all that is seen of it; or, without
    `newton`, of the guess itself."""

    return _advance(curve.on(course), course, origin, border, s, guess, np.asarray(newton))


@eqx.filter_jit
def _advance(
    curve: OrbitCurve, course: Course, origin: Array, border: Array, s: Array, guess: Array, newton: Array
) -> Look:
    return step_on(curve, course, origin, border, s, guess, newton)


def step_on(
    curve: OrbitCurve, course: Course, origin: Array, border: Array, s: Array, guess: Array, newton: Array | bool = True
) -> Look:
    """`advance`, within a program."""

    def residual(u: Array, _: Any) -> Array:
        off = jnp.append(curve.residual(u, course, origin)[0], border @ (u - origin) - s)
        return jnp.where(newton, off, u - guess)

    u, good = find_root(residual, guess, None, TOLERANCE, 10)
    return look_at(curve, u, border, course, origin, good)


def look_at(curve: OrbitCurve, u: Array, border: Array, course: Course, origin: Array, good: Array) -> Look:
    begin, end, x, value = curve.parts(u)
    n, rows, m = len(curve.sizes), len(begin), curve.dimension
    model = with_parameter(curve.model, curve.path, value)

    def equations(u: Array) -> tuple[tuple[Array, Scalar], tuple[Array, Array]]:
        f, arrival, last = curve.residual(u, course, origin)
        return (f, arrival), (f, last)

    (df, closing), (f, last) = jax.jacfwd(equations, has_aux=True)(u)
    scaled = df / row_sizes(df)[:, None]
    whole = jnp.concatenate([scaled, jnp.atleast_2d(border)])
    along = jnp.linalg.solve(whole, jnp.eye(len(u), m, m - len(u), dtype=u.dtype)).T
    if m == 1:
        along = along / jnp.linalg.norm(along)
    else:
        along = jnp.linalg.solve(jnp.linalg.cholesky(along @ along.T), along)
    branch = jnp.stack(jnp.linalg.slogdet(jnp.concatenate([df, along])))
    tangent = along.reshape(jnp.shape(border))

    # Derivatives from segment to segment at the same time: the blocks of DF, the moved times eliminated.
    index = jnp.arange(rows, dtype=course.num.dtype)
    after = jnp.where(index >= course.num - 1, 0, index + 1)
    mode, part = jnp.asarray(course.mode), jnp.asarray(course.part)
    field = (
        jax.vmap(lambda t, x, m, p: jfu.ravel_pytree(model.flow(t, curve.unravel(x), curve.state(m, p)))[0])(
            begin, x, mode, part
        )
        * curve.time
        / curve.sizes
    )
    blocks = df[:, :-m].reshape(rows, n + 2, rows, n + 2)
    own, on = blocks[index, :, index], blocks[after, :, index]
    # The next segment of the last one begins where it ends; of a single one it is the same.
    itself = jnp.zeros(n + 2, u.dtype).at[2:].set(1)
    on = jnp.where(course.num == 1, on - jnp.diag(itself), on)
    final = (index == course.num - 1)[:, None]
    on = on.at[:, 0].set(jnp.where(final, -closing[:-m].reshape(rows, n + 2), on[:, 0]))
    on = jnp.where((course.ends == TIME)[:, None, None], on.at[:, 0].set(0), on)

    def factor(own: Array, on: Array, ends: Array, last_field: Array) -> Array:
        # Unknown of a segment: begin, end, x. Its equations: started, finished, continued.
        by_x, by_end = own[1, 2:], own[1, 1]
        slope = jnp.where(ends == EVENT, by_end, 1)
        move = jnp.where(ends == EVENT, -by_x / slope, 0)  # of the end of the segment
        shift = -(on[0, 1] * move + on[0, 2:])  # of the beginning of the next
        plain = -(on[2:, 2:] + jnp.outer(on[2:, 1], move))
        return plain - jnp.outer(last_field, shift)

    factors = jax.vmap(factor)(own, on, course.ends, field[after])
    factors = factors * curve.sizes[:, None] / curve.sizes[None, :]
    factors = jnp.where((index < course.num)[:, None, None], factors, jnp.eye(n, dtype=u.dtype))

    zeros = structural_zeros(model.system, jnp.where((index < course.num)[:, None], mode, mode[:1]))
    found = floquet(factors, zeros, curve.autonomous)
    free = jnp.any((course.ends == FREE) & (index < course.num))
    either = zip(_infinitely_unstable(n, curve.autonomous), found)
    monodromy, multipliers, stable = (jnp.where(free, x, y) for x, y in either)

    # Along the way.
    theta = jnp.asarray(THETA, u.dtype)

    def path(a: Scalar, b: Scalar, x: Array, mode: Array, part: Array) -> tuple[Array, Array, Array]:
        return curve.flow.along(a, b, x, value, curve.state(mode, part))

    ts, xs, sums = jax.vmap(path)(begin, end, x, mode, part)
    inside = (index < course.num)[:, None]
    low, high = -_largest(theta, -xs, inside), _largest(theta, xs, inside)
    length = jnp.sum(jnp.where(inside[:, 0], end - begin, 0))
    mean, square = jnp.sum(jnp.where(inside[..., None], sums, 0), axis=0) / length
    period = end[course.num - 1] - begin[0]
    if not curve.autonomous:
        period = jnp.asarray(model.system.period, u.dtype) * curve.order.astype(u.dtype)
    least, between, most, index, rise, orders = _least(curve, model, theta, ts, xs, course)
    where, spots = theta[index], jnp.take_along_axis(xs, index[..., None], axis=1)
    rates, values, margins = _at_ends(curve, model, end, last, course)
    # Beside a branch point rounding moves the root by more than Newton's method is to find it to.
    wrong = jnp.max(jnp.abs(f))
    good = (good | (wrong < TOLERANCE)) & jnp.all(jnp.isfinite(tangent))
    return Look(
        u, tangent, good, value, period, begin, end, x, last, factors, monodromy, multipliers, stable,
        rates, values, margins, least, where, most, spots, between, rise, orders, low, high, mean, square, ts, xs,
        branch, wrong,
    )  # fmt: skip


def _infinitely_unstable(n: int, autonomous: bool) -> tuple[Array, Array, Array]:
    """Monodromy matrix, multipliers, and whether it is stable, of an orbit that slides on a surface that repels."""
    rest = [1.0] * autonomous + [jnp.nan] * (n - 1 - autonomous)
    return jnp.full((n, n), jnp.inf), jnp.array([jnp.inf, *rest], complex), jnp.array(False)


def _least(
    curve: OrbitCurve, model: Model, theta: Array, ts: Array, xs: Array, course: Course
) -> tuple[Array, Array, Array, Int[Array, "rows slots"], Array, Array]:
    """Of every guard in every segment the least value at the nodes, divided by the zeros that it must have at the
    ends, and that between them; the largest; at which node it is least; by how much it rises to the nodes beside
    that; and the zeros' orders."""
    rows = len(ts)
    if not model.slots:
        none = jnp.ones((rows, 0), ts.dtype)
        return none, none, none, jnp.zeros((rows, 0), jnp.int32), none, jnp.ones((2, rows, 0), ts.dtype)
    mode, part = jnp.asarray(course.mode), jnp.asarray(course.part)

    def row(ts: Array, xs: Array, m: Array, p: Array) -> Array:
        state = curve.state(m, p)
        return jax.vmap(lambda t, x: jnp.max(curve.guards(model, t, x, state), axis=-1))(ts, xs)

    values = jax.vmap(row)(ts, xs, mode, part)  # rows, nodes, slots
    zeros = jnp.asarray(zeros_at_begin(curve, model, course), values.dtype)  # rows, slots
    here = jnp.arange(values.shape[-1], dtype=course.slot.dtype) == course.slot[:, None]
    index = jnp.arange(rows, dtype=course.num.dtype)
    after = jnp.where(index >= course.num - 1, 0, index + 1)
    # On what is left freely it comes tangentially.
    last = jnp.where((course.ends == EVENT)[:, None] & here, jnp.where(course.ends[after] == FREE, 2, 1)[:, None], 0)
    orders = jnp.stack([zeros, last.astype(theta.dtype)])
    deflated = _deflated(values, theta[None, :, None], orders[:, :, None])
    index = jnp.argmin(deflated, axis=1)
    least = jnp.min(deflated, axis=1)
    beside = jnp.clip(jnp.stack([index - 1, index + 1], axis=1), 0, len(theta) - 1)
    rise = jnp.max(jnp.take_along_axis(deflated, beside, axis=1), axis=1) - least
    between = jnp.minimum(least, _dip(theta, deflated))
    return least, between, jnp.max(values, axis=1), index, rise, orders


def zeros_at_begin(curve: OrbitCurve, model: Model, course: Course) -> Array:
    """How many zeros each guard has at the beginning of each segment: that of the surface just left."""
    index = jnp.arange(len(course.slot), dtype=course.num.dtype)
    before = jnp.where(index == 0, course.num - 1, index - 1)
    slot, ends, mode_before = course.slot[before], course.ends[before], jnp.asarray(course.mode)[before]
    mode = jnp.asarray(course.mode)
    columns = []
    switch = jnp.asarray([s.switch for s in model.slots], jnp.int32)[slot]
    entry = course.entry[before]
    part = jnp.asarray([s.part for s in model.slots], jnp.int32)[slot]
    component = jnp.where(entry > 0, entry, jnp.where(part >= 0, part, 0))
    for s in model.slots:
        k = s.switch
        left = (switch == k) & ((ends == EVENT) | (ends == FREE))
        if s.holding or isinstance(model.switches[k], relay):
            columns.append(jnp.zeros(len(index)))
            continue
        free = jnp.ones(len(index), bool)
        order = jnp.ones(len(index))
        if k in model.holdable:
            free = ~model.held(k, mode[:, k])
            slid = model.held(k, mode_before[:, k])
            if k in model.contacts:
                order = jnp.where(slid, 3, 1)
            elif not model.static(k):
                order = jnp.where(slid, 2, 1)
        if model.parts[k] > 1:  # above, each component is a guard of its own; below, they are one
            free = free & jnp.where(mode[:, k] > 0, component == s.part, s.part == 0)
        columns.append(jnp.where(left & free, order, 0))
    return jnp.stack([c.astype(jnp.result_type(float)) for c in columns], axis=1)


def _at_ends(curve: OrbitCurve, model: Model, end: Array, last: Array, course: Course) -> tuple[Array, Array, Array]:
    """Rate and value of the guard that ends each segment, and |λ| - b where it crosses what could hold it."""
    if not model.slots:
        return -jnp.ones_like(end), jnp.zeros_like(end), jnp.ones_like(end)
    mode, part = jnp.asarray(course.mode), jnp.asarray(course.part)
    final = jnp.arange(len(end), dtype=course.num.dtype) == course.num - 1
    following = jnp.where(final[:, None], mode[:1], jnp.roll(mode, -1, axis=0))

    def row(t: Scalar, x: Array, m: Array, p: Array, after: Array, slot: Array, entry: Array) -> tuple:
        state = curve.state(m, p)
        margin = jnp.full_like(t, jnp.inf)
        for k in model.holdable:
            if k in model.contacts:
                continue
            here = jnp.asarray([s.switch == k for s in model.slots])[slot] & (m[k] != 0) & (after[k] != 0)
            held = state._replace(mode=tuple(jnp.where(i == k, 0, mi) for i, mi in enumerate(state.mode)))
            if model.parts[k] > 1:
                touched = jnp.where(entry > 0, entry, jnp.asarray([s.part for s in model.slots], jnp.int32)[slot])
                held = held._replace(part=tuple(touched if i == k else q for i, q in enumerate(held.part)))
            value = model.values(t, curve.unravel(x), held)[k]
            margin = jnp.where(here, jnp.abs(value) - model.bound(k), margin)
        rate = curve.rate(model, t, x, state, slot, entry)
        return rate, curve.guard(model, t, x, state, slot, entry), margin

    return jax.vmap(row)(end, last, mode, part, following, course.slot, course.entry)


def _dip(theta: Array, v: Float[Array, "rows nodes slots"]) -> Float[Array, "rows slots"]:
    """The least value between nodes, by the parabola about every node."""
    near, far = (theta[1:-1] - theta[:-2])[:, None], (theta[2:] - theta[1:-1])[:, None]
    mid = v[:, 1:-1]
    a, b = (mid - v[:, :-2]) / near, (v[:, 2:] - mid) / far
    slope, bend = (a * far + b * near) / (near + far), (b - a) / (near + far)
    low = mid - slope**2 / jnp.where(bend > 0, 4 * bend, jnp.inf)
    inside = (bend > 0) & (-slope < 2 * bend * far) & (slope < 2 * bend * near)
    return jnp.min(jnp.where(inside, low, jnp.inf), axis=1)


def _deflated(values: Array, theta: Array, orders: Array) -> Array:
    """Divided by zeros at both ends, of these orders."""
    below = theta ** orders[0] * (1 - theta) ** orders[1]
    # A node beside a zero is rounding divided by little.
    return jnp.where(below > 1e-9, values / jnp.where(below > 0, below, 1), jnp.inf)


def _largest(theta: Array, xs: Array, inside: Array) -> Array:
    """The largest value of each component, by the parabola through the largest sample and its neighbours."""
    here = jnp.where(inside[..., None], xs, -jnp.inf)
    peak = jnp.clip(jnp.argmax(here, axis=1), 1, len(theta) - 2)  # rows, components
    a, b, c = (jnp.take_along_axis(xs, (peak + k)[:, None], axis=1)[:, 0] for k in (-1, 0, 1))
    ta, tb, tc = (theta[peak + k] for k in (-1, 0, 1))
    left, right = (b - a) / (tb - ta), (c - b) / (tc - tb)
    bend = (right - left) / (tc - ta)
    safe = jnp.where(bend < 0, bend, -1)
    at = jnp.clip((ta + tb) / 2 - left / (2 * safe), ta, tc)
    top = a + left * (at - ta) + bend * (at - ta) * (at - tb)
    best = jnp.maximum(jnp.max(here, axis=1), jnp.where(bend < 0, top, -jnp.inf))
    return jnp.max(jnp.where(inside, best, -jnp.inf), axis=0)


@eqx.filter_jit
def least_between(
    curve: OrbitCurve, value: Scalar, ab: Array, shares: Array, x: Array, mode: Array, part: Array, slot: Array,
    orders: Array,
) -> Scalar:  # fmt: skip
    """The least value of a guard between two shares of a segment, from the state at the first one; without the zeros at
    its ends. Where several components meet, at a tip, it has a kink there: each is interpolated for itself."""
    model = with_parameter(curve.model, curve.path, value)
    state = curve.state(mode, part)
    theta = shares[0] + (shares[1] - shares[0]) * jnp.asarray(THETA, x.dtype)
    begin, end = ab[0] + (ab[1] - ab[0]) * shares
    ts, xs, _ = curve.flow.along(begin, end, x, value, state)
    parts = jax.vmap(lambda t, x: curve.guards(model, t, x, state)[slot])(ts, xs)
    i = jnp.argmin(_deflated(jnp.max(parts, axis=1), theta, orders))
    window = jnp.clip(i - 2, 0, NODES - 4) + jnp.arange(5, dtype=i.dtype)
    nodes, five = theta[window], jnp.where(jnp.isneginf(parts[window]), -1e300, parts[window])  # which is no component
    fine = jnp.linspace(theta[jnp.maximum(i - 1, 0)], theta[jnp.minimum(i + 1, NODES)], NODES + 1)
    apart = ~jnp.eye(5, dtype=bool)
    shares_of = (fine[:, None, None] - nodes) / jnp.where(apart, nodes[:, None] - nodes, 1)
    weights = jnp.prod(jnp.where(apart, shares_of, 1), axis=-1)  # of Lagrange's polynomials
    return jnp.min(_deflated(jnp.max(weights @ five, axis=1), fine, orders))
