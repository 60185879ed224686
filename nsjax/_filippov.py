"""The field in a mode, Filippov's multipliers, and the choice of mode where switches are at their surfaces.

A mode is one small integer for each switch: for `sgn` the sign +1 or -1 of its region, or 0 while sliding; for
`relay` 0 or 1; for `impact` 0. There is no enumeration of the 3^m combinations: sliding on m surfaces at once solves
the m equations n_i . f(t, y, λ) + ∂h_i/∂t = 0 for the m multipliers, (2.19)-(2.20).
"""

from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.flatten_util as jfu
import jax.lax as lax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int

from ._structure import is_affine, is_constant
from ._system import AbstractSwitch, frozen, impact, relay, sgn, System
from ._types import Mode, Scalar, Y


class Slot(NamedTuple):
    """One guard: a function that is positive while the mode lasts."""

    switch: int  # position of its switch
    part: int  # component of h, or the sign of the bound that λ reaches
    sliding: bool  # whether it watches λ


class State(NamedTuple):
    """A mode, with the component of h that is active on the surface of each switch (None for a smooth surface) and
    the number of roots at the present instant, to be left out when the next one is sought."""

    mode: Mode
    part: tuple[Int[Array, ""] | None, ...]
    roots: tuple[Int[Array, ""], ...]


def _pick(values: tuple[Any, ...], index: Any) -> Any:
    if index is None or len(values) == 1:
        return values[0]
    return jnp.stack(values)[index]


