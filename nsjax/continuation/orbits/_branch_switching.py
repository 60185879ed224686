"""Points at which branches of periodic orbits meet, and the smooth ones among them: flips and branch points."""

import dataclasses
from typing import Any

import equinox as eqx
import numpy as np

from ...maps._corner_normal_form import Cycle
from ...orbits.segments._corrector import Plane
from ...orbits.segments._equations import linearised, OrbitCurve
from ...orbits.segments._itinerary import capacity_for, OrbitItinerary, Start, ticks, TIME
from ...orbits.segments._point import correct, state_at
from ...system._mode import mode_words
from .._tracer import Zero
from ._bifurcation import OrbitBifurcation, OrbitHalfBranch
from ._test_functions import CORNERS, test_values
from ._tracer import alike, midpoint, OrbitPoint, OrbitTracer, spot_of


BRANCHING = (3e-3, 1e-3, 1e-2, 3e-4, 1e-4, 1e-5)  # lengths of the step by which a branch is entered along its direction
ALIKE = 1e-6  # two points that are nearer are one
MOST_LAPS = 8  # in which an autonomous orbit may pass through the same points several times


@dataclasses.dataclass
class Departure:
    """A half-branch: the orbit on it next to the point, with its tangent away from it."""

    spot: OrbitPoint
    curve: OrbitCurve  # whose `order` is that of these orbits
    laps: int
    side: int
    cycle: Cycle | None = None
    partner: "Departure | None" = None

    @property
    def leads_on(self) -> bool:
        """Not out of the interval at once."""
        return bool(0 <= self.spot.look.u[-1] <= 1)

    @property
    def multipliers(self) -> np.ndarray:
        """Their limits at a corner."""
        if self.cycle is None:
            return self.spot.multipliers
        if not self.curve.autonomous:
            return self.cycle.multipliers
        found = np.append(self.cycle.multipliers, 1.0)
        return found[np.argsort(-np.abs(found), kind="stable")]


@dataclasses.dataclass
class Node:
    """A point at which half-branches meet, those that go on into one another being partners."""

    spot: OrbitPoint
    order: int
    halves: list[Departure]
    bifurcation: OrbitBifurcation

    def is_at(self, zero: Zero, curve: OrbitCurve) -> bool:
        """Whether it is this zero of a test function: a smooth bifurcation may be right beside a corner."""
        smooth = zero.test.kind in ("flip", "branch")
        return smooth != self.bifurcation.discontinuous and together(self.spot, zero.point, curve, ALIKE)


def together(a: OrbitPoint, b: OrbitPoint, curve: OrbitCurve, tolerance: float) -> bool:
    """Whether two are the same orbit at the same parameter."""
    return abs(a.parameter - b.parameter) < tolerance * float(curve.width) and alike(a, b, curve, tolerance)


def with_order(curve: OrbitCurve, order: int) -> OrbitCurve:
    return eqx.tree_at(lambda c: c.order, curve, np.asarray(order, np.int32))


def tracer_for(tracer: OrbitTracer, curve: OrbitCurve) -> OrbitTracer:
    return dataclasses.replace(tracer, curve=curve)


def _kernel(tracer: OrbitTracer, itinerary: OrbitItinerary, u: Any) -> np.ndarray:
    return np.linalg.svd(linearised(tracer.curve, itinerary, u))[2][-2:]


def set_out(tracer: OrbitTracer, itinerary: OrbitItinerary, u: Any, direction: np.ndarray) -> OrbitPoint | None:
    """An orbit on the branch that leaves `u` in this direction, with its tangent away from it."""
    for step in BRANCHING:
        look = correct(tracer.curve, itinerary, Plane(u, direction, step))
        if not bool(look.good):
            continue
        spot = spot_of(tracer.curve, look, itinerary)
        if float(np.linalg.norm(spot.look.u - u)) < 5 * step and admissible(tracer.curve, spot):
            return _along(spot, direction)
    return None


def _along(spot: OrbitPoint, direction: np.ndarray) -> OrbitPoint:
    return spot if float(spot.look.tangent @ direction) >= 0 else spot.turned


def admissible(curve: OrbitCurve, spot: OrbitPoint) -> bool:
    scale = float(spot.look.branch[1])
    return all(v > -1e-9 for t, v in test_values(curve, spot, scale).items() if t.kind in CORNERS)


