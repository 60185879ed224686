"""One turn of the flow's loop: a step of a diffrax solver, or the work at an event.

Under `vmap` every lane is in its own mode and at its own time: it takes a step, or works on its event, and never waits
for the segments of the others.
"""

import dataclasses
import functools as ft
from collections.abc import Callable
from typing import Any, NamedTuple

import diffrax as dfx
import equinox as eqx
import jax
import jax.lax as lax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Int, PyTree

from .._numerics._autodiff import frozen
from .._numerics._barrier import once
from .._numerics._lane_cond import compact_cond
from .._numerics._select import select
from .._types import Scalar, Y
from ..system._mode import BEYOND, ModeState
from ..system._model import SwitchedSystem
from ._results import promoted, RESULTS
from ._save import Log, Saved
from .events._attraction import escapes
from .events._locate import Interval
from .events._transition import Transition, transition
from .steppers._sensitivity import largest_so_far, Sensed, trusted
from .steppers._stepper import stack, Step, Stepper, unresolved, Watch


class Carry(eqx.Module):
    """What one turn of the loop hands to the next."""

    t: Scalar
    y: Y
    f: Y  # the field at (t, y)
    state: ModeState
    dt: Scalar
    controller: PyTree
    active: Bool[Array, ""]
    result: RESULTS
    steps: Int[Array, ""]
    accepted: Int[Array, ""]
    events: Int[Array, ""]
    halted: Int[Array, ""]  # events in a row without progress in time
    halvings: Int[Array, ""]  # in a row, to resolve a guard
    crawled: Int[Array, ""]  # steps in a row of a few units in the last place of time
    swing: Scalar  # whose derivative is the largest of the state's so far
    grazed: Bool[Array, ""]  # whether an event was tangential
    forked: Bool[Array, ""]  # whether another solution sets out from the start too, or branches off on the way
    margin: Scalar  # the nearest that a guard came to zero without meeting it
    log: Log | None
    saved: Saved
    meter: PyTree


class _Attempt(NamedTuple):
    """A step of the solver, before it is known whether an event cuts it short."""

    step: Step
    keep: Bool[Array, ""]  # whether it is accepted
    dt: Scalar  # length of the next
    halvings: Int[Array, ""]
    controller: PyTree
    result: RESULTS
    busy: Bool[Array, ""]  # whether one of them may have a root
    touches: list[list[Bool[Array, ""]]]  # `[slot][part]`: whether it has one at the end of the solution


