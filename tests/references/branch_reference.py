"""Bifurcation points of the periodic orbits of chapter 6 in 40-digit arithmetic, for the tests of continuation.

Nothing of nsjax: arcs, transition and saltation matrices are those of `reference` and `orbit_reference`. Where an event
of zero duration is born (a contact, a stick phase), the orbit is found from the arcs on which the event has just not
happened, so that no equation is one-sided; its multipliers are given for both sides, as limits. Those at contacts
(6.6) and at touches of the belt (6.9) are approached like the square root of the parameter's distance, those of 6.8
linearly.

`POINTS` has the values as frozen constants, `COMPUTE` the functions that compute them anew.
"""

from collections.abc import Callable, Sequence
from functools import cache, partial
from math import inf
from typing import Any, NamedTuple

import numpy as np
from orbit_reference import _BeltSeries, _multipliers, _newton, _Polynomial, Belt, Friction, TwoSupports
from reference import mp, Oscillator, simulate, StickSlip


class Point(NamedTuple):
    """A bifurcation point and the orbit there, rounded to float64; Appendix C's values of the other parameters.

    `at` is the parameter's value, `y0` the state (x, v) at t = 0 (section 6.7: at the maximum of x), `amplitude` is
    max |x|. `multipliers` are by the side from which the point is approached, `more` are further quantities."""

    parameter: str
    at: float
    order: int
    period: float
    y0: tuple[float, float]
    amplitude: float
    multipliers: dict[str, tuple[complex, complex]]
    more: dict[str, float]


