"""The scorecard of the thesis, docs/scorecard.md: no cell is empty, each is what its script finds, and every figure of
the thesis is listed with what draws it."""

import functools
import importlib.util
import json
import re
import types

import drillstring
import numpy as np
import pytest
from documents import ROOT
from mpmath import mp
from scipy.integrate import solve_ivp
from scipy.optimize import brentq

from nsjax import gallery, OrbitBranch
from nsjax._cli._diagrams import DIAGRAMS
from nsjax.plot import components


def loaded() -> types.ModuleType:
    spec = importlib.util.spec_from_file_location("scorecard", ROOT / "docs" / "scorecard.py")
    assert spec is not None and spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


CARD = loaded()
SECTIONS = dict(
    re.findall(r"^## (\w+)\n(.*?)(?=^## |\Z)", CARD.PAGE.read_text(encoding="utf-8"), re.DOTALL | re.MULTILINE)
)


def rows(section: str) -> list[list[str]]:
    lines = [line for line in SECTIONS[section].splitlines() if line.startswith("|")]
    return [[cell.strip() for cell in re.split(r"(?<!\\)\|", line)[1:-1]] for line in lines[2:]]


# Independent values, computed anew: in 40 digits, by closed forms, in 30 digits, and by scipy.


def exactly(name):
    from branch_reference import POINTS

    return POINTS[name].at


def slope():
    return brentq(lambda z: np.arctan(z) + z / (1 + z * z) - np.pi / 4, 0, 1, xtol=1e-15) / 10


def period_of_5_7():
    from orbit_reference import hopf_pitchfork_orbit

    return float(hopf_pitchfork_orbit().period)


def rolls(omega, r, b_1=drillstring.B_1):
    """The radial balance (A.31), while the rotor rolls along the wall."""
    d = drillstring
    spin, normal = -d.R * omega / r, d.K_B * (r - d.R_C)
    return (d.K - omega**2 * d.M_F / 4 + d.M_F * omega * spin + b_1 * r**2 - d.M_A * spin**2) * r + normal


def where_rolling_ends():
    """(A.31), (A.32) with friction at its bound, point d."""
    d = drillstring

    def balance(omega, r):
        spin, normal = -d.R * omega / r, d.K_B * (r - d.R_C)
        return [rolls(omega, r), (d.C + d.D) * spin * r - d.D * omega / 2 * r + d.MU * normal]

    with mp.workdps(30):
        return float(mp.findroot(balance, (0.4, 1.01))[0])


def hopf_of_e2():
    """Where the pair of torsion, of the Jacobian in 30 digits, reaches the imaginary axis."""
    d, step = drillstring, mp.mpf(10) ** -10

    def leading(omega):
        r = mp.sqrt((omega**2 / 4 * (1 - 2 * d.BETA + 2 * d.BETA**2) - d.K) / mp.mpf("0.1"))
        y = [r, mp.mpf(0), d.BETA * omega / 2, mp.mpf(0), mp.mpf(0)]
        jacobian = mp.matrix(5, 5)
        for j in range(5):
            ends = [[x + s * step * (i == j) for i, x in enumerate(y)] for s in (1, -1)]
            rows = [d.drillstring(*end, omega, (-1, 1, 1)) for end in ends]
            for i in range(5):
                jacobian[i, j] = (rows[0][i] - rows[1][i]) / (2 * step)
        return max((x for x in mp.eig(jacobian, right=False) if abs(x.imag) > 0.5), key=lambda x: x.real).real

    with mp.workdps(30):
        return float(mp.findroot(leading, (2.54, 2.5405), solver="secant"))


def farthest():
    """Of section 6.7, c = 0.1 N s/m, v_dr = 0.5 m/s: how far the mass goes after the belt has let it go."""
    with mp.workdps(30):
        d, v = mp.mpf("0.05"), mp.mpf("0.5")
        w, a = mp.sqrt(1 - d**2), 1 - 2 * d * v  # it is let go where x + c v = F_stick = 2
        b = (v + d * a) / w

        def x(t):
            return 1 + mp.exp(-d * t) * (a * mp.cos(w * t) + b * mp.sin(w * t))

        return float(x(mp.findroot(lambda t: mp.diff(x, t), 0.5)))


