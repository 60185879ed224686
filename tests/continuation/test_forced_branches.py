"""Branches of forced orbits: of a model with a clock through its flips, and of orbits that slide all along."""

import dataclasses
from typing import Any, NamedTuple

import jax.numpy as jnp
import numpy as np
import pytest

import nsjax
from nsjax.continuation.orbits._bifurcation import OrbitBifurcation, OrbitHalfBranch
from nsjax.maps._corner_normal_form import CornerKind


class Current(NamedTuple):
    v: Any  # [V]
    i: Any  # [A]


class BuckConverter(nsjax.System):
    """The voltage-controlled DC/DC buck converter, with time in ms."""

    V_in: Any = 18.0

    def vector_field(self, t, y, s):
        return Current((y.i - y.v / 22) / 0.047, (self.V_in * 0.5 * (1 - s.comparator) - y.v) / 20)

    @nsjax.clock
    def ramp(self):
        return 0.4

    @nsjax.sgn
    def comparator(self, t, y):
        return 8.4 * (y.v - 11.3) - (3.8 + 4.4 * ((t % 0.4) / 0.4))

    @property
    def period(self):
        return 0.4


@pytest.fixture(scope="module")
def buck():
    orbit = nsjax.find_orbit(BuckConverter(), Current(12.0, 0.5), order=None)
    return nsjax.continue_orbit(orbit.system, orbit, "V_in", (18.0, 31.5), max_laps=2)


