"""Names of JAX that are not documented: only those of the table are used, and each may be missing."""

import ast
import pathlib
import subprocess
import sys

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import nsjax
from nsjax._numerics import _compile, _lane_cond, _operation, _undocumented
from nsjax._numerics._autodiff import FORWARD_ONLY
from nsjax._numerics._compile import interactive


PACKAGE = pathlib.Path(nsjax.__file__).parent


def private_imports(path):
    """The modules that a file imports from private parts of JAX."""
    for node in ast.walk(ast.parse(path.read_text())):
        names = [node.module or ""] if isinstance(node, ast.ImportFrom) else []
        names += [alias.name for alias in node.names] if isinstance(node, ast.Import) else []
        yield from (name for name in names if name.startswith(("jax._", "jaxlib.")))


def test_one_module_imports_them():
    files = {path.relative_to(PACKAGE).as_posix(): list(private_imports(path)) for path in PACKAGE.rglob("*.py")}
    assert {file: names for file, names in files.items() if names} == {
        "_numerics/_undocumented.py": ["jax._src.interpreters.ad"]
    }


@pytest.mark.parametrize("name", ["PARENT", "AXIS"])
def test_without_the_attributes_of_traces(monkeypatch, name):
    """Results are the same; fewer calls are known to be outermost."""
    monkeypatch.setattr(_compile, name, "no_such_attribute")
    asked = []

    @interactive
    def fn(x):
        return jnp.sum(jnp.sin(x) ** 2)

    def told(x):
        asked.append(_compile.outermost())
        return fn(x)

    x = jnp.arange(3.0)
    np.testing.assert_allclose(told(x), np.sum(np.sin(x) ** 2), rtol=1e-14)
    np.testing.assert_allclose(jax.jacfwd(told)(x), np.sin(2 * x), rtol=1e-14)
    np.testing.assert_allclose(jax.vmap(told)(x[:, None]), np.sin(x) ** 2, rtol=1e-14)
    assert asked == [True, False, False]


def test_without_linearizations(monkeypatch):
    """The message is that of JAX."""
    entry = nsjax.gallery.entry("3.4")
    slope = jax.grad(lambda t1: nsjax.solve(entry.system(), 0.0, t1, entry.orbit.y0).y1.x)
    with pytest.raises(TypeError, match="DirectAdjoint"):
        slope(1.0)
    monkeypatch.delitem(_operation.primitive_linearizations, FORWARD_ONLY.primitive)
    jax.clear_caches()
    with pytest.raises(ValueError, match="reverse-mode autodiff"):
        slope(1.0)


def test_without_lowering_of_jaxprs(monkeypatch):
    """Primitives with functions within are as they were, and work as long as these are made of plain primitives."""
    if "to_lojax" in vars(_lane_cond.COMPACT_COND.primitive):
        monkeypatch.delattr(_lane_cond.COMPACT_COND.primitive, "to_lojax")
    x = jnp.arange(3.0)
    root = jax.vmap(lambda x: _lane_cond.compact_cond(x > 0.5, lambda x: (jnp.sqrt(x),), (x,), (x,))[0])
    np.testing.assert_allclose(jax.jit(root)(x), np.sqrt([0, 1, 2]), rtol=1e-15)


def test_the_table_is_complete():
    for name in ("parent_trace", "axis_data", "primitive_linearizations", "lower_jaxpr2"):
        assert f"{name}` |" in _undocumented.__doc__


IMPORT = """
import sys, types

import diffrax, equinox, jax, jaxlib, jax.export, jax.extend.core, jax.flatten_util, lineax, optimistix

LIBRARIES = ("jax", "jaxlib", "equinox", "diffrax", "optimistix", "lineax")

def attributes():
    modules = {name: m for name, m in sys.modules.items() if name.partition(".")[0] in LIBRARIES}
    return {(name, key): value for name, m in modules.items() for key, value in list(vars(m).items())}

before = attributes()
settings = dict(jax.config.values)
import nsjax
after = attributes()
changed = {key for key, value in before.items() if after.get(key) is not value}
known = {name for name, _ in before}
added = {key for key, value in after.items() if key not in before and key[0] in known}
added = {key for key in added if key[1] != "__warningregistry__" and not isinstance(after[key], types.ModuleType)}
print(len(before), changed, added, jax.config.values == settings)
"""


def test_importing_changes_nothing_in_other_libraries():
    """Of all their modules every attribute is what it was, and there is no new one."""
    run = subprocess.run([sys.executable, "-c", IMPORT], capture_output=True, text=True)
    assert run.returncode == 0, run.stderr
    count, *rest = run.stdout.split()
    assert int(count) > 10_000 and rest == ["set()", "set()", "True"]
