"""Mistakes in a model, found before anything is integrated."""

import dataclasses
from functools import partial
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax.core import Tracer
from jaxtyping import Array, Bool

from .._numerics._jaxpr import is_affine, is_constant
from .._types import Scalar, Y
from ._model import ModeState, SwitchedSystem
from ._system import AbstractSwitch, clock, impact, relay, sgn, System


def _shape(tree: Any) -> Any:
    return jax.tree.map(lambda x: f"{x.dtype.name}{list(x.shape)}", tree)


def check_system(system: Any) -> None:
    if not isinstance(system, System):
        hint = " Call it, with its parameters: `Model(...)`." if isinstance(system, type) else ""
        raise TypeError(f"Argument `system` must be an instance of `nsjax.System`, but got {system!r}.{hint}")


def check_fields(system: System) -> None:
    """Checks that parameters declared as numbers are numbers."""
    for field in dataclasses.fields(system):
        value = getattr(system, field.name)
        if isinstance(value, System):
            check_fields(value)
        if field.type in (float, "float") and (value is None or isinstance(value, str)):
            owner = type(system).__name__
            raise TypeError(f"Parameter `{field.name}` of `{owner}` must be a number, but is {value!r}.")


def check_parameters(system: System) -> None:
    """Checks the values of the parameters, and what the switches make of them, where they are known."""
    owner = type(system).__name__
    if any(isinstance(x, Tracer) for x in jax.tree.leaves(system)):
        return
    for path, x in jax.tree_util.tree_leaves_with_path(system):
        if eqx.is_inexact_array_like(x) and np.isnan(np.asarray(x)).any():
            name = jax.tree_util.keystr(path, simple=True, separator=".")
            raise ValueError(f"Parameter `{name}` of `{owner}` must be a number, but is NaN.")
    for switch in system.switches:
        with jax.ensure_compile_time_eval():  # also within a function that is being compiled
            found = laws(system, switch)
        for part, law, good, value in found:
            if not np.all(np.asarray(good)):
                got = np.asarray(value)
                raise ValueError(
                    f"`{owner}.{switch.name}{part}` must be {law}, but is {got if got.ndim else float(got)}."
                )


def laws(system: System, switch: AbstractSwitch) -> list[tuple[str, str, Any, Any]]:
    """What must hold for the numbers of a switch: the name of its method, the law, whether it holds, the number."""
    if isinstance(switch, sgn) and switch.breakaway_fn is not None:
        b = jnp.asarray(switch.bound(system))
        least = 1 - 64 * float(jnp.finfo(jnp.result_type(b, 0.0)).eps)  # a quotient of equal forces may be rounded
        return [(".breakaway", "at least 1, as friction at rest is no weaker than in slip", b >= least, b)]
    if isinstance(switch, impact) and switch.restitution_fn is not None:
        e = jnp.asarray(switch.restitution_fn(system))
        return [(".restitution", "a number from 0 to 1", (e >= 0) & (e <= 1), e)]
    if isinstance(switch, clock):
        ticks = jnp.asarray(switch.guard(system))
        start = jnp.asarray(0.0 if switch.offset_fn is None else switch.offset_fn(system))
        found = [(".offset", "a finite time", jnp.isfinite(start), start)]
        if ticks.ndim == 0:
            return [("", "a time above zero", ticks > 0, ticks), *found]
        return [("", "a vector of increasing times", jnp.all(ticks[1:] > ticks[:-1]), ticks), *found]
    return []


