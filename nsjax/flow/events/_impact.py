"""The jump of an impact: one rebound, and the sum of all that follow up to rest."""

from collections.abc import Callable
from typing import NamedTuple

import jax
import jax.lax as lax
import jax.numpy as jnp
from jaxtyping import Array, Bool

from ..._numerics._autodiff import frozen
from ..._numerics._jaxpr import is_constant
from ..._numerics._linalg import linear_solve
from ..._numerics._select import select
from ..._types import Scalar, Y
from ...system._impact import impact
from ...system._mode import ModeState, OFF, put
from ...system._model import SwitchedSystem
from ...system._switch import ResettingSwitch


def rebound(model: SwitchedSystem, k: int, t: Scalar, y: Y, state: ModeState) -> tuple[Y, Y]:
    """The state after an impact, by the user's reset or by Newton's law with the impulse along ∂f/∂s; and the size of
    the terms of which it is the sum: where they cancel, what is left is their rounding.

    Contacts that rest take impulses of their own, as far as these push; friction that the contact force enters acts in
    the impact too, up to where it stops the sliding. Backwards in time Newton's law is inverted (1/e).
    """
    switch = model.switches[k]
    if isinstance(switch, ResettingSwitch) and switch.reset_fn is not None:
        out = switch.reset_fn(model.system, model.time(t), y)
        if switch.inverse_fn is not None:
            undone = switch.inverse_fn(model.system, model.time(t), y)
            out = jax.tree.map(lambda a, b: select(model.direction > 0, a, b), out, undone)
        return out, jax.tree.map(lambda a, b: jnp.abs(a) + jnp.abs(b), y, out)
    assert isinstance(switch, impact) and switch.restitution_fn is not None
    e = jnp.asarray(switch.restitution_fn(model.system), t.dtype)
    e = select(model.direction > 0, e, 1 / e)
    which = (k, *[j for j in model.contacts if j != k and k in model.contacts])
    takes_part = jnp.stack([jnp.ones((), bool)] + [state.mode[j] == 1 for j in which[1:]])

    def opening(y: Y) -> list[Scalar]:
        # Only dh/dt depends on the velocities, and for given positions it is affine in them.
        return [model.approach(k, t, y, state)] if k not in model.contacts else model.levels(which, t, y, state)

    def hit(s: tuple) -> tuple[Y, Y]:
        def push(j: int) -> Y:
            unit = tuple(select(i == j, 1, 0).astype(t.dtype) for i in range(len(s)))
            return jax.jvp(lambda s: model.field(t, y, s), (s,), (unit,))[1]

        pushes = [push(j) for j in which]
        rates = opening(y)
        gains = [jax.jvp(opening, (y,), (p,))[1] for p in pushes]
        if len(which) == 1:
            impulses = [-(1 + e) * rates[0] / gains[0][0]]
        else:
            want = jnp.stack([-(1 + e) * rates[0]] + [-r for r in rates[1:]])
            matrix = jnp.stack([jnp.stack(g) for g in gains], axis=1)
            # Contacts can only push: a linear complementarity problem. What would pull is let go and not taken back, so
            # that there are no more rounds than contacts, a number that is known when the program is made.
            held = takes_part
            for _ in which[1:]:
                square = select(held[:, None] & held[None, :], matrix, jnp.eye(len(which), dtype=t.dtype))
                p = linear_solve(square, select(held, want, 0))
                held = held & ((p >= 0) | (jnp.arange(len(which)) == 0))  # no contact pulls
            square = select(held[:, None] & held[None, :], matrix, jnp.eye(len(which), dtype=t.dtype))
            impulses = list(linear_solve(square, select(held, want, 0)))
        out, size = y, jax.tree.map(jnp.abs, y)
        for p, direction in zip(impulses, pushes):
            out = jax.tree.map(lambda a, b, p=p: a + p * b, out, direction)
            size = jax.tree.map(lambda a, b, p=p: a + jnp.abs(p * b), size, direction)
        return out, frozen(size)

    s = model.values(t, y, state)
    for j in model.holdable:
        if j in model.contacts or is_constant(lambda sj, j=j, s=s: hit(put(s, (j,), (sj,)))[0], s[j]):
            continue

        begin, still = model.level(j, t, y, state), state.mode[j] == 0
        if model.contact[j] == k:  # it is there for the instant of the impact
            (noise,) = model.rounding(lambda t, y, j=j: (model.level(j, t, y, state),), t, y)
            still = still | ((state.mode[j] == OFF) & (jnp.abs(begin) <= noise))
            s = put(s, (j,), (select(state.mode[j] == OFF, select(still, 0, jnp.sign(begin)), s[j]),))

        def slip(sj: Scalar, j: int = j, s: tuple = s) -> Scalar:
            return model.level(j, t, hit(put(s, (j,), (sj,)))[0], state)

        # Where friction would reverse the sliding it ends it: the value that does so is found by one Newton step.
        end, slope = jax.jvp(slip, (s[j],), (jnp.ones_like(s[j]),))
        stop = s[j] - end / select(slope == 0, 1, slope)
        new = select(~still & (begin * end < 0) & (slope != 0) & (jnp.abs(stop) <= 1), stop, s[j])
        if model.contact[j] == k:  # what does not slide goes on so, as far as friction can keep it
            new = select(still & (state.mode[j] == OFF) & (slope != 0), jnp.clip(stop, -1, 1), new)
        s = put(s, (j,), (new,))
    return hit(s)


