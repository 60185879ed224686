"""The house rules that a reader of the code relies on: modules stand on those below, and importing changes nothing."""

import ast
import pathlib
import subprocess
import sys

import pytest


PACKAGE = pathlib.Path(__file__).parents[1] / "nsjax"

# Bottom to top: a module imports only modules named before it.
ORDER = (
    "_version",
    "_types",
    "_text",
    "_results",
    "_once",
    "_progress",
    "_bracket",
    "_linear",
    "_minima",
    "_structure",
    "_system",
    "_parameter",
    "_compact",
    "_jacobian",
    "_implicit",
    "_forward",
    "_filippov",
    "_crossing",
    "_step",
    "_series",
    "_taylor",
    "_exponential",
    "_solution",
    "_sensitivity",
    "_save",
    "_attraction",
    "_laws",
    "_settle",
    "_event",
    "_check",
    "_arguments",
    "_diagnosis",
    "_start",
    "_flow",
    "_solve",
    "_saltation",
    "_variational",
    "_arcs",
    "_floquet",
    "_pencil",
    "_crossings",
    "_extremum",
    "_regularise",
    "_kinks",
    "_sweep",
    "_orbit",
    "_guess",
    "_shooting",
    "_cuts",
    "_segments",
    "_equilibrium",
    "_find_equilibrium",
    "_archive",
    "_curve",
    "_equilibrium_curve",
    "_bifurcation",
    "_corner",
    "_branch",
    "_trace",
    "_continue_equilibrium",
    "_generalized",
    "_search",
    "_find_orbit",
    "_poincare",
    "_reduced_map",
    "_brute_force",
    "_hopf_orbits",
    "_course",
    "_segment_flow",
    "_orbit_curve",
    "_orbit_look",
    "_orbit_start",
    "_test_function",
    "_orbit_trace",
    "_orbit_lane",
    "_cycles",
    "_return_map",
    "_orbit_bifurcation",
    "_orbit_node",
    "_orbit_grazing",
    "_orbit_half",
    "_orbit_corner",
    "_orbit_record",
    "_orbit_branch",
    "_orbit_tree",
    "_continue_orbit",
    "_continue_orbits",
    "_orbit_surface",
    "_orbit_singular",
    "_orbit_locus",
    "_continue_bifurcation",
    "_work_precision",
    "gallery",
    "plot",
    "_cli",
    "__main__",
)


def files(name):
    folder = PACKAGE / name
    return sorted(folder.glob("*.py")) if folder.is_dir() else [PACKAGE / f"{name}.py"]


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


def test_importing_is_light_and_changes_nothing():
    code = (
        "import sys, jax\n"
        "before = dict(jax.config.values)\n"
        "import nsjax\n"
        "assert nsjax.plot and nsjax.gallery\n"
        "import nsjax.__main__\n"
        "assert dict(jax.config.values) == before\n"
        "assert 'matplotlib' not in sys.modules\n"
    )
    done = subprocess.run([sys.executable, "-c", code], cwd=PACKAGE.parent, capture_output=True, text=True)
    assert not done.returncode, done.stderr
