"""The arguments of `solve` and of what is built on it: converted, and mistakes found before anything is compiled."""

from collections.abc import Mapping, Sequence
from typing import Any

import diffrax as dfx
import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax.core import Tracer

from .._numerics._text import components, did_you_mean, known
from .._types import Scalar, Y
from ..system._checks import check_direction, check_fields, check_parameters, check_system
from ..system._system import System
from ._save import times_in_order


def checked_start(system: System, t: Any, y: Y, mode: Any) -> tuple[Scalar, Y, dict[str, Any]]:
    """Where a solution sets out, converted and checked: time, state, and the modes that are given."""
    check_system(system)
    check_fields(system)
    y = checked_state(y)
    return checked_time("t0", t, jnp.result_type(*jax.tree.leaves(y))), y, given_modes(system, mode)


def checked_state(y: Y) -> Y:
    """A state of arrays of one floating point dtype. Integers become floating point numbers."""
    leaves = jax.tree.leaves(y, is_leaf=lambda x: x is None)
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
        if not (jnp.issubdtype(kind, jnp.floating) or jnp.issubdtype(kind, jnp.integer)):
            raise TypeError(f"Argument `y0` must hold floating point numbers, but has a leaf of dtype {kind}.")
    dtype = floating_dtype(leaves)
    return jax.tree.map(lambda x: jnp.asarray(x, dtype), y)


def floating_dtype(leaves: Sequence[Any]) -> Any:
    """That of the arrays of floating point numbers; where there is none, as of Python's numbers and integers alone, the
    default one."""
    own = [x for x in leaves if type(x) not in (float, int) and jnp.issubdtype(jnp.result_type(x), jnp.floating)]
    return jnp.result_type(*own) if own else jnp.result_type(float)


def checked_time(name: str, t: Any, dtype: Any) -> Scalar:
    t = jnp.asarray(t, dtype)
    if t.shape != ():
        raise ValueError(f"Argument `{name}` must be a scalar, but has shape {t.shape}; use `jax.vmap` for many.")
    return t


def check_span(system: System, t0: Scalar, t1: Scalar, saveat: Any) -> None:
    """Checks whether a system can be solved from `t0` to `t1`, and what is asked for saved on the way."""
    if not isinstance(saveat, dfx.SaveAt) or not (
        isinstance(saveat.subs, dfx.SubSaveAt) or (saveat.dense and saveat.subs is None)
    ):
        raise ValueError(f"Argument `saveat` must be a `diffrax.SaveAt` without nested `subs`, but got {saveat!r}.")
    for name in ("solver_state", "controller_state", "made_jump"):
        if getattr(saveat, name):
            raise ValueError(f"Argument `saveat` must not ask for `{name}`, which a flow with events does not have.")
    _check_times(saveat, t0, t1)
    check_direction(system, t1 < t0)


def check_numbers(system: System, t0: Scalar, t1: Scalar, y0: Y) -> None:
    """Checks the numbers that are known, where a failure is to raise: before anything is compiled."""
    for name, t in (("t0", t0), ("t1", t1)):
        if not isinstance(t, Tracer) and not np.isfinite(t):
            raise ValueError(f"Argument `{name}` must be finite, but is {float(t)}.")
    for name, value in components(y0).items() if known(y0) else ():
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
    if len(times) and not times_in_order(times, np.asarray(t0), np.asarray(t1)):
        bad = times[~np.isfinite(times)] if not np.isfinite(times).all() else times[(times - t0) * (times - t1) > 0]
        got = f"{bad[0]}" if len(bad) else "times in another order; sort them, `jnp.sort(ts)`"
        raise ValueError(
            f"Argument `saveat` must have times `ts` that follow one another from t0 = {float(t0):.10g} to t1 = "
            f"{float(t1):.10g}, but got {got}."
        )


def given_modes(system: System, mode: Any) -> dict[str, Any]:
    """The argument `mode`, by the names of the switches."""
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
