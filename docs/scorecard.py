"""The page docs/scorecard.md: `python docs/scorecard.py` computes it anew (three minutes on one core).

What the thesis says stands here; what nsjax finds is computed; what it is compared with is a closed form, or the orbit
in 40-digit arithmetic of tests/references, where nothing of nsjax is used. `tests/claims/test_scorecard.py` checks the
page.
"""

import functools
import pathlib
import sys
from collections.abc import Callable
from typing import NamedTuple

import diffrax
import jax
import numpy as np
from scipy.optimize import brentq

import nsjax
from nsjax import gallery
from nsjax.gallery import Line, Motion, Plane


HERE = pathlib.Path(__file__).parent
sys.path.insert(0, str(HERE.parent / "tests" / "references"))
PAGE = HERE / "scorecard.md"
AGREES = "agrees"


class Number(NamedTuple):
    """A number that the thesis states."""

    where: str
    what: str
    thesis: str  # as it is printed
    value: float  # what that means, for the parameters below
    digits: float  # half a unit of its last digit, or 0 for an exact expression
    found: Callable[[], float]  # by nsjax
    known: Callable[[], float]  # independently
    by: str  # how
    remark: str = AGREES  # or why not


class Point(NamedTuple):
    """A bifurcation that the thesis names."""

    where: str
    thesis: str  # its name there
    name: str  # that of nsjax
    known: Callable[[], float]  # the parameter's value, independently
    key: str  # of the branch
    remark: str = AGREES


# Numbers.


def saltation(t: float, x: float, before: int, after: int) -> np.ndarray:
    return np.asarray(
        nsjax.saltation_matrix(
            gallery.thesis("3.4"), t, Motion(x, 0.2), "belt", {"belt": before}, {"belt": after}
        )  # fmt: skip
    )


@functools.cache
def eigenvalues(mu: float, x: float) -> tuple[np.ndarray, np.ndarray]:
    """Of section 5.7, and the Jacobian."""
    equilibrium = nsjax.find_equilibrium(gallery.HopfPitchfork(mu=mu), Plane(x, 0.0))
    return np.asarray(equilibrium.eigenvalues), np.asarray(equilibrium.jacobian)


def crossing(index: int) -> float:
    first, second = eigenvalues(-1.0, 0.0)[1], eigenvalues(1.0, 0.0)[1]
    return nsjax.setvalued.eigenvalue_crossings(first, second)[index].q


def period_of_5_7() -> float:
    return float(nsjax.find_orbit(gallery.HopfPitchfork(mu=-1.0), Plane(1.546, 0.0), period=4.031).period)


def exact_period_of_5_7() -> float:
    from orbit_reference import hopf_pitchfork_orbit

    return hopf_pitchfork_orbit().period


@functools.cache
def smoothed_zeros() -> dict[str, float]:
    system = nsjax.smoothed(gallery.HopfPitchfork(mu=-1.0), 10.0)
    branch = nsjax.continue_equilibrium(system, Plane(0.0, 0.0), "mu", (-1.0, 1.0))
    return {point.kind: point.value for point in branch.special}


def slope(sign: int) -> Callable[[], float]:
    """Where (2/π)(arctan z + z/(1 + z²)), z = ε μ, the slope of the smoothed |x + μ| - |x - μ| over 2, is 1/2."""
    return lambda: sign * brentq(lambda z: np.arctan(z) + z / (1 + z * z) - np.pi / 4, 0, 1, xtol=1e-15) / 10


