"""Branches of periodic orbits of the drillstring (Figs. A.9 to A.12): each special point against scipy's shooting with
variational equations and saltation matrices."""

import numpy as np
import pytest
from drillstring import (
    arcs_of,
    at,
    B_1,
    BETA,
    C_B,
    CONTACT,
    drillstring,
    field,
    flat,
    FREE,
    just_stopping,
    K,
    K_B,
    lap,
    M_A,
    M_F,
    OF_P2,
    OF_P4,
    R_C,
    slope,
    smooth_point,
    solved,
    TOUCH,
    touching,
    whirl_of_p1,
)
from scipy.optimize import brentq

import nsjax
from nsjax import gallery
from nsjax.gallery import TwistedWhirl


pytestmark = pytest.mark.slow

OMEGA_F = np.sqrt((K + B_1 * R_C**2) / (M_F / 4 - M_F * BETA / 2 + M_A * BETA**2 / 4))  # r = R_c in (A.20)


def alike(found, want, tol):
    """Multipliers, in the order in which they are nearest to each other."""
    left = list(np.asarray(found, complex))
    for rho in want:
        k = int(np.argmin(np.abs(np.array(left) - rho)))
        assert abs(left.pop(k) - rho) <= tol * max(1, abs(rho))


def check(branch, kind, value):
    """A smooth special point: its place, its period, its multipliers."""
    (i,) = [i for i, s in zip(branch.indices, branch.special) if s.kind == kind and abs(s.value - value) < 1e-5]
    special = branch.special[branch.indices.index(i)]
    assert not special.discontinuous
    _, period, omega, rho = smooth_point(branch, i, kind)
    np.testing.assert_allclose(special.value, omega, atol=1e-8)
    np.testing.assert_allclose(special.period, period, rtol=1e-7)
    # At a fold two of them lie as far from 1 as the root of a rounding error.
    ones = np.argsort(np.abs(rho - 1))[: 2 if kind == "fold" else 0]
    rest = np.delete(rho, ones)
    mine = np.asarray(special.multipliers[0])
    mine = np.delete(mine, np.argsort(np.abs(mine - 1))[: len(ones)])
    alike(mine, rest, 1e-5 if kind == "fold" else 1e-6)  # where the state is known to the root of a rounding error


def jump_of_contact(y, omega, u=1e-7):
    """What a contact of no duration does to a deviation: the force c_b u is there at once, and gone as soon as it is
    zero again."""
    meeting = np.array([1.0, u, *y[2:]])
    push = (field(meeting, omega, (1, 1, 1)) - field(meeting, omega, FREE)) / u
    return np.eye(5) + np.outer(push, np.eye(5)[0])


@pytest.fixture(scope="module")
def p6():
    """P6 and P5, from an orbit beside the Hopf point of E2."""
    system = gallery.thesis("A.9", omega=2.5425)
    guess = TwistedWhirl(0.238468107547, 0.0369679337296, 0.199962366887, -0.0944242793382, 0.355375795276)
    orbit = nsjax.find_orbit(system, guess, period=6.0587479941)
    with pytest.warns(UserWarning, match="more than `max_branches`"):  # those of twice the period
        return nsjax.continue_orbit(system, orbit, "omega", (2.5, 2.7), max_branches=2)


def test_p6_and_p5_from_the_hopf_point_to_f(p6):
    first, second = p6.branches
    kinds = [(s.kind, s.discontinuous) for s in first.special]
    assert sorted(kinds) == [("Hopf", False), ("fold", False), ("fold-flip", True)]
    hopf = next(s for s in first.special if s.kind == "Hopf")
    np.testing.assert_allclose(hopf.value, 2.540313206, atol=1e-9)  # test_hopf_point_of_e2
    assert hopf.criticality == "subcritical"
    np.testing.assert_allclose(hopf.y.r, 0.2882901716, atol=1e-8)
    assert [s.kind for s in second.special] == ["fold-flip", "flip", "fold", "fold", "end"]
    f = second.special[-1]
    np.testing.assert_allclose(f.value, 2.653299832, atol=1e-8)  # (A.20) at r = R_c
    np.testing.assert_allclose([f.y.r, f.y.u, f.y.w], [1, 0, 0], atol=1e-8)


@pytest.mark.parametrize(
    "which, kind, value",
    [
        (0, "fold", 2.57651310792),
        (1, "flip", 2.61195615011),
        (1, "fold", 2.61335129184),
        (1, "fold", 2.59965178049),
    ],
)
def test_special_points_of_p6_and_p5(p6, which, kind, value):
    check(p6.branches[which], kind, value)


