"""The choice of mode where switches are at their surfaces."""

import itertools
from typing import Any

import jax
import jax.lax as lax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Int

from ._filippov import Model, State
from ._system import frozen
from ._types import Scalar, Y


_TRIED = 4  # so many switches at their surfaces are settled by trying every assignment


def settle(
    model: Model,
    t: Scalar,
    y: Y,
    state: State,
    at: dict[int, Bool[Array, ""]],
    leaves: dict[int, Int[Array, ""]],
) -> tuple[State, Bool[Array, ""], Bool[Array, ""], Bool[Array, ""]]:
    """Gives every `sgn` switch that is at its surface a mode from {0, +1, -1}, every contact one from {1, 0}.

    All of them hold if that is valid (|λ| <= b, a contact force λ >= 0), else as many as can be. Of up to four
    switches every assignment is tried; of those that hold as many the one that keeps what held before is taken, and if
    that is not one alone either, the solution is not unique. Of more, the one that
    violates its law most is released, to the sign of its λ, and a released switch whose motion then opposes this is
    taken back, until nothing is violated.

    **Arguments:**

    - `state`: the mode so far; a `sgn` switch that arrived at its surface still has the sign of the side it came from,
        and one whose side is unknown has 0.
    - `at`: for each `sgn` switch whether it is at its surface, for each contact whether it rests there (dh/dt = 0).
    - `leaves`: for each switch the sign with which its λ just reached its bound, else 0.

    **Returns:** the new state; whether a side must be chosen (a repulsive surface (2.25) met without one); whether one
    was chosen by rule, see `forks`; and whether not exactly one assignment was found.
    """
    model, t, y = frozen((model, t, y))  # modes have no derivative
    which = tuple(at)
    false = jnp.zeros((), bool)
    if not which:
        return state, false, false, false
    mode = dict(enumerate(state.mode))
    came = {k: mode[k] for k in which}

    def look(mode: dict[int, Any]) -> tuple[dict, dict, dict]:
        trial = state._replace(mode=tuple(mode.values()))
        s = model.values(t, y, trial)
        rates = dict(zip(which, model.rates(which, t, y, trial, s)))
        slopes = {k: jnp.zeros((), t.dtype) for k in which}
        if model.holdable:
            _, matrix = model.linear(t, y, trial, s)
            slopes |= {k: matrix[i, i] for i, k in enumerate(model.holdable)}
        return {k: s[k] for k in which}, rates, slopes

    # First guess: everything at its surface is held, unless its surface repels or its value does not act on it.
    trial = dict(mode)
    for k in which:
        if k in model.contacts:
            trial[k] = jnp.where(at[k], jnp.where(leaves[k] != 0, 0, 1), mode[k])
        elif k in model.holdable:
            trial[k] = jnp.where(at[k], 0, mode[k])
    s, rates, slopes = look(trial)
    noise = _noise(model, t, y, state, which, s)
    repels = {k: slopes[k] >= 0 for k in which}
    forked = false
    for k in which:
        if k in model.holdable and k not in model.contacts:
            forked = forked | (at[k] & (came[k] != 0) & (leaves[k] == 0) & forks(model, k, s[k], slopes[k]))
    for k in which:
        if k in model.contacts:
            continue
        if k in model.holdable:
            # A repulsive surface is left to the other side: beyond |λ| = 1 both fields point there.
            forced = jnp.where(repels[k], -leaves[k], leaves[k])
            passes = repels[k] & (came[k] != 0) & ~_grips(model, k, s[k])
            trial[k] = jnp.where(at[k] & (forced != 0), forced, jnp.where(at[k] & passes, -came[k], trial[k]))
        else:
            unmoved = jnp.where(came[k] == 0, 1, came[k])
            side = jnp.where(rates[k] == 0, unmoved, jnp.sign(rates[k]).astype(jnp.int32))
            # It cannot but cross; at a double root the sign of dh/dt is rounding.
            side = jnp.where((leaves[k] != 0) & (came[k] != 0), -came[k], side)
            trial[k] = jnp.where(at[k], side, mode[k])
    if 1 < len(which) <= _TRIED:
        trial, several, wrong = _best(model, t, which, at, came, leaves, trial, look, noise)
        forked = forked | several
    elif len(which) == 1:
        trial, wrong = _amend(model, which, at, leaves, trial, look(trial), noise)[0], false
    else:
        # A bound that is reached together with that of another switch is left with it, not in a second event.
        leaves = dict(leaves)
        for k in which:
            if k in model.holdable and k not in model.contacts:
                over = s[k] * came[k].astype(t.dtype) / model.bound(k) - 1
                tied = at[k] & (came[k] != 0) & ~repels[k] & (leaves[k] == 0) & (jnp.abs(over) <= nearly(t))
                leaves[k] = jnp.where(tied, came[k], leaves[k])
                trial[k] = jnp.where(tied, came[k], trial[k])

        # One release or taking back a round, until nothing is violated; so many rounds do for all to change twice.
        def amend(carry: tuple) -> tuple:
            count, trial, _ = carry
            return count + 1, *_amend(model, which, at, leaves, trial, look(trial), noise)

        def unsettled(carry: tuple) -> Bool[Array, ""]:
            count, _, wrong = carry
            return wrong & (count < 2 * len(which) + 2)

        trial = {k: m.astype(jnp.int32) for k, m in trial.items()}
        begin = (jnp.zeros((), jnp.int32), trial, jnp.ones((), bool))
        _, trial, wrong = lax.while_loop(unsettled, amend, begin)

    s, rates, slopes = look(trial)
    if model.contacts and len(model.holdable) > 1:
        trial = _pinned(model, t, y, state, at, leaves, trial, rates)
    roots = list(state.roots)
    unsure = false
    for k in which:
        if k in model.contacts:
            # It lifts off with h = dh/dt = 0, and where its force has reached zero d²h/dt² = 0 too.
            fresh = jnp.where(leaves[k] != 0, 3, 2)
            edge = jnp.where(jnp.abs(s[k] * slopes[k]) <= noise[k], 1, 0)
        else:
            # Leaving with dh/dt = 0 (the end of sliding with b = 1) makes a double root of h at this instant.
            simple = rates[k] * trial[k].astype(t.dtype) > 1e-10 * jnp.abs(slopes[k])
            fresh = jnp.where(simple, 1, 2)
            edge = jnp.zeros((), jnp.int32)
            if k in model.holdable:
                # What begins to be held with λ at its bound need not leave: where λ goes decides.
                edge = model.edge(k, s[k], nearly(t))
            unsure = unsure | (at[k] & (trial[k] == 0) & (slopes[k] > 0) & (came[k] == 0))
        held = model.held(k, trial[k]) if k in model.holdable else False
        roots[k] = jnp.where(at[k], jnp.where(held, edge, fresh), roots[k]).astype(jnp.int32)
    state = state._replace(mode=tuple(m.astype(jnp.int32) for m in trial.values()), roots=tuple(roots))
    return state, unsure, forked, wrong