def check_model(system: System, t: Scalar, y: Y, direction: Scalar) -> Scalar:
    """Checks the model where that needs no numbers: structure, shapes, and dependence on the switch values.

    **Returns:** the time `t`, to be used so that errors found at run time are raised.
    """
    name = type(system).__name__
    switches = system.switches
    names = [k.name for k in switches]
    for n in set(names):
        if names.count(n) > 1:
            raise ValueError(f"`{name}.switches` must have different names, but `{n}` occurs {names.count(n)} times.")
    zeros = tuple(jnp.zeros((), t.dtype) for _ in switches)

    def field(s: tuple) -> Y:
        return system.vector_field(t, y, system.values(s))

    out = jax.eval_shape(field, zeros)
    have, want = jax.tree.structure(out), jax.tree.structure(y)
    if have != want:
        raise ValueError(
            f"`{name}.vector_field` must return the structure of the state, {want}, but returned {have}. "
            "Return the same kind of tuple, dictionary or array as `y0`."
        )
    for (path, f), x in zip(jax.tree_util.tree_leaves_with_path(out), jax.tree.leaves(y)):
        if f.shape != x.shape or f.dtype != x.dtype:
            where = jax.tree_util.keystr(path)
            raise ValueError(
                f"`{name}.vector_field` must return leaves of the shapes and dtypes of the state, but its leaf "
                f"`{where or 'y'}` is {f.dtype}{list(f.shape)} where the state has {x.dtype}{list(x.shape)}."
            )
    for k, switch in enumerate(switches):
        if isinstance(switch, clock):
            _check_clock(name, switch, system)
            continue
        _check_guard(name, switch.name, switch.guard, system, t, y)
        if isinstance(switch, sgn):
            _check_sgn(name, k, switch, system, field, zeros)
        elif isinstance(switch, relay):
            if switch.off_guard is None:
                raise ValueError(
                    f"`{name}.{switch.name}` is a relay without the surface on which it switches off; add one with "
                    f"`@{switch.name}.off`."
                )
            _check_guard(name, f"{switch.name}.off", switch.off_guard, system, t, y)
            if isinstance(switch.guard(system, t, y), tuple) or isinstance(switch.off_guard(system, t, y), tuple):
                raise ValueError(f"`{name}.{switch.name}` is a relay: its surfaces must be scalars, not tuples.")
        else:
            assert isinstance(switch, impact)
            _check_impact(name, k, switch, system, t, y, field, zeros)
    obstacle = one_way(system)
    return eqx.error_if(t, direction < 0, obstacle) if obstacle else t


def one_way(system: System) -> str | None:
    """What keeps a system from being run backwards, if anything does."""
    for switch in system.switches:
        name = f"`{type(system).__name__}.{switch.name}`"
        if isinstance(switch, relay):
            return f"{name} is a relay, whose memory cannot be run backwards in time."
        if isinstance(switch, impact) and switch.reset_fn is not None and switch.inverse_fn is None:
            return (
                f"{name} has a reset, which does not tell the state before it from the one after it; to run it "
                f"backwards in time, give the state before it by `@{switch.name}.inverse`."
            )
    return None


def check_direction(system: System, backwards: Any) -> None:
    """Raises for a system that cannot be run backwards, where it is known that it is to be."""
    obstacle = one_way(system)
    if obstacle and not isinstance(backwards, Tracer) and backwards:
        raise ValueError(obstacle)


def _check_guard(owner: str, name: str, guard: Any, system: System, t: Scalar, y: Y) -> None:
    h = jax.eval_shape(lambda: guard(system, t, y))
    for part in h if isinstance(h, tuple) and not hasattr(h, "_fields") else (h,):
        if not isinstance(part, jax.ShapeDtypeStruct) or part.shape != () or part.dtype != t.dtype:
            got = part if not isinstance(part, jax.ShapeDtypeStruct) else f"{part.dtype}{list(part.shape)}"
            raise ValueError(
                f"`{owner}.{name}` must return a scalar of dtype {t.dtype} (or a tuple of them, meaning their "
                f"minimum), but returned {got}. For many surfaces define a switch for each, or override `switches`."
            )


def _check_clock(owner: str, switch: clock, system: System) -> None:
    ticks = jnp.asarray(switch.guard(system))
    if ticks.ndim > 1 or ticks.size == 0 or not jnp.issubdtype(ticks.dtype, jnp.floating):
        raise ValueError(
            f"`{owner}.{switch.name}` is a clock: it must return the time between two ticks, or a vector of times, but "
            f"returned {ticks.dtype}{list(ticks.shape)}."
        )
    start = 0.0 if switch.offset_fn is None else switch.offset_fn(system)
    if jnp.shape(start) != ():
        raise ValueError(f"`{owner}.{switch.name}.offset` must return a scalar, but its shape is {jnp.shape(start)}.")


def _check_sgn(owner: str, k: int, switch: sgn, system: System, field: Any, zeros: tuple) -> None:
    def along(sk: Scalar) -> Y:
        return field(zeros[:k] + (sk,) + zeros[k + 1 :])

    if not is_affine(along, zeros[k]):
        raise ValueError(
            f"`{owner}.vector_field` must be affine in `s.{switch.name}`, as the sliding field (2.19) is the convex "
            "combination of the fields on both sides, but it is not. Use it as a factor of a term: not inside a "
            "function, in a power, in `jnp.where`, or in a denominator. For two different laws write "
            f"`0.5 * (1 + s.{switch.name}) * plus + 0.5 * (1 - s.{switch.name}) * minus`."
        )
    bound = switch.bound(system)
    if jnp.shape(bound) != ():
        raise ValueError(
            f"`{owner}.{switch.name}.breakaway` must return a scalar, but its shape is {jnp.shape(bound)}."
        )


