"""How long a newcomer waits: the first answer of nsjax, diffrax, heyoka and scipy in a fresh process.

    python benchmarks/first_answer.py --out benchmarks/first_answer.json

Each row is a process of its own, without programs kept from before, measured `--repeats` times, or once if its first
call takes more than ten seconds: seconds (median) of the import; of tracing, with all else that Python does once; of
XLA's compiler (LLVM's for heyoka); of the same call again; the largest size of the process; and the ratio of what the
first call takes to diffrax's derivative of a solution up to one event.
"""

import argparse
import json
import os
import pathlib
import resource
import subprocess
import sys
import time
from collections.abc import Callable
from typing import Any

import numpy as np


UNIT = "diffrax: jacfwd(diffeqsolve) to one event"
LONG = 10.0  # seconds of a first call that is not repeated


def jax_ready() -> Any:
    """JAX with a first trivial program behind it, as the unit of all ratios has none of its start-up either."""
    import jax

    jax.config.update("jax_enable_x64", True)
    jax.block_until_ready(jax.jit(lambda x: x + 1)(1.0))
    return jax


def diffrax_event() -> Callable[[], Any]:
    import diffrax
    import jax.numpy as jnp
    import optimistix as optx

    jax = jax_ready()
    term = diffrax.ODETerm(lambda t, y, args: jnp.stack([y[1], -y[0] + 1.0]))
    event = diffrax.Event(lambda t, y, args, **_: y[1] - 0.2, optx.Newton(1e-10, 1e-10), direction=True)
    controller = diffrax.PIDController(rtol=1e-8, atol=1e-8)

    def end(y: Any) -> Any:
        sol = diffrax.diffeqsolve(
            term, diffrax.Tsit5(), 0.0, 10.0, 0.1, y, stepsize_controller=controller, event=event,
            adjoint=diffrax.ForwardMode(),
        )  # fmt: skip
        return sol.ys[-1]

    derivative, y = jax.jit(jax.jacfwd(end)), jnp.asarray([2.5, 0.0])
    return lambda: jax.block_until_ready(derivative(y))


def solution(name: str, how: str = "solve") -> Callable[[], Any]:
    """`solve` called directly, its derivative called directly ("jacfwd"), or as a user's own program ("jit")."""
    import jax.numpy as jnp
    from systems import ThreeSurfaces

    import nsjax
    from nsjax.gallery import entry, Motion, thesis

    jax = jax_ready()
    system = ThreeSurfaces() if name == "three" else thesis(name)
    start = entry(name).y0 if name == "A.9" else Motion(2.5, 0.0)
    y = jax.tree.map(jnp.asarray, start)

    def end(y: Any) -> Any:
        return nsjax.solve(system, 0.0, 10.0, y).y1

    called = {"solve": end, "jacfwd": jax.jacfwd(end), "jit": jax.jit(jax.jacfwd(end))}[how]
    return lambda: jax.block_until_ready(called(y))


def orbit(section: str) -> Any:
    import nsjax
    from nsjax.gallery import entry

    given = entry(section)
    system = given.system() if callable(given.system) else given.system
    guess = {} if system.period is not None else dict(period=float(given.orbit.period))
    return system, nsjax.find_orbit(system, given.orbit.y0, **guess)


def found(section: str) -> Callable[[], Any]:
    import nsjax  # noqa: F401  (which is no part of the first call)

    jax_ready()
    return lambda: orbit(section)[1].multipliers


def branch() -> Callable[[], Any]:
    import nsjax

    jax_ready()

    def follow() -> Any:
        system, start = orbit("6.6")
        return nsjax.continue_orbit(system, start, "omega", (1.0, 1.3), max_branches=1)

    return follow


def sweep(solver: str | None = None) -> Callable[[], Any]:
    import diffrax
    import jax.numpy as jnp
    from sweep import slider_lane
    from workloads import WORKLOADS

    import nsjax

    jax = jax_ready()
    values = jnp.asarray(WORKLOADS["S1"].sweep(4096))
    method = {None: None, "Dopri8": diffrax.Dopri8(), "Taylor": nsjax.Taylor()}[solver]

    def lane(v_dr: Any) -> Any:
        return slider_lane(v_dr, tol=1e-10, solver=method)

    return lambda: jax.block_until_ready(nsjax.sweep(lane, values, chunk=256))


def heyoka_event() -> Callable[[], Any]:
    import heyoka as hy

    x, v = hy.make_vars("x", "v")

    def run() -> Any:
        event = hy.t_event(v - 0.2, direction=hy.event_direction.positive)
        integrator = hy.taylor_adaptive([(x, v), (v, -x + 1.0)], [2.5, 0.0], t_events=[event])
        return integrator.propagate_until(10.0)

    return run


