"""Derivatives together with the itinerary to which they belong."""

import textwrap
from collections.abc import Callable
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, PyTree

from .._numerics._text import between, shown, written
from ..flow._results import outcomes, RESULTS
from ..flow._solution import Itinerary, Solution


@shown
class Sensitivity(eqx.Module):
    """What `sensitivity` returns.

    **Attributes:**

    - `value`: what the function returned.
    - `jacobian`: its derivative, leaves of `value` by leaves of the argument, as from `jax.jacfwd`.
    - `itinerary`: the modes that the solution passed through. The derivative tells how the value changes as long as
        they do not: compare by `a.itinerary.same_as(b.itinerary)`.
    - `defined`: whether the derivative exists: False where the solution failed or met a surface tangentially.
    - `result`: `RESULTS` of the solution.
    """

    value: PyTree
    jacobian: PyTree
    itinerary: Itinerary
    defined: Bool[Array, ""]
    result: RESULTS

    def __str__(self) -> str:
        axes = jnp.ndim(self.defined)
        count, exist = jnp.size(self.defined), jnp.sum(self.defined)
        if axes:
            head, way = f"{count} sensitivities, {exist} of them defined", f"{between(self.itinerary.num)} events each"
        else:
            head, way = "sensitivity" + " that is not defined" * (not exist), str(self.itinerary)
        return (
            f"{head}\n"
            f"  value       {written(self.value, axes, 4)}\n"
            f"  derivative  {written(self.jacobian, axes, 4)}\n"
            f"  itinerary   {textwrap.shorten(way, 100, placeholder=' ...')}\n"
            f"  result      {outcomes(self.result)}"
        )


def sensitivity(fn: Callable[[Any], tuple[PyTree, Solution]], x: PyTree, *, reverse: bool = False) -> Sensitivity:
    """Value and derivative of a function of a solution, with the itinerary to which they belong.

    A gradient is that of one itinerary. Where an optimiser or a Newton iteration walks over a grazing or a corner the
    next gradient is that of another, and the value may have a jump or a kink in between. Comparing the itineraries of
    two iterates shows it.

    **Arguments:**

    - `fn`: from `x` to `(value, solution)`, the solution being what `solve` returned. Call it with `throw=False` to see
        a failure in `result` instead of an exception.
    - `x`: any pytree, such as parameters, a state or a `System`. Its floating point leaves are differentiated.
    - `reverse`: by `jax.jacrev` instead of `jax.jacfwd`, for scalar values of many parameters; `solve` then needs an
        `adjoint`.

    **Returns:** a `Sensitivity`.
    """

    def run(x: PyTree) -> tuple[PyTree, tuple[PyTree, Itinerary, RESULTS]]:
        value, sol = fn(x)
        return value, (value, sol.itinerary, sol.result)

    x = jax.tree.map(lambda leaf: jnp.asarray(leaf) if isinstance(leaf, float) else leaf, x)
    derivative = eqx.filter_jacrev if reverse else eqx.filter_jacfwd
    jacobian, (value, itinerary, result) = derivative(run, has_aux=True)(x)
    return Sensitivity(value, jacobian, itinerary, result == RESULTS.successful, result)