class Model(eqx.Module):
    """A system as the flow sees it: time multiplied by `direction` so that it always increases, and the structure of
    its switches worked out once while tracing."""

    system: System
    direction: Any  # +1 or -1
    switches: tuple[AbstractSwitch, ...] = eqx.field(static=True)
    parts: tuple[int, ...] = eqx.field(static=True)  # number of components of h, per switch
    slidable: tuple[int, ...] = eqx.field(static=True)  # sgn switches whose value enters the rate of their own h
    jointly_affine: bool = eqx.field(static=True)
    slots: tuple[Slot, ...] = eqx.field(static=True)

    def __init__(self, system: System, direction: Any, t: Scalar, y: Y):
        self.system = system
        self.direction = direction
        self.switches = system.switches
        self.parts = tuple(len(k.components(system, t, y)) for k in self.switches)
        zeros = tuple(jnp.zeros((), jnp.result_type(t)) for _ in self.switches)

        def rate(k: int, t: Scalar, y: Y, s: tuple) -> tuple:
            f = self.field(t, y, s)
            return jax.jvp(lambda t, y: self.h(k, t, y), (t, y), (jnp.ones_like(t), f))[1]

        self.slidable = tuple(
            k
            for k, switch in enumerate(self.switches)
            if isinstance(switch, sgn)
            and not is_constant(lambda sk, k=k: rate(k, t, y, zeros[:k] + (sk,) + zeros[k + 1 :]), zeros[k])
        )
        self.jointly_affine = is_affine(lambda s: self.field(t, y, s), zeros)
        slots = []
        for k, switch in enumerate(self.switches):
            number = 1 if isinstance(switch, relay) else self.parts[k]
            slots += [Slot(k, part, False) for part in range(number)]
            slots += [Slot(k, sign, True) for sign in (1, -1) if k in self.slidable]
        self.slots = tuple(slots)

    # The smooth field for given switch values, and the indicator functions.

    def field(self, t: Scalar, y: Y, s: tuple[Any, ...]) -> Y:
        f = self.system.vector_field(t * self.direction, y, self.system.values(s))
        return jax.tree.map(lambda x: x * self.direction, f)

    def h(self, k: int, t: Scalar, y: Y) -> tuple[Scalar, ...]:
        return self.switches[k].components(self.system, t * self.direction, y)

    def bound(self, k: int) -> Any:
        switch = self.switches[k]
        assert isinstance(switch, sgn)
        return switch.bound(self.system)

    def _rates(self, which: tuple[int, ...], t: Scalar, y: Y, state: State, s: tuple) -> tuple[Scalar, ...]:
        """dh/dt along the field with switch values `s`, of the active component of each switch in `which`."""

        def hs(t: Scalar, y: Y) -> tuple[Scalar, ...]:
            return tuple(_pick(self.h(k, t, y), state.part[k]) for k in which)

        return jax.jvp(hs, (t, y), (jnp.ones_like(t), self.field(t, y, s)))[1]

    def _signs(self, t: Scalar, state: State) -> tuple[Any, ...]:
        """Switch values of a mode, with 0 for those which slide."""
        return tuple(
            jnp.zeros((), t.dtype) if isinstance(switch, impact) else m.astype(t.dtype)
            for switch, m in zip(self.switches, state.mode)
        )

    def _linear(self, t: Scalar, y: Y, state: State, s: tuple) -> tuple[Float[Array, " m"], Float[Array, "m m"]]:
        """Rates of the slidable surfaces at `s`, and their derivatives with respect to the slidable values."""
        which = self.slidable

        def rates(sigma: Float[Array, " m"]) -> Float[Array, " m"]:
            full = list(s)
            for i, k in enumerate(which):
                full[k] = sigma[i]
            return jnp.stack(self._rates(which, t, y, state, tuple(full)))

        sigma = jnp.stack([s[k] for k in which])
        return rates(sigma), jax.jacfwd(rates)(sigma)

    def values(self, t: Scalar, y: Y, state: State) -> tuple[Any, ...]:
        """The value of every switch in a mode: signs, and the multipliers λ of those that slide, (2.20)."""
        s = self._signs(t, state)
        which = self.slidable
        if not which:
            return s
        if len(which) == 1:
            (k,) = which

            def rate(sk: Scalar) -> Scalar:
                return self._rates(which, t, y, state, s[:k] + (sk,) + s[k + 1 :])[0]

            zero = jnp.zeros((), t.dtype)
            r, slope = jax.jvp(rate, (zero,), (jnp.ones_like(zero),))
            slides = state.mode[k] == 0
            # A vanishing slope off the surface is no fault; on it the quotient is infinite, and so is found.
            lam = -r / jnp.where(slides, slope, 1)
            return s[:k] + (jnp.where(slides, lam, s[k]),) + s[k + 1 :]
        slides = jnp.stack([state.mode[k] == 0 for k in which])
        eye = jnp.eye(len(which), dtype=t.dtype)
        # Multi-affine fields need Newton's method, which for jointly affine ones ends after one step.
        for _ in range(1 if self.jointly_affine else 6):
            r, slope = self._linear(t, y, state, s)
            step = jnp.linalg.solve(jnp.where(slides[:, None], slope, eye), jnp.where(slides, -r, 0))
            full = list(s)
            for i, k in enumerate(which):
                full[k] = s[k] + step[i]
            s = tuple(full)
        return s

    def flow(self, t: Scalar, y: Y, state: State) -> Y:
        """The right-hand side in a mode; for a sliding one it is Filippov's field (2.19)."""
        return self.field(t, y, self.values(t, y, state))

    def project(self, t: Scalar, y: Y, state: State) -> Y:
        """Removes the drift off the surfaces on which the solution slides.

        The state moves along ∂f/∂s, the direction in which the switch acts, so that the result does not depend on the
        units of the state. One Newton step: exact when h is affine, else quadratic in a drift that is itself of the
        order of the local error.
        """
        which = self.slidable
        if not which:
            return y
        s = self.values(t, y, state)
        slides = jnp.stack([state.mode[k] == 0 for k in which])
        h = jnp.stack([_pick(self.h(k, t, y), state.part[k]) for k in which])
        _, slope = self._linear(t, y, state, s)
        slope = jnp.where(slides[:, None] & slides[None, :], slope, jnp.eye(len(which), dtype=t.dtype))
        h = jnp.where(slides, h, 0)
        push = -h / slope[0] if len(which) == 1 else jnp.linalg.solve(slope, -h)
        ds = [jnp.zeros_like(v) for v in s]
        for i, k in enumerate(which):
            ds[k] = jnp.where(slides[i], push[i], 0)
        _, dy = jax.jvp(lambda s: self.field(t, y, s), (s,), (tuple(ds),))
        return jax.tree.map(jnp.add, y, dy)

    # Guards: positive while the mode lasts. Slot i is the maximum over the last axis, so that the event is the
    # instant at which all of its entries have become non-positive.

    @property
    def width(self) -> int:
        return max(self.parts, default=1)

    def guards(self, t: Scalar, y: Y, state: State) -> list[list[Scalar]]:
        """`guards[slot][part]`, as scalars: stacked arrays of length two or five cost XLA's CPU code several times as
        much."""
        one = jnp.ones((), t.dtype)
        s = self.values(t, y, state) if self.slidable else ()
        rows = []
        for slot in self.slots:
            k, switch, mode = slot.switch, self.switches[slot.switch], state.mode[slot.switch]
            if slot.sliding:
                row = [jnp.where(mode == 0, self.bound(k) - slot.part * s[k], one)]
            elif isinstance(switch, relay):
                on = switch.guard(self.system, t * self.direction, y)
                off = switch.off_guard(self.system, t * self.direction, y)
                row = [-jnp.where(mode == 1, off, on)]
            elif isinstance(switch, impact):
                row = [self.h(k, t, y)[slot.part]]
            elif self.parts[k] == 1:
                row = [jnp.where(mode == 0, one, mode.astype(t.dtype) * self.h(k, t, y)[0])]
            else:
                row = self._corner_guard(slot, t, y, state)
            rows.append(row)
        return rows

    def stacked(self, rows: list[list[Any]], filler: float) -> Array:
        """The same as an array `(slots, parts, ...)`; slots with fewer parts are filled up."""
        like = jnp.full_like(rows[0][0], filler)
        return jnp.stack([jnp.stack(row + [like] * (self.width - len(row))) for row in rows])

    def _corner_guard(self, slot: Slot, t: Scalar, y: Y, state: State) -> list[Scalar]:
        """h = min(h_1, ..., h_J). Where h > 0 each component is watched alone; where h < 0 the event is the instant at
        which the last of them becomes positive; while sliding on one, the others end the surface at its tip."""
        k, j = slot.switch, slot.part
        h, mode, part = self.h(k, t, y), state.mode[k], state.part[k]
        one = jnp.ones((), t.dtype)
        alone = jnp.where((mode == 0) & (part == j), one, h[j])
        if j == 0:
            return [jnp.where(mode < 0, -h[0], alone)] + [jnp.where(mode < 0, -hi, -one) for hi in h[1:]]
        return [jnp.where(mode < 0, one, alone)]

    def known_roots(self, state: State) -> list[list[Int[Array, ""]]]:
        """How many roots each guard has at the present instant (just left, so not to be found again)."""
        rows = []
        none = jnp.zeros((), jnp.int32)
        for k, j, sliding in self.slots:
            roots, mode, part = state.roots[k], state.mode[k], state.part[k]
            if sliding:
                row = [none]
            elif part is None:
                row = [roots]
            elif isinstance(self.switches[k], impact):
                row = [jnp.where(part == j, roots, none)]
            elif j == 0:
                row = [jnp.where((part == 0) | (mode < 0) & (part == i), roots, none) for i in range(self.parts[k])]
                row[1:] = [jnp.where(mode < 0, r, none) for r in row[1:]]
            else:
                row = [jnp.where((mode >= 0) & (part == j), roots, none)]
            rows.append(row)
        return rows

    def rounding(self, fn: Any, t: Scalar, y: Y) -> Array:
        """What rounding of time and state alone can make of the entries of `fn(t, y)`: below it they count as zero."""
        flat, unravel = jfu.ravel_pytree(y)
        dt, dy = jax.jacfwd(lambda t, y: jnp.stack(fn(t, unravel(y))), argnums=(0, 1))(t, flat)
        return 8 * jnp.finfo(t.dtype).eps * (jnp.abs(dt * t) + jnp.sum(jnp.abs(dy * flat), axis=-1))

    # The choice of mode.

    def settle(
        self, t: Scalar, y: Y, state: State, at: dict[int, Bool[Array, ""]], leaves: dict[int, Int[Array, ""]]
    ) -> tuple[State, Bool[Array, ""], Bool[Array, ""]]:
        """Gives every `sgn` switch that is at its surface a mode from {0, +1, -1}.

        All of them stick if that is valid (|λ| <= b). Otherwise the worst |λ|/b is released to the sign of its λ, and
        a released switch whose dh/dt then opposes its sign is taken back, until nothing is violated.

        **Arguments:**

        - `state`: the mode so far; a switch that arrived at its surface still has the sign of the side it came from,
            and one whose side is unknown has 0.
        - `at`: for each `sgn` switch whether it is at its surface.
        - `leaves`: for each slidable switch the sign with which its λ just reached its bound, else 0.

        **Returns:** the new state, whether the solution is not unique (a repulsive surface (2.25) met without a side),
        and whether no valid assignment was found.
        """
        self, t, y = frozen((self, t, y))  # modes have no derivative
        sgns = tuple(at)
        false = jnp.zeros((), bool)
        if not sgns:
            return state, false, false
        mode = dict(enumerate(state.mode))
        came = {k: mode[k] for k in sgns}

        def look(mode: dict[int, Any]) -> tuple[dict, dict, dict]:
            trial = state._replace(mode=tuple(mode.values()))
            s = self.values(t, y, trial)
            rates = dict(zip(sgns, self._rates(sgns, t, y, trial, s)))
            slopes = {k: jnp.zeros((), t.dtype) for k in sgns}
            if self.slidable:
                _, matrix = self._linear(t, y, trial, s)
                slopes |= {k: matrix[i, i] for i, k in enumerate(self.slidable)}
            return {k: s[k] for k in sgns}, rates, slopes

        # First guess: everything at its surface sticks, unless its surface repels or its value does not act on it.
        trial = dict(mode)
        for k in sgns:
            trial[k] = jnp.where(at[k], 0, mode[k]) if k in self.slidable else mode[k]
        _, rates, slopes = look(trial)
        repels = {k: slopes[k] >= 0 for k in sgns}
        for k in sgns:
            if k in self.slidable:
                # A repulsive surface is left to the other side: beyond |λ| = 1 both fields point there.
                forced = jnp.where(repels[k], -leaves[k], leaves[k])
                passes = repels[k] & (came[k] != 0)
                trial[k] = jnp.where(at[k] & (forced != 0), forced, jnp.where(at[k] & passes, -came[k], trial[k]))
            else:
                unmoved = jnp.where(came[k] == 0, 1, came[k])
                side = jnp.where(rates[k] == 0, unmoved, jnp.sign(rates[k]).astype(jnp.int32))
                # It cannot but cross; at a double root the sign of dh/dt is rounding.
                side = jnp.where((leaves[k] != 0) & (came[k] != 0), -came[k], side)
                trial[k] = jnp.where(at[k], side, mode[k])
        if len(sgns) == 1:
            trial, wrong = self._amend(sgns, at, leaves, trial, look(trial))[0], false
        else:
            # One release or taking back a round, until nothing is violated; so many rounds do for all to change twice.
            def amend(carry: tuple) -> tuple:
                count, trial, _ = carry
                return count + 1, *self._amend(sgns, at, leaves, trial, look(trial))

            def unsettled(carry: tuple) -> Bool[Array, ""]:
                count, _, wrong = carry
                return wrong & (count < 2 * len(sgns) + 2)

            trial = {k: m.astype(jnp.int32) for k, m in trial.items()}
            begin = (jnp.zeros((), jnp.int32), trial, jnp.ones((), bool))
            _, trial, wrong = lax.while_loop(unsettled, amend, begin)

        _, rates, slopes = look(trial)
        roots = list(state.roots)
        unsure = false
        for k in sgns:
            # Leaving with dh/dt = 0 (the end of sliding with b = 1) makes a double root of h at this instant.
            simple = rates[k] * trial[k].astype(t.dtype) > 1e-10 * jnp.abs(slopes[k])
            fresh = jnp.where(trial[k] == 0, 0, jnp.where(simple, 1, 2))
            roots[k] = jnp.where(at[k], fresh, roots[k]).astype(jnp.int32)
            unsure = unsure | (at[k] & (trial[k] == 0) & (slopes[k] > 0) & (came[k] == 0))
        state = state._replace(mode=tuple(m.astype(jnp.int32) for m in trial.values()), roots=tuple(roots))
        return state, unsure, wrong

    def _amend(self, sgns: tuple, at: dict, leaves: dict, trial: dict, seen: tuple) -> tuple[dict, Bool[Array, ""]]:
        """One release, or one taking back, of the switch that violates its law most."""
        s, rates, slopes = seen
        excess, opposed = [], []
        for k in sgns:
            loose = at[k] & (trial[k] == 0) if k in self.slidable else jnp.zeros((), bool)
            excess.append(jnp.where(loose, jnp.abs(s[k]) / (self.bound(k) if k in self.slidable else 1) - 1, -1))
            free = at[k] & (trial[k] != 0)
            free = free & (leaves[k] == 0)  # its λ is at the bound (or it crosses): dh/dt may be zero but for rounding
            against = -rates[k] * trial[k].astype(rates[k].dtype)
            small = 1e-10 * jnp.abs(slopes[k])
            opposed.append(jnp.where(free & (against > small), against, 0))
        worst = jnp.stack(excess)
        back = jnp.stack(opposed)
        release = jnp.any(~(worst <= 0))  # a multiplier that is not a number is a violation too
        retake = ~release & jnp.any(back > 0)
        out = dict(trial)
        for i, k in enumerate(sgns):
            first = release & (jnp.argmax(jnp.where(jnp.isnan(worst), jnp.inf, worst)) == i)
            again = retake & (jnp.argmax(back) == i)
            taken = jnp.where(slopes[k] < 0, 0, -trial[k])
            side = jnp.where((s[k] >= 0) == (slopes[k] < 0), 1, -1)  # where dh/dt = slope (s - λ) points
            out[k] = jnp.where(first, side, jnp.where(again, taken, trial[k])).astype(jnp.int32)
        return out, release | retake
