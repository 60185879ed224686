"""The exact flow of fields that are affine in the state."""

import functools

import diffrax as dfx
import equinox as eqx
import jax
import jax.numpy as jnp
import mpmath as mp
import numpy as np
import pytest
import reference
from jaxtyping import Array
from models import flat, itinerary, Motion, Pair, pid, Plane, times, with_change

import nsjax
from nsjax import Exponential, gallery, RESULTS, solve
from nsjax.flow.steppers._exponential import expm


DEFECTIVE = np.array([[-1.0, 1.0, 0.0], [0.0, -1.0, 1.0], [0.0, 0.0, -1.0]])
MATRICES = {
    "defective": 3 * DEFECTIVE,
    "nilpotent": np.diag([2.0, 3.0], 1),
    "zero": np.zeros((3, 3)),
    "singular": np.array([[0.0, 1.0, 0.0], [0.0, -0.3, 1.0], [0.0, -1.0, -0.3]]),
    "stiff": np.array([[-1e6, 1e6, 0.0], [0.0, 0.0, 1.0], [0.0, -1.0, 0.0]]),
    "hard spring": np.array([[0.0, 1.0, 0.0], [-1e8, 0.0, 0.0], [0.0, 1e-4, -1.0]]) * 1e-2,
    "growing": np.array([[20.0, 1.0, 0.0], [0.0, 20.0, 5.0], [0.0, -5.0, 20.0]]),
}


@pytest.mark.parametrize("name", MATRICES)
def test_expm(name):
    """With its derivative, against 40 digits; for matrices at which the obvious formulas fail."""
    m, e = MATRICES[name], np.random.default_rng(0).normal(size=(3, 3))
    got, slope = jax.jit(lambda m, e: jax.jvp(expm, (m,), (e,)))(m, e)
    with mp.workdps(40):
        both = np.block([[m, e], [np.zeros((3, 3)), m]])
        want, want_slope = np.split(np.array(mp.expm(mp.matrix(both.tolist())).tolist(), float)[:3], 2, axis=1)
    np.testing.assert_allclose(got, want, rtol=0, atol=1e-12 * abs(want).max())
    np.testing.assert_allclose(slope, want_slope, rtol=0, atol=1e-12 * abs(want_slope).max())


class Linear(nsjax.System):
    """y' = A y + b + a cos ωt, or with a ramp A y + b + a t."""

    A: Array
    b: Array
    a: Array
    w: float = 1.0
    ramp: bool = eqx.field(default=False, static=True)

    def vector_field(self, t, y, s):
        return self.A @ y + self.b + self.a * (t if self.ramp else jnp.cos(self.w * t))


def linear(A, b=0, a=0, w=1.0, ramp=False):
    """Of three states, so that all are one program: what comes after those of A stands still. Forces act on A's last."""
    n = len(A)
    matrix, forces = np.zeros((3, 3)), np.zeros((2, 3))
    matrix[:n, :n], forces[:, n - 1] = A, (b, a)
    return Linear(matrix, *forces, np.asarray(w), ramp)


@jax.jit
def run(system, t1, y0, t0=0.0):
    return solve(system, t0, t1, y0, solver=Exponential(), saveat=dfx.SaveAt(t1=True, dense=True), throw=False)


FREE, OSCILLATOR, CRITICAL = [[0.0, 1.0], [0.0, 0.0]], [[0.0, 1.0], [-1.0, 0.0]], [[0.0, 1.0], [-1.0, -2.0]]
SOLUTIONS = {
    # name: model, x(t) from rest at 0 and t = 0
    "singular, constant forcing": (linear(FREE, b=1.0), lambda t: t**2 / 2),
    "singular, linear forcing": (linear(FREE, a=1.0, ramp=True), lambda t: t**3 / 6),
    "singular, harmonic forcing": (linear(FREE, a=1.0, w=2.0), lambda t: (1 - np.cos(2 * t)) / 4),
    "resonance": (linear(OSCILLATOR, a=1.0), lambda t: t * np.sin(t) / 2),
    "close to resonance": (
        linear(OSCILLATOR, a=1.0, w=1 + 1e-7),
        lambda t: np.sin(5e-8 * t) * np.sin((1 + 5e-8) * t) / 5e-8 / (2 + 1e-7),
    ),
    "defective": (linear(CRITICAL, b=1.0), lambda t: 1 - (1 + t) * np.exp(-t)),
    "defective, forced": (linear(CRITICAL, a=1.0), lambda t: np.sin(t) / 2 - t * np.exp(-t) / 2),
}


@pytest.mark.parametrize("name", SOLUTIONS)
def test_against_closed_forms(name):
    system, exact = SOLUTIONS[name]
    sol = run(system, 40.0, jnp.zeros(3))
    t = np.linspace(0, 40, 401)
    size = abs(exact(t)).max()
    assert sol.result == RESULTS.successful
    np.testing.assert_allclose(sol.y1[0], exact(40.0), rtol=0, atol=2e-13 * size)
    np.testing.assert_allclose(jax.vmap(sol.evaluate)(t)[:, 0], exact(t), rtol=0, atol=1e-11 * size)