POINTS: dict[str, Point] = {
    "6.6 A": Point(
        parameter="omega",
        at=0.8972718642496267,
        order=1,
        period=7.002543551762996,
        y0=(-0.22431796606240667, 0.874405795355907),
        amplitude=1.0,
        multipliers={
            "free": ((0.6326325310908565 + 0.5517015094154278j), (0.6326325310908565 - 0.5517015094154278j)),
            "contact": ((0.3696268090984715 + 0.7536408275043007j), (0.3696268090984715 - 0.7536408275043007j)),
        },
        more={},
    ),
    "6.6 B": Point(
        parameter="omega",
        at=1.0919721615618228,
        order=1,
        period=5.753979385511889,
        y0=(-0.2729930403904557, -1.0504946998547893),
        amplitude=1.0,
        multipliers={
            "free": ((0.7467664592568405 + 0.4385512316915828j), (0.7467664592568405 - 0.4385512316915828j)),
            "contact": (1.4183699726104146, 0.5287670649914432),
        },
        more={"q_613": 0.558348221822477, "q_612": 0.5734140226045905},
    ),
    "6.6 fold": Point(
        parameter="omega",
        at=1.254808836944299,
        order=1,
        period=5.007284872555052,
        y0=(-1.2904289621804101, -0.42192245054715416),
        amplitude=1.3233678892855338,
        multipliers={"contact": (1.0, 0.30712001162299973)},
        more={},
    ),
    "6.7 fold": Point(
        parameter="v_dr",
        at=1.0980926241158726,
        order=1,
        period=6.439474890105244,
        y0=(2.386780742360099, 0.0),
        amplitude=2.386780742360099,
        multipliers={"stable": (1.0, 0.0), "unstable": (inf, 1.0)},
        more={"slip": 5.528804899215224, "x_out": 1.8901907375884128, "x_in": 0.8901907375884127},
    ),
    "6.8 A": Point(
        parameter="omega",
        at=0.6082104695967931,
        order=1,
        period=10.330610243103772,
        y0=(3.9638447113746476, 0.8314858465234769),
        amplitude=4.099651201813575,
        multipliers={"symmetric": (1.0, 0.0)},
        more={"slip_start": 6.10867952791479, "slip_end": 10.653591972765254, "stick": 0.6203926767014214},
    ),
    "6.8 B": Point(
        parameter="omega",
        at=0.6803260241880431,
        order=1,
        period=9.23555043286556,
        y0=(3.9179903457165968, 1.4877090168236695),
        amplitude=4.333332854165094,
        multipliers={
            "symmetric, no stick": (
                (-0.31030148847296646 + 0.07086593454466887j),
                (-0.31030148847296646 - 0.07086593454466887j),
            ),
            "symmetric, two sticks": (2.2378317076674956, 0.0),
            "asymmetric, one stick": (-0.507386470029414, 0.0),
        },
        more={"q_613": 0.507991079982952, "q_612": 0.744445326848913, "rest": 5.157529012962279},
    ),
    "6.8 C": Point(
        parameter="omega",
        at=0.6119254805267682,
        order=1,
        period=10.267892916913326,
        y0=(4.015565916746222, 1.4140669690163021),
        amplitude=4.381992697016079,
        multipliers={"one stick": (-0.34216136304183686, 0.0), "two sticks": (0.9319188924697931, 0.0)},
        more={
            "slip_start": -3.8045514729788388,
            "turn": 0.504108717895563,
            "slip_end": 5.36228837089193,
            "stick": 1.101053073042557,
        },
    ),
    "6.9 A": Point(
        parameter="omega",
        at=1.5140707167931038,
        order=2,
        period=8.299725022735748,
        y0=(0.6974927471812047, -0.5822604505323424),
        amplitude=2.2597775103675,
        multipliers={"no stick": (3.6623656100274955, 0.015956092740861672), "stick": (-0.14197764713914932, 0.0)},
        more={"touch": 5.021664072503915, "x_touch": 1.5248205273845095, "q_613 at +1": 0.6964328955507192},
    ),
    "6.9 B": Point(
        parameter="omega",
        at=1.667690998105968,
        order=2,
        period=7.5351912486372274,
        y0=(2.144890116155233, -0.5342622179058832),
        amplitude=2.242084855539536,
        multipliers={"no stick": (-1.2642583617786378, -0.03503805843362457), "stick": (1.8518341913998653, 0.0)},
        more={
            "touch": 5.991016610543651,
            "x_touch": 1.4156154570618331,
            "q_613 at +1": 0.7334209211655641,
            "q_613 at -1": 0.08207690102916375,
        },
    ),
    "6.9 C": Point(
        parameter="omega",
        at=1.7077997148850603,
        order=4,
        period=14.71644538271272,
        y0=(1.8567396897177262, -0.2521096530008829),
        amplitude=2.250144335716479,
        multipliers={"no stick": (0.8407253925431134, 0.007192336124639061), "stick": (-1.656357166380186, 0.0)},
        more={"touch": 5.894158683631216, "x_touch": 1.4198660071878606, "q_613 at -1": 0.7385366293866777},
    ),
    "6.9 fold I/V": Point(
        parameter="omega",
        at=1.6834405724957293,
        order=2,
        period=7.4646951128956776,
        y0=(1.8857867721190926, -0.7853617560151046),
        amplitude=2.2038788823275453,
        multipliers={"stick": (1.0, 0.0)},
        more={"slip_start": 5.622287598907454, "stick": 0.5368220417939239},
    ),
    "6.9 fold II/III": Point(
        parameter="omega",
        at=1.9117967959941686,
        order=2,
        period=6.573068142330699,
        y0=(0.9415165881712302, 0.33228291892590844),
        amplitude=1.0910385828334357,
        multipliers={"no stick": (1.1016788269904987, 1.0)},
        more={},
    ),
    "6.9 flip III/IV": Point(
        parameter="omega",
        at=1.712981036226939,
        order=2,
        period=7.335965984794683,
        y0=(2.0118400226382365, -0.31143648560941356),
        amplitude=2.045538473015814,
        multipliers={"no stick": (-1.0, -0.08447867482271078)},
        more={},
    ),
    "6.9 Neimark-Sacker III": Point(
        parameter="omega",
        at=1.9099652743390918,
        order=2,
        period=6.5793712499341295,
        y0=(1.0052696562163448, 0.3281759792638347),
        amplitude=1.1325409271800035,
        multipliers={
            "no stick": ((0.940628646050844 + 0.33943740251857357j), (0.940628646050844 - 0.33943740251857357j))
        },
        more={},
    ),
}


def _point(
    parameter: str, at: Any, order: int, period: Any, y0: Sequence, amplitude: Any, sides: dict, **more: Any
) -> Point:
    """Rounded; a side is a monodromy or a pair of multipliers."""
    pairs = {name: _multipliers(s) if isinstance(s, mp.matrix) else np.array(s, float) for name, s in sides.items()}
    x, v = y0
    return Point(
        parameter,
        float(at),
        order,
        float(period),
        (float(x), float(v)),
        float(amplitude),
        {name: tuple(pair.tolist()) for name, pair in pairs.items()},
        {name: float(value) for name, value in more.items()},
    )


