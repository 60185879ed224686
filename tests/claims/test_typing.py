"""What a user's type checker sees: no errors in a model of theirs, and the types of states that come out."""

import json
import os
import pathlib
import re
import subprocess
import sys
from importlib import resources

import pytest

import nsjax


ROOT = pathlib.Path(__file__).parents[2]
MODEL, CALLS = re.findall(r"```python\n(.*?)```", (ROOT / "README.md").read_text(), re.DOTALL)[:2]

REVEALED = {
    "sol.y1": "State",
    "sol.y1.x": "Array | float",
    "sol(1.0).v": "Array | float",
    "sol.events[0].y_after.x": "Array | float",
    "sol.t1": "Array",
    "orbit.y0": "State",
    "orbit.y0.v": "Array | float",
    "orbit.period": "Array",
    "orbit.solve().y1": "State",
    "orbit.maximum(lambda t, y: abs(y.x))": "Array",
    "nsjax.continue_orbit(StickSlip(), orbit, 'v_dr', (0.1, 0.5)).orbit(3).y0": "State",
    "nsjax.find_equilibrium(StickSlip(), State(1.0, 0.0)).y": "State",
    "nsjax.fundamental_matrix(StickSlip(), 0.0, 1.0, State(2.5, 0.0))": "Array",
    "nsjax.solve(StickSlip(), 0.0, 1.0, {'x': 1.0}).y1": "dict[str, float]",
    "StickSlip().belt(0.0, orbit.y0)": "Any",  # the indicator function, though pyright takes a switch for a property
}

SWITCHES = """
from typing import Any

import nsjax
from nsjax.gallery import Motion


class Everything(nsjax.System):
    e: float = 0.5

    def vector_field(self, t: Any, y: Motion, s: Any) -> Motion:
        return Motion(y.v, s.floor - s.heater - 0.1 * s.rub - 1.0)

    @nsjax.impact
    def floor(self, t: Any, y: Motion) -> Any:
        return y.x

    @floor.restitution
    def floor(self) -> float:
        return self.e

    @nsjax.impact
    def wall(self, t: Any, y: Motion) -> Any:
        return 1.0 - y.x

    @wall.reset
    def wall(self, t: Any, y: Motion) -> Motion:
        return Motion(y.x, -self.e * y.v)

    @nsjax.relay
    def heater(self, t: Any, y: Motion) -> Any:
        return y.x - 0.5

    @heater.off
    def heater(self, t: Any, y: Motion) -> Any:
        return -self.heater(t, y) - 0.2

    @nsjax.sgn
    def rub(self, t: Any, y: Motion) -> Any:
        return y.v

    @rub.breakaway
    def rub(self) -> float:
        return 2.0


nsjax.solve(Everything(), 0.0, 1.0, Motion(0.7, 0.0))
"""

TWICE = """
class Twice:
    def method(self):
        return 1

    def method(self):
        return 2


nsjax.sgn(0)(1)
"""


README = MODEL + CALLS + "".join(f"reveal_type({expression})\n" for expression in REVEALED)
FILES = {
    "basic": ("basic", README),
    "standard": ("standard", README),
    "switches": ("strict", SWITCHES),
    "twice": ("basic", SWITCHES + TWICE),
}


@pytest.fixture(scope="module")
def diagnostics(tmp_path_factory):
    """What pyright says of each file, to which nsjax is an installed package. It reads that once for all of them."""
    folder = tmp_path_factory.mktemp("models")
    for name, (mode, text) in FILES.items():
        (folder / f"{name}.py").write_text(f"# pyright: {mode}\n{text}")
    command = [
        sys.executable,
        "-m",
        "pyright",
        "--pythonpath",
        sys.executable,
        "--outputjson",
        *(f"{name}.py" for name in FILES),
    ]
    env = os.environ | {"PYTHONPATH": str(ROOT), "PYRIGHT_PYTHON_IGNORE_WARNINGS": "1"}
    done = subprocess.run(command, capture_output=True, text=True, env=env, cwd=folder)
    found = json.loads(done.stdout)
    assert found["summary"]["filesAnalyzed"] == len(FILES), done.stderr
    told = found["generalDiagnostics"]
    return {name: [d for d in told if pathlib.Path(d["file"]).stem == name] for name in FILES}


@pytest.mark.parametrize("mode", ["basic", "standard"])
def test_the_model_of_the_readme_has_no_errors_and_known_types(diagnostics, mode):
    found = diagnostics[mode]
    assert [d["message"] for d in found if d["severity"] != "information"] == []
    types = [re.search('is "(.*)"$', d["message"])[1] for d in found]
    assert dict(zip(REVEALED, types)) == REVEALED


def test_every_switch_may_be_completed_under_its_own_name(diagnostics):
    # (In strict mode the types of JAX's dependencies are partly unknown, which is no matter of the model's.)
    found = diagnostics["switches"]
    assert [d["message"] for d in found if d.get("rule") != "reportUnknownMemberType"] == []


def test_nothing_else_is_overlooked_for_it(diagnostics):
    rules = [d.get("rule") for d in diagnostics["twice"]]
    assert rules == ["reportRedeclaration", "reportCallIssue"]


def test_types_are_shipped():
    assert (resources.files(nsjax) / "py.typed").is_file()


def test_one_version_everywhere():
    """The package's own is that of its metadata (`tool.hatch.version`) and of the citation."""
    citation = (ROOT / "CITATION.cff").read_text()
    assert re.search(r"^version: (.*)$", citation, re.MULTILINE)[1] == nsjax.__version__
    assert 'path = "nsjax/_version.py"' in (ROOT / "pyproject.toml").read_text()
    for words in ("Leine", "Bifurcations in Discontinuous Mechanical Systems of Filippov-Type", "year: 2000"):
        assert words in citation
