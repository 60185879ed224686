"""What an event does to the state and the mode."""

import functools as ft
from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import jax.lax as lax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int

from ..._numerics._autodiff import frozen
from ..._numerics._bernstein import bend, largest
from ..._numerics._select import select
from ..._types import Scalar, Y
from ...system._mode import ModeState, OFF
from ...system._model import SwitchedSystem
from .._results import RESULTS
from ..steppers._stepper import stack, Stepper
from ._impact import completed, Gap, rebound
from ._locate import encounter, Interval, locate, Located, step_to
from ._mode_choice import settle


class Transition(NamedTuple):
    """A step that ends at an event, and how the solution goes on."""

    found: Bool[Array, ""]
    t: Scalar  # of the event
    t_after: Scalar  # the same; of an accumulation of impacts the time at which it ends
    y_before: Y
    y_after: Y
    f_after: Y
    state: ModeState
    slot: Int[Array, ""]
    news: Bool[Array, ""]  # whether anything changed, so that it belongs into the log
    points: Y | None  # control points of the step to the event, if asked for
    transversality: Scalar
    grazes: Bool[Array, ""]  # whether it was so tangential that it has no derivative
    forked: Bool[Array, ""]  # whether another solution goes on from here too
    result: RESULTS
    margin: Scalar  # how near a guard came to zero without meeting it, as a multiple of what the tolerance makes of it


def transition(
    model: SwitchedSystem,
    stepper: Stepper,
    tolerance: tuple[Any, Any],
    record: Callable[[Any], Any] | None,
    begin: Scalar,
    seen: tuple[tuple[int, ...], ...],
    step: Interval,
) -> Transition:
    """Locates the earliest event of a step, of a solution that sets out at time `begin`, and makes the transition.
    `tolerance`: relative and absolute. `record`: what dense output is made of, if any; it may be without derivatives.
    `seen`: see `encounter`."""
    event = _Event(model, begin, step, locate(model, stepper, step))
    event.fire()
    event.jump()
    contested = event.is_contested()
    later = event.later = model.within(tuple(event.modes))  # after a tick what depends on time is another function
    for k, switch in enumerate(model.switches):
        if switch.signed:
            event.meet(k)
        elif switch.unilateral:
            event.open_at_tick(k)
    event.come_to_rest()
    state, forked = event.choose()
    after, t, t_after, halted = event.after, event.t, event.t_after, event.halted
    if model.contacts:
        after = later.project(t_after, after, state)
    state = event.levels_just_passed(state, after)
    news = jnp.zeros((), bool)
    for k, switch in enumerate(model.switches[: model.declared]):
        news = news | (state.mode[k] != step.state.mode[k])
        if switch.jumps:
            news = news | event.fired[k]

    slot, part = event.slot, event.part
    met = encounter(model, t, event.before, step.state, part, tolerance, seen)
    cosine, missed = met.cosine[slot], event.missed
    if event.ticks is not None:
        cosine = select(event.ticks, 1, cosine)
        missed = jnp.minimum(missed, select(event.ticks, event.jumped_to(state, after), jnp.inf))
    # How deep h would fall without the event, if it has a minimum: h'²/(2h''). An error δ of h changes h' by h''δ/h',
    # and so the saltation matrix by δ/2 over this depth. Where δ, as the tolerance makes it, is a tenth of that, there
    # might be no event at all. All of this is the same in other units. (A short flight ends with a small rate as well,
    # but there h has no minimum, and the derivatives are right.)
    polynomial = [a[slot, part[slot]] for a in step.polynomials]
    length = select(halted, 1, step.t_next - step.t)
    bends = lax.stop_gradient(bend(polynomial, (t - step.t) / length))
    turns = event.found & news & ~halted & (bends > 0)
    depth = (met.rate[slot] * lax.stop_gradient(length)) ** 2 / (2 * select(turns, bends, 1))
    rtol = jnp.asarray(0.0 if stepper.exact else tolerance[0], t.dtype)  # NaN for steps of a given length
    # Rounding is allowed a hundred units in the last place, which in single precision is what the tolerance is.
    error = jnp.maximum(select(rtol >= 0, rtol, 0), 1e2 * float(jnp.finfo(t.dtype).eps))
    grazes = turns & (depth < 10 * error * jnp.maximum(largest(polynomial), met.size[slot]))
    points = None
    if record is not None:
        # Once more, to the very event and with the derivatives of where it begins and ends.
        at, within, before = record((t, (model, step.t, step.y, step.f, step.state), event.before))
        points = stack(stepper.points(within[2], before, step_to(at, stepper, within)[1]))
    return Transition(
        found=event.found,
        t=t,
        t_after=t_after,
        y_before=event.before,
        y_after=after,
        f_after=later.flow(t_after, after, state),
        state=state,
        slot=_reported(model, slot, step.state, state),
        news=news,
        points=points,
        transversality=select(grazes, 0, cosine),  # as it counts from here on
        grazes=grazes,
        forked=forked | contested,
        result=event.result,
        margin=jnp.minimum(
            jnp.min(select(missed < jnp.inf, missed / met.slack, jnp.inf)),
            select(turns, depth / met.slack[slot], jnp.inf),
        ),
    )


