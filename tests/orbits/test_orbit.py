"""Periodic orbits against closed forms and 40-digit references, and what the search says when there is none."""

import diffrax as dfx
import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import optimistix as optx
import pytest
import reference
import scipy.optimize
from models import Hammer, Motion, pid, Plane

import nsjax
from nsjax import find_orbit, fundamental_matrix, gallery, RESULTS


# Dopri8, the default, takes twice as long to compile.
METHOD = dict(solver=dfx.Tsit5(), stepsize_controller=pid(1e-13), max_steps=8192, max_events=16)


def by_autodiff(orbit, system):
    return fundamental_matrix(
        system, orbit.t0, orbit.t0 + orbit.period, orbit.y0, method="autodiff", mode=tuple(orbit.mode), **METHOD
    )


def spans(times, period):
    """Times between events around the cycle, which do not depend on the base point."""
    return np.mod(np.diff([*times, times[0]]), period)


@pytest.fixture(scope="module")
def classic():
    return find_orbit(gallery.StickSlip(), Motion(2.02, 0.0), period=13.54, **METHOD)


def test_section_3_4(classic):
    """Period 10 + π + 2 atan(1/5); stick from x = 0 to x = 2; multipliers 1 and 0 (pitfall 23: singular)."""
    period = 10 + np.pi + 2 * np.arctan(0.2)
    np.testing.assert_allclose(classic.period, period, atol=1e-10)
    assert [e.mode_after["belt"] for e in classic.events] == [0, -1]
    stick, slip = classic.events
    np.testing.assert_allclose(float(slip.t - stick.t), 10, atol=1e-10)
    np.testing.assert_allclose([stick.y_after.x, stick.y_after.v], [0.0, 0.2], atol=1e-10)
    np.testing.assert_allclose([slip.y_after.x, slip.y_after.v], [2.0, 0.2], atol=1e-10)
    np.testing.assert_allclose(classic.multipliers, [1, 0], atol=1e-10)
    assert classic.stable and classic.result == RESULTS.successful and classic.residual < 1e-10
    assert list(classic.itinerary) == [{"belt": -1}, {"belt": 0}, {"belt": -1}]
    assert "stable periodic orbit of StickSlip" in str(classic) and "13.536" in str(classic)


def check_stick_slip(orbit, exact, **parameters):
    np.testing.assert_allclose(orbit.period, exact.period, atol=1e-10)
    names = {0: "stick", -1: "slip"}
    assert [names[e.mode_after["belt"]] for e in orbit.events] == [e[1] for e in exact.events]
    np.testing.assert_allclose(
        spans([float(e.t) for e in orbit.events], exact.period),
        spans([e[0] for e in exact.events], exact.period),
        atol=1e-10,
    )
    for e, (_, _, x, v) in zip(orbit.events, exact.events):
        np.testing.assert_allclose([e.y_after.x, e.y_after.v], [x, v], atol=1e-10)
    np.testing.assert_allclose(orbit.multipliers, exact.multipliers, atol=1e-9)
    assert orbit.stable


@pytest.mark.parametrize("c", [0.0, pytest.param(0.1, marks=pytest.mark.slow)])
def test_sections_3_4_and_6_7(classic, c):
    orbit = classic if c == 0 else find_orbit(gallery.StickSlip(c=c), Motion(2.0, 0.0), period=12.635, **METHOD)
    check_stick_slip(orbit, reference.stick_slip_orbit(c=c))
    exact = reference.simulate(reference.StickSlip(c=c), float(orbit.period), map(float, orbit.y0))
    np.testing.assert_allclose(orbit.monodromy, reference.floats(exact.fundamental), atol=1e-9)
    if c:
        np.testing.assert_allclose(by_autodiff(orbit, gallery.StickSlip(c=c)), orbit.monodromy, atol=1e-8)
        # Pitfall 22: it slips in friction's direction, and sticks only as far as friction can hold.
        sol = orbit.solve(saveat=dfx.SaveAt(ts=jnp.linspace(0.0, orbit.period, 200)))
        mode, x, v = map(np.asarray, (sol.modes[:, 0], sol.ys.x, sol.ys.v))
        assert set(mode) == {-1, 0} and np.all(v[mode == -1] <= 0.2)
        assert np.all(np.abs(x + c * v)[mode == 0] <= 2 + 1e-9)


