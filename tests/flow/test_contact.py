"""Impacts to the end: accumulation, rest, sliding with the contact's own force, lift-off."""

from typing import NamedTuple

import diffrax as dfx
import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
import reference
from jaxtyping import Array
from models import flat, Motion, pid, TableBall

import nsjax
from nsjax import gallery, RESULTS, solve


Ball = gallery.BouncingBall
TIGHT = dict(stepsize_controller=pid(1e-12))
MANY = dict(max_steps=40_000, max_events=12_000)


def accumulation(e, g, x):
    return jnp.sqrt(2 * x / g) * (1 + e) / (1 - e)


def last_event(sol):
    return sol.events.t[sol.events.num - 1]


def test_ball_comes_to_rest():
    """Pitfall 16: infinitely many impacts lead to rest at the closed form's time; the derivative goes through them."""

    def at_rest(e, g, x):
        t = last_event(solve(Ball(e=e, g=g), 0.0, 5.0, Motion(x, jnp.zeros_like(x))))
        return t, t

    parameters = (0.8, 9.81, 1.0)
    derivative, t = jax.jacfwd(at_rest, argnums=(0, 1, 2), has_aux=True)(*map(jnp.asarray, parameters))
    np.testing.assert_allclose(t, accumulation(*parameters), rtol=1e-12)
    np.testing.assert_allclose(derivative, jax.grad(accumulation, argnums=(0, 1, 2))(*parameters), rtol=1e-8)


class Flat(nsjax.System):
    """The same ball with its state in one array, and its equation of motion in matrices."""

    inverse: Array  # of the mass matrix
    e: float = 0.8

    def vector_field(self, t, y, s):
        force = jnp.stack([-9.81 * 2 + s.floor])
        return jnp.concatenate([y[1:], self.inverse @ force])

    @nsjax.impact
    def floor(self, t, y):
        return y[0]

    @floor.restitution
    def floor(self):
        return self.e


@pytest.mark.slow
def test_state_in_one_array():
    """That dh/dt is no function of the contact force is seen entry by entry."""
    sol = solve(Flat(jnp.eye(1) / 2), 0.0, 5.0, jnp.array([1.0, 0.0]))
    assert sol.result == RESULTS.successful and sol.mode1 == 1
    np.testing.assert_allclose(last_event(sol), accumulation(0.8, 9.81, 1.0), rtol=1e-10)


def test_ball_that_hardly_loses_speed():
    """Pitfall 16: eleven thousand impacts before the rest."""
    sol = solve(Ball(e=0.999), 0.0, 1000.0, Motion(1.0, 0.0), **MANY)
    np.testing.assert_allclose(last_event(sol), accumulation(0.999, 9.81, 1.0), atol=1e-9)
    assert sol.mode1 == 1 and np.all(flat(sol.y1) == 0)


@pytest.mark.parametrize("x", [0.0, 1.0])
def test_plastic_impact(x):
    """Pitfalls 2, 16: e = 0 rests at the first impact; who starts at rest has none."""
    sol = solve(Ball(e=0.0), 0.0, 5.0, Motion(x, 0.0), **MANY)
    assert len(sol.events) == (x > 0) and sol.mode1 == 1
    np.testing.assert_allclose(sol.events.t[:1], np.sqrt(2 * x / 9.81) if x else np.inf, rtol=1e-12)
    np.testing.assert_allclose(flat(sol.y1), 0, atol=1e-15)


class Rising(nsjax.System):
    """A mass on the floor, pulled by a force that grows: lifts off at t = m g / r."""

    m: float = 2.0
    g: float = 9.81
    r: float = 10.0
    sign: float = 1.0  # -1: the floor pulls

    def vector_field(self, t, y, s):
        return Motion(y.v, -self.g + (self.r * t + self.sign * s.floor) / self.m)

    @nsjax.impact
    def floor(self, t, y):
        return y.x

    @floor.restitution
    def floor(self):
        return 0.5


