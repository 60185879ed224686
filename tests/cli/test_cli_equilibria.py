"""Continuation of equilibria on the command line: of a user's own model, and of the whirling rotor of section A.7."""

import json
import re
import textwrap

import numpy as np
import pytest
from command_line import run

import nsjax
from nsjax import _cli, gallery
from nsjax._cli import _drillstring


# x' = μ - |x|, (5.8): 0 equilibria below and 2 above μ = 0, at ±μ.
TENT = """
    from typing import NamedTuple

    import nsjax


    class State(NamedTuple):
        x: float  # [m]


    class Tent(nsjax.System):
        mu: float = 1.0  # [m/s]

        def vector_field(self, t, y, s):
            return State(self.mu - y.x * s.kink)

        @nsjax.sgn
        def kink(self, t, y):
            return y.x
"""


@pytest.fixture
def tent(tmp_path):
    path = tmp_path / "tent.py"
    path.write_text(textwrap.dedent(TENT))
    return path


def test_equilibria_of_a_model_of_ones_own(tent, tmp_path):
    file, kept = tmp_path / "numbers.json", tmp_path / "kept"
    status, out, err = run(
        *f"continue {tent} --equilibria --param mu --range -0.5,2 --y0 x=0.9".split(),
        *("--out", tmp_path / "pictures", "--json", file, "--save", kept),
    )
    assert status == 0, err
    assert "discontinuous saddle-node bifurcation at mu = 0" in out and "special points" in err
    assert [path.name for path in (tmp_path / "pictures").iterdir()] == ["Tent-bifurcation-diagram.png"]
    numbers = json.loads(file.read_text(), parse_constant=pytest.fail)
    (branch,) = numbers["branches"]
    assert numbers["parameter"] == "mu" and branch["of"] == "equilibria"
    mu, x = np.array([(p["parameter"], p["y"]["x"]) for p in branch["points"]]).T
    np.testing.assert_allclose(np.abs(x), mu, atol=1e-12)
    np.testing.assert_array_equal([p["measure"] for p in branch["points"]], x)
    for point in branch["points"]:
        side = point["mode"]["kink"]
        assert point["eigenvalues"] == [[-side, 0]] and point["stable"] == (side > 0)
    assert abs(mu.max() - 2) < 1e-14 and {p["stable"] for p in branch["points"]} == {True, False}
    (special,) = numbers["special"]
    assert (special["kind"], special["discontinuous"], special["letter"]) == ("saddle-node", True, "")
    assert special["surfaces"] == ["kink"] and sorted(special["count"]) == [0, 2]
    np.testing.assert_allclose(
        [special["value"], special["y"]["x"], special["crossings"][0]["q"]], [0, 0, 0.5], atol=1e-12
    )
    assert sorted(half["stable"] for half in special["halves"]) == [False, True]
    assert [half["eigenvalues"] for half in special["halves"]] == [[[-h["mode"]["kink"], 0]] for h in special["halves"]]
    at = branch["special"][0]["point"]
    assert branch["special"] == [{"point": at, "special": 0}] and abs(mu[at]) < 1e-12
    loaded = nsjax.Branch.load(kept / "Tent-branches.npz", _cli.load(str(tent), {}, None).system)
    np.testing.assert_array_equal(loaded.values, mu)


@pytest.mark.parametrize(
    "more, status, words",
    [
        ("", 2, "no default for .*; give --param"),
        ("--param mu --range -2,-1 --y0 x=1", 2, "mu = 1 lies outside .* where there is an equilibrium: --set mu"),
        ("--param mu --range -2,2", 2, "There is no default state; give one: --y0 x="),
        ("--param mu --range -2,2 --set mu=-1 --y0 x=1", 1, "no equilibrium"),
    ],
)
def test_what_is_missing_is_said(tent, more, status, words, tmp_path):
    found, out, err = run("continue", tent, "--equilibria", *more.split(), *["--out", tmp_path / "out"])
    assert (found, out) == (status, "")
    assert re.search(words, err), err


