"""Along a curve of special points of periodic orbits in two parameters, to where the orbits are none any more."""

import dataclasses
from collections.abc import Callable
from typing import NamedTuple

import numpy as np

from ..._numerics._bracket import bracketed
from ...orbits.segments._equations import linearised
from .._step_length import FIRST, next_length, shortened, turn_between, TURNED
from .._zeros import FAILED, interpolated
from ..orbits._test_functions import BRANCH, CORNERS, Test
from ..orbits._tracer import LAST_FOUND, OrbitPoint
from ..orbits.corners._grazing import cut_itinerary
from ._surface import AbstractBifurcationTracer, BifurcationTracer, cleared, CUSP, DELTA, Place, RESONANCES, seen_at


TOGETHER = 1e-3  # zeros that are nearer to each other, in steps, are one
DEGENERATE = 1e-2  # of the slope of the test function: where it is less, two branches of its zeros cross
# What vanishes together is told by the first. (At a resonance multipliers also pass 1 or -1.)
RANK = (*CORNERS, *(test.kind for test in RESONANCES), "cusp", "branch", "fold", "flip", "Neimark-Sacker")
LAST = (*CORNERS, "grazing", "low", "high", "1:1 resonance", "1:2 resonance")  # where the curve ends


class Codim2Point(NamedTuple):
    """What else vanishes at a point of the curve: of codimension two."""

    test: Test
    others: tuple[Test, ...]
    spot: OrbitPoint
    s: float = 0.0


@dataclasses.dataclass
class Trace:
    """Points one after the other, and what is met at some of them; `end` is the last if it ends the curve."""

    spots: list[OrbitPoint]
    met: list[tuple[int, Codim2Point]] = dataclasses.field(default_factory=list)
    end: Codim2Point | None = None
    why: str = ""
    closed: bool = False


def trace(locus: AbstractBifurcationTracer, place: Place, max_step: float, max_points: int) -> Trace:
    """Follows the curve from a point in the direction that it has there."""
    out, begin, length, steps = Trace([place.spot]), place, FIRST, 0
    while len(out.spots) < max_points:

        def attempt(length: float, place: Place = place) -> tuple[Place, float, list[Codim2Point]] | None:
            try:
                after = locus.place(locus.step(place, length), place.along, place.heading)
                turn = float(turn_between(place.along, after.along))
                return None if turn > TURNED else (after, turn, _met(locus, place, after, length))
            except FAILED:
                return None

        step = shortened(length, attempt)
        if step is None:
            out.why = LAST_FOUND
            return out
        length, (after, turn, found) = step
        for met in found:
            # Samples show late that a surface is touched: what lies beyond the exact point is no orbit.
            while met.test.kind == "grazing" and len(out.spots) > 1 and _beyond(out.spots[-1], met.spot, place):
                out.spots.pop()
            out.spots.append(met.spot)
            out.met.append((len(out.spots) - 1, met))
            if met.test.kind in LAST:
                out.end = met
                return out
        steps += 1
        if steps > 3 and _passes(locus, place, begin, length):
            out.spots.append(begin.spot)
            out.closed = True
            return out
        out.spots.append(after.spot)
        length = float(next_length(length, turn, after.along, after.spot.look.u, max_step))
        place = after
    out.why = f"max_points = {max_points}"
    return out


def _beyond(spot: OrbitPoint, end: OrbitPoint, place: Place) -> bool:
    """In the parameters: the orbits are cut differently."""
    return float((spot.look.u[-2:] - end.look.u[-2:]) @ place.along[-2:]) > 0


def _passes(locus: AbstractBifurcationTracer, place: Place, begin: Place, length: float) -> bool:
    s = float(place.along @ (begin.spot.look.u - place.spot.look.u))
    if not 0 < s <= length or place.along @ begin.along < 0.5:
        return False
    return bool(np.max(np.abs(locus.step(place, s).look.u - begin.spot.look.u)) < 1e-6)


def _met(locus: AbstractBifurcationTracer, place: Place, after: Place, length: float) -> list[Codim2Point]:
    """What vanishes between two points, in its order, up to the end of the curve."""
    old, new = locus.watched(place), locus.watched(after)
    found = []
    for test, value in old.items():
        if test not in new or new[test] == 0 or value * new[test] > 0:
            continue
        if test.kind in (*CORNERS, "low", "high") and new[test] > 0:
            continue  # it comes from where it could not be: a start on the point itself
        found.append(_located(locus, place, after, length, test))
    found = [met for met in found if _bifurcates(locus, met)]
    rank = {kind: i for i, kind in enumerate(RANK)}
    found.sort(key=lambda met: met.s)
    out: list[Codim2Point] = []
    while found:
        near = [met for met in found if met.s - found[0].s <= TOGETHER * length]
        found = found[len(near) :]
        first, *others = sorted(near, key=lambda met: rank.get(met.test.kind, 99))
        out.append(first._replace(others=tuple(met.test for met in others)))
        if first.test.kind in LAST:
            break
    return out


