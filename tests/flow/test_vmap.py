"""Many solutions at once: equal to the loop over single ones, whatever the other lanes do."""

import functools

import diffrax as dfx
import jax
import jax.lax as lax
import jax.numpy as jnp
import numpy as np
import pytest
import reference
from models import CHEAP, Motion, pid

import nsjax
from nsjax import gallery, RESULTS, solve


def one(v_dr, x=2.5, **kwargs):
    """Workload S1: the oscillator of section 3.4, eight to thirty events."""
    sol = solve(gallery.StickSlip(v_dr=v_dr), 0.0, 100.0, Motion(x, -0.5), throw=False, **(CHEAP | kwargs))
    return sol.y1, sol.t1, sol.events.num, sol.events.t[:6], sol.result, sol.stats["num_steps"]


def varied(v_dr, x):
    """A solution, and how its end changes with both."""

    def end(p):
        out = one(*p)
        return jnp.stack(out[0]), out

    slopes, out = jax.jacfwd(end, has_aux=True)(jnp.stack([v_dr, x]))
    return out, slopes


many = jax.jit(jax.vmap(varied))


def lanes(n):
    return jnp.linspace(0.1, 1.0, n), jnp.full(n, 2.5)


def equal(a, b):
    """Bit by bit."""
    return all(
        np.array_equal(x, y, equal_nan=True) for x, y in zip(jax.tree.leaves(a), jax.tree.leaves(b), strict=True)
    )


def test_equals_the_loop():
    """Pitfall 17: lanes in different modes, at different times, with eight to thirty events."""
    v, x = lanes(64)
    batch, slopes = many(v, x)
    assert len(set(batch[2].tolist())) > 5 and np.all(batch[4] == RESULTS.successful)
    single = jax.jit(varied)  # (without derivatives steps may be others: theirs have an error too)
    for i in range(64):
        alone, slope = single(v[i], x[i])
        np.testing.assert_allclose(slope, slopes[i], rtol=1e-9)
        for a, b in zip(jax.tree.leaves(alone), jax.tree.leaves(batch), strict=True):
            np.testing.assert_allclose(a, b[i], rtol=1e-12, atol=1e-12)
        assert alone[2] == batch[2][i] and alone[5] == batch[5][i]


@pytest.mark.slow
def test_4096_oscillators():
    """The acceptance test of the flow: states to 1e-9 and the event counts of single runs."""
    v = jnp.linspace(0.1, 1.0, 4096)
    tight = dict(solver=dfx.Dopri8(), stepsize_controller=pid(1e-12), max_steps=20_000)
    y, _, num, _, result, _ = jax.jit(jax.vmap(functools.partial(one, **tight)))(v)
    assert np.all(result == RESULTS.successful)
    assert num.min() >= 8 and num.max() <= 30
    np.testing.assert_allclose(np.stack(y, -1), reference.stick_slip_final(np.asarray(v)), atol=1e-9)
    single = jax.jit(functools.partial(one, **tight))
    for i in range(0, 4096, 7):
        assert single(v[i])[2] == num[i]


def test_a_bad_lane_harms_no_other():
    """Pitfalls 17, 18: NaN, infinity or a lane out of steps leave their neighbours as they are, bit by bit, and so their
    derivatives."""
    v, x = lanes(64)
    good = many(v, x)
    spoiled_v, spoiled_x = v.at[5].set(jnp.nan).at[40].set(-jnp.inf), x.at[9].set(jnp.nan).at[33].set(1e300)
    bad = many(spoiled_v, spoiled_x)
    keep = np.delete(np.arange(64), [5, 9, 33, 40])
    assert equal(jax.tree.map(lambda a: a[keep], good), jax.tree.map(lambda a: a[keep], bad))
    assert np.isfinite(good[1]).all()
    result = bad[0][4]
    assert np.all((result == RESULTS.nonfinite_field)[jnp.asarray([5, 9, 40])])
    assert np.array_equal(np.flatnonzero(result != RESULTS.successful), [5, 9, 33, 40])


