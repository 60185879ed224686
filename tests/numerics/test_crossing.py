"""Roots of guards: none missed, none out of order."""

import math

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from models import Roots

import nsjax
from nsjax._numerics._bernstein import (
    bend,
    binomials,
    deflate,
    first_root,
    first_roots,
    largest,
    no_root,
    nodes,
    to_bernstein,
    to_chebyshev,
)


def evaluate(c, u):
    """A polynomial in Bernstein form, by de Casteljau's scheme."""
    c = np.asarray(c)
    while c.shape[-1] > 1:
        c = c[..., :-1] + u * (c[..., 1:] - c[..., :-1])
    return c[..., 0]


def bernstein(power: np.ndarray) -> np.ndarray:
    """Bernstein coefficients on [0, 1] of Σ power[..., i] τ^i."""
    n = power.shape[-1] - 1
    m = np.array([[math.comb(j, i) / math.comb(n, i) if i <= j else 0.0 for i in range(n + 1)] for j in range(n + 1)])
    return power @ m.T


def from_roots(roots: np.ndarray) -> np.ndarray:
    return np.array([np.polynomial.polynomial.polyfromroots(r) for r in roots])


def coefficients(c: jax.Array) -> list[jax.Array]:
    """Those of the library from Bernstein coefficients along the last axis."""
    n = c.shape[-1] - 1
    return [w * c[..., j] for j, w in enumerate(binomials(n))]


search = jax.jit(jax.vmap(lambda c: first_root(coefficients(c))))


def test_first_roots_of_many():
    """Of a hundred polynomials only those with sign changes are looked at, some together: the answers are the same."""
    c = np.random.default_rng(0).normal(1.0, 0.8, size=(3, 100, 1, 7))  # in three lanes of a batch
    c[1] = np.abs(c[1]) + 0.1
    c[2, ::2, 0, 0] = -1.0
    found, root = jax.jit(jax.vmap(lambda c: first_roots(coefficients(c))))(jnp.asarray(c))
    alone, place = (np.reshape(x, (3, 100)) for x in search(jnp.asarray(c.reshape(300, 1, 7))))
    assert 20 < np.sum(alone[0]) < 80 and not np.any(alone[1]) and np.sum(alone[2]) > 50
    np.testing.assert_array_equal(found, alone)
    np.testing.assert_array_max_ulp(root, place, 1)  # two programs, which may round differently


@pytest.mark.parametrize("n", [1, 4, 8])
def test_polynomial_bases(n):
    rng = np.random.default_rng(n)
    power = rng.normal(size=n + 1)
    c, u = bernstein(power), rng.uniform(size=7)
    exact = np.polynomial.polynomial.polyval(u, power)
    values = np.polynomial.polynomial.polyval(nodes(n), power)
    np.testing.assert_allclose(to_bernstein(n) @ values, c, atol=1e-11)
    np.testing.assert_allclose([evaluate(jnp.asarray(c), x) for x in u], exact, atol=1e-13)
    assert largest(coefficients(jnp.asarray(c))) == abs(c).max()
    curved = np.polynomial.polynomial.polyval(u, np.polynomial.polynomial.polyder(power, 2))
    assert all(np.sign(bend(coefficients(jnp.asarray(c)), jnp.asarray(x))) == np.sign(y) for x, y in zip(u, curved))
    chebyshev = np.polynomial.chebyshev.chebval(2 * u - 1, to_chebyshev(n) @ values)
    np.testing.assert_allclose(chebyshev, exact, atol=1e-13)
    for k in (1, 2)[:n]:
        lifted = bernstein(np.concatenate([np.zeros(k), power[: n + 1 - k]]))  # τ^k p, of degree n
        low = np.polynomial.polynomial.polyval(u, power[: n + 1 - k])
        a = deflate(coefficients(jnp.asarray(lifted)), jnp.asarray(k))
        got = [evaluate(np.array(a) / binomials(n), x) for x in u]
        np.testing.assert_allclose(got, low, atol=1e-12)


