"""Corners of branches of periodic orbits: the orbit touches the tip of a surface, grazes one, or a segment vanishes."""

import dataclasses

import numpy as np

from ....maps._corner_normal_form import corner_kind, CornerMap, Cycle, Cycles, find_cycles
from ....orbits._settle import repeats_held
from ....orbits.segments._equations import linearised, OrbitCurve
from ....orbits.segments._itinerary import capacity_for, EVENT, GRAZING, REPELLING_EXIT, Start
from ....setvalued._eigenvalue_crossings import eigenvalue_crossings
from ..._tracer import Zero
from .._bifurcation import OrbitBifurcation, Origin
from .._branch_switching import (
    branch_point_at,
    cover_of,
    Departure,
    flip_at,
    half_branch_of,
    Node,
    set_out,
    side_of,
    together,
    tracer_for,
    with_order,
)
from .._test_functions import CORNERS
from .._tracer import midpoint, OrbitPoint, OrbitTracer
from ._enter_half_branch import half_of, NEIGHBOUR
from ._return_map import MAX_EVENTS, return_map, ReturnMap, Touch, touches_of


KNOWN = 1e-6  # the digits of a normal form
BEYOND = 1e-4  # of the interval, behind the end of a branch: there it is seen what its orbits go over into


def node_at(tracer: OrbitTracer, name: str, zero: Zero, most: int) -> Node | None:
    """What there is at the zero of a test function; None where nothing is known to begin there."""
    if zero.test.kind == "flip":
        return flip_at(tracer, name, zero.point)
    if zero.test.kind == "branch":
        return branch_point_at(tracer, name, zero.point)
    if zero.test.kind in (*CORNERS, "grazing"):
        node = corner_at(tracer, name, zero, most)
        if node is not None:
            node.bifurcation = dataclasses.replace(node.bifurcation, origin=Origin(zero.test, zero.point, tracer.curve))
        return node
    return None


def corner_at(tracer: OrbitTracer, name: str, zero: Zero, most: int) -> Node | None:
    """Where the orbit touches the tip of a surface, grazes one, or a segment vanishes or appears."""
    curve = tracer.curve
    kind = zero.test.kind
    spot = zero.point
    shrinks = float(spot.look.period) < KNOWN * float(curve.time)  # to a point
    if kind == "guard" or shrinks:
        return _end(tracer, name, zero)
    # Several places may be touched at once, by symmetry, and the event happen at some of them only.
    alike = ("duration", "margin") if kind in ("duration", "margin") else (kind,)
    kinds = {t.row: t.kind for t in (*zero.others, zero.test) if t.kind in alike}
    # Where a segment vanishes, the one before it ends at the same place.
    vanished = [row for row, what in kinds.items() if what == "duration"]
    kinds = {r: k for r, k in kinds.items() if k == "duration" or (r + 1) % int(spot.itinerary.num) not in vanished}
    rows = list(kinds)
    bounces = kind == "rate" and all(is_impact(curve, spot, row) for row in rows)
    if kind == "rate" and not bounces:
        node = repelled_at(tracer, name, spot, rows)
        return node or _end(tracer, name, zero)
    touches = touches_of(spot, rows)
    times = cover_of(spot, curve, KNOWN)
    if times > 1:
        once = _once(tracer, zero, rows, times)
        return None if once is None else corner_at(once[0], name, once[1], times * most)
    found_map = return_map(curve, spot, touches)
    if found_map is None or found_map[0].jumps:
        return _end(tracer, name, zero)
    mapped, points = found_map
    arrived = tuple(int(kinds[t.row] == "duration" or bounces) for t in touches)
    has_effect = mapped.corner.e.any()
    if not has_effect and held_beyond(curve, zero.point, zero.side):
        return _end(tracer, name, zero)
    cycles = cycles_of(mapped, most) if has_effect else _through(mapped.corner, zero.side, arrived)
    halves = [
        half for cycle in cycles.cycles if (half := half_of(tracer, spot, mapped.corner, points, cycle)) is not None
    ]
    _pair(halves)
    made = described(name, curve, spot, mapped, cycles, halves, touches=touches, arrived=arrived)
    return Node(spot, int(curve.order), halves, made)


