"""The jump of an impact: one rebound, and the sum of all that follow up to rest."""

from collections.abc import Callable, Sequence
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.lax as lax
import jax.numpy as jnp
from jaxtyping import Array, Bool

from ..._numerics._autodiff import frozen
from ..._numerics._jaxpr import is_constant
from ..._numerics._linalg import linear_solve
from ..._numerics._select import select
from ..._types import Scalar, Y
from ...system._mode import ModeState, OFF, pick, put
from ...system._model import SwitchedSystem
from ...system._switch import ResettingSwitch


class Gap(eqx.Module):
    """The indicator function of a switch whose events reset the state, or of several impacts by Newton's law, of which
    one has `fired`.

    What the impact leads to is worked out once for the group: worked out for each contact, the program grew with the
    square of their number.
    """

    model: SwitchedSystem
    which: tuple[int, ...] = eqx.field(static=True)
    fired: tuple[Bool[Array, ""], ...]

    @classmethod
    def of(cls, model: SwitchedSystem, k: int) -> "Gap":
        return cls(model, (k,), (jnp.ones((), bool),))

    @property
    def switch(self) -> ResettingSwitch:
        switch = self.model.switches[self.which[0]]
        assert isinstance(switch, ResettingSwitch)
        return switch

    @property
    def closes(self) -> bool:
        """Whether the switch keeps h >= 0, as an impact does; a surface that is crossed does not."""
        return self.switch.unilateral

    def chosen(self, numbers: Sequence[Any]) -> Any:
        """Selects from `numbers`, one for each switch, that of the switch which has fired."""
        out = numbers[0]
        for now, number in zip(self.fired[1:], numbers[1:]):
            out = jax.tree.map(lambda a, b, now=now: select(now, a, b), number, out)
        return out

    def h(self, t: Scalar, y: Y) -> tuple[Scalar, ...]:
        return self.chosen([self.model.h(k, t, y) for k in self.which])

    def part(self, state: ModeState) -> Any:
        """The component that is active."""
        part = state.part[self.which[0]]
        return 0 if part is None else part

    def rate(self, t: Scalar, y: Y, state: ModeState, f: Y | None = None) -> Scalar:
        """dh/dt along the flow. `f`: the field there, if it is known."""
        f = self.model.flow(t, y, state) if f is None else f
        part = state.part[self.which[0]]
        return jax.jvp(lambda t, y: pick(self.h(t, y), part), (t, y), (jnp.ones_like(t), f))[1]

    def slow(self, t: Scalar, y: Y, state: ModeState, f: Y | None = None) -> Scalar:
        """Returns the size below which dh/dt along the flow is rounding."""
        gap, t, y = frozen((self, t, y))
        f = gap.model.flow(t, y, state) if f is None else frozen(f)
        terms = gap.model.sizes(gap.h, t, y, jnp.ones_like(t), f)
        return 64 * jnp.finfo(t.dtype).eps * terms[gap.part(state)]


