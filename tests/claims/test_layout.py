"""The house rules that a reader of the code relies on: modules stand on those below, and importing changes nothing."""

import ast
import pathlib
import re
import subprocess
import sys

import pytest


PACKAGE = pathlib.Path(__file__).parents[2] / "nsjax"

# Bottom to top: a folder imports only those named before it.
ORDER = (
    "_version",
    "_types",
    "_numerics",
    "system",
    "mechanics",
    "gallery",
    "flow",
    "derivatives",
    "setvalued",
    "regularise",
    "sweeps",
    "orbits",
    "equilibria",
    "maps",
    "continuation",
    "_work_precision",
    "plot",
    "_cli",
    "__main__",
)


def files(name):
    folder = PACKAGE / name
    return sorted(folder.rglob("*.py")) if folder.is_dir() else [PACKAGE / f"{name}.py"]


def imported(path):
    """The modules of nsjax that a file imports, apart from those of its own folder if it lies deeper."""
    depth = len(path.relative_to(PACKAGE).parts)
    for node in ast.walk(ast.parse(path.read_text())):
        if isinstance(node, ast.ImportFrom):
            inside = node.level == depth or (node.level == 0 and (node.module or "").partition(".")[0] == "nsjax")
            module = (node.module or "").removeprefix("nsjax").removeprefix(".")
            if inside:
                yield from [module.partition(".")[0]] if module else [alias.name for alias in node.names]
        elif isinstance(node, ast.Import):
            assert not any(alias.name.partition(".")[0] == "nsjax" for alias in node.names), path


def test_every_module_has_its_place():
    found = {path.stem for path in PACKAGE.glob("*.py")} | {path.parent.name for path in PACKAGE.glob("*/__init__.py")}
    assert found - {"__init__"} == set(ORDER)


@pytest.mark.parametrize("name", ORDER)
def test_modules_import_only_those_below(name):
    below = set(ORDER[: ORDER.index(name)])
    above = {(path.name, module) for path in files(name) for module in imported(path) if module not in below}
    assert not above


def test_choices_are_one_operation():
    """`jnp.where` is a function of its own in a program: see `select`."""
    assert [path.name for path in PACKAGE.rglob("*.py") if "jnp.where(" in path.read_text()] == ["_select.py"]


def test_cited_pitfalls_are_listed():
    """The rows of tests/PITFALLS.md, and the numbers that tests name. (Row 60 waits for its stress test.)"""
    tests = pathlib.Path(__file__).parents[1]
    listed = {int(n) for n in re.findall(r"^\| (\d+) \|", (tests / "PITFALLS.md").read_text(), re.MULTILINE)}
    cited = set()
    for path in tests.rglob("*.py"):
        for numbers in re.findall(r"[Pp]itfalls?[ _](\d+(?:(?:, | and )\d+)*)", path.read_text()):
            cited |= {int(n) for n in re.findall(r"\d+", numbers)}
    assert cited == listed


def test_importing_is_light_and_changes_nothing():
    code = (
        "import sys, jax\n"
        "before = dict(jax.config.values)\n"
        "import nsjax\n"
        "assert nsjax.plot and nsjax.gallery\n"
        "import nsjax.__main__\n"
        "assert dict(jax.config.values) == before\n"
        "assert 'matplotlib' not in sys.modules\n"
        "jax.config.update('jax_num_cpu_devices', 2)\n"  # refused once JAX has begun to compute
        "assert len(jax.devices('cpu')) == 2\n"
    )
    done = subprocess.run([sys.executable, "-c", code], cwd=PACKAGE.parent, capture_output=True, text=True)
    assert not done.returncode, done.stderr
