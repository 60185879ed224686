"""The curve on which the periodic orbits of one itinerary lie when a parameter varies.

The states and times of all events are unknown. So the curve is smooth where the return map is not: at grazing, where a
segment has no length, and on surfaces that repel.
"""

import dataclasses
import functools as ft
from typing import Any

import equinox as eqx
import jax
import jax.flatten_util as jfu
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int

from ..._numerics._autodiff import frozen
from ..._numerics._compile import interactive
from ..._numerics._select import select
from ..._types import Scalar, Y
from ...flow._integrator import Integrator
from ...system._mode import ModeState
from ...system._model import SwitchedSystem
from ...system._parameter import FreeParameters, get_parameter
from ._guess import landing
from ._itinerary import EVENT, GRAZING, OrbitItinerary, PIECE, REPELLING_EXIT, Start, TIME
from ._segment_flow import ALWAYS, FREE_MODES, SegmentFlow


VANISHES = 1e-8  # an equation in the units of the unknowns


class OrbitCurve(eqx.Module):
    """The equations; what is unknown is measured in `sizes` (state), `time`, and `width`, the interval of the parameter
    from `low` on.

    With several free parameters (`low` and `width` are vectors) their orbits are a surface; with none (both are empty)
    an orbit is a point.

    `pieces`: into how many of equal length each segment is divided, for multiple shooting. Each has a row of its own.
    """

    model: SwitchedSystem
    free: FreeParameters
    like: Y
    low: Float[Array, "*parameters"]
    width: Float[Array, "*parameters"]
    sizes: Float[Array, " n"]
    time: Scalar
    guard_sizes: Float[Array, " slots"]  # what a unit of the unknowns makes of each guard
    order: Int[Array, ""]  # periods of the forcing
    normal: Float[Array, " n"]  # the phase condition of an autonomous orbit without events
    reference: Float[Array, " n"]
    integrator: Integrator = eqx.field(static=True)
    exact: int = eqx.field(static=True)  # which flows are known by their exponentials
    slides: bool = eqx.field(static=True, default=True)  # whether surfaces hold segments of the itinerary
    pieces: int = eqx.field(static=True, default=1)
    held: bool = eqx.field(static=True, default=False)  # whether surfaces hold an orbit throughout

    def on(self, itinerary: OrbitItinerary) -> "OrbitCurve":
        """With flows as the modes of an itinerary allow."""
        n = int(itinerary.num)
        slides = self.model.holds(*np.asarray(itinerary.mode)[:n])
        held = slides and not np.isin(np.asarray(itinerary.ends)[:n], (EVENT, REPELLING_EXIT)).any()
        return (
            self if (slides, held) == (self.slides, self.held) else dataclasses.replace(self, slides=slides, held=held)
        )

    @property
    def value(self) -> Array:
        """Of the free parameter in the model."""
        (path,) = self.free.paths
        return get_parameter(self.model.system, path)

    @property
    def fixed(self) -> "OrbitCurve":
        """The same for programs of this free parameter only. In others every parameter has a derivative, which may be
        infinite (of √c at c = 0, of |x|^n by n at x = 0), and zero times it, if the parameter is not free, is NaN."""
        return dataclasses.replace(self, free=self.free.fixed)

    def spoilt(self, f: Array, df: Array) -> Array:
        """Whether equations or derivatives are not finite, and `fixed` may be of help: where the solver integrates both
        at once, the state is lost too."""
        return ~(jnp.all(jnp.isfinite(f)) & jnp.all(jnp.isfinite(df)))

    def model_at(self, value: Array) -> SwitchedSystem:
        """The model with a value of the parameter (or of several)."""
        return self.model.with_system(self.free.put(self.model.system, value))

    def flow(self, value: Array) -> SegmentFlow:
        """That of the modes with a value of the parameter (or of several)."""
        sizes = frozen(jnp.asarray(self.sizes))
        return SegmentFlow(self.model, self.free, value, self.like, sizes, self.integrator, self.exactly, self.slides)

    @property
    def exactly(self) -> bool:
        """Whether flows are known by their exponentials; else they are steps of the solver."""
        return self.exact == ALWAYS or (self.exact == FREE_MODES and not self.slides)

    @property
    def autonomous(self) -> bool:
        return self.model.system.period is None

    @property
    def dimension(self) -> int:
        """That of the curve, or surface: how many parameters vary."""
        return int(np.size(self.low))

    def unravel(self, x: Array) -> Y:
        return jfu.ravel_pytree(self.like)[1](x)

    def parts(self, u: Array) -> tuple[Array, Array, Array, Array]:
        """Times of beginning and end, states at the beginnings, parameter."""
        n, known = len(self.sizes), len(u) - self.dimension
        z = u[:known].reshape(-1, n + 2)
        value = self.low + u[known:].reshape(jnp.shape(self.low)) * self.width
        return z[:, 0] * self.time, z[:, 1] * self.time, z[:, 2:] * self.sizes, value

    def spread(self, begin: Array, end: Array) -> tuple[Array, Array]:
        """Those times of the pieces which those of their segments make. All that is asked of a piece depends on the
        latter alone: where errors grow by many powers of ten, times of its own would take theirs from rounding."""
        if self.pieces == 1:
            return begin, end
        a, b = begin[:: self.pieces, None], end[self.pieces - 1 :: self.pieces, None]
        inner = a + (b - a) * jnp.arange(1, self.pieces, dtype=begin.dtype) / self.pieces
        return jnp.concatenate([a, inner], 1).ravel(), jnp.concatenate([inner, b], 1).ravel()

    def pack(self, start: Start, value: Any) -> np.ndarray:
        capacity, n = len(start.itinerary.slot), len(self.sizes)
        z = np.zeros((capacity, n + 2))
        for i in range(capacity):
            j = min(i, len(start.begin) - 1)
            z[i] = [start.begin[j], start.end[j], *start.x[j]]
            if i > j:
                z[i, :2] = start.end[j]
        z /= np.array([float(self.time)] * 2 + np.asarray(self.sizes).tolist())
        return np.append(z.ravel(), (np.asarray(value) - self.low) / self.width)

    def state(self, mode: Array, part: Array) -> ModeState:
        return ModeState.of(mode, [p if n > 1 else None for p, n in zip(part, self.model.parts)])

    def guard_rows(self, model: SwitchedSystem, t: Scalar, x: Array, state: ModeState) -> list[list[Scalar]]:
        """`[slot][part]`; those that no segment asks for are 1."""
        wanted = tuple(self.slides or not slot.holding for slot in model.slots)
        return [row or [jnp.ones_like(t)] for row in model.guards(t, self.unravel(x), state, wanted)]

    def guards(self, model: SwitchedSystem, t: Scalar, x: Array, state: ModeState) -> Float[Array, "slots parts"]:
        return model.stacked(self.guard_rows(model, t, x, state), -jnp.inf)

    def guard(self, model: SwitchedSystem, t: Scalar, x: Array, state: ModeState, slot: Array, entry: Array) -> Scalar:
        if not model.slots:
            return jnp.ones_like(t)
        return self.guards(model, t, x, state)[slot, entry]

    def rate(self, model: SwitchedSystem, t: Scalar, x: Array, state: ModeState, slot: Array, entry: Array) -> Scalar:
        """How fast a guard changes along the flow."""
        f = jfu.ravel_pytree(model.flow(t, self.unravel(x), state))[0]
        along = jax.jvp(lambda t, x: self.guard(model, t, x, state, slot, entry), (t, x), (jnp.ones_like(t), f))
        return along[1]

    def residual(self, u: Array, itinerary: OrbitItinerary, origin: Array) -> tuple[Array, Scalar, Array]:
        """What vanishes: for each segment its beginning in time and state, and what ends it. Also the time at which the
        last segment ends, and the states at the ends."""
        begin, end, x, value = self.parts(u)
        given, rows = (begin, end), len(begin)
        begin, end = self.spread(begin, end)
        model = self.model_at(value)
        flow = self.flow(value)
        index = jnp.arange(rows, dtype=itinerary.num.dtype)
        happened, final = index < itinerary.num, index == itinerary.num - 1
        mode, part = jnp.asarray(itinerary.mode), jnp.asarray(itinerary.part)
        following = select(final[:, None], mode[:1], jnp.roll(mode, -1, axis=0))

        def row(a: Scalar, b: Scalar, x: Array, mode: Array, part: Array) -> Array:
            return flow.arrive(a, b, x, self.state(mode, part))

        last = jax.vmap(row)(begin, end, x, mode, part)

        def jump(t: Scalar, x: Array, mode: Array, part: Array, after: Array, slot: Array, ends: Array) -> tuple:
            out = (self.unravel(x), jnp.zeros_like(t))
            if any(switch.jumps for switch in model.switches):
                table = jnp.asarray([(s.switch, s.part) for s in model.slots], jnp.int32)
                switch, wall = table[slot]
                # Of several walls it is the one that is hit, which need not be the one that the segment has left.
                hits = np.array([s.unilateral for s in model.switches])
                hits = hits & (np.arange(len(hits), dtype=np.int32) == switch)
                k = select(ends == EVENT, switch, -1)
                state = self.state(mode, select(hits, wall, part))
                out = landing(model, k, t, self.unravel(x), state, tuple(after))
            if self.held:  # off the surface the flow goes on beside it, so that any distance would repeat itself
                state = self.state(mode, part)
                onto = model.project(t, out[0], state)
                out = jax.tree.map(lambda a, b: select(ends == PIECE, b, a), onto, out[0]), out[1]
            return jfu.ravel_pytree(out[0])[0], out[1]

        after, rest = jax.vmap(jump)(end, last, mode, part, following, itinerary.slot, itinerary.ends)
        before = select(index == 0, itinerary.num - 1, index - 1)
        forced = None if self.autonomous else jnp.asarray(model.system.period, end.dtype) * self.order.astype(end.dtype)
        arrival = (end + rest)[before]
        anchor = jnp.zeros_like(end[0]) if forced is None else arrival[0] - forced
        # What begins away from events keeps its beginning.
        anchor = select(itinerary.ends[itinerary.num - 1] == TIME, origin[0] * self.time, anchor)
        started = begin - select(index == 0, anchor, arrival)
        if self.pieces > 1:
            started = select(index % self.pieces == 0, started, given[0] - begin)

        def ended(a: Scalar, b: Scalar, x: Array, last: Array, mode: Array, part: Array, *what: Array) -> Scalar:
            slot, entry, ends = what
            state = self.state(mode, part)
            out = self.guard(model, b, last, state, slot, entry)
            out = select(ends == GRAZING, self.rate(model, b, last, state, slot, entry) * self.time, out)
            if model.holdable and model.slots:
                holding = self.guard(model, a, x, state, slot, entry) + 1
                for k in model.holdable:
                    if k not in model.contacts:
                        here = jnp.asarray([s.switch == k for s in model.slots])[slot]
                        holding = select(here, holding - model.bound(k), holding)
                out = select(ends == REPELLING_EXIT, holding, out)
            out = out / (jnp.asarray(self.guard_sizes)[slot] if model.slots else 1)
            closing = self.normal @ (first - self.reference) if forced is None else b - begin[0] - forced
            return select(ends == TIME, closing / self.time, out)

        first, since, whence = x[0], begin, x
        if self.pieces > 1:  # what holds where a segment begins holds at its first piece
            opening = select(itinerary.ends == REPELLING_EXIT, index - (self.pieces - 1), index)
            since, whence = begin[opening], x[opening]
        what = itinerary.slot, itinerary.entry, itinerary.ends
        finish = jax.vmap(ended)(since, end, whence, last, mode, part, *what)
        if self.pieces > 1:
            finish = select(itinerary.ends == PIECE, (given[1] - end) / self.time, finish)
        # In the units of the unknowns.
        whole = jnp.concatenate([started[:, None] / self.time, finish[:, None], (x - after[before]) / self.sizes], 1)
        fill = (u - origin)[: len(u) - self.dimension].reshape(rows, -1)
        return select(happened[:, None], whole, fill).ravel(), arrival[0] / self.time, last


