"""The sweep S1 by nsjax and by its peers in one run: seconds against the error that was measured.

    python benchmarks/sweep.py --out benchmarks/sweep.json

Prints a table in Markdown. Each row is the median of `--repeats` runs, compile time apart; the error is the largest
component of the final state against the closed form, over all lanes.
"""

import argparse
import functools as ft
import json
import os
import platform
import statistics
import time
from importlib.metadata import version
from typing import Any

import diffrax
import jax
import jax.numpy as jnp
import numpy as np
import peers
from peers import belt_velocities, measure, Measured, reference

import nsjax
from nsjax.gallery import Motion, thesis


def nsjax_lane(v_dr: jax.Array, *, tol: float, solver: diffrax.AbstractSolver) -> tuple[Any, jax.Array, jax.Array]:
    """What a user of nsjax writes for one lane."""
    sol = nsjax.solve(
        thesis("3.4", v_dr=v_dr),
        0.0,
        peers.T1,
        Motion(peers.X0, peers.V0),
        solver=solver,
        stepsize_controller=diffrax.PIDController(rtol=tol, atol=tol),
        max_events=32,
        throw=False,
    )
    return sol.y1, sol.stats["num_events"], sol.stats["num_steps"]


def measure_nsjax(
    tol: float, solver: diffrax.AbstractSolver, v_dr: np.ndarray, *, batch: int | None, repeats: int
) -> Measured:
    lanes = jnp.asarray(v_dr)
    lane = ft.partial(nsjax_lane, tol=tol, solver=solver)
    sweep = jax.jit(jax.vmap(lane) if batch is None else lambda v: jax.lax.map(lane, v, batch_size=batch))
    start = time.perf_counter()
    compiled = sweep.lower(lanes).compile()
    compile_seconds = time.perf_counter() - start
    seconds = []
    for _ in range(repeats):
        start = time.perf_counter()
        y1, events, steps = jax.block_until_ready(compiled(lanes))
        seconds.append(time.perf_counter() - start)
    error = np.abs(np.stack(y1, axis=1) - reference.stick_slip_final(v_dr))
    assert events.min() >= 8 and events.max() <= 30
    name = f"nsjax {type(solver).__name__}" + (f"/{batch}" if batch else "")
    worst, median = float(error.max()), float(np.median(error))
    return Measured(name, tol, len(v_dr), statistics.median(seconds), compile_seconds, worst, median)


def table(rows: list[Measured]) -> str:
    lines = ["| code | tolerance | seconds | compile [s] | largest error |", "|---|---|---|---|---|"]
    lines += [
        f"| {r.peer} | {r.tol:.0e} | {r.seconds:.3g} | {r.compile_seconds:.1f} | {r.max_error:.1e} |" for r in rows
    ]
    return "\n".join(lines)


def machine() -> dict[str, Any]:
    packages = ("jax", "jaxlib", "diffrax", "optimistix", "equinox", "scipy", "numpy")
    return {
        "processor": platform.machine(),
        "cores": os.cpu_count(),
        "python": platform.python_version(),
        **{p: version(p) for p in packages},
    }


def main() -> None:
    jax.config.update("jax_enable_x64", True)
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--lanes", type=int, default=4096)
    parser.add_argument("--scipy-lanes", type=int, default=8, help="scipy runs so many; its time is scaled to all")
    parser.add_argument("--batch", type=int, default=256, help="chunks for nsjax and diffrax")
    parser.add_argument("--repeats", type=int, default=5)
    parser.add_argument("--out", help="where to write the numbers as JSON")
    args = parser.parse_args()
    v_dr = belt_velocities(args.lanes)
    rows = []
    for tol in (1e-8, 1e-10, 1e-12):
        for batch in (None, args.batch):
            for solver in (diffrax.Tsit5(), diffrax.Dopri8()):
                rows.append(measure_nsjax(tol, solver, v_dr, batch=batch, repeats=args.repeats))
            rows.append(measure("diffrax", tol, v_dr, repeats=args.repeats, batch_size=batch))
    rows.append(measure("heyoka", 1e-10, v_dr, repeats=3))
    few = belt_velocities(args.scipy_lanes)
    scipy = measure("DOP853", 1e-10, few, repeats=1)
    rows.append(scipy._replace(seconds=scipy.seconds * args.lanes / args.scipy_lanes, lanes=args.lanes))
    print(table(rows))
    if args.out:
        with open(args.out, "w") as file:
            json.dump({"machine": machine(), "rows": [r._asdict() for r in rows]}, file, indent=1)


if __name__ == "__main__":
    main()
