"""The largest Lyapunov exponent of two forced oscillators, many solutions side by side, in NumPy and in closed form
between events: x'' + c x' + x = a cos(ω t) + force.

Nothing of nsjax, and nothing like it: fixed steps, sign changes by cubics through their ends, roots by bisection,
perturbations by the formulas of their jumps.
"""

import numpy as np


class Oscillator:
    """Between events."""

    def __init__(self, a, omega, c=0.0):
        self.a, self.omega, self.c = a, omega, c
        self.period = 2 * np.pi / omega
        self.response = a / (1 - omega**2 + 1j * c * omega)

    def forced(self, t):
        wave = self.response * np.exp(1j * self.omega * t)
        return wave.real, (1j * self.omega * wave).real

    def propagator(self, tau):
        """Columns by column: of x'' + c x' + x = 0."""
        w, d = np.sqrt(1 - self.c**2 / 4), np.exp(-self.c * tau / 2)
        cos, sin = d * np.cos(w * tau), d * np.sin(w * tau) / w
        return cos + self.c / 2 * sin, sin, -sin, cos - self.c / 2 * sin

    def move(self, t, x, v, force, tau):
        px, pv = self.forced(t)
        e = self.propagator(tau)
        dx, dv = x - px - force, v - pv
        px, pv = self.forced(t + tau)
        return px + force + e[0] * dx + e[1] * dv, pv + e[2] * dx + e[3] * dv

    def acceleration(self, t, x, v, force):
        return self.a * np.cos(self.omega * t) + force - x - self.c * v


class ImpactOscillator(Oscillator):
    """With a wall at x = 0 and Newton's restitution."""

    def __init__(self, a, omega, c, e):
        super().__init__(a, omega, c)
        self.e = e

    def start(self, rng, lanes):
        return -0.5 + rng.uniform(-0.1, 0.1, lanes), rng.uniform(0, 0.2, lanes), np.zeros(lanes, int)

    def step(self, t, x, v, mode, tau):
        return self.move(t, x, v, 0.0, tau)

    def tangent(self, mode, p, q, tau):
        e = self.propagator(tau)
        return e[0] * p + e[1] * q, e[2] * p + e[3] * q

    def guard(self, t, x, v, mode):
        """Positive until the event; and its rate."""
        return -x, -v

    def jump(self, t, x, v, mode, p, q):
        before = self.acceleration(t, x, v, 0.0)
        after = self.acceleration(t, x, -self.e * v, 0.0)
        turn = (after + self.e * before) / v
        return np.zeros_like(x), -self.e * v, mode, -self.e * p, turn * p - self.e * q


class StickSlip(Oscillator):
    """On a belt: Coulomb friction of size 1 in slip, up to `stick` at rest; mode: the sign of the slip, 0 for stick."""

    def __init__(self, a, omega, belt, stick):
        super().__init__(a, omega)
        self.belt, self.stick = belt, stick

    def start(self, rng, lanes):
        return rng.uniform(-1, 1, lanes), rng.uniform(-2, 0.9, lanes) * self.belt, np.full(lanes, -1)

    def load(self, t, x):
        return self.a * np.cos(self.omega * t) - x

    def step(self, t, x, v, mode, tau):
        slip = self.move(t, x, v, -mode, tau)
        return np.where(mode == 0, x + self.belt * tau, slip[0]), np.where(mode == 0, self.belt, slip[1])

    def tangent(self, mode, p, q, tau):
        e = self.propagator(tau)
        return np.where(mode == 0, p, e[0] * p + e[1] * q), np.where(mode == 0, 0.0, e[2] * p + e[3] * q)

    def guard(self, t, x, v, mode):
        load = self.load(t, x)
        rate = -self.a * self.omega * np.sin(self.omega * t) - self.belt
        slip, bend = mode * (v - self.belt), mode * self.acceleration(t, x, v, -mode)
        return (
            np.where(mode == 0, self.stick - np.abs(load), slip),
            np.where(mode == 0, -np.sign(load) * rate, bend),
        )

    def jump(self, t, x, v, mode, p, q):
        load = self.load(t, x)
        rate = -self.a * self.omega * np.sin(self.omega * t) - self.belt
        side = np.sign(load).astype(int)
        passes = np.abs(load) > self.stick  # from one slip to the other
        later = np.where(mode == 0, side, np.where(passes, side, 0))
        leaves = (side - load) * p / rate  # the end of stick is later by p / rate
        ratio = (load - side) / np.where(mode == 0, 1.0, load - mode)
        q = np.where(mode == 0, leaves, np.where(passes, ratio * q, 0.0))
        return x, np.full_like(v, self.belt), later, p, q


