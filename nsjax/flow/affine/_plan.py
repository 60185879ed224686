"""Which models the exact flow is made for, and what of them stays the same in all modes."""

import functools as ft
from collections.abc import Callable
from typing import NamedTuple

import diffrax as dfx
import jax
import jax.flatten_util as jfu
import jax.numpy as jnp
from jaxtyping import Array, Float

from ..._numerics._jaxpr import dependence, is_constant
from ..._numerics._select import select
from ..._numerics._time_dependence import Forcing, forcing, time_dependence
from ..._types import Scalar, Y
from ...system._mode import ModeState, put, Slot
from ...system._model import SwitchedSystem
from ...system._relay import relay
from .._loop import Flow
from ..steppers._exponential import affine_parts


Flat = Float[Array, " n"]
Columns = Float[Array, "rows m"]
"""A function that is affine in z: its rows times z, with z = (y, 1) or, where time enters, z = (y, S, C, 1)."""

MOST_SWITCHES = 18  # whose modes make one 32-bit number


class GuardRow(NamedTuple):
    """Guards of one switch of which only one can fall to zero in a mode: its slots while free and while holding. Of a
    surface of several components each has a row of its own."""

    switch: int
    free: Slot | None
    held: Slot | None


class Plan(NamedTuple):
    """What is known of a model while it is traced."""

    size: int  # of the state
    timed: bool  # whether time enters
    rows: tuple[GuardRow, ...]
    pattern: tuple[tuple[bool, ...], ...]  # which entries of the matrices of all modes may not be zero
    crossed: dict[int, tuple[int, ...]]  # switches that are only crossed: on which surfaces that can hold they act

    @property
    def width(self) -> int:
        """The number of components of z."""
        return self.size + (3 if self.timed else 1)

    def of(self, k: int) -> list[int]:
        """The rows of a switch."""
        return [r for r, row in enumerate(self.rows) if row.switch == k]


class Constants(NamedTuple):
    """What stays the same in all modes, for one lane or with lanes along the last axis."""

    squared: Scalar  # the square of the angular frequency of the forcing
    push: dict[int, Flat]  # of each switch that can hold: the derivative of the field by its value
    gain: dict[int, Scalar]  # what it adds to its own dh/dt, of contacts d²h/dt²
    level: dict[int, Flat]  # of contacts: dh/dt in flight as a row times z
    bound: dict[int, Scalar]  # of λ
    restitution: dict[int, Scalar]
    pull: dict[int, Columns]  # of each `sgn` switch that is only crossed: the derivative of the field by its value
    levels: dict[int, Columns]  # of relays: the indicator functions of their two surfaces


class Problem(NamedTuple):
    """One solve of a model that has a plan."""

    flow: Flow
    model: SwitchedSystem  # that of the plan
    plan: Plan
    constants: Constants
    like: Y  # a state
    theta: float  # the phase that an arc may pass through


def planned(
    model: SwitchedSystem, meter: dfx.AbstractProgressMeter, state: ModeState, t: Scalar, y: Y
) -> tuple[SwitchedSystem, Plan] | None:
    """The plan of a model that is affine in every mode, and the model as it sees it; None for any other.

    Its switches are of two kinds: those that may hold the solution, `sgn` and `impact` with one h each, none of which
    acts on the surface of another one (of friction beside a wall, or of three coupled surfaces, a third of the events
    are not plain, and sweeps took up to twice the time of the general flow); and those that are only crossed: relays,
    and `sgn` switches whose effect vanishes on their surface, as springs and stops of any number of components.
    """
    if not isinstance(meter, dfx.NoProgressMeter) or len(model.switches) > MOST_SWITCHES:
        return None
    # Of switches with levels the exact flow knows relays only, whose two levels it writes as rows.
    if any(s.condition or s.ticking or (s.levels and not isinstance(s, relay)) for s in model.switches):
        return None
    if any(s.signed and s.jumps for s in model.switches):
        return None
    zeros = tuple(jnp.zeros_like(t) for _ in model.switches)
    crossed = tuple(k for k in range(len(zeros)) if not _simple(model, k, t, y) and _let_through(model, k, t, y))
    if crossed:
        model = SwitchedSystem(model.system, model.direction, t, y, crossed=crossed)
    for k, switch in enumerate(model.switches):
        newton = k in model.contacts and switch.restitution_fn is not None
        if k not in crossed and not (_simple(model, k, t, y) and (switch.signed or newton)):
            return None
    if not (model.steady and model.jointly_affine):
        return None
    fields = [lambda t, y: model.field(t, y, zeros), lambda t, y: model.flow(t, y, state)]
    fields += [ft.partial(pull, model, k, zeros) for k in crossed]
    if model.slots:
        fields.append(lambda t, y: model.guards(t, y, state))
    if not all(all(affine_parts(fn, t, y)) for fn in fields):
        return None
    plan = _plan(model, crossed, state, t, y)
    known: list[Forcing | None] = []
    jax.eval_shape(lambda t: known.append(frequency(model, plan, t, y)), t)  # nothing of it stays in the program
    return None if known[0] is None or known[0].grows else (model, plan)


