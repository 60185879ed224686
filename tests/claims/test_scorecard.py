"""The scorecard of the thesis, docs/scorecard.md: no cell is empty, and each is what its script finds."""

import importlib.util
import re
import types

import numpy as np
import pytest
from documents import ROOT

from nsjax import gallery


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


# Quick: no search for an orbit, and no branch.
QUICK = [i for i, row in enumerate(CARD.NUMBERS) if not row.where.startswith("section")]
SEARCHED = [i for i in range(len(CARD.NUMBERS)) if i not in QUICK]


def test_no_cell_is_empty():
    for section in ("Numbers", "Bifurcations", "Systems"):
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
    agrees = abs(row.known() - row.value) <= row.digits + 1e-12
    assert agrees == (row.remark == CARD.AGREES)
    assert agrees or row.remark.startswith("differs: ")


def check_number(i: int) -> None:
    row, cells = CARD.NUMBERS[i], rows("Numbers")[i]
    found = row.found()
    np.testing.assert_allclose(found, row.known(), rtol=1e-9, atol=1e-10)
    np.testing.assert_allclose(float(cells[3]), found, rtol=1e-9, atol=1e-10)
    np.testing.assert_allclose(float(cells[4].partition(" ")[0]), row.known(), rtol=1e-9, atol=1e-10)


@pytest.mark.parametrize("i", QUICK)
def test_numbers(i):
    check_number(i)


@pytest.mark.slow
@pytest.mark.parametrize("i", SEARCHED)
def test_numbers_that_are_searched_for(i):
    check_number(i)


def test_values_of_bifurcations_are_those_known_independently():
    for row, cells in zip(CARD.POINTS, rows("Bifurcations"), strict=True):
        np.testing.assert_allclose([float(cells[3]), float(cells[4])], row.known(), rtol=1e-9, atol=1e-9)


@pytest.mark.slow
@pytest.mark.parametrize("key", [*CARD.EQUILIBRIA, *CARD.ORBITS])
def test_bifurcations_are_found_and_named(key):
    points = [row for row in CARD.POINTS if row.key == key]
    assert points
    for row in points:
        value, name = CARD.nearest(row)
        np.testing.assert_allclose(value, row.known(), atol=1e-9)
        assert name == row.name
    # And there are no others: values that are found, each once.
    found = sorted({round(value, 7) + 0.0 for value, _ in CARD.special_points(key)})
    assert found == sorted(round(row.known(), 7) + 0.0 for row in points)
