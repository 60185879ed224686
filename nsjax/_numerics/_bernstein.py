"""The first root of a polynomial guard on a step, by sign variations of its Bernstein coefficients.

A sign test at the two ends of a step misses pairs of roots. The number of sign variations of the Bernstein
coefficients bounds the number of roots from above (Descartes), is exact when 0 or 1, and becomes so by subdivision, so
that each root is isolated or excluded.
"""

import functools as ft
import math

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int, Scalar

from ._barrier import once
from ._select import select


UNROLLED = 3  # steps of Halley's method on a root before a loop takes over
DEPTH = 40  # bisections: closer roots than 2**-40 of a step are one (2**-30 where jax has no 64-bit integers)


def nodes(degree: int, even: bool = False) -> np.ndarray:
    """Chebyshev-Lobatto nodes on [0, 1], or equally spaced ones, ends included."""
    j = np.arange(degree + 1) / max(degree, 1)
    return j if even else 0.5 - 0.5 * np.cos(np.pi * j)


@ft.lru_cache
def to_bernstein(degree: int, even: bool = False) -> np.ndarray:
    """Matrix from values at `nodes(degree, even)` to Bernstein coefficients."""
    x = nodes(degree, even)[:, None]
    j = np.arange(degree + 1)
    binomial = np.array([math.comb(degree, int(i)) for i in j])
    matrix = np.linalg.inv(binomial * x**j * (1 - x) ** (degree - j))
    matrix[0], matrix[-1] = np.eye(degree + 1)[0], np.eye(degree + 1)[-1]
    return matrix


@ft.lru_cache
def to_chebyshev(degree: int, even: bool = False) -> np.ndarray:
    """Matrix from values at `nodes(degree, even)` to Chebyshev coefficients, whose last ones tell the resolution."""
    return np.linalg.inv(np.polynomial.chebyshev.chebvander(2 * nodes(degree, even) - 1, degree))


# Below a polynomial is the list of its coefficients a_j in Σ a_j u^j (1 - u)^(n - j), its Bernstein coefficients times
# the binomials: they have the same signs, dividing by u shifts them, and Horner's scheme in u / (1 - u) evaluates them.
# A list, since XLA's CPU code for arrays whose last axis counts coefficients is not vectorised over lanes.


def binomials(n: int) -> list[float]:
    return [float(math.comb(n, j)) for j in range(n + 1)]


def _divided(a: list[Array]) -> list[Array]:
    """Divided by u, and raised to the same degree again."""
    return [a[1], *[x + y for x, y in zip(a[2:], a[1:-1])], a[-1]]


def deflate(a: list[Array], roots: Int[Array, "..."]) -> list[Array]:
    """Divides by u up to three times (`roots` of them), keeping the degree: takes out known roots at u = 0."""
    first = _divided(a)
    second = _divided(first)
    # A second root within rounding of the first cannot be told from a double one.
    double = jnp.abs(first[0]) <= 1e-10 * once(largest(first))
    third = roots == 3
    many = [select(third, x, y) for x, y in zip(_divided(second), second)]
    none, simple = roots == 0, (roots == 1) & ~double
    return once([select(none, x, select(simple, y, z)) for x, y, z in zip(a, first, many)])


def largest(a: list[Array]) -> Array:
    """The largest absolute value among the Bernstein coefficients, a bound of the polynomial on [0, 1]."""
    return ft.reduce(jnp.maximum, [jnp.abs(x) / w for x, w in zip(a, binomials(len(a) - 1))])


def lowest(a: list[Array]) -> Array:
    """The least among the Bernstein coefficients, a lower bound of the polynomial on [0, 1]."""
    return ft.reduce(jnp.minimum, [x / w for x, w in zip(a, binomials(len(a) - 1))])


def _horner(a: list[Array], x: Array) -> Array:
    return ft.reduce(lambda value, c: value * x + c, a[::-1])


def bend(a: list[Array], u: Scalar) -> Scalar:
    """The second derivative at `u` (which may be a little outside of [0, 1])."""
    n = len(a) - 1
    if n < 2:
        return jnp.zeros_like(u)
    c = [x / w for x, w in zip(a, binomials(n))]
    c = [w * (z - 2 * y + x) for w, x, y, z in zip(binomials(n - 2), c, c[1:], c[2:])]
    early = u < 0.5
    c = [select(early, x, y) for x, y in zip(c, c[::-1])]
    far = select(early, 1 - u, u)
    return n * (n - 1) * far ** (n - 2) * _horner(c, select(early, u, 1 - u) / far)


