"""Periodic orbits by shooting: through the event-driven flow, which finds the itinerary."""

from collections.abc import Callable
from typing import Any

import diffrax as dfx
import equinox as eqx
import jax
import jax.flatten_util as jfu
import jax.lax as lax
import jax.numpy as jnp
import optimistix as optx
from jaxtyping import Array

from ._filippov import Model
from ._guess import at_start, base_point
from ._jacobian import dense_jacobian
from ._orbit import distance, floquet, fractions, judge, Orbit, ravel, structural_zeros
from ._solution import is_okay, RESULTS
from ._solve import solve
from ._system import frozen, System
from ._types import Scalar, Y
from ._variational import arcs, monodromy_by_arcs


@eqx.filter_jit
def shoot(
    system: System,
    t0: Scalar,
    y0: Y,
    period: Scalar,
    order: int,
    symmetry: Callable[[Y], Y] | None,
    mode: Any,
    how: dict,
    tol: float,
    max_iterations: int,
) -> Orbit:
    """Newton's method on y(t0 + period) = y0, or y(t0 + period/2) = `symmetry`(y0), and what is said of the orbit."""
    autonomous = system.period is None
    still = frozen(system)
    model = Model(still, jnp.ones_like(t0), t0, y0)
    guess = lax.stop_gradient(y0)
    if autonomous:
        guess, period = lax.stop_gradient(base_point(still, t0, guess, lax.stop_gradient(period), mode, how))
        mode = None
    flat, unravel = jfu.ravel_pytree(guess)
    first_period = lax.stop_gradient(period)
    forcing = None if autonomous else jnp.asarray(system.period, t0.dtype) * order

    def flow(system: System, x: Array, period: Scalar) -> Array:
        sol = solve(system, t0, t0 + period, unravel(x), mode=mode, throw=False, **how)
        # A solution that ended early is no solution: Newton's method must not be led by it.
        ok = is_okay(sol.result)
        return jnp.where(ok, ravel(sol.y1), jnp.nan)

    part = 1.0 if symmetry is None else 0.5

    def image(x: Array) -> Array:
        return x if symmetry is None else ravel(symmetry(unravel(x)))

    if autonomous:
        # Poincaré's phase condition: the base point stays on the section through the guess.
        start = at_start(model, t0, guess)
        normal = ravel(model.flow(t0, guess, start))
        speed = normal @ normal

        def residual(z: tuple, system: System) -> tuple:
            x, log_period = z
            phase = normal @ (x - flat) / jnp.where(speed == 0, 1, speed)
            return flow(system, x, part * jnp.exp(log_period)) - image(x), phase

        unknown: Any = (flat, jnp.log(lax.stop_gradient(period)))
        at_rest = jnp.sqrt(speed) * period <= 1e-9 * (1 + jnp.max(jnp.abs(flat)))
    else:

        def residual(z: tuple, system: System) -> tuple:
            assert forcing is not None
            return (flow(system, z[0], part * forcing) - image(z[0]),)

        unknown = (flat,)
        at_rest = jnp.zeros((), bool)
    found = optx.root_find(
        lambda z, system: dense_jacobian(residual, z, system),
        optx.Newton(rtol=tol, atol=tol),
        unknown,
        args=system,
        max_steps=max_iterations,
        throw=False,
    )
    x = found.value[0]
    if autonomous:
        period = jnp.exp(found.value[1])
    else:
        assert forcing is not None
        period = forcing

    _, shares = fractions(autonomous, order)
    sol = solve(
        system, t0, t0 + period, unravel(x), mode=mode, throw=False, **how,
        saveat=dfx.SaveAt(ts=t0 + period * jnp.asarray(shares, t0.dtype), t1=True),
    )  # fmt: skip
    points = jax.vmap(ravel)(sol.ys)
    error = distance(points[-1], x)
    size = 1 + jnp.max(jnp.abs(x))
    good = (found.result == optx.RESULTS.successful) & (error <= 1e3 * tol * size) & is_okay(sol.result)
    result = judge(good, x, points[:-1], autonomous, order)
    if autonomous:
        # Where Newton's method ends near an equilibrium, its Jacobian is singular and it seldom says that it converged.
        last = ravel(model.flow(t0, unravel(x), at_start(model, t0, unravel(x))))
        at_rest = at_rest | (jnp.max(jnp.abs(last)) * first_period <= 1e-6 * size)
        result = RESULTS.where(at_rest, RESULTS.orbit_is_equilibrium, result)

    monodromy = monodromy_by_arcs(system, sol, t0, unravel(x), how["solver"], how["stepsize_controller"])
    zeros = structural_zeros(system, arcs(sol, t0, unravel(x))[3])
    multipliers, stable = floquet(monodromy, zeros, autonomous)
    return Orbit(
        system=system,
        t0=t0,
        y0=unravel(x),
        mode=sol.mode0,
        period=period,
        events=sol.events,
        monodromy=monodromy,
        multipliers=multipliers,
        structural_zeros=zeros,
        stable=stable,
        residual=error,
        admissible=jnp.ones((), bool),
        violation=jnp.zeros_like(t0),
        violation_t=t0,
        result=result,
        options=tuple(how.items()),
    )
