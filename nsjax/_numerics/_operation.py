"""Operations with rules of their own for batches and derivatives: primitives of JAX.

(`jax.custom_batching.custom_vmap` has no derivatives where its rule calls it again, and none in reverse mode;
`jax.custom_jvp` has no rule for batches.)
"""

from collections.abc import Callable
from typing import Any, NoReturn

import jax.extend.core as jex
from jax.interpreters import ad, batching, mlir, partial_eval as pe

from ._undocumented import lower_jaxpr2, primitive_linearizations


class Operation:
    """An operation on arrays, with parameters that are handed to each of its rules by name.

    **Arguments:**

    - `name`: how it is called in a program.
    - `run`: returns the results, a list of arrays.
    - `shapes`: returns the shapes and types of the results, from those of the arguments.
    - `batch`: takes the arguments and the axes along which they are batched (None for those that are not); returns the
        results and their axes.
    - `jvp`: takes the arguments and their tangents; returns the results and their tangents.
    - `reached`: takes which arguments are marked; returns which results depend on them. As a rule all of them do.
    - `prune`: takes which results are used, and the equation; returns which arguments they need, and an equation with
        only these. As a rule all arguments are needed.
    - `refuse`: raises an error about reverse mode. As a rule that of JAX is raised.
    """

    def __init__(
        self,
        name: str,
        *,
        run: Callable[..., list[Any]],
        shapes: Callable[..., list[Any]],
        batch: Callable[..., tuple[list[Any], list[Any]]],
        jvp: Callable[..., tuple[list[Any], list[Any]]],
        reached: Callable[..., list[bool]] | None = None,
        prune: Callable[[list[bool], Any], tuple[list[bool], Any]] | None = None,
        refuse: Callable[..., NoReturn] | None = None,
    ) -> None:
        self.primitive = jex.Primitive(name)
        self.primitive.multiple_results = True
        self.primitive.def_impl(run)
        self.primitive.def_abstract_eval(shapes)
        batching.primitive_batchers[self.primitive] = batch
        ad.primitive_jvps[self.primitive] = jvp
        mlir.register_lowering(self.primitive, mlir.lower_fun(run, multiple_results=True))
        if reached is not None:
            REACHED[name] = reached
        if prune is not None:
            pe.dce_rules[self.primitive] = lambda used, *given: _pruned(prune, used, given[-1])
        if refuse is not None:
            primitive_linearizations[self.primitive] = lambda nonzero, *args, **params: refuse(**params)
        if lower_jaxpr2 is not None:
            self.primitive.to_lojax = self._replaced  # type: ignore[method-assign]

    def bind(self, *args: Any, **params: Any) -> list[Any]:
        """The results of the operation."""
        return self.primitive.bind(*args, **params)

    def is_in(self, equation: Any) -> bool:
        """Whether an equation of a program is this operation."""
        return equation.primitive is self.primitive

    def _replaced(self, *args: Any, **params: Any) -> list[Any]:
        """Some functions of JAX are primitives that it replaces by others before it compiles (`jnp.searchsorted`, from
        0.12 on), and that may stand in the program of an operation."""
        if "jaxpr" in params:
            params["jaxpr"] = lower_jaxpr2(params["jaxpr"])
        return self.bind(*args, **params)


REACHED: dict[str, Callable[..., list[bool]]] = {}
"""By the name of an operation: from which of its arguments are marked, which results depend on them."""


def _pruned(prune: Callable[[list[bool], Any], tuple[list[bool], Any]], used: list[bool], equation: Any) -> Any:
    return prune(used, equation) if any(used) else ([False] * len(equation.invars), None)
