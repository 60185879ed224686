"""Trajectories against closed forms and 40-digit references."""

from typing import Any

import diffrax as dfx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
import reference
from models import (
    Bumper,
    CHEAP,
    Circle,
    flat,
    Hammer,
    Heat,
    itinerary,
    Motion,
    Pair,
    pid,
    Plane,
    Puck,
    Slider,
    Thermostat,
    times,
)

import nsjax
from nsjax import gallery, RESULTS, solve


def deviation(sol, ref, names):
    """From a reference solution: largest of event times, of states at events and at the end; infinite if the events are
    of other kinds."""
    if [names[e.mode_after[e.switch]] for e in sol.events] != [e[1] for e in ref.events]:
        return np.inf, np.inf
    table = np.array(ref.events, object).reshape(-1, 4)
    at_events = flat(sol.events.y_after)[: len(table)] - table[:, 2:].astype(float)
    time = np.abs(times(sol) - table[:, 0].astype(float)).max(initial=0)
    return time, np.abs([*at_events.ravel(), *(flat(sol.y1) - ref.y)]).max()


def slide(t1, x, v, **parameters):
    """All in one program."""
    return solve(Slider(**parameters), 0.0, t1, Motion(x, v), stepsize_controller=pid(1e-10), max_steps=8192)


STICK = {0: "stick", -1: "slip", 1: "slip"}


@pytest.mark.parametrize(
    "y0, parameters",
    [
        ((2.5, -0.5), dict()),
        ((2.5, -0.5), dict(v_dr=0.7, k=1.3)),
        ((0.3, 1.5), dict(c=0.1, v_dr=0.3, F_stick=1.5)),
        ((1.0, 0.0), dict(v_dr=-0.4, m=2.0, F_slip=0.7)),
    ],
)
def test_stick_slip(y0, parameters):
    """Section 3.4, static friction point: slip, stick, breakaway at F_stick; pitfalls 1, 13, 14."""
    ref = reference.solution(reference.StickSlip, 60.0, y0, **parameters)
    sol = slide(60.0, *y0, **parameters)
    names = STICK if all(e[1] != "cross" for e in ref.events) else None
    if names is None:  # a crossing leaves the other sign, as a slip does
        names = {0: "stick", -1: "slip", 1: "slip"}
        ref = ref._replace(events=[(t, "slip" if k == "cross" else k, x, v) for t, k, x, v in ref.events])
    assert max(deviation(sol, ref, names)) < 3e-9
    sticks = flat(sol.events.y_after)[: len(sol.events)]
    np.testing.assert_allclose(sticks[:, 1], parameters.get("v_dr", 0.2), atol=1e-13)


def test_stick_slip_from_every_kind_of_start():
    """Pitfall 2: starts on the surface, which stick, slip either way, or lie at the very end of stick."""
    # At (2, 0.2), the end of stick, it sticks for zero time; the reference starts an ulp later.
    cases = {(0.5, 0.2): 0, (-1.9, 0.2): 0, (2.5, 0.2): -1, (-2.5, 0.2): 1, (2.5, 0.3): 1, (2.0, 0.2): None}
    for start, mode in cases.items():
        sol = slide(20.0, *start)
        assert mode in (None, int(sol.mode0[0])), start
        ref = reference.solution(reference.StickSlip, 20.0, start if mode is not None else (2 + 1e-15, 0.2))
        assert mode is None or len(sol.events) == len(ref.events)
        np.testing.assert_allclose(flat(sol.y1), ref.y, atol=1e-8)


UNITS = 10.0 ** np.array([0.0, -12.0, -6.0, 6.0, 12.0])
BESIDE = 0.2 + np.array([0.0, np.spacing(0.2), -np.spacing(0.2), 1e-9, -1e-9])


