"""What can be read off a function's jaxpr: on which inputs a result (or its derivative) depends.

Used to leave out work which a model does not need, and to check models, without evaluating anything.
"""

from collections.abc import Callable
from typing import Any

import jax
import jax.extend.core as jex
import jax.numpy as jnp
import numpy as np


_CALLS = ("jit", "pjit", "closed_call", "custom_jvp_call", "custom_vjp_call")
# Each entry of the result depends on the same entry of the operands.
ELEMENTWISE = frozenset(
    "abs acos acosh add add_any and asin asinh atan atan2 atanh cbrt ceil clamp convert_element_type copy cos cosh "
    "div eq erf erf_inv erfc exp exp2 expm1 floor ge gt integer_pow is_finite le lgamma digamma log log1p logistic lt "
    "max min mul ne neg nextafter not or pow real_type reduce_precision rem round rsqrt select_n sign sin sinh sqrt "
    "square stop_gradient sub tan tanh xor".split()
)


def _padded(p: dict, m: np.ndarray, filler: np.ndarray) -> np.ndarray:
    """`lax.pad` of marks, or of what else an array may hold."""
    places = [lo + (inner + 1) * np.arange(n) for n, (lo, _, inner) in zip(m.shape, p["padding_config"])]
    shape = [lo + hi + n + inner * max(n - 1, 0) for n, (lo, hi, inner) in zip(m.shape, p["padding_config"])]
    out = np.full(shape, filler[()], m.dtype)
    kept = [(at >= 0) & (at < n) for at, n in zip(places, shape)]
    out[np.ix_(*(at[k] for at, k in zip(places, kept)))] = m[np.ix_(*kept)]
    return out


# They jump. So does what makes integers or truth values of real numbers (comparisons, conversions, `argmax`), and what
# a loop does is not looked at. (What only asks whether a number is finite does not count.)
_JUMPING = frozenset("ceil cond floor nextafter rem round scan sign while".split())
# Entries are moved, repeated or summed: what that makes of a mask (parameters `p` of the primitive, operands `m`).
MOVING: dict[str, Callable[..., Any]] = {
    "broadcast_in_dim": lambda p, m: np.broadcast_to(
        np.expand_dims(m, tuple(i for i in range(len(p["shape"])) if i not in p["broadcast_dimensions"])), p["shape"]
    ),
    "concatenate": lambda p, *ms: np.concatenate(ms, p["dimension"]),
    "pad": _padded,
    "reduce_sum": lambda p, m: m.any(p["axes"]),
    "reshape": lambda p, m: m.reshape(p["new_sizes"]),
    "rev": lambda p, m: np.flip(m, p["dimensions"]),
    "slice": lambda p, m: m[tuple(map(slice, p["start_indices"], p["limit_indices"], p["strides"] or [1] * m.ndim))],
    "split": lambda p, m: np.split(m, np.cumsum(p["sizes"])[:-1], p["axis"]),
    "squeeze": lambda p, m: m.squeeze(p["dimensions"]),
    "stack": lambda p, *ms: np.stack(ms, p["axis"]),
    "transpose": lambda p, m: m.transpose(p["permutation"]),
}


def _masks(jaxpr: Any, inputs: list[np.ndarray], jumps: list[str] | None = None) -> list[np.ndarray]:
    """Which entries of the results depend on the marked entries of the inputs; too many rather than too few. `jumps`
    gathers the operations that jump and are applied to such entries."""
    jumps = [] if jumps is None else jumps
    known = dict(zip(jaxpr.invars, inputs))

    def shape(v: Any) -> tuple[int, ...]:
        return getattr(v.aval, "shape", ())

    def read(v: Any) -> np.ndarray:
        return known[v] if not isinstance(v, jex.Literal) and v in known else np.zeros(shape(v), bool)

    for e in jaxpr.eqns:
        have, name = [read(v) for v in e.invars], e.primitive.name
        real = any(m.any() and jnp.issubdtype(v.aval.dtype, jnp.inexact) for v, m in zip(e.invars, have))
        whole = any(not jnp.issubdtype(v.aval.dtype, jnp.inexact) for v in e.outvars)
        if real and (name in _JUMPING or (whole and name not in ("is_finite", *_CALLS))):
            jumps.append(name)
        inner = [p for p in e.params.values() if isinstance(p, jex.ClosedJaxpr)]
        if not any(m.any() for m in have):
            out = [np.zeros(shape(v), bool) for v in e.outvars]
        elif name in ELEMENTWISE:
            out = [np.any(np.broadcast_arrays(*have), axis=0)]
        elif name in MOVING:
            moved = MOVING[name](e.params, *have)
            out = moved if isinstance(moved, list) else [moved]
        elif name == "dot_general" and not e.params["dimension_numbers"][1][0]:
            left, right = (m.any(tuple(axes)) for m, axes in zip(have, e.params["dimension_numbers"][0]))
            out = [np.logical_or.outer(left, right)]
        elif name in _CALLS and len(inner) == 1:
            out = _masks(inner[0].jaxpr, have, jumps)
        else:
            out = [np.ones(shape(v), bool) for v in e.outvars]
        known.update(zip(e.outvars, out))
    return [read(v) for v in jaxpr.outvars]


def is_constant(fn: Callable[[Any], Any], x: Any) -> bool:
    """Whether `fn` is structurally independent of `x`, entry by entry: a state may be one array or several leaves."""
    return not any(touched(fn, x))


def touched(fn: Callable[[Any], Any], x: Any) -> list[bool]:
    """Which leaves of `fn(x)` depend on `x`."""
    jaxpr = jax.make_jaxpr(fn)(x).jaxpr
    return [bool(m.any()) for m in _masks(jaxpr, [np.ones(v.aval.shape, bool) for v in jaxpr.invars])]


def is_affine(fn: Callable[[Any], Any], x: Any) -> bool:
    """Whether `fn` is structurally affine in `x`: its derivative does not depend on where it is taken, and it does not
    jump (the derivative of a staircase is constant too)."""
    dx = jax.tree.map(jnp.ones_like, x)
    return not may_jump(fn, x) and is_constant(lambda x: jax.jvp(fn, (x,), (dx,))[1], x)


def may_jump(fn: Callable[[Any], Any], x: Any) -> bool:
    """Whether `fn` holds an operation that jumps, of a number that depends on `x`."""
    jaxpr = jax.make_jaxpr(fn)(x).jaxpr
    met: list[str] = []
    _masks(jaxpr, [np.ones(v.aval.shape, bool) for v in jaxpr.invars], met)
    return bool(met)


def dependence(fn: Callable[[Any], Any], x: Any) -> np.ndarray:
    """Which results of `fn`, scalars, may depend on which numbers of `x`: booleans `(results, numbers)`."""
    jaxpr = jax.make_jaxpr(fn)(x).jaxpr
    none = [np.zeros(v.aval.shape, bool) for v in jaxpr.invars]
    columns = []
    for n, mask in enumerate(none):
        for i in np.ndindex(mask.shape):
            marked = mask.copy()
            marked[i] = True
            columns.append([m.any() for m in _masks(jaxpr, [*none[:n], marked, *none[n + 1 :]])])
    return np.array(columns, bool).reshape(len(columns), len(jaxpr.outvars)).T
