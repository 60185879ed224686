"""`select` is `jnp.where`, as one operation."""

import itertools

import jax
import jax.extend.core as jex
import jax.numpy as jnp
import numpy as np
import pytest

from nsjax import gallery, solve
from nsjax._numerics._select import select


def values():
    """Conditions, and what is chosen from."""
    f, i, b = jnp.arange(3.0), jnp.arange(3), jnp.array([True, False, True])
    scalars = [jnp.asarray(2.0), jnp.asarray(3), jnp.float32(1), jnp.float64(1)]
    conditions = [b, jnp.asarray(True), b[:, None], True, np.array([True, False, True]), i]
    return conditions, [f, f[:, None], *scalars, i, b, 0.0, 1, True, np.float64(3), np.int32(3), np.arange(3.0)]


def told(fn, *args):
    """What the result is, or what kind of error there is."""
    try:
        found = jax.eval_shape(lambda: fn(*args))
        return found.shape, found.dtype, found.weak_type
    except Exception as error:
        return type(error)


@pytest.fixture
def whole_tracebacks():
    """JAX takes 3 ms for each error to leave its own lines out."""
    before = jax.config.jax_traceback_filtering  # pyright: ignore[reportAttributeAccessIssue]
    jax.config.update("jax_traceback_filtering", "off")
    yield
    jax.config.update("jax_traceback_filtering", before)


@pytest.mark.usefixtures("whole_tracebacks")
@pytest.mark.parametrize("promotion", ["standard", "strict"])
def test_shapes_and_types(promotion):
    conditions, chosen = values()
    with jax.numpy_dtype_promotion(promotion):
        seen = [(told(select, *args), told(jnp.where, *args)) for args in itertools.product(conditions, chosen, chosen)]
    assert all(got == want for got, want in seen)
    assert 100 < sum(isinstance(got, tuple) for got, _ in seen)


def test_values():
    f, s, b = jnp.arange(3.0), jnp.asarray(2.0), jnp.array([True, False, True])
    for c, x, y in ((b, f, 0.0), (b[:, None], s, f), (jnp.asarray(False), 1.0, f[:, None]), (b, np.arange(3.0), s)):
        np.testing.assert_array_equal(select(c, x, y), np.where(c, x, y), strict=True)


def test_derivatives_and_lanes():
    """Of a number for lanes, or of lanes for a number; and not of the condition."""
    x, b = jnp.array([0.5, -1.0, 2.0]), jnp.array([True, False, True])
    for where in (select, jnp.where):
        fn = jax.vmap(lambda x, where=where: where(x > 0, x**2, 3.0))
        np.testing.assert_array_equal(fn(x), [0.25, 3, 4])
        np.testing.assert_array_equal(jax.jvp(fn, (x,), (jnp.ones(3),))[1], [1, 0, 4])
        one = jax.vmap(lambda c, where=where: where(c, x, 0.0))
        np.testing.assert_array_equal(one(b), np.where(np.asarray(b)[:, None], x, 0))


def test_one_operation():
    jaxpr = jax.make_jaxpr(lambda c, x: select(c, x, 0.0))(jnp.asarray(True), jnp.asarray(2.0))
    assert [e.primitive.name for e in jaxpr.jaxpr.eqns] == ["select_n"]


def functions(jaxpr):
    for eqn in jaxpr.eqns:
        if eqn.primitive.name in ("jit", "pjit"):
            yield eqn.params["name"]
        for inner in jex.jaxprs_in_params(eqn.params):
            yield from functions(inner)


def test_the_program_of_a_solution_calls_few():
    """With `jnp.where` there were 406 calls of it. Some of the 56 that are left are of diffrax and equinox."""
    y0 = gallery.THESIS["3.4"].y0
    jaxpr = jax.make_jaxpr(lambda v: solve(gallery.StickSlip(v_dr=v), 0.0, 1.0, y0).y1)(0.2)
    assert sum(name == "_where" for name in functions(jaxpr.jaxpr)) < 70
