"""Sweeps of section 6.6, a mass between two visco-elastic stops, by the methods of nsjax in turns.

    python benchmarks/stops.py --out benchmarks/stops.json

4096 lanes, ω = 0.6 ... 1.5, from x = -0.9, v = 0.94 to t = 100, 2 to 79 events a lane. The stops have surfaces of two
components: contact is where a mass is in reach and the force presses. Prints a table in Markdown: medians of the
rounds, in each of which every method runs once; ratios to Dopri8 within a round; compile time apart. The error is that
of the final state against scipy's DOP853 with events, at a tolerance of 1e-13, on sixteen of the lanes.
"""

import argparse
import functools as ft
import json
from collections.abc import Callable
from typing import Any

import diffrax
import jax
import jax.numpy as jnp
import numpy as np
from peers import seconds_of
from scipy.integrate import solve_ivp
from sweep import machine

import nsjax
from nsjax.gallery import Motion, Trilinear


START, T1 = (-0.9, 0.94), 100.0
METHODS: dict[str, diffrax.AbstractSolver | None] = {
    "nsjax": None,
    "nsjax Tsit5": diffrax.Tsit5(),
    "nsjax Dopri8": diffrax.Dopri8(),
    "nsjax Taylor": nsjax.Taylor(),
}
BASELINE = "nsjax Dopri8"


def lane_of(solver: diffrax.AbstractSolver | None) -> Callable[[jax.Array], Any]:
    """What a user writes: the final state of one lane, and whether it succeeded."""

    def lane(omega: jax.Array) -> Any:
        how = dict(rtol=1e-10, atol=1e-10, max_steps=100_000, throw=False)
        sol = nsjax.solve(Trilinear(omega=omega), 0.0, T1, Motion(*START), solver=solver, **how)
        return jnp.stack(sol.y1), nsjax.is_okay(sol.result)

    return lane


def by_scipy(omega: float, c: float = 0.05, x_c: float = 1.0, k_f: float = 4.0, c_f: float = 0.5) -> np.ndarray:
    """The final state, mode by mode: 0 between the stops, ±1 at one of them."""

    def reaches(side: int, y: np.ndarray) -> tuple[float, float]:
        gap = side * y[0] - x_c
        return gap, k_f * gap + c_f * side * y[1]

    def force(side: int, y: np.ndarray) -> float:
        return side * reaches(side, y)[1] if side else 0.0

    def event(side: int, part: int | None) -> Any:
        def least(t: float, y: np.ndarray) -> float:
            return min(reaches(side, y)) if part is None else reaches(side, y)[part]

        least.terminal, least.direction = True, 1 if part is None else -1  # type: ignore[attr-defined]
        return least

    t, y, mode = 0.0, np.array(START), 0
    while t < T1:
        events = [event(1, None), event(-1, None)] if mode == 0 else [event(mode, 0), event(mode, 1)]

        def rhs(t: float, y: np.ndarray, mode: int = mode) -> list[float]:
            return [y[1], 0.2 * np.sin(omega * t) - c * y[1] - y[0] - force(mode, y)]

        accuracy = dict(rtol=1e-13, atol=1e-13, max_step=0.02)  # so short that no contact is missed
        sol: Any = solve_ivp(rhs, (t, T1), y, "DOP853", events=events, **accuracy)
        t, y = sol.t[-1], sol.y[:, -1]
        if sol.status == 1:
            mode = 0 if mode else (1 if len(sol.t_events[0]) else -1)
    return y


def main() -> None:
    jax.config.update("jax_enable_x64", True)
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--lanes", type=int, default=4096)
    parser.add_argument("--rounds", type=int, default=7)
    parser.add_argument("--out", help="where to write the numbers as JSON")
    args = parser.parse_args()
    omega = np.linspace(0.6, 1.5, args.lanes)
    few = np.linspace(0, args.lanes - 1, 16).astype(int)
    exact = np.stack([by_scipy(w) for w in omega[few]])
    first, errors, seconds = [], [], np.zeros((args.rounds, len(METHODS)))
    runs = [ft.partial(nsjax.sweep, lane_of(solver), jnp.asarray(omega)) for solver in METHODS.values()]
    for run in runs:
        time, (end, okay) = seconds_of(run)
        first.append(time)
        errors.append(float(np.abs(np.asarray(end)[few] - exact).max()))
        assert np.all(okay), f"{int(np.sum(~okay))} lanes failed"
    for row in seconds:
        row[:] = [seconds_of(run)[0] for run in runs]
    base = seconds[:, list(METHODS).index(BASELINE)]
    rows = [
        dict(
            method=name,
            lanes=args.lanes,
            seconds=float(np.median(s)),
            ratio=float(np.median(s / base)),
            first=f,
            error=e,
        )
        for name, s, f, e in zip(METHODS, seconds.T, first, errors)
    ]
    print("| method | seconds | to Dopri8 | first call, seconds | largest error |\n|---|---|---|---|---|")
    for r in rows:
        print(f"| {r['method']} | {r['seconds']:.3g} | {r['ratio']:.2f} | {r['first']:.1f} | {r['error']:.1e} |")
    if args.out:
        with open(args.out, "w") as file:
            json.dump({"machine": machine(), "rows": rows}, file, indent=1)


if __name__ == "__main__":
    main()
