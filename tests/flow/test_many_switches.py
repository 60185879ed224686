"""More than three switches, whose operations are merged: blocks that do not touch each other move as each alone does."""

from typing import NamedTuple

import diffrax
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from programs import equations_of

import nsjax
from nsjax import gallery
from nsjax.gallery import Motion, thesis


N = 5  # of four blocks all guards would be searched
STARTS = np.stack([2 * np.sin(1.0 + np.arange(N)), np.cos(3.0 * np.arange(N))])
TS = np.linspace(0.0, 9.0, 19)
TIGHT = dict(stepsize_controller=diffrax.PIDController(rtol=1e-11, atol=1e-11))


class State(NamedTuple):
    x: jax.Array
    v: jax.Array


class Blocks(nsjax.System):
    """Blocks on one belt, each on a spring of its own, after (3.33)."""

    v_dr: float = 0.2
    n: int = N

    @property
    def switches(self):
        def contact(i):
            held = nsjax.sgn(lambda self, t, y: y.v[i] - self.v_dr, name=f"belt{i}")
            return held.breakaway(lambda self: 2.0)

        return tuple(contact(i) for i in range(self.n))

    def vector_field(self, t, y, s):
        return State(y.v, -y.x - jnp.stack([s[f"belt{i}"] for i in range(self.n)]))


def end(system, y0, tol):
    how = dict(stepsize_controller=diffrax.PIDController(rtol=tol, atol=tol), solver=diffrax.Tsit5())
    sol = nsjax.solve(system, 0.0, 9.0, y0, saveat=diffrax.SaveAt(ts=TS), **how)
    return sol.ys, sol.events.t, sol.events.num, sol.margin


def alone(v_dr, y0, tol):
    return end(thesis("3.4", v_dr=v_dr), Motion(*y0), tol)


def together(v_dr, y0, tol):
    return end(Blocks(v_dr), State(*y0), tol)


def with_slope(fn):
    """Of the belt's velocity; both from one program."""
    return jax.jit(lambda v, *args: jax.jvp(lambda v: fn(v, *args), (v,), (jnp.ones_like(v),)))


EACH = with_slope(jax.vmap(alone, (None, 1, None)))
MANY = with_slope(together)


def events_of(times, num):
    return np.asarray(times)[: int(num)]


@pytest.fixture(scope="module")
def singles():
    """x of each at `TS`, its derivative by the belt's velocity, and all events."""
    (ys, times, num, _), (slopes, *_) = EACH(0.2, STARTS, 1e-11)
    return ys.x, slopes.x, np.sort(np.concatenate([events_of(t, n) for t, n in zip(times, num)]))


def check(singles, found, xs):
    want, slope, times = singles
    (ys, events, num, _), (slopes, *_) = found
    np.testing.assert_allclose(xs(ys), want, atol=1e-8)
    np.testing.assert_allclose(events_of(events, num), times, atol=1e-8)
    np.testing.assert_allclose(xs(slopes), slope, atol=1e-6)


def test_as_each_alone(singles):
    check(singles, MANY(0.2, STARTS, 1e-11), lambda ys: ys.x.T)


def test_a_belt_that_is_all_but_met():
    """One block comes as near as 1e-4 to the velocity of the belt; the others, far from it, count for nothing."""
    near = 0.2 - 1e-4
    starts = np.stack([np.full(N, 1.01), np.zeros(N)])
    starts[0, 3] = 1 + near  # x = 1 + near cos t
    for found, of_it in (MANY, ...), (EACH, 3):
        (_, _, num, margin), _ = found(0.2, starts, 1e-8)
        assert np.all(num == 0)
        assert float(margin[of_it]) == pytest.approx(1e-4 / (1e-8 * (1 + near)), rel=1e-2)


@pytest.mark.slow
def test_a_scene_as_each_alone(singles):
    names = [f"x{i + 1}" for i in range(N)]
    begin = gallery.BlockChain(n=N).state(*(dict(zip(names, row)) for row in STARTS))

    chain = with_slope(lambda v, *how: end(gallery.BlockChain(n=N, k_c=0.0, v_dr=v), *how))
    check(singles, chain(0.2, begin, 1e-11), lambda ys: jnp.stack(ys.q))
    sol = jax.eval_shape(lambda: nsjax.solve(gallery.BlockChain(n=N), 0.0, 9.0, begin))
    assert isinstance(sol.system, gallery.BlockChain)


@pytest.mark.slow
def test_lanes_and_second_derivatives():
    def energy(v):
        y = nsjax.solve(Blocks(v), 0.0, 4.0, State(*STARTS), throw=False, **TIGHT).y1
        return jnp.sum(y.x**2 + y.v**2)

    vs, h = jnp.asarray([0.2, 0.35]), 1e-4
    slopes = jax.jit(jax.vmap(jax.jacfwd(energy)))
    bends = jax.jit(jax.vmap(jax.jacfwd(jax.jacfwd(energy))))(vs)
    np.testing.assert_allclose(bends, (slopes(vs + h) - slopes(vs - h)) / (2 * h), rtol=1e-4)


@pytest.mark.slow
def test_programs_grow_little():
    """Pitfall 47: twice as many switches make a third more of a program, derivatives included; one by one they made it twice as
    large."""

    def end(v, n):
        x, v0 = 2 * np.sin(1.0 + np.arange(n)), np.cos(3.0 * np.arange(n))
        return nsjax.solve(Blocks(v, n), 0.0, 9.0, State(x, v0), throw=False).y1.x

    for way in (lambda f: f, jax.jacfwd):
        programs = [jax.make_jaxpr(way(lambda v, n=n: end(v, n)))(0.2) for n in (6, 12)]
        few, many = (sum(1 for _ in equations_of(program.jaxpr)) for program in programs)
        assert many < 1.4 * few, (few, many)
