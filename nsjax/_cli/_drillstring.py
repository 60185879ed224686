"""The branches of the drillstring as Appendix A of the thesis shows them."""

import dataclasses
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from .. import gallery
from .._types import Scalar
from ..continuation.equilibria._branch import Branch
from ..continuation.orbits._branch import OrbitBranch
from ..gallery import (
    DrillstringModel,
    DrillstringScene,
    FreeDrillstringScene,
    TwistedWhirl,
    Whirl,
    WhirlModel,
    WhirlScene,
)
from ..mechanics import SceneModel
from ..system._system import System
from ._family import Arc, Family, Start


MIDDLE = "the middle of the stator"  # where a branch ends
ROUNDING = 1e-6  # of r where it vanishes: the square of r is what goes smoothly through zero
# Of equilibria: where the middle loses its stability; and where e2 meets the stator, and rolling ends.
WHIRLS = {("saddle-node", False): "c", ("saddle-node", True, "wall"): "f", ("saddle-node", True, "roll"): "d"}


def _radius(y: Any) -> Scalar:
    """Of a state in Cartesian coordinates."""
    return jnp.hypot(y.q.x, y.q.y)


def _radii(branch: OrbitBranch) -> np.ndarray:
    """The largest along each orbit, in Cartesian coordinates: exact on those that stay in the middle."""
    return np.hypot(*(np.maximum(np.abs(getattr(branch.low.q, x)), np.abs(getattr(branch.high.q, x))) for x in "xy"))


def _scene(of: type[SceneModel], system: System, **changes: Any) -> Any:
    """The same in Cartesian coordinates."""
    return of(**({f.name: getattr(system, f.name) for f in dataclasses.fields(system)} | changes))


def _in_the_middle(system: System) -> Start:
    scene = _scene(WhirlScene if isinstance(system, WhirlModel) else DrillstringScene, system, omega=1.0)
    return Start(scene, scene.state())


def _whirling(system: System) -> Start:
    """Beside e2, as it is for the parameters of the thesis; Ω by (A.17)."""
    whirl = Whirl(0.75, 0.0, 0.325)
    if isinstance(system, DrillstringModel):
        return Start(dataclasses.replace(system, omega=2.6), TwistedWhirl(*whirl, 0.0, 0.0))
    return Start(dataclasses.replace(system, omega=2.6), whirl)


def _stick_slip(system: System) -> Start:
    """On P1, in the middle, where there are Cartesian coordinates only. It does not meet the stator."""
    guess = gallery.entry("A.8").orbit
    assert guess is not None
    scene = _scene(FreeDrillstringScene, system, omega=2.0)
    return Start(scene, scene.state(dict(phi=guess.y0.phi), dict(phi=guess.y0.w)), guess.period)


def _whirl_with_twist(system: System) -> Start:
    """On P6, beside the Hopf point of E2."""
    guess = TwistedWhirl(0.23847, 0.03697, 0.19996, -0.09442, 0.35538)
    return Start(dataclasses.replace(system, omega=2.5425), guess, 6.05875)


def _beyond_the_middle(branch: Branch) -> Branch:
    """Without what polar coordinates show at r < 0, which is the same seen from the other side. (Or, where it were
    beyond the stator, nothing, as the model does not have it there.)"""
    inside = np.flatnonzero(np.asarray(branch.ys.r) >= -ROUNDING)
    first, last = int(inside[0]), int(inside[-1])
    rows = slice(first, last + 1)
    kept = [(i - first, s) for i, s in zip(branch.indices, branch.special) if first <= i <= last]
    begin, end = branch.ends
    return dataclasses.replace(
        branch,
        values=branch.values[rows],
        ys=jax.tree.map(lambda x: x[rows], branch.ys),
        modes=branch.modes[rows],
        multipliers=branch.multipliers[rows],
        eigenvalues=branch.eigenvalues[rows],
        unstable=branch.unstable[rows],
        stable=branch.stable[rows],
        special=tuple(s for _, s in kept),
        indices=tuple(i for i, _ in kept),
        ends=(MIDDLE if first else begin, MIDDLE if last < len(branch) - 1 else end),
    )


