"""A bifurcation diagram that is asked with the mouse: a click on a branch shows what is there."""

from collections.abc import Callable
from typing import Any, TYPE_CHECKING

import jax
import numpy as np

from .._numerics._text import components, written
from ..continuation.equilibria._branch import Branch
from ..continuation.orbits._branch import OrbitBranch
from ..flow._results import is_okay
from ..orbits._orbit import Orbit
from ._branch import bifurcation_diagram, heights_of
from ._orbit_branch import measured, orbit_diagram
from ._phase import phase_portrait
from ._style import Labels


if TYPE_CHECKING:
    from matplotlib.figure import Figure

# Fixed, so that nothing in the diagram moves when something else is shown beside it.
PLACE = dict(left=0.07, right=0.98, bottom=0.24, top=0.84, wspace=0.2)
CHOSEN = dict(marker="o", markersize=9, markerfacecolor="none", markeredgecolor="black", markeredgewidth=1.6, zorder=6)


class Explorer:
    """What `plot.explore` returns: the figure, and what was clicked last.

    **Attributes:**

    - `figure`: with the diagram, `diagram`, and beside it the axes `detail` of the point.
    - `selected`: the number of the branch among `branch.branches`, and of the point on it; None before the first click.
    - `orbit`: the `Orbit` there; None on branches of equilibria, or if none was found.
    """

    def __init__(self, branch: Branch | OrbitBranch, measure: Any, options: dict[str, Any], labels: Labels):
        import matplotlib.pyplot as plt

        self.branch, self.selected, self.orbit = branch, None, None
        self._options, self._labels = options, labels
        self._orbits: dict[tuple[int, int], Orbit | None] = {}
        self.figure: Figure
        self.figure, (self.diagram, self.detail) = plt.subplots(1, 2, figsize=(11, 4.9), gridspec_kw=PLACE)
        if isinstance(branch, OrbitBranch):
            orbit_diagram(branch, measure, ax=self.diagram, labels=labels)
            heights = [measured(measure, one) for one in branch.branches]
        else:
            bifurcation_diagram(branch, measure, ax=self.diagram, labels=labels)
            heights = [heights_of(one, measure) for one in branch.branches]
        self._places = [np.stack([one.values, height], axis=-1) for one, height in zip(branch.branches, heights)]
        (self._mark,) = self.diagram.plot([], [], linestyle="none", **CHOSEN)
        self._say("click on a branch")
        # As a function it lives as long as the figure does; of a method matplotlib holds a weak reference only.
        self.figure.canvas.mpl_connect("button_press_event", lambda event: self._clicked(event))

    def _clicked(self, event: Any) -> None:
        busy = getattr(self.figure.canvas, "toolbar", None)
        if event.inaxes is self.diagram and not (busy is not None and busy.mode):  # it may be zooming
            self.select(*self.nearest(event.x, event.y))

    def nearest(self, x: float, y: float) -> tuple[int, int]:
        """The branch and the point that is drawn nearest to a place in the figure [pixel]."""
        best: tuple[float, int, int] = (np.inf, 0, 0)
        for k, places in enumerate(self._places):
            gaps = np.linalg.norm(self.diagram.transData.transform(places) - (x, y), axis=1)
            gaps = np.where(np.isfinite(gaps), gaps, np.inf)
            i = int(np.argmin(gaps))
            best = min(best, (float(gaps[i]), k, i))
        return best[1:]

    def select(self, branch: int, point: int) -> Orbit | None:
        """Shows a point, as a click on it does.

        **Arguments:**

        - `branch`: the number of the branch among `branch.branches`.
        - `point`: that of the point on it.

        **Returns:** the orbit there, if there is one.
        """
        one, place = self.branch.branches[branch], self._places[branch][point]
        self.selected = branch, point
        self._mark.set_data([place[0]], [place[1]])
        self.detail.clear()
        if isinstance(one, OrbitBranch):
            self._say("looking for the orbit")
            self.figure.canvas.draw_idle()
            self.figure.canvas.flush_events()  # the first one takes as long as a program takes to compile
            self.detail.clear()
            self.orbit = self._orbit_at(one, branch, point)
            self._show_orbit(one, point)
        else:
            self._show_eigenvalues(one, point)
        self.figure.canvas.draw_idle()
        return self.orbit

    def _say(self, text: str) -> None:
        self.detail.set_axis_off()
        self.detail.text(0.5, 0.5, text, transform=self.detail.transAxes, ha="center", va="center", color="0.4")

    def _headline(self, one: Any, point: int, *words: str) -> None:
        value = f"{one.parameter} = {one.values[point]:.6g}"
        self.detail.text(
            0.5, -0.2, "\n".join([", ".join([value, *words[:-1]]), words[-1]]), transform=self.detail.transAxes,
            ha="center", va="top", fontsize="small",
        )  # fmt: skip

    def _orbit_at(self, one: OrbitBranch, branch: int, point: int) -> Orbit | None:
        if (branch, point) not in self._orbits:
            self._orbits[branch, point] = found_at(one, point, self._options)
        return self._orbits[branch, point]

    def _show_orbit(self, one: OrbitBranch, point: int) -> None:
        if self.orbit is None:
            why = (
                "a virtual branch: the system has no such orbit" if not one.admissible[point] else "no orbit was found"
            )
            self._say(why)
            return
        self.detail.set_axis_on()
        if len(components(self.orbit.y0)) > 1:
            phase_portrait(self.orbit, ax=self.detail, labels=self._labels)
        else:
            path = self.orbit.path()
            self.detail.plot(np.ravel(path.t), np.ravel(jax.tree.leaves(path.y)[0]))
        stable = "stable" if one.stable[point] else "unstable"
        self._headline(one, point, f"period {one.periods[point]:.6g}", stable, one.itineraries[point])

    def _show_eigenvalues(self, one: Branch, point: int) -> None:
        self.detail.set_axis_on()
        values = np.asarray(one.eigenvalues[point], complex)
        values = values[np.isfinite(values)]
        self.detail.axvline(0.0, color="0.75", linewidth=0.9, zorder=0)
        self.detail.plot(np.real(values), np.imag(values), linestyle="none", marker="x", color="C0", markersize=7)
        self.detail.margins(0.2)
        self.detail.set_xlabel("Re λ [1/time]")
        self.detail.set_ylabel("Im λ [1/time]")
        state = written(jax.tree.map(lambda x: x[point], one.ys))
        self._headline(one, point, "stable" if one.stable[point] else "unstable", state)


