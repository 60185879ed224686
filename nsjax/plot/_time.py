"""Components of the state against time."""

from typing import Any, TYPE_CHECKING

import jax
import numpy as np

from .._numerics._text import components
from ._path import arcs, chosen, solved
from ._style import axes_or_new, axis_label, declared, EVENT, JUMP, Labels, legend as add_legend, mode_line, once


if TYPE_CHECKING:
    from matplotlib.axes import Axes


def time_series(
    sol: Any,
    component: str | None = None,
    *,
    ax: "Axes | None" = None,
    labels: Labels = None,
    legend: bool = True,
) -> "Axes":
    """Draws one component of the state against time: coloured by mode, thick while it slides, with its events.

    **Arguments:**

    - `sol`: a `Solution` with `SaveAt(dense=True)` (or saved states), or an `Orbit`.
    - `component`: its name; by default the first.
    - `ax`: where to draw; by default a new figure.
    - `labels`: for the axes, as `{"t": "t [s]", "x": "x [m]"}`; by default the names, with the units that the
        classes of model and state declare: `x: Array  # [m]`, or `x: Array = eqx.field(metadata=dict(unit="m"))`.
    - `legend`: whether to explain the colours.

    **Returns:** the axes.

    **Raises:** `ValueError` for an unknown component, a batch of solutions, or one without states along the way.
    """
    sol = solved(sol)
    (name,) = chosen(components(sol.y1), [component])
    ax = axes_or_new(ax)
    for arc in arcs(sol):
        own = mode_line(sol.system, arc.mode)
        ax.plot(arc.t, arc.y[name], solid_capstyle="butt", **own | dict(label=once(ax, own["label"])))
    n = len(sol.events)
    times = np.asarray(sol.events.t[:n])
    log = (sol.events.y_before, sol.events.y_after)
    before, after = (components(jax.tree.map(lambda l: l[:n], state), ndim=1)[name] for state in log)
    for t, low, high in zip(times, before, after):
        if low != high:
            ax.plot([t, t], [low, high], **JUMP)
    ax.plot(times, after, label=once(ax, "event" if n else None), **EVENT)
    labels = declared(labels, sol.system, sol.y1)
    ax.set_xlabel(axis_label(labels, "t"))
    ax.set_ylabel(axis_label(labels, name))
    if legend:
        add_legend(ax)
    return ax
