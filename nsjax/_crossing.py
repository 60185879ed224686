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

from ._once import once


UNROLLED = 3  # steps of Halley's method on a root before a loop takes over
DEPTH = 40  # bisections: closer roots than 2**-40 of a step are one (2**-30 where jax has no 64-bit integers)


def nodes(degree: int) -> np.ndarray:
    """Chebyshev-Lobatto nodes on [0, 1], ends included."""
    return 0.5 - 0.5 * np.cos(np.pi * np.arange(degree + 1) / max(degree, 1))


@ft.lru_cache
def to_bernstein(degree: int) -> np.ndarray:
    """Matrix from values at `nodes(degree)` to Bernstein coefficients."""
    x = nodes(degree)[:, None]
    j = np.arange(degree + 1)
    binomial = np.array([math.comb(degree, int(i)) for i in j])
    matrix = np.linalg.inv(binomial * x**j * (1 - x) ** (degree - j))
    matrix[0], matrix[-1] = np.eye(degree + 1)[0], np.eye(degree + 1)[-1]
    return matrix


@ft.lru_cache
def to_chebyshev(degree: int) -> np.ndarray:
    """Matrix from values at `nodes(degree)` to Chebyshev coefficients, whose last ones tell the resolution."""
    return np.linalg.inv(np.polynomial.chebyshev.chebvander(2 * nodes(degree) - 1, degree))


def deflate(c: Float[Array, "... coefficients"], roots: Int[Array, "..."]) -> Float[Array, "... coefficients"]:
    """Divides by τ up to three times (`roots` of them), keeping the degree: takes out known roots at τ = 0."""
    n = c.shape[-1] - 1
    j = np.arange(n + 1)

    def divided(c: Array) -> Array:
        # τ B_{j-1}^{n-1} = (j/n) B_j^n, so q = c_j n/j of degree n-1; then elevated to degree n.
        q = c[..., 1:] * jnp.asarray(n / j[1:], c.dtype)
        lower = jnp.concatenate([q[..., :1], q], axis=-1)
        upper = jnp.concatenate([q, q[..., -1:]], axis=-1)
        up = jnp.asarray(j / n, c.dtype)
        return up * lower + (1 - up) * upper

    first = divided(c)
    second = divided(first)
    roots = roots[..., None]
    # Dividing twice a polynomial of degree n = 1 leaves only the slope, which is what dividing it again gives.
    # A second root within rounding of the first cannot be told from a double one.
    double = jnp.abs(first[..., :1]) <= 1e-10 * jnp.max(jnp.abs(first), axis=-1, keepdims=True)
    many = jnp.where(roots == 3, divided(second), second)
    return jnp.where(roots == 0, c, jnp.where((roots == 1) & ~double, first, many))


@ft.lru_cache
def elevate(degree: int, to: int) -> np.ndarray:
    """Matrix that raises the degree of a polynomial in Bernstein form."""
    matrix = np.eye(degree + 1)
    for n in range(degree + 1, to + 1):
        j = np.arange(n + 1)[:, None] / n
        padded = np.zeros((n + 2, degree + 1))
        padded[1:-1] = matrix
        matrix = j * padded[:-1] + (1 - j) * padded[1:]
    return matrix


def bend(c: Float[Array, " coefficients"], u: Scalar) -> Scalar:
    """The second derivative at `u` (which may be a little outside of [0, 1]), up to a positive factor."""
    c = c[2:] - 2 * c[1:-1] + c[:-2]
    while c.shape[0] > 1:
        c = (1 - u) * c[:-1] + u * c[1:]
    return c[0] if c.shape[0] else jnp.zeros_like(u)


def no_root(c: Float[Array, "... parts coefficients"]) -> Bool[Array, "..."]:
    """Whether the maximum over the parts is certainly positive on the whole step."""
    return jnp.any(jnp.all(c > 0, axis=-1), axis=-1)


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


