"""Points a second along branches of periodic orbits: section 6.6 over ω in (1.15, 1.25), four segments each orbit.

    python benchmarks/branches.py --out benchmarks/branches.json

One branch by `continue_orbit` (point by point, from Python) and by `continue_orbits` (a compiled loop), 1000 branches
at once by `continue_orbits`, for x_c = linspace(0.99, 1.01); beside AUTO-07p where it is installed, on meshes whose
errors are about 1e-12. Error: a state of each orbit, against matrix exponentials, of all points of the branch with
x_c = 1; AUTO's are those at the events. Seconds are of the processor: AUTO runs on one thread, XLA on as many as it
likes. Last a model that is not affine, whose segments are steps of a solver: a mass on a belt with falling friction and
a spring that hardens, over v_dr in (0.15, 0.25); error: the period, against scipy.
"""

import argparse
import json
import time
from typing import Any, NamedTuple

import diffrax
import jax
import jax.numpy as jnp
import numpy as np
import peers_auto
from scipy.integrate import solve_ivp
from scipy.linalg import expm
from sweep import machine
from systems import Falling

import nsjax
from nsjax.gallery import Motion, Trilinear


OMEGA = (1.15, 1.25)
V_DR = (0.15, 0.25)
# Whole orbits, as here; AUTO's user may know that half is enough.
MESHES = ((4, 5, 5), (4, 10, 4), (2, 3, 6))  # pieces, NTST, NCOL


class Row(NamedTuple):
    code: str
    branches: int
    points: int
    compile_seconds: float | None
    seconds: float  # of the processor, median
    per_second: float
    error: float


def search(x_c: Any) -> nsjax.Orbit:
    return nsjax.find_orbit(
        Trilinear(omega=1.2, x_c=x_c), Motion(-0.9, 0.94), order=1, method="shooting", throw=False, max_events=16,
        solver=diffrax.Tsit5(), stepsize_controller=diffrax.PIDController(rtol=1e-12, atol=1e-12),
    )  # fmt: skip


def error_of(omega: np.ndarray, t: np.ndarray, x: np.ndarray, v: np.ndarray) -> float:
    """Of the state at a time: half of the orbit is in contact on the right and then free, the other half its image."""
    z = peers_auto.exact(omega)
    duration, half = z[:, 1], np.pi / omega
    late = (t - z[:, 2]) % (2 * half)
    sign, late = np.where(late < half, 1, -1), late % half
    phase = omega * z[:, 2]
    start = np.stack([peers_auto.X_C * np.ones_like(t), z[:, 0], np.sin(phase), np.cos(phase), np.ones_like(t)], -1)
    touching, flying = np.minimum(late, duration), np.maximum(late - duration, 0)
    y = expm(peers_auto.piece(omega, True) * touching[:, None, None]) @ start[..., None]
    y = (expm(peers_auto.piece(omega, False) * flying[:, None, None]) @ y)[..., 0]
    return float(max(np.abs(x - sign * y[:, 0]).max(), np.abs(v - sign * y[:, 1]).max()))


def period_of(v_dr: float) -> float:
    """Of `Falling`: it sticks until the spring is as strong as friction, and slips until it is as fast as the belt."""
    one = Falling()
    x = next(float(r.real) for r in np.roots([one.k_3, 0, 1, -1]) if abs(r.imag) < 1e-12)

    def slip(t: float, y: np.ndarray) -> list[float]:
        return [y[1], -y[0] - one.k_3 * y[0] ** 3 + 1 / (1 + one.delta * (v_dr - y[1]))]

    def caught(t: float, y: np.ndarray) -> float:
        return y[1] - v_dr if t > 0.5 else -1.0

    caught.terminal = True  # type: ignore[attr-defined]
    end = solve_ivp(slip, (0, 50), [x, v_dr], "DOP853", rtol=1e-12, atol=1e-12, events=caught)
    return end.t[-1] + (x - end.y[0, -1]) / v_dr


