"""The scorecard of the thesis: what it states, what nsjax finds, and what is known independently of both.

What the thesis says stands here; what nsjax finds is computed. The independent values are closed forms, or were
computed by tests/references, in which there is nothing of nsjax: tests/claims/test_scorecard.py computes them anew.
"""

import functools
import warnings
from collections.abc import Callable, Iterator
from typing import Any, NamedTuple

import diffrax
import numpy as np

from .. import gallery
from .._numerics._stages import STAGES
from ..continuation.equilibria._branch import Branch
from ..continuation.equilibria._continue_equilibrium import continue_equilibrium
from ..continuation.orbits._branch import OrbitBranch
from ..continuation.orbits._continue_orbit import continue_orbit
from ..derivatives._saltation import saltation_matrix
from ..equilibria._find_equilibrium import find_equilibrium
from ..flow._solve import solve
from ..gallery import Line, Motion, Plane, Twist, TwistedWhirl, Whirl
from ..orbits._find_orbit import find_orbit
from ..orbits._orbit import Orbit
from ..regularise._regularise import smoothed
from ..setvalued._eigenvalue_crossings import eigenvalue_crossings
from ..system._system import System
from ._drillstring import STICK_SLIP_WHIRL
from ._family import Start


AGREES = "agrees"
WITHIN = 1e-9  # of each other are nsjax's values and the independent ones, relative
DRAWN = "drawn: the thesis gives no number"


class Number(NamedTuple):
    """A number that the thesis states."""

    where: str
    what: str
    thesis: str  # as it is printed
    value: float  # what that means, for the parameters below; not a number if the thesis only draws it
    digits: float  # half a unit of its last digit, or 0 for an exact expression
    found: Callable[[], float]  # by nsjax
    known: float  # independently
    by: str  # how
    remark: str = AGREES  # or why not


class Point(NamedTuple):
    """A bifurcation that the thesis names."""

    where: str
    thesis: str  # its name there
    name: str  # that of nsjax
    known: float  # the parameter's value, independently
    key: str  # of the branch
    remark: str = AGREES
    within: float = WITHIN  # to how much the independent value is known, relative


# Numbers.


def saltation(t: float, x: float, before: int, after: int) -> np.ndarray:
    return np.asarray(
        saltation_matrix(
            gallery.thesis("3.4"), t, Motion(x, 0.2), "belt", {"belt": before}, {"belt": after}
        )  # fmt: skip
    )


def slid() -> float:
    """How far example 2.2 slides in a tenth of a unit of time."""
    system: Any = gallery.thesis("example 2.2")
    return float(solve(system, 0.0, 0.1, Plane(0.0, float(system.c))).y1.x1)


def support(x: float, v: float, before: int, after: int) -> np.ndarray:
    """Saltation of section 3.5."""
    system = gallery.thesis("3.5")
    there = Motion(x, v)
    return np.asarray(saltation_matrix(system, 0.3, there, "support", {"support": before}, {"support": after}))


def trilinear(v: float) -> np.ndarray:
    """Saltation of section 6.6, at the support below."""
    free, touching = {"lower": -1, "upper": -1}, {"lower": 1, "upper": -1}
    return np.asarray(saltation_matrix(gallery.thesis("6.6"), 0.3, Motion(1.0, v), "lower", free, touching))


def held() -> float:
    return float(find_equilibrium(gallery.thesis("6.7"), Motion(1.1, 0.1)).y.x)


@functools.cache
def belt_orbit() -> Orbit:
    return find_orbit(gallery.StickSlip(c=0.1, v_dr=0.5), Motion(2.0, 0.0), period=8.0)


def rotor(omega: float, guess: Whirl, **changes: float) -> Any:
    return find_equilibrium(gallery.thesis("A.7", omega=omega, **changes), guess)


def in_the_middle(**changes: float) -> float:
    """The largest real part at ω = 2 rad/s, which is both (A.25) and (A.29)."""
    scene: Any = gallery.thesis("A.7", omega=2.0, coordinates="cartesian", **changes)
    return float(np.max(np.real(find_equilibrium(scene, scene.state()).eigenvalues)))


@functools.cache
def eigenvalues(mu: float, x: float) -> tuple[np.ndarray, np.ndarray]:
    """Of section 5.7, and the Jacobian."""
    equilibrium = find_equilibrium(gallery.HopfPitchfork(mu=mu), Plane(x, 0.0))
    return np.asarray(equilibrium.eigenvalues), np.asarray(equilibrium.jacobian)


