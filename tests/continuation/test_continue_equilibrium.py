"""Equilibria continued over a parameter: every system of chapter 5 by the same call, and corners of other kinds."""

import dataclasses

import diffrax as dfx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from models import Motion

import nsjax
from nsjax import continue_equilibrium, find_equilibria, gallery
from nsjax.gallery import Line, Plane


ROOT = 0.4416107917053284  # of (2/π)(arctan z + z/(1 + z²)) = 1/2: mpmath, 40 digits, see below


# System below its bifurcation, a guess, and what is found: kinds, with criticality; whether eigenvalues jump; count below
# and above; value; q of the crossings.
CASES = {
    "no crossing": (gallery.NoCrossing(-1.0), Plane(-1.0, 0.0), []),
    "Fig. 5.3b": (
        gallery.DoubleHopfCrossing(-1.0),
        gallery.Space(-0.3, -0.9, -0.3),
        [("Hopf-Hopf", None, True, (1, 1), 0.0, [0.1, 0.9])],
    ),
    "(5.7)": (gallery.SaddleNode(1.0), Line(1.0), [("saddle-node", None, False, (0, 2), 0.0, [])]),
    "(5.8)": (gallery.DiscontinuousSaddleNode(1.0), Line(1.0), [("saddle-node", None, True, (0, 2), 0.0, [0.5])]),
    "(5.10)": (gallery.Transcritical(-1.0), Line(0.0), [("transcritical", None, False, (2, 2), 0.0, [])]),
    "(5.11)": (
        gallery.DiscontinuousTranscritical(-1.0),
        Line(0.0),
        [("transcritical", None, True, (2, 2), 0.0, [0.5])],
    ),
    "(5.15)": (gallery.ImperfectTranscritical(-1.0), Line(0.3), []),
    "(5.17), α = -1": (
        gallery.Pitchfork(-1.0),
        Line(0.0),
        [("pitchfork", "supercritical", False, (1, 3), 0.0, [])],
    ),
    "(5.17), α = 1": (
        gallery.Pitchfork(-1.0, alpha=1.0),
        Line(0.0),
        [("pitchfork", "subcritical", False, (3, 1), 0.0, [])],
    ),
    "(5.18)": (
        gallery.DiscontinuousPitchfork(-1.0),
        Line(0.0),
        [("pitchfork", "supercritical", True, (1, 3), 0.0, [0.75])],
    ),
    "(5.22)": (
        gallery.DiscontinuousPitchfork(-1.0, alpha=1.0),
        Line(0.0),
        [("pitchfork", "subcritical", True, (3, 1), 0.0, [0.25])],
    ),
    "(5.23)": (gallery.ImperfectPitchfork(-1.0), Line(0.0), []),
    "(5.25)": (gallery.Hopf(-1.0), Plane(0.1, 0.0), [("Hopf", "supercritical", False, (1, 1), 0.0, [])]),
    "(5.25), α = 1": (
        gallery.Hopf(-1.0, alpha=1.0),
        Plane(0.1, 0.0),
        [("Hopf", "subcritical", False, (1, 1), 0.0, [])],
    ),
    "(5.29)": (gallery.DiscontinuousHopf(-1.0), Plane(0.0, 0.0), [("Hopf", None, True, (1, 1), 0.0, [0.75])]),
    "(5.32)": (
        gallery.HopfPitchfork(-1.0),
        Plane(0.0, 0.0),
        [("Hopf-pitchfork", "supercritical", True, (1, 3), 0.0, [0.25, 0.75])],
    ),
    "(5.40)": (
        gallery.SmoothHopfPitchfork(-1.0),
        Plane(0.0, 0.0),
        [
            ("Hopf", "supercritical", False, (1, 1), -ROOT / 10, []),
            ("pitchfork", "supercritical", False, (1, 3), ROOT / 10, []),
        ],
    ),
}


# Of these every run of the tests makes sure, of the others the slow ones (and the notebook on equilibria).
QUICK = ("(5.17), α = -1", "(5.25)", "(5.32)")


def marked(names):
    return [pytest.param(name, marks=[pytest.mark.slow] * (name not in QUICK)) for name in names]


@pytest.fixture(scope="module")
def found():
    """Each continued once."""
    kept = {}

    def branch(name):
        if name not in kept:
            system, start, _ = CASES[name]
            kept[name] = continue_equilibrium(system, start, "mu", (-1.0, 1.0))
        return kept[name]

    return branch


