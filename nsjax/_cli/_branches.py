"""Pictures of branches, with the names of the thesis."""

import pathlib
from collections.abc import Callable, Sequence
from typing import Any

import numpy as np

from .. import plot
from ..continuation.orbits._bifurcation import OrbitBifurcation
from ..continuation.orbits._branch import OrbitBranch
from ..plot._diagram import UNSTABLE, write_names
from ..plot._orbit_branch import write_once
from ..plot._style import legend
from ._diagrams import Diagram, Picture
from ._family import Followed, place
from ._job import Job
from ._pictures import figure, save
from ._report import Units


SHORT = 0.12  # of the width and height of a picture
FAR = 3.0  # from zero: what lies beyond, the circle would be too small to be seen beside
BEHIND = dict(color="0.55", linewidth=1.2, zorder=1.5)  # equilibria, in pictures with orbits


def draw_branches(job: Job, found: Sequence[Followed], diagram: Diagram, out: pathlib.Path) -> list[pathlib.Path]:
    """Writes the bifurcation diagrams, and for orbits the multipliers over the parameter, and their paths at corners.

    **Returns:** the files.
    """
    labels = Units.of(job).labels()
    figures = {}
    for picture in diagram.pictures:
        shown = [one for one in found if picture.families is None or one.family.name in picture.families]
        if shown:
            figures[picture.kind] = _diagram(shown, diagram, labels, picture)
    corners = []
    for one in found:
        if isinstance(one.branch, OrbitBranch):
            figures["-".join(["multiplier-diagram", *one.family.name.split()])] = _multipliers(one, diagram, labels)
            corners += [(special, one) for special in _corners(one.branch, one.shown())]
    if corners:
        figures["multiplier-circles"] = _circles(corners, labels)
    return save(job, figures, out)


def _diagram(found: Sequence[Followed], diagram: Diagram, labels: dict[Any, str], picture: Picture = Picture()) -> Any:
    drawn = figure(6.8, 5.2)
    ax = drawn.add_subplot()
    if picture.view is not None:
        ax.set(xlim=picture.view[0], ylim=picture.view[1])
    measure = diagram.measure
    if measure.equilibrium is not None:
        ends = np.array(diagram.interval)
        heights = np.broadcast_to(measure.equilibrium(found[0].branch.system, ends), ends.shape)
        style, word = ("-", "stable") if measure.stable else (UNSTABLE, "unstable")
        ax.plot(ends, heights, color="0.6", linewidth=1.6, linestyle=style, label=f"{word} equilibrium")
    words = labels | {"measure": measure.label} if measure.label else labels
    how = dict(ax=ax, labels=words, names=False, legend=False)
    mixed = len({type(one.branch) for one in found}) > 1
    for one in found:
        if isinstance(one.branch, OrbitBranch):
            plot.orbit_diagram(one.branch, one.family.measure, **how)
        else:
            plot.bifurcation_diagram(one.branch, one.family.measure, **how, **(BEHIND if mixed else {}))
    if measure.label:
        ax.set_ylabel(measure.label)
    legend(ax)
    write_once(ax, [(x, y, one.shown()(special)) for one in found for x, y, special in one.marked()])
    _number_arcs(ax, found)
    return drawn


def _number_arcs(ax: Any, found: Sequence[Followed]) -> None:
    """I, II, ... beside the longest stretch of each that is seen, unless it is too short for words."""
    (left, right), (low, high) = ax.get_xlim(), ax.get_ylim()
    longest: dict[str, tuple[float, tuple[float, float, str]]] = {}
    for family in found:
        for one in family.branch.branches:
            x, y = one.values, family.heights(one)
            seen = (left <= x) & (x <= right) & (low <= y) & (y <= high)
            for text, rows in family.arcs(one):
                rows = rows[seen[rows]]
                if not len(rows) or not text:
                    continue
                steps = np.hypot(np.diff(x[rows]) / (right - left), np.diff(y[rows]) / (high - low))
                along = np.concatenate([[0.0], np.cumsum(steps)])
                middle = rows[np.argmin(np.abs(along - along[-1] / 2))]
                if along[-1] > longest.get(text, (SHORT,))[0]:
                    longest[text] = along[-1], (float(x[middle]), float(y[middle]), text)
    write_names(ax, [where for _, where in longest.values()])


def _multipliers(one: Followed, diagram: Diagram, labels: dict[Any, str]) -> Any:
    drawn = figure(6.8, 5.2)
    ax = drawn.add_subplot()
    if diagram.view is not None:
        ax.set_ylim(diagram.view)
    how = dict(part=diagram.part, which=diagram.which, names=one.shown())
    plot.multiplier_diagram(one.branch, **how, ax=ax, labels=labels)
    return drawn


def _corners(branch: OrbitBranch, shown: Callable[[OrbitBifurcation], str]) -> list[OrbitBifurcation]:
    """Those with a name at which multipliers jump to finite values, each once."""
    seen, corners = set(), []
    for special in branch.special_points:
        finite = all(np.isfinite(m).all() for m in special.monodromies)
        if special.discontinuous and special.kind != "end" and finite and shown(special) and place(special) not in seen:
            corners.append(special)
        seen.add(place(special))
    return corners


def _circles(corners: Sequence[tuple[OrbitBifurcation, Followed]], labels: dict[Any, str]) -> Any:
    columns = min(len(corners), 3)
    rows = -(-len(corners) // columns)
    drawn = figure(4.2 * columns, 0.6 + 5.0 * rows)
    drawn.set_layout_engine("compressed")  # because the axes have equal units
    axes = drawn.subplots(rows, columns, squeeze=False).ravel()
    for ax in axes[len(corners) :]:
        ax.remove()
    for (special, found), ax in zip(corners, axes):
        # The same square for all, or as far as there is something.
        ends = np.abs(np.concatenate([np.ravel(side) for side in special.multipliers]))
        reach = min(FAR, max(1.2, 1.1 * float(ends.max())))
        ax.set(xlim=(-reach, reach), ylim=(-reach, reach))
        plot.multiplier_circle(special, ax=ax, labels=labels)
        symbol, _, unit = labels.get(special.parameter, special.parameter).partition(" [")
        letter = found.family.letter(special)
        words = ([letter] if letter else []) + [f"{symbol} = {special.value:.6g} {unit.removesuffix(']')}".strip()]
        name = special.name.partition(",")[0].partition(":")[0]
        ax.set_xlabel(f"{ax.get_xlabel()}\n{', '.join(words)}\n{name}")
    return drawn
