"""Single precision and other devices: what a sweep costs there, and whether it says the same.

    python benchmarks/accelerator.py --out benchmarks/accelerator.json

Workloads S1, S2 and S3 (`workloads.py`) with the tolerances that nsjax chooses (1e-8, in single precision 1e-5), on
each platform that JAX finds, in processes of their own. All lanes are compared with double precision on the CPU:
the state at the end, the number of events, and how the solution ended. 4096 parameters are taken, each as often as
there are lanes for it, neighbours side by side.
"""

import argparse
import json
import os
import subprocess
import sys
import tempfile
import time
from typing import Any, NamedTuple

import diffrax
import jax
import jax.numpy as jnp
import matplotlib.pyplot as plt
import numpy as np
from sweep import Hammer, machine
from workloads import F_SLIP, HAMMER, K, SLIDER, T1, WORKLOADS

import nsjax
from nsjax.gallery import Motion, thesis


DIFFERENT = 4096  # parameters
CHUNK = 1_000_000  # lanes of a device other than the CPU that go together: more are no faster, and take more memory
SOLVERS = ("Tsit5", "Dopri8", "Taylor", "Affine")


class Row(NamedTuple):
    """Medians of `seconds`; compilation is `first` less these. `error` is the largest difference of a component of what
    is wanted from double precision on the CPU, of the lanes with the same events; `lanes_apart` says how many had other
    events, `statuses_apart` how many ended in another way."""

    workload: str
    solver: str
    device: str
    precision: str
    lanes: int
    seconds: float
    first: float
    error: float
    median_error: float
    lanes_apart: int
    statuses_apart: int


def places(lanes: int) -> np.ndarray:
    """Which of the parameters each lane has."""
    if lanes < DIFFERENT:
        return np.linspace(0, DIFFERENT - 1, lanes).astype(int)
    return np.sort(np.resize(np.arange(DIFFERENT), lanes))


def ensemble(workload: str, solver: str) -> Any:
    """A function of one lane: what is wanted, the number of events, how it ended."""
    method = getattr(nsjax, solver, None) or getattr(diffrax, solver)

    def final(system: nsjax.System, y0: Motion) -> Any:
        limits = dict(max_events=32, max_steps=100_000, throw=False)
        sol = nsjax.solve(system, 0.0, T1, jax.tree.map(jnp.asarray, y0), solver=method(), **limits)
        return jnp.stack(sol.y1), (sol.stats["num_events"], sol.result._value)

    def slider(v_dr: jax.Array) -> Any:
        return final(thesis("3.4", v_dr=v_dr), Motion(*SLIDER))

    def hammer(omega: jax.Array) -> Any:
        return final(Hammer(omega=omega), Motion(*HAMMER))

    def derivative(v_dr: jax.Array) -> Any:
        def of(q: jax.Array) -> Any:
            return final(thesis("3.4", v_dr=q[2], F_slip=q[3], k=q[4]), Motion(q[0], q[1]))

        return jax.jacfwd(of, has_aux=True)(jnp.array([*SLIDER, v_dr, F_SLIP, K]))

    return {"S1": slider, "S2": hammer, "S3": derivative}[workload]


def child(args: argparse.Namespace) -> None:
    """Times what is asked for on the platform that the environment says, and prints a line of JSON for each."""
    device = jax.devices()[0]
    kind = jnp.float64 if jax.config.read("jax_enable_x64") else jnp.float32
    exact = np.load(args.reference) if os.path.exists(args.reference) else {}
    kept = dict(exact)
    for solver in args.solver:
        for workload in args.workload:
            fn = ensemble(workload, solver)
            for lanes in args.lanes:
                if time.time() > args.until:
                    print(f"no time left for {workload}, {solver}, {lanes} lanes", file=sys.stderr, flush=True)
                    continue
                at = places(lanes)
                values = jnp.asarray(WORKLOADS[workload].sweep(DIFFERENT)[at], kind)
                chunk = None if device.platform == "cpu" else min(lanes, CHUNK)
                seconds = []
                for _ in range(1 + args.repeats):
                    start = time.perf_counter()
                    out = jax.block_until_ready(nsjax.sweep(fn, values, chunk=chunk))
                    seconds.append(time.perf_counter() - start)
                y, (events, result) = jax.tree.map(np.asarray, out)
                if workload not in kept and lanes == DIFFERENT:
                    kept |= {workload: y, f"{workload} events": events, f"{workload} result": result}
                wanted = {name: kept[f"{workload}{name}"][at] for name in ("", " events", " result")}
                same = events == wanted[" events"]
                error = np.abs(y - wanted[""]).reshape(lanes, -1).max(1)[same]
                again = seconds[1:] or seconds
                row = Row(
                    workload, solver, device.device_kind, kind.__name__, lanes, float(np.median(again)), seconds[0],
                    float(error.max(initial=0)), float(np.median(error)), int((~same).sum()),
                    int((result != wanted[" result"]).sum()),
                )  # fmt: skip
                print(json.dumps(row._asdict()), flush=True)
    if not exact:
        np.savez(args.reference, **kept)


