"""Where solutions settle, after what time they return, and whether friction holds them there in a continuum.

Python follows them by the program of the search itself, lap by lap, so that nothing else is compiled.
"""

from collections.abc import Iterator
from typing import Any, NamedTuple

import diffrax as dfx
import equinox as eqx
import jax
import jax.flatten_util as jfu
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool

from .._numerics._compile import interactive
from .._numerics._lapack import eigvals, singular_values
from .._numerics._select import select
from .._types import Scalar, Y
from ..derivatives._flow_map import Directions, flow_map, with_room
from ..derivatives._variational import arcs
from ..flow._diagnosis import explain
from ..flow._integrator import Integrator
from ..flow._results import is_okay, RESULTS
from ..flow._solution import Solution
from ..flow._solve import integrate
from ..system._model import SwitchedSystem
from ..system._system import System
from ._guess import at_start, of_relays, Relays
from ._orbit import distance, ravel


FAR = 1e10  # never reached, over the fastest rate of the model: bounds on steps and events end the way
STEPS, EVENTS = 2000, 1000  # after which an autonomous solution counts as settled
LAPS = 100  # after which a forced one does
SETTLED = 1e-13  # relative: a lap that moves the state by less changes nothing any more


class Settled(NamedTuple):
    """Where a solution settles; the time in which it returns there (0 if it does not), whether it comes to rest, the
    modes of relays, and whether it failed on the way."""

    y: Y
    period: Scalar
    rests: Bool[Array, ""]
    mode: Relays
    failed: Bool[Array, ""]


def settle_down(
    system: System, t0: Scalar, y0: Y, sign: float, mode: Any, integrator: Integrator, concrete: bool
) -> Settled:
    """Follows the solution, backwards if `sign` is -1. Where numbers are not `concrete` an autonomous system's only."""
    if system.period is not None:
        for sol in _laps(system, t0, y0, sign, mode, integrator, LAPS):
            y0, mode = sol.y1, of_relays(system, sol.mode1)
        no = jnp.zeros((), bool)
        return Settled(y0, jnp.asarray(system.period, t0.dtype), no, mode, no)
    # How long it takes is measured in steps of the integration, which know the system's own scale of time. Only a guess
    # is wanted: a loose tolerance makes long steps, and so the solution is followed farther.
    far = t0 + sign * _far(system, t0, y0, mode)
    loose, last, smallest = (
        _loose(integrator, t0.dtype),
        None,
        jnp.asarray(integrator.smallest_size(t0.dtype), t0.dtype),
    )
    if not concrete:
        big = loose._replace(max_steps=STEPS, max_events=EVENTS)
        last = integrate(system, t0, far, y0, big, mode=mode)
        given = tuple(last.mode1) if system.switches else None
        loop = integrate(system, t0, far, last.y1, big, mode=given, saveat=dfx.SaveAt(dense=True))
        return _returned(system, last, loop, t0, sign, smallest)
    steps = events = 0
    while last is None or (steps < STEPS and events < EVENTS and bool(_goes_on(last))):
        last = _followed(system, t0, far, y0, mode, loose)
        y0, mode = last.y1, of_relays(system, last.mode1)
        steps, events = steps + int(last.stats["num_steps"]), events + int(last.events.num)
    loop = _followed(system, t0, far, y0, mode, loose)
    return _returned(system, last, loop, t0, sign, smallest)


def failure(system: System, t0: Scalar, y0: Y, sign: float, mode: Any, integrator: Integrator) -> str | None:
    """Returns why and where the solution from a guess fails, or None if it does not."""
    if system.period is None:
        end, integrator = t0 + sign * _far(system, t0, y0, mode), _loose(integrator, t0.dtype)
    else:
        end = t0 + sign * jnp.asarray(system.period, t0.dtype)
    sol = _followed(system, t0, end, y0, mode, integrator)
    return None if bool(_goes_on(sol) | is_okay(sol.result)) else explain(system, sol, end)


