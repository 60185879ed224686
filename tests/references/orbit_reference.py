"""Periodic orbits with their Floquet multipliers in 40-digit arithmetic, for the tests of shooting; nothing of nsjax.

The systems of sections 5.7, 6.6 and 6.8 and the impact oscillator are piecewise linear: exact arcs, first roots
isolated rigorously, exact transition and saltation matrices (`reference.simulate`). The slip of section 6.9 is
integrated by Taylor series together with its variational equation. Newton's method on these maps, from a rounded guess,
finds the orbits.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import cache, reduce
from typing import Any, NamedTuple

import numpy as np
from reference import Event, ExpSum, floats, ImpactOscillator, Machine, mp, Oscillator, Path, simulate, Surface


class Shot(NamedTuple):
    """A periodic orbit, rounded to float64, with a rounded guess for it.

    `y0` is its state (x, v) at t = 0, `events` are (t, kind, x, v) of one period, `multipliers` fall in modulus."""

    parameters: dict[str, float]  # under the gallery's names; the others have its defaults
    guess: tuple[float, float]
    guess_period: float | None  # None for a forced system
    order: int  # periods of the forcing in one of the orbit; 1 for an autonomous system
    period: float
    y0: np.ndarray
    events: list[tuple[float, str, float, float]]
    monodromy: np.ndarray
    multipliers: np.ndarray

    @property
    def stable(self) -> bool:
        """All multipliers are inside the unit circle, apart from the 1 of an autonomous system."""
        moduli = abs(self.multipliers)
        if self.guess_period is not None:
            moduli = np.delete(moduli, np.argmin(abs(self.multipliers - 1)))
        return bool(np.all(moduli < 1))

    def count(self, kind: str) -> int:
        """The number of events of this kind in a period."""
        return sum(name == kind for _, name, _, _ in self.events)


def _multipliers(monodromy: Any) -> np.ndarray:
    """Eigenvalues of a 2x2 matrix, by falling modulus; the smaller one from the determinant, without cancellation."""
    half = (monodromy[0, 0] + monodromy[1, 1]) / 2
    determinant = monodromy[0, 0] * monodromy[1, 1] - monodromy[0, 1] * monodromy[1, 0]
    root = mp.sqrt(mp.mpc(half**2 - determinant))
    large = half + (root if half * root.real >= 0 else -root)
    values = [complex(z) for z in (large, determinant / large if large else mp.mpc(0))]
    return np.array(values if any(z.imag for z in values) else [z.real for z in values])


def _newton(step: Callable[[Any], tuple[Any, Any]], unknowns: Sequence) -> Any:
    """Newton's method: `step` gives residual and Jacobian."""
    z = mp.matrix([mp.mpf(u) for u in unknowns])
    for _ in range(40):
        residual, jacobian = step(z)
        change = mp.lu_solve(jacobian, -residual)
        z = z + change
        if mp.norm(change) < mp.mpf("1e-18"):  # and the error is its square
            return z
    raise RuntimeError("Newton's method found no orbit near the guess.")


def _forced(flow: Callable[[Any, list], Path], guess: Sequence[float], order: int, parameters: dict) -> Shot:
    """The orbit of a system with the parameter omega near a guess at t = 0; `flow` is (end time, y0) to `Path`."""
    period = 2 * mp.pi * order / mp.mpf(parameters["omega"])

    def step(y: Any) -> tuple[Any, Any]:
        path = flow(period, list(y))
        return mp.matrix(path.y) - y, path.fundamental - mp.eye(2)

    y = _newton(step, guess)
    path = flow(period, list(y))
    return _shot(parameters, guess, None, order, period, y, path)


def _shot(parameters: dict, guess: Sequence, guess_period: Any, order: int, period: Any, y: Any, path: Path) -> Shot:
    events = [(float(e.t), e.kind, float(e.x), float(e.v)) for e in path.events]
    orbit = float(period), floats(list(y)), events, floats(path.fundamental), _multipliers(path.fundamental)
    return Shot(dict(parameters), tuple(guess), guess_period, order, *orbit)


