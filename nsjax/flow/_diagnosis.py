"""What a failed solution is reported as: one line with the cause, the place and the remedy.

Where the numbers are known this is raised in Python, after the compiled program has ended. (An error raised within one
comes with the stack of the compiler, and may be that of an earlier call.)
"""

from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from .._numerics._select import select
from .._numerics._text import components, counted, written
from .._types import Y
from ..system._checks import closing_contacts, forces_on_speeds
from ..system._mode import ModeState
from ..system._model import SwitchedSystem
from ._results import RESULTS
from ._solution import Solution


def explain(system: Any, sol: Solution, t1: Any) -> str:
    """Why a solution that was to end at `t1` failed, in one line."""
    text, result = str(RESULTS[sol.result]), sol.result
    where = f"t = {float(sol.t1):.10g}, {written(sol.y1)}"
    if result == RESULTS.nonfinite_field:
        what = _not_finite(system, sol)
        text = f"{what} at {where}." if what else f"{text[:-1]} next to {where}."
    elif result == RESULTS.dt_min_reached:
        largest = max(abs(float(value)) for value in components(sol.y1).values())
        cause = (
            "the solution grows beyond all bounds there (a finite-time blow-up)"
            if largest > 1e6
            else "it cannot be resolved to the tolerances (they are too small, or the field is singular or jumps there)"
        )
        text = f"The steps became too small at {where}: {cause}."
    elif result == RESULTS.wrong_contact:
        text = _wrong_contact(system, sol)
    elif result == RESULTS.max_steps_reached:
        text = f"{_steps_wanted(sol, float(t1))} (At {where}.)"
    elif result == RESULTS.stuck_in_events and (name := _rests_unheld(system, sol)):
        text = (
            f"The solution comes to rest on the surface of `{type(system).__name__}.{name}` with h = dh/dt = 0, but "
            f"`s.{name}` acts on d²h/dt² and not on dh/dt, so that this `sgn` cannot hold it there. Let h contain the "
            f"rate (h = x + ε dx/dt), or replace the jump of the force by a stiff spring. (At {where}.)"
        )
    elif result == RESULTS.stuck_in_events:
        text = f"{text} (At {where}, where these fired: {_fired(sol)}.)"
    elif result == RESULTS.wrong_reset and (timed := _timed(system, sol)):
        text = (
            f"`{type(system).__name__}.{timed}` depends on the time alone: no reset of the state leaves its surface. "
            f"Declare a `nsjax.clock` of the times at which it is zero, and reset the state by `@{timed}.reset` of the "
            f"clock. (At {where}.)"
        )
    elif result == RESULTS.jump_in_time:
        text = f"{_jumping(system, sol)} at {where}. {text.partition(') ')[2] or text}"
    else:
        text = f"{text} (At {where}.)"
    return " ".join(text.split())


def _wrong_contact(system: Any, sol: Solution) -> str:
    """Names the contact force that acts in the wrong direction, or on the wrong derivative of its gap."""
    owner, model = type(system).__name__, SwitchedSystem.forwards(system, sol.t1, sol.y1).at(sol.t1)
    for k, wrong in forces_on_speeds(model, sol.t1, sol.y1).items():
        if wrong:
            name = model.switches[k].name
            return (
                f"`{owner}.{name}` is an impact, the force of which acts on d²h/dt², but in `vector_field` `s.{name}` "
                "acts on dh/dt. What keeps its own h from falling below zero by acting on dh/dt, such as an ideal "
                "diode, is a `sgn` (see Common elements in the guide)."
            )
    closes = closing_contacts(model, sol.t1, sol.y1)
    name = next((model.switches[k].name for k, bad in closes.items() if bad), "name")
    return (
        f"`{owner}.vector_field` must contain `s.{name}` with the sign with which a contact force s.{name} >= 0 opens "
        f"the gap `{name}`, but it closes it. Change its sign, or that of what `{name}` returns: it must be positive "
        "while the contact is open."
    )


def _steps_wanted(sol: Solution, t1: float) -> str:
    """Returns how far the steps sufficed, and the `max_steps` that would do if the solution went on at that rate."""
    most, begin, end = sol.stats["max_steps"], float(sol.t0), float(sol.t1)
    part = (end - begin) / (t1 - begin)
    text = f"The maximum number of solver steps, `max_steps={most}`, was reached after {100 * part:.2g} % of the time."
    wanted = 1.5 * most / part if part > 0 else np.inf
    if wanted > 1e6:
        return (
            f"{text} The field may be stiff (take `solver=diffrax.Kvaerno5()` or `nsjax.Exponential()`), or jump where "
            "no switch or clock says so."
        )
    digits = 10 ** (len(str(int(wanted))) - 1)
    return (
        f"{text} Write `max_steps={digits * (int(wanted) // digits + 1)}`, or take a method with longer steps, such as "
        "`solver=nsjax.Taylor()`, or larger tolerances."
    )