def _solve(equations: Callable[..., Sequence], *guess: float) -> list:
    """Newton's method with difference quotients, whose error of 1e-18 costs nothing that it would notice."""
    h = mp.mpf("1e-18")

    def step(z: Any) -> tuple[Any, Any]:
        z = list(z)
        here = mp.matrix(equations(*z))
        columns = [(mp.matrix(equations(*z[:i], a + h, *z[i + 1 :])) - here) / h for i, a in enumerate(z)]
        return here, mp.matrix([[column[i] for column in columns] for i in range(len(z))])

    z = list(_newton(step, guess))
    if mp.norm(mp.matrix(equations(*z))) > mp.mpf("1e-28"):
        raise ArithmeticError("Newton's method stopped beside the root.")
    return z


def _crossings(first: Any, second: Any, at: int) -> list:
    """The q in [0, 1] for which (1 - q) first + q second has the eigenvalue `at`."""
    half = mp.mpf("0.5")
    d0, d, d1 = (mp.det((1 - q) * first + q * second - at * mp.eye(2)) for q in (mp.zero, half, mp.one))
    square = 2 * (d0 - 2 * d + d1)
    linear = d1 - d0 - square
    root = mp.sqrt(mp.mpc(linear**2 - 4 * square * d0))
    # 2 c / (-b ± root), which also holds where the jump is of rank one and the determinant linear in q
    roots = [2 * d0 / (s * root - linear) for s in (1, -1) if abs(s * root - linear) > mp.mpf("1e-30")]
    return sorted(q.real for q in roots if abs(q.imag) < mp.mpf("1e-30") and 0 <= q.real <= 1)


# Section 6.6


@cache
def trilinear_corner(which: str = "B") -> Point:
    """Section 6.6, ω_A or ω_B of Fig. 6.12: the linear orbit's amplitude f_0 / |k - m ω² + i c ω| is x_c.

    `more`: where the eigenvalue crosses +1, q by (6.13), which interpolates the monodromy between both sides (whatever
    its base point, thanks to the symmetry), and by (6.12), which interpolates each saltation matrix. The orbits with
    contact are to the right of both points."""
    s = TwoSupports()
    half = s.k / s.m - (s.c / s.m) ** 2 / 2  # (k - m w)² + c² w = (f_0 / x_c)² for w = ω²
    root = mp.sqrt(half**2 - (s.k**2 - (s.f_0 / s.x_c) ** 2) / s.m**2)
    omega = mp.sqrt(half + {"A": -root, "B": root}[which])
    response = s.f_0 / mp.mpc(s.k - s.m * omega**2, s.c * omega)  # x = Im(response exp(iωt)): forced by the sine
    # A contact that ends at once: (6.21) and nothing else.
    arc, salt = Oscillator(s.m, s.c, s.k).transition(mp.pi / omega), mp.matrix([[1, 0], [-s.c_f / s.m, 1]])
    free, contact = arc * arc, salt * arc * salt * arc
    # Half a period of the mirrored motion has the matrix -S Φ, and its square is the monodromy.
    q = {"q_613": _crossings(free, contact, 1), "q_612": _crossings(arc, salt * arc, -1)}
    y0, sides = (response.imag, omega * response.real), {"free": free, "contact": contact}
    more = {name: values[0] for name, values in q.items() if values}
    return _point("omega", omega, 1, 2 * mp.pi / omega, y0, abs(response), sides, **more)