def table(rows: list[dict[str, Any]]) -> str:
    lines = [
        "| | method | device | precision | lanes | seconds | lanes/s | first call [s] | error: median, largest | "
        "other events, statuses |",
        "|---|---|---|---|---|---|---|---|---|---|",
    ]
    lines += [
        f"| {r.workload} | {r.solver} | {r.device} | {r.precision} | {r.lanes} | {r.seconds:.3g} | "
        f"{r.lanes / r.seconds:.3g} | {r.first:.1f} | {r.median_error:.1e}, {r.error:.1e} | "
        f"{r.lanes_apart}, {r.statuses_apart} |"
        for r in map(lambda row: Row(**row), rows)
    ]
    return "\n".join(lines)


def picture(rows: list[dict[str, Any]]) -> plt.Figure:
    """Throughput of S1 by Taylor against the number of lanes."""
    figure, ax = plt.subplots(figsize=(6, 4), layout="constrained")
    own = sorted((r for r in map(lambda row: Row(**row), rows) if (r.workload, r.solver) == ("S1", "Taylor")), key=str)
    for i, device in enumerate(sorted({r.device for r in own})):
        for precision, line in (("float64", "-"), ("float32", "--")):
            here = sorted((r.lanes, r.lanes / r.seconds) for r in own if (r.device, r.precision) == (device, precision))
            if here:
                ax.plot(*zip(*here), line, marker="o", color=f"C{i}", label=f"{device}, {precision}")
    ax.set(xscale="log", yscale="log", xlabel="lanes [-]", ylabel="throughput [lanes/s]")
    ax.grid(True, which="major", color="0.9")
    ax.legend(fontsize="small", frameon=False)
    return figure


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--workload", nargs="+", default=["S1"], choices=("S1", "S2", "S3"))
    parser.add_argument("--solver", nargs="+", default=["Tsit5", "Taylor", "Affine"], choices=SOLVERS)
    parser.add_argument("--lanes", type=int, nargs="+", default=[1000, 4096, 100_000, 1_000_000, 10_000_000])
    parser.add_argument("--platform", nargs="+", default=["cpu"], help="of JAX: cpu, cuda")
    parser.add_argument("--precision", nargs="+", default=["float64", "float32"], choices=("float64", "float32"))
    parser.add_argument("--most", type=int, default=4096, help="lanes on the CPU")
    parser.add_argument("--repeats", type=int, default=3)
    parser.add_argument("--seconds", type=float, default=1e9, help="after which nothing new is begun")
    parser.add_argument("--out", help="where to write the numbers as JSON, and the picture")
    parser.add_argument("--until", type=float, help=argparse.SUPPRESS)
    parser.add_argument("--reference", help=argparse.SUPPRESS)
    args = parser.parse_args()
    if args.until is not None:
        return child(args)
    until = time.time() + args.seconds
    rows: list[dict[str, Any]] = []
    with tempfile.TemporaryDirectory() as folder:
        runs = [(p, x) for p in args.platform for x in args.precision]
        reference = [("cpu", "float64", ["Dopri8"], [DIFFERENT])]
        few = [n for n in args.lanes if n <= args.most]
        own = [(p, x, args.solver, few if p == "cpu" else args.lanes) for p, x in runs]
        for platform, precision, solvers, lanes in reference + own:
            environment = os.environ | {
                "JAX_PLATFORMS": platform if platform == "cpu" else f"{platform},cpu",
                "JAX_ENABLE_X64": str(int(precision == "float64")),
            }
            command = [sys.executable, __file__, "--until", str(until), "--reference", f"{folder}/reference.npz"]
            command += ["--workload", *args.workload, "--solver", *solvers, "--lanes", *map(str, lanes)]
            command += ["--repeats", str(args.repeats)]
            with subprocess.Popen(command, env=environment, stdout=subprocess.PIPE, text=True) as process:
                for line in process.stdout or ():
                    rows.append(json.loads(line))
                    print(table(rows[-1:]).splitlines()[-1], flush=True)
                    if args.out:
                        with open(args.out, "w") as file:
                            json.dump({"machine": machine(), "rows": rows}, file, indent=1)
            if process.returncode:
                print(f"{platform}, {precision}: ended with {process.returncode}", flush=True)
    print(f"\n{table(rows)}")
    if args.out:
        picture(rows).savefig(os.path.splitext(args.out)[0] + ".png", dpi=120)


if __name__ == "__main__":
    main()
