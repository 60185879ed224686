"""Curves of special points of periodic orbits in the plane of two parameters."""

from collections.abc import Callable
from typing import TYPE_CHECKING

import numpy as np

from ..continuation.bifurcations._continue_bifurcation import BifurcationCurve, CodimensionTwo
from ._diagram import write_names
from ._style import axes_or_new, axis_label, declared, Labels, legend as add_legend


if TYPE_CHECKING:
    from matplotlib.axes import Axes

COLORS = {
    "fold": "C0", "flip": "C2", "Neimark-Sacker": "C4", "symmetry breaking": "C9", "transcritical": "C8",
    "branch point": "C7", "grazing": "C3", "corner": "C1", "tangency": "C5",
}  # fmt: skip
NEAR = 0.03  # points that are nearer, in axes, are named together
Word = tuple[float, float, str]
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
    - `labels`: for the axes, as `{"omega": "ω [rad/s]"}`; by default the names with the units that the
        model declares.
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
    words: list[Word] = []
    for curve in curves:
        order = [curve.parameters.index(name) for name in (first, second)]
        x, y = curve.values[:, order].T
        style = dict(color=COLORS.get(curve.kind, "black"), linestyle="--" if curve.discontinuous else "-")
        ax.plot(x, y, linewidth=1.6, zorder=2, label=curve.name, **style)
        for point in curve.special:
            at = np.asarray(point.values)[order]
            ax.plot(at[:1], at[1:], **POINT)
            text = names(point) if callable(names) else point.name if names else ""
            words.append((float(at[0]), float(at[1]), text))
    ax.margins(0.08, 0.1)
    labels = declared(labels, curves[0].system)
    ax.set_xlabel(axis_label(labels, first))
    ax.set_ylabel(axis_label(labels, second))
    if legend:
        add_legend(ax)
    write_names(ax, _together(words, np.ptp(ax.get_xlim()), np.ptp(ax.get_ylim())))
    return ax


def _together(words: list[Word], width: float, height: float) -> list[Word]:
    """Names of points that lie close together, one below the other; curves that meet name their point each."""
    groups: list[list[Word]] = []
    for word in words:
        x, y, text = word
        near = (g for g in groups if abs(g[0][0] - x) < NEAR * width and abs(g[0][1] - y) < NEAR * height)
        group = next(near, None)
        if group is None:
            groups.append([word])
        elif text not in [other[2] for other in group]:
            group.append(word)
    return [(g[0][0], g[0][1], "\n".join(w[2] for w in g)) for g in groups if g[0][2]]
