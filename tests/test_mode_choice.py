"""Which mode a solution takes where switches are at their surfaces, and whether that is the only one."""

import collections
import functools

import diffrax as dfx
import jax
import jax.numpy as jnp
import mode_choice
import numpy as np
import pytest
from jax import Array
from mode_choice import Linear
from models import Motion, pid, Point

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


@pytest.mark.parametrize("m", [1, 2, 3])
def test_every_assignment(m):
    """Items 7 and 10, pitfalls 34, 38 and 39: the mode at the start and after each arrival, `unique` and the status,
    against an oracle that tries all assignments: thousands of random fields, of which hundreds have several solutions,
    and hundreds are held by a surface that would repel alone."""
    rng = np.random.default_rng(m)
    cases, paths = [], []
    while len(cases) < 3000:
        case = mode_choice.generate(rng, m)
        try:
            path = mode_choice.follow(case, 1.0)
        except mode_choice.Edge:
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
    assert seen["several"] >= 100 and seen["unique"] >= 1000 and seen["repulsive"] >= 100
    if m > 1:
        assert seen["repels alone"] >= 50 and seen["arrivals"] >= 1000