def rebound(gap: Gap, t: Scalar, y: Y, state: ModeState) -> tuple[Y, Y]:
    """The state after an event, by the user's reset or by Newton's law with the impulse along ∂f/∂s; and the size of
    the terms of which it is the sum: where they cancel, what is left is their rounding.

    Contacts that rest take impulses of their own, as far as these push; friction that the contact force enters acts in
    the impact too, up to where it stops the sliding. Backwards in time Newton's law is inverted (1/e).
    """
    model, switch = gap.model, gap.switch
    if switch.reset_fn is not None:
        out = switch.reset_fn(model.system, model.time(t), y)
        if switch.inverse_fn is not None:
            undone = switch.inverse_fn(model.system, model.time(t), y)
            out = jax.tree.map(lambda a, b: select(model.direction > 0, a, b), out, undone)
        return out, jax.tree.map(lambda a, b: jnp.abs(a) + jnp.abs(b), y, out)
    fired, factors = dict(zip(gap.which, gap.fired)), []
    for k in gap.which:
        restitution = model.switches[k].restitution_fn
        assert restitution is not None
        factors.append(jnp.asarray(restitution(model.system), t.dtype))
    e = gap.chosen(factors)
    e = select(model.direction > 0, e, 1 / e)
    k, can_rest = gap.which[0], gap.which[0] in model.contacts
    which = (*gap.which, *[j for j in model.contacts if j not in gap.which and can_rest])

    def opening(y: Y) -> list[Scalar]:
        # Only dh/dt depends on the velocities, and for given positions it is affine in them.
        return model.levels(which, t, y, state) if can_rest else [model.approach(k, t, y, state)]

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
            none = jnp.zeros((), bool)
            hits = jnp.stack([fired.get(j, none) for j in which])
            want = -select(hits, 1 + e, 1) * jnp.stack(rates)
            matrix = jnp.stack([jnp.stack(g) for g in gains], axis=1)
            # Contacts can only push: a linear complementarity problem. What would pull is let go and not taken back, so
            # that there are no more rounds than contacts, a number that is known when the program is made.
            held = hits | jnp.stack([state.mode[j] == 1 for j in which])
            for _ in which[1:]:
                square = select(held[:, None] & held[None, :], matrix, jnp.eye(len(which), dtype=t.dtype))
                p = linear_solve(square, select(held, want, 0))
                held = held & ((p >= 0) | hits)  # no contact pulls
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
        its = fired.get(model.contact[j])  # whether it is there for the instant of the impact
        if its is not None:
            (noise,) = model.rounding(lambda t, y, j=j: (model.level(j, t, y, state),), t, y)
            off = its & (state.mode[j] == OFF)
            still = still | (off & (jnp.abs(begin) <= noise))
            s = put(s, (j,), (select(off, select(still, 0, jnp.sign(begin)), s[j]),))

        def slip(sj: Scalar, j: int = j, s: tuple = s) -> Scalar:
            return model.level(j, t, hit(put(s, (j,), (sj,)))[0], state)

        # Where friction would reverse the sliding it ends it: the value that does so is found by one Newton step.
        end, slope = jax.jvp(slip, (s[j],), (jnp.ones_like(s[j]),))
        stop = s[j] - end / select(slope == 0, 1, slope)
        new = select(~still & (begin * end < 0) & (slope != 0) & (jnp.abs(stop) <= 1), stop, s[j])
        if its is not None:  # what does not slide goes on so, as far as friction can keep it
            new = select(its & still & (state.mode[j] == OFF) & (slope != 0), jnp.clip(stop, -1, 1), new)
        s = put(s, (j,), (new,))
    return hit(s)


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


def completed(gap: Gap, te: Scalar, before: Y, after: Y, state: ModeState, state_after: ModeState) -> Completed:
    """Checks an impact, and sums the sequence of ever shorter flights that follows it up to its accumulation point.

    With the velocity h' after the impact, the acceleration h'' < 0 and the ratio r = -h'(t+)/h'(t-) < 1 the remaining
    flights last 2 h' / (-h'') (1 + r + r² + ...). For a surface that is crossed h is taken with the sign it has.
    """
    model, eps = gap.model, jnp.finfo(te.dtype).eps
    speed = gap.rate(te, before, state)
    rate, state_after = _away(gap, te, after, state_after)
    if not gap.closes:
        speed = speed * state.mode[gap.which[0]].astype(te.dtype)
    rise, pull, f = _departure(model, rate, te, after, state_after)
    (blur,) = model.rounding(lambda t, y: (_departure(model, rate, t, y, state_after)[1],), te, after)
    h = jnp.stack(gap.h(te, after))
    noise = model.rounding(gap.h, te, after)
    slack = 1e4 * noise + 2 * jnp.abs(jnp.stack(gap.h(te, before)))
    part = gap.part(state_after)
    stays = jnp.abs(h[part]) <= slack[part]
    least = 64 * eps * jnp.abs(speed) + gap.slow(te, after, state_after)
    wrong = stays & (rise < -jnp.maximum(1e-9 * jnp.abs(speed), least))
    if gap.closes:
        wrong = jnp.any(h < -slack) | wrong
    ratio = select(speed == 0, 0, -rise / select(speed == 0, 1, speed))
    rises = rise > least
    # Where the force is rounding too, rounding of dh/dt makes no flight.
    flight = 2 * (rise - select(rises, 0, lax.stop_gradient(rise))) / select(pull < 0, -pull, 1)
    held = stays & ~rises & (jnp.abs(pull) <= blur)  # without any force
    possible = stays & ~wrong & ((pull < 0) | held) & (ratio < 1)
    impulse = jax.tree.map(jnp.subtract, after, before)
    if gap.switch.reset_fn is not None:
        rest, rested = _rest_after_resets(gap, te, after, impulse, state_after, possible & rises)
    else:
        rest = select(possible, flight / (1 - select(possible, ratio, 0)), 0)
        drift = jax.tree.map(lambda x, f: x + rest * f, after, f)
        left, gain = jax.jvp(lambda y: rate(te, y), (drift,), (impulse,))
        scale = select(gain == 0, 0, left / select(gain == 0, 1, gain))
        rested = jax.tree.map(lambda x, d: x - scale * d, drift, impulse)
    low = 0.25 * flight * rise <= 1e3 * noise[part]
    return Completed(rises, flight, rest, rested, possible, low, stays, wrong)