def pull(model: SwitchedSystem, k: int, s: tuple, t: Scalar, y: Y) -> Y:
    """The derivative of the field by the value of switch k."""
    return jax.jvp(lambda value: model.field(t, y, put(s, (k,), (value,))), (s[k],), (jnp.ones_like(s[k]),))[1]


def _simple(model: SwitchedSystem, k: int, t: Scalar, y: Y) -> bool:
    """Whether a switch may hold the solution: it has one h, and to do with no other, and acts always in one way."""
    zeros = tuple(jnp.zeros_like(t) for _ in model.switches)
    steady = is_constant(lambda at: pull(model, k, at[2], at[0], at[1]), (t, y, zeros))
    return model.parts[k] == 1 and model.apart[k] and steady and not model.switches[k].levels


def _let_through(model: SwitchedSystem, k: int, t: Scalar, y: Y) -> bool:
    """Whether a switch may be one that is only crossed: what it does to its own dh/dt is nothing, or a function of what
    its h is a function of, as the force of a stop that vanishes where it lets go. (Friction under a load that varies is
    not. Whether it vanishes is asked at each event.)"""
    switch, zeros = model.switches[k], tuple(jnp.zeros_like(t) for _ in model.switches)
    if switch.unilateral or (switch.static and k in model.holdable):
        return False
    if not is_constant(lambda s: pull(model, k, s, t, y), zeros):
        return False
    if switch.levels:
        return True
    x, unravel = jfu.ravel_pytree(y)

    def h(t: Scalar, x: Flat) -> list[Scalar]:
        return list(model.h(k, t, unravel(x)))

    def gains(x: Flat, s: tuple) -> list[Scalar]:
        return jax.jvp(lambda x: h(t, x), (x,), (_flat(pull(model, k, s, t, unravel(x))),))[1]

    acts = dependence(lambda s: jax.jvp(h, (t, x), (jnp.ones_like(t), _flat(model.field(t, y, s))))[1], zeros)[:, k]
    own, seen = dependence(lambda x: h(t, x), x), dependence(lambda x: gains(x, zeros), x)
    return all(not a or (g.any() and not (g & ~o).any()) for a, o, g in zip(acts, own, seen))


def surfaces(model: SwitchedSystem, k: int, t: Scalar, y: Y) -> tuple[Scalar, ...]:
    """All indicator functions of a switch."""
    return model.switches[k].surfaces(model.system, model.time(t), y)


def _flat(y: Y) -> Flat:
    return jfu.ravel_pytree(y)[0]


def _plan(model: SwitchedSystem, crossed: tuple[int, ...], state: ModeState, t: Scalar, y: Y) -> Plan:
    x, unravel = jfu.ravel_pytree(y)
    rows = []
    for k in range(len(model.switches)):
        free = [slot for slot in model.slots if slot.switch == k and not slot.holding]
        held = [slot for slot in model.slots if slot.switch == k and slot.holding]
        rows.append(GuardRow(k, free[0], held[0] if held else None))
        rows += [GuardRow(k, slot, None) for slot in free[1:]] + [GuardRow(k, None, slot) for slot in held[1:]]
    zeros = tuple(jnp.zeros_like(t) for _ in model.switches)
    reach = dependence(lambda s: model.rates(model.holdable, t, y, state, s), zeros) if model.holdable else []
    acts = {k: tuple(j for j, row in zip(model.holdable, reach) if row[k]) for k in crossed}
    plan = Plan(len(x), False, tuple(rows), (), acts)
    timed = not is_constant(lambda t: raw(model, plan, t, y), t)
    timed = timed or not is_constant(lambda t: of_mode(model, plan, y, state)(t, jnp.zeros_like(x)), t)

    def entries(x: Flat) -> list[Scalar]:
        out = _flat(model.flow(t, unravel(x), state))
        return [out[i] for i in range(plan.size)]

    plan, own = plan._replace(timed=timed), dependence(entries, x)
    pattern = tuple((*map(bool, row), *[True] * (plan.width - plan.size)) for row in own)
    return plan._replace(pattern=pattern)


def raw(model: SwitchedSystem, plan: Plan, t: Scalar, y: Y) -> Flat:
    """Field and indicator functions at y = 0, and what each switch that is only crossed adds, as functions of time."""
    still = jax.tree.map(jnp.zeros_like, y)
    zeros = tuple(jnp.zeros_like(t) for _ in model.switches)
    h = [x[None] for k in range(len(model.switches)) for x in surfaces(model, k, t, still)]
    pulls = [_flat(pull(model, k, zeros, t, still)) for k in plan.crossed]
    return jnp.concatenate([_flat(model.field(t, still, zeros)), *h, *pulls])


