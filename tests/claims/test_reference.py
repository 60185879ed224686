"""The references checked by second routes: closed forms, scipy, extended saltation products, finite differences."""

import numpy as np
import pytest
import reference as ref
from reference import mp
from scipy.integrate import solve_ivp
from scipy.optimize import brentq


def scipy_final(machine, t1, y0, side):
    """(kinds, state at t1) by DOP853; `side[mode]` is the sign of the surfaces' minimum while in that mode, which
    `direction` needs so that the event just handled does not fire again."""
    t, y, kinds = 0.0, np.asarray(y0, float), []
    mode = machine.mode(*map(mp.mpf, y))
    while True:
        m, c, k, b, f_0, omega = map(float, machine.oscillator(mode))

        def field(t, y):
            return [y[1], (b + f_0 * np.cos(omega * t) - c * y[1] - k * y[0]) / m]

        surfaces = {name: ref.floats(s) for name, s in machine.surfaces(mode).items()}

        def guard(t, y):
            return min(s @ [*y, 1.0] for s in surfaces.values())

        guard.terminal, guard.direction = True, -side[mode]
        sol = solve_ivp(field, (t, t1), y, method="DOP853", rtol=1e-12, atol=1e-13, events=guard, max_step=0.1)
        t, y = sol.t[-1], sol.y[:, -1]
        if not sol.status:
            return kinds, y
        name = min(surfaces, key=lambda name: abs(surfaces[name] @ [*y, 1.0]))
        kind, mode, *y = machine.after(name, mode, *y, field(t, y)[1])
        y = ref.floats(y)
        kinds.append(kind)


# `first_root`


def expsum(*terms, poly=(0, 0, 0)):
    return ref.ExpSum(tuple(map(mp.mpf, poly)), tuple((mp.mpc(a), mp.mpc(lam)) for a, lam in terms))


def test_first_root_is_the_first():
    # (cos τ - cos 2) with a ripple that crosses zero several times near τ = 2
    g = expsum((1, 1j), (0.02, 400j), poly=(-mp.cos(2), 0, 0))
    tau = np.linspace(0, 2.1, 2_000_001)
    values = np.cos(tau) - np.cos(2) + 0.02 * np.cos(400 * tau)
    assert np.sum(np.diff(np.sign(values)) != 0) > 1
    first = tau[np.argmax(values < 0)]
    assert 0 <= first - float(g.first_root(mp.mpf(10))) < 2e-6


def test_first_root_leaves_a_surface_tangentially():
    g = expsum((-1, 1j), poly=(1, 0, 0))  # 1 - cos τ touches zero again at 2 π
    assert g.first_root(mp.mpf(6)) is None
    with pytest.raises(ref.Grazing):
        g.first_root(mp.mpf(7))


def test_first_root_tells_a_near_miss_from_two_roots():
    assert expsum((1, 1j), poly=(1 + 1e-12, 0, 0)).first_root(mp.mpf(7)) is None
    root = expsum((1, 1j), poly=(1 - 1e-12, 0, 0)).first_root(mp.mpf(7))
    assert float(mp.pi - root) == pytest.approx(np.sqrt(2e-12), rel=1e-3)


# Section 3.4


def test_stick_slip_orbit_closed_form():
    orbit = ref.stick_slip_orbit()
    assert orbit.period == pytest.approx(10 + np.pi + 2 * np.arctan(0.2), abs=1e-14)
    assert orbit.y0[0] == pytest.approx(1 + np.hypot(1, 0.2), abs=1e-15)
    (t_entry, _, x_entry, _), (t_exit, _, x_exit, _) = orbit.events
    assert (x_entry, x_exit) == (pytest.approx(0, abs=1e-15), 2)
    assert (t_entry, t_exit) == pytest.approx((np.pi + np.arctan(0.2), 10 + np.pi + np.arctan(0.2)), abs=1e-14)
    assert orbit.monodromy == pytest.approx(np.array([[0, 0], [5, 1]]), abs=1e-14)
    assert orbit.multipliers == pytest.approx([1, 0], abs=1e-14)


