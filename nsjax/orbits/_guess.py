"""Where to begin the search for a periodic orbit."""

from typing import Any

import diffrax as dfx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Int

from .._numerics._compile import interactive
from .._numerics._select import select
from .._types import Scalar, Y
from ..derivatives._flow_map import with_room
from ..derivatives._variational import arcs
from ..flow._integrator import Integrator
from ..flow._results import is_okay
from ..flow._solution import Solution
from ..flow._solve import integrate
from ..system._level_switch import LevelSwitch
from ..system._model import SwitchedSystem
from ..system._system import System
from ._orbit import distance, ravel


LAPS = 2.5  # guessed periods, over which a better guess is looked for


Relays = dict[str, Int[Array, ""]] | None


def base_point(
    system: System, t0: Scalar, y0: Y, period: Scalar, sign: float, mode: Any, integrator: Integrator
) -> tuple[Y, Scalar, Relays]:
    """A better guess, from the solution over some guessed periods (backwards if `sign` is -1).

    The base point is in the middle of the longest arc between events, on a smooth one if there is any: the flow map is
    only one-sided differentiable at an event, and the phase condition wants a transversal section. The period is the
    time after which the solution comes nearest to it again, among those within half the guess of it. Third, the modes
    of relays there, which within a hysteresis only the solution knows.
    """
    end_time = t0 + sign * LAPS * period
    sol = integrate(system, t0, end_time, y0, with_room(integrator, t0.dtype), mode=mode, saveat=dfx.SaveAt(dense=True))
    return base_on(sol, t0, y0, period, sign)


def base_on(sol: Solution, t0: Scalar, y0: Y, period: Scalar, sign: float) -> tuple[Y, Scalar, Relays]:
    """The base point from a solution that is known."""
    system = sol.system
    begin, end, _, modes = arcs(sol, t0, y0)
    begin, end = (jnp.minimum(sign * (t - t0), period) for t in (begin, end))
    slides = jnp.stack(
        [modes[:, k] == 0 for k, s in enumerate(system.switches) if s.signed] or [jnp.zeros(len(begin), bool)]
    ).any(0)
    longest = jnp.argmax((end - begin) * select(slides, 1e-6, 1.0))
    base = t0 + sign * 0.5 * (begin[longest] + end[longest])
    here = sol.evaluate(base)
    share = jnp.linspace(0.5, 1.5, 401, dtype=base.dtype)
    later = jax.vmap(lambda u: ravel(sol.evaluate(base + sign * u * period)))(share)
    extent = jnp.max(later, axis=0) - jnp.min(later, axis=0)
    gap = distance(later / select(extent == 0, 1, extent), ravel(here) / select(extent == 0, 1, extent))
    # Of equally near returns the one nearest to the guess: a user who asks for two laps gets two.
    best = share[jnp.argmin(gap + 0.05 * jnp.abs(share - 1))]
    reached = is_okay(sol.result)
    here = jax.tree.map(lambda a, b: select(reached, a, b), here, y0)
    return here, select(reached, best, 1) * period, of_relays(system, modes[longest])


def of_relays(system: System, mode: Any) -> Relays:
    """Of a mode of all switches that of the relays, as an argument for `solve`."""
    return {k.name: mode[i] for i, k in enumerate(system.switches) if k.levels} or None


@interactive
def relays_at(system: System, t0: Scalar, y0: Y, given: Relays) -> Relays:
    """The modes of relays at a state; within their hysteresis those that are given, or off."""
    return of_relays(system, at_start(SwitchedSystem.forwards(system, t0, y0), t0, y0, given).mode)


@interactive
def undecided(system: System, t0: Scalar, y0: Y) -> dict[str, Bool[Array, ""]]:
    """Which switches with levels may have several modes at a state, as a relay has within its hysteresis."""
    unsure = {}
    for switch in system.switches:
        if isinstance(switch, LevelSwitch):
            modes = [switch.mode_at(system, t0, y0, jnp.asarray(before, jnp.int32)) for before in switch.modes]
            unsure[switch.name] = jnp.any(jnp.stack(modes) != modes[0])
    return unsure


def at_start(model: SwitchedSystem, t: Scalar, y: Y, given: Relays = None) -> Any:
    """The mode by the signs of h, and of relays within their hysteresis that which is given; a surface counts as slid
    upon."""
    modes = []
    for k, switch in enumerate(model.switches):
        zero = jnp.zeros((), jnp.int32)
        if switch.signed:
            h = model.least(k, t, y)
            noise = jnp.max(model.rounding(lambda t, y, k=k: model.h(k, t, y), t, y))
            zero = select(jnp.abs(h) <= 1e3 * noise, 0, jnp.sign(h)).astype(jnp.int32)
        elif switch.levels:
            before = jnp.asarray((given or {}).get(switch.name, switch.modes[0]), jnp.int32)
            zero = model.level_at(k, t, y, before)
        elif switch.ticking:
            zero = model.counts(t)[k]
        modes.append(zero)
    return model.state_at(t, y, tuple(modes))