class Flow(eqx.Module):
    """One solve: the model, the method, and the body of its loop."""

    model: SwitchedSystem
    stepper: Stepper
    controller: dfx.AbstractStepSizeController
    t0: Scalar
    t1: Scalar
    max_steps: int = eqx.field(static=True)
    max_events: int = eqx.field(static=True)
    keep_steps: int = eqx.field(static=True)  # save every n-th step
    want_points: bool = eqx.field(static=True)
    still: bool = eqx.field(static=True)  # whether only the state at the end has derivatives
    meter: dfx.AbstractProgressMeter
    affine: tuple[bool, ...] = eqx.field(static=True)  # whether each guard is affine in (t, y)
    jumpy: tuple[bool, ...] = eqx.field(static=True)  # whether each guard holds an operation that may jump
    reverse: bool = eqx.field(static=True)  # whether the loop is to be transposed
    seen: tuple[tuple[int, ...], ...] = eqx.field(static=True)  # of many guards what they take notice of, or empty

    @property
    def bounded(self) -> bool:
        """Whether there are tolerances."""
        return hasattr(self.controller, "rtol") and hasattr(self.controller, "atol")

    @property
    def tolerance(self) -> tuple[Any, Any]:
        """Relative and absolute, of a step; NaN for steps of a given length."""
        return getattr(self.controller, "rtol", jnp.nan), getattr(self.controller, "atol", jnp.nan)

    @property
    def record(self) -> Callable[[Any], Any] | None:
        """What is done to what dense output is made of, if it is wanted."""
        if not self.want_points:
            return None
        return frozen if self.still else lambda tree: tree

    def land(self, step: Interval, touches: list) -> Transition:
        """The step once more, to its first event."""
        model = self.model.within(step.state.mode)
        *first, last = once(self.stepper.scaled(model, step.polynomials))
        polynomials = [*first, select(model.stacked(touches, False), jnp.minimum(last, 0), last)]
        step = step._replace(polynomials=polynomials, noise=model.stacked(step.noise, 0.0))
        return transition(model, self.stepper, self.tolerance, self.record, self.t0, self.seen, step)

    def attempt(self, c: Carry) -> _Attempt:
        """A step of the solver, its error against the tolerance, and whether a guard may have a root on it."""
        model, stepper = self.model.within(c.state.mode), self.stepper

        t_next = select(c.t + c.dt >= self.t1, self.t1, c.t + c.dt)
        tick = model.next_tick(c.state.mode) if model.clocks else jnp.inf
        if model.clocks:
            t_next = jnp.minimum(t_next, jnp.maximum(tick, c.t))
        step = stepper(model, c.state, c.t, t_next, c.y, c.f, Watch(self.affine, self.controller))
        if self.seen:  # of many guards, each of which several kernels would compute anew
            step = step._replace(guards=once(step.guards))
        t_next = step.t_next
        keep, dt, controller, outcome = self.pace(c, step)
        halvings, result, touches = c.halvings, promoted(outcome), []
        if step.fits is not True:
            result = RESULTS.where(step.fits, result, RESULTS.mode_not_affine)
        busy = jnp.zeros((), bool)
        if model.slots:
            known, touches = model.known_roots(c.state), self.touches(c, step)
            low = self.survey(step.guards, known)
            is_finite, quiet = low == low, low > 0
            result = RESULTS.where(keep & ~is_finite, RESULTS.nonfinite_field, result)
            # Why a step is shortened: the polynomial of a guard does not stand for it to the precision needed, and what
            # is found on it would mean nothing. Not for ever: a guard with a kink is never a polynomial, and on a step
            # so short that rounding of time spoils it no guard is.
            eps = float(jnp.finfo(c.t.dtype).eps)
            floor = 4 * eps / unresolved(c.t.dtype) * jnp.maximum(jnp.abs(c.t), self.t1 - self.t0)
            poor = ~step.resolved | _backward(step, known)
            poor, last = poor & keep & is_finite, (halvings >= 30) | (t_next - c.t <= floor)
            if any(self.jumpy):
                leaps = poor & last & self.leaps(model, c, step)
                result, keep = RESULTS.where(leaps, RESULTS.jump_in_time, result), keep & ~leaps
            poor = poor & ~last
            halvings = select(poor, halvings + 1, select(keep, 0, halvings))
            keep = keep & ~poor
            length = frozen(t_next - c.t)
            if step.reach is not None:  # the next must be resolved as well
                dt = jnp.minimum(dt, jnp.maximum(step.reach, select(poor, 0.1, 1)) * length)
            dt = select(poor, jnp.minimum(dt, 0.5 * length), dt)
            # On the last few ulps before the end the polynomials are rounding.
            ahead = t_next - c.t > 4 * eps * jnp.abs(c.t)
            if model.clocks:
                ahead = ahead | (t_next >= tick)
                # A step cut short by a tick says nothing against a longer one.
                dt = select(keep & (t_next >= tick), jnp.maximum(dt, c.dt), dt)
            touching = ft.reduce(jnp.logical_or, [part for row in touches for part in row])
            busy = c.active & keep & is_finite & ((~quiet & ahead) | touching)
        if self.reverse:
            # The derivatives of a rejected step that overflows are infinite or NaN, and so is zero times that.
            again = stepper(model, c.state, c.t, select(keep, t_next, c.t), c.y, c.f)
            step = step._replace(t_next=again.t_next, y1=again.y1, ks=again.ks, slope=again.slope)
        return _Attempt(step, keep & c.active, dt, halvings, controller, result, busy, touches)

    def touches(self, c: Carry, step: Step) -> list[list[Bool[Array, ""]]]:
        """Which guards fall to zero at the very end of the solution, apart from rounding of the time, of the step
        (whose weights are numbers of some tens), or of their own; and the ticks at which the step ends. (The time that
        is left until a tick is not zero there if a product and a difference are rounded as one.)"""
        length = frozen(step.t_next) - frozen(c.t)
        eps = float(jnp.finfo(length.dtype).eps)
        far = 4 * eps * jnp.abs(frozen(step.t_next)) / select(length > 0, length, 1) + 32 * eps

        def touches(c: list[Scalar], noise: Scalar) -> Bool[Array, ""]:
            value, slope = self.stepper.end(c)
            return (value > 0) & (slope < 0) & (value + far * slope <= noise)

        final = (step.t_next >= self.t1) & (length > 0)
        pairs = [zip(*rows) for rows in zip(frozen(step.guards), frozen(step.noise))]
        rows = [[final & touches(c, noise) for c, noise in row] for row in pairs]
        for i, slot in enumerate(self.model.slots):
            if slot.switch in self.model.clocks:
                tick = frozen(self.model.tick(slot.switch, c.state.mode))
                rows[i] = [step.t_next >= tick - 4 * eps * jnp.abs(tick)]
        return rows

    def pace(self, c: Carry, step: Step) -> tuple[Any, Any, PyTree, Any]:
        """Whether a step is accurate enough, the length of the next, and the controller's state and verdict."""
        model, t, t_next = self.model.within(c.state.mode), *frozen((c.t, step.t_next))
        terms = dfx.ODETerm(lambda t, y, args: model.flow(t, y, c.state))
        order = self.stepper.solver.error_order(terms)
        own = self.stepper.pace(self.controller, frozen(step), t, frozen(c.y), self.t1 - self.t0)
        if own is None:
            # An error that is NaN counts as too large.
            error = jax.tree.map(lambda e: select(jnp.isnan(e), jnp.inf, e), step.error)
            # The step size is no function to be differentiated; powers of an error of zero are not even differentiable.
            y, y1, error = frozen((c.y, step.y1, error))
            # A step that overflows is too long, but must not make the next one infinity divided by infinity.
            y1 = jax.tree.map(lambda new, old: select(jnp.isfinite(new), new, old), y1, y)
            keep, a, b, _, controller, outcome = self.controller.adapt_step_size(
                t, t_next, y, y1, None, error, order, c.controller
            )
            dt = b - a
        else:
            (keep, dt), controller, outcome = own, c.controller, dfx.RESULTS.successful
        estimate = self.stepper.estimate(step)
        if estimate is not None and self.bounded and not self.reverse:
            seen = Sensed(model, c.state, c.t, t_next - t, c.y, step.y1, estimate, c.swing, keep)
            far = trusted(seen, self.tolerance, order)
            keep, dt = keep & (far >= t_next - t), jnp.minimum(dt, 0.9 * far)
        return keep, dt, controller, outcome

    def leaps(self, model: SwitchedSystem, c: Carry, step: Step) -> Bool[Array, ""]:
        """Whether a guard that no step is short enough to resolve jumps: changes by far more than its derivatives at
        both ends of the step make it, and rounding. (One with a kink does not.)"""
        change = jax.tree.map(lambda a, b, f: jnp.abs(b - a) + jnp.abs(f * (step.t_next - c.t)), c.y, step.y1, c.f)
        found = jnp.zeros((), bool)
        for i in [i for i, jumps in enumerate(self.jumpy) if jumps]:
            wanted = tuple(j == i for j in range(len(self.jumpy)))

            def guard(t: Scalar, y: Y, i: int = i, wanted: tuple[bool, ...] = wanted) -> list[Scalar]:
                return model.guards(t, y, c.state, wanted)[i]

            ends = [(c.t, c.y), (step.t_next, step.y1)]
            before, after = (jnp.stack(guard(*end)) for end in ends)
            smooth = [model.sizes(guard, *end, step.t_next - c.t, change) + model.rounding(guard, *end) for end in ends]
            found = found | jnp.any(jnp.abs(after - before) > 1e3 * (smooth[0] + smooth[1]))
        return lax.stop_gradient(found)

    def survey(self, guards: list, known: list) -> Scalar:
        """A lower bound of the guards along the step, leaving out their known roots; NaN if any coefficient is not
        finite. Where it is positive no guard has a root: one of its parts is positive all along."""
        rows = [ft.reduce(jnp.maximum, map(self.stepper.least, row, roots)) for row, roots in zip(guards, known)]
        return once(ft.reduce(jnp.minimum, rows) + 0 * sum(c for row in guards for part in row for c in part))

    def arrive(self, c: Carry, attempt: _Attempt) -> Transition:
        """Where the step leads: to its end, or to the first event on it."""
        model = self.model.within(c.state.mode)
        step = attempt.step
        t, no = step.t_next, jnp.zeros((), bool)
        y_end = model.project(t, step.y1, c.state)
        points = None if self.record is None else stack(self.stepper.points(*self.record((c.y, step.y1, step.ks))))
        end = Transition(
            found=no,
            t=t,
            t_after=t,
            y_before=step.y1,
            y_after=y_end,
            f_after=model.flow(t, y_end, c.state) if step.slope is None else step.slope,
            state=c.state,
            slot=jnp.zeros((), jnp.int32),
            news=no,
            points=points,
            transversality=jnp.ones_like(t),
            grazes=no,
            # Beyond a two-fold, which is no event: its multiplier is 0/0.
            forked=no if model.steady else escapes(model, t, y_end, c.state),
            result=RESULTS.successful,
            margin=jnp.full_like(t, jnp.inf),
        )
        if not model.slots:
            return end
        here = Interval(c.t, t, c.y, c.f, c.state, lax.stop_gradient(step.guards), lax.stop_gradient(step.noise))
        there = _landed(attempt.busy, self, (here, attempt.touches), end)
        # A lane that looked for a root may have found none.
        event = attempt.busy & there.found
        near = select(attempt.busy, there.margin, jnp.inf)
        there = jax.tree.map(lambda a, b: select(event, a, b), there, end)._replace(margin=near)
        roots = list(there.state.roots)
        for k, r in enumerate(roots):
            later = select(jnp.abs(r) >= BEYOND, jnp.sign(r) * BEYOND, 0) if model.static(k) else 0
            roots[k] = select(event, r, later)
        return there._replace(state=there.state._replace(roots=tuple(roots)))

    def body(self, c: Carry) -> Carry:
        model = self.model
        step = self.attempt(c)
        there = self.arrive(c, step)
        event, result = there.found, step.result
        # What happened to this lane: an event, an accepted step, a rejected one, or nothing as it has ended.
        moved = step.keep | event
        events, halted, grazed, forked, log = c.events, c.halted, c.grazed, c.forked, c.log
        if model.slots:
            at, news = there.t_after * model.direction, event & there.news
            slot, mode = there.slot.astype(jnp.int32), jnp.stack(there.state.mode)
            row = (at, there.y_before, there.y_after, slot, mode, there.transversality)
            if log is not None:
                log = log.write(events, news, frozen(row) if self.still else row)
            grazed, forked = grazed | (event & there.grazes), forked | (moved & there.forked)
            events = events + news.astype(jnp.int32)
            halted = select(event, select(there.t > c.t, 0, halted + 1), select(step.keep, 0, halted))
            result = RESULTS.where(event & (result == RESULTS.successful), there.result, result)
            # Several events at one instant need not be chatter: an impact sets in motion what rested, which lets go of
            # something else. But each switch changes a few times only.
            result = RESULTS.where(halted > 8 + 4 * len(model.switches), RESULTS.stuck_in_events, result)
        accepted = c.accepted + moved.astype(jnp.int32)

        def choose(which: Any, new: Any, old: Any) -> Any:
            return jax.tree.map(lambda a, b: select(which, a, b), new, old)

        new = (there.t_after, there.y_after, there.f_after, there.state)
        t, y, f, state = choose(moved, new, (c.t, c.y, c.f, c.state))
        steps = c.steps + c.active.astype(jnp.int32)
        done = t >= self.t1
        if any(k.ends for k in model.switches):
            done = done | (event & there.news & self.ends(there))
        few = 16 * float(jnp.finfo(t.dtype).eps) * jnp.abs(c.t)
        crawled = select(event | (step.step.t_next - c.t > few), 0, c.crawled + 1)
        result = RESULTS.where((crawled > 64) & ~done, RESULTS.dt_min_reached, result)
        new = Carry(
            t=t,
            y=y,
            f=f,
            state=state,
            dt=choose(c.active, step.dt, c.dt),
            controller=choose(c.active, step.controller, c.controller),
            active=c.active,
            result=result,
            steps=steps,
            accepted=accepted,
            events=events,
            halted=halted,
            halvings=step.halvings,
            crawled=crawled,
            swing=largest_so_far(c.swing, c.y),
            grazed=grazed,
            forked=forked,
            margin=jnp.minimum(c.margin, select(c.active, there.margin, jnp.inf)),
            log=log,
            saved=self.save(c, there, moved, accepted),
            meter=c.meter,
        )
        result = self.verdict(c, new, step, moved, done)
        active = c.active & ~done & (result == RESULTS.successful)
        meter = self.meter.step(c.meter, select(active, (t - self.t0) / (self.t1 - self.t0), 1.0))
        return dataclasses.replace(new, active=active, result=result, meter=meter)

    def ends(self, there: Transition) -> Bool[Array, ""]:
        """Whether an event is one that ends the solution: of an impact, that is not a lift-off."""
        last = jnp.zeros((), bool)
        for i, slot in enumerate(self.model.slots):
            switch = self.model.switches[slot.switch]
            if switch.ends and not (slot.holding and slot.switch in self.model.contacts):
                mode = there.state.mode[slot.switch]
                wanted = jnp.stack([mode == value for value in switch.ends]).any()
                last = last | ((there.slot == i) & wanted)
        return last

    def save(self, c: Carry, there: Transition, moved: Bool[Array, ""], accepted: Int[Array, ""]) -> Saved:
        """What `saveat` asks for of this turn; at an event the states before and after it."""
        model, saved = self.model, c.saved
        if saved.request.ts is not None:
            saved = saved.write_times(moved, (c.t, there.t), there.points, c.state.mode, model, self.reverse)
        saved = saved.write_step(moved, c.accepted, c.t, there.t, there.points)
        if self.keep_steps:
            due = moved & ((accepted % self.keep_steps == 0) | there.found)
            saved = saved.write(due, there.t, there.y_before, c.state.mode, model)
            after = (there.t_after, there.y_after, there.state.mode)
            saved = saved.write(due & there.found, *after, model)
        return saved

    def verdict(self, c: Carry, new: Carry, step: _Attempt, moved: Bool[Array, ""], done: Bool[Array, ""]) -> RESULTS:
        """Whether the lane can go on."""
        t, result = new.t, new.result
        good = result == RESULTS.successful
        result = RESULTS.where((new.steps >= self.max_steps) & ~done & good, RESULTS.max_steps_reached, result)
        if self.model.slots:
            full = (new.events >= self.max_events) & ~done & (result == RESULTS.successful)
            result = RESULTS.where(full, RESULTS.max_events_reached, result)
        result = RESULTS.where(~finite((new.y, new.f)), RESULTS.nonfinite_field, result)
        # Rejected again and again, down to nothing: at a place where the field ends, or where it is too rough.
        least = 1e-6 * float(jnp.finfo(t.dtype).eps) * (self.t1 - self.t0)
        tiny = ~moved & ((t + step.dt <= t) | (step.dt <= least)) & (result == RESULTS.successful)
        ended = ~finite(step.step.y1)
        result = RESULTS.where(tiny & ended, RESULTS.nonfinite_field, result)
        result = RESULTS.where(tiny & ~ended, RESULTS.dt_min_reached, result)
        return RESULTS.where(c.active, result, c.result)


