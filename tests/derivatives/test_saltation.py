"""Saltation matrices three ways: formula, automatic differentiation through the flow, central differences of the flow.

The smooth pieces before and after an event, which the last two have to be freed of, are matrix exponentials here.
"""

import functools

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from models import Motion, pid
from scipy.linalg import expm

import nsjax
from nsjax import gallery, saltation_matrices, saltation_matrix, solve


class Swell(nsjax.System):
    """x'' = -k x - s, s = sgn(x - a sin t): a surface that moves, h = x - a sin t, crossed without sliding."""

    k: float = 1.0
    a: float = 0.5

    def vector_field(self, t, y, s):
        return Motion(y.v, -self.k * y.x - s.surface)

    @nsjax.sgn
    def surface(self, t, y):
        return y.x - self.a * jnp.sin(t)


class Racket(nsjax.System):
    """x'' = -g - k x above a plate that moves, x >= a sin t, with Newton's restitution."""

    k: float = 0.3
    g: float = 1.0
    a: float = 0.2
    e: float = 0.7

    def vector_field(self, t, y, s):
        return Motion(y.v, -self.g - self.k * y.x + 2 * s.plate)

    @nsjax.impact
    def plate(self, t, y):
        return y.x - self.a * jnp.sin(t)

    @plate.restitution
    def plate(self):
        return self.e


class Ceiling(nsjax.System):
    """The same below a ceiling that moves, x <= 2 + a sin t, where the jump is written as a reset."""

    k: float = 0.3
    g: float = 1.0
    a: float = 0.2
    e: float = 0.7

    def vector_field(self, t, y, s):
        return Motion(y.v, -self.g - self.k * y.x)

    @nsjax.impact
    def ceiling(self, t, y):
        return 2 + self.a * jnp.sin(t) - y.x

    @ceiling.reset
    def ceiling(self, t, y):
        return Motion(y.x, -self.e * y.v + (1 + self.e) * self.a * jnp.cos(t))


def linear(k, c=0.0):
    """Jacobian of x'' = -k x - c x'."""
    return np.array([[0, 1], [-k, -c]])


STICK = np.array([[0.0, 1.0], [0.0, 0.0]])


@functools.cache
def runner():
    # One program a class of system: it serves the derivative and, for its values alone, the differences.
    @jax.jit
    def run(system, y0, t0, t1):
        def flow(y0):
            sol = solve(
                system, t0, t1, Motion(y0[0], y0[1]), stepsize_controller=pid(1e-13), max_steps=20_000, max_events=4
            )
            return jnp.stack(sol.y1), (jnp.stack(sol.y1), sol.events)

        return jax.jacfwd(flow, has_aux=True)(y0)

    return run


def floats(system):
    return jax.tree.map(lambda x: jnp.asarray(x) if isinstance(x, float) else x, system)


compiled = eqx.filter_jit(saltation_matrix)


def formula(system, t, y, switch, *modes):
    """One program a class of system and a switch."""
    system, t, y, modes = jax.tree.map(jnp.asarray, (system, float(t), y, modes))
    return compiled(system, t, y, switch, *modes, throw=False)


def differences(fn, y, *, h=4e-3):
    """Jacobian by central differences, extrapolated three times: error O(h^6)."""
    columns = []
    for unit in np.eye(len(y)):
        table = [(fn(y + d * unit) - fn(y - d * unit)) / (2 * d) for d in (h, h / 2, h / 4)]
        for order in (4, 16):
            table = [(order * b - a) / (order - 1) for a, b in zip(table, table[1:])]
        columns.append(table[0])
    return np.stack(columns, -1)