def where_slip_backwards_appears():
    """Of A.8: after slip forwards from where stick ends, the twist is all that friction can hold."""
    d = drillstring

    def excess(omega):
        def twist(t, y):
            return y[1], -y[0] - d.T_0 / (1 + d.DELTA * (y[1] + omega))

        def stands(t, y):
            return y[1] + omega

        stands.terminal, stands.direction = True, -1
        start = [-d.T_0 * (1 - 1e-15), -omega * (1 - 1e-15)]
        arc = solve_ivp(twist, (0, 30), start, "DOP853", events=stands, rtol=1e-13, atol=1e-15)
        return arc.y[0, -1] - d.T_0

    return brentq(excess, 0.7, 0.8, xtol=1e-13)


def where_stick_vanishes():
    """Of A.8: slip backwards, after slip forwards from where stick ends, ends at just that twist."""
    d = drillstring

    def left(omega):
        def stands(t, y, side):
            return side * (y[1] + omega)

        def twist(t, y, side):
            return y[1], -y[0] - side * d.T_0 / (1 + d.DELTA * side * (y[1] + omega))

        stands.terminal, stands.direction = True, -1
        y = [-d.T_0, -omega]
        for side in (1, -1):
            how = dict(events=stands, args=(side,), first_step=1e-3, rtol=1e-13, atol=1e-15)
            y = solve_ivp(twist, (0, 30), y, "DOP853", **how).y[:, -1]
        return y[0] + d.T_0

    return brentq(left, 1.8, 1.9, xtol=1e-13)


# Of P1 to P6: scipy's shooting, from what is in the files.


@functools.cache
def kept(family):
    return OrbitBranch.load(CARD.BRANCHES / f"A.9-{family}.npz", gallery.thesis("A.9"))


def touching(family, kind, arcs):
    special = next(s for s in kept(family).special_points if s.kind == kind and s.discontinuous)
    return drillstring.touching(drillstring.flat(special.y), special.period, special.value, arcs)[2]


def where_the_bit_just_stops():
    branch = kept("P2-to-P4")
    i, special = next(
        (i, s) for i, s in zip(branch.indices, branch.special) if s.kind == "fold" and s.surfaces == ("bit",)
    )
    return drillstring.just_stopping(branch, i, special)[2]


def smooth(family, kind, value):
    found = (
        (branch, i)
        for branch in kept(family).branches
        for i, s in zip(branch.indices, branch.special)
        if s.kind == kind and not s.discontinuous and abs(s.value - value) < 1e-4
    )
    return drillstring.smooth_point(*next(found), kind)[2]


def where_a_whirl_grows():
    return brentq(lambda omega: drillstring.whirl_of_p1(omega) - 1, 2.2, 2.3, xtol=1e-12)


KNOWN = {
    "Fig. 6.12, ω_A": lambda: exactly("6.6 A"),
    "Fig. 6.12, ω_B": lambda: exactly("6.6 B"),
    "Fig. 6.12": lambda: exactly("6.6 fold"),
    "Fig. 6.15": lambda: exactly("6.7 fold"),
    "Fig. 6.18, A": lambda: exactly("6.8 A"),
    "Fig. 6.18, B": lambda: exactly("6.8 B"),
    "Fig. 6.18, C": lambda: exactly("6.8 C"),
    "Fig. 6.20, A": lambda: exactly("6.9 A"),
    "Fig. 6.20, B": lambda: exactly("6.9 B"),
    "Fig. 6.20, C": lambda: exactly("6.9 C"),
    "Fig. 6.20, I/V": lambda: exactly("6.9 fold I/V"),
    "Fig. 6.20, II/III": lambda: exactly("6.9 fold II/III"),
    "Fig. 6.20, III/IV": lambda: exactly("6.9 flip III/IV"),
    "Fig. 6.20, III": lambda: exactly("6.9 Neimark-Sacker III"),
    "Fig. A.6, c": lambda: np.sqrt(4 * 0.4**2 / (0.3**2 + 0.1**2)),  # (A.21)
    "Fig. A.6, f": lambda: np.sqrt(1.1 / (1 / 4 - 0.25 / 2 + 2 * 0.25**2 / 4)),  # (A.20) with r = R_c
    "Fig. A.6, d": where_rolling_ends,
    "Fig. A.7b": where_slip_backwards_appears,
    "Fig. A.7a": where_stick_vanishes,
    "Fig. A.8, E2": hopf_of_e2,
    "Fig. A.9, P1a/P1b": where_a_whirl_grows,
    "Fig. A.11, P2/P3": lambda: touching("P2-to-P4", "flip", drillstring.OF_P2),
    "Fig. A.11, P3/P4": where_the_bit_just_stops,
    "Fig. A.11, P4a/P4b": lambda: smooth("P2-to-P4", "Neimark-Sacker", 2.9942),
    "Fig. A.11, P4b/P4c": lambda: smooth("P2-to-P4", "flip", 3.1247),
    "Fig. A.11, P4c/P4d": lambda: smooth("P2-to-P4", "flip", 3.2324),
    "Fig. A.11, P4d/P4e": lambda: smooth("P2-to-P4", "fold", 3.4391),
    "Fig. A.12, f": lambda: KNOWN["Fig. A.6, f"](),
    "Fig. A.10, P6a/P6b": lambda: smooth("P5-and-P6", "fold", 2.5765),
    "Fig. A.12, P5/P6": lambda: touching("P5-and-P6", "fold-flip", [(drillstring.FREE, None)]),
}
SHOT = [row for row in CARD.POINTS if row.key in CARD.FAMILIES]  # by shooting with scipy: minutes
REST = [row for row in CARD.POINTS if row.key not in CARD.FAMILIES]


