"""What is followed from one start, and how the thesis calls what lies on it."""

from collections.abc import Callable, Iterator, Mapping
from typing import Any, NamedTuple

import numpy as np

from ..continuation._branch import CLOSED
from ..continuation.equilibria._bifurcation import Bifurcation
from ..continuation.equilibria._branch import Branch
from ..continuation.orbits._bifurcation import OrbitBifurcation
from ..continuation.orbits._branch import OrbitBranch
from ..plot._branch import height_of, heights_of
from ..plot._diagram import wording
from ..plot._orbit_branch import measured, special_points
from ..system._system import System


AnyBranch = Branch | OrbitBranch
Special = Bifurcation | OrbitBifurcation


class Arc(NamedTuple):
    """A stretch of a branch between two special points: how the thesis can tell it."""

    order: int  # of its orbits; 1 for equilibria
    stable: bool  # those in its middle
    ends: frozenset[str]  # letters, or kinds, of the special points
    itinerary: str = ""  # of the orbit in its middle


class Start(NamedTuple):
    """Where a family is found."""

    system: System
    y0: Any  # a guess of an equilibrium, or of a state on an orbit
    period: float | None = None  # of an orbit of an autonomous system


class Family(NamedTuple):
    """Branches that are followed from one start, and their names."""

    name: str = ""  # in reports and files; empty of the only one
    equilibria: bool = False  # and not periodic orbits
    start: Callable[[System], Start] | None = None  # from the system of the command line; by default its own start
    interval: tuple[float, float] | None = None  # of the parameter, where it is shorter than that of the pictures
    letters: Mapping[tuple, str] = {}  # of special points: (kind, discontinuous), perhaps with the surfaces after it
    arcs: Callable[[Arc], str] = lambda arc: ""
    measure: Any = None  # as for `plot.orbit_diagram`, or for `plot.bifurcation_diagram`
    part: Callable[[Any], Any] = lambda branch: branch  # what is shown of the branch
    laps: int = 4  # the longest period that is looked for, over that of the orbit
    most: int | None = None  # of branches, where the thesis does not follow what else there is
    kinds: bool = True  # whether special points without a letter are named by their kind, in pictures

    def letter(self, special: Special) -> str:
        key = (special.kind, bool(special.discontinuous))
        return self.letters.get((*key, *special.surfaces), self.letters.get(key, ""))


class Followed(NamedTuple):
    """A family with its branches."""

    family: Family
    branch: AnyBranch

    def names(self) -> Callable[[Special], str]:
        """Letters, or else kinds. Orbits of several times the period that bifurcate with the others are not named, and
        of points of one kind it is that with the shortest period that has the letter."""
        words: dict[tuple, str] = {}
        named: list[float] = []
        for special in sorted(self.branch.special_points, key=lambda b: b.period or 0.0):
            if place(special) in words:
                continue
            letter = self.family.letter(special)
            close = any(abs(special.value - value) <= 1e-6 * abs(value) for value in named)
            words[place(special)] = "" if close else special.kind if letter in ("", *words.values()) else letter
            named.append(special.value)
        return lambda special: words[place(special)]

    def shown(self) -> Callable[[Special], str]:
        """The names that pictures show."""
        if not self.family.letters:
            return lambda special: wording(special.name, keep=special.kind == "none")
        names = self.names()
        return names if self.family.kinds else lambda special: self.letter(special, names)

    def letter(self, special: Special, names: Callable[[Special], str]) -> str:
        """The letter of the thesis; empty where it has none."""
        name = names(special)
        return name if name in self.family.letters.values() else ""

    def heights(self, one: Any) -> np.ndarray:
        """What stands for each point of one of the branches."""
        if isinstance(one, OrbitBranch):
            return measured(self.family.measure, one)
        return heights_of(one, self.family.measure)

    def marked(self) -> Iterator[tuple[float, float, Special]]:
        """Each special point, and where it is in a picture."""
        if isinstance(self.branch, OrbitBranch):
            heights = [self.heights(one) for one in self.branch.branches]
            for special, k, i in special_points(self.branch):
                yield special.value, float(heights[k][i]), special
        else:
            for special in self.branch.special_points:
                yield special.value, height_of(self.branch, special, self.family.measure), special

    def arcs(self, one: Any) -> Iterator[tuple[str, np.ndarray]]:
        """The names of the stretches of a branch between its special points, and the points that belong to each."""
        names = self.names()
        inner = [names(special) for special in one.special]
        # A closed branch does not end where it was begun.
        ends = [inner[-1], *inner, inner[0]] if inner and CLOSED in one.ends else ["", *inner, ""]
        cuts = [0, *one.indices, len(one)]
        for k, (start, stop) in enumerate(zip(cuts, cuts[1:])):
            if stop - start > 2:
                middle = (start + stop) // 2
                known = frozenset(name for name in ends[k : k + 2] if name)
                of_orbits = isinstance(one, OrbitBranch)
                order, way = (int(one.orders[middle]), one.itineraries[middle]) if of_orbits else (1, "")
                text = self.family.arcs(Arc(order, bool(one.stable[middle]), known, way))
                yield text, np.arange(start, stop)


def place(special: Special) -> tuple[str, str, str]:
    """The same for orbits that are images of each other, by symmetry or as the forcing begins its period later."""
    return special.kind, f"{special.value:.8g}", f"{special.period or 0.0:.6g}"