SERIES = "differs: the thesis breaks off the series of arctan after its first term"
NUMBERS = (
    Number("(3.41)", "S₂₂ where the belt catches the mass", "0", 0.0, 0.0,
           lambda: float(saltation(0.0, 0.0, -1, 0)[1, 1]), lambda: 0.0, "closed form"),
    Number("(3.43)", "S₂₁ where it is released, ΔF = 1 N, m = 1 kg, v_dr = 0.2 m/s [1/s]", "-ΔF/(m v_dr)", -5.0, 0.0,
           lambda: float(saltation(0.0, 2.0, 0, -1)[1, 0]), lambda: -1 / 0.2, "closed form"),
    Number("(5.33)", "Re λ, trivial branch, μ < 0", "1/2", 0.5, 0.0,
           lambda: float(eigenvalues(-1.0, 0.0)[0][0].real), lambda: 0.5, "closed form"),
    Number("(5.33)", "Im λ, trivial branch, μ < 0", "√11/2", np.sqrt(11) / 2, 0.0,
           lambda: float(abs(eigenvalues(-1.0, 0.0)[0][0].imag)), lambda: np.sqrt(11) / 2, "closed form"),
    Number("(5.34)", "λ₁, trivial branch, μ > 0", "0.30", 0.30, 5e-3,
           lambda: float(eigenvalues(1.0, 0.0)[0][0].real), lambda: (np.sqrt(13) - 3) / 2, "closed form"),
    Number("(5.34)", "λ₂, trivial branch, μ > 0", "-3.30", -3.30, 5e-3,
           lambda: float(eigenvalues(1.0, 0.0)[0][1].real), lambda: -(np.sqrt(13) + 3) / 2, "closed form"),
    Number("(5.35)", "λ₁, other branches", "-0.38", -0.38, 5e-3,
           lambda: float(eigenvalues(1.0, 2.0)[0][0].real), lambda: (np.sqrt(5) - 3) / 2, "closed form"),
    Number("(5.35)", "λ₂, other branches", "-2.62", -2.62, 5e-3,
           lambda: float(eigenvalues(1.0, 2.0)[0][1].real), lambda: -(np.sqrt(5) + 3) / 2, "closed form"),
    Number("Fig. 5.13", "q at which a pair crosses the axis", "1/4", 0.25, 0.0, lambda: crossing(0), lambda: 0.25,
           "the trace is 1 - 4 q"),
    Number("Fig. 5.13", "q at which an eigenvalue crosses zero", "3/4", 0.75, 0.0, lambda: crossing(1), lambda: 0.75,
           "the determinant is 3 - 4 q"),
    Number("section 5.7", "period of the orbit [s]", "4.03", 4.03, 5e-3, period_of_5_7, exact_period_of_5_7,
           "40 digits"),
    Number("section 5.7", "μ of the Hopf point, smoothed with ε = 10", "-π/(8 ε)", -np.pi / 80, 0.0,
           lambda: smoothed_zeros()["Hopf"], slope(-1), "closed form", SERIES),
    Number("section 5.7", "μ of the pitchfork, smoothed with ε = 10", "π/(8 ε)", np.pi / 80, 0.0,
           lambda: smoothed_zeros()["pitchfork"], slope(1), "closed form", SERIES),
)  # fmt: skip


# Bifurcations.


def exactly(name: str) -> Callable[[], float]:
    def known() -> float:
        from branch_reference import POINTS

        return POINTS[name].at

    return known


def zero() -> float:
    return 0.0


