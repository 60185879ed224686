"""The drillstring of Appendix A against closed forms, and against scipy on equations in the complex plane."""

import itertools
from typing import NamedTuple

import jax
import jax.numpy as jnp
import mpmath as mp
import numpy as np
import pytest
from drillstring import B_1, BETA, C, C_B, D, DELTA, drillstring, K, K_B, M, M_A, M_F, MU, R, R_C, T_0
from programs import equations_of
from scipy.integrate import solve_ivp
from scipy.optimize import brentq

import nsjax
from nsjax import gallery
from nsjax._types import Number
from nsjax.gallery import DrillstringScene, Twist, TwistedWhirl, Whirl, WhirlModel, WhirlScene


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
        program = jax.make_jaxpr(lambda y, system=system: nsjax.solve(system, 0.0, 20.0, y).y1)(y)
        counts.append(len(list(equations_of(program.jaxpr))))
        ends.append(np.array(jax.tree.leaves(nsjax.solve(system, 0.0, 20.0, y).y1)))
    assert counts[0] <= 1.03 * counts[1]
    np.testing.assert_allclose(ends[0], ends[1], atol=1e-9)


@pytest.mark.slow
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


@pytest.mark.slow
def test_equilibria_of_whirl():
    """Fig. A.6: from e2 over f to e3, over d to e4, both discontinuous saddle-nodes."""
    system = gallery.thesis("A.7", omega=2.64)
    r = np.sqrt((2.64**2 / 4 * (1 - 2 * BETA + 2 * BETA**2) - K) / B_1)
    branch = nsjax.continue_equilibrium(system, Whirl(r, 0.0, BETA * 1.32), "omega", (2.55, 2.8))
    (f,) = [b for b in branch.bifurcations if b.discontinuous]
    assert f.kind == "saddle-node"
    np.testing.assert_allclose(f.value, OMEGA_F, rtol=1e-12)
    np.testing.assert_allclose(jax.tree.leaves(f.y), [R_C, 0.0, BETA * OMEGA_F / 2], atol=1e-11)


def slope(of, *at):
    """dr/dω along equilibria, by the implicit function."""
    with mp.workdps(30):
        jacobian = mp.matrix(2, 3)
        for i, j in itertools.product(range(2), range(3)):
            jacobian[i, j] = mp.diff(lambda *x, i=i: of(*x)[i], tuple(at), tuple(int(k == j) for k in range(3)))
        return float(-mp.lu_solve(jacobian[:, 1:], jacobian[:, 0])[0])


@pytest.mark.slow
def test_the_whole_branch_of_whirl():
    """Fig. A.6 from point c on: stable e2, f, unstable e3, d, stable e4; their slopes beside f, (A.47)-(A.49)."""
    system = gallery.thesis("A.7", omega=2.64)
    r = np.sqrt((2.64**2 / 4 * (1 - 2 * BETA + 2 * BETA**2) - K) / B_1)
    branch = nsjax.continue_equilibrium(system, Whirl(r, 0.0, BETA * 1.32), "omega", (OMEGA_C + 1e-3, 3.5))
    (f,) = branch.bifurcations
    np.testing.assert_allclose(f.value, OMEGA_F, rtol=1e-12)
    rolling = gallery.thesis("A.7", omega=0.6)
    branch = nsjax.continue_equilibrium(rolling, Whirl(1.02, 0.0, -R * 0.6 / 1.02), "omega", (0.2, 2.6))
    (d,) = branch.bifurcations
    omega_d, r_d = point_d()
    assert d.discontinuous and d.kind == "saddle-node"
    np.testing.assert_allclose([d.value, d.y.r, d.y.Omega], [omega_d, r_d, -R * omega_d / r_d], rtol=1e-12)
    stable = np.asarray(branch.stable)
    assert stable.any() and not stable.all()
    # Beside f: e2 without, e3 with contact.
    no_contact = lambda omega, r, Omega: (radial(omega, r, Omega) / r, (C + D) * Omega - D * omega / 2)  # noqa: E731
    for of, off in ((no_contact, -1e-8), (slip, 1e-8)):
        want = slope(of, OMEGA_F, R_C, BETA * OMEGA_F / 2)
        omega = OMEGA_F + off / want
        guess = Whirl(R_C + off, 0.0, BETA * OMEGA_F / 2)

        def radius(omega, guess=guess):
            return nsjax.find_equilibrium(gallery.thesis("A.7", omega=omega), guess).y.r

        np.testing.assert_allclose(jax.jacfwd(radius)(omega), want, rtol=1e-5)