def _cubic(g0, r0, g1, r1, h, s):
    """Hermite's, at the part s of a step."""
    return (
        (1 + 2 * s) * (1 - s) ** 2 * g0 + s * (1 - s) ** 2 * h * r0 + s**2 * (3 - 2 * s) * g1 + s**2 * (s - 1) * h * r1
    )


INSIDE = np.linspace(0, 1, 12)[1:-1, None]


def mean_of_finite(rates):
    """The mean, and its standard error, of solutions that never come to rest, which are nearly all."""
    rates = rates[np.isfinite(rates)]
    return rates.mean(), rates.std(ddof=1) / np.sqrt(len(rates))


def largest_exponent(system, lanes, transient, span, steps=48, seed=0):
    """The mean of the largest exponent over `lanes` solutions and `span` periods each, and its standard error."""
    rng = np.random.default_rng(seed)
    x, v, mode = system.start(rng, lanes)
    p, q = rng.standard_normal((2, lanes))
    h, logs = system.period / steps, []
    for n in range(transient + span):
        for k in range(steps):
            x, v, mode, p, q = _across(system, k * h, h, x, v, mode, p, q)
        size = np.hypot(p, q)
        p, q = p / size, q / size
        if n >= transient:
            logs.append(np.log(size))
    rates = np.mean(logs, axis=0) / system.period
    return mean_of_finite(rates)


def after(system, x, v, periods, steps=48):
    """The states `periods` later."""
    x, v, mode = np.array(x), np.array(v), np.zeros(len(x), int)
    h = system.period / steps
    for k in range(periods * steps):
        x, v, mode, *_ = _across(system, k % steps * h, h, x, v, mode, np.zeros_like(x), np.zeros_like(x))
    return x, v


def _across(system, begin, h, x, v, mode, p, q):
    """One step, in pieces where there are events."""
    t, left = np.full_like(x, begin), np.full_like(x, h)
    active = np.arange(len(x))
    for _ in range(100):  # impacts that lead to rest are not followed
        if not len(active):
            return x, v, mode, p, q
        here = t[active], x[active], v[active], mode[active]
        tau = left[active]
        x1, v1 = system.step(*here, tau)
        g0, r0 = system.guard(*here)
        g1, r1 = system.guard(here[0] + tau, x1, v1, here[3])
        low = np.where((r0 < 0) & (r1 > 0), _cubic(g0, r0, g1, r1, tau, INSIDE).min(axis=0), g1)
        event = np.minimum(g1, low) < 0
        if event.any():
            tau[event] = _root(system, [z[event] for z in here], tau[event], g1[event] >= 0)
            x1, v1 = system.step(*here, tau)
        p1, q1 = system.tangent(here[3], p[active], q[active], tau)
        mode1, t1 = here[3].copy(), here[0] + tau
        if event.any():
            part = [z[event] for z in (t1, x1, v1, here[3], p1, q1)]
            x1[event], v1[event], mode1[event], p1[event], q1[event] = system.jump(*part)
        x[active], v[active], mode[active], p[active], q[active] = x1, v1, mode1, p1, q1
        t[active], left[active] = t1, left[active] - tau
        active = active[event & (left[active] > 0)]
    x[active], p[active] = np.nan, np.nan
    return x, v, mode, p, q


def _root(system, here, tau, inside):
    """By bisection; up to the lowest point of the guard where it comes back within the step."""
    if inside.any():
        low, high = np.zeros_like(tau), tau.copy()
        for _ in range(50):  # where the rate changes its sign
            middle = (low + high) / 2
            x, v = system.step(*here, middle)
            falls = system.guard(here[0] + middle, x, v, here[3])[1] < 0
            low, high = np.where(falls, middle, low), np.where(falls, high, middle)
        tau = np.where(inside, low, tau)
    low, high = np.zeros_like(tau), tau.copy()
    for _ in range(50):
        middle = (low + high) / 2
        x, v = system.step(*here, middle)
        above = system.guard(here[0] + middle, x, v, here[3])[0] > 0
        low, high = np.where(above, middle, low), np.where(above, high, middle)
    return high
