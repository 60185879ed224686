"""Several friction elements on one velocity, pitfall 37: only the sum of their forces is determined, so that
they must move as one element does whose strength is the sum of theirs."""

import functools
from typing import Any, NamedTuple

import diffrax as dfx
import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from jax import Array
from models import flat, itinerary, Motion, pid, times

import nsjax
from nsjax import RESULTS, solve


class Loads(NamedTuple):
    x: Array
    v: Array
    spent: Array  # ∫ s dt of each element


class Belt(nsjax.System):
    """x'' = a cos t - x - Σ F_i s_i, s_i in Sgn(c_i (v - v_dr)) with |λ_i| <= b_i."""

    F: Array
    b: Array
    c: Array
    a: float = 0.0
    v_dr: float = 0.2
    tuples: tuple[int, ...] = eqx.field(static=True, default=())  # the elements that have a corner, far away

    @property
    def switches(self):
        return _elements(self.F.shape[0], self.tuples)

    def vector_field(self, t, y, s):
        values = jnp.stack([s[k.name] for k in self.switches])
        return Loads(y.v, self.a * jnp.cos(t) - y.x - self.F @ values, values)


@functools.cache
def _elements(m, tuples) -> tuple[Any, ...]:
    def element(i):
        def guard(self, t, y):
            h = self.c[i] * (y.v - self.v_dr)
            return (h + 50 * self.c[i], h, h + 60 * self.c[i]) if i in tuples else h

        return nsjax.sgn(guard, name=f"e{i}").breakaway(lambda self: self.b[i])

    return tuple(element(i) for i in range(m))


class One(nsjax.System):
    """The same with one element."""

    F: float
    b: float
    a: float = 0.0
    v_dr: float = 0.2

    def vector_field(self, t, y, s):
        return Motion(y.v, self.a * jnp.cos(t) - y.x - self.F * s.belt)

    @nsjax.sgn
    def belt(self, t, y):
        return y.v - self.v_dr

    @belt.breakaway
    def belt(self):
        return self.b


TIGHT = dict(stepsize_controller=pid(1e-10), max_events=32)
STARTS = {"slipping": (2.5, -0.5), "sticking": (0.3, 0.2), "at the bound": (-1.5, 0.2), "beyond it": (1.9, 0.2)}
BELOW = [
    -3.0,
    -2.5,
    -2.0,
    -1.5,
    -1.0,
    -0.5,
    0.0,
    0.3,
    0.5,
    1.0,
    1.5,
    2.0,
    2.5,
    3.0,
]  # on the belt, all along the spring
GROUPS = {
    "alike": ([0.75, 0.75], [1.0, 1.0], [1.0, 1.0]),
    "two": ([1.0, 0.5], [1.0, 1.0], [1.0, 2.0]),
    "static": ([1.0, 0.5], [1.0, 2.0], [1.0, 1.0]),
    "static, in other units": ([1.0, 0.5], [1.6, 1.2], [1.0, 1e-6]),
    "small": ([1.0, 0.5], [1.0, 1.2], [1e-12, 1e-12]),
    "large": ([1.0, 0.5], [1.0, 1.2], [1e12, 1e12]),
    "small and large": ([1.0, 0.5], [1.0, 1.2], [1e-12, 1e12]),
    "three": ([0.3, 0.5, 0.7], [1.0, 1.5, 1.2], [1.0, -1.0, 3.0]),
    "five": ([0.3, 0.1, 0.7, 0.2, 0.2], [1.0, 1.5, 1.2, 1.0, 1.0], [1.0, 2.0, 3.0, 1e-6, 1.0]),
}


def group(name, a=0.0, **kwargs):
    """Elements, with the sign with which each resists; and the single one that is equal to them."""
    F, b, c = map(np.array, GROUPS[name])
    many = Belt(*map(jnp.asarray, (F * np.sign(c), b, c)), a=a, **kwargs)
    return many, One(float(F.sum()), float(F @ b / F.sum()), a=a)


