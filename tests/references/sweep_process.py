"""A process that takes part in a sweep, for tests: `python sweep_process.py ROLE ...`.

work FOLDER LANES   computes what is missing, and prints when it begins and when it is done
devices FOLDER      two devices: sweeps of all kinds, and in JSON what was found
charts              two devices: a chart of attractors by one and by both
"""

import hashlib
import json
import sys
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array
from models import Beats, CHEAP, Logistic

import nsjax


BLOCK, WIDE = 512, 200
OVER = {"a": np.array([2.8, 3.2, 3.5, 3.7, 3.8]), "middle": np.array([0.6, 0.52])}
BEATS = dict(section="beat", max_time=3.0, max_iterates=128, chunk=4, **CHEAP)


class Iterated(NamedTuple):
    turns: Array
    values: Array
    result: nsjax.RESULTS


def iterated(x, k):
    """As many turns as x tells, so that lanes wait for others; it fails above x = 8."""

    def turn(c):
        y, n = c
        return jnp.sin(k * y) + x / 7, n + 1

    y, n = jax.lax.while_loop(lambda c: c[1] < 3 * x, turn, (x, 0))
    result = nsjax.RESULTS.where(x > 8, nsjax.RESULTS.max_steps_reached, nsjax.RESULTS.successful)
    return Iterated(n, y * jnp.arange(1.0, 3.0), result)


def values(lanes):
    """Neighbours take different times."""
    return 1 + 8 * ((0.618034 * np.arange(lanes)) % 1)


def wide(x):
    """Cheap, and much to write."""
    return jnp.sin(x * jnp.arange(WIDE, dtype=x.dtype))


def digest(tree):
    found = hashlib.sha256()
    for leaf in jax.tree.leaves(tree):
        found.update(np.ascontiguousarray(leaf).tobytes())
    return found.hexdigest()


def work(folder, lanes):
    runs = nsjax.Sweep(wide, values(int(lanes)), path=folder, block=BLOCK, stale=5.0)
    print("ready", flush=True)
    runs.run()
    print("done", digest(runs.result()), flush=True)


def failure(fn):
    try:
        fn()
    except Exception as error:
        return f"{type(error).__name__}: {error}"
    return "none"


def devices(folder):
    x, even = values(2501), values(2500)
    found = {"number": len(jax.devices()), "plain": digest(nsjax.sweep(iterated, x, 1.5))}
    for name, which in dict(one=1, two=2, list=jax.devices()[::-1]).items():
        found[name] = digest(nsjax.sweep(iterated, x, 1.5, devices=which))
    found["small pieces"] = digest(nsjax.sweep(iterated, x, 1.5, devices=2, chunk=17))
    for name, which in dict(first=1, both=2).items():
        runs = nsjax.Sweep(iterated, x, 1.5, path=f"{folder}/{name}", block=BLOCK, devices=which)
        found[f"folder, {name}"] = digest(runs.run().result())

    mesh = jax.make_mesh((2,), ("lanes",))
    automatic = jax.sharding.Mesh(mesh.devices, mesh.axis_names)
    found["even"] = digest(nsjax.sweep(iterated, even, 1.5))
    places = {}
    for name, m in dict(explicit=mesh, automatic=automatic).items():
        spread = jax.device_put(even, jax.sharding.NamedSharding(m, jax.sharding.PartitionSpec("lanes")))
        outs = {
            "mesh": nsjax.sweep(iterated, even, 1.5, devices=m),
            "spread": nsjax.sweep(iterated, spread, 1.5),
            "jit": jax.jit(lambda x, m=m: nsjax.sweep(iterated, x, 1.5, devices=m))(even),
        }
        found[f"uneven, {name}"] = digest(nsjax.sweep(iterated, x, 1.5, devices=m))
        for how, out in outs.items():
            found[f"even, {how}, {name}"] = digest(out)
            places[f"{how}, {name}"] = str(out.values.sharding.spec)
    found["places"] = places

    def total(x, k, which=None):
        return jnp.sum(nsjax.sweep(lambda x: jnp.sin(k * x) / x, x, chunk=64, devices=which))

    few = jnp.asarray(even[:300])
    gaps = []
    for transform in (jax.jacfwd, jax.grad):
        want = transform(total, (0, 1))(few, 0.7)
        for m in (mesh, automatic):
            got = transform(lambda x, k, m=m: total(x, k, m), (0, 1))(few, 0.7)
            gaps += [float(abs(np.asarray(a) - np.asarray(b)).max()) for a, b in zip(got, want)]
    found["derivatives"] = max(gaps)
    found["errors"] = {
        "within jit": failure(lambda: jax.jit(lambda x: nsjax.sweep(jnp.sin, x, devices=2))(few)),
        "within derivatives": failure(lambda: jax.jacfwd(lambda k: nsjax.sweep(lambda x: k * x, few, devices=2))(1.0)),
        "too many": failure(lambda: nsjax.sweep(jnp.sin, few, devices=3)),
        "the function's": failure(lambda: nsjax.sweep(lambda x: x + {}["mine"], few, devices=2)),
    }
    print(json.dumps(found), flush=True)


def charts():
    found = [nsjax.attractor_chart(Logistic(), OVER, Beats(0.37, 0.25), devices=n, **BEATS) for n in (None, 1, 2)]
    digests = [digest((c.periods, c.classes, c.chaotic, c.exponents, c.ys)) for c in found]
    print(json.dumps({"charts": digests, "kinds": sorted(set(found[0].kinds().ravel()))}), flush=True)


def distributed(folder, address, number):
    jax.distributed.initialize(address, 2, int(number))
    x = values(1000)
    want = np.asarray(nsjax.sweep(iterated, x, 1.5).values)
    mesh = jax.make_mesh((4,), ("lanes",))
    place = jax.sharding.NamedSharding(mesh, jax.sharding.PartitionSpec("lanes"))
    spread = jax.make_array_from_callback(x.shape, place, lambda index: x[index])
    for found in nsjax.sweep(iterated, x, 1.5, devices=mesh), nsjax.sweep(iterated, spread, 1.5):
        shards = found.values.addressable_shards
        assert len(shards) == 2 and all(len(s.data) == 250 and np.array_equal(s.data, want[s.index]) for s in shards)
    assert "holds devices of other processes" in failure(
        lambda: nsjax.Sweep(iterated, x, 1.5, path=folder, devices=mesh)
    )
    runs = nsjax.Sweep(iterated, x, 1.5, path=folder, devices=jax.local_devices(), block=64, chunk=64).run()
    assert np.array_equal(runs.result().values, want)
    print("good", flush=True)


if __name__ == "__main__":
    role, *rest = sys.argv[1:]
    jax.config.update("jax_enable_x64", True)
    jax.config.update("jax_numpy_dtype_promotion", "strict")
    if role != "work":  # now or never
        jax.config.update("jax_num_cpu_devices", 2)
    {"work": work, "devices": devices, "charts": charts, "distributed": distributed}[role](*rest)
