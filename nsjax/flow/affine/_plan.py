"""Which models the exact flow is made for, and what of them stays the same in all modes."""

from collections.abc import Callable
from typing import Any, NamedTuple

import diffrax as dfx
import jax
import jax.flatten_util as jfu
import jax.lax as lax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float

from ..._numerics._autodiff import frozen
from ..._numerics._jaxpr import dependence, is_constant
from ..._numerics._select import select
from ..._numerics._series import Series
from ..._types import Scalar, Y
from ...system._impact import impact
from ...system._mode import ModeState
from ...system._model import SwitchedSystem
from ...system._sgn import sgn
from .._loop import Flow
from ..steppers._exponential import affine_parts


Flat = Float[Array, " n"]
Columns = Float[Array, "rows m"]
"""A function that is affine in z: its rows times z, with z = (y, 1) or, where time enters, z = (y, S, C, 1)."""

MOST_SWITCHES = 18  # whose modes make one 32-bit number


class GuardRow(NamedTuple):
    """Guards of one switch of which only one can fall to zero in a mode: its slots while free and while holding."""

    switch: int
    free: int | None
    held: int | None


class Plan(NamedTuple):
    """What is known of a model while it is traced."""

    size: int  # of the state
    timed: bool  # whether time enters
    rows: tuple[GuardRow, ...]
    pattern: tuple[tuple[bool, ...], ...]  # which entries of the matrices of all modes may not be zero

    @property
    def width(self) -> int:
        """The number of components of z."""
        return self.size + (3 if self.timed else 1)


class Constants(NamedTuple):
    """What stays the same in all modes, for one lane or with lanes along the last axis."""

    frequency: Scalar  # the square of that of the forcing
    push: dict[int, Flat]  # of each switch that can hold: the derivative of the field by its value
    gain: dict[int, Scalar]  # what it adds to its own dh/dt, of contacts d²h/dt²
    level: dict[int, Flat]  # of contacts: dh/dt in flight as a row times z
    bound: dict[int, Scalar]  # of λ
    restitution: dict[int, Scalar]
    forcing: Columns  # what is left of field and indicator functions at y = 0, as columns for (S, C, 1)
    fits: Bool[Array, ""]  # whether this stands for them


class Problem(NamedTuple):
    """One solve of a model that is allowed."""

    flow: Flow
    plan: Plan
    constants: Constants
    like: Y  # a state
    theta: float  # the phase that an arc may pass through


def allows(model: SwitchedSystem, meter: dfx.AbstractProgressMeter, state: ModeState, t: Scalar, y: Y) -> bool:
    """Whether a model is affine in every mode, with no other switches than `sgn` and `impact` with one h each, none of
    which acts on the surface of another one. (Of friction beside a wall, or of three coupled surfaces, a third of the
    events are not plain, and sweeps took up to twice the time of the general flow.)"""
    if not all(model.apart):
        return False
    if not isinstance(meter, dfx.NoProgressMeter) or len(model.switches) > MOST_SWITCHES:
        return False
    for k, switch in enumerate(model.switches):
        smooth = model.parts[k] == 1 and not switch.condition
        newton = isinstance(switch, impact) and switch.restitution_fn is not None and k in model.contacts
        if not (smooth and (isinstance(switch, sgn) or newton)):
            return False
    zeros = tuple(jnp.zeros_like(t) for _ in model.switches)

    def pushed(at: tuple[Scalar, Y, tuple]) -> Y:
        t, y, s = at
        return jax.jvp(lambda s: model.field(t, y, s), (s,), (tuple(jnp.ones_like(x) for x in s),))[1]

    if not (model.steady and model.jointly_affine and is_constant(pushed, (t, y, zeros))):
        return False
    if not all(affine_parts(lambda t, y: model.field(t, y, zeros), t, y)):
        return False
    if not all(affine_parts(lambda t, y: model.flow(t, y, state), t, y)):
        return False
    return not model.slots or all(affine_parts(lambda t, y: model.guards(t, y, state), t, y))


def made(flow: Flow, state: ModeState, t: Scalar, y: Y) -> Plan:
    """The plan of a model that is allowed."""
    model, x = flow.model, jfu.ravel_pytree(y)[0]
    rows = []
    for k in range(len(model.switches)):
        own = [i for i, slot in enumerate(model.slots) if slot.switch == k]
        free = next(i for i in own if not model.slots[i].holding)
        held = [i for i in own if model.slots[i].holding]
        rows.append(GuardRow(k, free, held[0] if held else None))
        rows += [GuardRow(k, None, i) for i in held[1:]]
    zeros = jnp.zeros_like(x)
    timed = not is_constant(lambda t: raw(model, t, y), t)
    timed = timed or not is_constant(lambda t: of_mode(flow, rows, y, state)(t, zeros), t)
    plan = Plan(len(x), timed, tuple(rows), ())
    return plan._replace(pattern=_pattern(flow, plan, state, t, y))


