"""The picture at the top of the README: `python docs/pictures/front.py` (seven minutes on one busy core).

    --keep FOLDER    where the branches and the chart are kept, and taken from the next time

The times in the second panel are not measured again: they are those of benchmarks/work_precision.json.
"""

import argparse
import json
import pathlib
import time

import diffrax
import jax
import jax.numpy as jnp
import matplotlib
import matplotlib.pyplot as plt
import numpy as np
from matplotlib.colors import BoundaryNorm, ListedColormap
from matplotlib.lines import Line2D

import nsjax
from nsjax import gallery, plot
from nsjax.gallery import Motion
from nsjax.plot._work_precision import method_colors


HERE = pathlib.Path(__file__).parent
METHODS = {  # of benchmarks/work_precision.json, as they are called here
    "events, Taylor": "events, Taylor series",
    "events, Dopri8": "events, Dopri8",
    "band, η = 1e-04": "switch model, η = 10⁻⁴",
    "arctan, ε = 1e+06": "smoothed, ε = 10⁶",
}
NAMES = (  # of the special points in section 6.9, in the order of ω, and where there is room for them [pt]
    ("discontinuous\nfold", (-4, 12)),
    ("discontinuous\nfold-flip", (-4, 18)),
    ("fold", (-6, -12)),
    ("discontinuous\nflip", (4, 18)),
    ("flip", (8, 4)),
    ("Neimark-Sacker", (-40, 75)),
    ("fold", (8, -3)),
)
PERIODS = 40  # of the forcing, the last of which is looked at
SIZE = (400, 250)  # of the chart: 100,000 lanes


def orbit_panel(ax):
    """A neighbourhood of the stick-slip orbit of section 3.4, carried along by the fundamental matrix."""
    orbit = nsjax.find_orbit(gallery.thesis("3.4"), Motion(2.0, 0.0), period=13.5)
    plot.perturbation_tube(orbit, radius=0.1, ellipses=14, ax=ax, surfaces=False, legend=False)
    ax.axhline(0.2, color="0.4", linestyle="--", linewidth=0.9, zorder=0)
    ax.text(-0.52, 0.23, "belt", color="0.4", fontsize="small")
    style = dict(arrowprops=dict(arrowstyle="-", color="0.5", linewidth=0.7), ha="center", fontsize="small")
    for event, name, S, x in zip(
        orbit.events, ("caught", "released"), ([[1, 0], [0, 0]], [[1, 0], [-5, 1]]), (0.4, 1.45)
    ):
        found = nsjax.saltation_matrix(
            orbit.system, event.t, event.y_before, "belt", event.mode_before, event.mode_after
        )  # fmt: skip
        np.testing.assert_allclose(found, S, atol=1e-9)
        first, second = ("  ".join(f"{number:>2}" for number in row) for row in S)
        words = f"{name}\nS = {first}\n    {second}"
        ax.annotate(words, (event.y_before.x, event.y_before.v), (x, 0.47), family="monospace", **style)
    below = (orbit.y0.x, orbit.y0.v - 0.1)
    ax.annotate("perturbations", below, (0.35, -1.42), **style)
    image, stretch, _ = np.linalg.svd(orbit.monodromy)
    way = image[:, 0] * np.sign(image[0, 0])
    last = np.array([orbit.y0.x, orbit.y0.v]) + 0.1 * stretch[0] * way
    ax.annotate("one period later", last, (1.75, -1.42), **style)
    ax.set(xlim=(-0.55, 2.55), ylim=(-1.55, 0.85), xlabel="displacement x [m]", ylabel="velocity v [m/s]")
    ax.set_title("A neighbourhood of a stick-slip orbit\n(linear) becomes a line when the belt catches it")


def accuracy_panel(ax):
    table = json.loads((HERE.parents[1] / "benchmarks" / "work_precision.json").read_text())["2.4 state"]
    colors = method_colors(METHODS)
    for (method, name), marker in zip(METHODS.items(), "o^sv"):
        rows = [row for row in table["rows"] if row["method"] == method and not row["failure"]]
        error = np.maximum([row["error"] for row in rows], table["doubt"])
        style = dict(color=f"C{colors[method]}", markersize=4, label=name)
        ax.loglog(error, [1e3 * row["seconds"] for row in rows], marker + "-", **style)
    low = 1e-13
    ax.axvspan(low, table["doubt"], color="0.92", zorder=0)
    ax.set_xlim(3, low)
    ax.set_xlabel("error of the state [m, m/s]")
    ax.set_ylabel("time of 16 solutions [ms]")
    ax.legend(fontsize="small", frameon=False)
    ax.set_title("Accuracy against time, measured:\nevents, and what is used in their place")


def followed():
    how = dict(stepsize_controller=diffrax.PIDController(rtol=1e-12, atol=1e-12), max_steps=8192, max_events=16)
    system = gallery.thesis("6.9", omega=1.65)
    orbit = nsjax.find_orbit(system, Motion(1.73, -0.83), order=2, solver=diffrax.Tsit5(), **how)
    return nsjax.continue_orbit(system, orbit, "omega", (1.5, 1.95))