def test_stick_slip_saltation_matrices():
    system = ref.StickSlip(m=2.0, v_dr=0.3, F_stick=1.7)
    stick, slip = (ref.floats(e.saltation) for e in ref.simulate(system, 15, (2.5, -0.5)).events[:2])
    assert stick == pytest.approx(np.array([[1, 0], [0, 0]]), abs=1e-15)  # (3.41)
    assert slip == pytest.approx(np.array([[1, 0], [-0.7 / (2.0 * 0.3), 1]]), abs=1e-14)  # (3.43)


@pytest.mark.parametrize("parameters", [{}, dict(m=2.0, k=1.5, F_slip=1.2, F_stick=2.6)])
@pytest.mark.parametrize("t1", [1.0, 6.0, 40.0])
def test_stick_slip_final_is_the_simulation(parameters, t1):
    v_dr = np.linspace(0.1, 1.0, 5)
    exact = [ref.floats(ref.simulate(ref.StickSlip(v_dr=v, **parameters), t1, (2.5, -0.5)).y) for v in v_dr]
    assert ref.stick_slip_final(v_dr, t1, **parameters) == pytest.approx(np.array(exact), abs=3e-14)
    assert ref.stick_slip_period(0.2) == ref.stick_slip_orbit().period


def test_stick_slip_with_both_signs_of_slip():
    system, side = ref.StickSlip(c=0.1), {-1: -1, 0: -1, 1: 1}
    path = ref.simulate(system, 17.0, (5.0, 0.5))
    kinds, y = scipy_final(system, 17.0, (5.0, 0.5), side)
    assert kinds == [e.kind for e in path.events] == ["cross", "cross", "stick", "slip"]
    assert y == pytest.approx(ref.floats(path.y), abs=1e-10)
    assert ref.floats(ref.simulate(ref.StickSlip(c=0.1, v_dr=-0.2), 17.0, (-5.0, -0.5)).y) == pytest.approx(
        -ref.floats(path.y), abs=1e-15
    )


@pytest.mark.parametrize("c, y0, t1", [(0.0, (2.5, -0.5), 30.0), (0.1, (5.0, 0.5), 17.0)])
def test_stick_slip_derivative_by_extended_saltation_product(c, y0, t1):
    """The parameters (v_dr, F_slip, k) as further states: exact arcs by block exponentials, saltation at events."""
    system = ref.StickSlip(c=c)
    m, k, F = system.m, system.k, system.F_slip

    def arc(mode, y, tau):
        slips = int(mode != 0)
        A = mp.matrix([[0, 1], [-slips * k / m, -slips * system.c / m]])
        b = mp.matrix([0, -mode * F / m])
        Z = mp.eye(5)
        for i, (dA, db) in {3: (0, -mp.mpf(mode) / m), 4: (-slips / m, 0)}.items():
            block = mp.zeros(5)
            for j in range(2):
                for i2 in range(2):
                    block[j, i2] = block[2 + j, 2 + i2] = A[j, i2]
                block[2 + j, 4] = b[j]
            block[1, 2], block[1, 4] = dA, db
            E = mp.expm(tau * block)
            w = E * mp.matrix([0, 0, y[0], y[1], 1])
            Z[0, i], Z[1, i] = w[0], w[1]
        Z[:2, :2] = E[:2, :2]
        return Z

    def field(mode, x, v):
        return mp.matrix([v, (-k * x - system.c * v - mode * F) / m if mode else 0, 0, 0, 0])

    path = ref.simulate(system, t1, y0)
    t, y, Z, mode = mp.zero, tuple(map(mp.mpf, y0)), mp.eye(5), system.mode(*map(mp.mpf, y0))
    for e in path.events:
        Z = arc(mode, y, e.t - t) * Z
        new = {"stick": 0, "slip": -1, "cross": -mode}[e.kind]
        n = mp.matrix([[k, 0, system.c, 0, e.x]] if e.kind == "slip" else [[0, 1, -1, 0, 0]])
        before, after = field(mode, e.x, e.v), field(new, e.x, e.v)
        Z = (mp.eye(5) + (after - before) * n / (n * before)[0]) * Z
        t, y, mode = e.t, (e.x, e.v), new
    Z = arc(mode, y, t1 - t) * Z
    result = ref.solution(ref.StickSlip, t1, y0, wrt=("v_dr", "F_slip", "k"), c=c)
    assert result.derivative == pytest.approx(ref.floats(Z)[:2], rel=1e-13, abs=1e-13)
    assert result.derivative[:, :2] == pytest.approx(ref.floats(path.fundamental), rel=1e-13, abs=1e-13)


