"""Branches of periodic orbits through the bifurcations of chapter 6, against 40-digit references."""

import branch_reference
import jax
import jax.numpy as jnp
import numpy as np
import pytest
import scipy.optimize
from branches import continue_orbit, orbit_of, QUICK, same_multipliers, stability_agrees, the
from models import Motion, Stop

import nsjax
from nsjax import gallery


POINTS = branch_reference.POINTS


@pytest.fixture(scope="module")
def stick_slip():
    """Section 6.7."""
    system = gallery.StickSlip(c=0.1, v_dr=0.5)
    return continue_orbit(system, orbit_of(system, Motion(2.0, 0.0), period=8.0), "v_dr", (0.1, 1.3))


@pytest.fixture(scope="module")
def friction():
    """Section 6.8, from its right end."""
    system = gallery.ForcedFriction(omega=0.8)
    return continue_orbit(system, orbit_of(system, Motion(5.4, 2.7)), "omega", (0.5, 0.85))


@pytest.fixture(scope="module")
def belt():
    """Section 6.9, from the stable branch I."""
    system = gallery.ForcedStickSlip(omega=1.65)
    return continue_orbit(system, orbit_of(system, Motion(1.73, -0.83), order=2), "omega", (1.5, 1.95))


@pytest.fixture(scope="module")
def trilinear():
    """Section 6.6, from the orbit without contact."""
    system = gallery.Trilinear(omega=1.15)
    return continue_orbit(system, orbit_of(system, Motion(-0.1, -0.7)), "omega", (0.5, 2.0))


def sides(name, *which):
    return tuple(POINTS[name].multipliers[side] for side in which)


def test_infinitely_unstable_fold(stick_slip):
    """Section 6.7, pitfall 24: the stable and the infinitely unstable branch, both, from one start."""
    point, want = the(stick_slip, POINTS["6.7 fold"].at), POINTS["6.7 fold"]
    assert point.kind == "infinitely unstable fold" and point.discontinuous and point.count == ((1, 1), ())
    np.testing.assert_allclose(point.value, want.at, atol=1e-11)
    np.testing.assert_allclose(point.period, want.period, atol=1e-10)
    same_multipliers(point.multipliers, sides("6.7 fold", "stable", "unstable"))
    assert len(stick_slip.branches) == 1 and list(stick_slip.values[[0, -1]]) == pytest.approx([0.1, 0.1])
    (at,) = stick_slip.indices
    assert stick_slip.stable[:at].all() and not stick_slip.stable[at + 1 :].any()
    assert np.isinf(stick_slip.multipliers[at + 2 :, 0]).all()
    np.testing.assert_allclose(stick_slip.high.x[at], want.amplitude, atol=1e-9)
    assert "infinitely unstable fold" in str(stick_slip)


@pytest.mark.slow
def test_infinitely_unstable_orbits(stick_slip):
    """The amplitude of the unstable orbit at v_dr = 0.5, found backwards by shooting."""
    system = gallery.StickSlip(c=0.1, v_dr=0.5)
    unstable = np.flatnonzero(~stick_slip.stable)
    i = unstable[np.argmin(np.abs(stick_slip.values[unstable] - 0.5))]
    system = gallery.StickSlip(c=0.1, v_dr=float(stick_slip.values[i]))
    y0 = jax.tree.map(lambda leaf: jnp.asarray(leaf[i]), stick_slip.ys)
    orbit = orbit_of(system, y0, period=float(stick_slip.periods[i]), backward=True)
    top = orbit.maximum(lambda t, y: y.x)
    np.testing.assert_allclose(stick_slip.high.x[i], top, atol=1e-8)
    np.testing.assert_allclose(stick_slip.periods[i], orbit.period, atol=1e-8)


