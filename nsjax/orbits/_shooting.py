"""Periodic orbits by shooting: through the event-driven flow, which finds the itinerary."""

from collections.abc import Callable
from typing import Any, NamedTuple

import diffrax as dfx
import equinox as eqx
import jax
import jax.flatten_util as jfu
import jax.lax as lax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool

from .._numerics._autodiff import frozen
from .._numerics._compile import interactive
from .._numerics._root import find_root, Newton, Sizes
from .._numerics._select import select
from .._types import Scalar, Y
from ..derivatives._floquet import floquet, forwards, structural_zeros
from ..derivatives._flow_map import Directions, flow_map, with_room
from ..derivatives._variational import arcs, AT_ONCE, monodromy_by_arcs
from ..flow._integrator import Integrator
from ..flow._results import is_okay, RESULTS
from ..flow._solution import Events, Solution
from ..flow._solve import integrate
from ..system._model import SwitchedSystem
from ..system._system import System
from ._guess import at_start, base_on, base_point, LAPS, relays_at
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

    def orbit(self, system: System, t0: Scalar, y0: Y, period: Scalar, mode: Any, concrete: bool) -> Orbit:
        """What Newton's method finds, and what is said of the orbit as it runs forwards. Where all numbers are
        `concrete` Python calls one small program several times; else all is one program, which has derivatives."""
        search = _search if concrete else _searched
        return search(self, system, t0, y0, jnp.asarray(period, t0.dtype), mode)

    def period(self, x: Array, z: Array, system: System) -> Scalar:
        """From the unknowns z, which begin with the state x. (The logarithm of the period is unknown: Newton's method
        cannot step to a period below zero.)"""
        return jnp.exp(z[-1]) if system.period is None else jnp.asarray(system.period, x.dtype) * self.order

    @property
    def part(self) -> float:
        """Of the period, over which the equations integrate."""
        return 1.0 if self.symmetry is None else 0.5

    def sizes(self, x: Array, field: Array, period: Scalar, autonomous: bool) -> Sizes:
        """The units of unknowns and equations, from a state of the orbit and the field there."""
        states = self.integrator.sizes_at(x, field, period)
        return Sizes(jnp.append(states, 1), jnp.append(states, period)) if autonomous else Sizes(states, states)

    def equations(self, z: Array, last: Array, section: "_Section | None", unravel: Callable[[Array], Y]) -> Array:
        """What vanishes, from the unknowns and the state at the end. The base point of an autonomous system stays on
        the section through the guess: Poincaré's phase condition."""
        x = z[: len(last)]
        gap = last - (x if self.symmetry is None else ravel(self.symmetry(unravel(x))))
        return gap if section is None else jnp.append(gap, section.height(x))


@interactive
def _unknowns(y0: Y, period: Scalar, autonomous: bool) -> Array:
    """The state; of an autonomous system the logarithm of the period is unknown too."""
    return jnp.append(ravel(y0), jnp.log(period)) if autonomous else ravel(y0)


class _Section(NamedTuple):
    """The plane through a guess, at right angles to the field there."""

    guess: Array
    normal: Array
    period: Scalar  # that of the guess

    @classmethod
    def through(cls, system: System, t0: Scalar, y0: Y, period: Scalar, mode: Any) -> "_Section":
        model = SwitchedSystem.forwards(system, t0, y0)
        return cls(ravel(y0), ravel(model.flow(t0, y0, at_start(model, t0, y0, mode))), period)

    def height(self, x: Array) -> Scalar:
        speed = self.normal @ self.normal
        return self.normal @ (x - self.guess) / select(speed == 0, 1, speed)

    def at_rest(self, x: Array, field: Array, smallest: Scalar) -> Bool[Array, ""]:
        """Whether the search was in an equilibrium, or ended in one: near it Newton's Jacobian is singular, and it
        seldom says that it converged. States below `smallest` count as zero."""
        slow = jnp.sqrt(self.normal @ self.normal) * self.period <= 1e-9 * (smallest + jnp.max(jnp.abs(self.guess)))
        return slow | (jnp.max(jnp.abs(field)) * self.period <= 1e-6 * (smallest + jnp.max(jnp.abs(x))))


