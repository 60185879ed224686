"""The drillstring of Appendix A against closed forms, and against scipy on equations in the complex plane."""

import itertools
import sys
from pathlib import Path
from typing import NamedTuple

import jax
import jax.numpy as jnp
import mpmath as mp
import numpy as np
import pytest
from scipy.integrate import solve_ivp
from scipy.optimize import brentq

import nsjax
from nsjax import gallery
from nsjax._types import Number
from nsjax.gallery import DrillstringScene, Twist, TwistedWhirl, Whirl, WhirlModel, WhirlScene


sys.path.insert(0, str(Path(__file__).parents[2] / "benchmarks"))
from program import count_equations  # noqa: E402


# Appendix C.6.
M = M_F = K = R_C = J = K_PHI = 1.0
C, D, B_1, K_B, C_B, MU, R, T_0, DELTA = 0.3, 0.1, 0.1, 50.0, 30.0, 0.5, 2.0, 0.2, 0.3
M_A, BETA = M + M_F, D / (C + D)


def whirl(z, v, theta, f_b):
    """z'' of the rotor's middle z = x + iy by (A.2), (A.13), and the fluid's force, under the contact force f_b."""
    drag, stiff = D, B_1 * abs(z) ** 2
    rest = 1j * M_F * theta * v + M_F * theta**2 / 4 * z - drag * (v - 0.5j * theta * z) - stiff * z
    a = (-C * v - K * z + rest + f_b) / M_A
    return a, rest - M_F * a


def contact(r, u, v_rel, touch, roll):
    """F_bN and F_bT, section 3.5 and (A.6)."""
    normal = (K_B * (r - R_C) + C_B * u) if touch > 0 else 0.0
    return normal, -MU * roll * normal


def drillstring(r, u, Omega, phi, w, omega, s):
    """(A.51), for values s of the switches."""
    theta = omega + w
    normal, along = contact(r, u, r * Omega + theta * R, s[0], s[1])
    a, fluid = whirl(r, u + 1j * r * Omega, theta, -normal + 1j * along)
    bit = -T_0 * s[2] / (1 + DELTA * abs(theta))
    twist = (-K_PHI * phi + bit + along * R - fluid.imag * r) / J
    return u, a.real + r * Omega**2, (a.imag - 2 * u * Omega) / r, w, twist


def numbers(system, y, s, t=0.0):
    y = jax.tree.map(jnp.asarray, y)
    return np.array(jax.tree.leaves(system.vector_field(jnp.asarray(t), y, system.values(tuple(map(jnp.asarray, s))))))


STATES = [(1.1, 0.3, -0.4, 0.2, 0.5), (0.4, -0.2, 1.3, -1.0, -2.6), (1.02, -0.5, -4.9, 0.3, 0.0)]


@pytest.mark.parametrize("y", STATES)
def test_the_equations_in_every_mode(y):
    for omega, touch, roll, bit in itertools.product((0.7, 2.5), (-1.0, 1.0), (-1.0, 1.0), (-1.0, 1.0)):
        theta = omega + y[4]
        if bit * theta < 0:
            continue
        want = drillstring(*y, omega, (touch, roll, bit))
        got = numbers(gallery.thesis("A.9", omega=omega), TwistedWhirl(*y), (touch, roll, bit))
        np.testing.assert_allclose(got, want, rtol=1e-13, atol=1e-13)
        # Without twist, and without whirl.
        want = drillstring(*y[:3], 0.0, 0.0, omega, (touch, roll, 0.0))[:3]
        got = numbers(gallery.thesis("A.7", omega=omega), Whirl(*y[:3]), (touch, roll))
        np.testing.assert_allclose(got, want, rtol=1e-13, atol=1e-13)
        got = numbers(gallery.thesis("A.8", omega=omega), Twist(*y[3:]), (bit,))
        np.testing.assert_allclose(got, [y[4], -y[3] - T_0 * bit / (1 + DELTA * abs(theta))], rtol=1e-13)


def test_the_stator_as_it_is_printed_has_no_damping():
    """(A.5): contact is where r > R_c, whatever the velocity."""
    system = gallery.thesis("A.7", c_b=None)
    y = Whirl(*map(jnp.asarray, (1.02, -5.0, 0.3)))
    (depth,) = system.switches[0].components(system, 0.0, y)
    assert float(depth) == pytest.approx(0.02)
    force = numbers(system, y, (-1.0, 1.0))[1] - numbers(system, y, (1.0, 1.0))[1]
    assert force == pytest.approx(50 * 0.02 / 2)


