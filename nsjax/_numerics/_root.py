"""Roots of equations with parameters, and their derivatives by the implicit function theorem."""

from collections.abc import Callable
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.flatten_util as jfu
import jax.numpy as jnp
import optimistix as optx
from jaxtyping import Array, Bool

from ._autodiff import dense_jacobian, frozen
from ._lapack import LinearSolver, solve
from ._select import select


class Sizes(NamedTuple):
    """The units in which Newton's method measures its unknowns and its equations, as they are flattened by
    `ravel_pytree`: each a vector, or one number for all."""

    unknowns: Any = 1.0
    equations: Any = 1.0


class Newton(NamedTuple):
    """When Newton's method ends."""

    tol: Any  # relative and absolute, of the unknowns; absolute, of the equations
    max_steps: int

    def solver(self, isolated: bool = True) -> optx.Newton:
        """Optimistix's method. Where roots may not be `isolated` its steps are the shortest ones."""
        return optx.Newton(rtol=self.tol, atol=self.tol, linear_solver=LinearSolver(isolated))

    def step(
        self, z: Array, residual: Array, jacobian: Array, sizes: Sizes = Sizes()
    ) -> tuple[Array, Bool[Array, ""], Bool[Array, ""]]:
        """One step of `find_root`, where residual and Jacobian are known: where it leads, whether the search ends
        there, and whether it has converged."""

        def linear(w: Array, _: Any) -> tuple[Array, None]:
            return (residual + jacobian @ (w * sizes.unknowns - z)) / sizes.equations, None

        solver, w = self.solver(), z / sizes.unknowns
        state = solver.init(linear, w, None, {}, jax.eval_shape(lambda: residual), None, frozenset())
        w, state, _ = solver.step(linear, w, None, {}, state, frozenset())
        ended, result = solver.terminate(linear, w, None, {}, state, frozenset())
        new = w * sizes.unknowns
        finite = jnp.all(jnp.isfinite(new))
        return new, ended | ~finite, ended & finite & (result == optx.RESULTS.successful)


def find_root(
    residual: Callable[[Any, Any], Any],
    guess: Any,
    parameters: Any,
    newton: Newton,
    *,
    sizes: Sizes = Sizes(),
    isolated: bool = True,
) -> tuple[Any, Bool[Array, ""]]:
    """A root of `residual(z, parameters)` by optimistix's Newton method, and whether it converged.

    Optimistix compares the residual with the absolute tolerance alone, and a component of z that is near zero too:
    without `sizes` rounding alone keeps a search among numbers of 1e9 from ending.

    The root's derivatives with respect to the parameters, of every order, are those of the implicit function. They are
    NaN where there is no root, or where it is not regular: optimistix's own rule raises an error there, which
    one bad lane of a batch would do for all. Where roots may not be `isolated` the steps are the shortest
    ones.
    """
    begin, unravel = jfu.ravel_pytree(frozen(guess))
    unknowns, equations = frozen(sizes)

    def flat(z: Array, parameters: Any) -> Array:
        return jfu.ravel_pytree(residual(unravel(z), parameters))[0]

    found = optx.root_find(
        lambda w, p: dense_jacobian(flat, w * unknowns, p) / equations,
        newton.solver(isolated),
        begin / unknowns,
        args=frozen(parameters),
        max_steps=newton.max_steps,
        throw=False,
    )
    converged = found.result == optx.RESULTS.successful
    z = frozen(found.value) * unknowns
    return unravel(_implicit(z, eqx.filter_closure_convert(flat, z, parameters), parameters, converged)), converged


@eqx.filter_custom_jvp
def _implicit(z: Array, residual: Callable[..., Array], parameters: Any, regular: Bool[Array, ""]) -> Array:
    return z


@_implicit.def_jvp
def _implicit_jvp(primals: Any, tangents: Any) -> tuple[Array, Array]:
    z, residual, parameters, regular = primals
    _, moved, change, _ = tangents
    z = _implicit(z, residual, parameters, regular)
    jacobian = jax.jacfwd(lambda z: residual(z, parameters))(z)
    dr = eqx.filter_jvp(lambda f, p: f(z, p), (residual, parameters), (moved, change))[1]
    if dr is None:
        return z, jnp.zeros_like(z)
    return z, select(regular, solve(jacobian, -dr), jnp.nan)
