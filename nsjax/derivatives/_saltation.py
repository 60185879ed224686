"""Saltation matrices from their formula, an oracle independent of automatic differentiation through the flow."""

from collections.abc import Mapping, Sequence
from typing import Any, NamedTuple

import jax
import jax.flatten_util as jfu
import jax.lax as lax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int

from .._numerics._autodiff import frozen
from .._numerics._select import select
from .._types import Scalar, Y
from ..flow._arguments import checked_state, checked_time
from ..flow._results import raise_if, RESULTS
from ..flow._solution import Events
from ..flow.events._impact import completed, Gap, rebound
from ..system._impact import impact
from ..system._mode import ModeState, put
from ..system._model import SwitchedSystem
from ..system._system import arrays_of, System


def _modes(system: System, mode: Any) -> tuple[Int[Array, ""], ...]:
    names = [k.name for k in system.switches]
    if isinstance(mode, Mapping):
        missing = [n for n in names if n not in mode and not isinstance(dict(zip(names, system.switches))[n], impact)]
        if missing or set(mode) - set(names):
            raise ValueError(f"A mode must give a value for each of the switches {names}, but got {dict(mode)}.")
        mode = [mode.get(n, 0) for n in names]
    elif not isinstance(mode, Sequence) and jnp.ndim(mode) == 0:
        mode = [mode]
    if len(mode) != len(names):
        raise ValueError(f"A mode must give a value for each of the switches {names}, but got {len(mode)} values.")
    return tuple(jnp.asarray(m, jnp.int32) for m in mode)


def event_function(model: SwitchedSystem, k: int, t: Scalar, y: Y, state: ModeState) -> Scalar:
    """The guard of switch k that is at zero: its surface, or while sliding the bound that λ has reached."""
    surface = model.switches[k].surface(model, k, t, y, state)
    if k not in model.holdable:
        return surface
    lam = model.values(t, y, state)[k]
    left = lam if k in model.contacts else model.bound(k) - jnp.sign(lam) * lam
    return select(model.held(k, state.mode[k]), left, surface)


def after_event(model: SwitchedSystem, k: int, t: Scalar, y: Y, state: ModeState, after: tuple) -> tuple[Y, Scalar]:
    """The state after an event of switch k at `t`, `y`, and how long the impacts that lead to rest take together."""
    none = jnp.zeros_like(t)
    if not model.switches[k].jumps:
        return y, none
    if k in model.clocks:  # its reset sees functions of time as they are after the tick
        ticked = model.next_mode(k, t, y, state.mode[k])
        model = model.within(put(state.mode, (k,), (ticked,)))
    gap = Gap.of(model, k)
    bounced, _ = rebound(gap, t, y, state)
    if not model.switches[k].unilateral:
        return bounced, none
    # (Between two ticks: a segment that follows may be the first of the next period.)
    after = tuple(state.mode[j] if j in model.clocks else m for j, m in enumerate(after))
    free = jnp.zeros_like(after[k])
    flight = model.state_at(t, bounced, after[:k] + (free,) + after[k + 1 :])
    end = completed(gap, t, y, bounced, state, flight)
    lands, rests = state.mode[k] == 0, after[k] == 1  # to lift off is no jump
    rest = select(rests, end.rest, 0)
    held = _held(model, t + rest, end.y, after)
    out = jax.tree.map(lambda a, b, c: select(lands, select(rests, a, b), c), held, bounced, y)
    return out, select(lands, rest, none)


def _held(model: SwitchedSystem, t: Scalar, y: Y, mode: tuple) -> Y:
    return model.project(t, y, model.state_at(t, y, mode))


class _Jump(NamedTuple):
    """An event of one switch, linearised; R is the identity unless it is an impact."""

    n: Float[Array, " n"]
    h_t: Scalar
    f_before: Float[Array, " n"]
    f_after: Float[Array, " n"]
    dr: Float[Array, "n n"]  # of R, with respect to the state
    r_t: Float[Array, " n"]
    drest: Float[Array, " n"]  # of the time that the impacts up to the state of rest take
    rest_t: Scalar
    onto: Float[Array, "n n"]  # the linearised constraints of resting contact
    blur: tuple[Float[Array, " n"], Float[Array, " n"]]  # what rounding can make of f_before and f_after


