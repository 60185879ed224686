"""Operations on many numbers as one on an array: the same results, and programs that hardly grow."""

import equinox.internal as eqxi
import jax
import jax.numpy as jnp
import numpy as np
import pytest

from nsjax._numerics._lane_cond import compact_cond
from nsjax._numerics._merge import merged


def count(jaxpr) -> int:
    """Equations, those of inner programs included."""
    inner = [p for e in jaxpr.eqns for p in jax.tree.leaves(list(e.params.values())) if hasattr(p, "eqns")]
    inner += [p.jaxpr for e in jaxpr.eqns for p in jax.tree.leaves(list(e.params.values())) if hasattr(p, "jaxpr")]
    return len(jaxpr.eqns) + sum(map(count, inner))


def oscillators(n):
    """n oscillators with a friction each, a coupled end, and sums and decisions over all of them."""

    def force(x, v, k):
        return jnp.where(v > 0, -1.0, 1.0) * (1 + 0.1 * k) - x * jnp.cos(v)

    def fn(x, v):
        forces = [force(x[k], v[k], k) for k in range(n)]
        forces[0] = forces[0] + 0.5 * x[1]
        any_fast, energy, highest = jnp.zeros((), bool), 0.0, -jnp.inf
        for k in range(n):
            any_fast, energy = any_fast | (v[k] > 1), energy + 0.5 * v[k] ** 2
            highest = jnp.maximum(highest, forces[k])
        return jnp.stack(forces), jnp.where(any_fast, energy, -energy), highest, [f * 2 for f in forces]

    return fn


def looped(n):
    """A loop whose carry is n numbers, with work that only some of the lanes have, and a scan within."""

    def fn(x):
        def body(c):
            i, ys = c
            total = sum(ys[1:], ys[0])
            new = compact_cond(total > 0.3, lambda ys: [y * 0.5 for y in ys], (ys,), list(ys))
            rows = jax.lax.scan(lambda a, u: (a + u * jnp.stack(new), sum(new[1:], new[0])), jnp.zeros(n), x)
            return i + 1, [y + 0.01 * r for y, r in zip(new, rows[0])]

        return jax.lax.while_loop(lambda c: c[0] < 4, body, (0, [jnp.sin(k + x[0]) for k in range(n)]))[1]

    return fn


def ended(n):
    """Equinox's loop, which chooses between two carries at the end of each turn."""

    def fn(x):
        def body(c):
            i, ys = c
            return i + 1, [jnp.cos(y) for y in ys]

        start = (0, [jnp.sin(k + x[0]) for k in range(n)])
        return eqxi.while_loop(lambda c: eqxi.unvmap_any(c[0] < 4), body, start, kind="lax")[1]

    return fn


@pytest.mark.parametrize("n", [3, 8])
@pytest.mark.parametrize("make", [oscillators, looped, ended])
def test_results_and_derivatives_are_the_same(make, n):
    fn = make(n)
    args = [jnp.asarray(np.random.default_rng(0).normal(size=(5, n))) for _ in range(2 if make is oscillators else 1)]

    def lanes(fn):
        return jax.jit(jax.vmap(lambda *a: (fn(*a), jax.jacfwd(fn)(*a))))(*args)

    jax.tree.map(lambda a, b: np.testing.assert_allclose(a, b, rtol=1e-13, atol=1e-13), lanes(merged(fn)), lanes(fn))
    got = merged(jax.vmap(fn))(*args)
    jax.tree.map(lambda a, b: np.testing.assert_allclose(a, b, rtol=1e-13, atol=1e-13), got, jax.vmap(fn)(*args))


@pytest.mark.parametrize("make", [oscillators, looped, ended])
def test_programs_do_not_grow(make):
    def size(n):
        xs = [jnp.ones(n)] * (2 if make is oscillators else 1)
        call = merged(make(n))
        whole = jax.make_jaxpr(lambda *xs: jax.tree.map(jnp.sum, call(*xs)))(*xs)
        return count(whole.jaxpr) - 3 * n  # what takes the results apart is asked for here

    assert size(32) <= size(8) + 3 * 24, (size(8), size(32))


def test_what_is_shared_is_counted_as_often_as_it_is_used():
    def fn(x):
        a = [x[k] + x[k + 1] for k in range(7)]
        b = [a[k] + a[k + 1] for k in range(6)]
        return b[0] + b[1] + b[2] + b[3] + b[4] + b[5] + b[0] + a[0]

    x = jnp.arange(8.0) ** 2
    assert merged(fn)(x) == fn(x)


def test_chains_of_integers_keep_their_type():
    def fn(x):
        total = jnp.zeros((), jnp.int32)
        for k in range(6):
            total = total + (x[k] > 0).astype(jnp.int32)
        return total

    out = merged(fn)(jnp.asarray([1.0, -1.0, 2.0, 3.0, -4.0, 5.0]))
    assert out == 4 and out.dtype == jnp.int32


def test_side_effects_happen_once_and_in_order():
    seen = []

    def fn(x):
        for k in range(5):
            jax.debug.callback(lambda v: seen.append(float(v)), x[k] * 2, ordered=True)
        return jnp.stack([x[k] * 2 for k in range(5)])

    jax.block_until_ready(jax.jit(merged(fn))(jnp.arange(5.0)))
    jax.effects_barrier()
    assert seen == [0.0, 2.0, 4.0, 6.0, 8.0]
