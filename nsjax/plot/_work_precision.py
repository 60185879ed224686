"""Time against error."""

from collections.abc import Iterable
from typing import Any, TYPE_CHECKING

import numpy as np

from ._style import axes_or_new, legend as add_legend


if TYPE_CHECKING:
    from matplotlib.axes import Axes

# What a name may hold, and the number of its colour and mark: first what is solved in place of the system, as the
# solver says less then.
_WORDS = {
    "band": 6, "switch model": 6, "arctan": 4, "linear": 5, "smooth": 4, "tsit5": 0, "dopri8": 1, "taylor": 2,
    "exponential": 3, "affine": 7, "kvaerno": 8,
}  # fmt: skip
_MARKERS = "os^vDPX<>*"
_LINES = ("-", "--", ":", "-.")  # of methods with one colour


def method_colors(names: Iterable[str]) -> dict[str, int]:
    """The number of the colour of each method: in every picture the same for a method whose name says what it is, and
    for others one that is left."""
    names = list(names)
    known = {name: next((c for word, c in _WORDS.items() if word in name.lower()), None) for name in names}
    free = [c for c in (9, 7, 8, 3, 5, 4, 2, 1, 0, 6) if c not in known.values()]
    others = [name for name, c in known.items() if c is None]
    return {name: c for name, c in known.items() if c is not None} | {
        name: (free or [9])[i % len(free or [9])] for i, name in enumerate(others)
    }


def work_precision(
    table: Any, *, ax: "Axes | None" = None, against: str = "seconds", unit: str = "", legend: bool = True
) -> "Axes":
    """Draws what accuracy costs: both axes logarithmic, a line for each method, a point for each tolerance.

    A method whose name holds that of its solver ("Tsit5", "Dopri8", "Taylor", "Exponential", "Affine"), or of what is
    solved in place of the system ("arctan", "linear", "band"), has the same colour in every picture; several that share
    a colour differ in their line style.

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
    colors = method_colors(dict.fromkeys(r.method for r in rows))
    for method in dict.fromkeys(r.method for r in rows):
        line = [r for r in rows if r.method == method]
        number = colors[method]
        alike = [name for name in dict.fromkeys(r.method for r in rows) if colors[name] == number].index(method)
        style = dict(color=f"C{number}", marker=_MARKERS[number], linestyle=_LINES[alike % len(_LINES)])
        error = np.maximum([r.error for r in line], floor)
        ax.plot(error, [getattr(r, against) for r in line], label=method, markersize=5, linewidth=1.2, **style)
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