@pytest.mark.slow
@pytest.mark.parametrize("solver", [nsjax.Taylor(), nsjax.Exponential()])
@pytest.mark.parametrize("method", ["shooting", "segments"])
def test_other_solvers(classic, solver, method):
    options = METHOD | dict(solver=solver, method=method)
    orbit = find_orbit(gallery.StickSlip(), Motion(2.02, 0.0), period=13.54, **options)
    np.testing.assert_allclose(orbit.period, classic.period, atol=1e-11)
    np.testing.assert_allclose(orbit.multipliers, [1, 0], atol=1e-10)


@pytest.mark.slow
def test_section_2_4():
    orbit = find_orbit(gallery.FallingStickSlip(), Motion(1.1, 0.0), period=12.0, **METHOD)
    check_stick_slip(orbit, reference.friction_curve_orbit())


@pytest.mark.slow
def test_section_3_5():
    """A forced orbit over a surface with a corner; its base point is at t0, as asked for."""
    system = gallery.DiscontinuousSupport()
    orbit = find_orbit(system, Motion(1.11, 1.34), **METHOD)
    exact = reference.support_orbit((1.11, 1.34), omega=1.2)
    np.testing.assert_allclose(orbit.period, exact.period, rtol=1e-14)
    np.testing.assert_allclose([orbit.y0.x, orbit.y0.v], exact.y0, atol=1e-10)
    names = {1: "contact", -1: "release"}
    assert [names[e.mode_after["support"]] for e in orbit.events] == [e[1] for e in exact.events]
    np.testing.assert_allclose([float(e.t) for e in orbit.events], [e[0] for e in exact.events], atol=1e-10)
    np.testing.assert_allclose(orbit.monodromy, exact.monodromy, atol=1e-9)
    np.testing.assert_allclose(
        np.sort_complex(np.asarray(orbit.multipliers)), np.sort_complex(exact.multipliers), atol=1e-9
    )
    assert orbit.stable


@pytest.mark.slow
@pytest.mark.parametrize(
    "system, y0, period",
    [(gallery.FallingStickSlip(), (1.1, 0.0), 12.0), (gallery.DiscontinuousSupport(), (1.11, 1.34), None)],
)
def test_monodromies_of_both_routes(system, y0, period):
    """Sections 2.4 and 3.5; that of 6.7 is in the test above."""
    orbit = find_orbit(system, Motion(*y0), period=period, **METHOD)
    np.testing.assert_allclose(by_autodiff(orbit, system), orbit.monodromy, atol=1e-8)


def test_period_is_found(classic):
    """Without a guess of the period the solution is followed to where it settles."""
    orbit = find_orbit(gallery.StickSlip(), Motion(1.5, 0.0), **METHOD)
    np.testing.assert_allclose(orbit.period, classic.period, atol=1e-10)


@pytest.mark.slow
def test_solution_over_several_periods(classic):
    sol = classic.solve(periods=2)
    np.testing.assert_allclose([sol.y1.x, sol.y1.v], [classic.y0.x, classic.y0.v], atol=1e-9)
    assert len(sol.events) == 4
    middle = sol(classic.period)
    np.testing.assert_allclose([middle.x, middle.v], [classic.y0.x, classic.y0.v], atol=1e-9)


# What may go wrong: pitfall 26.


@pytest.mark.parametrize(
    "parameters, y0, period, result",
    [
        pytest.param(  # a focus at x = F_slip / k
            dict(c=0.1), (1.0, 1e-3), 6.3, RESULTS.orbit_is_equilibrium, marks=pytest.mark.slow
        ),
        (dict(c=0.1), (2.0, 0.0), 2 * 12.6352, RESULTS.orbit_is_multiple_cover),
        (dict(), (2.02, 0.0), 3 * 13.536, RESULTS.orbit_is_multiple_cover),
        pytest.param(  # beyond the fold of Fig. 6.15
            dict(c=0.1, v_dr=2.0), (2.0, 0.0), 12.6, RESULTS.orbit_is_equilibrium, marks=pytest.mark.slow
        ),
    ],
)
def test_not_the_orbit_asked_for(parameters, y0, period, result):
    """Pitfall 26: ends in an equilibrium, or goes round more than once; both are told."""
    system = gallery.StickSlip(**parameters)
    orbit = find_orbit(system, Motion(*y0), period=period, throw=False, **METHOD)
    assert orbit.result == result
    with pytest.raises(nsjax.SolveError, match=str(RESULTS[result])[:30]):
        find_orbit(system, Motion(*y0), period=period, **METHOD)


