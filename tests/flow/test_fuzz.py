"""The flow against exact solutions of random piecewise-affine systems: same events, times, states, modes, derivatives."""

import collections
import functools

import diffrax as dfx
import exact
import jax
import numpy as np
import pytest
from affine import Affine
from exact import Case, Shape
from trajectory import assert_slopes_agree, count, share, Solved, tightly, told_but_ambiguous


# One compiled program each.
SHAPES = {
    "friction": (Shape(2, 1, 0, 0, forced=True, moving=False), dfx.Tsit5()),
    "corners": (Shape(4, 3, 0, 0, forced=True, moving=True), dfx.Tsit5()),
    "relays": (Shape(3, 2, 1, 0, forced=False, moving=False), dfx.Dopri8()),
    "bounce": (Shape(2, 0, 1, 1, forced=True, moving=True), dfx.Tsit5()),
    "walls": (Shape(4, 1, 1, 2, forced=True, moving=False), dfx.Tsit5()),
    "rest": (Shape(4, 1, 0, 2, forced=True, moving=True, rest=True), dfx.Tsit5()),
    "all": (Shape(6, 3, 2, 1, forced=False, moving=False), dfx.Tsit5()),
}
MAX_EVENTS = 40


# Compiling is what takes long, not running.
@functools.partial(
    jax.jit,
    static_argnames=("shape", "solver", "derive"),
    compiler_options={"xla_backend_optimization_level": 0},
)
def run(cases: Case, shape: Shape, solver: dfx.AbstractSolver, derive: bool) -> Solved:
    def one(case: Case):
        def flow(y0):
            sol = tightly(Affine(*case[:7], shape), case.t1, y0, solver, MAX_EVENTS)
            return sol.y1, sol

        jacobian, sol = jax.jacfwd(flow, has_aux=True)(case.y0) if derive else (None, flow(case.y0)[1])
        return Solved.of(sol, jacobian)

    return jax.vmap(one)(cases)


def fuzz(name: str, number: int, seed: int, derive: bool) -> tuple[collections.Counter, list]:
    """How many cases agree, are told by a status, are too sensitive to compare; and those that are wrong."""
    (shape, solver), rng = SHAPES[name], np.random.default_rng(seed)
    cases = [exact.generate(rng, shape) for _ in range(number)]
    truths = [exact.solve(case, shape, MAX_EVENTS) for case in cases]
    # What has no solution must be told, and so gets a little longer.
    ends = [0.1 if t is None else t.t1 + 0.1 * (t.ends != "") for t in truths]
    batch = Case(*(np.stack(column) for column in zip(*[c._replace(t1=np.array(e)) for c, e in zip(cases, ends)])))
    out = [None if x is None else np.asarray(x) for x in run(batch, shape, solver, derive)]
    return count(truths, Solved(*out), (name, seed))


QUICK = ("friction",)


@pytest.mark.parametrize(
    "name", [*QUICK, *(pytest.param(name, marks=pytest.mark.slow) for name in ("relays", "corners"))]
)
def test_random_systems(name):
    tally, wrong = fuzz(name, 80, 0, derive=name == "friction")
    assert not wrong
    assert share(tally, "sensitive") <= 0.02
    assert told_but_ambiguous(tally) == 0 and share(tally, "needlessly told") <= 0.1


@pytest.mark.slow
@pytest.mark.parametrize("name", SHAPES)
@pytest.mark.parametrize("derive", [False, True])
def test_many_random_systems(name, derive):
    """More than 20,000 systems in all; the tally is printed."""
    tally, wrong = collections.Counter(), []
    for seed in [10] if derive else range(1, 10):
        more, bad = fuzz(name, 400, seed, derive=derive)
        tally, wrong = tally + more, wrong + bad
    print("\n" + ", ".join(f"{key}: {number}" for key, number in tally.items()))
    assert not wrong
    assert share(tally, "sensitive") <= 0.02
    assert told_but_ambiguous(tally) == 0 and share(tally, "needlessly told") <= 0.1


@pytest.mark.parametrize("name", [pytest.param(n, marks=[pytest.mark.slow] * (n not in QUICK)) for n in SHAPES])
def test_the_oracle_against_itself(name):
    """Its derivatives, by saltation matrices, are those of its solutions."""
    shape = SHAPES[name][0]
    assert_slopes_agree(
        functools.partial(exact.generate, shape=shape), lambda case: exact.solve(case, shape, MAX_EVENTS), 12, 6
    )
