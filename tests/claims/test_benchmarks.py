"""Every script of `python benchmarks` runs, at its smallest: what it measures then is of no interest."""

import ast
import os
import pathlib
import subprocess
import sys

import pytest


FOLDER = pathlib.Path(__file__).parents[2] / "benchmarks"
SMALL = {
    "sweep.py": "--workload S1 --lanes 8 --scipy-lanes 1 --rounds 1",
    "stops.py": "--lanes 16 --rounds 1",
    "friction.py": "--lanes 16 --rounds 1 --sweep 6.8",
    "cost.py": "--lanes 4 --repeats 1",
    "first_answer.py": "--repeats 1 --rows",
    "growth.py": "--panels events --repeats 1",
    "orbits.py": "--lanes 3 --scipy-lanes 1 --repeats 1",
    "branches.py": "--lanes 2 --max-step 0.05 --repeats 1",
    "work_precision.py": "--systems hammer --tolerances 1e-4 --repeats 1",
}
ROWS = ("diffrax: jacfwd(diffeqsolve) to one event", "scipy: a solution to one event")


def test_all_are_known():
    tree = ast.parse((FOLDER / "__main__.py").read_text())
    (runs,) = [node.value for node in tree.body if isinstance(node, ast.Assign) and node.targets[0].id == "RUNS"]
    assert [script for script, *_ in ast.literal_eval(runs)] == list(SMALL)


@pytest.mark.slow
@pytest.mark.parametrize("script", SMALL)
def test_it_runs(script, tmp_path):
    if script in ("sweep.py", "friction.py"):
        pytest.importorskip("heyoka")
    out = tmp_path / ("found" if script in ("growth.py", "work_precision.py") else "found.json")
    rows = ROWS if script == "first_answer.py" else ()
    command = [sys.executable, FOLDER / script, *SMALL[script].split(), *rows, "--out", out]
    run = subprocess.run(command, capture_output=True, text=True, env=os.environ | {"MPLBACKEND": "Agg"})
    assert run.returncode == 0, run.stderr
    assert "|---|" in run.stdout and "nan" not in run.stdout
    assert (tmp_path / "found.json").stat().st_size > 100
