"""Units in the comments of classes that are in no file, as in a notebook."""

import itertools
import linecache

import pytest

from nsjax._numerics._units import Note, notes


STATE = """
from typing import NamedTuple

class Level(NamedTuple):
    height: float  # height [{}]
    pressure: float  # pressure [Pa]
"""
MODEL = """
import dataclasses

@dataclasses.dataclass
class Tank:
    area: float = 1.0  # area [{}]

    def volume(self, height):
        return self.area * height
"""


@pytest.fixture
def cell(monkeypatch):
    """Runs a text as IPython does: it stands in `linecache` under a file name that does not exist."""
    monkeypatch.setattr(linecache, "cache", dict(linecache.cache))
    number = itertools.count()

    def typed(text, again=None):
        name = again or f"/nowhere/ipykernel/{next(number)}.py"
        linecache.cache[name] = (len(text), None, text.splitlines(keepends=True), name)
        names = {"__name__": "__main__"}
        exec(compile(text, name, "exec"), names)
        return names

    return typed


def test_class_without_functions(cell):
    """The comment of its last field, at the end of the cell, belongs to it too."""
    level = cell(STATE.format("m"))["Level"]
    cell("height = 2.0\n")
    assert notes(level) == {"height": Note("height", "m"), "pressure": Note("pressure", "Pa")}


def test_of_two_cells_the_newer_counts_for_a_class_without_functions(cell):
    cell(STATE.format("m"))
    newer = cell(STATE.format("mm"))["Level"]
    assert notes(newer)["height"].unit == "mm"


def test_other_fields_are_another_class(cell):
    """The first cell is run again: its text is not the newest, but the other one has a field less."""
    text = STATE.format("m")
    cell(text, again="/nowhere/first")
    cell("from typing import NamedTuple\nclass Level(NamedTuple):\n    height: float  # height [ft]\n")
    assert notes(cell(text, again="/nowhere/first")["Level"])["height"].unit == "m"


def test_functions_say_which_cell(cell):
    older, newer = (cell(MODEL.format(unit))["Tank"] for unit in ("m^2", "cm^2"))
    assert (notes(older)["area"].unit, notes(newer)["area"].unit) == ("m^2", "cm^2")


def test_functions_say_which_of_two_in_one_cell(cell):
    """And what does not parse, what is not loaded yet, and what is in a file are passed over."""
    linecache.cache["/nowhere/bad"] = (9, None, ["class Tank:\n", "  x = \n"], "/nowhere/bad")
    linecache.cache["/nowhere/lazy"] = (lambda: "",)
    linecache.cache["/nowhere/file"] = (9, 1.0, MODEL.format("acre").splitlines(keepends=True), "/nowhere/file")
    names = cell(MODEL.format("m^2") + "first = Tank\n" + MODEL.format("cm^2"))
    assert (notes(names["first"])["area"].unit, notes(names["Tank"])["area"].unit) == ("m^2", "cm^2")


def test_a_base_in_another_cell(cell):
    """And what has no source anywhere has no units."""
    base = cell(MODEL.format("m^2"))["Tank"]
    assert notes(type("Barrel", (base,), {"__module__": "__main__"})) == {"area": Note("area", "m^2")}
    assert notes(type("Barrel", (), {"__module__": "__main__", "__annotations__": {"area": float}})) == {}
