"""The field in a mode, with the multipliers of the surfaces that hold it, and the guards of the mode.

A mode is one small integer for each switch: for `sgn` the sign +1 or -1 of its region, or 0 while sliding; for
`relay` 0 or 1; for `impact` 0 in free flight, 1 in resting contact; for `clock` the number of its ticks. There is no
table of 3^m fields (only of up to four that act on each other are all modes tried, `events/_mode_choice`):
being held on m surfaces at once solves m equations for the m multipliers, n_i . f(t, y, λ) + ∂h_i/∂t = 0 for sliding,
(2.19)-(2.20), and d²h_i/dt² = 0 for contact, whose multiplier is the contact force.
"""

import functools as ft
from collections.abc import Callable, Sequence
from typing import Any

import equinox as eqx
import jax
import jax.flatten_util as jfu
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int

from .._numerics._autodiff import frozen
from .._numerics._jaxpr import dependence, is_affine, is_constant
from .._numerics._select import select
from .._types import Mode, Scalar, Y
from ._clocked import Clocked
from ._coupling import Coupling
from ._mode import BEYOND, ModeState, OFF, pick, put, Slot
from ._one_sided import one_sided, Sides, sides_of
from ._sliding import linearised, project, resolved
from ._system import System


NONE = -1  # in place of a switch