@interactive
def _searched(shooting: Shooting, system: System, t0: Scalar, y0: Y, period: Scalar, mode: Any) -> Orbit:
    """The search as one program."""
    sign, integrator = shooting.sign, shooting.integrator
    autonomous, section = system.period is None, None
    still, t_still = frozen((system, t0))
    guess, first_period = lax.stop_gradient((y0, period))
    if autonomous:
        base = base_point(still, t_still, guess, first_period, sign, mode, integrator)
        guess, first_period, mode = lax.stop_gradient(base)
        section = _Section.through(still, t_still, guess, first_period, mode)
    at, unravel = jfu.ravel_pytree(guess)
    start = _unknowns(guess, first_period, autonomous)
    model = SwitchedSystem.forwards(still, t_still, guess)
    field = (
        ravel(model.flow(t_still, guess, at_start(model, t_still, guess, mode))) if section is None else section.normal
    )
    sizes = shooting.sizes(at, field, shooting.period(at, start, still), autonomous)

    def residual(z: Array, parameters: tuple) -> Array:
        system, t0 = parameters
        x = z[:-1] if autonomous else z
        end = t0 + sign * shooting.part * shooting.period(x, z, system)
        sol = integrate(system, t0, end, unravel(x), integrator, mode=mode)
        return shooting.equations(z, _reached(sol), section, unravel)

    # What depends on parameters does so by the second argument alone: the search needs no derivatives.
    z, converged = find_root(residual, start, (system, t0), shooting.newton, sizes=sizes)
    x = z[:-1] if autonomous else z
    period = shooting.period(x, z, system)
    shares = jnp.asarray(fractions(autonomous, shooting.order)[1], t0.dtype)
    saveat = dfx.SaveAt(ts=t0 + sign * period * shares, t1=True)
    sol = integrate(system, t0, t0 + sign * period, unravel(x), integrator, mode=mode, saveat=saveat)
    later = jax.vmap(ravel)(sol.ys)[:-1]
    monodromy = monodromy_by_arcs(system, sol, t0, unravel(x), integrator)
    return _described(shooting, sol, unravel(x), period, (later, monodromy), section, mode, converged)


class _Trial(NamedTuple):
    """A solution from a state, and what can be made of it."""

    base: tuple[Y, Scalar, Any]  # a better guess of state and period, and the modes of relays
    step: tuple[Array, Bool[Array, ""], Bool[Array, ""]]  # Newton's
    orbit: Orbit  # if it is closed


def _search(shooting: Shooting, system: System, t0: Scalar, y0: Y, period: Scalar, mode: Any) -> Orbit:
    """The search, step by step."""
    unsure, base, integrator = np.zeros((), bool), (y0, period, mode), with_room(shooting.integrator, t0.dtype)
    directions = Directions.of_state(system, t0, y0)
    # Last the direction of the end's time, for Newton's method in the period.
    directions = directions._replace(t1=np.eye(len(directions.t1), dtype=t0.dtype)[-1])

    def look(z: Array, laps: float, converged: Any, **how: bool) -> _Trial:
        number = np.asarray(laps, t0.dtype)
        t1, start = _posed(shooting, system, t0, base[0], z, number)
        passage = flow_map(system, t0, t1, start, base[2], integrator, directions)
        return _tried(shooting, system, t0, base, z, number, passage, converged, **how)

    if system.period is None:
        base = y0, period, (mode or {}) | (relays_at(system, t0, y0, mode) or {}) or None
        base = look(_unknowns(y0, period, True), LAPS, unsure).base
    z, converged = _unknowns(*base[:2], system.period is None), unsure
    for _ in range(shooting.newton.max_steps):
        new, ended, converged = look(z, shooting.part, unsure).step
        if not np.all(np.isfinite(new)):  # there is no solution from the unknowns; they are what is reported
            break
        z = new
        if ended:
            break
    orbit = look(z, 1.0, converged).orbit
    if _based_on_event(orbit):  # beside it the flow's derivative is that of one side
        orbit = look(z, 1.0, converged, by_arcs=True).orbit
    return orbit


def _based_on_event(orbit: Orbit) -> bool:
    t, period = np.asarray(orbit.events.t)[: int(orbit.events.num)] - float(orbit.t0), float(orbit.period)
    return bool(np.any(np.minimum(np.abs(t), np.abs(period - t)) <= AT_ONCE * period))


@interactive
def _posed(shooting: Shooting, system: System, t0: Scalar, guess: Y, z: Array, laps: Scalar) -> tuple[Scalar, Y]:
    """The time of the end, and the state at the start, that belong to unknowns."""
    x = z[:-1] if system.period is None else z
    end = t0 + shooting.sign * laps * shooting.period(x, z, system)
    return end, jfu.ravel_pytree(guess)[1](x)


