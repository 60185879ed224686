"""Friction that is there only while its contact is closed: `sgn.while_`."""

import dataclasses
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from jaxtyping import Array
from models import Motion, pid
from scipy.integrate import solve_ivp

import nsjax
from nsjax import find_equilibria, RESULTS, solve


OFF = 2
TIGHT = dict(stepsize_controller=pid(1e-11))


class Plane(NamedTuple):
    x: Array | float
    z: Array | float
    u: Array | float
    w: Array | float


class Block(nsjax.System):
    """A block on a rigid floor, pulled up ever more strongly, and to the side; its normal force pushes it sideways."""

    g: float = 10.0
    a: float = 4.0
    c: float = 1.0
    mu: float = 0.3
    e: float = 0.0
    lean: float = 0.0

    @nsjax.impact
    def floor(self, t, y):
        return y.z

    @floor.restitution
    def floor(self):
        return self.e

    @nsjax.sgn
    def rub(self, t, y):
        return y.u

    rub = rub.while_("floor")

    def vector_field(self, t, y, s):
        side = self.c + s.floor * (self.lean - self.mu * s.rub)
        return Plane(y.u, y.w, side, -self.g + self.a * t + s.floor)


class Soft(nsjax.System):
    """A mass on a spring above a soft floor that moves sideways, with friction while it touches; forced up and down."""

    k: float = 40.0
    c: float = 0.4
    mu: float = 0.5
    v: float = 0.3
    f: float = 3.0
    omega: float = 2.0
    g: float = 2.0

    @nsjax.sgn
    def floor(self, t, y):
        return -y.z, -self.k * y.z - self.c * y.w

    @nsjax.sgn
    def rub(self, t, y):
        return y.u - self.v

    rub = rub.while_("floor")

    def vector_field(self, t, y, s):
        N = (-self.k * y.z - self.c * y.w) * (1 + s.floor) / 2
        up = N - self.g + self.f * jnp.cos(self.omega * t)
        return Plane(y.u, y.w, -y.x - 0.1 * y.u - self.mu * N * s.rub, up)

    @property
    def period(self):
        return 2 * jnp.pi / self.omega


def logged(sol):
    n = int(sol.events.num)
    return np.asarray(sol.events.t[:n]), np.asarray(sol.events.switch[:n]), np.asarray(sol.events.mode_after[:n])


@jax.jit  # one program for all
def moved(system, t1, y0):
    """The solution, and the derivative of its last u by c and μ."""

    def last(c, mu):
        sol = solve(dataclasses.replace(system, c=c, mu=mu), 0.0, t1, y0)
        return sol.y1.u, sol

    return jax.jacfwd(last, argnums=(0, 1), has_aux=True)(system.c, system.mu)


def test_slip_stick_slip_and_lift_off_in_closed_form():
    """Pitfall 43: it comes to a halt, lets go where the normal force g - a t has fallen to c/μ, and flies from g/a on:
    in flight nothing rubs, and nothing sticks as its normal force vanishes."""
    g, a, c, mu, u0, t1 = 10.0, 4.0, 1.0, 0.3, 1.0, 4.0
    slopes, sol = moved(Block(), t1, Plane(0.0, 0.0, u0, 0.0))
    times, switches, modes = logged(sol)
    halt = min(np.roots([mu * a / 2, c - mu * g, u0]).real)
    slips, lifts = (g - c / mu) / a, g / a
    np.testing.assert_allclose(times, [halt, slips, lifts], rtol=1e-9)
    assert switches.tolist() == [1, 1, 0] and modes.tolist() == [[1, 0], [1, 1], [0, OFF]]
    np.testing.assert_allclose(sol.y1.u, c * (t1 - slips) - mu * a / 2 * (lifts - slips) ** 2, rtol=1e-9)
    want = [t1 - slips, -a / 2 * (lifts - slips) ** 2]  # where it lets go its acceleration is zero
    np.testing.assert_allclose(slopes, want, rtol=1e-7)


def test_in_flight_nothing_happens_to_it():
    """Its velocity passes zero high above the floor; on the floor it sticks at once or slides, as it lands."""
    y0 = Plane(0.0, 1.0, 0.3, 0.0)
    _, sol = moved(Block(c=-1.0, a=0.0), 1.0, y0)
    (land,), switches, modes = logged(sol)
    fall = np.sqrt(2 / 10)
    u, impulse = 0.3 - fall, 0.3 * 10 * fall
    assert 0 < -u < impulse  # the impact stops it, at once
    np.testing.assert_allclose(land, fall, rtol=1e-9)
    assert switches.tolist() == [0] and modes.tolist() == [[1, 0]]
    np.testing.assert_allclose(sol.y1.u, 0, atol=1e-12)
    for mu in (0.05, 0.02):  # it is stopped and slides off again; it slides on, and slower
        _, slides = moved(Block(c=-1.0, a=0.0, mu=mu), 1.0, y0)
        assert logged(slides)[1].tolist() == [0] and slides.mode1.tolist() == [1, -1]
        landed = min(u + mu * 10 * fall, 0)
        np.testing.assert_allclose(slides.y1.u, landed + (mu * 10 - 1) * (1 - fall), rtol=1e-9)


