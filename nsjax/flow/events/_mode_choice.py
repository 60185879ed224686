"""The choice of mode where switches are at their surfaces."""

import functools as ft
import itertools
from typing import Any, NamedTuple

import jax
import jax.lax as lax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Int

from ..._numerics._autodiff import frozen
from ..._numerics._lane_cond import compact_cond
from ..._numerics._linalg import nearly
from ..._numerics._select import select
from ..._types import Scalar, Y
from ...system._mode import ModeState
from ...system._model import SwitchedSystem
from ._attraction import coinciding, reach
from ._laws import Instant, judge, Outcome


# Up to this many switches at their surfaces, every assignment is tried: at most 81. The search by release and taking
# back, once used for any number, let slip what could stick, or went in circles.
_TRIED = 4


def settle(
    model: SwitchedSystem,
    t: Scalar,
    y: Y,
    state: ModeState,
    at: dict[int, Bool[Array, ""]],
    leaves: dict[int, Int[Array, ""]],
    given: tuple[int, ...] | None = None,
) -> tuple[ModeState, Bool[Array, ""], Bool[Array, ""], Bool[Array, ""]]:
    """Gives every `sgn` switch that is at its surface a mode from {0, +1, -1}, every contact one from {1, 0}.

    An assignment is valid if each that holds has |λ| <= b (a contact a force λ >= 0) and each other one moves to its
    side. A switch that acts on no other's surface, and on whose surface no other acts, has no choice. Of up to four
    others that are at their surfaces every assignment is tried; of the valid ones those are preferred in which no
    surface that repels holds what arrives at it, of these the ones that hold most, that keep what held before, and that
    cross what is met. Where more are, all are held that attract, the one that violates its law most is released, to the
    sign of its λ, and a released switch whose motion opposes this is taken back, until nothing is violated.

    **Arguments:**

    - `state`: the mode so far; a `sgn` switch that arrived at its surface still has the sign of the side it came from,
        and one whose side is unknown has 0.
    - `at`: for each `sgn` switch whether it is at its surface, for each contact whether it rests there (dh/dt = 0).
    - `leaves`: for each switch the sign with which its λ just reached its bound, else 0.
    - `given`: at the start of a solution the switches that keep the mode they have.

    **Returns:** the new state; whether a side must be chosen (a start on a repulsive surface (2.25)); whether there is
    another valid assignment, see `Solution.unique`; and whether not exactly one assignment was found.
    """
    model, t, y = frozen((model, t, y))  # modes have no derivative
    which = tuple(at)
    false = jnp.zeros((), bool)
    if not which:
        return state._replace(mode=model.present(state.mode)), false, false, false
    here = Instant(model, t, y, state, at, leaves, given)
    mode = dict(enumerate(state.mode))
    trial = dict(mode)
    for k in which:
        if k in model.contacts:
            trial[k] = select(at[k], select(leaves[k] != 0, 0, 1), mode[k])
        elif k in model.holdable:
            trial[k] = select(at[k], 0, mode[k])
    if model.pairs:
        here = _together(here, trial)
        for k in filter(here.dry, which):
            trial[k] = select(here.at[k], 0, trial[k])
    alone = [k for k in which if model.apart[k]]
    parts = [_alone(here.only(alone), trial)] if alone else []
    if len(alone) < len(which):
        parts.append(_jointly(here.only([k for k in which if k not in alone]), trial))
    trial, seen, others, wrong, noise = _merged(trial, parts)
    _, rates, slopes, _ = seen
    if model.contacts and len(model.holdable) > 1:
        trial = _pinned(here, trial, rates)
    trial = dict(zip(trial, model.present(tuple(trial.values()))))
    state, unsure = _entered(here, trial, seen, others, noise)
    forked = ft.reduce(jnp.logical_or, others.values())
    # At a two-fold n · f⁺ = n · f⁻ = 0, so that λ is 0/0 and no law says whether to stay or to leave. There is none
    # where what acts on the surfaces is constant: n · f⁺ - n · f⁻ keeps its sign.
    for k in which if not model.steady else ():
        if here.dry(k):
            if here.starts:
                s = here.values(trial)[1]
                (blur,) = model.rounding(lambda t, y, k=k, s=s: model.rates((k,), t, y, here.state, s), t, y)
                several = ~(jnp.maximum(jnp.abs(rates[k]), 2 * jnp.abs(slopes[k])) > blur)  # all fields are tangent
            else:
                # What is let go by a surface that has come to repel, beyond a two-fold, might have left it before.
                several = (here.came[k] == 0) & (here.leaves[k] != 0) & (slopes[k] > 0)
            several = several & ~here.absent(k, trial) if model.conditional(k) else several
            forked = forked | (here.at[k] & several)
    return state, unsure, forked, wrong


