"""Continuation on the command line: pictures and numbers of branches of periodic orbits, and those of chapter 6."""

import pathlib
from collections.abc import Callable, Iterator
from typing import Any, NamedTuple

import jax
import numpy as np

from .. import plot
from ..continuation._branch import CLOSED
from ..continuation.orbits._bifurcation import OrbitBifurcation
from ..continuation.orbits._branch import OrbitBranch
from ..plot._diagram import UNSTABLE, write_names
from ..plot._orbit_branch import amplitude
from ._job import Job, UsageError
from ._pictures import figure, save
from ._report import by_name, Units


SHORT = 0.12  # of the width and height of a picture


class Arc(NamedTuple):
    """A stretch of a branch between two special points: how the thesis can tell it."""

    order: int  # of its orbits
    stable: bool  # those in its middle
    ends: frozenset[str]  # letters, or kinds, of the special points


class Measure(NamedTuple):
    """What stands for an orbit, and for the equilibrium that the thesis draws beside it."""

    of: Callable[[OrbitBranch], Any] | None = None  # by default the amplitude
    label: str = ""
    equilibrium: Callable[[Any, np.ndarray], Any] | None = None  # at values of the parameter
    stable: bool = True


class Diagram(NamedTuple):
    """How the thesis shows the branches of a system."""

    parameter: str
    interval: tuple[float, float]
    letters: dict[tuple[str, bool], str] = {}  # of special points, by kind and whether they are discontinuous
    arcs: Callable[[Arc], str] = lambda arc: ""
    part: str = "abs"
    which: str = "all"
    view: tuple[float, float] | None = None  # of the multipliers
    enlarged: tuple[tuple[float, float], tuple[float, float]] | None = None
    measure: Measure = Measure()
    laps: int = 4  # the longest period that is followed, over that of the orbit
    kinds: bool = True  # whether special points without a letter are named by their kind

    def names(self, branch: OrbitBranch) -> Callable[[OrbitBifurcation], str]:
        """Letters, or else perhaps kinds. Orbits of several times the period that bifurcate with the others are not
        named, and of points of one kind it is that with the shortest period that has the letter."""
        words: dict[tuple, str] = {}
        named: list[float] = []
        for special in sorted(branch.special_points, key=lambda b: b.period):
            if _place(special) in words:
                continue
            letter = self.letters.get((special.kind, special.discontinuous), "")
            close = any(abs(special.value - value) <= 1e-6 * abs(value) for value in named)
            kind = special.kind if self.kinds else ""
            words[_place(special)] = "" if close else kind if letter in ("", *words.values()) else letter
            named.append(special.value)
        return lambda special: words[_place(special)]


def _place(special: OrbitBifurcation) -> tuple[str, str, str]:
    """The same for orbits that are images of each other, by symmetry or as the forcing begins its period later."""
    return special.kind, f"{special.value:.8g}", f"{special.period:.6g}"


def _arcs_68(arc: Arc) -> str:
    """Branch II is that on which C lies."""
    return "II" if "C" in arc.ends else "I"


def _arcs_69(arc: Arc) -> str:
    if arc.order > 2:
        if "B" in arc.ends:
            return "VIII" if arc.order == 8 else "VII"
        return "VI" if arc.order == 4 and "C" in arc.ends else ""
    if "A" in arc.ends:
        return "I" if arc.stable else "II"
    if "B" in arc.ends:
        return "V" if "fold" in arc.ends else "IV"
    return "III" if arc.stable else ""


DIAGRAMS = {
    "6.6": Diagram("omega", (0.5, 2.0), {("none", True): "$\\omega_A$", ("fold", True): "$\\omega_B$"}),
    "6.7": Diagram("v_dr", (0.1, 1.2), measure=Measure(equilibrium=lambda system, _: system.F_slip / system.k)),
    "6.8": Diagram(
        "omega",
        (0.5, 0.8),
        {("symmetry breaking", False): "A", ("symmetry breaking", True): "B", ("none", True): "C"},
        _arcs_68,
    ),
    "6.9": Diagram(
        "omega",
        (1.5, 1.95),
        {("fold", True): "A", ("fold-flip", True): "B", ("flip", True): "C"},
        _arcs_69,
        part="real",
        which="largest",
        view=(-4.0, 4.0),
        enlarged=((1.65, 1.73), (2.0, 2.3)),
    ),
    "A.8": Diagram(  # p1 and e1, Fig. A.7b
        "omega",
        (0.05, 3.0),
        measure=Measure(lambda p1: p1.low.w + p1.values, "min θ' [rad/s]", lambda _, omega: omega, stable=False),
    ),
    "A.9": Diagram(  # P2, P3 and P4, Figs. A.10 and A.11
        "omega",
        (2.2, 3.6),
        {("branch point", False): "P1", ("flip", True): "P2 | P3", ("fold", True): "P3 | P4", ("end", True): "f"},
        kinds=False,
        laps=1,  # the thesis does not follow those of twice the period, and each takes minutes
        view=(0.0, 4.0),
        enlarged=((2.34, 3.46), (0.998, 1.052)),
    ),
}


