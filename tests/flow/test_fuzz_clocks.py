"""The flow against exact solutions of random piecewise-affine systems with functions of time that jump (clocks,
square waves, sawteeth, tables, in fields and guards): same events, times, states, modes, derivatives, both ways in time."""

import functools

import clocked
import diffrax as dfx
import equinox as eqx
import exact
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from affine import Affine, switches
from clocked import Case, Clocks, Shape
from trajectory import count, share, Solved, tightly, told_but_ambiguous

import nsjax


# One compiled program each.
SHAPES = {
    "square": (Shape(exact.Shape(2, 1, 0, 0, forced=True, moving=True), ("periodic",)), dfx.Tsit5()),
    "friction": (Shape(exact.Shape(2, 2, 0, 0, forced=True, moving=True), ("periodic", "listed")), dfx.Tsit5()),
    "relay": (Shape(exact.Shape(3, 1, 1, 0, forced=True, moving=True), ("periodic", "periodic")), dfx.Tsit5()),
    "contact": (Shape(exact.Shape(4, 1, 0, 1, forced=True, moving=True), ("periodic",)), dfx.Tsit5()),
}
MAX_EVENTS = 60


class Clocked(Affine):
    """`clocked.Case` as a model, written as a user would."""

    clocks: Clocks
    kinds: tuple[str, ...] = eqx.field(static=True)

    def signals(self, t):
        out = []
        for i, kind in enumerate(self.kinds):
            period, offset, times, levels = (x[i] for x in self.clocks)
            if kind == "periodic":
                phase = (t - offset) / period
                out += [jnp.where(jnp.floor(phase) % 2 == 0, levels[0], levels[1]), phase % 1.0]
            else:
                passed = jnp.searchsorted(times, t, side="right")
                out += [levels[passed], t - jnp.append(0.0, times)[passed]]
        return jnp.stack(out)

    @property
    def switches(self):
        return (*switches(self.shape), *_clocks(self.kinds))


@functools.cache
def _clocks(kinds: tuple[str, ...]) -> tuple[nsjax.clock, ...]:
    def made(i: int, kind: str) -> nsjax.clock:
        if kind == "listed":
            return nsjax.clock(lambda self: self.clocks.times[i], name=f"t{i}")
        return nsjax.clock(lambda self: self.clocks.period[i], name=f"t{i}").offset(lambda self: self.clocks.offset[i])

    return tuple(made(i, kind) for i, kind in enumerate(kinds))


# Compiling is what takes long, not running.
@functools.partial(
    jax.jit, static_argnames=("shape", "solver", "derive"), compiler_options={"xla_backend_optimization_level": 0}
)
def run(cases: Case, shape: Shape, solver: dfx.AbstractSolver, derive: bool) -> tuple[Solved, jax.Array | None]:
    """The solutions, and the derivatives of the state at the end by the periods of the clocks."""

    def one(case: Case):
        def flow(y0, period):
            clocks = case.clocks._replace(period=period)
            system = Clocked(*case.plain[:7], shape.plain, clocks, shape.clocks)
            sol = tightly(system, case.plain.t1, y0, solver, MAX_EVENTS)
            return sol.y1, sol

        at = (case.plain.y0, case.clocks.period)
        derivatives, sol = jax.jacfwd(flow, (0, 1), has_aux=True)(*at) if derive else ((None, None), flow(*at)[1])
        return Solved.of(sol, derivatives[0]), derivatives[1]

    return jax.vmap(one)(cases)


def fuzz(name: str, number: int, seed: int, direction: int = 1, derive: bool = False) -> tuple:
    """The cases, their solutions, and those found; how many agree, are told by a status, are too sensitive to compare;
    and those that are wrong."""
    (shape, solver), rng = SHAPES[name], np.random.default_rng(seed)
    cases = [clocked.generate(rng, shape) for _ in range(number)]
    if direction < 0:  # with static friction there are several
        cases = [c._replace(plain=c.plain._replace(bound=np.ones_like(c.plain.bound))) for c in cases]
    truths = [clocked.solve(case, shape, direction, MAX_EVENTS) for case in cases]
    # What has no solution must be told, and so gets a little longer.
    ends = [0.1 * direction if t is None else t.t1 + 0.1 * direction * (t.ends != "") for t in truths]
    cases = [c._replace(plain=c.plain._replace(t1=np.array(e))) for c, e in zip(cases, ends)]
    batch = jax.tree.map(lambda *xs: np.stack(xs), *cases)
    found, by_period = jax.tree.map(np.asarray, run(batch, shape, solver, derive))
    return cases, truths, by_period, *count(truths, found, (name, seed, direction))


def check(tally: dict, wrong: list) -> None:
    assert not wrong
    assert tally["events"] > 4 * tally["agreed"]
    assert share(tally, "sensitive") <= 0.02
    assert told_but_ambiguous(tally) == 0 and share(tally, "needlessly told") <= 0.05


@pytest.mark.slow
@pytest.mark.parametrize("direction", [1, -1])
def test_random_clocks(direction):
    *_, tally, wrong = fuzz("square", 50, 0, direction)
    check(tally, wrong)


@pytest.mark.slow
@pytest.mark.parametrize("name", SHAPES)
@pytest.mark.parametrize("direction", [1, -1])
def test_many_random_clocks(name, direction):
    """Both ways in time, apart from relays and impacts; the tally is printed."""
    plain = SHAPES[name][0].plain
    if direction < 0 and plain.relay + plain.impact:
        pytest.skip("not of a unique past")
    *_, tally, wrong = fuzz(name, 400, 1, direction)
    print("\n" + ", ".join(f"{key}: {number}" for key, number in tally.items()))
    check(tally, wrong)


@pytest.mark.slow
def test_derivatives_by_periods():
    """Of the state at the end by the periods of the clocks, against differences of the reference; and by the start."""
    cases, truths, by_period, tally, wrong = fuzz("square", 100, 2, derive=True)
    assert not wrong
    (shape, _), compared, step = SHAPES["square"], 0, 1e-5
    for case, truth, got in zip(cases, truths, by_period):
        if truth is None or truth.ends or truth.gain > 1e3:
            continue
        pair = [
            clocked.solve(case._replace(clocks=case.clocks._replace(period=case.clocks.period + d)), shape)
            for d in (step, -step)
        ]
        if all(end is not None and not end.cut and len(end.t) == len(truth.t) for end in pair):
            slope = (pair[0].y1 - pair[1].y1) / (2 * step)
            np.testing.assert_allclose(got[:, 0], slope, atol=1e-6 * (1 + truth.gain) ** 2, rtol=1e-5)
            compared += bool(np.any(truth.switch == 1))
    assert compared > 50