def crossing(index: int) -> float:
    first, second = eigenvalues(-1.0, 0.0)[1], eigenvalues(1.0, 0.0)[1]
    return eigenvalue_crossings(first, second)[index].q


def period_of_5_7() -> float:
    return float(find_orbit(gallery.HopfPitchfork(mu=-1.0), Plane(1.546, 0.0), period=4.031).period)


@functools.cache
def smoothed_zeros() -> dict[str, float]:
    system = smoothed(gallery.HopfPitchfork(mu=-1.0), 10.0)
    branch = continue_equilibrium(system, Plane(0.0, 0.0), "mu", (-1.0, 1.0))
    return {point.kind: point.value for point in branch.special}


# Where (2/π)(arctan z + z/(1 + z²)), z = ε μ, the slope of the smoothed |x + μ| - |x - μ| over 2, is 1/2.
SLOPE = 0.044161079170532844
SERIES = "differs: the thesis breaks off the series of arctan after its first term"
NUMBERS = (
    Number("example 2.2", "x₁' on the surface (2.19), (2.20) [-]", "α f₊ + (1 - α) f₋ = 5", 5.0, 0.0,
           lambda: 10 * slid(), 5.0, "closed form"),
    Number("(3.41)", "S₂₂ where the belt catches the mass", "0", 0.0, 0.0,
           lambda: float(saltation(0.0, 0.0, -1, 0)[1, 1]), 0.0, "closed form"),
    Number("(3.43)", "S₂₁ where it is released, ΔF = 1 N, m = 1 kg, v_dr = 0.2 m/s [1/s]", "-ΔF/(m v_dr)", -5.0, 0.0,
           lambda: float(saltation(0.0, 2.0, 0, -1)[1, 0]), -1 / 0.2, "closed form"),
    Number("(3.57)", "S₂₁ where the mass meets the support, c_f = 0.5 N s/m, m = 1 kg [1/s]", "-c_f/m", -0.5, 0.0,
           lambda: float(support(0.0, 0.7, -1, 1)[1, 0]), -0.5, "closed form"),
    Number("(3.61)", "S - I where it leaves it, largest entry", "0", 0.0, 0.0,
           lambda: float(np.abs(support(0.1, -0.8, 1, -1) - np.eye(2)).max()), 0.0, "closed form"),
    Number("(5.33)", "Re λ, trivial branch, μ < 0", "1/2", 0.5, 0.0,
           lambda: float(eigenvalues(-1.0, 0.0)[0][0].real), 0.5, "closed form"),
    Number("(5.33)", "Im λ, trivial branch, μ < 0", "√11/2", np.sqrt(11) / 2, 0.0,
           lambda: float(abs(eigenvalues(-1.0, 0.0)[0][0].imag)), np.sqrt(11) / 2, "closed form"),
    Number("(5.34)", "λ₁, trivial branch, μ > 0", "0.30", 0.30, 5e-3,
           lambda: float(eigenvalues(1.0, 0.0)[0][0].real), (np.sqrt(13) - 3) / 2, "closed form"),
    Number("(5.34)", "λ₂, trivial branch, μ > 0", "-3.30", -3.30, 5e-3,
           lambda: float(eigenvalues(1.0, 0.0)[0][1].real), -(np.sqrt(13) + 3) / 2, "closed form"),
    Number("(5.35)", "λ₁, other branches", "-0.38", -0.38, 5e-3,
           lambda: float(eigenvalues(1.0, 2.0)[0][0].real), (np.sqrt(5) - 3) / 2, "closed form"),
    Number("(5.35)", "λ₂, other branches", "-2.62", -2.62, 5e-3,
           lambda: float(eigenvalues(1.0, 2.0)[0][1].real), -(np.sqrt(5) + 3) / 2, "closed form"),
    Number("Fig. 5.13", "q at which a pair crosses the axis", "1/4", 0.25, 0.0, lambda: crossing(0), 0.25,
           "the trace is 1 - 4 q"),
    Number("Fig. 5.13", "q at which an eigenvalue crosses zero", "3/4", 0.75, 0.0, lambda: crossing(1), 0.75,
           "the determinant is 3 - 4 q"),
    Number("section 5.7", "period of the orbit [s]", "4.03", 4.03, 5e-3, period_of_5_7, 4.031062171893588,
           "40 digits"),
    Number("section 5.7", "μ of the Hopf point, smoothed with ε = 10", "-π/(8 ε)", -np.pi / 80, 0.0,
           lambda: smoothed_zeros()["Hopf"], -SLOPE, "closed form", SERIES),
    Number("section 5.7", "μ of the pitchfork, smoothed with ε = 10", "π/(8 ε)", np.pi / 80, 0.0,
           lambda: smoothed_zeros()["pitchfork"], SLOPE, "closed form", SERIES),
    Number("(6.20)", "S₂₁ where the mass of 6.6 meets a support, c_f = 0.5 N s/m, m = 1 kg [1/s]", "-c_f/m", -0.5, 0.0,
           lambda: float(trilinear(0.7)[1, 0]), -0.5, "closed form"),
    Number("(6.23)", "x of the equilibrium of 6.7 [m]", "F_slip/k", 1.0, 0.0, held, 1.0, "closed form"),
    Number("section 6.7", "second multiplier of the stable orbit", "0", 0.0, 0.0,
           lambda: float(np.abs(belt_orbit().multipliers).min()), 0.0, "closed form"),
    Number("Fig. 6.16a", "fixed point 3 of the map, v_dr = 0.5 m/s [m]", "drawn", np.nan, 0.0,
           lambda: float(belt_orbit().maximum(lambda t, y: y.x)), 2.069791716371943, "closed form", DRAWN),
    Number("(A.17)", "Ω on e2 at ω = 2.6 rad/s [rad/s]", "D ω/(2 (c + D))", 0.325, 0.0,
           lambda: float(rotor(2.6, whirl_without_contact(2.6)).y.Omega), 0.325, "closed form"),
    Number("(A.20)", "r on e2 at ω = 2.6 rad/s [m]", "a root", 0.75, 0.0,
           lambda: float(rotor(2.6, whirl_without_contact(2.6)).y.r), 0.75, "closed form"),
    Number("(A.25)", "largest Re λ in the middle at ω = 2 √(k/m_f), D = 0 [1/s]", "0", 0.0, 0.0,
           lambda: in_the_middle(D=0.0), 0.0, "closed form"),
    Number("(A.29)", "largest Re λ in the middle at ω = 2 √(k/m), c = 0 [1/s]", "0", 0.0, 0.0,
           lambda: in_the_middle(c=0.0), 0.0, "closed form"),
    Number("(A.34)", "r while it rolls, ω = 2 rad/s, B₁ = 0 [m]", "a formula: 1.35", 1.3518358156576293, 0.0,
           lambda: float(rotor(2.0, Whirl(1.57, 0.0, -2.55), B_1=0.0).y.r), 1.56812954616285, "root of (A.33)",
           "differs: the denominator is 2 (k + k_b - ω² m_f/4)"),
    Number("Fig. A.6", "r on e4 at ω = 3 rad/s [m]", "drawn", np.nan, 0.0,
           lambda: float(rotor(3.0, Whirl(2.08, 0.0, -2.88)).y.r), 2.084733222215419, "root of (A.30), (A.31)", DRAWN),
)  # fmt: skip


