"""Curves of special points of periodic orbits in the plane of two parameters."""

from collections.abc import Callable
from typing import TYPE_CHECKING

import numpy as np

from .._continue_bifurcation import BifurcationCurve, CodimensionTwo
from ._diagram import write_names
from ._style import axes_or_new, axis_label, Labels, legend as add_legend


if TYPE_CHECKING:
    from matplotlib.axes import Axes

COLORS = {
    "fold": "C0", "flip": "C2", "Neimark-Sacker": "C4", "symmetry breaking": "C9", "transcritical": "C8",
    "branch point": "C7", "grazing": "C3", "corner": "C1", "tangency": "C5",
}  # fmt: skip
POINT = dict(marker="o", linestyle="none", color="black", markersize=5.5, zorder=4)


def parameter_plane(
    *curves: BifurcationCurve,
    names: bool | Callable[[CodimensionTwo], str] = True,
    ax: "Axes | None" = None,
    labels: Labels = None,
    legend: bool = True,
) -> "Axes":
    """Draws curves of special points of periodic orbits in the plane of the two parameters: each kind in a colour of
    its own, those at which multipliers jump dashed, with their points of codimension two.

    **Arguments:**

    - `curves`: from `continue_bifurcation`, in the same two parameters (in either order).
    - `names`: whether to write what the points of codimension two are; or a function of a `CodimensionTwo` that gives
        the words, none if empty.
    - `ax`: where to draw; by default a new figure.
    - `labels`: for the axes, as `{"omega": "ω [rad/s]"}`.
    - `legend`: whether to explain the lines.

    **Returns:** the axes.

    **Raises:** `ValueError` if there is no curve, or one in other parameters than the first.
    """
    if not curves:
        raise ValueError("Argument `curves` must hold a curve at least, but is empty.")
    first, second = curves[0].parameters
    for curve in curves:
        if set(curve.parameters) != {first, second}:
            raise ValueError(
                f"Argument `curves` must be in the same two parameters, but there are {curve.parameters} besides "
                f"{(first, second)}."
            )
    ax = axes_or_new(ax)
    words = []
    for curve in curves:
        order = [curve.parameters.index(name) for name in (first, second)]
        x, y = curve.values[:, order].T
        style = dict(color=COLORS.get(curve.kind, "black"), linestyle="--" if curve.discontinuous else "-")
        ax.plot(x, y, linewidth=1.6, zorder=2, label=curve.name, **style)
        for point in curve.special:
            at = np.asarray(point.values)[order]
            ax.plot(at[:1], at[1:], **POINT)
            text = names(point) if callable(names) else point.name.replace(" at ", "\nat ") if names else ""
            words.append((float(at[0]), float(at[1]), text))
    ax.margins(0.08, 0.1)
    (left, right), (low, high) = ax.get_xlim(), ax.get_ylim()
    # Curves that meet name their point each; it is written once.
    places = {(round(200 * x / (right - left)), round(200 * y / (high - low))): (x, y, t) for x, y, t in words[::-1]}
    write_names(ax, [place for place in places.values() if place[2]])
    ax.set_xlabel(axis_label(labels, first))
    ax.set_ylabel(axis_label(labels, second))
    if legend:
        add_legend(ax)
    return ax