EQUILIBRIA = {
    "(5.7)": (gallery.SaddleNode(1.0), Line(1.0)),
    "(5.8)": (gallery.DiscontinuousSaddleNode(1.0), Line(1.0)),
    "(5.10)": (gallery.Transcritical(-1.0), Line(0.0)),
    "(5.11)": (gallery.DiscontinuousTranscritical(-1.0), Line(0.0)),
    "(5.17)": (gallery.Pitchfork(-1.0, alpha=-1.0), Line(0.0)),
    "(5.18)": (gallery.DiscontinuousPitchfork(-1.0, alpha=-1.0), Line(0.0)),
    "(5.22)": (gallery.DiscontinuousPitchfork(-1.0, alpha=1.0), Line(0.0)),
    "(5.25)": (gallery.Hopf(-1.0), Plane(0.0, 0.0)),
    "(5.29)": (gallery.DiscontinuousHopf(-1.0), Plane(0.0, 0.0)),
    "(5.32)": (gallery.HopfPitchfork(-1.0), Plane(0.0, 0.0)),
}
ORBITS = {
    "6.6": (gallery.Trilinear(omega=1.15), Motion(-0.1, -0.7), {}, "omega", (0.5, 2.0)),
    "6.7": (gallery.StickSlip(c=0.1, v_dr=0.5), Motion(2.0, 0.0), dict(period=8.0), "v_dr", (0.4, 1.3)),
    "6.8": (gallery.ForcedFriction(omega=0.8), Motion(5.4, 2.7), {}, "omega", (0.5, 0.8)),
    "6.9": (gallery.ForcedStickSlip(omega=1.65), Motion(1.73, -0.83), dict(order=2), "omega", (1.5, 1.95)),
}
POINTS = (
    Point("(5.7)", "saddle-node", "saddle-node", zero, "(5.7)"),
    Point("(5.8)", "discontinuous saddle-node", "discontinuous saddle-node", zero, "(5.8)"),
    Point("(5.10)", "transcritical", "transcritical", zero, "(5.10)"),
    Point("(5.11)", "discontinuous transcritical", "discontinuous transcritical", zero, "(5.11)"),
    Point("(5.17)", "pitchfork, supercritical", "pitchfork, supercritical", zero, "(5.17)"),
    Point("(5.18)", "discontinuous pitchfork, supercritical", "discontinuous pitchfork, supercritical", zero, "(5.18)"),
    Point("(5.22)", "discontinuous pitchfork, subcritical", "discontinuous pitchfork, subcritical", zero, "(5.22)"),
    Point("(5.25)", "Hopf", "Hopf, supercritical", zero, "(5.25)"),
    Point("(5.29)", "discontinuous Hopf", "discontinuous Hopf", zero, "(5.29)"),
    Point("(5.32)", "Hopf-pitchfork", "discontinuous Hopf-pitchfork, supercritical", zero, "(5.32)"),
    Point("Fig. 6.12, ω_A", "no bifurcation", "no bifurcation", exactly("6.6 A"), "6.6"),
    Point("Fig. 6.12, ω_B", "discontinuous fold", "discontinuous fold", exactly("6.6 B"), "6.6"),
    Point("Fig. 6.12", "drawn, not named", "fold", exactly("6.6 fold"), "6.6"),
    Point("Fig. 6.15", "discontinuous fold, infinitely unstable", "discontinuous infinitely unstable fold",
          exactly("6.7 fold"), "6.7", "agrees; Fig. 6.16b rounds it to 1.1"),
    Point("Fig. 6.18, A", "symmetry breaking", "symmetry breaking, supercritical", exactly("6.8 A"), "6.8"),
    Point("Fig. 6.18, B", "discontinuous symmetry breaking", "discontinuous symmetry breaking, supercritical",
          exactly("6.8 B"), "6.8"),
    Point("Fig. 6.18, C", "no bifurcation", "no bifurcation", exactly("6.8 C"), "6.8"),
    Point("Fig. 6.20, A", "discontinuous fold", "discontinuous fold", exactly("6.9 A"), "6.9"),
    Point("Fig. 6.20, B", "discontinuous fold-flip", "discontinuous fold-flip", exactly("6.9 B"), "6.9",
          "agrees; the ω = 1.67587 of Fig. 6.23, \"just to the right\", is 0.008 above it"),
    Point("Fig. 6.20, C", "discontinuous flip", "discontinuous flip", exactly("6.9 C"), "6.9",
          "agrees; it lies on the branches VI and VII"),
    Point("Fig. 6.20, I/V", "fold", "fold", exactly("6.9 fold I/V"), "6.9"),
    Point("Fig. 6.20, II/III", "drawn, not named", "fold", exactly("6.9 fold II/III"), "6.9"),
    Point("Fig. 6.20, III/IV", "drawn, not named", "flip, supercritical", exactly("6.9 flip III/IV"), "6.9"),
    Point("Fig. 6.20, III", "not mentioned", "Neimark-Sacker", exactly("6.9 Neimark-Sacker III"), "6.9",
          "found besides: it lies next to the fold"),
)  # fmt: skip