# Bifurcations.


def whirl(omega: float, r: float, Omega: float) -> tuple[System, Whirl]:
    return gallery.thesis("A.7", omega=omega), Whirl(r, 0.0, Omega)


def whirl_without_contact(omega: float) -> Whirl:
    """e2 of (A.20), with the values of Appendix C.6."""
    r = float(np.sqrt((omega**2 / 4 * (1 - 2 * 0.25 + 2 * 0.25**2) - 1) / 0.1))
    return Whirl(r, 0.0, 0.25 * omega / 2)


def middle() -> tuple[System, Any]:
    scene: Any = gallery.thesis("A.7", omega=2.64, coordinates="cartesian")
    return scene, scene.state()


def twisted(omega: float) -> tuple[System, TwistedWhirl]:
    """E2 of A.9, with the twist to within what Newton's method needs."""
    free = whirl_without_contact(omega)
    return gallery.thesis("A.9", omega=omega), TwistedWhirl(free.r, 0.0, free.Omega, 0.0, 0.0)


MU = "mu", (-1.0, 1.0)
# Of each a system with a guess, made when it is asked for; the parameter, and its interval.
EQUILIBRIA: dict[str, tuple[Callable[[], tuple[System, Any]], str, tuple[float, float]]] = {
    "(5.7)": (lambda: (gallery.SaddleNode(1.0), Line(1.0)), *MU),
    "(5.8)": (lambda: (gallery.DiscontinuousSaddleNode(1.0), Line(1.0)), *MU),
    "(5.10)": (lambda: (gallery.Transcritical(-1.0), Line(0.0)), *MU),
    "(5.11)": (lambda: (gallery.DiscontinuousTranscritical(-1.0), Line(0.0)), *MU),
    "(5.17)": (lambda: (gallery.Pitchfork(-1.0, alpha=-1.0), Line(0.0)), *MU),
    "(5.18)": (lambda: (gallery.DiscontinuousPitchfork(-1.0, alpha=-1.0), Line(0.0)), *MU),
    "(5.22)": (lambda: (gallery.DiscontinuousPitchfork(-1.0, alpha=1.0), Line(0.0)), *MU),
    "(5.25)": (lambda: (gallery.Hopf(-1.0), Plane(0.0, 0.0)), *MU),
    "(5.29)": (lambda: (gallery.DiscontinuousHopf(-1.0), Plane(0.0, 0.0)), *MU),
    "(5.32)": (lambda: (gallery.HopfPitchfork(-1.0), Plane(0.0, 0.0)), *MU),
    "A.7 e1": (middle, "omega", (2.5, 2.7)),
    "A.7 e2": (lambda: (gallery.thesis("A.7", omega=2.64), whirl_without_contact(2.64)), "omega", (2.55, 2.8)),
    "A.7 e4": (lambda: whirl(0.6, 1.02, -2 * 0.6 / 1.02), "omega", (0.2, 2.6)),
    "A.9 E2": (lambda: twisted(2.55), "omega", (2.535, 2.6)),
}
ORBITS = {
    "6.6": (gallery.Trilinear(omega=1.15), Motion(-0.1, -0.7), {}, "omega", (0.5, 2.0)),
    "6.7": (gallery.StickSlip(c=0.1, v_dr=0.5), Motion(2.0, 0.0), dict(period=8.0), "v_dr", (0.4, 1.3)),
    "6.8": (gallery.ForcedFriction(omega=0.8), Motion(5.4, 2.7), {}, "omega", (0.5, 0.8)),
    "6.9": (gallery.ForcedStickSlip(omega=1.65), Motion(1.73, -0.83), dict(order=2), "omega", (1.5, 1.95)),
    "A.8": (gallery.thesis("A.8", omega=0.77), Twist(-1.0, 0.3), dict(period=6.32), "omega", (0.72, 0.78)),
    "A.8 stick": (gallery.thesis("A.8", omega=1.86), Twist(-2.1, 0.45), dict(period=6.3), "omega", (1.8, 1.9)),
}
# Families of A.9, which take minutes: followed where they are asked for, and not with the others.
EIGHT = 2e-8  # by shooting with scipy, where the test function of a point hardly changes
FAMILIES = {f"A.9 {name}": name for name in ("P1", "P2 to P4", "P5 and P6")}
PARTS = {"P1": (1.99, 2.3), "P5 and P6": (2.5424, 2.58)}  # on the branch through the start, with all points below
POINTS = (
    Point("(5.7)", "saddle-node", "saddle-node", 0.0, "(5.7)"),
    Point("(5.8)", "discontinuous saddle-node", "discontinuous saddle-node", 0.0, "(5.8)"),
    Point("(5.10)", "transcritical", "transcritical", 0.0, "(5.10)"),
    Point("(5.11)", "discontinuous transcritical", "discontinuous transcritical", 0.0, "(5.11)"),
    Point("(5.17)", "pitchfork, supercritical", "pitchfork, supercritical", 0.0, "(5.17)"),
    Point("(5.18)", "discontinuous pitchfork, supercritical", "discontinuous pitchfork, supercritical", 0.0, "(5.18)"),
    Point("(5.22)", "discontinuous pitchfork, subcritical", "discontinuous pitchfork, subcritical", 0.0, "(5.22)"),
    Point("(5.25)", "Hopf", "Hopf, supercritical", 0.0, "(5.25)"),
    Point("(5.29)", "discontinuous Hopf", "discontinuous Hopf", 0.0, "(5.29)"),
    Point("(5.32)", "Hopf-pitchfork", "discontinuous Hopf-pitchfork, supercritical", 0.0, "(5.32)"),
    Point("Fig. 6.12, ω_A", "no bifurcation", "no bifurcation", 0.8972718642496267, "6.6"),
    Point("Fig. 6.12, ω_B", "discontinuous fold", "discontinuous fold", 1.0919721615618228, "6.6"),
    Point("Fig. 6.12", "drawn, not named", "fold", 1.254808836944299, "6.6"),
    Point("Fig. 6.15", "discontinuous fold, infinitely unstable", "discontinuous infinitely unstable fold",
          1.0980926241158726, "6.7", "agrees; Fig. 6.16b rounds it to 1.1"),
    Point("Fig. 6.18, A", "symmetry breaking", "symmetry breaking, supercritical", 0.6082104695967931, "6.8"),
    Point("Fig. 6.18, B", "discontinuous symmetry breaking", "discontinuous symmetry breaking, supercritical",
          0.6803260241880431, "6.8"),
    Point("Fig. 6.18, C", "no bifurcation", "no bifurcation", 0.6119254805267682, "6.8"),
    Point("Fig. 6.20, A", "discontinuous fold", "discontinuous fold", 1.5140707167931038, "6.9"),
    Point("Fig. 6.20, B", "discontinuous fold-flip", "discontinuous fold-flip", 1.667690998105968, "6.9",
          "agrees; the ω = 1.67587 of Fig. 6.23, \"just to the right\", is 0.008 above it"),
    Point("Fig. 6.20, C", "discontinuous flip", "discontinuous flip", 1.7077997148850603, "6.9",
          "agrees; it lies on the branches VI and VII"),
    Point("Fig. 6.20, I/V", "fold", "fold", 1.6834405724957293, "6.9"),
    Point("Fig. 6.20, II/III", "drawn, not named", "fold", 1.9117967959941686, "6.9"),
    Point("Fig. 6.20, III/IV", "drawn, not named", "flip, supercritical", 1.712981036226939, "6.9"),
    Point("Fig. 6.20, III", "not mentioned", "Neimark-Sacker", 1.9099652743390918, "6.9",
          "found besides: it lies next to the fold"),
    Point("Fig. A.6, c", "e2 branches off e1", "Hopf, supercritical", 2.5298221281347035, "A.7 e1",
          "agrees, in Cartesian coordinates"),
    Point("Fig. A.6, f", "discontinuous saddle-node", "discontinuous saddle-node", 2.65329983228432, "A.7 e2",
          "agrees; the end of A.7 exchanges the causes at d and f"),
    Point("Fig. A.6, d", "discontinuous saddle-node", "discontinuous saddle-node", 0.42653790106203704, "A.7 e4",
          "agrees; the end of A.7 exchanges the causes at d and f"),
    Point("Fig. A.7b", "not mentioned", "no bifurcation", 0.742288947765, "A.8",
          "found besides: slip backwards appears"),
    Point("Fig. A.7a", "stick at ω = 2", "no bifurcation", 1.8366090661460444, "A.8 stick",
          "differs: beyond this ω there is no stick any more"),
    Point("Fig. A.8, E2", "Hopf", "Hopf, subcritical", 2.540313205640687, "A.9 E2"),
    Point("Fig. A.9, P1a/P1b", "Neimark-Sacker", "Neimark-Sacker", 2.2560104736564464, "A.9 P1"),
    Point("Fig. A.11, P2/P3", "discontinuous flip", "discontinuous flip, subcritical", 2.363098026192868,
          "A.9 P2 to P4"),
    Point("Fig. A.11, P3/P4", "discontinuous fold", "discontinuous fold", 2.3667897313084723, "A.9 P2 to P4"),
    Point("Fig. A.11, P4a/P4b", "Neimark-Sacker", "Neimark-Sacker", 2.9942060216557715, "A.9 P2 to P4"),
    Point("Fig. A.11, P4b/P4c", "flip", "flip, supercritical", 3.1247278847310227, "A.9 P2 to P4",
          AGREES, EIGHT),
    Point("Fig. A.11, P4c/P4d", "flip", "flip, supercritical", 3.232391958730243, "A.9 P2 to P4", AGREES, EIGHT),
    Point("Fig. A.11, P4d/P4e", "drawn, not named", "fold", 3.439077733153615, "A.9 P2 to P4"),
    Point("Fig. A.12, f", "Hopf", "end of the branch", 2.65329983228432, "A.9 P2 to P4",
          "agrees: P4 ends at the equilibrium, with a period that is not zero"),
    Point("Fig. A.10, P6a/P6b", "drawn, not named", "fold", 2.5765131079176147, "A.9 P5 and P6"),
    Point("Fig. A.12, P5/P6", "discontinuous fold", "discontinuous fold-flip", 2.5534276912267426, "A.9 P5 and P6",
          "found besides: multipliers cross -1 too, and orbits of twice the period are born"),
)  # fmt: skip


