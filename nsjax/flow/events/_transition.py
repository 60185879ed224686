"""Work at an event: where exactly it is, and what the state and the mode are afterwards."""

from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.flatten_util as jfu
import jax.lax as lax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int

from ..._numerics._autodiff import frozen
from ..._numerics._barrier import once
from ..._numerics._bernstein import at, bend, deflate, falls, first_root, largest
from ..._numerics._jaxpr import is_constant
from ..._numerics._linalg import linear_solve
from ..._types import Scalar, Y
from ...system._model import ModeState, SwitchedSystem
from ...system._system import clock, impact, relay, sgn
from .._results import RESULTS
from ..steppers._stepper import stack, Stepper
from ._mode_choice import settle


class Landing(NamedTuple):
    """A step that ends at an event, and how the solution goes on."""

    found: Bool[Array, ""]
    t: Scalar  # of the event
    t_after: Scalar  # the same, but for an accumulation of impacts that was completed: its time
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


def _step_to(te: Scalar, stepper: Stepper, args: tuple) -> tuple[Y, list[Y]]:
    model, t, y, f0, state, *_ = args
    step = stepper(model, state, t, te, y, f0)
    return step.y1, step.ks


def _guard(te: Scalar, y: Y, args: tuple) -> Scalar:
    model, _, _, _, state, slot, part, _ = args
    return model.stacked(model.guards(te, y, state), -1.0)[slot, part]


@eqx.filter_custom_jvp
def _arrival(te: Scalar, y_end: Y, stepper: Stepper, args: Any) -> tuple[Scalar, Y]:
    """The time of an event and the state there, differentiated by the implicit rule.

    With g the guard that fires, dte = -dg / (dg/dt along the flow), where dg is its change at fixed time; the state
    moves along the flow by dte. The rule refers to this function again, so that derivatives of every order are right.
    At a tangency dg/dt = 0 and they are infinite, as they should be.
    """
    return te, y_end


@_arrival.def_jvp
def _arrival_jvp(primals: Any, tangents: Any) -> tuple[tuple[Scalar, Y], tuple[Scalar, Y]]:
    te, y_end, stepper, args = primals
    te, y_end = _arrival(te, y_end, stepper, args)
    model, state, found = args[0], args[4], args[7]
    moved = eqx.filter_jvp(lambda args: _step_to(te, stepper, args)[0], (args,), (tangents[3],))[1]
    moved = jax.tree.map(lambda y, d: jnp.zeros_like(y) if d is None else d, y_end, moved)
    change = eqx.filter_jvp(lambda y, args: _guard(te, y, args), (y_end, args), (moved, tangents[3]))[1]
    change = jnp.zeros_like(te) if change is None else change
    f = model.flow(te, y_end, state)
    slope = jax.jvp(lambda t, y: _guard(t, y, args), (te, y_end), (jnp.ones_like(te), f))[1]
    shift = -change / jnp.where(found, slope, 1)
    return (te, y_end), (shift, jax.tree.map(lambda d, f: d + f * shift, moved, f))


