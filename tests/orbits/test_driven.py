"""`find_orbit` where all numbers are known: Python calls one program, and finds what the traced search finds."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from models import Motion

import nsjax
from nsjax import find_orbit, gallery


def test_a_new_number_is_no_new_program():
    """Issue 22: neither another parameter nor another guess is compiled for."""
    find_orbit(gallery.StickSlip(), Motion(2.02, 0.0), period=13.54)
    compiled = []

    def heard(event, seconds, **_):
        if event == "/jax/core/compile/backend_compile_duration":
            compiled.append(seconds)

    jax.monitoring.register_event_duration_secs_listener(heard)
    try:
        orbit = find_orbit(gallery.StickSlip(v_dr=0.25), Motion(2.0, 0.1), period=12.0)
        assert orbit.stable and not compiled
        jax.jit(lambda x: x + 3)(jnp.ones(7)).block_until_ready()
        assert compiled  # it would have been heard
    finally:
        jax.monitoring.unregister_event_duration_listener(heard)


class Rotor(nsjax.System):
    """x'' = -x + (x² + v² - 1) v: the unit circle repels, and attracts backwards in time; e^{4 π} is its multiplier."""

    def vector_field(self, t, y, s):
        return Motion(y.v, -y.x + (y.x**2 + y.v**2 - 1) * y.v)


CASES = {
    "autonomous": lambda: (gallery.thesis("3.4"), Motion(2.02, 0.0), dict(period=13.54)),
    "backward": lambda: (Rotor(), Motion(1.1, 0.0), dict(period=6.2, backward=True)),
    "forced": lambda: (gallery.thesis("6.8"), gallery.entry("6.8").y0, {}),
    "symmetric": lambda: (gallery.thesis("6.8"), gallery.entry("6.8").y0, dict(symmetry="inversion")),
}


@pytest.mark.parametrize("case", [pytest.param(c, marks=[pytest.mark.slow] * (c != "autonomous")) for c in CASES])
def test_one_program_finds_the_same(case):
    """The search within `jax.jit`, one program of its own, has the same base point, period, multipliers and events; its
    multipliers come from saltation matrices, and not from the derivative of the flow."""
    system, start, options = CASES[case]()
    stepwise = find_orbit(system, start, **options)
    whole = jax.jit(lambda system: find_orbit(system, start, **options))(system)
    for name in ("t0", "y0", "mode", "period", "structural_zeros", "stable"):
        np.testing.assert_allclose(
            *(jnp.stack(jax.tree.leaves(getattr(o, name))) for o in (stepwise, whole)), atol=1e-9
        )
    np.testing.assert_allclose(stepwise.multipliers, whole.multipliers, atol=1e-8)
    np.testing.assert_allclose(stepwise.monodromy, whole.monodromy, atol=1e-8)
    assert stepwise.itinerary.same_as(whole.itinerary)
    assert stepwise.events.t.shape == whole.events.t.shape


def test_constants_within_a_program():
    """Within `jax.jit` not even constants are known to Python: there is one try, and no question of their values."""
    period = jax.jit(lambda: find_orbit(Rotor(), Motion(1.1, 0.0), period=6.2, backward=True).period)()
    np.testing.assert_allclose(period, 2 * np.pi, rtol=1e-9)


@pytest.mark.slow
def test_events_beyond_the_bound():
    """The look for a base point has room for several periods; the orbit has not."""
    system = gallery.thesis("3.4")
    orbit = find_orbit(system, Motion(2.02, 0.0), period=13.54, max_events=2)
    assert orbit.events.t.shape == (2,) and int(orbit.events.num) == 2
    failed = find_orbit(system, Motion(2.02, 0.0), period=13.54, max_events=1, method="shooting", throw=False)
    assert failed.result == nsjax.RESULTS.orbit_not_found


class Powers(nsjax.System):
    """A spring of the power p, with an amplitude sqrt(a): at x < 0 and a = 0 what they make has no derivative by p, a."""

    p: float = 3.0
    a: float = 0.0
    count: int = 1

    def vector_field(self, t, y, s):
        force = jnp.cos(1.3 * t) - jnp.sqrt(self.a) - jnp.power(y.x, self.p) - 0.1 * s.friction
        return Motion(y.v, force - 0.3 * self.count * y.v)

    @nsjax.sgn
    def friction(self, t, y):
        return y.v

    @property
    def period(self):
        return 2 * jnp.pi / 1.3


@pytest.mark.slow
def test_a_parameter_by_which_nothing_can_be_differentiated():
    """Zero times an infinite derivative is not a number; the derivative by the state is one."""
    start = Motion(0.1, 0.1)
    orbit = find_orbit(Powers(), start)

    def state(x):
        return jnp.stack(nsjax.solve(Powers(), 0.0, Powers().period, Motion(*x)).y1)

    monodromy = jax.jacfwd(state)(jnp.stack(orbit.y0))
    np.testing.assert_allclose(orbit.monodromy, monodromy, atol=1e-6)
    # What the search finds within `jit`; where solutions settle is another orbit.
    np.testing.assert_allclose(np.stack(orbit.y0), [0.923124592128, 1.81383170516], atol=1e-9)