def called(point: Any) -> str:
    """Short name of a special point."""
    if point.kind in point.plain:
        return point.name
    name = "no bifurcation" if point.kind == "none" else point.kind
    if point.kind != "none" and point.discontinuous:
        name = f"discontinuous {name}"
    return f"{name}, {point.criticality}" if point.criticality else name


@functools.cache
def special_points(key: str) -> tuple[tuple[float, str], ...]:
    """Value and name of each that nsjax finds on the branches of an equation, or of a section of chapter 6."""
    if key in EQUILIBRIA:
        make, parameter, interval = EQUILIBRIA[key]
        branch: Branch | OrbitBranch = continue_equilibrium(*make(), parameter, interval)
    elif key in FAMILIES:
        branch = followed(FAMILIES[key])
    else:
        system, start, guess, parameter, interval = ORBITS[key]
        how = dict(stepsize_controller=diffrax.PIDController(rtol=1e-12, atol=1e-12), max_steps=8192, max_events=16)
        orbit = find_orbit(system, start, solver=diffrax.Tsit5(), **guess, **how)
        branch = continue_orbit(system, orbit, parameter, interval)
    return tuple((float(point.value), called(point)) for point in branch.special_points)


def followed(name: str) -> OrbitBranch:
    """A family of A.9, as `continue A.9` follows it; or the part that has the points of the table, in longer steps:
    special points are found to the same digits between them."""
    family = next(family for family in STICK_SLIP_WHIRL if family.name == name)
    entry = gallery.entry("A.9")
    assert entry.orbit is not None and family.interval is not None
    begin = Start(entry.system(), entry.orbit.y0, entry.orbit.period)
    if family.start is not None:
        begin = family.start(entry.system())
    how: dict[str, Any] = dict(rtol=1e-12, atol=1e-12)
    most: dict[str, Any] = {} if family.most is None else dict(max_branches=family.most)
    if name in PARTS:
        how |= dict(solver=diffrax.Tsit5(), max_steps=8192)
        most = dict(max_branches=1, max_step=0.1)
    orbit = find_orbit(begin.system, begin.y0, period=begin.period, **how)
    with warnings.catch_warnings():
        warnings.filterwarnings("ignore", "There are more than `max_branches`")
        interval = PARTS.get(name, family.interval)
        return continue_orbit(begin.system, orbit, "omega", interval, max_laps=family.laps, **most, **how)