class _Choice(NamedTuple):
    """The modes of some of the switches at an instant."""

    trial: dict[int, Any]
    seen: Outcome  # what they lead to
    others: dict[int, Bool[Array, ""]]  # whether another solution gives it another mode
    wrong: Bool[Array, ""]  # whether the choice is open
    noise: dict[int, Scalar]


def _merged(trial: dict[int, Any], parts: list[_Choice]) -> _Choice:
    """What is chosen for switches that have nothing to do with each other."""

    def union(dicts: Any) -> dict[int, Any]:
        found = [{k: each[k] for k in part.others if k in each} for part, each in zip(parts, dicts)]
        return {k: x for each in found for k, x in each.items()}

    seen = Outcome(*map(union, zip(*(part.seen for part in parts))))
    own, others, noise = (union(each) for each in zip(*((p.trial, p.others, p.noise) for p in parts)))
    return _Choice(trial | own, seen, others, ft.reduce(jnp.logical_or, [p.wrong for p in parts]), noise)


def _entered(
    here: Instant, trial: dict[int, Any], seen: Outcome, others: dict[int, Bool[Array, ""]], noise: dict
) -> tuple[ModeState, Bool[Array, ""]]:
    """The chosen mode, with the roots that its guards have at this instant; and whether a side must be chosen."""
    model, t, leaves = here.model, here.t, here.leaves
    s, rates, slopes, _ = seen
    roots, unsure = list(here.state.roots), jnp.zeros((), bool)
    for k in here.which:
        if k in model.contacts:
            # It lifts off with h = dh/dt = 0, and where its force has reached zero d²h/dt² = 0 too.
            fresh = select(leaves[k] != 0, 3, 2)
            edge = select(jnp.abs(s[k] * slopes[k]) <= noise[k], 1, 0)
        else:
            # Leaving with dh/dt = 0 (the end of sliding with b = 1) makes a double root of h at this instant.
            simple = rates[k] * trial[k].astype(t.dtype) > 1e-10 * jnp.abs(slopes[k])
            fresh = select(simple, 1, 2)
            edge = jnp.zeros((), jnp.int32)
            if k in model.holdable:
                # What begins to be held with λ at its bound need not leave: where λ goes decides.
                edge = model.edge(k, s[k], nearly(t))
            if here.starts:
                unsure = unsure | (here.open(k) & (trial[k] == 0) & (slopes[k] > 0) & others[k])
        held = model.held(k, trial[k]) if k in model.holdable else False
        known = select(held, edge, fresh)
        if model.conditional(k):
            known = select(here.absent(k, trial), 0, known)
        roots[k] = select(here.open(k), known, roots[k]).astype(jnp.int32)
    mode = tuple(m.astype(jnp.int32) for m in trial.values())
    return here.state._replace(mode=mode, roots=tuple(roots)), unsure


def _together(here: Instant, trial: dict[int, Any]) -> Instant:
    """Surfaces that coincide are met at one instant, and left at one instant."""
    model, t, y, state = here.model, here.t, here.y, here.state
    at, leaves, parts, h = dict(here.at), dict(here.leaves), list(state.part), {}
    for i in sorted({i for pair in model.pairs for i in pair}):
        k = model.holdable[i]
        values, blur = jnp.stack(model.h(k, t, y)), model.rounding(lambda t, y, k=k: model.h(k, t, y), t, y)
        part = 0
        if parts[k] is not None:
            # What is off its surface is nearest to it with the least component.
            part = select(at[k], parts[k], jnp.argmin(values).astype(jnp.int32))
            parts[k] = part
        h[i] = values[part], blur[part]
    here = here._replace(state=state._replace(part=tuple(parts)))
    first, s = here.values(trial)
    s = tuple(select(jnp.isfinite(v), v, 0) for v in s)
    rates, matrix = model.linear(t, y, first, s)
    pairs, size = coinciding(model, rates, matrix), reach(model, matrix)
    pushed = {model.holdable[i]: jnp.zeros((), jnp.int32) for i in h}
    for (i, j), (same, _) in pairs.items():
        for a, b in ((i, j), (j, i)):
            k, other = model.holdable[a], model.holdable[b]
            near = jnp.abs(h[b][0]) * size[a] <= h[b][1] * size[a] + 2 * jnp.abs(h[a][0]) * size[b]
            at[other] = at[other] | (at[k] & same & near)
        k, other = model.holdable[i], model.holdable[j]
        both = same & at[k] & at[other]
        pairs[i, j] = both, pairs[i, j][1]
        # Their values reach the bounds together, each in the direction in which it resists.
        turn = select((matrix[i, i] < 0) == (matrix[i, j] < 0), 1, -1)
        for a, b in ((k, other), (other, k)):
            follows = both & (leaves[b] == 0) & (here.came[b] == 0)
            leaves[b] = select(follows, turn * leaves[a], leaves[b]).astype(jnp.int32)
        for n, a in ((i, k), (j, other)):
            push = select(matrix[n, n] < 0, leaves[a], -leaves[a])
            pushed[a] = select(both, push, pushed[a])
    return here._replace(at=at, leaves=leaves, pairs=pairs, pushed=pushed)


