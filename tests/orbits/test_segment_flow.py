"""The flow of one mode: by the matrix exponential and by steps, with its derivatives."""

import dataclasses

import diffrax as dfx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from jax.extend.core import jaxprs_in_params
from models import Motion, pid

import nsjax
from nsjax import continue_orbit, find_orbit, gallery
from nsjax.flow._integrator import Integrator
from nsjax.orbits.segments._equations import OrbitCurve
from nsjax.orbits.segments._segment_flow import ALWAYS, exactness, FREE_MODES, NEVER, SegmentFlow
from nsjax.system._mode import ModeState
from nsjax.system._model import SwitchedSystem
from nsjax.system._parameter import FreeParameters
from nsjax.system._system import arrays_of


Y = Motion(np.asarray(0.3), np.asarray(-0.4))
HOW = Integrator(dfx.Tsit5(), None, 4096).checked(float, (1e-12, 1e-6))


class Driven(nsjax.System):
    """Forced at two frequencies: no exponential of a small matrix knows that."""

    omega: float = 0.7
    both: float = 1.0

    def vector_field(self, t, y, s):
        force = jnp.cos(self.omega * t) + self.both * jnp.cos(2 * self.omega * t)
        return Motion(y.v, force - 0.2 * y.v - y.x)

    @property
    def period(self):
        return 2 * jnp.pi / self.omega


def flow_of(system, exact, slides=True):
    system = arrays_of(system, jnp.float64)
    model = SwitchedSystem.forwards(system, jnp.zeros(()), Y)
    return SegmentFlow(model, FreeParameters.of(system, ("omega",)), system.omega, Y, jnp.ones(2), HOW, exact, slides)


def at(flow, omega):
    return dataclasses.replace(flow, value=omega)


def test_which_modes():
    def kind(system):
        system = arrays_of(system, jnp.float64)
        return exactness(SwitchedSystem.forwards(system, jnp.zeros(()), Y), jnp.zeros(()), Y)

    assert kind(gallery.ForcedFriction(omega=0.8)) == ALWAYS
    assert kind(gallery.Trilinear(omega=1.2)) == FREE_MODES
    assert kind(gallery.ForcedStickSlip(omega=1.65)) == NEVER


@pytest.fixture(scope="module")
def both():
    """(a, b, x, value, mode) -> end, derivatives and samples: exactly and by steps, a program each for all cases."""

    def results(exact):
        flow = flow_of(gallery.ForcedFriction(omega=0.8), exact)
        curve = _Curve(flow.model)

        @jax.jit
        def of(a, b, x, value, mode):
            where = OrbitCurve.state(curve, mode, jnp.asarray([0], jnp.int32))

            def end(a, b, x, value):
                there = at(flow, value).arrive(a, b, x, where)
                return there, there

            jacobians, there = jax.jacfwd(end, argnums=(0, 1, 2, 3), has_aux=True)(a, b, x, value)
            return there, jacobians, at(flow, value).along(a, b, x, where)

        return of

    return results(True), results(False)


@pytest.mark.parametrize("mode", [-1, 0, 1])
@pytest.mark.parametrize("ends", [(0.3, 2.9), (0.3, 0.3), (0.3, -1.1)])
def test_both_ways(both, mode, ends):
    """Also of no length, and backwards."""
    a, b = (jnp.asarray(t) for t in ends)
    x, value = jnp.array([0.3, 0.0 if mode == 0 else -0.4 * mode]), jnp.asarray(0.83)
    results = [of(a, b, x, value, jnp.asarray([mode], jnp.int32)) for of in both]
    (exact, by, (ts, xs, sums)), (stepped, want, (ts_2, xs_2, sums_2)) = results
    np.testing.assert_allclose(exact, stepped, atol=1e-11)
    for found, other in zip(by, want):
        np.testing.assert_allclose(found, other, atol=1e-10)
    np.testing.assert_allclose(ts, ts_2, atol=1e-15)
    np.testing.assert_allclose(xs, xs_2, atol=1e-7)  # the solver's dense output
    if ends[1] >= ends[0]:
        np.testing.assert_allclose(sums, sums_2, atol=1e-10)


def test_forcing_that_cancels():
    """While friction holds, forcing leaves nothing but rounding behind."""
    flow = flow_of(gallery.ForcedFriction(omega=0.8, f_0=250.0), True)
    where = OrbitCurve.state(_Curve(flow.model), jnp.asarray([0], jnp.int32), jnp.asarray([0], jnp.int32))
    x = jnp.array([0.02, 0.0])
    ends = jax.jit(jax.vmap(lambda a: flow.arrive(a, a + 0.7, x, where)))(jnp.linspace(0.0, 7.0, 8))
    np.testing.assert_allclose(ends, np.tile(x, (8, 1)), atol=1e-14)


class _Curve:
    """As much of a curve as tells states."""

    def __init__(self, model):
        self.model = model


