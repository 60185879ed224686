"""Arithmetic with power series: a function's jaxpr evaluated on the Taylor coefficients of its arguments.

The coefficients are found one order at a time, so that a differential equation's own series can be fed back, and each
is computed once. (`jax.experimental.jet` computes all orders of a given input anew each time, zeros included: programs
of 3,600 equations instead of 1,100 for the forced friction of section 6.8 at order 16, of 15,700 instead of 3,500 for
that of 2.4; and it does not know arctan.)
"""

import functools as ft
from collections.abc import Callable
from typing import Any

import jax
import jax.extend.core as jex
import jax.lax as lax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array

from ._barrier import once
from ._evaluation import called, Evaluation
from ._select import select


Coefficient = Array | None  # None is zero

# Linear in all of their operands.
_LINEAR = frozenset(
    "neg add add_any sub broadcast_in_dim reshape squeeze slice transpose concatenate reduce_sum rev copy stack pad "
    "stop_gradient cumsum real imag expand_dims".split()
)
# Linear in the operands that are not indices.
_PICKS = frozenset("gather dynamic_slice dynamic_update_slice scatter scatter-add scatter_add".split())
# Steps: their values do not change along a series.
_STEPS = frozenset("sign floor ceil round eq ne lt le gt ge and or not xor is_finite argmax argmin iota".split())

# Partial derivatives of c = f(a) or c = f(a, b) in terms of a, (b,) and c.
_DERIVATIVES: dict[str, tuple[Callable[..., Any], ...]] = {
    "exp": (lambda a, c: c,),
    "exp2": (lambda a, c: c * np.log(2.0),),
    "expm1": (lambda a, c: c + 1.0,),
    "log": (lambda a, c: 1.0 / a,),
    "log1p": (lambda a, c: 1.0 / (1.0 + a),),
    "sqrt": (lambda a, c: 0.5 / c,),
    "rsqrt": (lambda a, c: -0.5 * c / a,),
    "cbrt": (lambda a, c: c / (3.0 * a),),
    "tan": (lambda a, c: 1.0 + c * c,),
    "tanh": (lambda a, c: 1.0 - c * c,),
    "logistic": (lambda a, c: c * (1.0 - c),),
    "atan": (lambda a, c: 1.0 / (1.0 + a * a),),
    "asin": (lambda a, c: 1.0 / jnp.sqrt(1.0 - a * a),),
    "acos": (lambda a, c: -1.0 / jnp.sqrt(1.0 - a * a),),
    "asinh": (lambda a, c: 1.0 / jnp.sqrt(1.0 + a * a),),
    "acosh": (lambda a, c: 1.0 / jnp.sqrt(a * a - 1.0),),
    "atanh": (lambda a, c: 1.0 / (1.0 - a * a),),
    "erf": (lambda a, c: (2 / np.sqrt(np.pi)) * jnp.exp(-a * a),),
    "erfc": (lambda a, c: (-2 / np.sqrt(np.pi)) * jnp.exp(-a * a),),
    "pow": (lambda a, b, c: b * c / a, lambda a, b, c: c * jnp.log(a)),
    "atan2": (lambda a, b, c: b / (a * a + b * b), lambda a, b, c: -a / (a * a + b * b)),
}
# Pairs that are each other's derivative: the partner, and the signs of (own, partner's) derivatives.
_PAIRS = {"sin": ("cos", 1, -1), "cos": ("sin", -1, 1), "sinh": ("cosh", 1, 1), "cosh": ("sinh", 1, 1)}


def _power(n: int) -> Callable[[Any], Any]:
    def fn(x: Any) -> Any:
        m, out, square = abs(n), None, x
        while m:
            if m & 1:
                out = square if out is None else out * square
            m >>= 1
            square = square * square if m else square
        out = jnp.ones_like(x) if out is None else out
        return out if n >= 0 else 1.0 / out

    return fn


def _expansion(e: Any) -> Callable[..., Any] | None:
    """What stands for a primitive, in terms of others."""
    name = e.primitive.name
    if name == "integer_pow":
        return _power(e.params["y"])
    if name == "square":
        return lambda x: x * x
    if name == "clamp":
        return lambda low, x, high: jnp.minimum(jnp.maximum(x, low), high)
    return None


