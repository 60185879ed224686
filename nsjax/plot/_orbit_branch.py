"""Branches of periodic orbits over a parameter, their multipliers, and the paths on which these jump."""

from collections.abc import Callable, Iterator, Sequence
from typing import Any, TYPE_CHECKING

import jax
import numpy as np
from jaxtyping import Complex, Float

from .._numerics._text import components
from ..continuation.orbits._bifurcation import OrbitBifurcation
from ..continuation.orbits._branch import OrbitBranch
from ..derivatives._floquet import trivial
from ..setvalued._eigenvalue_crossings import eigenvalue_path as path_between
from ._diagram import begun, LINE, mark, stretches, UNSTABLE, wording, write_names
from ._eigenvalues import eigenvalue_path
from ._multiplier_pair import with_splits
from ._path import chosen
from ._style import axes_or_new, axis_label, declared, Labels, legend as add_legend, once


if TYPE_CHECKING:
    from matplotlib.axes import Axes

Measure = str | Callable[[OrbitBranch], Any] | None
Names = bool | Callable[[OrbitBifurcation], str]

STYLES = {
    0: ("-", "stable periodic orbit"),
    1: (UNSTABLE, "unstable periodic orbit"),
    2: ((0, (1, 1)), "infinitely unstable periodic orbit"),
    3: (":", "virtual", dict(color="0.6", linewidth=0.9, zorder=1)),
}
PARTS: dict[str, tuple[Callable[[Any], Any], str]] = {"abs": (np.abs, "|λ| [-]"), "real": (np.real, "Re λ [-]")}
PATH = dict(color="C3", linestyle=":", linewidth=1.4, zorder=3)
HALF = dict(marker="o", linestyle="none", markersize=3.5, zorder=4)


def amplitude(branch: OrbitBranch, name: str | None = None) -> Float[np.ndarray, " points"]:
    """The largest modulus [x] of a component of the state (by default the first) along each orbit of a branch; A in
    Figs. 6.12 to 6.21."""
    low, high = components(branch.low, 1), components(branch.high, 1)
    (name,) = chosen(high, [name])
    return np.maximum(np.abs(low[name]), np.abs(high[name]))


def orbit_diagram(
    branch: OrbitBranch,
    measure: Measure = None,
    *,
    names: Names = True,
    ax: "Axes | None" = None,
    labels: Labels = None,
    legend: bool = True,
) -> "Axes":
    """Draws branches of periodic orbits over the parameter, stable ones solid, unstable ones dashed, infinitely
    unstable ones dotted, virtual ones thin and grey, with their special points: red where multipliers jump through the
    unit circle, blue where they pass it smoothly, hollow where nothing bifurcates; Figs. 6.12, 6.15, 6.18, 6.20 and
    6.21.

    **Arguments:**

    - `branch`: from `continue_orbit`; its other branches are drawn too.
    - `measure`: what stands for an orbit: the name of a component of the state, for its amplitude max |x|; the name of
        one of the `records`, of numbers; or a function of a branch that gives a number for each of its points, as
        `lambda b: b.periods` or `lambda b: b.high.x - b.low.x`. By default the amplitude of the first component.
    - `names`: whether to write what the special points are; or a function of an `OrbitBifurcation` that gives the
        words, none if empty.
    - `ax`: where to draw; by default a new figure.
    - `labels`: for the axes, as `{"omega": "ω [rad/s]", "x": "x [m]"}`, a function being "measure"; by
        default the names with the units that model and state declare.
    - `legend`: whether to explain the lines.

    **Returns:** the axes.

    **Raises:** `ValueError` for an unknown component, or a record or function that is not one number for each point.
    """
    ax = axes_or_new(ax)
    heights = [measured(measure, one) for one in branch.branches]
    for one, height in zip(branch.branches, heights):
        stretches(ax, *_line(one, height), STYLES, LINE)
    words = []
    for special, k, i in special_points(branch):
        height = float(heights[k][i])
        mark(ax, special.value, height, special.discontinuous, special.is_bifurcation)
        words.append((special.value, height, _words(names, special)))
    labels = declared(labels, branch.system, branch.ys)
    ax.set_xlabel(axis_label(labels, branch.parameter))
    ax.set_ylabel(_measure_label(measure, branch, labels))
    if legend:
        add_legend(ax)
    write_once(ax, words)
    return ax