@pytest.mark.slow  # (a notebook runs 6.8)
def test_symmetry_breaking(friction):
    """Section 6.8: A smooth, B discontinuous, C a sliding-mode transition that is no bifurcation."""
    a, b, c = (the(friction, POINTS[f"6.8 {name}"].at) for name in "ABC")
    assert (a.kind, a.discontinuous, a.criticality) == ("symmetry breaking", False, "supercritical")
    assert (b.kind, b.discontinuous, b.criticality) == ("symmetry breaking", True, "supercritical")
    assert (c.kind, c.discontinuous, c.transition) == ("none", True, "sliding")
    assert a.evidence == b.evidence == c.evidence == "both"
    assert (b.count, c.count) == (((1, 1, 1), (1,)), ((1,), (1,)))
    for point, name in ((a, "A"), (b, "B"), (c, "C")):
        np.testing.assert_allclose(point.value, POINTS[f"6.8 {name}"].at, atol=1e-10)
    same_multipliers(b.multipliers, sides("6.8 B", *POINTS["6.8 B"].multipliers)[:2])
    same_multipliers(c.multipliers, sides("6.8 C", *POINTS["6.8 C"].multipliers))
    (crossing,) = b.crossings
    np.testing.assert_allclose(crossing.q, POINTS["6.8 B"].more["q_613"], atol=1e-6)
    assert crossing.kind == "+1" and c.crossings == []
    # Branch I, and branch II with its mirror image: C is passed twice.
    assert len(friction.branches) == 2
    assert sum(abs(s.value - c.value) < 1e-8 for s in friction.others[0].special) == 2


@pytest.mark.slow
def test_from_the_branch_that_broke_the_symmetry(friction):
    """At B one place has its stick phase vanish while at the other one is about to begin."""
    system = gallery.ForcedFriction(omega=0.65)
    branch = continue_orbit(system, orbit_of(system, Motion(4.0, 1.5)), "omega", (0.5, 0.85))
    want, found = ({(b.kind, b.discontinuous, round(b.value, 9)) for b in x.special_points} for x in (friction, branch))
    assert want == found and the(branch, POINTS["6.8 B"].at).count == ((1, 1, 1), (1,))
    assert len(branch.branches) == 2
    # The path of the set-valued multipliers is that of the symmetric orbits, from wherever it was reached.
    b = the(branch, POINTS["6.8 B"].at)
    same_multipliers(b.multipliers, sides("6.8 B", *POINTS["6.8 B"].multipliers)[:2])
    assert b.evidence == "both" and [c.kind for c in b.crossings] == ["+1"]


@pytest.mark.slow
@pytest.mark.parametrize("name", ["stick_slip", "friction", "belt", "trilinear"])
def test_stability_by_simulation(name, request):
    assert stability_agrees(request.getfixturevalue(name), 8, seed=1) > 5


@pytest.mark.slow
def test_forced_stick_slip(belt):
    """Section 6.9: A, B, C, both smooth folds, the flip, the Neimark-Sacker point, and branches I to VIII."""
    kinds = {
        "A": ("fold", True), "B": ("fold-flip", True), "C": ("flip", True), "fold I/V": ("fold", False),
        "fold II/III": ("fold", False), "flip III/IV": ("flip", False), "Neimark-Sacker III": ("Neimark-Sacker", False),
    }  # fmt: skip
    for name, (kind, corner) in kinds.items():
        want = POINTS[f"6.9 {name}"]
        point = the(belt, want.at)
        assert (point.kind, point.discontinuous) == (kind, corner), name
        np.testing.assert_allclose(point.value, want.at, atol=1e-10, err_msg=name)
        np.testing.assert_allclose(point.period, want.period, rtol=1e-10, err_msg=name)
        values = list(want.multipliers.values())
        same_multipliers(point.multipliers, (values[0], values[-1]))
    b, c = the(belt, POINTS["6.9 B"].at), the(belt, POINTS["6.9 C"].at)
    assert b.count == ((), (1, 1, 2, 4)) and b.evidence == "both"
    assert [crossing.kind for crossing in b.crossings] in (["-1", "+1"], ["+1", "-1"])
    assert c.count in (((1, 2), (1,)), ((1,), (1, 2)))
    torus = the(belt, POINTS["6.9 Neimark-Sacker III"].at)
    assert (torus.count, torus.by_count, torus.evidence) == (((1,), (1,)), "none", "crossing")
    # I to V are one closed curve; VI and VII one of period 4, from B to the flip; VIII has period 8.
    closed, *others = belt.branches
    assert "closed" in " ".join(closed.ends) and len(closed.special) == 6
    assert sorted(int(o.orders[0]) for o in others) == [4, 8]
    # Pitfall 41: by parabolas through samples 2.2e-3 too low on VI, and 5e-4 on VIII.
    for branch in others:
        for i in np.linspace(1, len(branch) - 2, 3).astype(int):
            orbit = branch.orbit(i)
            top, bottom = orbit.maximum(lambda t, y: y.x), -orbit.maximum(lambda t, y: -y.x)
            np.testing.assert_allclose([branch.high.x[i], branch.low.x[i]], [top, bottom], atol=1e-8)


