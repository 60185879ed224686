"""Mistakes in a model, found before anything is integrated."""

import dataclasses
from typing import Any

import equinox as eqx
import jax
import jax.flatten_util as jfu
import jax.numpy as jnp
import numpy as np
from jax.core import Tracer
from jaxtyping import Array, Bool

from .._numerics._jaxpr import is_constant
from .._numerics._select import select
from .._numerics._text import did_you_mean, outline
from .._types import Scalar, Y
from ._clock import clock
from ._mode import ModeState, put
from ._model import SwitchedSystem
from ._switch import AbstractSwitch
from ._system import is_number, System


def check_system(system: Any) -> None:
    if not isinstance(system, System):
        hint = " Call it, with its parameters: `Model(...)`." if isinstance(system, type) else ""
        raise TypeError(f"Argument `system` must be an instance of `nsjax.System`, but got {system!r}.{hint}")


def check_fields(module: eqx.Module) -> None:
    """Checks that parameters declared as numbers are numbers, in modules within modules too."""
    for field in dataclasses.fields(module):
        value = getattr(module, field.name)
        for part in value if type(value) is tuple else (value,):
            if isinstance(part, eqx.Module):
                check_fields(part)
        missing = value is None and field.type in (float, "float")
        if is_number(field) and (missing or isinstance(value, str)):
            owner = type(module).__name__
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
    with jax.ensure_compile_time_eval():  # also within a function that is being compiled
        found = system.laws
        for switch in system.switches:
            found = found + [(f"{switch.name}{part}", *rest) for part, *rest in switch.laws(system)]
    for name, law, good, value in found:
        if not np.all(np.asarray(good)):
            got = np.asarray(value)
            raise ValueError(f"`{owner}.{name}` must be {law}, but is {got if got.ndim else float(got)}.")


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
    _check_conditions(name, switches)
    zeros = tuple(jnp.zeros((), t.dtype) for _ in switches)

    def field(s: tuple) -> Y:
        return system.vector_field(t, y, system.values(s))

    out = jax.eval_shape(field, zeros)
    have, want = jax.tree.structure(out), jax.tree.structure(y)
    if have != want:
        raise ValueError(
            f"`{name}.vector_field` must return the structure of the state, {outline(y)}, but returned {outline(out)}. "
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
        switch.check(system, t, y, lambda sk, k=k: field(zeros[:k] + (sk,) + zeros[k + 1 :]))
    obstacle = one_way(system)
    return eqx.error_if(t, direction < 0, obstacle) if obstacle else t


def _check_conditions(owner: str, switches: tuple[AbstractSwitch, ...]) -> None:
    """Checks that what is there only while a contact is closed names a contact."""
    contacts = {k.name: k for k in switches if not k.condition and not isinstance(k, clock)}
    for k in switches:
        if k.condition and k.condition not in contacts:
            raise ValueError(
                f"`{owner}.{k.name}.while_` must name a switch of the system that is there at all times, and no clock "
                f"({', '.join(contacts) or 'there is none'}), but names `{k.condition}`."
                + did_you_mean(k.condition, contacts)
            )


def one_way(system: System) -> str | None:
    """What keeps a system from being run backwards, if anything does."""
    found = [switch.one_way(type(system).__name__) for switch in system.switches]
    return next(filter(None, found), None)


def check_direction(system: System, backwards: Any) -> None:
    """Raises for a system that cannot be run backwards, where it is known that it is to be."""
    obstacle = one_way(system)
    if obstacle and not isinstance(backwards, Tracer) and backwards:
        raise ValueError(obstacle)


def check_autonomous(system: System, t: Scalar, y: Y) -> None:
    """Checks that a model without a `period` does not depend on the time."""
    zeros = tuple(jnp.zeros_like(t) for _ in system.switches)

    def seen(t: Scalar) -> Any:
        surfaces = [switch.surfaces(system, t, y) for switch in system.switches]
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


def check_period(system: System, t: Scalar, y: Y) -> None:
    """Checks, where numbers are known, that a forced system is the same after its `period`: at a few times, for a few
    states and values of its switches."""
    if system.period is None or any(isinstance(x, Tracer) for x in jax.tree.leaves((system, t, y))):
        return
    names = ["vector_field", *(k.name for k in system.switches if not isinstance(k, clock))]
    # At irrational parts of the period, so that neither zeros of harmonics nor jumps are met by chance.
    with jax.ensure_compile_time_eval():
        changes = _changes(system, t, y)
    worst = int(np.argmax(changes))
    if changes[worst] > (1e-5 if t.dtype == jnp.float64 else 1e-2):
        raise ValueError(
            f"`{type(system).__name__}.period` is {float(np.asarray(system.period)):.10g}, but `{names[worst]}` is not "
            "the same one period later. Return the period of all that depends on time: the least common multiple where "
            "there are several."
        )


@eqx.filter_jit
def _changes(system: System, t: Scalar, y: Y) -> Array:
    """By which part of its size, of all such times, each function of a system changes in a period."""
    leaves, tree = jax.tree.flatten(y)
    states = [y, jax.tree.unflatten(tree, [x + 1 + 0.1 * i for i, x in enumerate(leaves)])]
    period = jnp.asarray(system.period, t.dtype)
    times = t + period * jnp.asarray(np.sqrt([2.0, 3.0, 5.0, 7.0, 11.0]) % 1, t.dtype)

    def values(t: Scalar, y: Y, s: Scalar) -> list[Array]:
        f = system.vector_field(t, y, system.values(tuple(s for _ in system.switches)))
        surfaces = [k.surfaces(system, t, y) for k in system.switches if not isinstance(k, clock)]
        return [jfu.ravel_pytree(tree)[0] for tree in (f, *surfaces)]

    def sampled(times: Array) -> list[Array]:
        signs = jnp.asarray([1.0, -1.0], t.dtype)
        rows = [jax.vmap(jax.vmap(values, (0, None, None)), (None, None, 0))(times, y, signs) for y in states]
        return [jnp.concatenate([jnp.ravel(x) for x in column]) for column in zip(*rows)]

    found = []
    for now, later in zip(sampled(times), sampled(times + period)):
        change, size = jnp.abs(now - later), jnp.max(jnp.abs(now), initial=0.0)
        known = jnp.isfinite(change)
        change = jnp.max(select(known, change, 0), initial=0.0)
        found.append(change / select(size > 0, size, 1))
    return jnp.stack(found)


def forces_on_speeds(model: SwitchedSystem, t: Scalar, y: Y) -> dict[int, Bool[Array, ""]]:
    """Tells for each impact with a coefficient of restitution that cannot be rested upon whether its contact force acts
    on dh/dt. Then no impulse changes dh/dt by a finite amount."""
    zeros = tuple(jnp.zeros_like(t) for _ in model.switches)
    found = {}
    for k in model.which("unilateral"):
        if k in model.contacts or model.switches[k].restitution_fn is None:
            continue

        def rates(value: Scalar, k: int = k) -> tuple[Scalar, ...]:
            f = model.field(t, y, put(zeros, (k,), (value,)))
            return jax.jvp(lambda t, y: model.h(k, t, y), (t, y), (jnp.ones_like(t), f))[1]

        gains = jax.jvp(rates, (zeros[k],), (jnp.ones_like(t),))[1]
        found[k] = jnp.any(jnp.stack([gain != 0 for gain in gains]))
    return found


def closing_contacts(model: SwitchedSystem, t: Scalar, y: Y) -> dict[int, Bool[Array, ""]]:
    """Of each contact force whether it closes its gap, which it must not."""
    zeros = tuple(jnp.zeros_like(t) for _ in model.switches)
    free = ModeState.of((), (None,) * len(zeros))
    found = {}
    for k in model.contacts:
        unit = tuple(select(i == k, 1, zero) for i, zero in enumerate(zeros))
        found[k] = model.rates((k,), t, y, free, unit)[0] < model.rates((k,), t, y, free, zeros)[0]
    return found
