"""A sketch of a scene: a block for each coordinate, and what acts on it in the symbols of mechanics."""

from typing import Any, TYPE_CHECKING

import numpy as np
from jax.core import Tracer

from ._contact import Contact, Rigid
from ._direction import Combination, Direction, Function
from ._friction import Friction
from ._words import felt, number


if TYPE_CHECKING:
    from matplotlib.axes import Axes

    from ._scene import Scene

WIDE = 1.0  # of a block
APART = 2.6  # from one block to the next, middle to middle
STEP = 0.46  # from one element to the next, between the same bodies
LINE = dict(color="0.15", linewidth=1.2, solid_capstyle="round")
TEXT = dict(fontsize="small", color="0.15", ha="center")
CLEAR = dict(facecolor="white", edgecolor="none", pad=0.6)  # of the lines of others


def sketch(scene: "Scene", *, ax: "Axes | None" = None) -> "Axes":
    """Draws a scene: a block for each coordinate, springs, dampers and stops at walls or between the blocks, the ground
    or the belt on which they rub, and the forces on them, each with its name.

    What acts along a function of q, or on more than two coordinates, is a circle tied to the blocks by dashed lines.
    Distances mean nothing.

    **Arguments:**

    - `scene`: a `nsjax.mechanics.Scene`.
    - `ax`: where to draw; by default a new figure.

    **Returns:** the axes, without frame.
    """
    drawing = _Drawing(scene)
    if ax is None:
        import matplotlib.pyplot as plt

        ax = plt.subplots(figsize=drawing.size, layout="constrained")[1]
    drawing.draw(ax)
    ax.set_aspect("equal")
    ax.axis("off")
    ax.margins(0.04)
    return ax


