"""The least values of the guards, and of the states, along the segments of an orbit."""

import jax
import jax.numpy as jnp
from jaxtyping import Array

from ..._numerics._compile import interactive
from ..._numerics._minima import grouped, in_order, Minima, minima, places_of, RESOLVED
from ..._numerics._select import select
from ..._types import Scalar
from ...system._mode import OFF
from ._equations import OrbitCurve
from ._itinerary import EVENT, OrbitItinerary, REPELLING_EXIT


@interactive
def extremes(curve: OrbitCurve, itinerary: OrbitItinerary, u: Array) -> tuple[Array, Array]:
    """The least and the largest value of each component of the state along an orbit."""
    found = along_orbit(curve, itinerary, u, turns=True, guards=False).least
    inside = jnp.arange(len(found), dtype=itinerary.num.dtype) < itinerary.num
    low, high = jnp.min(select(inside[:, None], found, jnp.inf), axis=0).reshape(2, -1)
    return low, -high


def along_orbit(curve: OrbitCurve, itinerary: OrbitItinerary, u: Array, turns: bool, guards: bool = True) -> Minima:
    """Of every segment the least values of the state's components, of their negatives (with `turns` between nodes too),
    and of the guards, these divided by the zeros that they must have at the ends."""
    begin, end, x, value = curve.parts(u)
    rows, slots = len(begin), len(curve.model.slots) * guards
    orders = jnp.zeros((rows, 2, 0), x.dtype)
    if slots:
        zeros = jnp.asarray(zeros_at_begin(curve, itinerary), x.dtype)  # rows, slots
        here = jnp.arange(slots, dtype=itinerary.slot.dtype) == itinerary.slot[:, None]
        index = jnp.arange(rows, dtype=itinerary.num.dtype)
        after = select(index >= itinerary.num - 1, 0, index + 1)
        # On what is left freely it comes tangentially.
        order = select(itinerary.ends[after] == REPELLING_EXIT, 2, 1)[:, None]
        last = select((itinerary.ends == EVENT)[:, None] & here, order, 0)
        orders = jnp.stack([zeros, last.astype(x.dtype)], axis=1)
    plain = jnp.zeros((rows, 2, 2 * len(curve.sizes)), x.dtype)
    orders = jnp.concatenate([plain, orders], axis=2)
    segments = begin, end, x, jnp.asarray(itinerary.mode), jnp.asarray(itinerary.part)
    return jax.vmap(lambda segment, orders: along_segment(curve, value, segment, orders, turns))(segments, orders)


def along_segment(curve: OrbitCurve, value: Array, segment: tuple, orders: Array, turns: bool) -> Minima:
    """As `along_orbit`, of one segment: its two times, first state, mode and parts; with any orders of the zeros."""
    a, b, x, mode, part = segment
    model = curve.model_at(value)
    flow = curve.flow(value)
    n, state = len(curve.sizes), curve.state(mode, part)
    slots = orders.shape[1] - 2 * n
    slack = jnp.concatenate(
        [jnp.asarray(size, x.dtype) for size in (curve.sizes, curve.sizes, curve.guard_sizes[:slots])]
    )

    def sample(first: Scalar, last: Scalar, x: Array) -> tuple[Array, Array, Array]:
        end = select(last < 1, a + (b - a) * last, b)
        return flow.along(a + (b - a) * first, end, x, state)

    def rows(t: Scalar, x: Array) -> list[list[Array]]:
        guards = curve.guard_rows(model, t, x, state) if slots else []
        return [*([x[i]] for i in range(n)), *([-x[i]] for i in range(n)), *guards]

    places = places_of(jax.eval_shape(rows, a, x))

    def functions(ts: Array, xs: Array) -> tuple[list[Array], Array]:
        return grouped(jax.vmap(rows)(ts, xs)), max(RESOLVED, flow.missed) * slack[places]

    def below(most: Array) -> Array:
        # The least value of a guard is of interest where it is about to vanish.
        return select(places < 2 * n, jnp.inf if turns else -jnp.inf, 0.1 * most)

    found = minima(sample, functions, x, orders[:, places], below, sums=jnp.zeros((2, n), x.dtype))
    return in_order(found, places)


def zeros_at_begin(curve: OrbitCurve, itinerary: OrbitItinerary) -> Array:
    """How many zeros each guard has at the beginning of each segment: that of the surface just left."""
    model = curve.model
    index = jnp.arange(len(itinerary.slot), dtype=itinerary.num.dtype)
    before = select(index == 0, itinerary.num - 1, index - 1)
    slot, ends, mode_before = itinerary.slot[before], itinerary.ends[before], jnp.asarray(itinerary.mode)[before]
    mode = jnp.asarray(itinerary.mode)
    columns = []
    switch = jnp.asarray([s.switch for s in model.slots], jnp.int32)[slot]
    entry = itinerary.entry[before]
    part = jnp.asarray([s.part for s in model.slots], jnp.int32)[slot]
    component = select(entry > 0, entry, select(part >= 0, part, 0))
    for s in model.slots:
        k = s.switch
        left = (switch == k) & ((ends == EVENT) | (ends == REPELLING_EXIT))
        if s.holding or model.switches[k].order == 0:
            columns.append(jnp.zeros(len(index)))
            continue
        free = jnp.ones(len(index), bool)
        order = jnp.ones(len(index))
        if model.conditional(k):
            left = left & (mode[:, k] != OFF)
        if k in model.holdable:
            free = ~model.held(k, mode[:, k])
            slid = model.held(k, mode_before[:, k])
            if k in model.contacts:
                order = select(slid, 3, 1)
            elif not model.static(k):
                order = select(slid, 2, 1)
        if model.parts[k] > 1:  # above, each component is a guard of its own; below, they are one
            free = free & (select(mode[:, k] < 0, 0, component) == s.part)
        columns.append(select(left & free, order, 0))
    return jnp.stack([c.astype(jnp.result_type(float)) for c in columns], axis=1)
