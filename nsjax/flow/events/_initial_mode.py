"""The mode in which a solution sets out."""

from typing import Any

import jax.numpy as jnp
from jaxtyping import Array, Bool

from ..._numerics._autodiff import frozen
from ..._numerics._linalg import nearly
from ..._types import Scalar, Y
from ...system._impact import impact
from ...system._mode import ModeState
from ...system._model import SwitchedSystem
from ...system._relay import relay
from ...system._sgn import sgn
from .._results import RESULTS
from ._mode_choice import settle


AT_ONCE = 0.01  # times the root of eps and of the time to be solved for: what is crossed sooner is where the start is


def start_mode(
    model: SwitchedSystem, t: Scalar, y: Y, given: dict[str, Any], horizon: Scalar
) -> tuple[ModeState, Bool[Array, ""], RESULTS]:
    """The mode in which the solution sets out: from the signs of h, from `mode=`, and on a surface by the fields; and
    whether another solution sets out there too. `horizon`: for how long it is to be solved."""
    modes, parts, roots, at, chosen = [], [], [], {}, []
    result = RESULTS.successful
    on, beyond = {}, {}
    counts = model.counts(t)
    for k, switch in enumerate(model.switches):
        zero = jnp.zeros((), jnp.int32)
        if k in counts:  # whatever `mode` says: it may be that of the same phase a period earlier
            modes.append(counts[k])
            parts.append(None)
            roots.append(zero)
            continue
        if isinstance(switch, relay):
            before = jnp.asarray(given.get(switch.name, 0), jnp.int32)
            modes.append(switch.mode_at(model.system, model.time(t), y, before))
            parts.append(None)
            roots.append(zero)
            continue
        h = jnp.stack(model.h(k, t, y))
        noise = model.rounding(lambda t, y, k=k: model.h(k, t, y), t, y)
        part = jnp.argmin(h)
        h, noise = h[part], noise[part]
        on[k] = jnp.abs(h) <= noise
        parts.append(part.astype(jnp.int32) if model.parts[k] > 1 else None)
        roots.append(zero)
        if isinstance(switch, impact):
            rests = jnp.zeros((), bool)
            if switch.name not in given:
                result = RESULTS.where(h < -noise, RESULTS.start_penetrates, result)
            else:
                if k not in model.contacts:
                    raise ValueError(
                        f"Argument `mode` must not name `{switch.name}`: this impact surface cannot hold the solution "
                        f"(it is a minimum, or `s.{switch.name}` is not a force that acts on d²h/dt²)."
                    )
                at[k], rests = rests, jnp.asarray(given[switch.name]) == 1
                result = RESULTS.where(rests & (h > 1e6 * noise), RESULTS.wrong_mode, result)
                beyond[k] = -h - 1e6 * noise
                on[k] = h <= noise
            if switch.name not in given and k in model.contacts:
                still = ModeState((), tuple(parts), ())
                (slow,) = model.rounding(lambda t, y, k=k, still=still: (model.level(k, t, y, still),), t, y)
                at[k] = rests = on[k] & (jnp.abs(model.level(k, t, y, still)) <= slow)
            modes.append(rests.astype(jnp.int32))
        elif switch.name in given:
            mode = jnp.asarray(given[switch.name], jnp.int32)
            # A state taken from an earlier solution may carry some drift off its surface.
            beyond[k] = jnp.where(mode == 0, jnp.abs(h), -mode.astype(h.dtype) * h) - 1e6 * noise
            modes.append(mode)
            chosen.append(k)
            at[k] = on[k] = mode.astype(h.dtype) * h <= noise
        else:
            modes.append(jnp.where(on[k], 0, jnp.sign(h)).astype(jnp.int32))
            at[k] = on[k]
    state = ModeState(tuple(modes), tuple(parts), tuple(roots))
    for k, switch in enumerate(model.switches):
        if isinstance(switch, sgn) and switch.name not in given:
            # Nearer than an event can be told from the start: the end of a period on a surface is off by rounding.
            instant = 2 * float(jnp.finfo(t.dtype).eps) * (jnp.abs(t) + horizon)
            h = jnp.min(jnp.stack(model.h(k, t, y)))
            on[k] = at[k] = on[k] | (jnp.abs(h) <= instant * jnp.abs(frozen(model.approach(k, t, y, state))))
            modes[k] = jnp.where(on[k], 0, modes[k])
    state = state._replace(mode=tuple(modes))
    for k, gap in beyond.items():
        # Near zero the rounding of h itself is nothing beside that of the terms which once led there.
        soon = AT_ONCE * float(jnp.finfo(t.dtype).eps) ** 0.5 * horizon
        off = gap > soon * jnp.abs(frozen(model.approach(k, t, y, state)))
        failure = RESULTS.start_penetrates if isinstance(model.switches[k], impact) else RESULTS.wrong_mode
        result = RESULTS.where(off, failure, result)
    leaves = {k: jnp.zeros((), jnp.int32) for k in at}
    state, unsure, forked, wrong = settle(model, t, y, state, at, leaves, tuple(chosen))
    for k in model.holdable:  # see `land`
        forked = forked | (model.held(k, state.mode[k]) & (model.direction < 0))
    result = RESULTS.where(unsure, RESULTS.repulsive_sliding, result)
    result = RESULTS.where(wrong, RESULTS.ambiguous_event, result)
    # Guards of surfaces on which the start lies have a root there already.
    roots = list(state.roots)
    f = model.flow(t, y, state)
    for k, value in enumerate(frozen(model.values(t, y, state))):
        if model.static(k) and k in model.holdable:
            edge = jnp.where(model.direction < 0, model.edge(k, value, nearly(t)), 0)
            roots[k] = jnp.where((state.mode[k] == 0) & ((k in chosen) | ~at[k]), edge, roots[k])
    for k, here in on.items():
        rate = model.approach(k, t, y, state)
        sign = 1 - state.mode[k] if isinstance(model.switches[k], impact) else state.mode[k]
        part = 0 if state.part[k] is None else state.part[k]
        size = model.sizes(lambda t, y, k=k: model.h(k, t, y), t, y, jnp.ones_like(t), f)[part]
        fresh = jnp.where(jnp.abs(rate) > jnp.sqrt(jnp.finfo(t.dtype).eps) * size, 1, 2)
        settled = jnp.zeros((), bool) if k in chosen else at.get(k, jnp.zeros((), bool))
        roots[k] = jnp.where(here & ~settled & (sign != 0), fresh, roots[k]).astype(jnp.int32)
    return state._replace(roots=tuple(roots)), forked, result
