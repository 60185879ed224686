"""Where on an arc the first event is, by sign variations of the polynomials of the guards, for all lanes at once."""

import functools as ft
from typing import Any, NamedTuple

import jax.lax as lax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int

from ..._numerics._barrier import once
from ..._numerics._bernstein import binomials
from ..._numerics._select import select


DEPTH = 24  # halvings of an arc; what they do not separate is left to the general flow
NEAR = 1e-5  # how near to zero a guard may come without an event, as a part of its size on the arc
SOON = 1e-7  # how near to each other two roots may be, or one to the start, as a part of the arc
_HALLEY = 2

Lanes = Float[Array, " lanes"]
Truths = Bool[Array, " lanes"]


class Corner(NamedTuple):
    """A surface of several components. Where h > 0 its mode ends when the first of them falls, and each is a guard of
    its own; where h < 0 when the last of them has become positive, and their guards are `joint`."""

    rows: list[int]
    joint: Truths


class Isolated(NamedTuple):
    """The beginning of an arc on which at most one guard falls to zero, once; of joint guards the last of those that
    do."""

    share: Lanes  # of the arc
    coefficients: Float[Array, "rows coefficients lanes"]  # there
    fires: Bool[Array, "rows lanes"]  # which guard falls
    doubtful: Truths  # whether it has not been isolated, or some guard comes near to zero


class _Look(NamedTuple):
    variations: Int[Array, "rows lanes"]
    begun: Truths  # whether some guard is not positive at the start
    near: Truths  # whether some guard without a root comes near to zero
    late: Truths  # or only seems to, by its coefficients, or at the end: a root may be right behind that
    many: Truths  # whether more roots than one may be left


def _look(a: Array, known: Int[Array, "rows lanes"], size: Array, corners: list[Corner]) -> _Look:
    count = a.shape[1]
    # What is known at the start is divided out: that drops the first coefficients.
    first = select(known == 0, a[:, 0], select(known == 1, a[:, 1], select(known == 2, a[:, 2], a[:, 3])))
    kept = [select(known > j, first, a[:, j]) if j < 3 else a[:, j] for j in range(count)]
    signs = [x > 0 for x in kept]
    changes = [(p != q).astype(jnp.int32) for p, q in zip(signs, signs[1:])]
    variations = sum(changes[1:], changes[0])
    weights = binomials(count - 1)
    least = ft.reduce(jnp.minimum, [x / w for x, w in zip(kept, weights)])
    largest = ft.reduce(jnp.maximum, [jnp.abs(x) / w for x, w in zip(kept, weights)])
    room = max(NEAR, 1e3 * float(jnp.finfo(a.dtype).eps)) * select(known > 0, largest, size)
    close, begun, free = (variations == 0) & ~(least > room), ~signs[0], kept[0] > 2 * room
    rows = _Look(variations, begun, close & ~free, close & free, variations > 1)
    event = variations > 0
    if corners:
        most = ft.reduce(jnp.maximum, [x / w for x, w in zip(kept, weights)])
        rows, event = _joined(rows, most < -room, free, corners)
    some = jnp.sum(event.astype(jnp.int32), axis=0)
    begun, near, late, many = (jnp.any(x, axis=0) for x in rows[1:])
    return _Look(rows.variations, begun, near, late, many | (some > 1))


def _joined(rows: _Look, below: Array, free: Array, corners: list[Corner]) -> tuple[_Look, Array]:
    """The same with what is true of joint guards together; and which rows stand for an event.

    They have none as long as one of them stays positive; where each that is positive at first falls once, they have one
    when the last does. `below`: which guards are clearly negative all along; `free`: clearly positive at the start.
    """
    both, either = ft.partial(ft.reduce, jnp.logical_and), ft.partial(ft.reduce, jnp.logical_or)
    out = [[x[r] for r in range(len(below))] for x in (*rows, rows.variations > 0)]
    for own, joint in corners:
        count, begun, near, late, _ = ([x[r] for r in own] for x in rows)
        clear, falls = ([(n == k) & ~x for n, x in zip(count, begun)] for k in (0, 1))
        never = [(n == 0) & x for n, x in zip(count, begun)]
        idle, over = either(clear), both(begun)
        event = ~idle & ~over & both([x | y for x, y in zip(falls, never)])
        close = idle & ~either([x & ~y & ~z for x, y, z in zip(clear, near, late)])
        close = close | (event & either([x & ~below[r] for x, r in zip(never, own)]))
        apart = either([free[r] for r in own])
        news = over, close & ~apart, close & apart, ~idle & ~over & ~event
        for n, r in enumerate(own):
            one = [(falls[n] & event).astype(count[n].dtype), *news, event & (n == 0)]
            for column, x in zip(out, one):
                column[r] = select(joint, x, column[r])
    *looks, event = map(jnp.stack, out)
    return _Look(*looks), event


def _halved(a: Array) -> Array:
    """The first half. (Each coefficient from those of the whole: by halves of halves XLA would compute these anew.)"""
    n = a.shape[1] - 1
    b = [a[:, j] / w for j, w in enumerate(binomials(n))]
    rows = [[w * 0.5**k for w in binomials(k)] for k in range(n + 1)]
    sums = (sum(w * x for w, x in zip(row[1:], b[1:])) + row[0] * b[0] for row in rows)
    return jnp.stack([w * x for w, x in zip(binomials(n), sums)], axis=1)


