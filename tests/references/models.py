"""Small models with known solutions, and a few shorthands, for the tests of the flow.

Tests share them because every new class of system is one more program to compile.
"""

from typing import NamedTuple

import diffrax as dfx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array

import nsjax
from nsjax import gallery, solve


Motion = type(gallery.THESIS["3.4"].y0)  # (x, v)


def pid(tol: float) -> dfx.PIDController:
    return dfx.PIDController(rtol=tol, atol=tol)


def flat(y) -> np.ndarray:
    """The state (or a batch of states, along the first axis) as a vector."""
    return np.stack([np.asarray(x) for x in jax.tree.leaves(y)], -1)


def times(sol) -> np.ndarray:
    """Event times."""
    return np.asarray(sol.events.t)[: int(sol.events.num)]


def itinerary(sol) -> list[tuple[str, int, int]]:
    """(switch, its mode before, its mode after) of every event."""
    return [(e.switch, e.mode_before[e.switch], e.mode_after[e.switch]) for e in sol.events]


class Point(NamedTuple):
    x: Array


class Plane(NamedTuple):
    x: Array
    y: Array


class Heat(NamedTuple):
    T: Array


class Thermostat(nsjax.System):
    """T' = a (T_env + 30 heater - T), on below T_low, off above T_high. With `T_high = T_low` it chatters."""

    a: float = 1.0
    T_env: float = 5.0
    T_low: float = 18.0
    T_high: float = 22.0

    def vector_field(self, t, y, s):
        return Heat(self.a * (self.T_env + 30.0 * s.heater - y.T))

    @nsjax.relay
    def heater(self, t, y):
        return self.T_low - y.T

    @heater.off
    def heater(self, t, y):
        return y.T - self.T_high


class Hammer(nsjax.System):
    """m x'' + c x' + k x = b + f_0 cos ωt + contact, wall at x >= x_w, restitution e: `reference.ImpactOscillator`."""

    m: float = 1.0
    c: float = 0.02
    k: float = 1.0
    b: float = 0.0
    f_0: float = 1.0
    omega: float = 0.8
    x_w: float = 0.5
    e: float = 0.8

    def vector_field(self, t, y, s):
        force = self.b + self.f_0 * jnp.cos(self.omega * t) - self.c * y.v - self.k * y.x
        return Motion(y.v, (force + s.wall) / self.m)

    @nsjax.impact
    def wall(self, t, y):
        return y.x - self.x_w

    @wall.restitution
    def wall(self):
        return self.e


class PeriodicHammer(Hammer):
    """The same, which says its period."""

    @property
    def period(self):
        return 2 * jnp.pi / self.omega


class Pair(nsjax.System):
    """(x, y)' = (w t, g) - [[2, c], [c, 2]] (sgn x, sgn y): two surfaces, coupled by c; piecewise polynomial in t."""

    w: float = 0.1
    g: float = 0.5
    c: float = 0.5

    def vector_field(self, t, y, s):
        return Plane(self.w * t - 2 * s.a - self.c * s.b, self.g - self.c * s.a - 2 * s.b)

    @nsjax.sgn
    def a(self, t, y):
        return y.x

    @nsjax.sgn
    def b(self, t, y):
        return y.y


class Circle(nsjax.System):
    """r' = r (g sin t - s), θ' = w: slides on the unit circle while |g sin t| < 1; a surface that is not affine."""

    w: float = 1.0
    g: float = 0.5

    def vector_field(self, t, y, s):
        radial = self.g * jnp.sin(t) - s.circle
        return Plane(radial * y.x - self.w * y.y, radial * y.y + self.w * y.x)

    @nsjax.sgn
    def circle(self, t, y):
        return y.x**2 + y.y**2 - 1


class Slider(gallery.StickSlip):
    """With the indicator function multiplied by `scale`."""

    scale: float = 1.0

    @nsjax.sgn
    def belt(self, t, y):
        return self.scale * (y.v - self.v_dr)

    @belt.breakaway
    def belt(self):
        return self.F_stick / self.F_slip


class Toggle(nsjax.System):
    """x'' = -a sgn(x - c): parabolas of length 2 v / a, on which solve is exact, joined on the surface. (Rounding grows
    with the square of their number.)"""

    a: float = 1.0
    c: float = 0.0

    def vector_field(self, t, y, s):
        return Motion(y.v, -self.a * s.side)

    @nsjax.sgn
    def side(self, t, y):
        return y.x - self.c


class Signs(NamedTuple):
    z: Array  # integrals of the three switch values
    q: Array  # the third guard, as a state


class Roots(nsjax.System):
    """Three switches whose guards are quartics in t with prescribed roots: two of them explicit functions of time,
    the third a state. Its solution records on which side each of them was, and for how long."""

    roots: Array  # (3, 4)
    scale: Array  # (3,)

    def quartic(self, k, t):
        return self.scale[k] * jnp.prod(t - self.roots[k])

    def start(self):
        return Signs(jnp.zeros(3), self.quartic(2, 0.0))

    def vector_field(self, t, y, s):
        rate = jax.jvp(lambda t: self.quartic(2, t), (t,), (jnp.ones_like(t),))[1]
        return Signs(jnp.stack([s.a, s.b, s.c]), rate)

    @nsjax.sgn
    def a(self, t, y):
        return self.quartic(0, t)

    @nsjax.sgn
    def b(self, t, y):
        return self.quartic(1, t)

    @nsjax.sgn
    def c(self, t, y):
        return y.q


class Puck(NamedTuple):
    x: Array
    v: Array
    u: Array


