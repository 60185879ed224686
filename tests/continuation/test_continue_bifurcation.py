"""Curves of special points of periodic orbits in two parameters, against closed forms and computations by scipy."""

import dataclasses
import pathlib
import re
from typing import Any, NamedTuple

import jax.numpy as jnp
import numpy as np
import pytest
from branches import continue_orbit, orbit_of
from jax import Array
from models import Duffing, Motion, Support
from programs import compilations
from scipy import optimize
from scipy.integrate import solve_ivp
from scipy.linalg import expm
from scipy.optimize import brentq, fsolve

import nsjax
from nsjax import continue_bifurcation, gallery


def branch_of(system, y0, parameter, interval, orbit=None, **options):
    return continue_orbit(system, orbit_of(system, y0, **(orbit or {})), parameter, interval, **options)


def of_kind(branch, kind):
    found = [b for b in branch.special_points if b.kind == kind]
    assert found, f"no {kind} among {[b.kind for b in branch.special_points]}"
    return found[0]


WALL = Support(c=0.05, x_c=4.0, k_f=1.0, c_f=1.0, omega=1.15)


class Twice(nsjax.System):
    """x'' + c x' + x = cos ωt + a cos(3ωt + φ), before an elastic wall: two crests in a period."""

    c: float = 0.1
    a: float = 0.3
    phi: float = 1.0 + np.pi
    x_c: float = 1.7
    omega: float = 0.42

    def vector_field(self, t, y, s):
        force = jnp.cos(self.omega * t) + self.a * jnp.cos(3 * self.omega * t + self.phi)
        return Motion(y.v, force - self.c * y.v - y.x - 2 * (y.x - self.x_c) * (1 + s.wall) / 2)

    @nsjax.sgn
    def wall(self, t, y):
        return y.x - self.x_c

    @property
    def period(self):
        return 2 * jnp.pi / self.omega


class Meissner(nsjax.System):
    """x'' + c x' + (δ + ε sgn(cos ωt)) x + x³ = 0: a parametric excitation that switches."""

    c: float = 0.1
    delta: float = 1.0
    epsilon: float = 0.5
    omega: float = 2.4

    def vector_field(self, t, y, s):
        return Motion(y.v, -self.c * y.v - (self.delta + self.epsilon * s.swing) * y.x - y.x**3)

    @nsjax.sgn
    def swing(self, t, y):
        return jnp.cos(self.omega * t)

    @property
    def period(self):
        return 2 * jnp.pi / self.omega


def meissner(omega, epsilon=0.5, c=0.1):
    """Trace and determinant of the monodromy matrix of x = 0."""
    half = np.pi / omega
    a, b = (np.sqrt(1 - c**2 / 4 + sign * epsilon) for sign in (1, -1))
    pair = 2 * np.cos(a * half) * np.cos(b * half) - (a / b + b / a) * np.sin(a * half) * np.sin(b * half)
    return np.exp(-c * half) * pair, np.exp(-2 * c * half)


def root(function, low, high):
    return float(np.asarray(brentq(function, low, high, xtol=1e-15)))


def duffing_map(x, v, t, omega, F):
    """The state after a period, and the derivatives by that before."""

    def rhs(t, z):
        x, v, *columns = z
        bend = -1 - 3 * x**2
        change = [w for a, b in (columns[:2], columns[2:]) for w in (b, bend * a - 0.2 * b)]
        return [v, F * np.cos(omega * t) - 0.2 * v - x - x**3, *change]

    end = solve_ivp(rhs, (t, t + 2 * np.pi / omega), [x, v, 1, 0, 0, 1], method="DOP853", rtol=3e-14, atol=1e-14)
    return end.y[:2, -1], end.y[2:, -1].reshape(2, 2).T


def duffing_fold(z, t, F):
    x, v, omega = z
    end, m = duffing_map(x, v, t, omega, F)
    return [*(end - [x, v]), np.linalg.det(np.eye(2) - m)]