def _backward(step: Step, known: list) -> Bool[Array, ""]:
    """Whether a guard that has just left a double root seems to fall from there. It rises, but at a loose tolerance its
    polynomial need not tell."""
    wrong = jnp.zeros((), bool)
    for row, noises, counts in zip(step.guards, step.noise, known):
        for c, noise, roots in zip(row, noises, counts):
            for r in (2, 3)[: len(c) - 2]:
                clear = ft.reduce(jnp.maximum, map(jnp.abs, c[r:])) > noise
                wrong = wrong | ((roots == r) & (c[r] < 0) & clear)
    return once(select(wrong, 1.0, 0.0)) > 0


def finite(tree: Any) -> Bool[Array, ""]:
    """Whether all numbers are finite: only then are all of their products with zero."""
    return once(sum(jnp.sum(0 * x) for x in jax.tree.leaves(tree))) == 0


def _landed(pred: Any, flow: Flow, here: tuple, default: Transition) -> Transition:
    """`flow.land(*here)` for lanes with work to do, else `default`."""
    dynamic, static = eqx.partition((flow, here), eqx.is_array)
    dynamic_default, static_default = eqx.partition(default, eqx.is_array)

    def branch(dynamic: Any) -> Any:
        flow, here = eqx.combine(dynamic, static)
        return eqx.filter(flow.land(*here), eqx.is_array)

    if flow.reverse:  # `compact_cond` has no rule for transposition
        return eqx.combine(lax.cond(pred, branch, lambda _: dynamic_default, dynamic), static_default)
    landed = compact_cond(pred, branch, (dynamic,), dynamic_default, flow.stepper.group)
    return eqx.combine(landed, static_default)
