"""Work for a few lanes of a batch: how many are worked on together."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from nsjax._numerics._lane_cond import compact_cond


X = np.linspace(0.1, 1, 100)


@pytest.mark.parametrize("group", [48, 64])
def test_groups(group):
    """Of as many lanes as are asked for, in derivatives too."""

    def one(x):
        return compact_cond(x > 0.5, jnp.exp, (x,), x, group)

    batch = jax.vmap(one)
    np.testing.assert_allclose(batch(X), np.where(X > 0.5, np.exp(X), X), rtol=1e-15)
    assert f"f64[{group}]" in str(jax.make_jaxpr(batch)(X))
    slope = jax.vmap(lambda x: jax.jvp(one, (x,), (jnp.ones_like(x),))[1])
    np.testing.assert_allclose(slope(X), np.where(X > 0.5, np.exp(X), 1), rtol=1e-15)
    assert f"f64[{group}]" in str(jax.make_jaxpr(slope)(X))