def duffing_cusp(z, t):
    """Besides, the curvature of the map along the eigenvector of 1, seen by the left one."""
    x, v, omega, F = z
    _, m = duffing_map(x, v, t, omega, F)
    left, _, right = np.linalg.svd(np.eye(2) - m)
    h, along = 1e-4, right[-1] / np.sign(right[-1, 0])
    (a, _), (b, _) = (duffing_map(x + s * along[0], v + s * along[1], t, omega, F) for s in (h, -h))
    bend = (a + b - 2 * duffing_map(x, v, t, omega, F)[0]) / h**2
    return [*duffing_fold(z[:3], t, F), left[:, -1] @ bend / np.sign(left[0, -1])]


@pytest.fixture(scope="module")
def duffing():
    return branch_of(Duffing(), Motion(0.5, 0.0), "omega", (0.9, 2.4))


@pytest.fixture(scope="module")
def wall():
    """In each mode its field is affine, which makes small programs."""
    return branch_of(WALL, Motion(-3.0, 0.0), "omega", (1.05, 1.35))


def fold_of(branch):
    return next(b for b in branch.bifurcations if b.kind == "fold" and not b.discontinuous)


@pytest.mark.slow
def test_folds_and_cusp(duffing):
    """Without switches: the folds of Duffing's oscillator meet in a cusp, through which the curve goes on."""
    folds = [b for b in duffing.bifurcations if b.kind == "fold"]
    curve = continue_bifurcation(folds[0], "F", (0.05, 1.3))
    assert (curve.kind, curve.discontinuous, curve.parameters) == ("fold", False, ("omega", "F"))
    assert all(len(column) == len(curve) for column in (curve.values, curve.periods, curve.multipliers, curve.ts))
    np.testing.assert_allclose(np.abs(curve.multipliers - 1).min(axis=1), 0, atol=1e-9)
    for i in np.linspace(1, len(curve) - 2, 4).astype(int):
        omega, F = curve.values[i]
        guess = [curve.ys.x[i], curve.ys.v[i], omega]
        want = fsolve(duffing_fold, guess, (curve.ts[i], F), xtol=1e-12)
        np.testing.assert_allclose(omega, want[2], atol=1e-9)
    # Both folds of the branch are on the curve.
    both = sorted(omega for omega, F in curve.values if abs(F - 1) < 1e-9)
    assert any(abs(omega - folds[0].value) < 1e-9 for omega in both)
    other = continue_bifurcation(folds[1], "F", (0.05, 1.3))
    (cusp,), (same,) = curve.special, other.special
    assert cusp.name == same.name == "cusp"
    np.testing.assert_allclose(cusp.values, same.values, atol=1e-10)
    # (Not `fsolve`, which warns that it comes no nearer: the curvature is a difference, with rounding of 1e-5. That
    # moves the point along the curve, and its parameters, which turn back there, by a higher power.)
    want = optimize.root(duffing_cusp, np.round([cusp.y.x, cusp.y.v, *cusp.values], 3), cusp.t, tol=1e-12).x
    np.testing.assert_allclose(cusp.values, want[2:], atol=1e-9)
    assert set(curve.ends) == {"F = 1.3", "omega = 2.4"} and "cusp at omega = " in str(curve)
    ax = nsjax.plot.parameter_plane(curve, labels={"omega": "ω [rad/s]"})
    assert (ax.get_xlabel(), ax.get_ylabel()) == ("ω [rad/s]", "F") and [t.get_text() for t in ax.texts] == ["cusp"]