def multiplier_diagram(
    branch: OrbitBranch,
    *,
    part: str = "abs",
    which: str = "all",
    names: Names = True,
    ax: "Axes | None" = None,
    labels: Labels = None,
    legend: bool = True,
) -> "Axes":
    """Draws the Floquet multipliers of branches of periodic orbits over the parameter, those of stable orbits solid, of
    unstable ones dashed. Where they jump, the path of the set-valued ones (6.13) is dotted: the eigenvalues of
    (1 - q) M₁ + q M₂ at that value of the parameter; Figs. 6.13, 6.19 and 6.22.

    The multiplier 1 that an autonomous system always has is left out, and so are virtual branches. Infinite ones lie on
    the upper edge. Where a complex pair becomes real the lines are interpolated as a square root; elsewhere they are
    straight between computed points.

    **Arguments:**

    - `branch`: from `continue_orbit`; its other branches are drawn too.
    - `part`: "abs" or "real".
    - `which`: "all", or "largest": of each orbit, that with the largest modulus.
    - `names`: as for `plot.orbit_diagram`.
    - `ax`: where to draw; by default a new figure.
    - `labels`: for the axes, as `{"omega": "ω [rad/s]", "multiplier": "|λ| [-]"}`.
    - `legend`: whether to explain the lines.

    **Returns:** the axes.

    **Raises:** `ValueError` for an unknown `part` or `which`.
    """
    if part not in PARTS:
        raise ValueError(f"Argument `part` must be 'abs' or 'real', but is {part!r}.")
    if which not in ("all", "largest"):
        raise ValueError(f"Argument `which` must be 'all' or 'largest', but is {which!r}.")
    ax = axes_or_new(ax)
    shown, default = PARTS[part]
    special = [found for found, _, _ in special_points(branch)]
    autonomous = branch.system.period is None
    lines = [line for one in branch.branches if one.admissible.any() for line in _lines(one, autonomous, which)]
    jumps = [(found.value, path) for found in special for path in _jumps(found, autonomous, which)]
    finite = [shown(values[np.isfinite(values)]) for values in (*(line[1] for line in lines), *(j[1] for j in jumps))]
    low, high = (pick(np.concatenate([*finite, [0.0, 1.0]])) for pick in (np.min, np.max))
    # An axis that was set stays as it is.
    infinity = float(high + 0.15 * (high - low)) if ax.get_autoscaley_on() else ax.get_ylim()[1]

    def heights(values: np.ndarray) -> np.ndarray:
        return np.where(np.isfinite(values), shown(values), np.where(np.isnan(values), np.nan, infinity))

    for x, values, kinds in lines:
        clip = dict(clip_on=not np.isinf(values).any())
        stretches(ax, x, heights(values), kinds, STYLES, LINE | clip)
    for x, path in jumps:
        ax.plot(np.full(len(path), x), heights(path), label=once(ax, "jump of the multipliers"), **PATH)
    for height in (1.0,) if part == "abs" else (-1.0, 1.0):
        ax.axhline(height, color="0.75", linewidth=0.9, zorder=0)
    if any(np.isinf(values).any() for _, values, _ in lines):
        ax.set_ylim(top=infinity)
        ax.annotate(
            "∞", (1.0, 1.0), (4, 0), xycoords="axes fraction", textcoords="offset points", va="center", size="large"
        )
    words = []
    for found in special:
        ends = _ends(found, autonomous, which)
        places = heights(ends)
        color = "0.5" if not found.is_bifurcation else "C3" if found.discontinuous else "C0"
        clip = dict(clip_on=not np.isinf(ends).any())
        ax.plot(np.full(len(places), found.value), places, color=color, **HALF, **clip)
        words.append((found.value, float(np.max(places)), _words(names, found)))
    labels = declared(labels, branch.system, branch.ys)
    ax.set_xlabel(axis_label(labels, branch.parameter))
    ax.set_ylabel(axis_label(labels, "multiplier", default))
    if legend:
        add_legend(ax)
    write_once(ax, words)
    return ax


def multiplier_circle(bifurcation: OrbitBifurcation, *, ax: "Axes | None" = None, labels: Labels = None) -> "Axes":
    """Draws the path of the set-valued multipliers at a corner in the complex plane, from the one-sided limit of the
    branch that came (q = 0) to that of its continuation (q = 1), with the unit circle and the crossings; Figs. 6.1 and
    6.2. The legend says of both on which side of the parameter's value they lie, and whether they are stable.

    **Arguments:**

    - `bifurcation`: a special point of an `OrbitBranch` at which multipliers jump.
    - `ax`, `labels`: as for `plot.eigenvalue_path`.

    **Returns:** the axes.

    **Raises:** `ValueError` for a point at which they do not jump, or at which one jumps to infinity.
    """
    if not bifurcation.discontinuous:
        raise ValueError(
            f"Argument `bifurcation` must be one at which multipliers jump, but they do not at this {bifurcation.name}."
        )
    if not all(np.isfinite(m).all() for m in bifurcation.monodromies):
        raise ValueError("Argument `bifurcation` must have finite multipliers: the way to infinity has no picture.")
    path = path_between(*bifurcation.monodromies, multipliers=True)
    # Those of the point itself: of an autonomous orbit the multiplier 1 stays where it is, but for its rounding.
    path = path._replace(crossings=list(bifurcation.crossings))
    symbol = axis_label(labels, bifurcation.parameter).partition(" [")[0]
    names = {f"q = {q}": f"q = {q}: {words}" for q, words in enumerate(_sides(bifurcation, symbol)) if words}
    return eigenvalue_path(path, ax=ax, labels=names | dict(labels or {}))