def _rests_unheld(system: Any, sol: Solution) -> str | None:
    """Returns the name of a `sgn` that does not act on dh/dt, and on whose surface the solution has come to rest with
    forces towards it on both sides; or None."""
    model = SwitchedSystem.forwards(system, sol.t1, sol.y1).at(sol.t1)
    t, y = sol.t1, sol.y1
    for k, switch in enumerate(model.switches):
        if switch.order != 1 or switch.jumps or k in model.holdable or model.parts[k] > 1:
            continue
        small = 1e-6 * (1 + max(abs(float(x)) for x in components(y).values()))
        pulls = []
        for side in (1, -1):
            mode = tuple(jnp.asarray(side if j == k else m, jnp.int32) for j, m in enumerate(sol.mode1))
            state = ModeState.of(mode, [jnp.zeros((), jnp.int32) if n > 1 else None for n in model.parts])

            def rate(t: Any, y: Y, state: ModeState = state) -> Any:
                return model.approach(k, t, y, state)

            f = model.flow(t, y, state)
            pulls.append(side * float(jax.jvp(rate, (t, y), (jnp.ones_like(t), f))[1]))
            near = abs(float(model.least(k, t, y))) <= small and abs(float(rate(t, y))) <= small
        if near and max(pulls) < 0:
            return switch.name
    return None


def _fired(sol: Solution) -> str:
    """The switches of the events at the end of a solution, with how many each had: `2 floor, 1 belt`."""
    events, t1 = sol.events, float(sol.t1)
    ts = np.asarray(events.t[: int(events.num)])
    late = np.abs(ts - t1) <= 1e-9 * (abs(t1 - float(sol.t0)) + abs(t1))
    return counted(events.names[k] for k in np.asarray(events.switch[: len(ts)])[late])


def _timed(system: Any, sol: Solution) -> str | None:
    """An impact with a reset whose gap does not depend on the state."""
    for switch in system.switches:
        if switch.jumps and not switch.ticking:
            gaps = jax.jacfwd(lambda y: switch.components(system, sol.t1, y))(sol.y1)
            if not any(np.any(leaf) for leaf in jax.tree.leaves(gaps)):
                return switch.name
    return None


def _pieces(system: Any, t: Any, y: Y, mode: Any) -> list[tuple[str, list[tuple[str, Any]]]]:
    """What the model's methods return, named."""
    owner, out = type(system).__name__, []
    model = SwitchedSystem.forwards(system, t, y)
    state = ModeState.of(mode, [jnp.zeros((), jnp.int32) if n > 1 else None for n in model.parts])
    model = model.within(state.mode)
    for switch in model.switches:
        h = switch.surfaces(system, model.time(t), y)
        if h:
            out.append((f"`{owner}.{switch.name}`", [("h", value) for value in h]))
    signs = tuple(
        select(x == 0, 1, x) if switch.order == 1 else x for switch, x in zip(model.switches, model.signs(t, state))
    )
    return [*out, (f"`{owner}.vector_field`", list(components(model.field(t, y, signs)).items()))]


def _not_finite(system: Any, sol: Solution) -> str | None:
    """Which function of the model returned a number that is not finite."""
    for name, value in components(sol.y1).items():
        if not np.isfinite(value):
            return f"The state ceased to be finite ({name} = {float(value)}: it overflows, or the model returned NaN)"
    for name, values in _pieces(system, sol.t1, sol.y1, sol.mode1):
        for part, value in values:
            if not np.isfinite(value):
                which = "" if part == "h" else f" for `{part}`"
                return f"{name} returned {float(value)}{which}"
    return None


def _jumping(system: Any, sol: Solution) -> str:
    """Which indicator function jumps within the step that failed."""
    span = abs(float(sol.t1 - sol.t0)) + abs(float(sol.t1))
    ahead = sol.t1 + 1e-6 * span * select(sol.t1 >= sol.t0, 1, -1)
    slope = dict(_pieces(system, sol.t1, sol.y1, sol.mode1))[f"`{type(system).__name__}.vector_field`"]
    leaves, tree = jax.tree.flatten(sol.y1)
    if all(jnp.ndim(leaf) == 0 for leaf in leaves):
        rates = jnp.asarray([value for _, value in slope])
        leaves = [leaf + (ahead - sol.t1) * rate for leaf, rate in zip(leaves, rates)]
    here, there = (
        _pieces(system, t, y, sol.mode1) for t, y in ((sol.t1, sol.y1), (ahead, jax.tree.unflatten(tree, leaves)))
    )
    jumps = [
        (max(abs(float(b) - float(a)) for (_, a), (_, b) in zip(before, after)), name)
        for (name, before), (_, after) in zip(here[:-1], there)
    ]
    return f"{max(jumps)[1]} jumps"