def locate(
    model: SwitchedSystem,
    stepper: Stepper,
    t: Scalar,
    t_next: Scalar,
    y: Y,
    f0: Y,
    state: ModeState,
    polynomials: list[Float[Array, "slots parts"]],
    noise: Float[Array, "slots parts"],
) -> tuple[Bool[Array, ""], Scalar, Y, Int[Array, ""], Int[Array, " slots"], Float[Array, " slots"]]:
    """The earliest event of a step: whether there is one, its time, the state there, the slot of the guard that fires,
    and of each guard the part that is active there. Without an event they are those of the guard that comes nearest to
    zero and rises again. And the least value of each guard that does so before the event, infinite of others.

    The root on the dense output is only where to look: the step is taken again to it, and one Newton step with the true
    field corrects the time, and with it the order of events closer than the dense output can tell. The state follows by
    its Taylor series to second order, so that what remains is of third order in the (small) error of the dense output.
    """
    known = model.stacked(model.known_roots(state), 0)
    # In the same search where each guard is least: what comes near to zero, and does not meet it, is told.
    single = jnp.asarray([slot.switch not in model.clocks and model.parts[slot.switch] == 1 for slot in model.slots])
    first = jnp.arange(known.shape[1]) == 0
    lows = [jnp.where(first, x, -1.0) for x in falls(polynomials)]
    both = [jnp.concatenate(pair) for pair in zip(deflate(polynomials, known), lows)]
    (found, turns), (root, low) = (jnp.split(x, 2) for x in jax.vmap(first_root)(both))
    single = single & (known[:, 0] == 0)
    turns = turns & (low > 0) & single
    args = (model, t, y, f0, state)
    frozen_model, start, y_start, f_start, _ = frozen(args)

    def flow(t: Scalar, y: Y) -> Y:
        return frozen_model.flow(t, y, state)

    def guards(t: Scalar, y: Y) -> Array:
        return model.stacked(frozen_model.guards(t, y, state), -1.0)

    # A multiplier that stays at its bound, or a guard which begins with a double root, has no sign if it does not rise
    # above rounding on the whole step.
    least = jnp.asarray([0 if slot.holding else 2 for slot in model.slots], known.dtype)[:, None]
    found = found & ~jnp.any((once(largest(polynomials)) <= noise) & (known >= least), axis=-1)
    root = jnp.where(found, root, jnp.inf)
    earliest = jnp.min(root)
    length = lax.stop_gradient(t_next) - start
    met = jnp.any(found)
    dips = jnp.where(turns & (low < earliest), at(polynomials, low)[:, 0], jnp.inf)
    nearest = jnp.argmin(dips / once(largest(polynomials))[:, 0])
    guess = start + jnp.where(met, jnp.minimum(earliest, 1), jnp.where(turns[nearest], low[nearest], 1)) * length

    y_guess = stepper(frozen_model, state, start, guess, y_start, f_start).y1
    f = flow(guess, y_guess)
    one = jnp.ones_like(guess)
    values, rates = jax.jvp(guards, (guess, y_guess), (one, f))
    part = jnp.argmax(values, axis=-1)
    value = jnp.take_along_axis(values, part[:, None], axis=-1)[:, 0]
    rate = jnp.take_along_axis(rates, part[:, None], axis=-1)[:, 0]
    shift = -value / jnp.where(rate == 0, 1, rate)
    # Where no root was found too the arithmetic must be of numbers: going backwards zero times that is not none.
    plain = jnp.where(found, root - earliest, 0) * length
    trusted = (rate < 0) & (jnp.abs(shift) <= 1e-2 * length) & (plain <= 1e-4 * length)
    shift = jnp.where(trusted, shift, plain)
    # Of events at one instant the first in the order of declaration: as long as no guard has fallen below its rounding.
    blur = jnp.take_along_axis(noise, part[:, None], axis=-1)[:, 0] / jnp.where(rate == 0, 1, jnp.abs(rate))
    latest = jnp.min(jnp.where(found, shift + jnp.where(trusted, blur, 0), jnp.inf))
    slot = jnp.where(met, jnp.argmax(found & (shift <= latest)), nearest).astype(jnp.int32)
    # The dense output tells how near that comes; without an event the step leads to the nearest of them itself.
    missed = jnp.where(~met & (jnp.arange(len(dips)) == nearest) & (dips < jnp.inf), value, dips)
    if model.clocks:  # at a tick a guard may jump away from zero as it comes to it
        ticks = met & jnp.asarray([k in model.clocks for k, _, _ in model.slots])[slot]
        falls_on = ticks & single & (value > 0) & (rate < 0)
        missed = jnp.where(falls_on, jnp.minimum(missed, value), missed)
    te = jnp.clip(guess + shift[slot], start, start + length)
    dt = te - guess
    bend = jax.jvp(flow, (guess, y_guess), (one, f))[1]
    y_end = jax.tree.map(lambda y, f, b: y + dt * (f + 0.5 * dt * b), y_guess, f, bend)
    te, y_end = _arrival(te, y_end, stepper, (*args, slot, part[slot], met))
    # At the very start of the step the event is a consequence of the one before: it has the same time and derivative.
    at_once = jnp.isfinite(root[slot]) & (root[slot] <= 0)
    te, y_end = jax.tree.map(lambda a, b: jnp.where(at_once, a, b), (t, y), (te, y_end))
    return met, te, y_end, slot, part, missed