def at(a: list[Array], u: Array) -> Array:
    """The values at `u`, one for each row."""
    u = u.reshape(u.shape + (1,) * (a[0].ndim - u.ndim))
    n = len(a) - 1
    return sum((x * u**j * (1 - u) ** (n - j) for j, x in enumerate(a[1:], 1)), a[0] * (1 - u) ** n)


def falls(a: list[Array]) -> list[Array]:
    """The derivative with its sign changed, as a polynomial of the same degree: its first root is a least value."""
    n = len(a) - 1
    c = [x / w for x, w in zip(a, binomials(n))]
    d = [w * (x - y) for w, x, y in zip(binomials(n - 1), c, c[1:])]
    return [d[0], *[x + y for x, y in zip(d, d[1:])], d[-1]]


def no_root(a: list[Array]) -> Bool[Array, "..."]:
    """Whether the maximum over the parts (the last axis) is certainly positive on the whole step."""
    return jnp.any(ft.reduce(jnp.minimum, a) > 0, axis=-1)


def _restrict(c: Float[Array, "parts coefficients"], a: Scalar, b: Scalar) -> Float[Array, "parts coefficients"]:
    """Bernstein coefficients on [a, b] of the polynomial given on [0, 1], by de Casteljau's scheme."""
    n = c.shape[-1] - 1

    def left(c: Array, u: Scalar) -> Array:
        out = [c[..., 0]]
        for _ in range(n):
            c = c[..., :-1] + u * (c[..., 1:] - c[..., :-1])
            out.append(c[..., 0])
        return jnp.stack(out, axis=-1)

    head = left(c, b)  # on [0, b]
    return left(head[..., ::-1], 1 - a / b)[..., ::-1]


def _polish(a: list[Scalar], wanted: Bool[Array, ""]) -> Scalar:
    """The one root on [0, 1] of a polynomial with a[0] > 0 >= a[-1], if it is `wanted`: Halley's method in u, or from
    the other end in 1 - u, kept inside the bracket [0, 1/2].

    The first steps are unrolled, being all that most roots need; for the others a loop goes on.
    """
    late = once(sum(a[1:], a[0])) > 0
    a = [once(select(late, -y, x)) for x, y in zip(a, a[::-1])]
    n, eps = len(a) - 1, jnp.finfo(a[0].dtype).eps

    def improve(state: tuple) -> tuple:
        low, high, u, done, count = state
        w = 1 / (1 - u)
        x = u * w
        value = slope = bend = jnp.zeros_like(u)  # by x, with half the second derivative
        for c in reversed(a):
            value, slope, bend = value * x + c, slope * x + value, bend * x + slope
        # The same by u, up to the factor w^n.
        slope, bend = w * (w * slope - n * value), w * w * (w * w * bend - (n - 1) * (w * slope - 0.5 * n * value))
        low = select(value > 0, u, low)
        high = select(value > 0, high, u)
        newton = value / slope
        ratio = newton * bend / slope  # of the curvature to the slope over the way that is left
        step = newton / (1 - ratio)
        guess = u - step
        inside = (guess >= low) & (guess <= high) & (slope < 0)  # it is a root downwards
        # Where the curvature rules (near a double root) Halley's steps are short without being good. Every third step
        # bisects, unless Halley has almost stopped: a flat polynomial cannot stall the search.
        step, ratio = jnp.abs(step), jnp.abs(ratio)
        trusted = inside & (ratio <= 0.5) & ((count % 3 != 2) | (step < 1e-2))
        exact = (value == 0) & (slope < 0)
        new = select(done | exact, u, select(trusted, guess, 0.5 * (low + high)))
        # The error that is left is the step times the square of the ratio, and where the curvature vanishes times that
        # of the step, by the third derivative.
        rest = (ratio * ratio + (n * step) ** 2) * step
        done = done | exact | (trusted & (rest <= eps)) | (high - low <= 4 * eps)
        return low, high, once(new), done, count + 1

    def busy(state: tuple) -> Bool[Array, ""]:
        *_, done, count = state
        return ~done & (count < 100)

    # A root at the very end is no place to start: an earlier one may be meant, and there the sign is rounding.
    secant = 0.5 * a[0] / (a[0] - 0.5**n * sum(a[1:], a[0]))
    guess = once(select(secant > 0.005, secant, 0.25))
    state = (jnp.zeros_like(guess), jnp.full_like(guess, 0.5), guess, ~wanted, jnp.zeros((), jnp.int32))
    for _ in range(UNROLLED):
        state = improve(state)
    u = jax.lax.while_loop(busy, improve, state)[2]
    return select(late, 1 - u, u)