@cache
def trilinear_fold() -> Point:
    """Section 6.6: the smooth fold to the right of ω_B, where the stable and the unstable orbit with contact meet.

    Half a period of the symmetric orbit: y(T/2) = -y(0), and the mirrored map has the multiplier +1."""

    def flow(omega: Any, x: Any, v: Any, parts: int = 2) -> Any:
        quarter = mp.pi / (2 * omega)  # sin ωt = cos ω(t - quarter)
        return simulate(TwoSupports(omega=omega), 4 * quarter / parts - quarter, (x, v), t0=-quarter)

    def equations(omega: Any, x: Any, v: Any) -> tuple:
        path = flow(omega, x, v)
        return path.y[0] + x, path.y[1] + v, mp.det(path.fundamental + mp.eye(2))

    omega, x, v = _solve(equations, 1.2548, -1.2904, -0.4219)
    path = flow(omega, x, v, 1)
    contact = next(e for e in path.events if e.kind.startswith("contact"))
    arc = TwoSupports(omega=omega).oscillator(int(contact.kind[-2:])).arc(contact.t, contact.x, contact.v)
    top = arc(arc.combine(mp.zero, mp.one, mp.zero).first_root(mp.pi / omega))
    return _point("omega", omega, 1, 2 * mp.pi / omega, (x, v), abs(top), {"contact": path.fundamental})


# Section 6.7


@cache
def stick_slip_fold() -> Point:
    """Section 6.7, Fig. 6.15: the slip arc that leaves stick at k x + c v_dr = F_stick comes back tangentially.

    With ξ = x - F_slip / k, it ends at v_dr (-c / k, 1). Backwards from there it is linear in v_dr, so that the
    duration of slip solves one equation, v = v_dr, and the force at its start then gives v_dr."""
    s = StickSlip(c=0.1)
    arc = Oscillator(s.m, s.c, s.k)

    def start(slip: Any) -> Any:
        return arc.transition(-slip) * mp.matrix([-s.c / s.k, 1])

    slip = mp.findroot(lambda slip: start(slip)[1] - 1, (mp.mpf(5), mp.mpf(6)), solver="anderson")
    v_dr = (s.F_stick - s.F_slip) / (s.k * start(slip)[0] + s.c)
    x_out, x_in = (s.F_stick - s.c * v_dr) / s.k, (s.F_slip - s.c * v_dr) / s.k
    moves = StickSlip(c=0.1, v_dr=v_dr).oscillator(-1).arc(0, x_out, v_dr)
    # It turns about F_slip / k > 0: max x is max |x|.
    x = moves(moves.combine(mp.zero, mp.one, mp.zero).first_root(slip))
    sides, period = {"stable": (1, 0), "unstable": (inf, 1)}, slip + (x_out - x_in) / v_dr
    return _point("v_dr", v_dr, 1, period, (x, mp.zero), x, sides, slip=slip, x_out=x_out, x_in=x_in)


# Section 6.8


def _friction(omega: Any) -> Friction:
    return Friction(*(mp.mpf(value) for value in Friction()))._replace(omega=omega)


def _breaks(p: Friction, t: Any, side: int) -> tuple[Any, Any]:
    """x from which a mass at rest breaks away at t with velocity of this sign, and d(x, v) just after it by dx: the
    later it leaves, the slower it is."""
    x = (p.f_0 * mp.cos(p.omega * t) - side * p.F_stick) / p.k
    a, rate = side * (p.F_stick - p.F_slip) / p.m, p.f_0 * p.omega * mp.sin(p.omega * t)
    return x, mp.matrix([1, a * p.k / rate])


def _slide(p: Friction, side: int, t0: Any, x0: Any, t1: Any) -> tuple[Any, Any, Any]:
    """(x, v, transition matrix) at t1 of the slip from rest at t0."""
    law = p.oscillator(side)
    arc = law.arc(t0, x0, mp.zero)
    return arc(t1 - t0), arc(t1 - t0, 1), law.transition(t1 - t0)


def _stops(p: Friction, t: Any, side: int) -> tuple[Any, Any]:
    """Saltation matrices of a passage of v = 0 into this direction at |F_ex| = F_stick: without and with a stick
    phase of zero length."""
    ratio = (p.F_stick - p.F_slip) / (p.F_stick + p.F_slip)
    return mp.matrix([[1, 0], [0, ratio]]), mp.matrix([[1, 0], [_breaks(p, t, side)[1][1], 0]])


