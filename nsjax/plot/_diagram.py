"""What diagrams over a parameter share: stretches of lines, marks of special points, and words beside them."""

from collections.abc import Mapping, Sequence
from typing import Any, TYPE_CHECKING

import numpy as np

from ._style import once


if TYPE_CHECKING:
    from matplotlib.axes import Axes

LINE = dict(color="black", linewidth=1.6)
PLATE = dict(facecolor="white", edgecolor="none", alpha=0.75, pad=1.0)  # behind names
UNSTABLE = (0, (4, 2))
GAPS = (8, 14, 20, 28, 38, 50, 64)  # between a point and its name [pt]: farther where there is no room
CLOSE = 14  # up to here a name needs no line to its point
STEP = 2  # between the places of a line that a name can cover [pt]
EDGE = 3  # between a name and the frame [pt]
COVERED = 10  # a place that is covered is as bad as so many points of distance
LEADER = dict(arrowstyle="-", linewidth=0.5, color="0.5", shrinkA=0, shrinkB=3)  # to a name that is far away
# From a point to its name: the corners first, then the sides, then what is between them.
WAYS = np.deg2rad([-45, 45, 135, 225, 0, 180, 90, 270, *np.arange(22.5, 360, 45)])


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
        own = dict(zorder=2) | style | dict(linestyle=linestyle, label=once(ax, label)) | dict(*more)
        ax.plot(x[start:last], y[start:last], **own)
        start = end


def begun(x: np.ndarray, y: np.ndarray, amplitude: np.ndarray, samples: int = 24) -> tuple[np.ndarray, np.ndarray]:
    """What belongs between the first two points of a branch of orbits that begins at a Hopf point, where it is no
    straight line: the parameter is even in the amplitude if the point is smooth. Parameter and height are polynomials
    of the amplitude through the first points.

    **Arguments:**

    - `x`, `y`, `amplitude`: of the Hopf point, at which the last is zero, and of at least one orbit beside it.

    **Returns:** parameter and height at places between the two.
    """
    rising = np.append(np.diff(amplitude) <= 0, True)
    count = min(int(np.argmax(rising)) + 1, 4)  # as far as the amplitude tells them apart
    if count < 2:
        return np.zeros(0), np.zeros(0)
    nodes = amplitude[:count] / amplitude[1]
    matrix = np.vander(nodes, increasing=True)
    at = np.vander(np.linspace(0, 1, samples + 2)[1:-1], count, increasing=True)
    return at @ np.linalg.solve(matrix, x[:count]), at @ np.linalg.solve(matrix, y[:count])


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
    """Writes beside each point, where it covers no line, no other point and no other words; with a line to the point if
    that is farther away. To be called when everything else is drawn, as it looks at the places of all."""
    if not points:
        return
    figure = ax.get_figure(root=True)
    assert figure is not None
    if figure.get_layout_engine() is not None:
        figure.draw_without_rendering()  # only then the axes are where they will be
    size = 72 / figure.dpi  # of a pixel [pt]
    window = size * ax.get_window_extent().get_points()
    marks = size * ax.transData.transform([point[:2] for point in points])
    occupied = _occupied(ax, size, window)
    for (x, y, text), at in zip(points, marks):
        half = size * _extent(ax, text) / 2
        others = marks[np.abs(marks - at).max(axis=1) > 1]

        def middle(angle: float, gap: float) -> np.ndarray:
            way = np.array([np.cos(angle), np.sin(angle)])
            return at + half * np.clip(np.sqrt(2) * way, -1, 1) + gap * way

        def worth(place: tuple[float, float]) -> float:
            center = middle(*place)
            inside = int(np.sum(np.all(np.abs(occupied - center) < half + 1, axis=1)))
            hidden = int(np.sum(np.all(np.abs(others - center) < half + GAPS[0], axis=1)))
            outside = bool(np.any(center - half < window[0] + EDGE) or np.any(center + half > window[1] - EDGE))
            return COVERED * (inside + 200 * hidden + 1000 * outside) + place[1]

        angle, gap = min(((angle, gap) for gap in GAPS for angle in WAYS), key=worth)
        center = middle(angle, gap)
        side = ("center", "left", "right")[int(np.sign(np.round(np.cos(angle), 6)))]
        style = dict(fontsize="small", bbox=PLATE, zorder=1, ha="center", va="center", multialignment=side)
        line = LEADER if gap > CLOSE else None
        name = ax.annotate(text, (x, y), tuple(center - at), textcoords="offset points", arrowprops=line, **style)
        name.set_in_layout(False)  # it was placed for axes of this size
        # Twice, as words on words are worse than words on a line.
        grid = _filled(np.stack([center - half, center + half]), 8)
        occupied = np.concatenate([occupied, np.repeat(grid, 2, axis=0), *[_along(at, center)] * (gap > CLOSE)])


def _extent(ax: "Axes", text: str) -> np.ndarray:
    """Width and height of a name [pixel]."""
    trial = ax.text(0.5, 0.5, text, transform=ax.transAxes, fontsize="small")
    box = trial.get_window_extent()
    trial.remove()
    return np.array([box.width, box.height])


def _filled(corners: np.ndarray, count: int) -> np.ndarray:
    """Places all over a box, `count` each way, from its lower and upper corner."""
    return np.stack(np.meshgrid(*np.linspace(corners[0], corners[1], count).T), axis=-1).reshape(-1, 2)


def _along(start: np.ndarray, end: np.ndarray) -> np.ndarray:
    """Places on a straight line, as close as `STEP`."""
    count = int(np.linalg.norm(end - start) / STEP) + 1
    return start + (end - start) * np.linspace(0, 1, count + 1)[:, None]


def _occupied(ax: "Axes", size: float, window: np.ndarray) -> np.ndarray:
    """Where the axes have lines, marks and words [pt]."""
    low, high = window
    found = [np.zeros((0, 2))]
    for line in ax.lines:
        xy = np.column_stack([np.asarray(x, float) for x in (line.get_xdata(), line.get_ydata())])
        xy = size * line.get_transform().transform(xy)
        if line.get_linestyle() not in ("None", "none", ""):
            # Pieces that can be seen at all.
            seen = [
                (a, b)
                for a, b in zip(xy[:-1], xy[1:])
                if np.all(np.isfinite([a, b])) and np.all(np.maximum(a, b) >= low) and np.all(np.minimum(a, b) <= high)
            ]
            found += [_along(np.clip(a, low, high), np.clip(b, low, high)) for a, b in seen]
        if line.get_marker() not in ("None", "none", ""):
            xy, radius = xy[np.isfinite(xy).all(axis=1)], line.get_markersize() / 2
            corners = radius * np.array([[0, 0], [1, 0], [0, 1], [-1, 0], [0, -1]])
            found.append((xy[:, None] + corners).reshape(-1, 2))
    for text in ax.texts:
        found.append(_filled(size * text.get_window_extent().get_points(), 8))
    legend = ax.get_legend()
    if legend is not None:
        found.append(_filled(size * legend.get_window_extent().get_points(), 20))
    return np.concatenate(found)
