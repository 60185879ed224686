"""Loops as one function: where they are asked for, where XLA can, and nowhere else."""

import threading

import diffrax
import jax
import jax.numpy as jnp
import jaxlib
import numpy as np
import pytest

import nsjax
from nsjax import gallery
from nsjax._numerics import _compile, _whole_loops
from nsjax._numerics._compile import interactive, MANY
from nsjax._numerics._whole_loops import ask_for_whole_loops, on_request, whole_loops
from nsjax.sweeps._lanes import WORTH


def climb(x):
    return jax.lax.while_loop(lambda x: jnp.sum(x) < 500, lambda x: x + jnp.sin(x) ** 2 + 0.1, x)


def sorted_climb(x):
    return jax.lax.while_loop(lambda x: jnp.sum(x) < 500, lambda x: jnp.sort(x + jnp.sin(x) ** 2 + 0.1), x)


def product_climb(x):
    """With a product that XLA otherwise gives to a library."""
    a = jnp.eye(9) + 0.1
    return jax.lax.while_loop(lambda x: jnp.sum(x) < 500, lambda x: a @ x, x[:81].reshape(9, 9) + 0.1)


def is_whole(fn, *args, **options):
    """Whether XLA's final program of a function has a loop as one function."""
    fresh = lambda *args: fn(*args)  # noqa: E731  (JAX keeps what it has compiled of the same one)
    return "xla_cpu_small_call" in jax.jit(fresh).lower(*args).compile(options or None).as_text()


X = np.linspace(0, 1, 200)  # too large for what XLA takes for small by itself

tried = pytest.mark.skipif(not jaxlib.__version__.startswith("0.10."), reason="what XLA does is not documented")


@tried
def test_loops_are_whole_within_and_not_outside():
    assert not is_whole(climb, X)
    with whole_loops():
        assert is_whole(climb, X)
        assert is_whole(climb, X, xla_backend_optimization_level=0)  # beside other options
        assert not is_whole(sorted_climb, X)  # which XLA would have to call
        with whole_loops(False):
            assert not is_whole(climb, X)
        with pytest.raises(jax.errors.JaxRuntimeError):
            is_whole(climb, X, xla_no_such_option=True)
    assert not is_whole(climb, X)


@tried
def test_products_are_part_of_them():
    """With the options that direct calls have; with XLA's own the library is in the way."""
    with whole_loops():
        assert is_whole(product_climb, X, **_compile.options())
        assert not is_whole(product_climb, X)


def test_numbers_are_the_same():
    for fn in climb, sorted_climb, product_climb:
        expected = jax.jit(fn)(X)
        assert np.max(expected) > 2  # the loop turned
        with whole_loops():
            np.testing.assert_allclose(jax.jit(lambda x, fn=fn: fn(x))(X), expected, rtol=1e-14)


@tried
def test_what_is_said_in_xla_flags_stands(monkeypatch):
    monkeypatch.setenv("XLA_FLAGS", f"--xla_backend_extra_options={_whole_loops.NAME}=0")
    with whole_loops():
        assert not is_whole(climb, X)


@tried
def test_another_version_compiles_as_elsewhere(monkeypatch):
    class Other:
        @staticmethod
        def ParseFromString(_):
            raise RuntimeError("no such message")

    monkeypatch.setattr(_whole_loops, "CompileOptions", Other, raising=False)
    with whole_loops():
        assert not is_whole(climb, X)


def test_they_are_asked_for_by_what_is_called_directly():
    seen = []

    @interactive
    def fn(x):
        seen.append(_whole_loops._here.wanted)
        return climb(x)

    fn(jnp.ones(3)), jax.jacfwd(fn)(jnp.ones(4)), jax.vmap(fn)(jnp.ones((3, 5)))
    assert all(seen) and len(seen) >= 3
    seen.clear()
    jax.jit(fn)(jnp.ones(6)), jax.vmap(fn)(jnp.ones((MANY + 1, 7)))
    assert not any(seen) and len(seen) >= 2
    assert not _whole_loops._here.wanted


@tried
def test_they_can_be_asked_for_while_tracing():
    def asking(x):
        ask_for_whole_loops()
        return climb(x)

    with on_request() as request:
        lowered = jax.jit(asking).lower(X)
    assert request.made
    assert not is_whole(asking, X)  # only there
    found = []  # elsewhere, as the threads of a sweep on several devices do

    def elsewhere():
        with on_request(request):
            found.append(lowered.compile().as_text())

    thread = threading.Thread(target=elsewhere)
    thread.start(), thread.join()
    assert "xla_cpu_small_call" in found[0]
    with on_request():
        assert not is_whole(climb, X)


def slides(t1, solver=diffrax.Tsit5(), system=gallery.StickSlip()):
    return nsjax.solve(system, 0.0, t1, gallery.Motion(2.5, -0.5), solver=solver, throw=False).y1.x


class Twice(gallery.StickSlip):
    """With one more surface."""

    @nsjax.sgn
    def second(self, t, y):
        return y.x + 10.0


@pytest.mark.parametrize(
    "options, asks",
    [
        ({}, True),
        ({"solver": diffrax.Dopri8()}, True),
        ({"solver": nsjax.Taylor()}, False),
        ({"system": Twice()}, False),
    ],
)
def test_what_asks_for_them(options, asks):
    """Runge-Kutta with one switch; also if it was traced before."""
    for _ in range(2):
        with on_request() as request:
            jax.make_jaxpr(lambda t1: slides(t1, **options))(1.0)
        assert request.made == asks


@pytest.mark.parametrize("number", [WORTH - 1, WORTH])
@pytest.mark.parametrize("options", [{}, {"devices": 1}])
def test_sweeps_of_many_lanes_let_them_ask(number, options):
    seen = []

    def lane(x):
        seen.append(_whole_loops._here.request is not None)
        return 2 * x

    nsjax.sweep(lane, jnp.ones(number), **options)
    assert seen and set(seen) == {number == WORTH}
    assert _whole_loops._here.request is None
