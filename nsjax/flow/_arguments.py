"""The arguments of `solve` and of what is built on it: converted, and mistakes found before anything is compiled."""

from collections.abc import Mapping, Sequence
from typing import Any

import diffrax as dfx
import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from diffrax._root_finder import use_stepsize_tol
from jax.core import Tracer

from .._numerics._text import components, did_you_mean, known
from .._types import Scalar, Y
from ..system._checks import check_direction, check_fields, check_parameters, check_system
from ..system._system import System
from ._save import in_order
from .steppers._exponential import Exponential


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
    check_fields(system)
    if not isinstance(solver, dfx.AbstractSolver):
        raise TypeError(f"Argument `solver` must be a diffrax solver such as `diffrax.Tsit5()`, but got {solver!r}.")
    leaves = jax.tree.leaves(y0, is_leaf=lambda x: x is None)
    if not leaves:
        raise ValueError("Argument `y0` must hold at least one number, but it is empty.")
    for leaf in leaves:
        if leaf is None or isinstance(leaf, str):
            raise TypeError(f"Argument `y0` must hold floating point numbers, but has a leaf {leaf!r}.")
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


def check_numbers(system: System, t0: Scalar, t1: Scalar, y0: Y) -> None:
    """Checks the numbers that are known, where a failure is to raise: before anything is compiled."""
    for name, t in (("t0", t0), ("t1", t1)):
        if not isinstance(t, Tracer) and not np.isfinite(t):
            raise ValueError(f"Argument `{name}` must be finite, but is {float(t)}.")
    for name, value in components(y0) if known(y0) else []:
        if not np.isfinite(value):
            raise ValueError(f"Argument `y0` must be finite, but its component `{name}` is {float(value)}.")
    check_parameters(system)


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
    values = {n: getattr(controller, n, None) for n in ("rtol", "atol")}
    values = {n: float(x) for n, x in values.items() if eqx.is_array_like(x) and not isinstance(x, Tracer)}
    for name, value in values.items():
        if not value >= 0:
            raise ValueError(f"Argument `stepsize_controller` must have {name} >= 0, but got {name} = {value}.")
    if len(values) == 2 and not any(values.values()):
        raise ValueError("Argument `stepsize_controller` must have a tolerance above zero, but rtol = atol = 0.")
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
        if isinstance(mode, str):
            raise ValueError(
                "Argument `mode` must be numbers, one for each switch, or a dictionary such as "
                f"{ {name: 0 for name in switches} }, but got {mode!r}."
            )
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
            names = ", ".join(f"`{n}`" for n in switches) or "none"
            raise ValueError(
                f"Argument `mode` must name switches of the system ({names}), but got `{name}`."
                + did_you_mean(str(name), switches)
            )
        allowed = tuple(sorted(switches[name].modes))
        if not allowed:
            continue
        traced = isinstance(value, Tracer)
        whole = traced or (eqx.is_array_like(value) and jnp.issubdtype(jnp.result_type(value), jnp.integer))
        if not whole or (not traced and jnp.ndim(value) == 0 and int(value) not in allowed):
            raise ValueError(f"Argument `mode` must give `{name}` one of {allowed}, but got {value!r}.")
    return {n: jnp.asarray(v, jnp.int32) for n, v in mode.items()}