@pytest.mark.parametrize("y", STATES)
@pytest.mark.parametrize("c_b", [30.0, None])
def test_cartesian_scenes_are_the_polar_models(y, c_b):
    r, u, Omega, phi, w = y
    turn = np.exp(0.7j)
    z, v = r * turn, (u + 1j * r * Omega) * turn
    for s in itertools.product((-1.0, 1.0), (-1.0, 0.3, 1.0), (-1.0, 0.5, 1.0)):
        flat = gallery.thesis("A.9", c_b=c_b, B_2=0.05)
        scene = gallery.thesis("A.9", coordinates="cartesian", c_b=c_b, B_2=0.05)
        assert isinstance(scene, DrillstringScene)
        state = scene.state(dict(x=z.real, y=z.imag, phi=phi), dict(x=v.real, y=v.imag, phi=w))
        *_, ax, ay, aphi = numbers(scene, state, s)
        _, du, dOmega, _, dw = numbers(flat, TwistedWhirl(*y), s)
        want = (du - r * Omega**2 + 1j * (r * dOmega + 2 * u * Omega)) * turn
        np.testing.assert_allclose([ax, ay, aphi], [want.real, want.imag, dw], rtol=1e-12, atol=1e-12)
        flat, scene = gallery.thesis("A.7", c_b=c_b), gallery.thesis("A.7", coordinates="cartesian", c_b=c_b)
        *_, ax, ay = numbers(scene, scene.state(dict(x=z.real, y=z.imag), dict(x=v.real, y=v.imag)), s[:2])
        _, du, dOmega = numbers(flat, Whirl(*y[:3]), s[:2])
        want = (du - r * Omega**2 + 1j * (r * dOmega + 2 * u * Omega)) * turn
        np.testing.assert_allclose([ax, ay], [want.real, want.imag], rtol=1e-12, atol=1e-12)


class Plane(NamedTuple):
    x: Number
    y: Number
    v_x: Number
    v_y: Number


class WhirlByHand(nsjax.System):
    """The scene of A.7, written out."""

    omega: float = 2.6
    m: float = 1.0
    c: float = 0.3
    k: float = 1.0
    m_f: float = 1.0
    D: float = 0.1
    B_1: float = 0.1
    B_2: float = 0.0
    R: float = 2.0
    R_c: float = 1.0
    k_b: float = 50.0
    c_b: float = 30.0
    mu_b: float = 0.5

    def polar(self, y):
        r = jnp.sqrt(y.x**2 + y.y**2)
        return r, (y.x * y.v_x + y.y * y.v_y) / r, (y.x * y.v_y - y.y * y.v_x) / r

    def vector_field(self, t, y, s):
        r, u, _ = self.polar(y)
        N = (self.k_b * (r - self.R_c) + self.c_b * u) * (1 + s.wall) / 2
        T = -self.mu_b * s.roll * N
        square, mass, turning = y.x**2 + y.y**2, self.m + self.m_f, self.m_f * self.omega
        drag = self.D + self.B_2 * square
        stiff = self.m_f * self.omega**2 / 4 - self.B_1 * square
        fx = stiff * y.x - turning * y.v_y - drag * (y.v_x + self.omega / 2 * y.y)
        fy = stiff * y.y + turning * y.v_x - drag * (y.v_y - self.omega / 2 * y.x)
        ax = (fx - self.k * y.x - self.c * y.v_x - (N * y.x + T * y.y) / r) / mass
        ay = (fy - self.k * y.y - self.c * y.v_y - (N * y.y - T * y.x) / r) / mass
        return Plane(y.v_x, y.v_y, ax, ay)

    @nsjax.sgn
    def wall(self, t, y):
        r, u, _ = self.polar(y)
        return r - self.R_c, self.k_b * (r - self.R_c) + self.c_b * u

    @nsjax.sgn
    def roll(self, t, y):
        return self.polar(y)[2] + self.omega * self.R

    roll = roll.while_("wall")


@pytest.mark.slow
def test_a_scene_costs_what_the_same_written_by_hand_costs():
    scene, hand = WhirlScene(), WhirlByHand()
    starts = scene.state(dict(x=0.5), dict(y=0.3)), Plane(0.5, 0.0, 0.0, 0.3)
    counts, ends = [], []
    for system, y in zip((scene, hand), starts):
        y = jax.tree.map(jnp.asarray, y)
        counts.append(count_equations(lambda y, system=system: nsjax.solve(system, 0.0, 20.0, y).y1, y))
        ends.append(np.array(jax.tree.leaves(nsjax.solve(system, 0.0, 20.0, y).y1)))
    assert counts[0] <= 1.03 * counts[1]
    np.testing.assert_allclose(ends[0], ends[1], atol=1e-9)


