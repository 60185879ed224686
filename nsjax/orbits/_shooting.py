"""Periodic orbits by shooting: through the event-driven flow, which finds the itinerary."""

from collections.abc import Callable
from typing import Any

import diffrax as dfx
import equinox as eqx
import jax
import jax.flatten_util as jfu
import jax.lax as lax
import jax.numpy as jnp
from jaxtyping import Array

from .._numerics._autodiff import frozen
from .._numerics._root import find_root
from .._types import Scalar, Y
from ..derivatives._floquet import floquet, forwards, structural_zeros
from ..derivatives._variational import arcs, monodromy_by_arcs
from ..flow._results import is_okay, RESULTS
from ..flow._solution import Events
from ..flow._solve import solve
from ..system._model import SwitchedSystem
from ..system._relay import relay
from ..system._system import System
from ._guess import at_start, base_point
from ._orbit import distance, fractions, judge, Orbit, ravel
from .segments._arcs import Arcs


@eqx.filter_jit
def shoot(
    system: System,
    t0: Scalar,
    y0: Y,
    period: Scalar,
    order: int,
    symmetry: Callable[[Y], Y] | None,
    backward: bool,
    mode: Any,
    how: dict,
    tol: float,
    max_iterations: int,
) -> Orbit:
    """Newton's method on y(t0 + period) = y0, or y(t0 + period/2) = `symmetry`(y0), and what is said of the orbit.

    With `backward` on y(t0 - period) = y0; what is said is of the orbit as it runs forwards.
    """
    sign = -1.0 if backward else 1.0
    autonomous = system.period is None
    still = frozen(system)
    guess = lax.stop_gradient(y0)
    model = SwitchedSystem(still, jnp.ones_like(frozen(t0)), frozen(t0), guess)
    if autonomous:
        guess, period, mode = lax.stop_gradient(
            base_point(still, frozen(t0), guess, lax.stop_gradient(period), sign, mode, how)
        )
    flat, unravel = jfu.ravel_pytree(guess)
    first_period = lax.stop_gradient(period)

    def period_of(z: tuple, system: System) -> Scalar:
        return jnp.exp(z[1]) if autonomous else jnp.asarray(system.period, t0.dtype) * order

    def flow(system: System, t0: Scalar, x: Array, period: Scalar) -> Array:
        sol = solve(system, t0, t0 + sign * period, unravel(x), mode=mode, throw=False, **how)
        # A solution that ended early is no solution: Newton's method must not be led by it.
        ok = is_okay(sol.result)
        return jnp.where(ok, ravel(sol.y1), jnp.nan)

    part = 1.0 if symmetry is None else 0.5

    def image(x: Array) -> Array:
        return x if symmetry is None else ravel(symmetry(unravel(x)))

    def returns(z: tuple, parameters: tuple) -> Array:
        system, t0 = parameters
        return flow(system, t0, z[0], part * period_of(z, system)) - image(z[0])

    unknown: Any = (flat,)
    residual: Callable[[tuple, tuple], Any] = returns
    at_rest = jnp.zeros((), bool)
    if autonomous:
        # Poincaré's phase condition: the base point stays on the section through the guess.
        normal = ravel(model.flow(frozen(t0), guess, at_start(model, frozen(t0), guess, mode)))
        speed = normal @ normal

        def on_section(z: tuple, parameters: tuple) -> tuple:
            return returns(z, parameters), normal @ (z[0] - flat) / jnp.where(speed == 0, 1, speed)

        unknown, residual = (flat, jnp.log(first_period)), on_section
        at_rest = jnp.sqrt(speed) * period <= 1e-9 * (1 + jnp.max(jnp.abs(flat)))
    # What depends on parameters does so by the second argument alone: the search needs no derivatives.
    z, converged = find_root(residual, unknown, (system, t0), tol, max_iterations)
    x, period = z[0], period_of(z, system)

    _, shares = fractions(autonomous, order)
    end = t0 + sign * period
    sol = solve(
        system, t0, end, unravel(x), mode=mode, throw=False, **how,
        saveat=dfx.SaveAt(ts=t0 + sign * period * jnp.asarray(shares, t0.dtype), t1=True),
    )  # fmt: skip
    points = jax.vmap(ravel)(sol.ys)
    error = distance(points[-1], x)
    size = 1 + jnp.max(jnp.abs(x))
    # A relay has a memory: its mode must come back with the state.
    relays = [k for k, switch in enumerate(system.switches) if isinstance(switch, relay)]
    closes = jnp.all(jnp.asarray([sol.mode0[k] == sol.mode1[k] for k in relays], bool))
    good = converged & (error <= 1e3 * tol * size) & is_okay(sol.result) & closes
    result = judge(good, x, points[:-1], autonomous, order)
    if autonomous:
        # Where Newton's method ends near an equilibrium, its Jacobian is singular and it seldom says that it converged.
        last = ravel(model.flow(t0, unravel(x), at_start(model, t0, unravel(x), mode)))
        at_rest = at_rest | (jnp.max(jnp.abs(last)) * first_period <= 1e-6 * size)
        result = RESULTS.where(at_rest, RESULTS.orbit_is_equilibrium, result)

    grazes = (sol.result == RESULTS.tangential_event) & (result == RESULTS.successful)
    result = RESULTS.where(grazes, RESULTS.tangential_event, result)
    begin, stop, y, modes = arcs(sol, t0, unravel(x))
    along, events = Arcs(begin, stop, modes, jax.tree.map(lambda y: y[:, None], y)), sol.events
    zeros = structural_zeros(system, modes)
    monodromy = monodromy_by_arcs(system, sol, t0, unravel(x), how["solver"], how["stepsize_controller"])
    found_out = floquet(monodromy[None], zeros, autonomous)
    if backward:
        found_out = forwards(found_out, zeros, autonomous)
        along, events = _reversed(along, events, unravel(x), period)
        zeros = jnp.zeros_like(zeros)
    monodromy, multipliers, stable = found_out
    return Orbit(
        system=system,
        t0=t0,
        y0=unravel(x),
        mode=sol.mode0,
        period=period,
        events=events,
        monodromy=monodromy,
        multipliers=multipliers,
        structural_zeros=zeros,
        stable=stable,
        residual=error,
        admissible=jnp.ones((), bool),
        violation=jnp.zeros_like(t0),
        violation_t=t0,
        arcs=along,
        result=result,
        options=tuple(how.items()),
    )