@pytest.fixture(scope="module")
def in_units():
    """The belt with h in all of `UNITS`, as rows: from above it for a time of 30, and from `BESIDE` it for one of 5."""

    def run(scale, x, v, t1):
        sol = slide(t1, x, v, scale=scale)
        return int(sol.events.num), int(sol.mode0[0]), flat(sol.y1)

    starts = [(2.5, -0.5, 30.0), *((0.5, v, 5.0) for v in BESIDE)]
    rows = [run(scale, *start) for scale in UNITS for start in starts]
    return [np.reshape(x, (len(UNITS), len(starts), *np.shape(x)[1:])) for x in zip(*rows)]


def test_scale_of_the_indicator_function_does_not_matter(in_units):
    """Pitfall 27: h multiplied by 1e-12 ... 1e12."""
    num, _, y = (x[:, 0] for x in in_units)
    assert np.all(num == num[0]) and num[0] > 3
    np.testing.assert_allclose(y, np.tile(y[:1], (5, 1)), atol=1e-12)


def test_scale_does_not_matter_on_the_surface(in_units):
    """Pitfall 27: who starts on the surface, apart from an ulp, is on it in every unit of h, and who starts beside it not."""
    _, mode, y = (x[:, 1:] for x in in_units)
    np.testing.assert_array_equal(mode, [[0, 0, 0, 1, -1]] * 5)
    np.testing.assert_allclose(y, np.tile(y[:1], (5, 1, 1)), atol=1e-12)


class Ring(Circle):
    """The circle with h in other units."""

    scale: float = 1.0

    @nsjax.sgn
    def circle(self, t, y):
        return self.scale * (y.x**2 + y.y**2 - 1)


def ring(t1, scale=1.0):
    return solve(Ring(scale=scale), 0.0, t1, Plane(1.5, 0.0), stepsize_controller=pid(1e-9), max_steps=100_000)


@pytest.mark.slow
def test_scale_of_a_surface_that_is_not_affine():
    """Pitfall 27: a polynomial stands for h to a fraction of h, whatever its unit."""
    rings = [ring(3.0, scale) for scale in (1.0, 1e-12, 1e12)]
    assert all(len(sol.events) == 1 for sol in rings)
    assert len({int(sol.stats["num_steps"]) for sol in rings}) == 1
    for sol in rings[1:]:
        np.testing.assert_allclose(flat(sol.y1), flat(rings[0].y1), atol=1e-12)


def test_long_sliding_does_not_drift():
    """Pitfall 14: 1000 time units on a circle, a surface which is not affine."""
    sol = ring(1000.0)
    (met,), y1 = times(sol), flat(sol.y1)
    r = 1.5 * np.exp(0.5 * (1 - np.cos(met)) - met)
    np.testing.assert_allclose(r, 1, atol=1e-8)
    np.testing.assert_allclose(y1, [np.cos(1000), np.sin(1000)], atol=1e-5)
    assert abs(np.hypot(*y1) - 1) < 1e-15 * 4


class Season(nsjax.System):
    """A field, a surface and a ceiling with a reset, all of which depend on time; `d = -1` runs it backwards."""

    d: float = 1.0

    def vector_field(self, t, y, s):
        return Motion(self.d * y.v, self.d * (jnp.sin(self.d * t) - 0.3 * y.x - 0.5 * s.moving))

    @nsjax.sgn
    def moving(self, t, y):
        return y.x - 0.5 * jnp.sin(self.d * t)

    @nsjax.impact
    def ceiling(self, t, y):
        return 1.2 + 0.2 * jnp.sin(self.d * t + 0.4) - y.x

    @ceiling.reset
    def ceiling(self, t, y):
        return self.rebound(t, y, 0.6**self.d)

    @ceiling.inverse
    def ceiling(self, t, y):
        return self.rebound(t, y, 0.6**-self.d)

    def rebound(self, t, y, e):
        return Motion(y.x, (1 + e) * 0.2 * jnp.cos(self.d * t + 0.4) - e * y.v)


def test_backwards_in_a_time_that_matters():
    """Pitfall 33: from 7 to 0 is from -7 to 0 in the system with time reversed, also for what depends on time."""
    back = solve(Season(), 7.0, 0.0, Motion(0.9, 0.5))
    same = solve(Season(d=-1.0), -7.0, 0.0, Motion(0.9, 0.5))
    assert {e.switch for e in same.events} == {"moving", "ceiling"}
    np.testing.assert_allclose(times(back), -times(same), atol=1e-9)
    assert itinerary(back) == itinerary(same)
    np.testing.assert_allclose(flat(back.y1), flat(same.y1), atol=1e-9)


