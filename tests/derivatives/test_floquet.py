"""Multipliers of products of many matrices, against 60-digit arithmetic."""

import jax
import jax.numpy as jnp
import mpmath
import numpy as np
import pytest

from nsjax.derivatives._floquet import eigenvalues, floquet


multipliers = jax.jit(lambda factors, zeros: floquet(factors, zeros, False)[1:])


def exact(factors):
    """Eigenvalues of the product, largest modulus first."""
    with mpmath.workdps(120):
        product = mpmath.eye(factors.shape[-1])
        for factor in factors:
            product = mpmath.matrix(factor.tolist()) * product
        values = mpmath.eig(product, left=False, right=False)
        return sorted(map(complex, values), key=lambda z: (-abs(z), z.imag))


SIZES = [(2, 30, 1.0), (6, 8, 2.0), *(pytest.param(*s, marks=pytest.mark.slow) for s in ((3, 20, 1.5), (4, 12, 2.0)))]


@pytest.mark.parametrize("n, count, spread", SIZES)
def test_far_apart(n, count, spread):
    """Pitfall 23: from 1e30 to 1e-30 each to eleven digits, where the product itself knows but the largest."""
    rng = np.random.default_rng(n)
    scale = 10.0 ** np.linspace(spread, -spread, n)
    frames = [np.linalg.qr(rng.normal(size=(n, n)))[0] for _ in range(count)]
    frames.append(frames[0])
    near = np.eye(n) + 0.2 * np.triu(rng.normal(size=(count, n, n)), 1)
    factors = np.stack([b @ (u * scale) @ a.T for a, b, u in zip(frames, frames[1:], near)])
    found, stable = multipliers(factors, 0)
    want = np.array(exact(factors))
    np.testing.assert_allclose(np.abs(found) / np.abs(want), 1, atol=1e-11)
    assert not stable


def test_pairs_and_zeros():
    """A conjugate pair among real ones keeps together; what is lost on one arc is lost for all."""
    c, s = np.cos(0.3), np.sin(0.3)
    block = np.zeros((4, 4))
    block[:2, :2] = 1e3 * np.array([[c, -s], [s, c]])
    block[2, 2], block[3, 3] = 1e-4, 0.5
    rng = np.random.default_rng(1)
    frame = rng.normal(size=(4, 4))
    factors = np.stack([frame @ block @ np.linalg.inv(frame)] * 2 + [np.diag([1.0, 1.0, 1.0, 0.0])])
    found, _ = multipliers(factors, 1)
    want = exact(factors)
    assert found[-1] == 0
    np.testing.assert_allclose(np.abs(found[:-1]), np.abs(want[:-1]), rtol=1e-9)
    np.testing.assert_allclose(np.real(found[:2]), np.real(want[:2]), rtol=1e-9)


def test_derivatives():
    """First and second, against those of the roots of the characteristic polynomial."""

    def matrix(p):
        return jnp.array([[p, 1.0], [2.0, p * p]])

    def roots(p):
        half, det = (p + p * p) / 2, p**3 - 2
        return jnp.stack([half + jnp.sqrt(half**2 - det), half - jnp.sqrt(half**2 - det)])

    def both(fn):
        return jax.jit(jax.jacfwd(lambda p: (jax.jacfwd(fn)(p),) * 2, has_aux=True))(1.3)

    for found, want in zip(both(lambda p: eigenvalues(matrix(p)).real), both(roots)):
        np.testing.assert_allclose(found, want, rtol=1e-12)
