"""What can be read off a function's jaxpr: on which inputs a result (or its derivative) depends.

Used to leave out work which a model does not need, and to check models, without evaluating anything.
"""

from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from ._evaluation import called, Evaluation


# Each entry of the result depends on the same entry of the operands.
ELEMENTWISE = frozenset(
    "abs acos acosh add add_any and asin asinh atan atan2 atanh cbrt ceil clamp convert_element_type copy cos cosh "
    "div eq erf erf_inv erfc exp exp2 expm1 floor ge gt integer_pow is_finite le lgamma digamma log log1p logistic lt "
    "max min mul ne neg nextafter not or pow real_type reduce_precision rem round rsqrt select_if_vmap select_n sign "
    "sin sinh sqrt square stop_gradient sub tan tanh xor".split()
)


def _union(m: np.ndarray, axes: Any = None) -> np.ndarray:
    """What is marked anywhere along these axes."""
    found = np.bitwise_or.reduce(m, axis=axes, initial=0)
    return np.asarray(found, m.dtype)  # NumPy hands out integers of Python by themselves


def _either(*ms: np.ndarray) -> np.ndarray:
    """What is marked in any of them, entry by entry."""
    return _union(np.stack(ms), 0)


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
    "reduce_sum": lambda p, m: _union(m, p["axes"]),
    "reshape": lambda p, m: m.reshape(p["new_sizes"]),
    "rev": lambda p, m: np.flip(m, p["dimensions"]),
    "slice": lambda p, m: m[tuple(map(slice, p["start_indices"], p["limit_indices"], p["strides"] or [1] * m.ndim))],
    "split": lambda p, m: np.split(m, np.cumsum(p["sizes"])[:-1], p["axis"]),
    "squeeze": lambda p, m: m.squeeze(p["dimensions"]),
    "stack": lambda p, *ms: np.stack(ms, p["axis"]),
    "transpose": lambda p, m: m.transpose(p["permutation"]),
}


Mask = np.ndarray  # of truth values, or of integers with a bit for each of many; as large as what it tells of


def _none(aval: Any) -> Mask:
    return np.zeros(getattr(aval, "shape", ()), bool)


def _masks(closed: Any, inputs: list[Mask], leapt: list[Mask] | None = None) -> tuple[list[Mask], list[Mask]]:
    """Which entries of the results depend on the marked entries of the inputs, and which by way of an operation that
    jumps (or on the entries that are marked as `leapt` already); too many rather than too few."""
    pairs = list(zip(inputs, leapt or [np.zeros_like(m) for m in inputs]))
    program = Evaluation(closed, pairs, lambda x, aval: (_none(aval), _none(aval)))
    for e, pairs in program:
        have, leaps, name = [pair[0] for pair in pairs], [pair[1] for pair in pairs], e.primitive.name
        inner = called(e)
        if inner is not None and any(m.any() for m in have):
            out = _masks(inner, have, leaps)
        else:
            out = _passed_on(e, have), _passed_on(e, leaps)
            real = any(m.any() and jnp.issubdtype(v.aval.dtype, jnp.inexact) for v, m in zip(e.invars, have))
            whole = any(not jnp.issubdtype(v.aval.dtype, jnp.inexact) for v in e.outvars)
            if real and (name in _JUMPING or (whole and name != "is_finite")):
                out = out[0], out[0]
        program.put(e, list(zip(*out)))
    return [pair[0] for pair in program.results], [pair[1] for pair in program.results]


def _passed_on(e: Any, have: list[Mask]) -> list[Mask]:
    """Which entries of the results of an operation depend on the marked entries of its operands."""
    name = e.primitive.name
    if not any(m.any() for m in have):
        return [_none(v.aval) for v in e.outvars]
    if name in ELEMENTWISE:
        return [_either(*np.broadcast_arrays(*have))]
    if name in MOVING:
        moved = MOVING[name](e.params, *have)
        return [np.asarray(m, np.result_type(*have)) for m in (moved if isinstance(moved, list) else [moved])]
    if name == "dot_general" and not e.params["dimension_numbers"][1][0]:
        left, right = (_union(m, tuple(axes)) for m, axes in zip(have, e.params["dimension_numbers"][0]))
        return [np.asarray(np.bitwise_or.outer(left, right), np.result_type(left, right))]
    marks = _either(*map(_union, have))
    return [np.broadcast_to(marks, getattr(v.aval, "shape", ())) for v in e.outvars]


