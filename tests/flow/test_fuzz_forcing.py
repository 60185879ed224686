"""Random forcings, friction laws and walls against scipy, which is restarted at each change of mode."""

import functools
from typing import NamedTuple

import diffrax as dfx
import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from jax import Array
from sliding import SlidingMass, Stribeck

import nsjax
from nsjax import RESULTS
from nsjax.gallery import Motion


KINDS = ("harmonics", "product", "table", "windows", "square", "chirp")


class RandomForcing(nsjax.System):
    """A block with friction, a spring and a wall, forced in one of several ways by random numbers."""

    kind: str = eqx.field(static=True)
    p: Array  # eight numbers from 0 to 1

    def force(self, t, np_):
        p = self.p
        if self.kind == "harmonics":
            return p[0] * np_.cos((1 + p[1]) * t) + p[2] * np_.cos((2 + 3 * p[3]) * t + p[4])
        if self.kind == "product":
            return 2 * p[0] * np_.cos((1 + p[1]) * t) * np_.cos((0.2 + p[2]) * t + p[3])
        if self.kind == "table":
            return np_.interp(t, self.knots, 4 * p - 2)
        if self.kind == "windows":
            return sum(
                (2 * p[i] - 1.2) * np_.where((t >= self.knots[i]) & (t < self.knots[i + 1]), 2.0, 0.0)
                for i in (0, 2, 5)
            )
        if self.kind == "square":
            return np_.where((t + p[3]) % (0.5 + p[0]) < (0.1 + 0.3 * p[1]), 1.5, -0.8 * p[2])
        return 1.5 * p[0] * np_.sin(p[1] * t + 0.2 * p[2] * t**2)

    @property
    def knots(self):
        return jnp.cumsum(0.05 + self.p)

    def breaks(self, end):
        knots, p = np.asarray(self.knots), np.asarray(self.p)
        if self.kind in ("table", "windows"):
            return knots
        if self.kind != "square":
            return np.zeros(0)
        n = np.arange(0, 60)
        return np.concatenate([n * (0.5 + p[0]) - p[3], n * (0.5 + p[0]) + 0.1 + 0.3 * p[1] - p[3]])

    def vector_field(self, t, y, s):
        return Motion(y.v, self.force(t, jnp) - 0.5 * self.p[5] * y.x - 0.8 * self.p[6] * s.ground - s.wall)

    @nsjax.sgn
    def ground(self, t, y):
        return y.v

    @nsjax.impact
    def wall(self, t, y):
        return 0.6 - y.x

    @wall.restitution
    def wall(self):
        return 0.6


END = 4.0


def _with_growth(mass, x, v):
    """The end time, the state there, and by how much a disturbance of the start grows."""
    (t, y, _), (other_t, other_y, _) = (mass.run(start, v) for start in (x, x + 1e-7))
    return t, y, np.inf if abs(other_t - t) > 1e-5 else np.max(np.abs(other_y - y)) / 1e-7


def _by_scipy(model):
    p = np.asarray(model.p)
    numbers = _Numbers(model.kind, p, np.cumsum(0.05 + p))

    def force(t, x):
        return RandomForcing.force(numbers, t, np) - 0.5 * p[5] * x

    cuts = np.unique([*(c for c in model.breaks(END) if 0 < c < END), END])
    return _with_growth(SlidingMass(force, lambda speed: 0.8 * p[6], cuts, wall=0.6), 0.3, 1.0)


@functools.cache
def _truths(kind, count, seed):
    numbers = np.random.default_rng(seed).random((count, 8))
    return numbers, [_by_scipy(RandomForcing(kind, jnp.asarray(p))) for p in numbers]


class _Numbers(NamedTuple):
    kind: str
    p: np.ndarray
    knots: np.ndarray


@functools.partial(jax.jit, static_argnames=("kind", "solver"))
def _by_nsjax(kind, solver, numbers, ends):
    def one(p, end):
        return nsjax.solve(RandomForcing(kind, p), 0.0, end, Motion(0.3, 1.0), solver=solver, throw=False)

    return jax.vmap(one)(numbers, ends)


def _failures_and_errors(kind, solver, count, seed, swept=False):
    """Which solutions report a failure, and how far the others are from scipy's, of those that a disturbance of the
    start does not change by much."""
    numbers, truths = _truths(kind, count, seed)
    sound = np.array([growth < 1e3 for _, _, growth in truths])
    ends = jnp.asarray([t - (1e-6 if t < END else 0) for t, *_ in truths])  # before an impact

    def one(args):
        p, end = args
        return nsjax.solve(RandomForcing(kind, p), 0.0, end, Motion(0.3, 1.0), throw=False)

    sol = (
        nsjax.sweep(one, (jnp.asarray(numbers), ends)) if swept else _by_nsjax(kind, solver, jnp.asarray(numbers), ends)
    )
    told = np.asarray(sol.result != RESULTS.successful)
    error = np.maximum(*(abs(np.asarray(a) - b) for a, b in zip(sol.y1, np.array([y for _, y, _ in truths]).T)))
    assert sound.mean() > 0.9
    return told[sound], error[sound]