class Mixed(nsjax.System):
    """x'' = -g above a floor, or stuck where `g` repels it from v = 0: every way to end."""

    g: float = 1.0
    e: float = 0.5
    a: float = 0.0

    def vector_field(self, t, y, s):
        return Motion(y.v, -self.g - self.a * s.drag + s.floor)

    @nsjax.impact
    def floor(self, t, y):
        return y.x

    @floor.restitution
    def floor(self):
        return self.e

    @nsjax.sgn
    def drag(self, t, y):
        return y.v


def test_every_lane_has_its_own_result():
    rows = [
        (RESULTS.successful, (1.0, 0.5, 0.0, 1.0, 0.0, 2.0)),
        (RESULTS.successful, (1.0, 0.5, 0.0, 1.0, 0.0, 60.0)),  # rests in the end
        (RESULTS.max_steps_reached, (1.0, 1.0, 0.0, 1.0, 0.0, 1e4)),
        (RESULTS.nonfinite_field, (np.nan, 0.5, 0.0, 1.0, 0.0, 2.0)),
        (RESULTS.repulsive_sliding, (0.0, 0.5, -1.0, 1.0, 0.0, 2.0)),
        (RESULTS.start_penetrates, (1.0, 0.5, 0.0, -1.0, 0.0, 2.0)),
        (RESULTS.wrong_parameter, (1.0, -0.5, 0.0, 1.0, 0.0, 5.0)),
    ]

    @jax.jit
    @jax.vmap
    def run(p):
        sol = solve(
            Mixed(g=p[0], e=p[1], a=p[2]),
            0.0,
            p[5],
            Motion(p[3], p[4]),
            throw=False,
            max_steps=1000,
            max_events=100,
            **CHEAP,
        )
        return sol.result, sol.t1, jnp.max(jnp.where(jnp.isfinite(sol.events.t), sol.events.t, 0))

    result, t1, last = run(jnp.asarray([row for _, row in rows]))
    for i, (want, _) in enumerate(rows):
        assert (result == want)[i], i
    assert t1[0] == 2 and t1[2] < 1e4 and t1[4] == 0
    # Flights of 2 √2, halved every time: t = √2 (1 + 2 (1/2 + 1/4 + ...)).
    np.testing.assert_allclose(last[1], 3 * np.sqrt(2), rtol=1e-6)


@pytest.mark.slow
def test_map_in_batches_and_nested_vmap():
    v, x = lanes(64)
    batch = jax.jit(jax.vmap(one))(v, x)
    chunks = jax.jit(lambda v, x: lax.map(lambda p: one(*p), (v, x), batch_size=16))(v, x)
    nested = jax.jit(jax.vmap(jax.vmap(one)))(v.reshape(8, 8), x.reshape(8, 8))
    for other in (chunks, jax.tree.map(lambda a: a.reshape(64, *a.shape[2:]), nested)):
        assert np.array_equal(other[2], batch[2])
        for a, b in zip(jax.tree.leaves(other), jax.tree.leaves(batch), strict=True):
            np.testing.assert_allclose(a, b, rtol=1e-12, atol=1e-12)


@pytest.mark.slow
def test_nothing_mapped_and_only_the_end_mapped():
    """Axes on which neither the start nor the system depends."""
    t1 = jnp.asarray([10.0, 40.0, 100.0])
    sol = jax.jit(
        jax.vmap(lambda t1: solve(gallery.StickSlip(v_dr=0.5), 0.0, t1, Motion(2.5, -0.5), throw=False, **CHEAP))
    )(t1)
    np.testing.assert_allclose(sol.t1, t1)
    assert np.all(np.diff(sol.events.num) > 0)
    np.testing.assert_allclose(sol.events.t[0, :2], sol.events.t[2, :2], rtol=1e-12)