class SwitchedSystem(Clocked):
    """A system as the flow sees it: time multiplied by `direction` so that it always increases, and the structure of
    its switches worked out once while tracing."""

    parts: tuple[int, ...] = eqx.field(static=True)  # number of components of h, per switch
    holdable: tuple[int, ...] = eqx.field(static=True)  # switches whose value can hold the solution on their surface
    contacts: tuple[int, ...] = eqx.field(static=True)  # the impacts among them
    holding: tuple[int, ...] = eqx.field(static=True)  # of `holdable`: in which mode
    acts: tuple[tuple[bool, ...], ...] = eqx.field(
        static=True
    )  # the value of each of them on which leaves of the state
    jointly_affine: bool = eqx.field(static=True)  # whether the field is so in the values of all of them
    steady: bool = eqx.field(static=True)  # whether what acts on a surface that can be slid on is constant
    pairs: tuple[tuple[int, int], ...] = eqx.field(static=True)  # of `holdable`: whose surfaces may coincide
    normal: tuple[tuple[int, int], ...] = eqx.field(static=True)  # a contact, and friction that may be along its normal
    coupling: Coupling = eqx.field(static=True)  # of `holdable`: which values act on which surfaces
    apart: tuple[bool, ...] = eqx.field(static=True)  # which have nothing to do with the mode of any other
    contact: tuple[int, ...] = eqx.field(static=True)  # of each the switch while whose contact is closed it is there
    slots: tuple[Slot, ...] = eqx.field(static=True)
    sides: Sides | None = eqx.field(static=True)  # kinks of the field that have the sign of the mode

    def __init__(
        self, system: System, direction: Any, t: Scalar, y: Y, smooth: bool = False, crossed: tuple[int, ...] = ()
    ):
        """`smooth`: whether the field of a mode is to be smooth beyond its surfaces, see `_one_sided`. `crossed`:
        switches that are taken for some which cannot hold the solution, whether they can or not."""
        super().__init__(system, direction)
        self.sides = None
        self.parts = tuple(len(k.components(system, t, y)) for k in self.switches)
        zeros = tuple(jnp.zeros((), jnp.result_type(t)) for _ in self.switches)
        one, order = jnp.ones_like(t), [switch.order for switch in self.switches]

        def rates(which: list[int], t: Scalar, y: Y, s: tuple) -> list[tuple[Scalar, ...]]:
            def h(t: Scalar, y: Y) -> list[tuple[Scalar, ...]]:
                return [self.h(k, t, y) for k in which]

            return jax.jvp(h, (t, y), (one, self.field(t, y, s)))[1]

        def second(s: tuple) -> list[tuple[Scalar, ...]]:
            return jax.jvp(lambda t, y: rates(hard, t, y, zeros), (t, y), (one, self.field(t, y, s)))[1]

        # A contact is a force that acts on velocities, and so on d²h/dt²; the corner of two walls cannot hold.
        reach = self._reach(range(len(order)), lambda s: rates(list(range(len(order))), t, y, s), zeros)
        hard = [k for k, n in enumerate(order) if n == 2 and self.parts[k] == 1 and not reach[k].any()]
        for k, row in zip(hard, self._reach(hard, second, zeros)):
            if row[k]:  # a force that acts on the gap of its own contact
                reach[k] = row
        signs = [n == 1 and not switch.jumps for n, switch in zip(order, self.switches)]
        may = [(signs[k] or k in hard) and k not in crossed for k in range(len(order))]
        self.holdable = tuple(k for k in range(len(order)) if may[k] and reach[k, k])
        self.contacts = tuple(k for k in self.holdable if order[k] == 2)
        self.holding = tuple(self.switches[k].holding for k in self.holdable)

        def pulled(values: tuple) -> list[Any]:
            return jax.tree.leaves(self.field(t, y, put(zeros, self.holdable, values)))

        nought = tuple(zeros[k] for k in self.holdable)
        self.acts = tuple(map(tuple, dependence(pulled, nought).T.tolist()))
        self.jointly_affine = is_affine(pulled, nought)
        dry = [k for k in self.holdable if k not in self.contacts]

        def effects(args: tuple[Scalar, Y, tuple]) -> list[Any]:
            t, y, s = args

            at = tuple(s[j] for j in self.holdable)

            def of(ds: tuple) -> Any:
                return jax.jvp(lambda *held: rates(dry, t, y, put(s, self.holdable, held)), at, ds)[1]

            return jax.vmap(of)(tuple(jnp.eye(len(at), dtype=one.dtype)))

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
        self.normal = ()
        if dry and self.contacts:
            opens = {c: dependence(lambda y, c=c: rates([c], t, y, zeros), y).any(0) for c in self.contacts}
            slides = {k: dependence(lambda y, k=k: self.h(k, t, y), y).any(0) for k in dry}
            self.normal = tuple(
                (self.holdable.index(c), self.holdable.index(k))
                for c in self.contacts
                for k in dry
                if (opens[c] & slides[k]).any()
            )
        # Whether the mode of another one has to do with it: of those whose mode is chosen at an event.
        free = np.array([(k in self.contacts or n == 1) and k not in crossed for k, n in enumerate(order)], bool)
        others = (reach | reach.T) & free & ~np.eye(len(order), dtype=bool)
        self.apart = tuple((~others.any(axis=1)).tolist())
        self.coupling = Coupling.of(reach[np.ix_(self.holdable, self.holdable)], self.pairs)
        places = {switch.name: k for k, switch in enumerate(self.switches)} | {"": NONE}
        self.contact = tuple(places[switch.condition] for switch in self.switches)
        slots = []
        for k, number in enumerate(self.parts):
            slots += [Slot(k, part, False) for part in range(number)]
            if k in self.holdable:
                slots += [Slot(k, sign, True) for sign in ((1,) if k in self.contacts else (1, -1))]
        self.slots = tuple(slots)
        self.sides = sides_of(self, t, y) if smooth else None

    def _reach(self, which: Sequence[int], fn: Callable[[tuple], Any], zeros: tuple) -> np.ndarray:
        """Which results of `fn` (for each switch in `which` as many as it has components) depend on which values."""
        owner, acts = np.repeat(np.array(which, int), [self.parts[k] for k in which]), dependence(fn, zeros)
        return np.array([acts[owner == k].any(axis=0) for k in which], bool).reshape(len(which), len(zeros))

    @classmethod
    def forwards(cls, system: System, t: Scalar, y: Y, smooth: bool = False) -> "SwitchedSystem":
        """Of a system in the time of its user; `t` and `y` tell shapes and structure only."""
        return cls(system, jnp.ones_like(t), t, y, smooth)

    def with_system(self, system: System) -> "SwitchedSystem":
        """The same structure with other parameters."""
        return eqx.tree_at(lambda m: m.system, self, system)

    def state_at(self, t: Scalar, y: Y, mode: tuple) -> ModeState:
        """A mode, with the component of each h that is active at a state: the least."""
        parts = [
            None if n == 1 else jnp.argmin(jnp.stack(self.h(k, t, y))).astype(jnp.int32)
            for k, n in enumerate(self.parts)
        ]
        return ModeState.of(mode, parts)

    # The smooth field for given switch values, and the indicator functions.

    def field(self, t: Scalar, y: Y, s: tuple[Any, ...]) -> Y:
        if self.sides is not None:
            f = one_sided(self.system, self.sides, self.time(t), y, s)
        else:
            f = self.system.vector_field(self.time(t), y, self.system.values(s))
        return jax.tree.map(lambda x: x * self.direction, f)

    def h(self, k: int, t: Scalar, y: Y) -> tuple[Scalar, ...]:
        return self.switches[k].components(self.system, self.time(t), y)

    def least(self, k: int, t: Scalar, y: Y) -> Scalar:
        """h of switch k, the least of its components. By comparisons, as XLA may work a component out twice, rounded
        otherwise: `jnp.min` would find its minimum nowhere then, and have no derivative."""
        return ft.reduce(lambda a, b: select(b < a, b, a), self.h(k, t, y))

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
        edge = select(jnp.abs(value) >= (1 - slack) * self.bound(k), sign, 0)
        if self.static(k):
            edge = edge + select((self.direction < 0) & (jnp.abs(value) > 1 + slack), BEYOND * sign, 0)
        return edge

    def conditional(self, k: int) -> bool:
        """Whether switch k is there only while a contact is closed."""
        return self.contact[k] != NONE

    def absent(self, k: int, mode: Mode) -> Bool[Array, ""]:
        """Whether switch k, a conditional one, is not there, as its contact is open."""
        return ~self.switches[self.contact[k]].closed(mode[self.contact[k]])

    def present(self, mode: Mode) -> Mode:
        """The mode without what is not there."""
        if not any(map(self.conditional, range(len(mode)))):
            return mode
        return tuple(
            select(self.absent(k, mode), OFF, m).astype(jnp.int32) if self.conditional(k) else m
            for k, m in enumerate(mode)
        )

    def held(self, k: int, mode: Any) -> Bool[Array, ""]:
        """Whether `mode` of switch k holds the solution on its surface."""
        return mode == self.switches[k].holding

    def holds(self, *modes: Any) -> bool:
        """Whether one of its switches does; in any of some modes that are known."""
        switches, holding = list(self.holdable), np.array(self.holding, int)
        return bool(np.any(np.stack(modes)[:, switches] == holding))

    def gap_is_held(self, contact: int, friction: int, t: Scalar, y: Y, state: ModeState) -> Bool[Array, ""]:
        """Whether friction along the normal of a contact sticks and so keeps its gap as it is, since the rate of the
        gap is a multiple of the sliding velocity. (A gap of zero would be left with its rounding.)"""
        model, t, y = frozen((self._in(state), t, y))

        def both(t: Scalar, y: Y) -> tuple[Scalar, Scalar]:
            return model.level(contact, t, y, state), model.level(friction, t, y, state)

        zeros = tuple(jnp.zeros((), t.dtype) for _ in model.switches)
        unit = put(zeros, (friction,), (jnp.ones((), t.dtype),))
        push = jax.jvp(lambda *s: model.field(t, y, s), zeros, unit)[1]
        opening, sliding = both(t, y)
        by_force = jax.jvp(lambda y: both(t, y), (y,), (push,))[1]
        ratio = by_force[0] / select(by_force[1] == 0, 1, by_force[1])
        multiple = ratio * sliding
        same = jnp.abs(opening - multiple) <= 1e-6 * (jnp.abs(opening) + jnp.abs(multiple))
        return model.held(friction, state.mode[friction]) & same

    def level(self, k: int, t: Scalar, y: Y, state: ModeState) -> Scalar:
        """What its multiplier keeps at zero: the active component of h; for a contact dh/dt, on which forces act."""
        return self.levels((k,), t, y, state)[0]

    def levels(self, which: tuple[int, ...], t: Scalar, y: Y, state: ModeState) -> list[Scalar]:
        """`level` of several switches. (One field serves all contacts: with one for each, tracing took the square of
        their number.)"""
        self = self._in(state)
        contacts = [k for k in which if k in self.contacts]

        def h(which: Sequence[int], t: Scalar, y: Y) -> list[Scalar]:
            return [pick(self.h(k, t, y), state.part[k]) for k in which]

        rates: dict[int, Scalar] = {}
        if contacts:
            zeros = tuple(jnp.zeros((), t.dtype) for _ in self.switches)
            along = jnp.ones_like(t), self.field(t, y, zeros)
            rates = dict(zip(contacts, jax.jvp(ft.partial(h, contacts), (t, y), along)[1]))
        return [rates[k] if k in rates else h((k,), t, y)[0] for k in which]

    def rates(self, which: tuple[int, ...], t: Scalar, y: Y, state: ModeState, s: tuple) -> tuple[Scalar, ...]:
        """The rates of change of `level` for each switch in `which`, for switch values `s`."""
        self = self._in(state)

        def levels(t: Scalar, y: Y) -> tuple[Scalar, ...]:
            return tuple(self.levels(which, t, y, state))

        return jax.jvp(levels, (t, y), (jnp.ones_like(t), self.field(t, y, s)))[1]

    def approach(self, k: int, t: Scalar, y: Y, state: ModeState, f: Y | None = None) -> Scalar:
        """dh/dt of switch k along the flow (the active component of h). `f`: the field there, if it is known."""
        self = self._in(state)
        f = self.flow(t, y, state) if f is None else f
        return jax.jvp(lambda t, y: pick(self.h(k, t, y), state.part[k]), (t, y), (jnp.ones_like(t), f))[1]

    def signs(self, t: Scalar, state: ModeState) -> tuple[Any, ...]:
        """Switch values of a mode, with 0 for those which are held, and for contacts."""
        return tuple(switch.value(m, t.dtype) for switch, m in zip(self.switches, state.mode))

    def linear(self, t: Scalar, y: Y, state: ModeState, s: tuple) -> tuple[Float[Array, " m"], Float[Array, "m m"]]:
        """Rates of the holdable surfaces at `s`, and their derivatives with respect to the holdable values."""
        near = linearised(self._in(state), t, y, state, s)
        return jnp.asarray(near.rates), self.coupling.matrix(near.slope)

    def values(self, t: Scalar, y: Y, state: ModeState) -> tuple[Any, ...]:
        """The value of every switch in a mode: signs, and the multipliers λ of those that are held, (2.20)."""
        return self.values_and_flow(t, y, state)[0] if self.holdable else self.signs(t, state)

    def flow(self, t: Scalar, y: Y, state: ModeState) -> Y:
        """The right-hand side in a mode; for a sliding one it is Filippov's field (2.19)."""
        return self.values_and_flow(t, y, state)[1]

    def values_and_flow(self, t: Scalar, y: Y, state: ModeState) -> tuple[tuple[Any, ...], Y]:
        """`values` and `flow`, worked out once."""
        return resolved(self._in(state), t, y, state)

    def project(self, t: Scalar, y: Y, state: ModeState, s: tuple[Any, ...] | None = None) -> Y:
        """Removes the drift off the surfaces that hold the solution. `s`: the values there, if they are known."""
        return project(self._in(state), t, y, state, s) if self.holdable else y

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
                rows.append([select(self.held(k, state.mode[k]), left, jnp.ones((), t.dtype))])
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
                rows.append([select(held & at, 1, none)])
                continue
            roots = select(held, none, roots) if k in self.holdable else roots
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