def _jump(model: SwitchedSystem, t: Scalar, y: Y, k: int, before: tuple, after: tuple) -> _Jump:
    flat, unravel = jfu.ravel_pytree(y)

    def ravel(y: Y) -> Array:
        return jfu.ravel_pytree(y)[0]

    state = model.state_at(t, y, before)
    h_t, n = jax.jacfwd(lambda t, x: event_function(model, k, t, unravel(x), state), argnums=(0, 1))(t, flat)
    f_before = ravel(model.flow(t, y, state))
    onto = jnp.eye(flat.size, dtype=flat.dtype)

    def hit(t: Scalar, x: Array) -> tuple[Array, Scalar]:
        out, rest = after_event(model, k, t, unravel(x), state, after)
        return ravel(out), rest

    (r_t, dr), (rest_t, drest) = jax.jacfwd(hit, argnums=(0, 1))(t, flat)
    x, rest = hit(t, flat)
    if model.switches[k].unilateral:
        rests = (before[k] == 0) & (after[k] == 1)
        onto = select(rests, jax.jacfwd(lambda x: ravel(_held(model, t + rest, unravel(x), after)))(x), onto)
    later = model.state_at(t, unravel(x), after)
    f_after = ravel(model.flow(t, unravel(x), later))
    still, at, begin, end, drift = frozen((model, t, flat, x, jnp.abs(t * f_before)))

    def blur(x: Array, state: ModeState) -> Array:
        size = unravel(jnp.abs(x) + drift)  # the time, too, is known to rounding only
        return still.rounding(lambda t, y: ravel(still.flow(t, y, state)), at, unravel(x), size)

    blurs = blur(begin, state) + _part(f_before), blur(end, later) + _part(f_after)
    return _Jump(n, h_t, f_before, f_after, dr, r_t, drest, rest_t, onto, blurs)


def _part(x: Array) -> Array:
    """What rounding can make of a sum of terms of this size."""
    return 8 * jnp.finfo(x.dtype).eps * jnp.abs(x)


def _unless_rounding(x: Array, blur: Array) -> Array:
    """Zero where terms cancel apart from their rounding; the derivative stays: next to it they need not cancel."""
    return x - lax.stop_gradient(select(jnp.abs(x) < blur, x, 0))


def _matrix(
    model: SwitchedSystem, t: Scalar, y: Y, k: int, before: tuple, after: tuple
) -> tuple[Float[Array, "n n"], Bool[Array, ""]]:
    """S = DR - f⁺ Dρ + (f⁺ (1 + Dρ f⁻ + ρ_t) - DR f⁻ - R_t) nᵀ / (nᵀ f⁻ + h_t): (3.32) for an event that takes the time
    ρ, as impacts do that lead to rest. Then P S, with the linearised projection P onto the contact.

    A perturbation δ before the event moves its time by dt = -nᵀδ / (nᵀf⁻ + h_t), the state after it by
    DR (δ + f⁻ dt) + R_t dt, and the time from which that goes on with f⁺ by dt + Dρ (δ + f⁻ dt) + ρ_t dt.

    Also returned: whether the surface is met tangentially, up to rounding, so that S is infinite.
    """
    j = _jump(model, t, y, k, before, after)
    late = 1 + j.drest @ j.f_before + j.rest_t  # how much later the state of rest begins when the impact does
    blur = jnp.abs(j.dr) @ j.blur[0] + jnp.abs(late) * j.blur[1] + _part(j.r_t)
    turn = jnp.outer(_unless_rounding(j.f_after * late - j.dr @ j.f_before - j.r_t, blur), j.n)
    # At a tangency the matrix is infinite, but what does not depend on the time of the event stays as it is.
    speed = j.n @ j.f_before + j.h_t
    tangential = (jnp.abs(speed) <= jnp.abs(j.n) @ j.blur[0] + _part(j.h_t)) & jnp.any(turn != 0)
    none = (turn == 0) & (speed == 0)
    terms = j.dr, -jnp.outer(j.f_after, j.drest), select(none, 0, turn / select(none, 1, speed))
    size = sum(map(jnp.abs, terms), jnp.zeros_like(turn))
    jump = _unless_rounding(sum(terms, jnp.zeros_like(turn)), _part(size))
    if not model.switches[k].unilateral:
        return jump, tangential
    finite = jnp.all(jnp.isfinite(jump))  # else zeros of the projection would make NaN of what is infinite
    projected = _unless_rounding(j.onto @ select(finite, jump, 0), _part(jnp.abs(j.onto) @ select(finite, size, 0)))
    return select(finite, projected, jump), tangential