@pytest.mark.parametrize("name", marked(CASES))
def test_chapter_5(name, found):
    """Kind, criticality, whether it is discontinuous, counts, values and critical q, as the thesis has them."""
    expected = CASES[name][2]
    seen = found(name).bifurcations
    assert [(b.kind, b.criticality, b.discontinuous, b.count) for b in seen] == [e[:4] for e in expected]
    for b, e in zip(seen, expected):
        np.testing.assert_allclose(b.value, e[4], atol=1e-10)
        np.testing.assert_allclose([c.q for c in b.crossings], e[5], atol=1e-10)
        assert b.evidence == ("crossing" if b.by_count == "none" else "both")


def test_exact_value_of_the_smoothed_bifurcations():
    import mpmath as mp

    mp.mp.dps = 40
    root = mp.findroot(lambda z: 2 / mp.pi * (mp.atan(z) + z / (1 + z**2)) - mp.mpf(1) / 2, 0.44)
    assert abs(root - ROOT) < 1e-15


@pytest.mark.slow
def test_places_on_two_surfaces(found):
    """(q_left, q_right) of 5.5 (ERRATA), and (q_1, q_2) of 5.4."""
    (b,) = found("(5.18)").bifurcations
    assert b.places == [{"left": pytest.approx(0.75, abs=1e-12), "right": pytest.approx(0.25, abs=1e-12)}]
    (b,) = found("(5.11)").bifurcations
    assert b.places == [{"kink": pytest.approx(0.5, abs=1e-12), "parameter": pytest.approx(0.5, abs=1e-12)}]


def test_places_on_four_surfaces(found):
    """Those of 5.7, with their eigenvalues."""
    (b,) = found("(5.32)").bifurcations
    for place, q in zip(b.places, (0.25, 0.75)):
        assert place == pytest.approx({"left": q, "right": 1 - q, "below": q, "above": 1 - q}, abs=1e-12)
    np.testing.assert_allclose(b.crossings[0].eigenvalue, 1j * np.sqrt(2), atol=1e-12)  # (5.36) at q = 1/4
    assert b.crossings[1].eigenvalue == 0
    np.testing.assert_allclose(b.period, np.pi * np.sqrt(2), rtol=1e-12)
    assert b.by_crossing == ("Hopf", "branch point") and b.by_count == "pitchfork"


def exact(name, value):
    """The equilibria of the closed forms, with their eigenvalues."""
    r, w = np.sqrt(abs(value)), np.sqrt
    return {
        "(5.7)": [(r, -2 * r), (-r, 2 * r)] if value > 0 else [],
        "(5.8)": [(value, -1), (-value, 1)] if value > 0 else [],
        "(5.10)": [(0, value), (value, -value)],
        "(5.11)": [(0, np.sign(value)), (value, -np.sign(value))],
        "(5.17), α = -1": [(0, value)] + ([(r, -2 * value), (-r, -2 * value)] if value > 0 else []),
        "(5.17), α = 1": [(0, value)] + ([(r, -2 * value), (-r, -2 * value)] if value < 0 else []),
        "(5.18)": [(0, -3)] if value < 0 else [(0, 1), (value, -1), (-value, -1)],
        "(5.22)": [(0, 3)] if value > 0 else [(0, -1), (value, 1), (-value, 1)],
        "(5.32)": [(0, (1 + 1j * w(11)) / 2)]
        if value < 0
        else [(0, -1.5 + w(13) / 2), (2 * value, -1.5 + w(5) / 2), (-2 * value, -1.5 + w(5) / 2)],
        "no crossing": [(value, -0.5)] if value < 0 else [(value / 5, -1.25 + 1j * w(5 - 1.25**2))],
    }[name]


CLOSED = (
    "(5.7)",
    "(5.8)",
    "(5.10)",
    "(5.11)",
    "(5.17), α = -1",
    "(5.17), α = 1",
    "(5.18)",
    "(5.22)",
    "(5.32)",
    "no crossing",
)


@pytest.mark.parametrize("name", marked(CLOSED))
def test_every_branch_is_followed(name, found):
    """Each point is an equilibrium of the closed form, with its eigenvalue; and none of these is missing anywhere."""
    branches = found(name).branches
    for branch in branches:
        first = np.asarray(jax.tree.leaves(branch.ys)[0])
        for value, x, roots in zip(branch.values, first, branch.eigenvalues):
            if abs(value) < 1e-3:
                continue
            near = [root for y, root in exact(name, value) if abs(x - y) < 1e-9]
            assert len(near) == 1, (value, x)
            np.testing.assert_allclose(roots[0] if roots[0].imag >= 0 else roots[1], near[0], atol=1e-9)
    for value in (-0.777, 0.777):
        seen = []
        for branch in branches:
            x = np.asarray(jax.tree.leaves(branch.ys)[0])
            for i in np.flatnonzero((branch.values[:-1] - value) * (branch.values[1:] - value) < 0):
                part = (value - branch.values[i]) / (branch.values[i + 1] - branch.values[i])
                seen.append(x[i] + part * (x[i + 1] - x[i]))
        np.testing.assert_allclose(sorted(seen), sorted(np.real([y for y, _ in exact(name, value)])), atol=1e-3)


