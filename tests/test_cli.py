"""The command line, in this process: tables, pictures, JSON, and one line for every mistake."""

import contextlib
import io
import json
import pathlib
import re

import diffrax as dfx
import jax.numpy as jnp
import numpy as np
import pytest

import nsjax
from nsjax import __main__ as command, gallery
from nsjax._cli._units import notes, ratio


PERIOD = 10 + np.pi + 2 * np.arctan(1 / 5)  # of the stick-slip orbit
README = pathlib.Path(__file__).parents[1] / "README.md"


def run(*argv):
    """Exit status, standard output and standard error."""
    out, err = io.StringIO(), io.StringIO()
    with contextlib.redirect_stdout(out), contextlib.redirect_stderr(err):
        try:
            status = command.main(list(map(str, argv)))
        except SystemExit as stop:  # from argparse
            status = stop.code
    return status, out.getvalue(), err.getvalue()


def check_stick_slip_orbit(orbit):
    assert orbit["period"] == pytest.approx(PERIOD, abs=1e-10)
    assert orbit["stable"] is True and orbit["residual"] < 1e-10
    assert orbit["itinerary"] == [{"belt": -1}, {"belt": 0}, {"belt": -1}]
    catch, release = orbit["events"]
    assert release["t"] - catch["t"] == pytest.approx(10, abs=1e-10)
    assert [e["switch"] for e in (catch, release)] == ["belt", "belt"]
    assert (catch["from"], catch["to"], release["to"]) == ({"belt": -1}, {"belt": 0}, {"belt": -1})
    assert (catch["y"]["x"], release["y"]["x"]) == (pytest.approx(0, abs=1e-10), pytest.approx(2, abs=1e-10))
    np.testing.assert_allclose(catch["saltation"], [[1, 0], [0, 0]], atol=1e-10)
    np.testing.assert_allclose(release["saltation"], [[1, 0], [-5, 1]], atol=1e-10)
    assert 0 < catch["transversality"] <= 1
    modulus = np.hypot(*np.transpose(orbit["multipliers"]))
    np.testing.assert_allclose(modulus, [1, 0], atol=1e-10)
    assert np.trace(orbit["monodromy"]) == pytest.approx(1, abs=1e-10)


# What it computes.


@pytest.fixture(scope="module")
def run_34(tmp_path_factory):
    folder = tmp_path_factory.mktemp("run")
    status, out, err = run("run", "3.4", "--out", folder / "pictures", "--json", folder / "numbers.json")
    assert status == 0, err
    return folder, out, json.loads((folder / "numbers.json").read_text())


def test_run_prints_everything(run_34):
    out = run_34[1]
    for words in (
        r"F_stick +2\.0 +\[N\] +maximum static",
        r"period +13\.536383773",
        "multipliers",
        "monodromy matrix",
    ):
        assert re.search(words, out), words
    assert out.count("saltation matrix at") == 2 and "t [s]" in out


def test_run_draws_the_pictures(run_34):
    folder, out, _ = run_34
    kinds = ("time-series", "phase-portrait", "fundamental-matrix", "multipliers")
    for kind in kinds:
        path = folder / "pictures" / f"3.4-{kind}.png"
        assert str(path) in out
        assert path.read_bytes()[:4] == b"\x89PNG" and path.stat().st_size > 10_000
    assert len(list((folder / "pictures").iterdir())) == len(kinds)


def test_run_writes_the_numbers(run_34):
    numbers = run_34[2]
    assert numbers["system"] == "3.4"
    assert numbers["parameters"] == dict(m=1.0, c=0.0, k=1.0, v_dr=0.2, F_slip=1.0, F_stick=2.0)
    check_stick_slip_orbit(numbers["orbit"])
    simulation = numbers["simulation"]
    assert (simulation["t1"], simulation["mode1"], simulation["result"]) == (40.0, {"belt": 0}, "successful")
    times = [event["t"] for event in simulation["events"]]
    assert times[3] - times[1] == pytest.approx(PERIOD, abs=1e-9)