def forks(model: Model, k: int, multiplier: Scalar, slope: Scalar) -> Bool[Array, ""]:
    """Whether `sgn` switch k, at its surface, can hold the solution there (|λ| <= b) and let it go as well: because the
    surface repels, or because |λ| > 1, so that on both sides the fields point the same way.

    The rule is that a repulsive surface is crossed, and that static friction holds."""
    size = jnp.abs(multiplier)
    return (size <= model.bound(k)) & ((slope > 0) | (size > 1 + nearly(size)))


def _grips(model: Model, k: int, multiplier: Scalar) -> Bool[Array, ""]:
    """Whether, running backwards, static friction holds what arrives. It does not where |λ| < 1: there nothing does."""
    if not model.static(k):
        return jnp.zeros((), bool)
    size = jnp.abs(multiplier)
    return (model.direction < 0) & (size > 1 + nearly(size)) & (size <= (1 + nearly(size)) * model.bound(k))


def _noise(model: Model, t: Scalar, y: Y, state: State, which: tuple, s: dict) -> dict:
    """What rounding can make of d²h/dt² of the contacts: a force below it counts as none, and holds."""
    zero = jnp.zeros((), t.dtype)
    if not model.contacts:
        return {k: zero for k in which}
    values = tuple(s.get(k, v) for k, v in enumerate(model.signs(t, state)))
    blurs = model.rounding(lambda t, y: model.rates(model.contacts, t, y, state, values), t, y)
    return {k: zero for k in which} | dict(zip(model.contacts, blurs))


def nearly(like: Scalar) -> float:
    """How closely two bounds must be reached to count as reached together."""
    return max(1e-10, 64 * float(jnp.finfo(like.dtype).eps))