# The names of the thesis.


def _whirl_arcs(arc: Arc) -> str:
    """Of the whirl model, Fig. A.6."""
    if arc.ends == {"d"}:
        return "e4"
    return {frozenset("cf"): "e2", frozenset("fd"): "e3"}.get(arc.ends, "")


def _twisted_arcs(arc: Arc) -> str:
    """Of the whole model, Figs. A.8 to A.12: torsion divides E2 by a Hopf point."""
    if arc.ends == {"d"}:
        return "E4"
    return {
        frozenset(("c", "E2 | P6")): "E2a",
        frozenset(("E2 | P6", "f")): "E2b",
        frozenset("fd"): "E3",
    }.get(arc.ends, "")


def _orbit_arcs(arc: Arc) -> str:
    """On P2 and P3 the bit comes to rest, to stick or to slip backwards; P3 and P4 touch the stator."""
    rests, touches = "bit +0" in arc.itinerary or "bit -1" in arc.itinerary, "wall +1" in arc.itinerary
    if rests:
        return "P3" if touches else "P2"
    return {
        frozenset(("P3 | P4", "Neimark-Sacker")): "P4a",
        frozenset(("Neimark-Sacker", "flip")): "P4b",
        frozenset(("flip",)): "P4c",
        frozenset(("flip", "fold")): "P4d",
        frozenset(("fold",)): "P4e",
    }.get(arc.ends, "")


def _whirl_orbit_arcs(arc: Arc) -> str:
    """P6 does not touch the stator: from the Hopf point to its fold, and from there to where it does, as P5."""
    if "wall +1" in arc.itinerary:
        return "P5"
    return "P6b" if "E2 | P6" in arc.ends else "P6a"


WHIRL = (
    Family(
        "e2 to e4",
        equilibria=True,
        start=_whirling,
        letters=WHIRLS,
        arcs=_whirl_arcs,
        measure="r",
        part=_beyond_the_middle,
    ),
    Family(
        "e1",
        equilibria=True,
        start=_in_the_middle,
        letters={("Hopf", False): "c"},
        arcs=lambda arc: "e1a" if arc.stable else "e1b",
        measure=_radius,
    ),
)
"""Those of A.7: e1 in Cartesian coordinates, in which the middle is a place like others."""

STICK_SLIP_WHIRL = (
    Family(
        "P2 to P4",
        interval=(2.2, 3.6),
        letters={
            ("branch point", False): "P1 | P2",
            ("flip", True): "P2 | P3",
            ("fold", True): "P3 | P4",
            ("end", True): "f",
        },
        arcs=_orbit_arcs,
        laps=2,  # so that flips are seen; but the thesis does not follow what is born there, and each takes minutes
        most=1,
        kinds=False,
    ),
    Family(
        "P5 and P6",
        start=_whirl_with_twist,
        interval=(2.5, 2.7),
        letters={("Hopf", False): "E2 | P6", ("fold-flip", True): "P5 | P6", ("end", True): "f"},
        arcs=_whirl_orbit_arcs,
        laps=2,
        most=2,
        kinds=False,
    ),
    Family(
        "P1",
        start=_stick_slip,
        interval=(0.05, 3.5),
        letters={("Neimark-Sacker", False): "P1 | P2"},
        arcs=lambda arc: "P1a" if arc.stable else "P1b",
        measure=_radii,
        laps=1,
        kinds=False,
    ),
    Family(
        "E2 to E4",
        equilibria=True,
        start=_whirling,
        interval=(0.05, 3.5),
        letters=WHIRLS | {("Hopf", False): "E2 | P6"},
        arcs=_twisted_arcs,
        measure="r",
        part=_beyond_the_middle,
        kinds=False,
    ),
    Family(
        "E1",
        equilibria=True,
        start=_in_the_middle,
        interval=(0.05, 3.5),
        letters={("Hopf", False): "c"},
        arcs=lambda arc: "E1",
        measure=_radius,
        kinds=False,
    ),
)
"""Those of A.9: P1, which stays in the middle, and E1 in Cartesian coordinates."""
