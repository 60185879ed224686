"""The command line, in this process: tables, pictures, JSON, and one line for every mistake."""

import json
import pathlib
import re

import diffrax as dfx
import equinox as eqx
import jax.numpy as jnp
import numpy as np
import pytest
from command_line import run
from scipy.integrate import solve_ivp

import nsjax
from nsjax import __main__ as command, gallery
from nsjax._cli import _follow, _scorecard, _search
from nsjax._cli._mistakes import advice
from nsjax._numerics._units import notes, ratio


PERIOD = 10 + np.pi + 2 * np.arctan(1 / 5)  # of the stick-slip orbit
README = pathlib.Path(__file__).parents[2] / "README.md"


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
    assert "no periodic orbit" not in out  # there is one


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
    units = numbers["units"]
    assert (units["state"], units["time"], units["parameters"]["c"]) == ({"x": "m", "v": "m/s"}, "s", "N s/m")
    assert set(units["parameters"]) == set(numbers["parameters"])
    assert numbers["nsjax"] == nsjax.__version__
    assert numbers["tolerances"] == {"rtol": 1e-12, "atol": 1e-12, "newton": pytest.approx(1e-10)}
    check_stick_slip_orbit(numbers["orbit"])
    simulation = numbers["simulation"]
    assert (simulation["t1"], simulation["mode1"], simulation["result"]) == (40.0, {"belt": 0}, "successful")
    times = [event["t"] for event in simulation["events"]]
    assert times[3] - times[1] == pytest.approx(PERIOD, abs=1e-9)


def test_numbers_on_standard_output():
    """(By the program that `run_34` has.)"""
    status, out, err = run("orbit", "3.4", "--json", "-")
    assert status == 0, err
    check_stick_slip_orbit(json.loads(out)["orbit"])  # and nothing else


@pytest.mark.slow  # (by default the blocks of the README run, tests/claims/test_site.py, and files of models below)
def test_orbit_of_the_model_in_the_readme(tmp_path):
    (tmp_path / "belt.py").write_text(re.search(r"```python\n(.*?)```", README.read_text(), re.DOTALL)[1])
    name = f"{tmp_path / 'belt.py'}:StickSlip"
    status, out, err = run("orbit", name, "--set", "v_dr=0.2", "--y0", "x=2,v=0", "--period", 13.5, "--json", "-")
    assert status == 0, err
    numbers = json.loads(out)  # and nothing else
    assert numbers["system"] == name and set(numbers["orbit"]["y0"]) == {"x", "v"}
    check_stick_slip_orbit(numbers["orbit"])


@pytest.mark.slow
def test_impacts_accumulate_to_rest(tmp_path):
    status, out, err = run("run", "1.1(3)", "--y0", "x=0.5", "--out", tmp_path, "--json", "-")
    simulation = json.loads(out)["simulation"]
    assert status == 0
    first, last = simulation["events"][0], simulation["events"][-1]
    assert last["to"] == {"floor": 1} and last["t"] == pytest.approx(9 * np.sqrt(2 * 0.5 / 9.81), rel=1e-12)
    assert first["y_after"]["v"] == pytest.approx(-0.8 * first["y"]["v"])
    np.testing.assert_allclose(np.diag(first["saltation"]), -0.8)
    assert {path.name for path in tmp_path.iterdir()} == {"1.1-3-time-series.png", "1.1-3-phase-portrait.png"}


def damped_period(v_dr, c=0.1, slip=1.0, stick=2.0):
    """Of section 6.7: from where the static force is reached in free flight to the belt's velocity, and back on it."""
    start = stick - c * v_dr

    def caught(t, y):
        return y[1] - v_dr if t > 1e-3 else -1.0

    caught.terminal, caught.direction = True, 1
    flight = solve_ivp(
        lambda t, y: [y[1], slip - c * y[1] - y[0]],
        (0, 20),
        [start, v_dr],
        "DOP853",
        events=caught,
        rtol=1e-13,
        atol=1e-13,
    )
    (duration,), ((x, _),) = flight.t_events[0], flight.y_events[0]
    return duration + (start - x) / v_dr


