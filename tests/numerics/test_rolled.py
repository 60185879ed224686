"""A loop that is written out in lanes: the same numbers, and which form stands in which program."""

import jax
import jax.lax as lax
import jax.numpy as jnp
import numpy as np
import pytest
from programs import count

from nsjax._numerics._lane_cond import compact_cond
from nsjax._numerics._rolled import rolled


def loop(f, y, k):
    def turn(carry, a):
        y, k = carry
        new = y + a * f(y + k)
        return (new, k + f(new)), new

    (y, k), all_of_them = lax.scan(turn, (y, k), jnp.arange(3.0))
    return y, k, all_of_them[-1]


def written_out(f, y, k):
    new = y
    for a in range(3):
        new = y + a * f(y + k)
        y, k = new, k + f(new)
    return y, k, new


def f(p, y):
    return jnp.sin(y * p[0]) * p[1]


def value(p):
    return sum(rolled(loop, written_out, lambda y: f(p, y), (p[0],), p[0] + p[1], p[1]))


def plain(p):
    return sum(written_out(lambda y: f(p, y), p[0] + p[1], p[1]))


def skipped(p):
    """As one of two: primals must not seem to depend on tangents there."""
    return compact_cond(p[0] > 0, value, (p,), p[0])


P = np.array([0.3, 0.7])
LANES = np.stack([P, 2 * P, -P])
WAYS = {
    "plain": (lambda fn: fn, P, 1),
    "jacfwd": (jax.jacfwd, P, 1),
    "jacfwd of jacfwd": (lambda fn: jax.jacfwd(jax.jacfwd(fn)), P, 1),
    "vmap": (jax.vmap, LANES, 0),
    "vmap of jacfwd": (lambda fn: jax.vmap(jax.jacfwd(fn)), LANES, 0),
    "vmap of jacfwd of jacfwd": (lambda fn: jax.vmap(jax.jacfwd(jax.jacfwd(fn))), LANES, 0),
    "jacfwd of vmap": (lambda fn: jax.jacfwd(jax.vmap(fn)), LANES, 0),
    "vmap of vmap": (lambda fn: jax.vmap(jax.vmap(fn)), LANES[None], 0),
}


@pytest.mark.parametrize("way", WAYS)
@pytest.mark.parametrize("fn", [value, skipped])
def test_same_numbers(way, fn):
    transformed, p, loops = WAYS[way]
    found = jax.jit(transformed(fn))(p)
    if fn is skipped:
        want = transformed(lambda p: jnp.where(p[0] > 0, plain(p), p[0]))(p)
    else:
        want = transformed(plain)(p)
    np.testing.assert_allclose(found, want, rtol=1e-12, atol=1e-12)
    primitives = count(jax.make_jaxpr(transformed(fn))(p).jaxpr)
    assert primitives["scan"] == loops
