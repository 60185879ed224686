"""How time and memory grow: with lanes, events, state dimension, and parameters differentiated.

    python benchmarks/growth.py --out benchmarks/growth

Prints a table in Markdown, writes all rows to `<out>.json` and four pictures to `<out>.png`. Seconds are the median of
`--repeats` runs, those of a panel in turns, compile time apart; memory is what the compiled program works in, arguments
and results left out.
"""

import argparse
import functools as ft
import json
from collections.abc import Callable, Iterator
from typing import Any, NamedTuple

import diffrax
import jax
import jax.numpy as jnp
import matplotlib.pyplot as plt
import numpy as np
from program import measure
from sweep import machine, slider_lane
from systems import Blocks, Chain, Shaken, Ticks, Toggle
from workloads import belt_velocities

import nsjax
from nsjax.gallery import Motion


LANES = 256  # of the panels in which something else grows: one chunk
TOL = 1e-8
LAST = {"blocks": 5}  # points over which a slope is taken, else three


class Row(NamedTuple):
    panel: str
    line: str
    x: int  # what grows
    lanes: int
    seconds: float
    compile_seconds: float
    bytes: int


def final(system: nsjax.System, t1: float, y0: Any, **options: Any) -> Any:
    """The final state of one lane, not a number where it failed."""
    controller = diffrax.PIDController(rtol=TOL, atol=TOL)
    sol = nsjax.solve(system, 0.0, t1, y0, stepsize_controller=controller, throw=False, **options)
    return jax.tree.map(lambda x: jnp.where(nsjax.is_okay(sol.result), x, jnp.nan), sol.y1)


# Each yields (line, what grows, function of the lanes, lanes).
Case = tuple[str, int, Callable[[jax.Array], Any], jax.Array]


def lanes() -> Iterator[Case]:
    """Workload S1 by Dopri8."""

    def lane(v_dr: jax.Array) -> Motion:
        return slider_lane(v_dr, tol=TOL, solver=diffrax.Dopri8())[0]

    for n in (1, 10, 100, 1_000, 10_000, 100_000):
        values = jnp.asarray(belt_velocities(n))
        yield "nsjax.sweep", n, lambda v: nsjax.sweep(lane, v), values
        if n > 256:  # up to there they are the same
            yield "one vmap", n, jax.vmap(lane), values


def events() -> Iterator[Case]:
    """Two units of time of it."""

    def toggled(rate: int, v: jax.Array) -> Any:
        return final(Toggle(rate), 2.0, Motion(0.0, v), max_events=256)

    def ticked(rate: int, v: jax.Array) -> Any:
        return final(Ticks(rate * v), 2.0, 0.5, max_events=256)

    start = jnp.linspace(0.9, 1.1, LANES)
    for rate in (1, 10, 100):
        yield "affine surface", rate, jax.vmap(ft.partial(toggled, rate)), start
        yield "sin(π y)", rate, jax.vmap(ft.partial(ticked, rate)), start


def blocks() -> Iterator[Case]:

    def slipping(n: int, v: jax.Array) -> Any:
        return final(Chain(n, v), 10.0, Blocks(2 * jnp.sin(1.0 + jnp.arange(n)), jnp.cos(3.0 * jnp.arange(n))))

    for n in (1, 2, 5, 10, 20, 50):
        yield "10 units of time", n, jax.vmap(ft.partial(slipping, n)), jnp.linspace(0.1, 1.0, LANES)


def parameters() -> Iterator[Case]:
    """x at the end as a function of as many amplitudes of the forcing."""
    belts = jnp.linspace(0.1, 1.0, LANES)
    backwards = dict(adjoint=diffrax.RecursiveCheckpointAdjoint(), max_steps=512)

    def x1(a: jax.Array, v: jax.Array, **options: Any) -> jax.Array:
        return final(Shaken(v_dr=v, a=a), 10.0, Motion(2.5, -0.5), **options).x

    for p in (1, 4, 16, 64):
        a = jnp.full(p, 0.5 / p)
        yield "jacfwd", p, jax.vmap(ft.partial(jax.jacfwd(x1), a)), belts
        yield "grad, checkpoints", p, jax.vmap(ft.partial(jax.grad(ft.partial(x1, **backwards)), a)), belts