def _elsewhere(
    here: Instant, chosen: Int[Array, " m"], seen: Outcome, table: Int[Array, "rows m"], clear: Bool[Array, " rows"]
) -> Bool[Array, " m"]:
    """Which switches have another mode in one of the assignments of a table that are `clear`. Static friction that
    holds goes on doing so, as its law says: that it might let go is no other solution."""
    differs = table != chosen
    for i, k in enumerate(here.which):
        if not here.starts and here.dry(k) and here.model.static(k):
            goes_on = (here.came[k] == 0) & (chosen[i] == 0) & (jnp.abs(seen.s[k]) > 1)
            differs = differs & ~(goes_on & (np.arange(len(here.which)) == i))
    return jnp.any(differs & clear[:, None], axis=0)


def _assignments(here: Instant) -> tuple[Int[Array, "rows m"], Bool[Array, " rows"]]:
    """All assignments of up to four switches that are at their surfaces, one a row; and which of the rows there are.
    What is not at its surface has no choice: its first option stands for what it is."""
    model, which = here.model, here.which
    options = [(1, 0) if k in model.contacts else (0, 1, -1) if k in model.holdable else (1, -1) for k in which]
    at = jnp.stack([here.at[k] for k in which])
    if len(which) <= _TRIED:
        table = np.array(list(itertools.product(*options)), np.int32)
        return jnp.asarray(table), jnp.all(at | (table == np.array([o[0] for o in options], np.int32)), axis=1)
    # Of a model with more, each row says which option the first that is at its surface has, the second, and so on.
    codes = np.array(list(itertools.product(range(3), repeat=_TRIED)), np.int32)
    turn = jnp.cumsum(at, dtype=jnp.int32) - 1
    code = sum(select(at & (turn == i), codes[:, i : i + 1], 0) for i in range(_TRIED))
    real = jnp.all(code < np.array([len(o) for o in options], np.int32), axis=1)
    real = real & jnp.all((np.arange(_TRIED, dtype=np.int32) <= turn[-1]) | (codes == 0), axis=1)
    first, second, third = np.array([(*o, 0)[:3] for o in options], np.int32).T
    return select(code == 0, first, select(code == 1, second, third)), real


def _jointly(here: Instant, trial: dict) -> _Choice:
    """The modes of switches that act on each other's surfaces."""
    which, crowded = here.which, len(here.which) > _TRIED
    held = here.look(trial) if here.model.contacts or crowded else None
    noise = here.noise(held.s if held else {})
    if held is not None and crowded:
        more = sum(here.at[k].astype(jnp.int32) for k in which) > _TRIED
        search = ft.partial(_search, here, trial, held, noise, more)
        found = compact_cond(more, search, (), _best(here, trial, noise))
    else:
        found = _best(here, trial, noise)
    trial, seen, others, wrong = found
    return _Choice(trial, seen, dict(zip(which, others)), wrong, noise)


def _best(here: Instant, trial: dict, noise: dict) -> tuple[dict, Outcome, Bool[Array, " m"], Bool[Array, ""]]:
    """The assignment to be preferred, of all that are valid; what it leads to; of each switch whether another solution
    gives it another mode; and whether the choice is open."""
    which = here.which
    table, real = _assignments(here)
    found = jax.vmap(ft.partial(judge, here, trial, noise))(table)
    score = select(found.valid & real, found.rank, -1)
    best = jnp.argmax(score)
    seen = jax.tree.map(lambda x: x[best], found.seen)
    # Where no assignment is valid, all scores are -1: a tie too, and so an open choice.
    others = _elsewhere(here, table[best], seen, table, found.sound[best] & found.clear & real)
    out = {k: select(here.at[k], table[best, i], trial[k]).astype(jnp.int32) for i, k in enumerate(which)}
    return trial | out, seen, others, jnp.sum(score == score[best]) != 1