# Each case: system, start, t0, t1, switches, modes before and after, Jacobians of the arcs, saltation matrices.
FALL = linear(1.0, 0.05)
TRILINEAR = linear(5.0, 0.55)
JUMP = np.array([[1, 0], [-0.5, 1]])  # -c_f / m
CASES = {
    "(3.41)": (gallery.StickSlip(m=2.0, k=1.5), (1.5, -0.3), 0.0, 4.5, ["belt"], [-1], [0],
        [linear(0.75), STICK], [np.diag([1, 0])]),
    "(3.41), (3.43)": (gallery.StickSlip(m=2.0, k=1.5), (1.5, -0.3), 0.0, 15.5, ["belt"] * 2, [-1, 0], [0, -1],
        [linear(0.75), STICK, linear(0.75)], [np.diag([1, 0]), np.array([[1, 0], [-1 / (2 * 0.2), 1]])]),
    "(3.57)": (gallery.DiscontinuousSupport(), (-0.8, 0.5), 0.3, 1.8, ["support"], [-1], [1],
        [linear(1), linear(5, 0.5)], [JUMP]),
    "(3.61)": (gallery.DiscontinuousSupport(), (0.4, 0.3), 0.0, 1.2, ["support"], [1], [-1],
        [linear(5, 0.5), linear(1)], [np.eye(2)]),
    "(6.21) a": (gallery.Trilinear(), (0.5, 1.0), 0.2, 1.2, ["lower"], [-1], [1], [FALL, TRILINEAR], [JUMP]),
    "(6.21) b": (gallery.Trilinear(), (1.3, 0.2), 0.2, 1.6, ["lower"], [1], [-1], [TRILINEAR, FALL], [np.eye(2)]),
    "(6.22) a": (gallery.Trilinear(), (-0.5, -1.0), 0.2, 1.2, ["upper"], [-1], [1], [FALL, TRILINEAR], [JUMP]),
    "(6.22) b": (gallery.Trilinear(), (-1.3, -0.2), 0.2, 1.6, ["upper"], [1], [-1], [TRILINEAR, FALL], [np.eye(2)]),
    "impact": (Racket(a=0.0), (0.6, 0.1), 0.5, 2.2, ["plate"], [0], [0], [linear(0.3)] * 2, [lambda e: racket(e, 0.0)]),
    "(3.32)": (Swell(), (1.0, -0.3), 0.5, 2.2, ["surface"], [1], [-1], [linear(1)] * 2,
        [lambda e: np.array([[1, 0], [2 / (e.y_before.v - 0.5 * np.cos(e.t)), 1]])]),
    "(3.32), restitution": (Racket(), (0.6, 0.1), 0.5, 2.2, ["plate"], [0], [0], [linear(0.3)] * 2,
        [lambda e: racket(e, 0.2)]),
    "(3.32), reset": (Ceiling(), (1.6, 3.0), 0.5, 1.0, ["ceiling"], [0], [0], [linear(0.3)] * 2,
        [lambda e: racket(e, 0.2)]),
}  # fmt: skip


def racket(e, a):
    """[[-e, 0], [(1 + e) w'' / w', -e]] for the gap w = x - a sin t, w' -> -e w': in the frame of the plate the surface
    stands still and the field is the same on both sides."""
    r, t = 0.7, float(e.t)
    before, after = e.y_before.v - a * np.cos(t), e.y_after.v - a * np.cos(t)
    pull = -1 - 0.3 * e.y_before.x + a * np.sin(t)  # w''
    np.testing.assert_allclose(after, -r * before, rtol=1e-12)
    return np.array([[-r, 0], [(1 + r) * pull / before, -r]])


QUICK = ("(3.41), (3.43)", "(3.32), restitution")  # each is a program of its own


@pytest.mark.parametrize("case", [pytest.param(c, marks=[pytest.mark.slow] * (c not in QUICK)) for c in CASES])
def test_three_ways(case):
    """Formula, autodiff and differences across the events against their exact product. Pitfall 19: exact to 1e-8 and not
    only to the accuracy of an interpolant."""
    system, y0, t0, t1, names, before, after, smooth, exact = CASES[case]
    system, y0 = floats(system), np.asarray(y0)
    jacobian, (_, events) = runner()(system, y0, t0, t1)
    assert [e.switch for e in events] == names
    times = [t0, *(float(e.t) for e in events), t1]
    for i, e in enumerate(events):
        assert (e.mode_before[e.switch], e.mode_after[e.switch]) == (before[i], after[i])
        modes = list(e.mode_before.values()), list(e.mode_after.values())
        want = exact[i](e) if callable(exact[i]) else exact[i]
        found = formula(system, e.t, e.y_before, e.switch, *modes)
        np.testing.assert_allclose(found, want, rtol=1e-11, atol=1e-11)
    formulas = np.asarray(eqx.filter_jit(saltation_matrices)(system, events))
    assert np.isnan(formulas[len(events) :]).all()
    whole = expm(smooth[0] * (times[1] - times[0]))
    for i, a in enumerate(smooth[1:]):
        whole = expm(a * (times[i + 2] - times[i + 1])) @ formulas[i] @ whole
    by_differences = differences(lambda y: np.asarray(runner()(system, y, t0, t1)[1][0]), y0)
    scale = np.abs(whole).max()
    errors = np.abs(jacobian - whole).max() / scale, np.abs(by_differences - whole).max() / scale
    assert errors[0] < 1e-10 and errors[1] < 1e-8
    if len(events) == 1:  # the event alone
        unwrap = [np.linalg.inv(expm(a * d)) for a, d in zip(smooth, np.diff(times))]
        for found in (np.asarray(jacobian), by_differences):
            np.testing.assert_allclose(
                unwrap[1] @ found @ unwrap[0], formulas[0], atol=1e-8 * np.abs(formulas[0]).max()
            )