class Panel(NamedTuple):
    cases: Callable[[], Iterator[Case]]
    xlabel: str
    title: str


PANELS = {
    "lanes": Panel(lanes, "number of lanes [-]", "workload S1"),
    "events": Panel(events, "events per unit of time [1/s]", f"two units of time, {LANES} lanes"),
    "blocks": Panel(blocks, "blocks n [-] (state dimension 2n)", f"chain of n blocks on a belt, {LANES} lanes"),
    "parameters": Panel(parameters, "parameters differentiated p [-]", f"derivative of x(10), {LANES} lanes"),
}


def measured(panel: str, repeats: int) -> list[Row]:
    """All cases of a panel, run in turns."""
    cases = list(PANELS[panel].cases())
    rows = []
    for (line, x, _, values), program in zip(cases, measure([(fn, (v,)) for _, _, fn, v in cases], repeats)):
        if not all(np.all(np.isfinite(leaf)) for leaf in jax.tree.leaves(program.out)):
            raise RuntimeError(f"Lanes failed: {line}, {panel} = {x}.")
        rows.append(Row(panel, line, x, len(values), program.seconds, program.compile_seconds, program.bytes))
    return rows


def plot(ax: Any, panel: str, line: str, x: list[int], y: list[float], **style: Any) -> None:
    last = LAST.get(panel, 3)
    slope = np.polyfit(np.log(x[-last:]), np.log(y[-last:]), 1)[0]
    ax.plot(x, y, markersize=4, label=f"{line}: slope {slope:.2f}", **style)


def draw(ax: Any, panel: str, rows: list[Row]) -> None:
    right = ax.twinx() if panel == "lanes" else None
    for i, line in enumerate(dict.fromkeys(r.line for r in rows)):
        found = [r for r in rows if r.line == line]
        x = [r.x for r in found]
        style = dict(marker="os^"[i], color=f"C{i}")
        plot(ax, panel, line, x, [r.seconds for r in found], **style)
        if right:
            plot(right, panel, f"{line}, memory", x, [r.bytes / 1e6 for r in found], linestyle=":", **style)
        if panel == "blocks":
            plot(
                ax,
                panel,
                "compile time",
                x,
                [r.compile_seconds for r in found],
                marker="s",
                color="0.5",
                linestyle="--",
            )
    ax.set(xscale="log", yscale="log", xlabel=PANELS[panel].xlabel, ylabel="time of all lanes [s]")
    ax.set_title(PANELS[panel].title, fontsize="medium")
    ax.grid(True, which="major", color="0.9")
    ax.legend(fontsize="small", frameon=False, loc="upper left")
    if right:
        right.set(yscale="log", ylabel="working memory [MB], dotted")
        right.legend(fontsize="small", frameon=False, loc="lower right")


def picture(rows: list[Row]) -> plt.Figure:
    panels = list(dict.fromkeys(r.panel for r in rows))
    figure, axes = plt.subplots(2, 2, figsize=(11, 8.5), layout="constrained")
    for ax, panel in zip(axes.flat, panels):
        draw(ax, panel, [r for r in rows if r.panel == panel])
    for ax in axes.flat[len(panels) :]:
        ax.remove()
    return figure


HEAD = "| what grows | | lanes | seconds | compile [s] | memory a lane [kB] |\n|---|---|---|---|---|---|"


def line(r: Row) -> str:
    return (
        f"| {r.panel} = {r.x} | {r.line} | {r.lanes} | {r.seconds:.3g} | {r.compile_seconds:.1f} "
        f"| {r.bytes / r.lanes / 1e3:.3g} |"
    )


def main() -> None:
    jax.config.update("jax_enable_x64", True)
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--panels", nargs="+", default=list(PANELS), choices=PANELS)
    parser.add_argument("--repeats", type=int, default=5)
    parser.add_argument("--out", help="where to write the numbers and the picture")
    args = parser.parse_args()
    rows = []
    print(HEAD)
    for panel in args.panels:
        found = measured(panel, args.repeats)
        rows += found
        print(*map(line, found), sep="\n", flush=True)
    if args.out:
        picture(rows).savefig(f"{args.out}.png", dpi=120)
        with open(f"{args.out}.json", "w") as file:
            json.dump({"machine": machine(), "rows": [r._asdict() for r in rows]}, file, indent=1)


if __name__ == "__main__":
    main()
