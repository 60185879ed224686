"""Basins of attraction over two components of the state."""

from typing import Any, TYPE_CHECKING

import numpy as np

from .._numerics._text import components
from ..maps._basins import Basins
from ._path import chosen
from ._style import axes_or_new, axis_label, declared, Labels, legend as add_legend


if TYPE_CHECKING:
    from matplotlib.axes import Axes

REST = ("failed", "undecided")  # labels -2 and -1
MARK = dict(linestyle="none", marker="o", markersize=6, markeredgecolor="black", zorder=4)


def basins(
    found: Basins,
    x: Any = None,
    y: Any = None,
    *,
    ax: "Axes | None" = None,
    labels: Labels = None,
    legend: bool = True,
) -> "Axes":
    """Draws the basins of a grid: a colour for each attractor, with its points where they lie within the grid; white
    where a start is undecided, grey where its solution failed.

    ```python
    nsjax.plot.basins(found, "x", "v", labels={"x": "x(0) [m]", "v": "v(0) [m/s]"})
    ```

    **Arguments:**

    - `found`: what `nsjax.basins` returned for a grid with two axes.
    - `x`, `y`: the components of the state that change along the second and the first axis; by default the first two.
    - `ax`: where to draw; by default a new figure.
    - `labels`: for the axes, by component.
    - `legend`: whether to name attractors.

    **Returns:** the axes.

    **Raises:** `ValueError` for starts that are no grid.
    """
    if found.labels.ndim != 2:
        raise ValueError(f"Only a grid with two axes can be drawn, but the starts have the shape {found.labels.shape}.")
    from matplotlib.colors import ListedColormap

    values = components(found.starts, 2)
    x, y = chosen(values, [x, y])
    across, up = values[x][0], values[y][:, 0]
    if not (np.allclose(values[x], across) and np.allclose(values[y], up[:, None])):
        raise ValueError(f"The starts are no grid over {x!r} and {y!r}: {x!r} must change along the second axis only.")
    ax = axes_or_new(ax)
    number = len(found.attractors)
    colours = ["0.75", "white", *(f"C{k % 10}" for k in range(number))]
    ax.pcolormesh(
        across,
        up,
        found.labels,
        cmap=ListedColormap(colours),
        vmin=-2.5,
        vmax=number - 0.5,
        alpha=0.55,
        rasterized=True,
    )
    for k, points in enumerate(found.attractors):
        at = components(points, 1)
        ax.plot(at[x], at[y], color=f"C{k % 10}", label=f"attractor {k}: {_points(len(at[x]))}", **MARK)
    for value, word in zip((-2, -1), REST):
        if (found.labels == value).any():
            box = dict(marker="s", linestyle="none", markersize=8, markeredgecolor="0.5")
            ax.plot([], [], markerfacecolor=colours[value + 2], label=word, **box)
    ax.set(xlim=(across.min(), across.max()), ylim=(up.min(), up.max()))
    labels = declared(labels, found.starts)
    ax.set(xlabel=axis_label(labels, x), ylabel=axis_label(labels, y))
    if legend:
        add_legend(ax)
    return ax


def _points(number: int) -> str:
    return "a point" if number == 1 else f"{number} points"
