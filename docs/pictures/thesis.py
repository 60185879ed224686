"""Figures of chapters 2 to 6 of the thesis that no command and no notebook draws: `python docs/pictures/thesis.py`
(two minutes on one core). `docs/scorecard.py` says which figure is drawn where.

    --out FOLDER    where to write the pictures; by default this folder
"""

import argparse
import pathlib

import diffrax
import jax
import jax.numpy as jnp
import matplotlib
import matplotlib.pyplot as plt
import numpy as np

import nsjax
from nsjax import gallery, plot
from nsjax.gallery import Line, Motion, Plane, Slip
from nsjax.mechanics import Contact, Coulomb, Damper, Friction, Harmonic, Scene, Spring, Viscoelastic
from nsjax.plot._diagram import write_names
from nsjax.plot._path import arcs, solved


HERE = pathlib.Path(__file__).parent
DENSE, STEPS = diffrax.SaveAt(dense=True), diffrax.SaveAt(steps=True)
TIGHT = dict(rtol=1e-8, atol=1e-8)


class Sliding(nsjax.System):
    """Pushed down onto x₂ = 0, and up until x₁ = 1, where the field below is parallel to it: it is left there."""

    def vector_field(self, t, y, s):
        above = (1 + s.surface) / 2
        return Plane(1.0 + 0.0 * y.x1, -above + (1 - above) * (1.0 - y.x1))

    @nsjax.sgn
    def surface(self, t, y):
        return y.x2


class Kink(nsjax.System):
    """x' = |x|."""

    def vector_field(self, t, y, s):
        return Line(y.x * s.kink)

    @nsjax.sgn
    def kink(self, t, y):
        return y.x


def name(ax, number):
    ax.set_title(f"Fig. {number}", loc="left", fontsize="medium")


def directions(ax, system, surface, xlim, ylim):
    """The field on either side of the line x₂ = surface, as arrows of one length."""
    x, y = np.meshgrid(np.linspace(*xlim, 9), np.linspace(*ylim, 8))
    rows = []
    for a, b in zip(x.ravel(), y.ravel()):
        values = system.values((jnp.asarray(np.sign(b - surface)),))
        rows.append(jnp.stack(system.vector_field(0.0, Plane(jnp.asarray(a), jnp.asarray(b)), values)))
    u, v = np.array(rows).T
    length = np.hypot(u, v)
    ax.quiver(x.ravel(), y.ravel(), u / length, v / length, color="0.7", scale=22, width=0.004, zorder=0)
    ax.axhline(surface, color="0.35", linestyle="--", linewidth=1.0, zorder=1)
    ax.set(xlim=xlim, ylim=ylim, xlabel="$x_1$ [-]", ylabel="$x_2$ [-]")


def solution(ax, system, y0, t1, **style):
    sol = nsjax.solve(system, 0.0, t1, y0, saveat=DENSE, **TIGHT)
    plot.phase_portrait(sol, ax=ax, surfaces=False, legend=False, **style)
    return sol


def examples(axes):
    """Figs. 2.1 to 2.3: how the field can lie beside a surface."""
    for ax, key, starts in (
        (axes[0], "2.1", ((-2.0, 2.0), (-0.5, 2.0))),
        (axes[1], "2.2", ((-2.0, 2.0), (-2.0, -0.5), (-0.5, 2.0))),
        (axes[2], "2.3", ((2.0, 1.001), (1.0, 0.999), (0.0, 1.001))),
    ):
        system = gallery.thesis(f"example {key}")
        level = float(system.c)
        directions(ax, system, level, (-2.4, 2.4), (level - 2, level + 2))
        for a, b in starts:
            solution(ax, system, Plane(a, level + b - 1.0), 0.7)
        name(ax, key)
        ax.set(xlabel="$x_1$ [-]", ylabel="$x_2$ [-]")


def sliding(exact, approximate):
    """Fig. 2.4: a sliding mode, and what the switch model makes of it."""
    start, end = Plane(-0.6, 0.7), 2.6
    for ax, system in ((exact, Sliding()), (approximate, nsjax.banded(Sliding(), 0.06))):
        directions(ax, Sliding(), 0.0, (-0.8, 2.2), (-0.7, 0.8))
        if ax is exact:
            sol = solution(ax, system, start, end)
            leave = [event.y_before for event in sol.events]
            np.testing.assert_allclose([leave[0].x1, leave[1].x1], [0.1, 1.0], atol=1e-8)
            places = ("A", start), ("B", leave[0]), ("C", leave[1]), ("D", sol.y1)
            for letter, y in places:
                ax.annotate(letter, (y.x1, y.x2), (4, 6), textcoords="offset points")
        else:
            ax.axhspan(-0.06, 0.06, color="C0", alpha=0.15)
            steps = nsjax.solve(system, 0.0, end, start, saveat=STEPS, **TIGHT)
            seen = np.isfinite(np.asarray(steps.ts))
            solution(ax, system, start, end, color="C0", linewidth=1.0)
            ax.plot(np.asarray(steps.ys.x1)[seen], np.asarray(steps.ys.x2)[seen], "C0.", markersize=5)
        ax.set(xlabel="$x_1$ [-]", ylabel="$x_2$ [-]")
    name(exact, "2.4a")
    name(approximate, "2.4b, steps in a band of ±0.06")