def diagram_for(job: Job, parameter: str | None, interval: tuple[float, float] | None) -> Diagram:
    """What to continue: as was asked for, or as the thesis does.

    **Raises:** `UsageError` where neither says.
    """
    known = DIAGRAMS.get(job.name)
    if known is not None and parameter in (None, known.parameter):
        return known._replace(interval=interval or known.interval)
    if parameter is None or interval is None:
        missing = "--param name" if parameter is None else "--range lo,hi"
        raise UsageError(f"There is no default for {job.name}; give {missing}. (There is for {', '.join(DIAGRAMS)}.)")
    return Diagram(parameter, interval)


def draw_branches(job: Job, branch: OrbitBranch, diagram: Diagram, out: pathlib.Path) -> list[pathlib.Path]:
    """Writes the bifurcation diagram, the multipliers over the parameter, and their paths at corners.

    **Returns:** the files.
    """
    labels = Units.of(job).labels()
    names = diagram.names(branch) if diagram.letters else True
    figures = {"bifurcation-diagram": _diagram(branch, diagram, names, labels)}
    if diagram.enlarged is not None:
        figures["bifurcation-diagram-enlarged"] = _diagram(branch, diagram, names, labels, diagram.enlarged)
    figures["multiplier-diagram"] = figure(6.8, 5.2)
    ax = figures["multiplier-diagram"].add_subplot()
    if diagram.view is not None:
        ax.set_ylim(diagram.view)
    how = dict(part=diagram.part, which=diagram.which)
    plot.multiplier_diagram(branch, **how, ax=ax, labels=labels, names=names)
    corners = list(_corners(branch, names))
    if corners:
        figures["multiplier-circles"] = _circles(corners, diagram, labels)
    return save(job, figures, out)


def _diagram(branch: OrbitBranch, diagram: Diagram, names: Any, labels: dict[Any, str], view: Any = None) -> Any:
    drawn = figure(6.8, 5.2)
    ax = drawn.add_subplot()
    if view is not None:
        ax.set(xlim=view[0], ylim=view[1])
    measure = diagram.measure
    if measure.equilibrium is not None:
        ends = np.array(diagram.interval)
        heights = np.broadcast_to(measure.equilibrium(branch.system, ends), ends.shape)
        style, word = ("-", "stable") if measure.stable else (UNSTABLE, "unstable")
        ax.plot(ends, heights, color="0.6", linewidth=1.6, linestyle=style, label=f"{word} equilibrium")
    words = labels | {"measure": measure.label} if measure.label else labels
    plot.orbit_diagram(branch, measure.of, ax=ax, labels=words, names=names)
    if callable(names):
        _number_arcs(ax, branch, diagram, names)
    return drawn


def _number_arcs(ax: Any, branch: OrbitBranch, diagram: Diagram, names: Callable[[OrbitBifurcation], str]) -> None:
    """I, II, ... beside the longest stretch of each that is seen, unless it is too short for words."""
    (left, right), (low, high) = ax.get_xlim(), ax.get_ylim()
    longest: dict[str, tuple[float, tuple[float, float, str]]] = {}
    for one in branch.branches:
        x, y = one.values, amplitude(one)
        seen = (left <= x) & (x <= right) & (low <= y) & (y <= high)
        for arc, start, stop in _arcs(one, names):
            rows = np.arange(start, stop)[seen[start:stop]]
            text = diagram.arcs(arc)
            if not len(rows) or not text:
                continue
            steps = np.hypot(np.diff(x[rows]) / (right - left), np.diff(y[rows]) / (high - low))
            along = np.concatenate([[0.0], np.cumsum(steps)])
            middle = rows[np.argmin(np.abs(along - along[-1] / 2))]
            if along[-1] > longest.get(text, (SHORT,))[0]:
                longest[text] = along[-1], (float(x[middle]), float(y[middle]), text)
    write_names(ax, [place for _, place in longest.values()])