def _sides(bifurcation: OrbitBifurcation, symbol: str) -> tuple[str, str]:
    """What lies at either end of the path of multipliers: orbits below or above the parameter's value, stable or not.
    Empty where that cannot be told."""
    found = []
    for side in bifurcation.multipliers:
        words = {
            f"{'stable' if half.stable else 'unstable'}, {symbol} {'below' if half.side < 0 else 'above'}"
            for half in bifurcation.halves
            if half.laps == 1 and half.side and _alike(half.multipliers, side)
        }
        found.append(words.pop() if len(words) == 1 else "")
    return found[0], found[1]


def _alike(first: np.ndarray, second: np.ndarray) -> bool:
    """Whether multipliers are the same, in whatever order."""
    far = np.abs(np.asarray(first, complex)[:, None] - np.asarray(second, complex))
    return far.shape[0] == far.shape[1] and all(np.min(far, axis=k).max() < 1e-5 for k in (0, 1))


def measured(measure: Measure, branch: OrbitBranch) -> np.ndarray:
    """What stands for each orbit of a branch, without the others; `measure` as for `orbit_diagram`."""
    recorded = branch.records.get(measure) if isinstance(measure, str) else None
    if recorded is None and not callable(measure):
        return amplitude(branch, measure)
    heights = np.asarray(measure(branch) if callable(measure) else recorded, float)
    if heights.shape != branch.values.shape:
        raise ValueError(
            "Argument `measure` must give a number for each point of a branch, an array of shape "
            f"{branch.values.shape}, but gave {heights.shape}."
        )
    return heights


def _measure_label(measure: Measure, branch: OrbitBranch, labels: Labels) -> str:
    if callable(measure):
        return axis_label(labels, "measure")
    if measure in branch.records:
        return axis_label(labels, measure)
    (name,) = chosen(components(jax.tree.map(lambda x: x[0], branch.ys)), [measure])
    symbol, bracket, unit = axis_label(labels, name).partition(" [")
    return f"max |{symbol}|{bracket}{unit}"