def _bifurcates(locus: AbstractBifurcationTracer, met: Codim2Point) -> bool:
    """Two real multipliers with the product 1 bifurcate only where both are 1, or -1."""
    if met.test.kind != "Neimark-Sacker":
        return True
    rho = met.spot.multipliers
    pair = np.any((np.abs(np.abs(rho) - 1) < 1e-5) & (np.abs(np.imag(rho)) > 1e-6))
    at = {"fold": 1.0, "branch": 1.0, "flip": -1.0}.get(locus.test.kind)
    double = at is not None and np.sum(np.abs(rho - at) < 1e-3) >= 2 + (locus.curve.autonomous and at == 1)
    return bool(pair or double)


def _located(locus: AbstractBifurcationTracer, place: Place, after: Place, length: float, test: Test) -> Codim2Point:
    seen: dict[float, OrbitPoint] = {0.0: place.spot, length: after.spot}

    def step(s: float) -> OrbitPoint:
        return locus.step(place, s)

    def value(spot: OrbitPoint) -> float:
        here = locus.place(spot, place.along, place.heading) if test == CUSP else dataclasses.replace(place, spot=spot)
        return locus.watched(here)[test]

    s, regular = length / 2, test != BRANCH
    try:
        if regular:
            rough = test.kind == "guard"  # the least of samples
            s = bracketed(seen, step, value, 1e-5 * length if rough else 1e-14)
            # Where the zeros of the test function cross others of its own, as at a corner at which the orbits turn
            # round with it, points of the curve are known less and less well.
            regular = locus.place(seen[s], place.along).slope > DEGENERATE * place.slope
    except FAILED:
        regular = False
    if not regular:
        near = min(seen, key=lambda t: abs(t - s))
        return _interpolated(locus, place, max(near, 0.1 * length), length, test, value)
    spot = seen[s]
    if test.kind == "guard" and isinstance(locus, BifurcationTracer):
        exact = _cut(locus, spot, test)
        if exact is not None:
            return Codim2Point(Test("grazing", test.row, test.slot), (), exact, s)
    return Codim2Point(test, (), spot, s)


def _interpolated(
    locus: AbstractBifurcationTracer,
    place: Place,
    s: float,
    length: float,
    test: Test,
    value: Callable[[OrbitPoint], float],
) -> Codim2Point:
    """A point at which the equations are singular, from points of the curve on both sides of it."""
    found = interpolated(s, 0.5 * length, lambda s: locus.step(place, s), value)
    u = found.at(lambda here: here.look.u)
    spot = seen_at(locus.curve, place.spot.itinerary, u, place.spot.look.tangent)
    # So are the multipliers there a limit, of saltation matrices that are none.
    monodromy = found.at(lambda here: here.monodromy)
    rho = np.linalg.eigvals(monodromy)
    rho = rho[np.argsort(-np.abs(rho))].astype(complex)
    return Codim2Point(test, (), dataclasses.replace(spot, monodromy=monodromy, multipliers=rho), found.s)


def _cut(locus: BifurcationTracer, spot: OrbitPoint, test: Test) -> OrbitPoint | None:
    """The point of the curve at which the least value of a guard is zero exactly: the orbit cut there."""
    start, rows = cut_itinerary(locus.curve, cleared(locus.curve, spot), [(test.row, test.slot)])
    row = rows[test.row, test.slot]
    own = locus.test
    if own.kind in (*CORNERS, "grazing") and row <= own.row:
        own = own._replace(row=own.row + 1)
    u = locus.curve.pack(start, spot.look.parameter)
    border = np.linalg.svd(np.asarray(linearised(locus.curve, start.itinerary, u)))[2][-2:]
    try:
        first, second = (dataclasses.replace(locus, test=t) for t in (own, Test("grazing", row)))
        rough = seen_at(locus.curve, start.itinerary, u, border)
        return meet(first, second, first.at(rough, np.zeros(2)))
    except FAILED:
        return None


def meet(first: BifurcationTracer, second: BifurcationTracer, spot: OrbitPoint) -> OrbitPoint:
    """Where two test functions vanish, by Newton's method on the surface."""
    for _ in range(12):
        here = np.array([first.value(spot), second.value(spot)])
        sides = [[first.at(spot, sign * DELTA * e) for sign in (1, -1)] for e in np.eye(2)]
        slopes = [[(f.value(a) - f.value(b)) / (2 * DELTA) for a, b in sides] for f in (first, second)]
        move = np.linalg.solve(np.array(slopes), -here)
        if not np.linalg.norm(move) < 0.3:
            break
        spot = first.at(spot, move)
        if np.linalg.norm(move) < 1e-10:
            return spot
    raise ArithmeticError("the curves do not meet there")