def test_orbit_of_the_model_in_the_readme(tmp_path):
    (tmp_path / "belt.py").write_text(re.search(r"```python\n(.*?)```", README.read_text(), re.DOTALL)[1])
    name = f"{tmp_path / 'belt.py'}:StickSlip"
    status, out, err = run("orbit", name, "--set", "v_dr=0.2", "--y0", "x=2,v=0", "--period", 13.5, "--json", "-")
    assert status == 0, err
    numbers = json.loads(out)  # and nothing else
    assert numbers["system"] == name and set(numbers["orbit"]["y0"]) == {"x", "v"}
    check_stick_slip_orbit(numbers["orbit"])


def test_impacts_accumulate_to_rest(tmp_path):
    status, out, err = run("run", "1.1(3)", "--y0", "x=0.5", "--out", tmp_path, "--json", "-")
    simulation = json.loads(out)["simulation"]
    assert status == 0
    first, last = simulation["events"][0], simulation["events"][-1]
    assert last["to"] == {"floor": 1} and last["t"] == pytest.approx(9 * np.sqrt(2 * 0.5 / 9.81), rel=1e-12)
    assert first["y_after"]["v"] == pytest.approx(-0.8 * first["y"]["v"])
    np.testing.assert_allclose(np.diag(first["saltation"]), -0.8)
    assert {path.name for path in tmp_path.iterdir()} == {"1.1-3-time-series.png", "1.1-3-phase-portrait.png"}


THERMOSTAT = """
import jax.numpy as jnp
import nsjax

class Thermostat(nsjax.System):
    k: float  # loss [1/s]
    n: int = 2

    def vector_field(self, t, y, s):
        return self.k * (30.0 * s.heater - y)

    @nsjax.relay
    def heater(self, t, y):
        return 18.0 - y[0]

    @heater.off
    def heater(self, t, y):
        return y[0] - 22.0

class Careless(nsjax.System):
    def vector_field(self, t, y, s):
        raise ValueError("of the user's own")
"""


@pytest.fixture
def thermostat(tmp_path):
    (tmp_path / "thermo.py").write_text(THERMOSTAT)
    return f"{tmp_path / 'thermo.py'}:Thermostat"


def test_state_that_is_an_array(thermostat, tmp_path, monkeypatch):
    def no_orbit(*args, **kwargs):
        raise RuntimeError("none\nwas found")

    monkeypatch.setattr(command, "find_orbit", no_orbit)
    argv = ["run", thermostat, "--set", "k=0.1", "--y0", "20,19", "--t1", "8", "--out", tmp_path / "out"]
    status, out, err = run(*argv)
    assert status == 0, err
    assert "y[0]" in out and "no periodic orbit: none was found" in out
    assert re.search(r"\n  1\.05360515\d+ +heater +heater \+0 -> \+1 +18 ", out)  # 10 log(20/18)


# Mistakes: one line that names what is possible, and status 2.


@pytest.mark.parametrize(
    "argv, words",
    [
        ("", "required"),
        ("walk 3.4", "list.*run.*orbit"),
        ("run", "required"),
        ("run 9.9", r"'9\.9'.*3\.4.*6\.9.*model\.py:ClassName"),
        ("run nowhere.py:A", r"no file 'nowhere\.py'"),
        ("run nowhere.py", "model.py:ClassName"),
        ("orbit 3.4 --set q=1", "'q'.*m, c, k, v_dr"),
        ("orbit 3.4 --set m=1,q=1", "'q'"),
        ("orbit 3.4 --set m=heavy", "m must be a number.*'heavy'"),
        ("orbit 3.4 --set m=nan", "number"),
        ("orbit 3.4 --set m", "name=value"),
        ("orbit 3.4 --y0 w=1", "'w'.*x, v"),
        ("orbit 3.4 --y0 1,2,3", "x, v"),
        ("orbit 3.4 --y0 -1,a", "number"),
        ("orbit 3.4 --mode support=1", "'support'.*belt"),
        ("orbit 3.4 --mode belt=2", "-1, 0 or 1"),
        ("orbit 3.4 --tol 0", "between 0 and 1"),
        ("orbit 3.4 --period long", "long"),
        ("orbit 3.4 --order 2", "period"),
        ("orbit 3.5 --period 3", "order"),
    ],
)
def test_mistakes(argv, words):
    status, out, err = run(*argv.split())
    assert (status, out) == (2, "")
    assert err.startswith("nsjax") and err.count("\n") == 1 and re.search(words, err), err


