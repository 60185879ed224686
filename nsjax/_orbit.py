"""Periodic orbits by shooting through the event-driven flow, with their Floquet multipliers."""

from typing import Any

import diffrax as dfx
import equinox as eqx
import jax
import jax.core
import jax.flatten_util as jfu
import jax.lax as lax
import jax.numpy as jnp
import numpy as np
import optimistix as optx
from jaxtyping import Array, Bool, Complex, Float, Int

from ._check import check_solve
from ._filippov import Model
from ._jacobian import dense_jacobian
from ._saltation import _states
from ._solution import Events, is_okay, Itinerary, raise_if, RESULTS, Solution
from ._solve import solve
from ._system import arrays_of, frozen, relay, sgn, System
from ._types import Scalar, Y
from ._variational import arcs, monodromy_by_arcs


class Orbit(eqx.Module):
    """A periodic solution.

    **Attributes:**

    - `t0`, `y0`, `mode`: time, state and mode at its base point; for an autonomous system a point away from events.
    - `period`: its period (`order` times that of the forcing).
    - `events`: the event log of one period.
    - `monodromy`: Φ(t0 + period, t0), shape `(n, n)`, for the state flattened by `ravel_pytree`.
    - `multipliers`: its eigenvalues, the Floquet multipliers, largest modulus first.
    - `stable`: whether all multipliers lie inside the unit circle, the trivial one of an autonomous system left out.
    - `residual`: largest component of y(t0 + period) - y0.
    - `result`: `RESULTS`.
    """

    system: System
    t0: Scalar
    y0: Y
    mode: Int[Array, " switches"]
    period: Scalar
    events: Events
    monodromy: Float[Array, "n n"]
    multipliers: Complex[Array, " n"]
    stable: Bool[Array, ""]
    residual: Scalar
    result: RESULTS
    # solver, stepsize_controller, max_steps, max_events: static, so that orbits come out of `vmap`
    method: tuple[tuple[str, Any], ...] = eqx.field(static=True)

    @property
    def itinerary(self) -> Itinerary:
        """The modes the orbit passes through, beginning with that of its base point."""
        e = self.events
        return Itinerary(self.mode, e.switch, e.mode_after, e.num, e.names)

    def solve(self, *, saveat: dfx.SaveAt = dfx.SaveAt(dense=True), periods: float = 1, **kwargs: Any) -> Solution:
        """The solution over one or several periods from the base point; further arguments as for `nsjax.solve`."""
        end = self.t0 + periods * self.period
        mode = tuple(self.mode) if self.events.names else None
        return solve(self.system, self.t0, end, self.y0, mode=mode, saveat=saveat, **(dict(self.method) | kwargs))

    def __str__(self) -> str:
        state = ", ".join(f"{x:.12g}" for x in _flat(self.y0))
        multipliers = ", ".join(f"{complex(m):.6g}" for m in self.multipliers)
        return (
            f"{'stable' if self.stable else 'unstable'} periodic orbit of {type(self.system).__name__}\n"
            f"  period       {float(self.period):.15g}\n"
            f"  base point   t = {float(self.t0):.6g}, y = ({state})\n"
            f"  itinerary    {self.itinerary}\n"
            f"  multipliers  {multipliers}\n"
            f"  residual     {float(self.residual):.1e}\n"
        )


def _distance(a: Array, b: Array) -> Array:
    return jnp.max(jnp.abs(a - b), axis=-1)


def _flat(y: Y) -> Array:
    return jfu.ravel_pytree(y)[0]


def _base_point(system: System, t0: Scalar, y0: Y, period: Scalar, mode: Any, method: dict) -> tuple[Y, Scalar]:
    """A better guess, from the solution over two and a half guessed periods.

    The base point is in the middle of the longest arc between events, on a smooth one if there is any: the flow map is
    only one-sided differentiable at an event, and the phase condition wants a transversal section. The period is the
    time after which the solution comes nearest to it again, among those within half the guess of it.
    """
    end_time = t0 + 2.5 * period
    sol = solve(system, t0, end_time, y0, mode=mode, saveat=dfx.SaveAt(dense=True), throw=False, **method)
    begin, end, _, modes = arcs(sol, t0, y0)
    begin, end = jnp.minimum(begin, t0 + period), jnp.minimum(end, t0 + period)
    slides = jnp.stack(
        [modes[:, k] == 0 for k, s in enumerate(system.switches) if isinstance(s, sgn)] or [jnp.zeros(len(begin), bool)]
    ).any(0)
    longest = jnp.argmax((end - begin) * jnp.where(slides, 1e-6, 1.0))
    base = 0.5 * (begin[longest] + end[longest])
    here = sol.evaluate(base)
    share = jnp.linspace(0.5, 1.5, 401, dtype=base.dtype)
    later = jax.vmap(lambda u: _flat(sol.evaluate(base + u * period)))(share)
    extent = jnp.max(later, axis=0) - jnp.min(later, axis=0)
    gap = _distance(later / jnp.where(extent == 0, 1, extent), _flat(here) / jnp.where(extent == 0, 1, extent))
    # Of equally near returns the one nearest to the guess: a user who asks for two laps gets two.
    best = share[jnp.argmin(gap + 0.05 * jnp.abs(share - 1))]
    reached = is_okay(sol.result)
    return here, jnp.where(reached, best, 1) * period


