"""The phase plane: trajectories with the surfaces they meet, and Poincaré sections."""

import itertools
from typing import Any, TYPE_CHECKING

import jax
import jax.flatten_util
import jax.numpy as jnp
import numpy as np

from .._numerics._jaxpr import is_constant
from .._numerics._text import components
from .._types import Y
from ..flow._solution import Solution
from ..orbits._orbit import Orbit
from ..system._switch import AbstractSwitch
from ._path import arcs, chosen, solved
from ._style import axes_or_new, axis_label, declared, EVENT, JUMP, Labels, legend as add_legend, mode_line, once


if TYPE_CHECKING:
    from matplotlib.axes import Axes

DASHES = (0, (4, 1.5))  # in widths of the line
STYLES = ("--", ":", "-.")  # of the surfaces of one switch
GRID = 201  # points along each axis on which the indicator functions are drawn


def phase_portrait(
    sol: Any,
    x: str | None = None,
    y: str | None = None,
    *,
    ax: "Axes | None" = None,
    labels: Labels = None,
    surfaces: bool = True,
    events: bool = True,
    legend: bool = True,
    **style: Any,
) -> "Axes":
    """Draws a trajectory in the phase plane: coloured by mode, thick where it slides, with its events; Fig. 3.5.

    For a state of two components the surfaces h = 0 are drawn as lines with the signs of h beside them, the region
    h < 0 lightly shaded, and hatched where an impact forbids it. (A surface that moves with time is left out.) An orbit
    that is not stable is dashed.

    **Arguments:**

    - `sol`: a `Solution` with `SaveAt(dense=True)` (or saved states), or an `Orbit`.
    - `x`, `y`: names of components of the state; by default the first two.
    - `ax`: where to draw; by default a new figure.
    - `labels`: for the axes, as `{"x": "x [m]"}`; by default the names of the components, with the units that
        their class declares, in comments or metadata.
    - `surfaces`, `events`: whether to draw them.
    - `legend`: whether to explain the colours.
    - `style`: properties of the line, as in `Axes.plot`, in place of those of the mode.

    **Returns:** the axes.

    **Raises:** `ValueError` for an unknown component, a batch of solutions, or one without states along the way.
    """
    unstable = isinstance(sol, Orbit) and not np.all(sol.stable)
    sol = solved(sol)
    x, y = chosen(components(sol.y1), [x, y])
    ax = axes_or_new(ax)
    if unstable:
        style = dict(linestyle=DASHES) | style
        ax.plot([], [], color="0.35", linestyle=style["linestyle"], label=once(ax, "unstable"))
    for arc in arcs(sol):
        own = mode_line(sol.system, arc.mode) | style
        ax.plot(arc.y[x], arc.y[y], solid_capstyle="butt", **own | dict(label=once(ax, own["label"])))
    if events:
        _draw_events(ax, sol, x, y)
    labels = declared(labels, sol.system, sol.y1)
    ax.set_xlabel(axis_label(labels, x))
    ax.set_ylabel(axis_label(labels, y))
    if surfaces and len(components(sol.y1)) == 2:
        _draw_surfaces(ax, sol, x, y)
    if legend:
        add_legend(ax)
    return ax


def _draw_events(ax: "Axes", sol: Solution, x: str, y: str) -> None:
    n = len(sol.events)
    log = (sol.events.y_before, sol.events.y_after)
    before, after = (components(jax.tree.map(lambda l: l[:n], state), ndim=1) for state in log)
    for i in np.flatnonzero((before[x] != after[x]) | (before[y] != after[y])):
        ax.plot([before[x][i], after[x][i]], [before[y][i], after[y][i]], **JUMP)
    ax.plot(after[x], after[y], label=once(ax, "event" if n else None), **EVENT)


