"""Corners of branches of periodic orbits: the orbit touches the tip of a surface, grazes one, or a segment vanishes."""

import dataclasses
from typing import Any

import jax
import jax.flatten_util as jfu
import jax.numpy as jnp
import numpy as np
from scipy.optimize import toms748

from ._course import capacity_for, Course, EVENT, FREE, LEAST, same_course, Start, start_from, TIME
from ._crossings import eigenvalue_crossings
from ._cycles import corner_kind, CornerMap, Cycle, Cycles, find_cycles
from ._orbit_bifurcation import named, OrbitBifurcation
from ._orbit_curve import linearised, OrbitCurve, with_parameter
from ._orbit_node import (
    admissible,
    branch_point_at,
    cover_of,
    flip_at,
    Half,
    Node,
    set_out,
    side_of,
    together,
    told,
    tracer_for,
    with_order,
)
from ._orbit_trace import Arc, CORNERS, OrbitTracer, Spot, Test, turned, Zero
from ._return_map import Base, follow, frame, return_map, ReturnMap, Touch, touches_of
from ._system import impact


DEPARTURES = (1e-4, 1e-5, 1e-3, 1e-6, 1e-7)  # at which a half-branch is entered: of the parameter, in its interval
BACK = 40  # points from there to the corner
NEIGHBOUR = 1e-5  # at which the corner is known again
KNOWN = 1e-6  # the digits of a normal form


def node_at(tracer: OrbitTracer, name: str, zero: Zero, most: int) -> Node | None:
    """What there is at the zero of a test function; None where nothing is known to begin there."""
    if zero.test.kind == "flip":
        return flip_at(tracer, name, zero.spot)
    if zero.test.kind == "branch":
        return branch_point_at(tracer, name, zero.spot)
    if zero.test.kind in (*CORNERS, "grazing"):
        return corner_at(tracer, name, zero, most)
    return None


def corner_at(tracer: OrbitTracer, name: str, zero: Zero, most: int) -> Node | None:
    """Where the orbit touches the tip of a surface, grazes one, or a segment vanishes or appears."""
    curve = tracer.curve
    kind = zero.test.kind
    spot = zero.spot
    if kind == "guard":
        return _end(tracer, name, zero)
    # Several places may be touched at once, by symmetry, and the event happen at some of them only.
    alike = ("duration", "margin") if kind in ("duration", "margin") else (kind,)
    kinds = {t.row: t.kind for t in (*zero.others, zero.test) if t.kind in alike}
    rows = list(kinds)
    bounces = kind == "rate" and all(_is_impact(curve, spot, row) for row in rows)
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
    cycles = cycles_of(mapped, most) if mapped.corner.e.any() else _through(mapped.corner, zero.side, arrived)
    halves = [half for cycle in cycles.cycles if (half := half_of(tracer, spot, points, cycle)) is not None]
    _pair(halves)
    made = described(name, curve, spot, mapped, cycles, halves, touches, arrived)
    return Node(spot, int(curve.order), halves, made)


