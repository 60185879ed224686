"""Sweeps at scale: what devices, folders and order cost or gain, throughput and memory against the number of lanes.

    python benchmarks/sweep_scale.py --out benchmarks/sweep_scale.json

Workload S1 by Dopri8 (`workloads.py`), and a cheap one: a tenth of it. What is compared is run in turns in one process
of two devices, and ratios are medians of the ratios within a turn. Memory is the largest that a process of its own came
to; pages of files that are mapped are in the second number only: the system takes those back when it needs them.

Beside the numbers, a picture of throughput and of chunks is drawn; `--parts` alone, with no part, draws it once more.
"""

import argparse
import itertools
import json
import pathlib
import statistics
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable
from typing import Any

import diffrax
import jax
import matplotlib.pyplot as plt
import numpy as np
from sweep import machine, slider_lane
from workloads import belt_velocities, SLIDER

import nsjax
from nsjax.gallery import Motion, thesis


PARTS = ("overhead", "order", "chunks", "throughput", "memory")


def heavy(v_dr: jax.Array) -> Any:
    """S1: t = 0 to 100 at a tolerance of 1e-8."""
    return slider_lane(v_dr, tol=1e-8, solver=diffrax.Dopri8())


def cheap(v_dr: jax.Array) -> Any:
    """The first 10 units of time, at 1e-6 by Tsit5."""
    controller = diffrax.PIDController(rtol=1e-6, atol=1e-6)
    limits = dict(max_events=16, max_steps=10_000, throw=False)
    sol = nsjax.solve(thesis("3.4", v_dr=v_dr), 0.0, 10.0, Motion(*SLIDER), stepsize_controller=controller, **limits)
    return sol.y1, sol.result


Way = Callable[[], Callable[[], Any]]  # prepares what is timed


def in_turns(ways: dict[str, Way], repeats: int) -> dict[str, list[float]]:
    for way in 2 * [*ways.values()]:  # it compiles for each device: with few pieces not all have one at first
        jax.block_until_ready(way()())
    seconds: dict[str, list[float]] = {name: [] for name in ways}
    for _ in range(repeats):
        for name, way in ways.items():
            run = way()
            start = time.perf_counter()
            jax.block_until_ready(run())
            seconds[name].append(time.perf_counter() - start)
    return seconds


def ratios(seconds: dict[str, list[float]], to: str) -> list[dict[str, Any]]:
    return [
        {
            "way": name,
            "seconds": statistics.median(own),
            "ratio": statistics.median(a / b for a, b in zip(own, seconds[to])),
            "ratios": [a / b for a, b in zip(own, seconds[to])],
        }
        for name, own in seconds.items()
    ]


def in_memory(fn: Callable[..., Any], x: np.ndarray, **options: Any) -> Way:
    return lambda: lambda: nsjax.sweep(fn, x, **options)


def overhead(lanes: int, block: int, repeats: int, root: str) -> list[dict[str, Any]]:
    x, number = belt_velocities(lanes), itertools.count()

    def in_folder(devices: int) -> Way:
        def made() -> Callable[[], Any]:
            runs = nsjax.Sweep(heavy, x, path=f"{root}/{next(number)}", block=block, devices=devices)
            return lambda: runs.run() and None

        return made

    ways: dict[str, Way] = {
        "sweep": in_memory(heavy, x),
        "sweep, devices=1": in_memory(heavy, x, devices=1),
        "sweep, devices=2": in_memory(heavy, x, devices=2),
        "Sweep, one device": in_folder(1),
        "Sweep, devices=2": in_folder(2),
    }
    return ratios(in_turns(ways, repeats), "sweep")


def order(lanes: int, repeats: int) -> list[dict[str, Any]]:
    """Neighbours that are alike against a random sample: what `order=` makes of the second is the first."""
    x = belt_velocities(lanes)
    mixed = np.random.default_rng(0).permutation(x)
    ways = {"sorted": in_memory(heavy, x), "random": in_memory(heavy, mixed)}
    return ratios(in_turns(ways, repeats), "random")


def chunks(lanes: int, sizes: list[int], repeats: int) -> list[dict[str, Any]]:
    x = belt_velocities(lanes)
    ways = {str(n): in_memory(heavy, x, chunk=n) for n in sizes}
    return ratios(in_turns(ways, repeats), "256")


def throughput(numbers: list[int], repeats: int) -> list[dict[str, Any]]:
    rows = []
    for n in numbers:
        x = belt_velocities(n)
        ways = {f"devices={d}": in_memory(cheap, x, devices=d) for d in (1, 2)}
        for name, seconds in in_turns(ways, repeats if n < 1e6 else 1).items():
            rows.append({"lanes": n, "way": name, "lanes a second": n / statistics.median(seconds)})
    return rows