def nearest(point: Point) -> tuple[float, str]:
    return min(special_points(point.key), key=lambda one: abs(one[0] - point.known))


def written(value: float, within: float = WITHIN) -> str:
    """In ten digits, or as many as are known."""
    return f"{value + 0.0:.{10 if within <= WITHIN else int(-np.log10(within)) + 1}g}" if abs(value) > 1e-12 else "0"


class Row(NamedTuple):
    """A line of the table."""

    where: str
    what: str
    thesis: str
    found: str  # with the name that nsjax has for it, if it has one
    known: str
    difference: float
    remark: str
    within: float


NUMBERS_OF = "numbers"  # what is computed besides the branches


def scorecard(sections: tuple[str, ...] = ()) -> Iterator[Row]:
    """The table, computed now.

    **Arguments:**

    - `sections`: which keys of `EQUILIBRIA`, `ORBITS` and `FAMILIES`, or "numbers"; by default all but the last.
    """
    for row in NUMBERS if NUMBERS_OF in (sections or (NUMBERS_OF,)) else ():
        STAGES.stage(f"scorecard: {row.where}, {row.what}")
        value = row.found()
        found, known = written(value), written(row.known)
        yield Row(row.where, row.what, row.thesis, found, known, value - row.known, row.remark, WITHIN)
    for row in POINTS:
        if row.key in sections or not sections and row.key not in FAMILIES:
            STAGES.stage(f"scorecard: {row.where}")
            value, name = nearest(row)
            told = f"{name}, {written(value)}"
            known, off = written(row.known, row.within), value - row.known
            yield Row(row.where, "bifurcation", row.thesis, told, known, off, row.remark, row.within)


def row_text(row: Row) -> str:
    """In lines: where, what the thesis says, what nsjax finds, and what is known otherwise."""
    return (
        f"{row.where}: {row.what}\n"
        f"  thesis         {row.thesis}\n"
        f"  nsjax          {row.found}\n"
        f"  independently  {row.known}, difference {row.difference:.1e}\n"
        f"  {row.remark}"
    )


def is_off(row: Row) -> bool:
    """Whether nsjax is not where it is to be."""
    return not abs(row.difference) <= row.within * (1 + abs(float(row.known)))