def test_lift_off():
    """Where the contact force vanishes h, dh/dt and d²h/dt² are all zero: no false impact on the next step."""
    p, t1 = Rising(), 3.0
    start = p.m * p.g / p.r

    def end(g):
        sol = solve(Rising(g=g), 0.0, t1, Motion(0.0, 0.0), **TIGHT)
        return jnp.stack(sol.y1), sol

    _, derivative, sol = jax.jvp(end, (jnp.asarray(p.g),), (jnp.ones(()),), has_aux=True)
    assert len(sol.events) == 1 and sol.events[0].mode_after == {"floor": 0}
    np.testing.assert_allclose(last_event(sol), start, rtol=1e-12)
    free = t1 - start
    np.testing.assert_allclose(flat(sol.y1), [p.r / p.m * free**3 / 6, p.r / p.m * free**2 / 2], rtol=1e-11)
    np.testing.assert_allclose(derivative, [-(free**2) / 2, -free], rtol=1e-9)


@pytest.mark.slow
def test_ball_on_an_oscillating_table():
    """Pitfalls 14, 16: against 40 digits, the times of landing, rest, lift-off and the next landing."""
    ref = reference.ball_on_table()
    few = dict(solver=dfx.Dopri8(), **TIGHT)  # steps, each of which rounds
    sol = solve(TableBall(), 0.0, 9.0, Motion(1.7, 0.0), saveat=dfx.SaveAt(steps=True), **few)
    events = list(sol.events)
    rest = [i for i, e in enumerate(events) if e.mode_after["table"] == 1][0]
    times = [float(events[i].t) for i in (0, rest, rest + 1, rest + 2)]
    want = [ref.first_impact, ref.accumulation, ref.lift_off, ref.next_impact]
    np.testing.assert_allclose(times, [float(t) for t in want], atol=1e-9)
    np.testing.assert_allclose(events[rest + 2].y_before.v, float(ref.next_velocity), atol=1e-9)
    resting = np.asarray(sol.modes[:, 0]) == 1
    gap = np.asarray(sol.ys.x)[resting] - 1.2 * np.cos(np.asarray(sol.ts)[resting])
    assert resting.sum() > 3 and np.max(np.abs(gap)) < 1e-14


@pytest.mark.slow
def test_ball_on_a_table_late():
    """Pitfalls 16, 28: after 1e6 time units flights are not taken for short because the time is long."""
    ref = reference.ball_on_table()
    t0 = float(2 * np.pi * 159155)
    sol = solve(TableBall(), t0, t0 + 4.0, Motion(1.7, 0.0), **TIGHT)
    rest = [e for e in sol.events if e.mode_after["table"] == 1][0]
    np.testing.assert_allclose(
        [sol.events.t[0] - t0, rest.t - t0], [float(ref.first_impact), float(ref.accumulation)], atol=1e-8
    )


def test_lift_off_at_a_loose_tolerance():
    """The step to the event drifts by 1e-7 below the table; the flight sets out from the table all the same."""
    sol = solve(TableBall(), 0.0, 9.0, Motion(1.7, 0.0), stepsize_controller=pid(1e-4))
    off = [e for e in sol.events if e.mode_before["table"] == 1]
    assert len(off) == 1
    np.testing.assert_allclose(off[0].y_before.x, 1.2 * np.cos(off[0].t), atol=1e-15)
    np.testing.assert_allclose(off[0].y_before.v, -1.2 * np.sin(off[0].t), atol=1e-15)


class Thrown(NamedTuple):
    x: Array
    z: Array
    u: Array
    v: Array


class Block(nsjax.System):
    """Thrown onto a floor with Coulomb friction: the contact force times the friction's sign, multi-affine."""

    mu: float = 0.3
    g: float = 9.81
    e: float = 0.5
    push: float = 0.0
    lift: float = 0.0  # a force that grows

    def vector_field(self, t, y, s):
        return Thrown(y.u, y.v, self.push - self.mu * s.floor * s.slide, self.lift * t - self.g + s.floor)

    @nsjax.impact
    def floor(self, t, y):
        return y.z

    @floor.restitution
    def floor(self):
        return self.e

    @nsjax.sgn
    def slide(self, t, y):
        return y.u