def _pattern(flow: Flow, plan: Plan, state: ModeState, t: Scalar, y: Y) -> tuple[tuple[bool, ...], ...]:
    model, x = flow.model, jfu.ravel_pytree(y)[0]
    unravel = jfu.ravel_pytree(y)[1]

    def entries(x: Flat) -> list[Scalar]:
        out = jfu.ravel_pytree(model.flow(t, unravel(x), state))[0]
        return [out[i] for i in range(plan.size)]

    own = dependence(entries, x)
    return tuple((*map(bool, row), *[True] * (plan.width - plan.size)) for row in own)


def raw(model: SwitchedSystem, t: Scalar, y: Y) -> Flat:
    """Field and indicator functions at y = 0, as functions of time."""
    still = jax.tree.map(jnp.zeros_like, y)
    zeros = tuple(jnp.zeros_like(t) for _ in model.switches)
    h = [model.h(k, t, still)[0][None] for k in range(len(model.switches))]
    return jnp.concatenate([jfu.ravel_pytree(model.field(t, still, zeros))[0], *h])


def of_mode(flow: Flow, rows: Any, y: Y, state: ModeState) -> Callable[[Scalar, Flat], Flat]:
    """The field of a mode, its guards, and what removes the drift off the surfaces that hold, one below the other."""
    model, unravel = flow.model, jfu.ravel_pytree(y)[1]

    def fn(t: Scalar, x: Flat) -> Flat:
        y = unravel(x)
        guards = model.guards(t, y, state) if model.slots else []
        values = []
        for row in rows:
            free, held = ([] if i is None else guards[i] for i in (row.free, row.held))
            if free and held:
                values.append(select(model.held(row.switch, state.mode[row.switch]), held[0], free[0]))
            else:
                values.append((free or held)[0])
        parts = [jfu.ravel_pytree(model.flow(t, y, state))[0], *[v[None] for v in values]]
        if model.holdable:
            parts.append(jfu.ravel_pytree(model.project(t, y, state))[0])
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


def constants(flow: Flow, plan: Plan, y: Y) -> Constants:
    """For one lane."""
    model, t, (x, unravel) = flow.model, flow.t0, jfu.ravel_pytree(y)
    zeros, still = tuple(jnp.zeros_like(t) for _ in model.switches), jnp.zeros_like(x)

    def field(s: tuple) -> Flat:
        return jfu.ravel_pytree(model.field(t, unravel(still), s))[0]

    push, gain, level, bound, restitution = {}, {}, {}, {}, {}
    for k in model.holdable:
        unit = tuple(select(i == k, 1, 0).astype(t.dtype) for i in range(len(zeros)))
        push[k] = jax.jvp(field, (zeros,), (unit,))[1]
        if k in model.contacts:
            free = ModeState.of([jnp.zeros((), jnp.int32)] * len(zeros), [None] * len(zeros))

            def rate(t: Scalar, x: Flat, k: int = k, free: ModeState = free) -> Flat:
                return model.level(k, t, unravel(x), free)[None]

            level[k] = columns(rate, plan, t)[0]
            gain[k] = level[k][: plan.size] @ push[k]
            restitution[k] = jnp.asarray(model.switches[k].restitution_fn(model.system), t.dtype)  # type: ignore
        else:
            gain[k] = jax.jvp(lambda x, k=k: model.h(k, t, unravel(x))[0], (still,), (push[k],))[1]
            bound[k] = jnp.asarray(model.bound(k), t.dtype)
    frequency, forcing, fits = _forcing(model, plan, t, y)
    return Constants(frequency, push, gain, level, bound, restitution, forcing, fits)


def _forcing(model: SwitchedSystem, plan: Plan, t: Scalar, y: Y) -> tuple[Scalar, Columns, Bool[Array, ""]]:
    """What depends on time, with b''' = -ω² b': constant, linear, quadratic or harmonic. (Forcing that grows or decays
    exponentially is left to the general flow: its S and C grow, and cancel.)"""
    now = raw(model, t, y)
    if not plan.timed:
        return jnp.zeros_like(t), now[:, None], jnp.ones((), bool)
    series = Series(lambda t: [raw(model, t, y)], t)
    terms = [series.step(k, t if k == 0 else jnp.ones_like(t) if k == 1 else None)[0] for k in range(5)]
    b1, b2, b3, b4 = (jnp.zeros_like(now) if c is None else w * c for w, c in zip((1.0, 2.0, 6.0, 24.0), terms[1:]))
    size = b1 @ b1 + b2 @ b2
    squared = -(b1 @ b3 + b2 @ b4) / select(size == 0, 1, size)
    fits = frozen(squared) >= 0
    return select(fits, squared, 0), jnp.stack([b1, b2, now], axis=1), lax.stop_gradient(fits)


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
        free = 2 if isinstance(switch, sgn) else 1
        count *= free + (k in model.holdable)
    return count