def saltation_matrix(
    system: System, t: Any, y: Y, switch: str, mode_before: Any, mode_after: Any, *, throw: bool = True
) -> Float[Array, "n n"]:
    """The saltation matrix of an event, by which the fundamental matrix jumps: Φ(t+) = S Φ(t-).

    S = DR + (f⁺ - DR f⁻ - R_t) nᵀ / (nᵀ f⁻ + h_t), with n = grad h: eq. (3.30) where the state does not jump (R = y)
    and h does not depend on time, (3.32) where it does. At a tangency the denominator vanishes, and the entries that
    depend on it are infinite. For an impact into resting contact R sums all impacts up to the accumulation point, whose
    time varies with the state.

    **Arguments:**

    - `system`: the model.
    - `t`, `y`: time and state at the event, before a jump of the state.
    - `switch`: the name of the switch whose surface is met, or whose multiplier reaches its bound.
    - `mode_before`, `mode_after`: the modes, as `{"name": value}`, one value a switch, or for one switch its value.
    - `throw`: whether a tangency is an error. Without it the matrix has entries that are infinite, or as large as
        rounding lets them be.

    **Returns:** the matrix, for the state flattened by `ravel_pytree` (fields of a `NamedTuple` in order), in units of
    one state component over another.

    **Raises:** `ValueError` for an unknown switch; with `throw` a runtime error if the surface is met tangentially, up
    to rounding, and the matrix depends on the time of the event.
    """
    names = [k.name for k in system.switches]
    if switch not in names:
        raise ValueError(f"Argument `switch` must be one of {', '.join(names) or 'no switches'}, but got {switch!r}.")
    y = checked_state(y)
    t = checked_time("t", t, jnp.result_type(*jax.tree.leaves(y)))
    system = arrays_of(system, t.dtype)
    model = SwitchedSystem.forwards(system, t, y)
    before, after = _modes(system, mode_before), _modes(system, mode_after)
    matrix, tangential = _matrix(model, t, y, names.index(switch), before, after)
    return raise_if(tangential, RESULTS.tangential_event, matrix) if throw else matrix


def saltation_matrices(system: System, events: Events) -> Float[Array, "events n n"]:
    """`saltation_matrix` of every event of a log; rows past the last event are NaN. At a tangency the entries that
    depend on the time of the event are infinite, or as large as rounding lets them be."""
    dtype = events.t.dtype
    system = arrays_of(system, dtype)
    template = jax.tree.map(lambda x: x[0], events.y_before)
    model = SwitchedSystem(system, jnp.ones((), dtype), jnp.zeros((), dtype), template)

    def one(t: Scalar, y: Y, switch: Array, before: Array, after: Array) -> Array:
        options = [_matrix(model, t, y, k, tuple(before), tuple(after))[0] for k in range(len(model.switches))]
        missing = jnp.full((len(jfu.ravel_pytree(y)[0]),) * 2, jnp.nan, dtype)
        return jnp.select([switch == k for k in range(len(options))], options, jnp.nan) if options else missing

    return jax.vmap(one)(events.t, events.y_before, events.switch, events.mode_before, events.mode_after)