def laws(ax):
    """Fig. 2.5: friction laws, as the blocks feel them; at rest up to F_s."""
    v = np.concatenate([-np.geomspace(1.0, 1e-5, 300), np.geomspace(1e-5, 1.0, 300)])
    for key, label, style in (("(2.26)", "(a)", "-"), ("(2.28)", "(b)", "--"), ("(2.29)", "(c)", ":")):
        block = gallery.thesis(key)
        found = []
        for x in v:
            values = block.values(tuple(jnp.asarray(np.sign(x)) for _ in block.switches))
            rate = block.vector_field(0.0, Slip(jnp.asarray(x)), values)
            found.append(float(block.F_ex - block.m * rate.v))
        ax.plot(v, found, style, label=label, linewidth=1.6)
    np.testing.assert_allclose(found[-1], 0.5)
    ax.plot([0, 0], [-1, 1], color="C2", linestyle=":", linewidth=1.6)
    ax.set(xlabel="$v$ [m/s]", ylabel="$F$ [N]")
    ax.legend(fontsize="small")
    name(ax, "2.5")


def regions(ax):
    """Fig. 2.8: the parts of the phase plane of the switch model, in a band that is wide enough to be seen."""
    system, eta = gallery.thesis("2.4"), 0.05
    v_dr, hold = float(system.v_dr), float(system.F_s / system.k)
    for y0 in (Motion(1.6, 0.0), Motion(0.9, 0.0), Motion(-1.3, -0.3)):
        sol = nsjax.solve(nsjax.banded(system, eta), 0.0, 9.0, y0, saveat=DENSE, rtol=1e-6, atol=1e-6)
        x, v = np.concatenate([np.stack([arc.y["x"], arc.y["v"]]) for arc in arcs(sol)], axis=1)
        ax.plot(x, v, color="0.3", linewidth=0.9)
    ax.axhspan(v_dr - eta, v_dr + eta, color="C0", alpha=0.15)
    for x in (-hold, hold):
        ax.plot([x, x], [v_dr - eta, v_dr + eta], color="C0", linewidth=1.2)
    plate = dict(facecolor="white", edgecolor="none", pad=0.5)
    for text, x, v in (
        ("$S_+$", 0.6, 0.6),
        ("$S_-$", 0.1, -0.2),
        ("U", 0, v_dr),
        ("$T_+$", 1.75, v_dr),
        ("$T_-$", -1.6, v_dr),
    ):
        ax.text(x, v, text, ha="center", va="center", color="C0", bbox=plate)
    ax.set(xlabel="$x$ [m]", ylabel="$x'$ [m/s]", xlim=(-2, 2.2), ylim=(-1.6, 0.9))
    name(ax, "2.8, a band of ±0.05 m/s")


def by_both_methods(axes):
    """Fig. 2.9: one period, with every step that was taken."""
    system = gallery.thesis("2.4")
    guess = gallery.entry("2.4").orbit
    orbit = nsjax.find_orbit(system, guess.y0, period=guess.period)
    counts = []
    for ax, changed, solver, title in (
        (axes[0], nsjax.smoothed(system, 1e6), diffrax.Kvaerno5(), "2.9a, smoothed, ε = 10⁶"),
        (axes[1], nsjax.banded(system, 1e-6), diffrax.Tsit5(), "2.9b, switch model"),
    ):
        end = orbit.t0 + orbit.period
        sol = nsjax.solve(changed, orbit.t0, end, orbit.y0, solver=solver, saveat=STEPS, max_steps=100_000, **TIGHT)
        seen = np.isfinite(np.asarray(sol.ts))
        x, v = np.asarray(sol.ys.x)[seen], np.asarray(sol.ys.v)[seen]
        # Smoothed, the friction force is largest beside v_rel = 0, and release comes a little later: another period.
        np.testing.assert_allclose([sol.y1.x, sol.y1.v], [orbit.y0.x, orbit.y0.v], atol=1e-2)
        counts.append(len(x))
        ax.plot(x, v, "+", markersize=5, color="black")
        ax.set(xlabel="$x$ [m]", ylabel="$x'$ [m/s]")
        name(ax, f"{title}: {len(x)} steps")
    assert counts[0] > 2 * counts[1]


