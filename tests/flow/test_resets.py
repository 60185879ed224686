"""Events that reset the state: on surfaces crossed from either side, at the ticks of a clock, and up to where they
accumulate."""

from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from models import Motion

import nsjax
from nsjax import RESULTS, solve


class Crossing(nsjax.System):
    """x'' = -x, with v -> r v wherever x changes its sign."""

    r: Any = 0.8

    def vector_field(self, t, y, s):
        return Motion(y.v, -y.x)

    @nsjax.sgn
    def middle(self, t, y):
        return y.x

    @middle.reset
    def middle(self, t, y):
        return Motion(y.x, self.r * y.v)


class Falling(nsjax.System):
    """Towards x = 0 with the acceleration a above and b below; v -> r v there."""

    a: Any = 1.0
    b: Any = 3.0
    r: Any = 0.5

    def vector_field(self, t, y, s):
        return Motion(y.v, -0.5 * (1 + s.middle) * self.a + 0.5 * (1 - s.middle) * self.b)

    @nsjax.sgn
    def middle(self, t, y):
        return y.x

    @middle.reset
    def middle(self, t, y):
        return Motion(y.x, self.r * y.v)


class Flipped(NamedTuple):
    x: Any
    v: Any
    side: Any
    count: Any


class FallingByImpact(nsjax.System):
    """The same, with the side as a state and the impacts counted."""

    a: Any = 1.0
    b: Any = 3.0
    r: Any = 0.5

    def vector_field(self, t, y, s):
        pull = -0.5 * (1 + y.side) * self.a + 0.5 * (1 - y.side) * self.b
        return Flipped(y.v, pull, jnp.zeros_like(t), jnp.zeros_like(t))

    @nsjax.impact
    def middle(self, t, y):
        return y.side * y.x

    @middle.reset
    def middle(self, t, y):
        return Flipped(y.x, self.r * y.v, -y.side, y.count + 1)


def accumulation(v, a, b, r):
    """When the flights of `Falling` end that begin at x = 0 with v > 0: 2v/a, 2rv/b, 2r²v/a, ..."""
    return 2 * v * (1 / a + r / b) / (1 - r**2)


@pytest.mark.parametrize("solver", [None, pytest.param(nsjax.Taylor(), marks=pytest.mark.slow)])
def test_a_reset_on_a_surface_crossed_from_either_side(solver):
    """Pitfall 53: half a turn takes π whatever the amplitude: after the crossings at π/2 and 3π/2 the solution is r² cos t."""

    def end(r):
        return solve(Crossing(r), 0.0, 6.0, Motion(1.0, 0.0), solver=solver, rtol=1e-10, atol=1e-10)

    sol = end(0.8)
    assert int(sol.events.num) == 2
    np.testing.assert_allclose(sol.events.t[:2], [np.pi / 2, 3 * np.pi / 2], rtol=1e-9)
    np.testing.assert_allclose(sol.y1, [0.64 * np.cos(6), -0.64 * np.sin(6)], rtol=1e-8)
    slope = jax.jacfwd(lambda r: end(r).y1)(0.8)
    np.testing.assert_allclose(slope, [1.6 * np.cos(6), -1.6 * np.sin(6)], rtol=1e-8)
    swept = nsjax.sweep(lambda r: end(r).y1, jnp.asarray([0.7, 0.8]))
    np.testing.assert_allclose(swept.x, np.array([0.49, 0.64]) * np.cos(6), rtol=1e-8)


def test_its_fundamental_matrix():
    sol = solve(Crossing(), 0.0, 6.0, Motion(1.0, 0.0))
    matrices = nsjax.saltation_matrices(Crossing(), sol.events)[:2]
    np.testing.assert_allclose(matrices, [0.8 * np.eye(2)] * 2, atol=1e-8)
    turn = 0.64 * np.array([[np.cos(6), np.sin(6)], [-np.sin(6), np.cos(6)]])
    for method in ("variational", "autodiff"):
        phi = nsjax.fundamental_matrix(Crossing(), 0.0, 6.0, Motion(1.0, 0.0), method=method, rtol=1e-10, atol=1e-10)
        np.testing.assert_allclose(phi, turn, rtol=1e-7)


def test_a_reset_may_turn_the_state_back():
    """With v -> -0.5 v the state stays on its side: |x| bounces as on a wall."""

    class Wall(Crossing):
        @nsjax.sgn
        def middle(self, t, y):
            return y.x

        @middle.reset
        def middle(self, t, y):
            return Motion(y.x, -0.5 * y.v)

    for x in (1.0, -1.0):
        sol = solve(Wall(), 0.0, 6.0, Motion(x, 0.0))
        assert int(sol.events.num) == 2 and int(sol.mode1[0]) == x
        np.testing.assert_allclose(sol.y1.x, x * 0.25 * np.cos(6), rtol=1e-6)