@pytest.mark.slow
def test_in_cartesian_coordinates_the_middle_is_an_equilibrium_and_a_whirl_an_orbit():
    """Point c is a Hopf bifurcation, and from there on e2 is an orbit of period 2π/|Ω|."""
    scene = gallery.thesis("A.7", omega=2.64, coordinates="cartesian")
    branch = nsjax.continue_equilibrium(scene, scene.state(), "omega", (0.2, 3.5))
    (hopf,) = branch.bifurcations
    assert hopf.kind == "Hopf" and hopf.criticality == "supercritical"
    np.testing.assert_allclose(hopf.value, OMEGA_C, rtol=1e-12)
    r, Omega = np.sqrt((2.64**2 / 4 * (1 - 2 * BETA + 2 * BETA**2) - K) / B_1), BETA * 1.32
    orbit = nsjax.find_orbit(scene, scene.state(dict(x=r), dict(y=r * Omega)), period=2 * np.pi / Omega)
    np.testing.assert_allclose(orbit.period, 2 * np.pi / Omega, rtol=1e-11)
    np.testing.assert_allclose(np.hypot(orbit.y0.q.x, orbit.y0.q.y), r, rtol=1e-10)
    whirls = nsjax.continue_orbit(scene, orbit, "omega", (2.5, 2.645))
    (born,) = [s for s in whirls.special_points if s.kind == "Hopf"]
    assert born.name == "Hopf bifurcation, supercritical"
    np.testing.assert_allclose([born.value, born.period], [OMEGA_C, 2 * np.pi / (BETA * OMEGA_C / 2)], rtol=1e-10)


# A.8: stick-slip.


def twist(t, y, omega, side):
    theta = y[1] + omega
    return y[1], -y[0] - side * T_0 / (1 + DELTA * side * theta)


def until_it_stands(y, omega, side):
    """The time and the twist at which θ' comes back to zero, in slip on one side."""

    def stands(t, y, omega, side):
        return side * (y[1] + omega)

    stands.terminal, stands.direction = True, -1
    # On the surface the first step finds that out; it leaves it tangentially where φ is that at which stick ends.
    arc = solve_ivp(twist, (0, 30), y, "DOP853", events=stands, args=(omega, side), rtol=1e-13, atol=1e-15)
    return arc.t[-1], arc.y[0, -1]


def after_stick(omega):
    """From where stick ends, φ = -T_0 / k_φ: duration and twist of the slip forwards."""
    return until_it_stands([-T_0 * (1 - 1e-15), -omega * (1 - 1e-15)], omega, 1)


def lap(phi, omega):
    """From slip backwards that ends at φ to the next that does: time, twist."""
    t, there = until_it_stands([phi, -omega], omega, 1)
    back, phi = until_it_stands([there, -omega], omega, -1)
    return t + back, phi


@pytest.mark.slow
def test_stick_slip_without_stick():
    """Fig. A.7a: at ω = 2 slip forwards and backwards alone. scipy's orbit by fixed-point iteration."""
    guess = gallery.entry("A.8").orbit
    orbit = nsjax.find_orbit(gallery.thesis("A.8"), guess.y0, period=guess.period)
    phi = -0.25
    for _ in range(15):  # the multiplier is 0.07
        period, phi = lap(phi, 2.0)
    np.testing.assert_allclose(orbit.period, period, rtol=1e-11)
    assert [e.switch for e in orbit.events] == ["bit", "bit"]
    np.testing.assert_allclose(orbit.events.y_after.phi[1], phi, rtol=1e-10)


