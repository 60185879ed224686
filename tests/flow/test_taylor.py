"""Power series of programs, and the solver made of them."""

import diffrax as dfx
import jax
import jax.numpy as jnp
import mpmath as mp
import numpy as np
import pytest
import reference
from jaxtyping import Array
from models import flat, itinerary, Motion, pid, Point, times, with_change

import nsjax
from nsjax import gallery, RESULTS, solve, Taylor
from nsjax._numerics._series import Series


# A function, the same in mpmath, and where to expand it.
FUNCTIONS = {
    "exp": (jnp.exp, mp.exp, 0.3),
    "exp2": (jnp.exp2, lambda x: mp.mpf(2) ** x, 0.3),
    "expm1": (jnp.expm1, mp.expm1, 0.3),
    "log": (jnp.log, mp.log, 0.7),
    "log1p": (jnp.log1p, mp.log1p, 0.7),
    "sqrt": (jnp.sqrt, mp.sqrt, 0.7),
    "rsqrt": (jax.lax.rsqrt, lambda x: 1 / mp.sqrt(x), 0.7),
    "cbrt": (jnp.cbrt, mp.cbrt, 0.7),
    "tan": (jnp.tan, mp.tan, 0.3),
    "tanh": (jnp.tanh, mp.tanh, 0.3),
    "logistic": (jax.nn.sigmoid, lambda x: 1 / (1 + mp.exp(-x)), 0.3),
    "atan": (jnp.arctan, mp.atan, 0.3),
    "asin": (jnp.arcsin, mp.asin, 0.3),
    "acos": (jnp.arccos, mp.acos, 0.3),
    "asinh": (jnp.arcsinh, mp.asinh, 0.3),
    "acosh": (jnp.arccosh, mp.acosh, 1.7),
    "atanh": (jnp.arctanh, mp.atanh, 0.3),
    "erf": (jax.lax.erf, mp.erf, 0.3),
    "erfc": (jax.lax.erfc, mp.erfc, 0.3),
    "sin": (jnp.sin, mp.sin, 0.3),
    "cosh": (jnp.cosh, mp.cosh, 0.3),
    "integer powers": (lambda x: x**3 + x**-2 + x**7, lambda x: x**3 + x**-2 + x**7, 0.3),
    "real powers": (lambda x: x**2.5 + x**x, lambda x: x**2.5 + x**x, 0.3),
    "arctan2": (lambda x: jnp.arctan2(x * x, 1 + x), lambda x: mp.atan2(x * x, 1 + x), 0.3),
    "one branch": (
        lambda x: abs(x - 1) * jnp.maximum(x, 2 * x) * jnp.clip(x * x, 0.0, 1.0) * jnp.where(x < 1, x, 0.0) + x * 7 % 2,
        lambda x: (1 - x) * 2 * x**4 + x * 7 - 2,
        0.3,
    ),
    "matrix": (
        lambda x: (jnp.array([[1.0, 2.0], [3.0, 4.0]]) @ jnp.stack([x, x * x])) @ jnp.stack([jnp.sin(x), x]),
        lambda x: (x + 2 * x * x) * mp.sin(x) + (3 * x + 4 * x * x) * x,
        0.3,
    ),
    "places": (
        lambda x: jnp.zeros(3).at[1].set(x).at[2].add(x * x)[jnp.array([1, 2])] @ jnp.stack([x, 1.0 + 0.0 * x]),
        lambda x: 2 * x * x,
        0.3,
    ),
    "linear solve": (
        lambda x: jnp.linalg.solve(jnp.array([[2.0, 1.0], [1.0, 3.0]]), jnp.stack([jnp.sin(x), x]))[0],
        lambda x: (3 * mp.sin(x) - x) / 5,
        0.3,
    ),
    "norm": (lambda x: jnp.linalg.norm(jnp.stack([x, 1 + x])), lambda x: mp.sqrt(x * x + (1 + x) ** 2), 0.3),
    "shared": (
        lambda x: jnp.sin(2 * x) * jnp.cos(2 * x) / (1 + jnp.sin(2 * x)),
        lambda x: mp.sin(2 * x) * mp.cos(2 * x) / (1 + mp.sin(2 * x)),
        0.3,
    ),
}


def coefficients(fn, x, order):
    """Taylor coefficients of `fn` at `x`."""
    series = Series(lambda x: [fn(x)], x)
    terms = [series.step(k, x if k == 0 else jnp.ones_like(x) if k == 1 else None)[0] for k in range(order + 1)]
    return np.array([0.0 if c is None else float(c) for c in terms])


@pytest.mark.parametrize("name", FUNCTIONS)
def test_series_of_functions(name):
    """Against mpmath, which differentiates numerically with 60 digits."""
    fn, exact, x = FUNCTIONS[name]
    with mp.workdps(60):
        want = np.array([float(c) for c in mp.taylor(exact, mp.mpf(x), 12)])
    np.testing.assert_allclose(coefficients(fn, jnp.asarray(x), 12), want, rtol=1e-13, atol=1e-13)