def test_a_reset_may_leave_the_surface():
    """A phase that is set back by a turn where it has made one."""

    class Rotor(nsjax.System):
        def vector_field(self, t, y, s):
            return Motion(y.v, 0.1 + 0 * y.x)

        @nsjax.sgn
        def turned(self, t, y):
            return y.x - 2 * jnp.pi

        @turned.reset
        def turned(self, t, y):
            return Motion(y.x - 2 * jnp.pi, y.v)

    sol = solve(Rotor(), 0.0, 20.0, Motion(0.0, 1.0))
    turns = (20.0 + 0.05 * 400) // (2 * np.pi)
    assert int(sol.events.num) == turns and int(sol.mode1[0]) == -1
    np.testing.assert_allclose(sol.y1.x, (20.0 + 0.05 * 400) % (2 * np.pi), rtol=1e-7)


def test_backwards_by_the_inverse():
    class Both(Crossing):
        @nsjax.sgn
        def middle(self, t, y):
            return y.x

        @middle.reset
        def middle(self, t, y):
            return Motion(y.x, self.r * y.v)

        @middle.inverse
        def middle(self, t, y):
            return Motion(y.x, y.v / self.r)

    end = solve(Both(), 0.0, 6.0, Motion(1.0, 0.0), rtol=1e-10, atol=1e-10).y1
    np.testing.assert_allclose(solve(Both(), 6.0, 0.0, end, rtol=1e-10, atol=1e-10).y1, [1.0, 0.0], atol=1e-8)
    with pytest.raises(Exception, match="`Crossing.middle` has a reset"):
        solve(Crossing(), 6.0, 0.0, Motion(1.0, 0.0))


@pytest.mark.parametrize("r", [0.5, 0.9])
def test_resets_that_accumulate(r):
    """Pitfall 54: sides that differ make flights of different lengths in turn; a sign and a counter have no limit."""
    a, b, v = 1.0, 3.0, 0.7
    args = dict(rtol=1e-11, atol=1e-11, throw=False, max_events=400)
    crossed = solve(Falling(a, b, r), 0.0, 90.0, Motion(0.0, v), **args)
    impacts = solve(FallingByImpact(a, b, r), 0.0, 90.0, Flipped(0.0, v, 1.0, 0.0), **args)
    for sol in (crossed, impacts):
        assert sol.result == RESULTS.accumulation_reached
        np.testing.assert_allclose(sol.t1, accumulation(v, a, b, r), rtol=1e-10)
        np.testing.assert_allclose([sol.y1.x, sol.y1.v], 0.0, atol=1e-11)
    number = int(impacts.events.num)
    assert number == int(crossed.events.num)
    np.testing.assert_allclose([impacts.y1.side, impacts.y1.count], [(-1) ** number, number])


def test_derivative_of_the_accumulation():
    def end(p):
        args = dict(rtol=1e-10, atol=1e-10, throw=False, max_events=64)
        return solve(Falling(p[1], p[2], p[3]), 0.0, 90.0, Motion(0.0, p[0]), **args).t1

    p = jnp.asarray([0.7, 1.0, 3.0, 0.5])
    np.testing.assert_allclose(jax.jacfwd(end)(p), jax.grad(lambda p: accumulation(*p))(p), rtol=1e-6)


def test_impacts_that_accumulate_with_what_they_do_not_scale():
    """A ball with a counter, and a sideways speed that halves at each bounce as its own speed does."""

    class Ball(nsjax.System):
        def vector_field(self, t, y, s):
            return Flipped(y.v, -jnp.ones_like(t), jnp.zeros_like(t), jnp.zeros_like(t))

        @nsjax.impact
        def floor(self, t, y):
            return y.x

        @floor.reset
        def floor(self, t, y):
            return Flipped(y.x, -0.5 * y.v, 0.5 * y.side, y.count + 1)

    sol = solve(Ball(), 0.0, 9.0, Flipped(0.5, 0.0, 1.0, 0.0), throw=False)
    assert sol.result == RESULTS.accumulation_reached
    np.testing.assert_allclose(sol.t1, 3.0, rtol=1e-7)  # 1 + 2 (1/2 + 1/4 + ...)
    np.testing.assert_allclose(sol.y1.count, int(sol.events.num))
    np.testing.assert_allclose(sol.y1.side, 0.0, atol=1e-12)