class Wall(nsjax.System):
    """x'' + c x' + x = cos ωt, x <= gap with restitution 0.6."""

    omega: float = 0.8
    c: float = 0.4
    gap: float = 1.0

    def vector_field(self, t, y, s):
        return Motion(y.v, jnp.cos(self.omega * t) - self.c * y.v - y.x - s.wall)

    @nsjax.impact
    def wall(self, t, y):
        return self.gap - y.x

    @wall.restitution
    def wall(self):
        return 0.6

    @property
    def period(self):
        return 2 * jnp.pi / self.omega


@pytest.mark.slow
def test_an_orbit_does_not_pass_through_a_wall():
    """Pitfall 22: the guess is on the orbit that the system has without its wall."""
    free = 1 / (1 - 0.8**2 + 0.4 * 0.8j)
    assert abs(free) > 2
    # A quarter of the period before cos ωt = 1.
    orbit = find_orbit(Wall(), Motion(free.imag, 0.8 * free.real), t0=-np.pi / 1.6, **METHOD)
    sol = orbit.solve(saveat=dfx.SaveAt(ts=jnp.linspace(orbit.t0, orbit.t0 + orbit.period, 500)))
    assert len(sol.events) >= 1 and 1 - 1e-3 < sol.ys.x.max() < 1 + 1e-12


class Hopf(nsjax.System):
    """r' = rate r (μ - r²), θ' = w in Cartesian coordinates: the orbit r = √μ, multipliers 1 and exp(-2 μ T)."""

    rate: float = 1.0
    mu: float = 0.5
    w: float = 2.0
    drift: float = 0.0

    def vector_field(self, t, y, s):
        rise = self.rate * (self.mu - y.x**2 - y.y**2)
        return Plane(y.x * rise - self.w * y.y + self.drift, y.y * rise + self.w * y.x)


class Resonator(nsjax.System):
    """x'' + c x' + k x = f_0 cos ωt."""

    c: float = 0.2
    k: float = 1.0
    f_0: float = 1.0
    omega: float = 0.7

    def vector_field(self, t, y, s):
        return Motion(y.v, self.f_0 * jnp.cos(self.omega * t) - self.c * y.v - self.k * y.x)

    @property
    def period(self):
        return 2 * jnp.pi / self.omega


@pytest.mark.slow
def test_no_orbit_at_all():
    """Nothing returns: x only grows."""
    with pytest.raises(nsjax.SolveError, match="No periodic orbit was found"):
        find_orbit(Hopf(rate=0.0, w=0.0, drift=1.0), Plane(1.0, 0.0), period=3.0, **METHOD)
    assert (
        find_orbit(Hopf(rate=0.0, w=0.0, drift=1.0), Plane(1.0, 0.0), throw=False, **METHOD).result
        == RESULTS.orbit_not_found
    )


def test_smooth_autonomous_orbit_and_its_derivatives():
    """Period 2 π / w and r = √μ; derivatives of the period, the state and the multipliers by parameters."""

    def orbit(p):
        o = find_orbit(Hopf(mu=p[0], w=p[1]), Plane(0.9, 0.1), period=3.0, throw=False, **METHOD)
        value = jnp.stack([o.period, jnp.hypot(*o.y0), jnp.min(jnp.abs(o.multipliers))])
        return value, (value, o.result)

    p = jnp.asarray([0.5, 2.0])
    derivative, (value, result) = jax.jit(jax.jacfwd(orbit, has_aux=True))(p)
    assert result == RESULTS.successful
    T, small = np.pi, np.exp(-np.pi)
    np.testing.assert_allclose(value, [T, np.sqrt(0.5), small], rtol=1e-10)
    np.testing.assert_allclose(
        derivative, [[0, -T / 2], [0.5 / np.sqrt(0.5), 0], [-2 * T * small, T / 2 * small]], atol=1e-8
    )