def test_reset_without_an_inverse_is_not_run_backwards():
    """The state before a reset is not told by the one after it."""

    class Valve(nsjax.System):
        def vector_field(self, t, y, s):
            return Motion(y.v, jnp.asarray(-1.0))

        @nsjax.impact
        def seat(self, t, y):
            return y.x

        @seat.reset
        def seat(self, t, y):
            return Motion(y.x, -0.5 * y.v)

    with pytest.raises(ValueError, match="`Valve.seat` has a reset.*`@seat.inverse`"):
        solve(Valve(), 1.0, 0.0, Motion(1.0, 0.0))
    with pytest.raises(Exception, match="`Valve.seat` has a reset"):
        jax.jit(lambda t1: solve(Valve(), 1.0, t1, Motion(1.0, 0.0), **CHEAP).y1)(0.0)


@pytest.mark.slow
def test_support():
    """Section 3.5: a surface with a corner, entered at x = x_c and left at vanishing contact force."""
    for omega, y0 in ((1.4, (1.0, 0.3)), (0.6, (-2.0, 1.0))):
        ref = reference.solution(reference.Support, 50.0, y0, omega=omega, x_c=0.1)
        system = gallery.DiscontinuousSupport(omega=omega, x_c=0.1, k_f=4.0, c_f=0.5, f_0=1.0, m=1.0, k=1.0)
        sol = solve(system, 0.0, 50.0, Motion(*y0), stepsize_controller=pid(1e-10), max_steps=8192)
        assert max(deviation(sol, ref, {1: "contact", -1: "release"})) < 1e-8


@pytest.mark.parametrize("e", [0.9, 0.95])
def test_impact_oscillator(e):
    """Newton's restitution; and pitfall 33: backwards in time to where it came from (e -> 1/e)."""
    ref = reference.solution(reference.ImpactOscillator, 40.0, (1.0, 0.0), e=e)
    run = dict(stepsize_controller=pid(1e-10), max_steps=8192)
    sol = solve(Hammer(e=e), 0.0, 40.0, Motion(1.0, 0.0), **run)
    assert max(deviation(sol, ref, {0: "impact"})) < 1e-7
    assert len(sol.events) >= 10
    back = solve(Hammer(e=e), 40.0, 0.0, sol.y1, **run)
    # Backwards the dissipation is growth.
    np.testing.assert_allclose(flat(back.y1), [1.0, 0.0], atol=1e-5)
    np.testing.assert_allclose(times(back), times(sol)[::-1], atol=1e-5)


def test_ball_does_not_fall_through_the_floor():
    """Pitfall 4: 30 bounces with dt0 = 1e-2, the last flights far shorter than that."""
    t1 = reference.bouncing_ball(3.6, e=0.8).accumulation - 0.004
    ref = reference.bouncing_ball(t1, e=0.8)
    assert len(ref.impact_times) >= 27
    sol = solve(gallery.BouncingBall(e=0.8), 0.0, t1, Motion(1.0, 0.0), dt0=1e-2)
    np.testing.assert_allclose(times(sol), ref.impact_times, atol=1e-12)
    np.testing.assert_allclose(flat(sol.y1), ref.y, atol=1e-12)
    assert np.all(np.asarray(sol.events.y_after.x)[: len(sol.events)] > -1e-15)


def relay_times(p, T, t1):
    """Switching times of the thermostat from below T_high, on."""
    t, on, out = 0.0, True, []
    while True:
        rest, goal = p.T_env + 30 * on, p.T_high if on else p.T_low
        t += np.log((T - rest) / (goal - rest)) / p.a
        if t > t1:
            return np.array(out)
        out.append(t)
        T, on = goal, not on