def _of_leaves(fn: Callable[[Any], Any], x: Any) -> tuple[list[bool], list[bool]]:
    """Which leaves of `fn(x)` depend on `x`, and which by way of an operation that jumps."""
    closed = jax.make_jaxpr(fn)(x)
    reached, leapt = _masks(closed, [np.ones(a.shape, bool) for a in closed.in_avals])
    return [bool(m.any()) for m in reached], [bool(m.any()) for m in leapt]


def touched(fn: Callable[[Any], Any], x: Any) -> list[bool]:
    """Which leaves of `fn(x)` depend on `x`."""
    return _of_leaves(fn, x)[0]


def jumps(fn: Callable[[Any], Any], x: Any) -> list[bool]:
    """Which leaves of `fn(x)` are made with an operation that jumps, of a number that depends on `x`."""
    return _of_leaves(fn, x)[1]


def bends_and_jumps(fn: Callable[[Any], Any], x: Any) -> tuple[list[bool], list[bool]]:
    """Which leaves of `fn(x)` are not structurally affine in `x`, as their derivatives depend on where they are taken
    or they jump (the derivative of a staircase is constant too); and which jump."""
    dx, leaps = jax.tree.map(jnp.ones_like, x), jumps(fn, x)
    moves = touched(lambda x: jax.jvp(fn, (x,), (dx,))[1], x)
    return [a or b for a, b in zip(leaps, moves, strict=True)], leaps


def is_constant(fn: Callable[[Any], Any], x: Any) -> bool:
    """Whether `fn` is structurally independent of `x`, entry by entry: a state may be one array or several leaves."""
    return not any(touched(fn, x))


def is_affine(fn: Callable[[Any], Any], x: Any) -> bool:
    """Whether `fn` is structurally affine in `x`."""
    return not any(bends_and_jumps(fn, x)[0])


def dependence(fn: Callable[[Any], Any], x: Any) -> np.ndarray:
    """Which results of `fn`, scalars, may depend on which numbers of `x`: booleans `(results, numbers)`."""
    closed = jax.make_jaxpr(fn)(x)
    shapes = [a.shape for a in closed.in_avals]
    ends = np.cumsum([0, *[a.size for a in closed.in_avals]])
    bits = np.array([1 << i for i in range(ends[-1])], object)  # integers of Python: of any number of bits
    masks = [bits[start:end].reshape(shape) for start, end, shape in zip(ends, ends[1:], shapes)]
    found = [int(_union(m)) for m in _masks(closed, masks)[0]]
    return np.array([[bool(marks & bit) for bit in bits] for marks in found], bool).reshape(len(found), len(bits))


_NOT_NEGATIVE = frozenset("abs cosh exp exp2 logistic sqrt square".split())
_KEEPING_SIGN = frozenset(MOVING) | frozenset(
    "add add_any convert_element_type copy cumsum div min mul reduce_max reduce_min reduce_precision "
    "stop_gradient".split()
)


def never_negative(fn: Callable[[Any], Any], x: Any) -> list[bool]:
    """Which leaves of `fn(x)` are sums, products and the like of squares, absolute values and exponentials, so that
    they cannot be negative whatever `x` is."""
    closed = jax.make_jaxpr(fn)(x)
    return _never_negative(closed, [False] * len(closed.in_avals))


def _never_negative(closed: Any, inputs: list[bool]) -> list[bool]:
    def constant(x: Any, aval: Any) -> bool:
        return not isinstance(x, jax.Array) and bool(np.all(np.asarray(x) >= 0))

    program = Evaluation(closed, inputs, constant)
    for e, have in program:
        name, inner = e.primitive.name, called(e)
        if inner is not None:
            out = _never_negative(inner, have)
        elif name == "select_n":
            out = [all(have[1:])]
        elif name == "max":
            out = [any(have)]
        elif name == "pow":
            out = [have[0]]
        elif name == "mul" and e.invars[0] is e.invars[1]:
            out = [True]
        else:
            even = name == "integer_pow" and e.params["y"] % 2 == 0
            out = [name in _NOT_NEGATIVE or even or (name in _KEEPING_SIGN and all(have))]
        program.put(e, out if len(out) == len(e.outvars) else out * len(e.outvars))
    return program.results