def test_formulas_do_not_depend_on_parameters():
    """(3.41) is diag(1, 0) for every parameter; (3.43), here with damping, and (3.57) for others than the defaults."""
    for p in (dict(m=0.7, c=0.2, k=3.0, v_dr=-0.6, F_slip=0.4, F_stick=0.9), dict(c=0.1)):
        system = gallery.StickSlip(**p)
        at = system.v_dr, (np.sign(system.v_dr) * system.F_stick - system.c * system.v_dr) / system.k
        for side in (1, -1):
            entry = formula(system, 0.0, Motion(0.1, at[0]), "belt", side, 0)
            np.testing.assert_allclose(entry, np.diag([1, 0]), atol=1e-15)
        leave = formula(system, 0.0, Motion(at[1], at[0]), "belt", 0, -int(np.sign(at[0])))
        excess = np.sign(at[0]) * (system.F_stick - system.F_slip) / system.m
        corner = 1 - excess * system.c / (system.k * at[0])  # h_β = k x + c v - F_stick; the thesis has c = 0
        np.testing.assert_allclose(leave, [[1, 0], [-excess / at[0], corner]], rtol=1e-13)
    support = gallery.DiscontinuousSupport(m=2.0, c_f=0.7, k_f=9.0)
    contact = formula(support, 1.3, Motion(0.0, 0.4), "support", {"support": -1}, {"support": 1})
    np.testing.assert_allclose(contact, [[1, 0], [-0.35, 1]], atol=1e-15)


def test_transversality_of_a_log():
    """The cosine between normal and trajectory, small where the derivative is about to fail (pitfall 10)."""
    system = floats(Racket())
    _, (_, events) = runner()(system, np.array([0.6, 0.1]), 0.5, 2.2)
    (e,) = events
    v, t = float(e.y_before.v), float(e.t)
    normal, speed = np.array([1, -0.2 * np.cos(t)]), np.array([v, 1])
    acceleration = -1 - 0.3 * float(e.y_before.x)
    want = abs(normal @ speed) / np.linalg.norm(normal) / np.linalg.norm([v, acceleration, 1])
    np.testing.assert_allclose(events.transversality[0], want, rtol=1e-12)
    assert np.isnan(events.transversality[1:]).all()
    # Autonomous: time does not count.
    system = floats(gallery.StickSlip())
    _, (_, log) = runner()(system, np.array([2.0, 0.0]), 0.0, 14.0)
    first, last = log.transversality[:2]
    v, a = float(log.y_before.v[0]), -float(log.y_before.x[0]) + 1
    np.testing.assert_allclose(first, a / np.hypot(v, a), rtol=1e-7)
    np.testing.assert_allclose(last, 1, rtol=1e-12)


def test_a_tangency_is_infinite_not_floored():
    """Pitfall 10."""
    s = formula(gallery.StickSlip(), 0.0, Motion(1.0, 0.2), "belt", -1, 1)  # x' = 0.2, v' = -x + F_slip = 0
    assert not np.isfinite(s).all() and not np.isnan(s).any()
    with pytest.raises(nsjax.SolveError, match="met tangentially"):
        saltation_matrix(gallery.StickSlip(), 0.0, Motion(1.0, 0.2), "belt", -1, 1)


@pytest.mark.parametrize("unit", [1e-9, *[pytest.param(unit, marks=pytest.mark.slow) for unit in (1.0, 1e6)]])
def test_a_tangential_impact_is_told_in_any_unit(unit):
    """An impact at no velocity and at one that rounding cannot tell from it; at a small one the matrix is right."""
    plate = Racket(a=0.0, g=-unit)

    def at(v):
        return plate, 1.3, Motion(0.0, v * unit), "plate", 0, 0

    for v in (0.0, -1e-18):
        with pytest.raises(nsjax.SolveError, match="met tangentially"):
            saltation_matrix(*at(v))
        matrix = saltation_matrix(*at(v), throw=False)
        assert abs(matrix[1, 0]) > 1e15 and matrix[0, 1] == 0 and not np.isnan(matrix).any()
    np.testing.assert_allclose(saltation_matrix(*at(-1e-9)), [[-0.7, 0], [-1.7e9, -0.7]], rtol=1e-12)


def test_what_cancels_is_zero():
    """Where the field does not jump the matrix is the identity, though rounding has taken the event off its surface. Next
    to that it may jump: the derivative tells."""
    trilinear = gallery.Trilinear()
    for v in np.linspace(-0.1, -0.9, 9):
        off = trilinear.x_c - trilinear.c_f * v / trilinear.k_f
        for x in (np.nextafter(off, 0), off, np.nextafter(off, 2)):
            leave = formula(trilinear, 3.7, Motion(x, v), "lower", [1, -1], [-1, -1])
            np.testing.assert_array_equal(leave, np.eye(2))
    small = gallery.Trilinear(c_f=1e-12)  # no rounding
    enter = formula(small, 3.7, Motion(1.0, 0.4), "lower", [-1, -1], [1, -1])
    np.testing.assert_allclose(enter, [[1, 0], [-1e-12, 1]], rtol=1e-3)
    belt = gallery.StickSlip()  # with F_stick = F_slip (3.43) is the identity

    def slip(bound):
        end = Motion(bound / belt.k, belt.v_dr)
        return (formula(gallery.StickSlip(F_stick=bound), 0.0, end, "belt", 0, -1),) * 2

    change, matrix = jax.jacfwd(slip, has_aux=True)(belt.F_slip)
    np.testing.assert_array_equal(matrix, np.eye(2))
    slope = -1 / (belt.m * belt.v_dr)
    np.testing.assert_allclose(change, [[0, 0], [slope, 0]], atol=1e-12)