@pytest.mark.slow
def test_another_start(belt):
    """From the unstable branch IV, and from the other end, the same comes out."""
    system = gallery.ForcedStickSlip(omega=1.68)
    orbit = orbit_of(system, Motion(2.11, -0.47), order=2)
    branch = continue_orbit(system, orbit, "omega", (1.5, 1.95))
    want, found = (sorted((b.kind, round(b.value, 9)) for b in x.bifurcations) for x in (belt, branch))
    assert set(want) == set(found), set(want) ^ set(found)


@pytest.mark.slow
def test_trilinear(trilinear):
    """Section 6.6: no bifurcation at A, a discontinuous fold at B, and the smooth fold beyond."""
    a, b, fold = (the(trilinear, POINTS[f"6.6 {name}"].at) for name in ("A", "B", "fold"))
    assert (a.kind, b.kind, fold.kind) == ("none", "fold", "fold")
    assert (a.discontinuous, b.discontinuous, fold.discontinuous) == (True, True, False)
    assert a.transition is None and a.evidence == b.evidence == "both" and a.crossings == []
    for point, name in ((a, "A"), (b, "B"), (fold, "fold")):
        np.testing.assert_allclose(point.value, POINTS[f"6.6 {name}"].at, atol=1e-10)
    same_multipliers(a.multipliers, sides("6.6 A", "free", "contact"))
    same_multipliers(b.multipliers, sides("6.6 B", "free", "contact"))
    np.testing.assert_allclose([c.q for c in b.crossings], [POINTS["6.6 B"].more["q_613"]], atol=1e-6)
    assert len(trilinear.branches) == 1 and list(trilinear.values[[0, -1]]) == pytest.approx([0.5, 2.0])


def test_growing():
    """A branch can be looked at while it grows, left, and gone on with."""
    system = gallery.StickSlip(c=0.1, v_dr=0.5)
    orbit = orbit_of(system, Motion(2.0, 0.0), period=8.0)
    growth = nsjax.OrbitContinuation(system, orbit, "v_dr", (0.45, 0.6), **QUICK)
    for point in growth:
        if point.parameter > 0.52:
            break
    part = growth.branch
    assert 0.52 < part.values.max() < 0.6
    for _ in growth:
        pass
    whole, at_once = growth.branch, continue_orbit(system, orbit, "v_dr", (0.45, 0.6))
    np.testing.assert_allclose(whole.values, at_once.values, atol=1e-12)
    assert whole.ends == at_once.ends == ("v_dr = 0.45", "v_dr = 0.6")


@pytest.mark.parametrize(
    "change, message",
    [
        (dict(parameter="speed"), "must be one of"),
        (dict(interval=(0.6, 0.7)), "must be \\(low, high\\) and hold 0.5"),
        (dict(scale=Motion(1.0, 0.0)), "must hold a positive number"),
    ],
)
def test_mistakes(change, message):
    system = gallery.StickSlip(c=0.1, v_dr=0.5)
    orbit = orbit_of(system, Motion(2.0, 0.0), period=8.0)
    given = dict(parameter="v_dr", interval=(0.4, 0.6)) | change
    with pytest.raises(ValueError, match=message):
        continue_orbit(system, orbit, **given)


class VanDerPol(nsjax.System):
    """A self-excited mass before a visco-elastic wall."""

    mu: float = 0.5
    x_c: float = 2.2
    k_f: float = 4.0
    c_f: float = 0.5

    def vector_field(self, t, y, s):
        force = self.wall(t, y)[1] * (1 + s.wall) / 2
        return Motion(y.v, self.mu * (1 - y.x**2) * y.v - y.x - force)

    @nsjax.sgn
    def wall(self, t, y):
        return y.x - self.x_c, self.k_f * (y.x - self.x_c) + self.c_f * y.v


@pytest.mark.slow
def test_grazing_impact():
    """A square-root corner: the linear orbit comes to touch the stop; beyond, it and orbits with impacts are found."""
    system = Stop(gap=0.3, omega=3.0)
    branch = continue_orbit(system, orbit_of(system, Motion(-0.12, 0.0)), "omega", (2.0, 3.1), max_laps=2)
    square = np.roots([1, system.c**2 - 2, 1 - 1 / system.gap**2]).max()  # |1 - ω² + i c ω| = 1 / gap
    point = the(branch, np.sqrt(square))
    assert point.discontinuous and point.kind == "flip" and point.count == ((1,), (1, 2)) and point.by_crossing is None
    free, bounced = sorted(point.multipliers, key=lambda rho: np.isinf(rho).any())
    modulus = np.exp(-system.c * point.period / 2)
    np.testing.assert_allclose(np.abs(free), modulus, rtol=1e-7)
    assert np.isinf(bounced).sum() == 1
    assert {int(b.orders[0]) for b in branch.branches} == {1, 2}