def _guess(here: Instant, trial: dict, seen: Outcome) -> dict:
    """What is held as a first guess: all but what leaves, what repels, and what cannot be held."""
    model, at, came, leaves, out = here.model, here.at, here.came, here.leaves, dict(trial)
    for k in here.which:
        if k in (here.given or ()):
            out[k] = came[k]
        elif here.dry(k):
            side, repels = here.side(k, seen.slopes[k]), seen.slopes[k] >= 0
            passes = repels & (came[k] != 0) & ~here.grips(k, seen.s[k])
            out[k] = select(at[k] & (side != 0), side, select(at[k] & passes, -came[k], trial[k]))
        elif k not in model.contacts:
            unmoved = select(came[k] == 0, 1, came[k])
            side = select(seen.rates[k] == 0, unmoved, jnp.sign(seen.rates[k]).astype(jnp.int32))
            # It cannot but cross; at a double root the sign of dh/dt is rounding.
            side = select((leaves[k] != 0) & (came[k] != 0), -came[k], side)
            out[k] = select(at[k], side, came[k])
    return out


def _alone(here: Instant, trial: dict) -> _Choice:
    """The modes of switches on whose surfaces no other value acts: none of them has a choice."""
    model, seen = here.model, here.look(trial)
    noise = here.noise(seen.s)
    first = _guess(here, trial, seen)
    if len(here.which) > 1:
        here, first = _left_together(here, first, seen)
    trial = _amend(here, first, here.look(first), noise, apart=True)[0]
    others = {k: jnp.zeros((), bool) for k in here.which}
    for k in filter(here.dry, here.which):
        either = _either(seen.s[k], model.bound(k), seen.slopes[k])
        others[k] = here.at[k] & here.fresh(k) & (here.leaves[k] == 0) & either
    return _Choice(trial, here.look(trial), others, jnp.zeros((), bool), noise)


def _either(multiplier: Scalar, bound: Any, slope: Scalar) -> Bool[Array, ""]:
    """Whether a surface can hold the solution (|λ| <= b) and let it go as well: because it repels, or because |λ| > 1,
    so that on both sides the fields point the same way."""
    size = jnp.abs(multiplier)
    return (size <= bound) & ((slope > 0) | (size > 1 + nearly(size)))


def _left_together(here: Instant, trial: dict, seen: Outcome) -> tuple[Instant, dict]:
    """A bound that is reached together with that of another switch is left with it, and what has just left stays so."""
    leaves, trial = dict(here.leaves), dict(trial)
    for k, came in here.came.items():
        if here.dry(k):
            over = seen.s[k] * came.astype(here.t.dtype) / here.model.bound(k) - 1
            tied = here.open(k) & (came != 0) & (seen.slopes[k] < 0) & (leaves[k] == 0)
            tied = tied & (jnp.abs(over) <= nearly(over))
            leaves[k] = select(tied, came, leaves[k])
            trial[k] = select(tied, came, trial[k])
    return here._replace(leaves=leaves), trial


def _search(
    here: Instant, trial: dict, seen: Outcome, noise: dict, wanted: Bool[Array, ""]
) -> tuple[dict, Outcome, Bool[Array, " m"], Bool[Array, ""]]:
    """The same where there are too many to try every assignment, if that is `wanted`."""
    which = here.which
    here, trial = _left_together(here, _guess(here, trial, seen), seen)

    # One release or taking back a round, until nothing is violated: of two that violate their laws, one may hold once
    # the other is released. In all rounds together each can change twice.
    def amend(carry: tuple) -> tuple:
        count, trial, _ = carry
        return count + 1, *_amend(here, trial, here.look(trial), noise)

    def unsettled(carry: tuple) -> Bool[Array, ""]:
        count, _, wrong = carry
        return wrong & (count < 2 * len(which) + 2)

    trial = {k: m.astype(jnp.int32) for k, m in trial.items()}
    begin = (jnp.zeros((), jnp.int32), trial, wanted)
    _, trial, wrong = lax.while_loop(unsettled, amend, begin)
    # Of all other assignments those in which one switch, or one group on surfaces that coincide, is let go or held.
    chosen, seen, table = jnp.stack([trial[k] for k in which]), here.look(trial), []
    for i, k in enumerate(which):
        for value in (0, 1, -1) if here.dry(k) else ():
            row = list(chosen)
            row[i] = jnp.asarray(value, jnp.int32)
            for pair, (same, ratio) in here.pairs.items():
                a, b = (here.model.holdable[n] for n in pair)
                if k in (a, b):
                    n = which.index(b if k == a else a)
                    row[n] = select(same, ratio.astype(jnp.int32) * value, row[n])
            table.append(jnp.stack(row))
    table = jnp.stack(table) if table else chosen[None]
    clear = jax.vmap(ft.partial(judge, here, trial, noise))(table).clear
    at = jnp.stack([here.at[k] for k in which])
    real = jnp.all(at | (table == chosen), axis=1)
    return trial, seen, _elsewhere(here, chosen, seen, table, clear & real), wrong


