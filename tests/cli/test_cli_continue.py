"""Continuation on the command line: the branch, its pictures, its numbers."""

import json
import re

import numpy as np
import pytest
from command_line import run

import nsjax
from nsjax import __main__ as command, _cli
from nsjax._cli import _branches, _follow, _search
from nsjax._cli._report import _symbol


FOLD = 1.0980926241158726  # at which v_dr; `branch_reference.POINTS["6.7 fold"]`


@pytest.fixture(scope="module")
def continued(tmp_path_factory):
    """The fold of section 6.7: standard output, numbers, the folder, and the branch itself."""
    folder = tmp_path_factory.mktemp("continue")
    kept = []

    def keeping(*args, **kwargs):
        kept.append(original(*args, **kwargs))
        return kept[-1]

    original = _follow.continue_orbit
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(_follow, "continue_orbit", keeping)
        status, out, err = run(
            *"continue 6.7 --param v_dr --range 0.9,1.2 --set v_dr=1 --period 6.6 --y0 2.3,0".split(),
            "--out", folder / "pictures", "--json", folder / "numbers.json",
        )  # fmt: skip
    assert status == 0, err
    assert "special points" in err  # how far it was, all the while
    return folder, out, json.loads((folder / "numbers.json").read_text(), parse_constant=pytest.fail), kept[0]


def test_it_prints_the_branch(continued):
    _, out, _, branch = continued
    assert str(branch) in out
    for words in (
        r"F_stick +2\.0 +\[N\]",
        r"infinitely unstable fold bifurcation at v_dr = 1\.098092",
        "surfaces +belt",
    ):
        assert re.search(words, out), words


def test_it_draws_the_pictures(continued):
    folder, out, _, _ = continued
    files = list((folder / "pictures").iterdir())
    # No picture of the way to an infinite multiplier.
    assert {path.name for path in files} == {"6.7-bifurcation-diagram.png", "6.7-multiplier-diagram.png"}
    assert all(str(path) in out and path.stat().st_size > 10_000 for path in files)


def test_the_numbers_are_the_branch(continued):
    _, _, numbers, branch = continued
    assert (numbers["system"], numbers["parameter"]) == ("6.7", "v_dr")
    assert numbers["nsjax"] == nsjax.__version__ and numbers["tolerances"]["rtol"] == 1e-12
    assert numbers["units"]["parameters"]["v_dr"] == numbers["units"]["state"]["v"] == "m/s"
    assert len(numbers["branches"]) == len(branch.branches)
    for written, one in zip(numbers["branches"], branch.branches):
        points = written["points"]
        np.testing.assert_array_equal([p["parameter"] for p in points], one.values)
        np.testing.assert_array_equal([p["period"] for p in points], one.periods)
        np.testing.assert_array_equal([p["y0"]["v"] for p in points], one.ys.v)
        np.testing.assert_array_equal([p["stable"] for p in points], one.stable)
        assert [p["itinerary"] for p in points] == list(one.itineraries)
        amplitudes = np.maximum(np.abs(one.low.x), np.abs(one.high.x))
        np.testing.assert_array_equal([p["measure"] for p in points], amplitudes)
        for point, multipliers in zip(points, one.multipliers):
            assert len(point["multipliers"]) == 2
            for pair, exact in zip(point["multipliers"], multipliers):
                assert pair is None if np.isinf(exact) else complex(*pair) == exact
        assert any(None in p["multipliers"] for p in points) and any(p["stable"] for p in points)


def test_special_points_are_told_once(continued):
    _, _, numbers, branch = continued
    (special,) = numbers["special"]
    assert special["kind"] == "infinitely unstable fold" and special["discontinuous"] is True
    assert special["value"] == pytest.approx(FOLD, abs=1e-7) and special["parameter"] == "v_dr"
    assert special["name"] == branch.special[0].name and special["evidence"] == branch.special[0].evidence
    np.testing.assert_allclose(special["multipliers"][0], [[1, 0], [0, 0]], atol=1e-9)
    assert None in special["multipliers"][1]
    assert special["count"] == [[1, 1], []] and special["crossings"] == []
    assert special["transition"] == branch.special[0].transition and special["surfaces"] == ["belt"]
    # Which branches meet there.
    halves = special["halves"]
    assert [(h["side"], h["laps"]) for h in halves] == [(-1, 1), (-1, 1)]
    assert sorted(h["stable"] for h in halves) == [False, True]
    for written, half in zip(halves, branch.special[0].halves):
        assert written["itinerary"] == half.itinerary and written["stable"] == half.stable
        pairs = zip(written["multipliers"], half.multipliers)
        assert all(pair is None if np.isinf(exact) else complex(*pair) == exact for pair, exact in pairs)
    assert numbers["branches"][0]["special"] == [{"point": branch.indices[0], "special": 0}]