def cross(special, first, second):
    """Whether multipliers of the matrices between two others cross the circle where the point says so, and only there.
    (That along the orbit is 1.)"""

    def unstable(q):
        rho = np.linalg.eigvals(first + q * (second - first))
        return int(np.sum(np.abs(np.delete(rho, np.argmin(np.abs(rho - 1)))) > 1))

    cuts = [0.0, *(c.q for c in special.crossings), 1.0]
    counts = [{unstable(q) for q in np.linspace(a, b, 42)[1:-1]} for a, b in zip(cuts, cuts[1:])]
    return all(len(one) == 1 for one in counts) and all(a != b for a, b in zip(counts, counts[1:]))


def test_p5_meets_p6_where_the_orbit_touches_the_stator(p6):
    """The thesis calls it a discontinuous fold; multipliers cross the circle at -1 too: no orbit | P5, P6 and one of
    twice the period."""
    special = next(s for s in p6.special if s.discontinuous)
    assert special.kind == "fold-flip" and special.count == ((), (1, 1, 2)) and special.surfaces == ("wall",)
    y, period, omega = touching(flat(special.y), special.period, special.value)
    np.testing.assert_allclose([special.value, special.period], [omega, period], atol=1e-9)
    free = lap(y, period, omega, [(FREE, None)])[1]
    alike(special.multipliers[0], np.linalg.eigvals(free), 1e-6)
    touched = free @ jump_of_contact(y, omega)
    alike(special.multipliers[1], np.linalg.eigvals(touched), 1e-6)
    # Conjecture 6.2: a fold and a flip.
    assert [c.kind for c in special.crossings] == ["+1", "-1"] and special.evidence == "both"
    assert cross(special, free, touched)


def beside_f(omega):
    """What is left of the equations where everything shrinks to f: (A.51) linear in the distance from it on both sides
    of the surface, with a constant for ω above it (1) or below (-1)."""
    r = 1.0
    y = np.array([r, 0.0, BETA * omega / 2, 0.0, 0.0])
    y[3] = drillstring(*y, omega, FREE)[4]
    sides = {s: slope(lambda x, s=s: field(x, omega, s), y) for s in (FREE, TOUCH)}
    h = 1e-6
    push = (field(y, omega + h, FREE) - field(y, omega - h, FREE)) / (2 * h)

    def linear(z, side, s):
        return sides[s] @ z + side * push

    def over(event, z, side, s):
        return -z[0] if event == CONTACT else K_B * z[0] + C_B * z[1]

    return y, linear, over


def limits_at_f(branch, i, omega):
    """Period and multipliers of the orbit that an orbit of the branch, near f, is like."""
    f, linear, over = beside_f(omega)
    side = np.sign(branch.values[i] - omega)
    arcs = arcs_of(branch, i)
    z = (at(branch.ys, i) - f) / abs(branch.values[i] - omega)
    along = linear(z, side, arcs[0][0])
    along = along / np.linalg.norm(along)

    def residual(x):
        return np.append(lap(x[:5], x[5], side, arcs, linear, over)[0] - x[:5], along @ (x[:5] - z))

    x = solved(residual, np.append(z, branch.periods[i]))
    return x[5], np.linalg.eigvals(lap(x[:5], x[5], side, arcs, linear, over)[1])


def test_the_limits_of_p5_at_f(p6):
    branch = p6.branches[1]
    f = branch.special[-1]
    period, rho = limits_at_f(branch, len(branch) - 2, OMEGA_F)
    np.testing.assert_allclose(f.period, period, rtol=1e-6)
    alike(f.multipliers[0], rho, 1e-6)
    alike(branch.multipliers[-1], rho, 1e-6)


@pytest.fixture(scope="module")
def p4():
    """P4, P3 and P2 are one branch."""
    system = gallery.thesis("A.9", omega=2.5)
    orbit = nsjax.find_orbit(system, TwistedWhirl(1.0197, 0.2029, 0.7161, 1.9272, -0.8771), period=5.4024)
    with pytest.warns(UserWarning, match="more than `max_branches`"):
        return nsjax.continue_orbit(system, orbit, "omega", (2.2, 3.6), max_branches=1)


