"""How modes and axes are shown, the same way in every picture."""

from collections.abc import Mapping
from typing import Any, TYPE_CHECKING

from .._numerics._units import notes, time_unit
from ..system._system import System


if TYPE_CHECKING:
    from matplotlib.axes import Axes

Labels = Mapping[Any, str] | None

EVENT = dict(marker="o", linestyle="none", markersize=4.5, markerfacecolor="white", markeredgecolor="black", zorder=4)
WIDER = 1.15  # than axes may a legend be: their own labels are beside them
JUMP = dict(color="0.4", linestyle=":", linewidth=1.0, zorder=1)


def axes_or_new(ax: "Axes | None") -> "Axes":
    if ax is not None:
        return ax
    import matplotlib.pyplot as plt

    return plt.subplots(layout="constrained")[1]


def mode_line(system: System, mode: tuple[int, ...]) -> dict[str, Any]:
    """Colour, width and label of a line in this mode: a colour of its own for each mode (of up to two switches), thick
    while it slides."""
    number, words, slides = 0, [], False
    for k, (switch, value) in enumerate(zip(system.switches, mode)):
        words.append(switch.words(value))
        slides |= switch.order == 1 and value == switch.holding
        if switch.modes:  # each tick of a clock is another mode: no line for each
            number += 3**k * switch.modes.index(value)
    return dict(color=f"C{number % 10}", linewidth=3.5 if slides else 1.5, label="; ".join(filter(None, words)) or None)


def declared(labels: Labels, *owners: Any) -> dict[Any, str]:
    """Labels, and where there is none the name with the unit that the class of a model or a state declares."""
    units = {name: note.unit for owner in owners for name, note in notes(type(owner)).items() if note.unit}
    if time := time_unit(units.values()):
        units["t"] = time
    return {name: f"{name} [{unit}]" for name, unit in units.items()} | dict(labels or {})


def axis_label(labels: Labels, name: Any, default: str | None = None) -> str:
    return (labels or {}).get(name, name if default is None else default)


def once(ax: "Axes", label: str | None) -> str | None:
    """A label for what is drawn next: itself if nothing in the axes has it yet. Else with an underscore, so that
    `Axes.legend` does not repeat it."""
    if label and any(known == label for known in ax.get_legend_handles_labels()[1]):
        return f"_{label}"
    return label


def legend(ax: "Axes", columns: int = 3) -> None:
    """A legend above the axes, where it hides nothing; each label once, as it was drawn first. It has at most so many
    columns, and fewer where they would be wider than the axes."""
    handles, names = ax.get_legend_handles_labels()
    unique = dict(reversed([*zip(names, handles)]))
    unique = {name: unique[name] for name in dict.fromkeys(names)}
    place = dict(loc="lower center", bbox_to_anchor=(0.5, 1.0), fontsize="small", frameon=False)
    for count in range(min(columns, len(unique)), 0, -1):
        drawn = ax.legend(unique.values(), unique.keys(), ncols=count, **place)
        if drawn.get_window_extent().width <= WIDER * ax.get_window_extent().width:
            break