@pytest.mark.slow  # (by default in reverse mode, below)
def test_forced_orbit_and_its_derivative():
    def exact(c, k, omega):
        stiff, damp = k - omega**2, c * omega
        return jnp.stack([stiff, omega * damp]) / (stiff**2 + damp**2)

    def orbit(p):
        o = find_orbit(Resonator(c=p[0], k=p[1], omega=p[2]), Motion(0.0, 0.0), throw=False, **METHOD)
        return jnp.stack(o.y0), (jnp.stack(o.y0), o.result)

    p = jnp.asarray([0.2, 1.0, 0.7])
    derivative, (y0, result) = jax.jit(jax.jacfwd(orbit, has_aux=True))(p)
    assert result == RESULTS.successful
    np.testing.assert_allclose(y0, exact(*p), atol=1e-10)
    np.testing.assert_allclose(derivative, jnp.stack(jax.jacfwd(exact, (0, 1, 2))(*p), -1), atol=1e-8)


@pytest.mark.slow
def test_maximum():
    """The amplitude of a resonator, with its first and second derivatives; it lies between the samples."""

    def amplitude(p):
        orbit = find_orbit(Resonator(c=p[0], omega=p[1]), Motion(0.0, 0.0), throw=False, **METHOD)
        return orbit.maximum(lambda t, y: jnp.abs(y.x))

    def exact(p):
        return 1 / jnp.hypot(1 - p[1] ** 2, p[0] * p[1])

    p = jnp.asarray([0.2, 0.7])
    np.testing.assert_allclose(amplitude(p), exact(p), rtol=1e-11)
    np.testing.assert_allclose(jax.jit(jax.jacfwd(amplitude))(p), jax.grad(exact)(p), rtol=1e-9)
    np.testing.assert_allclose(jax.jit(jax.jacfwd(jax.jacfwd(amplitude)))(p), jax.hessian(exact)(p), rtol=1e-7)


class TwoTones(nsjax.System):
    """A damped oscillator forced at frequencies 1 and 0.97: its orbit has a hundred peaks, of which none is another."""

    c: jax.Array | float = 0.3
    period = 200 * np.pi

    def vector_field(self, t, y, s):
        return Motion(y.v, -y.x - self.c * y.v + 0.1 * (jnp.cos(t) + jnp.cos(0.97 * t)))


def two_tones(t, c=0.3):
    return sum((0.1 * np.exp(1j * w * t) / (1 - w**2 + 1j * c * w)).real for w in (1, 0.97))


@pytest.mark.slow
def test_maximum_of_many_peaks():
    """Pitfall 41: no fixed number of samples decides which of a hundred peaks is the largest."""
    orbit = find_orbit(TwoTones(), Motion(0.0, 0.3), max_steps=20000)
    ts = np.linspace(0, 200 * np.pi, 2_000_001)
    for sign in (1, -1):
        top = ts[np.argmax(sign * two_tones(ts))]
        found = scipy.optimize.minimize_scalar(lambda t: -sign * two_tones(t), bracket=(top - 1e-3, top, top + 1e-3))
        np.testing.assert_allclose(orbit.maximum(lambda t, y: sign * y.x), -found.fun, rtol=1e-11)
    # What it was by 65 samples and Newton's method.
    assert np.max(orbit.path().y.x) < 0.98 * np.max(two_tones(ts))
    # A kink where it is least harms nothing; nor does a quantity that does not change.
    np.testing.assert_allclose(orbit.maximum(lambda t, y: jnp.abs(y.x)), np.abs(two_tones(ts)).max(), rtol=1e-9)
    np.testing.assert_allclose(orbit.maximum(lambda t, y: 0 * y.x + 2), 2, rtol=1e-15)


@pytest.mark.slow
def test_maximum_of_an_orbit_that_sticks(classic):
    """1 + √(1 + v²) in slip, at a state that Fig. 3.7 begins with; v_dr in stick, where it is not one place alone."""
    np.testing.assert_allclose(classic.maximum(lambda t, y: y.x), 1 + np.hypot(1, 0.2), rtol=1e-11)
    np.testing.assert_allclose(classic.maximum(lambda t, y: y.v), 0.2, rtol=1e-11)
    np.testing.assert_allclose(classic.maximum(lambda t, y: -y.v), np.hypot(1, 0.2), rtol=1e-11)