@pytest.mark.parametrize("name", marked(CASES))
def test_stability_changes_at_special_points_only(name, found):
    for branch in found(name).branches:
        changes = set(np.flatnonzero(np.diff(branch.unstable) != 0))
        assert all(any(i in (j - 1, j) for j in branch.indices) for i in changes)


@pytest.mark.slow
def test_branches_without_connection():
    """(5.15): two branches, no bifurcation; (5.23): the lower two are born in a saddle-node: x and μ by mpmath."""
    import mpmath as mp

    system = gallery.ImperfectTranscritical(1.0)
    starts = find_equilibria(system, Line(jnp.linspace(-2, 2, 9)))
    branch = continue_equilibrium(system, starts, "mu", (-1.0, 1.0))
    assert len(branch.branches) == 2 and not branch.bifurcations
    system = gallery.ImperfectPitchfork(1.0)
    starts = find_equilibria(system, Line(jnp.linspace(-2, 2, 9)))
    assert len(starts) == 3
    branch = continue_equilibrium(system, starts, "mu", (-1.0, 1.0))
    assert len(branch.branches) == 2
    (fold,) = branch.bifurcations

    def smooth(h):
        return 2 / mp.pi * mp.atan(10 * h) * h

    def f(x, mu):
        return -x + smooth(x + mu / 2) + mp.mpf(1) / 10 - smooth(x - mu / 2)

    mp.mp.dps = 30
    x, mu = mp.findroot(lambda x, mu: (f(x, mu), mp.diff(lambda x: f(x, mu), x)), (-0.16, 0.32))
    np.testing.assert_allclose([fold.value, fold.y.x], [float(mu), float(x)], atol=1e-10)
    assert fold.kind == "saddle-node" and fold.count == (0, 2) and not fold.discontinuous


class Cubic(nsjax.System):
    """x' = μ + a x - x³: a hysteresis point for a = 0 (Fig. 5.1), two folds for a > 0."""

    mu: float = -1.0
    a: float = 0.0

    def vector_field(self, t, y, s):
        return Line(self.mu + self.a * y.x - y.x**3)


@pytest.mark.slow
def test_hysteresis_point():
    """Fig. 5.1: vertical, and no bifurcation; unfolded, two folds at μ = ±2/(3 √3)."""
    branch = continue_equilibrium(Cubic(), Line(-1.0), "mu", (-1.0, 1.0))
    (point,) = branch.special
    assert point.kind == "hysteresis point" and not branch.bifurcations and point.evidence == "count"
    np.testing.assert_allclose([point.value, point.y.x], 0, atol=1e-12)
    assert np.all(np.diff(branch.values) > 0) and np.all(branch.stable[np.abs(branch.values) > 1e-9])
    branch = continue_equilibrium(Cubic(a=1.0), Line(-1.3), "mu", (-1.0, 1.0))
    fold = 2 / np.sqrt(27)
    assert [b.kind for b in branch.special] == ["saddle-node"] * 2
    np.testing.assert_allclose([b.value for b in branch.special], [fold, -fold], atol=1e-12)


def test_two_folds_in_one_step():
    """a = 1e-4: the folds at ∓7.7e-7 lie a hundredth of a step apart in x, and both are found."""
    branch = continue_equilibrium(Cubic(a=1e-4), Line(-1.0), "mu", (-1.0, 1.0))
    fold = 2 * (1e-4 / 3) ** 1.5
    np.testing.assert_allclose([b.value for b in branch.bifurcations], [-fold, fold], rtol=1e-9)


class Isola(nsjax.System):
    mu: float = 0.1

    def vector_field(self, t, y, s):
        return Line(0.25 - self.mu**2 - y.x**2)


def test_closed_branch():
    branch = continue_equilibrium(Isola(), Line(0.5), "mu", (-1.0, 1.0))
    assert branch.ends == ("the start", "the start: it is closed") and len(branch.bifurcations) == 2
    np.testing.assert_allclose([b.value for b in branch.bifurcations], [-0.5, 0.5], atol=1e-12)
    np.testing.assert_allclose(branch.ys.x**2 + branch.values**2, 0.25, atol=1e-12)