# Flow maps in closed form


@pytest.mark.parametrize(
    "flow, at",
    [
        (ref.crossing_flow, (0.8, 0.3, 1.1, 0.2)),
        (ref.sliding_flow, (0.1, 0.7, 0.8, 1.5, 1.0)),
        (ref.sliding_flow, (0.1, 0.7, 0.8, 1.5, 1.3)),
        (ref.impact_flow, (0.9, 0.4, 1.2, 0.7)),
    ],
)
def test_second_derivatives_by_two_routes(flow, at):
    """Central differences against `mpmath.diff`, component by component."""
    second = ref.second_derivative(lambda *p: flow(3.0, *p), *at)
    assert second == pytest.approx(second.transpose(0, 2, 1), abs=1e-15)
    point = tuple(map(mp.mpf, at))
    for i, j, k in [(0, 1, 1), (1, 1, 2), (1, 3, 3), (2, 2, 1), (0, 0, 3)]:
        order = tuple((j == n) + (k == n) for n in range(len(at)))
        assert second[i, j, k] == pytest.approx(float(mp.diff(lambda *p: flow(3.0, *p)[i], point, order)), abs=1e-9)


# Section 6.7


@pytest.mark.parametrize("v_dr", [0.2, 0.5, 1.0])
def test_damped_stick_slip_orbit(v_dr):
    orbit = ref.stick_slip_orbit(c=0.1, v_dr=v_dr)
    system = ref.StickSlip(c=0.1, v_dr=v_dr)
    kinds, y = scipy_final(system, orbit.period, orbit.y0, {-1: -1, 0: -1, 1: 1})
    assert kinds == [e[1] for e in orbit.events] == ["stick", "slip"]
    assert y == pytest.approx(orbit.y0, abs=1e-10)
    assert orbit.events[1][2] == pytest.approx(2 - 0.1 * v_dr)
    assert orbit.multipliers == pytest.approx([1, 0], abs=1e-14)
    period_map = ref.derivative(lambda x, v: ref.simulate(system, orbit.period, (x, v)).y, *orbit.y0)
    assert orbit.monodromy == pytest.approx(period_map, abs=1e-12)


def test_fold_of_the_damped_stick_slip_orbit():
    v_dr, x_top = ref.stick_slip_fold()
    assert v_dr == pytest.approx(1.1, abs=0.005)  # Fig. 6.16b
    assert ref.stick_slip_orbit(c=0.1, v_dr=v_dr + 1e-9) is None
    assert ref.stick_slip_orbit(c=0.1, v_dr=v_dr - 1e-9).y0[0] == pytest.approx(x_top, abs=1e-8)


# Section 2.4


def test_friction_curve_orbit():
    """Against DOP853 with the variational equation."""
    F_s, delta, v_dr = 1.0, 3.0, 0.2

    def field(t, z):
        q = 1 / (1 + delta * (v_dr - z[1]))
        J = np.array([[0, 1], [-1, F_s * delta * q**2]])
        return [z[1], F_s * q - z[0], *(J @ z[2:].reshape(2, 2)).ravel()]

    def arc(y, t):
        z0 = [*y, *np.eye(2).ravel()]
        return solve_ivp(field, (0, t), z0, method="DOP853", rtol=1e-13, atol=1e-14, dense_output=True)

    sol = arc((F_s, v_dr), 4.35)
    top = brentq(lambda t: sol.sol(t)[1], 0.5, 3.0, xtol=1e-15)
    entry = brentq(lambda t: sol.sol(t)[1] - v_dr, 3.0, 4.35, xtol=1e-15)
    exact_top, exact_entry = arc((F_s, v_dr), top).y[:, -1], arc((F_s, v_dr), entry).y[:, -1]
    stick = (F_s - exact_entry[0]) / v_dr
    orbit = ref.friction_curve_orbit()
    assert orbit.period == pytest.approx(entry + stick, abs=1e-9)
    assert orbit.y0 == pytest.approx(exact_top[:2], abs=1e-11)
    assert orbit.events[0][2] == pytest.approx(exact_entry[0], abs=1e-11)
    before = arc(orbit.y0, entry - top).y[2:, -1].reshape(2, 2)
    monodromy = exact_top[2:].reshape(2, 2) @ np.array([[1, stick], [0, 1]]) @ np.diag([1, 0]) @ before
    assert orbit.monodromy == pytest.approx(monodromy, abs=1e-9)
    assert orbit.multipliers == pytest.approx([1, 0], abs=1e-14)