@pytest.mark.slow
def test_the_flips_of_a_model_with_a_clock(buck):
    """On an orbit that is passed twice its clock has gone on in the second lap."""
    np.testing.assert_allclose([b.value for b in buck.bifurcations], [24.51657282856, 31.1179020], rtol=1e-8)
    (doubled,) = buck.others
    np.testing.assert_allclose(doubled.periods[1:], 0.8)  # (it begins at the flip)
    # The flow finds the same orbit again.
    again = doubled.orbit(len(doubled.values) // 2)
    end = nsjax.solve(again.system, again.t0, again.t0 + 0.8, again.y0, mode=None, rtol=1e-10, atol=1e-10)
    np.testing.assert_allclose(end.y1, again.y0, rtol=1e-7)


class Held(NamedTuple):
    x: Any
    v: Any
    u: Any


class HeldThroughout(nsjax.System):
    """A driven oscillator whose position acts on a switch that holds u = 0, as long as |2x| <= 3."""

    V: Any = 1.0

    def vector_field(self, t, y, s):
        return Held(y.v, -y.x - 0.1 * y.v + self.V * jnp.cos(2 * t), -3 * s.hold - 2 * y.x)

    @nsjax.sgn
    def hold(self, t, y):
        return y.u

    @property
    def period(self):
        return jnp.pi


@pytest.mark.slow
def test_an_orbit_that_slides_all_along():
    """|x| = V / |(i2)² + 0.2i + 1|; at 3/2 the switch lets go, and the orbit goes on with four events."""
    orbit = nsjax.find_orbit(HeldThroughout(), Held(0.0, 0.0, 0.0))
    branch = nsjax.continue_orbit(orbit.system, orbit, "V", (0.5, 6.0))
    (transition,) = branch.special_points
    assert "no bifurcation: sliding-mode transition" in str(branch) and not branch.bifurcations
    np.testing.assert_allclose(transition.value, 1.5 * abs(1 + 0.2j - 4), rtol=1e-9)
    assert branch.values[-1] == 6.0 and np.all(branch.stable)
    assert int(branch.orbit(len(branch.values) - 1).events.num) == 4


class Relative(NamedTuple):
    x: Any
    v: Any


class BallInCapsule(nsjax.System):
    """A ball between the two membranes of an inclined capsule that is shaken: a vibro-impact energy harvester."""

    F: Any = 0.3
    gravity: Any = 0.1
    restitution: Any = 0.5
    length: Any = 0.3

    def vector_field(self, t, y, s):
        return Relative(y.v, self.F * jnp.cos(jnp.pi * t) + self.gravity + s.bottom - s.top)

    @nsjax.impact
    def bottom(self, t, y):
        return y.x + self.length / 2

    @bottom.restitution
    def bottom(self):
        return self.restitution

    @nsjax.impact
    def top(self, t, y):
        return self.length / 2 - y.x

    @top.restitution
    def top(self):
        return self.restitution

    @property
    def period(self):
        return 2.0


def test_a_name_needs_its_multiplier(buck):
    """Where a test function changes its sign through a jump, no multiplier is at 1 or -1."""
    flip = buck.bifurcations[0]
    spot, curve = flip.origin.spot, flip.origin.curve
    assert OrbitBifurcation.smooth("flip", "V_in", spot, curve, flip.halves).kind == flip.kind == "flip"
    away = dataclasses.replace(spot, multipliers=np.array([1.00005, 0.25]))
    point = OrbitBifurcation.smooth("flip", "V_in", away, curve, flip.halves)
    assert (point.kind, point.by_crossing, point.by_count, point.evidence) == ("unresolved", (), "flip", "count")
    assert "unresolved special points within 1e-6" in str(point)
    for kind in ("fold", "transcritical"):
        assert OrbitBifurcation.smooth(kind, "V_in", spot, curve, []).kind == "unresolved"
    with pytest.raises(ValueError, match="unresolved special points within 1e-6.* only the neighbourhood is known"):
        nsjax.continue_bifurcation(point, "V_in", (18.0, 30.0))


def test_the_twins_of_a_symmetry_have_equal_multipliers(buck):
    spot, curve = buck.bifurcations[0].origin.spot, buck.bifurcations[0].origin.curve
    at = dataclasses.replace(spot, multipliers=np.array([1.0, 0.25]))

    def half(side, *multipliers):
        return OrbitHalfBranch(side, 1, np.array(multipliers), abs(multipliers[0]) < 1, "")

    halves = [half(-1, 0.99, 0.25), half(1, 1.01, 0.25), half(1, 0.98, 0.25), half(1, 0.98, 0.25)]
    point = OrbitBifurcation.smooth("symmetry breaking", "V_in", at, curve, halves)
    assert (point.kind, point.criticality) == ("symmetry breaking", "supercritical")
    halves[-1] = half(1, 0.9, 0.27)
    assert OrbitBifurcation.smooth("symmetry breaking", "V_in", at, curve, halves).kind == "branch point"


@pytest.mark.slow
@pytest.mark.filterwarnings("ignore:There are more than `max_branches`")
@pytest.mark.parametrize("seed", [2, 3])  # of which the branches have smooth special points
def test_named_points_have_their_multipliers(seed):
    """Pitfall 58: along cascades of a ball in a capsule, beside many grazings."""
    rng = np.random.default_rng(seed)
    system = BallInCapsule(
        *map(jnp.asarray, (0.3, rng.uniform(0.05, 0.2), rng.uniform(0.4, 0.7), rng.uniform(0.2, 0.4)))
    )
    settled = nsjax.solve(system, 0.0, 400.0, Relative(0.01, 0.0), throw=False, max_steps=2**16, max_events=2**12)
    orbit = nsjax.find_orbit(system, settled.y1, order=None)
    branch = nsjax.continue_orbit(system, orbit, "F", (0.2, 0.5), max_branches=4)
    smooth = [point for point in branch.special if not point.discontinuous]
    assert smooth
    for point in smooth:
        value = {"flip": -1, "fold": 1, "transcritical": 1, "symmetry breaking": 1, "branch point": 1}.get(point.kind)
        if value is not None:
            assert np.min(np.abs(point.multipliers[0] - value)) < 1e-5, point


def test_a_corner_in_doubt_is_named_if_all_its_orbits_are_there(buck):
    spot, curve = buck.bifurcations[0].origin.spot, buck.bifurcations[0].origin.curve

    def kind(certain, sides):
        halves = [OrbitHalfBranch(side, 1, np.array([0.5, 0.25]), True, "") for side in sides]
        found = CornerKind("fold", None, (1, 1), (), certain)
        return OrbitBifurcation.corner(
            "V_in", spot, curve, halves, found, None, surfaces=("comparator",),
            monodromies=(spot.monodromy,) * 2, multipliers=(spot.multipliers,) * 2, transition=None,
        ).kind  # fmt: skip

    assert kind(True, [-1]) == kind(False, [-1, -1]) == "fold"
    assert kind(False, [-1]) == kind(False, [-1, 1]) == "unresolved"