def block(p, u, z):
    """Times of rest and of sticking, final x: friction takes its share μ of every impulse, then of the weight."""
    fall, speeds = np.sqrt(2 * z / p.g), []
    v, x = p.g * fall, u * fall
    while v > 1e-17:
        u, v = u - p.mu * (1 + p.e) * v, p.e * v
        speeds.append(u)
        x += u * 2 * v / p.g
    rest = accumulation(p.e, p.g, z)
    return rest, rest + u / (p.mu * p.g), x + u**2 / (2 * p.mu * p.g)


@pytest.mark.slow
def test_friction_by_the_contact_force():
    """Contact together with friction on another coordinate: bounces, rests, slides, sticks."""
    p, u, z = Block(), 5.0, 0.5
    rest, stop, x = block(p, u, z)
    sol = solve(p, 0.0, 5.0, Thrown(0.0, z, u, 0.0), **TIGHT)
    modes = [tuple(e.mode_after.values()) for e in sol.events]
    assert modes[-2:] == [(1, 1), (1, 0)] and set(modes[:-2]) == {(0, 1)}
    np.testing.assert_allclose(sol.events.t[len(sol.events) - 2 : len(sol.events)], [rest, stop], rtol=1e-10)
    np.testing.assert_allclose(flat(sol.y1), [x, 0, 0, 0], atol=1e-10)
    # The impulse of friction ends the sliding, it does not turn it round.
    slow = solve(p, 0.0, 5.0, Thrown(0.0, z, 1.0, 0.0), **TIGHT)
    assert np.all(np.abs(slow.events.y_after.u[: len(slow.events)]) < 1e-15)
    np.testing.assert_allclose(slow.y1.x, np.sqrt(2 * z / p.g), rtol=1e-12)


@pytest.mark.slow
def test_lift_off_without_sliding():
    """A block that sticks takes off: where there is no contact force there is no friction to hold it, nor need for it."""
    sol = solve(Block(lift=9.81), 0.0, 1.5, Thrown(0.3, 0.0, 0.0, 0.0), **TIGHT)
    assert [tuple(e.mode_after.values()) for e in sol.events] == [(0, 0)]
    np.testing.assert_allclose(flat(sol.y1), [0.3, 9.81 / 48, 0, 9.81 / 8], atol=1e-12)


@pytest.mark.slow
def test_fundamental_matrix_through_rest():
    """Two routes, while it slides at rest and after it sticks."""
    y0, ts = Thrown(0.0, 0.5, 5.0, 0.0), jnp.array([1.2, 5.0])
    formula = nsjax.fundamental_matrix(Block(), 0.0, 5.0, y0, ts=ts, solver=dfx.Tsit5())
    autodiff = nsjax.fundamental_matrix(Block(), 0.0, 5.0, y0, ts=ts, solver=dfx.Tsit5(), method="autodiff")
    np.testing.assert_allclose(formula, autodiff, atol=1e-6)
    np.testing.assert_allclose(autodiff[:, 1::2], 0, atol=1e-12)  # z and its rate are known
    d = 1e-6
    x = [block(Block(), 5.0 + a, 0.5 + b)[2] for a, b in [(0, d), (0, -d), (d, 0), (-d, 0)]]
    np.testing.assert_allclose(autodiff[1, 0, :3], [1, (x[0] - x[1]) / 2 / d, (x[2] - x[3]) / 2 / d], rtol=1e-6)
    np.testing.assert_allclose(autodiff[1, 2], 0, atol=1e-12)


class Stack(nsjax.System):
    """Two balls above each other on a floor."""

    e: float = 0.0
    m: float = 2.0  # of the upper one; the lower one has 1
    g: float = 1.0

    def vector_field(self, t, y, s):
        return Thrown(y.u, y.v, -self.g + s.floor - s.between, -self.g + s.between / self.m)

    @nsjax.impact
    def floor(self, t, y):
        return y.x

    @nsjax.impact
    def between(self, t, y):
        return y.z - y.x

    @floor.restitution
    def floor(self):
        return self.e

    @between.restitution
    def between(self):
        return self.e


