"""A branch of periodic orbits as one compiled loop: a lane among thousands that are followed at once."""

from typing import Any, NamedTuple

import jax
import jax.lax as lax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int

from ...._numerics._select import select
from ...._types import Scalar
from ....orbits.segments._corrector import Plane
from ....orbits.segments._equations import OrbitCurve
from ....orbits.segments._itinerary import OrbitItinerary
from ....orbits.segments._point import corrected, PointData
from ..._step_length import FIRST, next_length, SHORTEST, turn_between, TURNED
from .._test_functions import BRANCH, branch_value, CIRCLE, circle_values, corner_tests, corner_values, PASSED, Test


TRIES = 40  # to locate one zero
EACH = 4  # orbits computed for each point, on average, at most
# What a lane is doing, and how it ended.
STARTING, STEPPING, LOCATING, ENDED, LOST, NO_ORBIT = range(6)


class Row(NamedTuple):
    """What is kept of an orbit."""

    parameter: Scalar
    period: Scalar
    t: Scalar
    x: Array
    u: Array
    multipliers: Array
    stable: Bool[Array, ""]


class Place(NamedTuple):
    """A point of the curve, and what the test functions are there."""

    u: Array
    tangent: Array
    log: Scalar  # of the determinant, by which that of the next points is divided
    values: Array
    row: Row


class Lane(NamedTuple):
    at: Place
    far: Place  # the step in which zeros are being located
    bend: Array  # by how much the tangent turned in the last step, over its length
    length: Scalar  # of the step
    doing: Int[Array, ""]
    wanted: Bool[Array, " tests"]  # zeros still to be located
    target: Int[Array, ""]
    near: Array  # the bracket: distance and value at its ends
    off: Array
    tries: Int[Array, ""]
    end: Scalar  # distance in this step of the first zero at which the branch ends
    last: Int[Array, ""]  # of which test that is
    arc: Scalar  # length of the curve so far
    rows: Row
    arcs: Float[Array, " points"]
    kinds: Int[Array, " points"]  # -1: an ordinary point; else of which test it is the zero
    count: Int[Array, ""]
    work: Int[Array, ""]  # orbits computed


def lane_tests(rows: int, slots: int) -> list[Test]:
    """The test functions, in the order of `values_of`."""
    return [Test("low"), Test("high"), *corner_tests(rows, slots), Test("fold"), BRANCH, *CIRCLE]


def values_of(curve: OrbitCurve, look: PointData, itinerary: OrbitItinerary, log: Scalar) -> Array:
    share = look.u[-1]
    corners, there = corner_values(curve, look, itinerary)
    smooth = jnp.stack([look.tangent[-1], branch_value(look, log)])
    circle = circle_values(look.multipliers, curve.autonomous)
    ends = jnp.stack([share, 1 - share])
    return jnp.concatenate([ends, select(there, corners, 1), smooth, circle])


def place_of(curve: OrbitCurve, look: PointData, itinerary: OrbitItinerary, log: Scalar) -> Place:
    # In the middle of the longest segment, if possible of one that no surface holds.
    mode, held = jnp.asarray(itinerary.mode), jnp.zeros(len(look.begin), bool)
    for k in curve.model.holdable:
        held |= curve.model.held(k, mode[:, k])
    length = select(jnp.arange(len(held), dtype=itinerary.num.dtype) < itinerary.num, look.end - look.begin, -jnp.inf)
    i = jnp.argmax(length * select(held, 1e-6, 1.0))
    middle = look.ts.shape[1] // 2
    row = Row(
        look.parameter, look.period, look.ts[i, middle], look.xs[i, middle], look.u, look.multipliers,
        look.stable,
    )  # fmt: skip
    return Place(look.u, look.tangent, look.branch[1], values_of(curve, look, itinerary, log), row)


