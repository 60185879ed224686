"""Charts of attractors over two parameters."""

from typing import Any, Literal, TYPE_CHECKING

import numpy as np

from ..maps._attractor_chart import AttractorChart
from ._style import axes_or_new, axis_label, Labels, legend as add_legend


if TYPE_CHECKING:
    from matplotlib.axes import Axes

CHAOS, UNDECIDED, FAILED = "0.15", "white", "0.75"
COLOURS = ("#4477aa", "#66ccee", "#228833", "#ccbb44", "#ee6677", "#aa3377", "#e69f00", "#88ccaa", "#bb8866", "#9988dd")
OTHERS = "0.55"  # of those beyond the ten that have a colour of their own
LONGEST = 30  # characters of an itinerary in the legend
BOX = dict(marker="s", linestyle="none", markersize=8, markeredgecolor="0.5", markeredgewidth=0.5)
Shown = Literal["period", "itinerary", "exponent"]


def attractor_chart(
    found: AttractorChart,
    by: Shown = "period",
    *,
    ax: "Axes | None" = None,
    labels: Labels = None,
    legend: bool = True,
) -> "Axes":
    """Draws a chart of attractors: a colour for each period, or for each class of itineraries; chaos nearly black,
    white where nothing is known, light grey where the solution failed.

    ```python
    nsjax.plot.attractor_chart(found, labels={"omega": "ω [rad/s]", "v_dr": "v_dr [m/s]"})
    ```

    **Arguments:**

    - `found`: what `nsjax.attractor_chart` returned; its first parameter goes along the axis to the right.
    - `by`: `"period"`, `"itinerary"`, or `"exponent"` for the largest Lyapunov exponent, which is red where it is
        positive; what is below the least that is drawn, minus infinity too, has its colour.
    - `ax`: where to draw; by default a new figure.
    - `labels`: for the axes, by parameter, and for `"exponent"`.
    - `legend`: whether to explain the colours. The ten most frequent itineraries have one of their own.

    **Returns:** the axes.

    **Raises:** `ValueError` for another `by`.
    """
    if by not in ("period", "itinerary", "exponent"):
        raise ValueError(f"Argument `by` must be 'period', 'itinerary' or 'exponent', but got {by!r}.")
    ax = axes_or_new(ax)
    across, up = found.values
    if by == "exponent":
        _exponents(ax, found, labels, legend)
    else:
        own, names = _periods(found) if by == "period" else _itineraries(found)
        colours = [FAILED, UNDECIDED, CHAOS, *(COLOURS[k] if k < len(COLOURS) else OTHERS for k in range(len(names)))]
        code = np.where(found.chaotic, 2, np.where(found.failed, 0, np.where(own >= 0, 3 + own, 1)))
        _mesh(ax, across, up, code, colours)
        if legend:
            own = [*zip(range(3, 3 + len(COLOURS)), _shortened(names[: len(COLOURS)])), (3 + len(COLOURS), "others")]
            for k, name in [*own, (2, "chaos"), (1, "undecided"), (0, "failed")]:
                if (code == k).any() or (name == "others" and (code > k).any()):
                    ax.plot([], [], markerfacecolor=colours[k], label=name, **BOX)
            add_legend(ax, 3 if by == "period" else 2)
    ax.set(xlabel=axis_label(labels, found.parameters[0]), ylabel=axis_label(labels, found.parameters[1]))
    return ax


def _shortened(names: list[str]) -> list[str]:
    """Long ones by their beginning and end, where these tell them apart: a legend shows each text once."""
    short = [n if len(n) <= LONGEST else f"{n[: LONGEST - 11]}…{n[-10:]}" for n in names]
    return [n if short.count(s) > 1 else s for n, s in zip(names, short)]


def _periods(found: AttractorChart) -> tuple[np.ndarray, list[str]]:
    """The place of each period among those that there are; -1 elsewhere."""
    there = np.unique(found.periods[found.periods > 0])
    return np.where(found.periods > 0, np.searchsorted(there, found.periods), -1), [f"period {p}" for p in there]


def _itineraries(found: AttractorChart) -> tuple[np.ndarray, list[str]]:
    """Those beyond what is kept of an itinerary are others."""
    long = (found.classes < 0) & (found.periods > 0)
    own = np.where(long, len(COLOURS), found.classes)
    names = [*found.itineraries, *[""] * (len(COLOURS) + 1 - len(found.itineraries))]
    return own, names


def _mesh(ax: "Axes", across: np.ndarray, up: np.ndarray, code: np.ndarray, colours: list[str]) -> None:
    from matplotlib.colors import ListedColormap

    if code.max() < len(colours) - 1:
        colours = colours[: code.max() + 1]
    kwargs: dict[str, Any] = dict(cmap=ListedColormap(colours), vmin=-0.5, vmax=len(colours) - 0.5)
    ax.pcolormesh(across, up, code.T, shading="nearest", rasterized=True, **kwargs)


def _exponents(ax: "Axes", found: AttractorChart, labels: Labels, legend: bool) -> None:
    rates = np.ma.masked_invalid(np.where(found.exponents == -np.inf, -1e300, found.exponents))
    finite = found.exponents[np.isfinite(found.exponents)]
    most = max(float(np.quantile(np.abs(finite), 0.9)) if finite.size else 0.0, 1e-12)
    ax.set_facecolor(FAILED)
    kwargs: dict[str, Any] = dict(cmap="RdBu_r", vmin=-most, vmax=most)
    mesh = ax.pcolormesh(*found.values, rates.T, shading="nearest", rasterized=True, **kwargs)
    if legend:
        ax.figure.colorbar(mesh, ax=ax, extend="both", label=axis_label(labels, "exponent", "λ₁"))