@pytest.mark.slow
def test_stick_slip_in_the_middle_of_the_stator():
    """P1 in the whole scene: at r = 0 the friction of the open contact has its surface where that of the bit is, and is
    not met there. Whirl decays."""
    scene = gallery.thesis("A.9", coordinates="cartesian", omega=2.0)
    orbit = nsjax.find_orbit(scene, scene.state(dict(phi=-2.1307), dict(phi=0.4496)), period=6.296)
    torsion = nsjax.find_orbit(gallery.thesis("A.8"), Twist(-2.1307, 0.4496), period=6.296)
    np.testing.assert_allclose(orbit.period, torsion.period, rtol=1e-10)
    assert [event.switch for event in orbit.events] == ["bit", "bit"] and orbit.stable
    rho = np.asarray(orbit.multipliers)
    twist = np.asarray(torsion.multipliers)[np.argmin(np.abs(torsion.multipliers))]
    assert np.min(np.abs(rho - twist)) < 1e-8 and np.sum(np.abs(rho.imag) > 0.1) == 4


BACKWARDS = 0.7422889477650  # where slip backwards appears; as the next test finds it


@pytest.mark.slow
@pytest.mark.parametrize("omega, low, high", [(0.77, 0.72, 0.78), (0.72, 0.71, 0.77)])
def test_the_corner_where_slip_backwards_appears(omega, low, high):
    """Pitfall 25: seen from either side. A segment that returns to its surface vanishes, beside orbits on which it has
    no duration anyway; and a surface can only just hold what comes onto it. The branch goes on."""
    corner = brentq(lambda omega: after_stick(omega)[1] - T_0, 0.7, 0.8, xtol=1e-13)
    assert corner == pytest.approx(BACKWARDS, abs=1e-11)
    system = gallery.thesis("A.8", omega=omega)
    orbit = nsjax.find_orbit(system, Twist(-1.0, 0.3), period=6.32)
    branch = nsjax.continue_orbit(system, orbit, "omega", (low, high))
    assert branch.ends == (f"omega = {low}", f"omega = {high}")
    (point,) = branch.special_points
    assert (point.kind, point.discontinuous, point.count) == ("none", True, ((1,), (1,)))
    np.testing.assert_allclose(point.value, corner, atol=1e-9)
    np.testing.assert_allclose(point.period, after_stick(corner)[0] + 2 * T_0 / corner, rtol=1e-9)


@pytest.mark.slow
def test_the_branch_p1():
    """Fig. A.7b: it does not end; slip backwards appears, and then stick vanishes."""

    def arrives(omega):  # where stick vanishes: slip backwards ends at φ = -T_0
        t, phi = after_stick(omega)
        return until_it_stands([phi, -omega], omega, -1)[1] + T_0

    gone = brentq(arrives, 1.5, 2.0, xtol=1e-13)
    guess = gallery.entry("A.8").orbit
    system = gallery.thesis("A.8")
    orbit = nsjax.find_orbit(system, guess.y0, period=guess.period)
    branch = nsjax.continue_orbit(system, orbit, "omega", (0.05, 3.0))
    assert branch.ends == ("omega = 0.05", "omega = 3") and branch.stable.all() and not branch.others
    assert [p.kind for p in branch.special_points] == ["none", "none"]
    np.testing.assert_allclose([p.value for p in branch.special_points], [BACKWARDS, gone], atol=1e-8)
    slowest = np.asarray(branch.low.w) + branch.values  # of Fig. A.7b
    np.testing.assert_allclose(slowest[branch.values < BACKWARDS], 0, atol=1e-9)
    assert np.all(slowest[branch.values > BACKWARDS + 0.05] < 0)


# A.9: both.