def rebound(model: SwitchedSystem, k: int, t: Scalar, y: Y, state: ModeState) -> tuple[Y, Y]:
    """The state after an impact, by the user's reset or by Newton's law with the impulse along ∂f/∂s; and the size of
    the terms of which it is the sum: where they cancel, what is left is their rounding.

    Contacts that rest take impulses of their own, as far as these push; friction that the contact force enters acts in
    the impact too, up to where it stops the sliding. Backwards in time Newton's law is inverted (1/e).
    """
    switch = model.switches[k]
    assert isinstance(switch, impact)
    if switch.reset_fn is not None:
        out = switch.reset_fn(model.system, model.time(t), y)
        if switch.inverse_fn is not None:
            undone = switch.inverse_fn(model.system, model.time(t), y)
            out = jax.tree.map(lambda a, b: jnp.where(model.direction > 0, a, b), out, undone)
        return out, jax.tree.map(lambda a, b: jnp.abs(a) + jnp.abs(b), y, out)
    assert switch.restitution_fn is not None
    e = jnp.asarray(switch.restitution_fn(model.system), t.dtype)
    e = jnp.where(model.direction > 0, e, 1 / e)
    which = (k, *[j for j in model.contacts if j != k and k in model.contacts])
    takes_part = jnp.stack([jnp.ones((), bool)] + [state.mode[j] == 1 for j in which[1:]])

    def opening(y: Y) -> list[Scalar]:
        # Only dh/dt depends on the velocities, and for given positions it is affine in them.
        return [model.level(j, t, y, state) if j in model.contacts else model.approach(j, t, y, state) for j in which]

    def hit(s: tuple) -> tuple[Y, Y]:
        def push(j: int) -> Y:
            unit = tuple(jnp.where(i == j, 1, 0).astype(t.dtype) for i in range(len(s)))
            return jax.jvp(lambda s: model.field(t, y, s), (s,), (unit,))[1]

        pushes = [push(j) for j in which]
        rates = opening(y)
        gains = [jax.jvp(opening, (y,), (p,))[1] for p in pushes]
        if len(which) == 1:
            impulses = [-(1 + e) * rates[0] / gains[0][0]]
        else:
            want = jnp.stack([-(1 + e) * rates[0]] + [-r for r in rates[1:]])
            matrix = jnp.stack([jnp.stack(g) for g in gains], axis=1)
            held = takes_part
            for _ in which[1:]:
                square = jnp.where(held[:, None] & held[None, :], matrix, jnp.eye(len(which), dtype=t.dtype))
                p = linear_solve(square, jnp.where(held, want, 0))
                held = held & ((p >= 0) | (jnp.arange(len(which)) == 0))  # no contact pulls
            square = jnp.where(held[:, None] & held[None, :], matrix, jnp.eye(len(which), dtype=t.dtype))
            impulses = list(linear_solve(square, jnp.where(held, want, 0)))
        out, size = y, jax.tree.map(jnp.abs, y)
        for p, direction in zip(impulses, pushes):
            out = jax.tree.map(lambda a, b, p=p: a + p * b, out, direction)
            size = jax.tree.map(lambda a, b, p=p: a + jnp.abs(p * b), size, direction)
        return out, frozen(size)

    s = model.values(t, y, state)
    for j in model.holdable:
        if j in model.contacts or is_constant(lambda sj, j=j: hit(s[:j] + (sj,) + s[j + 1 :])[0], s[j]):
            continue

        def slip(sj: Scalar, j: int = j) -> Scalar:
            return model.level(j, t, hit(s[:j] + (sj,) + s[j + 1 :])[0], state)

        # Where friction would reverse the sliding it ends it: the value that does so is found by one Newton step.
        end, slope = jax.jvp(slip, (s[j],), (jnp.ones_like(s[j]),))
        reverses = (state.mode[j] != 0) & (model.level(j, t, y, state) * end < 0) & (slope != 0)
        stop = s[j] - end / jnp.where(slope == 0, 1, slope)
        s = s[:j] + (jnp.where(reverses & (jnp.abs(stop) <= 1), stop, s[j]),) + s[j + 1 :]
    return hit(s)