@pytest.mark.slow
def test_other_parameters_than_the_gallerys_are_searched_from_nothing(tmp_path, monkeypatch):
    """The gallery's period, 12.635, is that of twice this orbit, more or less."""
    told = ("--set", "v_dr=0.5", "--y0", "x=2.5,v=0")
    status, out, err = run("orbit", "6.7", *told, "--json", "-")
    assert status == 0, err
    assert json.loads(out)["orbit"]["period"] == pytest.approx(damped_period(0.5), abs=1e-8)
    assert err.count("\n") == 1 and re.search("period 12.635 of the gallery.*where the solution settles.*7.6346", err)
    orbits = []

    def follow(system, orbit, *args, **kwargs):
        orbits.append((orbit, kwargs["max_laps"]))
        raise OSError("enough")

    monkeypatch.setattr(_follow, "continue_orbit", follow)
    run("continue", "6.7", *told, "--max-laps", "2", "--out", tmp_path)
    ((orbit, laps),) = orbits
    assert float(orbit.period) == pytest.approx(damped_period(0.5), abs=1e-8) and laps == 2


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

    monkeypatch.setattr(_search, "find_orbit", no_orbit)
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
        ("run 6.77", r"'6\.77'.*Did you mean 6\.7 \(Stick-slip"),
        ("run StickSlp", r"Did you mean 3\.4 \(Stick-slip"),
        ("run nowhere.py:A", r"no file 'nowhere\.py'"),
        ("run nowhere.py", r"no file 'nowhere\.py'"),
        ("orbit 3.4 --set q=1", "'q'.*m, c, k, v_dr"),
        ("orbit 3.4 --set m=1,q=1", "'q'"),
        ("orbit 3.4 --set vdr=1", "'vdr'.*Did you mean 'v_dr'"),
        ("orbit 3.4 --set f_stick=1", "Did you mean 'F_stick'"),
        ("run 3.4 --set F_stick=0.5", "breakaway` must be at least 1.* but is 0.5"),
        ("orbit 3.4 --y0 V=1", "'V'.*Did you mean 'v'"),
        ("orbit 3.4 --mode bel=1", "'bel'.*Did you mean 'belt'"),
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
        ("orbit 3.4 --order 2", "--order must be 1.*--period"),
        ("orbit 3.4 --order 0", "--order: invalid positive integer"),
        ("orbit 3.5 --period 3", "--period must not.*--order"),
        ("orbit 3.4 --json /dev/null/numbers.json", "--json: '/dev/null' is a file"),
        ("orbit 3.4 --json /", "--json: '/' is a folder"),
        ("run 3.4 --out /dev/null/pictures", "--out: '/dev/null' is a file"),
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


def test_files_are_checked_before_the_work(monkeypatch):
    """A command that cannot write its result ends before it has computed for minutes."""
    monkeypatch.setattr(command, "load", lambda *args: pytest.fail("began"))
    monkeypatch.setattr("tempfile.TemporaryFile", lambda dir: open("/proc/nothing/here", "w"))
    for argv in ("run 3.4 --out pictures", "orbit 3.4 --json made/numbers.json"):
        status, _, err = run(*argv.split())
        assert status == 2 and re.search("cannot be written: No such file", err) and err.count("\n") == 1


