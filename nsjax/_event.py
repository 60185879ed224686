"""Work at an event: where exactly it is, and what the state and the mode are afterwards."""

from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.lax as lax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int

from ._crossing import first_root
from ._filippov import Model, State
from ._solution import RESULTS
from ._step import stack, Stepper
from ._system import frozen, impact, relay, sgn
from ._types import Scalar, Y


class Landing(NamedTuple):
    """A step that ends at an event, and how the solution goes on."""

    found: Bool[Array, ""]
    t: Scalar  # of the event
    t_after: Scalar  # the same, but for an accumulation of impacts that was completed
    y_before: Y
    y_after: Y
    f_after: Y
    state: State
    slot: Int[Array, ""]
    news: Bool[Array, ""]  # whether anything changed, so that it belongs into the log
    points: Y | None  # control points of the step to the event, if asked for
    result: RESULTS


def _step_to(te: Scalar, stepper: Stepper, args: tuple) -> tuple[Y, list[Y]]:
    model, t, y, f0, state, _, _ = args
    y_end, _, increments, _ = stepper(lambda t, y: model.flow(t, y, state), t, te, y, f0)
    return y_end, increments


def _guard(te: Scalar, y: Y, args: tuple) -> Scalar:
    model, _, _, _, state, slot, part = args
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
    model, state = args[0], args[4]
    moved = eqx.filter_jvp(lambda args: _step_to(te, stepper, args)[0], (args,), (tangents[3],))[1]
    moved = jax.tree.map(lambda y, d: jnp.zeros_like(y) if d is None else d, y_end, moved)
    change = eqx.filter_jvp(lambda y, args: _guard(te, y, args), (y_end, args), (moved, tangents[3]))[1]
    change = jnp.zeros_like(te) if change is None else change
    f = model.flow(te, y_end, state)
    slope = jax.jvp(lambda t, y: _guard(t, y, args), (te, y_end), (jnp.ones_like(te), f))[1]
    shift = -change / slope
    return (te, y_end), (shift, jax.tree.map(lambda d, f: d + f * shift, moved, f))


def locate(
    model: Model,
    stepper: Stepper,
    t: Scalar,
    t_next: Scalar,
    y: Y,
    f0: Y,
    state: State,
    coefficients: Float[Array, "slots parts coefficients"],
) -> tuple[Bool[Array, ""], Scalar, Y, list[Y], Int[Array, ""], Int[Array, ""]]:
    """The earliest event of a step: its time, the state there, the slot and the part of the guard that fires.

    The root on the dense output is only where to look: the step is taken again to it, and one Newton step with the true
    field corrects the time, and with it the order of events closer than the dense output can tell. The state follows by
    its Taylor series to second order, so that what remains is of third order in the (small) error of the dense output.
    """
    found, root = jax.vmap(first_root)(coefficients)
    root = jnp.where(found, root, jnp.inf)
    earliest = jnp.min(root)
    args = (model, t, y, f0, state)
    frozen_model, start, y_start, f_start, _ = frozen(args)
    length = lax.stop_gradient(t_next) - start
    guess = start + jnp.minimum(earliest, 1) * length

    def flow(t: Scalar, y: Y) -> Y:
        return frozen_model.flow(t, y, state)

    def guards(t: Scalar, y: Y) -> Array:
        return model.stacked(frozen_model.guards(t, y, state), -1.0)

    y_guess, _, increments, _ = stepper(flow, start, guess, y_start, f_start)
    f = flow(guess, y_guess)
    one = jnp.ones_like(guess)
    values, rates = jax.jvp(guards, (guess, y_guess), (one, f))
    part = jnp.argmax(values, axis=-1)
    value = jnp.take_along_axis(values, part[:, None], axis=-1)[:, 0]
    rate = jnp.take_along_axis(rates, part[:, None], axis=-1)[:, 0]
    shift = -value / jnp.where(rate == 0, 1, rate)
    plain = (root - earliest) * length
    trusted = (rate < 0) & (jnp.abs(shift) <= 1e-2 * length) & (plain <= 1e-4 * length)
    shift = jnp.where(trusted, shift, plain)
    slot = jnp.argmin(jnp.where(found, shift, jnp.inf)).astype(jnp.int32)
    te = jnp.clip(guess + shift[slot], start, start + length)
    dt = te - guess
    bend = jax.jvp(flow, (guess, y_guess), (one, f))[1]
    y_end = jax.tree.map(lambda y, f, b: y + dt * (f + 0.5 * dt * b), y_guess, f, bend)
    te, y_end = _arrival(te, y_end, stepper, (*args, slot, part[slot]))
    # At the very start of the step the event is a consequence of the one before: it has the same time and derivative.
    at_once = jnp.isfinite(root[slot]) & (root[slot] <= 0)
    te, y_end = jax.tree.map(lambda a, b: jnp.where(at_once, a, b), (t, y), (te, y_end))
    return jnp.any(found), te, y_end, increments, slot, part[slot]


