"""The orbits of chapters 5 and 6, stable and unstable, from plausible guesses, against 40-digit references."""

import diffrax as dfx
import jax
import jax.numpy as jnp
import numpy as np
import orbit_reference
import pytest
from models import Motion, pid, Stop

import nsjax
from nsjax import find_orbit, gallery, RESULTS


METHOD = dict(solver=dfx.Tsit5(), stepsize_controller=pid(1e-13), max_steps=8192, max_events=16)


def cases(system, reference, keys, slow):
    mark = (pytest.mark.slow,) if slow else ()
    return [pytest.param(system, reference, key, marks=mark, id=f"{system.__name__}-{key}") for key in keys]


SHOTS = (
    *cases(Stop, orbit_reference.impact_orbit, orbit_reference.IMPACT, False),
    *cases(gallery.ForcedStickSlip, orbit_reference.forced_stick_slip_orbit, orbit_reference.STICK_SLIP, True),
    *cases(gallery.ForcedFriction, orbit_reference.friction_orbit, orbit_reference.FRICTION, True),
    *cases(gallery.Trilinear, orbit_reference.trilinear_orbit, orbit_reference.TRILINEAR, True),
)


def search(system, shot, **options):
    """From two digits of a state at t = 0."""
    return find_orbit(
        system(**shot.parameters), Motion(*shot.guess), order=shot.order, throw=False, **(METHOD | options)
    )


def check(orbit, shot):
    assert orbit.result == RESULTS.successful
    np.testing.assert_allclose([orbit.y0.x, orbit.y0.v], shot.y0, atol=1e-10)
    np.testing.assert_allclose(orbit.period, shot.period, rtol=1e-14)
    np.testing.assert_allclose([float(e.t) for e in orbit.events], [e[0] for e in shot.events], atol=1e-10)
    # Conjugate pairs come in either order.
    np.testing.assert_allclose(np.abs(orbit.multipliers), np.abs(shot.multipliers), atol=1e-8)
    np.testing.assert_allclose(np.real(orbit.multipliers), np.real(shot.multipliers), atol=1e-8)
    assert orbit.stable == shot.stable and orbit.admissible


@pytest.mark.parametrize("system, reference, key", SHOTS)
def test_shooting(system, reference, key):
    shot = reference(key)
    check(search(system, shot), shot)


@pytest.mark.slow
@pytest.mark.parametrize("system, reference, key", SHOTS)
def test_segments(system, reference, key):
    shot = reference(key)
    check(search(system, shot, method="segments"), shot)


@pytest.mark.slow
@pytest.mark.parametrize("method", ["shooting", "segments"])
def test_section_5_7(method):
    """Eight kinks in a period; size, but not period, in proportion to μ."""
    exact = orbit_reference.hopf_pitchfork_orbit()
    np.testing.assert_allclose(exact.period, 4.03, atol=5e-3)  # the thesis's figure
    for size in 1.0, 0.3:
        orbit = find_orbit(
            gallery.thesis("5.7", mu=-size), gallery.Plane(1.5 * size, 0.0), period=4.0, method=method, **METHOD
        )
        np.testing.assert_allclose(orbit.period, exact.period, atol=1e-10)
        np.testing.assert_allclose(orbit.multipliers, exact.multipliers, atol=1e-8)
        assert list(orbit.trivial) == [True, False] and orbit.stable and len(orbit.events) == 8
        kinks = sorted(tuple(np.round([*e.y_after], 9)) for e in orbit.events)
        want = sorted(tuple(np.round(np.multiply(size, e[2:4]), 9)) for e in exact.events)
        np.testing.assert_allclose(kinks, want, atol=2e-9)