def _reported(model: SwitchedSystem, slot: Int[Array, ""], before: ModeState, after: ModeState) -> Int[Array, ""]:
    """The slot of an event as the log names it: where a derived clock ticks, that of a switch whose mode changes."""
    switches = jnp.asarray([s.switch for s in model.slots])
    out = slot
    for k in reversed(range(model.declared)) if model.declared < len(model.switches) else ():
        changed = (switches[slot] >= model.declared) & (before.mode[k] != after.mode[k])
        out = select(changed, [s.switch for s in model.slots].index(k), out)
    return out


class _Event:
    """An event while its consequences are worked out, one after the other."""

    later: SwitchedSystem  # the model after a tick

    def __init__(self, model: SwitchedSystem, begin: Scalar, step: Interval, located: Located):
        self.model, self.begin = model, begin
        self.found, self.t, before, self.slot, self.part, self.missed = located
        self.state = state = step.state
        self.ticks = jnp.asarray([s.switch in model.clocks for s in model.slots])[self.slot] if model.clocks else None
        if self.ticks is not None:  # to the last digit
            self.t = self.t + lax.stop_gradient(select(self.ticks, model.next_tick(state.mode) - self.t, 0))
        # What leaves a surface must do so from there: from beside it, at a loose tolerance, it met the surface again at
        # once, and chattered.
        self.before = model.project(self.t, before, state) if model.holdable else before
        self.halted = self.t <= step.t
        self.parts, self.modes = list(state.part), list(state.mode)
        self.roots = [select(self.halted, r, 0) for r in state.roots]
        self.after, self.size = self.before, jax.tree.map(jnp.abs, self.before)
        self.t_after = self.t
        self.at: dict[int, Bool[Array, ""]] = {}
        self.result = RESULTS.successful

    def mode_state(self) -> ModeState:
        return ModeState(tuple(m.astype(jnp.int32) for m in self.modes), tuple(self.parts), tuple(self.roots))

    def fire(self) -> None:
        """Which switches fire; of which λ has reached a bound; and which come to the tip of a surface with corners."""
        count = len(self.modes)
        self.fired = [jnp.zeros((), bool)] * count
        self.bounds = [jnp.zeros((), jnp.int32)] * count
        self.tip = [jnp.zeros((), bool)] * count
        component = self.part[self.slot].astype(jnp.int32)
        for i, (k, number, holding) in enumerate(self.model.slots):
            now = self.slot == i
            if holding:
                self.bounds[k] = select(now, number, self.bounds[k])
                continue
            self.fired[k] = self.fired[k] | now
            if self.parts[k] is not None:
                mode = self.state.mode[k]
                if self.model.switches[k].signed:
                    self.tip[k] = self.tip[k] | (now & (mode == 0))
                self.parts[k] = select(now, select(mode < 0, component, number), self.parts[k])

    def jump(self) -> None:
        """The modes of clocks and of switches with levels, and the states after impacts."""
        model, t, before, modes = self.model, self.t, self.before, self.modes
        for k, switch in enumerate(model.switches):
            if switch.levels or switch.ticking:
                modes[k] = select(self.fired[k], model.next_mode(k, t, before, modes[k]), modes[k])
        touching = self.state._replace(part=tuple(self.parts))
        for which in self.jumping():
            # A reset by a clock sees functions of time as they are after the tick.
            ticks = which[0] in model.clocks
            gap = self.gap(which, model.within(tuple(modes)) if ticks else model)
            if not ticks:
                # Another impact at this instant may have opened it: then h < 0 is rounding.
                rate = gap.rate(t, before, touching)
                if not gap.closes:
                    rate = self.state.mode[which[0]].astype(t.dtype) * rate
                away = rate > gap.slow(t, before, touching)
                for k in which:
                    opens = self.fired[k] & away
                    self.roots[k] = select(opens, 1, self.roots[k])
                    self.fired[k] = self.fired[k] & ~opens
            hit = rebound(gap, t, before, touching)
            now = ft.reduce(jnp.logical_or, [self.fired[k] for k in which])
            now_and_then = hit, (self.after, self.size)
            self.after, self.size = jax.tree.map(lambda a, b, now=now: select(now, a, b), *now_and_then)

    def jumping(self) -> list[tuple[int, ...]]:
        """The switches whose events change the state. Impacts by Newton's law that can be rested upon are one group, as
        only one of them fires at an event."""
        model = self.model

        def alike(k: int) -> bool:
            return k in model.contacts and model.switches[k].restitution_fn is not None

        group = tuple(filter(alike, model.jumping))
        return ([group] if group else []) + [(k,) for k in model.jumping if k not in group]

    def gap(self, which: tuple[int, ...], model: SwitchedSystem) -> Gap:
        return Gap(model, which, tuple(self.fired[k] for k in which))

    def is_contested(self) -> Bool[Array, ""]:
        """Whether an impact changes the speed at which another contact, met at the same instant, closes: which of the
        two rebounds first then decides the outcome, and only the order of declaration says so."""
        model, t, contested = self.model, self.t, jnp.zeros((), bool)
        impacts = model.which("unilateral")
        if len(impacts) < 2:
            return contested
        before, after = frozen((self.before, self.after))
        fields = [frozen(model.flow(t, y, self.state)) for y in (before, after)]
        for k in impacts:
            other = ft.reduce(jnp.logical_or, [self.fired[j] for j in impacts if j != k])
            h, noise = model.least(k, t, before), jnp.max(model.rounding(lambda t, y, k=k: model.h(k, t, y), t, before))
            speeds = [model.approach(k, t, y, self.state, f) for y, f in zip((before, after), fields)]
            least = jnp.maximum(*[Gap.of(model, k).slow(t, y, self.state, f) for y, f in zip((before, after), fields)])
            meets = (self.state.mode[k] == 0) & (jnp.abs(h) <= 1e4 * noise) & (jnp.minimum(*speeds) < -least)
            contested = contested | (other & meets & (jnp.abs(speeds[1] - speeds[0]) > least))
        return frozen(contested)

    def meet(self, k: int) -> None:
        """Whether a `sgn` switch is at its surface, and if an impact or a tick took it off, on which side it is."""
        model, later, t, roots, tip = self.model, self.later, self.t, self.roots, self.tip[k]
        # The end of a surface at its tip leads into h < 0.
        mode = select(tip, -1, self.modes[k])
        here = ((self.state.mode[k] == 0) | self.fired[k] | (self.halted & (roots[k] > 0))) & ~tip
        roots[k] = select(tip, 1, roots[k])
        if model.jumping or model.clocks:
            # An impact may carry the state across the surface, or off it, and a tick the surface across the state: the
            # switch follows at once.
            h0 = model.least(k, t, self.before)
            h1 = later.least(k, t, self.after)
            slack = jnp.max(later.rounding(lambda t, y: later.h(k, t, y), t, self.after, self.size))
            if model.clocks:  # time is shifted a little off a tick, to either side of it
                shift, still = 2 * (model.margin(t) + later.margin(t)), jax.tree.map(jnp.zeros_like, self.after)
                slack += jnp.max(later.sizes(lambda t, y: later.h(k, t, y), t, self.after, shift, still))
            moved, off = jnp.abs(h1 - h0) > slack, jnp.abs(h1) > slack
            mode = select(moved & off, jnp.sign(h1).astype(jnp.int32), mode)
            roots[k] = select(moved, 0, roots[k])
            here = select(moved, ~off, here)
            if model.clocks and self.parts[k] is not None:
                nearest = jnp.argmin(jnp.stack(later.h(k, t, self.after))).astype(jnp.int32)
                self.parts[k] = select(moved, nearest, self.parts[k])
        if model.conditional(k):
            # Where its contact closes it is met anew; where that stays open, the mode that it would have is dropped.
            anew = self.state.mode[k] == OFF
            h = jnp.stack(later.h(k, t, self.after))
            slack, part = later.rounding(lambda t, y: later.h(k, t, y), t, self.after, self.size), jnp.argmin(h)
            on = jnp.abs(h[part]) <= slack[part]
            mode = select(anew, select(on, 0, jnp.sign(h[part])).astype(jnp.int32), mode)
            roots[k], here = select(anew, 0, roots[k]), select(anew, on, here)
            if self.parts[k] is not None:
                self.parts[k] = select(anew, part.astype(jnp.int32), self.parts[k])
        self.modes[k], self.at[k] = mode, here

    def open_at_tick(self, k: int) -> None:
        """A gap that is a function of time may jump open at a tick, but not to the forbidden side."""
        if self.ticks is None:
            return
        later, t, after = self.later, self.t, self.after
        gaps = jnp.stack(later.h(k, t, after))
        slack = 1e4 * later.rounding(lambda t, y: later.h(k, t, y), t, after, self.size)
        self.result = RESULTS.where(self.ticks & jnp.any(gaps < -slack), RESULTS.jump_penetrates, self.result)
        self.modes[k] = select(self.ticks & jnp.all(gaps > slack), 0, self.modes[k])

    def come_to_rest(self) -> None:
        """Whether an impact ends in a state of rest, with all the ever shorter flights that would follow it."""
        # The geometric series is exact for a constant force. What the force changes within a flight of √eps of the time
        # passed moves the state by some eps; flights on from there would cost an event each, and have no digits left.
        model, t, state, jumped = self.model, self.t, self.mode_state(), self.after
        eps = jnp.finfo(t.dtype).eps
        brief = jnp.maximum(jnp.sqrt(eps) * (t - self.begin), 1e4 * eps * jnp.abs(t))
        for which in self.jumping():
            if which[0] in model.clocks:
                continue
            fired = ft.reduce(jnp.logical_or, [self.fired[k] for k in which])
            end = completed(self.gap(which, model), t, self.before, jumped, self.state, state)
            ends = fired & end.possible & ((end.flight <= brief) | end.low)
            self.t_after, self.after = jax.tree.map(
                lambda a, b, ends=ends: select(ends, a, b), (t + end.rest, end.y), (self.t_after, self.after)
            )
            self.result = RESULTS.where(fired & end.wrong, RESULTS.wrong_reset, self.result)
            fresh = select(end.stays, select(end.rises, 1, 2), 0)
            for k in which:
                if model.switches[k].unilateral:
                    self.roots[k] = select(self.fired[k], fresh, self.roots[k]).astype(jnp.int32)
                if k in model.contacts:
                    moved = self.set_in_motion(k, state, jumped, brief)
                    self.at[k] = (ends & self.fired[k]) | ((self.modes[k] == 1) & ~moved)
                else:
                    reached = ends & (self.result == RESULTS.successful)
                    self.result = RESULTS.where(reached, RESULTS.accumulation_reached, self.result)

    def set_in_motion(self, k: int, state: ModeState, y: Y, brief: Scalar) -> Bool[Array, ""]:
        """Whether another impact sets a resting contact in motion: it lifts off for more than a brief flight, or is hit
        at once."""
        later, t = self.later, self.t
        level = later.level(k, t, y, state)
        (slack,) = later.rounding(lambda t, y: (later.level(k, t, y, state),), t, y, self.size)
        free = state._replace(mode=tuple(select(j == k, 0, m) for j, m in enumerate(state.mode)))
        (pull,) = later.rates((k,), t, y, free, later.values(t, y, free))
        moved = level != self.model.level(k, t, self.before, state)
        moved = moved & (self.state.mode[k] == 1) & (jnp.abs(level) > 1e3 * slack)
        moved = moved & ((level < 0) | (2 * level > -pull * brief))
        self.modes[k] = select(moved, 0, self.modes[k])
        self.roots[k] = select(moved, (level > 0).astype(jnp.int32), self.roots[k])
        return moved

    def choose(self) -> tuple[ModeState, Bool[Array, ""]]:
        """The mode from here on, and whether another solution goes on in another one."""
        model, at = self.model, {k: self.at[k] for k in sorted(self.at)}
        # What cannot be held crosses when it fires, unless that is the residual of an event a few ulps earlier: dh/dt
        # tells.
        crosses = [now & ~(self.halted & (roots == 0)) for now, roots in zip(self.fired, self.state.roots)]
        # After a reset only dh/dt tells: it may turn the state back.
        crosses = [jnp.zeros_like(now) if s.jumps else now for now, s in zip(crosses, model.switches)]
        leaves = {
            k: self.bounds[k] if k in model.holdable else crosses[k].astype(jnp.int32) for k in range(len(crosses))
        }
        state, _, forked, wrong = settle(self.later, self.t_after, self.after, self.mode_state(), at, leaves)
        # Run backwards, what slides or rests is what solutions that run forwards leave or join there.
        for k in model.holdable:
            entered = model.held(k, state.mode[k]) & ~model.held(k, self.state.mode[k])
            forked = forked | (entered & (model.direction < 0))
        wrong = wrong & (self.result == RESULTS.successful)
        self.result = RESULTS.where(wrong, RESULTS.ambiguous_event, self.result)
        return self.released(state), forked

    def released(self, state: ModeState) -> ModeState:
        """Notes the roots of gaps of zero that friction has held and lets go: h, dh/dt and d²h/dt² vanish there."""
        later, t, y, roots = self.later, self.t_after, self.after, list(state.roots)
        for i, j in later.normal:
            k, friction = later.holdable[i], later.holdable[j]
            h, noise = later.least(k, t, y), jnp.max(later.rounding(lambda t, y, k=k: later.h(k, t, y), t, y))
            # Beside zero h has no rounding of its own: what it has is that of the way which forces make in the time.
            (rate,) = later.rates((k,), t, y, state, later.signs(t, state))
            drift = float(jnp.finfo(t.dtype).eps) * (t - self.begin) ** 2 * jnp.abs(rate)
            left = self.model.held(friction, self.state.mode[friction]) & ~later.held(friction, state.mode[friction])
            left = left & (state.mode[k] == 0) & (jnp.abs(h) <= 1e4 * (noise + drift))
            roots[k] = select(left, 3, roots[k]).astype(jnp.int32)
        return state._replace(roots=tuple(roots))

    def levels_just_passed(self, state: ModeState, after: Y) -> ModeState:
        """Notes the root of the level that ends the new mode, where it is the one just passed: a relay without
        hysteresis."""
        levels, roots = self.model.which("levels"), list(state.roots)
        if not levels:
            return state
        # The state has the rounding of the event's time, too.
        f = self.later.flow(self.t, after, state)
        size = frozen(jax.tree.map(lambda y, f: jnp.abs(y) + jnp.abs(self.t * f), after, f))
        for k in levels:
            own = tuple(s.switch == k for s in self.model.slots)

            def guard(t: Scalar, y: Y, own: tuple[bool, ...] = own) -> list[Scalar]:
                return self.later.guards(t, y, state, own)[own.index(True)]

            on_it = jnp.abs(guard(self.t, after)[0]) <= self.later.rounding(guard, self.t, after, size)[0]
            roots[k] = select(self.fired[k], on_it.astype(jnp.int32), roots[k])
        return state._replace(roots=tuple(roots))

    def jumped_to(self, state: ModeState, after: Y) -> Float[Array, " slots"]:
        """The guards after a tick, which may make one of them jump to just above zero; infinite where they say nothing
        of that."""
        later = self.later
        onto = later.stacked(later.guards(self.t, after, state), jnp.inf)[:, 0]
        single = jnp.asarray([not s.holding and later.parts[s.switch] == 1 for s in later.slots])
        fresh = (onto > 0) & single & (later.stacked(later.known_roots(state), 0)[:, 0] == 0)
        return select(fresh, onto, jnp.inf)