def looks(orbit: nsjax.Orbit, parameter: str, interval: tuple, max_step: float, repeats: int) -> tuple[list, Any, Any]:
    """What is seen at each point of a branch, one after the other; seconds of the first time and of the others."""
    seconds, first = [], 0.0
    points: list[Any] = []
    for i in range(repeats + 1):
        wall = time.perf_counter()
        growth = nsjax.OrbitContinuation(orbit.system, orbit, parameter, interval, max_step=max_step, max_branches=1)
        start = time.process_time()
        points = list(growth)
        if i == 0:
            first = time.perf_counter() - wall
        else:
            seconds.append(time.process_time() - start)
    median = float(np.median(seconds))
    return [point.look for point in points], first - median, median


def one_by_one(orbit: nsjax.Orbit, max_step: float, repeats: int) -> Row:
    look, first, median = looks(orbit, "omega", OMEGA, max_step, repeats)
    x = np.stack([one.x[0] for one in look])
    error = error_of(np.array([float(one.parameter) for one in look]), np.array([one.begin[0] for one in look]), *x.T)
    return Row("continue_orbit", 1, len(look), first, median, len(look) / median, error)


def by_steps(repeats: int) -> Row:
    orbit = nsjax.find_orbit(Falling(), Motion(1.0, 0.2), solver=diffrax.Dopri8())
    look, first, median = looks(orbit, "v_dr", V_DR, 0.1, repeats)
    error = max(abs(float(one.period) - period_of(float(one.parameter))) for one in look)
    return Row("continue_orbit, not affine", 1, len(look), first, median, len(look) / median, error)


def at_once(orbits: nsjax.Orbit, max_step: float, points: int, repeats: int) -> Row:
    """In lanes; the middle one has x_c = 1."""
    lanes = len(orbits.t0)
    seconds, first = [], 0.0
    branches: Any = None
    for i in range(repeats + 1):
        wall, start = time.perf_counter(), time.process_time()
        branches = nsjax.continue_orbits(orbits, "omega", OMEGA, max_step=max_step, points=points)
        if i == 0:
            first = time.perf_counter() - wall
        else:
            seconds.append(time.process_time() - start)
    n, lane = branches.num[lanes // 2], lanes // 2
    columns = (branches.values, branches.ts, branches.ys.x, branches.ys.v)
    error = error_of(*(column[lane, :n] for column in columns))
    total, median = int(branches.num.sum()), float(np.median(seconds))
    return Row("continue_orbits", lanes, total, first - median, median, total / median, error)


def by_auto(pieces: int, ntst: int, ncol: int) -> Row:
    found = peers_auto.measure(pieces=pieces, ntst=ntst, ncol=ncol)
    name = f"AUTO-07p, {pieces} pieces, NTST {ntst}, NCOL {ncol}"
    return Row(name, 1, found.points, None, found.points / found.per_second, found.per_second, found.error)


def main() -> None:
    jax.config.update("jax_enable_x64", True)
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--lanes", type=int, default=1000)
    parser.add_argument("--max-step", type=float, default=0.002)
    parser.add_argument("--repeats", type=int, default=5)
    parser.add_argument("--out", help="a JSON file for the figures")
    options = parser.parse_args()
    one = nsjax.sweep(search, jnp.ones(1))
    many = nsjax.sweep(search, jnp.linspace(0.99, 1.01, options.lanes + 1 - options.lanes % 2))
    single = jax.tree.map(lambda leaf: leaf[0], one)
    rows = [one_by_one(single, options.max_step, options.repeats)]
    rows.append(at_once(one, options.max_step, 2000, options.repeats))
    rows.append(at_once(many, 10 * options.max_step, 200, options.repeats))
    rows += [by_auto(*mesh) for mesh in MESHES] if peers_auto.directory() else []
    rows.append(by_steps(options.repeats))
    print(
        "| code | branches | points | compile [s] | processor [s] | points/s | error |\n|---|---|---|---|---|---|---|"
    )
    for row in rows:
        compiled = "" if row.compile_seconds is None else f"{row.compile_seconds:.0f}"
        figures = f"{row.seconds:.3g} | {row.per_second:.0f} | {row.error:.1e}"
        print(f"| {row.code} | {row.branches} | {row.points} | {compiled} | {figures} |")
    if options.out:
        with open(options.out, "w") as file:
            json.dump({"machine": machine(), "rows": [row._asdict() for row in rows]}, file, indent=1)


if __name__ == "__main__":
    main()
