"""Finished programs in a folder: found again by another process, and only where nothing differs."""

import os
import subprocess
import sys

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import nsjax
from nsjax._numerics import _programs
from nsjax._numerics._compile import interactive
from nsjax._numerics._programs import cache_folder, keep_programs, Programs


@pytest.fixture
def folder(tmp_path, monkeypatch):
    monkeypatch.setattr(_programs._Place, "folder", None)
    return keep_programs(tmp_path / "programs")


@pytest.fixture
def compiled(monkeypatch):
    """How often something was traced and compiled."""
    seen, compile_ = [], Programs._compiled

    def spied(self, *args):
        seen.append(self._fn.__name__)
        return compile_(self, *args)

    monkeypatch.setattr(Programs, "_compiled", spied)
    return seen


def made():
    """As another process has it: the same code, and nothing in memory."""

    @interactive
    def solved(tree, power, label="a"):
        a, b = tree["a"], tree["b"]
        return {"x": jnp.linalg.solve(a, b**power), "label": label, "power": power, "none": None, "kind": type(label)}

    return solved


A, B = np.asarray([[2.0, 1.0], [0.5, 3.0]]), np.asarray([1.0, 2.0])


def test_a_program_is_found_again(folder, compiled):
    """With everything that it returns beside arrays."""
    first = made()({"a": A, "b": B}, 2)
    assert compiled == ["solved"] and len(list(folder.iterdir())) == 1
    fn = made()
    for factor in (1, 2):
        again = fn({"a": jnp.asarray(A), "b": factor * B}, 2)
        np.testing.assert_array_equal(again.pop("x"), factor**2 * first["x"])
        assert again == {"label": "a", "power": 2, "none": None, "kind": str}
    assert compiled == ["solved"]
    np.testing.assert_allclose(made()({"a": A, "b": B}, 3)["x"], np.linalg.solve(A, B**3), rtol=1e-15)
    made()({"a": A, "b": B}, 2, label="b"), made()({"a": A, "b": B}, 2.0)
    assert compiled == ["solved"] * 4 and len(list(folder.iterdir())) == 4
    fn({"a": A, "b": B}, True), fn({"a": A, "b": B}, 1)  # equal, and yet not the same
    assert len(compiled) == 6
    with jax.enable_x64(False):
        assert made()({"a": A, "b": B}, 2)["x"].dtype == jnp.float32
    assert len(compiled) == 7