@interactive
def _far(system: System, t0: Scalar, y0: Y, mode: Any) -> Scalar:
    """A time that no search reaches: in the unit of the largest eigenvalue of the field's derivative."""
    model = SwitchedSystem.forwards(system, t0, y0)
    state, (x, unravel) = at_start(model, t0, y0, mode), jfu.ravel_pytree(y0)
    rate = jnp.max(jnp.abs(eigvals(jax.jacfwd(lambda x: ravel(model.flow(t0, unravel(x), state)))(x))))
    return FAR / select(jnp.isfinite(rate) & (rate > 0), rate, 1)


def _goes_on(sol: Solution) -> Bool[Array, ""]:
    """Whether only a bound ended it."""
    return (sol.result == RESULTS.max_steps_reached) | (sol.result == RESULTS.max_events_reached)


def _loose(integrator: Integrator, dtype: Any) -> Integrator:
    tol = 1e-6 if jnp.finfo(dtype).eps < 1e-10 else 1e-4
    controller = integrator.stepsize_controller
    if not isinstance(controller, dfx.PIDController):
        return integrator._replace(stepsize_controller=dfx.PIDController(rtol=tol, atol=tol))
    controller = eqx.tree_at(lambda c: (c.rtol, c.atol), controller, (tol, tol * integrator.smallest_size(dtype)))
    return integrator._replace(stepsize_controller=controller)


def _followed(system: System, t0: Scalar, t1: Scalar, y0: Y, mode: Any, integrator: Integrator) -> Solution:
    """By the program of the search, which has derivatives too."""
    return flow_map(system, t0, t1, y0, mode, with_room(integrator, t0.dtype), Directions.of_state(system, t0, y0))[0]


@interactive
def _returned(system: System, last: Solution, loop: Solution, t0: Scalar, sign: float, smallest: Scalar) -> Settled:
    """From the solution up to where it has settled, and from there on. States below `smallest` count as zero."""
    starts, stops, _, _, steps = loop.dense
    # Eight points a step: the polynomial between control points bends little.
    u = jnp.asarray(np.arange(8) / 8, starts.dtype)
    times = sign * (starts[:, None] + (stops - starts)[:, None] * u).ravel()
    valid = jnp.repeat(jnp.arange(len(starts), dtype=steps.dtype) < steps, 8)
    states = jax.vmap(lambda t: ravel(loop.evaluate(t)))(select(valid, times, t0))
    # A solution that has ended in an event returns to the state after it, between two of these points.
    events = loop.events
    times = jnp.concatenate([times, events.t])
    states = jnp.concatenate([states, jax.vmap(ravel)(events.y_after)])
    valid = jnp.concatenate([valid, jnp.arange(len(events.t), dtype=events.num.dtype) < events.num])
    order = jnp.argsort(select(valid, sign * times, jnp.inf))
    times, states, valid = times[order], states[order], valid[order]
    here = ravel(last.y1)
    scale = jnp.max(select(valid[:, None], jnp.abs(states - here), 0), axis=0)
    gap = jnp.max(jnp.abs(states - here) / select(scale == 0, 1, scale), axis=-1)
    gap = select(valid, gap, jnp.inf)
    # The first local minimum of the distance that is small, once the solution has been far away.
    far = jnp.cumsum(gap > 0.3) > 0
    near = far & (gap < 0.1)
    low = near & (gap <= jnp.roll(gap, 1)) & (gap <= jnp.roll(gap, -1))
    ended = (last.result == RESULTS.max_steps_reached) | (last.result == RESULTS.successful)
    rests = ended & (jnp.max(scale) <= 1e-4 * (smallest + jnp.max(jnp.abs(here))))
    period = select(rests, 0, sign * (times[jnp.argmax(low)] - t0))
    failed = ~(_goes_on(last) | is_okay(last.result))
    return Settled(last.y1, period, rests, of_relays(system, last.mode1), failed)


