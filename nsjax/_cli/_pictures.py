"""The pictures that `run` writes."""

import pathlib
import re
import textwrap
from typing import Any

import numpy as np

from .. import plot
from ..derivatives._variational import matrices_along
from ..flow._solution import Solution
from ..flow._solve import solve
from ..orbits._orbit import Orbit
from ..orbits._passage import passage
from ..plot import components
from ..plot._path import arcs, solved
from ._job import Job
from ._report import Units


def draw(job: Job, sol: Solution, orbit: Orbit | None, out: pathlib.Path) -> list[pathlib.Path]:
    """Writes a phase portrait and time series, and for an orbit its fundamental matrix and multipliers.

    **Returns:** the files.
    """
    labels = Units.of(job).labels()
    names = list(components(sol.y1))
    figures = {"time-series": _time_series(sol, names, labels)}
    if len(names) > 1:
        figures["phase-portrait"] = _phase_portrait(sol, orbit, labels)
    if orbit is not None:
        figures["fundamental-matrix"] = _fundamental_matrix(orbit, names, labels)
        figures["multipliers"] = figure(4.5, 4.5)
        plot.multipliers(orbit, ax=figures["multipliers"].add_subplot())
    return save(job, figures, out)


def stem(job: Job) -> str:
    """The name of a job, as the names of its files begin with it."""
    return re.sub(r"[^\w.]+", "-", job.name.rpartition(":")[2] if not job.from_gallery else job.name).strip("-")


def save(job: Job, figures: dict[str, Any], out: pathlib.Path) -> list[pathlib.Path]:
    """Writes figures by their kind, with the name of the job in their file names and titles."""
    out.mkdir(parents=True, exist_ok=True)
    files = []
    title = f"{job.name}: {job.title}" if job.from_gallery else stem(job)
    for kind, drawn in figures.items():
        drawn.suptitle(textwrap.fill(title, int(11 * drawn.get_figwidth())), fontsize="medium")
        files.append(out / f"{stem(job)}-{kind}.png")
        drawn.savefig(files[-1], dpi=150)
    return files


def figure(width: float, height: float) -> Any:
    from matplotlib.figure import Figure  # not pyplot: no window, no state

    return Figure(figsize=(width, height), layout="constrained")


def _time_series(sol: Solution, names: list[str], labels: dict[Any, str]) -> Any:
    drawn = figure(8, 1.2 + 2.0 * len(names))
    axes = drawn.subplots(len(names), 1, sharex=True, squeeze=False)[:, 0]
    for i, (name, ax) in enumerate(zip(names, axes)):
        plot.time_series(sol, name, ax=ax, labels=labels, legend=i == 0)
        ax.label_outer()
    return drawn


def _phase_portrait(sol: Solution, orbit: Orbit | None, labels: dict[Any, str]) -> Any:
    drawn = figure(6.4, 5.2)
    ax = drawn.add_subplot()
    if orbit is None:
        plot.phase_portrait(sol, ax=ax, labels=labels)
        return drawn
    # The way to the orbit, in grey beneath it.
    plot.phase_portrait(
        sol, ax=ax, surfaces=False, events=False, legend=False, color="0.75", linewidth=0.8, label="simulation"
    )
    plot.phase_portrait(orbit, ax=ax, labels=labels)
    return drawn


def _fundamental_matrix(orbit: Orbit, names: list[str], labels: dict[Any, str]) -> Any:
    """Φ over one period; for an autonomous system from the maximum of the first component, as in Fig. 3.7."""
    n = len(names)
    drawn = figure(1.2 + 2.6 * n, 1.0 + 1.9 * n)
    period, t0, y0, sol = float(orbit.period), orbit.t0, orbit.y0, solved(orbit)
    if orbit.system.period is None:
        # Not at an event itself, where the flow has only one-sided derivatives.
        tops = [(arc.y[names[0]][1:-1].max(), arc.t[1 + arc.y[names[0]][1:-1].argmax()], arc.mode) for arc in arcs(sol)]
        _, top, mode = max(tops)
        t0, y0 = np.asarray(top, np.asarray(t0).dtype), sol.evaluate(top)
        sol = passage(orbit, t0, y0, mode)
        if sol is None:
            how = dict(mode=[int(m) for m in mode], throw=False) | orbit.integrator.arguments
            sol = solve(orbit.system, t0, t0 + period, y0, **how)
    jumps = np.sort((np.asarray(orbit.events.t)[: len(orbit.events)] - float(t0)) % period)
    nearby = 1e-9 * period  # both sides of each jump
    ts = np.sort(np.concatenate([np.linspace(0, period, 400), jumps - nearby, jumps + nearby]))
    phi = matrices_along(sol, y0, float(t0) + ts, orbit.integrator, throw=False)
    axes = drawn.subplots(n, n, sharex=True, squeeze=False)
    plot.fundamental_matrix(ts, phi, jumps, axes=axes, labels=labels)
    return drawn