@pytest.mark.parametrize(
    "damage", [lambda code: code[: len(code) // 2], lambda code: b"", lambda code: b"0" + code[1:]]
)
def test_a_damaged_file_is_made_anew(folder, compiled, damage):
    first = made()({"a": A, "b": B}, 2)
    (file,) = folder.iterdir()
    file.write_bytes(damage(file.read_bytes()))
    np.testing.assert_array_equal(made()({"a": A, "b": B}, 2)["x"], first["x"])
    assert len(compiled) == 2
    made()({"a": A, "b": B}, 2)
    assert len(compiled) == 2


def test_code_that_does_not_run_is_made_anew(folder, compiled, monkeypatch):
    made()({"a": A, "b": B}, 2)

    def refused(*args):
        raise jax.errors.JaxRuntimeError("NOT_FOUND: Function not found")

    monkeypatch.setattr(_programs.serialize_executable, "deserialize_and_load", lambda *args: refused)
    fn = made()
    np.testing.assert_allclose(fn({"a": A, "b": B}, 2)["x"], np.linalg.solve(A, B**2), rtol=1e-15)
    fn({"a": A, "b": B}, 2)
    assert len(compiled) == 2


def test_what_calls_python_is_not_written(folder, compiled):
    for _ in range(2):

        @interactive
        def asked(x):
            return jax.pure_callback(lambda x: 2 * x, jax.ShapeDtypeStruct((), x.dtype), x)

        assert asked(jnp.asarray(2.0)) == 4
    assert compiled == ["asked"] * 2 and not list(folder.iterdir())


def test_room(folder, compiled, monkeypatch):
    """Those that were not used for longest make place."""
    for power in (1, 2, 3):
        made()({"a": A, "b": B}, power)
        os.utime(max(folder.iterdir(), key=lambda file: file.stat().st_mtime), (power, power))
    made()({"a": A, "b": B}, 1)  # used again
    size = sum(file.stat().st_size for file in folder.iterdir())
    monkeypatch.setattr(_programs, "ROOM", int(1.1 * size))  # they differ by a few bytes
    made()({"a": A, "b": B}, 4)
    assert len(list(folder.iterdir())) == 3
    del compiled[:]
    made()({"a": A, "b": B}, 1), made()({"a": A, "b": B}, 3)
    assert compiled == []
    made()({"a": A, "b": B}, 2)
    assert compiled == ["solved"]


def test_only_where_it_was_asked_for(tmp_path, monkeypatch, compiled):
    """And transformed, or within another program, a function is what it always was."""
    monkeypatch.setattr(_programs._Place, "folder", None)
    made()({"a": A, "b": B}, 2)
    keep_programs(tmp_path)
    fn = made()
    jax.jit(lambda b: fn({"a": A, "b": b}, 2)["x"])(B)
    jax.jvp(lambda b: fn({"a": A, "b": b}, 2)["x"], (B,), (B,))
    jax.vmap(lambda b: fn({"a": A, "b": b}, 2)["x"])(np.stack([B, B]))
    assert compiled == [] and not list(tmp_path.iterdir())


def test_memory_is_freed_with_that_of_jax(folder, compiled):
    fn = made()
    fn({"a": A, "b": B}, 2), fn({"a": A, "b": B}, 2)
    for file in folder.iterdir():
        file.unlink()
    jax.clear_caches()
    fn({"a": A, "b": B}, 2)
    assert len(compiled) == 2


MODEL = """
from typing import NamedTuple
import jax
import nsjax

jax.config.update("jax_enable_x64", True)

class State(NamedTuple):
    x: float
    v: float

class Belt(nsjax.System):
    k: float = 1.0
    mu: tuple = (1.0, 2.0)

    def vector_field(self, t, y, s):
        print("traced")
        return State(y.v, -self.k * y.x - s.belt)

    @nsjax.sgn
    def belt(self, t, y):
        return y.v - 0.2

nsjax.keep_programs({folder!r})
sol = nsjax.solve(Belt(), 0.0, 4.0, State(2.5, 0.0))
print(float(sol.y1.x).hex(), float(sol.events.t[0]).hex(), type(sol.y1).__name__, sol.events[0])
"""
ORBIT = """
print(nsjax.find_orbit(Belt(), State(1.0, 0.2), period=6.3, throw=False))
"""


@pytest.mark.parametrize("more", ["", pytest.param(ORBIT, marks=pytest.mark.slow)], ids=["solution", "orbit too"])
def test_another_process(tmp_path, more):
    """The solution has the same bits, and the model is traced only when it is checked."""
    script, found = tmp_path / "script.py", []
    script.write_text(MODEL.replace("{folder!r}", repr(str(tmp_path / "programs"))) + more)
    for _ in range(2):
        run = subprocess.run([sys.executable, script], capture_output=True, text=True, timeout=300)
        assert run.returncode == 0, run.stderr
        found.append(run.stdout)
    assert found[0].count("traced") > 10 > 2 >= found[1].count("traced")
    assert found[1].replace("traced\n", "") == found[0].replace("traced\n", "")
    assert "belt" in found[0] and ("stable periodic" in found[0]) == bool(more)


@pytest.mark.parametrize(
    "platform, variables, where",
    [
        ("linux", {"XDG_CACHE_HOME": ""}, ".cache/nsjax"),
        ("linux", {"XDG_CACHE_HOME": "/elsewhere"}, "/elsewhere/nsjax"),
        ("darwin", {}, "Library/Caches/nsjax"),
        ("win32", {"LOCALAPPDATA": "/local"}, "/local/nsjax"),
    ],
)
def test_the_folder_is_that_of_the_platform(monkeypatch, tmp_path, platform, variables, where):
    monkeypatch.setattr("sys.platform", platform)
    monkeypatch.setattr("pathlib.Path.home", lambda: tmp_path)
    for name, value in variables.items():
        monkeypatch.setenv(name, value)
    assert cache_folder() == tmp_path / where


def test_a_folder_that_cannot_be_made(tmp_path):
    file = tmp_path / "file"
    file.write_text("")
    with pytest.raises(OSError):
        nsjax.keep_programs(file / "programs")