def _polish(c: Float[Array, " coefficients"]) -> Scalar:
    """The one root on [0, 1] of a polynomial with c[0] > 0 >= c[-1]: Halley's method kept inside the bracket.

    The first steps are unrolled, being all that most roots need; for the others a loop goes on.
    """
    n = c.shape[-1] - 1
    differences = [c[j] for j in range(n + 1)]
    powers = []
    for j in range(n + 1):
        powers.append(once(math.comb(n, j) * differences[0]))
        differences = [b - a for a, b in zip(differences[:-1], differences[1:])]
    eps = jnp.finfo(c.dtype).eps

    def improve(state: tuple) -> tuple:
        low, high, u, done, count = state
        value = slope = bend = jnp.zeros_like(u)  # with half the second derivative
        for a in reversed(powers):
            value, slope, bend = value * u + a, slope * u + value, bend * u + slope
        low = jnp.where(value > 0, u, low)
        high = jnp.where(value > 0, high, u)
        newton = value / slope
        ratio = newton * bend / slope  # of the curvature to the slope over the way that is left
        step = newton / (1 - ratio)
        guess = u - step
        inside = (guess >= low) & (guess <= high) & (slope < 0)  # it is a root downwards
        # Where the curvature rules (near a double root) Halley's steps are short without being good. Every third step
        # bisects, unless Halley has all but halted: a flat polynomial cannot stall the search.
        step, ratio = jnp.abs(step), jnp.abs(ratio)
        trusted = inside & (ratio <= 0.5) & ((count % 3 != 2) | (step < 1e-2))
        exact = (value == 0) & (slope < 0)
        new = jnp.where(done | exact, u, jnp.where(trusted, guess, 0.5 * (low + high)))
        # The error that is left is the step times the square of the ratio.
        done = done | exact | (trusted & (ratio * ratio * step <= eps)) | (high - low <= 4 * eps)
        return low, high, once(new), done, count + 1

    def busy(state: tuple) -> Bool[Array, ""]:
        *_, done, count = state
        return ~done & (count < 100)

    # A root at the very end is no place to start: an earlier one may be meant, and there the sign is rounding.
    secant = c[0] / (c[0] - c[-1])
    guess = once(jnp.where(secant < 0.99, secant, 0.5))
    state = (jnp.zeros_like(guess), jnp.ones_like(guess), guess, jnp.zeros((), bool), jnp.zeros((), jnp.int32))
    for _ in range(UNROLLED):
        state = improve(state)
    return jax.lax.while_loop(busy, improve, state)[2]


def first_root(c: Float[Array, "parts coefficients"]) -> tuple[Bool[Array, ""], Scalar]:
    """The earliest τ in [0, 1] at which the maximum of the polynomials over the parts is no longer positive.

    Walks through dyadic intervals from the left: one without a root is passed, one with exactly one is done, any other
    is halved. A root that so many halvings do not separate from its neighbour (a double root) is reported where it is.

    **Arguments:**

    - `c`: Bernstein coefficients on the step.

    **Returns:** whether there is one, and its place (1 if there is none).
    """
    one, zero = jnp.ones((), c.dtype), jnp.zeros((), jnp.result_type(int))
    wide = zero.dtype == jnp.int64
    depth = DEPTH if wide else 30

    def look(local: Array, level: Array) -> tuple[Bool[Array, ""], Bool[Array, ""]]:
        """Whether an interval has no root, and whether it has one that need not be isolated further."""
        positive = local > 0
        variations = jnp.sum(positive[:, 1:] != positive[:, :-1], axis=-1)
        single = (variations == 1) & positive[:, 0]
        others_negative = jnp.sum(jnp.any(positive, axis=-1)) == 1
        begun = ~jnp.any(positive[:, 0])
        return no_root(local), begun | (jnp.any(single) & others_negative) | (level >= depth)

    def busy(state: tuple) -> Bool[Array, ""]:
        _, _, _, free, sure, over = state
        return ~over & (free | ~sure)

    def walk(state: tuple) -> tuple:
        level, index, _, free, _, _ = state
        # Past an interval without a root: the next one, at the coarsest level that starts there.
        after = index + 1
        up = jnp.zeros_like(level)
        moved = after
        for shift in (32, 16, 8, 4, 2, 1)[0 if wide else 1 :]:
            even = (moved & ((1 << shift) - 1)) == 0
            up = up + jnp.where(even, shift, 0)
            moved = jnp.where(even, moved >> shift, moved)
        up = jnp.minimum(up, level)
        over = free & ((after >> level) == 1)
        level, index = jnp.where(free, level - up, level + 1), jnp.where(free, after >> up, 2 * index)
        a, width = index.astype(c.dtype), 0.5 ** level.astype(c.dtype)
        local = jnp.where(level == 0, c, _restrict(c, a * width, (a + 1) * width))
        return level, index, local, *look(local, level), over

    free, sure = look(c, zero)
    level, index, local, free, _, over = jax.lax.while_loop(busy, walk, (zero, zero, c, free, sure, free))
    found = ~over & ~free
    positive = local > 0
    begun = ~jnp.any(positive[:, 0])
    part = jnp.argmax(positive[:, 0] & ~positive[:, -1])
    chosen = local[part] if local.shape[0] > 1 else local[0]
    polished = found & (chosen[0] > 0) & (chosen[-1] <= 0)
    safe = jnp.where(polished, chosen, jnp.asarray(np.linspace(1, -1, c.shape[-1]), c.dtype))
    place = jnp.where(polished, _polish(safe), jnp.where(begun, 0.0, 0.5))
    root = (index.astype(c.dtype) + place) * 0.5 ** level.astype(c.dtype)
    return found, jnp.where(found, root, one)