def test_what_the_thesis_shows_can_be_asked_for_in_part():
    """Of A.9 the equilibria alone; of a system of which it shows orbits, equilibria over the same parameter."""
    both, none = (_cli.diagram_for(_cli.load(key, {}, None), None, None, True) for key in ("A.9", "A.8"))
    assert [family.name for family in both.families] == ["E2 to E4", "E1"]
    assert [picture.kind for picture in both.pictures] == ["equilibria"]
    assert [family.equilibria for family in none.families] == [True] and none.parameter == "omega"


def test_what_lies_beyond_the_middle_is_left_out():
    """A branch that goes on to r < 0, upwards or downwards, ends at r = 0 with the point that is there."""
    system, r = gallery.thesis("A.7"), np.array([-0.2, -1e-7, 0.3, 0.5])
    special = type("Special", (), {"kind": "saddle-node"})()
    for way, index in ((1, 1), (-1, 2)):
        branch = nsjax.Branch(
            system, "omega", np.arange(4.0), gallery.Whirl(r[::way], r[::way], r[::way]), np.ones((4, 2), int),
            np.ones((4, 2)), np.zeros((4, 3), complex), np.zeros(4, int), r[::way] > 0.4, (special,), (index,),
            ("below", "above"),
        )  # fmt: skip
        cut = _drillstring._beyond_the_middle(branch)
        np.testing.assert_array_equal(cut.ys.r, r[1:][::way])
        np.testing.assert_array_equal(cut.stable, cut.ys.r > 0.4)
        assert cut.special == (special,) and abs(cut.ys.r[cut.indices[0]]) < 1e-6
        assert cut.ends[::way] == ("the middle of the stator", "above" if way > 0 else "below")


OMEGA_C, OMEGA_F = np.sqrt(6.4), np.sqrt(7.04)  # (A.21), and (A.20) with r = R_c, for the values of Appendix C.6


@pytest.mark.slow
def test_the_equilibria_of_the_whirl_model(tmp_path):
    """Fig. A.6."""
    file = tmp_path / "numbers.json"
    status, out, err = run("continue", "A.7", "--out", tmp_path, "--json", file)
    assert status == 0, err
    assert "e2 to e4: 1 branch of WhirlModel" in out and "e1: 1 branch of WhirlScene" in out
    numbers = json.loads(file.read_text(), parse_constant=pytest.fail)
    whirls, middle = numbers["branches"]
    assert [branch["family"] for branch in numbers["branches"]] == ["e2 to e4", "e1"]
    letters = {special["letter"]: special for special in numbers["special"]}
    assert sorted(special["letter"] for special in numbers["special"]) == ["c", "c", "d", "f"]
    np.testing.assert_allclose([letters["c"]["value"], letters["f"]["value"]], [OMEGA_C, OMEGA_F], rtol=1e-9)
    # The errata: d is where rolling ends, f where contact begins.
    assert letters["d"]["surfaces"] == ["roll"] and letters["f"]["surfaces"] == ["wall"]
    assert letters["d"]["value"] < 0.5
    for branch in numbers["branches"]:
        for point in branch["points"]:
            assert point["parameter"] >= 0.05 and point["measure"] > -1e-6
    for point in whirls["points"]:
        r, omega = point["y"]["r"], point["parameter"]
        if point["mode"]["wall"] < 0:  # e2, (A.20) with (A.17)
            np.testing.assert_allclose(r**2, (omega**2 * 0.15625 - 1) / 0.1, atol=1e-9)
            assert point["stable"] or r < 1e-6
        if point["mode"]["roll"] == 0:  # e4, (A.30)
            np.testing.assert_allclose(r * point["y"]["Omega"], -2 * omega, rtol=1e-12)
            assert point["stable"] or abs(omega - letters["d"]["value"]) < 1e-9
    assert all(point["stable"] == (point["parameter"] < OMEGA_C - 1e-9) for point in middle["points"])


@pytest.mark.parametrize(
    "ends, name",
    [("cf", "e2"), ("fd", "e3"), ("d", "e4")],
)
def test_the_names_of_whirls(ends, name):
    arc = _cli.Arc(1, True, frozenset(ends))
    assert _drillstring._whirl_arcs(arc) == name