def _draw_surfaces(ax: "Axes", sol: Solution, x: str, y: str) -> None:
    ax.margins(0.08)  # room for the signs beside a surface that the trajectory slides on
    xlim, ylim = ax.get_xlim(), ax.get_ylim()
    along = [np.linspace(*lim, GRID) for lim in (xlim, ylim)]
    plane = np.stack(np.meshgrid(*along), axis=-1)
    # Components stand in the order in which the state is raveled.
    if list(components(sol.y1)) != [x, y]:
        plane = plane[..., ::-1]
    flat, unravel = jax.flatten_util.ravel_pytree(sol.y1)
    plane = jnp.asarray(plane, flat.dtype).reshape(-1, 2)
    drawn = np.concatenate([np.asarray(line.get_xydata())[::4] for line in ax.get_lines()])
    for switch in sol.system.switches:
        surfaces = jax.jit(jax.vmap(lambda point, k=switch: k.drawn(sol.system, sol.t0, unravel(point))))(plane)
        labels = list(switch.drawn(sol.system, sol.t0, sol.y1))  # in their order, which transformations do not keep
        for label, style in zip(labels, itertools.cycle(STYLES)):
            if not is_constant(lambda t, k=switch, label=label: k.drawn(sol.system, t, sol.y1)[label], sol.t0):
                continue
            h = np.asarray(surfaces[label]).reshape(GRID, GRID)
            if h.min() < 0 < h.max():
                _draw_surface(ax, switch, label, (along[0], along[1], h), style, drawn)
    ax.set_xlim(xlim)
    ax.set_ylim(ylim)


def _draw_surface(
    ax: "Axes", switch: AbstractSwitch, label: str, field: tuple[np.ndarray, ...], style: str, drawn: np.ndarray
) -> None:
    """Draws the zeros of h, with what `switch` says of their two sides. `field`: x, y, and h on their grid."""
    x, y, h = field
    line = dict(colors="0.35", linestyles=style, linewidths=1.0)
    contour = ax.contour(x, y, h, levels=[0.0], zorder=1, **line)
    ax.plot([], [], color="0.35", linestyle=style, linewidth=1.0, label=once(ax, label))
    if switch.signed:
        ax.contourf(x, y, h, levels=[h.min() - 1, 0.0], colors=["0.5"], alpha=0.12, zorder=0)
    elif switch.unilateral:
        filled = ax.contourf(x, y, h, levels=[h.min() - 1, 0.0], colors=["none"], hatches=["////"], zorder=0)
        filled.set_edgecolor("0.8")
    if not switch.levels:
        vertices = np.concatenate([p.vertices for p in contour.get_paths()])
        _draw_signs(ax, vertices, x, y, h, drawn)


def _draw_signs(
    ax: "Axes", vertices: np.ndarray, x: np.ndarray, y: np.ndarray, h: np.ndarray, drawn: np.ndarray
) -> None:
    """Writes + and - on either side of the surface, at its point that is farthest from what is drawn, and the frame."""
    corner, size = np.array([x[0], y[0]]), np.array([x[-1] - x[0], y[-1] - y[0]])
    place = (vertices - corner) / size  # in [0, 1] along both axes
    room = np.array([np.abs(p - (drawn - corner) / size).max(axis=-1).min() for p in place])
    room = np.minimum(room, np.minimum(place, 1 - place).min(axis=-1) + 0.02)
    best = int(np.argmax(room))
    column, row = np.round(place[best] * (GRID - 1)).astype(int)
    slope = np.array([np.gradient(h, axis=1)[row, column], np.gradient(h, axis=0)[row, column]])
    slope = slope / (np.linalg.norm(slope) or 1.0)
    for text, side in (("+", 1), ("−", -1)):
        ax.annotate(
            text,
            vertices[best],
            7 * side * slope,
            textcoords="offset points",
            ha="center",
            va="center",
            color="0.35",
            fontsize="small",
        )


def poincare_section(
    points: Y,
    x: str | None = None,
    y: str | None = None,
    *,
    ax: "Axes | None" = None,
    labels: Labels = None,
    **style: Any,
) -> "Axes":
    """Draws the points at which trajectories pierce a section, as dots.

    **Arguments:**

    - `points`: states, leaves with one leading axis.
    - `x`, `y`: names of components of the state; by default the first two.
    - `ax`: where to draw; by default a new figure.
    - `labels`: for the axes, as `{"x": "x [m]"}`.
    - `style`: for the dots, as in `Axes.plot`.

    **Returns:** the axes.

    **Raises:** `ValueError` for an unknown component.
    """
    values = components(points, ndim=1)
    x, y = chosen(values, [x, y])
    ax = axes_or_new(ax)
    style = dict(marker=".", markersize=2, linestyle="none") | style
    ax.plot(values[x], values[y], **style)
    labels = declared(labels, points)
    ax.set_xlabel(axis_label(labels, x))
    ax.set_ylabel(axis_label(labels, y))
    return ax