@pytest.mark.parametrize(
    "system, start, kinds",
    [
        (gallery.HopfPitchfork(0.0), Plane(0.0, 0.0), ["Hopf-pitchfork"]),
        (gallery.DiscontinuousSaddleNode(0.0), Line(0.0), ["saddle-node"]),
        (gallery.Pitchfork(0.0), Line(0.0), ["pitchfork"]),
        pytest.param(gallery.SaddleNode(0.0), Line(0.0), ["saddle-node"], marks=pytest.mark.slow),
        (gallery.Hopf(0.0), Plane(0.0, 0.0), ["Hopf"]),
        pytest.param(gallery.DiscontinuousPitchfork(1.0), Line(0.9), ["pitchfork"], marks=pytest.mark.slow),
        pytest.param(gallery.HopfPitchfork(1.0), Plane(2.1, 0.1), ["Hopf-pitchfork"], marks=pytest.mark.slow),
    ],
)
def test_from_other_starts(system, start, kinds):
    """At the bifurcation itself, and on the branches that are born there: the same diagram."""
    branch = continue_equilibrium(system, start, "mu", (-1.0, 1.0))
    assert [b.kind for b in branch.bifurcations] == kinds
    number = {"Hopf-pitchfork": 2, "pitchfork": 2}.get(kinds[0], 1)
    assert len(branch.branches) == number


class Three(nsjax.System):
    """x' = -1.25 x + |x + μ| - |x - μ| + |x/4 - μ/8|: three kinks meet at the origin, none along a branch."""

    mu: float = -1.0

    def vector_field(self, t, y, s):
        wide = s.left * (y.x + self.mu) - s.right * (y.x - self.mu)
        return Line(-1.25 * y.x + wide + s.third * (y.x - self.mu / 2) / 4 - jnp.abs(self.mu) / 8)

    @nsjax.sgn
    def left(self, t, y):
        return y.x + self.mu

    @nsjax.sgn
    def right(self, t, y):
        return y.x - self.mu

    @nsjax.sgn
    def third(self, t, y):
        return y.x - self.mu / 2


@pytest.mark.slow
def test_three_surfaces_meet():
    """For μ < 0 only x = 0; for μ > 0 also x = -4μ/3, where f = -2μ - 3x/2, and x = 7μ/4, where f = 7μ/4 - x."""

    def f(x, mu):
        return -1.25 * x + abs(x + mu) - abs(x - mu) + abs(x - mu / 2) / 4 - abs(mu) / 8

    branch = continue_equilibrium(Three(), Line(0.0), "mu", (-1.0, 1.0))
    (b,) = branch.bifurcations
    assert b.surfaces == ("left", "right", "third") and b.kind == "pitchfork" and b.count == (1, 3)
    for one in branch.branches:
        np.testing.assert_allclose([f(x, mu) for x, mu in zip(one.ys.x, one.values)], 0, atol=1e-12)
    ends = sorted(float(x) for one in branch.branches for x, mu in zip(one.ys.x, one.values) if abs(mu - 1) < 1e-9)
    np.testing.assert_allclose(ends, [-4 / 3, 0, 7 / 4], atol=1e-12)


class Singular(nsjax.System):
    """x' = μ - p max(0, x) - c min(0, x)²: for x < 0 the Jacobian at the corner is zero."""

    mu: float = 1.0
    c: float = 0.0

    def vector_field(self, t, y, s):
        return Line(self.mu - y.x * (1 + s.kink) / 2 - self.c * y.x**2 * (1 - s.kink) / 2)

    @nsjax.sgn
    def kink(self, t, y):
        return y.x


@pytest.mark.slow
def test_singular_one_sided_jacobian():
    """c = 0: at μ = 0 every x < 0 is an equilibrium, for μ < 0 none. c = 1: the branch x = -√μ sets out vertically."""
    branch = continue_equilibrium(Singular(), Line(1.0), "mu", (-1.0, 1.0))
    (b,) = branch.bifurcations
    assert b.kind == "continuum" and b.count == (0, 1) and "continuum of equilibria" in str(branch)
    np.testing.assert_allclose(b.value, 0, atol=1e-12)
    branch = continue_equilibrium(Singular(c=1.0), Line(1.0), "mu", (-1.0, 1.0))
    (b,) = branch.bifurcations
    assert b.kind == "saddle-node" and b.discontinuous and b.count == (0, 2) and b.evidence == "both"
    x, mu = branch.ys.x, branch.values
    np.testing.assert_allclose(np.where(x > 0, x - mu, x**2 - mu), 0, atol=1e-12)
    assert x.min() == pytest.approx(-1) and x.max() == pytest.approx(1)


class Relay(nsjax.System):
    """x' = μ - a x - Sgn(x), Filippov: held at the origin while |μ| <= 1."""

    mu: float = 2.0
    a: float = 1.0

    def vector_field(self, t, y, s):
        return Line(self.mu - self.a * y.x - s.surface)

    @nsjax.sgn
    def surface(self, t, y):
        return y.x