def _rate(model: Model, k: int, t: Scalar, y: Y, state: State) -> Scalar:
    """dh/dt of an impact surface along the flow (the active component of h)."""
    return model._rates((k,), t, y, state, model.values(t, y, state))[0]


def _derivative(model: Model, fn: Any, t: Scalar, y: Y, state: State) -> Scalar:
    """d/dt of `fn(t, y)` along the flow."""
    return jax.jvp(fn, (t, y), (jnp.ones_like(t), model.flow(t, y, state)))[1]


def rebound(model: Model, k: int, t: Scalar, y: Y, state: State) -> Y:
    """The state after an impact: the user's reset, or Newton's law with the impulse along ∂f/∂s.

    Backwards in time Newton's law is inverted (1/e).
    """
    switch = model.switches[k]
    assert isinstance(switch, impact)
    if switch.reset_fn is not None:
        return switch.reset_fn(model.system, t * model.direction, y)
    assert switch.restitution_fn is not None
    e = jnp.asarray(switch.restitution_fn(model.system), t.dtype)
    e = jnp.where(model.direction > 0, e, 1 / e)
    s = model.values(t, y, state)
    unit = tuple(jnp.where(i == k, 1, 0).astype(t.dtype) for i in range(len(s)))
    push = jax.jvp(lambda s: model.field(t, y, s), (s,), (unit,))[1]
    # Only h' depends on the velocities, and for given positions it is affine in them.
    rate, gain = jax.jvp(lambda y: _rate(model, k, t, y, state), (y,), (push,))
    return jax.tree.map(lambda a, b: a - (1 + e) * rate / gain * b, y, push)


def land(
    model: Model,
    stepper: Stepper,
    want_points: bool,
    t_start: Scalar,
    t: Scalar,
    t_next: Scalar,
    y: Y,
    f0: Y,
    state: State,
    coefficients: Float[Array, "slots parts coefficients"],
) -> Landing:
    """Locates the earliest event of a step and makes the transition there."""
    found, te, before, increments, slot, part = locate(model, stepper, t, t_next, y, f0, state, coefficients)
    halted = te <= t
    fired = {k: jnp.zeros((), bool) for k in range(len(model.switches))}
    bounds = {k: jnp.zeros((), jnp.int32) for k in range(len(model.switches))}
    tip = dict(fired)
    parts, roots, modes = list(state.part), list(state.roots), list(state.mode)
    for i, (k, number, sliding) in enumerate(model.slots):
        now = slot == i
        if sliding:
            bounds[k] = jnp.where(now, number, bounds[k])
            continue
        fired[k] = fired[k] | now
        if parts[k] is not None:
            tip[k] = tip[k] | (now & (state.mode[k] == 0)) if isinstance(model.switches[k], sgn) else tip[k]
            parts[k] = jnp.where(now, jnp.where(state.mode[k] < 0, part.astype(jnp.int32), number), parts[k])

    result = RESULTS.successful
    after, at = before, {}
    for k, switch in enumerate(model.switches):
        roots[k] = jnp.where(halted, roots[k], 0)
        if isinstance(switch, relay):
            modes[k] = jnp.where(fired[k], 1 - modes[k], modes[k])
        elif isinstance(switch, impact):
            hit = rebound(model, k, te, before, state._replace(part=tuple(parts)))
            after = jax.tree.map(lambda a, b, now=fired[k]: jnp.where(now, a, b), hit, after)
    for k, switch in enumerate(model.switches):
        if isinstance(switch, sgn):
            # The end of a surface at its tip leads into h < 0.
            modes[k] = jnp.where(tip[k], -1, modes[k])
            here = ((state.mode[k] == 0) | fired[k] | (halted & (roots[k] > 0))) & ~tip[k]
            roots[k] = jnp.where(tip[k], 1, roots[k])
            if any(isinstance(other, impact) for other in model.switches):
                # A reset may carry the state across the surface, or off it: the switch follows at once.
                h0 = jnp.min(jnp.stack(model.h(k, te, before)))
                h1 = jnp.min(jnp.stack(model.h(k, te, after)))
                moved = h0 != h1
                modes[k] = jnp.where(moved, jnp.sign(h1).astype(jnp.int32), modes[k])
                roots[k] = jnp.where(moved, 0, roots[k])
                here = (here & ~moved) | (moved & (h1 == 0))
            at[k] = here
    state_after = State(tuple(m.astype(jnp.int32) for m in modes), tuple(parts), tuple(roots))
    # What cannot slide crosses when it fires, but for the residual of an event a few ulps earlier, which dh/dt tells.
    crosses = {k: fired[k] & ~(halted & (state.roots[k] == 0)) for k in fired}
    bounds = {k: b if k in model.slidable else crosses[k].astype(jnp.int32) for k, b in bounds.items()}
    state_after, _, wrong = model.settle(te, after, state_after, at, bounds)
    result = RESULTS.where(wrong, RESULTS.ambiguous_event, result)

    t_after, roots = te, list(state_after.roots)
    guards = model.guards(te, after, state_after) if any(isinstance(s, relay) for s in model.switches) else None
    for k, switch in enumerate(model.switches):
        if isinstance(switch, relay):
            # Its new surface may be the one just crossed (no hysteresis): then its root here is known.
            assert guards is not None
            first = next(i for i, s in enumerate(model.slots) if s.switch == k)
            noise = model.rounding(lambda t, y, first=first: (model.guards(t, y, state_after)[first][0],), te, after)[0]
            roots[k] = jnp.where(fired[k], (jnp.abs(guards[first][0]) <= noise).astype(jnp.int32), roots[k])
        elif isinstance(switch, impact):
            t_after, after, roots[k], failed = _rebounded(
                model, k, fired[k], t_start, te, before, state, t_after, after, state_after, roots[k]
            )
            result = RESULTS.where(failed == 1, RESULTS.wrong_reset, result)
            result = RESULTS.where(failed == 2, RESULTS.accumulation_reached, result)
    state_after = state_after._replace(roots=tuple(roots))
    news = jnp.zeros((), bool)
    for k, switch in enumerate(model.switches):
        news = news | (fired[k] if isinstance(switch, impact) else state_after.mode[k] != state.mode[k])
    points = stack(stepper.points(y, before, increments)) if want_points else None
    f_after = model.flow(t_after, after, state_after)
    return Landing(found, te, t_after, before, after, f_after, state_after, slot, news, points, result)