@dataclass(frozen=True)
class HopfPitchfork(Machine):
    """Section 5.7, (5.32): x1' = x2, x2' = -x1 + |x1 + μ| - |x1 - μ| - x2 - |x2 + μ| + |x2 - μ|; (5.38) is μ = -1.

    Mode: 3 i + j, where i and j say whether x1 and x2 are below (-1), in (0) or above (1) the band of |μ|. In the band
    |x + μ| - |x - μ| = 2 sgn(μ) x, outside it is 2 μ sgn(x). The field is continuous: saltation matrices are I."""

    mu: Any = -1

    def _side(self, z: Any) -> int:
        return int(mp.sign(z)) if abs(z) > abs(self.mu) else 0

    def _sides(self, mode: int) -> tuple[int, int]:
        j = (mode + 1) % 3 - 1
        return (mode - j) // 3, j

    def mode(self, x: Any, v: Any) -> int:
        return 3 * self._side(x) + self._side(v)

    def oscillator(self, mode: int) -> Oscillator:
        (i, j), sign = self._sides(mode), mp.sign(self.mu)
        k = mp.one if i else 1 - 2 * sign
        c = mp.one if j else 1 + 2 * sign
        return Oscillator(mp.one, c, k, 2 * self.mu * (i - j))

    def surfaces(self, mode: int) -> dict[str, Surface]:
        i, j = self._sides(mode)
        levels = {f"x {s:+d}": Surface(mp.one, mp.zero, -s * abs(self.mu)) for s in ((i,) if i else (-1, 1))}
        return levels | {f"v {s:+d}": Surface(mp.zero, mp.one, -s * abs(self.mu)) for s in ((j,) if j else (-1, 1))}

    def after(self, surface: str, mode: int, x: Any, v: Any, a: Any) -> tuple[str | None, int, Any, Any]:
        (i, j), side = self._sides(mode), int(surface[1:])
        if surface[0] == "x":
            return surface, 3 * (0 if i else side) + j, side * abs(self.mu), v
        return surface, 3 * i + (0 if j else side), x, side * abs(self.mu)


@cache
def hopf_pitchfork_orbit(mu: float = -1.0) -> Shot:
    """Section 5.7: the stable orbit of (5.32) for μ < 0 from its maximum of x1, that of Fig. 5.15 for μ = -1.

    Newton's method for (x1, period) with x2 = 0 at the start. The thesis has T = 4.03. As every saltation matrix is I,
    the second multiplier is the exponential of the mean divergence: exp(2 t_in - T), t_in the time with |x2| < |μ|."""
    system, guess, guess_period = HopfPitchfork(mu=mu), (1.5 * abs(mu), 0.0), 4.0

    def step(z: Any) -> tuple[Any, Any]:
        path = simulate(system, z[1], (z[0], mp.zero))
        (x, v), M = path.y, path.fundamental
        a = system.oscillator(system.mode(x, v)).arc(0, x, v)(mp.zero, 2)
        return mp.matrix([x - z[0], v]), mp.matrix([[M[0, 0] - 1, v], [M[1, 0], a]])

    x, period = _newton(step, (guess[0], guess_period))
    path = simulate(system, period, (x, mp.zero))
    return _shot({"mu": mu}, guess, guess_period, 1, period, [x, mp.zero], path)


@dataclass(frozen=True)
class TwoSupports(Machine):
    """Section 6.6, (6.14)-(6.20), with the forcing f_0 cos ωt (a quarter of a period later than the thesis's sine).

    Mode 1: contact above, min(x - x_c, k_f (x - x_c) + c_f x') > 0; mode -1: the same for (-x, -x'); 0: none."""

    m: Any = 1
    c: Any = 0.05
    k: Any = 1
    x_c: Any = 1
    k_f: Any = 4
    c_f: Any = 0.5
    f_0: Any = 0.2
    omega: Any = 1.15

    def mode(self, x: Any, v: Any) -> int:
        return sum(s for s in (-1, 1) if min(s * x - self.x_c, self._force(s, x, v)) > 0)

    def _force(self, side: int, x: Any, v: Any) -> Any:
        return self.k_f * (side * x - self.x_c) + self.c_f * side * v

    def oscillator(self, mode: int) -> Oscillator:
        c, k = abs(mode) * self.c_f, abs(mode) * self.k_f
        return Oscillator(self.m, self.c + c, self.k + k, mode * self.k_f * self.x_c, self.f_0, self.omega)

    def surfaces(self, mode: int) -> dict[str, Surface]:
        sides = (mode,) if mode else (-1, 1)
        gap = {f"gap {s:+d}": Surface(mp.mpf(s), mp.zero, -self.x_c) for s in sides}
        return gap | {f"force {s:+d}": Surface(s * self.k_f, s * self.c_f, -self.k_f * self.x_c) for s in sides}

    def after(self, surface: str, mode: int, x: Any, v: Any, a: Any) -> tuple[str | None, int, Any, Any]:
        name, side = surface.split()
        s = int(side)
        if name == "gap":
            x, contact = s * self.x_c, s * v > 0
        else:
            v = -s * self.k_f * (s * x - self.x_c) / self.c_f
            contact = s * x > self.x_c and s * (self.k_f * v + self.c_f * a) > 0
        now = s if contact else 0
        return None if now == mode else f"contact {s:+d}" if contact else f"release {s:+d}", now, x, v