def _best(
    model: Model, t: Scalar, which: tuple, at: dict, came: dict, leaves: dict, trial: dict, look: Any, noise: dict
) -> tuple[dict, Bool[Array, ""], Bool[Array, ""]]:
    """The valid assignment that holds most, of all; whether others hold as many, and whether the choice is open."""
    options = [(1, 0) if k in model.contacts else (0, 1, -1) if k in model.holdable else (1, -1) for k in which]
    table = np.array(list(itertools.product(*options)), np.int32)

    def judge(row: Int[Array, " m"]) -> tuple[Bool[Array, ""], Int[Array, ""], Int[Array, ""]]:
        mode = dict(trial)
        for i, k in enumerate(which):
            mode[k] = jnp.where(at[k], row[i], trial[k]).astype(jnp.int32)
        s, rates, slopes = look(mode)
        valid, held, kept = jnp.ones((), bool), jnp.zeros((), jnp.int32), jnp.zeros((), jnp.int32)
        for i, k in enumerate(which):
            small = nearly(t) * jnp.abs(slopes[k])
            if k in model.contacts:
                stays = row[i] == 1
                law = jnp.where(
                    stays, (s[k] * slopes[k] >= -noise[k]) & (leaves[k] == 0), (rates[k] > noise[k]) | (leaves[k] != 0)
                )
            else:
                stays = (row[i] == 0) & (k in model.holdable)
                if k in model.holdable:
                    # Who has just left, at this very instant, is at the bound and may have dh/dt = 0.
                    opening = rates[k] * row[i].astype(rates[k].dtype)
                    goes = (opening > small) | ((row[i] == came[k]) & (opening >= -small))
                    forced = jnp.where(slopes[k] >= 0, -leaves[k], leaves[k])
                    # With b = 1 dh/dt is zero too where λ reaches it, as far as it does.
                    forced = (row[i] == forced) & (opening >= -1e-6 * jnp.abs(slopes[k]))
                    goes = jnp.where(leaves[k] == 0, goes, forced)
                    bound = model.bound(k)
                    left = (came[k] != 0) & (s[k] * came[k].astype(t.dtype) >= (1 - nearly(t)) * bound)
                    attracts = (slopes[k] < 0) | (came[k] == 0) | _grips(model, k, s[k])
                    sticks = (jnp.abs(s[k]) <= (1 + nearly(t)) * bound) & (leaves[k] == 0) & attracts & ~left
                else:
                    crosses = (leaves[k] != 0) & (came[k] != 0)
                    unmoved = jnp.where(came[k] == 0, 1, came[k])
                    onward = jnp.where(rates[k] == 0, unmoved, jnp.sign(rates[k]).astype(jnp.int32))
                    goes = row[i] == jnp.where(crosses, -came[k], onward)
                    sticks = jnp.zeros((), bool)
                law = jnp.where(stays, sticks, goes)
            # A switch that is not at its surface has no choice: its first option stands for what it is.
            valid = valid & jnp.where(at[k], law, row[i] == options[i][0])
            held = held + (at[k] & stays).astype(jnp.int32)
            if k in model.holdable:
                kept = kept + (at[k] & stays & model.held(k, came[k])).astype(jnp.int32)
        return valid, held, kept

    valid, held, kept = jax.vmap(judge)(jnp.asarray(table))
    most = jnp.max(jnp.where(valid, held, -1))
    several = jnp.sum(valid & (held == most)) > 1
    score = jnp.where(valid & (held == most), kept, -1)
    best = jnp.argmax(score)
    out = {k: jnp.where(at[k], jnp.asarray(table)[best, i], trial[k]).astype(jnp.int32) for i, k in enumerate(which)}
    return trial | out, several, jnp.sum(score == score[best]) != 1


def _pinned(model: Model, t: Scalar, y: Y, state: State, at: dict, leaves: dict, trial: dict, rates: dict) -> dict:
    """A `sgn` switch at its surface that a contact keeps there, whatever its own value, is neither side's. (One that
    has just reached its bound has dh/dt = 0 too.)"""
    held = state._replace(mode=tuple(trial.values()))
    s = model.values(t, y, held)
    _, matrix = model.linear(t, y, held, s)
    out = dict(trial)
    for i, k in enumerate(model.holdable):
        if k in model.contacts:
            continue
        pull = sum(
            jnp.where(at[c] & (trial[c] == 1), jnp.abs(matrix[i, j] * s[c]), 0)
            for j, c in enumerate(model.holdable)
            if c in model.contacts
        )
        pinned = at[k] & (leaves[k] == 0) & (pull > 0) & (jnp.abs(rates[k]) <= 1e-10 * pull)
        out[k] = jnp.where(pinned, 0, trial[k]).astype(jnp.int32)
    return out


def _amend(
    model: Model, which: tuple, at: dict, leaves: dict, trial: dict, seen: tuple, noise: dict
) -> tuple[dict, Bool[Array, ""]]:
    """One release, or one taking back, of the switch that violates its law most."""
    s, rates, slopes = seen
    excess, opposed = [], []
    for k in which:
        held = at[k] & model.held(k, trial[k]) if k in model.holdable else jnp.zeros((), bool)
        if k in model.contacts:
            over, against = -s[k] * slopes[k] - noise[k], -rates[k]
        else:
            over = jnp.abs(s[k]) / (model.bound(k) if k in model.holdable else 1) - 1
            against = -rates[k] * trial[k].astype(rates[k].dtype)
        excess.append(jnp.where(held, over, -1))
        # What has just left has its λ at the bound (or it crosses): dh/dt may be zero but for rounding.
        free = at[k] & ~held & (trial[k] != 0 if k not in model.contacts else True) & (leaves[k] == 0)
        opposed.append(jnp.where(free & (against > 1e-10 * jnp.abs(slopes[k])), against, 0))
    worst = jnp.stack(excess)
    back = jnp.stack(opposed)
    release = jnp.any(~(worst <= 0))  # a multiplier that is not a number is a violation too
    retake = ~release & jnp.any(back > 0)
    out = dict(trial)
    for i, k in enumerate(which):
        first = release & (jnp.argmax(jnp.where(jnp.isnan(worst), jnp.inf, worst)) == i)
        again = retake & (jnp.argmax(back) == i)
        if k in model.contacts:
            side, taken = 0, 1
        else:
            taken = jnp.where(slopes[k] < 0, 0, -trial[k])
            side = jnp.where((s[k] >= 0) == (slopes[k] < 0), 1, -1)  # where dh/dt = slope (s - λ) points
        out[k] = jnp.where(first, side, jnp.where(again, taken, trial[k])).astype(jnp.int32)
    return out, release | retake