def _away(gap: Gap, t: Scalar, y: Y, state: ModeState) -> tuple[Callable[[Scalar, Y], Scalar], ModeState]:
    """dh/dt as a function of time and state, counted positive away from the surface, and the mode of the flight that
    begins at `t`, `y`. (From a surface that is crossed it leads to the side to which h moves.)"""
    if gap.closes:
        return lambda t, y: gap.rate(t, y, state), state
    (k,), rate = gap.which, frozen(gap.rate(t, y, state))
    side = select(rate == 0, state.mode[k], jnp.sign(rate).astype(jnp.int32))
    state = state._replace(mode=put(state.mode, (k,), (side,)))
    return lambda t, y: side.astype(t.dtype) * gap.rate(t, y, state), state


def _departure(
    model: SwitchedSystem, rate: Callable[[Scalar, Y], Scalar], t: Scalar, y: Y, state: ModeState
) -> tuple[Scalar, Scalar, Y]:
    """dh/dt and d²h/dt² where a flight begins, and the field there."""
    f = model.flow(t, y, state)
    rise, pull = jax.jvp(rate, (t, y), (jnp.ones_like(t), f))
    return rise, pull, f


def _rest_after_resets(
    gap: Gap, t: Scalar, y: Y, impulse: Y, state: ModeState, wanted: Bool[Array, ""]
) -> tuple[Scalar, Y]:
    """Returns the duration of all flights that follow an event with a reset of the user's, and the state after them.

    The next two flights are made: the two sides of a surface that is crossed may differ. What they change is repeated
    in the ratio of the speeds before and after them. A component that the reset changes by as much each time (a
    counter, a sign) has no limit: it keeps the value that it has, apart from its drift. `impulse`: what the reset has
    just changed.
    """
    model, start, length, speeds = gap.model, y, jnp.zeros_like(t), []
    last = jax.tree.map(jnp.zeros_like, y)
    for _ in range(2):
        rate, state = _away(gap, t, y, state)
        rise, pull, f = _departure(model, rate, t, y, state)
        flight = 2 * rise / select(pull < 0, -pull, 1)
        landing = jax.tree.map(lambda x, f, flight=flight: x + flight * f, y, f)
        y = rebound(gap, t, landing, state)[0]
        last = jax.tree.map(jnp.subtract, y, landing)
        length = length + flight
        speeds.append(rise)
    rate, _ = _away(gap, t, y, state)
    ratio = rate(t, y) / select(wanted, speeds[0], 1)
    again = 1 / (1 - select(wanted & (ratio < 1), ratio, 0))
    rest = select(wanted, length * again, 0)

    def limit(x: Array, moved: Array, first: Array, last: Array, f: Array) -> Array:
        decays = jnp.abs(last - ratio * first) <= 0.5 * (1 - ratio) * jnp.abs(first)
        return x + select(wanted, select(decays, (moved - x) * again, rest * f), 0)

    return rest, jax.tree.map(limit, start, y, impulse, last, model.flow(t, start, state))
