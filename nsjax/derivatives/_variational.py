"""The fundamental solution matrix, by two routes that share nothing after the trajectory itself."""

from typing import Any, Literal

import diffrax as dfx
import jax
import jax.flatten_util as jfu
import jax.lax as lax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int

from .._numerics._autodiff import frozen
from .._numerics._compile import interactive
from .._numerics._select import select
from .._types import Scalar, Y
from ..flow._arguments import checked_start, checked_time
from ..flow._integrator import Integrator
from ..flow._mode_flow import VariedModeFlow
from ..flow._results import is_okay, raise_if, RESULTS
from ..flow._solution import Solution
from ..flow._solve import integrate, solve
from ..system._model import SwitchedSystem
from ..system._system import arrays_of, System
from ._saltation import saltation_matrices


AT_ONCE = 1e-9  # of the whole time: so near to the start an event happens at it


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
    rtol: float | None = None,
    atol: float | None = None,
    max_steps: int = 4096,
    max_events: int = 64,
    throw: bool = True,
) -> Float[Array, "n n"] | Float[Array, "times n n"]:
    """The fundamental solution matrix Φ(t, t0) = ∂y(t)/∂y(t0) along a solution.

    `"variational"` integrates Φ' = (∂f/∂y) Φ on each smooth arc, eq. (3.5), and multiplies by the saltation matrix at
    each event (3.30); `"autodiff"` is `jax.jacfwd` of `solve`.

    **Arguments:**

    - `system`, `t0`, `t1`, `y0`, `mode`, `solver`, `stepsize_controller`, `rtol`, `atol`, `max_steps`, `max_events`,
        `throw`: as for `solve` (here Dopri8 and, for float64, tolerances of 1e-10 by default).
    - `ts`: times between `t0` and `t1` at which Φ is wanted (before the jump, where it falls on an event).
    - `method`: the route.

    **Returns:** Φ(t1, t0) of shape `(n, n)`, or Φ(ts, t0) of shape `(len(ts), n, n)`, for the state flattened by
    `ravel_pytree`.

    **Raises:** a runtime error if the solution grazes a surface before a time at which Φ is wanted: it is not defined
    there (with `throw=False` it is NaN).
    """
    if method not in ("variational", "autodiff"):
        raise ValueError(f"Argument `method` must be 'variational' or 'autodiff', but got {method!r}.")
    t0, y0, _ = checked_start(system, t0, y0, mode)
    t1 = checked_time("t1", t1, t0.dtype)
    integrator = Integrator(solver, stepsize_controller, max_steps, max_events).checked(
        t0.dtype, (1e-10, 1e-5), rtol=rtol, atol=atol
    )
    how: dict[str, Any] = dict(mode=mode, throw=throw) | integrator.arguments
    flat, unravel = jfu.ravel_pytree(y0)
    times = jnp.asarray([t1] if ts is None else ts, t0.dtype)
    if method == "autodiff":
        saveat = dfx.SaveAt(t1=True) if ts is None else dfx.SaveAt(ts=jnp.asarray(ts, t0.dtype))

        def flow(x: Array) -> tuple[Array, Solution]:
            sol = solve(system, t0, t1, unravel(x), saveat=saveat, **how)
            return jax.vmap(lambda y: jfu.ravel_pytree(y)[0])(sol.ys), sol

        phi, sol = jax.jit(jax.jacfwd(flow, has_aux=True))(flat)
    else:
        sol = solve(system, t0, t1, y0, **how)
        return matrices_along(sol, y0, ts, integrator, throw)
    phi, bad, result = _checked(sol, t0, times, phi, RESULTS.successful)
    phi = raise_if(bad, result, phi) if throw else phi
    return phi[0] if ts is None else phi


def matrices_along(sol: Solution, y0: Y, ts: Any, integrator: Integrator, throw: bool) -> Array:
    """`fundamental_matrix` along a solution that is known, which set out from `y0`, by the variational equation."""
    t0 = jnp.asarray(sol.t0)
    times = jnp.asarray([sol.t1] if ts is None else ts, t0.dtype)
    whole, phi, result = _by_arcs(arrays_of(sol.system, t0.dtype), sol, t0, y0, times, integrator)
    phi, bad, result = _checked(sol, t0, times, whole[None] if ts is None else phi, result)
    phi = raise_if(bad, result, phi) if throw else phi
    return phi[0] if ts is None else phi


@interactive
def _checked(
    sol: Solution, t0: Scalar, times: Array, phi: Array, result: RESULTS
) -> tuple[Array, Bool[Array, ""], RESULTS]:
    """The derivatives, which are NaN where there are none: beyond a grazing, or where the variational equation could
    not be integrated (`result` is that of its integration); whether some are missing, and why."""
    beyond = _beyond_grazing(sol, t0, times)
    phi = select(beyond[:, None, None], jnp.nan, phi)
    grazes = jnp.any(beyond)
    return phi, grazes | ~is_okay(result), RESULTS.where(grazes, RESULTS.tangential_event, result)


def _beyond_grazing(sol: Solution, t0: Scalar, times: Float[Array, " times"]) -> Bool[Array, " times"]:
    """Which times come after an event so tangential that there are no derivatives by what was before it."""
    sign, events = select(sol.t1 >= t0, 1, -1), sol.events
    first = jnp.min(select(events.transversality == 0, events.t * sign, jnp.inf), initial=jnp.inf)
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
            return jnp.concatenate([a[None], select(held, b, c)])

        return jax.tree.map(leaf, first, later, end)

    begin = rows(t0, events.t, sol.t1)
    end = jnp.concatenate([begin[1:], sol.t1[None]])
    return begin, end, rows(y0, events.y_after, sol.y1), rows(sol.mode0, events.mode_after, sol.mode1)


