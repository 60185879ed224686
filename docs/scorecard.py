"""The page docs/scorecard.md: `python docs/scorecard.py` computes it anew (three minutes on one core).

The tables of numbers and bifurcations are those of `python -m nsjax scorecard`, `nsjax/_cli/_scorecard.py`; the
branches of A.9, which take twenty minutes, are read from the files that the notebook of the drillstring keeps. Which
figure is drawn where is said here. `tests/claims/test_scorecard.py` checks the page.
"""

import functools
import pathlib
from typing import NamedTuple

import jax

from nsjax import gallery, OrbitBranch
from nsjax._cli._scorecard import (
    AGREES,
    called,
    DRAWN,
    EQUILIBRIA,
    FAMILIES,
    nearest,
    Number,
    NUMBERS,
    ORBITS,
    Point,
    POINTS,
    special_points as special_points,
    written,
)


HERE = pathlib.Path(__file__).parent
PAGE = HERE / "scorecard.md"
BRANCHES = HERE.parent / "notebooks" / "drillstring"
__all__ = ["AGREES", "DRAWN", "EQUILIBRIA", "ORBITS"]


# Figures.


class Command(NamedTuple):
    """A picture that `python -m nsjax` writes by this command."""

    verb: str  # "run" or "continue"
    key: str
    picture: str

    def __str__(self) -> str:
        key = f'"{self.key}"' if " " in self.key else self.key
        return f"`{self.verb} {key}`: {self.picture}"


class Notebook(NamedTuple):
    """A cell of a notebook, which has the words."""

    stem: str
    words: str

    def __str__(self) -> str:
        return f"[{self.stem}](../notebooks/{self.stem}.ipynb)"


class Picture(NamedTuple):
    """A picture of the documentation, drawn by a script that has the words."""

    file: str
    words: str
    script: str = "pictures/thesis.py"

    def __str__(self) -> str:
        return f"[{self.file}](pictures/{self.file})"


class Figure(NamedTuple):
    """A figure of the thesis, and where it is drawn. `schematic` says what it is if it shows no result; then what is
    named besides corresponds to it, if anything does."""

    number: str
    caption: str
    drawn: tuple[Command | Notebook | Picture, ...] = ()
    schematic: str = ""

    @property
    def where(self) -> str:
        places = ", ".join(map(str, self.drawn))
        if not self.schematic:
            return places
        return f"{self.schematic}; ours: {places}" if places else self.schematic