def test_stiff():
    """A mode that decays within 1e-6 beside a slow one: short steps while it lasts, then those of the slow one."""
    system = linear([[-1e6, 1e6, 0.0], [0.0, 0.0, 1.0], [0.0, -1.0, 0.0]])
    sol = run(system, 100.0, jnp.array([3.0, 1.0, 0.0]))
    # x' = -λ (x - cos t): x follows with a lag.
    lam = 1e6
    lag = (lam**2 * np.cos(100.0) + lam * np.sin(100.0)) / (lam**2 + 1)
    np.testing.assert_allclose(sol.y1, [lag, np.cos(100.0), -np.sin(100.0)], atol=1e-11)
    assert sol.stats["num_steps"] < 200


def test_what_it_is_not_made_for_is_told():
    """Products of states, a matrix that depends on time, two frequencies, gradients through the steps."""

    class Mathieu(nsjax.System):
        def vector_field(self, t, y, s):
            return Motion(y.v, -(1 + 0.1 * jnp.cos(t)) * y.x)

    class Duffing(nsjax.System):
        def vector_field(self, t, y, s):
            return Motion(y.v, -y.x - y.x**3)

    class Beats(nsjax.System):
        def vector_field(self, t, y, s):
            return Motion(y.v, -y.x + jnp.cos(t) + jnp.cos(1.5 * t))

    y0 = Motion(1.0, 0.0)
    with pytest.raises(ValueError, match="affine in the state, but `Duffing` is not"):
        solve(Duffing(), 0.0, 1.0, y0, solver=Exponential())
    with pytest.raises(ValueError, match="that of `Mathieu` depends on time"):
        solve(Mathieu(), 0.0, 1.0, y0, solver=Exponential())
    with pytest.raises(ValueError, match="harmonic of one frequency .*, but that of `Beats` is not"):
        solve(Beats(), 0.0, 1.0, y0, solver=Exponential())
    with pytest.raises(ValueError, match="`adjoint` must not be `RecursiveCheckpointAdjoint` for `Exponential`"):
        solve(Beats(), 0.0, 1.0, y0, solver=Exponential(), adjoint=dfx.RecursiveCheckpointAdjoint())


def test_in_diffeqsolve():
    terms = dfx.ODETerm(lambda t, y, args: jnp.stack([y[1], -y[0] + jnp.cos(t)]))
    controller = dfx.PIDController(rtol=1e-6, atol=1e-6)
    options = dict(dt0=0.1, y0=jnp.zeros(2), stepsize_controller=controller, saveat=dfx.SaveAt(dense=True))
    sol = dfx.diffeqsolve(terms, Exponential(), 0.0, 20.0, **options)
    t = jnp.linspace(0, 20, 101)
    # The tolerance is that of dense output; steps are exact.
    np.testing.assert_allclose(jax.vmap(sol.evaluate)(t)[:, 0], t * jnp.sin(t) / 2, atol=1e-6)
    np.testing.assert_allclose(sol.evaluate(20.0)[0], 10 * np.sin(20.0), atol=1e-12)


# With events.


def stick_slip(v):
    sol = solve(gallery.StickSlip(v_dr=v), 0.0, 100.0, Motion(2.5, -0.5), solver=Exponential())
    return jnp.stack(sol.y1), sol.stats["num_steps"]


@pytest.mark.slow  # (by default with the exact flow, test_affine)
def test_stick_slip():
    """A sweep of the belt's velocity, through up to thirty events, against closed forms; and the derivative by it,
    against forty digits."""
    v = np.linspace(0.1, 0.9, 9)
    changed = jax.jit(lambda v: jax.jvp(stick_slip, (v,), (1.0,), has_aux=True))
    y1, slope, steps = map(np.stack, zip(*map(changed, v)))
    np.testing.assert_allclose(y1, reference.stick_slip_final(v, 100.0), atol=1e-12)
    assert np.all(steps < 160)
    for i in (0, 4, 7):
        want = reference.solution(reference.StickSlip, 100.0, (2.5, -0.5), wrt=("v_dr",), v_dr=float(v[i])).derivative
        np.testing.assert_allclose(slope[i], np.asarray(want, float)[:, 2], rtol=1e-10)


@pytest.mark.slow
@pytest.mark.parametrize("direction", [1, -1])
def test_sliding_on_two_surfaces(direction):
    """Corners: sliding on one, then on both; piecewise polynomial, so that Taylor is exact too."""
    system = Pair()
    got, want = (
        solve(system, 0.0, direction * 2.0, Plane(1.0, 0.3), solver=m, throw=False)
        for m in (Exponential(), nsjax.Taylor(6))
    )
    assert itinerary(got) == itinerary(want) and len(itinerary(got)) == (2 if direction > 0 else 0)
    np.testing.assert_allclose(times(got), times(want), atol=1e-13)
    np.testing.assert_allclose(flat(got.y1), flat(want.y1), atol=1e-13)


