"""Periodic orbits a second: a thousand at once, each with its Floquet multipliers, by both formulations.

    python benchmarks/orbits.py --out benchmarks/orbits.json

The stick-slip orbits of section 3.4, v_dr = linspace(0.1, 0.9), from x = 2, v = 0 and the period 2.2 / v_dr + 3.4;
error of the period against its closed form. scipy: DOP853 with a terminal event, and fsolve with its difference
quotients, on a few lanes; its time is scaled.
"""

import argparse
import json
import time
from typing import Any, NamedTuple

import diffrax
import jax
import jax.numpy as jnp
import numpy as np
from peers_scipy import stick_slip
from program import measure
from scipy.integrate import solve_ivp
from scipy.optimize import fsolve
from sweep import machine

import nsjax
from nsjax.gallery import Motion, StickSlip


import reference  # isort: skip  # of the tests, whose folder `workloads` makes known


class Row(NamedTuple):
    code: str
    found: int  # lanes
    compile_seconds: float
    seconds: float  # of all lanes
    per_second: float
    error: float


def options(solver: diffrax.AbstractSolver, tol: float) -> dict[str, Any]:
    controller = diffrax.PIDController(rtol=tol, atol=tol)
    return dict(solver=solver, stepsize_controller=controller, max_steps=1024, max_events=8, throw=False)


def search(v_dr: Any, **how: Any) -> nsjax.Orbit:
    return nsjax.find_orbit(StickSlip(v_dr=v_dr), Motion(2.0, 0.0), period=2.2 / v_dr + 3.4, **how)


def by_scipy(v_dr: float, tol: float) -> float:
    """The period of section 3.4, by shooting from (x0, 0) on x0 and the period."""
    model = stick_slip(v_dr)

    def flow(x0: float, period: float) -> np.ndarray:
        t, y, s = 0.0, np.array([x0, 0.0]), -1
        while t < period:

            def guard(t: float, y: np.ndarray, s: int) -> float:
                return model.guard(t, y, s)

            guard.terminal, guard.direction = True, 1.0
            sol = solve_ivp(model.field, (t, period), y, method="DOP853", args=(s,), rtol=tol, atol=tol, events=guard)
            t, y = sol.t[-1], sol.y[:, -1]
            if sol.status == 1:
                y, s = model.change(y, s)
        return y

    (_, period), _, _, _ = fsolve(lambda z: flow(*z) - [z[0], 0.0], [2.0, 2.2 / v_dr + 3.4], full_output=True)
    return float(period)


CODES = {
    "shooting, Dopri8": ("shooting", diffrax.Dopri8(), 1e-10),
    "shooting, Taylor": ("shooting", nsjax.Taylor(), 1e-12),
    "segments, Dopri8": ("segments", diffrax.Dopri8(), 1e-10),
}

HEAD = "| code | found | compile [s] | seconds | orbits/s | error |\n|---|---|---|---|---|---|"


def line(r: Row) -> str:
    return f"| {r.code} | {r.found} | {r.compile_seconds:.0f} | {r.seconds:.3g} | {r.per_second:.3g} | {r.error:.1e} |"


def main() -> None:
    jax.config.update("jax_enable_x64", True)
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--lanes", type=int, default=1000)
    parser.add_argument("--scipy-lanes", type=int, default=20)
    parser.add_argument("--repeats", type=int, default=5)
    parser.add_argument("--out", help="where to write the numbers as JSON")
    args = parser.parse_args()
    rows = []
    print(HEAD)
    values = np.linspace(0.1, 0.9, args.lanes)
    for code, (method, solver, tol) in CODES.items():
        how = options(solver, tol) | dict(method=method)

        def lane(v_dr: Any, how: Any = how) -> Any:
            orbit = search(v_dr, **how)
            return orbit.y0, orbit.period, orbit.multipliers, nsjax.is_okay(orbit.result)

        (program,) = measure([(lambda p, fn=lane: nsjax.sweep(fn, p), (jnp.asarray(values),))], args.repeats)
        _, period, _, okay = jax.tree.map(np.asarray, program.out)
        wrong = float(np.max(np.abs(period - reference.stick_slip_period(values))[okay]))
        rate = args.lanes / program.seconds
        rows.append(Row(code, int(okay.sum()), program.compile_seconds, program.seconds, rate, wrong))
        print(line(rows[-1]), flush=True)
    few = np.linspace(0.1, 0.9, args.scipy_lanes)
    start = time.perf_counter()
    periods = np.array([by_scipy(float(v), 1e-10) for v in few])
    seconds = (time.perf_counter() - start) / args.scipy_lanes
    wrong = np.abs(periods - reference.stick_slip_period(few))
    found = wrong < 1e-6  # the others went astray
    share, worst = float(np.mean(found)), float(np.max(wrong[found], initial=0.0))
    rows.append(Row("scipy", round(share * args.lanes), 0.0, seconds * args.lanes, 1 / seconds, worst))
    print(line(rows[-1]))
    if args.out:
        with open(args.out, "w") as file:
            json.dump({"machine": machine(), "lanes": args.lanes, "rows": [r._asdict() for r in rows]}, file, indent=1)


if __name__ == "__main__":
    main()