@cache
def friction_symmetry_breaking() -> Point:
    """Section 6.8, A: the symmetric orbit with two stick phases has the multiplier +1.

    The mass breaks away upwards at t0, from x0, and rests from t1 on, at -x0. Each half of the period maps the place
    of rest with the same derivative; that of the mirrored map is -1."""

    def half(omega: Any, t0: Any, t1: Any) -> tuple[Any, Any, Any, Any]:
        p = _friction(omega)
        x0, lead = _breaks(p, t0, 1)
        x1, v1, M = _slide(p, 1, t0, x0, t1)
        return x0, x1, v1, (M * lead)[0]

    def equations(*z: Any) -> tuple:
        x0, x1, v1, slope = half(*z)
        return x1 + x0, v1, slope - 1

    omega, t0, t1 = z = _solve(equations, 0.6082, 6.109, 10.65)
    x0, _, _, slope = half(*z)
    period, p = 2 * mp.pi / omega, _friction(omega)
    x, v, _ = _slide(p, 1, t0, x0, period)
    stick, sides = t0 + period / 2 - t1, {"symmetric": (slope**2, 0)}
    return _point("omega", omega, 1, period, (x, v), abs(x0), sides, slip_start=t0, slip_end=t1, stick=stick)


@cache
def friction_first_stick() -> Point:
    """Section 6.8, B: the symmetric orbit without stick passes v = 0 with |F_ex| = F_stick.

    Multipliers of the symmetric orbit without stick (ω > ω_B), with two stick phases of zero length, and of the
    asymmetric one with one of them (ω < ω_B)."""

    def half(omega: Any, t0: Any) -> tuple[Any, Any, Any, Any]:
        p = _friction(omega)
        x0, _ = _breaks(p, t0, 1)
        return x0, *_slide(p, 1, t0, x0, t0 + mp.pi / omega)

    def equations(*z: Any) -> tuple:
        x0, x1, v1, _ = half(*z)
        return x1 + x0, v1

    omega, t0 = z = _solve(equations, 0.6803, 5.158)
    x0, _, _, M = half(*z)
    p, period = _friction(omega), 2 * mp.pi / omega
    through, sticks = _stops(p, t0, 1)  # and the same on the other side, by symmetry
    free, two, one = through * M * through * M, sticks * M * sticks * M, through * M * sticks * M
    sides = {
        "symmetric, no stick": free,
        "symmetric, two sticks": (two[0, 0] + two[1, 1], 0),  # singular: the trace is the other eigenvalue
        "asymmetric, one stick": (one[0, 0] + one[1, 1], 0),
    }
    # As in section 6.6, by (6.13) and (6.12): an eigenvalue of half a period crosses +1 or -1.
    q_613, q_612 = _crossings(free, two, 1), [q for at in (1, -1) for q in _crossings(through * M, sticks * M, at)]
    x, v, _ = _slide(p, 1, t0, x0, period)
    return _point("omega", omega, 1, period, (x, v), abs(x0), sides, q_613=q_613[0], q_612=q_612[0], rest=t0)


@cache
def friction_second_stick() -> Point:
    """Section 6.8, C: on branch II one of two stick phases vanishes: that orbit passes v = 0 with |F_ex| = F_stick.

    It breaks away upwards at t0, turns at t1 (the zero-length stick) and rests from t2 until t0 + T. Multipliers with
    one stick phase (ω > ω_C) and with two (ω < ω_C)."""

    def turns(omega: Any, t0: Any, t1: Any, t2: Any) -> tuple:
        p = _friction(omega)
        x0, lead = _breaks(p, t0, 1)
        x1, v1, up = _slide(p, 1, t0, x0, t1)
        x2, v2, down = _slide(p, -1, t1, x1, t2)
        return p, x0, lead, (x1, v1, up), (x2, v2, down)

    def equations(*z: Any) -> tuple:
        p, x0, _, (x1, v1, _), (x2, v2, _) = turns(*z)
        return v1, x1 - _breaks(p, z[2], -1)[0], v2, x2 - x0

    omega, t0, t1, t2 = z = _solve(equations, 0.6119, -3.805, 0.5041, 5.362)
    p, x0, lead, (x1, _, up), (_, _, down) = turns(*z)
    names = ("one stick", "two sticks")
    sides = {name: ((down * salt * up * lead)[0], 0) for name, salt in zip(names, _stops(p, t1, -1))}
    x, v, _ = _slide(p, 1, t0, x0, mp.zero)
    period = 2 * mp.pi / omega
    more = dict(slip_start=t0, turn=t1, slip_end=t2, stick=t0 + period - t2)
    return _point("omega", omega, 1, period, (x, v), max(abs(x0), abs(x1)), sides, **more)