def _reversed(arcs: Arcs, events: Events, y0: Y, period: Scalar) -> tuple[Arcs, Events]:
    """The arcs and the events of a solution over one period backwards, as they follow each other forwards."""
    num = events.num

    def back(leaf: Array, count: Array) -> Array:
        """The first `count` rows in reverse."""
        index = jnp.arange(len(leaf), dtype=count.dtype)
        return leaf[jnp.where(index < count, count - 1 - index, index)]

    def log(leaf: Array) -> Array:
        return back(leaf, num)

    before, after, y_before, y_after = jax.tree.map(
        log, (events.mode_after, events.mode_before, events.y_after, events.y_before)
    )
    ends = (log(events.t) + period, log(events.switch), before, after, y_before, y_after, log(events.transversality))
    turned = eqx.tree_at(
        lambda e: (e.t, e.switch, e.mode_before, e.mode_after, e.y_before, e.y_after, e.transversality), events, ends
    )
    # An arc begins where, backwards, it ended: after the event that ends it there, or at the base point.
    rows = len(arcs.begin)
    happened = jnp.arange(rows - 1, dtype=num.dtype) < num

    def starts(first: Array, later: Array) -> Array:
        held = happened.reshape((-1,) + (1,) * (later.ndim - 1))
        return jnp.concatenate([first[None], jnp.where(held, later, first)])[:, None]

    used = jnp.arange(rows, dtype=num.dtype) <= num

    def times(t: Array) -> Array:
        return jnp.where(used, back(t, num + 1) + period, t + 2 * period)  # the others stay at the end

    mode = back(arcs.mode, num + 1)
    return Arcs(times(arcs.end), times(arcs.begin), mode, jax.tree.map(starts, y0, y_after)), turned
