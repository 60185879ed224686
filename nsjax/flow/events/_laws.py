"""The laws of the switches at their surfaces: what an assignment of hold and release leads to, if it is valid."""

from typing import Any, NamedTuple

import jax.numpy as jnp
from jaxtyping import Array, Bool, Int

from ..._numerics._linalg import nearly
from ..._numerics._select import select
from ..._types import Scalar, Y
from ...system._mode import ModeState
from ...system._model import SwitchedSystem
from ._attraction import attraction, negligible, Pairs, reach


class Outcome(NamedTuple):
    """What an assignment leads to, for each switch that may be at its surface."""

    s: dict[int, Scalar]  # its value: a sign, or the multiplier λ
    rates: dict[int, Scalar]  # dh/dt, of contacts d²h/dt²
    slopes: dict[int, Scalar]  # what its value adds to that while all others that hold do so, see `attraction`
    spans: dict[int, Scalar]  # what all `sgn` switches together may add; only of surfaces that may coincide


class Instant(NamedTuple):
    """Where switches are at their surfaces, and what is known of each of them: see `settle`."""

    model: SwitchedSystem
    t: Scalar
    y: Y
    state: ModeState
    at: dict[int, Bool[Array, ""]]
    leaves: dict[int, Int[Array, ""]]
    given: tuple[int, ...] | None
    pairs: Pairs = {}
    pushed: dict[int, Int[Array, ""]] = {}  # to which side those go that leave a surface with others

    @property
    def which(self) -> tuple[int, ...]:
        return tuple(self.at)

    def only(self, which: list[int]) -> "Instant":
        """The same where no others are at their surfaces."""
        pairs = {p: pair for p, pair in self.pairs.items() if all(self.model.holdable[i] in which for i in p)}
        return self._replace(at={k: self.at[k] for k in which}, pairs=pairs)

    @property
    def came(self) -> dict[int, Int[Array, ""]]:
        return {k: self.state.mode[k] for k in self.at}

    @property
    def starts(self) -> bool:
        return self.given is not None

    def dry(self, k: int) -> bool:
        """Whether it is a `sgn` switch that can hold the solution."""
        return k in self.model.holdable and k not in self.model.contacts

    def open(self, k: int) -> Bool[Array, ""]:
        """Whether its mode is to be chosen."""
        return jnp.zeros((), bool) if k in (self.given or ()) else self.at[k]

    def absent(self, k: int, mode: dict[int, Any]) -> Bool[Array, ""]:
        """Whether it is not there, as its contact is open."""
        return self.model.absent(k, tuple(mode.values()))

    def side(self, k: int, slope: Scalar) -> Int[Array, ""]:
        """To which side one goes that leaves its surface: where both fields point beyond |λ| = 1, from a surface that
        repels to the other side."""
        alone = select(slope >= 0, -self.leaves[k], self.leaves[k])
        return select(self.pushed[k] == 0, alone, self.pushed[k]) if k in self.pushed else alone

    def fresh(self, k: int) -> Bool[Array, ""] | bool:
        """Whether it comes to its surface only now."""
        return True if self.starts else self.came[k] != 0

    def values(self, mode: dict[int, Any]) -> tuple[ModeState, tuple]:
        trial = self.state._replace(mode=self.model.present(tuple(mode.values())))
        return trial, self.model.values(self.t, self.y, trial)

    def look(self, mode: dict[int, Any]) -> Outcome:
        model, t, y, which = self.model, self.t, self.y, self.which
        trial, s = self.values(mode)
        rates = dict(zip(which, model.rates(which, t, y, trial, s)))
        slopes = {k: jnp.zeros((), t.dtype) for k in which}
        spans = slopes
        if model.holdable:
            _, matrix = model.linear(t, y, trial, s)
            held = jnp.stack([model.held(k, trial.mode[k]) for k in model.holdable])
            effects = attraction(model, matrix, held, self.pairs)
            slopes = slopes | {
                k: matrix[i, i] if k in model.contacts else effects[i] for i, k in enumerate(model.holdable)
            }
            if self.pairs:
                spans = spans | dict(zip(model.holdable, reach(model, matrix)))
        return Outcome({k: s[k] for k in which}, rates, slopes, spans)

    def grips(self, k: int, multiplier: Scalar) -> Bool[Array, ""]:
        """Whether, running backwards, static friction holds what arrives. It does not where |λ| < 1: there nothing
        does."""
        if not self.model.static(k):
            return jnp.zeros((), bool)
        size = jnp.abs(multiplier)
        return (
            (self.model.direction < 0) & (size > 1 + nearly(size)) & (size <= (1 + nearly(size)) * self.model.bound(k))
        )

    def noise(self, s: dict) -> dict[int, Scalar]:
        """What rounding can make of d²h/dt² of the contacts: a force below it counts as zero, and holds."""
        model, t, y, state = self.model, self.t, self.y, self.state
        zero = {k: jnp.zeros((), t.dtype) for k in self.which}
        if not model.contacts:
            return zero
        values = tuple(s.get(k, v) for k, v in enumerate(model.signs(t, state)))
        blurs = model.rounding(lambda t, y: model.rates(model.contacts, t, y, state, values), t, y)
        return zero | dict(zip(model.contacts, blurs))


