"""Time against error."""

from typing import Any, TYPE_CHECKING

import numpy as np

from ._style import axes_or_new, legend as add_legend


if TYPE_CHECKING:
    from matplotlib.axes import Axes

_MARKERS = "os^vDPX<>*"


def work_precision(
    table: Any, *, ax: "Axes | None" = None, against: str = "seconds", unit: str = "", legend: bool = True
) -> "Axes":
    """Draws what accuracy costs: both axes logarithmic, a line for each method, a point for each tolerance.

    **Arguments:**

    - `table`: what `nsjax.work_precision` returned.
    - `ax`: where to draw; by default a new figure.
    - `against`: "seconds" or "evaluations" (of the vector field, if they were counted).
    - `unit`: that of the quantity, for the label.
    - `legend`: whether to name the methods.

    **Returns:** the axes. Errors below the doubt in the reference are in the shaded part.

    **Raises:** `ValueError` if `against` is neither, or was not counted.
    """
    if against not in ("seconds", "evaluations"):
        raise ValueError(f"Argument `against` must be 'seconds' or 'evaluations', but got {against!r}.")
    rows = [r for r in table.rows if not r.failure]
    if against == "evaluations" and any(r.evaluations is None for r in rows):
        raise ValueError("Argument `against` must be 'seconds' for a table made without `count=True`.")
    ax = axes_or_new(ax)
    floor = max(table.doubt, 1e-16)
    for i, method in enumerate(dict.fromkeys(r.method for r in rows)):
        line = [r for r in rows if r.method == method]
        style = dict(marker=_MARKERS[i % len(_MARKERS)], markersize=5, linewidth=1.2, color=f"C{i % 10}")
        error = np.maximum([r.error for r in line], floor)
        ax.plot(error, [getattr(r, against) for r in line], label=method, **style)
    ax.set_xscale("log")
    ax.set_yscale("log")
    low, high = ax.get_xlim()
    if table.doubt > 0:
        ax.axvspan(low, max(low, table.doubt), color="0.9", zorder=0)
    ax.set_xlim(high, low)
    ax.set_xlabel(f"error{f' [{unit}]' if unit else ''}")
    ax.set_ylabel("time [s]" if against == "seconds" else "evaluations of the vector field [-]")
    ax.grid(True, which="major", color="0.9")
    if legend:
        add_legend(ax)
    return ax