def land(
    model: SwitchedSystem,
    stepper: Stepper,
    tolerance: tuple[Any, Any],
    want_points: bool,
    t_start: Scalar,
    t: Scalar,
    t_next: Scalar,
    y: Y,
    f0: Y,
    state: ModeState,
    polynomials: list[Float[Array, "slots parts"]],
    noise: Float[Array, "slots parts"],
) -> Landing:
    """Locates the earliest event of a step and makes the transition there."""
    found, te, before, slot, active, missed = locate(model, stepper, t, t_next, y, f0, state, polynomials, noise)
    part = active[slot]
    ticks = jnp.asarray([k in model.clocks for k, _, _ in model.slots])[slot] if model.clocks else None
    if ticks is not None:  # to the last digit
        te = te + lax.stop_gradient(jnp.where(ticks, model.next_tick(state.mode) - te, 0))
    if model.holdable:
        before = model.project(te, before, state)  # what leaves a surface must do so from there, and not from beside it
    halted = te <= t
    fired = {k: jnp.zeros((), bool) for k in range(len(model.switches))}
    bounds = {k: jnp.zeros((), jnp.int32) for k in range(len(model.switches))}
    tip = dict(fired)
    parts, roots, modes = list(state.part), list(state.roots), list(state.mode)
    for i, (k, number, holding) in enumerate(model.slots):
        now = slot == i
        if holding:
            bounds[k] = jnp.where(now, number, bounds[k])
            continue
        fired[k] = fired[k] | now
        if parts[k] is not None:
            tip[k] = tip[k] | (now & (state.mode[k] == 0)) if isinstance(model.switches[k], sgn) else tip[k]
            parts[k] = jnp.where(now, jnp.where(state.mode[k] < 0, part.astype(jnp.int32), number), parts[k])

    result = RESULTS.successful
    after, size = before, jax.tree.map(jnp.abs, before)
    for k, switch in enumerate(model.switches):
        roots[k] = jnp.where(halted, roots[k], 0)
        if isinstance(switch, relay):
            modes[k] = jnp.where(fired[k], 1 - modes[k], modes[k])
        elif isinstance(switch, clock):
            modes[k] = jnp.where(fired[k], modes[k] + jnp.where(model.direction > 0, 1, -1), modes[k])
        elif isinstance(switch, impact):
            touching = state._replace(part=tuple(parts))
            # Another impact at this instant may have opened it: then h < 0 is rounding.
            opens = fired[k] & (model.approach(k, te, before, touching) > slow(model, k, te, before, touching))
            roots[k] = jnp.where(opens, 1, roots[k])
            fired[k] = fired[k] & ~opens
            hit = rebound(model, k, te, before, touching)
            after, size = jax.tree.map(lambda a, b, now=fired[k]: jnp.where(now, a, b), hit, (after, size))
    later = model.within(tuple(modes))  # at a tick what depends on time is another function from now on
    at = {}
    for k, switch in enumerate(model.switches):
        if isinstance(switch, sgn):
            # The end of a surface at its tip leads into h < 0.
            modes[k] = jnp.where(tip[k], -1, modes[k])
            here = ((state.mode[k] == 0) | fired[k] | (halted & (roots[k] > 0))) & ~tip[k]
            roots[k] = jnp.where(tip[k], 1, roots[k])
            if any(isinstance(other, (impact, clock)) for other in model.switches):
                # An impact may carry the state across the surface, or off it, and a tick the surface across the state:
                # the switch follows at once.
                h0 = jnp.min(jnp.stack(model.h(k, te, before)))
                h1 = jnp.min(jnp.stack(later.h(k, te, after)))
                slack = jnp.max(later.rounding(lambda t, y, k=k: later.h(k, t, y), te, after, size))
                if model.clocks:  # time is shifted a little off a tick, to either side of it
                    shift, still = 2 * (model.margin(te) + later.margin(te)), jax.tree.map(jnp.zeros_like, after)
                    slack += jnp.max(later.sizes(lambda t, y, k=k: later.h(k, t, y), te, after, shift, still))
                moved, off = jnp.abs(h1 - h0) > slack, jnp.abs(h1) > slack
                modes[k] = jnp.where(moved & off, jnp.sign(h1).astype(jnp.int32), modes[k])
                roots[k] = jnp.where(moved, 0, roots[k])
                here = jnp.where(moved, ~off, here)
                if model.clocks and parts[k] is not None:
                    nearest = jnp.argmin(jnp.stack(later.h(k, te, after))).astype(jnp.int32)
                    parts[k] = jnp.where(moved, nearest, parts[k])
            at[k] = here
        elif isinstance(switch, impact) and ticks is not None:
            gaps = jnp.stack(later.h(k, te, after))
            slack = 1e4 * later.rounding(lambda t, y, k=k: later.h(k, t, y), te, after, size)
            result = RESULTS.where(ticks & jnp.any(gaps < -slack), RESULTS.jump_penetrates, result)
            modes[k] = jnp.where(ticks & jnp.all(gaps > slack), 0, modes[k])
    state_after = ModeState(tuple(m.astype(jnp.int32) for m in modes), tuple(parts), tuple(roots))

    t_after, jumped = te, after
    for k, switch in enumerate(model.switches):
        if not isinstance(switch, impact):
            continue
        end = completed(model, k, te, before, jumped, state, state_after)
        eps = jnp.finfo(te.dtype).eps
        brief = jnp.maximum(jnp.sqrt(eps) * (te - t_start), 1e4 * eps * jnp.abs(te))
        ends = fired[k] & end.possible & ((end.flight <= brief) | end.low)
        t_after, after = jax.tree.map(
            lambda a, b, ends=ends: jnp.where(ends, a, b), (te + end.rest, end.y), (t_after, after)
        )
        result = RESULTS.where(fired[k] & end.wrong, RESULTS.wrong_reset, result)
        fresh = jnp.where(end.stays, jnp.where(end.rises, 1, 2), 0)
        roots[k] = jnp.where(fired[k], fresh, roots[k]).astype(jnp.int32)
        if k in model.contacts:
            # Another impact may set a resting contact in motion: it lifts off for more than a brief flight, or is hit
            # at once.
            level = later.level(k, te, jumped, state_after)
            (slack,) = later.rounding(lambda t, y, k=k: (later.level(k, t, y, state_after),), te, jumped, size)
            free = state_after._replace(mode=tuple(jnp.where(j == k, 0, m) for j, m in enumerate(state_after.mode)))
            (pull,) = later.rates((k,), te, jumped, free, later.values(te, jumped, free))
            moved = level != model.level(k, te, before, state_after)
            moved = moved & (state.mode[k] == 1) & (jnp.abs(level) > 1e3 * slack)
            moved = moved & ((level < 0) | (2 * level > -pull * brief))
            modes[k] = jnp.where(moved, 0, modes[k])
            roots[k] = jnp.where(moved, (level > 0).astype(jnp.int32), roots[k])
            at[k] = ends | ((modes[k] == 1) & ~moved)
        else:
            result = RESULTS.where(ends & (result == RESULTS.successful), RESULTS.accumulation_reached, result)
    at = {k: at[k] for k in sorted(at)}
    state_after = ModeState(tuple(m.astype(jnp.int32) for m in modes), tuple(parts), tuple(roots))
    # What cannot be held crosses when it fires, but for the residual of an event a few ulps earlier, which dh/dt tells.
    crosses = {k: fired[k] & ~(halted & (state.roots[k] == 0)) for k in fired}
    bounds = {k: b if k in model.holdable else crosses[k].astype(jnp.int32) for k, b in bounds.items()}
    state_after, _, forked, wrong = settle(later, t_after, after, state_after, at, bounds)
    # Run backwards, what slides or rests is what solutions that run forwards leave or join there.
    for k in model.holdable:
        entered = model.held(k, state_after.mode[k]) & ~model.held(k, state.mode[k])
        forked = forked | (entered & (model.direction < 0))
    result = RESULTS.where(wrong & (result == RESULTS.successful), RESULTS.ambiguous_event, result)
    if model.contacts:
        after = later.project(t_after, after, state_after)

    roots = list(state_after.roots)
    for k, switch in enumerate(model.switches):
        if isinstance(switch, relay):
            # Its new surface may be the one just crossed (no hysteresis): then its root here is known.
            own = tuple(s.switch == k for s in model.slots)

            def guard(t: Scalar, y: Y, own: tuple[bool, ...] = own) -> list[Scalar]:
                return later.guards(t, y, state_after, own)[own.index(True)]

            on_it = jnp.abs(guard(te, after)[0]) <= later.rounding(guard, te, after)[0]
            roots[k] = jnp.where(fired[k], on_it.astype(jnp.int32), roots[k])
    state_after = state_after._replace(roots=tuple(roots))
    news = jnp.zeros((), bool)
    for k, switch in enumerate(model.switches):
        news = news | (state_after.mode[k] != state.mode[k])
        if isinstance(switch, impact):
            news = news | fired[k]
    cosines, slack = transversality(model, te, before, state, active, tolerance)
    cosine = cosines[slot]
    if ticks is not None:
        cosine = jnp.where(ticks, 1, cosine)
        # A guard may also jump to just above zero.
        onto = later.stacked(later.guards(te, after, state_after), jnp.inf)[:, 0]
        fresh = ticks & (onto > 0) & jnp.asarray([not s.holding and model.parts[s.switch] == 1 for s in model.slots])
        fresh = fresh & (later.stacked(later.known_roots(state_after), 0)[:, 0] == 0)
        missed = jnp.where(fresh, jnp.minimum(missed, onto), missed)
    bends = bend([a[slot, part] for a in polynomials], (te - t) / jnp.where(halted, 1, t_next - t)) > 0
    grazes = found & news & ~halted & bends & (cosine < jnp.cbrt(jnp.finfo(te.dtype).eps))
    cosine = jnp.where(grazes, 0, cosine)  # as it counts from here on
    points = None
    if want_points:
        # Once more, to the very event and with the derivatives of where it begins and ends.
        _, increments = _step_to(te, stepper, (model, t, y, f0, state))
        points = stack(stepper.points(y, before, increments))
    f_after = later.flow(t_after, after, state_after)
    return Landing(
        found,
        te,
        t_after,
        before,
        after,
        f_after,
        state_after,
        slot,
        news,
        points,
        cosine,
        grazes,
        forked,
        result,
        jnp.min(jnp.where(missed < jnp.inf, missed / slack, jnp.inf)),
    )