CHAPTER_2 = functools.partial(Picture, "thesis_2.png")
CHAPTERS_3_TO_6 = functools.partial(Picture, "thesis_3_to_6.png")
SKETCHES = functools.partial(Picture, "thesis_sketches.png")
STICK_SLIP, EQUILIBRIA_03, BRANCHES_04, DRILLSTRING = (
    functools.partial(Notebook, stem) for stem in ("01_stick_slip", "03_equilibria", "04_branches", "05_drillstring")
)
Run, Continue = (functools.partial(Command, verb) for verb in ("run", "continue"))
DIAGRAM, MULTIPLIERS, CIRCLES = "bifurcation-diagram", "multiplier-diagram", "multiplier-circles"
SKETCH, DEFINITION, MEASURED = "a sketch of a mechanism", "a sketch of a definition", "a measurement, of no model"
FIGURES = (
    Figure("2.1", "Transversal intersection", (CHAPTER_2('"2.1"'), Run("example 2.1", "phase-portrait"))),
    Figure("2.2", "Attraction sliding mode", (CHAPTER_2('"2.2"'), Run("example 2.2", "phase-portrait"))),
    Figure("2.3", "Repulsion sliding mode", (CHAPTER_2('"2.3"'),)),
    Figure("2.4", "Numerical approximation of a sliding mode", (CHAPTER_2('"2.4a"'),)),
    Figure("2.5", "Friction models", (CHAPTER_2('"2.5"'),)),
    Figure("2.6", "Block on a floor", (SKETCHES('"2.6"'),), SKETCH),
    Figure("2.7", "1-DOF model with dry friction", (SKETCHES('"2.7, 3.4"'),), SKETCH),
    Figure("2.8", "Phase spaces of the stick-slip system", (CHAPTER_2('"2.8,'),)),
    Figure("2.9", "Periodic solutions by smoothing and by the switch model", (CHAPTER_2('"2.9a,'),)),
    Figure("3.1", "Projection of derivatives on the normal", (), DEFINITION),
    Figure("3.2", "Disturbed and undisturbed solution", (Notebook("02_design", "perturbation_tube"),), DEFINITION),
    Figure("3.3", "Construction of δt for autonomous Σ", (), DEFINITION),
    Figure("3.4", "1-DOF model with dry friction", (SKETCHES('"2.7, 3.4"'),), SKETCH),
    Figure("3.5", "Phase portrait", (Run("3.4", "phase-portrait"), STICK_SLIP("plot.phase_portrait(orbit"))),
    Figure("3.6", "Definition of subspaces V, W and D", (CHAPTERS_3_TO_6('"3.6 and 6.14"'),)),
    Figure("3.7", "Fundamental solution matrix", (Run("3.4", "fundamental-matrix"),)),
    Figure("3.8", "Mass with discontinuous support", (SKETCHES('"3.8a"'), Run("3.5", "phase-portrait"))),
    Figure("4.1", "Linear approximation over a hyper-surface", (), DEFINITION),
    Figure("4.2", "Linear approximation with two hyper-surfaces", (), DEFINITION),
    Figure("4.3", "Function, classical derivative and generalized derivative", (CHAPTERS_3_TO_6('"4.3"'),)),
    Figure("5.1", "Hysteresis point", (EQUILIBRIA_03("Fig. 5.1"),)),
    Figure("5.2", "Eigenvalue paths at a bifurcation", (EQUILIBRIA_03("Fig. 5.2"),)),
    Figure("5.3", "Eigenvalue paths at a bifurcation", (EQUILIBRIA_03("Fig. 5.3"),)),
    Figure("5.4", "Saddle-node bifurcation", (EQUILIBRIA_03("Fig. 5.4a"),)),
    Figure("5.5", "Transcritical bifurcation, smooth", (EQUILIBRIA_03("Fig. 5.5a"),)),
    Figure("5.6", "Transcritical bifurcation, discontinuous", (EQUILIBRIA_03("Fig. 5.6a"),)),
    Figure("5.7", "Non-symmetric smoothing", (EQUILIBRIA_03("Fig. 5.7,"),)),
    Figure("5.8", "Pitchfork bifurcation, smooth", (EQUILIBRIA_03("Fig. 5.8a"),)),
    Figure("5.9", "Pitchfork bifurcation, discontinuous", (EQUILIBRIA_03("Fig. 5.9a"),)),
    Figure("5.10", "Non-symmetric smoothing", (EQUILIBRIA_03("Fig. 5.10,"),)),
    Figure("5.11", "Hopf bifurcation, smooth", (EQUILIBRIA_03("Fig. 5.11,"),)),
    Figure("5.12", "Hopf bifurcation, discontinuous", (EQUILIBRIA_03("Fig. 5.12,"),)),
    Figure("5.13", "Path of the eigenvalues of J(0, 0)", (EQUILIBRIA_03("Fig. 5.13"),)),
    Figure("5.14", "Bifurcation diagrams", (EQUILIBRIA_03("Fig. 5.14a"),)),
    Figure("5.15", "Periodic solution", (EQUILIBRIA_03("Fig. 5.15"), Run("5.7", "phase-portrait"))),
    Figure("5.16", "Path of the eigenvalues of the approximating system", (EQUILIBRIA_03("Fig. 5.16"),)),
    Figure("6.1", "Discontinuous bifurcation; single crossing", (Continue("6.6", CIRCLES),), DEFINITION),
    Figure("6.2", "Discontinuous bifurcation; double crossing", (Continue("6.9", CIRCLES),), DEFINITION),
    Figure("6.3", "Poincaré map for an autonomous system", (), DEFINITION),
    Figure("6.4", "Poincaré map at a fold bifurcation", (BRANCHES_04("Fig. 6.16"),), "sketches of maps"),
    Figure("6.5", "Poincaré map at a flip bifurcation", (), "sketches of maps"),
    Figure("6.6", "Tent map", (BRANCHES_04("Fig. 6.23"),), "a sketch of a map"),
    Figure("6.7", "Double intersection of a smooth hyper-surface", (), DEFINITION),
    Figure("6.8", "Double intersection of a non-smooth hyper-surface", (), DEFINITION),
    Figure("6.9", "Third scenario", (), DEFINITION),
    Figure("6.10", "Trilinear system", (SKETCHES('"6.10"'),), SKETCH),
    Figure("6.11", "Subspaces of the trilinear system", (Run("6.6", "phase-portrait"),)),
    Figure("6.12", "Response diagram of trilinear spring system", (Continue("6.6", DIAGRAM), BRANCHES_04("Fig. 6.12"))),
    Figure("6.13", "Floquet multipliers", (Continue("6.6", MULTIPLIERS), BRANCHES_04("Fig. 6.13"))),
    Figure("6.14", "Phase plane of the stick-slip system", (CHAPTERS_3_TO_6('"3.6 and 6.14"'),)),
    Figure("6.15", "Bifurcation diagram, stick-slip system", (Continue("6.7", DIAGRAM), BRANCHES_04("Fig. 6.15"))),
    Figure("6.16", "Poincaré maps of the stick-slip system", (BRANCHES_04("Fig. 6.16"),)),
    Figure("6.17", "Forced vibration with dry friction", (SKETCHES('"6.17"'),), SKETCH),
    Figure("6.18", "Bifurcation diagram, dry friction", (Continue("6.8", DIAGRAM), BRANCHES_04("Fig. 6.18"))),
    Figure("6.19", "Floquet multipliers", (Continue("6.8", MULTIPLIERS), BRANCHES_04("Fig. 6.19"))),
    Figure("6.20", "Bifurcation diagram, forced stick-slip", (Continue("6.9", DIAGRAM), BRANCHES_04("Fig. 6.20"))),
    Figure(
        "6.21",
        "Bifurcation diagram, forced stick-slip",
        (Continue("6.9", f"{DIAGRAM}-enlarged"), BRANCHES_04("Fig. 6.21")),
    ),
    Figure("6.22", "Floquet multiplier", (Continue("6.9", MULTIPLIERS), BRANCHES_04("Fig. 6.22"))),
    Figure("6.23", "Poincaré map (ω = 1.67587 rad/s)", (BRANCHES_04("Fig. 6.23"),)),
    Figure("A.1", "Drilling rig", (), SKETCH),
    Figure("A.2", "Measured downhole angular velocity versus time", (), MEASURED),
    Figure("A.3", "Measured downhole friction curve", (), MEASURED),
    Figure("A.4", "Measured bending moment versus angular velocity", (DRILLSTRING("up and down"),), MEASURED),
    Figure("A.5", "Stick-slip whirl model", (DRILLSTRING("scene.sketch()"),), SKETCH),
    Figure("A.6", "Whirl model, equilibrium branches", (Continue("A.7", DIAGRAM), DRILLSTRING("Fig. A.6"))),
    Figure(
        "A.7",
        "Stick-slip model",
        (Run("A.8", "phase-portrait"), Continue("A.8", DIAGRAM), DRILLSTRING("Fig. A.7a"), DRILLSTRING("Fig. A.7b")),
    ),
    Figure("A.8", "Equilibrium branches", (Continue("A.9", "equilibria"), DRILLSTRING("Fig. A.8"))),
    Figure("A.9", "Periodic branches", (Continue("A.9", DIAGRAM), DRILLSTRING("Fig. A.9"))),
    Figure("A.10", "Zoom of Fig. A.9", (Continue("A.9", f"{DIAGRAM}-enlarged"), DRILLSTRING("Fig. A.10"))),
    Figure("A.11", "Zoom of Fig. A.10", (Continue("A.9", f"{DIAGRAM}-enlarged-2"), DRILLSTRING("Fig. A.11"))),
    Figure("A.12", "Zoom of Fig. A.11", (Continue("A.9", f"{DIAGRAM}-enlarged-3"), DRILLSTRING("Fig. A.12"))),
)


