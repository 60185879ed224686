"""nsjax and heyoka in turns, in one process: ratios that hold on a machine whose speed wanders.

    python benchmarks/sweep_turns.py --out benchmarks/sweep_turns.json

The workloads S1, S2 (tolerance 1e-10) and S3 (1e-12) of `sweep.py`, 4096 lanes, chunks of 256. In each round every
method runs once; of each the median of its ratios to heyoka's batches in the same round, the ratio of the least times,
and what the first call takes, compilation included.
"""

import argparse
import json
import time
from collections.abc import Callable
from typing import Any

import diffrax
import jax
import jax.numpy as jnp
import numpy as np
import peers_heyoka
from peers import WIDTH
from sweep import LANES, machine
from workloads import WORKLOADS

import nsjax


TOLERANCE = {"S1": 1e-10, "S2": 1e-10, "S3": 1e-12}
PEER = "heyoka"


def runs_of(workload: str, number: int) -> dict[str, Callable[[], Any]]:
    values, tol, (by_hand, _) = WORKLOADS[workload].sweep(number), TOLERANCE[workload], LANES[workload]
    lanes, batches = jnp.asarray(values), peers_heyoka.ensemble(workload, tol=tol, width=WIDTH)
    runs: dict[str, Callable[[], Any]] = {PEER: lambda: batches(values)}
    for solver in (diffrax.Dopri8(), nsjax.Taylor(), nsjax.Affine()):

        def lane(p: jax.Array, tol: jax.Array, solver: Any = solver) -> Any:
            return by_hand(p, tol=tol, solver=solver)

        runs[type(solver).__name__] = lambda lane=lane: nsjax.sweep(lane, lanes, jnp.asarray(tol), chunk=256)
    return runs


def seconds_of(run: Callable[[], Any]) -> float:
    start = time.perf_counter()
    jax.block_until_ready(run())
    return time.perf_counter() - start


def measured(workload: str, number: int, rounds: int) -> list[dict[str, Any]]:
    runs = runs_of(workload, number)
    first = {name: seconds_of(run) for name, run in runs.items()}
    each = [{name: seconds_of(run) for name, run in runs.items()} for _ in range(rounds)]
    of = {name: np.array([one[name] for one in each]) for name in runs}
    return [
        dict(
            workload=workload, method=name, seconds=float(np.median(s)), first=first[name],
            ratio=float(np.median(s / of[PEER])), of_least=float(s.min() / of[PEER].min()),
        )
        for name, s in of.items()
    ]  # fmt: skip


def main() -> None:
    jax.config.update("jax_enable_x64", True)
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--workload", nargs="+", default=list(TOLERANCE), choices=TOLERANCE)
    parser.add_argument("--lanes", type=int, default=4096)
    parser.add_argument("--rounds", type=int, default=11)
    parser.add_argument("--out", help="where to write the numbers as JSON")
    args = parser.parse_args()
    rows = [row for workload in args.workload for row in measured(workload, args.lanes, args.rounds)]
    print("| | method | seconds | ratio to heyoka: median, of the least | first call [s] |\n|---|---|---|---|---|")
    for row in rows:
        figures = f"{row['seconds']:.3g} | {row['ratio']:.2f}, {row['of_least']:.2f} | {row['first']:.1f}"
        print(f"| {row['workload']} | {row['method']} | {figures} |")
    if args.out:
        with open(args.out, "w") as file:
            json.dump({"machine": machine(), "rows": rows}, file, indent=1)


if __name__ == "__main__":
    main()