# Section 6.9


def _belt(p: Belt, t: Any, x: Any, v: Any, stop: Any) -> tuple[Any, Any, Any, Any]:
    """(x, v, transition matrix, max |x|) of the slip below the belt's velocity from t to `stop`, whether or not the
    belt's velocity is passed: what has to hold there is in the equations."""
    M, size = mp.eye(2), abs(x)
    while t < stop:
        arc = _BeltSeries(t, x, v, -1, p)
        end = min(arc.step, stop - t)
        M, top = arc.fundamental(end) * M, _Polynomial([arc.gap(0) + p.v_dr, *arc.gap.poly[1:]], ()).first_root(end)
        t, x, v = t + end, arc.position(end), arc.gap(end) + p.v_dr
        size = max(size, abs(x), abs(arc.position(top)) if top is not None else 0)
    return x, v, M, size


def _leaves(p: Belt, t: Any) -> Any:
    """x at which stick ends at t: F_ex = α_0."""
    return (p.alpha_0 + p.f_0 * mp.cos(p.omega * t)) / p.k


TOUCHES = {"A": (2, 1.5141, 5.0217), "B": (2, 1.6677, 5.991), "C": (4, 1.7078, 5.8942)}


def _after_stick(order: int, stick: Any, omega: Any, t0: Any) -> tuple[tuple, Any]:
    """(residual, transition matrix of the slip) of an orbit that leaves the belt at t0 and comes back one period less
    the duration of stick later. Without stick it arrives where it leaves, at F_ex = α_0, where x'' = 0: it touches."""
    p = Belt(omega=omega)
    x0, period = _leaves(p, t0), 2 * mp.pi * order / omega
    x, v, M, _ = _belt(p, t0, x0, p.v_dr, t0 + period - stick)
    return (x - x0 + p.v_dr * stick, v - p.v_dr), M


@cache
def belt_touch(which: str) -> Point:
    """Section 6.9, A (branches I and II), B (V and IV) and C (VII and VI, of twice the period): the orbit without
    stick touches the belt's velocity.

    On the side with stick the orbit arrives with x'' -> 0 as the stick phase becomes shorter, but (3.41) does not
    contain x'': it remains diag(1, 0), and the multiplier's limit is Φ_11. `more`: where the eigenvalue crosses
    ±1, q by (6.13), q = 0 being the orbit without stick."""
    order, *guess = TOUCHES[which]
    omega, t0 = _solve(lambda *z: _after_stick(order, mp.zero, *z)[0], *guess)
    p, period = Belt(omega=omega), 2 * mp.pi * order / omega
    x0 = _leaves(p, t0)
    _, _, M, size = _belt(p, t0, x0, p.v_dr, t0 + period)
    x, v, _, _ = _belt(p, t0, x0, p.v_dr, period)
    salted = mp.matrix([[M[0, 0], M[0, 1]], [0, 0]])
    more = {f"q_613 at {at:+d}": q for at in (1, -1) for q in _crossings(M, salted, at)}
    return _point(
        "omega",
        omega,
        order,
        period,
        (x, v),
        size,
        {"no stick": M, "stick": (M[0, 0], 0)},
        touch=t0,
        x_touch=x0,
        **more,
    )


@cache
def belt_touch_monodromies(which: str) -> tuple[np.ndarray, np.ndarray]:
    """Over whole periods of the forcing from its phase 0, at A, B or C of section 6.9: without stick, and with it."""
    order, *guess = TOUCHES[which]
    omega, t0 = _solve(lambda *z: _after_stick(order, mp.zero, *z)[0], *guess)
    p, period = Belt(omega=omega), 2 * mp.pi * order / omega
    x0 = _leaves(p, t0)
    whole, rest = (_belt(p, t0, x0, p.v_dr, end)[2] for end in (t0 + period, period))
    there = [rest * stick * whole * rest**-1 for stick in (mp.eye(2), mp.diag([1, 0]))]
    return tuple(np.array(m.tolist(), float) for m in there)  # pyright: ignore[reportReturnType]