def scipy_event() -> Callable[[], Any]:
    from scipy.integrate import solve_ivp

    def slips(t: float, y: np.ndarray) -> float:
        return y[1] - 0.2

    slips.terminal, slips.direction = True, 1  # pyright: ignore[reportFunctionMemberAccess]
    field = lambda t, y: [y[1], -y[0] + 1.0]  # noqa: E731
    return lambda: solve_ivp(field, (0, 10), [2.5, 0.0], "DOP853", rtol=1e-10, atol=1e-10, events=slips)


ROWS: dict[str, Callable[[], Callable[[], Any]]] = {
    UNIT: diffrax_event,
    "nsjax: solve, one sgn switch": lambda: solution("3.4"),
    "nsjax: jacfwd(solve), one sgn switch": lambda: solution("3.4", "jacfwd"),
    "nsjax: jit(jacfwd(solve)), one sgn switch": lambda: solution("3.4", "jit"),
    "nsjax: solve, three switches": lambda: solution("three"),
    "nsjax: jacfwd(solve), three switches": lambda: solution("three", "jacfwd"),
    "nsjax: jit(jacfwd(solve)), three switches": lambda: solution("three", "jit"),
    "nsjax: solve, drillstring (five states, three switches)": lambda: solution("A.9"),
    "nsjax: jacfwd(solve), drillstring": lambda: solution("A.9", "jacfwd"),
    "nsjax: jit(jacfwd(solve)), drillstring": lambda: solution("A.9", "jit"),
    "nsjax: find_orbit, 3.4": lambda: found("3.4"),
    "nsjax: find_orbit, 6.6": lambda: found("6.6"),
    "nsjax: find_orbit and continue_orbit, 6.6": branch,
    "nsjax: sweep, S1, 4096 lanes": sweep,
    "nsjax: sweep, S1, 4096 lanes, Dopri8": lambda: sweep("Dopri8"),
    "nsjax: sweep, S1, 4096 lanes, Taylor": lambda: sweep("Taylor"),
    "heyoka: a solution to one event": heyoka_event,
    "scipy: a solution to one event": scipy_event,
}


def measured(name: str) -> dict[str, float]:
    """In this process: seconds of each stage."""
    start = time.perf_counter()
    run = ROWS[name]()
    imported = time.perf_counter() - start
    compiled = [0.0]
    if "jax" in sys.modules:
        import jax

        def heard(event: str, seconds: float, **_: Any) -> None:
            compiled[0] += seconds * (event == "/jax/core/compile/backend_compile_duration")

        jax.monitoring.register_event_duration_secs_listener(heard)
    times = []
    for _ in range(3):
        start = time.perf_counter()
        run()
        times.append(time.perf_counter() - start)
        if len(times) == 1:
            compiling = compiled[0]
    again = min(times[1:])
    if name.startswith("heyoka"):  # every new integrator is compiled
        compiling, again = times[0], again if again < 0.5 * times[0] else 0.0
    memory = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024
    traces = times[0] - compiling - again
    return dict(imports=imported, traces=traces, compiles=compiling, again=again, first=times[0], memory=memory)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--repeats", type=int, default=3)
    parser.add_argument("--rows", nargs="*", default=list(ROWS), metavar="ROW")
    parser.add_argument("--out", type=pathlib.Path)
    parser.add_argument("--one", help=argparse.SUPPRESS)
    args = parser.parse_args()
    if args.one:
        print(json.dumps(measured(args.one)))
        return
    environment = {k: v for k, v in os.environ.items() if k != "JAX_COMPILATION_CACHE_DIR"}
    table: dict[str, dict[str, float]] = {}
    print("| | import | trace | compile | again | MB | first call | ratio |\n|---|---|---|---|---|---|---|---|")
    for name in args.rows:
        runs = []
        for _ in range(args.repeats):
            command = [sys.executable, __file__, "--one", name]
            done = subprocess.run(command, env=environment, capture_output=True, text=True)
            if done.returncode:
                if "ModuleNotFoundError" in done.stderr:
                    break
                raise SystemExit(f"{name} failed:\n{done.stderr}")
            runs.append(json.loads(done.stdout.splitlines()[-1]))
            if runs[-1]["first"] > LONG:
                break
        if not runs:
            print(f"| {name} | not installed | | | | | | |", flush=True)
            continue
        table[name] = row = {k: float(np.median([run[k] for run in runs])) for k in runs[0]}
        ratio = row["first"] / table[UNIT]["first"] if UNIT in table else float("nan")
        cells = [f"{row[k]:.2f}" for k in ("imports", "traces", "compiles")] + [f"{row['again']:.3f}"]
        cells += [f"{row['memory']:.0f}", f"{row['first']:.2f}", f"{ratio:.1f}"]
        print(f"| {name} | {' | '.join(cells)} |", flush=True)
    if args.out:
        args.out.write_text(json.dumps(table, indent=1) + "\n")


if __name__ == "__main__":
    main()
