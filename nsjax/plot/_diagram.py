"""What diagrams over a parameter share: stretches of lines, marks of special points, and words beside them."""

from collections.abc import Mapping, Sequence
from typing import Any, TYPE_CHECKING

import numpy as np

from ._eigenvalues import PLATE


if TYPE_CHECKING:
    from matplotlib.axes import Axes

LINE = dict(color="black", linewidth=1.6)
UNSTABLE = (0, (4, 2))
GAP = 8  # between a point and its name [pt]
GAPS = (GAP, 20, 34)  # where there is no room at that
FAR = 3  # how much of a line a name would rather cover than be a point farther away
LEADER = dict(arrowstyle="-", linewidth=0.5, color="0.5", shrinkA=0, shrinkB=3)  # to a name that is
WAYS = ((1, -1), (1, 1), (-1, 1), (-1, -1), (1, 0), (-1, 0), (0, 1), (0, -1))  # from a point to its name


def stretches(
    ax: "Axes", x: np.ndarray, y: np.ndarray, kinds: np.ndarray, styles: Mapping[Any, Any], style: dict[str, Any]
) -> None:
    """Lines, each of one kind from end to end, in the line style, with the label, and perhaps further style, that
    `styles[kind]` says. A line ends at the first point of another kind."""
    start = 0
    for end in range(1, len(x) + 1):
        if end < len(x) and kinds[end] == kinds[start]:
            continue
        last = min(end + 1, len(x))
        linestyle, label, *more = styles[kinds[start]]
        own = dict(zorder=2) | style | dict(linestyle=linestyle, label=label) | dict(*more)
        ax.plot(x[start:last], y[start:last], **own)
        start = end


def mark(ax: "Axes", x: float, y: float, discontinuous: bool, bifurcation: bool) -> None:
    """A special point: red where multipliers or eigenvalues jump, blue where not, hollow where nothing bifurcates."""
    style = dict(marker="o", linestyle="none", markersize=6, zorder=4, color="C3" if discontinuous else "C0")
    if not bifurcation:
        style |= dict(markersize=5, markerfacecolor="white", markeredgecolor="0.3")
    ax.plot([x], [y], **style)


def wording(name: str, keep: bool = False) -> str:
    """The name of a bifurcation, short and in lines; whole if it is no bifurcation."""
    text = name.partition(":")[0].replace("discontinuous ", "discontinuous\n").replace(" bifurcation, ", ",\n")
    return text if keep else text.removesuffix(" bifurcation")


def write_names(ax: "Axes", points: Sequence[tuple[float, float, str]]) -> None:
    """Writes beside each point, on the side where fewest lines, other points and other words are."""
    (x0, x1), (y0, y1) = ax.get_xlim(), ax.get_ylim()
    figure, window = ax.figure, ax.get_window_extent()
    assert figure is not None
    unit = figure.dpi / 72 / np.array([window.width, window.height])  # a point of text, as a part of the axes

    def placed(x: Any, y: Any) -> np.ndarray:
        return np.stack([(np.asarray(x) - x0) / (x1 - x0), (np.asarray(y) - y0) / (y1 - y0)], axis=-1)

    taken = [placed(line.get_xdata(), line.get_ydata()) for line in ax.lines if line.get_transform() == ax.transData]
    dense = [np.linspace(a, b, 50) for line in taken for a, b in zip(line[:-1], line[1:])]
    words = [text.get_window_extent().transformed(ax.transAxes.inverted()) for text in ax.texts]
    occupied = np.concatenate([*taken, *dense, *(_filled(w.min, w.max) for w in words)])
    marks = placed(*np.transpose([point[:2] for point in points])) if points else np.zeros((0, 2))
    for x, y, text in points:
        at = placed(x, y)
        others = marks[np.abs(marks - at).max(axis=1) > 1e-6]
        half = unit * np.array([5.2 * max(map(len, text.split("\n"))), 11.0 * (1 + text.count("\n"))]) / 2

        def middle(way: np.ndarray, gap: float) -> np.ndarray:
            return at + way * (half + gap * unit)

        def covered(place: tuple[np.ndarray, float]) -> float:
            center = middle(*place)
            inside = int(np.sum(np.all(np.abs(occupied - center) < half, axis=1)))
            inside += 2_000 * int(np.sum(np.all(np.abs(others - center) < half + GAP * unit, axis=1)))
            outside = np.abs(center - 0.5) + half > 0.5
            return inside + 10_000 * int(np.any(outside)) + FAR * (place[1] - GAP)

        way, gap = min(((np.array(way), gap) for gap in GAPS for way in WAYS), key=covered)
        align = dict(ha=("center", "left", "right")[way[0]], va=("center", "bottom", "top")[way[1]])
        place = dict(xytext=tuple(gap * way), textcoords="offset points", fontsize="small", bbox=PLATE, zorder=1)
        ax.annotate(text, (x, y), arrowprops=LEADER if gap > GAP else None, **place, **align)
        occupied = np.concatenate([occupied, _filled(middle(way, gap) - half, middle(way, gap) + half)])


def _filled(low: np.ndarray, high: np.ndarray) -> np.ndarray:
    """Points all over a box."""
    corners = np.linspace(0, 1, 8)
    grid = np.stack(np.meshgrid(corners, corners), axis=-1).reshape(-1, 2)
    return np.repeat(low + (high - low) * grid, 20, axis=0)
