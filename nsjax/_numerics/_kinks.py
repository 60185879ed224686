"""Kinks of a function, found in its program: |h|, and the maximum and minimum of two numbers with the difference h.

The jaxpr is evaluated, and where a sign is put in for a kink, |h| is h times that.
"""

import contextlib
import functools as ft
from collections.abc import Callable, Generator
from typing import Any

import jax
import jax.extend.core as jex
import jax.lax as lax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array

from ._evaluation import anywhere, called, Evaluation


_KINKS: dict[str, Callable[..., Any]] = {"abs": jnp.abs, "max": jnp.maximum, "min": jnp.minimum, "clamp": lax.clamp}
_IDLE = {"max": -np.inf, "min": np.inf}  # bounds that never act
_PARTIAL = ("pow", "sqrt", "rsqrt", "log", "log1p", "acos", "asin", "acosh", "atanh")
_SMOOTH = ("hypot", "logaddexp", "logaddexp2")  # functions of JAX that are smooth, but written with kinks

# One evaluation serves to list kinks, to give the h of one of them (it goes no further), and to put signs in. So it is
# a generator: it yields the kind and h of each kink, and is sent the sign of h, or None to leave it as it is.
Walk = Generator[tuple[str, Array], Array | None, Any]
Seen = dict[Any, tuple[Any, tuple, Any]]
"""By an operation's name and arguments: its result, the arguments, its parameters."""


def _has_kink(e: Any) -> bool:
    if e.primitive.name in _KINKS:
        return jnp.issubdtype(e.outvars[0].aval.dtype, jnp.floating)
    inner = [jaxpr for jaxpr in jex.jaxprs_in_params(e.params) if jaxpr.debug_info.func_name not in _SMOOTH]
    return any(_has_kink(e) for jaxpr in inner for e in jaxpr.eqns)


def _is_call(e: Any) -> bool:
    """Whether it is a function that is only written apart, as `jnp.flip` is."""
    inner = called(e, with_rules=False)
    return inner is not None and inner.jaxpr.debug_info.func_name not in _SMOOTH


def _is_known(x: Any) -> bool:
    """Whether it is a number written in the program: these are kept as NumPy arrays."""
    return isinstance(x, np.ndarray)


def _once(seen: Seen, name: Any, fn: Callable[..., Any], *x: Any, params: Any = None) -> Any:
    """`fn(*x)`, kept with x, so that equal values are one object: kinks on the same surface have one switch."""
    key = (name, *[(v.dtype.str, v.shape, v.tobytes()) if _is_known(v) else id(v) for v in x])
    if key not in seen:
        known = all(map(_is_known, x))
        with jax.ensure_compile_time_eval() if known else contextlib.nullcontext():
            out = fn(*x)
        number = isinstance(out, jax.Array) and jnp.issubdtype(out.dtype, jnp.number)
        seen[key] = np.asarray(out) if known and number else out, x, params
    return seen[key][0]


def _walk(closed: jex.ClosedJaxpr, values: list[Any], seen: Seen) -> Walk:
    """Evaluates a program."""
    program = Evaluation(closed, values, lambda x, aval: x if isinstance(x, jax.Array) else np.asarray(x, aval.dtype))
    for e, x in program:
        name, inner = e.primitive.name, called(e)
        if not (_has_kink(e) or _is_call(e)):
            bind = ft.partial(e.primitive.bind, **e.primitive.get_bind_params(e.params))
            out = bind(*x) if e.effects else _once(seen, (name, str(e.params)), bind, *x, params=e.params)
            out = out if e.primitive.multiple_results else [out]
        elif inner is not None:
            out = yield from _walk(inner, x, seen)
        elif name == "clamp":
            raised = yield from _kink("max", [x[1], x[0]], seen)
            out = [(yield from _kink("min", [raised, x[2]], seen))]
        elif name in _KINKS:
            out = [(yield from _kink(name, x, seen))]
        else:
            raise ValueError(
                f"A kink (abs, maximum, minimum, clip) inside `{name}` cannot be marked, because it may be met any "
                "number of times. Write the vector field without the loop or branch, or declare the kink as a `sgn` "
                "switch."
            )
        program.put(e, out)
    return program.results


def _kink(kind: str, x: list[Any], seen: Seen) -> Walk:
    """|h|, or the greater or smaller of two numbers whose difference is h."""
    x = sorted(x, key=_is_known)  # the surface 0 - x is that of x
    if _is_known(x[0]):
        return _once(seen, kind, _KINKS[kind], *x)
    bound = x[1] if len(x) > 1 and _is_known(x[1]) else None
    if bound is not None and np.all(bound == _IDLE[kind]):
        return _once(seen, "spread", lambda a, b: jnp.broadcast_to(a, jnp.broadcast_shapes(a.shape, b.shape)), *x)
    alone = len(x) == 1 or bound is not None and bound.ndim == 0 and bound == 0
    h = x[0] if alone else _once(seen, ("sub", "{}"), jnp.subtract, *x)  # as the program's own a - b is known
    if ("switch", id(h)) not in seen:
        seen["switch", id(h)] = (yield kind, h), (h,), None
    s, _, _ = seen["switch", id(h)]
    if s is None:
        return _once(seen, kind, _KINKS[kind], *x)
    size = _once(seen, "size", jnp.multiply, h, s)
    if len(x) == 1:
        return size
    return _once(seen, kind, lambda a, b, size: (a + b + (size if kind == "max" else -size)) / 2, *x, size)


def evaluate(fn: Callable[..., Any], *args: Any, seen: Seen | None = None) -> Walk:
    """Evaluates a function of pytrees of arrays."""
    closed, out = jax.make_jaxpr(fn, return_shape=True)(*args)
    found = yield from _walk(closed, jax.tree.leaves(args), {} if seen is None else seen)
    return jax.tree.unflatten(jax.tree.structure(out), [jnp.asarray(x) for x in found])


def has_kinks(fn: Callable[..., Any], *args: Any) -> bool:
    return any(map(_has_kink, jax.make_jaxpr(fn)(*args).jaxpr.eqns))


def is_partial(fn: Callable[..., Any], *args: Any) -> bool:
    """Whether a function has parts that are not defined for all numbers, as powers are not for negative ones. (That
    quotients are not either does not count.)"""
    return anywhere(jax.make_jaxpr(fn)(*args).jaxpr, lambda e: e.primitive.name in _PARTIAL)
