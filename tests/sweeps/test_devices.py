"""`sweep` and `Sweep` on two devices: the same bits as on one, and results where they belong."""

import json
import os
import pathlib
import socket
import subprocess
import sys

import jax
import jax.numpy as jnp
import pytest

from nsjax import Sweep, sweep
from nsjax.sweeps._devices import DeviceQueue, devices_of


SCRIPT = pathlib.Path(__file__).parents[1] / "references" / "sweep_process.py"


def begin(*words):
    """(It stands in the folder of references, and finds nsjax as this process does.)"""
    env = os.environ | {"PYTHONPATH": os.pathsep.join(filter(None, sys.path))}
    pipes = dict(stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True)
    return subprocess.Popen([sys.executable, str(SCRIPT), *map(str, words)], env=env, **pipes)


def test_two_devices(tmp_path):
    """All in one process, as JAX has to be told how many devices there are before it begins."""
    process = begin("devices", tmp_path)
    out, errors = process.communicate()
    assert process.returncode == 0, errors
    found = json.loads(out)
    assert found["number"] == 2

    ways = ["one", "two", "list", "small pieces", "folder, first", "folder, both"]
    ways += [f"uneven, {mesh}" for mesh in ("explicit", "automatic")]
    assert {name: found[name] for name in ways} == dict.fromkeys(ways, found["plain"])
    ways = [f"even, {how}, {mesh}" for how in ("mesh", "spread", "jit") for mesh in ("explicit", "automatic")]
    assert {name: found[name] for name in ways} == dict.fromkeys(ways, found["even"])
    assert len(found["places"]) == 6 and all(place.startswith("P('lanes',") for place in found["places"].values())

    assert found["derivatives"] < 1e-12
    errors = found["errors"]
    for where in ("within jit", "within derivatives"):
        assert "must be a `jax.sharding.Mesh` within `jax.jit`, `jax.vmap` and derivatives, but is 2" in errors[where]
    assert "from 1 to 2, but is 3" in errors["too many"] and "jax_num_cpu_devices" in errors["too many"]
    assert errors["the function's"] == "KeyError: 'mine'"


@pytest.mark.slow
def test_charts_of_two_devices():
    process = begin("charts")
    out, errors = process.communicate()
    assert process.returncode == 0, errors
    found = json.loads(out)
    assert len(set(found["charts"])) == 1 and {"chaos", "period 1", "period 4"} <= set(found["kinds"])


@pytest.mark.slow
def test_a_mesh_of_two_processes(tmp_path):
    """A sweep in both at once, over all four devices; and in a folder, where each has its own."""
    with socket.socket() as free:
        free.bind(("localhost", 0))
        address = f"localhost:{free.getsockname()[1]}"
    for process in [begin("distributed", tmp_path, address, i) for i in range(2)]:
        out, errors = process.communicate(timeout=120)
        assert process.returncode == 0 and "good" in out, errors


def test_what_devices_may_be():
    (device,) = jax.devices()
    mesh = jax.make_mesh((1,), ("lanes",))
    assert devices_of(None) == devices_of(1) == devices_of([device]) == devices_of(mesh) == [device]
    for wrong in (0, 2, -1):
        with pytest.raises(ValueError, match=f"`devices` must be a number from 1 to 1, but is {wrong}"):
            devices_of(wrong)
    for wrong in (True, 1.0, "cpu", [], ["cpu"]):
        with pytest.raises(TypeError, match="Argument `devices` must"):
            devices_of(wrong)
    with pytest.raises(ValueError, match="different devices"):
        devices_of([device, device])


def test_derivatives_within_what_is_swept():
    x = jnp.linspace(0.1, 2.0, 10)
    found = sweep(jax.value_and_grad(jnp.sin), x, chunk=4, devices=1)
    assert jnp.array_equal(found[0], sweep(jnp.sin, x, chunk=4)) and jnp.allclose(found[1], jnp.cos(x))
    with pytest.raises(ValueError, match=r"nsjax.sweep\(jax.jacfwd\(fn\), x, devices=n\)"):
        jax.grad(lambda k: jnp.sum(sweep(lambda x: k * x, x, devices=1)))(1.0)


def test_one_program_for_many_calls(tmp_path):
    """As `jax.jit` has it: other values, and an object that goes on with a sweep, trace and compile nothing."""
    traced = []

    def fn(x, k, n):
        traced.append(1)
        return k * x + (1 if n is True else 0)

    x = jnp.arange(10.0)
    for k in (1.0, 2.0):
        assert jnp.array_equal(sweep(fn, x, k, 1, chunk=4, devices=1), k * x)
    assert len(traced) == 1
    assert jnp.array_equal(sweep(fn, x, 2.0, True, chunk=4, devices=1), 2 * x + 1)  # though 1 == True
    assert len(traced) == 2
    sweep(fn, x, 2.0, 1, chunk=4, devices=1)
    assert len(traced) == 2
    for _ in range(2):
        Sweep(fn, x, 2.0, 1, path=tmp_path, block=5, chunk=5).run()
    assert len(traced) == 3
    with jax.enable_x64(False):
        narrow = sweep(fn, x.astype("float32"), 2.0, 1, chunk=4, devices=1)
        assert narrow.dtype == "float32" and jnp.array_equal(narrow, 2 * x.astype("float32"))


def test_a_queue_ends_with_the_first_error():
    """What was begun is finished, and the rest is never begun."""
    begun = []

    def work(i):
        begun.append(i)
        if i == 2:
            raise RuntimeError("third")
        return i

    with pytest.raises(RuntimeError, match="third"), DeviceQueue(jax.devices()) as each:
        assert len(each) == 1
        futures = [each.submit(lambda device, i=i: work(i)) for i in range(3)]
        assert [future.result() for future in futures[:2]] == [0, 1]
        futures[2].result()
    assert begun == [0, 1, 2]
