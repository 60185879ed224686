"""What primitives that carry functions are told of these."""

import jax
import jax.lax as lax
import jax.numpy as jnp
import pytest

from nsjax._numerics._inner import batched_outputs
from nsjax._numerics._lane_cond import compact_cond
from nsjax._numerics._rolled import rolled


def plain(a, b, c):
    return a + b, jnp.where(b > 0, b, 1.0), c, jnp.ones(())


def loop(a, b, c):
    """`b` comes to the first number of the carry in the second turn only."""
    return lax.fori_loop(0, 5, lambda i, y: (y[0] + y[1], y[2], y[2], 2 * y[3]), (a, a, b, c))


def counted(a, b, c):
    """How often is a matter of `b`."""
    return lax.while_loop(lambda y: y[0] < b, lambda y: (y[0] + 1, y[1] * 2), (a, c))


def scanned(a, b, c):
    (end, _), each = lax.scan(lambda y, x: ((y[0] + x, y[1]), (y[1], x * c)), (a, b), jnp.arange(3.0))
    return end, *each


def chosen(a, b, c):
    return lax.cond(c > 0, lambda a, b: (a, b, 1.0), lambda a, b: (a, a, 2.0), a, b)


def nested(a, b, c):
    """A jitted function and a primitive of ours in a branch."""

    def branch(a, b):
        twice = jax.jit(lambda x, y: (2 * x, 3 * y))
        return compact_cond(a > 0, twice, (a, b), (a, a))

    return lax.cond(c > 0, branch, lambda a, b: (a, b), a, b)


def staged(a, b, c):
    def stages(fn, y):
        return [fn(y), 2 * y]

    return rolled(stages, stages, lambda y: y * a, (b,), b), c


# By the arguments, which results depend on them.
REACHED = {
    plain: ("ab", "b", "c", ""),
    loop: ("ab", "ab", "b", "c"),
    counted: ("ab", "abc"),
    scanned: ("a", "b", "c"),
    chosen: ("a", "abc", "c"),  # the first result is the same in both branches
    nested: ("ac", "abc"),
    staged: ("ab", "b", "c"),
}


@pytest.mark.parametrize("fn", REACHED)
def test_which_results_are_batched(fn):
    """For every choice of what is batched: never too few, and no more than what depends on it."""
    closed = jax.make_jaxpr(fn)(1.0, 2.0, 3.0)
    for number in range(8):
        batched = [bool(number >> i & 1) for i in range(3)]
        names = {name for name, b in zip("abc", batched) if b}
        assert batched_outputs(closed, batched) == [bool(names & set(row)) for row in REACHED[fn]], names
