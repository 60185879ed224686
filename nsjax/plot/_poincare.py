"""Poincaré maps of one component against the diagonal, and brute-force bifurcation diagrams."""

from collections.abc import Callable
from typing import Any, TYPE_CHECKING

import jax
import numpy as np

from .._numerics._text import components
from ..maps._brute_force import BruteForce
from ._path import chosen
from ._style import axes_or_new, axis_label, declared, JUMP, Labels, legend as add_legend


if TYPE_CHECKING:
    from matplotlib.axes import Axes

DIAGONAL = dict(color="0.6", linewidth=0.9, zorder=1)
COBWEB = dict(color="C1", linewidth=0.9, zorder=2)
POINT = dict(linestyle="none", marker="o", markersize=6, markeredgecolor="black", zorder=4)
STEEP = 5.0  # how many times the slopes beside it a slope is that counts as a jump
DOTS = dict(linestyle="none", marker=".", markersize=1.2, color="0.25", zorder=1, rasterized=True)


def poincare_map(
    x: Any,
    image: Any,
    *,
    cobweb: Any = None,
    fixed_points: bool = True,
    ax: "Axes | None" = None,
    labels: Labels = None,
    legend: bool = True,
    **style: Any,
) -> "Axes":
    """Draws a map of one number into one, with the diagonal and its fixed points on it, where the slope is less than 1
    (filled) and where it is not (hollow); Figs. 6.4, 6.5, 6.16 and 6.23.

    Where the map is NaN the line is interrupted, and where it jumps it is dotted. A jump over the diagonal
    counts as a fixed point of infinite slope: an orbit that leaves a surface which repels, as in Fig. 6.16, is one.

    **Arguments:**

    - `x`: values, in rising order, shape `(n,)`.
    - `image`: their images, shape `(n,)`; those of `nsjax.poincare_map`, or of `nsjax.reduced_map`.
    - `cobweb`: iterates x_0, x_1, ... to be drawn as a staircase between map and diagonal; see `iterates=` of
        `nsjax.poincare_map`.
    - `fixed_points`: whether to mark them; they are interpolated between samples.
    - `ax`: where to draw; by default a new figure.
    - `labels`: for the axes, as `{"x": "$x_n$ [m]", "image": "$x_{n+1}$ [m]"}`.
    - `legend`: whether to explain the marks.
    - `style`: properties of the line, as in `Axes.plot`.

    **Returns:** the axes.

    **Raises:** `ValueError` for shapes that do not fit, or an `x` that does not rise.
    """
    x, image = np.asarray(x), np.asarray(image)
    if x.ndim != 1 or x.shape != image.shape or len(x) < 2:
        raise ValueError(
            f"Arguments `x` and `image` must be vectors of one length, 2 or more, but are {x.shape} and {image.shape}."
        )
    if not np.all(np.diff(x) > 0):
        raise ValueError("Argument `x` must rise, but does not; sort it, and `image` with it.")
    ax = axes_or_new(ax)
    jumps = _jumps(x, image)
    cuts = np.flatnonzero(jumps) + 1
    line = dict(color="black", linewidth=1.6, zorder=3) | style
    for piece in np.split(np.arange(len(x)), cuts):
        ax.plot(x[piece], image[piece], **line)
    for i in np.flatnonzero(jumps):
        ax.plot(x[i : i + 2], image[i : i + 2], **JUMP)
    ends = [np.nanmin(x), np.nanmax(x)]
    ax.plot(ends, ends, **DIAGONAL)
    if cobweb is not None:
        steps = np.repeat(np.asarray(cobweb), 2)
        ax.plot(steps[:-1], steps[1:], label="iterates", **COBWEB)
    if fixed_points:
        for place, slope in _fixed_points(x, image, jumps):
            stable = abs(slope) < 1
            name = f"fixed point, |slope| {'<' if stable else '≥'} 1"
            ax.plot(place, place, label=name, markerfacecolor="black" if stable else "white", **POINT)
    low, high = min(ax.dataLim.min), max(ax.dataLim.max)
    room = 0.03 * (high - low)
    ax.set(xlim=(low - room, high + room), ylim=(low - room, high + room), aspect="equal")
    ax.set_xlabel(axis_label(labels, "x", "$x_n$"))
    ax.set_ylabel(axis_label(labels, "image", "$x_{n+1}$"))
    if legend:
        add_legend(ax)
    return ax


def _jumps(x: np.ndarray, image: np.ndarray) -> np.ndarray:
    """Whether the map jumps between a sample and the next: it is much steeper than on both sides of them, and it is
    seen."""
    rise = np.abs(np.diff(image))
    slope = rise / np.diff(x)
    beside = np.fmax(np.r_[0, slope[:-1]], np.r_[slope[1:], 0])
    span = np.nanmax(image) - np.nanmin(image) if np.isfinite(image).any() else 0.0
    return (rise > 0.05 * span) & (slope > STEEP * beside) & (slope > 2)


def _fixed_points(x: np.ndarray, image: np.ndarray, jumps: np.ndarray) -> list[tuple[float, float]]:
    """(place, slope) of each, by linear interpolation."""
    above = image - x
    out = []
    for i in range(len(x) - 1):
        slope = (image[i + 1] - image[i]) / (x[i + 1] - x[i])
        if above[i] == 0 or above[i] * above[i + 1] < 0:
            place = x[i] - above[i] * (x[i + 1] - x[i]) / (above[i + 1] - above[i])
            out.append((float(place), np.inf if jumps[i] else float(slope)))
    if above[-1] == 0:
        out.append((float(x[-1]), float((image[-1] - image[-2]) / (x[-1] - x[-2]))))
    return out


def brute_force(
    found: BruteForce,
    measure: str | Callable[[Any], Any] | None = None,
    *,
    ax: "Axes | None" = None,
    labels: Labels = None,
    **style: Any,
) -> "Axes":
    """Draws a brute-force bifurcation diagram as small dots, behind the branches if `ax` has some; Fig. 6.20.

    **Arguments:**

    - `found`: from `nsjax.brute_force`.
    - `measure`: the scalar that stands for the state: the name of a component, or a function of the state; by default
        the first component. Branches are drawn by their values at the same section if they shall meet the dots.
    - `ax`: where to draw; by default a new figure.
    - `labels`: for the axes, as `{"omega": "ω [rad/s]", "x": "x [m]"}`, a function of the state being
        "measure"; by default the names with the units that model and state declare.
    - `style`: for the dots, as in `Axes.plot`.

    **Returns:** the axes.

    **Raises:** `ValueError` for an unknown component.
    """
    ax = axes_or_new(ax)
    if callable(measure):
        name, points = "measure", np.asarray(jax.vmap(jax.vmap(jax.vmap(measure)))(found.ys))
    else:
        by_name = components(found.ys, ndim=3)
        (name,) = chosen(by_name, [measure])
        points = by_name[name]
    values = np.broadcast_to(np.asarray(found.values)[:, None, None], points.shape)
    ax.plot(values.ravel(), points.ravel(), **DOTS | style)
    labels = declared(labels, found.ys)
    ax.set_xlabel(axis_label(labels, found.parameter))
    ax.set_ylabel(axis_label(labels, name))
    return ax