@eqx.filter_jit
def _shoot(
    system: System,
    t0: Scalar,
    y0: Y,
    period: Scalar,
    order: int,
    mode: Any,
    method: dict,
    tol: float,
    max_iterations: int,
) -> Orbit:
    """Newton's method on y(t0 + period) = y0, and everything said of the orbit."""
    autonomous = system.period is None
    still = frozen(system)
    model = Model(still, jnp.ones_like(t0), t0, y0)
    guess = lax.stop_gradient(y0)
    if autonomous:
        guess, period = lax.stop_gradient(_base_point(still, t0, guess, lax.stop_gradient(period), mode, method))
        mode = None
    flat, unravel = jfu.ravel_pytree(guess)
    first_period = lax.stop_gradient(period)
    forcing = None if autonomous else jnp.asarray(system.period, t0.dtype) * order

    def flow(system: System, x: Array, period: Scalar) -> Array:
        sol = solve(system, t0, t0 + period, unravel(x), mode=mode, throw=False, **method)
        # A solution that ended early is no solution: Newton's method must not be led by it.
        ok = is_okay(sol.result)
        return jnp.where(ok, _flat(sol.y1), jnp.nan)

    if autonomous:
        # Poincaré's phase condition: the base point stays on the section through the guess.
        start = _at_start(model, t0, guess)
        normal = _flat(model.flow(t0, guess, start))
        speed = normal @ normal

        def residual(z: tuple, system: System) -> tuple:
            x, log_period = z
            phase = normal @ (x - flat) / jnp.where(speed == 0, 1, speed)
            return flow(system, x, jnp.exp(log_period)) - x, phase

        unknown: Any = (flat, jnp.log(lax.stop_gradient(period)))
        at_rest = jnp.sqrt(speed) * period <= 1e-9 * (1 + jnp.max(jnp.abs(flat)))
    else:

        def residual(z: tuple, system: System) -> tuple:
            assert forcing is not None
            return (flow(system, z[0], forcing) - z[0],)

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

    primes = [p for p in (2, 3, 5, 7) if autonomous or order % p == 0]
    fractions = np.array(sorted({j / 8 for j in range(1, 8)} | {1 / p for p in primes} | {1.0}))
    sol = solve(
        system, t0, t0 + period, unravel(x), mode=mode, throw=False, **method,
        saveat=dfx.SaveAt(ts=t0 + period * jnp.asarray(fractions, t0.dtype), t1=True),
    )  # fmt: skip
    points = jax.vmap(_flat)(sol.ys)
    away = _distance(points[:-1], x)
    error = _distance(_flat(sol.y1), x)
    amplitude = jnp.max(away)
    size = 1 + jnp.max(jnp.abs(x))
    if autonomous:
        # Where Newton's method ends near an equilibrium, its Jacobian is singular and it seldom says that it converged.
        last = _flat(model.flow(t0, unravel(x), _at_start(model, t0, unravel(x))))
        at_rest = at_rest | (jnp.max(jnp.abs(last)) * first_period <= 1e-6 * size)
    repeats = jnp.zeros((), bool)
    for p in primes:
        repeats = repeats | (away[int(np.argmin(np.abs(fractions - 1 / p)))] <= 1e-6 * amplitude)
    good = (found.result == optx.RESULTS.successful) & (error <= 1e3 * tol * size) & is_okay(sol.result)
    result = RESULTS.where(good, RESULTS.successful, RESULTS.orbit_not_found)
    result = RESULTS.where(good & repeats, RESULTS.orbit_is_multiple_cover, result)
    if autonomous:
        result = RESULTS.where((good & (amplitude <= 1e-8 * size)) | at_rest, RESULTS.orbit_is_equilibrium, result)

    monodromy = monodromy_by_arcs(system, sol, t0, unravel(x), method["solver"], method["stepsize_controller"])
    finite = jnp.all(jnp.isfinite(monodromy))
    multipliers = jnp.linalg.eigvals(jnp.where(finite, monodromy, 0))
    multipliers = jnp.where(finite, multipliers, jnp.nan)
    multipliers = multipliers[jnp.argsort(-jnp.abs(lax.stop_gradient(multipliers)))]
    inside = jnp.abs(multipliers) < 1
    if autonomous:
        inside = inside.at[jnp.argmin(jnp.abs(multipliers - 1))].set(True)
    events = sol.events
    return Orbit(
        system=system,
        t0=t0,
        y0=unravel(x),
        mode=sol.mode0,
        period=period,
        events=events,
        monodromy=monodromy,
        multipliers=multipliers,
        stable=jnp.all(inside),
        residual=error,
        result=result,
        method=tuple(method.items()),
    )