def _line(branch: OrbitBranch, heights: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Parameter, height and key in `STYLES` of what is drawn: the points of a branch, and more next to Hopf points."""
    values, kinds = branch.values, _kinds(branch)
    low, high = (np.stack(list(components(leaf, 1).values())) for leaf in (branch.low, branch.high))
    amplitudes = np.linalg.norm(high - low, axis=0)
    for special, i in sorted(zip(branch.special, branch.indices), key=lambda pair: -pair[1]):
        if special.kind == "Hopf" and i in (0, len(branch) - 1) and len(branch) > 1:
            way = 1 if i == 0 else -1
            new = begun(*(array[::way][:4] for array in (branch.values, heights, amplitudes)))
            place = 1 if i == 0 else len(values) - 1
            values, heights = (np.insert(old, place, add[::way]) for old, add in zip((values, heights), new))
            kinds = np.insert(kinds, place, np.full(len(new[0]), kinds[1 if i == 0 else -2]))
    return values, heights, kinds


def _kinds(branch: OrbitBranch) -> np.ndarray:
    """Of each point, its key in `STYLES`."""
    infinite = np.isinf(branch.multipliers).any(axis=1)
    kinds = np.where(~branch.admissible, 3, np.where(branch.stable, 0, np.where(infinite, 2, 1)))
    for special, i in zip(branch.special, branch.indices):
        if not special.discontinuous and 0 <= i < len(kinds) - 1:
            kinds[i] = kinds[i + 1]  # where a multiplier is on the circle the new kind begins
    return kinds


def special_points(branch: OrbitBranch) -> Iterator[tuple[OrbitBifurcation, int, int]]:
    """Each once: itself, on which of the branches (0 is the first), and at which of its points."""
    seen: set[int] = set()
    for k, one in enumerate(branch.branches):
        for special, i in zip(one.special, one.indices):
            if id(special) not in seen:
                yield special, k, min(max(i, 0), len(one) - 1)
            seen.add(id(special))


def write_once(ax: "Axes", words: Sequence[tuple[float, float, str]]) -> None:
    """Names beside their points, each once: orbits that are images of each other bifurcate at the same place."""
    ax.margins(0.06, 0.16)  # room for them
    (left, right), (low, high) = ax.get_xlim(), ax.get_ylim()
    places = {
        (round(500 * x / (right - left)), round(500 * y / (high - low)), text): (x, y, text) for x, y, text in words
    }
    write_names(ax, [place for place in places.values() if place[2]])


def _words(names: Names, special: OrbitBifurcation) -> str:
    if callable(names):
        return names(special)
    return wording(special.name, keep=special.kind == "none") if names else ""


def _proper(multipliers: Complex[np.ndarray, "points n"], autonomous: bool) -> Complex[np.ndarray, "points m"]:
    """The multipliers without that of a shift along the orbit, largest modulus first."""
    if autonomous:
        kept = ~np.asarray(trivial(multipliers))
        multipliers = multipliers[kept].reshape(len(multipliers), -1)
    order = np.argsort(-np.abs(multipliers), axis=1, kind="stable")
    return np.take_along_axis(multipliers, order, axis=1)


def _lines(branch: OrbitBranch, autonomous: bool, which: str) -> Iterator[tuple[np.ndarray, np.ndarray, np.ndarray]]:
    """Parameter, one multiplier, and its key in `STYLES`, between two corners."""
    values, kinds = _proper(branch.multipliers, autonomous), _kinds(branch)
    cuts = _cuts(branch)
    for start, stop in zip([0, *cuts], [*cuts, len(branch)]):
        if stop > start:
            x, rows, kind = with_splits(branch.values[start:stop], _followed(values[start:stop]), kinds[start:stop])
            if which == "largest":
                rows = np.take_along_axis(rows, np.argmax(np.abs(rows), axis=1)[:, None], axis=1)
            for column in rows.T:
                yield x, column, kind


def _cuts(branch: OrbitBranch) -> list[int]:
    """Where a branch passes a corner there are two points, with the same parameter and other multipliers: the second
    of them."""
    cuts = set()
    for special, i in zip(branch.special, branch.indices):
        if special.discontinuous:
            same = np.abs(np.diff(branch.values[max(i - 1, 0) : i + 2])) <= 1e-9 * abs(special.value)
            cuts |= {max(i - 1, 0) + int(j) + 1 for j in np.flatnonzero(same)}
    return sorted(cuts)


def _followed(rows: Complex[np.ndarray, "points m"]) -> Complex[np.ndarray, "points m"]:
    """Each row in the order that continues the one before: by modulus two that are real would change places."""
    from scipy.optimize import linear_sum_assignment  # slow to import

    out = rows.copy()
    far = np.where(np.isfinite(rows), rows, 1e6)  # two infinite ones are near each other
    for i in range(1, len(rows)):
        order = linear_sum_assignment(np.abs(far[i - 1][:, None] - far[i]))[1]
        out[i], far[i] = out[i][order], far[i][order]
    return out


def _jumps(special: OrbitBifurcation, autonomous: bool, which: str) -> list[np.ndarray]:
    """The paths of the multipliers at a corner."""
    if not special.discontinuous or special.kind == "end":
        return []
    before, after = special.monodromies
    if not (np.isfinite(before).all() and np.isfinite(after).all()):
        largest = [_proper(np.asarray(side, complex)[None], autonomous)[0, 0] for side in special.multipliers]
        return [np.array(sorted(largest, key=np.isinf))]
    columns = path_between(before, after, multipliers=True).eigenvalues.T
    if autonomous:
        columns = np.delete(columns, np.argmin(np.max(np.abs(columns - 1), axis=1)), axis=0)
    if which == "largest":  # at either end
        columns = columns[sorted({int(np.argmax(np.abs(columns[:, q]))) for q in (0, -1)})]
    return list(columns)


def _ends(special: OrbitBifurcation, autonomous: bool, which: str) -> np.ndarray:
    """The multipliers that are marked: limits from both sides of a corner, or the one that meets the circle."""
    sides = [_proper(np.asarray(side, complex)[None], autonomous)[0] for side in special.multipliers]
    if special.discontinuous:
        return np.concatenate([side[:1] if which == "largest" else side for side in sides])
    critical = np.argmin(np.abs(np.abs(sides[0]) - 1)) if which == "all" else 0
    return sides[0][[critical]]