def test_zeros_cost_nothing():
    """Coefficients that vanish whatever the numbers are do not enter the program: the work grows with the order, and
    not with its square."""

    def size(order):
        def run(x, k):
            series = Series(lambda x, k: [k * jnp.sin(x) + x], x, k)
            return [series.step(i, *((x, k) if i == 0 else (jnp.ones_like(x), None) if i == 1 else (None, None)))[0]
                    for i in range(order + 1)]  # fmt: skip

        return len(jax.make_jaxpr(run)(1.0, 2.0).jaxpr.eqns)

    assert size(16) - size(8) == 2 * (size(12) - size(8)) < 160


# As a solver of diffrax.


def test_in_diffeqsolve():
    """A nonlinear equation, y' = -2 t y², y = 1 / (1 + t²), with dense output; the order is the number of terms."""
    terms = dfx.ODETerm(lambda t, y, args: -2 * t * y**2)

    def run(method, **kwargs):
        return dfx.diffeqsolve(terms, method, 0.0, 2.0, **dict(dt0=0.1, y0=jnp.asarray(1.0)) | kwargs)

    tight = dict(stepsize_controller=pid(1e-12), saveat=dfx.SaveAt(dense=True))
    sol = run(Taylor(16), **tight)
    t = jnp.linspace(0, 2, 101)
    np.testing.assert_allclose(jax.vmap(sol.evaluate)(t), 1 / (1 + t**2), atol=1e-11)
    assert sol.stats["num_steps"] < 40
    errors = [abs(float(run(Taylor(6), dt0=dt).ys[0]) - 0.2) for dt in (0.1, 0.05)]
    assert 5.5 < np.log2(errors[0] / errors[1]) < 7


def test_what_it_cannot_do_is_told():
    class Loop(nsjax.System):
        def vector_field(self, t, y, s):
            return Point(-jax.lax.fori_loop(0, 3, lambda i, x: x * x, y.x))

    with pytest.raises(TypeError, match="not known of `scan`, .*`solver`") as told:
        solve(Loop(), 0.0, 1.0, Point(1.0), solver=Taylor())
    assert "Dopri8" in str(told.value)
    with pytest.raises(ValueError, match="`terms` must be an integer, at least 4, but got 3"):
        Taylor(3)


# In the flow.


@pytest.mark.slow
@pytest.mark.parametrize("key", gallery.THESIS)
def test_gallery(key):
    """Every system, by Dopri8 and by series: the same events, states, and changes of these with the start."""
    (want, change), (got, changed) = (with_change(gallery.THESIS[key], m) for m in (dfx.Dopri8(), Taylor()))
    assert got.result == want.result and itinerary(got) == itinerary(want)
    np.testing.assert_allclose(times(got), times(want), atol=1e-10)
    np.testing.assert_allclose(flat(got.y1), flat(want.y1), atol=1e-10)
    np.testing.assert_allclose(flat(changed), flat(change), atol=1e-8 * (1 + np.abs(flat(change)).max()))
    assert got.stats["num_steps"] <= want.stats["num_steps"]


class Rippled(nsjax.System):
    """Goes at one speed through surfaces that are not affine."""

    def vector_field(self, t, y, s):
        return 2.0 + 0 * y * s.ripple

    @nsjax.sgn
    def ripple(self, t, y):
        return jnp.sin(y)


@pytest.mark.slow
def test_derivative_by_the_start_with_curved_guards():
    """Steps that may be shortened for the sake of a guard still end where the solution is to end."""
    out = jax.jvp(lambda t0: solve(Rippled(), t0, 3.0, 0.5, solver=Taylor(8)).y1, (0.0,), (1.0,))
    np.testing.assert_allclose(out, (6.5, -2.0), atol=1e-12)


TIGHT = dict(stepsize_controller=pid(1e-13))


def end(v, solver):
    """The state after four events."""
    return jnp.stack(solve(gallery.StickSlip(v_dr=v), 0.0, 20.0, Motion(2.5, -0.5), solver=solver, **TIGHT).y1)


def test_derivative():
    """By the belt's velocity, against forty digits."""
    value, slope = jax.jit(lambda v: jax.jvp(lambda v: end(v, Taylor()), (v,), (1.0,)))(0.5)
    np.testing.assert_allclose(value, reference.stick_slip_final(np.array([0.5]), 20.0)[0], atol=1e-12)
    known = reference.solution(reference.StickSlip, 20.0, (2.5, -0.5), wrt=("v_dr",), v_dr=0.5).derivative
    np.testing.assert_allclose(slope, reference.floats(known[:, 2]), rtol=1e-9)


@pytest.mark.slow
def test_second_derivative():
    got, want = (jax.jit(jax.jacfwd(jax.jacfwd(lambda v, s=s: end(v, s))))(0.5) for s in (Taylor(), dfx.Dopri8()))
    np.testing.assert_allclose(got, want, rtol=1e-7)