def _arcs(branch: OrbitBranch, names: Callable[[OrbitBifurcation], str]) -> Iterator[tuple[Arc, int, int]]:
    """The stretches of a branch between its special points: with their first point, and that after their last."""
    inner = list(map(names, branch.special))
    # A closed branch does not end where it was begun.
    ends = [inner[-1], *inner, inner[0]] if inner and CLOSED in branch.ends else ["", *inner, ""]
    cuts = [0, *branch.indices, len(branch)]
    for k, (start, stop) in enumerate(zip(cuts, cuts[1:])):
        if stop - start > 2:
            middle = (start + stop) // 2
            known = frozenset(name for name in ends[k : k + 2] if name)
            yield Arc(int(branch.orders[middle]), bool(branch.stable[middle]), known), start, stop


def _corners(branch: OrbitBranch, names: Any) -> Iterator[OrbitBifurcation]:
    """Those at which multipliers jump to finite values, each once."""
    seen = set()
    for special in branch.special_points:
        finite = all(np.isfinite(m).all() for m in special.monodromies)
        known = not callable(names) or names(special)
        if special.discontinuous and special.kind != "end" and finite and known and _place(special) not in seen:
            yield special
        seen.add(_place(special))


def _circles(corners: list[OrbitBifurcation], diagram: Diagram, labels: dict[Any, str]) -> Any:
    columns = min(len(corners), 3)
    rows = -(-len(corners) // columns)
    drawn = figure(4.2 * columns, 0.6 + 4.2 * rows)
    drawn.set_layout_engine("compressed")  # because the axes have equal units
    axes = drawn.subplots(rows, columns, squeeze=False).ravel()
    for ax in axes[len(corners) :]:
        ax.remove()
    for special, ax in zip(corners, axes):
        plot.multiplier_circle(special, ax=ax)
        symbol, _, unit = labels.get(special.parameter, special.parameter).partition(" [")
        letter = diagram.letters.get((special.kind, special.discontinuous))
        words = ([letter] if letter else []) + [f"{symbol} = {special.value:.6g} {unit.removesuffix(']')}".strip()]
        name = special.name.partition(",")[0].partition(":")[0]
        ax.annotate(
            f"{', '.join(words)}\n{name}", (0.5, 0.0), (0, -38), xycoords="axes fraction", textcoords="offset points",
            ha="center", va="top", fontsize="small",
        )  # fmt: skip
    return drawn


# JSON.


def _pairs(multipliers: Any) -> list[list[float] | None]:
    """Real and imaginary parts; an infinite one is null."""
    return [[z.real, z.imag] if np.isfinite(z) else None for z in np.asarray(multipliers, complex).tolist()]


def branch_record(branch: OrbitBranch) -> dict[str, Any]:
    """Branches in numbers; their special points are named by their place in the list `special`."""
    special = branch.special_points
    place = {id(one): i for i, one in enumerate(special)}
    return {
        "parameter": branch.parameter,
        "branches": [
            {
                "points": list(_points(one)),
                "special": [{"point": int(i), "special": place[id(b)]} for i, b in zip(one.indices, one.special)],
                "ends": list(one.ends),
            }
            for one in branch.branches
        ],
        "special": [_special(one) for one in special],
    }


def _points(branch: OrbitBranch) -> Iterator[dict[str, Any]]:
    heights = amplitude(branch)
    for i in range(len(branch)):
        yield {
            "parameter": branch.values[i],
            "measure": heights[i],
            "period": branch.periods[i],
            "order": branch.orders[i],
            "t0": branch.ts[i],
            "y0": by_name(jax.tree.map(lambda x, i=i: x[i], branch.ys)),
            "multipliers": _pairs(branch.multipliers[i]),
            "itinerary": branch.itineraries[i],
            "stable": bool(branch.stable[i]),
        }


def _special(special: OrbitBifurcation) -> dict[str, Any]:
    return {
        "kind": special.kind,
        "name": special.name,
        "parameter": special.parameter,
        "value": special.value,
        "period": special.period,
        "t": special.t,
        "y": by_name(special.y),
        "discontinuous": bool(special.discontinuous),
        "criticality": special.criticality,
        "evidence": special.evidence,
        "multipliers": [_pairs(side) for side in special.multipliers],
        "crossings": [{"q": c.q, "eigenvalue": [c.eigenvalue.real, c.eigenvalue.imag]} for c in special.crossings],
        "count": [list(map(int, side)) for side in special.count],
        "halves": [
            {
                "side": int(half.side),
                "laps": int(half.laps),
                "multipliers": _pairs(half.multipliers),
                "stable": bool(half.stable),
                "itinerary": half.itinerary,
            }
            for half in special.halves
        ],
        "surfaces": list(special.surfaces),
        "transition": special.transition,
    }