@pytest.mark.slow
@pytest.mark.parametrize("row", SHOT, ids=lambda row: row.where)
def test_values_that_scipy_finds_by_shooting(row):
    np.testing.assert_allclose(row.known, KNOWN[row.where](), rtol=row.within)


@pytest.mark.parametrize("row", SHOT, ids=lambda row: row.where)
def test_branches_that_are_kept(row):
    """Those of the notebook have the points of the table, with their names."""
    value, name = CARD.found(row)
    np.testing.assert_allclose(value, row.known, rtol=row.within)
    assert name == row.name


@pytest.mark.parametrize("row", REST, ids=lambda row: row.where)
def test_values_that_are_known_otherwise(row):
    """What stands in the table as such is what the references give."""
    if row.where not in KNOWN:  # of chapter 5, where all of them are zero
        assert row.known == 0.0 and row.where.startswith("(5.")
        return
    np.testing.assert_allclose(row.known, KNOWN[row.where](), rtol=1e-11)


def test_numbers_that_are_known_otherwise():
    known = {row.what: row.known for row in CARD.NUMBERS}
    np.testing.assert_allclose(known["period of the orbit [s]"], period_of_5_7(), rtol=1e-13)
    np.testing.assert_allclose(known["μ of the pitchfork, smoothed with ε = 10"], slope(), rtol=1e-13)
    np.testing.assert_allclose(known["μ of the Hopf point, smoothed with ε = 10"], -slope(), rtol=1e-13)
    with mp.workdps(30):
        without = mp.findroot(lambda r: rolls(2, r, 0), 1.57)
        with_fluid = mp.findroot(lambda r: rolls(3, r), 2.08)
    np.testing.assert_allclose(known["r while it rolls, ω = 2 rad/s, B₁ = 0 [m]"], float(without), rtol=1e-13)
    np.testing.assert_allclose(known["r on e4 at ω = 3 rad/s [m]"], float(with_fluid), rtol=1e-13)
    np.testing.assert_allclose(known["fixed point 3 of the map, v_dr = 0.5 m/s [m]"], farthest(), rtol=1e-13)


# Quick ones: no search for an orbit.
QUICK = [i for i, row in enumerate(CARD.NUMBERS) if not row.where.startswith(("section", "Fig. 6.16a"))]
SEARCHED = [i for i in range(len(CARD.NUMBERS)) if i not in QUICK]


def test_no_cell_is_empty():
    for section in ("Numbers", "Bifurcations", "Figures", "Systems"):
        assert rows(section)
        assert all(all(row) for row in rows(section))
    assert [row[:3] for row in rows("Numbers")] == [[row.where, row.what, row.thesis] for row in CARD.NUMBERS]
    assert [row[:3] for row in rows("Bifurcations")] == [[row.where, row.thesis, row.name] for row in CARD.POINTS]
    assert [row[-1] for row in rows("Bifurcations")] == [row.remark for row in CARD.POINTS]


def test_every_system_of_the_thesis_is_listed():
    listed = {row[0]: row[1:] for row in rows("Systems")}
    assert list(listed) == list(gallery.THESIS)
    for key, entry in gallery.THESIS.items():
        assert listed[key] == [entry.title, f"`{type(entry.system()).__name__}`"]