def start(system, x, v):
    return Loads(jnp.asarray(x), jnp.asarray(v), jnp.zeros(system.F.shape))


@functools.partial(jax.jit, compiler_options={"xla_backend_optimization_level": 0})
def run(many, one, t1):
    """The elements from all starts and from `BELOW`, and the one that is equal to them: programs that tests share."""

    def both(x, v):
        y0 = Loads(x, v, jnp.zeros(many.F.shape)), Motion(x, v)
        return [solve(m, 0.0, t1, y, throw=False, **TIGHT) for m, y in zip((many, one), y0)]

    return jax.vmap(both)(*jnp.asarray([*STARTS.values(), *((x, 0.2) for x in BELOW)]).T)


def lane(sol, x):
    """The solution that started at `x` of `BELOW`."""
    return jax.tree.map(lambda a: a[len(STARTS) + BELOW.index(x)], eqx.filter(sol, eqx.is_array))


@pytest.mark.slow
@pytest.mark.parametrize("name", GROUPS)
def test_elements_that_move_as_one(name):
    """Same events at the same times, one of them for all elements; same motion; and as unique."""
    many, one = group(name, a=0.4)
    sol, want = run(many, one, 40.0)
    signs = np.sign(np.asarray(many.c)).astype(int)
    assert np.all(sol.result == RESULTS.successful) and np.all(sol.events.num > 0)
    np.testing.assert_array_equal(sol.unique, want.unique)
    np.testing.assert_array_equal(sol.mode0, signs * np.asarray(want.mode0))
    np.testing.assert_array_equal(sol.events.num, want.events.num)
    np.testing.assert_allclose(sol.events.t, want.events.t, atol=1e-8)
    modes, single = np.asarray(sol.events.mode_after), np.asarray(want.events.mode_after)
    np.testing.assert_array_equal(np.where(modes == -128, 0, modes), np.where(single == -128, 0, signs * single))
    np.testing.assert_allclose([sol.y1.x, sol.y1.v], want.y1, atol=1e-8)


@pytest.mark.slow
def test_shares():
    """While they stick λ_i = θ b_i, each in the direction in which it resists: ∫λ_i dt over a stick phase, here from
    x = -1 to 1 with θ = -x / ΣF b, and the same whatever the order of declaration."""
    F, b, c = map(np.array, GROUPS["three"])
    F = F * np.sign(c)
    t1 = 6.0
    for order in ([0, 1, 2], [2, 0, 1], [1, 2, 0]):
        system = Belt(*(jnp.asarray(a[order]) for a in (F, b, c)))
        sol = lane(run(system, group("three")[1], t1)[0], -1.0)
        assert sol.events.num == 0
        theta = (1.0 * t1 - 0.1 * t1**2) / np.sum(abs(F) * b)
        np.testing.assert_allclose(sol.y1.spent, (theta * b * np.sign(c))[order], atol=1e-12)


@pytest.mark.slow
@pytest.mark.parametrize("solver", [nsjax.Taylor(), nsjax.Exponential(), dfx.Kvaerno5()])
def test_other_methods(solver):
    many, one = group("static")
    y0 = (2.5, -0.5)
    options = dict(solver=solver, max_steps=20_000)
    sol = solve(many, 0.0, 20.0, start(many, *y0), **options)
    want = solve(one, 0.0, 20.0, Motion(*y0), **TIGHT)
    np.testing.assert_allclose(times(sol), times(want), atol=1e-6)
    np.testing.assert_allclose([sol.y1.x, sol.y1.v], flat(want.y1), atol=1e-6)