def follow_lane(
    curve: OrbitCurve,
    itinerary: OrbitItinerary,
    u: Array,
    found: Bool[Array, ""],
    upwards: Array,
    max_step: Array,
    points: int,
) -> Lane:
    """The branch from `u` on, to its end, to the first corner, or to `points` points."""
    zero, none = jnp.zeros_like(u[0]), jnp.zeros((), jnp.int32)
    border = jnp.zeros_like(u).at[-1].set(1)
    tests = lane_tests(len(itinerary.slot), len(curve.model.slots))
    x = jnp.zeros(len(curve.sizes), u.dtype)
    row = Row(zero, zero, zero, x, u, jax.lax.complex(x, x), jnp.zeros((), bool))
    at = Place(u, border, zero, jnp.zeros(len(tests), u.dtype), row)
    rows = jax.tree.map(lambda x: jnp.zeros((points, *x.shape), x.dtype), row)
    ends = jnp.asarray([test != BRANCH and test.kind not in PASSED for test in tests])
    lane = Lane(
        at=at, far=at, bend=jnp.zeros_like(u), length=zero,
        doing=select(found, STARTING, NO_ORBIT).astype(jnp.int32), wanted=jnp.zeros_like(ends), target=none,
        near=jnp.zeros(2, u.dtype), off=jnp.zeros(2, u.dtype), tries=none, end=jnp.full_like(zero, jnp.inf), last=none,
        arc=zero, rows=rows, arcs=jnp.zeros(points, u.dtype), kinds=jnp.full(points, -1, jnp.int32), count=none,
        work=none,
    )  # fmt: skip

    def going(lane: Lane) -> Array:
        return (lane.doing <= LOCATING) & (lane.count < points) & (lane.work < EACH * points)

    def step(lane: Lane) -> Lane:
        moved = _moved(curve, itinerary, lane, ends, upwards, max_step)
        return jax.tree.map(lambda new, old: select(going(lane), new, old), moved, lane)

    return lax.while_loop(going, step, lane)


def _written(lane: Lane, row: Row, arc: Scalar, kind: Any, when: Bool[Array, ""]) -> Lane:
    index = select(when, lane.count, len(lane.arcs))  # past the end it is dropped

    def put(buffer: Array, value: Any) -> Array:
        return buffer.at[index].set(value, mode="drop")

    return lane._replace(
        rows=jax.tree.map(put, lane.rows, row),
        arcs=put(lane.arcs, arc),
        kinds=put(lane.kinds, kind),
        count=lane.count + when.astype(jnp.int32),
    )


def _moved(
    curve: OrbitCurve, itinerary: OrbitItinerary, lane: Lane, ends: Array, upwards: Array, max_step: Array
) -> Lane:
    """One more orbit: the next point, or one nearer to a zero."""
    at, locating, starting = lane.at, lane.doing == LOCATING, lane.doing == STARTING
    chord = (lane.far.u - at.u) / select(locating, lane.length, 1)
    s = select(locating, _between(lane), lane.length)
    guess = select(locating, at.u + s * chord, _ahead(lane, s))
    look = corrected(curve, itinerary, Plane(at.u, at.tangent, s), guess, turns=False)
    turn = select(starting & (look.tangent[-1] * upwards < 0), -1, 1).astype(s.dtype)
    # The sign of a determinant of which the tangent is a row.
    look = look._replace(tangent=turn * look.tangent, branch=look.branch * jnp.stack([turn, jnp.ones_like(turn)]))
    here = place_of(curve, look, itinerary, select(starting, look.branch[1], at.log))
    lane = lane._replace(work=lane.work + 1)
    first = lane._replace(
        at=here,
        far=here,
        length=jnp.full_like(s, FIRST),
        doing=select(look.good, STEPPING, NO_ORBIT).astype(jnp.int32),
    )
    options = (
        _written(first, here.row, s, -1, look.good),
        _located(lane, here, look.good, s, ends, max_step),
        _stepped(lane, here, look.good, ends, max_step),
    )
    return jax.tree.map(lambda a, b, c: select(starting, a, select(locating, b, c)), *options)