@pytest.mark.slow
def test_fold_meets_grazing(wall):
    """The linear response touches the wall where its amplitude is the distance. The fold of the orbits with contact
    ends there where their multiplier, with the limit of the saltation matrix, is 1."""
    corner, fold = (next(b for b in wall.bifurcations if b.discontinuous == d) for d in (True, False))
    grazing, folds = (continue_bifurcation(b, "x_c", (0.5, 12.0)) for b in (corner, fold))
    omega, x_c = grazing.values.T
    np.testing.assert_allclose(np.abs(1 - omega**2 + 0.05j * omega) * x_c, 1, atol=1e-10)
    assert grazing.name == "grazing of wall" and grazing.discontinuous and len(grazing) > 50

    def multiplier_one(omega, c=0.05, c_f=1.0):
        e, rate = np.exp(-c * np.pi / omega), np.sqrt(1 - c**2 / 4)
        angle = 2 * np.pi * rate / omega
        return 1 - 2 * e * np.cos(angle) + c_f * e * np.sin(angle) / rate + e**2

    at = root(multiplier_one, 1.1, 1.2)
    cusp, end = sorted(folds.special, key=lambda p: p.name)
    assert (cusp.name, end.name) == ("cusp", "fold at a grazing of wall") and "a grazing of wall" in folds.ends
    np.testing.assert_allclose(end.values, [at, 1 / abs(1 - at**2 + 0.05j * at)], atol=1e-10)
    np.testing.assert_allclose(end.multipliers, [1, np.exp(-0.05 * 2 * np.pi / at)], atol=1e-6)
    # A fold at another distance of the wall, found anew.
    i = np.argmin(np.abs(folds.values[:, 1] - 3.3))
    value, distance = folds.values[i]
    again = branch_of(dataclasses.replace(WALL, x_c=float(distance)), Motion(-2.0, 0.0), "omega", (1.05, 1.35))
    assert min(abs(b.value - value) for b in again.bifurcations if b.kind == "fold") < 1e-9


@pytest.mark.slow
def test_double_grazing():
    """Where both crests of the linear response touch the wall, its curve of grazings ends."""
    branch = branch_of(Twice(), Motion(0.0, 0.0), "omega", (0.39, 0.45))
    curve = continue_bifurcation(branch.special_points[0], "x_c", (1.0, 12.0), first=(0.25, 0.5))

    def response(angle, omega, derivative=0):
        parts = [(1, 1.0), (3, 0.3 * np.exp(1j * (1.0 + np.pi)))]
        lines = [(k * 1j) ** derivative * a * np.exp(1j * k * angle) / (1 - (k * omega) ** 2 + 0.1j * k * omega)
                 for k, a in parts]  # fmt: skip
        return np.real(sum(lines))

    def equations(z):
        first, second, omega = z
        return [response(first, omega, 1), response(second, omega, 1), response(first, omega) - response(second, omega)]

    crest, omega = np.asarray(fsolve(equations, [5.3, 1.05, 0.325], xtol=1e-12))[[0, 2]]
    (point,) = curve.special
    assert point.name == "double grazing" and "a grazing of wall" in curve.ends
    np.testing.assert_allclose(point.values, [omega, response(crest, omega)], atol=1e-9)
    angles = np.linspace(0, 2 * np.pi, 20001)
    heights = [np.max(response(angles, omega)) for omega in curve.values[:, 0]]
    np.testing.assert_allclose(curve.values[:, 1], heights, rtol=1e-6)


@pytest.mark.slow
def test_flips():
    branch = branch_of(Meissner(), Motion(0.0, 0.0), "omega", (2.2, 2.5), scale=Motion(1.0, 1.0), max_laps=1)
    curve = continue_bifurcation(of_kind(branch, "flip"), "epsilon", (0.05, 0.9), first=(1.0, 4.0))
    trace, square = meissner(*curve.values.T)
    np.testing.assert_allclose(1 + trace + square, 0, atol=1e-10)
    assert curve.ends == ("epsilon = 0.9",) * 2 and np.ptp(curve.values[:, 0]) > 1  # both sides of the resonance


@pytest.mark.slow
def test_neimark_sacker_and_resonances():
    """Without damping x = 0 has multipliers on the unit circle, until these meet at -1."""
    branch = branch_of(
        Meissner(omega=3.0), Motion(0.0, 0.0), "c", (-0.1, 0.15), scale=Motion(1.0, 1.0), max_laps=1
    )  # fmt: skip
    curve = continue_bifurcation(of_kind(branch, "Neimark-Sacker"), "omega", (0.6, 5.0))
    np.testing.assert_allclose(curve.values[:, 0], 0, atol=1e-11)
    assert curve.ends == ("1:2 resonance", "omega = 5") or curve.ends == ("omega = 5", "1:2 resonance")
    cosines = {"1:2 resonance": (-2, 2.2, 2.4), "1:3 resonance": (-1, 2.9, 3.2), "1:4 resonance": (0, 3.9, 4.2)}
    assert sorted(p.name for p in curve.special) == sorted(cosines)
    for point in curve.special:
        trace, *between = cosines[point.name]
        want = root(lambda omega, trace=trace: meissner(omega, c=0.0)[0] - trace, *between)
        np.testing.assert_allclose(point.values, [0, want], atol=1e-9)