@pytest.mark.parametrize("where", ["slipping", pytest.param("sticking", marks=pytest.mark.slow)])
def test_derivatives_through_sticking(where):
    """By parameters, strengths and start: those of the one element, and numbers."""
    x, v = STARTS[where]

    def many(p):
        F, b = p[2:4], p[4:6]
        system = Belt(F, b, p[8:], a=p[6], v_dr=p[7])
        return jnp.stack(solve(system, 0.0, 20.0, start(system, p[0], p[1]), **TIGHT).y1[:2])

    def one(p):
        F, b = p[2:4], p[4:6]
        system = One(jnp.sum(F), F @ b / jnp.sum(F), a=p[6], v_dr=p[7])
        return jnp.stack(solve(system, 0.0, 20.0, Motion(p[0], p[1]), **TIGHT).y1)

    p = jnp.asarray([x, v, 1.0, 0.5, 1.0, 1.4, 0.3, 0.2, 1.0, 2.0])
    got, want = jax.jacfwd(many)(p), jax.jacfwd(one)(p[:8])
    assert np.all(np.isfinite(got)) and np.max(np.abs(want)) > 0.1
    np.testing.assert_allclose(got[:, :8], want, atol=1e-6)
    np.testing.assert_allclose(got[:, 8:], 0, atol=1e-6)  # the units of the surfaces


def test_the_unit_of_a_surface_costs_no_steps():
    """Its derivative is zero but for rounding, for which no step must be shortened."""
    x, v = STARTS["slipping"]
    p = jnp.asarray([x, v, 1.0, 2.0])

    def end(p):
        system = Belt(jnp.asarray([1.0, 0.5]), jnp.asarray([1.0, 1.4]), p[2:], a=0.3)
        sol = solve(system, 0.0, 20.0, start(system, p[0], p[1]), **TIGHT)
        return sol.y1.x, sol.stats["num_steps"]

    steps = jax.jit(lambda direction: jax.jvp(end, (p,), (direction,))[0][1])
    by_x, by_v, by_first, by_second = map(steps, jnp.eye(4))
    assert by_first == by_second == by_x == by_v, (by_x, by_v, by_first, by_second)


@pytest.mark.slow
@pytest.mark.parametrize("tuples", [(0,), (1,), (0, 1)])
def test_one_component_of_a_corner(tuples):
    """The surfaces coincide where a certain component of a tuple is the least."""
    many, one = group("static", tuples=tuples)
    for y0 in ((2.5, -0.5), (0.3, 0.2), (-1.0, 1.4)):
        sol = solve(many, 0.0, 20.0, start(many, *y0), **TIGHT)
        want = solve(one, 0.0, 20.0, Motion(*y0), **TIGHT)
        assert sol.result == RESULTS.successful and len(sol.events) == len(want.events)
        np.testing.assert_allclose(times(sol), times(want), atol=1e-8)
        np.testing.assert_allclose([sol.y1.x, sol.y1.v], flat(want.y1), atol=1e-8)


class Blocks(nsjax.System):
    """Two blocks on a belt, coupled by a spring; on the first one two friction elements, or one as strong; between the
    blocks another."""

    F: Array
    joint: float = 0.3
    merged: bool = eqx.field(static=True, default=False)

    @property
    def switches(self):
        return _on_blocks(self.merged)

    def vector_field(self, t, y, s):
        on_first = jnp.sum(self.F) * s.a if self.merged else self.F[0] * s.a + self.F[1] * s.b
        spring = y.x[1] - y.x[0]
        between = self.joint * s.c
        return Motion(y.v, jnp.stack([-y.x[0] + spring - on_first + between, 0.5 * (-spring - between - 0.4 * s.d)]))


@functools.cache
def _on_blocks(merged) -> tuple[Any, ...]:
    a = nsjax.sgn(lambda self, t, y: y.v[0] - 0.2, name="a")
    b = nsjax.sgn(lambda self, t, y: 3 * (y.v[0] - 0.2), name="b")
    c = nsjax.sgn(lambda self, t, y: y.v[1] - y.v[0], name="c")
    d = nsjax.sgn(lambda self, t, y: y.v[1] + 0.1, name="d")
    return (a, c, d) if merged else (a, b, c, d)


