"""The workloads S1, S2, S3 (`workloads.py`) by nsjax and by its peers in one run: seconds against the measured error.

    python benchmarks/sweep.py --out benchmarks/sweep.json

Prints a table in Markdown for each workload: medians of the rounds, in each of which every code runs once (what is slow
in the first three only), ratios to heyoka's batches within a round, compile time apart. The error is the largest
component of what is wanted against the reference, over all lanes.
"""

import argparse
import functools as ft
import json
import os
import platform
from collections.abc import Callable
from importlib.metadata import PackageNotFoundError, version
from typing import Any

import diffrax
import jax
import jax.numpy as jnp
import numpy as np
from peers import Code, code_of, count_lines, HEAD, in_chunks, in_turns, line, Measured, unpack_checked
from workloads import F_SLIP, HAMMER, K, SLIDER, T1, WORKLOADS

import nsjax
from nsjax.gallery import Motion, StickSlip, thesis


class Hammer(nsjax.System):
    """x'' + 0.02 x' + x = cos ωt with a wall at x = 0.5 and restitution 0.8."""

    omega: float = 2.8

    def vector_field(self, t, y, s):
        return Motion(y.v, jnp.cos(self.omega * t) - 0.02 * y.v - y.x - s.wall)

    @nsjax.impact
    def wall(self, t, y):
        return 0.5 - y.x

    @wall.restitution
    def wall(self):
        return 0.8


# What a user of nsjax writes for one lane: the final state or its derivative, and whether it succeeded.


def final(system: nsjax.System, y0: Motion, tol: float, **how: Any) -> tuple[Motion, jax.Array]:
    limits = dict(max_events=32, max_steps=100_000, throw=False)
    sol = nsjax.solve(system, 0.0, T1, y0, rtol=tol, atol=tol, **limits, **how)
    return sol.y1, nsjax.is_okay(sol.result)


def slider_lane(v_dr: jax.Array, **options: Any) -> tuple[Motion, jax.Array]:
    return final(thesis("3.4", v_dr=v_dr), Motion(*SLIDER), **options)


def hammer_lane(omega: jax.Array, **options: Any) -> tuple[Motion, jax.Array]:
    return final(Hammer(omega=omega), Motion(*HAMMER), **options)


def derivative_lane(v_dr: jax.Array, **options: Any) -> tuple[jax.Array, jax.Array]:
    def of(q: jax.Array) -> tuple[jax.Array, jax.Array]:
        y1, ok = final(thesis("3.4", v_dr=q[2], F_slip=q[3], k=q[4]), Motion(q[0], q[1]), **options)
        return jnp.stack(y1), ok

    return jax.jacfwd(of, has_aux=True)(jnp.array([*SLIDER, v_dr, F_SLIP, K]))


TOLERANCES = {"S1": 1e-10, "S2": 1e-10, "S3": 1e-12}
LANES: dict[str, tuple[Callable[..., Any], type]] = {
    "S1": (slider_lane, StickSlip),
    "S2": (hammer_lane, Hammer),
    "S3": (derivative_lane, StickSlip),
}


def own_codes(workload: str, tols: list[float], values: np.ndarray, batch: int | None) -> list[Code]:
    """Each method one program for all tolerances; those whose error does not depend on it with the smallest."""
    lanes = jnp.asarray(values)
    by_hand, model = LANES[workload]
    lines = count_lines((model, final, by_hand))
    codes = []
    for solver in (None, diffrax.Tsit5(), diffrax.Dopri8(), nsjax.Taylor(), nsjax.Exponential()):

        def lane(p: jax.Array, tol: jax.Array, solver: diffrax.AbstractSolver | None = solver) -> Any:
            return by_hand(p, tol=tol, solver=solver)

        name = in_chunks("nsjax" if solver is None else f"nsjax {type(solver).__name__}", batch)
        for tol in [min(tols)] if solver is None or isinstance(solver, nsjax.Exponential) else tols:
            run = ft.partial(nsjax.sweep, lane, lanes, jnp.asarray(tol), chunk=batch or len(values))
            codes.append(Code(name, tol, values, lines, lambda run=run: run, unpack_checked))
    return codes


def measure_all(workload: str, args: argparse.Namespace) -> list[Measured]:
    values, few = (WORKLOADS[workload].sweep(n) for n in (args.lanes, args.scipy_lanes))
    tols = args.tol or [TOLERANCES[workload]]
    codes = [code_of(peer, workload, tol, values) for peer in ("heyoka", "heyoka-batch") for tol in tols]
    for batch in [b or None for b in args.batch]:
        codes += own_codes(workload, tols, values, batch)
        codes += [code_of("diffrax", workload, tol, values, batch) for tol in tols]
    codes.append(code_of("DOP853", workload, min(tols), few))
    return in_turns(workload, codes, rounds=args.rounds, patience=args.patience)


def processor() -> str:
    """Its name, as far as the system tells."""
    try:
        with open("/proc/cpuinfo") as file:
            names = [line.partition(":")[2].strip() for line in file if line.startswith("model name")]
    except OSError:
        names = []
    return names[0] if names else platform.processor() or platform.machine()


def machine() -> dict[str, Any]:
    found = {"processor": processor(), "cores": os.cpu_count(), "python": platform.python_version()}
    for package in ("jax", "jaxlib", "diffrax", "optimistix", "equinox", "scipy", "numpy", "heyoka"):
        try:
            found[package] = version(package)
        except PackageNotFoundError:  # heyoka, for those who only import this function
            continue
    return found


def main() -> None:
    jax.config.update("jax_enable_x64", True)
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--workload", nargs="+", default=list(WORKLOADS), choices=WORKLOADS)
    parser.add_argument("--lanes", type=int, default=4096)
    parser.add_argument("--scipy-lanes", type=int, default=8, help="scipy runs so many; its time is scaled to all")
    parser.add_argument("--batch", type=int, nargs="+", default=[256], help="chunks of nsjax and diffrax; 0: vmap")
    parser.add_argument("--tol", type=float, nargs="+", help="instead of 1e-10 (S1, S2) and 1e-12 (S3)")
    parser.add_argument("--rounds", type=int, default=7)
    parser.add_argument("--patience", type=float, default=6.0, help="seconds of one code, beyond its first three runs")
    parser.add_argument("--out", help="where to write the numbers as JSON")
    args = parser.parse_args()
    rows = []
    for workload in args.workload:
        rows += (found := measure_all(workload, args))
        print(f"\n### {workload}, {args.lanes} lanes\n\n{HEAD}")
        print(*(line(row, args.lanes) for row in found), sep="\n", flush=True)
    if args.out:
        with open(args.out, "w") as file:
            json.dump({"machine": machine(), "rows": [r._asdict() for r in rows]}, file, indent=1)


if __name__ == "__main__":
    main()