def first_root(a: list[Float[Array, " parts"]]) -> tuple[Bool[Array, ""], Scalar]:
    """The earliest u in [0, 1] at which the maximum of the polynomials over the parts is no longer positive.

    Walks through dyadic intervals from the left: one without a root is passed, one with exactly one is done, any other
    is halved. A root that these halvings do not separate from its neighbour (a double root) is reported where it is.

    **Returns:** whether there is one, and its place (1 if there is none).
    """
    n, dtype = len(a) - 1, a[0].dtype
    one, zero = jnp.ones((), dtype), jnp.zeros((), jnp.result_type(int))
    wide = zero.dtype == jnp.int64
    depth = DEPTH if wide else 30

    def look(local: list[Array], level: Array) -> tuple[Bool[Array, ""], Bool[Array, ""]]:
        """Whether an interval has no root, and whether it has one that need not be isolated further."""
        positive = [x > 0 for x in local]
        variations = sum((p != q).astype(jnp.int32) for p, q in zip(positive, positive[1:]))
        # Where each part falls once, or is not positive at all, the maximum falls where the last of them does.
        falls_once = (variations == 1) & positive[0]
        never = ~ft.reduce(jnp.logical_or, positive)
        begun = ~jnp.any(positive[0])
        return no_root(local), begun | (jnp.any(falls_once) & jnp.all(falls_once | never)) | (level >= depth)

    def busy(state: tuple) -> Bool[Array, ""]:
        _, _, _, free, sure, over = state
        return ~over & (free | ~sure)

    # No stack of intervals, which in a batch would have room for the deepest lane: two integers tell which interval is
    # next, and its coefficients are made from those of the whole step, so that rounding does not add up over levels.
    def walk(state: tuple) -> tuple:
        level, index, _, free, _, _ = state
        # Past an interval without a root: the next one, at the coarsest level that starts there.
        after = index + 1
        up = jnp.zeros_like(level)
        moved = after
        for shift in (32, 16, 8, 4, 2, 1)[0 if wide else 1 :]:
            even = (moved & ((1 << shift) - 1)) == 0
            up = up + select(even, shift, 0)
            moved = select(even, moved >> shift, moved)
        up = jnp.minimum(up, level)
        over = free & ((after >> level) == 1)
        level, index = select(free, level - up, level + 1), select(free, after >> up, 2 * index)
        start, width = index.astype(dtype), 0.5 ** level.astype(dtype)
        weights = jnp.asarray(binomials(n), dtype)
        local = _restrict(jnp.stack(a, axis=-1) / weights, start * width, (start + 1) * width) * weights
        local = [select(level == 0, x, local[:, j]) for j, x in enumerate(a)]
        return level, index, local, *look(local, level), over

    free, sure = look(a, zero)
    level, index, local, free, _, over = jax.lax.while_loop(busy, walk, (zero, zero, a, free, sure, free))
    found = ~over & ~free
    begun = ~jnp.any(local[0] > 0)
    falling = found & (local[0] > 0) & (local[-1] <= 0)
    # (Of one part a `vmap` would only add axes.)
    places = jax.vmap(_polish)(local, falling) if len(falling) > 1 else _polish([x[0] for x in local], falling[0])
    last = jnp.max(select(falling, places, 0.0))
    place = select(jnp.any(falling), last, select(begun, 0.0, 0.5))
    root = (index.astype(dtype) + place) * 0.5 ** level.astype(dtype)
    return found, select(found, root, one)


FEW = 4  # polynomials looked at together, of many
DENSE = 24  # up to so many all are looked at: two for each guard, see `locate`


def first_roots(a: list[Float[Array, "polynomials parts"]]) -> tuple[Bool[Array, " polynomials"], Array]:
    """`first_root` of each of them. Of many, most are positive all along, and only the others are looked at."""
    count = len(a[0])
    if count <= DENSE:
        return jax.vmap(first_root)(a)
    busy = ~no_root(a)
    order = -jnp.arange(count, dtype=jnp.float32)

    def look(carry: tuple) -> tuple:
        left, found, root = carry
        key, place = jax.lax.top_k(select(left, order, -jnp.inf), FEW)  # the first ones that are left
        new = jax.vmap(first_root)([x.at[place].get(mode="clip") for x in a])
        place = select(key > -jnp.inf, place, count)  # what is none of them is dropped
        left, found, root = (x.at[place].set(y, mode="drop") for x, y in zip(carry, (False, *new)))
        return left, found, root

    start = (busy, jnp.zeros(count, bool), jnp.ones(count, a[0].dtype))
    return jax.lax.while_loop(lambda carry: jnp.any(carry[0]), look, start)[1:]