@pytest.mark.parametrize("lean, u", [(0.2, 0.0), (0.5, 0.2), (-0.5, -0.2)])
def test_an_impact_without_sliding(lean, u):
    """The normal impulse P pushes the block sideways by lean · P; friction keeps it where it is, up to μ P."""
    _, sol = moved(Block(c=0.0, a=0.0, e=0.5, lean=lean), 0.5, Plane(0.0, 1.0, 0.0, 0.0))
    np.testing.assert_allclose(sol.y1.u, u * 1.5 * np.sqrt(20), rtol=1e-9, atol=1e-12)
    assert sol.mode1.tolist() == [0, OFF]


@pytest.mark.slow
def test_it_starts_as_its_contact_does():
    """Open, closed, with what an earlier solution ended in, and in one batch."""
    high, low = Plane(0.0, 0.2, 0.0, 0.0), Plane(0.0, 0.0, 0.0, 0.0)
    starts = jax.tree.map(lambda *x: jnp.asarray(x), high, low, low._replace(u=-0.5))
    ends = jax.jit(jax.vmap(lambda y: solve(Block(), 0.0, 0.1, y)))(starts)
    assert (ends.result == RESULTS.successful).all()
    assert ends.mode1.tolist() == [[0, OFF], [1, 0], [1, -1]]
    for mode, y in zip(ends.mode1, (high, low, low._replace(u=-0.5))):
        assert solve(Block(), 0.0, 0.1, y, mode=mode).mode1.tolist() == mode.tolist()
    assert solve(Block(), 0.0, 0.1, high, mode={"rub": 0}).mode1.tolist() == [0, OFF]
    with pytest.raises(ValueError, match=r"must give `rub` one of \(-1, 0, 1, 2\)"):
        solve(Block(), 0.0, 0.1, high, mode={"rub": 3})


def followed(m, t1, y0):
    """By scipy, phase by phase: in flight, sliding either way, sticking."""

    def normal(y):
        return -m.k * y[1] - m.c * y[3]

    def rates(phase):
        def f(t, y):
            N = 0.0 if phase is None else normal(y)
            side = -y[0] - 0.1 * y[2] - m.mu * N * (phase or 0)
            side = 0.0 if phase == 0 else side
            return [y[2], y[3], side, N - m.g + m.f * np.cos(m.omega * t)]

        return f

    def event(fn, direction):
        fn.terminal, fn.direction = True, direction
        return fn

    def bound(sign):
        return event(lambda t, y: m.mu * normal(y) - sign * (-y[0] - 0.1 * y[2]), -1)

    def sides(y):
        return int(np.sign(y[2] - m.v))

    t, y, phase = 0.0, np.array(y0), None
    while t < t1:
        opens = event(lambda t, y: normal(y), -1)
        watched = {
            None: [event(lambda t, y: y[1], -1)],
            0: [opens, bound(1), bound(-1)],
        }.get(phase, [opens, event(lambda t, y: y[2] - m.v, -(phase or 0))])
        run = solve_ivp(rates(phase), (t, t1), y, method="DOP853", rtol=1e-12, atol=1e-13, events=watched)
        t, y = run.t[-1], run.y[:, -1]
        if run.status == 0:
            return y
        which = [len(e) > 0 for e in run.t_events].index(True)
        if phase is None:
            phase = sides(y)
        elif which == 0:
            phase = None
        elif phase == 0:
            phase = 1 if which == 1 else -1
        else:
            y[2] = m.v
            held = abs(-y[0] - 0.1 * y[2]) <= m.mu * normal(y)
            phase = 0 if held else -phase
    return y


@pytest.mark.slow
def test_on_a_soft_floor_as_scipy_has_it():
    """Bounces, with slip of both signs and stick: the floor lets go where its force vanishes."""
    y0, t1 = (0.6, 0.3, 1.5, 0.0), 20.0
    sol = solve(Soft(), 0.0, t1, Plane(*y0), max_events=300, **TIGHT)
    times, switches, modes = logged(sol)
    np.testing.assert_allclose(list(sol.y1), followed(Soft(), t1, y0), rtol=1e-7, atol=1e-8)
    open_ = modes[:, 0] == -1
    assert (modes[open_, 1] == OFF).all() and (modes[~open_, 1] != OFF).all()
    assert {0, 1, -1} <= set(modes[~open_, 1].tolist()), "a test that sees less than it says"
    assert (switches[:-1][open_[:-1]] == 0).all() and (switches[1:][open_[:-1]] == 0).all()