def test_samples():
    """Between the ends too they are those of the exponential: each is the end of a shorter flow."""
    flow = flow_of(gallery.Trilinear(omega=1.2), True, slides=False)
    where = OrbitCurve.state(_Curve(flow.model), jnp.asarray([-1, 1], jnp.int32), jnp.asarray([0, 0], jnp.int32))
    a, x = jnp.asarray(0.1), jnp.array([-1.1, 0.2])
    ts, xs, _ = jax.jit(lambda b: flow.along(a, b, x, where))(jnp.asarray(1.3))
    arrive = jax.jit(lambda b: flow.arrive(a, b, x, where))
    for i in (0, 1, 7, 31, 64):
        np.testing.assert_allclose(arrive(ts[i]), xs[i], atol=1e-12)


class Decay(nsjax.System):
    """y' = -k y + c, both of which are arrays of the model."""

    k: jax.Array | float = 0.7
    c: jax.Array | float = 0.4

    def vector_field(self, t, y, s):
        return -self.k * y + self.c * jnp.ones_like(y)


@pytest.mark.parametrize("exact", [pytest.param(True, marks=pytest.mark.slow), False])
def test_tangents_of_the_model(exact):
    """By free parameters, or by arrays of the model; no column is carried for what has no tangent."""
    y, t = jnp.array([1.3]), jnp.asarray(2.0)
    model = SwitchedSystem.forwards(arrays_of(Decay(), jnp.float64), t, y)
    both = FreeParameters.of(model.system, ("k",), ("c",))

    def end(p, x=y, free=both):
        flow = SegmentFlow(model, free, p, y, jnp.ones(1), HOW, exact, False)
        return flow.arrive(jnp.zeros(()), t, x, ModeState((), (), ()))[0]

    def by_arrays(p):
        system = dataclasses.replace(model.system, k=p[0], c=p[1])
        flow = SegmentFlow(
            model.with_system(system), FreeParameters.of(system), jnp.zeros(0), y, jnp.ones(1), HOW, exact, False
        )
        return flow.arrive(jnp.zeros(()), t, y, ModeState((), (), ()))[0]

    def closed(p):
        return y[0] * jnp.exp(-p[0] * t) + p[1] / p[0] * (1 - jnp.exp(-p[0] * t))

    @jax.jit
    def derivatives(p):
        def first(p):
            slope, there = jax.jacfwd(lambda p: (end(p),) * 2, has_aux=True)(p)
            return slope, (slope, there)

        return jax.jacfwd(first, has_aux=True)(p)

    p = jnp.array([0.7, 0.4])
    hessian, (slope, there) = derivatives(p)
    value, gradient, curvature = jax.jit(lambda p: (closed(p), jax.jacfwd(closed)(p), jax.hessian(closed)(p)))(p)
    np.testing.assert_allclose(there, value, atol=1e-11)
    np.testing.assert_allclose(slope, gradient, atol=1e-10)
    np.testing.assert_allclose(hessian, curvature, atol=1e-8)
    np.testing.assert_allclose(jax.jit(jax.jacfwd(by_arrays))(p), gradient, atol=1e-10)
    # Which ones are free may be known to the program only when it runs.
    chosen = jax.jit(lambda p, free: jax.jacfwd(lambda p: end(p, free=free))(p))
    np.testing.assert_allclose(chosen(p, both), gradient, atol=1e-10)
    step = 1e-5 * np.eye(2)
    differences = [(derivatives(p + h)[1][1] - derivatives(p - h)[1][1]) / 2e-5 for h in step]
    np.testing.assert_allclose(slope, differences, atol=1e-8)

    if not exact:
        assert _columns(end, p) == 3
        assert _columns(lambda x: end(p, x), y) == 1
        assert _columns(by_arrays, p) == 3
        by_c = FreeParameters.of(model.system, ("c",))
        for free in (by_c, by_c.fixed):
            assert _columns(lambda c, free=free: end(c, free=free), p[1]) == 2


def _columns(fn, x):
    """How many columns the variational equation of a derivative carries."""
    jaxpr = jax.make_jaxpr(lambda x: jax.jvp(fn, (x,), (jnp.ones_like(x),)))(x)
    return max(_widths(jaxpr.jaxpr))


def _widths(jaxpr):
    found = set()
    for eqn in jaxpr.eqns:
        if eqn.primitive.name == "while":
            found |= {v.aval.shape[0] for v in eqn.outvars if v.aval.ndim == 2 and v.aval.shape[1] == 1}
        for inner in jaxprs_in_params(eqn.params):
            found |= _widths(inner)
    return found


@pytest.mark.slow
def test_two_frequencies():
    """What the exponential does not know goes by steps."""
    points = []
    for both in (1.0, 0.0):
        system = Driven(both=both)
        how = dict(solver=dfx.Tsit5(), stepsize_controller=pid(1e-12), method="shooting")
        branch = continue_orbit(system, find_orbit(system, Motion(1.0, 0.0), order=1, **how), "omega", (0.69, 0.71))
        k = np.array([1, 2])[:, None]
        gains = np.array([1.0, both])[:, None] / (1 - (k * branch.values) ** 2 + 0.2j * k * branch.values)
        want = np.sum(gains * np.exp(1j * k * branch.values * branch.ts), axis=0).real
        np.testing.assert_allclose(branch.ys.x, want, atol=1e-10)
        points.append(len(branch))
    assert min(points) > 2