class _Drawing:
    """Where everything stands: what is between which bodies, and how high the blocks are for it."""

    def __init__(self, scene: "Scene"):
        self.scene = scene
        self.names = scene.coordinates
        self.left: dict[int, list[Any]] = {}  # of a block: effects that tie it to the ground
        self.right: dict[int, list[Any]] = {}  # stops and walls on its right
        self.under: dict[int, list[Any]] = {}
        self.forces: dict[int, list[Any]] = {}
        self.between: dict[tuple[int, int], list[Any]] = {}
        self.loose: list[Any] = []
        for name, effect in scene.placed:
            self._place(name, effect)
        sides = [*self.left.values(), *self.right.values(), *self.between.values()]
        self.high = STEP * max(2.5, max(map(len, sides), default=0) + 0.5)
        self.size = (1.6 + 1.15 * APART * len(self.names), 1.6 + 1.2 * self.high + 0.4 * bool(self.loose))

    def _place(self, name: str, effect: Any) -> None:
        ends = _ends(self.scene, effect.directions[0]) if len(effect.directions) == 1 else None
        ends = None if ends is None else {self.names.index(n): sign for n, sign in ends.items()}
        where: Any = self.loose
        if ends is not None and len(ends) == 1:
            ((i, sign),) = ends.items()
            if effect.symbol == "force":
                where = self.forces.setdefault(i, [])
            elif effect.symbol == "friction":
                where = self.under.setdefault(i, [])
            elif effect.symbol == "contact":
                where = (self.right if sign < 0 else self.left).setdefault(i, [])
            elif effect.symbol:
                # Blocks further on, whose left neighbour is in the way, are tied to a wall on the right, if last.
                where = (self.right if i and i == len(self.names) - 1 else self.left).setdefault(i, [])
        elif ends is not None and len(ends) == 2 and effect.symbol not in ("", "force"):
            i, j = sorted(ends)
            if j == i + 1 and ends[i] != ends[j]:
                where = self.between.setdefault((i, j), [])
        where.append((name, effect))

    def draw(self, ax: "Axes") -> None:
        from matplotlib.patches import Rectangle

        for i, name in enumerate(self.names):
            middle = i * APART
            box = Rectangle((middle - WIDE / 2, 0), WIDE, self.high, facecolor="0.9", edgecolor="0.15", linewidth=1.4)
            ax.add_patch(box)
            ax.text(middle, self.high / 2, _mass_text(self.scene, i), va="center", **TEXT)
            y = self.high + 0.16
            ax.plot([middle, middle], [self.high, y + 0.06], **LINE | dict(linewidth=0.9))
            _arrow(ax, (middle, y), (middle + 0.42, y), 0.9)
            ax.text(middle + 0.5, y, name, va="center", bbox=CLEAR, **TEXT | dict(ha="left", style="italic"))
            self._draw_sides(ax, i, middle)
            self._draw_ground(ax, i, middle)
            for n, (label, _) in enumerate(self.forces.get(i, []), 1):
                y = self.high + 0.16 + 0.28 * n
                _arrow(ax, (middle, y), (middle + 0.5, y), 2.0, color="C3")
                ax.text(middle + 0.58, y, label, va="center", **TEXT | dict(color="C3", ha="left"))
        for (i, j), found in self.between.items():
            self._elements(ax, found, i * APART + WIDE / 2, j * APART - WIDE / 2)
        for n, (label, effect) in enumerate(self.loose):
            self._tied(ax, n, label, effect)

    def _draw_sides(self, ax: "Axes", i: int, middle: float) -> None:
        for found, side in ((self.left.get(i, []), -1), (self.right.get(i, []), 1)):
            if found:
                wall = middle + side * (APART - WIDE / 2 - (0.25 if len(self.names) > 1 else 0.0))
                inner = 0 < i < len(self.names) - 1 or (i == 0 and side > 0 and len(self.names) > 1)
                wall = middle + side * (WIDE / 2 + 0.62) if inner or (i > 0 and side < 0) else wall
                _hatch(ax, (wall, -0.05), (wall, self.high + 0.05), side)
                self._elements(ax, found, wall, middle + side * WIDE / 2)

    def _draw_ground(self, ax: "Axes", i: int, middle: float) -> None:
        for n, (label, effect) in enumerate(self.under.get(i, [])):
            low, ends = -0.28 * n, (middle - 0.62 * WIDE, middle + 0.62 * WIDE)
            if isinstance(effect, Friction) and effect.v is not None:
                _belt(ax, ends, low)
                ax.text(middle, low - 0.36, label, va="top", **TEXT)
            else:
                _hatch(ax, (ends[0], low), (ends[1], low), -1)
                ax.text(middle, low - 0.18, label, va="top", **TEXT)

    def _elements(self, ax: "Axes", found: list[Any], x0: float, x1: float) -> None:
        """Side by side between two bodies, from top to bottom; `x1` is the block that moves."""
        for n, (label, effect) in enumerate(found):
            y = self.high - STEP * (n + 0.75) if len(found) > 1 else self.high / 2
            draw = {
                "spring": _spring, "damper": _damper, "contact": _stop, "backlash": _backlash, "friction": _rub,
            }.get(effect.symbol, _box)  # fmt: skip
            draw(ax, x0, x1, y, effect)
            ax.text((x0 + x1) / 2, y + 0.11, label, va="bottom", **TEXT)

    def _tied(self, ax: "Axes", n: int, label: str, effect: Any) -> None:
        """What has no symbol between bodies."""
        blocks = [self.names.index(name) for name in felt(self.scene, label, effect)]
        x = np.mean([i * APART for i in blocks]) + 0.9 if blocks else n * APART
        y = self.high + 0.5 + 0.28 * max(map(len, self.forces.values()), default=0) + 0.42 * n
        for i in blocks:
            ax.plot([i * APART, x], [self.high, y], **LINE | dict(linewidth=0.8, linestyle=(0, (4, 3)), zorder=0))
        ax.plot([x], [y], marker="o", markersize=7, markerfacecolor="white", **LINE)
        ax.text(x + 0.14, y, label, va="center", bbox=CLEAR, **TEXT | dict(ha="left"))


def _ends(scene: "Scene", along: Direction) -> dict[str, int] | None:
    """The blocks between which an effect acts, with the signs of the distance; None if it is not of this kind."""
    if isinstance(along, Function):
        found: dict[str, Any] = {n: s and s * along.sign for n, s in along.slopes_at(scene.state().q).items()}
    elif isinstance(along, Combination):
        found = {n: f if w is None else w for n, w, f in zip(along.names, along.whole, along.factors)}
    else:
        return along.slopes
    if any(s is None or isinstance(s, Tracer) for s in found.values()):
        return None
    # A lever pulls the same way, whatever its ratio; between two blocks there is no symbol for it.
    sizes = {abs(float(s)) for s in found.values()}
    return {n: int(np.sign(float(s))) for n, s in found.items()} if len(sizes) == 1 and 0 not in sizes else None


def _mass_text(scene: "Scene", i: int) -> str:
    return number(scene.mass[i]) if isinstance(scene.mass, tuple) else "M"


def _arrow(ax: "Axes", start: Any, end: Any, width: float, color: str = "0.15") -> None:
    style = dict(arrowstyle="-|>", linewidth=width, color=color, shrinkA=0, shrinkB=0)
    ax.annotate("", end, start, arrowprops=style)
    ax.update_datalim([start, end])  # beyond the limits of the axes it would not be drawn