def test_thermostat():
    """A relay with hysteresis, closed form; it starts between its surfaces, on by `mode`."""
    p = Thermostat(a=0.7)
    sol = solve(p, 0.0, 10.0, Heat(20.0), mode={"heater": 1}, stepsize_controller=pid(1e-10))
    exact = relay_times(p, 20.0, 10.0)
    np.testing.assert_allclose(times(sol), exact, atol=1e-8)
    assert itinerary(sol) == [("heater", 1 - i % 2, i % 2) for i in range(len(exact))]


def test_relay_without_hysteresis_is_told():
    chatters = Thermostat(T_high=18.0)
    how = dict(mode={"heater": 1}, stepsize_controller=pid(1e-10))
    sol = solve(chatters, 0.0, 10.0, Heat(16.0), **how, throw=False)
    assert sol.result == RESULTS.stuck_in_events
    with pytest.raises(nsjax.SolveError, match=r"where these fired: \d+ heater\.\)"):
        solve(chatters, 0.0, 10.0, Heat(16.0), **how)


class Stiffened(nsjax.System):
    """An oscillator that is stiffer beyond x = 0.3, without a jump of its force; by a relay whose two levels are the
    same, which is crossed and does not chatter."""

    w: Any

    def vector_field(self, t, y, s):
        return y[1], self.w**2 * (-y[0] - 0.5 * s.beyond * (y[0] - 0.3))

    @nsjax.relay
    def beyond(self, t, y):
        return y[0] - 0.3

    @beyond.off
    def beyond(self, t, y):
        return 0.3 - y[0]


@pytest.mark.parametrize("map_lanes", [nsjax.sweep, lambda fn, w: jax.jit(jax.vmap(fn))(w)])
def test_relay_whose_levels_are_the_same_is_crossed(map_lanes):
    """At late times the state on its surface has the rounding of the time. Energy is conserved, and both parts of a
    period are known: at x = 0.3 the speed is v, the rest of the way a quarter of a harmonic motion and what is before."""

    def end(w):
        sol = solve(Stiffened(w), 0.0, 200.0, (0.0, 2 * w), max_steps=2**14, throw=False)
        return sol.result, sol.events.num, sol.y1

    w = np.linspace(0.5, 3.0, 20)
    result, number, (x, v) = map_lanes(end, jnp.asarray(w))
    assert np.all(np.asarray(result == RESULTS.successful))
    # Around its middle at x = 0.1 the stiffer oscillator has the frequency sqrt(1.5) w.
    fast, speed = np.sqrt(1.5) * w, np.sqrt(4 - 0.3**2) * w
    begin = np.arcsin(0.15) / w
    beyond = 2 / fast * np.arctan2(speed, fast * 0.2)
    period = np.pi / w + 2 * begin + beyond
    laps = np.floor((200.0 - begin) / period)
    rest = 200.0 - begin - laps * period
    np.testing.assert_array_equal(number, 2 * laps + 1 + (rest > beyond))
    energy = v**2 / 2 + w**2 * (x**2 / 2 + 0.25 * np.maximum(x - 0.3, 0) ** 2)
    np.testing.assert_allclose(energy, 2 * w**2, rtol=1e-5)


# Section 2.1: fields are constant on both sides, for which one step of Euler's method is exact.

ONE_STEP = dict(solver=dfx.Euler(), stepsize_controller=dfx.ConstantStepSize(), dt0=10.0)


def test_transversal_intersection():
    """Example 2.1: (4 t, ...) crosses x2 = c once."""
    sol = solve(gallery.TransversalIntersection(), 0.0, 2.0, _plane(0.0, 2.0), **ONE_STEP)
    np.testing.assert_allclose(times(sol), [0.5], atol=1e-14)
    np.testing.assert_allclose(flat(sol.y1), [6 * 0.5 + 2 * 1.5, 1 - 6 * 1.5], atol=1e-13)


def _plane(x1, x2):
    return type(gallery.THESIS["example 2.2"].y0)(x1, x2)