def guard_sizes(curve: OrbitCurve, start: Start) -> np.ndarray:
    """What a unit of the unknowns makes of each guard: from their gradients at the beginnings of the segments."""
    filled, n = start.filled(), len(start.begin)
    rows = np.minimum(np.arange(len(filled.itinerary.slot)), n - 1)
    return np.asarray(_guard_sizes(curve, filled.itinerary, start.begin[rows], start.x[rows]))


@interactive
def _guard_sizes(curve: OrbitCurve, itinerary: OrbitItinerary, begin: Array, x: Array) -> Array:
    return guard_sizes_at(curve, itinerary, begin, x)


def guard_sizes_at(
    curve: OrbitCurve, itinerary: OrbitItinerary, begin: Float[Array, " rows"], x: Float[Array, "rows n"]
) -> Float[Array, " slots"]:
    """`guard_sizes` within a program."""
    if not curve.model.slots:
        return jnp.zeros(0, x.dtype)
    mode, part = jnp.asarray(itinerary.mode), jnp.asarray(itinerary.part)
    # Those of a switch that is held are seen in that mode alone.
    every = jnp.stack([jnp.full_like(mode[0], m) for m in (-1, 0, 1)])
    segments = begin, x, mode, part
    extra = *(jnp.repeat(column[:1], 3, axis=0) for column in (begin, x)), every, jnp.repeat(part[:1], 3, axis=0)
    rows = [jnp.concatenate(pair) for pair in zip(segments, extra)]
    found = jnp.max(jax.vmap(lambda *row: _gradients(curve, *row))(*rows), axis=0)
    return select(jnp.isfinite(found) & (found > 0), found, 1.0)