def of_mode(model: SwitchedSystem, plan: Plan, y: Y, state: ModeState) -> Callable[[Scalar, Flat], Flat]:
    """The field of a mode, its guards, and what removes the drift off the surfaces that hold, one below the other."""
    unravel = jfu.ravel_pytree(y)[1]

    def fn(t: Scalar, x: Flat) -> Flat:
        y = unravel(x)
        guards = dict(zip(model.slots, model.guards(t, y, state))) if model.slots else {}
        values = []
        for k, free, held in plan.rows:
            if free is not None and k in plan.crossed and model.switches[k].signed:
                values.append(state.mode[k].astype(t.dtype) * model.h(k, t, y)[free.part])
            elif free and held:
                values.append(select(model.held(k, state.mode[k]), guards[held][0], guards[free][0]))
            else:
                values.append(guards[free or held][0])
        parts = [_flat(model.flow(t, y, state)), *[v[None] for v in values]]
        if model.holdable:
            parts.append(_flat(model.project(t, y, state)))
        return jnp.concatenate(parts)

    return fn


def columns(fn: Callable[[Scalar, Flat], Flat], plan: Plan, t: Scalar) -> Columns:
    """A function of time and state, affine in the state, as rows times z. Time begins at `t`, with S = C = 0."""
    zeros, one = jnp.zeros(plan.size, t.dtype), jnp.ones_like(t)
    parts = [jax.jacfwd(fn, argnums=1)(t, zeros)]
    if plan.timed:

        def rate(t: Scalar) -> Flat:
            return jax.jvp(lambda t: fn(t, zeros), (t,), (one,))[1]

        first, second = jax.jvp(rate, (t,), (one,))
        parts += [first[:, None], second[:, None]]
    return jnp.concatenate([*parts, fn(t, zeros)[:, None]], axis=1)


def constants(model: SwitchedSystem, plan: Plan, t: Scalar, y: Y) -> Constants:
    """For one lane."""
    x, unravel = jfu.ravel_pytree(y)
    zeros, still = tuple(jnp.zeros_like(t) for _ in model.switches), jnp.zeros_like(x)

    push, gain, level, bound, restitution = {}, {}, {}, {}, {}
    for k in model.holdable:
        push[k] = _flat(pull(model, k, zeros, t, unravel(still)))
        if k in model.contacts:
            free = ModeState.of([jnp.zeros((), jnp.int32)] * len(zeros), [None] * len(zeros))

            def rate(t: Scalar, x: Flat, k: int = k, free: ModeState = free) -> Flat:
                return model.level(k, t, unravel(x), free)[None]

            level[k] = columns(rate, plan, t)[0]
            gain[k] = level[k][: plan.size] @ push[k]
            law = model.switches[k].restitution_fn
            assert law is not None  # `planned` has asked for it
            restitution[k] = jnp.asarray(law(model.system), t.dtype)
        else:
            gain[k] = jax.jvp(lambda x, k=k: model.h(k, t, unravel(x))[0], (still,), (push[k],))[1]
            bound[k] = jnp.asarray(model.bound(k), t.dtype)
    pulls, levels = {}, {}
    for k in plan.crossed:
        if model.switches[k].levels:
            levels[k] = columns(lambda t, x, k=k: jnp.stack(surfaces(model, k, t, unravel(x))), plan, t)
        else:
            pulls[k] = columns(lambda t, x, k=k: _flat(pull(model, k, zeros, t, unravel(x))), plan, t)
    known = frequency(model, plan, t, y)
    assert known is not None  # it was asked for by `planned`
    squared = jnp.asarray(known.squared, t.dtype)
    return Constants(squared, push, gain, level, bound, restitution, pulls, levels)


def frequency(model: SwitchedSystem, plan: Plan, t: Scalar, y: Y) -> Forcing | None:
    """What depends on time: constant, linear or quadratic, or harmonic of one frequency; None if it is anything else,
    or if it jumps. (Forcing that grows exponentially is left to the general flow: its S and C grow, and cancel.)"""
    found = time_dependence(lambda t: raw(model, plan, t, y), t)
    return None if found.jumps or found.unknown else forcing(found.results)


def clock(since: Scalar, squared: Scalar) -> tuple[Scalar, Scalar]:
    """S = sin(ωτ)/ω and C = (1 - cos ωτ)/ω², for ω² = 0 too: τ and τ²/2."""
    still = squared == 0
    rate = jnp.sqrt(select(still, 1, squared))
    half = jnp.sin(0.5 * rate * since) / rate
    return select(still, since, jnp.sin(rate * since) / rate), select(still, 0.5 * since**2, 2 * half**2)


def numbers(model: SwitchedSystem) -> int:
    """How many modes there are."""
    count = 1
    for k, switch in enumerate(model.switches):
        free = 1 if switch.unilateral else 2
        count *= free + (k in model.holdable)
    return count
