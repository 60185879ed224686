"""The field in a mode, with the multipliers of the surfaces that hold it, and the guards of the mode.

A mode is one small integer for each switch: for `sgn` the sign +1 or -1 of its region, or 0 while sliding; for
`relay` 0 or 1; for `impact` 0 in free flight, 1 in resting contact; for `clock` the number of its ticks. There is no
table of 3^m fields (only of up to four switches are all combinations tried where they meet, `events/_mode_choice`):
being held on m surfaces at once solves m equations for the m multipliers, n_i . f(t, y, λ) + ∂h_i/∂t = 0 for sliding,
(2.19)-(2.20), and d²h_i/dt² = 0 for contact, whose multiplier is the contact force.
"""

import functools as ft
from typing import Any

import equinox as eqx
import jax
import jax.flatten_util as jfu
import jax.lax as lax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int

from .._numerics._autodiff import frozen
from .._numerics._jaxpr import dependence, is_affine, is_constant, touched
from .._numerics._linalg import parallel, Row, row, solve_rows
from .._types import Scalar, Y
from ._clocked import Clocked
from ._linearisation import Linearisation, linearise
from ._mode import BEYOND, ModeState, pick, put, Slot
from ._parameter import Path, put_parameter
from ._system import System


class SwitchedSystem(Clocked):
    """A system as the flow sees it: time multiplied by `direction` so that it always increases, and the structure of
    its switches worked out once while tracing."""

    parts: tuple[int, ...] = eqx.field(static=True)  # number of components of h, per switch
    holdable: tuple[int, ...] = eqx.field(static=True)  # switches whose value can hold the solution on their surface
    contacts: tuple[int, ...] = eqx.field(static=True)  # the impacts among them
    acts: tuple[tuple[bool, ...], ...] = eqx.field(
        static=True
    )  # the value of each of them on which leaves of the state
    jointly_affine: bool = eqx.field(static=True)  # whether the field is so in the values of all of them
    steady: bool = eqx.field(static=True)  # whether what acts on a surface that can be slid on is constant
    pairs: tuple[tuple[int, int], ...] = eqx.field(static=True)  # of `holdable`: whose surfaces may coincide
    slots: tuple[Slot, ...] = eqx.field(static=True)

    def __init__(self, system: System, direction: Any, t: Scalar, y: Y):
        super().__init__(system, direction)
        self.parts = tuple(len(k.components(system, t, y)) for k in self.switches)
        zeros = tuple(jnp.zeros((), jnp.result_type(t)) for _ in self.switches)
        one = jnp.ones_like(t)

        def rate(k: int, t: Scalar, y: Y, s: tuple) -> Any:
            return jax.jvp(lambda t, y: self.h(k, t, y), (t, y), (one, self.field(t, y, s)))[1]

        def second(k: int, s: tuple) -> Any:
            return jax.jvp(lambda t, y: rate(k, t, y, zeros), (t, y), (one, self.field(t, y, s)))[1]

        def acts(fn: Any, k: int) -> bool:
            return not is_constant(lambda sk: fn(zeros[:k] + (sk,) + zeros[k + 1 :]), zeros[k])

        def holds(k: int) -> bool:
            if self.switches[k].order == 1:
                return acts(lambda s: rate(k, t, y, s), k)
            # A contact force that acts on velocities, and so on d²h/dt²; the corner of two walls cannot hold.
            smooth = self.switches[k].order == 2 and self.parts[k] == 1
            return smooth and is_constant(lambda s: rate(k, t, y, s), zeros) and acts(lambda s: second(k, s), k)

        self.holdable = tuple(k for k in range(len(self.switches)) if holds(k))
        self.contacts = tuple(k for k in self.holdable if self.switches[k].order == 2)

        def pulled(values: tuple) -> list[Any]:
            return jax.tree.leaves(self.field(t, y, put(zeros, self.holdable, values)))

        nought = tuple(zeros[k] for k in self.holdable)
        self.acts = tuple(
            tuple(touched(lambda v, i=i: pulled(put(nought, (i,), (v,))), v)) for i, v in enumerate(nought)
        )
        self.jointly_affine = is_affine(pulled, nought)
        dry = [k for k in self.holdable if k not in self.contacts]

        def effects(args: tuple[Scalar, Y, tuple]) -> list[Any]:
            t, y, s = args

            def of(j: int) -> Any:
                return jax.jvp(
                    lambda sj: [rate(k, t, y, s[:j] + (sj,) + s[j + 1 :]) for k in dry], (s[j],), (jnp.ones_like(s[j]),)
                )[1]

            return [of(j) for j in self.holdable]

        self.steady = not dry or is_constant(effects, (t, y, zeros))
        self.pairs = ()
        if len(dry) > 1:
            # Normals of surfaces that coincide are parallel, so that both depend on the same states.
            seen = [dependence(lambda y, k=k: self.h(k, t, y), y).any(0) for k in dry]
            self.pairs = tuple(
                (self.holdable.index(dry[i]), self.holdable.index(dry[j]))
                for j in range(len(dry))
                for i in range(j)
                if (seen[i] & seen[j]).any()
            )
        slots = []
        for k, number in enumerate(self.parts):
            slots += [Slot(k, part, False) for part in range(number)]
            if k in self.holdable:
                slots += [Slot(k, sign, True) for sign in ((1,) if k in self.contacts else (1, -1))]
        self.slots = tuple(slots)

    @classmethod
    def forwards(cls, system: System, t: Scalar, y: Y) -> "SwitchedSystem":
        """Of a system in the time of its user; `t` and `y` tell shapes and structure only."""
        return cls(system, jnp.ones_like(t), t, y)

    def with_system(self, system: System) -> "SwitchedSystem":
        """The same structure with other parameters."""
        return eqx.tree_at(lambda m: m.system, self, system)

    def with_parameter(self, path: Path, value: Any) -> "SwitchedSystem":
        return self.with_system(put_parameter(self.system, path, value))

    def state_at(self, t: Scalar, y: Y, mode: tuple) -> ModeState:
        """A mode, with the component of each h that is active at a state: the least."""
        parts = [
            None if n == 1 else jnp.argmin(jnp.stack(self.h(k, t, y))).astype(jnp.int32)
            for k, n in enumerate(self.parts)
        ]
        return ModeState.of(mode, parts)

    # The smooth field for given switch values, and the indicator functions.

    def field(self, t: Scalar, y: Y, s: tuple[Any, ...]) -> Y:
        f = self.system.vector_field(self.time(t), y, self.system.values(s))
        return jax.tree.map(lambda x: x * self.direction, f)

    def h(self, k: int, t: Scalar, y: Y) -> tuple[Scalar, ...]:
        return self.switches[k].components(self.system, self.time(t), y)

    def bound(self, k: int) -> Any:
        return self.switches[k].bound(self.system)

    def static(self, k: int) -> bool:
        """Whether switch k has a static friction point, so that it holds beyond |λ| = 1."""
        return self.switches[k].static

    def edge(self, k: int, value: Scalar, slack: float) -> Int[Array, ""]:
        """The sign of the bound that the value of a held `sgn` switch is at, or 0.

        Running backwards, what is held with |λ| > 1 by static friction is let go where |λ| falls to 1: there the
        field beside the surface turns round (section 6.7). Which side of 1 it came from is remembered by `BEYOND`.
        """
        sign = jnp.sign(value).astype(jnp.int32)
        edge = jnp.where(jnp.abs(value) >= (1 - slack) * self.bound(k), sign, 0)
        if self.static(k):
            edge = edge + jnp.where((self.direction < 0) & (jnp.abs(value) > 1 + slack), BEYOND * sign, 0)
        return edge

    def held(self, k: int, mode: Any) -> Bool[Array, ""]:
        """Whether `mode` of switch k holds the solution on its surface."""
        return mode == self.switches[k].holding

    def holds(self, mode: Any) -> bool:
        """Whether one of its switches does; of a mode that is known."""
        return any(bool(self.held(k, mode[k])) for k in self.holdable)

    def level(self, k: int, t: Scalar, y: Y, state: ModeState) -> Scalar:
        """What its multiplier keeps at zero: the active component of h; for a contact dh/dt, on which forces act."""
        self = self._in(state)

        def h(t: Scalar, y: Y) -> Scalar:
            return pick(self.h(k, t, y), state.part[k])

        if k not in self.contacts:
            return h(t, y)
        zeros = tuple(jnp.zeros((), t.dtype) for _ in self.switches)
        return jax.jvp(h, (t, y), (jnp.ones_like(t), self.field(t, y, zeros)))[1]

    def rates(self, which: tuple[int, ...], t: Scalar, y: Y, state: ModeState, s: tuple) -> tuple[Scalar, ...]:
        """The rates of change of `level` for each switch in `which`, for switch values `s`."""
        self = self._in(state)

        def levels(t: Scalar, y: Y) -> tuple[Scalar, ...]:
            return tuple(self.level(k, t, y, state) for k in which)

        return jax.jvp(levels, (t, y), (jnp.ones_like(t), self.field(t, y, s)))[1]

    def approach(self, k: int, t: Scalar, y: Y, state: ModeState) -> Scalar:
        """dh/dt of switch k along the flow (the active component of h)."""
        self = self._in(state)
        f = self.flow(t, y, state)
        return jax.jvp(lambda t, y: pick(self.h(k, t, y), state.part[k]), (t, y), (jnp.ones_like(t), f))[1]

    def signs(self, t: Scalar, state: ModeState) -> tuple[Any, ...]:
        """Switch values of a mode, with 0 for those which are held, and for contacts."""
        return tuple(switch.value(m, t.dtype) for switch, m in zip(self.switches, state.mode))

    def linearised(self, t: Scalar, y: Y, state: ModeState, s: tuple) -> Linearisation:
        """The field and the rates of the holdable surfaces at `s`, and how they change with the holdable values."""
        self = self._in(state)
        tree = jax.tree.structure(y)

        def field(*values: Scalar) -> list[Any]:
            return jax.tree.leaves(self.field(t, y, put(s, self.holdable, values)))

        def levels(t: Scalar, *leaves: Any) -> list[Scalar]:
            return [self.level(k, t, jax.tree.unflatten(tree, leaves), state) for k in self.holdable]

        near = linearise(field, tuple(s[k] for k in self.holdable), levels, t, y, self.acts)
        if self.contacts and len(self.holdable) > 1:
            # Friction along a contact that holds already is free, and so is that of a contact without force: a trace of
            # compliance gives it the value 0.
            least = jnp.sqrt(jnp.finfo(t.dtype).tiny)
            for i in [i for i, k in enumerate(self.holdable) if k not in self.contacts]:
                total = sum(jnp.sum(jnp.abs(x)) for x in jax.tree.leaves(near.slope[i]))
                trace = jnp.where(total == 0, least, 4 * jnp.finfo(t.dtype).eps * total)
                own = row([trace if i == j else jnp.zeros_like(trace) for j in range(len(self.holdable))])
                near.slope[i] = jax.tree.map(jnp.subtract, near.slope[i], own)
        return near

    def linear(self, t: Scalar, y: Y, state: ModeState, s: tuple) -> tuple[Float[Array, " m"], Float[Array, "m m"]]:
        """Rates of the holdable surfaces at `s`, and their derivatives with respect to the holdable values."""
        near = self.linearised(t, y, state, s)
        return jnp.asarray(near.rates), jnp.stack([jnp.asarray(rates) for rates in near.slope])

    def multipliers(self, slope: list[Any], right: Row, held: Any) -> Any:
        """σ with slope σ = right over the holdable switches that are `held`, and 0 for the others.

        Where surfaces coincide (friction elements on one velocity) slope is singular: it determines only the sum of
        what they do. They share it in proportion to their bounds, |λ_i| / b_i = |λ_j| / b_j, as elastic elements do
        that yield at the same deflection. No other split holds for longer: all of them reach their bounds together,
        each in the direction in which it resists, and so when the sum of their strengths is spent.
        """
        m, zero, one = len(slope), jnp.zeros_like(right[0]), jnp.ones_like(right[0])
        # Off the surface a slope may vanish, and must not matter; on it the quotient is infinite, and so is noticed.
        units = [row([one if i == j else zero for j in range(m)]) for i in range(m)]
        rows = [
            jax.tree.map(lambda x, h, u, i=i: jnp.where(held[i] & h, x, u), slope[i], held, units[i]) for i in range(m)
        ]
        right, matrix = jax.tree.map(lambda r, h: jnp.where(h, r, 0), right, held), list(rows)
        for i, j in self.pairs:
            same = held[i] & held[j] & parallel(rows[i], rows[j])
            # The row tells in which direction each of them pushes the surface, and either of the two rows will do.
            bounds = {i: self.bound(self.holdable[j]), j: -self.bound(self.holdable[i])}
            weights = row([jnp.asarray(bounds.get(n, zero), zero.dtype) for n in range(m)])
            share = jax.tree.map(lambda x, w: jnp.where(x < 0, -w, w), rows[i], weights)
            matrix[j] = jax.tree.map(lambda a, b, same=same: jnp.where(same, a, b), share, matrix[j])
            one_of = row([same if n == j else jnp.zeros_like(same) for n in range(m)])
            right = jax.tree.map(lambda r, gone: jnp.where(gone, 0, r), right, one_of)
        return solve_rows(matrix, right)

    def _resolved(self, t: Scalar, y: Y, state: ModeState) -> tuple[tuple[Any, ...], Y]:
        """The value of every switch in a mode, and the field for them."""
        self = self._in(state)
        s, which = self.signs(t, state), self.holdable
        if not which:
            return s, self.field(t, y, s)
        held = row([self.held(k, state.mode[k]) for k in which])

        def moves(s: tuple) -> tuple[Row, Linearisation]:
            near = self.linearised(t, y, state, s)
            return self.multipliers(near.slope, jax.tree.map(jnp.negative, near.rates), held), near

        def after(s: tuple, move: Row) -> tuple:
            return put(s, which, [s[k] + d for k, d in zip(which, move)])

        if self.jointly_affine:
            move, near = moves(s)
            return after(s, move), near.pulled(near.field, move)
        # Newton's method for a multi-affine field, in a fixed number of steps: such a loop can be transposed. Friction
        # proportional to a contact force has no effect where that is zero: the search sets out from another value.
        begin = [jnp.where(h, 1, s[k]) if k in self.contacts else s[k] for k, h in zip(which, held)]
        s = lax.fori_loop(0, 6, lambda _, s: after(s, moves(s)[0]), put(s, which, begin))
        return s, self.field(t, y, s)

    def values(self, t: Scalar, y: Y, state: ModeState) -> tuple[Any, ...]:
        """The value of every switch in a mode: signs, and the multipliers λ of those that are held, (2.20)."""
        return self._resolved(t, y, state)[0] if self.holdable else self.signs(t, state)

    def flow(self, t: Scalar, y: Y, state: ModeState) -> Y:
        """The right-hand side in a mode; for a sliding one it is Filippov's field (2.19)."""
        return self._resolved(t, y, state)[1]

    def force(self, t: Scalar, y: Y, state: ModeState) -> Scalar:
        """The largest component of the terms that make up the field: with it those which cancel where it is held."""
        self = frozen(self._in(state))
        t, y = frozen((t, y))
        s = self.values(t, y, state)
        size = jax.tree.map(jnp.abs, self.field(t, y, s))
        for k in self.holdable:
            unit = tuple(jnp.where(i == k, s[k], 0) for i in range(len(s)))
            pull = jax.jvp(lambda s: self.field(t, y, s), (s,), (unit,))[1]
            size = jax.tree.map(lambda a, b: a + jnp.abs(b), size, pull)
        return ft.reduce(jnp.maximum, [jnp.max(x) for x in jax.tree.leaves(size)])

    def project(self, t: Scalar, y: Y, state: ModeState) -> Y:
        """Removes the drift off the surfaces that hold the solution.

        The state moves along ∂f/∂s, the direction in which the switch acts, so that the result does not depend on the
        units of the state; positions move along what this is in a unit of time. One Newton step: exact when h is
        affine, else quadratic in a drift that is itself of the order of the local error.
        """
        which = self.holdable
        if not which:
            return y
        self = self._in(state)
        s = self.signs(t, state) if self.jointly_affine and not self.contacts else self.values(t, y, state)
        held = row([self.held(k, state.mode[k]) for k in which])
        near = self.linearised(t, y, state, s)

        def closing(gaps: list[Scalar]) -> Row:
            """The values which close the gaps."""
            found = self.multipliers(near.slope, row([-g for g in gaps]), held)
            return jax.tree.map(lambda h, d: jnp.where(h, d, 0), held, found)

        if self.contacts:
            gaps = [self.h(k, t, y)[0] if k in self.contacts else jnp.zeros_like(t) for k in which]
            push = near.pulled(jax.tree.map(jnp.zeros_like, y), closing(gaps))
            dq = jax.jvp(lambda y: self.field(t, y, s), (y,), (push,))[1]
            y = jax.tree.map(jnp.add, y, dq)
        return near.pulled(y, closing([self.level(k, t, y, state) for k in which]))

    # Guards: positive while the mode lasts. Slot i is the maximum over the last axis, so that the event is the
    # instant at which all of its entries have become non-positive.

    @property
    def width(self) -> int:
        return max(self.parts, default=1)

    def guards(
        self,
        t: Scalar,
        y: Y,
        state: ModeState,
        wanted: tuple[bool, ...] | None = None,
        s: tuple[Any, ...] | None = None,
    ) -> list[list[Scalar]]:
        """`guards[slot][part]` (of the slots that are `wanted`, else empty), as scalars: stacked arrays of two or
        five cost XLA's CPU code several times as much. `s`: the values of the switches, if they are known."""
        self = self._in(state)
        wanted = (True,) * len(self.slots) if wanted is None else wanted
        if s is None:
            s = self.values(t, y, state) if any(w and slot.holding for w, slot in zip(wanted, self.slots)) else ()
        rows = []
        for slot, want in zip(self.slots, wanted):
            if not want:
                rows.append([])
                continue
            k = slot.switch
            if slot.holding:
                left = self.switches[k].bound_guard(self, slot, s[k], state)
                rows.append([jnp.where(self.held(k, state.mode[k]), left, jnp.ones((), t.dtype))])
            else:
                rows.append(self.switches[k].guard_row(self, slot, t, y, state))
        return rows

    def stacked(self, rows: list[list[Any]], filler: float) -> Array:
        """The same as an array `(slots, parts, ...)`; slots with fewer parts are filled up."""
        like = jnp.full_like(rows[0][0], filler)
        return jnp.stack([jnp.stack(row + [like] * (self.width - len(row))) for row in rows])

    def known_roots(self, state: ModeState) -> list[list[Int[Array, ""]]]:
        """How many roots each guard has at the present instant (just left, so not to be found again)."""
        rows = []
        for slot in self.slots:
            k, none = slot.switch, jnp.zeros((), jnp.int32)
            roots, held = state.roots[k], self.held(k, state.mode[k])
            if slot.holding:
                at = roots == slot.part
                if self.static(k):
                    at = at | (roots == slot.part * (BEYOND + 1))
                rows.append([jnp.where(held & at, 1, none)])
                continue
            roots = jnp.where(held, none, roots) if k in self.holdable else roots
            rows.append(self.switches[k].known_row(self, slot, roots, state))
        return rows

    def sizes(self, fn: Any, t: Scalar, y: Y, dt: Scalar, dy: Y) -> Array:
        """Sums of the absolute values of the terms of d`fn` for changes `dt` and `dy`, whatever they cancel to."""
        flat, unravel = jfu.ravel_pytree(y)
        by_t, by_y = jax.jacfwd(lambda t, y: jnp.stack(fn(t, unravel(y))), argnums=(0, 1))(t, flat)
        return jnp.abs(by_t * dt) + jnp.sum(jnp.abs(by_y * jfu.ravel_pytree(dy)[0]), axis=-1)

    def rounding(self, fn: Any, t: Scalar, y: Y, size: Y | None = None) -> Array:
        """What rounding of time and state alone can make of the entries of `fn(t, y)`: below it they count as zero.
        `size`: that of the terms of which the state is the sum, if they may cancel."""
        return 8 * jnp.finfo(t.dtype).eps * self.sizes(fn, t, y, t, y if size is None else size)