GRADIENTS = [
    (Stop, orbit_reference.impact_orbit, "three impacts", ("omega", "e")),
    (gallery.ForcedStickSlip, orbit_reference.forced_stick_slip_orbit, "V", ("omega", "alpha_1")),
    (gallery.ForcedFriction, orbit_reference.friction_orbit, "asymmetric, one stick", ("omega", "F_stick")),
    (gallery.Trilinear, orbit_reference.trilinear_orbit, "unstable", ("k_f", "f_0")),
]


@pytest.mark.slow
@pytest.mark.parametrize("method", ["shooting", "segments"])
@pytest.mark.parametrize("system, reference, key, names", GRADIENTS, ids=[case[0].__name__ for case in GRADIENTS])
def test_gradients(system, reference, key, names, method):
    """Of states, event times, amplitude and multipliers, against difference quotients of orbits found anew."""
    shot = reference(key)

    def measures(p):
        parameters = dict(shot.parameters) | dict(zip(names, p))
        options = METHOD | dict(method=method, throw=False, stepsize_controller=pid(1e-12))
        orbit = find_orbit(system(**parameters), Motion(*shot.y0), order=shot.order, **options)
        trace = jnp.sum(orbit.multipliers).real
        return jnp.stack([orbit.y0.x, orbit.y0.v, orbit.events.t[1], orbit.events.y_before.x[0], trace])

    default = system()
    p = jnp.array([float(shot.parameters.get(name, getattr(default, name))) for name in names])
    derivative = jax.jacfwd(measures)(p)

    def quotient(step):
        return np.stack([(measures(p + step * e) - measures(p - step * e)) / (2 * step) for e in jnp.eye(2)], axis=1)

    # Beside slow impacts third derivatives are large: extrapolated.
    exact = (4 * quotient(1e-5) - quotient(2e-5)) / 3
    size = 1 + np.abs(derivative)
    np.testing.assert_allclose(derivative / size, exact / size, atol=1e-6)


@pytest.mark.slow
def test_order_is_found_out():
    """The subharmonic from nothing but a start: followed to where it settles, it repeats itself after two periods."""
    shot = orbit_reference.impact_orbit("subharmonic")
    orbit = find_orbit(Stop(**shot.parameters), Motion(-0.5, 0.0), order=None, **METHOD)
    np.testing.assert_allclose(orbit.period, shot.period, rtol=1e-14)
    np.testing.assert_allclose(np.abs(orbit.multipliers), np.abs(shot.multipliers), atol=1e-8)
    # Another start leads, slowly, to the orbit without contact.
    free = find_orbit(Stop(**shot.parameters), Motion(0.0, 0.0), order=None, **METHOD)
    np.testing.assert_allclose(free.period, shot.period / 2, rtol=1e-14)
    assert len(free.events) == 0


@pytest.mark.slow
def test_grazing():
    """Pitfall 10: the linear orbit's amplitude is just the gap. By segments, with an impact of velocity zero, that is
    well-posed: the Jacobian of the equations is regular, and only the monodromy matrix does not exist."""
    c, omega = 0.1, 1.3
    response = 1 / (1 - omega**2 + 1j * c * omega)
    start, touch = 0.5, float(-np.angle(response) / omega) % (2 * np.pi / omega)
    system = Stop(c=c, omega=omega, gap=abs(response))
    free = {"stop": 0}
    segments = [nsjax.Segment(free, touch - start + 0.05, ends="stop"), nsjax.Segment(free, 2.0)]
    z = response * np.exp(1j * omega * start)
    exact = [z.real, (1j * omega * z).real]
    guess = Motion(exact[0] + 0.02, exact[1] - 0.03)
    orbit = find_orbit(system, guess, t0=start, segments=segments, **METHOD)
    np.testing.assert_allclose([orbit.y0.x, orbit.y0.v], exact, atol=1e-10)
    np.testing.assert_allclose([orbit.events.t[0], orbit.events.y_before.v[0]], [touch, 0], atol=1e-9)
    assert orbit.result == RESULTS.tangential_event and orbit.admissible
    assert "met tangentially" in str(RESULTS[orbit.result])