@pytest.mark.slow
def test_two_contacts():
    """The lower ball lands and rests, then the upper one on it; both stay, without drift."""
    sol = solve(Stack(), 0.0, 1000.0, Thrown(0.5, 1.0, 0.0, 0.0), **TIGHT)
    assert [tuple(e.mode_after.values()) for e in sol.events] == [(1, 0), (1, 1)]
    np.testing.assert_allclose(sol.events.t[:2], [1.0, np.sqrt(2)], rtol=1e-12)
    np.testing.assert_allclose(flat(sol.y1), 0, atol=1e-14)


class Relaxed(nsjax.System):
    """A spring that has its natural length at the stop."""

    k: float
    a: float

    def vector_field(self, t, y, s):
        return Motion(y.v, -self.k * y.x + self.k * self.a + s.stop)

    @nsjax.impact
    def stop(self, t, y):
        return y.x - self.a

    @stop.restitution
    def stop(self):
        return 0.0


@pytest.mark.slow
def test_rest_without_force():
    """After a plastic impact nothing moves and no force acts, apart from their rounding, whatever its sign."""

    @jax.jit
    @jax.vmap
    def run(k, a):
        sol = solve(Relaxed(k=k, a=a), 0.0, 8.0, Motion(a, jnp.asarray(0.1)), throw=False)
        return sol.result == RESULTS.successful, sol.mode1[0], sol.events.num, sol.y1.x - a

    k, a = np.random.default_rng(0).uniform(0.3, 1, (2, 64))
    good, mode, num, gap = run(jnp.asarray(k), jnp.asarray(a))
    assert np.all(good) and np.all(mode == 1) and np.all(num == 1)
    np.testing.assert_allclose(gap, 0, atol=1e-15)


class Bar(nsjax.System):
    """Height x and tilt z of a bar on a support under either end."""

    e: float
    l: float
    J: float = 4.0

    def vector_field(self, t, y, s):
        return Thrown(y.u, y.v, -1.0 + s.left + s.right, self.l * (s.right - s.left) / self.J)

    @nsjax.impact
    def left(self, t, y):
        return y.x - self.l * y.z

    @nsjax.impact
    def right(self, t, y):
        return y.x + self.l * y.z

    @left.restitution
    def left(self):
        return self.e

    @right.restitution
    def right(self):
        return self.e


@pytest.mark.slow
def test_flat_landing():
    """Both ends arrive at one instant, each above or below its support by rounding. The first impact opens the other
    contact, which then has none (e = 0.9), or the bar rocks to rest (e = 0), whatever the height."""

    @jax.jit
    @jax.vmap
    def run(x, e, l, t1):
        sol = solve(Bar(e=e, l=l), 0.0, t1, Thrown(x, 0 * x, 0 * x, 0 * x), throw=False, **TIGHT)
        return sol.result == RESULTS.successful, sol.y1, sol.events.num, sol.events.t, sol.mode1

    c = np.tile(np.sqrt(2 * np.random.default_rng(0).uniform(1, 2, 32)), 2)  # speed, and time, of the fall
    e, l, t1 = np.repeat([[0.9, 0.0], [0.5, 1.8], [1.2, 2.0]], 32, axis=1)
    good, y1, num, t, mode = run(*map(jnp.asarray, (c**2 / 2, e, l, t1 * c)))
    assert np.all(good)
    free, rocks = e > 0, e == 0
    assert np.all(num[free] == 1) and np.all(mode[rocks] == 1)
    impulse, after = (1.9 * c / (1 + 0.25 / 4))[free], 0.2 * c[free]
    end = [(impulse - c[free] - after / 2) * after, -impulse / 8 * after, impulse - c[free] - after, -impulse / 8]
    np.testing.assert_allclose(np.stack([*y1])[:, free], end, atol=1e-11)
    np.testing.assert_allclose(np.stack([*y1])[:, rocks], 0, atol=1e-14)
    # Rates of opening shrink by `ratio`, while the other end rests: a geometric series of flights.
    ratio, pull = (4 - 1.8**2) / (4 + 1.8**2), 2 * 1.8**2 / (4 + 1.8**2)
    rest = np.take_along_axis(t, num[:, None] - 1, axis=1)[rocks, 0]
    np.testing.assert_allclose(rest, c[rocks] * (1 + 2 * ratio / pull), rtol=2e-8)


