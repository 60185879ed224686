"""Traced programs in a folder: found again by another process, and only where nothing differs."""

import os
import pickle
import subprocess
import sys
import types
import zlib

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import nsjax
from nsjax._numerics import _programs
from nsjax._numerics._compile import interactive
from nsjax._numerics._fingerprint import stamp
from nsjax._numerics._programs import cache_folder, keep_programs


@pytest.fixture
def folder(tmp_path, monkeypatch):
    monkeypatch.setattr(_programs._Place, "folder", None)
    return keep_programs(tmp_path / "programs")


@pytest.fixture
def traced(monkeypatch):
    """The functions that were traced."""
    names, trace = [], _programs._traced

    def spied(fn, given):
        names.append(fn.__name__)
        return trace(fn, given)

    monkeypatch.setattr(_programs, "_traced", spied)
    return names


def made():
    """As another process has it: the same code, and nothing in memory."""

    @interactive
    def solved(tree, power, label="a"):
        a, b = tree["a"], tree["b"]
        return {"x": jnp.linalg.solve(a, b**power), "label": label, "power": power, "none": None, "kind": type(label)}

    return solved


A, B = np.asarray([[2.0, 1.0], [0.5, 3.0]]), np.asarray([1.0, 2.0])


def test_a_program_is_found_again(folder, traced):
    """With everything that it returns beside arrays."""
    first = made()({"a": A, "b": B}, 2)
    assert traced == ["solved"] and len(list(folder.iterdir())) == 1
    fn = made()
    for factor in (1, 2):
        again = fn({"a": jnp.asarray(A), "b": factor * B}, 2)
        np.testing.assert_array_equal(again.pop("x"), factor**2 * first["x"])
        assert again == {"label": "a", "power": 2, "none": None, "kind": str}
    assert traced == ["solved"]
    np.testing.assert_allclose(made()({"a": A, "b": B}, 3)["x"], np.linalg.solve(A, B**3), rtol=1e-15)
    made()({"a": A, "b": B}, 2, label="b"), made()({"a": A, "b": B}, 2.0)
    assert traced == ["solved"] * 4 and len(list(folder.iterdir())) == 4
    with jax.enable_x64(False):
        assert made()({"a": A, "b": B}, 2)["x"].dtype == jnp.float32
    assert len(traced) == 5


def test_results_are_arguments_of_the_same_program(folder, compilations):
    """JAX commits the results of a program that was read to a device, and would compile it again for such arguments."""
    made()({"a": A, "b": B}, 2)
    fn = made()
    x = fn({"a": A, "b": B}, 2)["x"]
    count = len(compilations)
    for _ in range(2):
        x = fn({"a": A, "b": x}, 2)["x"]
    assert len(compilations) == count


@pytest.fixture
def compilations():
    names = []

    def listen(event, seconds, **about):
        if event == "/jax/core/compile/backend_compile_duration":
            names.append(about.get("fun_name"))

    jax.monitoring.register_event_duration_secs_listener(listen)
    yield names
    jax.monitoring.unregister_event_duration_listener(listen)


@pytest.mark.parametrize(
    "damage", [lambda code: code[: len(code) // 2], lambda code: b"", lambda code: b"0" + code[1:]]
)
def test_a_damaged_file_is_made_anew(folder, traced, damage):
    first = made()({"a": A, "b": B}, 2)
    (file,) = folder.iterdir()
    file.write_bytes(damage(file.read_bytes()))
    np.testing.assert_array_equal(made()({"a": A, "b": B}, 2)["x"], first["x"])
    assert len(traced) == 2
    made()({"a": A, "b": B}, 2)
    assert len(traced) == 2


class Command:
    """What runs a command when it is unpickled."""

    def __init__(self, call):
        self.call = call

    def __reduce__(self):
        return self.call


@pytest.mark.parametrize(
    "call", [(exec, ("raise SystemExit",)), (nsjax.keep_programs, ("elsewhere",))], ids=["built in", "ours"]
)
def test_a_file_cannot_run_anything(folder, traced, monkeypatch, tmp_path, call):
    monkeypatch.chdir(tmp_path)
    first = made()({"a": A, "b": B}, 2)
    (file,) = folder.iterdir()
    whole = zlib.decompress(file.read_bytes())
    program = whole[8 + int.from_bytes(whole[:8], "big") :]
    skeleton = pickle.dumps(Command(call))
    file.write_bytes(zlib.compress(len(skeleton).to_bytes(8, "big") + skeleton + program))
    np.testing.assert_array_equal(made()({"a": A, "b": B}, 2)["x"], first["x"])
    assert len(traced) == 2 and not (tmp_path / "elsewhere").exists()


def test_what_calls_python_is_not_written(folder):
    for _ in range(2):

        @interactive
        def asked(x):
            return jax.pure_callback(lambda x: 2 * x, jax.ShapeDtypeStruct((), x.dtype), x)

        assert asked(jnp.asarray(2.0)) == 4
    assert not list(folder.iterdir())


def test_room(folder, traced, monkeypatch):
    """Those that were not used for longest make place."""
    for power in (1, 2, 3):
        made()({"a": A, "b": B}, power)
        os.utime(max(folder.iterdir(), key=lambda file: file.stat().st_mtime), (power, power))
    made()({"a": A, "b": B}, 1)  # used again
    size = sum(file.stat().st_size for file in folder.iterdir())
    monkeypatch.setattr(_programs, "ROOM", int(1.1 * size))  # they differ by a few bytes
    made()({"a": A, "b": B}, 4)
    assert len(list(folder.iterdir())) == 3
    del traced[:]
    made()({"a": A, "b": B}, 1), made()({"a": A, "b": B}, 3)
    assert traced == []
    made()({"a": A, "b": B}, 2)
    assert traced == ["solved"]


def test_only_where_it_was_asked_for(tmp_path, monkeypatch, traced):
    """And transformed, or within another program, a function is what it always was."""
    monkeypatch.setattr(_programs._Place, "folder", None)
    made()({"a": A, "b": B}, 2)
    keep_programs(tmp_path)
    fn = made()
    jax.jit(lambda b: fn({"a": A, "b": b}, 2)["x"])(B)
    jax.jvp(lambda b: fn({"a": A, "b": b}, 2)["x"], (B,), (B,))
    jax.vmap(lambda b: fn({"a": A, "b": b}, 2)["x"])(np.stack([B, B]))
    assert traced == [] and not list(tmp_path.iterdir())


def test_memory_is_freed_with_that_of_jax(folder, traced):
    fn = made()
    fn({"a": A, "b": B}, 2), fn({"a": A, "b": B}, 2)
    for file in folder.iterdir():
        file.unlink()
    jax.clear_caches()
    fn({"a": A, "b": B}, 2)
    assert len(traced) == 2


def test_an_edited_library_is_another_one(tmp_path, monkeypatch):
    file = tmp_path / "library" / "__init__.py"
    file.parent.mkdir()
    file.write_text("x = 1")
    monkeypatch.setitem(sys.modules, "library", types.SimpleNamespace(__file__=str(file)))
    first = stamp.__wrapped__("library")
    assert stamp.__wrapped__("library") == first
    file.write_text("x = 12")
    second = stamp.__wrapped__("library")
    (file.parent / "more.py").write_text("")
    assert len({first, second, stamp.__wrapped__("library")}) == 3


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