@pytest.mark.parametrize("i", range(len(CARD.NUMBERS)))
def test_a_remark_says_whether_the_thesis_agrees(i):
    """To half a unit of the digits that it prints, by the independent value; where it does not, a remark says why."""
    row = CARD.NUMBERS[i]
    if np.isnan(row.value):
        assert row.remark == CARD.DRAWN
        return
    agrees = abs(row.known - row.value) <= row.digits + 1e-12
    assert agrees == (row.remark == CARD.AGREES)
    assert agrees or row.remark.startswith("differs: ")


def check_number(i: int) -> None:
    row, cells = CARD.NUMBERS[i], rows("Numbers")[i]
    found = row.found()
    np.testing.assert_allclose(found, row.known, rtol=1e-9, atol=1e-10)
    np.testing.assert_allclose(float(cells[3]), found, rtol=1e-9, atol=1e-10)
    np.testing.assert_allclose(float(cells[4].partition(" ")[0]), row.known, rtol=1e-9, atol=1e-10)


@pytest.mark.parametrize("i", QUICK)
def test_numbers(i):
    check_number(i)


@pytest.mark.slow
@pytest.mark.parametrize("i", SEARCHED)
def test_numbers_that_are_searched_for(i):
    check_number(i)


def test_values_of_bifurcations_are_those_known_independently():
    for row, cells in zip(CARD.POINTS, rows("Bifurcations"), strict=True):
        np.testing.assert_allclose(float(cells[3]), row.known, rtol=row.within, atol=1e-9)
        assert cells[4] == CARD.written(row.known, row.within)


# Figures.

CAPTIONS = {"2": 9, "3": 8, "4": 3, "5": 16, "6": 23, "A": 12}  # how many each chapter has; the first has none


def test_every_figure_of_the_thesis_is_listed():
    numbers = [f"{chapter}.{i}" for chapter, count in CAPTIONS.items() for i in range(1, count + 1)]
    assert [figure.number for figure in CARD.FIGURES] == numbers
    assert rows("Figures") == [[figure.number, figure.caption, figure.where] for figure in CARD.FIGURES]
    for figure in CARD.FIGURES:  # what shows a result is drawn
        assert figure.drawn or figure.schematic in (CARD.DEFINITION, CARD.SKETCH, CARD.MEASURED, "sketches of maps")


@pytest.mark.parametrize("figure", CARD.FIGURES, ids=lambda figure: figure.number)
def test_what_draws_a_figure_exists(figure):
    for place in figure.drawn:
        if isinstance(place, CARD.Command) and place.verb == "run":
            entry = gallery.THESIS[place.key]
            several = len(components(entry.y0)) > 1
            written = {"time-series"} | ({"phase-portrait"} if several else set())
            written |= {"fundamental-matrix", "multipliers"} if entry.orbit else set()
            assert place.picture in written
        elif isinstance(place, CARD.Command):
            diagram = DIAGRAMS[place.key]
            written = {picture.kind for picture in diagram.pictures}
            if not all(family.equilibria for family in diagram.families):
                written |= {CARD.MULTIPLIERS, CARD.CIRCLES}
            assert place.picture in written
        elif isinstance(place, CARD.Notebook):
            notebook = json.loads((ROOT / "notebooks" / f"{place.stem}.ipynb").read_text(encoding="utf-8"))
            assert any(
                place.words in "".join(cell["source"])
                and any("image/png" in output.get("data", {}) for output in cell["outputs"])
                for cell in notebook["cells"]
                if cell["cell_type"] == "code"
            )
        else:
            assert (ROOT / "docs" / "pictures" / place.file).stat().st_size > 1000
            assert place.words in (ROOT / "docs" / place.script).read_text(encoding="utf-8")


@pytest.mark.slow
@pytest.mark.parametrize("key", [*CARD.EQUILIBRIA, *CARD.ORBITS])
def test_bifurcations_are_found_and_named(key):
    points = [row for row in CARD.POINTS if row.key == key]
    assert points
    for row in points:
        value, name = CARD.nearest(row)
        np.testing.assert_allclose(value, row.known, atol=1e-9)
        assert name == row.name
    # And there are no others: values that are found, each once.
    found = sorted({round(value, 7) + 0.0 for value, _ in CARD.special_points(key)})
    assert found == sorted(round(row.known, 7) + 0.0 for row in points)
