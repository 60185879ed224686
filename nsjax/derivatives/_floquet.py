"""Floquet multipliers: the eigenvalues of a product of many matrices, along the arcs of an orbit and at its events."""

from typing import Any

import jax
import jax.lax as lax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Complex, Float, Int

from .._numerics._lapack import eig, inv, qr, solve
from .._numerics._select import select
from ..system._system import System


LAPS = 8  # of orthogonal iteration: multipliers farther apart than a factor of forty are told apart to all digits


def structural_zeros(system: System, modes: Int[Array, "arcs switches"]) -> Int[Array, ""]:
    """How many multipliers vanish because the solution is held on surfaces: each that slides takes one dimension of the
    perturbations, each contact that rests two, and what is lost on one arc of the orbit is lost for all."""
    lost = jnp.zeros(len(modes), jnp.int32)
    for k, switch in enumerate(system.switches):
        if switch.order:
            lost += select(modes[:, k] == switch.holding, switch.order, 0).astype(lost.dtype)
    return jnp.max(lost)


def product(factors: Float[Array, "factors n n"]) -> Float[Array, "n n"]:
    """A_k ... A_2 A_1."""
    return lax.scan(lambda m, a: (a @ m, None), jnp.eye(factors.shape[-1], dtype=factors.dtype), factors)[0]


def _triangular(factors: Float[Array, "factors n n"]) -> Float[Array, "n n"]:
    """A matrix similar to the product, triangular apart from blocks of eigenvalues of nearly one modulus.

    The product itself rounds its small eigenvalues to those of a matrix as large as its largest. Orthogonal iteration
    around the cycle (the unshifted form of the periodic QR algorithm) turns every factor to triangular form, whose
    diagonals multiply without cancellation; eigenvalues of nearly one modulus remain as a block.
    """

    def turn(q: Array, a: Array) -> tuple[Array, tuple[Array, Array]]:
        after, r = _qr(a @ q)
        return after, (q, r)

    # Shifts would turn faster, but each lane would deflate at another place: so a fixed number of turns, one loop for a
    # batch. To derivatives the q are constants: the matrix is similar to the product whatever they are.
    frozen = lax.stop_gradient(factors)
    q = lax.fori_loop(
        0, LAPS, lambda _, q: lax.scan(turn, q, frozen)[0], jnp.eye(factors.shape[-1], dtype=factors.dtype)
    )
    last, (qs, rs) = lax.scan(turn, q, frozen)
    turned = jnp.swapaxes(jnp.concatenate([qs[1:], last[None]]), 1, 2) @ factors @ qs
    rs = rs + (turned - lax.stop_gradient(turned))  # triangular, with the derivatives of what is not
    around = q.T @ last
    eps = float(jnp.finfo(factors.dtype).eps)
    around = select(jnp.tril(jnp.abs(around) <= 1e3 * eps, -1), 0, around)
    return around @ product(rs)


def _qr(a: Float[Array, "n n"]) -> tuple[Float[Array, "n n"], Float[Array, "n n"]]:
    """The QR factorization, for up to three rows by Givens rotations: LAPACK is called lane by lane."""
    n = a.shape[-1]
    if n > 3:
        return qr(a)
    r, q = [a[i] for i in range(n)], [x for x in jnp.eye(n, dtype=a.dtype)]
    for j in range(n - 1):
        for i in range(n - 1, j, -1):
            x, y = r[i - 1][j], r[i][j]
            h = jnp.hypot(x, y)
            c, s = select(h > 0, x / select(h > 0, h, 1), 1), select(h > 0, y / select(h > 0, h, 1), 0)
            for rows in (r, q):
                rows[i - 1], rows[i] = c * rows[i - 1] + s * rows[i], c * rows[i] - s * rows[i - 1]
            r[i] = r[i].at[j].set(0)
    return jnp.stack(q).T, jnp.stack(r)


