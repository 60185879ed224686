"""Sweeps of friction laws that are no constant, and of forced friction, by the methods of nsjax and by heyoka in turns.

    python benchmarks/friction.py --out benchmarks/friction.json

- 2.4: stick-slip of section 2.4 with the friction force F_s / (1 + δ |v_rel|), written with `jnp.abs`,
  v_dr = 0.1 ... 0.5, from (2.5, -0.5).
- 6.8: the forced mass with dry friction of section 6.8, which sticks up to twice the force of slip, ω = 0.4 ... 0.8,
  from (3, 1).

4096 lanes each, to t = 100. Prints a table in Markdown for each: medians of the rounds, in each of which every method
runs once; ratios to heyoka's batches within a round; compile time apart. The error is that of the final state against
heyoka at a tolerance of 1e-15, which three lanes of scipy's DOP853 are held against; a lane that one of them takes
through other events is counted apart.
"""

import argparse
import functools as ft
import json
from collections.abc import Callable
from typing import Any, NamedTuple

import diffrax
import jax
import jax.numpy as jnp
import numpy as np
import peers_scipy
from peers import seconds_of
from sweep import machine
from workloads import T1

import nsjax
from nsjax.gallery import ForcedFriction, Motion


F_S, DELTA = 1.0, 3.0  # of section 2.4; k = m = 1
DAMPING, AMPLITUDE, SLIP, STICK = 0.01, 2.5, 1.0, 2.0  # of section 6.8; k = m = 1
METHODS: dict[str, tuple[diffrax.AbstractSolver | None, float]] = {
    "nsjax": (None, 1e-8),
    "nsjax Tsit5": (diffrax.Tsit5(), 1e-10),
    "nsjax Dopri8": (diffrax.Dopri8(), 1e-10),
    "nsjax Taylor": (nsjax.Taylor(), 1e-11),
}
BASELINE = "heyoka-batch"
ALIKE = 1e-3  # a lane that differs by more went through other events


class Stribeck(nsjax.System):
    v_dr: float = 0.2

    def vector_field(self, t, y, s):
        return Motion(y.v, -y.x - F_S / (1 + DELTA * jnp.abs(y.v - self.v_dr)) * s.belt)

    @nsjax.sgn
    def belt(self, t, y):
        return y.v - self.v_dr


class Sweep(NamedTuple):
    """What is swept. `field`, `guard` and `change` are those of `peers_heyoka` and `peers_scipy`: the mode s is 0 for
    stick and else the sign of the sliding velocity, and the last state is the time."""

    model: Callable[[Any], nsjax.System]
    values: Callable[[int], np.ndarray]
    start: tuple[float, float]
    side: int
    field: Callable[..., list[Any]]
    guard: Callable[..., Any]
    change: Callable[..., tuple[float, float]]


def falling_field(y: Any, s: Any, v_dr: Any, cos: Any) -> list[Any]:
    x, v, t = y
    return [v, s * s * (-x - s * F_S / (1.0 + DELTA * s * (v - v_dr))), 0.0 * t + 1.0]


def falling_guard(y: Any, s: Any, v_dr: Any, cos: Any) -> Any:
    x, v, _ = y
    return -s * (v - v_dr) + (1.0 - s * s) * (x - F_S)


def falling_change(y: Any, s: float, v_dr: float) -> tuple[float, float]:
    """The velocity and the mode after an event."""
    return v_dr, (-1.0 if s == 0 else 0.0 if abs(y[0]) <= F_S else -s)


def load(x: Any, t: Any, omega: Any, cos: Any) -> Any:
    return AMPLITUDE * cos(omega * t) - x


def forced_field(y: Any, s: Any, omega: Any, cos: Any) -> list[Any]:
    x, v, t = y
    return [v, s * s * (load(x, t, omega, cos) - DAMPING * v - s * SLIP), 0.0 * t + 1.0]


def forced_guard(y: Any, s: Any, omega: Any, cos: Any) -> Any:
    x, v, t = y
    return -s * v + (1.0 - s * s) * (load(x, t, omega, cos) ** 2.0 - STICK**2)


def forced_change(y: Any, s: float, omega: float) -> tuple[float, float]:
    push = load(y[0], y[2], omega, np.cos)
    return 0.0, (float(np.sign(push)) if s == 0 or abs(push) > STICK else 0.0)


SWEEPS = {
    "2.4": Sweep(
        lambda v_dr: Stribeck(v_dr=v_dr), lambda n: np.linspace(0.1, 0.5, n), (2.5, -0.5), -1,
        falling_field, falling_guard, falling_change,
    ),
    "6.8": Sweep(
        lambda omega: ForcedFriction(omega=omega), lambda n: np.linspace(0.4, 0.8, n), (3.0, 1.0), 1,
        forced_field, forced_guard, forced_change,
    ),
}  # fmt: skip