def _laps(
    system: System, t0: Scalar, y0: Y, sign: float, mode: Any, integrator: Integrator, number: int
) -> Iterator[Solution]:
    """A solution of a forced system, period by period, up to where it repeats itself or fails. The bounds of
    `integrator` are those of one period."""
    end, smallest = t0 + sign * jnp.asarray(system.period, t0.dtype), float(integrator.smallest_size(t0.dtype))
    for _ in range(number):
        sol = _followed(system, t0, end, y0, mode, integrator)
        yield sol
        before, after = (np.concatenate([np.ravel(leaf) for leaf in jax.tree.leaves(y)]) for y in (y0, sol.y1))
        if np.max(np.abs(after - before)) <= SETTLED * (smallest + np.max(np.abs(after))) or not bool(
            is_okay(sol.result)
        ):
            return
        y0, mode = sol.y1, of_relays(system, sol.mode1)


def repeats(system: System, t0: Scalar, y0: Y, sign: float, mode: Any, integrator: Integrator, most: int = 16) -> int:
    """After how many periods of the forcing a solution that has settled repeats itself."""
    laps = _laps(system, t0, y0, sign, mode, integrator, most)
    points = np.stack([np.concatenate([np.ravel(leaf) for leaf in jax.tree.leaves(sol.y1)]) for sol in laps])
    gaps = np.linalg.norm(points - np.concatenate([np.ravel(leaf) for leaf in jax.tree.leaves(y0)]), axis=1)
    # What is left of the way to where it settles is small beside the state, and beside how far the points lie apart.
    extent = 1e-4 * np.max(np.abs(points)) + 1e-2 * np.max(gaps)
    return 1 + int(np.argmax(gaps <= max(extent, 2 * np.min(gaps))))


def repeats_held(system: System, t0: Scalar, y: Y, period: Scalar, mode: Any, integrator: Integrator) -> bool:
    """Whether a state of a forced system comes back, held by friction all the time."""
    smallest = jnp.asarray(integrator.smallest_size(t0.dtype), t0.dtype)
    return bool(_comes_back_held(_followed(system, t0, t0 + period, y, mode, integrator), t0, y, smallest))


@interactive
def _comes_back_held(sol: Solution, t0: Scalar, y: Y, smallest: Scalar) -> Bool[Array, ""]:
    begin, end, _, modes = arcs(sol, t0, y)
    back = distance(ravel(sol.y1), ravel(y)) <= 1e-8 * (smallest + jnp.max(jnp.abs(ravel(y))))
    return is_okay(sol.result) & back & held_throughout(sol.system, begin, end, modes)


@interactive
def sticks_anywhere(system: System, t0: Scalar, y: Y) -> Bool[Array, ""]:
    """Whether an equilibrium of the sliding field is one of a continuum: on the surfaces that hold it the derivative of
    the field is singular."""
    model = SwitchedSystem.forwards(system, t0, y)
    state = at_start(model, t0, y)
    x, unravel = jfu.ravel_pytree(y)
    matrix = jax.jacfwd(lambda x: ravel(model.flow(t0, unravel(x), state)))(x)
    size = jnp.max(jnp.abs(matrix))
    sticks = jnp.zeros((), bool)
    for k, switch in enumerate(model.switches):
        if switch.signed:
            held = state.mode[k] == 0
            sticks = sticks | held
            for i in range(model.parts[k]):
                # In the direction off the surface the field says nothing: there the matrix is made regular.
                n = jax.grad(lambda x, k=k, i=i: model.h(k, t0, unravel(x))[i])(x)
                n = n / select(jnp.any(n != 0), jnp.linalg.norm(n), 1)
                matrix = matrix + select(held, size, 0) * jnp.outer(n, n)
    values = singular_values(matrix)
    return sticks & (values[-1] <= 1e-9 * values[0])


def held_throughout(system: System, begin: Array, end: Array, modes: Array) -> Bool[Array, ""]:
    """Whether friction holds a solution along all of its arcs. (At the edge of the continuum it lets go for a time
    of the size of the root of rounding.)"""
    length = jnp.maximum(end - begin, 0)
    free = [jnp.sum(select(modes[:, i] == 0, 0, length)) for i, k in enumerate(system.switches) if k.signed]
    return jnp.any(jnp.asarray(free, length.dtype) <= 1e-3 * jnp.sum(length))