@pytest.mark.slow
def test_backwards():
    """Through a slip and back."""
    system, y0 = gallery.StickSlip(v_dr=0.5), Motion(2.5, -0.5)
    there = solve(system, 0.0, 3.0, y0, solver=Taylor(), **TIGHT)
    back = solve(system, 3.0, 0.0, there.y1, solver=Taylor(), **TIGHT)
    np.testing.assert_allclose(flat(back.y1), flat(y0), atol=1e-12)


class Chord(nsjax.System):
    """A mass on a circle, and a line that it is below of for a moment, where it is pushed back."""

    depth: Array

    def vector_field(self, t, y, s):
        return Motion(y.v, -y.x + 0.5 * (1 - s.line))

    @nsjax.sgn
    def line(self, t, y):
        return y.x + 1.0 - self.depth


@pytest.mark.parametrize("depth", [1e-1, 1e-4, 1e-7])
def test_two_roots_in_one_step(depth):
    """Pitfall 5: in and out again within the hundredth, or the ten thousandth, of a step."""
    sol = solve(Chord(depth), 0.0, 6.0, Motion(1.0, 0.0), solver=Taylor(), stepsize_controller=pid(1e-12))
    v = np.sqrt(depth * (2 - depth))
    # Below the line x - 1 = -(2 - depth) cos τ - v sin τ.
    want = np.arccos(depth - 1) + np.array([0, 2 * np.arctan(v / (2 - depth))])
    np.testing.assert_allclose(times(sol), want, atol=1e-14 / v)


class Kinked(nsjax.System):
    """A spring twice as stiff in compression, written without a switch."""

    def vector_field(self, t, y, s):
        return Motion(y.v, -y.x - 3 * jnp.minimum(y.x, 0.0))


def test_kink_without_a_switch():
    """A series continues the branch it is on: that the field at the step's end is another is seen."""
    sol = solve(Kinked(), 0.0, 1.5 * np.pi, Motion(1.0, 0.0), solver=Taylor(), stepsize_controller=pid(1e-9))
    # A quarter of the slow circle, half of the fast one, half of the slow one.
    np.testing.assert_allclose(flat(sol.y1), [1.0, 0.0], atol=1e-7)


class Root(nsjax.System):
    """x' = sqrt(c - t): no number beyond t = c, and in no step that a series at t < c stands for."""

    c: float

    def vector_field(self, t, y, s):
        return Point(jnp.sqrt(self.c - t))


@pytest.mark.parametrize("c, results", [(1.0, (RESULTS.dt_min_reached, RESULTS.nonfinite_field)), (-1.0, None)])
def test_end_of_the_field(c, results):
    """Pitfall 30: told, and soon; from the start, and on the way."""
    sol = solve(Root(c), 0.0, 2.0, Point(0.0), solver=Taylor(), throw=False)
    assert sol.result in (results or (RESULTS.nonfinite_field,)) and sol.stats["num_steps"] < 500
    np.testing.assert_allclose(sol.t1, max(c, 0.0), atol=1e-9)


@pytest.mark.slow
def test_single_precision():
    y0 = Motion(jnp.float32(2.5), jnp.float32(-0.5))
    system = jax.tree.map(lambda x: jnp.asarray(x, jnp.float32), gallery.StickSlip(v_dr=0.5))
    sol = solve(system, 0.0, 20.0, y0, solver=Taylor(8))
    assert sol.y1.x.dtype == jnp.float32 and sol.result == RESULTS.successful
    np.testing.assert_allclose(flat(sol.y1), reference.stick_slip_final(np.array([0.5]), 20.0)[0], atol=1e-3)


@pytest.mark.slow
def test_saved_and_vmapped():
    """Dense output and saved times are the solution itself; lanes in different modes."""
    v_dr = np.linspace(0.2, 1.0, 5)
    t = jnp.linspace(0.0, 20.0, 41)

    def run(v):
        options = dict(solver=Taylor(), stepsize_controller=pid(1e-11))
        dense = solve(gallery.StickSlip(v_dr=v), 0.0, 20.0, Motion(2.5, -0.5), saveat=dfx.SaveAt(dense=True), **options)
        saved = solve(gallery.StickSlip(v_dr=v), 0.0, 20.0, Motion(2.5, -0.5), saveat=dfx.SaveAt(ts=t), **options)
        return jnp.stack(jax.vmap(dense.evaluate)(t), -1), jnp.stack(saved.ys, -1)

    dense, saved = jax.jit(jax.vmap(run))(jnp.asarray(v_dr))
    for i in (1, 20, 33):
        exact = reference.stick_slip_final(v_dr, float(t[i]))
        np.testing.assert_allclose(dense[:, i], exact, atol=1e-9)
        np.testing.assert_allclose(saved[:, i], exact, atol=1e-9)