def motion(t, y, omega, touch):
    return drillstring(*y, omega, (touch, 1, 1))


def flow(y, omega, time):
    """scipy, with contact as the equations have it; rotor and bit slip forwards."""

    def meets(t, y, *_):
        return y[0] - R_C

    def leaves(t, y, *_):
        return K_B * (y[0] - R_C) + C_B * y[2 - 1]

    for event, way in ((meets, 1), (leaves, -1)):
        event.terminal, event.direction = True, way
    t, touch = 0.0, 1 if y[0] > R_C and leaves(0, y) > 0 else -1
    while t < time:
        event = leaves if touch > 0 else meets
        arc = solve_ivp(motion, (t, time), y, "DOP853", events=event, args=(omega, touch), rtol=1e-12, atol=1e-13)
        t, y = arc.t[-1], arc.y[:, -1]
        touch = -touch if arc.status == 1 else touch
    return y


@pytest.mark.slow
def test_an_orbit_with_contact():
    """P4 at ω = 2.5, unstable: contact begins and ends once a lap, and nothing else happens."""
    guess = TwistedWhirl(1.0197, 0.2029, 0.7161, 1.9272, -0.8771)
    orbit = nsjax.find_orbit(gallery.thesis("A.9", omega=2.5), guess, period=5.402)
    assert [e.switch for e in orbit.events] == ["wall", "wall"] and not orbit.stable
    y, time = np.array(orbit.y0), float(orbit.period)
    np.testing.assert_allclose(time, 5.402389875780514, rtol=1e-10)
    np.testing.assert_allclose(flow(y, 2.5, time), y, atol=1e-8)
    step = 1e-5
    columns = [(flow(y + step * e, 2.5, time) - flow(y - step * e, 2.5, time)) / (2 * step) for e in np.eye(5)]
    want = np.linalg.eigvals(np.array(columns).T)
    order = lambda rho: rho[np.lexsort((rho.imag, -abs(rho).round(4)))]  # noqa: E731
    np.testing.assert_allclose(order(np.asarray(orbit.multipliers)), order(want), atol=1e-5)


def of_e2(omega):
    """E2 and its eigenvalues, in 30 digits."""
    r = mp.sqrt((omega**2 / 4 * (1 - 2 * BETA + 2 * BETA**2) - K) / mp.mpf("0.1"))
    y = [r, mp.mpf(0), BETA * omega / 2, mp.mpf(0), mp.mpf(0)]
    y[3] = drillstring(*y, omega, (-1, 1, 1))[4] / K
    jacobian, step = mp.matrix(5, 5), mp.mpf(10) ** -10
    for j in range(5):
        ends = [drillstring(*[x + s * step * (i == j) for i, x in enumerate(y)], omega, (-1, 1, 1)) for s in (1, -1)]
        for i in range(5):
            jacobian[i, j] = (ends[0][i] - ends[1][i]) / (2 * step)
    return y, mp.eig(jacobian, right=False)


def test_hopf_point_of_e2():
    """Where E2 loses its stability to torsion."""
    with mp.workdps(30):

        def leading(omega):
            return max((x for x in of_e2(omega)[1] if abs(x.imag) > mp.mpf("0.5")), key=lambda x: x.real)

        omega = mp.findroot(lambda omega: leading(omega).real, (2.54, 2.5405), solver="secant")
        y, _ = of_e2(omega)
        frequency = abs(leading(omega).imag)
    np.testing.assert_allclose(float(omega), 2.540313206, atol=1e-9)
    system = gallery.thesis("A.9", omega=float(omega))
    found = nsjax.find_equilibrium(system, TwistedWhirl(*map(float, y)))
    np.testing.assert_allclose(jax.tree.leaves(found.y), np.array(y, float), atol=1e-12)
    roots = np.asarray(found.eigenvalues)
    pair = roots[np.argmin(np.abs(roots - 1j * float(frequency)))]
    assert abs(pair - 1j * float(frequency)) < 1e-10
