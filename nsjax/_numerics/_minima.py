"""The least values that functions take along a smooth path, wherever and however often they turn.

The path is followed in pieces, each so short that the polynomials through its Chebyshev points stand for all
functions: the last coefficients of their Chebyshev series tell. Where one is not resolved the piece is halved, unless
it cannot be as low there as elsewhere. Of a polynomial every dip that may be the lowest is followed to its bottom.
"""

import functools as ft
from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import jax.lax as lax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from .._types import Scalar
from ._barrier import once
from ._select import select


NODES = 40  # parts of a piece: they resolve a phase of 7.6, somewhat more than a period
# Chebyshev's points, denser at both ends, and the weights of integrals over them (Clenshaw and Curtis).
THETA = 0.5 - 0.5 * np.cos(np.pi * np.arange(NODES + 1) / NODES)
_moments = [0.0 if k % 2 else 1 / (1 - k**2) for k in range(NODES + 1)]
WEIGHTS = np.linalg.solve(np.polynomial.chebyshev.chebvander(2 * THETA - 1, NODES).T, _moments)

RESOLVED = 1e-10  # the part of its largest value by which a polynomial may miss a function
MARGIN = 8.0  # an unresolved function is lower than at its nodes by at most this many times what may be missed
CALM = 1e-2  # of what may be missed: after a piece that misses less the next is twice as long
SHORTEST = 2.0**-14  # of the path: a kink is not resolved by any polynomial
BESIDE = 6e-4  # of the path: nearer to a zero a function divided by it is rounding divided by little
REFINEMENTS = 5  # of Newton's method, each of which doubles the digits
NARROWINGS = 16  # of a dip in which parts meet, to a third each