def slow(model: SwitchedSystem, k: int, t: Scalar, y: Y, state: ModeState, f: Y | None = None) -> Scalar:
    """What rounding can make of dh/dt of switch k along the flow. `f`: the field there, if it is known."""
    model, t, y = frozen((model, t, y))
    f = model.flow(t, y, state) if f is None else frozen(f)
    terms = model.sizes(lambda t, y: model.h(k, t, y), t, y, jnp.ones_like(t), f)
    return 64 * jnp.finfo(t.dtype).eps * terms[0 if state.part[k] is None else state.part[k]]


class Completed(NamedTuple):
    """What an impact leads to: a flight, or with all the flights that would follow it a state of rest."""

    rises: Bool[Array, ""]  # whether dh/dt > 0 after the impact, by more than rounding
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
    flights last 2 h' / (-h'') (1 + r + r² + ...). For a surface that is crossed h is taken with the sign it has.
    """
    eps = jnp.finfo(te.dtype).eps
    speed = model.approach(k, te, before, state)
    rate, state_after = _away(model, k, te, after, state_after)
    if not isinstance(model.switches[k], impact):
        speed = speed * state.mode[k].astype(te.dtype)
    rise, pull, f = _departure(model, rate, te, after, state_after)
    (blur,) = model.rounding(lambda t, y: (_departure(model, rate, t, y, state_after)[1],), te, after)
    h = jnp.stack(model.h(k, te, after))
    noise = model.rounding(lambda t, y: model.h(k, t, y), te, after)
    slack = 1e4 * noise + 2 * jnp.abs(jnp.stack(model.h(k, te, before)))
    part = 0 if state_after.part[k] is None else state_after.part[k]
    stays = jnp.abs(h[part]) <= slack[part]
    least = 64 * eps * jnp.abs(speed) + slow(model, k, te, after, state_after)
    wrong = stays & (rise < -jnp.maximum(1e-9 * jnp.abs(speed), least))
    if isinstance(model.switches[k], impact):
        wrong = jnp.any(h < -slack) | wrong
    ratio = select(speed == 0, 0, -rise / select(speed == 0, 1, speed))
    rises = rise > least
    # Where the force is rounding too, rounding of dh/dt makes no flight.
    flight = 2 * (rise - select(rises, 0, lax.stop_gradient(rise))) / select(pull < 0, -pull, 1)
    held = stays & ~rises & (jnp.abs(pull) <= blur)  # without any force
    possible = stays & ~wrong & ((pull < 0) | held) & (ratio < 1)
    impulse = jax.tree.map(jnp.subtract, after, before)
    switch = model.switches[k]
    if isinstance(switch, ResettingSwitch) and switch.reset_fn is not None:
        rest, rested = _rest_after_resets(model, k, te, after, impulse, state_after, possible & rises)
    else:
        rest = select(possible, flight / (1 - select(possible, ratio, 0)), 0)
        drift = jax.tree.map(lambda x, f: x + rest * f, after, f)
        left, gain = jax.jvp(lambda y: rate(te, y), (drift,), (impulse,))
        scale = select(gain == 0, 0, left / select(gain == 0, 1, gain))
        rested = jax.tree.map(lambda x, d: x - scale * d, drift, impulse)
    low = 0.25 * flight * rise <= 1e3 * noise[part]
    return Completed(rises, flight, rest, rested, possible, low, stays, wrong)


def _away(
    model: SwitchedSystem, k: int, t: Scalar, y: Y, state: ModeState
) -> tuple[Callable[[Scalar, Y], Scalar], ModeState]:
    """dh/dt as a function of time and state, counted positive away from the surface, and the mode of the flight that
    begins at `t`, `y`. (From a surface that is crossed it leads to the side to which h moves.)"""
    if isinstance(model.switches[k], impact):
        return lambda t, y: model.approach(k, t, y, state), state
    rate = frozen(model.approach(k, t, y, state))
    side = select(rate == 0, state.mode[k], jnp.sign(rate).astype(jnp.int32))
    state = state._replace(mode=put(state.mode, (k,), (side,)))
    return lambda t, y: side.astype(t.dtype) * model.approach(k, t, y, state), state


def _departure(
    model: SwitchedSystem, rate: Callable[[Scalar, Y], Scalar], t: Scalar, y: Y, state: ModeState
) -> tuple[Scalar, Scalar, Y]:
    """dh/dt and d²h/dt² where a flight begins, and the field there."""
    f = model.flow(t, y, state)
    rise, pull = jax.jvp(rate, (t, y), (jnp.ones_like(t), f))
    return rise, pull, f


def _rest_after_resets(
    model: SwitchedSystem, k: int, t: Scalar, y: Y, impulse: Y, state: ModeState, wanted: Bool[Array, ""]
) -> tuple[Scalar, Y]:
    """How long all flights together last that follow an event with a reset of the user's, and the state after them.

    The next two flights are made: the two sides of a surface that is crossed may differ. What they change is repeated
    in the ratio of the speeds before and after them. A component that the reset changes by as much each time (a
    counter, a sign) has no limit: it keeps the value that it has, apart from its drift. `impulse`: what the reset has
    just changed.
    """
    start, length, speeds = y, jnp.zeros_like(t), []
    last = jax.tree.map(jnp.zeros_like, y)
    for _ in range(2):
        rate, state = _away(model, k, t, y, state)
        rise, pull, f = _departure(model, rate, t, y, state)
        flight = 2 * rise / select(pull < 0, -pull, 1)
        landing = jax.tree.map(lambda x, f, flight=flight: x + flight * f, y, f)
        y = rebound(model, k, t, landing, state)[0]
        last = jax.tree.map(jnp.subtract, y, landing)
        length = length + flight
        speeds.append(rise)
    rate, _ = _away(model, k, t, y, state)
    ratio = rate(t, y) / select(wanted, speeds[0], 1)
    again = 1 / (1 - select(wanted & (ratio < 1), ratio, 0))
    rest = select(wanted, length * again, 0)

    def limit(x: Array, moved: Array, first: Array, last: Array, f: Array) -> Array:
        decays = jnp.abs(last - ratio * first) <= 0.5 * (1 - ratio) * jnp.abs(first)
        return x + select(wanted, select(decays, (moved - x) * again, rest * f), 0)

    return rest, jax.tree.map(limit, start, y, impulse, last, model.flow(t, start, state))