def transversality(
    model: SwitchedSystem, t: Scalar, y: Y, state: ModeState, part: Int[Array, " slots"], tolerance: Any
) -> tuple[Float[Array, " slots"], Float[Array, " slots"]]:
    """Of each guard the cosine between the trajectory and the normal of its surface, in time and state; and what an
    error of the state within the tolerance (relative, absolute) makes of it."""
    model, t, y = frozen((model, t, y))
    flat, unravel = jfu.ravel_pytree(y)

    def guards(t: Scalar, x: Array) -> Float[Array, " slots"]:
        return model.stacked(model.guards(t, unravel(x), state), -1.0)[np.arange(len(model.slots)), part]

    h_t, n = jax.jacfwd(guards, argnums=(0, 1))(t, flat)
    rtol, atol = tolerance
    f = jfu.ravel_pytree(model.flow(t, y, state))[0]
    return jax.vmap(cosine, (0, 0, None))(h_t, n, f), jnp.abs(n) @ (atol + rtol * jnp.abs(flat))


def cosine(h_t: Scalar, n: Float[Array, " n"], f: Float[Array, " n"]) -> Scalar:
    """Between the trajectory and the normal (h_t, n) of a surface."""
    size = (n @ n + h_t**2) * (f @ f + jnp.where(h_t == 0, 0, 1))
    return jnp.abs(n @ f + h_t) / jnp.sqrt(size)


