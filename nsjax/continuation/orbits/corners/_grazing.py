"""Where an orbit of a branch grazes a surface: a cut where the guard is least makes that a smooth equation."""

from typing import Any

import numpy as np

from ...._numerics._bracket import bracketed
from ....orbits.segments._equations import guards_along, OrbitCurve
from ....orbits.segments._itinerary import capacity_for, EVENT, GRAZING, OrbitItinerary, Start, TIME
from ..._tracer import Zero
from .._test_functions import Test
from .._tracer import alike, OrbitPoint, OrbitTracer


TANGENTIAL = 0.1  # the rate of a guard, in units of the curve, below which a segment that vanishes may be a grazing
FOUND = 3e-3  # how far from a point where the equations are singular the orbit that grazes is


def exactly(tracer: OrbitTracer, zero: Zero) -> Zero | None:
    """A corner by equations that are smooth and regular there; None if its grazing is not found."""
    if zero.test.kind == "guard":
        return landing_at(tracer, zero) or grazing_at(tracer, zero)
    return (touching_at(tracer, zero) or zero) if zero.test.kind in ("duration", "rate") else zero


def landing_at(tracer: OrbitTracer, zero: Zero) -> Zero | None:
    """Where a surface can only just hold what comes onto it: a corner at the event, like that of orbits that cross it
    there and can only just do so. None if the guard vanishes elsewhere."""
    look, itinerary, slots = zero.point.look, zero.point.itinerary, tracer.curve.model.slots
    i, n = zero.test.row, int(itinerary.num)
    before, after = slots[int(itinerary.slot[i - 1 if i else n - 1])], slots[zero.test.slot]
    comes = n > 1 and itinerary.ends[i - 1 if i else n - 1] == EVENT and not before.holding
    if look.where[zero.test.row, zero.test.slot] > 0 or not (comes and after.holding and before.switch == after.switch):
        return None
    return zero._replace(test=Test("margin", i - 1 if i else n - 1), others=())


def touching_at(tracer: OrbitTracer, zero: Zero) -> Zero | None:
    """Where segments beyond a surface vanish because orbits only graze it: both ends come to it tangentially, and the
    equations are singular. Those without these segments, but with cuts, are not. None if it is nothing like that."""
    curve, look, c, n = tracer.curve, zero.point.look, zero.point.itinerary, int(zero.point.itinerary.num)
    slots, length = curve.model.slots, np.asarray(look.end) - np.asarray(look.begin)
    size = np.asarray(curve.guard_sizes)[np.asarray(c.slot)] / float(curve.time) if slots else 1.0
    slow = np.abs(look.rates) < TANGENTIAL * size

    def vanishes(i: int) -> bool:
        h, j = (i - 1) % n, (i + 1) % n
        before, after = slots[int(c.slot[h])], slots[int(c.slot[i])]
        plain = not before.holding and not curve.model.switches[before.switch].unilateral
        crossed = c.ends[h] == c.ends[i] == EVENT and before.switch == after.switch
        return bool(plain and crossed and slow[h] and slow[i] and np.all(c.mode[h] == c.mode[j]))

    gone = set()
    for kind, i, _ in (zero.test, *zero.others):
        if kind in ("margin", "rate", "duration") and n > 1:
            around = [i] if kind != "rate" else [i, (i + 1) % n]
            short = [j for j in around if length[j] < TANGENTIAL * float(curve.time) and vanishes(j)]
            if not short:
                return None
            gone.add(min(short, key=lambda j: length[j]))
    before = [(i - 1) % n for i in sorted(gone)]
    if not gone or gone & set(before):
        return None
    kept = [i for i in range(n) if i not in gone]
    targets = [kept.index(i) for i in before]
    itinerary = c.take(kept, capacity_for(len(kept)))
    ends = np.array(itinerary.ends)
    ends[targets] = GRAZING
    start = Start(itinerary._replace(ends=ends), look.begin[kept], look.end[kept], look.x[kept])
    at = tracer.orbit_near(start.itinerary, curve.pack(start, zero.point.parameter))
    found = None if at is None else _zero_along(tracer, at, targets[0])
    if found is None or abs(found.parameter - zero.point.parameter) > FOUND * float(curve.width):
        return None
    if not alike(found, zero.point, curve, FOUND) or np.any(np.abs(found.look.ends[targets]) > 1e-9):
        return None
    first, *others = (Test("duration", row) for row in targets)
    return zero._replace(point=found, test=first, others=tuple(others))