@pytest.mark.parametrize(
    "gap", [lambda y: y.x**2, lambda y: jnp.abs(y.x), lambda y: y.x * y.x, lambda y: jnp.maximum(y.x, 0.0)]
)
def test_a_gap_that_is_never_negative_is_refused(gap):
    class Touched(nsjax.System):
        def vector_field(self, t, y, s):
            return Motion(y.v, -y.x)

        @nsjax.impact
        def wall(self, t, y):
            return gap(y)

        @wall.reset
        def wall(self, t, y):
            return Motion(y.x, -y.v)

    with pytest.raises(ValueError, match=r"`Touched.wall` is never negative .* `@nsjax.sgn` with `@wall.reset`"):
        solve(Touched(), 0.0, 6.0, Motion(1.0, 0.0))


def test_mistakes_in_resets_of_signs_and_clocks():
    class Static(Crossing):
        @nsjax.sgn
        def middle(self, t, y):
            return y.x

        @middle.breakaway
        def middle(self):
            return 2.0

        @middle.reset
        def middle(self, t, y):
            return y

    class Loose(Crossing):
        @nsjax.sgn
        def middle(self, t, y):
            return y.x

        @middle.reset
        def middle(self, t, y):
            return y.x

    class Inverse(nsjax.System):
        def vector_field(self, t, y, s):
            return -y

        @nsjax.clock
        def tick(self):
            return 1.0

        @tick.inverse
        def tick(self, t, y):
            return y

    for model, y, words in [
        (Static(), Motion(1.0, 0.0), "must be one scalar, without `breakaway`"),
        (Loose(), Motion(1.0, 0.0), "`Loose.middle.reset` must return a state of the structure"),
        (Inverse(), jnp.asarray(1.0), "there is no `@tick.reset`"),
    ]:
        with pytest.raises(ValueError, match=words):
            solve(model, 0.0, 1.0, y)


class Doses(nsjax.System):
    """y' = -k y, and y -> y + dose at T, 2T, ..."""

    k: Any = 0.3
    T: Any = 0.7
    dose: Any = 2.0

    def vector_field(self, t, y, s):
        return -self.k * y

    @nsjax.clock
    def tick(self):
        return self.T

    @tick.reset
    def tick(self, t, y):
        return y + self.dose

    @tick.inverse
    def tick(self, t, y):
        return y - self.dose

    @property
    def period(self):
        return self.T


def amount(k, T, dose, y, t):
    return y * jnp.exp(-k * t) + sum(dose * jnp.exp(-k * (t - n * T)) for n in range(1, 6))


@pytest.mark.parametrize("solver", [None, pytest.param(nsjax.Taylor(), marks=pytest.mark.slow)])
def test_doses_by_a_clock(solver):
    def end(p, y):
        return solve(Doses(*p), 0.0, 4.0, y, solver=solver, rtol=1e-10, atol=1e-10).y1

    p, y = jnp.asarray([0.3, 0.7, 2.0]), jnp.asarray(1.0)
    np.testing.assert_allclose(end(p, y), amount(*p, y, 4.0), rtol=1e-9)
    for have, want in zip(
        jax.jacfwd(end, (0, 1))(p, y), jax.jacfwd(lambda p, y: amount(*p, y, 4.0), (0, 1))(p, y), strict=True
    ):
        np.testing.assert_allclose(have, want, rtol=1e-8)
    ks = jnp.asarray([0.2, 0.3])
    swept = nsjax.sweep(lambda k: end(p.at[0].set(k), y), ks)
    np.testing.assert_allclose(swept, [amount(k, 0.7, 2.0, 1.0, 4.0) for k in ks], rtol=1e-8)


def test_a_dose_at_the_end_is_given_once():
    """A tick at the end of one solution belongs to it, and has passed where the next begins."""
    y = jnp.asarray(1.0)
    for _ in range(5):
        y = solve(Doses(), 0.0, 0.7, y).y1
    np.testing.assert_allclose(y, amount(0.3, 0.7, 2.0, 1.0, 3.5), rtol=1e-7)
    t, y = 0.0, jnp.asarray(1.0)
    for n in range(1, 6):
        y, t = solve(Doses(), t, 0.7 * n, y).y1, 0.7 * n
    np.testing.assert_allclose(y, amount(0.3, 0.7, 2.0, 1.0, 3.5), rtol=1e-7)
    later = solve(Doses(), 3.5, 3.9, y).y1
    np.testing.assert_allclose(solve(Doses(), 3.9, 0.1, later).y1, np.exp(-0.03), rtol=1e-6)


def test_the_orbit_of_periodic_doses():
    """y = dose / (1 - exp(-kT)) after a dose; the multiplier is exp(-kT)."""
    orbit = nsjax.find_orbit(Doses(), jnp.asarray(1.0))
    np.testing.assert_allclose(orbit.y0, 2.0 / (1 - np.exp(-0.21)), rtol=1e-7)
    np.testing.assert_allclose(orbit.multipliers, [np.exp(-0.21)], rtol=1e-7)


