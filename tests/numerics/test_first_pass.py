"""What a first pass leaves over is told, wherever in a function it is said."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from nsjax._numerics._first_pass import first_pass, is_first_pass, left_over, told, UnreachableError


def root(x):
    """The square root, by a first pass only of what is not negative."""
    return left_over(x < 0, jnp.sqrt(jnp.abs(x))) if is_first_pass() else jnp.sqrt(jnp.abs(x))


x = np.asarray([1.0, -4.0, 9.0])

FUNCTIONS = {
    "called": root,
    "within jit": jax.jit(root),
    "within jit within jit": jax.jit(lambda x: 2 * jax.jit(root)(x)),
    "differentiated": jax.grad(root),
    "with tangents": lambda x: jax.jvp(lambda x: root(x) ** 2, (x,), (2.0,))[1],
    "in many directions": lambda x: jax.jacfwd(lambda p: root(p[0] * p[1]))(jnp.stack([x, 1.0])),
    "in a batch": lambda x: jax.vmap(lambda k: root(k * x))(jnp.asarray([1.0, 2.0])),
    "of its own derivative": jax.custom_jvp(root),
    "beside what is no array": lambda x: dict(root=root(x), none=None, one=1),
}
FUNCTIONS["of its own derivative"].defjvp(lambda x, dx: (root(*x), dx[0]))


@pytest.mark.parametrize("name", FUNCTIONS)
def test_told(name):
    """Lane by lane, and what the function returns is the same. (Of a batch within a lane the lane is one.)"""
    fn = FUNCTIONS[name]
    with first_pass():
        out, left = jax.jit(jax.vmap(told(fn)))(x)
    np.testing.assert_array_equal(left, [False, True, False])
    jax.tree.map(lambda a, b: np.testing.assert_allclose(a, b, rtol=1e-14), out, jax.vmap(fn)(x))


def test_nothing_to_tell():
    """A function that leaves nothing over has the program that it has otherwise; what it returns of it counts."""
    with first_pass():
        out, left = told(lambda x: (jnp.sin(x), root(x) > 0)[:1])(x[0])
        assert left is not None and not left
        _, left = told(jnp.sin)(x[0])
    assert left is None and out[0] == jnp.sin(1.0)


def turned(x):
    return jax.lax.scan(lambda x, k: (root(x) - k, x), x, jnp.asarray([0.0, 2.0, 3.0]))


def branched(x):
    return jax.lax.cond(x > 5, lambda x: x, root, x)


@pytest.mark.parametrize(
    "fn, want",
    [(turned, [True, True, True]), (lambda x: turned(x + 15), [False, True, False]), (branched, [False, True, False])],
    ids=["scan", "scan to its end", "cond"],
)
def test_in_loops_and_branches(fn, want):
    with first_pass():
        out, left = jax.jit(jax.vmap(told(fn)))(x)
        one, alone = told(fn)(x[2])
    np.testing.assert_array_equal(left, want)
    assert alone == want[2]
    jax.tree.map(np.testing.assert_array_equal, out, jax.vmap(fn)(x))
    jax.tree.map(np.testing.assert_array_equal, one, fn(x[2]))


def test_in_a_loop_without_a_bound():
    """What is left over might keep it from ending."""

    def fn(x):
        return jax.lax.while_loop(lambda x: x > 2, root, x)

    with first_pass(), pytest.raises(UnreachableError):
        told(fn)(x[0])
    assert np.isfinite(fn(x[2]))


def test_programs_are_kept_apart():
    """One that was traced in a first pass is not taken outside of one, nor the other way round."""
    fn = jax.jit(lambda x: jnp.asarray(is_first_pass()) & (x > 0))
    assert not fn(1.0)
    with first_pass():
        assert fn(1.0)
    assert not fn(1.0)