def test_accumulation_on_a_corner_is_told():
    """Two walls in one switch cannot be rested upon."""

    class Corner(Ball):
        @nsjax.impact
        def floor(self, t, y):
            return y.x, 10.0 + y.x

        @floor.restitution
        def floor(self):
            return self.e

    sol = solve(Corner(e=0.6), 0.0, 10.0, Motion(1.0, 0.0), throw=False)
    assert sol.result == RESULTS.accumulation_reached
    np.testing.assert_allclose(sol.t1, accumulation(0.6, 9.81, 1.0), rtol=1e-12)
    np.testing.assert_allclose(flat(sol.y1), 0, atol=1e-12)


class Row(NamedTuple):
    """Of three balls."""

    x: Array
    v: Array


class Balls(nsjax.System):
    """Three balls of length and mass 1 in a row, with the contacts between them declared in either order."""

    reversed: bool = eqx.field(static=True, default=False)

    def vector_field(self, t, y, s):
        return Row(y.v, jnp.stack([-s.left, s.left - s.right, s.right]))

    @property
    def switches(self):
        pairs = (("left", 0), ("right", 1))
        contacts = [
            nsjax.impact(lambda self, t, y, i=i: y.x[i + 1] - y.x[i] - 1, name=name).restitution(lambda self: 0.5)
            for name, i in pairs
        ]
        return tuple(contacts[::-1] if self.reversed else contacts)


def test_where_the_order_of_declaration_decides_the_solution_is_not_unique():
    """Pitfall 55: impacts on both sides of a ball at one instant: unique exactly where the order of declaration changes nothing."""
    cases = {
        "from both sides": ([0.0, 2.0, 4.0], [1.0, 0.0, -1.0]),
        "both gaps close, one ball at rest": ([0.0, 2.0, 4.0], [1.0, 0.5, 0.0]),
        "touching, from both sides": ([0.0, 1.0, 2.0], [1.0, 0.0, -1.0]),
        "touching, unequal": ([0.0, 1.0, 2.0], [1.0, 0.5, 0.0]),
        "two that rest on each other are hit": ([0.0, 2.0, 3.0], [1.0, 0.0, 0.0]),
        "one after the other": ([0.0, 2.0, 3.5], [1.0, 0.0, 0.0]),
    }
    unique = {}
    for name, (x, v) in cases.items():
        start = Row(jnp.asarray(x), jnp.asarray(v))
        one, two = (solve(Balls(reversed=way), 0.0, 3.0, start) for way in (False, True))
        same = bool(jnp.allclose(one.y1.v, two.y1.v, atol=1e-9))
        assert bool(one.unique) == bool(two.unique) == same, name
        unique[name] = same
    assert list(unique.values()) == [False] * 4 + [True] * 2


def test_an_impact_in_a_corner_is_unique():
    """Both walls are met at once, but neither impulse changes the velocity towards the other wall."""

    class Corner(nsjax.System):
        def vector_field(self, t, y, s):
            return Row(y.v, jnp.stack([s.wall, s.floor]))

        @nsjax.impact
        def wall(self, t, y):
            return y.x[0]

        @nsjax.impact
        def floor(self, t, y):
            return y.x[1]

        wall = wall.restitution(lambda self: 0.5)
        floor = floor.restitution(lambda self: 0.5)

    sol = solve(Corner(), 0.0, 2.0, Row(jnp.ones(2), -jnp.ones(2)))
    assert sol.unique and sol.events.num == 2
    np.testing.assert_allclose(sol.y1.v, 0.5, rtol=1e-12)


