"""The fundamental solution matrix, by two routes that share nothing after the trajectory itself."""

from typing import Any, Literal

import diffrax as dfx
import equinox as eqx
import jax
import jax.flatten_util as jfu
import jax.lax as lax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float

from .._types import Scalar, Y
from ..flow._arguments import check_solve
from ..flow._results import raise_if, RESULTS
from ..flow._solution import Solution
from ..flow._solve import solve
from ..system._mode import ModeState
from ..system._model import SwitchedSystem
from ..system._system import arrays_of, System
from ._saltation import saltation_matrices, states


def fundamental_matrix(
    system: System,
    t0: Any,
    t1: Any,
    y0: Y,
    *,
    ts: Any = None,
    method: Literal["variational", "autodiff"] = "variational",
    mode: Any = None,
    solver: dfx.AbstractSolver = dfx.Dopri8(),
    stepsize_controller: dfx.AbstractStepSizeController | None = None,
    max_steps: int = 4096,
    max_events: int = 64,
    throw: bool = True,
) -> Float[Array, "n n"] | Float[Array, "times n n"]:
    """The fundamental solution matrix Φ(t, t0) = ∂y(t)/∂y(t0) along a solution.

    `"variational"` integrates Φ' = (∂f/∂y) Φ on each smooth arc, eq. (3.5), and multiplies by the saltation matrix at
    each event (3.30); `"autodiff"` is `jax.jacfwd` of `solve`.

    **Arguments:**

    - `system`, `t0`, `t1`, `y0`, `mode`, `solver`, `stepsize_controller`, `max_steps`, `max_events`, `throw`: as for
        `solve` (here Dopri8 and, for float64, tolerances of 1e-10 by default).
    - `ts`: times between `t0` and `t1` at which Φ is wanted (before the jump, where it falls on an event).
    - `method`: the route.

    **Returns:** Φ(t1, t0) of shape `(n, n)`, or Φ(ts, t0) of shape `(len(ts), n, n)`, for the state flattened by
    `ravel_pytree`.

    **Raises:** a runtime error if the solution grazes a surface before a time at which Φ is wanted: it is not defined
    there (with `throw=False` it is NaN).
    """
    if method not in ("variational", "autodiff"):
        raise ValueError(f"Argument `method` must be 'variational' or 'autodiff', but got {method!r}.")
    y0, t0, t1, solver, controller, _ = check_solve(
        system, t0, t1, y0, mode, solver, stepsize_controller, dfx.SaveAt(t1=True), max_steps, max_events, None
    )
    if stepsize_controller is None:
        tol = 1e-10 if jnp.finfo(t0.dtype).eps < 1e-10 else 1e-5
        controller = dfx.PIDController(rtol=tol, atol=tol)
    kwargs: dict[str, Any] = dict(
        mode=mode,
        solver=solver,
        stepsize_controller=controller,
        max_steps=max_steps,
        max_events=max_events,
        throw=throw,
    )
    flat, unravel = jfu.ravel_pytree(y0)
    times = jnp.asarray([t1] if ts is None else ts, t0.dtype)
    if method == "autodiff":
        saveat = dfx.SaveAt(t1=True) if ts is None else dfx.SaveAt(ts=jnp.asarray(ts, t0.dtype))

        def flow(x: Array) -> tuple[Array, Solution]:
            sol = solve(system, t0, t1, unravel(x), saveat=saveat, **kwargs)
            return jax.vmap(lambda y: jfu.ravel_pytree(y)[0])(sol.ys), sol

        phi, sol = jax.jit(jax.jacfwd(flow, has_aux=True))(flat)
    else:
        sol = solve(system, t0, t1, y0, **kwargs)
        whole, phi = _by_arcs(arrays_of(system, t0.dtype), sol, t0, y0, times, solver, controller, max_steps)
        phi = whole[None] if ts is None else phi
    beyond = _beyond_grazing(sol, t0, times)
    phi = jnp.where(beyond[:, None, None], jnp.nan, phi)
    if throw:
        phi = raise_if(jnp.any(beyond), RESULTS.tangential_event, phi)
    return phi[0] if ts is None else phi


def _beyond_grazing(sol: Solution, t0: Scalar, times: Float[Array, " times"]) -> Bool[Array, " times"]:
    """Which times come after an event so tangential that there are no derivatives by what was before it."""
    sign, events = jnp.where(sol.t1 >= t0, 1, -1), sol.events
    first = jnp.min(jnp.where(events.transversality == 0, events.t * sign, jnp.inf), initial=jnp.inf)
    return (sol.result == RESULTS.tangential_event) & ((times * sign > first) | (times == sol.t1))