def grazing_at(tracer: OrbitTracer, zero: Zero) -> Zero | None:
    """The orbit at which the least value of a guard along a segment is zero: cut there, that is a smooth equation. Its
    tests are the segments that end with the cuts."""
    spot = zero.point
    least, where, n = spot.look.least, spot.look.where, int(spot.itinerary.num)
    # Least values are those of samples; what turns out not to vanish is left out again.
    near = np.maximum(0.05 * spot.look.most, 10 * abs(least[zero.test.row, zero.test.slot]))
    both = [(i, j) for i, j in np.argwhere(least < near).tolist() if i < n and 0.002 < where[i, j] < 0.998]
    both = sorted(both, key=lambda pair: pair != (zero.test.row, zero.test.slot))
    both = both or [(zero.test.row, zero.test.slot)]
    while both:
        cut = _cut(tracer, spot, both)
        if cut is None:
            return None
        at, rows = cut
        values = np.abs(np.array([at.look.ends[r] for r in rows]))
        if np.all(values < 1e-9):
            first, *others = (Test("grazing", row) for row in rows)
            return zero._replace(point=at, test=first, others=tuple(others))
        kept = [pair for pair, v in zip(both, values) if v < 1e-9 or pair == both[0]]
        if len(kept) == len(both):
            return None
        both = kept
    return None


def _cut(tracer: OrbitTracer, spot: OrbitPoint, cuts: list[tuple[int, int]]) -> tuple[OrbitPoint, list[int]] | None:
    """The orbit with cuts where these guards are least along these segments, at the parameter at which the first of
    them vanishes; and the segments that end with the cuts."""
    start, by_cut = cut_itinerary(tracer.curve, spot, cuts)
    at = tracer.orbit_near(start.itinerary, tracer.curve.pack(start, spot.parameter))
    if at is None:
        return None
    found = _zero_along(tracer, at, by_cut[cuts[0]])
    return None if found is None else (found, [by_cut[pair] for pair in cuts])


def cut_itinerary(
    curve: OrbitCurve, spot: OrbitPoint, cuts: list[tuple[int, int]]
) -> tuple[Start, dict[tuple[int, int], int]]:
    """An orbit cut where these guards are least along these segments; and which segment ends with which cut."""
    look, n = spot.look, int(spot.itinerary.num)
    c = spot.itinerary
    whole = c.ends[0] == TIME
    rows: list[Any] = []
    order: dict[tuple[int, int], int] = {}
    for i in range(n):
        inside = sorted((float(look.where[i, j]), j) for r, j in cuts if r == i)
        begin, x = look.begin[i], look.x[i]
        span = look.end[i] - look.begin[i]
        for share, j in inside:
            t = look.begin[i] + share * span
            entry = _component(curve, look, c, i, j, t)
            rows.append((c.mode[i], c.part[i], GRAZING, j, entry, begin, t, x))
            order[i, j] = len(rows) - 1
            begin, x = t, look.spots[i, j]
        rows.append((c.mode[i], c.part[i], c.ends[i], c.slot[i], c.entry[i], begin, look.end[i], x))
    if whole:  # it does not begin at one of its events
        last = rows.pop()
        period = float(look.period)
        first = rows[0]
        rows[0] = (*first[:5], last[5] - period, first[6], last[7])
    mode, part, ends, slot, entry, begins, stops, xs = (np.array(column) for column in zip(*rows))
    ends, slot, entry = (column.astype(np.int32) for column in (ends, slot, entry))
    itinerary = OrbitItinerary(mode, part, ends, slot, entry, np.asarray(len(rows), np.int32))
    start = Start(itinerary, begins, stops, xs).filled()
    return start, order


def _component(curve: OrbitCurve, look: Any, itinerary: OrbitItinerary, i: int, j: int, t: float) -> int:
    """Of a guard with several components that which is least there: at a tip another one takes over."""
    at = look.parameter, np.asarray(t), look.spots[i, j], itinerary.mode[i], itinerary.part[i]
    values, rates, bends = (np.asarray(rows)[j] for rows in guards_along(curve, *at))
    options = [p for p in range(len(values)) if np.isfinite(values[p])]
    if len(options) < 2:
        return options[0]
    motions = [(float(rates[p]), float(bends[p])) for p in options]
    best, least = options[0], np.inf
    for p, (rate, bend) in zip(options, motions):
        # Where it is least itself, is it the one that counts?
        move = -rate / bend if bend > 0 else np.inf
        if not abs(move) < least:
            continue
        there = [values[q] + r * move + b * move**2 / 2 for q, (r, b) in zip(options, motions)]
        if there[options.index(p)] >= max(there) - 1e-3 * abs(bend) * move**2 - 1e-3:
            best, least = p, abs(move)
    return best


def _zero_along(tracer: OrbitTracer, at: OrbitPoint, row: int) -> OrbitPoint | None:
    """The point of the curve, next to one, at which the guard at the end of a segment vanishes."""

    def value(spot: OrbitPoint) -> float:
        return float(spot.look.ends[row])

    if value(at) == 0:
        return at
    for reach in (1e-3, 1e-2, 5e-2):
        for s in (reach, -reach):
            far = tracer.at(at, s)
            if far is None or value(far) * value(at) > 0:
                continue
            seen = {0.0: at, s: far}
            try:
                return seen[bracketed(seen, lambda s: tracer.at(at, s), value)]
            except ArithmeticError:
                continue
    return None