def branch_panel(ax, branch):
    plot.orbit_diagram(branch, ax=ax, names=False, legend=False)
    ax.set(xlim=(1.38, 1.97), ylim=(0.95, 2.55))
    ax.set(xlabel="angular frequency ω [rad/s]", ylabel="largest |x| in a period [m]")
    assert len(branch.special_points) == len(NAMES)
    marks = [(line.get_xdata()[0], line.get_ydata()[0]) for line in ax.lines if line.get_marker() == "o"]
    for point, (name, offset) in zip(sorted(branch.special_points, key=lambda point: point.value), NAMES):
        assert name.split("\n") == ["discontinuous"] * point.discontinuous + [point.kind]
        place = min(marks, key=lambda mark: abs(mark[0] - point.value))
        side = "left" if offset[0] > 0 or offset[1] > 20 else "right"
        line = dict(arrowstyle="-", color="0.5", linewidth=0.7, shrinkB=3) if offset[1] > 20 else None
        ax.annotate(
            name, place, offset, textcoords="offset points", fontsize="small", ha=side, va="center", arrowprops=line
        )
    lines = [
        Line2D([], [], color="k", ls=style, lw=1.6, label=name) for style, name in (("-", "stable"), ("--", "unstable"))
    ]
    style = dict(marker="o", ls="none", ms=5)
    points = [
        Line2D([], [], color=color, label=name, **style) for color, name in (("C3", "discontinuous"), ("C0", "smooth"))
    ]
    ax.legend(handles=lines + points, fontsize="small", frameon=False, loc="lower left")
    ax.set_title("Branches of section 6.9: every bifurcation\nis found, followed and named")


def stops(omega, friction):
    """How often a mass that is forced against dry friction stops in a period, once it has settled."""
    system = gallery.ForcedFriction(omega=omega, F_slip=friction, F_stick=friction)
    how = dict(solver=nsjax.Affine(), throw=False, max_events=512, max_steps=16384)
    sol = nsjax.solve(system, 0.0, PERIODS * system.period, Motion(0.0, 0.0), **how)
    late = (sol.events.t > (PERIODS - 1) * system.period) & (jnp.arange(512) < sol.events.num)
    return jnp.sum(late & (sol.events.mode_after[:, 0] == 0)), sol.events.num, nsjax.is_okay(sol.result)


def swept():
    omega, friction = np.meshgrid(np.linspace(0.08, 1.3, SIZE[0]), np.linspace(0.01, 2.6, SIZE[1]))
    number, events, good = (
        np.asarray(x).reshape(omega.shape) for x in nsjax.sweep(stops, omega.ravel(), friction.ravel())
    )
    return dict(omega=omega, friction=friction, stops=number, events=events, good=good)


def chart_panel(ax, chart):
    assert chart["good"].all()
    number = chart["stops"]
    kind = np.where(chart["events"] == 0, 4, (number + 1) // 2)
    assert kind.max() == 4
    colors = ListedColormap(["#fde725", "#35b779", "#31688e", "#440154", "0.85"])
    norm = BoundaryNorm(np.arange(6) - 0.5, 5)
    mesh = ax.pcolormesh(chart["omega"], chart["friction"], kind, cmap=colors, norm=norm, rasterized=True)
    bar = ax.figure.colorbar(mesh, ax=ax, ticks=range(5))
    bar.ax.set_yticklabels(["none", "1, 2", "3, 4", "5, 6", "never\nmoves"])
    bar.ax.tick_params(length=0)
    bar.set_label("stops in a period [-]")
    ax.set(xlabel="angular frequency ω [rad/s]", ylabel="friction force [N]")
    ax.set_title(f"One sweep of {kind.size:,} forced oscillators,\nevery stop of each located")


def kept(folder, name, make, save, load):
    """What `make` returns, or what it returned before."""
    path = folder / name if folder else None
    if path and path.exists():
        return load(path)
    start = time.perf_counter()
    result = make()
    print(f"{name}: {time.perf_counter() - start:.0f} s")
    if path:
        save(path, result)
    return result


def main():
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--keep", type=pathlib.Path)
    parser.add_argument("--out", type=pathlib.Path, default=HERE / "front.png")
    args = parser.parse_args()
    jax.config.update("jax_enable_x64", True)
    matplotlib.use("Agg")
    branch = kept(
        args.keep, "branch.npz", followed,
        lambda path, branch: branch.save(path),
        lambda path: nsjax.OrbitBranch.load(path, gallery.ForcedStickSlip(), Motion(0.0, 0.0)),
    )  # fmt: skip
    chart = kept(args.keep, "chart.npz", swept, lambda path, chart: np.savez(path, **chart), np.load)
    with plt.rc_context({"font.size": 9, "axes.titlesize": 10, "axes.titlelocation": "left"}):
        axes = plt.subplots(2, 2, figsize=(10.5, 7.6), layout="constrained")[1]
        orbit_panel(axes[0, 0])
        accuracy_panel(axes[0, 1])
        branch_panel(axes[1, 0], branch)
        chart_panel(axes[1, 1], chart)
        plt.savefig(args.out, dpi=110)


if __name__ == "__main__":
    main()
