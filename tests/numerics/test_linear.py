"""Linear equations for the multipliers."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from nsjax._numerics._linalg import linear_solve


@pytest.mark.parametrize("seed", range(8))
@pytest.mark.parametrize("m", [1, 2, 3, 4, 6])
def test_linear_solve(m, seed):
    """Pitfall 27, and also where rows and columns have units of very different size; zeros on the
    diagonal; derivatives.

    Elimination solves (A + ΔA) x = b with |ΔA| <= 3 m eps P |L| |U|, which for small matrices in units that are meant
    for them is no more than m^2 eps |A| (growth 1; of random ones it is 2 at most): so x, in its units, is known to
    4 m^2 eps cond(A), whatever library does it.
    """
    rng = np.random.default_rng([m, seed])
    units = 10.0 ** rng.uniform(-12, 12, (2, 50, m))
    a, x = rng.normal(size=(50, m, m)), rng.normal(size=(50, m)) / units[1]
    a[:25, range(m), range(m)] = 0 if m > 1 else 1
    condition = np.linalg.cond(a)
    a = units[0][:, :, None] * a * units[1][:, None]
    b = np.einsum("kij,kj->ki", a, x)
    bound = 4 * m**2 * np.finfo(float).eps * condition
    got = jax.jit(jax.vmap(linear_solve))(a, b)
    assert np.all(np.abs((got - x) * units[1]).max(axis=1) <= bound)
    moved = jax.jit(jax.vmap(lambda a, b: jax.jvp(lambda a: linear_solve(a, b), (a,), (a,))[1]))(a, jnp.asarray(b))
    assert np.all(np.abs((moved + x) * units[1]).max(axis=1) <= 8 * bound)


def test_batches_are_no_library_calls():
    """In XLA's pool of threads batches of LAPACK's LU decompositions wait for tasks that stand behind them: loops over
    batches of models with five switches came to a standstill."""
    a, b = np.ones((8, 3, 5, 5)), np.ones((8, 3, 5))
    for fn in (linear_solve, lambda a, b: jax.jvp(linear_solve, (a, b), (a, b))[1]):
        text = jax.jit(jax.vmap(jax.vmap(fn))).lower(a, b).as_text()
        assert "getrf" not in text and "custom_call" not in text
    assert "getrf" in jax.jit(linear_solve).lower(a[0, 0], b[0, 0]).as_text()
