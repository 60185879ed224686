"""Paths of set-valued eigenvalues in the complex plane."""

from typing import TYPE_CHECKING

import numpy as np

from ..setvalued._eigenvalue_crossings import EigenvaluePath
from ._diagram import write_names
from ._style import axes_or_new, axis_label, Labels, legend, once


if TYPE_CHECKING:
    from matplotlib.axes import Axes


def eigenvalue_path(path: EigenvaluePath, *, ax: "Axes | None" = None, labels: Labels = None) -> "Axes":
    """Draws the path along which eigenvalues jump, from q = 0 (hollow) to q = 1 (filled), with the imaginary axis, or
    the unit circle for multipliers, and the q of each crossing beside it; Figs. 5.2, 5.3, 5.13.

    **Arguments:**

    - `path`: from `nsjax.setvalued.eigenvalue_path`.
    - `ax`: where to draw; by default a new figure.
    - `labels`: for the axes, as `{"Re": "Re λ [1/s]", "Im": "Im λ [1/s]"}`; by default without units. And for the
        ends, as `{"q = 0": "q = 0: μ < 0", "q = 1": "q = 1: μ > 0"}`.

    **Returns:** the axes.
    """
    ax = axes_or_new(ax)
    values = path.eigenvalues
    if path.multipliers:
        angle = np.linspace(0, 2 * np.pi, 361)
        ax.plot(np.cos(angle), np.sin(angle), color="0.5", linewidth=1.0)
        ax.axvline(0, color="0.85", linewidth=0.8, zorder=0)
    else:
        ax.axvline(0, color="0.5", linewidth=1.0, zorder=1)
    ax.axhline(0, color="0.85", linewidth=0.8, zorder=0)
    for i, branch in enumerate(values.T):
        ax.plot(branch.real, branch.imag, color=f"C{i % 10}", linewidth=1.8)
    for at, face, name in ((0, "white", "q = 0"), (-1, "black", "q = 1")):
        style = dict(marker="o", linestyle="none", markersize=6, markeredgecolor="black", markerfacecolor=face)
        ax.plot(values[at].real, values[at].imag, label=axis_label(labels, name), zorder=4, **style)
    names = _draw_crossings(ax, path)
    if path.multipliers:
        ax.set_aspect("equal")
    ax.margins(0.08)
    unit = " [-]" if path.multipliers else ""
    ax.set_xlabel(axis_label(labels, "Re", f"Re λ{unit}"))
    ax.set_ylabel(axis_label(labels, "Im", f"Im λ{unit}"))
    legend(ax)
    write_names(ax, names)
    return ax


def _draw_crossings(ax: "Axes", path: EigenvaluePath) -> list[tuple[float, float, str]]:
    """Marks them, and says what is to be written beside which place."""
    cross = dict(marker="x", linestyle="none", markersize=8, markeredgewidth=2.0, color="C3", zorder=5)
    texts: dict[tuple[float, float], list[str]] = {}
    for c in path.crossings:
        if c.until != c.q:  # it stays on the axis, and is seen there
            continue
        for z in dict.fromkeys([c.eigenvalue, c.eigenvalue.conjugate()]):
            label = "crosses" if c.direction else "touches, or crosses both ways"
            ax.plot([z.real], [z.imag], label=once(ax, label), **cross)
            texts.setdefault((round(z.real, 9), round(z.imag, 9)), []).append(f"{c.q:.4g}")
    return [(*place, "q = " + ", ".join(dict.fromkeys(qs))) for place, qs in texts.items()]