def found_at(one: OrbitBranch, point: int, options: dict[str, Any]) -> Orbit | None:
    """By shooting, which is one program for all points; and where that fails in segments, as violent orbits need."""
    if not one.admissible[point]:
        return None
    ways = [options] if "method" in options else [dict(method="shooting") | options, options]
    for how in ways:
        found = one.orbit(point, throw=False, **how)
        near = abs(float(found.period) - one.periods[point]) <= 1e-6 * abs(one.periods[point])
        if bool(is_okay(found.result)) and near:
            return found
    return None


def explore(
    branch: Branch | OrbitBranch,
    measure: str | Callable[[Any], Any] | None = None,
    *,
    labels: Labels = None,
    **options: Any,
) -> Explorer:
    """Draws branches, and shows what is at a point of them when it is clicked: the orbit in the phase plane, with its
    period and its itinerary; of an equilibrium the eigenvalues.

    It works in the windows of matplotlib, and in notebooks after `%matplotlib widget` (`pip install ipympl`). The first
    click on a branch of orbits takes as long as the program that finds them takes to compile. Where no clicks come, as
    in a script, `Explorer.select` does the same.

    ```python
    branch = nsjax.continue_orbit(system, orbit, "omega", (0.5, 2.0))
    explorer = nsjax.plot.explore(branch)
    plt.show()
    explorer.orbit  # of the point that was clicked last
    ```

    **Arguments:**

    - `branch`: from `continue_orbit` or `continue_equilibrium`; its other branches are drawn too.
    - `measure`: as for `plot.orbit_diagram` or `plot.bifurcation_diagram`.
    - `labels`: for the axes, as `{"omega": "ω [rad/s]", "x": "x [m]"}`.
    - `options`: for `OrbitBranch.orbit`.

    **Returns:** the `Explorer`.

    **Raises:** `TypeError` for what is no branch.
    """
    if not isinstance(branch, Branch | OrbitBranch):
        raise TypeError(f"Argument `branch` must be a `Branch` or an `OrbitBranch`, but got {type(branch).__name__}.")
    return Explorer(branch, measure, options, labels)