def monodromy_by_arcs(system: System, sol: Solution, t0: Scalar, y0: Y, integrator: Integrator) -> Float[Array, "n n"]:
    """Φ at the end of `sol`, which comes back, by the variational equation and the saltation formula. An event at its
    very start that happens again at its very end counts once."""
    return _by_arcs(system, sol, t0, y0, sol.t1[None], integrator, _repeated(sol, t0))[0]


def _repeated(sol: Solution, t0: Scalar) -> Int[Array, ""]:
    """How many events at the very start lead to the mode of the end."""
    if not sol.events.t.size:
        return jnp.zeros_like(sol.events.num)
    events, rows = sol.events, jnp.arange(sol.events.t.shape[0], dtype=sol.events.num.dtype)
    at_once = (rows < events.num) & (jnp.abs(events.t - t0) <= AT_ONCE * jnp.abs(sol.t1 - t0))
    same = at_once & jnp.all(events.mode_after == sol.mode1, axis=1)
    closed = jnp.all(sol.mode0 == sol.mode1) | ~jnp.any(same)
    return select(closed, 0, 1 + jnp.argmax(same)).astype(events.num.dtype)


@interactive
def _by_arcs(
    system: System,
    sol: Solution,
    t0: Scalar,
    y0: Y,
    times: Array,
    integrator: Integrator,
    skipped: Int[Array, ""] | int = 0,
) -> tuple[Float[Array, "n n"], Float[Array, "times n n"], RESULTS]:
    """Φ at the end of `sol`, with the jump of an event there, and at `times`, from the arcs between the events and the
    jumps at these; those of the first `skipped` are left out. And whether every arc could be integrated; what depends
    on one that could not is NaN."""
    flat, unravel = jfu.ravel_pytree(y0)
    model = SwitchedSystem.forwards(system, t0, y0)
    n = flat.size
    eye = jnp.eye(n, dtype=flat.dtype)
    begin, end, state, modes = arcs(sol, t0, y0)
    jumps = eye[None]
    if sol.events.t.size:
        index = jnp.arange(sol.events.t.size, dtype=sol.events.num.dtype)
        happened = (index >= skipped) & (index < sol.events.num)
        later = select(happened[:, None, None], saltation_matrices(system, sol.events), eye)
        jumps = jnp.concatenate([jumps, later])

    def matrix(columns: Y) -> Array:
        return jax.vmap(lambda column: jfu.ravel_pytree(column)[0], out_axes=1)(columns)

    rows, first = jax.vmap(lambda y: jfu.ravel_pytree(y)[0])(state), model.state_at(t0, y0, tuple(sol.mode0))
    largest = jnp.max(select(jnp.isfinite(rows), jnp.abs(rows), 0), axis=0)
    sizes = frozen(integrator.sizes_of(largest, jfu.ravel_pytree(model.flow(t0, y0, first))[0], sol.t1 - t0))
    relative, jumps = integrator.in_sizes(flat.dtype), jumps * sizes / sizes[:, None]

    def arc(phi: Array, a: Scalar, b: Scalar, y: Y, mode: Array, jump: Array) -> tuple[Array, Array, RESULTS]:
        smooth = VariedModeFlow(model, model.state_at(a, y, tuple(mode)), unravel(sizes))
        # On an arc that runs backwards so do the times.
        low, high = jnp.minimum(a, b), jnp.maximum(a, b)
        inside = jnp.clip(times, low, high)
        order = jnp.argsort(select(b >= a, inside, -inside))
        varied = unravel(jfu.ravel_pytree(y)[0] / sizes), jax.vmap(unravel, in_axes=1)(jump @ phi)
        out = integrate(smooth, a, b, varied, relative, saveat=dfx.SaveAt(ts=inside[order]))
        done, along = is_okay(out.result), jax.vmap(matrix)(out.ys[1])
        along = jnp.zeros_like(along).at[order].set(along)
        return select(done, matrix(out.y1[1]), jnp.nan), select(done, along, jnp.nan), out.result

    none = jnp.zeros((len(times), n, n), flat.dtype)

    def turn(c: tuple[Array, RESULTS], row: tuple) -> tuple[tuple[Array, RESULTS], Array]:
        phi, result = c
        phi, along, new = lax.cond(row[0], arc, lambda phi, *_: (phi, none, RESULTS.successful), phi, *row[1:])
        return (phi, RESULTS.where(is_okay(result), new, result)), along

    there = jnp.arange(len(end), dtype=sol.events.num.dtype) <= sol.events.num
    (whole, result), by_arc = lax.scan(turn, (eye, RESULTS.successful), (there, begin, end, state, modes, jumps))
    # Each time belongs to the arc that ends at or after it; the first one wins, so that Φ is that before a jump.
    sign = select(sol.t1 >= t0, 1, -1)
    index = jnp.clip(jnp.searchsorted(sign * end, sign * times, side="left"), 0, sol.events.num)
    along = by_arc[index, jnp.arange(len(times))]
    return whole * sizes[:, None] / sizes, along * sizes[:, None] / sizes, result
