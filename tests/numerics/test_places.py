"""Entries of arrays at known places."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from nsjax._numerics._places import at_places


INDICES = {
    # places among 12, and whether no gather is needed
    "all": (np.arange(12), True),
    "one": (np.array([7]), True),
    "evenly": (np.arange(1, 12, 3), True),
    "backwards": (np.arange(12)[::-1], True),  # twelve parts of one
    "each three times": (np.repeat(np.arange(12), 3), True),
    "all three times": (np.tile(np.arange(12), 3), True),
    "two halves in turn": (np.arange(12).reshape(2, 6).T.ravel(), True),
    "pairs and singles in turn": (np.array([[i, 4 + 2 * i, 5 + 2 * i] for i in range(4)]).ravel(), True),
    "one place and a row": (np.array([3] * 5 + [0, 1, 2]), True),
    "any": (np.random.default_rng(0).integers(0, 12, 97), False),
    "none": (np.zeros(0, int), False),
}


@pytest.mark.parametrize("shape", [(12,), (12, 2)])
@pytest.mark.parametrize("name", INDICES)
def test_the_entries_are_those_of_an_index_array(name, shape):
    index, plain = INDICES[name]
    x = np.random.default_rng(1).normal(size=(3, *shape))
    call = jax.vmap(at_places(index))
    np.testing.assert_array_equal(call(jnp.asarray(x)), x[:, index])
    assert not (plain and "gather" in str(jax.make_jaxpr(call)(x)))