# Section 3.5


@pytest.fixture(scope="module")
def support():
    return ref.support_orbit((-4.2, 5.6))


def test_support_orbit(support):
    system = ref.Support()
    kinds, y = scipy_final(system, support.period, support.y0, {0: -1, 1: 1})
    assert kinds == [e[1] for e in support.events] == ["contact", "release"]
    assert y == pytest.approx(support.y0, abs=1e-9)
    period_map = ref.derivative(lambda x, v: ref.simulate(system, support.period, (x, v)).y, *support.y0)
    assert support.monodromy == pytest.approx(period_map, abs=1e-13)
    # Liouville: det = exp(-c_f × time in contact / m) × det S_α S_β, and both of these are 1
    (t_contact, *_), (t_release, *_) = support.events
    assert np.linalg.det(support.monodromy) == pytest.approx(np.exp(-0.5 * (t_release - t_contact)), rel=1e-13)


def test_support_saltation_matrices(support):
    contact, release = (ref.floats(e.saltation) for e in ref.simulate(ref.Support(m=2.0), 9, (-0.5, 0.1)).events[:2])
    assert contact == pytest.approx(np.array([[1, 0], [-0.25, 1]]), abs=1e-15)  # (3.57)
    assert release == pytest.approx(np.eye(2), abs=1e-15)  # (3.61)


def test_support_without_damper_has_a_continuous_field():
    system = ref.Support(c_f=0.0, c=0.1, x_c=0.2)
    path = ref.simulate(system, 10.0, (-0.5, 0.1))
    kinds, y = scipy_final(system, 10.0, (-0.5, 0.1), {0: -1, 1: 1})
    assert kinds == [e.kind for e in path.events] and y == pytest.approx(ref.floats(path.y), abs=1e-10)
    assert all(ref.floats(e.saltation) == pytest.approx(np.eye(2), abs=1e-15) for e in path.events)


# Impacts


@pytest.mark.parametrize("t, x0, v0", [(0.3, 1.0, 0.0), (1.5, 1.3, -2.0), (4.0, 1.0, 0.0)])
def test_bouncing_ball(t, x0, v0):
    """The closed form against exact arcs with events."""
    ball = ref.bouncing_ball(t, x0, v0)

    def final(x, v, g, e):
        return ref.simulate(ref.ImpactOscillator(c=0, k=0, f_0=0, x_w=0, b=-g, e=e), t, (x, v)).y

    path = ref.simulate(ref.ImpactOscillator(c=0, k=0, f_0=0, x_w=0, b=-9.81), t, (x0, v0))
    assert ball.y == pytest.approx(ref.floats(path.y), abs=1e-13)
    assert ball.impact_times == pytest.approx([float(e.t) for e in path.events], abs=1e-14)
    assert ball.derivative == pytest.approx(ref.derivative(final, x0, v0, 9.81, 0.8, h=1e-15), rel=1e-10, abs=1e-12)
    assert ball.accumulation == pytest.approx(
        ref.bouncing_ball(4.063, 1.0).impact_times[-1] if x0 == 1 else ball.accumulation, abs=1e-3
    )
    with pytest.raises(ValueError, match="at rest"):
        ref.bouncing_ball(ball.accumulation + 1e-9, x0, v0)


@pytest.mark.parametrize("e", [0.8, 0.999])
def test_accumulation_of_the_bouncing_ball(e):
    """The closed form against the sum of the flights, the same function in double precision, and differences."""
    at = dict(x0=1.3, v0=0.4, g=9.81, e=e)
    exact = ref.bouncing_ball_accumulation(**at)
    V = mp.sqrt(mp.mpf(0.4) ** 2 + 2 * mp.mpf(9.81) * mp.mpf(1.3))
    flights = mp.nsum(lambda n: 2 * V * mp.mpf(e) ** n / mp.mpf(9.81), [1, mp.inf])
    assert abs(exact.t - (mp.mpf(0.4) + V) / mp.mpf(9.81) - flights) < 1e-25
    assert float(exact.t) == pytest.approx(ref.bouncing_ball(0.1, **at).accumulation, rel=1e-13)
    found = ref.derivative(lambda *p: [ref.bouncing_ball_accumulation(*p).t], *at.values())
    assert found[0] == pytest.approx(ref.floats(exact.derivative), rel=1e-15)