def _once(tracer: OrbitTracer, zero: Zero, rows: list[int], times: int) -> tuple[OrbitTracer, Zero] | None:
    """The corner of an orbit that is seen several times, seen once: the lap that ends with the first of the places."""
    curve, look, itinerary = tracer.curve, zero.point.look, zero.point.itinerary
    n, whole, last = int(itinerary.num), float(look.period), zero.test.row
    lap, slack = whole / times, KNOWN * whole
    t = look.end[last] - lap
    lap_rows, begins, ends = [], [], []
    for back in range(n):
        i = (last - back) % n
        shift = whole if i > last else 0.0
        lap_rows.insert(0, i)
        begins.insert(0, max(t, look.begin[i] - shift))
        ends.insert(0, look.end[i] - shift)
        if begins[0] < t + slack:
            break
    begins[0] = t
    x = look.x[lap_rows].copy()
    x[0] = look.x[(last + 1) % n]  # what ends here begins anew
    short = itinerary.take(lap_rows, capacity_for(len(lap_rows)))
    once = tracer_for(tracer, with_order(curve, int(curve.order) // times))
    u = once.curve.pack(Start(short, np.array(begins), np.array(ends), x), zero.point.parameter)
    border = np.zeros_like(u)
    border[-1] = 1.0
    if (
        zero.test.kind == "duration" and short.ends[len(lap_rows) - 1] != GRAZING
    ):  # it stays zero: the parameter may be least there
        at = (len(lap_rows) - 1) * (len(curve.sizes) + 2)
        border[[-1, at, at + 1]] = 0.0, -1.0, 1.0
    spot = once.orbit_near(short, u, border)
    if spot is None or not together(spot, zero.point, curve, NEIGHBOUR):
        return None
    tests = [t._replace(row=lap_rows.index(t.row)) for t in (zero.test, *zero.others) if t.row in lap_rows]
    return once, zero._replace(point=spot, test=tests[0], others=tuple(tests[1:]))


def is_impact(curve: OrbitCurve, spot: OrbitPoint, row: int) -> bool:
    """Whether a segment ends with an impact: one that becomes a grazing does nothing any more."""
    slot = curve.model.slots[int(spot.itinerary.slot[row])]
    return curve.model.switches[slot.switch].unilateral and not slot.holding


def cycles_of(mapped: ReturnMap, most: int) -> Cycles:
    m, n = mapped.corner.b.shape
    if m % 2 == 0:
        try:
            return find_cycles(mapped.corner, most, symmetry=-np.eye(n), rtol=KNOWN)
        except ValueError:  # it has none
            pass
    return find_cycles(mapped.corner, most, rtol=KNOWN)


def _through(corner: CornerMap, side: int, arrived: tuple[int, ...]) -> Cycles:
    """Where the event has no effect to leading order there is one orbit on each side; on which the event happens is
    seen from the branch that came."""
    m, n = corner.b.shape
    step, shift, before = np.eye(n), np.zeros(n), []
    for p in range(m):
        before.append((step, shift))
        step, shift = corner.a[p] @ step, corner.a[p] @ shift + corner.b[p]
    x = np.linalg.solve(np.eye(n) - step, shift)
    rates = np.stack([a @ x + b for a, b in before])
    rho = _multipliers(step).astype(complex)
    none, stable = np.zeros(m), bool(np.all(np.abs(rho) < 1))
    words = ((side, arrived), (-side, tuple(1 - w for w in arrived)))
    found = tuple(Cycle(s, 1, word, s * rates, none, none, rho, stable) for s, word in words)
    return Cycles(found, (), (), 1, 2)


def _pair(halves: list[Departure]) -> None:
    """The branch itself goes on: of the orbits of one lap the two, or those that are symmetric."""
    single = [h for h in halves if h.laps == 1]
    if len(single) != 2:
        single = [h for h in single if h.cycle is not None and _symmetric(h.cycle)]
    if len(single) == 2:
        single[0].partner, single[1].partner = single[1], single[0]
    images = [h for h in halves if h.laps == 1 and h.partner is None]
    if len(images) == 2:
        images[0].partner, images[1].partner = images[1], images[0]


def _symmetric(cycle: Cycle) -> bool:
    m = len(cycle.word) // cycle.laps
    return m % 2 == 0 and cycle.image is not None and len(set(cycle.word)) == 1


def _monodromy(mapped: ReturnMap, word: tuple[int, ...]) -> np.ndarray:
    out = np.eye(mapped.monodromies.shape[-1])
    for i, w in enumerate(word):
        out = mapped.monodromies[i % len(mapped.monodromies), w] @ out
    return out


def described(
    name: str,
    curve: OrbitCurve,
    spot: OrbitPoint,
    mapped: ReturnMap,
    cycles: Cycles,
    halves: list[Departure],
    *,
    touches: list[Touch],
    arrived: tuple[int, ...],
) -> OrbitBifurcation:
    by_count = corner_kind(cycles)
    finite = not mapped.corner.square.any()
    here = next((h for h in halves if h.laps == 1 and h.cycle is not None and h.cycle.word == arrived), None)
    if here is not None and here.cycle is not None and here.cycle.image is not None and not _symmetric(here.cycle):
        # One that broke the symmetry goes on into its image; the multipliers that tell are those of the symmetric ones.
        here = next((h for h in halves if h.laps == 1 and h.cycle is not None and _symmetric(h.cycle)), here)
        arrived = here.cycle.word if here.cycle is not None else arrived
    other = None if here is None else here.partner
    words = (arrived, tuple(1 - w for w in arrived) if other is None or other.cycle is None else other.cycle.word)
    crossings = []
    if finite:
        sides = [_monodromy(mapped, word) for word in words]
        sides = transverse(*sides) if curve.autonomous else sides
        crossings = eigenvalue_crossings(*sides, multipliers=True) if len(sides[0]) else []
    surfaces = tuple(
        dict.fromkeys(
            curve.model.switches[curve.model.slots[int(spot.itinerary.slot[t.row])].switch].name for t in touches
        )
    )
    square = np.resize(mapped.corner.square, len(arrived))
    infinite = [bool(np.any(square & np.array(word, bool))) for word in words]
    monodromies = [_monodromy(mapped, word) for word in words]
    monodromies = [np.full_like(m, np.inf) if lost else m for m, lost in zip(monodromies, infinite)]
    alone = {h.cycle.word: h.multipliers for h in halves if h.laps == 1 and h.cycle is not None}
    values = [alone[w] if lost and w in alone else _multipliers(m) for w, m, lost in zip(words, monodromies, infinite)]
    return OrbitBifurcation.corner(
        name,
        spot,
        curve,
        [half_branch_of(h) for h in halves],
        by_count,
        crossings if finite else None,
        surfaces=surfaces,
        monodromies=(monodromies[0], monodromies[1]),
        multipliers=(values[0], values[1]),
        transition="sliding" if len({_held(curve, h.spot) for h in halves if h.laps == 1}) > 1 else None,
    )


def _held(curve: OrbitCurve, spot: OrbitPoint) -> int:
    """How many segments a surface holds."""
    return sum(curve.model.holds(spot.itinerary.mode[i]) for i in spot.itinerary.rows)


def _multipliers(monodromy: np.ndarray) -> np.ndarray:
    if not np.isfinite(monodromy).all():
        return np.array([np.inf] + [np.nan] * (len(monodromy) - 1), complex)
    values = np.linalg.eigvals(monodromy)
    return values[np.argsort(-np.abs(values))]


def transverse(*monodromies: np.ndarray) -> list[np.ndarray]:
    """Without the direction along an autonomous orbit, an eigenvector of all of them with the eigenvalue 1: what they
    do to the other directions, in one frame, so that there are matrices between them."""
    eye = np.eye(len(monodromies[0]))
    frame = np.linalg.svd(np.concatenate([m - eye for m in monodromies]))[2][:-1]
    return [frame @ m @ frame.T for m in monodromies]


def repelled_at(tracer: OrbitTracer, name: str, spot: OrbitPoint, rows: list[int]) -> Node | None:
    """Where the orbit comes tangentially onto a surface that static friction holds: beyond, orbits slide on it where it
    repels, and may leave it at any point (section 6.7)."""
    curve, n = tracer.curve, int(spot.itinerary.num)
    (row,) = rows[:1]
    after = (row + 1) % n
    slot = curve.model.slots[int(spot.itinerary.slot[after])]
    if not (slot.holding and curve.model.static(slot.switch)) or spot.itinerary.ends[after] != EVENT:
        return None
    ends = np.array(spot.itinerary.ends)
    ends[after] = REPELLING_EXIT
    halves = []
    for itinerary in (spot.itinerary, spot.itinerary._replace(ends=ends)):
        kernel = np.linalg.svd(linearised(curve, itinerary, spot.look.u))[2][-1]
        for sign in (1, -1):
            born = set_out(tracer, itinerary, spot.look.u, sign * kernel)
            if born is not None:
                halves.append(Departure(born, curve, 1, side_of(born, spot, curve)))
                break
    if len(halves) != 2:
        return None
    halves[0].partner, halves[1].partner = halves[1], halves[0]
    switch = curve.model.switches[slot.switch].name
    made = OrbitBifurcation.repelled(name, spot, curve, [half_branch_of(h) for h in halves], (switch,))
    return Node(spot, int(curve.order), halves, made)


def held_beyond(curve: OrbitCurve, spot: OrbitPoint, side: int) -> bool:
    """Whether beyond an orbit, of a branch that lies on this side of it, friction holds a forced system for ever."""
    held = [i for i in spot.itinerary.rows if curve.model.holds(spot.itinerary.mode[i])]
    if curve.autonomous or not held:
        return False
    t, x, _ = midpoint(curve, spot, held)
    value = np.asarray(spot.parameter - side * BEYOND * float(curve.width))
    system = curve.model_at(value).system
    period = np.asarray(float(system.period) * int(curve.order))
    y, integrator = curve.unravel(x), curve.integrator._replace(max_events=MAX_EVENTS)
    return repeats_held(system, np.asarray(t), y, period, None, integrator)


def _end(tracer: OrbitTracer, name: str, zero: Zero) -> Node:
    """No orbit nearby beyond this point, or a continuum of them."""
    itinerary = zero.point.itinerary
    row = zero.test.row
    slot = zero.test.slot if zero.test.kind == "guard" else int(itinerary.slot[row])
    switch = tracer.curve.model.switches[tracer.curve.model.slots[slot].switch].name
    kind = "continuum" if held_beyond(tracer.curve, zero.point, zero.side) else "end"
    made = OrbitBifurcation.end(name, zero.point, tracer.curve, (switch,), zero.side, kind)
    return Node(zero.point, int(tracer.curve.order), [], made)