TRILINEAR = {"contact": (-0.9, 0.94), "unstable": (-0.46, -1.14), "free": (-0.1, -0.7)}


@cache
def trilinear_orbit(branch: str = "contact", omega: float = 1.15) -> Shot:
    """Section 6.6 (forced by the sine), to the right of ω_B in Fig. 6.12: "contact" (stable) and "unstable" touch both
    supports, and "free" (stable) is the linear oscillator's orbit without contact."""
    system, quarter = TwoSupports(omega=omega), mp.pi / (2 * mp.mpf(omega))  # sin ωt = cos ω(t - quarter)

    def flow(t1: Any, y: list) -> Path:
        path = simulate(system, t1 - quarter, y, t0=-quarter)
        return path._replace(events=[e._replace(t=e.t + quarter) for e in path.events])

    return _forced(flow, TRILINEAR[branch], 1, {"omega": omega})


IMPACT = {
    "stable": (0.7, 1.3, 1, (-0.04, 1.5)),
    "flip": (0.9, 1.1, 1, (0.15, 1.5)),
    "subharmonic": (0.7, 3.0, 2, (0.11, 0.52)),
    "saddle": (0.7, 3.0, 2, (-0.22, -0.11)),
    "three impacts": (0.95, 1.2, 2, (-0.24, -0.45)),
}


@cache
def impact_orbit(which: str) -> Shot:
    """x'' + c x' + x = f_0 cos ωt with x <= gap and restitution e: c = 0.1, f_0 = 1, gap = 0.2 and four pairs (e, ω).

    "stable" and "flip" (unstable, λ < -1) have one impact in one period of the forcing, "subharmonic" (stable) and
    "saddle" (λ > 1; at the same parameters) one in two, "three impacts" (stable) three in two. Names of `parameters`:
    c, f_0, gap, e, omega."""
    e, omega, order, guess = IMPACT[which]
    parameters = {"c": 0.1, "f_0": 1.0, "gap": 0.2, "e": e, "omega": omega}
    system = ImpactOscillator(c=0.1, f_0=1.0, x_w=0.2, e=e, omega=omega)

    def flow(t1: Any, y: list) -> Path:
        return simulate(system, t1, y)

    return _forced(flow, guess, order, parameters)


class Friction(NamedTuple):
    """Section 6.8, (6.25), (6.26), read mechanically: a mass at rest sticks while |F_ex| <= F_stick, where
    F_ex = k x - f_0 cos ωt, and then slips against sgn(F_ex). Mode: sgn(x')."""

    m: Any = 1
    c: Any = 0.01
    k: Any = 1
    f_0: Any = 2.5
    F_slip: Any = 1
    F_stick: Any = 2
    omega: Any = 0.65

    def oscillator(self, mode: int) -> Oscillator:
        return Oscillator(self.m, self.c, self.k, -mode * self.F_slip, self.f_0, self.omega)

    def force(self, t: Any, x: Any) -> ExpSum:
        """F_ex of a mass at rest from time t on."""
        return ExpSum((self.k * x, mp.zero, mp.zero), ((-self.f_0 * mp.expj(self.omega * t), mp.mpc(0, self.omega)),))

    def rest(self, t: Any, x: Any) -> int:
        """The mode of a mass that comes to rest."""
        force = self.force(t, x)(mp.zero)
        return 0 if abs(force) <= self.F_stick else -int(mp.sign(force))

    def simulate(self, t1: Any, y0: Sequence) -> Path:
        """The exact trajectory from y0 = (x, v) at 0 to t1. Saltation matrices: (3.41) from slip to stick; from stick
        to slip, on the moving surface ±F_ex = F_stick, dx leads to dv = x'' k dx / (dF_ex/dt)."""
        t, (x, v), events, M = mp.zero, y0, [], mp.eye(2)
        mode = int(mp.sign(v)) if v else self.rest(t, x)
        while True:
            if mode:
                law = self.oscillator(mode)
                arc = law.arc(t, x, v)
                tau = arc.combine(mp.zero, mp.one, mp.zero).first_root(t1 - t)
                end = t1 - t if tau is None else tau
                M = law.transition(end) * M
                x, v, a = (arc(end, n) for n in range(3))
                if tau is None:
                    return Path(events, (x, v), M)
                t, v, mode = t + end, mp.zero, self.rest(t + end, x)
                after = self.oscillator(mode).arc(t, x, v)(mp.zero, 2) if mode else mp.zero
                salt, kind = mp.matrix([[1, 0], [0, after / a]]), "cross" if mode else "stick"
            else:
                force = self.force(t, x)
                ends = {s: force.combine(mp.one, mp.zero, -s * self.F_stick).first_root(t1 - t) for s in (-1, 1)}
                sign, tau = min(((s, e) for s, e in ends.items() if e is not None), key=lambda e: e[1], default=(0, 0))
                if not sign:
                    return Path(events, (x, mp.zero), mp.matrix([[1, 0], [0, 0]]) * M)
                t, mode, kind = t + tau, -sign, "slip"
                after = self.oscillator(mode).arc(t, x, mp.zero)(mp.zero, 2)
                salt = mp.matrix([[1, 0], [after * self.k / force(tau, 1), 0]])
            M = salt * M
            events.append(Event(t, kind, x, v, salt))