def test_boundary_equilibria():
    """a = 1: the equilibrium x = μ - 1 becomes one of sliding at μ = 1, λ = μ, and x = μ + 1 at μ = -1. a = -1: the two
    meet there and vanish."""
    branch = continue_equilibrium(Relay(), Line(1.0), "mu", (-2.0, 2.0))
    assert [b.kind for b in branch.special] == ["none"] * 2 and len(branch.others) == 0
    np.testing.assert_allclose([b.value for b in branch.special], [-1, 1], atol=1e-12)
    x, lam = branch.ys.x, branch.multipliers[:, 0]
    np.testing.assert_allclose(x, np.sign(branch.values) * np.maximum(np.abs(branch.values) - 1, 0), atol=1e-12)
    np.testing.assert_allclose(lam, np.clip(branch.values, -1, 1), atol=1e-12)
    assert all(b.by_crossing is None and b.evidence == "count" for b in branch.special) and np.all(branch.stable)
    branch = continue_equilibrium(Relay(a=-1.0, mu=0.5), Line(-1.5), "mu", (-2.0, 2.0))
    assert [(b.kind, b.discontinuous) for b in branch.bifurcations] == [("saddle-node", True)] * 2
    np.testing.assert_allclose([b.value for b in branch.bifurcations], [-1, 1], atol=1e-12)
    assert {b.count for b in branch.bifurcations} == {(2, 0), (0, 2)}


class Ball(nsjax.System):
    """A mass on a spring above a floor: it rests on it while the spring is short."""

    x_0: float = 1.0

    def vector_field(self, t, y, s):
        return Motion(y.v, self.x_0 - y.x - 0.1 * y.v + s.floor)

    @nsjax.impact
    def floor(self, t, y):
        return y.x

    @floor.restitution
    def floor(self):
        return 0.5


def test_contact():
    """x = x_0 > 0, or resting with the force -x_0."""
    branch = continue_equilibrium(Ball(), Motion(1.0, 0.0), "x_0", (-1.0, 1.0))
    (b,) = branch.special
    assert b.kind == "none" and b.surfaces == ("floor",) and abs(b.value) < 1e-12 and b.count == (1, 1)
    np.testing.assert_allclose(branch.ys.x, np.maximum(branch.values, 0), atol=1e-12)
    np.testing.assert_allclose(branch.multipliers[:, 0], np.maximum(-branch.values, 0), atol=1e-12)


class Thermostat(nsjax.System):
    T_0: float = 1.5

    def vector_field(self, t, y, s):
        return Line(self.T_0 + s.heater - y.x)

    @nsjax.relay
    def heater(self, t, y):
        return 1.0 - y.x

    @heater.off
    def heater(self, t, y):
        return y.x - 2.0


@pytest.mark.slow
def test_relay_ends_a_branch():
    """Below T_0 = 1 the heater switches on: this equilibrium is gone."""
    branch = continue_equilibrium(Thermostat(), Line(1.5), "T_0", (0.0, 3.0))
    (b,) = branch.special
    assert b.kind == "end" and b.count == (0, 1) and b.value == pytest.approx(1.0, abs=1e-12)
    assert branch.values.min() == pytest.approx(1.0, abs=1e-12) and branch.values.max() == 3.0
    assert branch.ends[0].startswith("end at T_0 = 1")


class Scaled(nsjax.System):
    """(5.8) in micrometres, with an indicator function in other units."""

    mu: float = 1.0
    unit: float = 1.0

    def vector_field(self, t, y, s):
        return Plane(y.x2, 1e6 * (1e-6 * self.mu - s.kink * y.x1) - 100 * y.x2)

    @nsjax.sgn
    def kink(self, t, y):
        return self.unit * y.x1


@pytest.mark.parametrize("unit", [1e-12, 1e12])
def test_pitfall_27_units(unit):
    branch = continue_equilibrium(Scaled(unit=unit), Plane(1e-6, 0.0), "mu", (-1.0, 1.0))
    (b,) = branch.bifurcations
    assert b.kind == "saddle-node" and b.evidence == "both" and len(branch) < 100
    np.testing.assert_allclose([b.value, b.crossings[0].q], [0, 0.5], atol=1e-10)
    np.testing.assert_allclose(np.abs(branch.ys.x1), 1e-6 * branch.values, atol=1e-17)


class Close(nsjax.System):
    """x' = μ - x for x > 0, and μ - x - 500 x² for x < 0: a corner at x = 0, a fold at x = -1e-3, within one step."""

    mu: float = 1.0

    def vector_field(self, t, y, s):
        return Line(self.mu - y.x - 500 * y.x**2 * (1 - s.kink) / 2)

    @nsjax.sgn
    def kink(self, t, y):
        return y.x


def test_pitfall_25_corner_and_fold_within_one_step():
    """Both are reported: the corner, which is none, at μ = 0, and the fold at μ = -5e-4."""
    branch = continue_equilibrium(Close(), Line(1.0), "mu", (-1.0, 1.0))
    assert sorted(b.kind for b in branch.special) == ["none", "saddle-node"]
    (fold,) = branch.bifurcations
    np.testing.assert_allclose([fold.value, fold.y.x], [-5e-4, -1e-3], atol=1e-10)


