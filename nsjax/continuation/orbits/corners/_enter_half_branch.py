"""The half-branches that the normal form of a corner foretells, entered next to it."""

import dataclasses
import functools
import itertools

import jax
import jax.numpy as jnp
import numpy as np

from ....maps._corner_normal_form import CornerMap, Cycle
from ....orbits.segments._equations import OrbitCurve
from ....orbits.segments._itinerary import EventRecord, same_itinerary, Start, starts_from, ticks
from ..._tracer import Trace
from .._branch_switching import admissible, Departure, together, tracer_for, with_order
from .._tracer import OrbitPoint, OrbitTracer
from ._grazing import exactly
from ._return_map import Base, follow, frame


DEPARTURES = (1e-4, 1e-5, 1e-3, 1e-6, 1e-7)  # at which a half-branch is entered: of the parameter, in its interval
PUSHES = (0.0, 1.0, 10.0)  # towards the side of the border where a cycle is, over the square of the distance
BACK = 40  # points from there to the corner
NEIGHBOUR = 1e-5  # at which the corner is known again


def half_of(
    tracer: OrbitTracer, spot: OrbitPoint, corner: CornerMap, points: list[Base], cycle: Cycle
) -> Departure | None:
    """The orbit that a cycle of the normal form foretells, a little way off: piece by piece by the flow, which finds
    its itinerary, and then corrected."""
    own = tracer_for(tracer, with_order(tracer.curve, int(tracer.curve.order) * cycle.laps))
    for departure, push in itertools.product(DEPARTURES, PUSHES if corner.square.any() else PUSHES[:1]):
        distance = min(departure, 10 * departure / max(1e-12, float(np.abs(cycle.points).max())))
        away = _pushed(corner, cycle, push * distance)
        found = _entered(own, spot, points, cycle._replace(points=cycle.points + away), distance)
        if found is None or not admissible(own.curve, found):
            continue
        found = _beside(own, spot, found if float(found.look.tangent[-1]) * cycle.side >= 0 else found.turned)
        if found is not None:
            return Departure(found, own.curve, cycle.laps, cycle.side, cycle)
    return None


def _pushed(corner: CornerMap, cycle: Cycle, size: float) -> np.ndarray:
    """A shift of the points by which an event with a square root happens, or does not: where it is taken the distance
    from the border is of second order, and so is what the normal form leaves out."""
    places = np.arange(len(cycle.word)) % len(corner.c)
    toward = np.where(np.array(cycle.word) == 1, -1.0, 1.0) * corner.square[places]
    return size * toward[:, None] * corner.n[places] * np.max(np.abs(cycle.points)) ** 2


def _entered(
    tracer: OrbitTracer, spot: OrbitPoint, points: list[Base], cycle: Cycle, distance: float
) -> OrbitPoint | None:
    """Corrected across the way on which the foretold orbits lie: at one parameter there may be none, where the branch
    turns round next to the corner."""
    curve = tracer.curve
    near, far = (_predicted(curve, spot, points, cycle, share * distance) for share in (0.5, 1.0))
    if near is None or far is None or not same_itinerary(near.itinerary, far.itinerary):
        return None
    values = [spot.parameter + cycle.side * share * distance * float(curve.width) for share in (0.5, 1.0)]
    before, guess = (curve.pack(s.filled(), v) for s, v in zip((near, far), values))
    return tracer.orbit_near(far.filled().itinerary, guess, (guess - before) / np.linalg.norm(guess - before))


def _beside(tracer: OrbitTracer, at: OrbitPoint, found: OrbitPoint) -> OrbitPoint | None:
    """The orbit between a corner and whatever else there is on the way to it from an orbit, whose tangent should point
    away from the corner; None if the way does not come there."""
    short = dataclasses.replace(tracer, max_points=BACK)
    for back in (found.turned, found):
        trace, passed = Trace((back,)), []  # at which points something else is
        while not trace.over:
            trace = short.further(trace)
            if trace.passed:
                passed.append(len(trace.points) - 1)
        end = None if trace.end is None else exactly(tracer, trace.end)
        if end is None or not together(end.point, at, tracer.curve, NEIGHBOUR):
            continue
        if not passed:
            return back.turned
        last, final = trace.points[-2:]
        if passed[-1] < len(trace.points) - 2:
            return last.turned
        way = final.look.u - last.look.u
        between = tracer.orbit_near(found.itinerary, last.look.u + way / 2, way / np.linalg.norm(way))
        return None if between is None else between.turned
    return None


def _predicted(curve: OrbitCurve, spot: OrbitPoint, points: list[Base], cycle: Cycle, distance: float) -> Start | None:
    m, period = len(points), float(spot.look.period)
    count = m * cycle.laps
    sizes = np.asarray(curve.sizes)
    value = spot.parameter + cycle.side * distance * float(curve.width)
    off = [frame(curve, spot, points[i % m]) @ cycle.points[i] for i in range(count)]
    x = np.stack([points[i % m].x + distance * sizes * off[i] for i in range(count)])
    begin = np.array([points[i % m].t for i in range(count)])
    end = np.array([points[(i + 1) % m].t + (period if (i + 1) % m == 0 else 0) for i in range(count)])
    modes = np.stack([points[i % m].mode for i in range(count)]).astype(np.int32)
    _, _, events, good = follow(curve, x, np.full(count, value), spot.look.parameter, begin, end, modes)
    if not np.all(good):
        return None
    here, there = (curve.model_at(jnp.asarray(v)).system for v in (spot.parameter, value))
    slow = 1.0 if curve.autonomous else float(there.period) / float(here.period)
    diaries, gone_on = [], ticks(curve.model, spot.itinerary)
    for lane in range(count):
        diary = EventRecord.of(jax.tree.map(lambda leaf: leaf[lane], events))
        before, after = (modes + (lane // m) * gone_on for modes in diary.modes)
        diaries.append(diary._replace(t=diary.t + (lane // m) * period * slow, modes=(before, after)))
    at = begin[0] * slow, cycle.laps * period * slow, modes[0], x[0]
    diary = functools.reduce(EventRecord.joined, diaries)
    if curve.autonomous and len(diary.t):  # time counts from the first event, as on the curve
        diary = diary._replace(t=diary.t - diary.t[0])
    return starts_from(curve.model, curve.like, [there], [diary], [at])[0]