def isolate(
    a: Float[Array, "rows coefficients lanes"],
    known: Int[Array, "rows lanes"],
    missed: Array,
    wanted: Truths,
    corners: list[Corner],
) -> Isolated:
    """**Arguments:** the scaled Bernstein coefficients of the guards on the arc; how many roots each has at its start;
    what the polynomials may be off; which lanes have work; which guards belong together."""
    size = once(ft.reduce(jnp.maximum, [jnp.abs(a[:, j]) / w for j, w in enumerate(binomials(a.shape[1] - 1))]))
    rough = jnp.any(~(missed <= 1e-6 * size), axis=0)  # a guard that is NaN too
    look = ft.partial(_look, known=known, size=size, corners=corners)

    def busy(carry: tuple) -> Array:
        depth, *_, seen = carry
        return jnp.any((seen.many | seen.late) & ~seen.begun & wanted & ~rough) & (depth < DEPTH)

    def halve(carry: tuple) -> tuple:
        depth, a, share, seen = carry
        again = (seen.many | seen.late) & wanted
        a, share = select(again, _halved(a), a), select(again, 0.5 * share, share)
        return depth + 1, a, share, look(a)

    start = (jnp.zeros((), jnp.int32), a, jnp.ones_like(a[0, 0]), look(a))
    _, a, share, seen = lax.while_loop(busy, halve, start)
    doubtful = seen.many | seen.late | seen.begun | seen.near | rough
    return Isolated(share, a, seen.variations > 0, doubtful)


def last(
    found: Isolated, fires: Bool[Array, "rows lanes"], known: Int[Array, "rows lanes"], corners: list[Corner]
) -> tuple[Lanes, Bool[Array, "rows lanes"], Truths]:
    """Where the guard that `fires` falls, as a part of the arc; of those of a corner, which may be several, the last
    one. And which it is, and whether another one falls at the same place."""

    def chosen(x: Any, rows: Any) -> Array:
        return sum((select(fires[r], x[r], 0) for r in rows[1:]), select(fires[rows[0]], x[rows[0]], 0))

    a, every = found.coefficients, range(len(fires))
    if not corners:
        at = root(once(chosen(a, every)), chosen(known, every), jnp.any(fires, axis=0))
        return at, fires, jnp.zeros_like(found.doubtful)
    place = np.zeros(len(a), int)  # each of a corner has its own
    for rows, _ in corners:
        place[rows] = range(len(rows))
    groups = [np.flatnonzero(place == p) for p in range(place.max() + 1)]
    some = jnp.stack([ft.reduce(jnp.logical_or, [fires[r] for r in rows]) for rows in groups])
    stacked = once(jnp.stack([chosen(a, rows) for rows in groups], axis=1))
    roots = select(some, root(stacked, jnp.stack([chosen(known, rows) for rows in groups]), some), -1)
    at = ft.reduce(jnp.maximum, roots)
    late = [(x & (r > at - SOON)).astype(jnp.int32) for x, r in zip(some, roots)]
    return at, fires & (roots == at)[place], jnp.sum(jnp.stack(late), axis=0) > 1


def _horner(c: list[Array], x: Array) -> tuple[Array, Array, Array]:
    """Value, derivative and half the second derivative."""
    value = slope = bend = jnp.zeros_like(x)
    for a in reversed(c):
        value, slope, bend = value * x + a, slope * x + value, bend * x + slope
    return value, slope, bend


def root(a: Float[Array, "coefficients *lanes"], known: Int[Array, " *lanes"], wanted: Bool[Array, " *lanes"]) -> Array:
    """The only root on (0, 1] of polynomials with one sign variation, after those known at 0 have been divided out: by
    Halley's method from the eighth of the interval in which it is."""
    n = len(a) - 1
    signs = [select(known > j, 0, a[j]) if j < 3 else a[j] for j in range(n + 1)]
    late = once(sum(signs[1:], signs[0])) > 0
    shifted = [list(a), [*a[1:], *[0 * a[0]]], [*a[2:], *[0 * a[0]] * 2], [*a[3:], *[0 * a[0]] * 3]]
    early = [select(known == 0, p, select(known == 1, q, select(known == 2, r, s))) for p, q, r, s in zip(*shifted)]
    c = [select(late, -x, y) for x, y in zip(reversed(list(a)), early)]
    points = [j / 8 for j in range(5)]
    values = [once(sum(x * (u**j * (1 - u) ** (n - j)) for j, x in enumerate(c))) if u else c[0] for u in points]
    low, first, last = jnp.full_like(c[0], points[3]), values[3], values[4]
    for k in (2, 1, 0):
        here = values[k + 1] <= 0
        low, first, last = (
            select(here, x, y) for x, y in zip((points[k], values[k], values[k + 1]), (low, first, last))
        )
    low = once(low)
    u = once(low + 0.125 * jnp.clip(first / (first - last), 0, 1))
    before = u
    for _ in range(_HALLEY):
        w = 1 / (1 - u)
        value, slope, bend = _horner(c, u * w)
        slope, bend = w * (w * slope - n * value), w * w * (w * w * bend - (n - 1) * (w * slope - 0.5 * n * value))
        newton = value / slope
        ratio = newton * bend / slope
        new = u - newton / select(jnp.abs(ratio) < 0.5, 1 - ratio, 1)
        before, u = u, once(jnp.clip(new, low, low + 0.125))
    # The few that have not converged: by bisection.
    poor = wanted & ~(jnp.abs(u - before) < 1e-3)

    def bisect(carry: tuple) -> tuple:
        count, low, high = carry
        middle = 0.5 * (low + high)
        above = _horner(c, middle / (1 - middle))[0] > 0
        return count + 1, select(above, middle, low), select(above, high, middle)

    def again(u: Array) -> Array:
        start = (jnp.zeros((), jnp.int32), jnp.zeros_like(u), jnp.full_like(u, 0.5))
        return select(poor, lax.while_loop(lambda c: c[0] < 50, bisect, start)[2], u)

    u = lax.cond(jnp.any(poor), again, lambda u: u, u)
    return select(late, 1 - u, u)