@cache
def belt_stick_orbit(which: str, stick: float) -> tuple[Any, Any]:
    """(ω, multiplier) of the orbit with a stick phase of this duration, on the branch that ends at A, B or C."""
    order, *guess = TOUCHES[which]
    equations = partial(_after_stick, order, mp.mpf(stick))
    omega, t0 = _solve(lambda *z: equations(*z)[0], *guess)
    return omega, equations(omega, t0)[1][0, 0]


def belt_stick_limit(which: str) -> tuple[float, float, float]:
    """A second route to the side with stick: (ω, multiplier, ω'') at stick duration 0, by extrapolation.

    ω = ω(0) + ω'' stick² / 2 + ..., while the multiplier is linear in the duration: along the branch it is approached
    like the square root of ω - ω(0). Positive ω'': the orbits with stick are to the right of the point."""
    step = 2e-4
    omegas, multipliers = zip(*(belt_stick_orbit(which, step * i) for i in range(1, 6)))
    at = _at_zero(omegas)
    curvature = _at_zero([2 * (omega - at) / (step * i) ** 2 for i, omega in enumerate(omegas, 1)])
    return float(at), float(_at_zero(multipliers)), float(curvature)


def _at_zero(values: Sequence) -> Any:
    """Of the polynomial through the values at 1, 2, ..."""
    n = len(values)
    return sum((-1) ** i * mp.binomial(n, i + 1) * y for i, y in enumerate(values))


@cache
def belt_fold_stick() -> Point:
    """Section 6.9: the smooth fold of branches I and V, whose orbits stick once: Φ_11 = 1 from the belt to the belt."""

    def equations(omega: Any, t0: Any, stick: Any) -> tuple:
        residual, M = _after_stick(2, stick, omega, t0)
        return *residual, M[0, 0] - 1

    omega, t0, stick = _solve(equations, 1.68344, 5.6223, 0.5368)
    p, period = Belt(omega=omega), 4 * mp.pi / omega
    x0 = _leaves(p, t0)
    x, v, _, _ = _belt(p, t0, x0, p.v_dr, period)
    _, _, M, size = _belt(p, t0, x0, p.v_dr, t0 + period - stick)
    return _point("omega", omega, 2, period, (x, v), size, {"stick": (M[0, 0], 0)}, slip_start=t0, stick=stick)


BELT_SMOOTH = {
    "fold": ((1.9118, 0.9415, 0.3323), lambda trace, det: 1 - trace + det),
    "flip": ((1.71298, 2.0118, -0.3114), lambda trace, det: 1 + trace + det),
    "Neimark-Sacker": ((1.90997, 1.0053, 0.3282), lambda trace, det: det - 1),
}


@cache
def belt_smooth(which: str) -> Point:
    """Section 6.9, the bifurcations of the orbits that never stick: the fold of II and III, the flip of III and IV,
    and the Neimark-Sacker point on III before its fold, by trace and determinant of the monodromy."""
    guess, test = BELT_SMOOTH[which]

    def flow(omega: Any, x: Any, v: Any) -> tuple:
        return _belt(Belt(omega=omega), mp.zero, x, v, 4 * mp.pi / omega)

    def equations(omega: Any, x: Any, v: Any) -> tuple:
        x1, v1, M, _ = flow(omega, x, v)
        return x1 - x, v1 - v, test(M[0, 0] + M[1, 1], mp.det(M))

    omega, x, v = _solve(equations, *guess)
    _, _, M, size = flow(omega, x, v)
    return _point("omega", omega, 2, 4 * mp.pi / omega, (x, v), size, {"no stick": M})


COMPUTE: dict[str, Callable[[], Point]] = {
    "6.6 A": partial(trilinear_corner, "A"),
    "6.6 B": partial(trilinear_corner, "B"),
    "6.6 fold": trilinear_fold,
    "6.7 fold": stick_slip_fold,
    "6.8 A": friction_symmetry_breaking,
    "6.8 B": friction_first_stick,
    "6.8 C": friction_second_stick,
    "6.9 A": partial(belt_touch, "A"),
    "6.9 B": partial(belt_touch, "B"),
    "6.9 C": partial(belt_touch, "C"),
    "6.9 fold I/V": belt_fold_stick,
    "6.9 fold II/III": partial(belt_smooth, "fold"),
    "6.9 flip III/IV": partial(belt_smooth, "flip"),
    "6.9 Neimark-Sacker III": partial(belt_smooth, "Neimark-Sacker"),
}