FRICTION = {
    "symmetric, sliding through": (0.8, (5.4, 2.7)),
    "asymmetric, one stick": (0.65, (4.0, 1.5)),
    "asymmetric, one stick, mirrored": (0.65, (3.9, 1.0)),
    "symmetric, unstable": (0.65, (3.96, 1.22)),
    "asymmetric, two sticks": (0.61, (4.03, 1.21)),
    "symmetric, two sticks": (0.58, (3.9, 0.6)),
    "symmetric, stuck at the start": (0.51, (3.7, 0.0)),
}


@cache
def friction_orbit(which: str) -> Shot:
    """Section 6.8, the orbits of Fig. 6.18 by name (a key of `FRICTION`), with the values of Appendix C.4 apart from ω.

    Branch I to the right of B at ω = 0.8 (never sticks, complex multipliers), between A and B at 0.65 (two stick
    phases, unstable), to the left of A at 0.58 and 0.51 (two). Branch II between B and C at 0.65 (one stick phase) with
    its mirror image -x(t + T/2), and between A and C at 0.61 (two).

    At ω = 0.51 the mass is stuck at t = 0, with F_slip < |F_ex|: pushed away from the surface (v < 0) it would not
    return. The monodromy is that of starts on the surface, whose velocity stays zero: its second column is zero."""
    omega, guess = FRICTION[which]
    system = Friction(*(mp.mpf(value) for value in Friction()._replace(omega=omega)))
    return _forced(system.simulate, guess, 1, {"omega": omega})


class _Polynomial(ExpSum):
    """A polynomial of any degree, with the root isolation of `ExpSum`; `poly` are its coefficients."""

    def __call__(self, tau: Any, n: int = 0) -> Any:
        return reduce(lambda total, c: total * tau + c, reversed(self._derived(n)), mp.zero)

    def bound(self, n: int, stop: Any) -> Any:
        return reduce(lambda total, c: total * stop + abs(c), reversed(self._derived(n)), mp.zero)

    def _derived(self, n: int) -> Sequence:
        coefficients = self.poly
        for _ in range(n):
            coefficients = [i * c for i, c in enumerate(coefficients)][1:]
        return coefficients


class _BeltSeries:
    """Taylor series of one step of slip in section 6.9, and of its variational equation; `side` is sgn(v_rel)."""

    order = 36

    def __init__(self, t: Any, x: Any, v: Any, side: int, p: "Belt"):
        self.x, self.v = [x], [v]
        dx, dv = [[mp.one], [mp.zero]], [[mp.zero], [mp.one]]
        phase, r, r2 = p.f_0 * mp.expj(p.omega * t), [v - p.v_dr], []
        for n in range(self.order):
            r2.append(sum(r[j] * r[n - j] for j in range(n + 1)))
            cube = sum(r2[j] * r[n - j] for j in range(n + 1))
            force = p.alpha_1 * r[n] - p.alpha_3 * cube - p.k * self.x[n] + phase.real - (n == 0) * side * p.alpha_0
            phase *= mp.mpc(0, p.omega) / (n + 1)
            self.x.append(self.v[n] / (n + 1))
            self.v.append(force / (p.m * (n + 1)))
            r.append(self.v[-1])
            for a, b in zip(dx, dv):
                force = p.alpha_1 * b[n] - 3 * p.alpha_3 * sum(r2[j] * b[n - j] for j in range(n + 1)) - p.k * a[n]
                a.append(b[n] / (n + 1))
                b.append(force / (p.m * (n + 1)))
        self.columns = [(_Polynomial(a, ()), _Polynomial(b, ())) for a, b in zip(dx, dv)]
        self.gap = _Polynomial(r, ())  # v_rel
        self.position = _Polynomial(self.x, ())
        last = [abs(c[-1]) for c in (self.x, self.v, *dx, *dv)]
        self.step = min((mp.mpf("1e-37") / c) ** (mp.one / self.order) for c in last if c)

    def fundamental(self, tau: Any) -> Any:
        return mp.matrix([[column[i](tau) for column in self.columns] for i in (0, 1)])


