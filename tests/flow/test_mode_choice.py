"""Which mode a solution takes where switches are at their surfaces, and whether that is the only one."""

import collections
import functools

import jax
import jax.numpy as jnp
import mode_choice
import numpy as np
import pytest
from jax import Array
from mode_choice import Linear
from models import Point

import nsjax
from nsjax import RESULTS, solve


class Rubbing(nsjax.System):
    """y' = p + M s, s_k in Sgn(y_k) with breakaway bounds b."""

    p: Array
    M: Array
    b: Array

    @property
    def switches(self):
        return _surfaces(self.p.shape[0])

    def vector_field(self, t, y, s):
        return Point(self.p + self.M @ jnp.stack([s[k.name] for k in self.switches]))


@functools.cache
def _surfaces(m):
    def surface(i):
        switch = nsjax.sgn(lambda self, t, y: y.x[i], name=f"s{i}")
        return switch.breakaway(lambda self: self.b[i])

    return tuple(surface(i) for i in range(m))


@functools.partial(jax.jit, compiler_options={"xla_backend_optimization_level": 0})
@jax.vmap
def run(case):
    sol = solve(Rubbing(case.p, case.M, case.b), 0.0, 1.0, Point(case.y0), max_events=12, throw=False)
    return sol.mode0, sol.events.t, sol.events.mode_after, sol.unique, sol.result._value


def value(result):
    return int(np.asarray(result._value))


STATUS = {
    "": RESULTS.successful,
    "repulsive": RESULTS.repulsive_sliding,
    "open": RESULTS.ambiguous_event,
}


def crowded(case, path):
    """Whether five switches are at their surfaces at one instant."""
    return np.sum(case.y0 == 0) > 4 or any(mode.count(0) + 1 > 4 for mode in [path.mode0, *path.modes])


@pytest.mark.parametrize("m", [1, *(pytest.param(m, marks=pytest.mark.slow) for m in (2, 3, 5))])
def test_every_assignment(m):
    """Pitfalls 34, 38 and 39: the mode at the start and after each arrival, `unique` and the status,
    against an oracle that tries all assignments: thousands of random fields, of which hundreds have several solutions,
    and hundreds are held by a surface that would repel alone. (Of five switches, where up to four are at their surfaces:
    batches of them came to a standstill, and one that had to be found by trying was missed.)"""
    rng = np.random.default_rng(m)
    cases, paths = [], []
    while len(cases) < (3000 if m < 4 else 1500):
        case = mode_choice.generate(rng, m)
        try:
            path = mode_choice.follow(case, 1.0)
        except mode_choice.Edge:
            continue
        if crowded(case, path):
            continue
        cases.append(case)
        paths.append(path)
    mode0, t, modes, unique, result = map(np.asarray, run(Linear(*map(np.stack, zip(*cases)))))
    seen, wrong = collections.Counter(), []
    for i, (case, path) in enumerate(zip(cases, paths)):
        number = len(path.modes)
        same = result[i] == value(STATUS[path.result])
        if path.result != "open":
            same &= tuple(mode0[i]) == path.mode0 and unique[i] == path.unique
        same &= list(map(tuple, modes[i][:number])) == path.modes and np.allclose(t[i][:number], path.times[:number])
        if not same:
            wrong.append((i, case, path, mode0[i], t[i], modes[i], unique[i], result[i]))
        seen[path.result or ("unique" if path.unique else "several")] += 1
        every = [path.mode0, *path.modes]
        seen["repels alone"] += any(mode[k] == 0 and case.M[k, k] > 0 for mode in every for k in range(m))
        seen["arrivals"] += number
    print(seen)
    assert not wrong, (len(wrong), wrong[:3])
    assert seen["several"] >= 100 and seen["unique"] >= (1000 if m < 4 else 500) and seen["repulsive"] >= 100
    if m > 1:
        assert seen["repels alone"] >= 50 and seen["arrivals"] >= 1000


