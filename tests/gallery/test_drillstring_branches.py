"""Branches of periodic orbits of the drillstring (Figs. A.9 to A.12): each special point against scipy's shooting with
variational equations and saltation matrices."""

import jax
import numpy as np
import pytest
from drillstring import (
    B_1,
    BETA,
    C_B,
    CONTACT,
    drillstring,
    field,
    K,
    K_B,
    lap,
    M_A,
    M_F,
    of_flip,
    of_fold,
    of_neimark_sacker,
    R_C,
    RELEASE,
    SLIP,
    slope,
    special_point,
    STOP,
)
from scipy.optimize import root

import nsjax
from nsjax import gallery
from nsjax.gallery import TwistedWhirl


pytestmark = pytest.mark.slow

TESTS = {"fold": of_fold, "flip": of_flip, "Neimark-Sacker": of_neimark_sacker}
FREE, TOUCH = (-1, 1, 1), (1, 1, 1)
OMEGA_F = np.sqrt((K + B_1 * R_C**2) / (M_F / 4 - M_F * BETA / 2 + M_A * BETA**2 / 4))  # r = R_c in (A.20)


def arcs_of(branch, i):
    """The modes of an orbit from its base point on, and what ends each."""
    arcs = []
    for segment in branch.segments[i]:
        wall, roll, bit = segment.mode
        event = None
        if segment.ends == "wall":
            event = CONTACT if wall < 0 else RELEASE
        elif segment.ends == "bit":
            event = SLIP if bit == 0 else STOP
        arcs.append(((wall, 1 if wall < 0 else roll, bit), event))
    return arcs


def flat(tree):
    return np.array([float(x) for x in jax.tree.leaves(tree)])


def at(ys, i):
    return flat(jax.tree.map(lambda x: x[i], ys))


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
    _, period, omega, rho = special_point(
        at(branch.ys, i), branch.periods[i], branch.values[i], arcs_of(branch, i), TESTS[kind]
    )
    np.testing.assert_allclose(special.value, omega, atol=1e-8)
    np.testing.assert_allclose(special.period, period, rtol=1e-7)
    # At a fold two of them lie as far from 1 as the root of a rounding error.
    ones = np.argsort(np.abs(rho - 1))[: 2 if kind == "fold" else 0]
    rest = np.delete(rho, ones)
    mine = np.asarray(special.multipliers[0])
    mine = np.delete(mine, np.argsort(np.abs(mine - 1))[: len(ones)])
    alike(mine, rest, 1e-6)


def touching(y, period, omega):
    """The orbit without contact that touches the stator: state there (u = 0, r = R_c), period, parameter."""

    def residual(z):
        start = np.array([1.0, 0.0, *z[:3]])
        return lap(start, z[3], z[4], [(FREE, None)])[0] - start

    z = root(residual, [*y[2:], period, omega], method="hybr", options=dict(xtol=1e-13, eps=1e-14)).x
    return np.array([1.0, 0.0, *z[:3]]), z[3], z[4]


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
    return nsjax.continue_orbit(system, orbit, "omega", (2.3, 3.6), max_branches=2)


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


def test_p5_meets_p6_where_the_orbit_touches_the_stator(p6):
    """The thesis calls it a discontinuous fold; multipliers cross the circle at -1 too: no orbit | P5, P6 and one of
    twice the period."""
    special = next(s for s in p6.special if s.discontinuous)
    assert special.kind == "fold-flip" and special.count == ((), (1, 1, 2)) and special.surfaces == ("wall",)
    y, period, omega = touching(flat(special.y), special.period, special.value)
    np.testing.assert_allclose([special.value, special.period], [omega, period], atol=1e-9)
    free = lap(y, period, omega, [(FREE, None)])[1]
    alike(special.multipliers[0], np.linalg.eigvals(free), 1e-6)
    alike(special.multipliers[1], np.linalg.eigvals(free @ jump_of_contact(y, omega)), 1e-6)


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

    x = root(residual, np.append(z, branch.periods[i]), method="hybr", options=dict(xtol=1e-12, eps=1e-14)).x
    return x[5], np.linalg.eigvals(lap(x[:5], x[5], side, arcs, linear, over)[1])


def test_the_limits_of_p5_at_f(p6):
    branch = p6.branches[1]
    f = branch.special[-1]
    period, rho = limits_at_f(branch, len(branch) - 2, OMEGA_F)
    np.testing.assert_allclose(f.period, period, rtol=1e-6)
    alike(f.multipliers[0], rho, 1e-6)
    alike(branch.multipliers[-1], rho, 1e-6)
