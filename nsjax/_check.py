"""Mistakes in a model or in the arguments of `solve`, found before anything is integrated."""

from collections.abc import Mapping, Sequence
from functools import partial
from typing import Any

import diffrax as dfx
import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from diffrax._root_finder import use_stepsize_tol
from jax.core import Tracer

from ._exponential import Exponential
from ._filippov import Model, State
from ._save import in_order
from ._structure import is_affine, is_constant
from ._system import clock, impact, relay, sgn, System
from ._types import Scalar, Y


def _shape(tree: Any) -> Any:
    return jax.tree.map(lambda x: f"{x.dtype.name}{list(x.shape)}", tree)


def check_system(system: Any) -> None:
    if not isinstance(system, System):
        hint = " Call it, with its parameters: `Model(...)`." if isinstance(system, type) else ""
        raise TypeError(f"Argument `system` must be an instance of `nsjax.System`, but got {system!r}.{hint}")


def check_solve(
    system: System,
    t0: Any,
    t1: Any,
    y0: Y,
    mode: Any,
    solver: Any,
    controller: Any,
    saveat: Any,
    max_steps: Any,
    max_events: Any,
    adjoint: Any,
) -> tuple[Y, Scalar, Scalar, Any, dfx.AbstractStepSizeController, dict[str, Any]]:
    """Converts and checks the arguments of `solve`."""
    check_system(system)
    if not isinstance(solver, dfx.AbstractSolver):
        raise TypeError(f"Argument `solver` must be a diffrax solver such as `diffrax.Tsit5()`, but got {solver!r}.")
    leaves = jax.tree.leaves(y0)
    if not leaves:
        raise ValueError("Argument `y0` must hold at least one number, but it is empty.")
    for leaf in leaves:
        kind = jnp.result_type(leaf)
        if jnp.issubdtype(kind, jnp.complexfloating):
            raise TypeError(
                "Argument `y0` must be real, but has a complex leaf; split it into real and imaginary part."
            )
        if not isinstance(leaf, (float, int)) and not jnp.issubdtype(kind, jnp.floating):
            raise TypeError(f"Argument `y0` must be of floating point dtype, but has a leaf of dtype {kind}.")
        if isinstance(leaf, (bool, int)):
            raise TypeError(
                f"Argument `y0` must hold floating point numbers, but has the integer {leaf!r}; write {leaf}.0."
            )
    dtype = jnp.result_type(*leaves)
    dtype = jnp.result_type(float) if all(isinstance(x, float) for x in leaves) else dtype
    y0 = jax.tree.map(lambda x: jnp.asarray(x, dtype), y0)
    t0, t1 = jnp.asarray(t0, dtype), jnp.asarray(t1, dtype)
    for name, t in (("t0", t0), ("t1", t1)):
        if t.shape != ():
            raise ValueError(f"Argument `{name}` must be a scalar, but has shape {t.shape}; use `jax.vmap` for many.")
    for name, value in (("max_steps", max_steps), ("max_events", max_events)):
        if not isinstance(value, int) or value < 1:
            raise ValueError(f"Argument `{name}` must be a positive integer, but got {value!r}.")
    if not isinstance(saveat, dfx.SaveAt) or not (
        isinstance(saveat.subs, dfx.SubSaveAt) or (saveat.dense and saveat.subs is None)
    ):
        raise ValueError(f"Argument `saveat` must be a `diffrax.SaveAt` without nested `subs`, but got {saveat!r}.")
    for name in ("solver_state", "controller_state", "made_jump"):
        if getattr(saveat, name):
            raise ValueError(f"Argument `saveat` must not ask for `{name}`, which a flow with events does not have.")
    _check_times(saveat, t0, t1)
    check_direction(system, t1 < t0)
    if isinstance(solver, Exponential) and isinstance(adjoint, dfx.RecursiveCheckpointAdjoint):
        raise ValueError(
            "Argument `adjoint` must not be `RecursiveCheckpointAdjoint` for `Exponential`, whose matrix exponential "
            "is a loop of unknown length; use `diffrax.DirectAdjoint()`."
        )
    controller = _controller(controller, dtype)
    return y0, t0, t1, _implicit(solver, controller, adjoint), controller, _given(system, mode)


def _check_times(saveat: dfx.SaveAt, t0: Scalar, t1: Scalar) -> None:
    """Checks the times at which the solution is to be saved, where all of them are known (else `_integrate` does)."""
    ts = getattr(saveat.subs, "ts", None)
    if ts is None or any(isinstance(t, Tracer) for t in (ts, t0, t1)):
        return
    times = np.asarray(ts, t0.dtype)
    if times.ndim != 1:
        raise ValueError(f"Argument `saveat` must have a vector of times `ts`, but its shape is {times.shape}.")
    if len(times) and not in_order(times, np.asarray(t0), np.asarray(t1)):
        bad = times[~np.isfinite(times)] if not np.isfinite(times).all() else times[(times - t0) * (times - t1) > 0]
        got = f"{bad[0]}" if len(bad) else "times in another order; sort them, `jnp.sort(ts)`"
        raise ValueError(
            f"Argument `saveat` must have times `ts` that follow one another from t0 = {float(t0):.10g} to t1 = "
            f"{float(t1):.10g}, but got {got}."
        )


