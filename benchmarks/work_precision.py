"""What accuracy costs, by method, for systems of the thesis: final states and their first derivatives.

    python benchmarks/work_precision.py --out benchmarks/work_precision

Prints a table in Markdown for each, writes all rows to `<out>.json` and the pictures to `<out>_<system>.png`. With
`--draw` nothing is measured: the pictures are drawn from the rows that are there.
"""

import argparse
import json
from collections.abc import Callable
from typing import Any, NamedTuple

import diffrax as dfx
import equinox as eqx
import jax
import jax.numpy as jnp
import matplotlib.pyplot as plt
from sweep import Hammer, machine

import nsjax
from nsjax import Exponential, gallery, Method, Taylor
from nsjax._work_precision import Row
from nsjax.gallery import Motion


class Case(NamedTuple):
    system: nsjax.System
    y0: Any
    t1: float
    parameter: str  # the derivative is with respect to this one


LANES = 16
CASES = {
    "2.4": Case(gallery.thesis("2.4"), Motion(1.1, 0.0), 100.0, "v_dr"),
    "3.4": Case(gallery.thesis("3.4"), Motion(2.5, -0.5), 100.0, "v_dr"),
    "6.6": Case(gallery.thesis("6.6"), gallery.entry("6.6").y0, 30.0, "omega"),
    "6.8": Case(gallery.thesis("6.8"), gallery.entry("6.8").y0, 30.0, "omega"),
    "hammer": Case(Hammer(), Motion(0.5, -1.0), 30.0, "omega"),
}


def methods(key: str) -> dict[str, Method]:
    found = {
        "events, Tsit5": Method(dfx.Tsit5()),
        "events, Dopri8": Method(dfx.Dopri8()),
        "events, Taylor": Method(Taylor()),
    }
    if key in ("3.4", "6.6", "hammer"):  # affine in the state
        found["events, Exponential"] = Method(Exponential())
    if key == "2.4":
        for eps in (1e4, 1e6):
            found[f"arctan, ε = {eps:.0e}"] = Method(dfx.Kvaerno5(), lambda s, eps=eps: nsjax.smoothed(s, eps))
    if key in ("2.4", "6.6", "6.8"):
        found["linear, ε = 1e+06"] = Method(dfx.Kvaerno5(), lambda s: nsjax.smoothed(s, 1e6, "linear"))
    if key != "hammer":
        for eta in (1e-4, 1e-6):
            found[f"band, η = {eta:.0e}"] = Method(dfx.Tsit5(), lambda s, eta=eta: nsjax.banded(s, eta))
    return found


def quantities(case: Case) -> dict[str, Callable[..., Any]]:
    # A single solution takes little longer than the call of the program: many starts at once.
    shifts = jnp.linspace(-0.01, 0, LANES)  # away from the wall

    def moved(system: Any, method: Method, p: Any) -> Any:
        system = eqx.tree_at(lambda s: getattr(s, case.parameter), system, p)
        return jax.vmap(lambda d: method.solve(system, 0.0, case.t1, case.y0._replace(x=case.y0.x + d)).y1)(shifts)

    def state(system: Any, method: Method) -> Any:
        return moved(system, method, jnp.asarray(getattr(system, case.parameter)))

    def derivative(system: Any, method: Method) -> Any:
        return jax.jacfwd(lambda p: moved(system, method, p))(jnp.asarray(getattr(system, case.parameter)))

    return {"state": state, "derivative": derivative}


def evaluations() -> nsjax.WorkPrecision:
    """Section 2.4 for one start, with evaluations of the right-hand side counted."""
    case, chosen = CASES["2.4"], methods("2.4")
    few = {k: chosen[k] for k in ("events, Tsit5", "events, Dopri8", "arctan, ε = 1e+06", "band, η = 1e-06")}

    def end(system: Any, method: Method) -> Any:
        return method.solve(system, 0.0, case.t1, case.y0).y1

    return nsjax.work_precision(case.system, end, few, [1e-8], count=True)


def compare(system: Any, quantity: Any, chosen: dict[str, Method], args: Any) -> nsjax.WorkPrecision:
    """A table of all methods. What approximates the system has an error of its own: tolerances below 1e-8 show no more
    of it, and take minutes."""
    exact = {k: m for k, m in chosen.items() if m.change is None}
    rest = {k: m for k, m in chosen.items() if m.change is not None}
    options = dict(max_steps=100_000)
    table = nsjax.work_precision(system, quantity, exact, args.tolerances, repeats=args.repeats, **options)
    coarse = [tol for tol in args.tolerances if tol >= 1e-8]
    more = nsjax.work_precision(system, quantity, rest, coarse, repeats=1, **options)
    return nsjax.WorkPrecision(table.rows + more.rows, table.doubt)


def draw(out: str, key: str, tables: dict[str, nsjax.WorkPrecision]) -> None:
    case = CASES[key]
    figure, axes = plt.subplots(1, 2, figsize=(11, 5.2), layout="constrained", sharey=True)
    for ax, (name, table) in zip(axes, tables.items()):
        nsjax.plot.work_precision(table, ax=ax)
        what = name if name == "state" else f"d state / d {case.parameter}"
        ax.set_xlabel(f"error of {what} at t = {case.t1:g} (largest component)")
    figure.savefig(f"{out}_{key}.png", dpi=120)
    plt.close(figure)


def draw_again(out: str, systems: list[str]) -> None:
    with open(f"{out}.json") as file:
        rows = json.load(file)
    for key in systems:
        found = {name: rows[f"{key} {name}"] for name in quantities(CASES[key])}
        tables = {k: nsjax.WorkPrecision(tuple(Row(**r) for r in t["rows"]), t["doubt"]) for k, t in found.items()}
        draw(out, key, tables)


def main() -> None:
    jax.config.update("jax_enable_x64", True)
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--systems", nargs="*", default=list(CASES), choices=CASES)
    parser.add_argument("--tolerances", nargs="*", type=float, default=[1e-4, 1e-6, 1e-8, 1e-10, 1e-12])
    parser.add_argument("--repeats", type=int, default=5)
    parser.add_argument("--out", help="where to write the numbers and the pictures")
    parser.add_argument("--draw", action="store_true", help="draw the pictures from <out>.json")
    args = parser.parse_args()
    if args.draw:
        draw_again(args.out, args.systems)
        return
    rows: dict[str, Any] = {"machine": machine()}
    for key in args.systems:
        case, tables = CASES[key], {}
        for name, quantity in quantities(case).items():
            chosen = {k: m for k, m in methods(key).items() if name == "state" or "band" not in k}
            tables[name] = compare(case.system, quantity, chosen, args)
            print(f"\n### {key}, {name} at t = {case.t1:g}\n\n{tables[name]}", flush=True)
            rows[f"{key} {name}"] = dict(doubt=tables[name].doubt, rows=[r._asdict() for r in tables[name].rows])
        if args.out:
            draw(args.out, key, tables)
    if "2.4" in args.systems:
        counted = evaluations()
        print(f"\n### 2.4, evaluations of the right-hand side\n\n{counted}", flush=True)
        rows["2.4 evaluations"] = dict(doubt=counted.doubt, rows=[r._asdict() for r in counted.rows])
    if args.out:
        with open(f"{args.out}.json", "w") as file:
            json.dump(rows, file, indent=1)


if __name__ == "__main__":
    main()