class Series:
    """`fn`, for arguments that are power series in one variable.

    `step(k, *arguments)` takes the k-th coefficients of its arguments, `None` for zero, and returns those of the
    results; orders are to be taken in turn, and one may be taken again with other numbers. `fn` takes and returns flat
    lists of arrays.

    **Raises:** `TypeError`, naming the operation, if `fn` contains one whose series is not known.
    """

    def __init__(self, fn: Callable[..., list[Any]], *args: Any):
        closed = jax.make_jaxpr(fn)(*args)
        self.jaxpr = closed.jaxpr
        self.equations: list[tuple[Any, list[Any], list[Any]]] = []  # equation, operands, results
        self.terms: list[list[Coefficient]] = []  # of each value met, by its number
        self.inner: dict[tuple, Series] = {}
        self.seen: dict[Any, list[int]] = {}
        self.inputs = [self.number([]) for _ in self.jaxpr.invars]
        self.outputs = self.inline(closed, self.inputs)

    def number(self, terms: list[Coefficient]) -> int:
        self.terms.append(terms)
        return len(self.terms) - 1

    def inline(self, closed: jex.ClosedJaxpr, values: list[int]) -> list[int]:
        """Lists the equations of a program, those of the functions it calls included, equal ones once."""
        program = Evaluation(closed, values, lambda x, aval: self.number([x]))
        for e, operands in program:
            inner, short = called(e), _expansion(e)
            if short is not None:
                inner = jax.make_jaxpr(short)(*[jax.ShapeDtypeStruct(v.aval.shape, v.aval.dtype) for v in e.invars])
            program.put(e, self.enlist(e, operands) if inner is None else self.inline(inner, operands))
        return program.results

    def enlist(self, e: Any, operands: list[int]) -> list[int]:
        def name(i: int) -> Any:
            (value,) = self.terms[i] if len(self.terms[i]) == 1 else (None,)
            plain = isinstance(value, (int, float, np.generic)) or isinstance(value, np.ndarray) and value.ndim == 0
            return ("literal", np.result_type(value).name, float(value)) if plain else i  # pyright: ignore

        key: Any = (e.primitive, *map(name, operands), str(e.params))
        if key not in self.seen:
            self.seen[key] = [self.number([]) for _ in e.outvars]
            self.equations.append((e, operands, self.seen[key]))
        return self.seen[key]

    def term(self, value: int, k: int) -> Coefficient:
        terms = self.terms[value]
        return terms[k] if k < len(terms) else None

    def varies(self, value: int) -> bool:
        """Whether any coefficient after the first is known not to be zero."""
        return any(c is not None for c in self.terms[value][1:])

    def step(self, k: int, *args: Coefficient) -> list[Coefficient]:
        for value, x in zip(self.inputs, args, strict=True):
            self.put(value, k, x)
        for e, operands, results in self.equations:
            for value, x in zip(results, self.equation(k, e, operands, results), strict=True):
                self.put(value, k, x)
        return [self.term(value, k) for value in self.outputs]

    def put(self, value: int, k: int, x: Coefficient) -> None:
        terms = self.terms[value]
        terms.extend([None] * (k + 1 - len(terms)))
        terms[k] = x

    # Of max, abs and the like the series is that of the side on which the first coefficients are. It says nothing of a
    # kink ahead: `_error` of the Taylor steps looks for one at the end of a step.
    def equation(self, k: int, e: Any, operands: list[int], results: list[int]) -> list[Coefficient]:
        name, bind = e.primitive.name, ft.partial(e.primitive.bind, **e.params)
        if k == 0 or not any(self.varies(i) for i in operands):
            if k:
                return [None] * len(results)
            out = bind(*[self.full(self.term(i, 0), v) for i, v in zip(operands, e.invars)])
            return list(out) if e.primitive.multiple_results else [out]
        new = [self.term(i, k) for i in operands]
        if name in _STEPS or not any(jnp.issubdtype(v.aval.dtype, jnp.inexact) for v in e.outvars):
            return [None] * len(results)
        if name in _LINEAR or name == "convert_element_type":
            return self.linear(e, name, new, bind, len(results))
        if name in _PICKS:
            moving = [jnp.issubdtype(v.aval.dtype, jnp.inexact) for v in e.invars]
            if all(c is None for c, m in zip(new, moving) if m):
                return [None]
            pairs = zip(operands, new, moving, e.invars)
            return [bind(*[self.full(c, v) if m else self.term(i, 0) for i, c, m, v in pairs])]
        if name in ("mul", "dot_general"):
            return [self.product(k, *operands, times=bind)]
        if name == "div":
            a, b = operands
            known = self.product(k, results[0], b, last=k - 1)  # what is left is c_k b_0
            top = _minus(new[0], known)
            return [None if top is None else once(top / self.full(self.term(b, 0), e.invars[1]))]
        if name == "select_n":
            if all(c is None for c in new[1:]):
                return [None]
            return [bind(self.term(operands[0], 0), *[self.full(c, v) for c, v in zip(new[1:], e.invars[1:])])]
        if name in ("max", "min"):
            a, b = (self.full(self.term(i, 0), v) for i, v in zip(operands, e.invars))
            first = a >= b if name == "max" else a <= b
            return [select(first, *(self.full(c, v) for c, v in zip(new, e.invars)))]
        if name == "abs":
            return [None if new[0] is None else jnp.sign(self.full(self.term(operands[0], 0), e.invars[0])) * new[0]]
        if name == "rem":
            a, b = (self.full(self.term(i, 0), v) for i, v in zip(operands, e.invars))
            whole = jnp.trunc(a / b)
            return [_minus(new[0], None if new[1] is None else whole * new[1])]
        if name in _PAIRS:
            return [self.pair(k, e, operands[0], results[0])]
        if name in _DERIVATIVES:
            return [self.chain(k, e, operands, results[0])]
        if name == "custom_linear_solve":
            fixed = sum(e.params["const_lengths"])  # the matrix and its factors come first
            if not any(self.varies(i) for i in operands[:fixed]):
                pairs = zip(operands[:fixed], e.invars)
                first = [self.full(self.term(i, 0), v) for i, v in pairs]
                return list(bind(*first, *[self.full(c, v) for c, v in zip(new[fixed:], e.invars[fixed:])]))
            name = "a linear solve whose matrix depends on time or state"
        raise TypeError(
            f"A Taylor series is not known of `{name}`, which the vector field or a surface contains. Use another "
            "`solver`, such as `diffrax.Dopri8()`, or write the model without it."
        )

    def full(self, x: Coefficient, v: Any) -> Array:
        return jnp.zeros(v.aval.shape, v.aval.dtype) if x is None else x

    def linear(self, e: Any, name: str, new: list[Coefficient], bind: Any, number: int) -> list[Coefficient]:
        if all(c is None for c in new):
            return [None] * number
        if name in ("add", "add_any"):
            return [_plus(*new)]
        if name == "sub":
            return [_minus(*new)]
        return [bind(*[self.full(c, v) for c, v in zip(new, e.invars)])]

    def product(
        self, k: int, a: int, b: int, *, times: Any = jnp.multiply, last: int | None = None, weigh: bool = False
    ) -> Coefficient:
        """Σ a_i b_{k-i}, i = 0 ... `last`; each term times i if `weigh`."""
        total: Coefficient = None
        for i in range((k if last is None else last) + 1):
            x, y = self.term(a, i), self.term(b, k - i)
            if x is None or y is None or (weigh and i == 0):
                continue
            part = times(x, y)
            total = _plus(total, i * part if weigh and i > 1 else part)
        return total if total is None else once(total)

    def pair(self, k: int, e: Any, a: int, c: int) -> Coefficient:
        """c' = ±a' d with d' = ±a' c: sine and cosine."""
        name, own, others = _PAIRS[e.primitive.name]
        partner = self.seen.setdefault((name, a), [self.number([])])[0]
        if not self.terms[partner]:
            self.put(partner, 0, getattr(lax, name)(self.full(self.term(a, 0), e.invars[0])))
        if k > 1:
            self.put(partner, k - 1, _times(others / (k - 1), self.product(k - 1, a, c, weigh=True)))
        return _times(own / k, self.product(k, a, partner, weigh=True))

    def chain(self, k: int, e: Any, operands: list[int], c: int) -> Coefficient:
        """c' = Σ a' ∂f/∂a."""
        total: Coefficient = None
        for i, (a, derivative) in enumerate(zip(operands, _DERIVATIVES[e.primitive.name], strict=True)):
            if not self.varies(a):
                continue
            values = [*operands, c]
            if (c, i) not in self.inner:
                like = [jax.ShapeDtypeStruct(v.aval.shape, v.aval.dtype) for v in (*e.invars, *e.outvars)]
                self.inner[c, i] = Series(lambda *xs, fn=derivative: [fn(*xs)], *like)
            inner = self.inner[c, i]
            slope = self.seen.setdefault(("slope", c, i), [self.number([])])[0]
            for j in range(min(k - 1, len(self.terms[slope])), k):
                full = [self.full(self.term(v, 0), x) for v, x in zip(values, (*e.invars, *e.outvars))]
                self.put(slope, j, inner.step(j, *(full if j == 0 else [self.term(v, j) for v in values]))[0])
            total = _plus(total, self.product(k, a, slope, weigh=True))
        return _times(1 / k, total)


def _plus(a: Coefficient, b: Coefficient) -> Coefficient:
    return b if a is None else a if b is None else a + b


def _minus(a: Coefficient, b: Coefficient) -> Coefficient:
    return a if b is None else -b if a is None else a - b


def _times(factor: float, x: Coefficient) -> Coefficient:
    return x if x is None or factor == 1 else factor * x
