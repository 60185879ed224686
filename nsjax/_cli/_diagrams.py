"""How the thesis shows the branches of its systems, and what is to be continued."""

from collections.abc import Callable
from typing import Any, NamedTuple

import numpy as np

from ._drillstring import STICK_SLIP_WHIRL, WHIRL
from ._family import Arc, Family
from ._job import Job, UsageError


View = tuple[tuple[float, float], tuple[float, float]]  # of the parameter, and of what stands for a solution


class Picture(NamedTuple):
    """A bifurcation diagram, or a part of it."""

    kind: str = "bifurcation-diagram"
    view: View | None = None
    families: tuple[str, ...] | None = None  # by name; by default all


class Measure(NamedTuple):
    """What stands for a solution, and for the equilibrium that the thesis draws beside it."""

    label: str = ""
    equilibrium: Callable[[Any, np.ndarray], Any] | None = None  # at values of the parameter
    stable: bool = True


class Diagram(NamedTuple):
    """What is followed of a system, and shown."""

    parameter: str
    interval: tuple[float, float]
    families: tuple[Family, ...] = (Family(),)
    pictures: tuple[Picture, ...] = (Picture(),)
    measure: Measure = Measure()
    part: str = "abs"  # of multipliers
    which: str = "all"
    view: tuple[float, float] | None = None  # of the multipliers
    lasts: str = ""  # how long it takes, where that is more than a few minutes

    def interval_of(self, family: Family) -> tuple[float, float]:
        """That in which the family is followed; empty, the upper end being the lower, where it is elsewhere."""
        low, high = family.interval or self.interval
        return max(low, self.interval[0]), min(high, self.interval[1])


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


_DETAIL = "bifurcation-diagram-enlarged"
_WHOLE = ("P2 to P4", "P5 and P6", "P1", "E2 to E4")  # E1 lies beneath P1

DIAGRAMS = {
    "6.6": Diagram(
        "omega",
        (0.5, 2.0),
        (Family(letters={("none", True): "$\\omega_A$", ("fold", True): "$\\omega_B$"}),),
    ),
    "6.7": Diagram("v_dr", (0.1, 1.2), measure=Measure(equilibrium=lambda system, _: system.F_slip / system.k)),
    "6.8": Diagram(
        "omega",
        (0.5, 0.8),
        (
            Family(
                letters={("symmetry breaking", False): "A", ("symmetry breaking", True): "B", ("none", True): "C"},
                arcs=_arcs_68,
            ),
        ),
    ),
    "6.9": Diagram(
        "omega",
        (1.5, 1.95),
        (Family(letters={("fold", True): "A", ("fold-flip", True): "B", ("flip", True): "C"}, arcs=_arcs_69),),
        (Picture(), Picture(_DETAIL, ((1.65, 1.73), (2.0, 2.3)))),
        part="real",
        which="largest",
        view=(-4.0, 4.0),
    ),
    "A.7": Diagram(  # Fig. A.6
        "omega",
        (0.05, 3.0),
        WHIRL,
        (Picture(view=((0.0, 3.0), (-0.12, 2.2))),),
        Measure("r [m]"),
    ),
    "A.8": Diagram(  # p1 and e1, Fig. A.7b
        "omega",
        (0.05, 3.0),
        (Family(measure=lambda p1: p1.low.w + p1.values),),
        measure=Measure("min θ' [rad/s]", lambda _, omega: omega, stable=False),
    ),
    "A.9": Diagram(
        "omega",
        (0.05, 3.6),
        STICK_SLIP_WHIRL,
        (
            Picture("equilibria", ((0.0, 3.0), (-0.1, 2.0)), ("E1", "E2 to E4")),  # Fig. A.8
            Picture("bifurcation-diagram", ((0.0, 3.5), (-0.1, 2.0)), _WHOLE),  # Fig. A.9
            Picture(_DETAIL, ((2.2, 3.5), (-0.06, 1.2)), _WHOLE),  # Fig. A.10
            Picture(f"{_DETAIL}-2", ((2.24, 3.5), (0.998, 1.052)), _WHOLE),  # Fig. A.11
            Picture(f"{_DETAIL}-3", ((2.54, 2.66), (0.998, 1.005)), _WHOLE),  # Fig. A.12
        ),
        measure=Measure("max r [m]"),
        view=(0.0, 4.0),
        lasts="twenty minutes",
    ),
}


def diagram_for(
    job: Job, parameter: str | None, interval: tuple[float, float] | None, equilibria: bool = False
) -> Diagram:
    """What to continue: as was asked for, or as the thesis does.

    **Arguments:**

    - `job`: the system and its start.
    - `parameter`, `interval`: where they were given.
    - `equilibria`: whether equilibria were asked for; without it, what the thesis shows, or periodic orbits.

    **Raises:** `UsageError` where neither says.
    """
    known = DIAGRAMS.get(job.name)
    if known is not None and parameter in (None, known.parameter):
        known = known._replace(interval=interval or known.interval)
        if not equilibria:
            return known
        families = tuple(family for family in known.families if family.equilibria)
        shown = {family.name for family in families}
        pictures = tuple(p for p in known.pictures if p.families is None or shown >= set(p.families))
        if families and pictures:
            return known._replace(families=families, pictures=pictures)
        return Diagram(known.parameter, known.interval, (Family(equilibria=True),))
    if parameter is None or interval is None:
        missing = "--param name" if parameter is None else "--range lo,hi"
        raise UsageError(f"There is no default for {job.name}; give {missing}. (There is for {', '.join(DIAGRAMS)}.)")
    return Diagram(parameter, interval, (Family(equilibria=equilibria),))