def called(point) -> str:
    """Short name of a special point."""
    name = "no bifurcation" if point.kind == "none" else point.kind
    if point.kind != "none" and point.discontinuous:
        name = f"discontinuous {name}"
    return f"{name}, {point.criticality}" if point.criticality else name


@functools.cache
def special_points(key: str) -> tuple[tuple[float, str], ...]:
    """Value and name of each that nsjax finds on the branches of an equation, or of a section of chapter 6."""
    if key in EQUILIBRIA:
        system, start = EQUILIBRIA[key]
        branch = nsjax.continue_equilibrium(system, start, "mu", (-1.0, 1.0))
    else:
        system, start, guess, parameter, interval = ORBITS[key]
        how = dict(stepsize_controller=diffrax.PIDController(rtol=1e-12, atol=1e-12), max_steps=8192, max_events=16)
        orbit = nsjax.find_orbit(system, start, solver=diffrax.Tsit5(), **guess, **how)
        branch = nsjax.continue_orbit(system, orbit, parameter, interval)
    return tuple((float(point.value), called(point)) for point in branch.special_points)


def nearest(point: Point) -> tuple[float, str]:
    return min(special_points(point.key), key=lambda one: abs(one[0] - point.known()))


# The page.


def written(value: float) -> str:
    return f"{value + 0.0:.10g}" if abs(value) > 1e-12 else "0"


def number_row(row: Number, found: float) -> str:
    cells = row.where, row.what, row.thesis, written(found), f"{written(row.known())} ({row.by})", row.remark
    return f"| {' | '.join(cells)} |"


def point_row(row: Point, value: float, name: str) -> str:
    return f"| {' | '.join((row.where, row.thesis, name, written(value), written(row.known()), row.remark))} |"


def system_row(entry: gallery.Entry) -> str:
    return f"| {entry.key} | {entry.title} | `{type(entry.system()).__name__}` |"


PROSE = """\
# Scorecard

What R. I. Leine's thesis (2000) states, what nsjax finds, and what is known independently of both. Made by
`docs/scorecard.py`, checked by `tests/claims/test_scorecard.py`. Not complete yet: numbers that can only be read off
figures, and Appendix A, are left out.

## Numbers

| where | what | thesis | nsjax | independently | |
|---|---|---|---|---|---|
{numbers}

## Bifurcations

Values are those of μ [-], of ω [rad/s], in section 6.7 of v_dr [m/s]. Those of chapter 6 were computed in 40-digit
arithmetic from exact arcs (section 6.9: Taylor series), those of chapter 5 are zero by construction.

| where | thesis | nsjax | value by nsjax | independently | |
|---|---|---|---|---|---|
{points}

## Readings

Where the thesis can be read in several ways, or contradicts itself, these are the readings with which its orbits exist.

* Static friction (sections 3.4, 6.7, 6.8): sticking ends only when the force that is needed exceeds F_stick, although
  the force in slip is F_slip. With the convex hull of ±F_slip alone the orbits of 3.4 and 6.7 do not exist.
* Amplitudes in Figs. 6.12 to 6.21 are max |x| over a period.
* At ω_A of Fig. 6.12 the multipliers jump in angle only; Fig. 6.13 shows their modulus and so nothing there.
* (A.5) has no damping, but Appendix C.6 lists c_b. With F_bN = max(0, k_b (r - R_c) + c_b r') the figures of A.9 come
  out; that is the gallery's default.

## Systems

All that have a number in the thesis and stand in the gallery, with the values of Appendix C where it has any.

| number | system | class |
|---|---|---|
{systems}
"""


def page() -> str:
    return PROSE.format(
        numbers="\n".join(number_row(row, row.found()) for row in NUMBERS),
        points="\n".join(point_row(row, *nearest(row)) for row in POINTS),
        systems="\n".join(map(system_row, gallery.THESIS.values())),
    )


def main() -> None:
    jax.config.update("jax_enable_x64", True)
    PAGE.write_text(page(), encoding="utf-8")


if __name__ == "__main__":
    main()