def _at_start(model: Model, t: Scalar, y: Y) -> Any:
    """The mode by the signs of h; a surface counts as slid upon."""
    modes = []
    for k, switch in enumerate(model.switches):
        zero = jnp.zeros((), jnp.int32)
        if isinstance(switch, sgn):
            h = jnp.min(jnp.stack(model.h(k, t, y)))
            noise = jnp.max(model.rounding(lambda t, y, k=k: model.h(k, t, y), t, y))
            zero = jnp.where(jnp.abs(h) <= 1e3 * noise, 0, jnp.sign(h)).astype(jnp.int32)
        elif isinstance(switch, relay):
            zero = (switch.guard(model.system, t, y) > 0).astype(jnp.int32)
        modes.append(zero)
    return _states(model, t, y, tuple(modes))


@eqx.filter_jit
def _settle(system: System, t0: Scalar, y0: Y, mode: Any, method: dict) -> tuple[Y, Scalar, Bool[Array, ""]]:
    """Follows the solution to where it settles; for an autonomous system also the time in which it returns there (0 if
    it does not), and whether it comes to rest.

    How long that takes is measured in steps of the integration, which know the system's own scale of time.
    """
    if system.period is not None:
        end = t0 + 100 * jnp.asarray(system.period, t0.dtype)
        return solve(system, t0, end, y0, mode=mode, throw=False, **method).y1, end - t0, jnp.zeros((), bool)
    # Only a guess is wanted: a loose tolerance makes long steps, and so the solution is followed farther.
    loose = 1e-6 if jnp.finfo(t0.dtype).eps < 1e-10 else 1e-4
    controller = dfx.PIDController(rtol=loose, atol=loose)
    big = dict(solver=method["solver"], stepsize_controller=controller, max_steps=2000, max_events=1000)
    last = solve(system, t0, t0 + 1e9, y0, mode=mode, throw=False, **big)
    given = tuple(last.mode1) if system.switches else None
    loop = solve(system, t0, t0 + 1e9, last.y1, mode=given, saveat=dfx.SaveAt(dense=True), throw=False, **big)
    starts, stops, points, _, steps = loop.dense
    # Eight points a step: the polynomial between control points bends little.
    u = jnp.asarray(np.arange(8) / 8, starts.dtype)
    times = (starts[:, None] + (stops - starts)[:, None] * u).ravel()
    valid = jnp.repeat(jnp.arange(len(starts), dtype=steps.dtype) < steps, 8)
    states = jax.vmap(lambda t: _flat(loop.evaluate(t)))(jnp.where(valid, times, t0))
    here = _flat(last.y1)
    scale = jnp.max(jnp.where(valid[:, None], jnp.abs(states - here), 0), axis=0)
    gap = jnp.max(jnp.abs(states - here) / jnp.where(scale == 0, 1, scale), axis=-1)
    gap = jnp.where(valid, gap, jnp.inf)
    # The first local minimum of the distance that is small, once the solution has been far away.
    far = jnp.cumsum(gap > 0.3) > 0
    near = far & (gap < 0.1)
    low = near & (gap <= jnp.roll(gap, 1)) & (gap <= jnp.roll(gap, -1))
    rests = (last.result == RESULTS.max_steps_reached) & (jnp.max(scale) <= 1e-4 * (1 + jnp.max(jnp.abs(here))))
    return last.y1, jnp.where(rests, 0, times[jnp.argmax(low)] - t0), rests