def test_ball_on_table():
    """Against DOP853 as long as impacts can be told apart, the contact force, and a table at rest."""
    ball = ref.ball_on_table()
    t, y, impacts = 0.0, np.array([1.7, 0.0]), []

    def gap(t, y):
        return y[0] - 1.2 * np.cos(t)

    gap.terminal, gap.direction = True, -1
    for _ in range(4):
        sol = solve_ivp(
            lambda t, y: [y[1], -1.0], (t, 40), y, method="DOP853", rtol=1e-12, atol=1e-13, events=gap, max_step=0.02
        )
        t, (_, v) = sol.t[-1], sol.y[:, -1]
        impacts.append(t)
        y = np.array([1.2 * np.cos(t), -1.2 * np.sin(t) - 0.4 * (v + 1.2 * np.sin(t))])
    assert impacts == pytest.approx(ref.floats(ball.impacts[:4]), abs=1e-9)
    assert 0 < ball.accumulation - ball.impacts[30] < 1e-12
    assert ball.first_impact == ball.impacts[0] and abs(ball.first_velocity + ball.first_impact) < 1e-35
    # Rest ends where gravity just holds the ball: 1.2 cos t = 1 and rising.
    assert ball.accumulation < ball.lift_off < ball.next_impact
    assert np.cos(float(ball.lift_off)) == pytest.approx(1 / 1.2) and ball.lift_off_velocity > 0
    flight = np.linspace(float(ball.lift_off), float(ball.next_impact), 1001)
    tau = flight - flight[0]
    height = 1.2 * np.cos(flight[0]) + float(ball.lift_off_velocity) * tau - tau**2 / 2 - 1.2 * np.cos(flight)
    assert np.all(height[1:-1] > 0) and abs(height[-1]) < 1e-14
    assert float(ball.next_velocity) == pytest.approx(float(ball.lift_off_velocity) - tau[-1], abs=1e-15)
    still = ref.ball_on_table(a=0, g=9.81, e=0.8, gap=1.3, v0=0.4)
    assert abs(still.accumulation - ref.bouncing_ball_accumulation(1.3, 0.4, 9.81, 0.8).t) < 1e-35
    assert still.lift_off is None


@pytest.mark.parametrize("e, t1, impacts", [(0.7, 5.0, 7), (0.85, 40.0, 20)])
def test_impacts_with_flat_roots(e, t1, impacts):
    """Slow impacts, whose roots rounding makes the less certain: Newton's method ends all the same. A start between any
    two of them goes on alike, and the wall is never passed."""
    system = ref.ImpactOscillator(e=e)
    path = ref.simulate(system, t1, (1.0, 0.0))
    assert len(path.events) == impacts
    for a, b in zip(path.events, path.events[1:]):
        assert abs(a.x - mp.mpf(0.5)) == 0 and a.v > 0
        arc = system.oscillator(0).arc(a.t, a.x, a.v)
        assert abs(arc(b.t - a.t) - mp.mpf(0.5)) < 1e-35
        assert all(arc((b.t - a.t) * k / 20) > 0.5 for k in range(1, 20))
    middle = (path.events[-1].t + path.events[-2].t) / 2
    again = ref.simulate(system, t1, ref.simulate(system, middle, (1.0, 0.0)).y, t0=middle)
    assert max(abs(p - q) for p, q in zip(again.y, path.y)) < 1e-30


def test_impact_oscillator():
    system = ref.ImpactOscillator()
    exact = ref.solution(ref.ImpactOscillator, 20.0, (0.1, 0.0), wrt=("omega", "e"))
    kinds, y = scipy_final(system, 20.0, (0.1, 0.0), {0: -1})
    assert len(kinds) == len(exact.events) == 5
    assert y == pytest.approx(exact.y, abs=1e-9)
    assert exact.derivative[:, :2] == pytest.approx(
        ref.floats(ref.simulate(system, 20.0, (0.1, 0.0)).fundamental), rel=1e-13, abs=1e-14
    )