def arcs(sol: Solution, t0: Scalar, y0: Y) -> tuple[Array, Array, Y, Array]:
    """Start and end times, start states and modes of the arcs between the events of a solution; those past the last
    event have no length."""
    events = sol.events
    capacity = events.t.shape[0]
    happened = jnp.arange(capacity, dtype=events.num.dtype) < events.num

    def rows(first: Any, later: Any, end: Any) -> Any:
        def leaf(a: Array, b: Array, c: Array) -> Array:
            held = happened.reshape((-1,) + (1,) * (b.ndim - 1))
            return jnp.concatenate([a[None], jnp.where(held, b, c)])

        return jax.tree.map(leaf, first, later, end)

    begin = rows(t0, events.t, sol.t1)
    end = jnp.concatenate([begin[1:], sol.t1[None]])
    return begin, end, rows(y0, events.y_after, sol.y1), rows(sol.mode0, events.mode_after, sol.mode1)


def monodromy_by_arcs(
    system: System, sol: Solution, t0: Scalar, y0: Y, solver: Any, controller: Any, max_steps: int = 4096
) -> Float[Array, "n n"]:
    """Φ at the end of `sol`, by the variational equation and the saltation formula."""
    return _by_arcs(system, sol, t0, y0, sol.t1[None], solver, controller, max_steps)[0]


class _Arc(System):
    """y and Φ on an arc in a fixed mode: a smooth system, Φ' = (∂f/∂y) Φ. Its columns are perturbations, of the
    structure of the state, with one leading axis."""

    model: SwitchedSystem
    state: ModeState

    def vector_field(self, t: Scalar, y: Y, s: Any) -> Y:
        y, columns = y

        def rhs(y: Y) -> Y:
            return self.model.flow(t, y, self.state)

        return rhs(y), jax.vmap(lambda column: jax.jvp(rhs, (y,), (column,))[1])(columns)


@eqx.filter_jit
def _by_arcs(
    system: System,
    sol: Solution,
    t0: Scalar,
    y0: Y,
    times: Array,
    solver: dfx.AbstractSolver,
    controller: dfx.AbstractStepSizeController,
    max_steps: int,
) -> tuple[Float[Array, "n n"], Float[Array, "times n n"]]:
    """Φ at the end of `sol`, with the jump of an event there, and at `times`, from the arcs between the events and the
    jumps at these."""
    flat, unravel = jfu.ravel_pytree(y0)
    model = SwitchedSystem(system, jnp.ones_like(t0), t0, y0)
    n = flat.size
    eye = jnp.eye(n, dtype=flat.dtype)
    begin, end, state, modes = arcs(sol, t0, y0)
    jumps = eye[None]
    if sol.events.t.size:
        happened = jnp.arange(sol.events.t.size, dtype=sol.events.num.dtype) < sol.events.num
        later = jnp.where(happened[:, None, None], saltation_matrices(system, sol.events), eye)
        jumps = jnp.concatenate([jumps, later])

    def matrix(columns: Y) -> Array:
        return jax.vmap(lambda column: jfu.ravel_pytree(column)[0], out_axes=1)(columns)

    def arc(phi: Array, row: tuple) -> tuple[Array, Array]:
        a, b, y, mode, jump = row
        smooth = _Arc(model, states(model, a, y, tuple(mode)))
        # On an arc that runs backwards so do the times.
        low, high = jnp.minimum(a, b), jnp.maximum(a, b)
        inside = jnp.clip(times, low, high)
        order = jnp.argsort(jnp.where(b >= a, inside, -inside))
        out = solve(
            smooth, a, b, (y, jax.vmap(unravel, in_axes=1)(jump @ phi)), saveat=dfx.SaveAt(ts=inside[order]),
            solver=solver, stepsize_controller=controller, max_steps=max_steps, throw=False,
        )  # fmt: skip
        along = jax.vmap(matrix)(out.ys[1])
        return matrix(out.y1[1]), jnp.zeros_like(along).at[order].set(along)

    whole, by_arc = lax.scan(arc, eye, (begin, end, state, modes, jumps))
    # Each time belongs to the arc that ends at or after it; the first one wins, so that Φ is that before a jump.
    sign = jnp.where(sol.t1 >= t0, 1, -1)
    index = jnp.clip(jnp.searchsorted(sign * end, sign * times, side="left"), 0, len(end) - 1)
    return whole, by_arc[index, jnp.arange(len(times))]