def lane_of(sweep: Sweep, solver: diffrax.AbstractSolver | None, tol: float) -> Callable[[jax.Array], Any]:
    """What a user writes: the final state of one lane, and whether it succeeded."""

    def lane(value: jax.Array) -> Any:
        how = {} if solver is None else dict(solver=solver, rtol=tol, atol=tol)
        sol = nsjax.solve(sweep.model(value), 0.0, T1, Motion(*sweep.start), max_steps=100_000, throw=False, **how)
        return jnp.stack(sol.y1), nsjax.is_okay(sol.result)

    return lane


def by_heyoka(sweep: Sweep, tol: float) -> Callable[[np.ndarray], np.ndarray]:
    import heyoka as hy
    import peers_heyoka

    state = hy.make_vars("x", "v", "t")
    value, s = hy.par[0], hy.par[1]

    def change(y: np.ndarray, p: np.ndarray) -> None:
        y[1], p[1] = sweep.change(y, p[1], p[0])

    field = list(zip(state, sweep.field(state, s, value, hy.cos)))
    start = [*sweep.start, 0.0], [0.0, float(sweep.side)]
    model = peers_heyoka.Model(field, sweep.guard(state, s, value, hy.cos), change, *start)
    run = peers_heyoka.batch(model, tol, 8)
    return lambda values: run(values)[:, :2]


def by_scipy(sweep: Sweep, value: float) -> np.ndarray:
    def change(y: np.ndarray, s: int) -> tuple[np.ndarray, int]:
        v, after = sweep.change(y, s, value)
        return np.array([y[0], v, y[2]]), int(after)

    model = peers_scipy.Model(
        lambda t, y, s: sweep.field(y, s, value, np.cos), lambda t, y, s: sweep.guard(y, s, value, np.cos), change,
        np.array([*sweep.start, 0.0]), sweep.side,
    )  # fmt: skip
    return peers_scipy.lane(model, method="DOP853", tol=1e-13)[:2]


def measure(name: str, lanes: int, rounds: int) -> list[dict[str, Any]]:
    sweep = SWEEPS[name]
    values = sweep.values(lanes)
    exact = by_heyoka(sweep, 1e-15)(values)
    for i in (0, lanes // 2, lanes - 1):
        error = np.abs(by_scipy(sweep, values[i]) - exact[i]).max()
        assert error < 1e-8, f"The reference of {name} at {values[i]} is wrong by {error:.1e}."
    runs: dict[str, Callable[[], Any]] = {
        method: ft.partial(nsjax.sweep, lane_of(sweep, *how), jnp.asarray(values)) for method, how in METHODS.items()
    }
    fast = by_heyoka(sweep, 1e-11)
    runs[BASELINE] = lambda: (fast(values), np.ones(lanes, bool))
    first, errors, seconds = [], [], np.zeros((rounds, len(runs)))
    for run in runs.values():
        time, (end, okay) = seconds_of(run)
        first.append(time)
        errors.append(np.abs(np.asarray(end) - exact).max(1))
        assert np.all(okay), f"{int(np.sum(~okay))} lanes failed"
    for row in seconds:
        row[:] = [seconds_of(run)[0] for run in runs.values()]
    base = seconds[:, list(runs).index(BASELINE)]
    return [
        dict(
            sweep=name, method=method, lanes=lanes, seconds=float(np.median(s)), ratio=float(np.median(s / base)),
            first=f, error=float(e[e < ALIKE].max()), other_events=int(np.sum(e >= ALIKE)),
        )
        for method, s, f, e in zip(runs, seconds.T, first, errors)
    ]  # fmt: skip


def main() -> None:
    jax.config.update("jax_enable_x64", True)
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--sweep", nargs="+", default=list(SWEEPS), choices=SWEEPS)
    parser.add_argument("--lanes", type=int, default=4096)
    parser.add_argument("--rounds", type=int, default=5)
    parser.add_argument("--out", help="where to write the numbers as JSON")
    args = parser.parse_args()
    rows = []
    for name in args.sweep:
        rows += (found := measure(name, args.lanes, args.rounds))
        print(f"\n### Section {name}, {args.lanes} lanes\n")
        print(
            "| method | seconds | to heyoka's batches | first call, seconds | largest error | lanes with other events |"
        )
        print("|---|---|---|---|---|---|")
        for r in found:
            times = f"{r['seconds']:.3g} | {r['ratio']:.2f} | {r['first']:.1f}"
            print(f"| {r['method']} | {times} | {r['error']:.1e} | {r['other_events']} |", flush=True)
    if args.out:
        with open(args.out, "w") as file:
            json.dump({"machine": machine(), "rows": rows}, file, indent=1)


if __name__ == "__main__":
    main()
