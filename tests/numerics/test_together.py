"""Values of which a batch has all or none."""

import jax
import jax.lax as lax
import jax.numpy as jnp
import numpy as np
import pytest

from nsjax._numerics._together import together
from nsjax._numerics._while_any import while_any


def loop_together(going, body, start):
    return lax.while_loop(going, body, together(start))


def summed(x, loop=loop_together, seen=lambda x: x):
    """1 + x + … + x⁴: of what the loop begins with only `x` differs from lane to lane."""

    def body(carry):
        count, term, total, x = carry
        return count + 1, term * seen(x), total + term, x

    return loop(lambda carry: carry[0] < 5, body, (jnp.asarray(0), jnp.ones_like(x), jnp.zeros_like(x), x))[2]


XS = np.array([0.5, -2.0, 3.0])
WANT = sum(np.asarray(XS) ** i for i in range(5))


@pytest.mark.parametrize("loop, least, most", [(loop_together, 1, 1), (while_any, 1, 1), (lax.while_loop, 2, 9)])
def test_a_loop_is_batched_once(loop, least, most):
    batches = []

    @jax.custom_batching.custom_vmap
    def seen(x):
        return x

    @seen.def_vmap
    def rule(size, batched, x):
        batches.append(size)
        return x, batched[0]

    found = jax.vmap(lambda x: summed(x, loop, seen))(XS)
    np.testing.assert_array_equal(found, WANT)
    assert least <= len(batches) <= most


def test_what_does_not_differ_is_left():
    """No lanes for the values when directions of derivatives are the batch."""
    slopes = jax.jit(jax.jacfwd(summed))(XS)
    np.testing.assert_array_equal(slopes, np.diag(sum(i * np.asarray(XS) ** (i - 1) for i in range(1, 5))))
    (loop,) = [e for e in jax.make_jaxpr(jax.jacfwd(summed))(XS).eqns if e.primitive.name == "while"]
    assert sorted({v.aval.shape for v in loop.outvars}) == [(), (3,), (3, 3)]


def test_backwards_and_alone():
    def product(x, y):
        x, y = together((x, y))
        return x * y

    assert jax.grad(product, argnums=(0, 1))(2.0, 3.0) == (3.0, 2.0)
    np.testing.assert_array_equal(jax.vmap(jax.grad(product), in_axes=(0, None))(XS, 3.0), [3.0] * 3)
    assert together(()) == () and together({"a": 1.0})["a"] == 1
