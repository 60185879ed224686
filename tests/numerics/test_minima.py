"""The least values of functions along a path, however often they turn (pitfall 41), against closed forms."""

import diffrax as dfx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from models import Motion, pid

import nsjax
from nsjax._numerics._minima import minima, THETA


def along(*functions, orders=None, slack=0.0, span=1.0):
    """Of functions of the time, each a list of parts of which it is the largest, all with as many."""

    def sample(first, last, x):
        ts = span * (first + (last - first) * jnp.asarray(THETA))
        return ts, ts[:, None], last - first

    def values(ts, xs):
        rows = [jnp.stack([part(ts) for part in parts]) for parts in functions]
        return [jnp.stack(rows)], jnp.full(len(functions), slack)

    orders = jnp.zeros((2, len(functions))) if orders is None else orders
    return jax.jit(lambda: minima(sample, values, jnp.zeros(1), orders, sums=jnp.zeros(())))()


def wave(t, peaks):
    return jnp.cos(2 * np.pi * peaks * t) + 0.3 * jnp.cos(2 * np.pi * 0.97 * peaks * t + 1)


@jax.jit
def extremes(peaks):
    return along([lambda t: wave(t, peaks)], [lambda t: -wave(t, peaks)])


@pytest.mark.parametrize("peaks", [1, 7, 40, 300, 3000])
def test_many_peaks(peaks):
    """The deepest of many dips, whose depths change slowly from one to the next."""
    t = np.linspace(0, 1, 400 * peaks + 1)
    t = t[np.argmin(np.asarray(wave(t, peaks)))]
    slope, bend = jax.grad(wave), jax.grad(jax.grad(wave))
    for _ in range(20):
        t = np.clip(t - slope(t, peaks) / bend(t, peaks), 0, 1)
    found = extremes(float(peaks))
    np.testing.assert_allclose(found.least[0], wave(t, peaks), rtol=1e-9)
    assert found.least[0] < float(wave(found.xs[:, 0], peaks).min()) or peaks == 1
    np.testing.assert_allclose(found.x[:, 0], found.share, atol=1e-9)
    np.testing.assert_allclose(wave(found.share[0], peaks), found.least[0], atol=1e-9)
    np.testing.assert_allclose(found.sums, 1, rtol=1e-14)


def test_dips_beside_the_ends():
    """Between the last two nodes a dip is seen only by the polynomial, which is even about the end."""
    offsets = np.concatenate([np.linspace(-0.02, 0.02, 401), np.linspace(-1e-4, 1e-4, 201)])
    found = along(*([lambda t, a=a: -jnp.cos(2 * np.pi * (t - a))] for a in offsets), span=1.0)
    np.testing.assert_allclose(found.least, -1, rtol=1e-13)
    apart = np.asarray(found.share) - offsets
    np.testing.assert_allclose(apart, np.round(apart), atol=1e-7)


def test_dips_of_nearly_one_depth():
    """Which of two dips is the deeper is not decided at the nodes, where one of them is seen and the other is not."""

    @jax.jit
    def dips(low, high):
        return along([lambda t: (t - low) ** 2 * (t - high) ** 2 + 1e-9 * (t - low)])

    for at in np.linspace(0.2, 0.3, 7):
        found = dips(at, at + 0.5)
        np.testing.assert_allclose(found.share[0], at, atol=1e-6)
        assert abs(found.least[0]) < 1e-12


def test_kinks():
    """A function with kinks is resolved by no polynomial, and where two parts of one meet is a kink."""
    found = along([lambda t: jnp.abs(t - 1 / 3)], [lambda t: 2 - jnp.abs(jnp.cos(40 * t))])
    np.testing.assert_allclose(found.least, [0, 1], atol=1e-6)
    found = along([lambda t: jnp.exp(t - 0.3) - 1, lambda t: 0.3 - t], [lambda t: (t - 0.7) ** 2, lambda t: -1 - t])
    np.testing.assert_allclose(found.least, 0, atol=1e-8)
    np.testing.assert_allclose(found.share, [0.3, 0.7], atol=1e-6)


def rest(t):
    return 1 + t + 0.999 * jnp.sin(30 * t)


@jax.jit
def between_zeros(before, after):
    guard = lambda t: t**before * (1 - t) ** after * rest(t)  # noqa: E731
    return along([guard], orders=jnp.stack([before, after])[:, None])


@pytest.mark.parametrize("before, after", [(1, 0), (1, 1), (2, 1), (0, 2), (3, 0)])
def test_zeros_at_the_ends(before, after):
    """Divided by them, it is least inside; a dip that comes down to zero is seen with them."""
    t = np.linspace(1e-3, 1 - 1e-3, 1_000_001)
    found = between_zeros(float(before), float(after))
    np.testing.assert_allclose(found.least[0], np.asarray(rest(t)).min(), rtol=1e-7, atol=1e-9)


def test_noise_ends():
    """What is all rounding is not resolved for ever: told how much does not matter, it is done at once."""
    found = along([lambda t: 1e-13 * jnp.sin(1e9 * t)], slack=1e-9)
    assert abs(found.least[0]) <= 2e-13
    found = along([lambda t: jnp.full_like(t, jnp.nan)])
    assert np.isnan(found.least[0])


def test_a_part_that_is_not_known():
    """What is NaN on a piece of the path is not told from the others."""
    found = along([lambda t: jnp.where(t < 0.4, jnp.cos(40 * t), jnp.nan)], [lambda t: -jnp.cos(40 * t)])
    assert np.isnan(found.least[0])
    np.testing.assert_allclose(found.least[1], -1, rtol=1e-12)


@pytest.mark.slow
def test_orbit_of_twelve_periods():
    """Pitfall 41: an arc with six peaks of nearly one height. Of 65 samples the largest stands beside
    another one, 2.244732 m; the reference is a fine table of the solution and the polynomial through its largest."""
    system = nsjax.gallery.ForcedStickSlip(omega=1.695)
    how = dict(solver=dfx.Tsit5(), stepsize_controller=pid(1e-12), max_steps=8192)
    orbit = nsjax.find_orbit(system, Motion(2.166922604, -0.486269223), order=12, **how)
    sol = nsjax.solve(system, 0.0, orbit.period, orbit.y0, saveat=dfx.SaveAt(dense=True), **how)
    ts = np.linspace(0, float(sol.t1), 40_001)
    x = np.asarray(jax.vmap(lambda t: sol(t).x)(jnp.asarray(ts)))
    i = int(np.argmax(x))
    peak = np.polynomial.Polynomial.fit(ts[i - 2 : i + 3] - ts[i], x[i - 2 : i + 3], 4)
    top = min(peak.deriv().roots(), key=abs).real
    assert np.sum((x[1:-1] > x[:-2]) & (x[1:-1] > x[2:])) > 5
    np.testing.assert_allclose(orbit.maximum(lambda t, y: y.x), peak(top), atol=1e-10)