@interactive
def _tried(
    shooting: Shooting,
    system: System,
    t0: Scalar,
    base: tuple[Y, Scalar, Any],
    z: Array,
    laps: Scalar,
    passage: tuple[Solution, Array],
    converged: Any,
    *,
    by_arcs: bool = False,
) -> _Trial:
    """What is made of the `passage` over `laps` periods from the unknowns z: the solution, and the derivatives of its
    end by state and time. The section stands on the guesses of state, period and modes. `by_arcs`: whether the
    monodromy matrix is that of the saltation formula, and not the derivative of the flow."""
    (guess, first, mode), sign, autonomous = base, shooting.sign, system.period is None
    sol, tangents = passage
    monodromy, speed = tangents[:-1].T, tangents[-1]
    unravel = jfu.ravel_pytree(guess)[1]
    x = z[:-1] if autonomous else z
    period = shooting.period(x, z, system)
    section = _Section.through(system, t0, guess, first, mode) if autonomous else None
    span = sign * laps * period

    def residual(z: Array) -> Array:
        # The derivatives of the end are known.
        x, change = (z[:-1], span * (z[-1] - lax.stop_gradient(z[-1]))) if autonomous else (z, 0)
        last = _reached(sol) + monodromy @ (x - lax.stop_gradient(x)) + speed * change
        return shooting.equations(z, last, section, unravel)

    sizes = shooting.sizes(x, speed, period, autonomous)
    step = shooting.newton.step(z, residual(z), jax.jacfwd(residual)(z), sizes)
    better = base_on(sol, t0, unravel(x), period, sign) if autonomous else base
    shares = jnp.asarray(fractions(autonomous, shooting.order)[1], t0.dtype)
    later = jax.vmap(lambda t: ravel(sol.evaluate(t)))(t0 + sign * period * shares)
    one = sol.within(shooting.integrator.max_events)
    monodromy = monodromy_by_arcs(system, one, t0, unravel(x), shooting.integrator) if by_arcs else monodromy
    orbit = _described(shooting, one, unravel(x), period, (later, monodromy), section, mode, converged)
    return _Trial(better, step, orbit)


def _reached(sol: Solution) -> Array:
    """The state at the end. A solution that ended early is no solution: Newton's method must not be led by it."""
    return select(is_okay(sol.result), ravel(sol.y1), jnp.nan)


def _described(
    shooting: Shooting,
    sol: Solution,
    y0: Y,
    period: Scalar,
    along: tuple[Array, Array],
    section: _Section | None,
    mode: Any,
    converged: Any,
) -> Orbit:
    """What is said of the orbit that is a solution over one period; `along` it are states at `fractions` of the period,
    and at its end the monodromy matrix."""
    system, t0, integrator, (later, monodromy) = sol.system, sol.t0, shooting.integrator, along
    model, x, autonomous = SwitchedSystem.forwards(system, t0, y0), ravel(y0), system.period is None
    error, smallest = distance(ravel(sol.y1), x), shooting.integrator.smallest_size(x.dtype)
    # A switch with levels may have a memory: its mode must come back with the state.
    closes = jnp.all(jnp.asarray([sol.mode0[k] == sol.mode1[k] for k in model.which("levels")], bool))
    near = error <= 1e3 * shooting.newton.tol * (smallest + jnp.max(jnp.abs(x)))
    result = judge(converged & near & is_okay(sol.result) & closes, x, later, autonomous, shooting.order, smallest)
    if section is not None:
        field = ravel(model.flow(t0, y0, at_start(model, t0, y0, mode)))
        result = RESULTS.where(section.at_rest(x, field, smallest), RESULTS.orbit_is_equilibrium, result)
    grazes = (sol.result == RESULTS.tangential_event) & (result == RESULTS.successful)
    result = RESULTS.where(grazes, RESULTS.tangential_event, result)
    begin, stop, y, modes = arcs(sol, t0, y0)
    pieces, events = Arcs(begin, stop, modes, jax.tree.map(lambda y: y[:, None], y)), sol.events
    zeros = structural_zeros(system, modes)
    found_out = floquet(monodromy[None], zeros, autonomous)
    if shooting.backward:
        found_out = forwards(found_out, zeros, autonomous)
        pieces, events = _reversed(pieces, events, y0, period)
        zeros = jnp.zeros_like(zeros)
    monodromy, multipliers, stable = found_out
    return Orbit(
        system=system,
        t0=t0,
        y0=y0,
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
        arcs=pieces,
        result=result,
        integrator=integrator,
    )


def _reversed(arcs: Arcs, events: Events, y0: Y, period: Scalar) -> tuple[Arcs, Events]:
    """The arcs and the events of a solution over one period backwards, in the order of forward time."""
    num = events.num

    def back(leaf: Array, count: Array) -> Array:
        """The first `count` rows in reverse."""
        index = jnp.arange(len(leaf), dtype=count.dtype)
        return leaf[select(index < count, count - 1 - index, index)]

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
        return jnp.concatenate([first[None], select(held, later, first)])[:, None]

    used = jnp.arange(rows, dtype=num.dtype) <= num

    def times(t: Array) -> Array:
        return select(used, back(t, num + 1) + period, t + 2 * period)  # the others stay at the end

    mode = back(arcs.mode, num + 1)
    return Arcs(times(arcs.end), times(arcs.begin), mode, jax.tree.map(starts, y0, y_after)), turned
