"""Systems beyond the thesis: what is known of each, in closed form or by an independent computation."""

import diffrax
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from buck import flip_of_the_buck_converter, multipliers_of_the_buck_converter
from scipy.optimize import brentq

import nsjax
from nsjax import gallery


def test_names():
    """However they are written; one that is misspelt is told with all that there are."""
    assert gallery.entry("Brake-Squeal") is gallery.APPLICATIONS["brake squeal"]
    assert set(gallery.SYSTEMS) == {*gallery.THESIS, *gallery.APPLICATIONS}
    with pytest.raises(ValueError, match="'neuron'"):
        gallery.entry("neurone")


@pytest.mark.slow
def test_blocks_that_start_alike_move_alike():
    """The springs between them do nothing: all have the period of section 3.4."""
    chain = gallery.BlockChain(n=2)
    sol = nsjax.solve(chain, 0.0, 45.0, chain.state({"x1": 2.0, "x2": 2.0}))
    begins = [float(e.t) for e in sol.events if e.switch == "belt2" and e.mode_after["belt2"] == 0]
    assert len(begins) == 4
    np.testing.assert_allclose(np.diff(begins[1:]), 10 + np.pi + 2 * np.arctan(1 / 5), atol=1e-6)
    np.testing.assert_allclose(sol.y1.q.x1, sol.y1.q.x2, atol=1e-12)


@pytest.mark.parametrize("c", [0.1, pytest.param(0.02, marks=pytest.mark.slow)])
def test_a_brake_squeals_from_its_hopf_point_on(c):
    brake = gallery.BrakePad(mu=0.7, c=c)
    branch = nsjax.continue_equilibrium(brake, gallery.Pad(4.0, -2.0, 0.0, 0.0), "mu", (0.6, 0.9))
    (hopf,) = branch.bifurcations
    assert hopf.kind == "Hopf" and not hopf.discontinuous
    np.testing.assert_allclose(hopf.value, (1.0 + c**2 * 4 / 2) / (4 / 3), atol=1e-10)
    np.testing.assert_allclose(hopf.period, 2 * np.pi / np.sqrt(2.0), rtol=1e-9)


@pytest.mark.slow
def test_a_brake_squeals_with_stick():
    """Beyond it small oscillations grow until the pad sticks to the disc."""
    brake = gallery.BrakePad(mu=0.85)
    still = nsjax.find_equilibrium(brake, gallery.Pad(4.0, -2.0, 0.0, 0.0))
    start = still.y._replace(x=still.y.x + 0.05)
    sol = nsjax.solve(brake, 0.0, 150.0, start)
    assert not bool(still.stable) and any(e.mode_after == {"disc": 0} for e in sol.events)


def gears(part):
    """A pair of gears, forced by a part of the force at which they begin to rattle, on its response while closed."""
    g = gallery.GearPair()
    onset = g.F_m * np.hypot(1 - g.m * g.omega**2 / g.k, g.c * g.omega / g.k)
    force = part * onset
    amplitude = force / (g.k - g.m * g.omega**2 + 1j * g.c * g.omega)
    pair = gallery.GearPair(F_a=force)
    place = {"d": g.b + g.F_m / g.k + amplitude.real}
    return pair, pair.state(place, {"d": (1j * g.omega * amplitude).real}), onset


@pytest.mark.parametrize("part, rattles", [(1 - 1e-6, False), (1 + 1e-6, True)])
def test_gears_rattle_from_where_the_response_is_the_static_deflection(part, rattles):
    pair, start, _ = gears(part)
    sol = nsjax.solve(
        pair, 0.0, 30.0, start, stepsize_controller=diffrax.PIDController(rtol=1e-11, atol=1e-11), dt0=0.1
    )
    assert (len(sol.events) > 0) == rattles


@pytest.mark.slow
def test_gears_rattle_beside_the_closed_mesh():
    """The branch of closed meshes comes to the surface at the onset, where nothing bifurcates, as the force is
    continuous; rattling gears coexist with it between two folds."""
    pair, start, onset = gears(0.9)
    orbit = nsjax.find_orbit(pair, start, order=1)
    branch = nsjax.continue_orbit(pair, orbit, "F_a", (0.05, 0.2), max_branches=1)
    (corner,) = [b for b in branch.special_points if not b.is_bifurcation]
    assert list(corner.surfaces) == ["mesh.upper"]
    np.testing.assert_allclose(corner.value, onset, atol=1e-10)
    low, high = sorted(b.value for b in branch.bifurcations if b.kind == "fold")
    assert low < onset < high


@pytest.mark.slow
def test_a_clutch_judders_below_its_hopf_point():
    clutch = gallery.Clutch(omega=2.0)
    branch = nsjax.continue_equilibrium(clutch, clutch.state({"theta": 0.1}), "omega", (1.0, 3.0))
    (hopf,) = branch.bifurcations
    np.testing.assert_allclose(
        hopf.value, (np.sqrt(clutch.T_0 * clutch.delta / clutch.c) - 1) / clutch.delta, atol=1e-10
    )
    np.testing.assert_allclose(hopf.period, 2 * np.pi, rtol=1e-9)
    assert not branch.stable[0] and branch.stable[-1]


@pytest.mark.slow
def test_a_buck_converter_flips():
    """A multiplier of its orbit is -1 where matrix exponentials say so; 24.516 is in the literature."""
    voltage = flip_of_the_buck_converter()
    assert abs(voltage - 24.516) < 1e-3
    orbit = nsjax.find_orbit(gallery.BuckConverter(V_in=voltage), gallery.Charge(12.0, 0.6), order=1)
    want = np.sort(multipliers_of_the_buck_converter(voltage).real)
    np.testing.assert_allclose(want[0], -1.0, atol=1e-10)
    np.testing.assert_allclose(np.sort(orbit.multipliers.real), want, atol=1e-8)


@pytest.mark.slow
@pytest.mark.parametrize("h, tau", [(0.1, 1.0), (0.5, 2.0)])
def test_a_relay_servo_has_its_period_in_closed_form(h, tau):
    half = brentq(lambda p: p - 2 * tau * np.tanh(p / (2 * tau)) - 2 * h, 1e-3, 20.0, xtol=1e-15)
    servo = gallery.RelayServo(h=h, tau=tau)
    orbit = nsjax.find_orbit(servo, gallery.Motion(0.0, 0.5), period=2.1 * half)
    np.testing.assert_allclose(orbit.period, 2 * half, atol=1e-11)
    assert orbit.stable


def test_a_neuron_fires_with_its_period_in_closed_form():
    orbit = nsjax.find_orbit(gallery.Neuron(), gallery.Potential(0.3), period=1.1, solver=diffrax.Tsit5())
    np.testing.assert_allclose(orbit.period, np.log(3.0), rtol=1e-12)


@pytest.mark.slow
def test_how_the_period_of_a_neuron_changes_with_the_current():
    def period(current):
        return nsjax.find_orbit(gallery.Neuron(I=current), gallery.Potential(0.3), period=1.1).period

    np.testing.assert_allclose(jax.jacfwd(period)(jnp.asarray(1.5)), 1 / 1.5 - 1 / 0.5, rtol=1e-9)