def figure_row(figure: Figure) -> str:
    return f"| {figure.number} | {figure.caption} | {figure.where} |"


# The page.


@functools.cache
def kept(key: str) -> tuple[tuple[float, str], ...]:
    """Value and name of the special points of a family of A.9, from its file."""
    name = FAMILIES[key]
    system = gallery.FreeDrillstringScene() if name == "P1" else gallery.thesis("A.9")
    branch = OrbitBranch.load(BRANCHES / f"A.9-{'-'.join(name.split())}.npz", system)
    return tuple((float(point.value), called(point)) for point in branch.special_points)


def found(row: Point) -> tuple[float, str]:
    """What nsjax finds: of A.9 from the files."""
    if row.key not in FAMILIES:
        return nearest(row)
    return min(kept(row.key), key=lambda one: abs(one[0] - row.known))


def number_row(row: Number, found: float) -> str:
    cells = row.where, row.what, row.thesis, written(found), f"{written(row.known)} ({row.by})", row.remark
    return f"| {' | '.join(cells)} |"


def point_row(row: Point, value: float, name: str) -> str:
    known = written(row.known, row.within)
    return f"| {' | '.join((row.where, row.thesis, name, written(value), known, row.remark))} |"


def system_row(entry: gallery.Entry) -> str:
    return f"| {entry.key} | {entry.title} | `{type(entry.system()).__name__}` |"