def slow(model: SwitchedSystem, k: int, t: Scalar, y: Y, state: ModeState) -> Scalar:
    """What rounding can make of dh/dt of switch k along the flow."""
    model, t, y = frozen((model, t, y))
    f = model.flow(t, y, state)
    terms = model.sizes(lambda t, y: model.h(k, t, y), t, y, jnp.ones_like(t), f)
    return 64 * jnp.finfo(t.dtype).eps * terms[0 if state.part[k] is None else state.part[k]]


class Completed(NamedTuple):
    """What an impact leads to: a flight, or with all the flights that would follow it a state of rest."""

    rises: Bool[Array, ""]  # whether dh/dt > 0 after the impact, but for rounding
    flight: Scalar  # how long the next flight lasts
    rest: Scalar  # how long all flights together last
    y: Y  # the state after all of them
    possible: Bool[Array, ""]  # whether the flights become ever shorter
    low: Bool[Array, ""]  # whether the next one rises so little above the rounding of h that its end is uncertain
    stays: Bool[Array, ""]  # on the surface: a reset of the user's own may carry the state off it
    wrong: Bool[Array, ""]  # whether the reset leads to the forbidden side


def completed(
    model: SwitchedSystem, k: int, te: Scalar, before: Y, after: Y, state: ModeState, state_after: ModeState
) -> Completed:
    """Checks an impact, and sums the sequence of ever shorter flights that follows it up to its accumulation point.

    With the velocity h' after the impact, the acceleration h'' < 0 and the ratio r = -h'(t+)/h'(t-) < 1 the remaining
    flights last 2 h' / (-h'') (1 + r + r² + ...).
    """

    def rate(t: Scalar, y: Y) -> Scalar:
        return model.approach(k, t, y, state_after)

    one, eps = jnp.ones_like(te), jnp.finfo(te.dtype).eps
    speed = model.approach(k, te, before, state)
    rise = rate(te, after)
    f = model.flow(te, after, state_after)
    pull = jax.jvp(rate, (te, after), (one, f))[1]
    (blur,) = model.rounding(lambda t, y: (jax.jvp(rate, (t, y), (one, model.flow(t, y, state_after)))[1],), te, after)
    h = jnp.stack(model.h(k, te, after))
    noise = model.rounding(lambda t, y: model.h(k, t, y), te, after)
    slack = 1e4 * noise + 2 * jnp.abs(jnp.stack(model.h(k, te, before)))
    part = 0 if state_after.part[k] is None else state_after.part[k]
    stays = jnp.abs(h[part]) <= slack[part]
    least = 64 * eps * jnp.abs(speed) + slow(model, k, te, after, state_after)
    wrong = jnp.any(h < -slack) | (stays & (rise < -jnp.maximum(1e-9 * jnp.abs(speed), least)))
    ratio = jnp.where(speed == 0, 0, -rise / jnp.where(speed == 0, 1, speed))
    rises = rise > least
    # Rounding of dh/dt, where the force is but rounding too, is no flight.
    flight = 2 * (rise - jnp.where(rises, 0, lax.stop_gradient(rise))) / jnp.where(pull < 0, -pull, 1)
    held = stays & ~rises & (jnp.abs(pull) <= blur)  # without any force
    possible = stays & ~wrong & ((pull < 0) | held) & (ratio < 1)
    rest = jnp.where(possible, flight / (1 - jnp.where(possible, ratio, 0)), 0)
    drift = jax.tree.map(lambda x, f: x + rest * f, after, f)
    impulse = jax.tree.map(jnp.subtract, after, before)
    left, gain = jax.jvp(lambda y: rate(te, y), (drift,), (impulse,))
    scale = jnp.where(gain == 0, 0, left / jnp.where(gain == 0, 1, gain))
    rested = jax.tree.map(lambda x, d: x - scale * d, drift, impulse)
    low = 0.25 * flight * rise <= 1e3 * noise[part]
    return Completed(rises, flight, rest, rested, possible, low, stays, wrong)
