"""The return map at a corner of a branch of periodic orbits: its derivatives on both sides, as limits.

Beside the corner the orbit is followed, with derivatives, from states and parameters on a ray through it. What is
found there is a smooth function of the square root of the distance, and so its limit is known to many digits, where
no finite distance would do.
"""

from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from ...._numerics._compile import interactive, on_host
from ....derivatives._flow_map import Directions, flow_map, with_room
from ....flow._results import is_okay
from ....flow._solution import Events
from ....maps._corner_normal_form import CornerMap
from ....orbits._guess import of_relays
from ....orbits.segments._equations import field_at, OrbitCurve
from ....system._parameter import put_parameter
from .._tracer import midpoint


LEVELS = 8  # distances from the corner
REACHES = (0.1, 0.05, 0.02, 0.008)  # roots of the largest of them, in units of the curve
NEAREST = 0.05  # the smallest of them over the largest: beside a tangency rounding is divided by little
SAME = 1e-7  # relative: what jumps by less does not
MAX_EVENTS = 64  # as `find_orbit` has by default, whose program is used again


class Touch(NamedTuple):
    """A place where the orbit at the corner touches a surface: when, and the segment that ends there."""

    t: float
    row: int


class Base(NamedTuple):
    """A point of the orbit between two such places, away from events, where a piece of the map begins."""

    t: float
    x: np.ndarray
    mode: np.ndarray


class ReturnMap(NamedTuple):
    """The map of a lap, piece by piece.

    - `corner`: its normal form, in units of the curve; without the direction of the flow if it is autonomous.
    - `monodromies`: of each piece without and with the event, shape (m, 2, n, n), in units of the state.
    - `jumps`: whether the state itself jumps from one side to the other: nothing is continued then.
    """

    corner: CornerMap
    monodromies: np.ndarray
    jumps: bool


def follow(curve: OrbitCurve, xs: Any, values: Any, reference: Any, begin: Any, end: Any, modes: Any) -> tuple:
    """Pieces of laps: the states at their ends, the derivatives of these by state and parameter, the events, and
    whether all went well. Times are those of the phases of the forcing for the value `reference` of the parameter."""
    model, integrator = curve.model, with_room(curve.integrator._replace(max_events=MAX_EVENTS), np.float64)
    directions = Directions.of_state(model.system, np.zeros(()), curve.like)
    last = np.eye(len(curve.sizes) + 1)[-1]  # the parameter
    directions = directions._replace(system=put_parameter(directions.system, curve.free.paths[0], last))
    rows = []
    for x, value, a, b, mode in zip(xs, values, begin, end, modes):
        slow, slower = (1.0, 0.0) if curve.autonomous else on_host(_slowed(curve, value, np.asarray(reference)))
        way = directions._replace(t0=a * slower * last, t1=b * slower * last)
        given = (
            {k.name: m for k, m in zip(model.switches, mode)} if model.holds(mode) else of_relays(model.system, mode)
        )
        system = curve.model_at(np.asarray(value)).system
        times = np.asarray(a * slow), np.asarray(b * slow)
        sol, tangents = flow_map(system, *times, curve.unravel(x), given, integrator, way)
        y1 = np.concatenate([np.ravel(leaf) for leaf in jax.tree.leaves(sol.y1)])
        rows.append((y1, tangents.T, sol.events, is_okay(sol.result)))
    return jax.tree.map(lambda *leaves: np.stack(leaves), *on_host(rows))


@interactive
def _slowed(curve: OrbitCurve, value: Any, reference: Any) -> tuple[jax.Array, jax.Array]:
    """The period of the forcing over that at the value `reference` of the parameter, and its derivative."""

    def period(value: jax.Array) -> jax.Array:
        return jnp.asarray(curve.model_at(value).system.period, curve.sizes.dtype)

    now, change = jax.jvp(period, (value,), (jnp.ones_like(value),))
    return now / period(reference), change / period(reference)


def bases(curve: OrbitCurve, spot: Any, touches: list[Touch]) -> list[Base]:
    """One before each place, in the middle of the longest segment there that no surface holds."""
    n, m, period = int(spot.itinerary.num), len(touches), float(spot.look.period)
    out = []
    for p, touch in enumerate(touches):
        before = touches[p - 1].row if m > 1 else touch.row
        rows, i = [], (before + 1) % n
        while True:
            rows.append(i)
            if i == touch.row:
                break
            i = (i + 1) % n
        t, x, mode = midpoint(curve, spot, rows)
        # Before the place, in the same lap as the places are counted.
        while t > touch.t:
            t -= period
        while t < touch.t - period:
            t += period
        out.append(Base(t, x, mode))
    return out


def return_map(curve: OrbitCurve, spot: Any, touches: list[Touch]) -> tuple[ReturnMap, list[Base]] | None:
    """The normal form at a corner, or None if no direction is found in which the itinerary changes there."""
    points = bases(curve, spot, touches)
    pieces = []
    for p in range(len(points)):
        piece = _piece(curve, spot, points, p)
        if piece is None:
            return None
        pieces.append(piece)
    frames = [frame(curve, spot, base) for base in points]
    a, b, e, n, c, square, jumps, both = [], [], [], [], [], [], False, []
    for p, (minus, plus, root, side, jump) in enumerate(pieces):
        left, right = frames[(p + 1) % len(frames)].T, frames[p]
        wide = np.block([[right, np.zeros((len(right), 1))], [np.zeros((1, right.shape[1])), np.ones((1, 1))]])
        low = left @ minus @ wide
        if root is None:
            rise = left @ plus @ wide - low
        else:
            rise = left @ root @ wide
        u, s, vt = np.linalg.svd(rise)
        normal, effect = vt[0], u[:, 0] * s[0]
        if s[0] <= SAME * max(1.0, np.abs(low).max()):
            normal, effect = np.zeros(len(vt[0])), np.zeros(len(low))
        toward = float(normal @ (wide.T @ side))
        if toward > 0:  # with the event g < 0
            normal, effect = -normal, -effect
        if root is not None:  # d √(-g) / dg = -1 / (2 √(-g)), and √(-g) is the root of the distance times this
            effect = -effect * 2 * np.sqrt(abs(toward))
        a.append(low[:, :-1])
        b.append(low[:, -1])
        e.append(effect)
        n.append(normal[:-1])
        c.append(normal[-1])
        square.append(root is not None)
        jumps = jumps or jump
        sizes = np.asarray(curve.sizes)
        both.append([(m[:, :-1] * sizes[:, None]) / sizes[None, :] for m in (minus, plus)])
    corner = CornerMap(*map(np.array, (a, b, e, n, c, square)))
    return ReturnMap(corner, np.array(both), jumps), points