def _rebounded(
    model: Model,
    k: int,
    fired: Bool[Array, ""],
    t_start: Scalar,
    te: Scalar,
    before: Y,
    state: State,
    t_after: Scalar,
    after: Y,
    state_after: State,
    roots: Int[Array, ""],
) -> tuple[Scalar, Y, Int[Array, ""], Int[Array, ""]]:
    """Checks an impact, and ends a sequence of ever shorter flights at its accumulation point.

    With the velocity h' after the impact, the acceleration h'' < 0 and the ratio r = -h'(t+)/h'(t-) < 1 the remaining
    flights last 2 h' / (-h'') (1 + r + r² + ...).
    """

    def rate(t: Scalar, y: Y) -> Scalar:
        return _rate(model, k, t, y, state_after)

    speed = _rate(model, k, te, before, state)
    rise = rate(te, after)
    pull = _derivative(model, rate, te, after, state_after)
    h = jnp.stack(model.h(k, te, after))
    noise = model.rounding(lambda t, y: model.h(k, t, y), te, after)
    slack = 1e4 * noise + 2 * jnp.abs(jnp.stack(model.h(k, te, before)))
    part = 0 if state_after.part[k] is None else state_after.part[k]
    stays = jnp.abs(h[part]) <= slack[part]  # on its surface: a reset of the user's own may carry the state off it
    wrong = fired & (jnp.any(h < -slack) | (stays & (rise < -1e-9 * jnp.abs(speed))))

    ratio = jnp.where(speed == 0, 0, -rise / jnp.where(speed == 0, 1, speed))
    flight = 2 * rise / -pull
    short = flight <= jnp.sqrt(jnp.finfo(te.dtype).eps) * (te - t_start)
    ends = fired & stays & ~wrong & (pull < 0) & (ratio < 1) & short
    rest = jnp.where(ends, flight / (1 - ratio), 0)
    drift = jax.tree.map(lambda x, f: x + rest * f, after, model.flow(te, after, state_after))
    impulse = jax.tree.map(jnp.subtract, after, before)
    left, gain = jax.jvp(lambda y: rate(te, y), (drift,), (impulse,))
    scale = jnp.where(gain == 0, 0, left / jnp.where(gain == 0, 1, gain))
    settled = jax.tree.map(lambda x, d: x - scale * d, drift, impulse)
    after = jax.tree.map(lambda a, b: jnp.where(ends, a, b), settled, after)
    simple = rise > 0
    roots = jnp.where(fired, jnp.where(stays, jnp.where(simple, 1, 2), 0), roots).astype(jnp.int32)
    return t_after + rest, after, roots, jnp.where(wrong, 1, jnp.where(ends, 2, 0))