def _check_impact(
    owner: str, k: int, switch: impact, system: System, t: Scalar, y: Y, field: Any, zeros: tuple
) -> None:
    name = switch.name
    if (switch.reset_fn is None) == (switch.restitution_fn is None):
        raise ValueError(
            f"`{owner}.{name}` is an impact: give it either `@{name}.reset` (the state after it) or "
            f"`@{name}.restitution` (Newton's coefficient e)."
        )
    if switch.inverse_fn is not None and switch.reset_fn is None:
        raise ValueError(
            f"`{owner}.{name}.inverse` undoes a reset, but there is no `@{name}.reset`; Newton's law needs none."
        )
    if switch.reset_fn is not None:
        for part, fn in (("reset", switch.reset_fn), ("inverse", switch.inverse_fn or switch.reset_fn)):
            after, want = jax.eval_shape(partial(fn, system, t, y)), jax.eval_shape(lambda: y)
            if jax.tree.structure(after) != jax.tree.structure(want) or _shape(after) != _shape(want):
                raise ValueError(
                    f"`{owner}.{name}.{part}` must return a state of the structure {_shape(want)}, but returned "
                    f"{_shape(after)}."
                )
    elif is_constant(lambda sk: field(zeros[:k] + (sk,) + zeros[k + 1 :]), zeros[k]):
        raise ValueError(
            f"`{owner}.{name}.restitution` needs the direction of the impulse, which is that of the contact force "
            f"`s.{name}` in `vector_field`, but it does not occur there. Add it to the equation of motion "
            f"(`+ s.{name} / m`), or write the jump out with `@{name}.reset`."
        )


def check_autonomous(system: System, t: Scalar, y: Y) -> None:
    """Checks that a model without a `period` does not depend on the time."""
    zeros = tuple(jnp.zeros_like(t) for _ in system.switches)

    def seen(t: Scalar) -> Any:
        surfaces = [
            (k.guard(system, t, y), k.off_guard(system, t, y)) if isinstance(k, relay) else k.components(system, t, y)
            for k in system.switches
        ]
        return system.vector_field(t, y, system.values(zeros)), surfaces

    if any(isinstance(k, clock) for k in system.switches) or not is_constant(seen, t):
        name = type(system).__name__
        raise ValueError(
            f"`{name}` depends on the time t, but has no `period`: add a property `period`, that of its forcing, as "
            "`return 2 * jnp.pi / self.omega`."
        )


def check_clocks(system: System) -> None:
    """Checks, where numbers are known, that the clocks of a forced system tick alike in each of its periods."""
    for switch in system.switches:
        if not isinstance(switch, clock) or any(isinstance(x, Tracer) for x in jax.tree.leaves(system)):
            continue
        with jax.ensure_compile_time_eval():
            ticks, period = np.asarray(switch.guard(system)), float(np.asarray(system.period))
        name = f"`{type(system).__name__}.{switch.name}`"
        if ticks.ndim:
            raise ValueError(f"{name} is a list of times, which does not repeat itself: no orbit is periodic.")
        ratio = period / float(ticks)
        if abs(ratio - round(ratio)) > 1e-9 * ratio or round(ratio) < 1:
            raise ValueError(
                f"The period of `{type(system).__name__}` must be a multiple of that of the clock {name}, but they are "
                f"{period:.10g} and {float(ticks):.10g}."
            )


def closing_contacts(model: SwitchedSystem, t: Scalar, y: Y) -> dict[int, Bool[Array, ""]]:
    """Of each contact force whether it closes its gap, which it must not."""
    zeros = tuple(jnp.zeros_like(t) for _ in model.switches)
    free = ModeState((), (None,) * len(zeros), ())
    found = {}
    for k in model.contacts:
        unit = tuple(jnp.where(i == k, 1, zero) for i, zero in enumerate(zeros))
        found[k] = model.rates((k,), t, y, free, unit)[0] < model.rates((k,), t, y, free, zeros)[0]
    return found
