"""Test functions: what vanishes at the special points along a branch of periodic orbits.

Each is written once, in the namespace of its arrays: NumPy's for a point that is looked at, jax's within a program.
"""

import functools as ft
from typing import Any, NamedTuple

import numpy as np

from ..._numerics._repeated import Same
from ...derivatives._floquet import trivial
from ...orbits.segments._equations import OrbitCurve
from ...orbits.segments._itinerary import EVENT, GRAZING, OrbitItinerary, REPELLING_EXIT
from ...orbits.segments._point import PointData


PASSED = ("fold", "flip", "Neimark-Sacker")  # bifurcations through which the branch goes on as it is
CORNERS = ("duration", "margin", "rate", "guard")  # in the order in which what vanishes together is told by the first


class Test(NamedTuple):
    """A function whose zero is looked for: what it is, of which segment, and of which guard."""

    kind: str
    row: int = 0
    slot: int = 0


BRANCH = Test("branch")
CIRCLE = (Test("flip"), Test("Neimark-Sacker"))


def complex_pair(multipliers: np.ndarray) -> bool:
    """Whether two of them are on the circle, and not real, as at a Neimark-Sacker point: real ones with the product 1
    are another zero of its test function."""
    on = np.abs(np.abs(multipliers) - 1) < 1e-5
    return bool(np.any(on & (np.abs(np.imag(multipliers)) > 1e-6)))


@ft.lru_cache(maxsize=64)
def corner_tests(rows: int, slots: int) -> tuple[Test, ...]:
    """By the numbers of segments and guards, in the order of `corner_values`."""
    of_segments = (Test(kind, i) for kind in ("rate", "margin", "duration") for i in range(rows))
    return (*of_segments, *(Test("guard", i, j) for i in range(rows) for j in range(slots)))


def corner_values(curve: OrbitCurve, look: PointData, itinerary: OrbitItinerary) -> tuple[Any, Any]:
    """Positive as long as the orbit is one; and which of these there are."""
    xp = look.begin.__array_namespace__()
    index = xp.arange(len(look.begin), dtype=itinerary.num.dtype)
    last, ends = itinerary.num - 1, xp.asarray(itinerary.ends)
    real, event = index <= last, ends == EVENT
    ends_before, ends_after = ends[xp.where(index == 0, last, index - 1)], ends[xp.where(index >= last, 0, index + 1)]
    values = [-look.rates, look.margins, (look.end - look.begin) / curve.time, look.least.ravel()]
    there = [
        real & event & (ends_after != REPELLING_EXIT),
        real & event & xp.isfinite(look.margins),
        real & (itinerary.num > 1) & (ends != GRAZING) & (ends_before != GRAZING),
        (real[:, None] & xp.isfinite(look.least)).ravel(),
    ]
    return xp.concatenate(values), xp.concatenate(there)


def branch_value(look: PointData, log: Any) -> Any:
    """The determinant of the equations bordered by the tangent, over exp(log)."""
    sign, size = look.branch
    xp = sign.__array_namespace__()
    return sign * xp.exp(xp.clip(size - log, -300, 300))


def circle_values(multipliers: Any, autonomous: bool) -> Any:
    """Zero where a multiplier is -1, and where two have the product 1."""
    xp = multipliers.__array_namespace__()
    counts = xp.isfinite(multipliers) & ~(trivial(multipliers) & autonomous)
    rho = xp.where(counts, multipliers, 0)
    first, second = np.triu_indices(len(rho), 1)
    flip = (1 + rho) / (1 + xp.abs(rho)).astype(rho.dtype)
    off = xp.where(counts[first] & counts[second], rho[first] * rho[second] - 1, 1)
    pairs = off / (1 + xp.abs(off)).astype(rho.dtype)
    return xp.stack([xp.prod(flip), xp.prod(pairs)]).real


def test_values(curve: OrbitCurve, spot: Any, log: float) -> dict[Test, float]:
    """All test functions of a point; the determinant is divided by exp(log)."""
    return {**_undivided(Same(curve), Same(spot)), BRANCH: float(branch_value(spot.look, log))}


@ft.lru_cache(maxsize=16)  # each point is looked at as the end of a step and as the beginning of the next
def _undivided(curve: Same, spot: Same) -> dict[Test, float]:
    look = spot.it.look
    share = float(look.u[-1])
    ends = {Test("low"): share, Test("high"): 1 - share, Test("fold"): float(look.tangent[-1])}
    return ends | of_corners(curve.it, spot.it) | of_circle(curve.it, spot.it)


def of_corners(curve: OrbitCurve, spot: Any) -> dict[Test, float]:
    values, there = corner_values(curve, spot.look, spot.itinerary)
    names = corner_tests(*spot.look.least.shape)
    return {name: value for name, value, known in zip(names, values.tolist(), there.tolist()) if known}


def of_circle(curve: OrbitCurve, spot: Any) -> dict[Test, float]:
    return dict(zip(CIRCLE, circle_values(spot.multipliers, curve.autonomous).tolist()))