def _between(lane: Lane) -> Scalar:
    """Where the secant of the bracket vanishes, or its middle (the second half of tries)."""
    (a, b), (fa, fb) = lane.near, lane.off
    s = (a * fb - b * fa) / select(fb == fa, 1, fb - fa)
    inside = (s > a) & (s < b) & (lane.tries < TRIES // 2)
    return select(inside, s, (a + b) / 2)


def _ahead(lane: Lane, s: Scalar) -> Array:
    """The predictor, to second order."""
    return lane.at.u + s * (lane.at.tangent + s / 2 * lane.bend)


def _on(lane: Lane, here: Place, max_step: Array, passes: Bool[Array, ""]) -> Lane:
    """At the end of the step, if it `passes`, with the length of the next."""
    turn = turn_between(lane.at.tangent, here.tangent)
    length = next_length(lane.length, turn, here.tangent, here.u, max_step)
    bend = (here.tangent - lane.at.tangent) / select(passes, lane.length, 1)
    new = lane._replace(at=here, bend=bend, length=length, arc=lane.arc + lane.length)
    return jax.tree.map(lambda new, old: select(passes, new, old), new, lane)


def _stepped(lane: Lane, here: Place, good: Array, ends: Array, max_step: Array) -> Lane:
    turn = turn_between(lane.at.tangent, here.tangent)
    good = good & (turn <= TURNED) & jnp.all(jnp.isfinite(here.values))
    before, after = lane.at.values, here.values
    changed = select(ends, (before > 0) & (after <= 0), before * after < 0)
    passes = good & ~jnp.any(changed)
    shorter = lane.length / 2
    lost = ~good & (shorter < SHORTEST)
    on = _on(lane._replace(length=select(good, lane.length, shorter)), here, max_step, passes)._replace(
        far=here,
        doing=select(lost, LOST, select(good & ~passes, LOCATING, STEPPING)).astype(jnp.int32),
        wanted=changed & good,
        end=jnp.full_like(lane.end, jnp.inf),
    )
    return _aimed(_written(on, here.row, on.arc, -1, passes))


def _aimed(lane: Lane) -> Lane:
    """At the next zero to be located."""
    target = jnp.argmax(lane.wanted).astype(jnp.int32)
    return lane._replace(
        target=target,
        near=jnp.stack([jnp.zeros_like(lane.length), lane.length]),
        off=jnp.stack([lane.at.values[target], lane.far.values[target]]),
        tries=jnp.zeros_like(lane.tries),
    )


def _located(lane: Lane, here: Place, good: Array, s: Scalar, ends: Array, max_step: Array) -> Lane:
    """The bracket by the Illinois method; or, once it is closed, on to the next zero, or to the next step."""
    value = here.values[lane.target]
    (a, b), (fa, fb) = lane.near, lane.off
    left = value * fa > 0  # the zero is on the other side
    same = select(left, a, b) != select(left, 0, lane.length)  # that end has moved before
    near = select(left, jnp.stack([s, b]), jnp.stack([a, s]))
    off = select(left, jnp.stack([value, select(same, fb / 2, fb)]), jnp.stack([select(same, fa / 2, fa), value]))
    tries = lane.tries + 1
    # Beside a singular point there is no orbit to be had: what is known by then is all.
    closed = ~good | (value == 0) | (near[1] - near[0] < 1e-14) | (jnp.abs(s - select(left, a, b)) < 1e-13)
    closed = closed | (tries >= TRIES)
    done = lane._replace(near=near, off=off, tries=tries)
    ending = closed & ends[lane.target] & (s < lane.end)
    end, last = select(ending, s, lane.end), select(ending, lane.target, lane.last)
    done = _written(done, here.row, lane.arc + s, lane.target, closed & good)
    wanted = lane.wanted & ~(closed & (jnp.arange(len(ends), dtype=lane.target.dtype) == lane.target))
    over = closed & ~jnp.any(wanted)
    ended = over & jnp.isfinite(end)
    passes = over & ~ended
    after = _on(done, lane.far, max_step, passes)._replace(
        doing=select(ended, ENDED, select(passes, STEPPING, LOCATING)).astype(jnp.int32),
        wanted=wanted,
        end=end,
        last=last,
    )
    aimed = _aimed(after)
    after = jax.tree.map(lambda a, b: select(closed & ~over, a, b), aimed, after)
    return _written(after, lane.far.row, after.arc, -1, passes)