@pytest.mark.slow
def test_beside_other_surfaces():
    """Two surfaces that coincide and two that do not, all of which act on one another."""
    F = jnp.asarray([0.6, 0.4])
    met = 0
    for x, v in (
        ([1.0, -1.0], [0.2, 0.2]),
        ([2.0, 1.0], [0.0, 0.0]),
        ([0.2, 0.1], [0.2, -0.1]),
        ([-2.0, 2.0], [0.5, 1]),
    ):
        y0 = Motion(jnp.asarray(x), jnp.asarray(v, float))
        sol, want = (solve(Blocks(F, merged=m), 0.0, 20.0, y0, **TIGHT) for m in (False, True))
        assert sol.result == RESULTS.successful and sol.unique == want.unique
        assert [[m[k] for k in "acd"] for m in sol.itinerary] == [[m[k] for k in "acd"] for m in want.itinerary]
        assert all(m["a"] == m["b"] for m in sol.itinerary)
        np.testing.assert_allclose(times(sol), times(want), atol=1e-7)
        np.testing.assert_allclose(np.concatenate(sol.y1), np.concatenate(want.y1), atol=1e-7)
        met += len(sol.events)
    assert met > 20


@pytest.mark.slow
def test_effects_of_opposite_sign():
    """An element that pushes along (anti-friction) takes its share of the load against its own direction: together they
    hold until both are spent, |x| = F_1 + F_2, though beyond F_1 - F_2 they might slip: a static point of their own.
    It is known to arrive there with |x| < F_1 - F_2 only from within; elsewhere there are two solutions."""
    system = Belt(jnp.asarray([1.0, -0.5]), jnp.ones(2), jnp.ones(2))
    inside, alike = run(system, One(0.5, 3.0), 30.0)
    inside, alike = lane(inside, 0.3), lane(alike, 0.3)
    beyond, same = run(system, One(0.5, 3.0), 0.1)
    beyond, same = lane(beyond, 1.0), lane(same, 1.0)
    assert inside.events.num >= 3
    np.testing.assert_allclose(times(inside), times(alike), atol=1e-8)
    np.testing.assert_allclose([inside.y1.x, inside.y1.v], flat(alike.y1), atol=1e-8)
    assert not beyond.unique and list(beyond.mode1) == [0, 0]
    assert not same.unique
    np.testing.assert_allclose(times(inside)[0], (1.5 - 0.3) / 0.2, rtol=1e-9)


def test_parallel_effects_on_different_surfaces():
    """v = 0 and x + v = 1 are pushed by the same forces, but cross each other: the multiplier matrix is singular, and
    no split holds both but at rest, x = 1, v = 0."""

    class Crossed(nsjax.System):
        force: float

        def vector_field(self, t, y, s):
            return Motion(y.v, self.force - s.a - 0.3 * s.b)

        @nsjax.sgn
        def a(self, t, y):
            return y.v - 0.5

        @nsjax.sgn
        def b(self, t, y):
            return y.x + y.v - 1

    # On v = 0.5 it passes x + v = 1 at t = 1: λ_a = force ± 0.3 before and after.
    sol = solve(Crossed(0.2), 0.0, 2.0, Motion(0.0, 0.5), **TIGHT)
    assert sol.result == RESULTS.successful and itinerary(sol) == [("b", -1, 1)]
    np.testing.assert_allclose(times(sol), 1, atol=1e-9)
    np.testing.assert_allclose(flat(sol.y1), [1, 0.5], atol=1e-9)
    sol = solve(Crossed(0.2), 0.0, 2.0, Motion(0.5, 0.5), **TIGHT)
    np.testing.assert_allclose(flat(sol.y1), [1.5, 0.5], atol=1e-9)


@pytest.mark.slow
def test_batch():
    """Lanes with and without sticking."""
    sol, want = run(*group("static"), 15.0)
    assert np.all(sol.result == RESULTS.successful)
    np.testing.assert_allclose([sol.y1.x, sol.y1.v], want.y1, atol=1e-8)