class Bumper(nsjax.System):
    """A puck that bounces between walls x >= -1 and x <= 1, with dry friction on v (its sign flips at every impact,
    pitfall 35), a relay on v that every impact may switch, and a clock that changes the friction at t = t_c."""

    order: tuple[int, ...] = (0, 1, 2, 3, 4)
    e: float = 0.9
    mu: float = 0.1
    t_c: float = 2.0

    @property
    def switches(self):
        found = super().switches
        return tuple(found[i] for i in self.order)

    def vector_field(self, t, y, s):
        friction = self.mu * (1.5 + 0.5 * s.clock) * s.rub
        return Puck(y.v, -friction + s.left - s.right, s.motor)

    @nsjax.impact
    def left(self, t, y):
        return y.x + 1

    @left.restitution
    def left(self):
        return self.e

    @nsjax.impact
    def right(self, t, y):
        return 1 - y.x

    @right.restitution
    def right(self):
        return self.e

    @nsjax.sgn
    def rub(self, t, y):
        return y.v

    @nsjax.relay
    def motor(self, t, y):  # on when moving right fast enough, off when moving left fast enough
        return y.v - 0.5

    @motor.off
    def motor(self, t, y):
        return -0.5 - y.v

    @nsjax.sgn
    def clock(self, t, y):
        return t - self.t_c


def with_change(entry, solver):
    """The solution of an entry of the gallery, and how its end changes as start and state there do, all at once."""
    control, end = pid(1e-12), min(entry.t1, 30.0)

    def run(t0, y0):
        sol = solve(
            entry.system(), t0, end, y0, solver=solver, stepsize_controller=control, throw=False, max_steps=20_000
        )
        return sol.y1, sol

    start = jnp.asarray(float(entry.t0)), jax.tree.map(jnp.asarray, entry.y0)
    _, change, sol = jax.jvp(run, start, jax.tree.map(jnp.ones_like, start), has_aux=True)
    return sol, change


class Support(nsjax.System):
    """x'' + c x' + x = cos ωt before a visco-elastic support at x_c, whose damper makes multipliers jump at a touch."""

    c: float = 0.1
    k_f: float = 4.0
    c_f: float = 1.0
    x_c: float = 3.0
    omega: float = 1.14

    def vector_field(self, t, y, s):
        force = self.wall(t, y)[1] * (1 + s.wall) / 2
        return Motion(y.v, jnp.cos(self.omega * t) - self.c * y.v - y.x - force)

    @nsjax.sgn
    def wall(self, t, y):
        return y.x - self.x_c, self.k_f * (y.x - self.x_c) + self.c_f * y.v

    @property
    def period(self):
        return 2 * jnp.pi / self.omega


class Duffing(nsjax.System):
    """x'' + c x' + x + x³ = F cos ωt."""

    c: float = 0.2
    F: float = 1.0
    omega: float = 1.0

    def vector_field(self, t, y, s):
        return Motion(y.v, self.F * jnp.cos(self.omega * t) - self.c * y.v - y.x - y.x**3)

    @property
    def period(self):
        return 2 * jnp.pi / self.omega


class Stop(nsjax.System):
    """x'' + c x' + x = f_0 cos ωt, x <= gap with restitution e."""

    e: float = 0.7
    c: float = 0.1
    f_0: float = 1.0
    gap: float = 0.2
    omega: float = 1.3

    def vector_field(self, t, y, s):
        return Motion(y.v, self.f_0 * jnp.cos(self.omega * t) - self.c * y.v - y.x - s.stop)

    @nsjax.impact
    def stop(self, t, y):
        return self.gap - y.x

    @stop.restitution
    def stop(self):
        return self.e

    @property
    def period(self):
        return 2 * jnp.pi / self.omega


CHEAP = dict(solver=dfx.Heun(), stepsize_controller=pid(1e-4))  # quick to compile; accuracy is not the point


class TableBall(nsjax.System):
    """`reference.ball_on_table`: lands, bounces, rests, lifts off and lands again."""

    a: float = 1.2
    w: float = 1.0
    g: float = 1.0
    e: float = 0.4

    def vector_field(self, t, y, s):
        return Motion(y.v, -self.g + s.table)

    @nsjax.impact
    def table(self, t, y):
        return y.x - self.a * jnp.cos(self.w * t)

    @table.restitution
    def table(self):
        return self.e


class Touch(nsjax.System):
    """x = cos t from t = -π on, with a wall at 1 + gap, which it touches at t = 0 if gap = 0."""

    gap: float = 0.0
    e: float = 0.5

    def vector_field(self, t, y, s):
        return Motion(y.v, -y.x - s.wall)

    @nsjax.impact
    def wall(self, t, y):
        return 1 + self.gap - y.x

    @wall.restitution
    def wall(self):
        return self.e


def impact(gap, e=0.5):
    """State at t = 3 in closed form."""
    wall = 1 + gap
    hit = jnp.arccos(jnp.minimum(wall, 1.0))
    v = -e * jnp.sin(hit)
    late = 3.0 + hit
    return jnp.stack([wall * jnp.cos(late) + v * jnp.sin(late), -wall * jnp.sin(late) + v * jnp.cos(late)])


class Beats(NamedTuple):
    x: float
    phase: float


class Logistic(nsjax.System):
    """At each beat x becomes a x (1 - x). A switch tells on which side of a threshold x is, and does nothing."""

    a: float = 3.2
    middle: float = 0.6
    pause: float = 1.0  # between beats

    def vector_field(self, t, y, s):
        return Beats(jnp.zeros_like(y.x), 1 / self.pause + jnp.zeros_like(y.phase))

    @nsjax.impact
    def beat(self, t, y):
        return 1 - y.phase

    @beat.reset
    def beat(self, t, y):
        return Beats(self.a * y.x * (1 - y.x), y.phase - 1)

    @nsjax.sgn
    def side(self, t, y):
        return y.x - self.middle
