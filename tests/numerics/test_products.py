"""Products of matrices to the precision of their numbers, on devices that would take fewer digits."""

import jax
import jax.extend.core as jex
import jax.numpy as jnp
import pytest
from models import Hammer, Motion

import nsjax
from nsjax._numerics._compile import interactive
from nsjax._numerics._products import full_products


def products(jaxpr):
    """The precision of each product in a program."""
    for e in jaxpr.eqns:
        if e.primitive.name == "dot_general":
            yield e.params["precision"]
        for p in jax.tree.leaves(list(e.params.values()), is_leaf=lambda p: isinstance(p, jex.Jaxpr | jex.ClosedJaxpr)):
            if isinstance(p, jex.Jaxpr | jex.ClosedJaxpr):
                yield from products(p if isinstance(p, jex.Jaxpr) else p.jaxpr)


HIGHEST = (jax.lax.Precision.HIGHEST,) * 2


WAYS = {
    "lanes": jax.vmap,
    "compiled": lambda lane: jax.vmap(jax.jit(lane)),
    "derivatives": lambda lane: jax.vmap(jax.jacfwd(lane)),
}


@pytest.mark.parametrize(
    ("solver", "way"),
    [
        pytest.param(solver, way, marks=() if (solver, way) == (nsjax.Taylor(), "compiled") else pytest.mark.slow)
        for solver in (nsjax.Taylor(), nsjax.Affine())
        for way in WAYS
    ],
)
def test_of_a_sweep(solver, way):
    """In single precision a GPU rounds what it multiplies to ten bits: errors of 1e-2 in the state were seen."""

    def lane(x):
        y0 = Motion(x, jnp.zeros_like(x))
        return nsjax.solve(Hammer(), 0.0, 10.0, y0, solver=solver, throw=False).y1.x

    found = list(products(jax.make_jaxpr(WAYS[way](lane))(jnp.ones(3, jnp.float32)).jaxpr))
    assert found and set(found) == {HIGHEST}


def test_what_the_user_says_stands():
    @full_products
    def fn(a, b):
        return a @ b

    a = jnp.ones((2, 2))
    with jax.default_matmul_precision("high"):
        assert set(products(jax.make_jaxpr(fn)(a, a).jaxpr)) == {(jax.lax.Precision.HIGH,) * 2}
    assert set(products(jax.make_jaxpr(fn)(a, a).jaxpr)) == {HIGHEST}
    low = interactive(lambda a, b: jnp.dot(a, b, precision="default"))
    assert set(products(jax.make_jaxpr(low)(a, a).jaxpr)) == {(jax.lax.Precision.DEFAULT,) * 2}
    assert jax.config.jax_default_matmul_precision is None
