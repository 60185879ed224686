"""Pictures and numbers of all branches of the drillstring (Figs. A.8 to A.12), from the files that the notebook has.
(What is in them is tested in tests/gallery/test_drillstring_branches.py.)"""

import json
import pathlib

import numpy as np
import pytest
from command_line import run

import nsjax
from nsjax import __main__ as command, _cli, gallery
from nsjax._cli import _branches, _follow


FOLDER = pathlib.Path(__file__).parents[2] / "notebooks" / "drillstring"


@pytest.fixture(scope="module")
def job():
    return _cli.load("A.9", {}, None)


@pytest.fixture(scope="module")
def found(job):
    systems = {"P1": gallery.FreeDrillstringScene(), "E1": gallery.DrillstringScene()}
    families = []
    for family in _cli.diagram_for(job, None, None).families:
        kind = nsjax.Branch if family.equilibria else nsjax.OrbitBranch
        path = FOLDER / f"A.9-{'-'.join(family.name.split())}.npz"
        families.append(_cli.Followed(family, kind.load(path, systems.get(family.name, job.system))))
    return families


def test_branches_have_the_names_of_the_thesis(found):
    named = {
        one.family.name: {text for branch in one.branch.branches for text, _ in one.arcs(branch)} - {""}
        for one in found
    }
    assert named == {
        "P2 to P4": {"P2", "P3", "P4a", "P4b", "P4c", "P4d", "P4e"},
        "P5 and P6": {"P5", "P6a", "P6b"},
        "P1": {"P1a", "P1b"},
        "E2 to E4": {"E2a", "E2b", "E3", "E4"},
        "E1": {"E1"},
    }
    # Stable ones: the bit comes to rest on P2 and P3, never on P4.
    (orbits,) = (one for one in found if one.family.name == "P2 to P4")
    for text, rows in orbits.arcs(orbits.branch):
        itineraries = {orbits.branch.itineraries[i] for i in rows[1:-1]}
        rests = {"bit +0" in way or "bit -1" in way for way in itineraries}
        if text.startswith("P4"):
            assert rests == {False} and orbits.branch.stable[rows[1:-1]].all() == (text in ("P4b", "P4d"))
        elif text:
            assert (text == "P2") == ("wall +1" not in next(iter(itineraries)))


def test_special_points_have_their_letters(found, job):
    diagram = _cli.diagram_for(job, None, None)
    numbers = json.loads(json.dumps(_cli.record(job, {}, **_cli.branch_record(found))))
    assert {branch["family"] for branch in numbers["branches"]} == {one.family.name for one in found}
    assert sum(len(branch["points"]) for branch in numbers["branches"]) == sum(
        len(branch) for one in found for branch in one.branch.branches
    )
    letters = {}
    for special in numbers["special"]:
        letters.setdefault(special["letter"], []).append(special["value"])
    letters.pop("")
    assert set(letters) == {"P1 | P2", "P2 | P3", "P3 | P4", "P5 | P6", "E2 | P6", "c", "d", "f"}
    for letter, values in letters.items():  # a point that several families come to is one
        np.testing.assert_allclose(values, values[0], atol=1e-8, err_msg=letter)
    assert [len(letters[x]) for x in ("P1 | P2", "E2 | P6", "c", "f", "P2 | P3")] == [2, 2, 2, 3, 1]
    kinds = {special["letter"]: (special["kind"], special["discontinuous"]) for special in numbers["special"]}
    assert kinds["P2 | P3"] == ("flip", True) and kinds["P3 | P4"] == ("fold", True)
    assert kinds["P5 | P6"] == ("fold-flip", True)
    # In a picture each is written once.
    (picture,) = (picture for picture in diagram.pictures if picture.kind.endswith("enlarged"))
    (ax,) = _branches._diagram(found, diagram, {}, picture).axes
    words = [text.get_text() for text in ax.texts]
    assert len(words) == len(set(words)) and {"f", "P2", "P6a", "E2b", "P1b"} <= set(words)
    assert {line.get_label() for line in ax.lines} >= {"stable equilibrium", "unstable periodic orbit"}


def test_pictures_of_one_family(found, job, tmp_path):
    """With the paths of its multipliers at corners."""
    (one,) = (one for one in found if one.family.name == "P5 and P6")
    files = _cli.draw_branches(job, [one], _cli.diagram_for(job, None, None), tmp_path)
    names = {path.name.removeprefix("A.9-").removesuffix(".png") for path in files}
    assert names >= {"bifurcation-diagram", "multiplier-diagram-P5-and-P6", "multiplier-circles"}
    assert all(path.stat().st_size > 10_000 for path in files)


@pytest.mark.slow
def test_a_picture_for_each_figure(found, job, tmp_path):
    files = _cli.draw_branches(job, found, _cli.diagram_for(job, None, None), tmp_path)
    names = {path.name.removeprefix("A.9-").removesuffix(".png") for path in files}
    orbits = {f"multiplier-diagram-{name}" for name in ("P1", "P2-to-P4", "P5-and-P6")}
    enlarged = {f"bifurcation-diagram{end}" for end in ("", "-enlarged", "-enlarged-2", "-enlarged-3")}
    assert names == orbits | enlarged | {"equilibria", "multiplier-circles"}
    assert all(path.stat().st_size > 10_000 for path in files)


def test_what_is_followed_and_what_is_left_out(found, monkeypatch, tmp_path):
    """Over a part of the interval, families that begin elsewhere are left out, which is said; what is followed is kept."""
    asked = []

    class Orbit:
        result = nsjax.RESULTS.successful

    def orbits(system, orbit, parameter, interval, **how):
        asked.append((type(system).__name__, float(system.omega), interval, how["max_laps"], how.get("max_branches")))
        return found[1].branch

    def equilibria(system, start, parameter, interval, **how):
        raise AssertionError("neither E1 nor E2 begin there")

    monkeypatch.setattr(_follow, "continue_orbit", orbits)
    monkeypatch.setattr(_follow, "continue_equilibrium", equilibria)
    monkeypatch.setattr(_follow, "find", lambda *args: (Orbit, None))
    monkeypatch.setattr(_follow, "try_guess", lambda *args: (Orbit, None))
    monkeypatch.setattr(command, "draw_branches", lambda *args: [])  # for which there are other tests
    status, out, err = run(
        *"continue A.9 --range 2.5,2.55 --set omega=2.52".split(),
        "--out",
        tmp_path / "out",
        "--save",
        tmp_path / "kept",
    )
    assert status == 0, err
    assert asked == [
        ("DrillstringModel", 2.52, (2.5, 2.55), 2, 1),
        ("DrillstringModel", 2.5425, (2.5, 2.55), 2, 2),
    ]
    for name, omega in (("P1", "2"), ("E2 to E4", "2.6"), ("E1", "1")):
        assert f"no {name}: its start is at omega = {omega}, which is not in the range" in err
    assert "P2 to P4: " in out and "P5 and P6: " in out
    assert sorted(path.name for path in (tmp_path / "kept").iterdir()) == ["A.9-P2-to-P4.npz", "A.9-P5-and-P6.npz"]