def frame(curve: OrbitCurve, spot: Any, base: Base) -> np.ndarray:
    """The directions across the flow, in columns; all of them if it is forced."""
    n = len(curve.sizes)
    if not curve.autonomous:
        return np.eye(n)
    at = spot.look.parameter, np.asarray(base.t), base.x, base.mode, np.zeros(len(base.mode), np.int32)
    f = np.asarray(field_at(curve, *at))
    f = f / np.asarray(curve.sizes)
    return np.linalg.svd(f[None])[2][1:].T


def _piece(curve: OrbitCurve, spot: Any, points: list[Base], p: int) -> Any:
    """The derivatives of one piece by state and parameter without and with the event, in units of the curve; the
    factor of 1/root where they diverge; a direction to the side with the event; and whether the state jumps."""
    sizes = np.append(np.asarray(curve.sizes), float(curve.width))
    n, m, period = len(sizes) - 1, len(points), float(spot.look.period)
    base, last = points[p], points[(p + 1) % m]
    end = last.t + (period if p + 1 == m else 0.0)
    nodes = NEAREST + (1 - NEAREST) * (1 - np.cos(np.pi * (np.arange(LEVELS) + 0.5) / LEVELS)) / 2
    generator = np.random.default_rng(0)
    directions = [*np.eye(n + 1), *generator.standard_normal((4, n + 1))]
    found = None
    for reach in REACHES:
        for d in directions:
            d = d / np.linalg.norm(d)
            roots = reach * nodes
            z = np.append(base.x, float(spot.look.parameter))
            z = z + np.concatenate([np.outer(roots**2, d), -np.outer(roots**2, d)]) * sizes
            lanes = 2 * LEVELS
            ends, jacobians, events, good = follow(
                curve,
                z[:, :-1],
                z[:, -1],
                spot.look.parameter,
                np.full(lanes, base.t),
                np.full(lanes, end),
                np.tile(base.mode.astype(np.int32), (lanes, 1)),
            )
            keys = [_key(events, lane) for lane in range(lanes)]
            one, other = keys[:LEVELS], keys[LEVELS:]
            if not good.all() or len(set(one)) > 1 or len(set(other)) > 1 or one[0] == other[0]:
                continue
            scaled = jacobians / sizes[:n][:, None] * sizes
            fits = [_limit(roots, scaled[half]) for half in (slice(0, LEVELS), slice(LEVELS, None))]
            places = [_limit(roots, ends[half] / sizes[:n])[0] for half in (slice(0, LEVELS), slice(LEVELS, None))]
            error = max(fit[2] for fit in fits)
            # The side with the event: of more events, or where the derivative diverges.
            more = 0 if len(one[0]) > len(other[0]) else 1
            if fits[1 - more][1] is not None and fits[more][1] is None:
                more = 1 - more
            side = d if more == 0 else -d
            jump = bool(np.abs(places[0] - places[1]).max() > 1e-6)
            entry = (error, (fits[1 - more][0], fits[more][0], fits[more][1], side, jump))
            if found is None or error < found[0]:
                found = entry
            break
        if found is not None and found[0] < 1e-9:
            break
    return None if found is None else found[1]


def _key(events: Events, lane: int) -> tuple:
    n = int(events.num[lane])
    return tuple((int(k), *map(int, m)) for k, m in zip(events.switch[lane, :n], events.mode_after[lane, :n]))


def _limit(roots: np.ndarray, values: np.ndarray) -> tuple[np.ndarray, np.ndarray | None, float]:
    """The limit of a smooth function of the root, the coefficient of 1/root if it has one, and how well both are known:
    by the polynomials through all values, and through all but one."""
    flat = values.reshape(len(roots), -1)

    def fitted(rows: slice) -> tuple[np.ndarray, np.ndarray]:
        r = roots[rows] / roots.max()
        powers = r[:, None] ** np.arange(len(r))
        diverging = np.linalg.solve(powers, r[:, None] * flat[rows])
        plain = np.linalg.solve(powers, flat[rows])
        return plain[0], diverging[:2]

    plain, diverging = fitted(slice(None))
    plain_less, diverging_less = fitted(slice(1, None))
    size = 1 + np.abs(plain).max()
    if np.abs(diverging[0]).max() < 1e-6 * (1 + np.abs(diverging[1]).max()):
        return plain.reshape(values.shape[1:]), None, float(np.abs(plain - plain_less).max() / size)
    error = float(np.abs(diverging - diverging_less).max() / (1 + np.abs(diverging).max()))
    root = (diverging[0] * roots.max()).reshape(values.shape[1:])
    return diverging[1].reshape(values.shape[1:]), root, error


def touches_of(spot: Any, rows: list[int]) -> list[Touch]:
    """The places at the ends of these segments, in the order of time within one period."""
    return sorted(Touch(float(spot.look.end[i]), i) for i in rows)