class Forms(nsjax.System):
    """Normal forms of two bifurcations side by side, at μ = m and μ = m + d."""

    mu: float = -1.0
    m: float = 0.0
    d: float = 0.0
    kind: str = "pitchfork"

    def vector_field(self, t, y, s):
        def rate(x, mu):
            if self.kind == "pitchfork":
                return jnp.stack([mu * x[0] - x[0] ** 3])
            if self.kind == "transcritical":
                return jnp.stack([mu * x[0] - x[0] ** 2])
            r = x @ x
            return jnp.stack([mu * x[0] - x[1] - x[0] * r, x[0] + mu * x[1] - x[1] * r])

        n = len(y) // 2
        return jnp.concatenate([rate(y[:n], self.mu - self.m), rate(y[n:], self.mu - self.m - self.d)])


@pytest.mark.slow
@pytest.mark.parametrize("kind", ["pitchfork", "transcritical", "Hopf"])
def test_wherever_in_the_interval(kind):
    """Places that steps end on, that bisection hits exactly, and where rows of the equations vanish in all digits."""
    zero = jnp.zeros(4 if kind == "Hopf" else 2)
    for m in [-0.95, -0.938, -0.898, -0.858, -0.75, -0.5, -0.35, 0.1, 0.25, 0.5, 0.55, 0.85]:
        found = continue_equilibrium(Forms(m=m, d=3.0, kind=kind), zero, "mu", (-1.0, 1.0)).bifurcations
        assert [b.kind for b in found] == [kind], m
        np.testing.assert_allclose(found[0].value, m, atol=1e-10)


@pytest.mark.slow
def test_at_one_place_at_once():
    """Two Hopf bifurcations, or two pitchforks, at one place or so close that no step tells them apart."""
    for d in (0.0, 1e-5):
        (b,) = continue_equilibrium(Forms(m=0.3, d=d, kind="Hopf"), jnp.zeros(4), "mu", (-1.0, 1.0)).bifurcations
        assert b.kind == "Hopf-Hopf" and abs(b.value - 0.3) <= 2 * d + 1e-12
    found = continue_equilibrium(Forms(m=0.3, d=0.01, kind="Hopf"), jnp.zeros(4), "mu", (-1.0, 1.0)).bifurcations
    np.testing.assert_allclose([b.value for b in found], [0.3, 0.31], atol=1e-10)
    (b,) = continue_equilibrium(Forms(m=0.2), jnp.zeros(2), "mu", (-1.0, 1.0)).bifurcations
    assert b.kind == "degenerate branch point" and abs(b.value - 0.2) < 1e-12


class Lorenz(nsjax.System):
    rho: float = 10.0

    def vector_field(self, t, y, s):
        return jnp.stack([10 * (y[1] - y[0]), y[0] * (self.rho - y[2]) - y[1], y[0] * y[1] - 8 / 3 * y[2]])


@pytest.mark.slow
def test_lorenz():
    """A pitchfork at ρ = 1, and subcritical Hopf bifurcations at ρ = σ (σ + β + 3)/(σ - β - 1) = 470/19."""
    branch = continue_equilibrium(Lorenz(), jnp.zeros(3), "rho", (0.0, 30.0))
    kinds = [(b.kind, b.criticality) for b in branch.bifurcations]
    assert kinds == [("pitchfork", "supercritical")] + [("Hopf", "subcritical")] * 2 and len(branch.branches) == 2
    np.testing.assert_allclose([b.value for b in branch.bifurcations], [1, 470 / 19, 470 / 19], rtol=1e-11)
    period = 2 * np.pi / np.sqrt(8 / 3 * (470 / 19 + 10))
    np.testing.assert_allclose(branch.bifurcations[1].period, period, rtol=1e-10)


class Pendulum(nsjax.System):
    mu: float = -1.0

    def vector_field(self, t, y, s):
        return Motion(y.v, self.mu * y.x - y.x**3)


@pytest.mark.slow
def test_conservative_system():
    """Its eigenvalues stay on the axis: that is no Hopf bifurcation, wherever one begins."""
    for mu in (-1.0, -0.7):
        branch = continue_equilibrium(Pendulum(mu), Motion(0.0, 0.0), "mu", (-1.0, 1.0))
        assert [(b.kind, b.criticality) for b in branch.special] == [("pitchfork", "supercritical")]