@pytest.mark.slow
def test_orbit_and_derivative():
    """The orbit that the solution settles to, and its monodromy matrix, against differences of the period map."""
    m = Soft(c=8.0)
    settled = solve(m, 0.0, 40 * np.pi, Plane(0.6, 0.3, 0.0, 0.0), max_events=2000)
    orbit = nsjax.find_orbit(m, settled.y1)
    assert (np.asarray(orbit.events.mode_after)[: int(orbit.events.num), 1] == OFF).any()

    def mapped(y):
        return jnp.stack(solve(m, 0.0, np.pi, Plane(*y), max_events=300, **TIGHT).y1)

    y, h = jnp.stack(orbit.y0), 1e-5
    columns = [(mapped(y.at[i].add(h)) - mapped(y.at[i].add(-h))) / (2 * h) for i in range(4)]
    np.testing.assert_allclose(orbit.monodromy, np.stack(columns, axis=1), atol=1e-5)


class Pressed(nsjax.System):
    """A mass on a belt, which it touches if the load presses it on."""

    load: float = 1.0
    v: float = 0.2

    @nsjax.sgn
    def touch(self, t, y):
        return self.load

    @nsjax.sgn
    def belt(self, t, y):
        return y.v - self.v

    belt = belt.while_("touch")

    def vector_field(self, t, y, s):
        return Motion(y.v, -y.x - 0.2 * y.v - self.load * (1 + s.touch) / 2 * s.belt)


def test_equilibria_in_the_modes_that_there_are():
    """Pressed on, it hangs on the belt's slip at x = 1; lifted, at x = 0, in the mode in which nothing rubs."""
    starts = Motion(jnp.asarray([0.3, 2.0]), jnp.zeros(2))
    (on,) = find_equilibria(Pressed(load=1.0), starts)
    (off,) = find_equilibria(Pressed(load=-1.0), starts)
    np.testing.assert_allclose([on.y.x, off.y.x], [1.0, 0.0], atol=1e-12)
    assert on.mode.tolist() == [1, -1] and off.mode.tolist() == [-1, OFF]


def test_mistakes():
    rub = nsjax.sgn(lambda self, t, y: y.u, name="rub")
    other = nsjax.sgn(lambda self, t, y: y.u - 1, name="other")
    tick = nsjax.clock(lambda self: 1.0, name="tick")

    def refused(*switches):
        class Wrong(Block):
            @property
            def switches(self):
                return (Block.floor, *switches)

        with pytest.raises(ValueError, match="`Wrong.rub.while_` must name a switch") as error:
            solve(Wrong(), 0.0, 1.0, Plane(0.0, 1.0, 0.0, 0.0))
        return str(error.value)

    assert "Did you mean `floor`?" in refused(rub.while_("flor"))
    assert "but names `rub`" in refused(rub.while_("rub"))
    assert "but names `tick`" in refused(rub.while_("tick"), tick)
    assert "but names `other`" in refused(rub.while_("other"), other.while_("floor"))


class OneVelocity(nsjax.System):
    """A block on a belt that moves along a wall, with friction on both: at one velocity. The wall is away."""

    wall_at: float = 2.0

    def vector_field(self, t, y, s):
        push = (1 + s.wall) / 2
        return {"v": jnp.cos(t) - 0.3 * s.belt - 0.5 * push * s.rub, "z": jnp.zeros_like(y["z"])}

    @nsjax.sgn
    def wall(self, t, y):
        return y["z"] - self.wall_at

    @nsjax.sgn
    def belt(self, t, y):
        return y["v"]

    @nsjax.sgn
    def rub(self, t, y):
        return 2 * y["v"]

    rub = rub.while_("wall")


class OneFriction(nsjax.System):
    force: float = 0.3

    def vector_field(self, t, y, s):
        return jnp.cos(t) - self.force * s.belt

    @nsjax.sgn
    def belt(self, t, y):
        return y


@pytest.mark.slow
@pytest.mark.parametrize("z, force", [(1.0, 0.3), (3.0, 0.8)])
def test_the_surface_of_another_one_is_met_alone(z, force):
    """What is not there shares no surface, though its h is zero where that of another switch is."""
    sol = solve(OneVelocity(), 0.0, 8.0, {"v": jnp.asarray(0.1), "z": jnp.asarray(z)}, **TIGHT)
    one = solve(OneFriction(force), 0.0, 8.0, jnp.asarray(0.1), **TIGHT)
    np.testing.assert_allclose(sol.y1["v"], one.y1, atol=1e-10)
    times, want = ([e.t for e in each.events] for each in (sol, one))
    assert len(want) >= 2
    np.testing.assert_allclose(sorted(set(np.round(times, 9))), np.round(want, 9), atol=2e-9)
