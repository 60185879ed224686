"""Bifurcation diagrams."""

from collections.abc import Callable, Sequence
from typing import Any, TYPE_CHECKING

import jax
import numpy as np

from .._bifurcation import Bifurcation, NOT_BIFURCATIONS
from .._branch import Branch
from .._orbit import Orbit
from .._parameter import get_parameter, parameter_path
from ._eigenvalues import PLATE
from ._path import components
from ._style import axes_or_new, axis_label, Labels, legend as add_legend


if TYPE_CHECKING:
    from matplotlib.axes import Axes

LINE = dict(color="black", linewidth=1.6)
PERIODIC = dict(color="0.6", linewidth=1.6)
UNSTABLE = (0, (4, 2))


def bifurcation_diagram(
    branch: Branch,
    measure: str | Callable[[Any], Any] | None = None,
    *,
    orbits: Sequence[Sequence[Orbit]] = (),
    ax: "Axes | None" = None,
    labels: Labels = None,
    legend: bool = True,
) -> "Axes":
    """Draws branches of equilibria over the parameter, stable ones solid, unstable ones dashed, with their special
    points; and branches of periodic orbits in grey; Figs. 5.4 to 5.16.

    **Arguments:**

    - `branch`: from `continue_equilibrium`; its other branches are drawn too.
    - `measure`: the scalar [x] that stands for the state (section 5.1): the name of a component, or a function of the
        state; by default the first component.
    - `orbits`: branches of periodic orbits, each a sequence in the order of the parameter; their largest and least
        measure along the orbit is drawn.
    - `ax`: where to draw; by default a new figure.
    - `labels`: for the axes, as `{"mu": "μ [-]", "x": "x [m]"}`, a function of the state being "measure".
    - `legend`: whether to explain the lines.

    **Returns:** the axes.

    **Raises:** `ValueError` for an unknown component.
    """
    ax = axes_or_new(ax)
    names = list(components(jax.tree.map(lambda x: x[0], branch.ys)))
    if measure is None:
        measure = names[0]
    if isinstance(measure, str) and measure not in names:
        raise ValueError(f"Argument `measure` must be one of {', '.join(names)}, or a function, but got {measure!r}.")
    for one in branch.branches:
        _stretches(ax, one.values, _measured(measure, one.ys), one.stable, LINE, "equilibrium")
    for family in orbits:
        _periodic(ax, family, branch.parameter, measure)
    points: dict[int, Bifurcation] = {}
    for one in branch.branches:
        points |= {id(special): special for special in one.special}
    _name(ax, [_point(ax, special, measure) for special in points.values()])
    name = measure if isinstance(measure, str) else "measure"
    ax.set_xlabel(axis_label(labels, branch.parameter))
    ax.set_ylabel(axis_label(labels, name))
    if legend:
        add_legend(ax)
    return ax


def _measured(measure: str | Callable[[Any], Any], ys: Any) -> np.ndarray:
    """Of states with a leading axis."""
    if isinstance(measure, str):
        return np.asarray(components(ys, 1)[measure])
    return np.asarray(jax.vmap(measure)(ys))


def _stretches(ax: "Axes", x: np.ndarray, y: np.ndarray, stable: np.ndarray, style: dict[str, Any], what: str) -> None:
    """Lines, each stable or unstable from end to end. A change between two points is at the first of them, where these
    are one corner seen from both sides, and at the second, where that is the special point."""
    start = 0
    for end in range(1, len(x) + 1):
        if end < len(x) and stable[end] == stable[start]:
            continue
        last = min(end + 1, len(x))
        line = dict(linestyle="-" if stable[start] else UNSTABLE, label=f"{'' if stable[start] else 'un'}stable {what}")
        ax.plot(x[start:last], y[start:last], zorder=2, **style, **line)
        start = end


def _periodic(ax: "Axes", family: Sequence[Orbit], parameter: str, measure: str | Callable[[Any], Any]) -> None:
    values, most, least, stable = [], [], [], []
    for orbit in family:
        path = jax.tree.map(lambda x: x.reshape(-1), orbit.path().y)
        along = _measured(measure, path)
        values.append(float(get_parameter(orbit.system, parameter_path(orbit.system, parameter))))
        most.append(np.nanmax(along))
        least.append(np.nanmin(along))
        stable.append(bool(orbit.stable))
    for extreme in most, least:
        _stretches(ax, np.array(values), np.array(extreme), np.array(stable), PERIODIC, "periodic orbit")


def _point(ax: "Axes", special: Bifurcation, measure: str | Callable[[Any], Any]) -> tuple[float, float, str]:
    """Marks it, and says where it is and what is written beside it."""
    height = float(_measured(measure, jax.tree.map(lambda x: np.asarray(x)[None], special.y))[0])
    face = "C3" if special.discontinuous else "C0"
    style = dict(marker="o", linestyle="none", markersize=6, zorder=4, color=face)
    if special.kind in NOT_BIFURCATIONS:
        style |= dict(markersize=5, markerfacecolor="white", markeredgecolor="0.3")
    ax.plot([special.value], [height], **style)
    text = special.name.partition(":")[0].replace("discontinuous ", "discontinuous\n").replace(" bifurcation, ", ",\n")
    return special.value, height, text if special.kind == "none" else text.removesuffix(" bifurcation")


def _name(ax: "Axes", points: Sequence[tuple[float, float, str]]) -> None:
    """Writes beside each point, on the side where fewest lines and other words are."""
    (x0, x1), (y0, y1) = ax.get_xlim(), ax.get_ylim()

    def placed(x: Any, y: Any) -> np.ndarray:
        return np.stack([(np.asarray(x) - x0) / (x1 - x0), (np.asarray(y) - y0) / (y1 - y0)], axis=-1)

    taken = [placed(line.get_xdata(), line.get_ydata()) for line in ax.lines]
    dense = [np.linspace(a, b, 50) for line in taken for a, b in zip(line[:-1], line[1:])]
    occupied = np.concatenate([*taken, *dense])
    for x, y, text in points:
        at = placed(x, y)
        size = np.array([0.03 + 0.016 * max(map(len, text.split("\n"))), 0.07 * (1 + text.count("\n"))])

        def covered(way: np.ndarray) -> int:
            offset = (occupied - at) * way / size
            edge = at + way * size
            return int(np.sum(np.all((offset > 0) & (offset < 1), axis=1))) + 10_000 * int(
                np.any((edge < 0) | (edge > 1))
            )

        way = min((np.array(w) for w in ((1, -1), (1, 1), (-1, 1), (-1, -1))), key=covered)
        align = dict(ha="left" if way[0] > 0 else "right", va="bottom" if way[1] > 0 else "top")
        place = dict(xytext=tuple(8 * way), textcoords="offset points", fontsize="small", bbox=PLATE, zorder=1)
        ax.annotate(text, (x, y), **place, **align)
        corners = np.linspace(0, 1, 8)
        grid = np.stack(np.meshgrid(corners, corners), axis=-1).reshape(-1, 2)
        occupied = np.concatenate([occupied, np.repeat(at + way * size * grid, 20, axis=0)])
