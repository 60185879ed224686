"""Bifurcation diagrams."""

from collections.abc import Callable, Sequence
from typing import Any, TYPE_CHECKING

import jax
import numpy as np

from .._numerics._text import components
from ..continuation.equilibria._bifurcation import Bifurcation
from ..continuation.equilibria._branch import Branch
from ..orbits._orbit import Orbit
from ..system._parameter import get_parameter, parameter_path
from ._diagram import begun, LINE, mark, stretches, UNSTABLE, wording, write_names
from ._style import axes_or_new, axis_label, declared, Labels, legend as add_legend


if TYPE_CHECKING:
    from matplotlib.axes import Axes

Measure = str | Callable[[Any], Any] | None

PERIODIC = dict(color="0.6", linewidth=1.6)


def bifurcation_diagram(
    branch: Branch,
    measure: Measure = None,
    *,
    orbits: Sequence[Sequence[Orbit]] = (),
    names: bool | Callable[[Bifurcation], str] = True,
    ax: "Axes | None" = None,
    labels: Labels = None,
    legend: bool = True,
    **style: Any,
) -> "Axes":
    """Draws branches of equilibria over the parameter, stable ones solid, unstable ones dashed, with their special
    points; and branches of periodic orbits in grey; Figs. 5.4 to 5.16.

    **Arguments:**

    - `branch`: from `continue_equilibrium`; its other branches are drawn too.
    - `measure`: the scalar [x] that stands for the state (section 5.1): the name of a component, or a function of the
        state; by default the first component.
    - `orbits`: branches of periodic orbits, each a sequence in the order of the parameter; their largest and least
        measure along the orbit is drawn.
    - `names`: whether to write what the special points are; or a function of a `Bifurcation` that gives the words, none
        if empty.
    - `ax`: where to draw; by default a new figure.
    - `labels`: for the axes, as `{"mu": "μ [-]", "x": "x [m]"}`, a function of the state being
        "measure"; by default the names with the units that model and state declare.
    - `legend`: whether to explain the lines.
    - `style`: for the lines, as in `Axes.plot`.

    **Returns:** the axes.

    **Raises:** `ValueError` for an unknown component.
    """
    ax = axes_or_new(ax)
    measure = _known(branch, measure)
    for one in branch.branches:
        stretches(ax, one.values, _measured(measure, one.ys), one.stable, _styles("equilibrium"), LINE | style)
    for family in orbits:
        _periodic(ax, family, branch, measure)
    points = {id(special): special for one in branch.branches for special in one.special}
    places = [_point(ax, special, measure, names) for special in points.values()]
    name = measure if isinstance(measure, str) else "measure"
    labels = declared(labels, branch.system, branch.ys)
    ax.set_xlabel(axis_label(labels, branch.parameter))
    ax.set_ylabel(axis_label(labels, name))
    if legend:
        add_legend(ax)
    write_names(ax, [place for place in places if place[2]])
    return ax


def _styles(what: str) -> dict[bool, Any]:
    return {True: ("-", f"stable {what}"), False: (UNSTABLE, f"unstable {what}")}


def _measured(measure: str | Callable[[Any], Any], ys: Any) -> np.ndarray:
    """Of states with a leading axis."""
    if isinstance(measure, str):
        return np.asarray(components(ys, 1)[measure])
    return np.asarray(jax.vmap(measure)(ys))


def _periodic(ax: "Axes", family: Sequence[Orbit], branch: Branch, measure: str | Callable[[Any], Any]) -> None:
    # Extremes of samples, where `Orbit.maximum` is exact: on an arc of half a wave they are off by 3e-4 of the
    # amplitude at most, which is not visible, and the exact program takes several times as long to compile.
    rows = []
    for orbit in family:
        path = jax.tree.map(lambda x: x.reshape(-1), orbit.path().y)
        along = _measured(measure, path)
        value = float(get_parameter(orbit.system, parameter_path(orbit.system, branch.parameter)))
        rows.append((value, np.nanmax(along), np.nanmin(along), float(orbit.stable)))
    values, most, least, stable = np.array(rows).reshape(-1, 4).T
    values, most, least, stable = _from_hopf(values, most, least, stable, branch, measure)
    for extreme in most, least:
        stretches(ax, values, extreme, stable > 0, _styles("periodic orbit"), PERIODIC)


def _from_hopf(
    values: np.ndarray, most: np.ndarray, least: np.ndarray, stable: np.ndarray, branch: Branch,
    measure: str | Callable[[Any], Any],
) -> tuple[np.ndarray, ...]:  # fmt: skip
    """With the Hopf point at which the orbits shrink to an equilibrium, and what lies between, at the end where that
    is."""
    sizes = most - least
    hopf = [special for special in branch.special_points if "Hopf" in special.kind]
    if not hopf or len(values) < 2 or not min(sizes[0], sizes[-1]) < 0.5 * sizes.max():
        return values, most, least, stable
    way = 1 if sizes[0] <= sizes[-1] else -1
    values, most, least, stable, sizes = (array[::way] for array in (values, most, least, stable, sizes))
    nearest = min(hopf, key=lambda special: abs(special.value - values[0]))
    height = _height(nearest, measure)
    if not least[0] <= height <= most[0]:
        return values, most, least, stable
    first = np.insert(values, 0, nearest.value), np.insert(sizes, 0, 0.0)
    drawn = []
    for extreme in most, least:
        x, y = begun(first[0][:4], np.insert(extreme, 0, height)[:4], first[1][:4])
        drawn.append(np.concatenate([[height], y, extreme]))
        x = np.concatenate([[nearest.value], x, values])
    return x, *drawn, np.concatenate([np.full(len(x) - len(values), stable[0]), stable])


def heights_of(branch: Branch, measure: Measure) -> np.ndarray:
    """What stands for each of the states of a branch, without the others; `measure` as for `bifurcation_diagram`."""
    return _measured(_known(branch, measure), branch.ys)


def height_of(branch: Branch, special: Bifurcation, measure: Measure) -> float:
    """What stands for the state at a special point of a branch."""
    return _height(special, _known(branch, measure))


def _known(branch: Branch, measure: Measure) -> str | Callable[[Any], Any]:
    names = list(components(jax.tree.map(lambda x: x[0], branch.ys)))
    if measure is None:
        return names[0]
    if isinstance(measure, str) and measure not in names:
        raise ValueError(f"Argument `measure` must be one of {', '.join(names)}, or a function, but got {measure!r}.")
    return measure


def _height(special: Bifurcation, measure: str | Callable[[Any], Any]) -> float:
    return float(_measured(measure, jax.tree.map(lambda x: np.asarray(x)[None], special.y))[0])


def _point(
    ax: "Axes", special: Bifurcation, measure: str | Callable[[Any], Any], names: bool | Callable[[Bifurcation], str]
) -> tuple[float, float, str]:
    """Marks it, and says where it is and what is written beside it."""
    height = _height(special, measure)
    mark(ax, special.value, height, special.discontinuous, special.is_bifurcation)
    if callable(names):
        return special.value, height, names(special)
    return special.value, height, wording(special.name, keep=special.kind == "none") if names else ""