@pytest.mark.slow
def test_symmetry_breaking():
    """Where x = 0 has the multiplier 1: at every point of the curve the equations of the orbits are singular."""
    branch = branch_of(
        Meissner(omega=1.1), Motion(0.0, 0.0), "omega", (0.98, 1.15), scale=Motion(1.0, 1.0), max_laps=1
    )  # fmt: skip
    curve = continue_bifurcation(of_kind(branch, "symmetry breaking"), "epsilon", (0.05, 0.9), first=(0.6, 2.0))
    trace, square = meissner(*curve.values.T)
    np.testing.assert_allclose(1 - trace + square, 0, atol=1e-9)
    assert curve.ends == ("epsilon = 0.9",) * 2 and not curve.discontinuous


def slip(tau, c, x, v):
    """The damped oscillator x'' + c x' + x = 0 after this time."""
    return expm(np.array([[0.0, 1.0], [-1.0, -c]]) * tau) @ [x, v]


@pytest.mark.slow
def test_infinitely_unstable_folds():
    """Section 6.7, as the guide has it: the mass comes back to the belt just as this could hold it with the slip force."""
    page = pathlib.Path(__file__).parents[2] / "docs" / "guide" / "two_parameters.md"
    blocks = re.findall(r"```python\n(.*?)```", page.read_text(), re.DOTALL)
    (block,) = [b for b in blocks if "continue_bifurcation" in b]
    shown: dict[str, Any] = dict(nsjax=nsjax)
    exec(block, shown)
    curve = shown["curve"]
    assert curve.name == "tangency of belt" and np.ptp(curve.values[:, 1]) > 0.3
    assert np.isnan(curve.multipliers).all()  # they are limits
    for (v_dr, c), period in zip(curve.values[::8], curve.periods[::8]):

        def equations(z, c=c):
            v, tau = z
            return slip(tau, c, 1 - c * v, v) - [-c * v, v]

        tau = period - 1 / v_dr  # on the belt it moves from one force to the other
        np.testing.assert_allclose(fsolve(equations, [v_dr, tau], xtol=1e-12)[0], v_dr, atol=1e-9)


@pytest.mark.parametrize(
    "change, message",
    [
        (dict(parameter="omega"), "another one than that of the branch"),
        (dict(parameter="speed"), "must be one of"),
        (dict(interval=(4.5, 5.0)), "must be \\(low, high\\) and hold 4"),
        (dict(first=(0.5, 0.6)), "`first` must be \\(low, high\\)"),
    ],
)
def test_mistakes(wall, change, message):
    with pytest.raises(ValueError, match=message):
        continue_bifurcation(fold_of(wall), **(dict(parameter="x_c", interval=(3.5, 4.5)) | change))


@pytest.mark.parametrize(
    "name, system, start, intervals",
    [
        pytest.param(
            "wall", WALL, Motion(-3.0, 0.0), dict(omega=(1.14, 1.16), x_c=(3.9, 4.1), k_f=(0.95, 1.05)),
            marks=pytest.mark.slow,
        ),
        pytest.param(
            "duffing", Duffing(), Motion(0.5, 0.0), dict(omega=(0.99, 1.01), F=(0.9, 1.1), c=(0.18, 0.22)),
            marks=pytest.mark.slow,
        ),
    ],
)  # fmt: skip
def test_another_parameter_is_no_new_program(name, system, start, intervals, request):
    """One parameter, or two, are changed without a compilation (pitfall 31)."""
    fold, orbit = fold_of(request.getfixturevalue(name)), orbit_of(system, start)
    of, one, other = intervals
    continue_orbit(system, orbit, of, intervals[of])  # tests before this one may have been told to forget
    with compilations() as compiled:
        branch = continue_orbit(system, orbit, one, intervals[one])
        assert len(branch) > 3 and not compiled
    first = continue_bifurcation(fold, one, intervals[one])
    with compilations() as compiled:
        second = continue_bifurcation(fold, other, intervals[other])
        assert not compiled
    for curve, varied in ((first, one), (second, other)):
        assert len(curve) > 3 and curve.parameters == (of, varied) and np.ptp(curve.values[:, 1]) > 0.03