def _pinned(here: Instant, trial: dict, rates: dict) -> dict:
    """A `sgn` switch at its surface that a contact keeps there, whatever its own value, is neither side's. (One that
    has just reached its bound has dh/dt = 0 too.)"""
    model = here.model
    held, s = here.values(trial)
    _, matrix = model.linear(here.t, here.y, held, s)
    out = dict(trial)
    for i, k in enumerate(model.holdable):
        if k in model.contacts:
            continue
        pull = sum(
            select(here.at[c] & (trial[c] == 1), jnp.abs(matrix[i, j] * s[c]), 0)
            for j, c in enumerate(model.holdable)
            if c in model.contacts
        )
        pinned = here.open(k) & (here.leaves[k] == 0) & (pull > 0) & (jnp.abs(rates[k]) <= 1e-10 * pull)
        out[k] = select(pinned, 0, trial[k]).astype(jnp.int32)
    return out


def _amend(here: Instant, trial: dict, seen: Outcome, noise: dict, apart: bool = False) -> tuple[dict, Bool[Array, ""]]:
    """One release, or one taking back, of the switch that violates its law most; of each, if they are `apart`."""
    model, which = here.model, here.which
    s, rates, slopes, _ = seen
    excess, opposed = [], []
    # What reaches its bound together with another one is let go by an event of its own, whatever rounding says.
    slack = nearly(here.t) if apart and len(which) > 1 else 0.0
    for k in which:
        held = here.open(k) & model.held(k, trial[k]) if k in model.holdable else jnp.zeros((), bool)
        if k in model.contacts:
            over, against = -s[k] * slopes[k] - noise[k], -rates[k]
        else:
            over = jnp.abs(s[k]) / (model.bound(k) if k in model.holdable else 1) - (1 + slack)
            against = -rates[k] * trial[k].astype(rates[k].dtype)
        excess.append(select(held, over, -1))
        # What has just left has its λ at the bound (or it crosses): dh/dt may be zero apart from rounding.
        free = here.open(k) & ~here.absent(k, trial) if model.conditional(k) else here.open(k)
        free = free & ~held & (trial[k] != 0 if k not in model.contacts else True) & (here.leaves[k] == 0)
        opposed.append(select(free & (against > 1e-10 * jnp.abs(slopes[k])), against, 0))
    # (A multiplier that is NaN is a violation too.)
    released = [~(over <= 0) for over in excess]
    retaken = [(against > 0) & ~over for against, over in zip(opposed, released)]
    if not apart:
        worst, back = jnp.stack(excess), jnp.stack(opposed)
        release, index = jnp.any(~(worst <= 0)), np.arange(len(which))
        released = list(release & (jnp.argmax(select(jnp.isnan(worst), jnp.inf, worst)) == index))
        retaken = list(~release & jnp.any(back > 0) & (jnp.argmax(back) == index))
    out = dict(trial)
    for k, first, again in zip(which, released, retaken):
        if k in model.contacts:
            side, taken = 0, 1
        else:
            taken = select(slopes[k] < 0, 0, -trial[k])
            side = select((s[k] >= 0) == (slopes[k] < 0), 1, -1)  # where dh/dt = slope (s - λ) points
        out[k] = select(first, side, select(again, taken, trial[k])).astype(jnp.int32)
    # Surfaces that coincide are left and held together.
    moved = dict(out)
    for (i, j), (same, ratio) in here.pairs.items():
        for k, other in ((model.holdable[i], model.holdable[j]), (model.holdable[j], model.holdable[i])):
            follows = same & (out[k] != trial[k]) & here.open(other)
            moved[other] = select(follows, ratio.astype(jnp.int32) * out[k], moved[other]).astype(jnp.int32)
    return moved, ft.reduce(jnp.logical_or, [*released, *retaken])
