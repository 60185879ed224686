"""Programs of JAX (jaxprs) read operation by operation, on values of any kind: numbers, descriptions, truth values."""

from collections.abc import Callable, Iterator, Sequence
from typing import Any, Generic, TypeVar

import jax.extend.core as jex


T = TypeVar("T")

_INLINED = frozenset(("jit", "pjit", "closed_call"))
_WITH_RULES = frozenset(("custom_jvp_call", "custom_vjp_call"))


class Evaluation(Generic[T]):
    """A program that is evaluated on values of any kind by the loop that iterates over it.

    **Arguments:**

    - `closed`: the program.
    - `values`: what stands for its arguments.
    - `constant`: returns what stands for a constant, of which it is given the number and the type (`aval`).

    The iterator returns each operation (equation of the jaxpr) with the values of its operands. The body of the loop
    computes the values of the results and passes them to `put`.
    """

    def __init__(self, closed: jex.ClosedJaxpr, values: Sequence[T], constant: Callable[[Any, Any], T]) -> None:
        self._jaxpr, self._constant = closed.jaxpr, constant
        self._values: dict[Any, T] = dict(zip(self._jaxpr.invars, values, strict=True))
        for v, number in zip(self._jaxpr.constvars, closed.consts, strict=True):
            self._values[v] = constant(number, v.aval)

    def __iter__(self) -> Iterator[tuple[Any, list[T]]]:
        for equation in self._jaxpr.eqns:
            yield equation, self._read(equation.invars)

    def put(self, equation: Any, results: Sequence[T]) -> None:
        """Keeps what stands for the results of an operation."""
        self._values.update(zip(equation.outvars, results, strict=True))

    @property
    def results(self) -> list[T]:
        """What stands for the results of the program."""
        return self._read(self._jaxpr.outvars)

    def _read(self, variables: Sequence[Any]) -> list[T]:
        values, constant = self._values, self._constant
        return [constant(v.val, v.aval) if isinstance(v, jex.Literal) else values[v] for v in variables]


def called(equation: Any, with_rules: bool = True) -> jex.ClosedJaxpr | None:
    """Returns the program of an operation that does nothing but call it, as a function under `jax.jit` does; else None.
    `with_rules`: whether functions with derivatives of their own (`jax.custom_jvp`) count too."""
    name = equation.primitive.name
    if name in _INLINED or (with_rules and name in _WITH_RULES):
        (inner,) = (p for p in equation.params.values() if isinstance(p, jex.ClosedJaxpr))
        return inner
    return None


def has_programs(equation: Any) -> bool:
    """Whether an operation has programs within, as loops and branches have."""
    return any(True for _ in jex.jaxprs_in_params(equation.params))


def within(equation: Any, test: Callable[[Any], bool]) -> bool:
    """Whether any operation of the programs of an operation passes a test, at any depth."""
    return any(anywhere(jaxpr, test) for jaxpr in jex.jaxprs_in_params(equation.params))


def anywhere(jaxpr: jex.Jaxpr, test: Callable[[Any], bool]) -> bool:
    """Whether any operation of a program passes a test, at any depth."""
    return any(test(equation) or within(equation, test) for equation in jaxpr.eqns)


def applied(equation: Any, operands: Sequence[Any]) -> list[Any]:
    """Returns the results of an operation for these arrays."""
    out = equation.primitive.bind(*operands, **equation.primitive.get_bind_params(equation.params))
    return list(out) if equation.primitive.multiple_results else [out]