def eigenvalues(matrix: Float[Array, "n n"]) -> Complex[Array, " n"]:
    """The eigenvalues, largest modulus first, with derivatives of first and second order where they are simple.

    (jax's own rule has no second derivative.) Each is improved by Newton's method on (M - μ) v = 0, v₀ᴴ v = 1 from
    where it is known already: every step doubles the order of the derivatives that are right.
    """
    mu, v = eig(lax.stop_gradient(matrix))
    order = jnp.argsort(-jnp.abs(mu))
    mu, v = mu[order], v[:, order]
    n = len(mu)
    square = matrix.astype(mu.dtype)

    def improved(mu: Array, v0: Array) -> Array:
        value, v, norm = mu, v0, jnp.conj(v0)
        for _ in range(2):
            shifted = square - mu * jnp.eye(n, dtype=mu.dtype)
            bordered = jnp.block([[shifted, -v[:, None]], [norm[None], jnp.zeros((1, 1), mu.dtype)]])
            rest = jnp.append(shifted @ v, norm @ v - 1)
            move = solve(bordered, rest)
            v, mu = v - move[:n], mu - move[n]
        return _valued(value, mu)

    return jax.vmap(improved, in_axes=(0, 1))(mu, v)


@jax.custom_jvp
def _valued(value: Array, like: Array) -> Array:
    """`value`, with the derivatives of `like`."""
    return value


@_valued.defjvp
def _valued_jvp(primals: tuple, tangents: tuple) -> tuple[Array, Array]:
    return _valued(*primals), tangents[1]


def floquet(
    factors: Float[Array, "factors n n"], zeros: Int[Array, ""], autonomous: bool
) -> tuple[Float[Array, "n n"], Complex[Array, " n"], Bool[Array, ""]]:
    """The monodromy matrix, the multipliers, largest modulus first, with their structural zeros; and whether the orbit
    is stable."""
    monodromy = product(factors)
    triangular = _triangular(factors)
    finite = jnp.all(jnp.isfinite(triangular))
    eye = jnp.eye(monodromy.shape[-1], dtype=monodromy.dtype)
    multipliers = select(finite, eigenvalues(select(finite, triangular, eye)), jnp.nan)
    n = len(multipliers)
    multipliers = select(finite & (jnp.arange(n, dtype=zeros.dtype) >= n - zeros), 0, multipliers)
    return monodromy, multipliers, stability(multipliers, autonomous)


def stability(multipliers: Complex[Array, " n"], autonomous: bool) -> Bool[Array, ""]:
    """Whether all multipliers except the trivial one lie inside the unit circle."""
    inside = jnp.abs(multipliers) < 1
    if autonomous:
        inside = inside | trivial(multipliers)
    return jnp.all(inside)


def trivial(multipliers: Complex[Array, "*batch n"]) -> Bool[Array, "*batch n"]:
    """Which multiplier of an autonomous system is that of a shift along the orbit: the one nearest to 1."""
    xp: Any = multipliers.__array_namespace__()  # NumPy's, too
    finite = xp.isfinite(multipliers)
    away = xp.where(finite, xp.abs(xp.where(finite, multipliers, 0) - 1), xp.inf)
    return xp.arange(multipliers.shape[-1]) == xp.argmin(away, axis=-1, keepdims=True)


def forwards(
    backwards: tuple[Float[Array, "n n"], Complex[Array, " n"], Bool[Array, ""]],
    zeros: Int[Array, ""],
    autonomous: bool,
) -> tuple[Float[Array, "n n"], Complex[Array, " n"], Bool[Array, ""]]:
    """The same of an orbit whose monodromy matrix and multipliers in backward time are known, `zeros` of which vanish.

    Backwards in time a surface that repels attracts. The multipliers are the reciprocals; where one is infinite there
    is no monodromy matrix, which is infinite then.
    """
    monodromy, multipliers, _ = backwards
    lost = zeros > 0
    inverse = inv(select(lost, jnp.eye(len(monodromy), dtype=monodromy.dtype), monodromy))
    vanishes = multipliers == 0
    multipliers = select(vanishes, jnp.inf, 1 / select(vanishes, 1, multipliers))[::-1]
    return select(lost, jnp.inf, inverse), multipliers, stability(multipliers, autonomous)