MEMORY = """
import sys, time
import jax
jax.config.update("jax_enable_x64", True)
import numpy as np
import nsjax
from sweep_scale import cheap
path, lanes = sys.argv[1], int(sys.argv[2])
x = np.lib.format.open_memmap(f"{path}/x.npy", "w+", float, (lanes,))
for i in range(0, lanes, 100_000):
    x[i : i + 100_000] = 0.1 + 0.9 * np.arange(i, min(i + 100_000, lanes)) / lanes
del x
runs = nsjax.Sweep(cheap, np.load(f"{path}/x.npy", mmap_mode="r"), path=f"{path}/run")
most, start = 0, time.perf_counter()
for block in runs:
    words = open("/proc/self/smaps_rollup").read().split()
    kb = {words[i]: int(words[i + 1]) for i in range(len(words) - 1) if words[i].endswith(":")}
    most = max(most, kb["Anonymous:"])
seconds = time.perf_counter() - start
runs.result()
(peak,) = [line.split()[1] for line in open("/proc/self/status") if line.startswith("VmHWM")]
print(most / 1e3, int(peak) / 1e3, seconds)
"""


def memory(numbers: list[int]) -> list[dict[str, Any]]:
    rows = []
    for n in numbers:
        with tempfile.TemporaryDirectory() as path:
            here = str(pathlib.Path(__file__).parent)
            command = [sys.executable, "-c", f"import sys; sys.path.insert(0, {here!r})\n{MEMORY}", path, str(n)]
            found = subprocess.run(command, capture_output=True, text=True, check=True).stdout.split()
        own, most, seconds = map(float, found)
        rows.append({"lanes": n, "MB of its own": own, "MB with mapped files": most, "seconds": seconds})
    return rows


def picture(found: dict[str, Any]) -> plt.Figure:
    """Throughput against lanes, in memory by devices and in a folder; and what the size of chunks does."""
    figure, (left, right) = plt.subplots(1, 2, figsize=(11, 4.2), layout="constrained")
    rows = found["throughput"]
    for way, colour in (("devices=1", "C0"), ("devices=2", "C1")):
        own = [(row["lanes"], row["lanes a second"]) for row in rows if row["way"] == way]
        left.plot(*zip(*own), marker="o", color=colour, label=f"sweep, {way}")
    folder = [(row["lanes"], row["lanes"] / row["seconds"]) for row in found["memory"]]
    left.plot(
        *zip(*folder), marker="s", color="C2", linestyle="--", label="Sweep in a folder, one device, with compiling"
    )
    left.set(xscale="log", yscale="log", xlabel="lanes [-]", ylabel="throughput [lanes/s]")
    left.legend(fontsize="small", frameon=False, loc="lower right")
    every = {int(row["way"]): row["ratios"] for row in found["chunks"]}
    middle = [statistics.median(own) for own in every.values()]
    right.plot([*every], middle, marker="o", color="C0", label="median")
    low, high = zip(*(np.quantile(own, [0.25, 0.75]) for own in every.values()))
    right.fill_between([*every], low, high, color="C0", alpha=0.2, linewidth=0, label="half of the runs")
    right.set(xscale="log", xlabel="chunk [lanes]", ylabel="time, relative to chunks of 256 [-]", ylim=(0, None))
    right.set_xticks([*every], [str(n) for n in every])
    right.minorticks_off()
    right.legend(fontsize="small", frameon=False, loc="lower right")
    for ax in (left, right):
        ax.grid(True, which="major", color="0.9")
    return figure


def main() -> None:
    jax.config.update("jax_enable_x64", True)
    jax.config.update("jax_num_cpu_devices", 2)
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--lanes", type=int, default=32768)
    parser.add_argument("--block", type=int, default=8192, help="of the sweep in a folder whose overhead is measured")
    parser.add_argument("--chunks", type=int, nargs="+", default=[64, 128, 256, 512, 1024, 4096])
    parser.add_argument("--numbers", type=int, nargs="+", default=[10**i for i in range(7)])
    parser.add_argument("--memory", type=int, nargs="*", default=[100_000, 10_000_000])
    parser.add_argument("--parts", nargs="*", default=PARTS, help=f"of {', '.join(PARTS)}; others stay as they are")
    parser.add_argument("--repeats", type=int, default=5)
    parser.add_argument("--out", help="where to write the numbers as JSON, and the picture")
    args = parser.parse_args()
    found: dict[str, Any] = {}
    if args.out and pathlib.Path(args.out).exists():
        found = json.loads(pathlib.Path(args.out).read_text())
    unknown = set(args.parts) - set(PARTS)
    if unknown:
        parser.error(f"unknown parts: {', '.join(unknown)}")
    if args.parts:
        found["machine"] = machine()
    with tempfile.TemporaryDirectory() as root:
        parts = {
            "overhead": lambda: overhead(args.lanes, args.block, args.repeats, root),
            "order": lambda: order(args.lanes // 2, args.repeats),
            "chunks": lambda: chunks(args.lanes // 4, args.chunks, args.repeats),
            "throughput": lambda: throughput(args.numbers, args.repeats),
            "memory": lambda: memory(args.memory),
        }
        for name in args.parts:
            found[name] = parts[name]()
            print(f"\n### {name}\n")
            for row in found[name]:
                print(", ".join(f"{k} {v:.4g}" if isinstance(v, float) else f"{k} {v}" for k, v in row.items()
                                if not isinstance(v, list)), flush=True)  # fmt: skip
            if args.out:
                with open(args.out, "w") as file:
                    json.dump(found, file, indent=1)
    if args.out:
        picture(found).savefig(pathlib.Path(args.out).with_suffix(".png"), dpi=120)


if __name__ == "__main__":
    main()