def test_the_way_from_p1_to_f(p4):
    """P2 is born in the middle of the stator, P3 where it begins to touch, P4 where the bit no more sticks."""
    bifurcations = [(s.kind, s.discontinuous, round(s.value, 8)) for s in p4.special if s.is_bifurcation]
    assert bifurcations[1:] == [
        ("flip", True, 2.36309803),
        ("fold", False, 2.44306864),
        ("flip", False, 2.38414967),
        ("fold", False, 2.38112293),
        ("Neimark-Sacker", False, 2.46406621),
        ("fold", False, 2.46434385),
        ("fold", True, 2.36678973),
        ("Neimark-Sacker", False, 2.99420602),
        ("flip", False, 3.12472787),
        ("flip", False, 3.23239196),
        ("fold", False, 3.43907773),
        ("fold", False, 2.57476937),
        ("Neimark-Sacker", False, 2.57703852),
    ]
    f = p4.special[-1]
    assert f.kind == "end"
    np.testing.assert_allclose(f.value, OMEGA_F, atol=1e-8)
    period, rho = limits_at_f(p4, len(p4) - 2, OMEGA_F)
    np.testing.assert_allclose(f.period, period, rtol=1e-6)
    alike(f.multipliers[0], rho, 1e-6)


@pytest.mark.parametrize(
    "kind, value",
    [
        ("Neimark-Sacker", 2.99420602119),
        ("flip", 3.12472787101),
        ("flip", 3.23239196111),
        ("fold", 3.43907773314),
        ("fold", 2.57476936905),
        ("Neimark-Sacker", 2.57703852209),
        ("fold", 2.44306864091),
        ("flip", 2.38414967115),
        ("fold", 2.38112293315),
        ("Neimark-Sacker", 2.46406620698),
        ("fold", 2.46434385293),
    ],
)
def test_special_points_of_p4_and_p3(p4, kind, value):
    check(p4, kind, value)


def test_p2_is_born_at_the_neimark_sacker_point_of_p1(p4):
    """Where a whirl about the middle neither grows nor decays; in polar coordinates P2 just ends there."""
    born = brentq(lambda omega: whirl_of_p1(omega) - 1, 2.2, 2.3, xtol=1e-12)
    np.testing.assert_allclose(p4.values[0], born, atol=1e-8)
    assert p4.high.r[0] < 1e-8


def test_p1_loses_its_stability_there():
    """In Cartesian coordinates, without the stator that it does not meet, P1 is an orbit like others."""
    system = gallery.FreeDrillstringScene(omega=2.25)
    guess = gallery.entry("A.8").orbit
    start = system.state(dict(phi=guess.y0.phi), dict(phi=guess.y0.w))
    branch = nsjax.continue_orbit(
        system, nsjax.find_orbit(system, start, period=guess.period), "omega", (2.2, 2.3), max_laps=1
    )
    (born,) = branch.special_points
    assert born.kind == "Neimark-Sacker" and not born.discontinuous
    np.testing.assert_allclose(
        born.value, brentq(lambda omega: whirl_of_p1(omega) - 1, 2.2, 2.3, xtol=1e-12), atol=1e-8
    )
    below = branch.values < born.value
    assert branch.stable[below].all() and not branch.stable[~below][1:].any()
    for i in (0, -1):
        rho = np.abs(branch.multipliers[i])
        want = whirl_of_p1(branch.values[i])
        np.testing.assert_allclose(np.sort(rho[np.abs(rho - 1) > 1e-6])[-2:], want, rtol=1e-7)  # a pair


def test_p3_begins_where_p2_touches_the_stator(p4):
    """The discontinuous flip: a contact of no duration, with the multipliers on both sides of it."""
    special = next(s for s in p4.special if s.kind == "flip" and s.discontinuous)
    assert special.count == ((1,), (1, 2)) and special.surfaces == ("wall",)
    i = p4.indices[p4.special.index(special)]
    y, period, omega = touching(flat(special.y), special.period, special.value, OF_P2)
    np.testing.assert_allclose([special.period, special.value], [period, omega], atol=1e-8)
    free = lap(y, period, omega, OF_P2)[1]
    touched = free @ jump_of_contact(y, omega)
    for mine, want in zip(special.multipliers, (touched, free)):
        alike(mine, np.linalg.eigvals(want), 1e-6)
    assert [c.kind for c in special.crossings] == ["-1"] and cross(special, touched, free)
    assert any(s.mode[0] > 0 for s in p4.segments[i + 2]) != any(s.mode[0] > 0 for s in p4.segments[i - 2])


def test_p4_begins_where_the_bit_no_more_sticks(p4):
    """The discontinuous fold: the orbit just comes to θ' = 0."""
    special = next(s for s in p4.special if s.kind == "fold" and s.discontinuous)
    assert special.surfaces == ("bit",) and special.count == ((), (1, 1))
    i = p4.indices[p4.special.index(special)]
    start, period, omega = just_stopping(p4, i, special)
    np.testing.assert_allclose([special.period, special.value], [period, omega], atol=1e-8)
    free = lap(start, period, omega, OF_P4)[1]
    alike(special.multipliers[0], np.linalg.eigvals(free), 1e-6)
