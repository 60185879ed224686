"""`sweep` is `jax.vmap` in chunks: the same values and derivatives, for any number of lanes and any arguments."""

from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from jax import Array
from models import CHEAP, flat, Motion

import nsjax
from nsjax import gallery, sweep


def final(system, x0):
    """(state, events) of `gallery.StickSlip` at t = 20."""
    sol = nsjax.solve(system, 0.0, 20.0, Motion(x0, -0.5), throw=False, **CHEAP)
    return sol.y1, sol.events.num


def test_solutions_and_their_derivatives():
    """One field of a system in many values; three chunks, the last of them filled up."""
    v = jnp.linspace(0.1, 1.0, 10)

    def in_chunks(v):
        return sweep(final, gallery.StickSlip(v_dr=v), 2.5, chunk=4)

    def at_once(v):
        return jax.vmap(lambda v: final(gallery.StickSlip(v_dr=v), 2.5))(v)

    def with_derivative(fn):
        (y, events), (dy, _) = jax.jit(lambda v: jax.jvp(fn, (v,), (jnp.ones_like(v),)))(v)
        return flat(y), flat(dy), events

    found, want = with_derivative(in_chunks), with_derivative(at_once)
    assert found[0].shape == (10, 2) and len(set(found[2].tolist())) > 1
    for a, b in zip(found, want):
        np.testing.assert_allclose(a, b, rtol=1e-10)


class Row(NamedTuple):
    a: Array
    b: Array


def mixed(row, scale, label):
    assert row.b.shape == (3,) and label == "static"
    return dict(sum=row.a * jnp.sum(row.b) * scale, same=1.0, wide=jnp.outer(row.b, row.b))


@pytest.mark.parametrize(
    "lanes, chunk", [(0, None), (1, None), (256, None), (257, None), (1000, None), (8, 4), (9, 4), (5, 1), (3, 8)]
)
def test_any_pytree_and_any_length(lanes, chunk):
    """Around the default chunk and others; numbers and what is no array are the same in every lane."""
    rows = Row(np.arange(lanes, dtype=float), jnp.ones((lanes, 3)))
    out = sweep(mixed, rows, 2.0, "static", chunk=chunk)
    np.testing.assert_allclose(out["sum"], 6.0 * np.arange(lanes))
    np.testing.assert_allclose(out["same"], np.ones(lanes))
    assert out["wide"].shape == (lanes, 3, 3)


def test_derivatives_and_jit():
    """With respect to what is mapped and to what is not, forward and in reverse; the last lane, which fills up the last
    chunk, counts once."""
    x = jnp.linspace(0.1, 2.0, 10)

    def total(x, k):
        return jnp.sum(sweep(lambda x, k: jnp.sin(k * x) / x, x, k, chunk=4))

    k = jnp.asarray(0.7)
    want = (k * jnp.cos(k * x) / x - jnp.sin(k * x) / x**2, jnp.sum(jnp.cos(k * x)))
    for transform in (jax.jacfwd, jax.grad):
        found = jax.jit(transform(total, (0, 1)))(x, k)
        np.testing.assert_allclose(found[0], want[0], rtol=1e-12)
        np.testing.assert_allclose(found[1], want[1], rtol=1e-12)


def test_gradients_of_many_lanes_in_little_memory():
    """Of a loss over all lanes: forward, and in reverse with each lane computed once more, memory is that of a chunk and of
    what goes in and out; in reverse alone it is that of all that all lanes did."""

    def lane(x, k):
        return jax.lax.scan(lambda y, _: (jnp.sin(k * y) + x, None), x, length=100)[0]

    def loss(fn):
        return lambda k, x: jnp.mean(sweep(lambda x: fn(x, k), x) ** 2)

    again = jax.grad(loss(jax.checkpoint(lane)))
    ways = dict(forward=jax.jacfwd(loss(lane)), reverse=jax.grad(loss(lane)), again=again)
    sizes, values = {}, {}
    for name, way in ways.items():
        for lanes in (1024, 16384):
            args = jnp.asarray(0.7), jnp.linspace(0.1, 1.0, lanes)
            program = jax.jit(way).lower(*args).compile()
            sizes[name, lanes] = program.memory_analysis().temp_size_in_bytes
            values[name, lanes] = program(*args)
    most = 15360 * 8 * 10  # bytes: some numbers a lane
    for name in ("forward", "again"):
        assert sizes[name, 16384] - sizes[name, 1024] < most < 0.2 * sizes["reverse", 16384]
        for lanes in (1024, 16384):
            np.testing.assert_allclose(values[name, lanes], values["reverse", lanes], rtol=1e-12)


def test_a_new_number_is_no_new_program():
    traced = []

    def fn(x, k):
        traced.append(1)
        return k * x

    x = jnp.arange(10.0)
    for k in (1.0, 2.0, 3.0):
        np.testing.assert_allclose(sweep(fn, x, k, chunk=4), k * x)
    once = len(traced)
    sweep(fn, x, 4.0, chunk=4)
    assert len(traced) == once


def test_mistakes_are_told():
    x = jnp.ones(4)
    with pytest.raises(ValueError, match=r"one length .*`args\[0\]` has 4, `args\[1\].v_dr` has 5"):
        sweep(final, x, gallery.StickSlip(v_dr=jnp.ones(5)))
    with pytest.raises(ValueError, match="only scalars"):
        sweep(final, gallery.StickSlip(), 2.5)
    for chunk in (0, -1, 2.5):
        with pytest.raises(ValueError, match="`chunk` must be a positive integer"):
            sweep(jnp.sin, x, chunk=chunk)