class Chord(nsjax.System):
    """x = cos t, and a line x = depth - 1 on which something else switches."""

    depth: Array

    def vector_field(self, t, y, s):
        return (y[1], -y[0], s.line)

    @nsjax.sgn
    def line(self, t, y):
        return y[0] + 1.0 - self.depth


@jax.jit
@functools.partial(jax.vmap, in_axes=(None, 0))
def events_of_chord(depth, t0):
    y0 = (jnp.cos(t0), -jnp.sin(t0), 0.0)
    return solve(Chord(depth), t0, 6.0, y0, solver=Exponential(), throw=False).events


@pytest.mark.parametrize("depth", [1e-1, 1e-7, 1e-13, -1e-13])
def test_roots_next_to_each_other(depth):
    """Pitfall 5: two roots down to 4e-7 apart, and a near miss, in the middle of a step; however steps fall."""
    sol = events_of_chord(depth, np.linspace(0, 2.5, 40))
    if depth < 0:
        assert not np.any(sol.num)
        return
    half = 2 * np.arcsin(np.sqrt(depth / 2))
    assert np.all(sol.num == 2)
    np.testing.assert_allclose(sol.t[:, 0], np.pi - half, atol=2e-15 / half)
    np.testing.assert_allclose(sol.t[:, 1], np.pi + half, atol=2e-15 / half)


NOT_AFFINE = (
    *("(2.26)", "(2.28)", "2.4", "6.9", "A.7", "A.8", "A.9"),
    *("(5.7)", "(5.10)", "(5.15)", "(5.17)", "(5.23)", "(5.25)", "(5.29)", "(5.40)"),
)


@pytest.mark.parametrize("key", NOT_AFFINE)
def test_refusal_in_the_gallery(key):
    """Friction that depends on the velocity smoothly, and the smooth fields of chapter 5."""
    entry = gallery.THESIS[key]
    with pytest.raises(ValueError, match=f"affine in the state, but `{type(entry.system()).__name__}` is not"):
        solve(entry.system(), entry.t0, entry.t1, entry.y0, solver=Exponential())


@pytest.mark.slow
@pytest.mark.parametrize("key", [key for key in gallery.THESIS if key not in NOT_AFFINE])
def test_gallery(key):
    """Every system of the thesis whose modes are affine, against Dopri8."""
    (want, change), (got, changed) = (with_change(gallery.THESIS[key], m) for m in (dfx.Dopri8(), Exponential()))
    assert got.result == want.result and itinerary(got) == itinerary(want)
    np.testing.assert_allclose(times(got), times(want), atol=1e-10)
    np.testing.assert_allclose(flat(got.y1), flat(want.y1), atol=1e-10)
    np.testing.assert_allclose(flat(changed), flat(change), atol=1e-8 * (1 + np.abs(flat(change)).max()))


@pytest.mark.slow
def test_float32():
    """Single precision: what it can hold."""
    system = gallery.StickSlip(v_dr=jnp.float32(0.5))
    y0 = Motion(jnp.float32(2.5), jnp.float32(-0.5))
    sol = solve(system, jnp.float32(0), jnp.float32(20), y0, solver=Exponential())
    assert sol.y1.x.dtype == jnp.float32
    np.testing.assert_allclose(flat(sol.y1), reference.stick_slip_final(np.array([0.5]), 20.0)[0], atol=2e-5)


class Pressed(nsjax.System):
    """Friction that holds against harmonic forcing."""

    c: float = 1.0
    a: float = 0.9
    w: float = 1.3
    f: float = 2.3
    v: float = 1e-3

    def vector_field(self, t, y, s):
        return (-self.c * y[0] + self.a * jnp.cos(self.w * t) - self.f * s.belt,)

    @nsjax.sgn
    def belt(self, t, y):
        return y[0] - self.v


@pytest.mark.slow
def test_sticking_where_the_forcing_turns():
    """Pitfall 40: the forces cancel while it sticks, and their rounding is judged by them."""
    rng = np.random.default_rng(0)
    rows = {
        name: rng.uniform(*ends, 127) for name, ends in dict(c=(0.1, 3), a=(0.1, 2), w=(0.3, 4), f=(0.5, 3)).items()
    }
    rows["v"] = 10 ** rng.uniform(-6, 0, 127)
    many = {name: jnp.asarray(np.append(getattr(Pressed(), name), row)) for name, row in rows.items()}

    @jax.jit
    @jax.vmap
    def ends(parameters):
        exact, steps = (
            solve(Pressed(**parameters), 0.0, 20.0, (0.5,), solver=solver, stepsize_controller=pid(1e-12), throw=False)
            for solver in (Exponential(), nsjax.Taylor(12))
        )
        return exact.result, exact.events.num == steps.events.num, exact.y1[0] - steps.y1[0]

    result, same, error = ends(many)
    assert np.all(result == RESULTS.successful) and np.all(same)
    np.testing.assert_allclose(error, 0, atol=1e-12)
