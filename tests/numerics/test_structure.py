"""On which entries of its argument a function depends, against its Jacobian at a point."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from nsjax._numerics._jaxpr import dependence, is_affine, is_constant


M = np.arange(1.0, 10.0).reshape(3, 3)
FUNCTIONS = {
    "entries": lambda y: jnp.stack([y[2], jnp.sin(y[0]), jnp.asarray(2.0)]),
    "parts": lambda y: jnp.concatenate([y[1:], y[:1] ** 2]),
    "reversed": lambda y: y[::-1],
    "sum": lambda y: jnp.stack([jnp.sum(y[:2]), y[2]]),
    "product": lambda y: (jnp.stack([y[0], 0 * y[0], jnp.asarray(0.0)]) @ M, M @ y),
    "outer": lambda y: jnp.stack([y, 2 * y]).T.reshape(3, 2)[:, 1],
    "choice": lambda y: jnp.where(y[0] > 0, y[1], jnp.asarray(1.0)),
    "call": lambda y: jax.jit(lambda a, b: (a * 2, b))(y[0], y[1]),
    "custom": lambda y: jnp.stack([jax.nn.relu(y[0]), jax.nn.softplus(y[2])]),
    "loop": lambda y: jax.lax.fori_loop(0, 2, lambda _, a: a + 1, y[1]),
    "matrix": lambda y: jnp.linalg.solve(M + jnp.eye(3), y)[0],
    "update": lambda y: y.at[0].set(3.0)[1],
}


@pytest.mark.parametrize("name", FUNCTIONS)
def test_no_dependence_is_overlooked(name):
    """Of every output on every input; and where values are only moved none is invented."""
    fn, y = FUNCTIONS[name], jnp.asarray([0.3, -0.4, 0.7])
    outputs = jax.tree.leaves(jax.eval_shape(fn, y))
    for k, out in enumerate(outputs):
        for i in np.ndindex(out.shape):
            for j in range(3):

                def entry(x, i=i, j=j, k=k):
                    return jax.tree.leaves(fn(y.at[j].set(x)))[k][i]

                # `at[j].set` itself is not followed entry by entry: put the argument together from its entries.
                def followed(x, i=i, j=j, k=k):
                    parts = [x if n == j else y[n] for n in range(3)]
                    return jax.tree.leaves(fn(jnp.stack(parts)))[k][i]

                depends = not is_constant(followed, y[j])
                slope = jax.grad(entry)(y[j])
                assert depends or slope == 0
                if name in ("entries", "parts", "reversed", "sum", "outer", "call"):
                    assert depends == (slope != 0), (i, j, k)


def test_affine():
    x = jnp.asarray([0.3, -0.4])
    assert is_affine(lambda x: M[:2, :2] @ x + 1, x)
    assert is_affine(lambda x: jnp.sin(x[1]) * 0 + x[0], x) is False
    assert is_affine(lambda x: jnp.concatenate([x, x**2])[:2], x)
    assert not is_affine(lambda x: jnp.concatenate([x, x**2])[1:], x)


def test_dependence_on_many_numbers_at_once():
    """Of each scalar on each of more numbers than a word has bits, in two leaves: where it is zero the Jacobian is."""
    x = {"a": jnp.linspace(0.1, 1.0, 70), "b": jnp.linspace(1.0, 2.0, 6).reshape(2, 3)}

    def fn(x):
        bent = jnp.sin(x["a"])
        moved = [
            bent[0] * bent[69],
            jnp.sum(x["b"][:, 1]),
            jnp.where(x["a"][69] > 0, x["b"][1, 2], 2.0),
            jnp.asarray(1.0),
        ]
        return [*moved, jnp.pad(x["a"], (2, 0))[3], (x["b"] @ M)[1, 0], jnp.sum(x["a"][::2]), x["a"] @ bent]

    wanted = np.zeros((8, 76), bool)
    wanted[0, [0, 69]] = wanted[1, [71, 74]] = wanted[2, [69, 75]] = wanted[4, 1] = wanted[5, 73:76] = True
    wanted[6, :70:2] = wanted[7, :70] = True
    assert (dependence(fn, x) == wanted).all()