class Belt(nsjax.System):
    """A mass on a belt, with friction that falls with the relative velocity, written with a plain absolute value."""

    v_dr: float = 5.0

    def vector_field(self, t, y, s):
        force = s.belt / (1 + jnp.abs(y.v - self.v_dr))
        return Motion(y.v, -y.x - 0.1 * y.v - force)

    @nsjax.sgn
    def belt(self, t, y):
        return y.v - self.v_dr


@pytest.mark.slow
def test_unmarked_kink_beside_a_switch():
    """Hopf where 1/(1 + v_dr)² = 0.1. Below v_dr = 0 there is no way on: at rest all |x| <= 1 are equilibria."""
    branch = continue_equilibrium(Belt(), Motion(0.2, 0.0), "v_dr", (-1.0, 5.0))
    end, hopf = branch.special
    assert (end.kind, end.count) == ("continuum", (0, 1)) and hopf.kind == "Hopf"
    np.testing.assert_allclose([end.value, hopf.value], [0, np.sqrt(10) - 1], atol=1e-10)
    assert branch.ends == ("continuum of equilibria at v_dr = 0", "v_dr = 5")


class Two(nsjax.System):
    """x' = μ - x + |x| - |x - d|, of slopes -1, 1, -1: an S whose folds are at x = 0, μ = d and x = d, μ = 0."""

    mu: float = -1.0
    d: float = 1e-3

    def vector_field(self, t, y, s):
        return Line(self.mu - y.x + s.first * y.x - s.second * (y.x - self.d))

    @nsjax.sgn
    def first(self, t, y):
        return y.x

    @nsjax.sgn
    def second(self, t, y):
        return y.x - self.d


@pytest.mark.parametrize("d", [pytest.param(1e-3, marks=pytest.mark.slow), 1e-5, 1e-7])
def test_corners_next_to_each_other(d):
    branch = continue_equilibrium(Two(d=d), Line(-1.0), "mu", (-1.0, 1.0))
    assert [b.kind for b in branch.bifurcations] == ["saddle-node"] * 2
    np.testing.assert_allclose([b.value for b in branch.bifurcations], [0, d], atol=1e-12)
    assert len(branch.branches) == 1 and set(branch.ends) == {"mu = -1", "mu = 1"}


class Bratu(nsjax.System):
    lam: float = 0.5

    def vector_field(self, t, y, s):
        n = len(y)
        wide = jnp.concatenate([jnp.zeros(1), y, jnp.zeros(1)])
        return (n + 1) ** 2 * (wide[2:] - 2 * y + wide[:-2]) + self.lam * jnp.exp(y)


@pytest.mark.slow
def test_larger_systems():
    """Determinants of 136 rows are out of range. The fold of the discretised problem by scipy."""
    import scipy.optimize

    n = 17
    branch = continue_equilibrium(Bratu(), jnp.full(n, 0.1), "lam", (0.0, 4.0), max_points=300)
    (fold,) = branch.bifurcations
    middle = n // 2

    def lam_of(top):
        def residual(z):
            y, lam = z[:-1], z[-1]
            wide = np.concatenate([[0], y, [0]])
            f = (n + 1) ** 2 * (wide[2:] - 2 * y + wide[:-2]) + lam * np.exp(y)
            return [*f, y[middle] - top]

        return scipy.optimize.root(residual, [*np.asarray(fold.y), fold.value], tol=1e-13).x[-1]

    most = scipy.optimize.minimize_scalar(lambda top: -lam_of(top), bounds=(1.0, 1.4), options=dict(xatol=1e-10))
    assert fold.kind == "saddle-node"
    np.testing.assert_allclose(fold.value, -most.fun, rtol=1e-9)


@pytest.mark.slow
def test_orbits_born_at_a_hopf_point():
    """(5.25): radius √d and period 2π/(ω + β d), above only."""
    system = gallery.Hopf(-1.0)
    (b,) = continue_equilibrium(system, Plane(0.1, 0.0), "mu", (-1.0, 1.0)).bifurcations
    below, above = nsjax.continuation.hopf_orbits(system, b, [0.25, 0.5], solver=dfx.Tsit5())
    assert below == [] and len(above) == 1
    (family,) = above
    np.testing.assert_allclose([orbit.period for orbit in family], [2 * np.pi / 1.25, 2 * np.pi / 1.5], rtol=1e-9)
    np.testing.assert_allclose([np.hypot(*orbit.y0) for orbit in family], [0.5, np.sqrt(0.5)], rtol=1e-9)
    told = b.with_orbits(below, above)
    assert told.evidence == "both" and told.criticality == "supercritical" and "periodic orbits 0 -> 1" in str(told)
    with pytest.raises(ValueError, match="`distance` must be positive"):
        nsjax.continuation.hopf_orbits(system, b, -0.1)
    with pytest.raises(ValueError, match="must be a Hopf bifurcation, but is: saddle-node"):
        nsjax.continuation.hopf_orbits(
            system, dataclasses.replace(b, kind="saddle-node", period=None, criticality=None), 0.1
        )