PROSE = """\
# Scorecard

What R. I. Leine's thesis (2000) states, what nsjax finds, and what is known independently of both.
`python -m nsjax scorecard` computes it anew. Made by `docs/scorecard.py`, checked by
`tests/claims/test_scorecard.py`.

## Numbers

| where | what | thesis | nsjax | independently | |
|---|---|---|---|---|---|
{numbers}

## Bifurcations

Values are those of μ [-], of ω [rad/s], in section 6.7 of v_dr [m/s]. Those of chapter 6 were computed in 40-digit
arithmetic from exact arcs (section 6.9: Taylor series), those of chapter 5 are zero by construction, those of
Appendix A are closed forms or roots in 30 digits, of A.8 and of P1 to P6 of A.9 from integrations by scipy, the latter
by shooting with saltation matrices, which gives some of them to eight digits only. nsjax's values of P1 to P6 are those
of the files of [05_drillstring](../notebooks/05_drillstring.ipynb): `python -m nsjax scorecard "A.9 P1"` follows one
family anew, which takes minutes.

| where | thesis | nsjax | value by nsjax | independently | |
|---|---|---|---|---|---|
{points}

## Figures

Every figure of chapters 2 to 6 and of Appendix A (chapter 1 has none), and what draws it: `run` and `continue` are
commands of `python -m nsjax`, and write a picture of that name.

| figure | | drawn by |
|---|---|---|
{figures}

## Not compared

The thesis's counts of operations and of integration points (section 2.4) are those of its programs; our steps for
the same two orbits are in [Fig. 2.9](pictures/thesis_2.png). The measured numbers of Appendix A (11.5, 7 and 2 rad/s in
section A.10) belong to no model.

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
        points="\n".join(point_row(row, *found(row)) for row in POINTS),
        figures="\n".join(map(figure_row, FIGURES)),
        systems="\n".join(map(system_row, gallery.THESIS.values())),
    )


def main() -> None:
    jax.config.update("jax_enable_x64", True)
    PAGE.write_text(page(), encoding="utf-8")


if __name__ == "__main__":
    main()