class Verdict(NamedTuple):
    """What speaks for an assignment."""

    valid: Bool[Array, ""]  # whether all laws are kept of switches whose mode is to be chosen
    sound: Bool[Array, ""]  # whether all laws are
    clear: Bool[Array, ""]  # and not just so: what leaves its surface does so with dh/dt beyond rounding
    rank: Int[Array, ""]
    seen: Outcome


def judge(here: Instant, trial: dict, noise: dict, row: Int[Array, " m"]) -> Verdict:
    """An assignment, one entry of `row` for each switch that may be at its surface: whether each law is kept, by the
    multipliers of the assignment as a whole, (2.19)-(2.20), with |λ| <= b in place of |λ| <= 1 (Fig. 2.5 (c))."""
    # Every comparison leaves out what rounding makes of it. One law made too strict leaves no assignment, and the event
    # counts as ambiguous; made too loose it lets an event follow at the same instant that undoes this one.
    model, t, which, at, came, leaves = here.model, here.t, here.which, here.at, here.came, here.leaves
    yes, rank = jnp.ones((), bool), jnp.zeros((), jnp.int32)
    mode = dict(trial)
    for i, k in enumerate(which):
        mode[k] = select(at[k], row[i], trial[k]).astype(jnp.int32)
    seen = here.look(mode)
    s, rates, slopes, spans = seen
    valid, sound, clear, repelled = yes, yes, yes, ~yes
    for i, k in enumerate(which):
        held, crosses = ~yes, (row[i] == -came[k]) & (came[k] != 0)
        if k in model.contacts:
            held = row[i] == 1
            stays = (s[k] * slopes[k] >= -noise[k]) & (leaves[k] == 0)
            law = strict = select(held, stays, (rates[k] > noise[k]) | (leaves[k] != 0))
        elif k in model.holdable:
            held = row[i] == 0
            small = nearly(t) * jnp.abs(slopes[k])
            opening = rates[k] * row[i].astype(rates[k].dtype)
            # What has just left, at this very instant, is at the bound and may have dh/dt = 0.
            goes = (opening > small) | ((row[i] == came[k]) & (opening >= -small))
            # With b = 1 dh/dt is zero too where λ reaches it, as far as it does.
            forced = (row[i] == here.side(k, slopes[k])) & (opening >= -1e-6 * jnp.abs(slopes[k]))
            bound = model.bound(k)
            # With |λ| = b both are right, to hold and to let go. What came from the side to which it would be let go
            # stays there: held, it would be let go again at the same instant.
            left = (came[k] != 0) & (s[k] * came[k].astype(t.dtype) >= (1 - nearly(t)) * bound)
            sticks = (jnp.abs(s[k]) <= (1 + nearly(t)) * bound) & (leaves[k] == 0) & ~left
            law = select(held, sticks, select(leaves[k] == 0, goes, forced))
            strict = law & (held | (leaves[k] != 0) | (opening > small))
            if model.conditional(k):  # what is not there has no choice: its first option stands for that
                absent = here.absent(k, mode)
                law, strict = (select(absent, held, x) for x in (law, strict))
                held, crosses = held & ~absent, crosses & ~absent
            # Repulsion is no law, but a preference: a surface that repels may hold what has been on it so far, (2.25).
            repels = (slopes[k] >= 0) & (came[k] != 0) & ~here.grips(k, s[k])
            repelled = repelled | (at[k] & held & repels)
        else:
            turns = (leaves[k] != 0) & (came[k] != 0)  # it can only cross
            unmoved = select(came[k] == 0, 1, came[k])
            onward = select(rates[k] == 0, unmoved, jnp.sign(rates[k]).astype(jnp.int32))
            law = row[i] == select(turns, -came[k], onward)
            strict = law = select(here.absent(k, mode), row[i] == 1, law) if model.conditional(k) else law
        valid = valid & (~at[k] | (row[i] == came[k] if k in (here.given or ()) else law))
        sound, clear = sound & (~at[k] | law), clear & (~at[k] | strict)
        kept = held & (model.held(k, came[k]) if k in model.holdable else False)
        # Powers of five: of up to four switches, no number of lesser preferences outweighs a greater one. To hold is
        # preferred because friction does so while it can; of several that hold as many, the one that goes on as before.
        for weight, better in ((25, held), (5, kept), (1, crosses)):
            rank = rank + select(at[k] & better, weight, 0)
    for (i, j), (same, ratio) in here.pairs.items():
        k, other = model.holdable[i], model.holdable[j]
        for each in filter(model.conditional, (k, other)):  # what is not there shares no surface
            same = same & ~here.absent(each, mode)
        a, b = mode[k], mode[other]
        one = ~same | (a.astype(t.dtype) == ratio * b.astype(t.dtype))
        # Where only their effects are parallel, one surface that is held does not hold the other.
        still = negligible(rates[k], spans[k]) & negligible(rates[other], spans[other])
        one = one & (still | ~(model.held(k, a) & model.held(other, b)))
        valid, sound, clear = valid & one, sound & one, clear & one
    return Verdict(valid, sound, clear, (rank + select(repelled, 0, 125)).astype(jnp.int32), seen)