@pytest.mark.slow
def test_orbits_born_subcritically():
    """α = 1: the unstable orbit of radius √d is below."""
    system = gallery.Hopf(-1.0, alpha=1.0)
    (b,) = continue_equilibrium(system, Plane(0.1, 0.0), "mu", (-1.0, 1.0)).bifurcations
    below, above = nsjax.continuation.hopf_orbits(system, b, 0.25, sizes=[0.45, 0.6])
    assert above == [] and len(below) == 1 and not below[0][0].stable
    np.testing.assert_allclose(below[0][0].period, 2 * np.pi / 1.25, rtol=1e-9)


@pytest.mark.slow
def test_orbits_born_at_a_discontinuous_hopf_point():
    """(5.29): radius d, period 2π, above only, and a multiplier exp(-2π)."""
    system = gallery.DiscontinuousHopf(-1.0)
    (b,) = continue_equilibrium(system, Plane(0.0, 0.0), "mu", (-1.0, 1.0)).bifurcations
    below, above = nsjax.continuation.hopf_orbits(system, b, [0.5, 1.0])
    assert below == [] and len(above) == 1
    np.testing.assert_allclose([np.hypot(*orbit.y0) for orbit in above[0]], [0.5, 1.0], rtol=1e-9)
    np.testing.assert_allclose([orbit.period for orbit in above[0]], 2 * np.pi, rtol=1e-9)
    np.testing.assert_allclose(np.abs(above[0][1].multipliers), [1, np.exp(-2 * np.pi)], rtol=1e-6)
    told = b.with_orbits(below, above)
    assert told.orbits == (0, 1) and told.criticality == "supercritical" and told.evidence == "both"


@pytest.mark.slow
def test_parameter_of_a_system_within():
    """`smoothed(system)` is continued over the parameter of `system`: (5.40) again."""
    system = nsjax.smoothed(gallery.HopfPitchfork(-1.0), 10.0)
    branch = continue_equilibrium(system, Plane(0.0, 0.0), "mu", (-1.0, 1.0))
    np.testing.assert_allclose([b.value for b in branch.bifurcations], [-ROOT / 10, ROOT / 10], atol=1e-11)
    again = continue_equilibrium(system, Plane(0.0, 0.0), "system.mu", (-1.0, 1.0))
    assert [b.kind for b in again.bifurcations] == ["Hopf", "pitchfork"]


def test_print(found):
    text = str(found("(5.32)"))
    assert "2 branches of HopfPitchfork" in text and "mu in [-1, 1]" in text
    assert "discontinuous Hopf-pitchfork bifurcation, supercritical at mu = 0, y = (0, 0)" in text
    assert "evidence   both: equilibria 1 -> 3 (pitchfork)" in text and "q_left = 0.25" in text


def test_errors():
    system, start = gallery.Pitchfork(-1.0), Line(0.0)
    with pytest.raises(ValueError, match="must be one of mu, alpha, the parameters of `Pitchfork`, but got 'nu'"):
        continue_equilibrium(system, start, "nu", (-1.0, 1.0))
    with pytest.raises(TypeError, match="must be the name of a field"):
        continue_equilibrium(system, start, 1.0, (-1.0, 1.0))
    with pytest.raises(ValueError, match=r"must be \(low, high\) and hold -1, the value of `mu`"):
        continue_equilibrium(system, start, "mu", (-0.5, 1.0))
    with pytest.raises(ValueError, match="`scale` must hold a positive number"):
        continue_equilibrium(system, start, "mu", (-1.0, 1.0), scale=Line(0.0))
    with pytest.raises(ValueError, match="at least one equilibrium"):
        continue_equilibrium(system, [], "mu", (-1.0, 1.0))
    with pytest.raises(ValueError, match="more digits than float32 has.*jax_enable_x64"):
        continue_equilibrium(system, Line(jnp.float32(0.0)), "mu", (-1.0, 1.0))
    virtual = [e for e in find_equilibria(gallery.HopfPitchfork(-1.0), Plane(jnp.ones(1), jnp.ones(1)), virtual=True)]
    virtual = next(e for e in virtual if not e.admissible)
    with pytest.raises(ValueError, match="what was found is virtual"):
        continue_equilibrium(gallery.HopfPitchfork(-1.0), virtual, "mu", (-1.0, 1.0))
    with pytest.warns(UserWarning, match="more than `max_branches` = 1"):
        continue_equilibrium(system, start, "mu", (-1.0, 1.0), max_branches=1)
    branch = continue_equilibrium(system, start, "mu", (-1.0, 1.0), max_points=10)
    assert any(end.startswith("max_points = 10") for end in branch.ends)