# A pair, y' = (p_0 - s_0 + g s_1, p_1 + g s_0 - s_1) from (-0.1, 0), with a static point of the first alone.
PAIRS = {
    "two modes": ((1.0, 0.5, 0.95, 2.1), False, (0, 1)),
    "one mode": ((-0.1, 1.34, 0.6, 1.2), True, (0, 1)),
}


@pytest.mark.parametrize("name", PAIRS)
def test_unique_by_the_mode_taken(name):
    """Pitfall 39: with both held, the first guess, |λ| > b; with the second let go the first can be held, and
    in one of two cases let go too."""
    (p0, p1, g, b), unique, mode = PAIRS[name]
    case = Linear(np.array([p0, p1]), np.array([[-1, g], [g, -1]]), np.array([b, 1.0]), np.array([-0.1, 0.0]))
    path = mode_choice.follow(case, 0.1)
    assert (path.unique, path.modes[-1]) == (unique, mode)
    sol = solve(Rubbing(*map(jnp.asarray, case[:3])), 0.0, 0.1, Point(jnp.asarray(case.y0)))
    assert sol.unique == unique and tuple(sol.mode1.tolist()) == mode


@pytest.mark.parametrize("unit", [1e-12, 1.0, 1e12])
@pytest.mark.parametrize("y0", [(0.0, 0.0), (0.3, -0.1), (-0.2, 0.05), (0.0, 0.3), (0.2, 0.0)])
def test_held_by_two_that_would_not_hold_alone(y0, unit):
    """Pitfall 38: y' = (0.5 a + 1.9 b, -0.5 a - 1.2 b). The first surface repels alone (0.5 > 0), and the second
    does while the first is slid on (-1.2 + 0.5 * 1.9 / 0.5 > 0); but all solutions come to the origin and stay there."""
    M = unit * np.array([[0.5, 1.9], [-0.5, -1.2]])
    system = Rubbing(jnp.zeros(2), jnp.asarray(M), jnp.ones(2))
    sol = solve(system, 0.0, 3.0, Point(unit * jnp.asarray(y0)), throw=False)
    assert sol.result == RESULTS.successful and sol.unique
    assert tuple(sol.mode1.tolist()) == (0, 0)
    np.testing.assert_allclose(sol.y1.x, 0, atol=1e-14 * unit)


@pytest.mark.slow
def test_many_surfaces():
    """Of six surfaces not every assignment is tried: two that are held as above, and two pairs of which the first guess is
    wrong (pitfall 39), of which one may have two solutions; the order of declaration is no matter."""
    M, p, b = np.zeros((6, 6)), np.zeros(6), np.ones(6)
    M[:2, :2] = [[0.5, 1.9], [-0.5, -1.2]]
    for last, unique in (("one mode", True), ("two modes", False)):
        for i, name in ((2, "one mode"), (4, last)):
            p[i], p[i + 1], g, b[i] = PAIRS[name][0]
            M[i : i + 2, i : i + 2] = [[-1, g], [g, -1]]
        for order in (np.arange(6), np.array([5, 3, 1, 4, 2, 0])):
            system = Rubbing(*(jnp.asarray(a) for a in (p[order], M[np.ix_(order, order)], b[order])))
            sol = solve(system, 0.0, 0.1, Point(jnp.zeros(6)), throw=False)
            assert sol.result == RESULTS.successful and sol.unique == unique, (order, last)
            np.testing.assert_array_equal(sol.mode1, np.array([0, 0, 0, 1, 0, 1])[order])
            # With the first two off their surfaces, all assignments of the others are tried.
            sol = solve(system, 0.0, 0.1, Point(jnp.asarray(np.where(order < 2, 0.3, 0.0))), throw=False)
            assert sol.result == RESULTS.successful and sol.unique == unique, (order, last)
            np.testing.assert_array_equal(sol.mode1, np.array([1, 1, 0, 1, 0, 1])[order])
