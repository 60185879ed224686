"""Periodic orbits by shooting: through the event-driven flow, which finds the itinerary."""

from collections.abc import Callable
from typing import Any, NamedTuple

import diffrax as dfx
import equinox as eqx
import jax
import jax.flatten_util as jfu
import jax.lax as lax
import jax.numpy as jnp
from jaxtyping import Array

from .._numerics._autodiff import frozen
from .._numerics._compile import interactive
from .._numerics._root import find_root, Newton
from .._types import Scalar, Y
from ..derivatives._floquet import floquet, forwards, structural_zeros
from ..derivatives._variational import arcs, monodromy_by_arcs
from ..flow._integrator import Integrator
from ..flow._results import is_okay, RESULTS
from ..flow._solution import Events
from ..flow._solve import integrate
from ..system._model import SwitchedSystem
from ..system._relay import relay
from ..system._system import System
from ._guess import at_start, base_point
from ._orbit import distance, fractions, judge, Orbit, ravel
from .segments._arcs import Arcs


class Shooting(NamedTuple):
    """Shooting at y(t0 + period) = y0, or y(t0 + period/2) = `symmetry`(y0); or, `backward`, at y(t0 - period) = y0."""

    order: int
    symmetry: Callable[[Y], Y] | None
    backward: bool
    integrator: Integrator
    newton: Newton

    @property
    def sign(self) -> float:
        return -1.0 if self.backward else 1.0

    def orbit(self, system: System, t0: Scalar, y0: Y, period: Scalar, mode: Any) -> Orbit:
        """What Newton's method finds, and what is said of the orbit as it runs forwards."""
        return _shoot(self, system, t0, y0, period, mode)

    def equations(self, start: Y, period: Scalar, mode: Any, normal: Array | None) -> tuple[Any, Callable]:
        """The unknowns, with their guess, and what vanishes: a function of them and of (system, t0). Of an autonomous
        system the logarithm of the period is unknown too, and the base point stays on the section through the guess
        that has this `normal`: Poincaré's phase condition."""
        flat, unravel = jfu.ravel_pytree(start)
        part = 1.0 if self.symmetry is None else 0.5

        def returns(z: tuple, parameters: tuple) -> Array:
            system, t0 = parameters
            end = t0 + self.sign * part * self.period(z, system)
            sol = integrate(system, t0, end, unravel(z[0]), self.integrator, mode=mode)
            # A solution that ended early is no solution: Newton's method must not be led by it.
            last = jnp.where(is_okay(sol.result), ravel(sol.y1), jnp.nan)
            return last - (z[0] if self.symmetry is None else ravel(self.symmetry(unravel(z[0]))))

        if normal is None:
            return (flat,), returns
        speed = normal @ normal

        def on_section(z: tuple, parameters: tuple) -> tuple:
            return returns(z, parameters), normal @ (z[0] - flat) / jnp.where(speed == 0, 1, speed)

        return (flat, jnp.log(period)), on_section

    def period(self, z: tuple, system: System) -> Scalar:
        return jnp.exp(z[1]) if system.period is None else jnp.asarray(system.period, z[0].dtype) * self.order


@interactive
def _shoot(shooting: Shooting, system: System, t0: Scalar, y0: Y, period: Scalar, mode: Any) -> Orbit:
    sign, integrator, tol = shooting.sign, shooting.integrator, shooting.newton.tol
    autonomous = system.period is None
    still, t_still = frozen((system, t0))
    guess, first_period = lax.stop_gradient((y0, period))
    model = SwitchedSystem.forwards(still, t_still, guess)
    normal = None
    if autonomous:
        base = base_point(still, t_still, guess, first_period, sign, mode, integrator)
        guess, first_period, mode = lax.stop_gradient(base)
        normal = ravel(model.flow(t_still, guess, at_start(model, t_still, guess, mode)))
    unravel = jfu.ravel_pytree(guess)[1]
    unknown, residual = shooting.equations(guess, first_period, mode, normal)
    # What depends on parameters does so by the second argument alone: the search needs no derivatives.
    z, converged = find_root(residual, unknown, (system, t0), shooting.newton)
    x, period = z[0], shooting.period(z, system)

    shares = jnp.asarray(fractions(autonomous, shooting.order)[1], t0.dtype)
    saveat = dfx.SaveAt(ts=t0 + sign * period * shares, t1=True)
    sol = integrate(system, t0, t0 + sign * period, unravel(x), integrator, mode=mode, saveat=saveat)
    points = jax.vmap(ravel)(sol.ys)
    error = distance(points[-1], x)
    size = 1 + jnp.max(jnp.abs(x))
    # A relay has a memory: its mode must come back with the state.
    closes = jnp.all(jnp.asarray([sol.mode0[k] == sol.mode1[k] for k in model.of_kind(relay)], bool))
    good = converged & (error <= 1e3 * tol * size) & is_okay(sol.result) & closes
    result = judge(good, x, points[:-1], autonomous, shooting.order)
    if normal is not None:
        # Where Newton's method ends near an equilibrium, its Jacobian is singular and it seldom says that it converged.
        last = ravel(model.flow(t0, unravel(x), at_start(model, t0, unravel(x), mode)))
        at_rest = jnp.sqrt(normal @ normal) * first_period <= 1e-9 * (1 + jnp.max(jnp.abs(unknown[0])))
        at_rest |= jnp.max(jnp.abs(last)) * first_period <= 1e-6 * size
        result = RESULTS.where(at_rest, RESULTS.orbit_is_equilibrium, result)
    grazes = (sol.result == RESULTS.tangential_event) & (result == RESULTS.successful)
    result = RESULTS.where(grazes, RESULTS.tangential_event, result)

    begin, stop, y, modes = arcs(sol, t0, unravel(x))
    along, events = Arcs(begin, stop, modes, jax.tree.map(lambda y: y[:, None], y)), sol.events
    zeros = structural_zeros(system, modes)
    monodromy = monodromy_by_arcs(system, sol, t0, unravel(x), integrator)
    found_out = floquet(monodromy[None], zeros, autonomous)
    if shooting.backward:
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
        integrator=integrator,
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
