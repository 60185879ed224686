"""`find_orbit` where all numbers are known: Python calls one program, and finds what the traced search finds."""

import dataclasses

import diffrax
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from models import Motion
from programs import compilations

import nsjax
from nsjax import find_orbit, gallery
from nsjax.orbits._passage import passage
from nsjax.plot._path import once_round


QUICK = dict(solver=diffrax.Tsit5())  # of half the size of the default; tests of one system share its program


def test_a_new_number_is_no_new_program():
    """Neither another parameter nor another guess is compiled for."""
    find_orbit(gallery.StickSlip(), Motion(2.02, 0.0), period=13.54, **QUICK)
    with compilations() as compiled:
        orbit = find_orbit(gallery.StickSlip(v_dr=0.25), Motion(2.0, 0.1), period=12.0, **QUICK)
        assert orbit.stable and not compiled
        jax.jit(lambda x: x + 3)(jnp.ones(7)).block_until_ready()
        assert compiled  # it would have been heard


def test_results_are_read_without_a_program_for_each_operation():
    """Eager operations are programs too, of some 30 ms each. Events, prints and dense output need none, or
    one."""
    sol = nsjax.solve(gallery.StickSlip(), 0.0, 20.0, Motion(2.5, 0.0), saveat=diffrax.SaveAt(dense=True))
    with compilations() as compiled:
        assert len(list(sol.events)) == 3 and str(sol.events).count("belt") == 6
        assert not compiled
        one = sol(np.linspace(0, 20, 7))
        assert len(compiled) <= 4  # each operation by itself made forty
        assert one.x.shape == (7,) and float(one.x[0]) == 2.5
        count = len(compiled)
        sol(np.linspace(1, 19, 7))
        assert len(compiled) == count


@pytest.mark.parametrize("key", ["3.4", pytest.param("6.6", marks=pytest.mark.slow)])
def test_once_round_an_orbit_by_the_program_that_found_it(key, monkeypatch):
    """A picture of an orbit that was found compiles no solution of its own; the solution is the same."""
    given = gallery.entry(key)
    period = {} if given.system().period is not None else dict(period=given.orbit.period)
    orbit = find_orbit(given.system(), given.orbit.y0, **period, **QUICK)
    own = orbit.solve()
    monkeypatch.delattr(type(orbit), "solve")
    sol = once_round(orbit)
    ts = orbit.t0 + orbit.period * np.linspace(0, 1, 30)
    for a, b in zip(sol(ts), own(ts)):
        np.testing.assert_allclose(a, b, atol=1e-11)
    np.testing.assert_allclose(sol.events.t[: len(sol.events)], own.events.t[: len(own.events)], rtol=1e-12)


def test_a_point_on_a_surface_needs_its_mode():
    """The program knows of no modes but those of relays: where the orbit slides, h alone does not say how it goes on."""
    orbit = find_orbit(gallery.thesis("3.4"), Motion(2.02, 0.0), period=13.54, **QUICK)
    stick = next(e for e in orbit.events if e.mode_after == {"belt": 0})
    assert passage(orbit, stick.t, stick.y_after, (0,)) is not None  # attracted, so that it is the only way
    assert passage(orbit, orbit.t0, orbit.y0, (0,)) is None


def test_a_program_that_is_not_there_is_not_compiled_for_a_picture():
    """The flow map has twice the size of a solution."""

    class Other(gallery.StickSlip):
        pass

    orbit = find_orbit(gallery.thesis("3.4"), Motion(2.02, 0.0), period=13.54, **QUICK)
    assert passage(orbit, orbit.t0, orbit.y0, orbit.mode) is not None
    assert passage(dataclasses.replace(orbit, system=Other()), orbit.t0, orbit.y0, orbit.mode) is None


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


@pytest.mark.slow
@pytest.mark.parametrize("case", CASES)
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
    period = jax.jit(lambda: find_orbit(Rotor(), Motion(1.1, 0.0), period=6.2, backward=True, **QUICK).period)()
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