def _hatch(ax: "Axes", start: Any, end: Any, side: int) -> None:
    """A fixed wall, hatched on its far side: the left (-1) or right (1) of a wall, or below (-1) the ground."""
    (x0, y0), (x1, y1) = start, end
    ax.plot([x0, x1], [y0, y1], **LINE | dict(linewidth=1.6))
    length = np.hypot(x1 - x0, y1 - y0)
    for p in np.linspace(0, 1, max(2, round(length / 0.13)) + 1)[:-1] + 0.06 / length:
        x, y = x0 + p * (x1 - x0), y0 + p * (y1 - y0)
        dx, dy = (0.1 * side, -0.1) if x0 == x1 else (-0.1, 0.1 * side)
        ax.plot([x, x + dx], [y, y + dy], **LINE | dict(linewidth=0.8))


def _belt(ax: "Axes", ends: tuple[float, float], y: float) -> None:
    from matplotlib.patches import FancyBboxPatch

    shape = f"round,pad=0,rounding_size={0.13}"
    x0, x1 = ends
    outline = FancyBboxPatch((x0, y - 0.28), x1 - x0, 0.26, boxstyle=shape, facecolor="white", edgecolor="0.15")
    ax.add_patch(outline)
    for x in (x0 + 0.13, x1 - 0.13):
        ax.plot([x], [y - 0.15], marker="o", markersize=3, color="0.15")
    middle = (x0 + x1) / 2
    _arrow(ax, (middle - 0.2, y - 0.15), (middle + 0.25, y - 0.15), 1.0)


def _spring(ax: "Axes", x0: float, x1: float, y: float, effect: Any) -> None:
    ends = 0.18 * (x1 - x0)
    x = np.concatenate([[x0], np.linspace(x0 + ends, x1 - ends, 10), [x1]])
    ax.plot(x, y + 0.09 * np.array([0, 0, 1, -1, 1, -1, 1, -1, 1, -1, 0, 0]), **LINE)


def _damper(ax: "Axes", x0: float, x1: float, y: float, effect: Any) -> None:
    middle, side = (x0 + x1) / 2, np.sign(x1 - x0)
    cup, piston = middle - 0.12 * side, middle + 0.02 * side
    ax.plot([x0, cup], [y, y], **LINE)
    ax.plot([cup + 0.28 * side, cup, cup, cup + 0.28 * side], [y + 0.1, y + 0.1, y - 0.1, y - 0.1], **LINE)
    ax.plot([piston, piston], [y - 0.07, y + 0.07], **LINE | dict(linewidth=2.2))
    ax.plot([piston, x1], [y, y], **LINE)


def _stop(ax: "Axes", x0: float, x1: float, y: float, effect: Any) -> None:
    """A stop on the wall, with a gap between it and the block."""
    tip = x1 - 0.22 * (x1 - x0)
    if isinstance(effect, Contact) and isinstance(effect.law, Rigid):
        ax.plot([x0, tip], [y, y], **LINE | dict(linewidth=3.5, solid_capstyle="butt"))
    else:
        _spring(ax, x0, tip, y, effect)
    ax.plot([tip, tip], [y - 0.1, y + 0.1], **LINE | dict(linewidth=2.2))


def _backlash(ax: "Axes", x0: float, x1: float, y: float, effect: Any) -> None:
    """A spring, and a pin with play in a fork."""
    side, fork = np.sign(x1 - x0), x1 - 0.42 * (x1 - x0)
    _spring(ax, x0, fork, y, effect)
    jaw = fork + 0.26 * side
    ax.plot([jaw, fork, fork, jaw], [y + 0.09, y + 0.09, y - 0.09, y - 0.09], **LINE)
    ax.plot([jaw, jaw], [y + 0.09, y + 0.05], **LINE)
    ax.plot([jaw, jaw], [y - 0.09, y - 0.05], **LINE)
    pin = fork + 0.13 * side
    ax.plot([pin, x1], [y, y], **LINE)
    ax.plot([pin, pin], [y - 0.05, y + 0.05], **LINE | dict(linewidth=2.2))


def _rub(ax: "Axes", x0: float, x1: float, y: float, effect: Any) -> None:
    """Two plates that rub on each other."""
    middle = (x0 + x1) / 2
    for start, end, at in ((x0, middle + 0.15, y + 0.03), (middle - 0.15, x1, y - 0.03)):
        ax.plot([start, end], [at, at], **LINE | dict(linewidth=1.8))


def _box(ax: "Axes", x0: float, x1: float, y: float, effect: Any) -> None:
    ax.plot([x0, x1], [y, y], **LINE)
    ax.plot([(x0 + x1) / 2], [y], marker="s", markersize=10, markerfacecolor="white", markeredgecolor="0.15")