def test_start_by_mode():
    """`mode=` sets out at rest or free; a surface that cannot hold is refused, and so is a force that pulls."""
    free = solve(Rising(), 0.0, 0.5, Motion(0.0, 0.0), mode={"floor": 1})
    assert free.mode1 == 1
    lifted = solve(Rising(), 0.0, 0.1, Motion(1.0, 0.0), mode={"floor": 1}, throw=False)
    assert lifted.result == RESULTS.wrong_mode

    class Jumper(nsjax.System):
        def vector_field(self, t, y, s):
            return Motion(y.v, -1.0 + 0 * y.x)

        @nsjax.impact
        def floor(self, t, y):
            return y.x

        @floor.reset
        def floor(self, t, y):
            return Motion(y.x, -0.5 * y.v)

    with pytest.raises(ValueError, match="cannot hold"):
        solve(Jumper(), 0.0, 1.0, Motion(1.0, 0.0), mode={"floor": 1})

    with pytest.raises(Exception, match="opens the gap `floor`.*or that of what `floor` returns"):
        solve(Rising(sign=-1.0), 0.0, 1.0, Motion(1.0, 0.0), mode={"floor": 0})


@pytest.mark.parametrize("mu", [pytest.param(0.3, marks=pytest.mark.slow), pytest.param(1.5, marks=pytest.mark.slow)])
def test_friction_of_an_open_contact(mu):
    """Pitfall 43: in flight there is no friction, so that the sliding velocity passes through zero and does not stick;
    on the floor there is, and the impact takes its share of it."""
    sol = solve(Block(mu=mu, g=1.0, e=0.0, push=1.0), 0.0, 3.0, Thrown(0.0, 0.5, -0.5, 0.0))
    flight, landing = sol.events[0], sol.events[1]
    assert flight.switch == "slide" and flight.mode_after == {"floor": 0, "slide": 1}
    np.testing.assert_allclose([flight.t, flight.y_after.u], [0.5, 0.0], atol=1e-12)
    assert landing.switch == "floor" and landing.mode_after == {"floor": 1, "slide": 1 if mu < 1 else 0}
    # The impulse 1 takes up to mu off the velocity 0.5; then friction holds the push, or does not.
    v = max(0.5 - mu, 0.0)
    pull = 1 - mu if mu < 1 else 0.0
    np.testing.assert_allclose([landing.t, landing.y_after.u], [1.0, v], atol=1e-12)
    end = [v + 2 * pull, 2 * v + 2 * pull]
    np.testing.assert_allclose([sol.y1.u, sol.y1.x - landing.y_after.x], end, atol=1e-9)


@pytest.mark.parametrize("drift", [1e-20, 3e-16, -3e-16])
def test_a_start_that_is_told_to_rest_may_have_drifted(drift):
    """Where h is a state itself, a number next to zero has no rounding to be compared with."""
    rest = solve(Ball(), 0.0, 1.0, Motion(drift, 0.0), mode={"floor": 1})
    np.testing.assert_allclose(rest.y1, 0.0, atol=1e-15)
    for far in (1e-3, -1e-3):
        assert solve(Ball(), 0.0, 1.0, Motion(far, 0.0), mode={"floor": 1}, throw=False).result in (
            RESULTS.wrong_mode,
            RESULTS.start_penetrates,
        )


@pytest.mark.parametrize("drift", [1e-20, 3e-16, -3e-16])
def test_a_start_that_is_told_to_slide_may_have_drifted(drift):
    class Held(nsjax.System):
        def vector_field(self, t, y, s):
            return Motion(0.5 - s.line, jnp.ones_like(t))

        @nsjax.sgn
        def line(self, t, y):
            return y.x

    np.testing.assert_allclose(solve(Held(), 0.0, 1.0, Motion(drift, 0.0), mode={"line": 0}).y1, [0.0, 1.0], atol=1e-15)
    far = solve(Held(), 0.0, 1.0, Motion(1e-3, 0.0), mode={"line": 0}, throw=False)
    assert far.result == RESULTS.wrong_mode


