"""Linearised dynamics: the fundamental solution matrix against time, and Floquet multipliers."""

from collections.abc import Sequence
from typing import Any, TYPE_CHECKING

import numpy as np
from jaxtyping import ArrayLike, Float

from ..derivatives._floquet import trivial
from ..flow._solution import Events
from ._style import axes_or_new, axis_label, Labels, legend


if TYPE_CHECKING:
    from matplotlib.axes import Axes


def fundamental_matrix(
    ts: Float[ArrayLike, " times"],
    phi: Float[ArrayLike, "times n n"],
    events: Events | Float[ArrayLike, " events"] | None = None,
    *,
    axes: "Float[np.ndarray, 'n n'] | None" = None,
    labels: Labels = None,
) -> np.ndarray:
    """Draws the entries of the fundamental solution matrix Φ(t, t0) against time, one panel for each; Fig. 3.7.

    **Arguments:**

    - `ts`, `phi`: times and matrices, from `nsjax.fundamental_matrix(..., ts=ts)`.
    - `events`: the log of the solution, or the times of its events; lines are cut there, so that the jumps by saltation
        matrices show.
    - `axes`: an array of n x n axes; by default those of a new figure.
    - `labels`: as `{"t": "t [s]", (1, 2): "$\\Phi_{12}$ [s]"}`, counting from 1.

    **Returns:** the array of axes, of shape `(n, n)`.

    **Raises:** `ValueError` where the shapes do not fit.
    """
    ts, phi = np.asarray(ts), np.asarray(phi)
    n = phi.shape[-1]
    if phi.shape != (len(ts), n, n):
        raise ValueError(f"Argument `phi` must have the shape ({len(ts)}, n, n) for these `ts`, but has {phi.shape}.")
    if axes is None:
        import matplotlib.pyplot as plt

        size = (1.2 + 2.6 * n, 0.8 + 1.8 * n)
        axes = plt.subplots(n, n, sharex=True, squeeze=False, figsize=size, layout="constrained")[1]
    axes = np.asarray(axes)
    if axes.shape != (n, n):
        raise ValueError(f"Argument `axes` must have the shape ({n}, {n}), but has {axes.shape}.")
    if isinstance(events, Events):
        events = events.t[: len(events)]
    cuts = np.zeros(0) if events is None else np.asarray(events)
    pieces = np.split(np.arange(len(ts)), np.searchsorted(ts, cuts))
    for (i, j), ax in np.ndenumerate(axes):
        for piece in pieces:
            ax.plot(ts[piece], phi[piece, i, j], color="C0")
        for t in cuts:
            ax.axvline(t, color="0.6", linestyle=":", linewidth=0.8, zorder=0)
        ax.set_ylabel(axis_label(labels, (i + 1, j + 1), f"$\\Phi_{{{i + 1}{',' * (n > 9)}{j + 1}}}$"))
        if i == n - 1:
            ax.set_xlabel(axis_label(labels, "t"))
    return axes


def multipliers(orbit: Any, *, ax: "Axes | None" = None) -> "Axes":
    """Draws the Floquet multipliers of an orbit in the complex plane, with the unit circle.

    The multiplier 1 which an autonomous system always has, that of a shift along the orbit, is drawn hollow. An
    infinite one stands at the right edge. Of several orbits each has its own colour, the stable ones dots and the
    unstable ones diamonds.

    **Arguments:**

    - `orbit`: an `Orbit`, or a sequence of them, as from `find_orbits`.
    - `ax`: where to draw; by default a new figure.

    **Returns:** the axes.

    **Raises:** `ValueError` for an orbit that was not found, or none at all.
    """
    orbits = list(orbit) if isinstance(orbit, Sequence) else [orbit]
    if not orbits:
        raise ValueError("Argument `orbit` must be an orbit or a sequence of them, but is empty.")
    if any(np.isnan(np.asarray(each.multipliers)).any() for each in orbits):
        raise ValueError("Argument `orbit` must be an orbit that was found, but its multipliers are NaN.")
    ax = axes_or_new(ax)
    angle = np.linspace(0, 2 * np.pi, 361)
    ax.plot(np.cos(angle), np.sin(angle), color="0.5", linewidth=1.0)
    ax.axhline(0, color="0.85", linewidth=0.8, zorder=0)
    ax.axvline(0, color="0.85", linewidth=0.8, zorder=0)
    for i, each in enumerate(orbits):
        if len(orbits) == 1:
            _draw_multipliers(ax, each, "C3", "o", "Floquet multipliers")
        else:
            name, mark = ("stable", "o") if each.stable else ("unstable", "D")
            _draw_multipliers(ax, each, f"C{i % 10}", mark, f"orbit {i + 1}, {name}")
    ax.set_aspect("equal")
    ax.set_xlabel("Re λ [-]")
    ax.set_ylabel("Im λ [-]")
    legend(ax)
    return ax


def _draw_multipliers(ax: "Axes", orbit: Any, color: str, marker: str, label: str) -> None:
    values = np.asarray(orbit.multipliers)
    infinite = np.isinf(values)
    along = np.asarray(trivial(values)) if orbit.system.period is None else np.zeros(len(values), bool)
    style: dict[str, Any] = dict(linestyle="none", markeredgecolor=color, clip_on=False)
    for those, fill, name in ((~along, color, label), (along, "white", "along the orbit")):
        shown = values[those & ~infinite]
        if len(shown):
            ax.plot(np.real(shown), np.imag(shown), marker=marker, markerfacecolor=fill, label=name, **style)
    if infinite.any():
        # Its argument has no meaning: beside the positive real axis, whatever the limits.
        edge = ax.get_yaxis_transform()
        ax.plot([1.0], [0.0], transform=edge, marker=">", markersize=9, markerfacecolor=color, label=label, **style)
        note = "∞" if infinite.sum() == 1 else f"∞ ({infinite.sum()} of them)"
        ax.annotate(note, (1.0, 0.0), (8, 0), xycoords=edge, textcoords="offset points", va="center", color=color)
        ax.margins(x=0.15)
