"""Reference solutions that share nothing with nsjax: exact arcs, closed forms, 40-digit arithmetic.

Every system here but that of section 2.4 is piecewise linear. Between events its displacement is a sum of exponentials,
whose first root is isolated rigorously by Taylor bounds (`ExpSum.first_root`); so no tolerance enters anywhere.
Fundamental matrices are products of exact transition matrices and saltation matrices (3.30); `derivative` (central
differences in 40 digits) gives the same and any parameter's derivative by a second route.

Parameters are taken as the doubles they are. `simulate` carries mpmath numbers; `solution` and the orbits are float64.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, fields
from functools import partial, reduce
from typing import Any, NamedTuple

import mpmath
import numpy as np


mp = mpmath.MPContext()  # a context of our own: the global precision is left alone
mp.dps = 40
ON_SURFACE = mp.mpf("1e-30")  # |g| below this at the start of an arc: the arc starts on the surface g = 0


class Grazing(ArithmeticError):
    """A double root: the trajectory touches a surface, and its derivative does not exist."""


def floats(a: Any) -> np.ndarray:
    """Rounds an mpmath matrix or a sequence of numbers to float64."""
    return np.array(a.tolist() if isinstance(a, mp.matrix) else a, dtype=float)


def derivative(fn: Callable[..., Sequence], *at: float, h: float = 1e-13) -> np.ndarray:
    """Jacobian d fn / d at, by central differences in 40 digits; relative error about h² = 1e-26."""
    h, at = mp.mpf(h), [mp.mpf(a) for a in at]
    columns = []
    for i in range(len(at)):
        high, low = (fn(*at[:i], at[i] + d, *at[i + 1 :]) for d in (h, -h))
        columns.append([(b - a) / (2 * h) for a, b in zip(low, high)])
    return floats(columns).T


def second_derivative(fn: Callable[..., Sequence], *at: float, h: float = 1e-10) -> np.ndarray:
    """d² fn / d at², of shape (len(fn), len(at), len(at)), by central differences in 40 digits; error about 1e-20."""
    h, at = mp.mpf(h), [mp.mpf(a) for a in at]

    def shifted(i: int, a: int, j: int, b: int) -> Sequence:
        return fn(*(x + h * (a * (k == i) + b * (k == j)) for k, x in enumerate(at)))

    n = range(len(at))
    signs = [(1, 1), (1, -1), (-1, 1), (-1, -1)]
    rows = [[[[a * b * y for y in shifted(i, a, j, b)] for a, b in signs] for j in n] for i in n]
    return np.moveaxis(floats([[[sum(y) / (4 * h * h) for y in zip(*four)] for four in row] for row in rows]), -1, 0)


def crossing_flow(t1: Any, x0: Any, v0: Any, a: Any, c: Any) -> list:
    """x'' = -a sgn(x - c) from x0 > c until t1 before the second crossing: (x, v, time of the first crossing)."""
    root = mp.sqrt(v0**2 + 2 * a * (x0 - c))
    t = (v0 + root) / a
    tau = mp.mpf(t1) - t
    return [c - root * tau + a * tau**2 / 2, -root + a * tau, t]


def sliding_flow(t1: Any, x0: Any, v0: Any, w: Any, F: Any, b: Any) -> list:
    """x'' = w t - F Sgn(x'), breakaway b, from v0 > 0: slips to rest, sticks while w t <= b F, and slips again:
    (x, v, start and end of stick). For b = 1 the end of stick is tangential; the derivative by b is one-sided then."""
    t1, start, end = mp.mpf(t1), (F - mp.sqrt(F**2 - 2 * w * v0)) / w, b * F / w
    rest, tau = x0 + v0 * start + w * start**3 / 6 - F * start**2 / 2, t1 - end
    return [rest + w * tau**3 / 6 + (b - 1) * F * tau**2 / 2, w * tau**2 / 2 + (b - 1) * F * tau, start, end]


def impact_flow(t1: Any, x0: Any, v0: Any, g: Any, e: Any) -> list:
    """A ball until t1 between its first and second impact: (x, v, time of the impact)."""
    V = mp.sqrt(v0**2 + 2 * g * x0)
    t = (v0 + V) / g
    tau = mp.mpf(t1) - t
    return [e * V * tau - g * tau**2 / 2, e * V - g * tau, t]


@dataclass(frozen=True)
class ExpSum:
    """g(τ) = p0 + p1 τ + p2 τ² + Re Σ a exp(λ τ) for τ >= 0."""

    poly: tuple
    terms: tuple[tuple, ...]  # pairs (a, λ), complex

    def __call__(self, tau: Any, n: int = 0) -> Any:
        """The n-th derivative at τ."""
        p0, p1, p2 = self.poly
        poly = (p0 + tau * (p1 + tau * p2), p1 + 2 * tau * p2, 2 * p2)[n] if n < 3 else 0
        return poly + sum((a * lam**n * mp.exp(lam * tau)).real for a, lam in self.terms)

    def bound(self, n: int, stop: Any) -> Any:
        """An upper bound of the n-th derivative's modulus on [0, stop]."""
        p0, p1, p2 = map(abs, self.poly)
        poly = (p0 + stop * (p1 + stop * p2), p1 + 2 * stop * p2, 2 * p2)[n] if n < 3 else 0
        return poly + sum(abs(a * lam**n) * max(1, mp.exp(lam.real * stop)) for a, lam in self.terms)

    def combine(self, alpha: Any, beta: Any, delta: Any) -> "ExpSum":
        """α g + β g' + δ."""
        p0, p1, p2 = self.poly
        poly = (alpha * p0 + beta * p1 + delta, alpha * p1 + 2 * beta * p2, alpha * p2)
        return ExpSum(poly, tuple((a * (alpha + beta * lam), lam) for a, lam in self.terms))

    def first_root(self, stop: Any) -> Any:
        """The first root in (0, stop], or None; a root at 0 itself (the surface being left) does not count."""
        start = mp.mpf(0)
        if abs(self(start)) < ON_SURFACE:
            n = next((n for n in (1, 2, 3) if abs(self(start, n)) > ON_SURFACE), None)
            if n is None:
                raise Grazing("The arc stays on the surface.")
            # g = g_n τ^n / n! + R with |R| <= M τ^(n+1) / (n+1)!: no root before τ = (n + 1) |g_n| / M
            start = (n + 1) * abs(self(start, n)) / self.bound(n + 1, stop) / 2 if self.bound(n + 1, stop) else stop
            if start >= stop:
                return None
        curvature = self.bound(2, stop)
        pending = [(start, stop, self(start), self(stop))]
        while pending:
            a, b, ga, gb = pending.pop()
            width, mid = b - a, (a + b) / 2
            if ga * gb > 0 and min(abs(ga), abs(gb)) > curvature * width**2 / 8:
                continue  # the chord is farther from zero than g can be from the chord
            if abs(self(mid, 1)) > curvature * width / 2:  # monotone
                if ga * gb <= 0:
                    return self._polish(a, b, ga)
                continue
            if width**2 < ON_SURFACE:  # below it the sign of g is rounding
                raise Grazing(f"A double root near τ = {mp.nstr(mid, 17)}.")
            gm = self(mid)
            pending += [(mid, b, gm, gb), (a, mid, ga, gm)]  # the earlier half on top
        return None

    def _polish(self, a: Any, b: Any, ga: Any) -> Any:
        """Newton's method on a bracket that holds exactly one simple root."""
        tau = (a + b) / 2
        noise = (
            100 * mp.eps * self.bound(0, b)
        )  # of g by rounding: the flatter g, the farther apart Newton's last steps
        for _ in range(200):
            g = self(tau)
            if abs(g) < noise:
                return tau - g / self(tau, 1)
            a, b = (tau, b) if g * ga > 0 else (a, tau)
            new = tau - g / self(tau, 1)
            new = new if a <= new <= b else (a + b) / 2
            if abs(new - tau) < 10 * mp.eps * max(1, abs(tau)):
                return new
            tau = new
        raise ArithmeticError("Newton's method did not converge.")


class Oscillator(NamedTuple):
    """m x'' + c x' + k x = b + f_0 cos ωt."""

    m: Any
    c: Any
    k: Any
    b: Any = mp.mpf(0)
    f_0: Any = mp.mpf(0)
    omega: Any = mp.mpf(1)

    def arc(self, t: Any, x: Any, v: Any) -> ExpSum:
        """The displacement x(t + τ), exactly."""
        m, c, k, b, f_0, omega = self
        forced = f_0 / mp.mpc(k - m * omega**2, c * omega) * mp.expj(omega * t) if f_0 else mp.mpc(0)
        terms = ((forced, mp.mpc(0, omega)),) if f_0 else ()
        x, v = x - forced.real, v + omega * forced.imag
        if not k and not c:
            return ExpSum((x, v, b / (2 * m)), terms)
        root = mp.sqrt(mp.mpc(c**2 - 4 * m * k))
        if not k or not root:
            raise NotImplementedError("Critical damping, and damping without a spring.")
        l1, l2 = (-c + root) / (2 * m), (-c - root) / (2 * m)
        x = x - b / k
        return ExpSum(
            (b / k, mp.mpf(0), mp.mpf(0)),
            (((v - l2 * x) / (l1 - l2), l1), ((l1 * x - v) / (l1 - l2), l2), *terms),
        )

    def transition(self, tau: Any) -> Any:
        """Fundamental matrix of one arc."""
        free = [Oscillator(self.m, self.c, self.k).arc(0, mp.mpf(x), mp.mpf(1 - x)) for x in (1, 0)]
        return mp.matrix([[arc(tau, n) for arc in free] for n in (0, 1)])


class Surface(NamedTuple):
    """The surface α x + β v + δ = 0."""

    alpha: Any
    beta: Any
    delta: Any


class Event(NamedTuple):
    """An event: the state after it, and its saltation matrix (3.30)."""

    t: Any
    kind: str
    x: Any
    v: Any
    saltation: Any


class Path(NamedTuple):
    """A trajectory: its events, the state (x, v) at its end and the fundamental matrix d y(t1) / d y(t0)."""

    events: list[Event]
    y: tuple[Any, Any]
    fundamental: Any


@dataclass(frozen=True)
class Machine:
    """A piecewise linear oscillator. A subclass says for each mode which oscillator it is and which surfaces end it."""

    def __post_init__(self) -> None:
        for f in fields(self):
            object.__setattr__(self, f.name, mp.mpf(getattr(self, f.name)))

    def mode(self, x: Any, v: Any) -> int:
        """The mode at the start."""
        raise NotImplementedError

    def oscillator(self, mode: int) -> Oscillator:
        raise NotImplementedError

    def surfaces(self, mode: int) -> dict[str, Surface]:
        raise NotImplementedError

    def after(self, surface: str, mode: int, x: Any, v: Any, a: Any) -> tuple[str | None, int, Any, Any]:
        """(kind, mode, x, v) after arriving at a surface with acceleration a; kind None: nothing happens there."""
        raise NotImplementedError

    def jacobian(self, kind: str) -> Any:
        """Jacobian of the state's jump."""
        return mp.eye(2)


def simulate(machine: Machine, t1: Any, y0: Sequence, *, t0: Any = 0, max_events: int = 2000) -> Path:
    """The exact trajectory from y0 = (x, v) at t0 to t1."""
    t, t1, (x, v) = mp.mpf(t0), mp.mpf(t1), (mp.mpf(y) for y in y0)
    mode, fundamental, events = machine.mode(x, v), mp.eye(2), []
    for _ in range(max_events):
        law = machine.oscillator(mode)
        arc = law.arc(t, x, v)
        roots = ((arc.combine(*s).first_root(t1 - t), name) for name, s in machine.surfaces(mode).items())
        tau, name = min([r for r in roots if r[0] is not None], default=(t1 - t, None))
        x, v, a = (arc(tau, n) for n in range(3))
        fundamental = law.transition(tau) * fundamental
        if name is None:
            return Path(events, (x, v), fundamental)
        t, surface, before = t + tau, machine.surfaces(mode)[name], mp.matrix([v, a])
        kind, mode, x, v = machine.after(name, mode, x, v, a)
        if kind is not None:
            after = mp.matrix([v, machine.oscillator(mode).arc(t, x, v)(mp.mpf(0), 2)])
            n, jump = mp.matrix([[surface.alpha, surface.beta]]), machine.jacobian(kind)
            saltation = jump + (after - jump * before) * n / (n * before)[0]
            fundamental = saltation * fundamental
            events.append(Event(t, kind, x, v, saltation))
    raise RuntimeError(f"More than {max_events} events.")


@dataclass(frozen=True)
class StickSlip(Machine):
    """Mass on a moving belt with a static friction point (3.33)-(3.34), read mechanically: a mass that arrives at
    v = v_dr with |F_ex| <= F_stick sticks, and slips when F_ex = k x + c v reaches ±F_stick. Mode: sgn(v_rel)."""

    m: Any = 1
    c: Any = 0
    k: Any = 1
    v_dr: Any = 0.2
    F_slip: Any = 1
    F_stick: Any = 2

    def mode(self, x: Any, v: Any) -> int:
        if v != self.v_dr:
            return 1 if v > self.v_dr else -1
        force = self.k * x + self.c * v
        return 0 if abs(force) <= self.F_stick else -int(mp.sign(force))

    def oscillator(self, mode: int) -> Oscillator:
        return Oscillator(self.m, self.c, self.k, -mode * self.F_slip) if mode else Oscillator(self.m, mp.zero, mp.zero)

    def surfaces(self, mode: int) -> dict[str, Surface]:
        if mode:
            return {"belt": Surface(mp.zero, mp.one, -self.v_dr)}  # (3.36)
        limit = mp.sign(self.v_dr) * self.F_stick
        return {"slip": Surface(self.k, mp.zero, self.c * self.v_dr - limit)} if self.v_dr else {}  # (3.38)

    def after(self, surface: str, mode: int, x: Any, v: Any, a: Any) -> tuple[str | None, int, Any, Any]:
        if surface == "slip":
            return "slip", -int(mp.sign(self.v_dr)), x, self.v_dr
        sticks = abs(self.k * x + self.c * self.v_dr) <= self.F_stick
        return ("stick", 0, x, self.v_dr) if sticks else ("cross", -mode, x, self.v_dr)


@dataclass(frozen=True)
class Support(Machine):
    """Discontinuous support, section 3.5: m x'' + c x' + k x (+ k_f (x - x_c) + c_f x' in contact) = f_0 cos ωt.

    Contact (mode 1) is where min(x - x_c, k_f (x - x_c) + c_f x') > 0.
    """

    m: Any = 1
    c: Any = 0
    k: Any = 1
    k_f: Any = 4
    c_f: Any = 0.5
    f_0: Any = 1
    omega: Any = 1.4
    x_c: Any = 0

    def mode(self, x: Any, v: Any) -> int:
        return int(x > self.x_c and self.k_f * (x - self.x_c) + self.c_f * v > 0)

    def oscillator(self, mode: int) -> Oscillator:
        c, k, b = mode * self.c_f, mode * self.k_f, mode * self.k_f * self.x_c
        return Oscillator(self.m, self.c + c, self.k + k, b, self.f_0, self.omega)

    def surfaces(self, mode: int) -> dict[str, Surface]:
        gap = {"gap": Surface(mp.one, mp.zero, -self.x_c)}  # (3.46)
        force = {"force": Surface(self.k_f, self.c_f, -self.k_f * self.x_c)}  # (3.47)
        return gap | force if self.c_f else gap

    def after(self, surface: str, mode: int, x: Any, v: Any, a: Any) -> tuple[str | None, int, Any, Any]:
        if surface == "gap":
            x, contact = self.x_c, v > 0  # there the contact force is c_f v
        else:
            v, contact = -self.k_f * (x - self.x_c) / self.c_f, x > self.x_c and self.k_f * v + self.c_f * a > 0
        kind = None if contact == mode else "contact" if contact else "release"
        return kind, int(contact), x, v


@dataclass(frozen=True)
class ImpactOscillator(Machine):
    """m x'' + c x' + k x = b + f_0 cos ωt with a wall at x_w and Newton's restitution e (no accumulation)."""

    m: Any = 1
    c: Any = 0.02
    k: Any = 1
    b: Any = 0
    f_0: Any = 1
    omega: Any = 0.8
    x_w: Any = 0.5
    e: Any = 0.8

    def mode(self, x: Any, v: Any) -> int:
        return 0

    def oscillator(self, mode: int) -> Oscillator:
        return Oscillator(self.m, self.c, self.k, self.b, self.f_0, self.omega)

    def surfaces(self, mode: int) -> dict[str, Surface]:
        return {"wall": Surface(mp.one, mp.zero, -self.x_w)}

    def after(self, surface: str, mode: int, x: Any, v: Any, a: Any) -> tuple[str | None, int, Any, Any]:
        return "impact", 0, self.x_w, -self.e * v

    def jacobian(self, kind: str) -> Any:
        return mp.diag([1, -self.e])


class Solution(NamedTuple):
    """A trajectory rounded to float64: `events` are (t, kind, x, v), `y` = (x, v)(t1), and its `derivative` with
    respect to (x0, v0, *wrt), of shape (2, 2 + len(wrt))."""

    events: list[tuple[float, str, float, float]]
    y: np.ndarray
    derivative: np.ndarray


def solution(
    machine: type[Machine], t1: float, y0: Sequence[float], *, wrt: Sequence[str] = (), **parameters: float
) -> Solution:
    """`solution(StickSlip, 100.0, (2.5, -0.5), wrt=("v_dr", "F_slip", "k"), c=0.1)`.

    The start must not lie on a surface: there the derivative is one-sided."""
    system = machine(**parameters)

    def final(x: Any, v: Any, *changed: Any) -> Sequence:
        return simulate(machine(**parameters | dict(zip(wrt, changed))), t1, (x, v)).y

    path = simulate(system, t1, y0)
    return Solution(
        _rounded(path.events), floats(path.y), derivative(final, *y0, *(getattr(system, name) for name in wrt))
    )


class Orbit(NamedTuple):
    """A periodic orbit, rounded to float64: from y0 at t0 = 0; `events` are (t, kind, x, v)."""

    period: float
    y0: np.ndarray
    events: list[tuple[float, str, float, float]]
    monodromy: np.ndarray
    multipliers: np.ndarray


def _rounded(events: list) -> list[tuple[float, str, float, float]]:
    return [(float(t), kind, float(x), float(v)) for t, kind, x, v, *_ in events]


def _orbit(period: Any, y0: Sequence, events: list, monodromy: Any) -> Orbit:
    monodromy = floats(monodromy)
    multipliers = np.linalg.eigvals(monodromy)
    order = np.argsort(-abs(multipliers))
    return Orbit(float(period), floats(y0), _rounded(events), monodromy, multipliers[order])


def stick_slip_orbit(**parameters: float) -> Orbit | None:
    """The stable stick-slip orbit of sections 3.4 and 6.7 (v_dr > 0) from its maximum of x; None if there is none.

    It leaves stick where k x + c v_dr = F_stick, so one slip arc gives it; no iteration."""
    system = StickSlip(**parameters)
    x_exit = (system.F_stick - system.c * system.v_dr) / system.k
    arc = system.oscillator(-1).arc(0, x_exit, system.v_dr)
    try:
        slip = arc.combine(*system.surfaces(-1)["belt"]).first_root(4 * mp.pi * mp.sqrt(system.m / system.k))
    except Grazing:
        return None
    if slip is None or abs(system.k * arc(slip) + system.c * system.v_dr) > system.F_stick:
        return None
    period = slip + (x_exit - arc(slip)) / system.v_dr
    top = arc.combine(mp.zero, mp.one, mp.zero).first_root(slip)
    y0 = (arc(top), mp.zero)
    path = simulate(system, period, y0)
    return _orbit(period, y0, path.events, path.fundamental)


def infinitely_unstable_orbit(c: float, v_dr: float) -> tuple[float, float, float]:
    """Duration of the slip of the unstable orbit of section 6.7, x where it leaves the belt, and its period: backwards
    from where it touches the belt's velocity, at k x + c v_dr = F_slip (m = k = F_slip = 1)."""
    c, v = mp.mpf(c), mp.mpf(v_dr)
    a, w = -c / 2, mp.sqrt(1 - c * c / 4)

    def moves(t: Any) -> tuple[Any, Any]:
        p, q = -c * v, (v + a * c * v) / w
        e, cos, sin = mp.exp(a * t), mp.cos(w * t), mp.sin(w * t)
        return 1 + e * (p * cos + q * sin), e * ((a * p + q * w) * cos + (a * q - p * w) * sin)

    start = mp.findroot(lambda t: moves(t)[1] - v, (-6, -5), solver="anderson")
    slides = (moves(start)[0] - (1 - c * v)) / v
    return float(-start), float(moves(start)[0]), float(slides - start)


def symmetric_friction_orbit(w: Any, guess: Sequence[float], c: Any = 0.01, f_0: Any = 2.5, stick: Any = 2) -> tuple:
    """The symmetric orbit of section 6.8 with two stick phases (m = k = F_slip = 1): when it breaks away upwards and
    where, when it sticks again (at minus that place), and the square of the derivative of that map of half a period."""
    w, c, f_0, stick = (mp.mpf(p) for p in (w, c, f_0, stick))
    a, wd = -c / 2, mp.sqrt(1 - c * c / 4)
    response = f_0 / (1 - w * w + mp.mpc(0, 1) * c * w)

    def slip(t_0: Any, x: Any, t: Any) -> tuple[Any, Any]:
        def forced(t: Any) -> tuple[Any, Any]:
            z = response * mp.exp(mp.mpc(0, 1) * w * t)
            return z.real - 1, (mp.mpc(0, w) * z).real

        p, q = x - forced(t_0)[0], -forced(t_0)[1]
        q, tau = (q - a * p) / wd, t - t_0
        e, cos, sin = mp.exp(a * tau), mp.cos(wd * tau), mp.sin(wd * tau)
        moves = e * (p * cos + q * sin), e * ((a * p + q * wd) * cos + (a * q - p * wd) * sin)
        return moves[0] + forced(t)[0], moves[1] + forced(t)[1]

    def equations(t_0: Any, x: Any, t: Any) -> tuple:
        end = slip(t_0, x, t)
        return f_0 * mp.cos(w * t_0) - x - stick, end[1], end[0] + x

    t_0, x, t = mp.findroot(equations, guess)

    def halved(x: Any) -> Any:
        start = mp.findroot(lambda s: f_0 * mp.cos(w * s) - x - stick, t_0)
        return slip(start, x, mp.findroot(lambda s: slip(start, x, s)[1], t))[0]

    return float(t_0), float(x), float(t), float(mp.diff(halved, x) ** 2)


def stick_slip_fold(c: float = 0.1, **parameters: float) -> tuple[float, float]:
    """(v_dr, x at the maximum) of the discontinuous fold of Fig. 6.15, where the slip arc that leaves stick returns to
    the belt's velocity tangentially, at k x + c v_dr = F_slip."""

    def touch(v_dr: Any, tau: Any) -> tuple[Any, Any]:
        system = StickSlip(c=c, v_dr=v_dr, **parameters)
        arc = system.oscillator(-1).arc(0, (system.F_stick - system.c * v_dr) / system.k, v_dr)
        return arc(tau, 1) - v_dr, arc(tau, 2)

    v_dr, tau = mp.findroot(touch, (mp.mpf(1.1), mp.mpf(4.6)))
    system = StickSlip(c=c, v_dr=v_dr, **parameters)
    arc = system.oscillator(-1).arc(0, (system.F_stick - system.c * v_dr) / system.k, v_dr)
    return float(v_dr), float(arc(arc.combine(mp.zero, mp.one, mp.zero).first_root(tau)))


def stick_slip_period(
    v_dr: Any = 0.2, m: float = 1.0, k: float = 1.0, F_slip: float = 1.0, F_stick: float = 2.0
) -> Any:
    """Period of the orbit of section 3.4 (c = 0), in closed form; a numpy array of v_dr will do.

    Stick from x = (2 F_slip - F_stick) / k to F_stick / k, then a circular arc of π + 2 atan(√(m k) v_dr / ΔF)."""
    excess = F_stick - F_slip
    return 2 * excess / (k * v_dr) + np.sqrt(m / k) * (np.pi + 2 * np.arctan2(np.sqrt(m * k) * v_dr, excess))


def stick_slip_final(
    v_dr: np.ndarray,
    t1: float = 100.0,
    x0: float = 2.5,
    v0: float = -0.5,
    m: float = 1.0,
    k: float = 1.0,
    F_slip: float = 1.0,
    F_stick: float = 2.0,
) -> np.ndarray:
    """Final states (lanes, 2) of workload S1 in closed form: section 3.4 with c = 0 from a slip (v0 < v_dr) that ends
    in stick, for an array of v_dr; error a few 1e-14."""
    v_dr = np.asarray(v_dr, dtype=float)
    rate, centre, x_exit = np.sqrt(k / m), F_slip / k, F_stick / k
    radius = np.hypot(x0 - centre, v0 / rate)
    if not np.all((v0 < v_dr) & (v_dr < rate * radius)):
        raise ValueError("The first slip must reach the velocity of the belt.")
    x_entry = centre - np.sqrt(radius**2 - (v_dr / rate) ** 2)
    if not np.all(abs(x_entry) <= x_exit):
        raise ValueError("The first arrival at the belt must stick.")
    # slip turns clockwise in the plane (x - centre, v / rate)
    first = (np.arctan2(v0 / rate, x0 - centre) - np.arctan2(v_dr / rate, x_entry - centre)) % (2 * np.pi) / rate
    exit_time = first + (x_exit - x_entry) / v_dr
    period = stick_slip_period(v_dr, m, k, F_slip, F_stick)
    stick = 2 * (x_exit - centre) / v_dr

    def slip(tau: np.ndarray, x: Any, v: Any) -> np.ndarray:
        c, s, x = np.cos(rate * tau), np.sin(rate * tau), x - centre
        return np.stack(np.broadcast_arrays(centre + x * c + v / rate * s, v * c - rate * x * s), -1)

    since = np.mod(t1 - exit_time, period)  # since the last exit from stick, once in the periodic orbit
    stuck_for = since - (period - stick)
    later = np.where(
        (stuck_for < 0)[:, None],
        slip(since, x_exit, v_dr),
        np.stack([2 * centre - x_exit + v_dr * stuck_for, v_dr], -1),
    )
    first_stick = np.stack([x_entry + v_dr * (t1 - first), v_dr], -1)
    return np.where((t1 < first)[:, None], slip(t1, x0, v0), np.where((t1 < exit_time)[:, None], first_stick, later))


def support_orbit(y0: Sequence[float], *, periods: int = 1, **parameters: float) -> Orbit:
    """Periodic orbit of the discontinuous support (3.5) near y0 at t = 0, by Newton's method on the exact map."""
    system = Support(**parameters)
    period, y = 2 * mp.pi * periods / system.omega, mp.matrix([mp.mpf(x) for x in y0])
    for _ in range(30):
        path = simulate(system, period, list(y))
        step = mp.lu_solve(path.fundamental - mp.eye(2), y - mp.matrix(path.y))
        y = y + step
        if mp.norm(step) < 1e-28:
            path = simulate(system, period, list(y))
            return _orbit(period, list(y), path.events, path.fundamental)
    raise RuntimeError("Newton's method found no orbit near the guess.")


class Ball(NamedTuple):
    """State (x, v) of a bouncing ball, the impacts before it, and d(x, v) / d(x0, v0, g, e)."""

    y: np.ndarray
    impact_times: np.ndarray
    derivative: np.ndarray
    accumulation: float


def bouncing_ball(t: float, x0: float = 1.0, v0: float = 0.0, g: float = 9.81, e: float = 0.8) -> Ball:
    """x'' = -g, x >= 0, v+ = -e v-: closed form. After the accumulation of impacts (e < 1) the ball rests.

    Impact n = 0, 1, ... is at t_n = (v0 + V + 2 V s_n) / g with V² = v0² + 2 g x0, s_n = e + ... + e^n."""
    V = np.sqrt(v0**2 + 2 * g * x0)
    dV = np.array([g, v0, x0, 0.0]) / V
    d_v0, d_g, d_e = np.eye(4)[1:]
    accumulation = (v0 + V * (1 + e) / (1 - e)) / g if e < 1 else np.inf
    if t >= accumulation:
        raise ValueError("The ball is at rest, after infinitely many impacts.")
    s, ds, times = 0.0, 0.0, []
    while (t_n := (v0 + V * (1 + 2 * s)) / g) <= t:
        n = len(times) + 1
        times.append(t_n)
        dt_n = (d_v0 + dV * (1 + 2 * s) + 2 * V * ds * d_e - t_n * d_g) / g
        s, ds = s + e**n, ds + n * e ** (n - 1)
    n = len(times)
    x, u, tau, dx, du, dtau = x0, v0, t, np.eye(4)[0], d_v0, np.zeros(4)
    if n:
        x, u, tau = 0.0, e**n * V, t - times[-1]
        dx, du, dtau = np.zeros(4), e**n * dV + n * e ** (n - 1) * V * d_e, -dt_n
    v = u - g * tau
    dy = [dx + u * dtau + tau * du - g * tau * dtau - tau**2 / 2 * d_g, du - g * dtau - tau * d_g]
    return Ball(np.array([x + u * tau - g * tau**2 / 2, v]), np.array(times), np.array(dy), float(accumulation))


class Accumulation(NamedTuple):
    """The time at which a bouncing ball comes to rest, and its derivatives by (x0, v0, g, e)."""

    t: Any
    derivative: tuple[Any, Any, Any, Any]


def bouncing_ball_accumulation(x0: Any = 1.0, v0: Any = 0.0, g: Any = 9.81, e: Any = 0.8) -> Accumulation:
    """t = (v0 + V (1 + e) / (1 - e)) / g with V = sqrt(v0² + 2 g x0), in 40 digits.

    The first impact is at t_1 = (v0 + V) / g with velocity V; its flights last 2 V e^n / g, so that
    t = t_1 + (2 V / g) (e + e² + ...) = t_1 + 2 V e / (g (1 - e))."""
    x0, v0, g, e = (mp.mpf(p) for p in (x0, v0, g, e))
    V, ratio = mp.sqrt(v0**2 + 2 * g * x0), (1 + e) / (1 - e)
    t = (v0 + V * ratio) / g
    return Accumulation(
        t, (ratio / V, (1 + v0 / V * ratio) / g, x0 * ratio / (V * g) - t / g, 2 * V / (g * (1 - e) ** 2))
    )


class TableBall(NamedTuple):
    """Times of a ball on an oscillating table, and its velocities (not relative to the table)."""

    first_impact: Any
    first_velocity: Any  # before it
    impacts: list[Any]  # times of those that are told apart, up to flights of 1e-30
    accumulation: Any  # rest begins
    lift_off: Any  # rest ends, None where it never does
    lift_off_velocity: Any
    next_impact: Any
    next_velocity: Any  # before it


def ball_on_table(a: Any = 1.2, w: Any = 1.0, g: Any = 1.0, e: Any = 0.4, gap: Any = 0.5, v0: Any = 0.0) -> TableBall:
    """x'' = -g above a table at a cos(w t), restitution e, from x = a + gap and velocity v0 at t = 0.

    It bounces, its impacts accumulate, it rests on the table while the contact force (for a unit mass)
    g - a w² cos(w t) is positive, lifts off where that vanishes, flies and lands again. Flight by flight in 90 digits;
    beyond flights of 1e-30, where gravity is constant, the rest of the geometric series."""
    with mp.workdps(90):
        a, w, g, e, gap, v0 = (mp.mpf(p) for p in (a, w, g, e, gap, v0))

        def flight(t: Any, height: Any, u: Any) -> ExpSum:
            """The gap from time t on, from a gap `height` and relative velocity u."""
            phase = mp.expj(w * t)
            linear = (height + a * phase.real, u - a * w * phase.imag, -g / 2)
            return ExpSum(linear, ((-a * phase, mp.mpc(0, w)),))

        def pull(t: Any) -> Any:
            return g - a * w**2 * mp.cos(w * t)  # -h''

        def table(t: Any) -> Any:
            return -a * w * mp.sin(w * t)

        long = 10 * mp.pi / w + 10 * (abs(v0) + mp.sqrt(2 * g * gap) + a * w) / g
        arc = flight(mp.zero, gap, v0)
        t = first = arc.first_root(long)
        u, impacts = arc(t, 1), [t]
        velocity = u + table(t)
        while True:
            u, arc = -e * u, flight(t, mp.zero, -e * u)
            guess = 2 * u / pull(t)
            if guess > mp.mpf("1e-4"):
                tau = arc.first_root(long)
            elif pull(t) <= 0:
                raise ValueError("The table falls away faster than the ball where its impacts accumulate.")
            elif guess < mp.mpf("1e-30"):
                break
            else:  # h'' changes by one part in ten thousand at most: Newton's method from the root of the parabola
                tau = guess
                for _ in range(8):
                    tau = tau - arc(tau) / arc(tau, 1)
            t, u = t + tau, arc(tau, 1)
            impacts.append(t)
        t = t + guess / (1 - e)
        if pull(t) < 0:
            raise ValueError("The table falls away faster than the ball where its impacts accumulate.")
        if g >= a * w**2:
            return TableBall(first, velocity, impacts, t, None, None, None, None)
        turns = mp.ceil((w * t + mp.acos(g / (a * w**2))) / (2 * mp.pi))
        leave = (2 * mp.pi * turns - mp.acos(g / (a * w**2))) / w
        arc = flight(leave, mp.zero, mp.zero)
        land = arc.first_root(long)
        return TableBall(
            first, velocity, impacts, t, leave, table(leave), leave + land, arc(land, 1) + table(leave + land)
        )


def _horner(series: list, tau: Any) -> Any:
    return reduce(lambda total, c: total * tau + c, reversed(series))


class _Series:
    """Taylor series in 40 digits of one slip step (v < v_dr) of section 2.4 and of its variational equation."""

    order = 40

    def __init__(self, x: Any, v: Any, basis: Any, p: dict[str, Any]):
        self.x, self.v, self.basis = [x], [v], [[basis[i, j] for i in (0, 1)] for j in (0, 1)]
        dx, dv = [[b[0]] for b in self.basis], [[b[1]] for b in self.basis]
        w, q, q2 = [1 + p["delta"] * (p["v_dr"] - v)], [], []  # F = F_s q with q = 1 / w, and dF/dv = F_s δ q²
        for n in range(self.order):
            q.append((mp.mpf(n == 0) - sum(w[j] * q[n - j] for j in range(1, n + 1))) / w[0])
            q2.append(sum(q[j] * q[n - j] for j in range(n + 1)))
            self.v.append((p["F_s"] * q[n] - p["k"] * self.x[n]) / (p["m"] * (n + 1)))
            self.x.append(self.v[n] / (n + 1))
            w.append(-p["delta"] * self.v[n + 1])
            for a, b in zip(dx, dv):
                force = p["F_s"] * p["delta"] * sum(q2[j] * b[n - j] for j in range(n + 1)) - p["k"] * a[n]
                b.append(force / (p["m"] * (n + 1)))
                a.append(b[n] / (n + 1))
        self.dx, self.dv = dx, dv
        # the last terms bound the step: |a_N| h^N = 1e-38
        self.step = min((mp.mpf("1e-38") / abs(c)) ** (mp.one / self.order) for c in (self.x[-1], self.v[-1]) if c)

    def at(self, tau: Any) -> tuple[Any, Any, Any]:
        columns = [[_horner(a, tau), _horner(b, tau)] for a, b in zip(self.dx, self.dv)]
        return _horner(self.x, tau), _horner(self.v, tau), mp.matrix(columns).T


def _slip_until(x: Any, v: Any, level: Any, falling: bool, p: dict[str, Any]) -> tuple[Any, Any, Any, Any]:
    """Slip from (x, v) until v passes `level` falling or rising: (duration, x, v, fundamental matrix)."""
    t, basis, sign = mp.zero, mp.eye(2), -1 if falling else 1
    while True:
        series = _Series(x, v, basis, p)
        end = series.at(series.step)
        if sign * (v - level) < 0 <= sign * (end[1] - level):
            beyond = partial(_horner, [series.v[0] - level, *series.v[1:]])
            tau = mp.findroot(beyond, (0, series.step), solver="anderson")
            return (t + tau, *series.at(tau))
        t, (x, v, basis) = t + series.step, end
        if t > 1000:
            raise RuntimeError("The slip arc does not reach the wanted velocity.")


def friction_curve_orbit(
    m: float = 1.0, k: float = 1.0, v_dr: float = 0.2, F_s: float = 1.0, delta: float = 3.0
) -> Orbit:
    """The orbit of section 2.4, F = -F_s sgn(v_rel) / (1 + δ |v_rel|), from its maximum of x.

    Stick ends at k x = F_s, where slip and stick field are equal: a tangential exit, whose saltation matrix is I.
    """
    p = {name: mp.mpf(value) for name, value in dict(m=m, k=k, v_dr=v_dr, F_s=F_s, delta=delta).items()}
    x_exit = p["F_s"] / p["k"]
    rise, x_top, _, after_exit = _slip_until(x_exit, p["v_dr"], mp.zero, True, p)
    slip, x_entry, _, before_entry = _slip_until(x_top, mp.zero, p["v_dr"], False, p)
    stick = (x_exit - x_entry) / p["v_dr"]
    if abs(x_entry) > x_exit:
        raise RuntimeError("The mass does not stick when it reaches the belt's velocity.")
    monodromy = after_exit * mp.matrix([[1, stick], [0, 1]]) * mp.diag([1, 0]) * before_entry  # (3.41)
    events = [(slip, "stick", x_entry, p["v_dr"]), (slip + stick, "slip", x_exit, p["v_dr"])]
    return _orbit(slip + stick + rise, (x_top, mp.zero), events, monodromy)