class Belt(NamedTuple):
    """Section 6.9, (6.27), (6.28), friction law (b) read mechanically: at v = v_dr the mass sticks while
    |F_ex| = |k x - f_0 cos ωt| <= α_0, and then slips against sgn(F_ex)."""

    m: Any = mp.mpf(1)
    k: Any = mp.mpf(1)
    v_dr: Any = mp.mpf(1)
    alpha_0: Any = mp.mpf(1.5)
    alpha_1: Any = mp.mpf(1.5)
    alpha_3: Any = mp.mpf(0.45)
    f_0: Any = mp.mpf(0.1)
    omega: Any = mp.mpf(1.65)

    def force(self, t: Any, x: Any, duration: Any = mp.zero) -> Any:
        """F_ex after sticking for this long."""
        return self.k * (x + self.v_dr * duration) - self.f_0 * mp.cos(self.omega * (t + duration))

    def after(self, t: Any, x: Any) -> int:
        """The mode on the surface: 0 for stick, or the sign of v_rel that follows."""
        force = self.force(t, x)
        return 0 if abs(force) <= self.alpha_0 else -int(mp.sign(force))

    def simulate(self, t1: Any, y0: Sequence) -> Path:
        """The trajectory from y0 = (x, v) at 0 to t1. Where stick ends friction is continuous (α_0 on both sides), and
        the saltation matrix is I; where it begins, it is (3.41)."""
        t, (x, v), events, M = mp.zero, y0, [], mp.eye(2)
        mode = int(mp.sign(v - self.v_dr)) if v != self.v_dr else self.after(t, x)
        while t < t1:
            if mode:
                arc = _BeltSeries(t, x, v, mode, self)
                stop = min(arc.step, t1 - t)
                tau = arc.gap.first_root(stop)
                end = stop if tau is None else tau
                M = arc.fundamental(end) * M
                t, x, v, a = t + end, arc.position(end), arc.gap(end) + self.v_dr, arc.gap(end, 1)
                if tau is None:
                    continue
                v, mode = self.v_dr, self.after(t, x)
                after = (-mode * self.alpha_0 - self.force(t, x)) / self.m if mode else mp.zero
                salt, kind = mp.matrix([[1, 0], [0, after / a]]), "cross" if mode else "stick"
            else:
                if self.k * self.v_dr <= abs(self.f_0 * self.omega):
                    raise NotImplementedError("F_ex is not monotonic in stick.")
                duration = (self.alpha_0 + self.f_0 * mp.cos(self.omega * t)) / self.k - x
                for _ in range(60):  # a monotonic function
                    rate = self.k * self.v_dr + self.f_0 * self.omega * mp.sin(self.omega * (t + duration))
                    change = (self.alpha_0 - self.force(t, x, duration)) / rate
                    duration += change
                    if abs(change) < mp.mpf("1e-37"):
                        break
                stuck = min(duration, t1 - t)
                t, x = t + stuck, x + self.v_dr * stuck
                if stuck < duration:
                    break
                mode, salt, kind = -1, mp.eye(2), "slip"
            M = salt * M
            events.append(Event(t, kind, x, v, salt))
        return Path(events, (x, v), M)


STICK_SLIP = {
    "I": (1.68, (1.73, -0.83)),
    "II": (1.68, (0.46, -0.44)),
    "III": (1.8, (1.68, 0.06)),
    "IV": (1.68, (2.11, -0.47)),
    "V": (1.68, (2.02, -0.69)),
}


@cache
def forced_stick_slip_orbit(branch: str) -> Shot:
    """Section 6.9: the period-2 orbits on the branches I to V of Figs 6.20 to 6.22 (order 2), at an ω of ours.

    I (stable) and V (λ > 1) stick once in the two periods; II (λ > 1), III (stable, complex) and IV (λ < -1) never do.
    Further from this ω: I and V meet in a fold between 1.682 and 1.684, V and IV end at B (ω = 1.668), IV becomes III
    in a flip between 1.71 and 1.72, III and II meet in a fold near 1.912, II and I end at A (1.514)."""
    omega, guess = STICK_SLIP[branch]
    return _forced(Belt(omega=mp.mpf(omega)).simulate, guess, 2, {"omega": omega})
