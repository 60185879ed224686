"""Nothing for nothing: what each switch that a model declares, and a derivative, add to program and time.

    python benchmarks/cost.py --out benchmarks/cost.json

Prints a table in Markdown: equations of the jaxpr, compile time, and the time of 1024 lanes with Tsit5, t from 0 to 20.
"""

import argparse
import json
from collections.abc import Callable
from typing import Any, NamedTuple

import diffrax
import jax
import jax.numpy as jnp
import numpy as np
from program import count_equations, measure
from sweep import machine
from systems import Free, Hitting, Rubbing

import nsjax
from nsjax.gallery import Motion


T1 = 20.0
HOW = dict(stepsize_controller=diffrax.PIDController(rtol=1e-8, atol=1e-8), throw=False)


class Row(NamedTuple):
    model: str
    derivative: str
    equations: int  # of the program of one lane
    compile_seconds: float
    seconds: float  # of all lanes
    steps: float  # of a lane, mean
    events: float


def by_nsjax(system: nsjax.System) -> Callable[[Motion], Any]:
    def lane(y0: Motion) -> Any:
        sol = nsjax.solve(system, 0.0, T1, y0, **HOW)
        return sol.y1, (nsjax.is_okay(sol.result), sol.stats["num_steps"], sol.stats["num_events"])

    return lane


def by_diffrax(y0: Motion) -> Any:
    """x'' = -x without nsjax."""
    term = diffrax.ODETerm(lambda t, y, args: Motion(y.v, -y.x))
    options = dict(adjoint=diffrax.ForwardMode(), saveat=diffrax.SaveAt(t1=True), **HOW)
    sol = diffrax.diffeqsolve(term, diffrax.Tsit5(), 0.0, T1, None, y0, **options)
    okay = sol.result == diffrax.RESULTS.successful
    return jax.tree.map(lambda x: x[0], sol.ys), (okay, sol.stats["num_steps"], jnp.zeros(()))


FAR = 1e3
MODELS = {
    "diffrax by itself": by_diffrax,
    "no switch": by_nsjax(Free()),
    "`sgn`": by_nsjax(Rubbing()),
    "`sgn`, never met": by_nsjax(Rubbing(v_dr=FAR)),
    "`sgn`, `impact`": by_nsjax(Hitting()),
    "`sgn`, `impact`, never met": by_nsjax(Hitting(v_dr=FAR, gap=FAR)),
}
DERIVATIVES = {
    "none": lambda lane: lane,
    "by the start (2)": lambda lane: jax.jacfwd(lane, has_aux=True),
}


HEAD = (
    "| model | derivative | equations | compile [s] | seconds | steps a lane | events a lane |\n"
    "|---|---|---|---|---|---|---|"
)


def line(r: Row) -> str:
    return (
        f"| {r.model} | {r.derivative} | {r.equations} | {r.compile_seconds:.1f} | {r.seconds:.3g} | {r.steps:.0f} "
        f"| {r.events:.0f} |"
    )


def main() -> None:
    jax.config.update("jax_enable_x64", True)
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--lanes", type=int, default=1024)
    parser.add_argument("--repeats", type=int, default=5)
    parser.add_argument("--out", help="where to write the numbers as JSON")
    args = parser.parse_args()
    starts = Motion(jnp.linspace(0.0, 1.0, args.lanes), jnp.linspace(-0.5, 0.1, args.lanes))
    rows = []
    print(HEAD)
    for derivative, transform in DERIVATIVES.items():
        lanes = [transform(lane) for lane in MODELS.values()]
        programs = measure([(lambda y0, fn=fn: nsjax.sweep(fn, y0), (starts,)) for fn in lanes], args.repeats)
        for model, fn, program in zip(MODELS, lanes, programs):
            _, (okay, steps, events) = program.out
            if not np.all(okay):
                raise RuntimeError(f"Lanes failed: {model}, {derivative}.")
            equations = count_equations(fn, Motion(0.5, -0.5))
            rows.append(
                Row(
                    model, derivative, equations, program.compile_seconds, program.seconds,
                    float(np.mean(steps)), float(np.mean(events)),
                )
            )  # fmt: skip
            print(line(rows[-1]), flush=True)
    if args.out:
        with open(args.out, "w") as file:
            json.dump({"machine": machine(), "lanes": args.lanes, "rows": [r._asdict() for r in rows]}, file, indent=1)


if __name__ == "__main__":
    main()
