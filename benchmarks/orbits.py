"""Periodic orbits a second: a thousand at once, each with its Floquet multipliers, by both formulations.

    python benchmarks/orbits.py --out benchmarks/orbits.json

Autonomous: section 3.4, v_dr = linspace(0.1, 1), from x = 2, v = 0 and the period 2.2 / v_dr + 3.4; error of the period
against its closed form. Forced: section 6.6, ω = linspace(1.12, 1.18), from (-0.9, 0.94); error of the state at t = 0
against 40-digit orbits at five of the lanes. scipy: DOP853 with a terminal event, and fsolve with its difference
quotients, on a few lanes; its time is scaled.
"""

import argparse
import json
import time
from collections.abc import Callable
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
from nsjax.gallery import Motion, StickSlip, Trilinear


import reference  # isort: skip  # of the tests, whose folder `workloads` makes known
from orbit_reference import trilinear_orbit  # isort: skip


class Row(NamedTuple):
    system: str
    code: str
    found: int  # lanes
    compile_seconds: float
    seconds: float  # of all lanes
    per_second: float
    error: float


def options(solver: diffrax.AbstractSolver, tol: float) -> dict[str, Any]:
    controller = diffrax.PIDController(rtol=tol, atol=tol)
    return dict(solver=solver, stepsize_controller=controller, max_steps=1024, max_events=8, throw=False)


def autonomous(v_dr: Any, **how: Any) -> nsjax.Orbit:
    return nsjax.find_orbit(StickSlip(v_dr=v_dr), Motion(2.0, 0.0), period=2.2 / v_dr + 3.4, **how)


def forced(omega: Any, **how: Any) -> nsjax.Orbit:
    return nsjax.find_orbit(Trilinear(omega=omega), Motion(-0.9, 0.94), **how)


def period_error(v_dr: np.ndarray, orbits: Any) -> float:
    return float(np.max(np.abs(orbits.period - reference.stick_slip_period(v_dr))))


def state_error(omega: np.ndarray, orbits: Any) -> float:
    lanes = np.linspace(0, len(omega) - 1, 5).astype(int)
    exact = np.array([trilinear_orbit("contact", float(omega[i])).y0 for i in lanes])
    return float(np.max(np.abs(np.column_stack([orbits.y0.x, orbits.y0.v])[lanes] - exact)))


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


SYSTEMS: dict[str, tuple[Callable[..., Any], Callable[[int], np.ndarray], Callable[..., float]]] = {
    "3.4": (autonomous, lambda n: np.linspace(0.1, 1.0, n), period_error),
    "6.6": (forced, lambda n: np.linspace(1.12, 1.18, n), state_error),
}
CODES = {
    "shooting, Dopri8": ("shooting", diffrax.Dopri8(), 1e-10),
    "shooting, Taylor": ("shooting", nsjax.Taylor(), 1e-12),
    "segments, Dopri8": ("segments", diffrax.Dopri8(), 1e-10),
}

HEAD = "| system | code | found | compile [s] | seconds | orbits/s | error |\n|---|---|---|---|---|---|---|"


def line(r: Row) -> str:
    return (
        f"| {r.system} | {r.code} | {r.found} | {r.compile_seconds:.0f} | {r.seconds:.3g} | {r.per_second:.3g} "
        f"| {r.error:.1e} |"
    )


def main() -> None:
    jax.config.update("jax_enable_x64", True)
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--lanes", type=int, default=1000)
    parser.add_argument("--scipy-lanes", type=int, default=5)
    parser.add_argument("--repeats", type=int, default=5)
    parser.add_argument("--out", help="where to write the numbers as JSON")
    args = parser.parse_args()
    rows = []
    print(HEAD)
    for system, (search, parameters, error) in SYSTEMS.items():
        values = parameters(args.lanes)
        for code, (method, solver, tol) in CODES.items():
            how = options(solver, tol) | dict(method=method)

            def lane(value: Any, search: Any = search, how: Any = how) -> Any:
                orbit = search(value, **how)
                return orbit.y0, orbit.period, orbit.multipliers, nsjax.is_okay(orbit.result)

            program = measure(lambda p, fn=lane: nsjax.sweep(fn, p), jnp.asarray(values), repeats=args.repeats)
            y0, period, _, okay = jax.tree.map(np.asarray, program.out)
            found = Found(Motion(y0.x[okay], y0.v[okay]), period[okay])
            wrong = error(values[okay], found)
            rate = args.lanes / program.seconds
            rows.append(Row(system, code, int(okay.sum()), program.compile_seconds, program.seconds, rate, wrong))
            print(line(rows[-1]), flush=True)
    values = SYSTEMS["3.4"][1](args.scipy_lanes)
    start = time.perf_counter()
    periods = np.array([by_scipy(float(v), 1e-10) for v in values])
    seconds = (time.perf_counter() - start) / args.scipy_lanes
    wrong = float(np.max(np.abs(periods - reference.stick_slip_period(values))))
    rows.append(Row("3.4", "scipy", args.scipy_lanes, 0.0, seconds * args.lanes, 1 / seconds, wrong))
    print(line(rows[-1]))
    if args.out:
        with open(args.out, "w") as file:
            json.dump({"machine": machine(), "lanes": args.lanes, "rows": [r._asdict() for r in rows]}, file, indent=1)


class Found(NamedTuple):
    y0: Motion
    period: np.ndarray


if __name__ == "__main__":
    main()