def _gradients(curve: OrbitCurve, t: Scalar, x: Array, mode: Array, part: Array) -> Array:
    """The largest component of the gradient of each guard, by the unknowns."""
    state = curve.state(mode, part)
    by_t, by_x = jax.jacfwd(lambda t, x: curve.guards(curve.model, t, x, state), argnums=(0, 1))(t, x)
    both = jnp.concatenate([by_t[..., None] * curve.time, by_x * curve.sizes], axis=-1)
    return jnp.max(select(jnp.isfinite(both), jnp.abs(both), 0), axis=(-2, -1))


def row_sizes(df: Array) -> Array:
    """A row that vanishes, as at a branch point of one state that is zero, is not made one of rounding."""
    sizes = jnp.max(jnp.abs(df), axis=1)
    return select(sizes < VANISHES, 1, sizes)


@interactive
def field_at(curve: OrbitCurve, value: Array, t: Scalar, x: Array, mode: Array, part: Array) -> Array:
    """The field in a mode."""
    model = curve.model_at(value)
    return jfu.ravel_pytree(model.flow(t, curve.unravel(x), curve.state(mode, part)))[0]


@interactive
def guards_along(
    curve: OrbitCurve, value: Array, t: Scalar, x: Array, mode: Array, part: Array
) -> tuple[Array, Array, Array]:
    """All guards in a mode, `[slot, part]`, and their first and second derivatives along the flow."""
    model, state = curve.model_at(value), curve.state(mode, part)

    def along(t: Scalar, x: Array) -> tuple[Array, Array]:
        f = jfu.ravel_pytree(model.flow(t, curve.unravel(x), state))[0]
        return jax.jvp(lambda t, x: curve.guards(model, t, x, state), (t, x), (jnp.ones_like(t), f))

    f = jfu.ravel_pytree(model.flow(t, curve.unravel(x), state))[0]
    (values, rates), (_, bends) = jax.jvp(along, (t, x), (jnp.ones_like(t), f))
    return values, rates, bends


def linearised(curve: OrbitCurve, itinerary: OrbitItinerary, u: Any) -> Float[np.ndarray, "rows unknowns"]:
    """The derivatives of the equations, row by row of size one."""
    _, df, sizes = equations(curve.on(itinerary), itinerary, u, u)
    return df / sizes[:, None]


def equations(curve: OrbitCurve, itinerary: OrbitItinerary, u: Any, origin: Any) -> tuple[Any, Any, Any]:
    """The equations, their derivatives, and the sizes of these, row by row."""
    f, df, sizes, spoilt = _equations(curve, itinerary, u, origin)
    if spoilt:
        f, df, sizes, _ = _equations(curve.fixed, itinerary, u, origin)
    return f, df, sizes


@ft.partial(interactive, host=True)
def _equations(curve: OrbitCurve, itinerary: OrbitItinerary, u: Array, origin: Array) -> tuple[Array, ...]:
    def residual(u: Array) -> tuple[Array, Array]:
        f = curve.residual(u, itinerary, origin)[0]
        return f, f

    df, f = jax.jacfwd(residual, has_aux=True)(u)
    return f, df, row_sizes(df), curve.spoilt(f, df)
