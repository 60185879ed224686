"""Programs for a user who waits: compiled quickly, and the same as any other within other programs."""

import gc

import jax
import jax.numpy as jnp
import jaxlib
import numpy as np
import pytest

from nsjax._numerics import _compile
from nsjax._numerics._compile import interactive, without_collection


def test_the_same_within_other_programs():
    """XLA allows options of its compiler at the outermost program only; what is within another has none."""
    traced = []

    @interactive
    def fn(x, power):
        traced.append(gc.isenabled())
        return jnp.sum(jnp.sin(x) ** power)

    x = jnp.arange(3.0)
    value, slope = np.sum(np.sin(x) ** 2), 2 * np.sin(x) * np.cos(x)
    assert gc.isenabled()
    np.testing.assert_allclose(fn(x, 2), value, rtol=1e-14)
    np.testing.assert_allclose(fn(x, power=2), value, rtol=1e-14)
    np.testing.assert_allclose(jax.jit(lambda x: fn(x, 2))(x), value, rtol=1e-14)
    np.testing.assert_allclose(jax.jit(jax.jacfwd(lambda x: fn(x, 2)))(x), slope, rtol=1e-14)
    np.testing.assert_allclose(jax.vmap(lambda x: fn(x, 2))(x[:, None]), np.sin(x) ** 2, rtol=1e-14)
    assert not any(traced) and gc.isenabled()  # while it is traced, alone or within, nothing is collected
    count = len(traced)
    fn(x + 1, 2)
    assert len(traced) == count  # compiled once


def test_options_are_given_to_the_outermost_program_only(monkeypatch):
    """Whatever else is in the way: the compiler gets them where the function is called directly, and not elsewhere."""
    given, jit = [], _compile.eqx.filter_jit

    def spied(fn, **options):
        compiled = jit(fn, **options)

        def call(*args):
            given.append(options)
            return compiled(*args)

        return call

    monkeypatch.setattr(_compile.eqx, "filter_jit", spied)
    fn = interactive(lambda x: jnp.cos(x))
    np.testing.assert_allclose(fn(jnp.ones(())), np.cos(1))
    np.testing.assert_allclose(jax.jit(fn)(jnp.ones(())), np.cos(1))
    assert given == [{"compiler_options": _compile.options()}, {}]
    if jaxlib.__version__.startswith("0.10."):
        assert _compile.options() == _compile.QUICK and _compile.options(often=True) == _compile.KERNELS


def test_what_is_outermost():
    """What executes at once is in nobody's way; what is collected into another program, now or later, is."""
    seen = []

    def fn(x):
        seen.append(_compile.outermost())
        return jnp.sin(x)

    x = jnp.ones(3)
    fn(x), jax.jvp(fn, (x,), (x,)), jax.jacfwd(fn)(x), jax.vmap(fn)(x), jax.jacfwd(jax.jacfwd(fn))(x)
    assert seen == [True] * 5
    seen.clear()
    jax.jit(fn)(x), jax.jit(jax.jacfwd(fn))(x), jax.linearize(fn, x), jax.vmap(fn)(jnp.ones(_compile.MANY + 1))
    jax.lax.scan(lambda _, x: (None, fn(x)), None, x), jax.grad(lambda x: jnp.sum(fn(x)))(x)
    assert seen == [False] * len(seen) and len(seen) >= 6


def test_derivatives_called_directly_have_the_options(monkeypatch):
    """And the linear part that `jax.linearize` keeps can be compiled within another program."""
    fn = interactive(lambda x: jnp.sum(jnp.sin(x) ** 2))
    x = jnp.arange(3.0)
    np.testing.assert_allclose(jax.jacfwd(fn)(x), np.sin(2 * x), rtol=1e-14)
    np.testing.assert_allclose(jax.jacfwd(jax.jacfwd(fn))(x), np.diag(2 * np.cos(2 * x)), rtol=1e-14, atol=1e-15)
    np.testing.assert_allclose(jax.vmap(jax.jacfwd(fn))(x[:, None]), np.sin(2 * x)[:, None], rtol=1e-14)
    np.testing.assert_allclose(jax.jit(jax.linearize(fn, x)[1])(jnp.ones(3)), np.sum(np.sin(2 * x)), rtol=1e-14)


def test_collection_is_restored():
    with pytest.raises(ZeroDivisionError), without_collection():
        assert not gc.isenabled()
        raise ZeroDivisionError
    assert gc.isenabled()
    gc.disable()
    try:
        with without_collection():
            pass
        assert not gc.isenabled()  # as it was found
    finally:
        gc.enable()


def test_options_that_xla_does_not_know_are_left_out(monkeypatch):
    known = _compile.options()
    monkeypatch.setattr(_compile, "QUICK", _compile.QUICK | {"xla_no_such_option": True})
    assert _compile.options() == known
    np.testing.assert_allclose(interactive(lambda x: 2 * x)(jnp.ones(())), 2)