def test_attraction_sliding():
    """Example 2.2: slides with x1' = 5 from where it meets x2 = c, (2.19)-(2.20)."""
    sol = solve(gallery.AttractionSliding(), 0.0, 3.0, _plane(0.0, 3.0), **ONE_STEP)
    np.testing.assert_allclose(times(sol), [1.0], atol=1e-14)
    assert itinerary(sol) == [("surface", 1, 0)]
    np.testing.assert_allclose(flat(sol.y1), [6 + 5 * 2, 1.0], atol=1e-13)


def test_repulsion_sliding():
    """Example 2.3, (2.25): not unique unless `mode` says which; then any of the three."""
    problem = gallery.RepulsionSliding(), 0.0, 1.0, _plane(0.0, 1.0)
    sol = solve(*problem, throw=False, **ONE_STEP)
    assert sol.result == RESULTS.repulsive_sliding
    with pytest.raises(Exception, match="not unique"):
        solve(*problem, **ONE_STEP)
    for mode, end in ((0, (-5.0, 1.0)), (1, (-6.0, 3.0)), (-1, (-2.0, -5.0))):
        sol = solve(*problem, mode={"surface": jnp.asarray(mode)}, **ONE_STEP)
        np.testing.assert_allclose(flat(sol.y1), end, atol=1e-13)
        assert len(sol.events) == 0 and sol.mode1[0] == mode


@pytest.mark.slow
def test_points_of_one_dimension():
    """(2.3), examples 2.4 and 2.5: rest at x = 0; leave it; stay on it if told to."""
    line = type(gallery.THESIS["(2.3)"].y0)
    sol = solve(gallery.SlidingPoint(), 0.0, 5.0, line(2.0))
    np.testing.assert_allclose(times(sol), [2.0], atol=1e-14)
    assert sol.y1.x == 0
    assert solve(gallery.RepellingPoint(), 0.0, 1.0, line(0.0), throw=False).result == RESULTS.repulsive_sliding
    sol = solve(gallery.StickingPoint(), 0.0, 1.0, line(0.0), throw=False)
    assert sol.result == RESULTS.repulsive_sliding  # x = 3 t starts there too
    sol = solve(gallery.StickingPoint(), 0.0, 1.0, line(0.0), mode={"surface": 0}, throw=False)
    assert sol.result == RESULTS.successful and sol.y1.x == 0 and sol.mode1[0] == 0
    np.testing.assert_allclose(solve(gallery.StickingPoint(), 0.0, 1.0, line(1.0)).y1.x, 4.0, atol=1e-13)


# Several surfaces.


def pair_exact(p, t1):
    """The coupled pair from (1, 2): x slides from t_a, both slide from t_b, x leaves at t_c."""
    w, g, c = float(p.w), float(p.g), float(p.c)
    t_a = min(r.real for r in np.roots([w / 2, -2 - c, 1]) if r.real > 0)
    # Then λ_x = (w t - c) / 2 and y' = g - 2 - c λ_x.
    slope, bend = g - 2 + c * c / 2, -c * w / 4
    y = 2 + (g - c - 2) * t_a
    t_b = min(r.real for r in np.roots([bend, slope, y - slope * t_a - bend * t_a**2]) if r.real > t_a)
    det = 4 - c * c
    t_c = (det + c * g) / (2 * w)
    # Then y slides with λ_y = (g - c) / 2 and x' = w t - 2 - c λ_y, which starts from zero.
    x = w / 2 * (t1 - t_c) ** 2
    return [t_a, t_b, t_c], [x, 0.0]


@pytest.mark.parametrize("c", [0.0, 0.5])
def test_sliding_on_two_surfaces(c):
    """Pitfall 15: on one surface, on the intersection of two, and tangentially off one of them."""
    p = Pair(c=c)
    t, y = pair_exact(p, 26.0)
    sol = solve(p, 0.0, 26.0, Plane(1.0, 2.0), stepsize_controller=pid(1e-10))
    assert itinerary(sol) == [("a", 1, 0), ("b", 1, 0), ("a", 0, 1)]
    np.testing.assert_allclose(times(sol), t, atol=1e-10)
    np.testing.assert_allclose(flat(sol.y1), y, atol=1e-9)