@pytest.mark.slow
def test_reverse_mode():
    """With `DirectAdjoint`, as `jax.grad` and optimisers need it; without it is refused, by name."""

    def amplitude(p, adjoint):
        options = METHOD | dict(stepsize_controller=pid(1e-11))
        o = find_orbit(Resonator(c=p[0], omega=p[1]), Motion(0.0, 0.0), throw=False, adjoint=adjoint, **options)
        return jnp.hypot(o.y0.x, o.y0.v / p[1])

    def exact(p):
        return 1 / jnp.hypot(1 - p[1] ** 2, p[0] * p[1])

    p = jnp.asarray([0.2, 0.7])
    found = jax.jit(jax.grad(lambda p: amplitude(p, dfx.DirectAdjoint())))(p)
    np.testing.assert_allclose(found, jax.grad(exact)(p), rtol=1e-8)
    with pytest.raises(TypeError, match="`nsjax.find_orbit` was linearised .* needs `adjoint=diffrax.DirectAdjoint"):
        jax.grad(lambda p: amplitude(p, dfx.ForwardMode()))(p)
    with pytest.raises(ValueError, match="`adjoint` must be `diffrax.ForwardMode"):
        amplitude(p, dfx.RecursiveCheckpointAdjoint())


@pytest.mark.slow
def test_fit_by_optimistix():
    """Least squares need `jax.linearize`: damping and frequency from a state of the orbit."""
    options = METHOD | dict(stepsize_controller=pid(1e-10), adjoint=dfx.DirectAdjoint(), throw=False)

    def remainder(p, data):
        orbit = find_orbit(Resonator(c=p[0], omega=p[1]), Motion(0.0, 0.0), **options)
        return jnp.stack([*orbit.y0]) - data

    true = jnp.array([0.2, 0.7])
    data = remainder(true, jnp.zeros(2))
    method = optx.LevenbergMarquardt(rtol=1e-8, atol=1e-8)
    found = optx.least_squares(remainder, method, jnp.array([0.3, 0.6]), args=data, max_steps=30)
    np.testing.assert_allclose(found.value, true, atol=1e-7)


@pytest.mark.slow
def test_derivative_where_there_is_no_orbit():
    """Pitfall 17: one lane of a batch has none, and there the derivative is not a number."""

    def period(w):
        drift = jnp.where(w == 0, 1.0, 0.0)
        o = find_orbit(Hopf(w=w, rate=1 - drift, drift=drift), Plane(0.9, 0.1), period=3.0, throw=False, **METHOD)
        return o.period, o.result

    derivative, result = jax.jit(jax.vmap(jax.jacfwd(period, has_aux=True)))(jnp.asarray([2.0, 0.0, 2.2]))
    assert list(result == RESULTS.successful) == [True, False, True]
    np.testing.assert_allclose(derivative[::2], -2 * np.pi / np.array([2.0, 2.2]) ** 2, rtol=1e-9)
    assert np.isnan(derivative[1])


@pytest.mark.slow
def test_derivative_of_the_stick_slip_period():
    """T = 2 / v + π + 2 atan v."""

    def period(v):
        return find_orbit(gallery.StickSlip(v_dr=v), Motion(2.02, 0.0), period=13.54, throw=False, **METHOD).period

    for v in (0.2, 0.3):
        found = jax.jit(jax.jacfwd(period))(jnp.asarray(v))
        np.testing.assert_allclose(found, -2 / v**2 + 2 / (1 + v**2), rtol=1e-8)


@pytest.mark.slow
@pytest.mark.parametrize("method", ["shooting", "segments"])
def test_second_derivative_of_the_stick_slip_period(method):
    """T'' = 4 / v³ - 4 v / (1 + v²)²; pitfall 20."""
    options = METHOD | dict(stepsize_controller=pid(1e-12), max_steps=1024, max_events=4, method=method)

    def period(v):
        return find_orbit(gallery.StickSlip(v_dr=v), Motion(2.02, 0.0), period=13.54, throw=False, **options).period

    v = 0.2
    found = jax.jit(jax.jacfwd(jax.jacfwd(period)))(jnp.asarray(v))
    np.testing.assert_allclose(found, 4 / v**3 - 4 * v / (1 + v**2) ** 2, rtol=1e-8)


@pytest.mark.slow
def test_second_derivative_of_a_multiplier():
    """exp(-4 π μ / w); jax's own rule for eigenvalues has no second derivative."""

    def small(p):
        orbit = find_orbit(Hopf(mu=p[0], w=p[1]), Plane(0.9, 0.1), period=3.0, throw=False, **METHOD)
        return jnp.min(jnp.abs(orbit.multipliers))

    p = jnp.asarray([0.5, 2.0])
    exact = jax.hessian(lambda p: jnp.exp(-4 * jnp.pi * p[0] / p[1]))(p)
    np.testing.assert_allclose(jax.jit(jax.jacfwd(jax.jacfwd(small)))(p), exact, rtol=1e-7)