def _once(tracer: OrbitTracer, zero: Zero, rows: list[int], times: int) -> tuple[OrbitTracer, Zero] | None:
    """The corner of an orbit that is seen several times, seen once: the lap that ends with the first of the places."""
    curve, look, course = tracer.curve, zero.spot.look, zero.spot.course
    n, whole, last = int(course.num), float(look.period), zero.test.row
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
    short = course.take(lap_rows, capacity_for(len(lap_rows)))
    once = tracer_for(tracer, with_order(curve, int(curve.order) // times))
    u = np.asarray(once.curve.pack(Start(short, np.array(begins), np.array(ends), x), zero.spot.parameter))
    border = np.zeros_like(u)
    border[-1] = 1.0
    if zero.test.kind == "duration":  # it stays zero: the parameter may be least there
        at = (len(lap_rows) - 1) * (len(curve.sizes) + 2)
        border[[-1, at, at + 1]] = 0.0, -1.0, 1.0
    spot = once.corrected(short, u, border)
    if spot is None or not together(spot, zero.spot, curve, NEIGHBOUR):
        return None
    tests = [t._replace(row=lap_rows.index(t.row)) for t in (zero.test, *zero.others) if t.row in lap_rows]
    return once, zero._replace(spot=spot, test=tests[0], others=tuple(tests[1:]))


def _is_impact(curve: OrbitCurve, spot: Spot, row: int) -> bool:
    """Whether a segment ends with an impact: one that becomes a grazing does nothing any more."""
    slot = curve.model.slots[int(spot.course.slot[row])]
    return isinstance(curve.model.switches[slot.switch], impact) and not slot.holding


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
    rho = np.linalg.eigvals(step)
    rho = rho[np.argsort(-np.abs(rho))].astype(complex)
    none, stable = np.zeros(m), bool(np.all(np.abs(rho) < 1))
    words = ((side, arrived), (-side, tuple(1 - w for w in arrived)))
    found = tuple(Cycle(s, 1, word, s * rates, none, none, rho, stable) for s, word in words)
    return Cycles(found, (), (), 1, 2)


def _pair(halves: list[Half]) -> None:
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
    spot: Spot,
    mapped: ReturnMap,
    cycles: Cycles,
    halves: list[Half],
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
        sides = [_reduced(curve, _monodromy(mapped, word)) for word in words]
        crossings = eigenvalue_crossings(*sides, multipliers=True) if len(sides[0]) else []
    surfaces = tuple(
        dict.fromkeys(
            curve.model.switches[curve.model.slots[int(spot.course.slot[t.row])].switch].name for t in touches
        )
    )
    square = np.resize(mapped.corner.square, len(arrived))
    infinite = [bool(np.any(square & np.array(word, bool))) for word in words]
    monodromies = [_monodromy(mapped, word) for word in words]
    monodromies = [np.full_like(m, np.inf) if lost else m for m, lost in zip(monodromies, infinite)]
    alone = {h.cycle.word: h.multipliers for h in halves if h.laps == 1 and h.cycle is not None}
    values = [alone[w] if lost and w in alone else _multipliers(m) for w, m, lost in zip(words, monodromies, infinite)]
    return named(
        by_count,
        crossings if finite else None,
        name,
        spot,
        curve,
        [told(h) for h in halves],
        surfaces,
        (monodromies[0], monodromies[1]),
        (values[0], values[1]),
        "sliding" if len({_held(curve, h.spot) for h in halves if h.laps == 1}) > 1 else None,
    )


def _held(curve: OrbitCurve, spot: Spot) -> int:
    """How many segments a surface holds."""
    mode, held = (
        spot.course.mode[: int(spot.course.num)],
        {k: int(k in curve.model.contacts) for k in curve.model.holdable},
    )
    return sum(any(row[k] == value for k, value in held.items()) for row in mode)


def _multipliers(monodromy: np.ndarray) -> np.ndarray:
    if not np.isfinite(monodromy).all():
        return np.array([np.inf] + [np.nan] * (len(monodromy) - 1), complex)
    values = np.linalg.eigvals(monodromy)
    return values[np.argsort(-np.abs(values))]


def _reduced(curve: OrbitCurve, monodromy: np.ndarray) -> np.ndarray:
    """Without the direction along an autonomous orbit."""
    if not curve.autonomous:
        return monodromy
    values, vectors = np.linalg.eig(monodromy.T)
    along = np.real(vectors[:, np.argmin(np.abs(values - 1))])
    frame = np.linalg.svd(along[None])[2][1:]
    return frame @ monodromy @ frame.T


def half_of(tracer: OrbitTracer, spot: Spot, points: list[Base], cycle: Cycle) -> Half | None:
    """The orbit that a cycle of the normal form foretells, a little way off: piece by piece by the flow, which finds
    its itinerary, and then corrected."""
    own = tracer_for(tracer, with_order(tracer.curve, int(tracer.curve.order) * cycle.laps))
    for departure in DEPARTURES:
        distance = min(departure, 10 * departure / max(1e-12, float(np.abs(cycle.points).max())))
        found = _entered(own, spot, points, cycle, distance)
        if found is None or not admissible(own.curve, found):
            continue
        found = _beside(own, spot, found if float(found.look.tangent[-1]) * cycle.side >= 0 else turned(found))
        if found is not None:
            return Half(found, own.curve, cycle.laps, cycle.side, cycle)
    return None


def _entered(tracer: OrbitTracer, spot: Spot, points: list[Base], cycle: Cycle, distance: float) -> Spot | None:
    """Corrected across the way on which the foretold orbits lie: at one parameter there may be none, where the branch
    turns round next to the corner."""
    curve = tracer.curve
    near, far = (_foretold(curve, spot, points, cycle, share * distance) for share in (0.5, 1.0))
    if near is None or far is None or not same_course(near.course, far.course):
        return None
    values = [spot.parameter + cycle.side * share * distance * float(curve.width) for share in (0.5, 1.0)]
    before, guess = (np.asarray(curve.pack(s.filled(), v)) for s, v in zip((near, far), values))
    return tracer.corrected(far.filled().course, guess, (guess - before) / np.linalg.norm(guess - before))


def _beside(tracer: OrbitTracer, at: Spot, found: Spot) -> Spot | None:
    """The orbit between a corner and whatever else there is on the way to it from an orbit, whose tangent should point
    away from the corner; None if the way does not come there."""
    short = dataclasses.replace(tracer, max_points=BACK)
    for back in (turned(found), found):
        arc = Arc([back])
        for _ in short.arc(arc):
            pass
        end = arc.end
        if end is not None and end.test.kind == "guard":
            end = grazing_at(tracer, end)
        if end is None or not together(end.spot, at, tracer.curve, NEIGHBOUR):
            continue
        if not arc.passed:
            return turned(back)
        last, final = arc.spots[-2:]
        if arc.passed[-1][0] < len(arc.spots) - 2:
            return turned(last)
        way = final.look.u - last.look.u
        between = tracer.corrected(found.course, last.look.u + way / 2, way / np.linalg.norm(way))
        return None if between is None else turned(between)
    return None


def _foretold(curve: OrbitCurve, spot: Spot, points: list[Base], cycle: Cycle, distance: float) -> Start | None:
    m, period = len(points), float(spot.look.period)
    count = m * cycle.laps
    sizes = np.asarray(curve.sizes)
    value = spot.parameter + cycle.side * distance * float(curve.width)
    off = [frame(curve, spot, points[i % m]) @ cycle.points[i] for i in range(count)]
    x = np.stack([points[i % m].x + distance * sizes * off[i] for i in range(count)])
    begin = np.array([points[i % m].t for i in range(count)])
    end = np.array([points[(i + 1) % m].t + (period if (i + 1) % m == 0 else 0) for i in range(count)])
    modes = np.stack([points[i % m].mode for i in range(count)]).astype(np.int32)
    lanes = _filled(x, np.full(count, value), begin, end, modes)
    xs, values, begins, stops, held = lanes
    _, _, events, good = follow(curve, xs, values, np.asarray(spot.look.parameter), begins, stops, held)
    if not bool(np.all(np.asarray(good)[:count])):
        return None
    here, there = (with_parameter(curve.model, curve.path, jnp.asarray(v)).system for v in (spot.parameter, value))
    slow = 1.0 if curve.autonomous else float(there.period) / float(here.period)
    rows = []
    for lane in range(count):
        lap = (lane // m) * period * slow
        for e in _lane(events, lane):
            after, before = tuple(e.mode_after.values()), tuple(e.mode_before.values())
            rows.append((float(e.t) + lap, e.switch, before, after, e.y_before, e.y_after))
    total = cycle.laps * period * slow
    return start_from(there, curve.like, rows, begin[0] * slow, total, x[0], modes[0])


def _lane(events: Any, lane: int) -> Any:
    return jax.tree.map(lambda leaf: leaf[lane], jax.device_get(events))


def _filled(*columns: np.ndarray) -> list[np.ndarray]:
    """So many lanes that few programs are compiled."""
    lanes = 16 * -(-len(columns[0]) // 16)
    return [np.concatenate([c, np.repeat(c[-1:], lanes - len(c), axis=0)]) for c in columns]


def grazing_at(tracer: OrbitTracer, zero: Zero) -> Zero | None:
    """The orbit at which the least value of a guard along a segment is zero: cut there, that is a smooth equation. Its
    tests are the segments that end with the cuts."""
    spot = zero.spot
    least, where, n = spot.look.least, spot.look.where, int(spot.course.num)
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
            return zero._replace(spot=at, test=first, others=tuple(others))
        kept = [pair for pair, v in zip(both, values) if v < 1e-9 or pair == both[0]]
        if len(kept) == len(both):
            return None
        both = kept
    return None


def _cut(tracer: OrbitTracer, spot: Spot, cuts: list[tuple[int, int]]) -> tuple[Spot, list[int]] | None:
    """The orbit with cuts where these guards are least along these segments, at the parameter at which the first of
    them vanishes; and the segments that end with the cuts."""
    curve, look, n = tracer.curve, spot.look, int(spot.course.num)
    c = spot.course
    whole = c.ends[0] == TIME
    rows: list[Any] = []
    order: list[tuple[int, int]] = []
    for i in range(n):
        inside = sorted((float(look.where[i, j]), j) for r, j in cuts if r == i)
        begin, x = look.begin[i], look.x[i]
        span = look.end[i] - look.begin[i]
        for share, j in inside:
            t = look.begin[i] + share * span
            entry = _component(curve, look, c, i, j, t)
            rows.append((c.mode[i], c.part[i], LEAST, j, entry, begin, t, x))
            order.append((i, j))
            begin, x = t, look.spots[i, j]
        rows.append((c.mode[i], c.part[i], c.ends[i], c.slot[i], c.entry[i], begin, look.end[i], x))
    if whole:  # its beginning is none of its events
        last = rows.pop()
        period = float(look.period)
        first = rows[0]
        rows[0] = (*first[:5], last[5] - period, first[6], last[7])
    mode, part, ends, slot, entry, begins, stops, xs = (np.array(column) for column in zip(*rows))
    ends, slot, entry = (column.astype(np.int32) for column in (ends, slot, entry))
    course = Course(mode, part, ends, slot, entry, np.asarray(len(rows), np.int32))
    start = Start(course, begins, stops, xs).filled()
    at = tracer.corrected(start.course, np.asarray(curve.pack(start, spot.parameter)))
    if at is None:
        return None
    targets = [i for i, row in enumerate(rows) if row[2] == LEAST]
    by_cut = dict(zip(order, targets))
    found = _zero_along(tracer, at, by_cut[cuts[0]])
    return None if found is None else (found, [by_cut[pair] for pair in cuts])


def _component(curve: OrbitCurve, look: Any, course: Course, i: int, j: int, t: float) -> int:
    """Of a guard with several components that which is least there: at a tip another one takes over."""
    model = with_parameter(curve.model, curve.path, jnp.asarray(look.parameter))
    state = curve.state(jnp.asarray(course.mode[i]), jnp.asarray(course.part[i]))
    at = jnp.asarray(look.spots[i, j])
    when = jnp.asarray(t)
    values = np.asarray(curve.guards(model, when, at, state))[j]
    options = [p for p in range(len(values)) if np.isfinite(values[p])]
    if len(options) < 2:
        return options[0]
    f = jfu.ravel_pytree(model.flow(when, curve.unravel(at), state))[0]

    def motion(p: int) -> tuple[float, float]:
        rate, bend = jax.jvp(lambda t, x: curve.rate(model, t, x, state, j, p), (when, at), (jnp.ones_like(when), f))
        return float(rate), float(bend)

    motions = [motion(p) for p in options]
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


def _zero_along(tracer: OrbitTracer, at: Spot, row: int) -> Spot | None:
    """The point of the curve, next to one, at which the guard at the end of a segment vanishes."""
    seen = {0.0: at}

    def value(s: float) -> float:
        if s not in seen:
            here = tracer.at(at, s)
            if here is None:
                raise ArithmeticError
            seen[s] = here
        return float(seen[s].look.ends[row])

    if value(0.0) == 0:
        return at
    for reach in (1e-3, 1e-2, 5e-2):
        for s in (reach, -reach):
            try:
                if value(s) * value(0.0) <= 0:
                    root = float(toms748(value, *sorted((0.0, s)), xtol=1e-15, rtol=1e-14, maxiter=60))
                    value(root)
                    return seen[root]
            except ArithmeticError:
                continue
    return None


def repelled_at(tracer: OrbitTracer, name: str, spot: Spot, rows: list[int]) -> Node | None:
    """Where the orbit comes tangentially onto a surface that static friction holds: beyond, orbits slide on it where it
    repels, and may leave it at any point (section 6.7)."""
    curve, n = tracer.curve, int(spot.course.num)
    (row,) = rows[:1]
    after = (row + 1) % n
    slot = curve.model.slots[int(spot.course.slot[after])]
    if not (slot.holding and curve.model.static(slot.switch)) or spot.course.ends[after] != EVENT:
        return None
    ends = np.array(spot.course.ends)
    ends[after] = FREE
    halves = []
    for course in (spot.course, spot.course._replace(ends=ends)):
        kernel = np.linalg.svd(np.asarray(linearised(curve, course, spot.look.u)))[2][-1]
        for sign in (1, -1):
            born = set_out(tracer, course, spot.look.u, sign * kernel)
            if born is not None:
                halves.append(Half(born, curve, 1, side_of(born, spot, curve)))
                break
    if len(halves) != 2:
        return None
    halves[0].partner, halves[1].partner = halves[1], halves[0]
    switch = curve.model.switches[slot.switch].name
    made = OrbitBifurcation.repelled(name, spot, curve, [told(h) for h in halves], (switch,))
    return Node(spot, int(curve.order), halves, made)


def _end(tracer: OrbitTracer, name: str, zero: Zero) -> Node:
    """No orbit nearby beyond this point."""
    course = zero.spot.course
    row = zero.test.row
    slot = zero.test.slot if zero.test.kind == "guard" else int(course.slot[row])
    switch = tracer.curve.model.switches[tracer.curve.model.slots[slot].switch].name
    made = OrbitBifurcation.end(name, zero.spot, tracer.curve, (switch,))
    return Node(zero.spot, int(tracer.curve.order), [], made)