WITHIN = 2e-5  # of which 1e-6 of time make some


@pytest.mark.slow
@pytest.mark.parametrize("kind", ["table", "square"])
def test_random_forcings_in_a_sweep(kind):
    told, error = _failures_and_errors(kind, None, 40, 1, swept=True)
    assert not told.any()
    assert error.max() < WITHIN, (int(error.argmax()), error.max())


@pytest.mark.slow
@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.parametrize("solver", ["swept", "Taylor"])
def test_many_random_forcings(kind, solver):
    """3,000 of them, with friction that sticks and impacts, and none that is wrong without a word."""
    told, error = _failures_and_errors(kind, nsjax.Taylor(), 250, 2, swept=solver == "swept")
    assert told.mean() < 0.01
    assert error[~told].max() < WITHIN, (int(error.argmax()), error.max())


STEP = 1e-4  # of the amplitudes, in difference quotients


@functools.cache
def _slopes_at_zero():
    """Random harmonics of which one or both amplitudes are zero, with the derivatives of the end by both amplitudes, of
    those that a disturbance of the start or of an amplitude does not change by much."""
    rng = np.random.default_rng(3)
    numbers, slopes = [], []
    for i in range(60):
        p = rng.random(8)
        p[[[0], [2], [0, 2]][i % 3]] = 0.0
        ends = []
        for amplitude in (0, 2):
            for sign in (1, -1):
                moved = p.copy()
                moved[amplitude] += sign * STEP
                ends.append(_by_scipy(RandomForcing("harmonics", jnp.asarray(moved))))
        if all(t == END and growth < 1e2 for t, _, growth in ends):
            states = [y for _, y, _ in ends]
            numbers.append(p)
            slopes.append([(states[0] - states[1]) / (2 * STEP), (states[2] - states[3]) / (2 * STEP)])
    return np.array(numbers), np.array(slopes)


@pytest.mark.slow
@pytest.mark.parametrize("solver", [None, dfx.Tsit5(), dfx.Dopri8(), nsjax.Taylor()])
def test_random_derivatives_by_an_amplitude_of_zero(solver):
    """Through sticking and impacts: by default in a sweep, and by each solver."""
    numbers, want = _slopes_at_zero()
    assert len(numbers) > 30

    def end(amplitudes, p):
        p = p.at[np.array([0, 2])].set(amplitudes)
        sol = nsjax.solve(RandomForcing("harmonics", p), 0.0, END, Motion(0.3, 1.0), solver=solver, throw=False)
        return jnp.stack(sol.y1)

    def slope(p):
        return jax.jacfwd(end)(p[np.array([0, 2])], p).T

    points = jnp.asarray(numbers)
    slopes = nsjax.sweep(slope, points) if solver is None else jax.jit(jax.vmap(slope))(points)
    np.testing.assert_allclose(slopes, want, atol=1e-4, rtol=1e-4)


LATE = 15.0


@functools.cache
def _stribeck_truths():
    rng = np.random.default_rng(5)
    numbers = rng.uniform([0.1, 0.5, 0.0, 0.3, 0.5], [0.8, 3.0, 0.3, 1.2, 2.5], (160, 5))
    starts, ends = rng.uniform(-1.2, 1.2, (160, 2)), []
    for (mu, delta, belt, force, omega), (x, v) in zip(numbers, starts):
        mass = SlidingMass(
            lambda t, x, force=force, omega=omega: force * np.cos(omega * t) - np.sin(x),
            lambda speed, mu=mu, delta=delta: mu / (1 + delta * speed),
            np.array([LATE]), belt,
        )  # fmt: skip
        ends.append(_with_growth(mass, x, v))
    return numbers, starts, ends


@pytest.mark.slow
@pytest.mark.parametrize("solver", [dfx.Tsit5(), dfx.Dopri8(), nsjax.Taylor()])
def test_random_friction_in_the_sliding_velocity(solver):
    """A step that looks beyond the surface takes the law of its own mode: `Taylor` took 3 wrong events in 160."""
    numbers, starts, truths = _stribeck_truths()
    sound = np.array([growth < 1e3 for *_, growth in truths])
    assert sound.mean() > 0.9

    @jax.jit
    @jax.vmap
    def end(p, start):
        how = dict(solver=solver, rtol=1e-10, atol=1e-10, throw=False)
        sol = nsjax.solve(Stribeck(*p), 0.0, LATE, Motion(start[0], start[1]), **how)
        return jnp.stack(sol.y1), sol.result == RESULTS.successful

    y1, fine = end(jnp.asarray(numbers), jnp.asarray(starts))
    assert np.asarray(fine)[sound].mean() > 0.98
    error = np.max(np.abs(np.asarray(y1) - [y for _, y, _ in truths]), axis=1)
    assert error[sound & np.asarray(fine)].max() < 1e-5