@pytest.mark.slow
def test_many_orbits_at_once():
    """Pitfall 17: a sweep over the belt's velocity, with one lane that has no orbit."""
    v = jnp.asarray([0.15, 0.2, 0.4, jnp.nan, 0.8])

    @jax.jit
    @jax.vmap
    def sweep(v):
        o = find_orbit(gallery.StickSlip(v_dr=v), Motion(2.02, 0.0), period=reference_period(v), throw=False, **METHOD)
        return o.period, o.multipliers, o.result, o.stable

    period, multipliers, result, stable = sweep(v)
    good = np.isfinite(v)
    np.testing.assert_allclose(period[good], reference.stick_slip_period(np.asarray(v))[good], atol=1e-9)
    np.testing.assert_allclose(multipliers[good], np.tile([1, 0], (4, 1)), atol=1e-9)
    assert np.all((result == RESULTS.successful) == good) and np.all(stable[good])


def reference_period(v):
    return 2 / v + jnp.pi


@pytest.mark.parametrize(
    "change, message",
    [
        (dict(order=0), "`order` must be a positive integer"),
        (dict(order=2), "`order` must be 1 for an autonomous system"),
        (dict(period=-1.0), "`period` must be positive"),
        (dict(max_steps=0), "`max_steps` must be a positive integer"),
    ],
)
def test_wrong_arguments(change, message):
    with pytest.raises(ValueError, match=message):
        find_orbit(gallery.StickSlip(), Motion(2.0, 0.0), **(dict(period=13.5) | METHOD | change))


def test_a_period_is_not_given_to_a_forced_system():
    with pytest.raises(ValueError, match="use `order` for a subharmonic"):
        find_orbit(Resonator(), Motion(0.0, 0.0), period=9.0)


def test_a_model_that_depends_on_time_has_a_period():
    """Else what is found repeats a state, but not what drives it."""
    with pytest.raises(ValueError, match="`Hammer` depends on the time t, but .* add a property `period`"):
        find_orbit(Hammer(), Motion(1.0, 0.0))


class Feedback(nsjax.System):
    """x'' + 0.1 x' + x = cos 0.7 t - 0.3 (2 r - 1), with a relay r of hysteresis."""

    def vector_field(self, t, y, s):
        return Motion(y.v, jnp.cos(0.7 * t) - 0.1 * y.v - y.x - 0.3 * (2 * s.r - 1))

    @nsjax.relay
    def r(self, t, y):
        return y.x - 0.2

    @r.off
    def r(self, t, y):
        return -0.2 - y.x

    @property
    def period(self):
        return 2 * jnp.pi / 0.7


@pytest.mark.slow
def test_the_mode_of_a_relay_comes_back():
    """Within the hysteresis there is a state that comes back, but with the relay on where it was off."""
    orbit = find_orbit(Feedback(), Motion(1.0, 0.0), **METHOD)
    sol = orbit.solve(saveat=dfx.SaveAt(ts=orbit.t0 + orbit.period * jnp.linspace(0, 1, 400)))
    i = int(np.flatnonzero((np.abs(sol.ys.x) < 0.1) & (sol.ys.v < 0))[0])  # on, on its way to be switched off
    guess, t0 = jax.tree.map(lambda y: y[i], sol.ys), sol.ts[i]
    found = find_orbit(Feedback(), guess, t0=t0, mode={"r": 1}, **METHOD)
    assert int(found.mode[0]) == 1
    np.testing.assert_allclose(found.multipliers, orbit.multipliers, rtol=1e-8)
    # (Under `jit` there is one try; else another one follows, from where the solution settles.)
    off = eqx.filter_jit(lambda y: find_orbit(Feedback(), y, t0=t0, mode={"r": 0}, throw=False, **METHOD))(guess)
    assert not bool(nsjax.is_okay(off.result))
    assert int(find_orbit(Feedback(), guess, t0=t0, mode={"r": 0}, **METHOD).mode[0]) == 1
    # It is found without being told.
    alone = find_orbit(Feedback(), guess, t0=t0, **METHOD)
    assert int(alone.mode[0]) == 1
    np.testing.assert_allclose(alone.y0, found.y0, rtol=1e-9)