def test_a_table_of_doses_sees_the_time_after_the_tick():
    class Table(Doses):
        @nsjax.clock
        def tick(self):
            return jnp.asarray([1.0, 2.0, 2.5])

        @tick.reset
        def tick(self, t, y):
            return y + jnp.where(t < 2.0, 1.0, 10.0)

    sol = solve(Table(k=0.0), 0.0, 3.0, jnp.asarray(0.0))
    np.testing.assert_allclose(sol.y1, 21.0, rtol=1e-12)
    np.testing.assert_allclose(sol.events.t[:3], [1.0, 2.0, 2.5], rtol=1e-15)


def test_kicks_of_a_ball_at_rest():
    """A ball that rests on a floor is thrown up by each tick; one that is pressed down rebounds at once."""

    class Kicked(nsjax.System):
        kick: Any

        def vector_field(self, t, y, s):
            return Motion(y.v, -1.0 + s.floor)

        @nsjax.impact
        def floor(self, t, y):
            return y.x

        @floor.restitution
        def floor(self):
            return 0.0

        @nsjax.clock
        def tick(self):
            return 3.0

        @tick.reset
        def tick(self, t, y):
            return Motion(y.x, y.v + self.kick)

    up = solve(Kicked(0.8), 0.0, 4.0, Motion(0.0, 0.0))
    np.testing.assert_allclose(up.y1, [0.8 - 0.5, -0.2], rtol=1e-9)
    down = solve(Kicked(-0.8), 0.0, 4.0, Motion(0.0, 0.0))
    np.testing.assert_allclose(down.y1, [0.0, 0.0], atol=1e-12)
    assert int(down.mode1[0]) == 1


class Forced(Crossing):
    """A damped and driven oscillator, slowed down wherever x changes its sign."""

    def vector_field(self, t, y, s):
        return Motion(y.v, -y.x - 0.1 * y.v + jnp.cos(1.3 * t))

    @property
    def period(self):
        return 2 * jnp.pi / 1.3


@pytest.mark.slow
def test_an_orbit_through_a_crossed_surface():
    """The flow and its derivative confirm the orbit that shooting finds, and the branch in segments."""
    orbit = nsjax.find_orbit(Forced(), Motion(0.5, 0.5), order=None)

    def end(y):
        return solve(orbit.system, orbit.t0, orbit.t0 + orbit.period, y, rtol=1e-11, atol=1e-11).y1

    np.testing.assert_allclose(end(orbit.y0), orbit.y0, rtol=1e-9)
    by_x, by_v = jax.jacfwd(end)(orbit.y0)
    wanted = np.linalg.eigvals(np.array([[by_x.x, by_x.v], [by_v.x, by_v.v]]))
    np.testing.assert_allclose(np.sort_complex(orbit.multipliers), np.sort_complex(wanted), rtol=1e-8)
    branch = nsjax.continue_orbit(orbit.system, orbit, "r", (0.7, 0.8))
    last = branch.orbit(int(np.argmin(branch.values)))
    back = solve(last.system, last.t0, last.t0 + last.period, last.y0, rtol=1e-11, atol=1e-11).y1
    np.testing.assert_allclose(back, last.y0, rtol=1e-8)


class TwoDoses(Doses):
    """Doses of 1 and 3 in turn, chosen by a function of time that jumps at the ticks."""

    def vector_field(self, t, y, s):
        return Motion(-self.k * y.x, -0.5 * y.v + y.x)

    @nsjax.clock
    def tick(self):
        return self.T

    @tick.reset
    def tick(self, t, y):
        return Motion(y.x + jnp.where(jnp.floor(t / self.T) % 2 == 0, 1.0, 3.0), y.v)

    @property
    def period(self):
        return 2 * self.T


@pytest.mark.parametrize("method", ["shooting", pytest.param("segments", marks=pytest.mark.slow)])
def test_an_orbit_of_two_doses(method):
    orbit = nsjax.find_orbit(TwoDoses(), Motion(1.0, 1.0), method=method)
    # After the dose of 1 at t = 0, which the one of 3 at t = T follows.
    decay = np.exp(-0.21)
    np.testing.assert_allclose(orbit.y0.x, (1 + 3 * decay) / (1 - decay**2), rtol=1e-9)
    np.testing.assert_allclose(orbit.multipliers, [np.exp(-0.42), np.exp(-0.7)], rtol=1e-9)


def test_the_saltation_matrix_of_a_tick():
    """The time of a tick does not depend on the state."""
    matrix = nsjax.saltation_matrix(TwoDoses(), 0.7, Motion(1.0, 1.0), "tick", 0, 1)
    np.testing.assert_array_equal(matrix, np.eye(2))
