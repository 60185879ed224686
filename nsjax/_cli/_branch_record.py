"""Branches as JSON, be they of equilibria or of periodic orbits."""

from collections.abc import Iterator, Sequence
from typing import Any

import jax
import numpy as np

from ..continuation.orbits._bifurcation import OrbitBifurcation
from ..continuation.orbits._branch import OrbitBranch
from ._family import AnyBranch, Followed, Special
from ._report import by_name


def branch_record(found: Sequence[Followed]) -> dict[str, Any]:
    """Branches in numbers; their special points are named by their place in the list `special`."""
    special = [(one, followed) for followed in found for one in followed.branch.special_points]
    place = {id(one): i for i, (one, _) in enumerate(special)}
    return {
        "parameter": found[0].branch.parameter,
        "branches": [
            {
                "family": followed.family.name,
                "of": "periodic orbits" if isinstance(one, OrbitBranch) else "equilibria",
                "points": list(_points(one, followed.heights(one))),
                "special": [{"point": int(i), "special": place[id(b)]} for i, b in zip(one.indices, one.special)],
                "ends": list(one.ends),
            }
            for followed in found
            for one in followed.branch.branches
        ],
        "special": [_special(one, followed) for one, followed in special],
    }


def _pairs(numbers: Any) -> list[list[float] | None]:
    """Real and imaginary parts; what is infinite, or there is none of, is null."""
    return [[z.real, z.imag] if np.isfinite(z) else None for z in np.asarray(numbers, complex).tolist()]


def _points(branch: AnyBranch, heights: np.ndarray) -> Iterator[dict[str, Any]]:
    for i in range(len(branch)):
        common = {"parameter": branch.values[i], "measure": heights[i], "stable": bool(branch.stable[i])}
        y = by_name(jax.tree.map(lambda x, i=i: x[i], branch.ys))
        if isinstance(branch, OrbitBranch):
            yield common | {
                "period": branch.periods[i],
                "order": branch.orders[i],
                "t0": branch.ts[i],
                "y0": y,
                "multipliers": _pairs(branch.multipliers[i]),
                "itinerary": branch.itineraries[i],
            }
        else:
            names = [switch.name for switch in branch.system.switches]
            yield common | {
                "y": y,
                "mode": dict(zip(names, branch.modes[i])),
                "eigenvalues": _pairs(branch.eigenvalues[i]),
            }


def _special(special: Special, found: Followed) -> dict[str, Any]:
    halves = [{"side": int(half.side), "stable": bool(half.stable)} for half in special.halves]
    common = {
        "letter": found.letter(special, found.names()),
        "kind": special.kind,
        "name": special.name,
        "parameter": special.parameter,
        "value": special.value,
        "period": special.period,
        "y": by_name(special.y),
        "discontinuous": bool(special.discontinuous),
        "criticality": special.criticality,
        "evidence": special.evidence,
        "crossings": [{"q": c.q, "eigenvalue": [c.eigenvalue.real, c.eigenvalue.imag]} for c in special.crossings],
        "surfaces": list(special.surfaces),
    }
    if isinstance(special, OrbitBifurcation):
        more = [
            {"laps": int(half.laps), "multipliers": _pairs(half.multipliers), "itinerary": half.itinerary}
            for half in special.halves
        ]
        common |= {
            "t": special.t,
            "multipliers": [_pairs(side) for side in special.multipliers],
            "count": [list(map(int, side)) for side in special.count],
            "transition": special.transition,
        }
    else:
        names = [switch.name for switch in found.branch.system.switches]
        more = [
            {"mode": dict(zip(names, half.mode)), "eigenvalues": _pairs(half.eigenvalues)} for half in special.halves
        ]
        common |= {"count": list(map(int, special.count))}
    return common | {"halves": [half | own for half, own in zip(halves, more)]}