def find_orbit(
    system: System,
    y0: Y,
    *,
    period: Any = None,
    t0: Any = 0.0,
    order: int = 1,
    mode: Any = None,
    solver: dfx.AbstractSolver = dfx.Dopri8(),
    stepsize_controller: dfx.AbstractStepSizeController | None = None,
    tol: float | None = None,
    max_iterations: int = 30,
    max_steps: int = 4096,
    max_events: int = 64,
    throw: bool = True,
) -> Orbit:
    """Finds a periodic orbit by shooting: y(t0 + period) = y0, solved by optimistix's Newton method.

    For an autonomous system the period is unknown too and Poincaré's phase condition is added; the base point of the
    result is moved away from events. Where Newton's method does not converge from the guess, the solution is first
    followed to where it settles (this needs concrete values: not under `jit` or `vmap`). The orbit's period, states and
    multipliers are differentiable with respect to the parameters of `system`, by implicit differentiation.

    **Arguments:**

    - `system`: the model. It is forced if its `period` is not None.
    - `y0`: a guess of a state on the orbit, for a forced system at time `t0`.
    - `period`: autonomous systems: a guess of the period [time]; found by following the solution if None. For forced
        systems it is `order * system.period`, and must not be given.
    - `t0`: time of the base point.
    - `order`: subharmonic order of a forced orbit.
    - `mode`: as for `solve`, for a guess on a surface.
    - `solver`, `stepsize_controller`, `max_steps`, `max_events`: as for `solve`; by default Dopri8 with tolerances of
        1e-12 (float32: 1e-6).
    - `tol`: tolerance of Newton's method, by default 1e-10 (float32: 1e-4).
    - `throw`: whether a failure raises; if not, look at `Orbit.result`.

    **Returns:** an `Orbit`.

    **Raises:** a runtime error that says whether the search ended in an equilibrium, in a multiple cover of a shorter
    orbit, or nowhere.
    """
    if not isinstance(order, int) or order < 1:
        raise ValueError(f"Argument `order` must be a positive integer, but got {order!r}.")
    y0, t0, _, solver, controller, given = check_solve(
        system, t0, t0, y0, mode, solver, stepsize_controller, dfx.SaveAt(t1=True), max_steps, max_events, None
    )
    double = bool(jnp.finfo(t0.dtype).eps < 1e-10)
    if stepsize_controller is None:
        small = 1e-12 if double else 1e-6
        controller = dfx.PIDController(rtol=small, atol=small)
    tol = (1e-10 if double else 1e-4) if tol is None else tol
    system = arrays_of(system, t0.dtype)
    method = dict(solver=solver, stepsize_controller=controller, max_steps=max_steps, max_events=max_events)
    autonomous = system.period is None
    if not autonomous and period is not None:
        raise ValueError("Argument `period` must not be given for a forced system; use `order` for a subharmonic.")
    if autonomous and order != 1:
        raise ValueError("Argument `order` must be 1 for an autonomous system; pass the longer `period` instead.")
    concrete = not any(isinstance(x, jax.core.Tracer) for x in jax.tree.leaves((system, y0, period)))
    kwargs = dict(order=order, mode=given, method=method, tol=tol, max_iterations=max_iterations)
    settled = autonomous and period is None
    if settled:
        y0, period, rests = _settle(frozen(system), t0, lax.stop_gradient(y0), given, method)
        kwargs["mode"] = None
        lost = ~(period > 0)
        period = jnp.where(lost, 1, period)
    period = jnp.asarray(1.0 if period is None else period, t0.dtype)
    if concrete and autonomous and not period > 0:
        raise ValueError(f"Argument `period` must be positive, but got {period}.")
    orbit = _shoot(system, t0, y0, period, **kwargs)
    if settled:
        end = RESULTS.where(rests, RESULTS.orbit_is_equilibrium, RESULTS.orbit_not_found)
        orbit = eqx.tree_at(lambda o: o.result, orbit, RESULTS.where(lost, end, orbit.result))
    elif concrete and bool((orbit.result != RESULTS.successful) & (orbit.result != RESULTS.orbit_is_multiple_cover)):
        y1, period, rests = _settle(system, t0, y0, given, method)
        if rests:
            orbit = eqx.tree_at(lambda o: o.result, orbit, RESULTS.orbit_is_equilibrium)
        if period > 0:
            second = _shoot(system, t0, y1, period, **(kwargs | {"mode": None}))
            orbit = second if bool(second.result == RESULTS.successful) else orbit
    if throw:
        orbit = raise_if(orbit.result != RESULTS.successful, orbit.result, orbit)
    return orbit
