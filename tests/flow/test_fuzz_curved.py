"""The flow against 36-digit solutions of random systems whose fields and guards are not affine (polynomials,
sines, products; 3 to 6 states, up to 5 switches): same events, times, states, modes, or a status that says no."""

import collections
import fractions
import functools

import curved
import diffrax as dfx
import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from curved import Case, Shape
from jaxtyping import Array
from scipy.integrate import solve_ivp
from trajectory import assert_slopes_agree, count, share, Solved, tightly, told_but_ambiguous

import nsjax


# One compiled program each.
SHAPES = {
    "one": (Shape(3, 1, forced=True, moving=False), dfx.Tsit5()),
    "two": (Shape(4, 2, forced=True, moving=True), dfx.Tsit5()),
    "series": (Shape(4, 2, forced=True, moving=True), nsjax.Taylor()),
    "three": (Shape(5, 3, forced=False, moving=False), dfx.Dopri8()),
    "five": (Shape(6, 5, forced=True, moving=False), dfx.Tsit5()),
}
MAX_EVENTS = 40


class Curved(nsjax.System):
    """`curved.Case` as a model."""

    F: Array
    D: Array
    G: Array
    W: Array
    phase: Array
    bound: Array
    omega: Array
    shape: Shape = eqx.field(static=True)

    def features(self, t, y, clock):
        bent = [y * jnp.roll(y, -1), y * jnp.sum(y**2), jnp.sin(self.W @ y + self.phase)]
        ticks = [jnp.cos(self.omega * t)[None], jnp.sin(self.omega * t)[None]] if clock else []
        return jnp.concatenate([jnp.ones(1), y, *bent, *ticks])

    def vector_field(self, t, y, s):
        z = self.features(t, y, self.shape.forced)
        weights = jnp.stack([s[k.name] for k in self.switches])
        return self.F[:, : len(z)] @ z + weights @ (self.D[:, :, : len(z)] @ z)

    def surface(self, row, t, y):
        z = self.features(t, y, self.shape.moving)
        return row[: len(z)] @ z

    @property
    def switches(self):
        return _switches(self.shape)


@functools.cache
def _switches(shape: Shape) -> tuple[nsjax.sgn, ...]:
    made = [nsjax.sgn(lambda self, t, y, k=k: self.surface(self.G[k], t, y), name=f"s{k}") for k in range(shape.sgn)]
    return tuple(switch.breakaway(lambda self, k=k: self.bound[k]) for k, switch in enumerate(made))


# Compiling is what takes long, not running.
@functools.partial(jax.jit, static_argnames=("shape", "solver"), compiler_options={"xla_backend_optimization_level": 0})
def run(cases: Case, shape: Shape, solver: dfx.AbstractSolver) -> Solved:
    def one(case: Case):
        return Solved.of(tightly(Curved(*case[:7], shape), case.t1, case.y0, solver, MAX_EVENTS))

    return jax.vmap(one)(cases)


def fuzz(name: str, number: int, seed: int) -> tuple[collections.Counter, list]:
    """How many cases agree, are told by a status, are too sensitive to compare; and those that are wrong."""
    (shape, solver), rng = SHAPES[name], np.random.default_rng(seed)
    cases = [curved.generate(rng, shape) for _ in range(number)]
    truths = [curved.solve(case, shape, MAX_EVENTS) for case in cases]
    # What has no solution must be told, and so gets a little longer.
    ends = [0.1 if t is None else t.t1 + 0.1 * (t.ends != "") for t in truths]
    batch = Case(*(np.stack(column) for column in zip(*[c._replace(t1=np.array(e)) for c, e in zip(cases, ends)])))
    return count(truths, jax.tree.map(np.asarray, run(batch, shape, solver)), (name, seed))


@pytest.mark.slow
@pytest.mark.parametrize("name", ["one", "two"])
def test_random_curved_systems(name):
    tally, wrong = fuzz(name, 50, 0)
    assert not wrong
    assert tally["events"] > 100
    assert share(tally, "sensitive") <= 0.05
    assert told_but_ambiguous(tally) == 0 and share(tally, "needlessly told") <= 0.05


@pytest.mark.slow
@pytest.mark.parametrize("name", SHAPES)
def test_many_random_curved_systems(name):
    """2,000 systems in all; the tally is printed."""
    tally, wrong = fuzz(name, 400, 1)
    print("\n" + ", ".join(f"{key}: {number}" for key, number in tally.items()))
    assert not wrong
    assert share(tally, "sensitive") <= 0.05
    assert told_but_ambiguous(tally) == 0
    assert share(tally, "needlessly told") <= 0.05


def sliding_case() -> tuple[Case, Shape, curved.Trajectory]:
    """One that slides on two surfaces at once and leaves one of them again."""
    shape, rng = Shape(4, 2, forced=True, moving=True), np.random.default_rng(0)
    while True:
        case = curved.generate(rng, shape)
        truth = curved.solve(case, shape, MAX_EVENTS)
        if truth is not None and not truth.cut and np.any(np.all(truth.modes[:-1] == 0, 1)):
            return case, shape, truth


def test_the_digits_of_the_reference(monkeypatch):
    """With more digits, longer series and other steps all is the same to twenty digits."""
    case, shape, truth = sliding_case()
    found = []
    for order, left, bits in ((curved.ORDER, curved.LEFT, curved.BITS), (36, 1e-29, 150)):
        for name, value in (("ORDER", order), ("LEFT", left), ("BITS", bits), ("ONE", 1 << bits)):
            monkeypatch.setattr(curved, name, value)
        oracle = curved.Curved(case, shape)
        oracle.run(truth.t1, MAX_EVENTS, "")
        found.append([fractions.Fraction(x, 1 << bits) for x in oracle.exactly])
    assert len(found[0]) == len(found[1]) == len(truth.t) + shape.n
    assert max(abs(a - b) for a, b in zip(*found)) < 1e-20 * (1 + truth.gain)


def test_the_series_of_the_reference():
    """From event to event, sliding included, the state is that of scipy's integrator, whose multipliers are solved for
    anew at every stage."""
    case, shape, truth = sliding_case()
    law = curved.Curved(case, shape).law
    y, mode = case.y0, np.sign(case.G @ curved.Curved(case, shape).features(0.0, case.y0[None])[0][0]).astype(int)
    for begin, end, after in zip([0, *truth.t], [*truth.t, truth.t1], [*truth.modes, None]):

        def f(t, y, mode=tuple(mode)):
            return law(t, y[None], mode)[0][0]

        y = solve_ivp(f, (begin, end), y, method="DOP853", rtol=1e-13, atol=1e-13).y[:, -1]
        mode = after
    np.testing.assert_allclose(y, truth.y1, atol=1e-12 * (1 + truth.gain))


@pytest.mark.slow
@pytest.mark.parametrize("name", ("one", "two", "five"))
def test_the_reference_against_itself(name):
    """What errors grow by, from saltation matrices, is what its solutions depart from each other by."""
    shape = SHAPES[name][0]
    assert_slopes_agree(
        functools.partial(curved.generate, shape=shape), lambda case: curved.solve(case, shape, MAX_EVENTS), 4, 2
    )