class Thermostat(nsjax.System):
    """Heats below 0.9 until 1.1, towards `heat`: an orbit that never leaves the hysteresis."""

    heat: jax.Array | float

    def vector_field(self, t, y, s):
        return -y + self.heat * s.on

    @nsjax.relay
    def on(self, t, y):
        return 0.9 - y

    @on.off
    def on(self, t, y):
        return y - 1.1


@pytest.mark.slow
@pytest.mark.parametrize("heat", [1.5, 3.0])
@pytest.mark.parametrize("period", [None, 0.5])
def test_an_orbit_within_the_hysteresis(heat, period):
    """The base point lies in the longer arc, whichever mode that is of. Both in closed form."""
    on, off = np.log((heat - 0.9) / (heat - 1.1)), np.log(1.1 / 0.9)
    for method in ("shooting", "segments"):
        orbit = find_orbit(Thermostat(heat), jnp.asarray(1.0), period=period, method=method, **METHOD)
        np.testing.assert_allclose(orbit.period, on + off, rtol=1e-10)
        assert int(orbit.mode[0]) == (on > off)


class Held(nsjax.System):
    """x'' = -x - 0.1 x' - sgn(x') + p(t), which comes to stick for ever."""

    def push(self, t):
        return 0.0

    @nsjax.sgn
    def friction(self, t, y):
        return y.v

    def vector_field(self, t, y, s):
        return Motion(y.v, -y.x - 0.1 * y.v - s.friction + self.push(t))


class Driven(Held):
    period = 2 * np.pi

    def push(self, t):
        return 0.3 * jnp.cos(t)


@pytest.mark.parametrize(
    "system, guess",
    [(Held(), {}), (Held(), dict(period=6.0)), pytest.param(Driven(), {}, marks=pytest.mark.slow)],
    ids=["free", "period", "forced"],
)
@pytest.mark.parametrize(
    "y0",
    [Motion(0.1, 0.0), pytest.param(Motion(3.0, 0.1), marks=pytest.mark.slow)],
    ids=["at rest", "comes to rest"],
)
def test_a_continuum_is_named(system, guess, y0):
    """Every x that friction can hold is an equilibrium, or an orbit."""
    orbit = find_orbit(system, y0, throw=False, **guess, **METHOD)
    assert orbit.result == RESULTS.orbit_sticks_for_ever and not bool(nsjax.is_okay(orbit.result))


@pytest.mark.slow
def test_an_equilibrium_that_slides_is_no_continuum():
    """x' = -x on the surface y = 0 of y' = -sgn y: one point alone."""

    class Sliding(nsjax.System):
        @nsjax.sgn
        def surface(self, t, y):
            return y.v

        def vector_field(self, t, y, s):
            return Motion(-y.x, -s.surface)

    orbit = find_orbit(Sliding(), Motion(1.0, 0.2), throw=False, **METHOD)
    assert orbit.result == RESULTS.orbit_is_equilibrium


def test_an_orbit_comes_back_from_a_file(classic, tmp_path):
    """With all that can be done with it; by another solver it would be another orbit, which is refused."""
    system, orbit, path = gallery.StickSlip(), classic, tmp_path / "orbit.npz"
    orbit.save(path)
    again = nsjax.Orbit.load(path, gallery.StickSlip(v_dr=7.0), **METHOD)
    assert jax.tree.structure(again) == jax.tree.structure(orbit)
    for a, b in zip(jax.tree.leaves(again), jax.tree.leaves(orbit), strict=True):
        np.testing.assert_array_equal(a, b)
    assert str(again) == str(orbit) and again.integrator == orbit.integrator
    np.testing.assert_array_equal(again.path().y.x, orbit.path().y.x)
    with pytest.raises(ValueError, match="`rtol`, `atol`.* must be those with which the orbit was found.*rtol=1e-13"):
        nsjax.Orbit.load(path, system, rtol=1e-9, **METHOD | dict(stepsize_controller=None))
    with pytest.raises(
        ValueError, match="holds an `Orbit`, but an `Solution` was to be loaded. Use `nsjax.Orbit.load`"
    ):
        nsjax.Solution.load(path, system)