def _repeated(curve: OrbitCurve, spot: OrbitPoint, times: int, period: float) -> tuple[OrbitItinerary, Start]:
    """The orbit several times."""
    n = int(spot.itinerary.num)
    rows = list(range(n)) * times
    itinerary = spot.itinerary.take(rows, capacity_for(len(rows)))
    lap = np.minimum(np.arange(len(itinerary.mode)) // n, times - 1).astype(np.int32)
    itinerary = itinerary._replace(mode=itinerary.mode + lap[:, None] * ticks(curve.model, spot.itinerary))
    shift = np.repeat(np.arange(times) * period, n)
    look = spot.look
    first = (np.tile(look.begin[:n], times) + shift, np.tile(look.end[:n], times) + shift)
    if itinerary.ends[0] == TIME:  # one segment, for as long
        itinerary = spot.itinerary
        return itinerary, Start(itinerary, look.begin[:1], look.begin[:1] + times * period, look.x[:1])
    return itinerary, Start(itinerary, *first, np.tile(look.x[:n], (times, 1)))


def flip_at(tracer: OrbitTracer, name: str, spot: OrbitPoint) -> Node | None:
    """Where a multiplier is -1: the orbit twice is a branch point of orbits of twice the period."""
    curve = tracer.curve
    itinerary, start = _repeated(curve, spot, 2, float(spot.look.period))
    twice = tracer_for(tracer, with_order(curve, 2 * int(curve.order)))
    u = twice.curve.pack(start, spot.parameter)
    kernel = _kernel(twice, itinerary, u)
    # On the orbit twice the parameter moves; on what is born here it does not, to first order.
    direction = np.array([-kernel[1][-1], kernel[0][-1]]) @ kernel
    direction = direction / np.linalg.norm(direction)
    born = set_out(twice, itinerary, u, direction)
    halves = []
    if born is not None:
        halves.append(Departure(born, twice.curve, 2, side_of(born, spot, curve)))
    made = OrbitBifurcation.smooth("flip", name, spot, curve, [half_branch_of(half) for half in halves])
    return Node(spot, int(curve.order), halves, made)


def _across(kernel: np.ndarray, tangent: np.ndarray) -> np.ndarray:
    """The direction in the kernel across the part of a tangent in it."""
    inside = kernel @ tangent
    direction = np.array([-inside[1], inside[0]]) @ kernel
    return direction / np.linalg.norm(direction)


def branch_point_at(tracer: OrbitTracer, name: str, spot: OrbitPoint) -> Node | None:
    """Where a multiplier is 1 and another branch crosses."""
    curve = tracer.curve
    n = int(spot.itinerary.num)
    cover = cover_of(spot, curve)
    if cover == 2:  # seen from the branch of twice the period
        rows = list(range(n // 2))
        itinerary = spot.itinerary.take(rows, capacity_for(len(rows))) if n > 1 else spot.itinerary
        once = tracer_for(tracer, with_order(curve, int(curve.order) // 2))
        start = Start(itinerary, spot.look.begin[: len(rows)], spot.look.end[: len(rows)], spot.look.x[: len(rows)])
        base = once.orbit_near(itinerary, once.curve.pack(start, spot.parameter))
        if base is None:
            return None
        node = flip_at(once, name, base)
        if node is not None:
            for other in (base, base.turned):
                side = int(np.sign(other.look.tangent[-1]))
                node.halves.append(Departure(other, once.curve, 1, side))
            node.halves[-1].partner, node.halves[-2].partner = node.halves[-2], node.halves[-1]
        return node
    kernel = _kernel(tracer, spot.itinerary, spot.look.u)
    tangent = np.asarray(spot.look.tangent)
    halves = []
    for direction in (tangent, _across(kernel, tangent)):
        pair = []
        for sign in (1, -1):
            born = set_out(tracer, spot.itinerary, spot.look.u, sign * direction)
            if born is not None:
                pair.append(Departure(born, curve, 1, side_of(born, spot, curve)))
        if len(pair) == 2:
            pair[0].partner, pair[1].partner = pair[1], pair[0]
        halves += pair
    sides = sorted(half.side for half in halves)
    kind = "symmetry breaking" if sides in ([-1, -1, -1, 1], [-1, 1, 1, 1]) else "transcritical"
    if len(halves) != 4:
        kind = "branch point"
    made = OrbitBifurcation.smooth(kind, name, spot, curve, [half_branch_of(half) for half in halves])
    return Node(spot, int(curve.order), halves, made)


def cover_of(spot: OrbitPoint, curve: OrbitCurve, tolerance: float = 1e-4) -> int:
    """How many times the orbit passes through the same points."""
    look, n, order = spot.look, int(spot.itinerary.num), int(curve.order)
    period = float(look.period)
    t, x, _ = midpoint(curve, spot, spot.itinerary.rows)

    def away(times: int) -> float:
        later = float(look.begin[0]) + (t - float(look.begin[0]) + period / times) % period
        i = next((i for i in range(n) if look.begin[i] <= later <= look.end[i]), n - 1)
        there = state_at(curve, spot.itinerary, look, i, later)
        return float(np.max(np.abs(there - x) / np.asarray(curve.sizes)))

    most = MOST_LAPS if curve.autonomous else order
    several = [k for k in range(most, 1, -1) if curve.autonomous or order % k == 0]
    return next((k for k in several if away(k) < tolerance), 1)


def side_of(half: OrbitPoint, at: OrbitPoint, curve: OrbitCurve) -> int:
    return int(np.sign(half.parameter - at.parameter)) or int(np.sign(half.look.tangent[-1]))


def half_branch_of(half: Departure) -> OrbitHalfBranch:
    spot = half.spot
    return OrbitHalfBranch(
        half.side, half.laps, half.multipliers, spot.stable, itinerary_text(half.curve, spot.itinerary)
    )


def itinerary_text(curve: OrbitCurve, itinerary: OrbitItinerary) -> str:
    names = [k.name for k in curve.model.switches]
    return " -> ".join(mode_words(names, itinerary.mode[i]) for i in itinerary.rows)