def test_first_root_of_random_polynomials():
    """Pitfall 5: against the roots they were made from; close pairs, multiple roots, roots at the ends, none."""
    rng = np.random.default_rng(0)
    count, degree = 3000, 6
    roots = rng.uniform(-0.3, 1.3, (count, degree))
    kind = np.arange(count) % 6
    roots[kind == 1, 1] = roots[kind == 1, 0] + 10.0 ** rng.uniform(-6, -2, count)[kind == 1]
    roots[kind == 2, 1] = roots[kind == 2, 0]
    roots[kind == 3] = rng.uniform(1.01, 2, (count, degree))[kind == 3]
    roots[kind == 4, 0] = 1.0
    roots[kind == 5, :3] = roots[kind == 5, :1]
    power = from_roots(roots)
    power *= np.sign(power[:, :1]) * 10.0 ** rng.uniform(-12, 12, (count, 1))  # positive at the start; pitfall 27
    parts = np.split(bernstein(power)[:, None], 10)  # of a size that another test has
    found, tau = map(np.concatenate, zip(*map(search, parts)))
    inside = np.where((roots >= 0) & (roots <= 1), roots, np.inf)
    first = inside.min(1)
    # What rounding of the coefficients (1e-16 of the largest) may do to a root, by its multiplicity.
    scale = abs(power).max(1)
    for i in range(count):
        others = np.abs(np.delete(roots[i], np.argmin(abs(roots[i] - first[i]))) - first[i])
        if np.isinf(first[i]):
            assert not found[i]
            continue
        order = 1 + np.sum(others < 1e-5)
        lead = abs(power[i, -1]) * np.prod(others[others >= 1e-5])
        slack = 10 * (1e-14 * scale[i] / lead) ** (1 / order) + 1e-14
        edge = first[i] > 1 - slack or order % 2 == 0  # rounding may take these roots away
        assert found[i] or edge, (i, roots[i])
        if found[i] and not (edge and abs(tau[i] - first[i]) > slack):
            assert abs(tau[i] - first[i]) <= slack, (i, tau[i], first[i], roots[i])
        elif found[i]:  # a double root that vanished: then it is the next one
            assert np.min(abs(roots[i] - tau[i])) <= 1e-6


@pytest.mark.parametrize("end", [0.0, 1e-17, -1e-17])
def test_root_at_the_end_does_not_hide_an_earlier_one(end):
    """Pitfall 9: the guard vanishes at the end of the step, and before."""
    c = jnp.asarray([1.0, 0.1, -0.5, end])[None, None]
    exact = np.roots([np.polynomial.polynomial.Polynomial(p).coef for p in [[1, -2.7, 0.9, 0.8]]][0][::-1])
    assert exact.real.min() is not None
    found, tau = search(c)
    assert found[0] and abs(evaluate(c[0, 0], tau[0])) < 1e-15 and tau[0] < 0.5


def test_earlier_root_of_polynomials_that_vanish_at_the_end():
    """Pitfall 9, many at once: the end value is rounding, of the sign that hides the last root."""
    rng = np.random.default_rng(4)
    count = 2000
    r = np.stack([rng.uniform(0.02, 0.95, count), np.ones(count), 1 + 10.0 ** rng.uniform(-3, -1, count)], -1)
    c = bernstein(from_roots(np.concatenate([r, r[:, 2:]], -1)))
    c *= np.sign(c[:, :1])
    c[:, -1] = -1e-17
    found, tau = search(jnp.asarray(c)[:, None])
    assert np.all(found)
    np.testing.assert_allclose(tau, r[:, 0], atol=1e-11)


def test_maximum_of_two_parts():
    """A slot is the maximum over its parts: it fires when the last of them has become non-positive."""
    a, b = bernstein(from_roots(np.array([[0.3, 1.2], [0.6, 0.7]])))
    pairs = [a, -np.ones(3)], [a, b], [a, 1e-3 + 0 * b], [-a, b], [a, -a]
    found, tau = search(jnp.asarray(pairs))
    assert list(found) == [True, True, False, False, True]  # -a is positive from 0.3 on, so that one part always is
    np.testing.assert_allclose(tau[np.array([0, 1, 4])], [0.3, 0.6, 0.3], atol=1e-14)
    assert not no_root(coefficients(jnp.asarray([a, b])))
    assert no_root(coefficients(jnp.asarray([a, np.ones(3)])))


def test_parts_that_fall_once_each():
    """Their maximum falls to zero with the last of them, however near the others are; a part that is never positive
    has no say."""
    rng = np.random.default_rng(1)
    c = np.sort(rng.normal(size=(400, 3, 6)), axis=-1)[..., ::-1].copy()
    c[:200, 1] = c[:200, 0] + 1e-9 * rng.normal(size=(200, 1))  # nearly equal
    c[::4, 2] = -np.abs(c[::4, 2])  # never positive
    found, root = search(jnp.asarray(c))
    start, end = c[..., 0].max(axis=1), c[..., -1].max(axis=1)
    np.testing.assert_array_equal(found, (start <= 0) | (end <= 0))
    crosses = (start > 0) & (end <= 0)
    assert crosses.sum() > 100
    low, high = np.zeros(400), np.ones(400)
    for _ in range(60):
        middle = (low + high) / 2
        above = np.array([max(evaluate(part, u) for part in row) for row, u in zip(c, middle)]) > 0
        low, high = np.where(above, middle, low), np.where(above, high, middle)
    np.testing.assert_allclose(np.asarray(root)[crosses], low[crosses], rtol=0, atol=1e-12)
    assert np.all(np.asarray(root)[found & (start <= 0)] == 0)


# The property test of the flow: prescribed roots, found by `solve`.

KINDS = ("generic", "close pair", "double", "simultaneous", "at t0", "at t1", "cluster")