class Pressed(nsjax.System):
    """A mass with dry friction, which F sin t presses onto a plastic stop at x = 1 and draws off it again."""

    F: float = 3.0

    def vector_field(self, t, y, s):
        return Motion(y.v, self.F * jnp.sin(t) - s.ground - s.stop)

    @nsjax.sgn
    def ground(self, t, y):
        return y.v

    @nsjax.impact
    def stop(self, t, y):
        return 1.0 - y.x

    @stop.restitution
    def stop(self):
        return 0.0


def released(F):
    """x(4) of the mass that friction holds at the stop until F |sin t| = 1, with x'' = F sin t + 1 from there on."""
    begin = jnp.pi + jnp.arcsin(1 / F)
    since = 4.0 - begin
    return 1 - F * (jnp.sin(4.0) - jnp.sin(begin)) + F * jnp.cos(begin) * since + since**2 / 2


def pressed(F, x, v, solver=None):
    sol = solve(Pressed(F), 0.0, 4.0, Motion(x, v), solver=solver, rtol=1e-10, atol=1e-10)
    return sol.y1.x, sol


@pytest.mark.parametrize("solver", [None, pytest.param(nsjax.Taylor(), marks=pytest.mark.slow)])
def test_friction_along_the_normal_of_a_contact(solver):
    """Pitfall 56: the contact bears the load while it rests, and friction holds the mass when it has opened."""
    run = jax.jit(lambda *at: jax.jacfwd(pressed, has_aux=True)(*at, solver))
    slope, sol = run(3.0, 1.0, 0.0)
    np.testing.assert_allclose(sol.events.t[: int(sol.events.num)], [np.pi, np.pi + np.arcsin(1 / 3)], rtol=1e-9)
    np.testing.assert_allclose(sol.y1.x, 0.938126445, rtol=1e-9)
    np.testing.assert_allclose(slope, jax.grad(released)(3.0), rtol=1e-7)
    thrown = run(3.0, 0.9, 0.8)[1]
    np.testing.assert_allclose(thrown.y1.x, sol.y1.x, rtol=1e-9)


def test_friction_along_the_normal_of_a_contact_in_a_sweep():
    swept = nsjax.sweep(lambda F: pressed(F, 1.0, 0.0)[0], jnp.asarray([2.0, 3.0]))
    np.testing.assert_allclose(swept, jax.vmap(released)(jnp.asarray([2.0, 3.0])), rtol=1e-8)


def test_friction_beside_a_stop_on_a_moving_belt():
    """Friction that sticks to a belt does not keep the gap to a fixed stop as it is."""

    class Carried(Pressed):
        def vector_field(self, t, y, s):
            return Motion(y.v, -5.0 * s.ground - s.stop)

        @nsjax.sgn
        def ground(self, t, y):
            return y.v - 0.5

    sol = solve(Carried(), 0.0, 4.0, Motion(0.0, 0.5))
    np.testing.assert_allclose(sol.events.t[0], 2.0, rtol=1e-7)  # it comes to the stop, and rests there
    np.testing.assert_allclose(sol.y1, [1.0, 0.0], atol=1e-9)


def test_friction_that_is_overcome_towards_its_stop():
    """Drawn off by less than friction holds, and pressed on again: the mass stays at the stop."""

    class Swayed(Pressed):
        def vector_field(self, t, y, s):
            return Motion(y.v, 1.2 + self.F * jnp.sin(t) - s.ground - s.stop)

    sol = solve(Swayed(2.0), 0.0, 20.0, Motion(1.0, 0.0))
    np.testing.assert_allclose(sol.y1, [1.0, 0.0], atol=1e-12)
    assert int(sol.stats["num_steps"]) < 500