def test_the_diagram_shows_the_equilibrium(continued, tmp_path):
    *_, branch = continued
    job = _cli.load("6.7", {}, None)
    diagram = _cli.diagram_for(job, None, None)
    files = _cli.draw_branches(job, [_cli.Followed(diagram.families[0], branch)], diagram, tmp_path)
    assert [path.name for path in files] == ["6.7-bifurcation-diagram.png", "6.7-multiplier-diagram.png"]


@pytest.mark.slow
def test_the_drillstring_is_shown_by_its_lowest_speed(tmp_path):
    """Fig. A.7b: of branch p1 the least θ', and e1, unstable, on which θ' = ω."""
    job = _cli.load("A.8", {}, None)
    orbit = nsjax.find_orbit(job.system, job.guess.y0, period=job.guess.period)
    branch = nsjax.continue_orbit(job.system, orbit, "omega", (1.95, 2.05))
    diagram = _cli.diagram_for(job, None, (1.95, 2.05))
    found = [_cli.Followed(diagram.families[0], branch)]
    (ax,) = _branches._diagram(found, diagram, {}).axes
    assert ax.get_ylabel() == "min θ' [rad/s]"
    e1, p1 = (np.array(line.get_xydata()) for line in ax.lines[:2])
    np.testing.assert_array_equal(e1[:, 0], e1[:, 1])
    assert ax.lines[0].get_label() == "unstable equilibrium" and np.all(p1[:, 1] < 0)  # it slips backwards
    assert _cli.draw_branches(job, found, diagram, tmp_path)


def test_run_with_branches_continues_its_orbit(continued, monkeypatch, tmp_path):
    """Its own orbit, over the interval of the thesis; the numbers stand beside those of the orbit."""
    *_, branch = continued
    asked = []

    class Found:
        result = command.RESULTS.successful

    def follow(system, orbit, parameter, interval, **kwargs):
        asked.append((orbit, parameter, interval))
        return branch

    monkeypatch.setattr(_follow, "continue_orbit", follow)
    monkeypatch.setattr(_search, "find_orbit", lambda *args, **kwargs: Found)
    monkeypatch.setattr(command, "draw", lambda *args: [])
    monkeypatch.setattr(command, "report", lambda *args: "report")
    monkeypatch.setattr(command, "orbit_record", lambda orbit: {})
    status, out, err = run("run", "6.7", "--branches", "--t1", "1", "--out", tmp_path, "--json", tmp_path / "n.json")
    assert status == 0, err
    assert asked == [(Found, "v_dr", (0.1, 1.2))] and str(branch) in out
    numbers = json.loads((tmp_path / "n.json").read_text())
    assert len(numbers["continuation"]["branches"][0]["points"]) == len(branch)


@pytest.mark.parametrize(
    "argv, words",
    [
        ("continue 3.4", "no default for 3.4; give --param"),
        ("continue 3.4 --param v_dr", "--range lo,hi"),
        ("continue 6.7 --param c", "--range lo,hi"),
        ("continue 6.7 --range 1", "two numbers"),
        ("continue 6.7 --range 1,0.5", "the lower one first"),
        ("continue 6.7 --range 0,much", "An end of --range must be a number"),
        ("continue 6.7 --range -2,-1", r"v_dr = 0\.2 lies outside \[-2, -1\].*--set v_dr"),
        ("continue 6.7 --param q --range 0,1", "--param must be one of"),
        ("continue 6.7 --max-laps 0", "--max-laps: invalid positive integer"),
        ("run 3.4 --branches", r"--branches is for 6\.6, 6\.7, 6\.8, 6\.9"),
    ],
)
def test_mistakes(argv, words):
    status, out, err = run(*argv.split())
    assert (status, out) == (2, "")
    assert err.startswith("nsjax") and err.count("\n") == 1 and re.search(words, err), err


@pytest.mark.parametrize(
    "order, stable, ends, number",
    [
        (2, True, {"A", "fold"}, "I"),
        (2, False, {"A", "fold"}, "II"),
        (2, True, {"flip", "Neimark-Sacker"}, "III"),
        (2, False, {"flip", "B"}, "IV"),
        (2, False, {"B", "fold"}, "V"),
        (4, True, {"C", "flip"}, "VI"),
        (4, False, {"B", "C"}, "VII"),
        (8, False, {"B", "C"}, "VIII"),
        (2, False, {"fold", "Neimark-Sacker"}, ""),
    ],
)
def test_branches_of_section_69_have_the_numbers_of_the_thesis(order, stable, ends, number):
    assert _cli.DIAGRAMS["6.9"].families[0].arcs(_cli.Arc(order, stable, frozenset(ends))) == number


@pytest.mark.parametrize(
    "name, symbol",
    [
        ("omega", "$\\omega$"),
        ("alpha_0", "$\\alpha_{\\mathrm{0}}$"),
        ("v_dr", "$v_{\\mathrm{dr}}$"),
        ("Speed", "Speed"),
    ],
)
def test_symbols(name, symbol):
    assert _symbol(name) == symbol