def attraction(ax):
    """Figs. 3.6 and 6.14: V, W and D, and three solutions: I and II end on the stable orbit, III in the equilibrium.
    The unstable orbit between them is found backwards in time."""
    system = gallery.thesis("6.7")
    v_dr = float(system.v_dr)
    guess = gallery.entry("6.7").orbit
    stable = nsjax.find_orbit(system, guess.y0, period=guess.period)
    plot.phase_portrait(stable, ax=ax, surfaces=False, events=False, legend=False, color="black", linewidth=2.4)
    # Backwards from where the field in V is parallel to the belt, round to the belt, and along it.
    leave = Motion((1.0 - 0.1 * v_dr), v_dr - 1e-9)
    back = nsjax.solve(system, 0.0, -6.5, leave, saveat=DENSE, **TIGHT)
    plot.phase_portrait(
        back, ax=ax, surfaces=False, events=False, legend=False, color="black", linestyle="--", linewidth=1.4
    )
    inside, outside = (max(float(np.max(arc.y["x"])) for arc in arcs(solved(one))) for one in (back, stable))
    assert 1.1 < inside < outside
    names = []
    for y0, text in (
        (Motion(outside + 0.4, 0.0), "I"),
        (Motion(0.5 * (inside + outside), 0.0), "II"),
        (Motion(inside - 0.05, 0.0), "III"),
    ):
        sol = nsjax.solve(system, 0.0, 12.0, y0, saveat=DENSE, **TIGHT)
        plot.phase_portrait(sol, ax=ax, surfaces=False, events=False, legend=False, color="C0", linewidth=0.9)
        names.append((float(y0.x), float(y0.v), text))
    ax.plot([1.0], [0.0], "ko", markersize=5)
    ax.axhline(v_dr, color="0.35", linestyle=":", linewidth=1.0)
    belt = "D: the belt, up to $F_{stick}$"
    for text, x, v in (("V", -0.25, -0.6), ("W", 0.2, v_dr + 0.18), (belt, 0.9, v_dr + 0.18)):
        ax.text(x, v, text, color="C2")
    ax.set(xlabel="$x$ [m]", ylabel="$x'$ [m/s]", ylim=(-1.6, v_dr + 0.4))
    write_names(ax, names)
    name(ax, "3.6 and 6.14")


def generalized(ax):
    """Fig. 4.3: a function with a kink, its derivative, and the generalized one."""
    x = np.linspace(-1, 1, 201)
    ax.plot(x, np.abs(x), label="f(x) = |x|")
    for side in (-1, 1):
        rate = nsjax.setvalued.generalized_jacobian(Kink(), Line(0.5 * side), tolerance=1e-9).vertices
        ax.plot([0, side], [float(np.ravel(rate)[0])] * 2, color="C1", label="f'(x)" if side > 0 else None)
    both = np.ravel(nsjax.setvalued.generalized_jacobian(Kink(), Line(0.0), tolerance=1e-9).vertices)
    np.testing.assert_allclose(np.sort(both), [-1, 1])
    ax.plot([0, 0], both, color="C3", linewidth=2.4, label="∂f(0)")
    ax.set(xlabel="$x$ [-]", ylabel="$f$, $f'$, $\\partial f$ [-]")
    ax.legend(fontsize="small")
    name(ax, "4.3")


def sketches(axes):
    """Figs. 2.6, 2.7 and 3.4, 3.8, 6.10, 6.17: the mechanisms."""
    soft = Viscoelastic(k=4.0, c=0.5)
    scenes = {
        "2.6": Scene(dict(x=1.0), floor=Friction("x", Coulomb(1.0)), F_ex=Harmonic("x", omega=1.0)),
        "2.7, 3.4": Scene(dict(x=1.0), k=Spring("x", k=1.0), c=Damper("x", c=0.1), F=Friction("x", slip=1.0, v=0.2)),
        "3.8a": Scene(
            dict(x=1.0), k=Spring("x", k=1.0), support=Contact({"x": -1}, soft), f_0=Harmonic("x", omega=1.0)
        ),
        "6.10": Scene(
            dict(x=1.0), k=Spring("x", k=1.0), c=Damper("x", c=0.1), upper=Contact({"x": -1}, soft, gap=1.0),
            lower=Contact("x", soft, gap=1.0), f_0=Harmonic("x", omega=1.0),
        ),
        "6.17": Scene(
            dict(x=1.0), k=Spring("x", k=1.0), c=Damper("x", c=0.1), F=Friction("x", slip=1.0),
            f_0=Harmonic("x", omega=1.0),
        ),
    }  # fmt: skip
    for ax, (number, scene) in zip(axes, scenes.items()):
        scene.sketch(ax=ax)
        name(ax, number)


def main():
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--out", type=pathlib.Path, default=HERE)
    args = parser.parse_args()
    matplotlib.use("Agg")
    jax.config.update("jax_enable_x64", True)
    fig, axes = plt.subplots(3, 3, figsize=(12.0, 10.5), layout="constrained")
    examples(axes[0])
    sliding(*axes[1, :2])
    laws(axes[1, 2])
    regions(axes[2, 0])
    by_both_methods(axes[2, 1:])
    fig.savefig(args.out / "thesis_2.png", dpi=80)
    fig, axes = plt.subplots(1, 2, figsize=(10.0, 3.8), layout="constrained", width_ratios=(1.5, 1))
    attraction(axes[0])
    generalized(axes[1])
    fig.savefig(args.out / "thesis_3_to_6.png", dpi=80)
    fig, axes = plt.subplots(1, 5, figsize=(15.0, 2.8), layout="constrained")
    sketches(axes)
    fig.savefig(args.out / "thesis_sketches.png", dpi=80)


if __name__ == "__main__":
    main()