def test_checks_leave_nothing_behind(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    assert run(*"run 3.4 --set q=1 --out a/b --json c/d.json".split())[0] == 2
    assert not list(tmp_path.iterdir())


def test_json_makes_its_folder(tmp_path, monkeypatch):
    class Found:
        result = nsjax.RESULTS.successful

    monkeypatch.setattr(_search, "find_orbit", lambda *args, **kwargs: Found)
    monkeypatch.setattr(command, "report", lambda *args: "report")
    monkeypatch.setattr(command, "orbit_record", lambda orbit: {})
    assert run("orbit", "3.4", "--json", tmp_path / "deep" / "numbers.json")[0] == 0
    assert json.loads((tmp_path / "deep" / "numbers.json").read_text())["system"] == "3.4"


def test_a_file_with_one_model_needs_no_name(thermostat, tmp_path, monkeypatch):
    """Classes count, be there a base or an instance of it."""
    seen = []
    monkeypatch.setattr(_search, "find_orbit", lambda system, *args, **kwargs: seen.append(system))
    path, _, _ = thermostat.rpartition(":")
    status, _, err = run("orbit", path, "--y0", "1,2")
    assert status == 2 and err.count("\n") == 1
    assert f"has 2 systems; name one: {path}:Thermostat, {path}:Careless" in err
    single = tmp_path / "single.py"
    text = THERMOSTAT.replace(
        "class Thermostat(nsjax.System)", "class Base(nsjax.System):\n    pass\n\nclass One(Base)"
    )
    single.write_text(text.partition("class Careless")[0] + "warm = One(k=2.0)\n")
    with pytest.raises(AttributeError):  # of the None found
        run("orbit", single, "--set", "k=3", "--y0", "1,2")
    assert type(seen[0]).__name__ == "One" and seen[0].k == 3.0
    (tmp_path / "none.py").write_text("import nsjax")
    assert "no class of nsjax.System" in run("orbit", tmp_path / "none.py")[2]


def test_a_file_that_is_meant(thermostat, monkeypatch):
    path, _, _ = thermostat.rpartition(":")
    assert "Did you mean" in run("orbit", path.replace("thermo", "termo"), "--y0", "1,2")[2]
    monkeypatch.chdir(pathlib.Path(path).parent)
    assert "Did you mean thermo.py?" in run("orbit", "thermo")[2]


@pytest.mark.parametrize(
    "old, new, line, words",
    [
        ("", "", 'raise ValueError("of the user\'s own")', "ValueError: of the user's own"),
        ('raise ValueError("of the user\'s own")', "return s.heater", "return s.heater", "AttributeError.*no switch"),
        (
            'raise ValueError("of the user\'s own")',
            "return y if y[0] > 0 else -y",
            "return y if",
            "BoolConv.*jnp.where",
        ),
        ('raise ValueError("of the user\'s own")', "return np.sin(y)", "return np.sin", "ArrayConv.*jax.numpy"),
        ('raise ValueError("of the user\'s own")', "return open('gone')", "return open", "FileNotFoundError"),
        ("import nsjax", "import nsjax, nothing_there", "import nsjax, nothing", "ModuleNotFoundError: No module"),
        ("import nsjax", "import nsjax; import sys; sys.exit(3)", "import nsjax; ", "SystemExit: 3"),
        ("import nsjax", "import nsjax; x = (", "import nsjax; x = (", "SyntaxError: '[(]' was never closed"),
    ],
)
def test_a_mistake_in_the_model_is_a_short_report(thermostat, old, new, line, words):
    """The user's own line, whatever it called, and no page of tracebacks."""
    path = pathlib.Path(thermostat.rpartition(":")[0])
    path.write_text(THERMOSTAT.replace("import jax.numpy as jnp", "import numpy as np").replace(old, new))
    number = next(i for i, text in enumerate(path.read_text().splitlines(), 1) if line in text)
    argv = ("orbit", f"{path}:Careless", "--y0", "1.0,2.0", "--period", "1")
    status, out, err = run(*argv)
    assert (status, out) == (2, "")
    first, code, what, rest = err.splitlines()
    assert first.startswith(f"nsjax: error in thermo.py, line {number}") and line in code
    assert re.search(words, what) and "--traceback" in rest
    with pytest.raises((Exception, SystemExit), match=None) as caught:
        command.main([*argv, "--traceback"])
    assert type(caught.value).__name__ in what


def test_an_error_within_a_program_is_one_line(tmp_path):
    """Equinox would put the stack of the compiler around it."""
    (tmp_path / "ball.py").write_text(
        "import nsjax\n"
        "class Ball(nsjax.System):\n"
        "    def vector_field(self, t, y, s):\n"
        "        return {'x': y['v'], 'v': -1.0 - s.floor}\n"
        "    @nsjax.impact\n"
        "    def floor(self, t, y):\n"
        "        return y['x']\n"
        "    @floor.restitution\n"
        "    def floor(self):\n"
        "        return 0.5\n"
    )
    status, _, err = run("run", tmp_path / "ball.py", "--y0", "x=1,v=0", "--out", tmp_path)
    assert status == 2 and err.count("\n") == 1 and re.search("sign with which a contact force.*Change its sign", err)


def test_version(capsys):
    """The version is printed on the standard output, with exit status 0."""
    assert run("--version") == (0, f"nsjax {nsjax.__version__}\n", "")


def test_no_orbit_is_status_1(monkeypatch):
    class Failed:
        result = nsjax.RESULTS.max_steps_reached

    monkeypatch.setattr(_search, "find_orbit", lambda *args, **kwargs: Failed)
    status, out, err = run("orbit", "3.4")
    assert (status, out) == (1, "")
    assert err.startswith("nsjax: no periodic orbit") and err.count("\n") == 1


def test_options_reach_the_search(monkeypatch):
    tries = []

    def search(system, y0, **kwargs):
        tries.append(dict(kwargs, system=system, y0=y0))
        raise RuntimeError("lost")

    monkeypatch.setattr(_search, "find_orbit", search)
    argv = "orbit 6.9 --set omega=1.7,k=2 --set m=3 --y0 -1,2 --tol 1e-9 --mode belt=-1".split()
    status, _, err = run(*argv)
    assert status == 1 and err.count("\n") == 1
    assert re.search("neither with order 2 of the gallery nor where the solution settles: lost", err)
    for seen in tries:
        assert (seen["system"].omega, seen["system"].k, seen["system"].m) == (1.7, 2.0, 3.0)
        assert tuple(seen["y0"]) == (-1.0, 2.0) and seen["mode"] == {"belt": -1}
        assert isinstance(seen["stepsize_controller"], dfx.PIDController) and seen["stepsize_controller"].rtol == 1e-9
        assert seen["tol"] == pytest.approx(1e-7)
    # The guess of the gallery, and then none: other parameters may have an orbit of another order.
    assert [(seen["order"], seen["period"]) for seen in tries] == [(2, None), (None, None)]
    tries.clear()
    run("orbit", "6.9", "--order", "1", "--y0", "v=0.5", "--t0", "1")
    (seen,) = tries  # an order that is asked for is kept to
    assert (seen["order"], seen["t0"]) == (1, 1.0)
    assert seen["y0"] == gallery.Motion(jnp.asarray(1.0), jnp.asarray(0.5))  # the rest is the gallery's start
    tries.clear()
    run("orbit", "6.7", "--period", "20")
    assert [(seen["order"], seen["period"]) for seen in tries] == [(1, 20.0), (1, None)]
    tries.clear()
    run("orbit", "6.7")
    assert [seen["period"] for seen in tries] == [12.635]


@pytest.mark.parametrize(
    "result, words",
    [
        ("orbit_not_found", "--y0.*--period.*--set"),
        ("orbit_is_equilibrium", "--y0.*--set"),
        ("orbit_is_multiple_cover", r"Divide --period \(or --order\)"),
        ("max_steps_reached", "--tol"),
        ("max_events_reached", "--y0"),
        ("wrong_mode", "--mode places"),
        ("start_penetrates", "Put --y0"),
        ("repulsive_sliding", "--mode name=0"),
    ],
)
def test_advice_names_options(result, words):
    """An error names what can be changed from the command line."""
    said = advice(getattr(nsjax.RESULTS, result))
    assert re.search(words, said) and not re.search(r"`(y0|period|order|mode)`|max_steps|max_events", said)


# What stands around it.


def test_list_names_every_system():
    status, out, _ = run("list")
    assert status == 0
    assert [re.split(r"  +", line)[0] for line in out.splitlines()] == list(gallery.SYSTEMS)


def test_a_list_that_nobody_reads_to_its_end(monkeypatch):
    def closed(*args, **kwargs):
        raise BrokenPipeError(32, "Broken pipe")

    monkeypatch.setattr(command, "_list", closed)
    assert run("list") == (2, "", "nsjax: error: [Errno 32] Broken pipe\n")


def test_scorecard(monkeypatch):
    """A section of it; and a value that is off ends with status 1."""
    status, out, err = run("scorecard", "(5.8)")
    assert (status, err) == (0, "")
    words = r"\(5\.8\): bifurcation\n  thesis +disc\w+ saddle-node\n  nsjax +disc\w+ saddle-node, 0\n  indep\w+ +0, diff.*\n  agrees\n"
    assert re.fullmatch(words, out), out
    rows = tuple(row._replace(known=0.1) for row in _scorecard.POINTS if row.key == "(5.8)")
    monkeypatch.setattr(_scorecard, "POINTS", rows)
    assert run("scorecard", "(5.8)")[0] == 1
    status, out, err = run("scorecard", "(5.88)")
    assert (status, out) == (2, "") and "'(5.88)'. Did you mean '(5.8)'" in err


def test_units_are_read_from_comments():
    assert notes(gallery.StickSlip)["c"] == ("damping", "N s/m")
    assert notes(gallery.Motion)["v"].unit == "m/s"
    assert notes(gallery.AttractionSliding)["c"].unit == ""
    # A field may say it itself, and then the comment does not count.
    typed = type(
        "Typed",
        (gallery.StickSlip,),
        {
            "__annotations__": {"c": float, "q": float},
            "c": eqx.field(default=1.0, metadata=dict(unit="kg/s")),
            "q": eqx.field(default=1.0, metadata=dict(unit="m^3/s", meaning="flow")),
        },
    )
    assert notes(typed)["c"] == ("damping", "kg/s") and notes(typed)["q"] == ("flow", "m^3/s")
    assert notes(typed)["k"] == notes(gallery.StickSlip)["k"]


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


@pytest.mark.slow
def test_the_units_of_a_scene_are_those_of_its_coordinates(tmp_path):
    """Gear rattle: d in metres. Lengths and velocities, on paper and in JSON."""
    file = tmp_path / "numbers.json"
    status, out, err = run("run", "gear rattle", "--t1", "1", "--out", tmp_path, "--json", file)
    assert status == 0, err
    assert re.search(r"q\.d = [\d.]+ m, v\.d = \S+ m/s", out) and "[-]" not in out
    assert json.loads(file.read_text())["units"]["state"] == {"q.d": "m", "v.d": "m/s"}