def test_a_loaded_point(wall):
    with pytest.raises(ValueError, match="loaded from a file"):
        continue_bifurcation(dataclasses.replace(fold_of(wall), origin=None), "x_c", (3.5, 4.5))


@pytest.mark.slow
def test_contacts_that_vanish_by_symmetry():
    """Section 6.6, ω_A reached from the orbits with contact, of which both contacts vanish at once: up to the resonance
    and down its other side the linear response has the amplitude of the distance."""
    system = gallery.Trilinear(omega=0.95)
    branch = branch_of(system, Motion(-0.9007, 0.9438), "omega", (0.85, 1.0))
    (corner,) = branch.special_points
    assert corner.kind == "none" and corner.origin is not None and corner.origin.test.kind == "duration"
    curve = continue_bifurcation(corner, "x_c", (0.3, 6.0), first=(0.3, 1.6))
    omega, x_c = curve.values.T
    np.testing.assert_allclose(np.abs(1 - omega**2 + 0.05j * omega) * x_c, 0.2, atol=1e-10)
    assert np.min(omega) < 0.9 and np.max(omega) > 1.1 and np.max(x_c) > 3.9
    assert curve.kind == "grazing" and set(curve.surfaces) == {"lower", "upper"}


class Line(NamedTuple):
    x: Array


class Imperfect(nsjax.System):
    """x' = (μ + cos(t) / 2) x - x³ + ε: a pitchfork for ε = 0, and none else."""

    mu: float = -0.3
    epsilon: float = 0.0
    eta: float = 1.0

    def vector_field(self, t, y, s):
        return Line((self.mu + jnp.cos(t) / 2) * y.x - self.eta * y.x**3 + self.epsilon)

    @property
    def period(self):
        return 2 * jnp.pi


@pytest.mark.slow  # (branch points of branches are in test_continue_orbit)
def test_a_single_branch_point():
    """It lies on a curve over a parameter that leaves the symmetry, and on none over one that breaks it: over both the
    orbits are a smooth surface."""
    branch = branch_of(Imperfect(), Line(0.0), "mu", (-0.5, 0.5))
    (point,) = branch.bifurcations
    assert point.kind == "symmetry breaking" and point.value == pytest.approx(0, abs=1e-10)
    curve = continue_bifurcation(point, "eta", (0.5, 2.0))
    np.testing.assert_allclose(curve.values[:, 0], 0, atol=1e-10)
    assert np.ptp(curve.values[:, 1]) == pytest.approx(1.5)
    with pytest.raises(ValueError, match="beside this symmetry breaking bifurcation, supercritical none was found"):
        continue_bifurcation(point, "epsilon", (-0.1, 0.1))


@pytest.mark.slow
def test_where_A_B_and_C_meet():
    """Section 6.8: three curves, each computed on its own, through one point of codimension two."""
    entry = gallery.entry("6.8")
    branch = branch_of(entry.system(), entry.y0, "omega", (0.5, 0.8), orbit=dict(order=1))
    found = [of_kind(branch, "none")]
    found += [next(b for b in branch.bifurcations if b.discontinuous == d) for d in (False, True)]
    curves = [continue_bifurcation(b, "f_0", (2.0, 3.0), first=(0.4, 1.2)) for b in found]
    (first,), (second,), (third,) = (curve.special for curve in curves)
    np.testing.assert_allclose(second.values, first.values, atol=1e-8)
    np.testing.assert_allclose(third.values, first.values, atol=1e-8)