def make(count: int, seed: int = 0):
    rng = np.random.default_rng(seed)
    r = rng.uniform(-0.1, 1.1, (count, 3, 4))
    kind = rng.integers(0, len(KINDS), (count, 3))
    gap = 10.0 ** rng.uniform(-6, -2, (count, 3))
    for k in range(3):
        r[:, k, 1] = np.where(kind[:, k] == 1, r[:, k, 0] + gap[:, k], r[:, k, 1])
        r[:, k, 1] = np.where(kind[:, k] == 2, r[:, k, 0], r[:, k, 1])
        r[:, k, 1] = np.where((kind[:, k] == 3) & (k > 0), r[:, k - 1, 0], r[:, k, 1])
        r[:, k, 0] = np.where(kind[:, k] == 4, 0.0, np.where(kind[:, k] == 5, 1.0, r[:, k, 0]))
        for j in (2, 3):
            r[:, k, j] = np.where(kind[:, k] == 6, r[:, k, 1] + 1e-3 * (j - 1), r[:, k, j])
    return r, rng.choice([-1, 1], (count, 3)) * 10.0 ** rng.uniform(-1, 1, (count, 3)), kind


@jax.jit
@jax.vmap
def run(roots, scale):
    system = Roots(roots, scale)
    return nsjax.solve(system, 0.0, 1.0, system.start(), max_events=32, throw=False)


@pytest.mark.parametrize("count", [500, pytest.param(10_000, marks=pytest.mark.slow)])
def test_no_root_missed_and_none_out_of_order(count):
    """Pitfalls 2, 5, 6, 7, 9, 10: quartic guards with prescribed roots, generic, close (1e-6 to 1e-2), double,
    clustered, common to two switches, at t0, at t1. The solution knows for how long each guard was positive."""
    r, scale, kind = make(count)
    sol = jax.tree.map(np.asarray, run(r, scale))
    assert np.all(nsjax.is_okay(sol.result)), np.flatnonzero(~nsjax.is_okay(sol.result))
    t = np.where(np.isfinite(sol.events.t), sol.events.t, 2.0)
    assert np.all(np.diff(t, axis=1) >= 0)
    inside = np.sort(np.clip(r, 0, 1), axis=-1)
    ends = np.concatenate([np.zeros((count, 3, 1)), inside, np.ones((count, 3, 1))], -1)
    middle = 0.5 * (ends[..., 1:] + ends[..., :-1])
    sign = np.sign(scale)[..., None] * np.prod(np.sign(middle[..., None] - r[:, :, None, :]), -1)
    truth = np.sum(np.diff(ends) * sign, -1)
    ordered = np.sort(r, axis=-1)
    triple = np.min(ordered[..., 2:] - ordered[..., :-2], axis=-1) < 1e-5  # by chance, one in ten thousand
    limit = np.where(triple, 4e-5, 1e-5)  # 1e-14 cube-rooted; of double roots square-rooted, and some
    assert np.all(np.abs(sol.y1.z - truth) < limit)
    for i, k in np.ndindex(count, 3):
        for root in r[i, k][(r[i, k] > 0) & (r[i, k] < 1)]:
            others = np.sort(abs(r[i, k] - root))[1:]
            if others[0] > 0:  # a simple root
                slack = 1e-13 + 1e-14 / np.prod(others)
                assert np.min(abs(t[i][sol.events.switch[i] == k] - root), initial=2) < slack, (i, KINDS[kind[i, k]])


@pytest.mark.parametrize("degree", [7, 12])
def test_steep_polynomial(degree):
    """Pitfall 8: arctan(50 (r - τ)) as a polynomial of that degree; Newton's method from most places leaves [0, 1]."""
    place = jax.jit(jax.vmap(lambda c: first_root(coefficients(c[None]))))
    r = np.linspace(0.02, 0.98, 97)
    values = np.arctan(50 * (r[:, None] - nodes(degree)))
    c = values @ to_bernstein(degree).T
    found, root = place(jnp.asarray(c))
    assert np.all(found)
    for ci, u in zip(c, np.asarray(root)):
        assert abs(evaluate(ci, u)) < 1e-13 * np.abs(ci).max()
        grid = np.linspace(0, max(u - 1e-6, 0), 500)
        assert min(evaluate(ci, x) for x in grid) > 0


@pytest.mark.parametrize("degree", [2, 6, 9])
def test_root_next_to_its_mirror_image(degree):
    """δ² - τ² falls to zero at δ; with a small δ a step of Newton's or Halley's method from 0 says nothing."""
    place = jax.jit(lambda c: first_root(coefficients(c[None])))
    for delta in 10.0 ** -np.arange(1, 8):
        c = bernstein(np.array([delta**2, 0, -1, *[0] * (degree - 2)]))
        found, root = place(jnp.asarray(c))
        assert found
        np.testing.assert_allclose(root, delta, rtol=1e-14 / delta)