def test_a_rotor_that_does_not_touch_its_stator_has_no_events():
    """Friction is there only in contact: turning the other way over v_rel = 0 is no event."""
    system = gallery.thesis("A.7", omega=0.1)
    sol = nsjax.solve(system, 0.0, 5.0, Whirl(0.5, 0.0, -0.6))
    v_rel = [float(y.r * y.Omega + 0.2) for y in (Whirl(0.5, 0.0, -0.6), sol.y1)]
    assert v_rel[0] < 0 < v_rel[1] and len(sol.events) == 0
    assert "roll off" in str(sol)


@pytest.mark.parametrize("key", ["A.7", "A.9"])
def test_the_middle_of_the_stator(key):
    """In Cartesian coordinates it is a place like others, in single precision too."""
    scene = gallery.thesis(key, coordinates="cartesian", omega=1.0)
    off = (-1.0, 0.0, 1.0)[: len(scene.switches)]
    for dtype in (jnp.float64, jnp.float32):
        y = jax.tree.map(lambda x: jnp.asarray(x, dtype), scene.state())
        slope = jax.jacfwd(jax.jacfwd(lambda y: scene.vector_field(0.0, y, scene.values(tuple(map(jnp.asarray, off))))))
        assert all(np.isfinite(x).all() for x in jax.tree.leaves(slope(y)))


def test_coordinates_are_asked_for_by_name():
    with pytest.raises(ValueError, match="Argument `coordinates` must be 'polar' or 'cartesian', but got 'flat'"):
        gallery.thesis("A.7", coordinates="flat")
    with pytest.raises(ValueError, match="Argument `coordinates` must be left out for 'A.8'"):
        gallery.thesis("A.8", coordinates="cartesian")
    assert isinstance(gallery.thesis("(A.16)", coordinates="polar"), WhirlModel)


# A.7: equilibria.

OMEGA_C = np.sqrt(4 * K * (C + D) ** 2 / (C**2 * M_F + D**2 * M))  # (A.21)
OMEGA_F = np.sqrt((K + B_1 * R_C**2) / (M_F / 4 - M_F * BETA / 2 + M_A * BETA**2 / 4))  # r = R_c in (A.20)


def radial(omega, r, Omega):
    return (K - omega**2 * M_F / 4 + M_F * omega * Omega + B_1 * r**2 - M_A * Omega**2) * r


def slip(omega, r, Omega):
    """(A.40), (A.41)."""
    normal = K_B * (r - R_C)
    return radial(omega, r, Omega) + normal, (C + D) * Omega * r - D * omega / 2 * r + MU * normal


def point_d():
    """Where rolling ends: (A.31), (A.32) with friction at its bound."""
    with mp.workdps(30):
        found = mp.findroot(lambda omega, r: list(slip(omega, r, -R * omega / r)), (0.4, 1.01))
        return float(found[0]), float(found[1])


def test_equilibria_of_whirl():
    """Fig. A.6: from e2 over f to e3, over d to e4, both discontinuous saddle-nodes."""
    system = gallery.thesis("A.7", omega=2.64)
    r = np.sqrt((2.64**2 / 4 * (1 - 2 * BETA + 2 * BETA**2) - K) / B_1)
    branch = nsjax.continue_equilibrium(system, Whirl(r, 0.0, BETA * 1.32), "omega", (2.55, 2.8))
    (f,) = [b for b in branch.bifurcations if b.discontinuous]
    assert f.kind == "saddle-node"
    np.testing.assert_allclose(f.value, OMEGA_F, rtol=1e-12)
    np.testing.assert_allclose(jax.tree.leaves(f.y), [R_C, 0.0, BETA * OMEGA_F / 2], atol=1e-11)


@pytest.mark.slow
def test_the_whole_branch_of_whirl():
    system = gallery.thesis("A.7", omega=2.64)
    r = np.sqrt((2.64**2 / 4 * (1 - 2 * BETA + 2 * BETA**2) - K) / B_1)
    branch = nsjax.continue_equilibrium(system, Whirl(r, 0.0, BETA * 1.32), "omega", (OMEGA_C + 1e-3, 3.5))
    print(branch)
