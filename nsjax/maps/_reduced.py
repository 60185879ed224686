"""The reduced map of Fig. 6.23: of one component of the state, the others being periodic."""

from typing import Any, NamedTuple

import diffrax as dfx
import jax
import jax.flatten_util as jfu
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array

from .._numerics._compile import interactive
from .._numerics._root import find_root, Newton, Sizes
from .._numerics._select import select
from .._numerics._text import between, shown, written
from .._types import Scalar, Y
from ..flow._arguments import checked_start
from ..flow._integrator import Integrator
from ..flow._results import is_okay, outcomes, raise_if, RESULTS
from ..flow._solve import integrate
from ..orbits._guess import at_start
from ..orbits._orbit import ravel
from ..system._model import SwitchedSystem
from ..system._system import arrays_of, System
from ._iterate import unless_failed
from ._stroboscopic import phase_map


@shown
class ReducedIterate(NamedTuple):
    """An iterate of a reduced map.

    **Attributes:**

    - `value`: the component after `order` periods.
    - `y`: the state at the start: the given value of the component, and the others, which are periodic.
    - `result`: `RESULTS`; where it is a failure the others are NaN.
    """

    value: Scalar
    y: Y
    result: RESULTS

    def __str__(self) -> str:
        axes = jnp.ndim(self.value)
        head = f"{self.value.size} iterates" if axes else "iterate"
        end = f"  values  {between(self.value)}\n  from    {written(self.y, axes)}\n  result  {outcomes(self.result)}"
        return f"{head} of a reduced map\n{end}"


def _place(y: Y, component: str) -> int:
    """Where in the flattened state the component is."""
    names = []
    for path, leaf in jax.tree_util.tree_flatten_with_path(y)[0]:
        name = jax.tree_util.keystr(path, simple=True, separator=".")
        name = f"y.{name}" if name.isdigit() else name or "y"
        names += [name + f"[{','.join(map(str, i))}]" * bool(i) for i in np.ndindex(jnp.shape(leaf))]
    if component not in names:
        raise ValueError(f"Argument `component` must be one of {', '.join(names)}, but got {component!r}.")
    if len(names) < 2:
        raise ValueError("Argument `guess` must be a state of two or more components, but has one: its map is reduced.")
    return names.index(component)


def reduced_map(
    system: System,
    x: Any,
    component: str,
    *,
    guess: Y,
    order: int = 1,
    t0: Any = 0.0,
    mode: Any = None,
    solver: dfx.AbstractSolver = dfx.Dopri8(),
    stepsize_controller: dfx.AbstractStepSizeController | None = None,
    rtol: float | None = None,
    atol: float | None = None,
    tol: float | None = None,
    max_newton_steps: int = 30,
    max_steps: int = 4096,
    max_events: int = 64,
    throw: bool = True,
) -> ReducedIterate:
    """The map x_n -> x_(n + order) of one component of a forced system, the others being periodic (section 6.9).

    The T-advance map (6.10) of a system in the plane cannot be drawn. Here the other components are found by Newton's
    method to be the same after `order` periods as before, and what is left is a map of one number into one. Where that
    meets the diagonal there is a periodic orbit; Fig. 6.23.

    ```python
    def one(x):
        return nsjax.reduced_map(system, x, "x", guess=State(0.0, -0.7), order=2, throw=False).value

    image = nsjax.sweep(one, jnp.linspace(1.5, 2.5, 200))
    ```

    There may be several such states for a value of x, or none: which is found depends on `guess`. The derivatives, of
    every order, are those of the implicit function. (That by x is 1 where an orbit
    has the multiplier 1, but no multiplier elsewhere.)

    **Arguments:**

    - `system`: the model, whose `period` is not None.
    - `x`: the value of the component at `t0`, a scalar; `nsjax.sweep` or `jax.vmap` for many.
    - `component`: its name: `"x"` for `y.x`, `"q[0]"` for an entry of a vector.
    - `guess`: a state with which Newton's method begins; its `component` is not used.
    - `order`: after how many periods of the forcing the others are the same.
    - `t0`: the phase of the forcing [time].
    - `tol`, `max_newton_steps`: of Newton's method, by default 1e-10 (float32: 1e-4) and 30.
    - `mode`, `solver`, `stepsize_controller`, `rtol`, `atol`, `max_steps`, `max_events`: as for `solve`; by default
        Dopri8 with tolerances of 1e-12 (float32: 1e-6).
    - `throw`: whether a failure raises; if not, look at `ReducedIterate.result`.

    **Returns:** a `ReducedIterate`.

    **Raises:** `ValueError` for an autonomous system or an unknown component; a runtime error if no such state is
    found.
    """
    t0, y0, given = checked_start(system, t0, guess, mode)
    integrator = Integrator(solver, stepsize_controller, max_steps, max_events).checked(
        t0.dtype, (1e-12, 1e-6), rtol=rtol, atol=atol
    )
    tol = (1e-10 if jnp.finfo(t0.dtype).eps < 1e-10 else 1e-4) if tol is None else tol
    x = jnp.asarray(x, t0.dtype)
    if x.shape != ():
        raise ValueError(f"Argument `x` must be a scalar, but has shape {x.shape}; use `nsjax.sweep` for many.")
    phase_map(system, order, integrator)
    system = arrays_of(system, t0.dtype)
    span = _Span(given or None, order, integrator)
    out = _reduced((system, t0, x), y0, _place(y0, component), span, Newton(tol, max_newton_steps))
    return raise_if(~is_okay(out.result), out.result, out) if throw else out


class _Span(NamedTuple):
    """How a solution is followed over `order` periods of the forcing."""

    mode: Any
    order: int
    integrator: Integrator


@interactive
def _reduced(
    parameters: tuple[System, Scalar, Scalar], guess: Y, place: int, span: _Span, newton: Newton
) -> ReducedIterate:
    system, t0, x = parameters
    flat, unravel = jfu.ravel_pytree(guess)

    def state(others: Array, x: Scalar) -> Y:
        return unravel(jnp.insert(others, place, x))

    def without(x: Array) -> Array:
        return jnp.delete(x, place, assume_unique_indices=True)

    def advance(others: Array, parameters: tuple) -> tuple[Array, RESULTS]:
        system, t0, x = parameters
        end = t0 + jnp.asarray(system.period, t0.dtype) * span.order
        sol = integrate(system, t0, end, state(others, x), span.integrator, mode=span.mode)
        # Newton's method must not be led by a solution that ended early.
        return select(is_okay(sol.result), jfu.ravel_pytree(sol.y1)[0], jnp.nan), sol.result

    def residual(others: Array, parameters: tuple) -> Array:
        return without(advance(others, parameters)[0]) - others

    model, y0 = SwitchedSystem.forwards(system, t0, guess), state(without(flat), x)
    field = ravel(model.flow(t0, y0, at_start(model, t0, y0, span.mode)))
    sizes = without(span.integrator.sizes_at(ravel(y0), field, jnp.asarray(system.period, t0.dtype) * span.order))
    others, converged = find_root(residual, without(flat), parameters, newton, sizes=Sizes(sizes, sizes))
    after, result = advance(others, parameters)
    gap, smallest = jnp.max(jnp.abs(without(after) - others)), span.integrator.smallest_size(t0.dtype)
    good = converged & (gap <= 1e3 * newton.tol * (smallest + jnp.max(jnp.abs(after)))) & is_okay(result)
    result = RESULTS.where(good, result, RESULTS.reduced_map_not_found)
    value, y = unless_failed(result, (after[place], state(others, x)))
    return ReducedIterate(value, y, result)