@pytest.mark.slow  # (by default that of the drillstring, where slip backwards appears)
def test_autonomous_corner():
    """The limit cycle comes to touch the tip of a surface: what damps there only delays it, and nothing jumps."""
    system = VanDerPol()
    orbit = orbit_of(system, Motion(2.0, 0.0), period=6.3)
    branch = continue_orbit(system, orbit, "x_c", (1.9, 2.3))
    (point,) = branch.special_points
    np.testing.assert_allclose(point.value, orbit.maximum(lambda t, y: y.x), atol=1e-10)
    assert (point.kind, point.count, point.transition) == ("none", ((1,), (1,)), None)
    same_multipliers(point.multipliers, (np.asarray(orbit.multipliers),) * 2)
    assert len(branch.branches) == 1 and list(branch.values[[0, -1]]) == pytest.approx([1.9, 2.3])


class Squash(nsjax.System):
    """A ball between a racket at a sin t and a wall at x = L: one impact with two surfaces."""

    a: float = 0.3
    L: float = 1.0
    e: float = 0.8
    period: float = 2 * np.pi

    def vector_field(self, t, y, s):
        return Motion(y.v, s.hit)

    @nsjax.impact
    def hit(self, t, y):
        return y.x - self.a * jnp.sin(t), self.L - y.x

    @hit.restitution
    def hit(self):
        return self.e


def squash(a, L, e):
    """Time at the racket, and speed after it, of the orbit with one hit of each surface a period."""
    share = (1 - e**2) / (2 * np.pi * e)
    t = scipy.optimize.brentq(lambda t: share * (L - a * np.sin(t)) - a * np.cos(t), 0, np.pi / 2, xtol=1e-15)
    return t, (L - a * np.sin(t)) * (1 + 1 / e) / (2 * np.pi)


@pytest.mark.slow
def test_the_wall_that_is_hit():
    """An impact with several surfaces, one of which moves: each acts where it is hit, not where it is left."""
    a, e = 0.3, 0.8
    t, u = squash(a, 1.0, e)
    system = Squash(a, 1.0, e)
    start = Motion(a * np.sin(t) + u * e * t, -u * e)  # at t = 0, on its way to the racket
    orbit = orbit_of(system, start)
    assert list(orbit.events.t[:2] - t) == pytest.approx([0, 2 * np.pi * e / (1 + e)], abs=1e-9)
    branch = continue_orbit(system, orbit, "L", (0.8, 1.2))
    want = np.array([squash(a, value, e)[1] for value in branch.values])
    np.testing.assert_allclose(branch.high.v, want, rtol=1e-9)
    np.testing.assert_allclose(branch.low.v, -e * want, rtol=1e-9)
    assert list(branch.values[[0, -1]]) == pytest.approx([0.8, 1.2]) and not branch.special_points


@pytest.mark.parametrize(
    "alpha, criticality", [(-1.0, "supercritical"), pytest.param(1.0, "subcritical", marks=pytest.mark.slow)]
)
def test_a_branch_shrinks_to_a_hopf_point(alpha, criticality):
    """(5.25): r = √(-μ/α), period 2π/(ω + β r²). The parameter is even in the size, but the orbits do not turn back."""
    system = gallery.Hopf(mu=-0.8 * alpha, alpha=alpha)
    orbit = orbit_of(system, gallery.Plane(0.894, 0.0), period=2 * np.pi / 1.8)
    branch = continue_orbit(system, orbit, "mu", (-1.0, 1.0))
    (hopf,) = branch.special_points
    assert hopf.name == f"Hopf bifurcation, {criticality}" and not branch.others
    assert hopf.count == (((), (1,)) if alpha < 0 else ((1,), ()))
    np.testing.assert_allclose([hopf.value, hopf.period, *hopf.y], [0, 2 * np.pi, 0, 0], atol=1e-13)
    at = branch.indices[0]
    assert at in (0, len(branch) - 1) and branch.values[at] == hopf.value
    assert branch.stable.all() if alpha < 0 else not branch.stable.any()
    np.testing.assert_allclose(branch.high.x1, np.sqrt(np.abs(branch.values)), atol=1e-6)
    np.testing.assert_allclose(branch.periods, 2 * np.pi / (1 - branch.values / alpha), rtol=1e-9)