def _implicit(solver: Any, controller: Any, adjoint: Any) -> Any:
    """Gives an implicit solver's root finder the tolerances of the step size controller, and the solver a kind of loop
    that can be differentiated, as diffrax does."""
    if not isinstance(solver, dfx.AbstractImplicitSolver):
        return solver
    open_ = [n for n in ("rtol", "atol", "norm") if getattr(solver.root_finder, n) is use_stepsize_tol]
    if open_ and not isinstance(controller, dfx.AbstractAdaptiveStepSizeController):
        raise ValueError(
            "Argument `stepsize_controller` must be adaptive for an implicit solver whose root finder has no "
            "tolerances, but got a fixed one. Use `diffrax.PIDController(rtol=..., atol=...)`, or pass "
            "`root_finder=diffrax.VeryChord(rtol=..., atol=..., norm=optimistix.max_norm)` to the solver."
        )
    if getattr(solver, "scan_kind", "") is None and not isinstance(adjoint, dfx.RecursiveCheckpointAdjoint):
        solver = eqx.tree_at(lambda s: s.scan_kind, solver, "lax", is_leaf=lambda x: x is None)
    return eqx.tree_at(
        lambda s: [getattr(s.root_finder, n) for n in open_], solver, [getattr(controller, n) for n in open_]
    )


def _controller(controller: Any, dtype: Any) -> dfx.AbstractStepSizeController:
    eps = float(jnp.finfo(dtype).eps)
    if controller is None:
        tol = 1e-8 if eps < 1e-10 else 1e-5
        return dfx.PIDController(rtol=tol, atol=tol)
    if not isinstance(controller, dfx.AbstractStepSizeController):
        raise TypeError(
            "Argument `stepsize_controller` must be a diffrax step size controller, such as "
            f"`diffrax.PIDController(rtol=1e-8, atol=1e-8)`, but got {controller!r}."
        )
    rtol = getattr(controller, "rtol", None)
    # A step of size one is rounded by about eps; its error estimate by a few times that. (Inside `jit` the
    # tolerance may have no value yet.)
    least = 8 * eps
    known = eqx.is_array_like(rtol) and not isinstance(rtol, Tracer)
    if known and 0 < float(rtol) < least:
        cure = (
            "Call `jax.config.update('jax_enable_x64', True)` and pass float64 values, or loosen the tolerance."
            if eps > 1e-10
            else "Loosen the tolerance."
        )
        raise ValueError(
            f"Argument `stepsize_controller` must have a tolerance that {dtype} can hold (rtol >= {least:.1e}), but "
            f"got rtol = {float(rtol):.1e}. {cure}"
        )
    return controller


def _given(system: System, mode: Any) -> dict[str, Any]:
    switches = {k.name: k for k in system.switches}
    if mode is None:
        return {}
    if not isinstance(mode, Mapping):
        single = not isinstance(mode, Sequence) and jnp.ndim(mode) == 0
        values = [mode] if single else list(mode)
        if len(values) != len(switches):
            raise ValueError(
                f"Argument `mode` must have one value for each of the {len(switches)} switches "
                f"({', '.join(switches)}), but got {len(values)}."
            )
        mode = dict(zip(switches, values))
    for name, value in mode.items():
        if name not in switches:
            known = ", ".join(f"`{n}`" for n in switches) or "none"
            raise ValueError(f"Argument `mode` must name switches of the system, but got `{name}`; they are: {known}.")
        allowed = (-1, 0, 1) if isinstance(switches[name], sgn) else (0, 1)
        if isinstance(switches[name], clock):
            continue
        if isinstance(value, int) and value not in allowed:
            raise ValueError(f"Argument `mode` must give `{name}` one of {allowed}, but got {value}.")
    return {n: jnp.asarray(v, jnp.int32) for n, v in mode.items()}


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


def check_contacts(model: Model, t: Scalar, y: Y) -> Scalar:
    """Checks that every contact force opens its gap, which depends on numbers.

    **Returns:** the time `t`, to be used so that the error is raised.
    """
    zeros = tuple(jnp.zeros_like(t) for _ in model.switches)
    free = State((), (None,) * len(zeros), ())
    for k in model.contacts:
        unit = tuple(jnp.where(i == k, 1, zero) for i, zero in enumerate(zeros))
        force = model.rates((k,), t, y, free, unit)[0] - model.rates((k,), t, y, free, zeros)[0]
        name = model.switches[k].name
        t = eqx.error_if(
            t,
            force < 0,
            f"`{type(model.system).__name__}.vector_field` must contain `s.{name}` with the sign with which a contact "
            f"force s.{name} >= 0 opens the gap `{name}`, but it closes it. Change its sign.",
        )
    return t