# θ = (1 - cos φ) / 2: in φ the polynomials are cosine series, and the nodes are equally spaced.
_SPACING = np.pi / NODES
_PHI = _SPACING * np.arange(NODES + 1)
_SERIES = np.linalg.inv(np.cos(np.outer(_PHI, np.arange(NODES + 1))))
# The coefficients that must vanish, so that there are two nodes and more for each half wave and no dip hides between
# them.
_TAIL = _SERIES[NODES // 2 - 3 :]
_BARYCENTRIC = (-1.0) ** np.arange(NODES + 1) * np.where(np.arange(NODES + 1) % NODES == 0, 0.5, 1)
_LOCAL = np.arange(-5, 6)  # nodes through which a dip is a polynomial
_TO_POWERS = np.linalg.inv(np.vander(_LOCAL, increasing=True))


class Minima(NamedTuple):
    """Of each function along a path.

    - `least`: its least value, shape `(functions,)`; `share`: at which share of the way; `x`: the state there.
    - `most`: the largest value at the nodes.
    - `sums`: what `sample` added up.
    - `ts`, `xs`: times and states at the nodes `THETA` of the whole path.
    """

    least: Float[Array, " functions"]
    share: Float[Array, " functions"]
    x: Float[Array, "functions n"]
    most: Float[Array, " functions"]
    sums: Any
    ts: Float[Array, " nodes"]
    xs: Float[Array, "nodes n"]


class _Walk(NamedTuple):
    begin: Scalar  # of the next piece, as a share of the path
    width: Scalar
    x: Array  # the state there
    seen: Array  # the least values at any nodes
    minima: Minima


def minima(
    sample: Callable[[Scalar, Scalar, Array], tuple[Array, Array, Any]],
    functions: Callable[[Array, Array], tuple[list[Array], Array]],
    x: Float[Array, " n"],
    orders: Float[Array, "2 functions"],
    below: Callable[[Array], Array] = lambda most: jnp.full_like(most, jnp.inf),
    sums: Any = (),
) -> Minima:
    """Follows functions along a path. It is not to be differentiated.

    **Arguments:**

    - `sample`: from two shares of the path and the state at the first, the times and states at the nodes between them,
        and quantities that add up over pieces.
    - `functions`: from times and states at nodes the functions' values, in groups of shape `(functions, parts, nodes)`,
        each the largest of its parts, which are smooth; and how much of each does not matter, shape `(functions,)`:
        what the errors of the states make of it.
    - `x`: the state at the beginning.
    - `orders`: of the zeros that each function must have at both ends, by which it is divided.
    - `below`: what is higher is not looked at between nodes.
    - `sums`: what the quantities that add up begin with, as a rule zeros.
    """
    row, ts = jnp.zeros(orders.shape[1], x.dtype), jnp.zeros(NODES + 1, x.dtype)
    xs, top = jnp.zeros((NODES + 1, *x.shape), x.dtype), jnp.full_like(row, jnp.inf)
    blank = Minima(top, jnp.zeros_like(row), jnp.zeros((*row.shape, *x.shape), x.dtype), -top, sums, ts, xs)
    start = _Walk(jnp.zeros_like(x[0]), jnp.ones_like(x[0]), x, top, blank)

    def step(walk: _Walk) -> _Walk:
        end = walk.begin + walk.width
        ts, xs, sums = once(sample(walk.begin, end, walk.x))
        groups, slack = once(functions(ts, xs))
        whole = jnp.concatenate([jnp.max(values, axis=1) for values in groups])
        missed = jnp.concatenate([_missed(values) for values in groups])
        low, most = jnp.min(whole, axis=1), jnp.maximum(walk.minima.most, jnp.max(whole, axis=1))
        seen = jnp.minimum(walk.seen, low)
        allowed = RESOLVED * jnp.max(jnp.abs(whole), axis=1) + slack
        # What stays higher than what is known need not be resolved: a guard that is sharp far from zero would halve
        # piece after piece. (Divided by its zeros it is another function, which this bound says nothing of.)
        undivided = (orders[0] == 0) & (orders[1] == 0)
        too_high = undivided & (low - MARGIN * missed > seen)
        rough = jnp.any((missed > allowed) & ~too_high) & (walk.width > SHORTEST)

        first, found = 0, []
        for values in groups:
            part = slice(first, first := first + len(values))
            lowest = jax.vmap(ft.partial(_lowest, walk.begin, walk.width), in_axes=(0, 1, 0))
            found.append(lowest(values, orders[:, part], below(most)[part]))
        least, phi = (jnp.concatenate(column) for column in zip(*found))
        states = jax.vmap(lambda phi: _interpolated(xs.T, phi))(phi)
        share = walk.begin + walk.width * _theta(phi)
        old = walk.minima
        lower = ~rough & ((least < old.least) | jnp.isnan(least))  # what cannot be told is not told wrong
        first = walk.width == 1
        found = Minima(
            least=select(lower, least, old.least),
            share=select(lower, share, old.share),
            x=select(lower[:, None], states, old.x),
            most=most,
            sums=jax.tree.map(lambda a, b: a + select(rough, 0, b), old.sums, sums),
            ts=select(first, ts, old.ts),
            xs=select(first, xs, old.xs),
        )
        begin = select(rough, walk.begin, end)
        calm = jnp.all((missed <= CALM * allowed) | too_high)
        width = walk.width * select(rough, 0.5, select(calm, 2, 1))
        x_next = select(rough, walk.x, xs[-1])
        return _Walk(begin, jnp.minimum(width, 1 - begin), x_next, seen, found)

    # (A function that is NaN counts as resolved, so that the walk ends. The second condition follows from the first:
    # of a loop whose condition depends on one number alone, XLA would look for a count of the turns, which takes long.)
    return lax.while_loop(lambda walk: (walk.begin < 1) & (walk.width > 0), step, start).minima


def places_of(rows: list[list[Any]]) -> np.ndarray:
    """In which order functions `[function][part]` stand in groups of as many parts."""
    return np.argsort([len(row) for row in rows], kind="stable")


def grouped(rows: list[list[Array]]) -> list[Array]:
    """Functions `[function][part]` of times, in groups of as many parts."""
    groups = []
    for count in sorted({len(row) for row in rows}):
        groups.append(jnp.stack([jnp.stack(row) for row in rows if len(row) == count]))
    return groups


def in_order(found: Minima, places: np.ndarray) -> Minima:
    """The same, but of the functions in the order in which they were grouped."""
    back = np.argsort(places)
    return found._replace(**{name: getattr(found, name)[back] for name in ("least", "share", "x", "most")})


def _theta(phi: Array) -> Array:
    return 0.5 - 0.5 * jnp.cos(phi)


def divided(values: Array, share: Array, orders: Array) -> Array:
    """By zeros at both ends, of these orders; infinite right beside them."""
    below, beside = jnp.ones_like(share), jnp.zeros(share.shape, bool)
    for order, s in ((orders[0], share), (orders[1], 1 - share)):
        below = below * select(order == 0, 1, select(order == 1, s, select(order == 2, s**2, s**3)))
        beside = beside | ((order > 0) & (s < BESIDE))
    beside = beside | (below < 1e-9)
    return select(beside, jnp.inf, values / select(beside, 1, below))


def _interpolated(values: Float[Array, "parts nodes"], phi: Scalar) -> Float[Array, " parts"]:
    """The polynomials through the values at the nodes, by the barycentric formula."""
    off = jnp.cos(phi) - jnp.asarray(np.cos(_PHI), phi.dtype)
    weights = jnp.asarray(_BARYCENTRIC, phi.dtype) / select(off == 0, 1, off)
    weights = select(jnp.any(off == 0), (off == 0).astype(phi.dtype), weights)
    return values @ weights / jnp.sum(weights)


def _missed(values: Float[Array, "functions parts nodes"]) -> Float[Array, " functions"]:
    """The last coefficients, which tell what the polynomials of a function miss."""
    return jnp.max(jnp.abs(values @ jnp.asarray(_TAIL.T, values.dtype)), axis=(1, 2))


def _least(x: Float[Array, " n"]) -> tuple[Scalar, Array]:
    """The least number, and where it is first. (XLA's own search for the place is slow on CPUs.)"""
    least, index = jnp.min(x), jnp.arange(len(x), dtype=jnp.int32)
    return least, jnp.min(select(x == least, index, len(x) - 1))


def _beside(d: Float[Array, "3"]) -> Scalar:
    """How much lower than at an end it may be between there and the next node: a + b u² + c u⁴ through three nodes."""
    first, second = d[1] - d[0], d[2] - d[0]
    c = (second - 4 * first) / 12
    b = jnp.minimum(first - c, 0)
    return select(jnp.isfinite(second) & (c > 0), b**2 / select(c > 0, 2 * c, 1), 0)


def _lowest(
    begin: Scalar, width: Scalar, values: Float[Array, "parts nodes"], orders: Float[Array, "2"], below: Scalar
) -> tuple[Scalar, Scalar]:
    """The least value of a function on a piece, and at which φ."""
    several = len(values) > 1

    def whole(parts: Array, phi: Array) -> Array:
        value = jnp.max(parts, axis=-1) if several else parts[..., 0]
        return divided(value, begin + width * _theta(phi), orders)

    d = whole(values.T, jnp.asarray(_PHI, values.dtype))
    edge = jnp.full((1,), jnp.inf, d.dtype)
    before, after = jnp.concatenate([edge, d[:-1]]), jnp.concatenate([d[1:], edge])
    dip = (d <= before) & (d <= after) & jnp.isfinite(d)
    left, right = (select(jnp.isfinite(side), side - d, 0) for side in (before, after))
    inside = jnp.isfinite(before) & jnp.isfinite(after)
    bend = select(inside, left + right, 1)
    # Twice as deep as the parabola's, for half waves of two nodes.
    depth = select(inside, (right - left) ** 2 / select(bend > 0, 4 * bend, 1) + 0.05 * bend, (left + right) / 2)
    depth = depth.at[0].add(_beside(d[:3])).at[-1].add(_beside(d[:-4:-1]))
    bound = select(dip, d - depth, jnp.inf)
    bound = select(bound < below, bound, jnp.inf)
    rounding = 64 * jnp.finfo(d.dtype).eps * jnp.max(jnp.abs(select(jnp.isfinite(d), d, 0)))

    def bottom(i: Array) -> Scalar:
        """Where a dip is lowest, by polynomials for its parts."""
        near = jnp.abs(i + jnp.asarray(_LOCAL, i.dtype))  # (both ends are mirrors)
        here = i.astype(d.dtype)
        local = jnp.asarray(_TO_POWERS, d.dtype) @ values.T[NODES - jnp.abs(NODES - near)]
        low = select(jnp.isfinite(before[i]), -1.0, 0.0).astype(d.dtype)
        high = select(jnp.isfinite(after[i]), 1.0, 0.0).astype(d.dtype)
        at_end, inwards = (i == 0) | (i == NODES), select(i == 0, 1, -1)

        def at(u: Array) -> Array:
            parts = ft.reduce(lambda total, c: total * u[..., None] + c, local[::-1])
            return whole(parts, (here + u) * _SPACING)

        def slope(u: Scalar) -> Scalar:
            return jax.jvp(at, (u,), (jnp.ones_like(u),))[1]

        def refine(_: Any, u: Scalar) -> Scalar:
            rate, bend = jax.jvp(slope, (u,), (jnp.ones_like(u),))
            new = jnp.clip(u - select(bend > 0, rate / select(bend > 0, bend, 1), 0), low, high)
            # About an end it is even in u, which hides a dip beside it: a function of u², with these derivatives.
            safe = select(at_end, u, 1)
            rate, bend = rate / (2 * safe), (bend - rate / safe) / (4 * safe**2)
            square = jnp.clip(u**2 - select(bend > 0, rate / select(bend > 0, bend, 1), 0), 1e-8, 1)
            return select(at_end, inwards * jnp.sqrt(square), new)

        def narrow(_: Any, window: tuple[Scalar, Scalar]) -> tuple[Scalar, Scalar]:
            points = jnp.linspace(*window, 7, dtype=d.dtype)
            j = jnp.argmin(at(points))
            return points[jnp.maximum(j - 1, 0)], points[jnp.minimum(j + 1, 6)]

        if several:  # where two parts meet it has a kink
            u = 0.5 * sum(lax.fori_loop(0, NARROWINGS, narrow, (low, high)))
        else:
            u = lax.fori_loop(0, REFINEMENTS, refine, select(at_end, 0.5 * inwards, 0).astype(d.dtype))
        return (here + u) * _SPACING

    def deepen(state: tuple) -> tuple:
        least, place, next_bound, i = state
        phi = bottom(i)
        value = whole(_interpolated(values, phi), phi)
        lower = value < least
        # (Dips with the same bound, to the last digit, are those of a symmetry.)
        rest = select(bound > next_bound, bound, jnp.inf)
        return select(lower, value, least), select(lower, phi, place), *_least(rest)

    def deeper(state: tuple) -> Array:
        least, _, next_bound, _ = state
        return next_bound < least - rounding

    least, i = _least(d)
    start = least, i.astype(d.dtype) * _SPACING, *_least(bound)
    return lax.while_loop(deeper, deepen, start)[:2]