def test_two_surfaces_met_at_one_instant():
    """Pitfall 7: x and y reach zero together, and both slide from there."""
    p = Pair(w=0.0, g=0.0, c=0.5)
    sol = solve(p, 0.0, 2.0, Plane(1.0, 1.0), stepsize_controller=pid(1e-10))
    np.testing.assert_allclose(times(sol), 0.4, atol=1e-13)
    assert np.all(sol.mode1 == 0)
    np.testing.assert_allclose(flat(sol.y1), 0, atol=1e-14)


# Impacts, friction, a relay and a clock together.


@pytest.fixture(scope="module")
def puck():
    return solve(Bumper(), 0.0, 4.0, Puck(0.0, 1.0, 0.0), stepsize_controller=pid(1e-10))


def puck_exactly(t_c):
    """The state at t = 4 and the events, (name, time), with the clock at t_c."""
    x, v, t, mu = 0.0, 1.0, 0.0, 0.1
    events, motor, on = [], 0.0, 1
    while True:
        a = -mu * (1.0 if t < t_c else 2.0) * np.sign(v)
        candidates = [("clock", t_c - t)] if t < t_c else []
        gap = np.sign(v) - x
        tau = (np.sqrt(v * v + 2 * a * gap) - abs(v)) / a * np.sign(v) if v * v + 2 * a * gap > 0 else np.inf
        candidates += [("wall", tau), ("stop", -v / a), ("end", 4 - t)]
        name, tau = min(candidates, key=lambda c: c[1])
        x, v, t, motor = x + v * tau + a * tau**2 / 2, v + a * tau, t + tau, motor + on * tau
        if name == "end":
            return [x, v, motor], events
        events.append((name, t))
        assert name != "stop"
        if name == "wall":
            v = -0.9 * v
            on = 1 if v > 0.5 else 0 if v < -0.5 else on


@pytest.mark.slow
def test_impacts_flip_friction_and_relay(puck):
    """Pitfalls 12, 35: an impact reverses v, hence friction's sign and the relay, at the same instant."""
    sol = puck
    end, events = puck_exactly(2.0)
    np.testing.assert_allclose(flat(sol.y1), end, atol=1e-9)
    walls = [(e.switch, float(e.t)) for e in sol.events if e.switch in ("left", "right")]
    np.testing.assert_allclose([t for _, t in walls], [t for n, t in events if n == "wall"], atol=1e-9)
    for e in sol.events:
        if e.switch in ("left", "right"):
            assert e.mode_after["rub"] == -e.mode_before["rub"] != 0


@pytest.mark.slow
@pytest.mark.parametrize("t_c", [0.8, 10 - np.sqrt(80)])
def test_clock_and_wall_in_one_step(t_c):
    """Pitfall 12: the clock strikes on the step that would meet the wall, shortly before the wall or with it."""
    sol = solve(Bumper(t_c=t_c), 0.0, 4.0, Puck(0.0, 1.0, 0.0), stepsize_controller=pid(1e-10))
    end, events = puck_exactly(t_c)
    assert [e[0] for e in events][:2] == ["clock", "wall"]
    np.testing.assert_allclose(flat(sol.y1), end, atol=1e-9)
    clock = [float(e.t) for e in sol.events if e.mode_after["clock"] != e.mode_before["clock"]]
    np.testing.assert_allclose(clock, [t_c], atol=1e-12)


@pytest.mark.slow
@pytest.mark.parametrize("order", [(4, 3, 2, 1, 0), (2, 0, 4, 1, 3)])
def test_order_of_declaration_does_not_matter(puck, order):
    """Pitfall 32."""
    sol = solve(Bumper(order=order), 0.0, 4.0, Puck(0.0, 1.0, 0.0), stepsize_controller=pid(1e-10))
    np.testing.assert_allclose(flat(sol.y1), flat(puck.y1), atol=1e-12)
    assert len(sol.events) == len(puck.events)
    np.testing.assert_allclose(times(sol), times(puck), atol=1e-12)