@pytest.mark.parametrize(
    "name, argv, words",
    [
        ("Thermostat", ["--y0", "20,19"], "k have no default"),
        ("Thermostat", ["--set", "k=1"], "--y0"),
        ("Thermostat", ["--set", "k=1,n=1.5", "--y0", "20,19"], "n must be an integer"),
        ("Thermostate", ["--y0", "20,19"], "'Thermostate'.*Thermostat, Careless"),
    ],
)
def test_mistakes_with_a_file(thermostat, name, argv, words):
    status, _, err = run("run", thermostat.replace("Thermostat", name), *argv)
    assert status == 2 and err.count("\n") == 1 and re.search(words, err), err


def test_errors_of_the_model_itself_keep_their_traceback(thermostat):
    with pytest.raises(ValueError, match="user's own"):
        run("run", thermostat.replace("Thermostat", "Careless"), "--y0", "1,2")


def test_no_orbit_is_status_1(monkeypatch):
    class Failed:
        result = nsjax.RESULTS.max_steps_reached

    monkeypatch.setattr(command, "find_orbit", lambda *args, **kwargs: Failed)
    status, out, err = run("orbit", "3.4")
    assert (status, out) == (1, "")
    assert err.startswith("nsjax: no periodic orbit") and err.count("\n") == 1


def test_options_reach_the_search(monkeypatch):
    seen = {}

    def search(system, y0, **kwargs):
        seen.update(kwargs, system=system, y0=y0)
        raise RuntimeError

    monkeypatch.setattr(command, "find_orbit", search)
    run("orbit", "6.9", "--set", "omega=1.7,k=2", "--set", "m=3", "--y0", "-1,2", "--tol", "1e-9", "--mode", "belt=-1")
    assert (seen["system"].omega, seen["system"].k, seen["system"].m) == (1.7, 2.0, 3.0)
    assert tuple(seen["y0"]) == (-1.0, 2.0) and seen["mode"] == {"belt": -1}
    assert (seen["order"], seen["period"]) == (2, None)  # the guess of the gallery
    assert isinstance(seen["stepsize_controller"], dfx.PIDController) and seen["stepsize_controller"].rtol == 1e-9
    run("orbit", "6.9", "--order", "1", "--y0", "v=0.5", "--t0", "1")
    assert (seen["order"], seen["t0"]) == (1, 1.0)
    assert seen["y0"] == gallery.Motion(jnp.asarray(1.0), jnp.asarray(0.5))  # the rest is the gallery's start


# What stands around it.


def test_list_names_every_system():
    status, out, _ = run("list")
    assert status == 0
    assert [re.split(r"  +", line)[0] for line in out.splitlines()] == list(gallery.THESIS)


def test_units_are_read_from_comments():
    assert notes(gallery.StickSlip)["c"] == ("damping", "N s/m")
    assert notes(gallery.Motion)["v"].unit == "m/s"
    assert notes(gallery.AttractionSliding)["c"].unit == ""


@pytest.mark.parametrize(
    "unit, other, expected",
    [
        ("m", "m/s", "s"),
        ("m/s", "m", "1/s"),
        ("m", "m", "-"),
        ("m", "", ""),
        ("N s/m", "kg", "N s/(m kg)"),
        ("m²", "s", "m^2/s"),
    ],
)
def test_ratio_of_units(unit, other, expected):
    assert ratio(unit, other) == expected
