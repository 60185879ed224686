"""Why a solution, or a search, ended."""

import warnings
from typing import Any

import diffrax as dfx
import equinox as eqx
import jax
import numpy as np
from jax.core import Tracer
from jaxtyping import Array, Bool

from .._numerics._text import counted


with warnings.catch_warnings():  # of another text for success, which diffrax prints as nothing
    warnings.simplefilter("ignore")

    class RESULTS(dfx.RESULTS):  # pyright: ignore[reportGeneralTypeIssues]
        """Diffrax's results, and those of nonsmooth flows."""

        successful = "successful"
        tangential_event = (
            "A surface was met tangentially (grazing): nᵀf⁻ + h_t vanishes there, see `sol.events.transversality`. "
            "The solution is right, but its derivatives through that event are not defined."
        )
        max_events_reached = (
            "The maximum number of events was reached. Increase `max_events`; if events crowd together, look at "
            "`sol.events`."
        )
        accumulation_reached = (
            "Impacts accumulated (Zeno): infinitely many in a finite time, on a surface that cannot hold the "
            "solution (its h is a tuple, the contact force does not occur in `vector_field`, or it is crossed with a "
            "reset). `sol.t1` and `sol.y1` hold the time and the state at the accumulation point."
        )
        repulsive_sliding = (
            "The start lies on a surface that repels (2.25) but can hold the solution too, which is therefore not "
            "unique. Choose one by `mode={'name': 0}` to stay on the surface, or +1 or -1 to leave it to that side."
        )
        ambiguous_event = (
            "Several switches met their surfaces at one instant, and no combination of sticking and slipping "
            "satisfies all of their laws (or was found to)."
        )
        stuck_in_events = (
            "Events followed one another without any progress in time: the model chatters. A relay whose two "
            "surfaces coincide, or a reset that does not leave its surface, does this."
        )
        mode_not_affine = (
            "`nsjax.Exponential` met a mode that it cannot step exactly: it slides or rests where the field that does "
            "so is not affine in the state. Take `nsjax.Taylor()` or a Runge-Kutta solver."
        )
        nonfinite_field = (
            "The vector field or an indicator function returned a value that is not finite (NaN or infinity)."
        )
        wrong_save_times = (
            "The times of `SaveAt(ts=...)` must be finite, lie between `t0` and `t1`, and follow one another in the"
            " direction of the integration."
        )
        wrong_mode = "Argument `mode` places the start on one side of a surface, but `y0` lies clearly on the other."
        start_penetrates = (
            "The start lies beyond an impact surface: h < 0 there. Put `y0` where h >= 0, or change the sign of h."
        )
        wrong_reset = (
            "A reset left the state on the wrong side of its surface (h < 0), or still approaching it (dh/dt < 0). "
            "Check the signs in the method decorated with `.reset`."
        )
        wrong_parameter = (
            "A number of a switch is out of its range: a breakaway bound is at least 1, a coefficient of "
            "restitution lies between 0 and 1, the time between two ticks of a clock is positive."
        )
        wrong_contact = (
            "A contact force `s.name` >= 0 must open its gap by acting on d²h/dt², but in `vector_field` it closes it, "
            "or acts on dh/dt. Change its sign there; what acts on dh/dt is a `sgn`."
        )
        clock_too_fast = (
            "A clock ticks so fast that time has too few digits to tell its ticks apart, or more than 2^30 of them "
            "have passed. Let time begin nearer to the clock's offset, or take float64."
        )
        jump_penetrates = (
            "At a tick of a clock an impact surface jumped beyond the state: h < 0 from then on. A gap may open at "
            "once, but cannot close so."
        )
        jump_in_time = (
            "An indicator function jumps where nothing tells of it (`floor`, `%`, `round`, `where` or a table, of "
            "the time or of the state). Declare the times at which it does as ticks of a `nsjax.clock`; what jumps "
            "with the state is a switch of its own."
        )
        equilibrium_not_found = (
            "No equilibrium was found: Newton's method did not converge. Start nearer to one, give another `mode`, "
            "or check that the field vanishes anywhere."
        )
        no_return = (
            "The solution did not come back to the section within `max_time`. Give it more time, check `direction`,"
            " or start where it does; a solution that comes to rest never returns."
        )
        reduced_map_not_found = (
            "No state with this value of the component was found whose other components are periodic: Newton's "
            "method did not converge. There may be none; or give another `guess`, such as the state found for a "
            "value nearby."
        )
        orbit_not_found = (
            "No periodic orbit was found: Newton's method did not converge. Start nearer to one (`y0`, `period`), "
            "or check that the system has one."
        )
        orbit_not_admissible = (
            "A periodic orbit was found in the segments given, but it is no solution: it does not keep to the modes"
            " of these segments. With `throw=False` look at `violation` and `violation_t`; start nearer to one that"
            " does."
        )
        orbit_is_equilibrium = (
            "The search for a periodic orbit ended in an equilibrium. Start farther away from it, near the orbit."
        )
        orbit_sticks_for_ever = (
            "Friction holds the solution for ever, and not at one place only: every state of a continuum repeats "
            "itself, and no orbit is isolated. Start where friction slips, with more energy, or make friction smaller, "
            "or larger what drives the system."
        )
        orbit_is_multiple_cover = (
            "The orbit found repeats itself within the period asked for. Divide `period` (or `order`) by the number"
            " of repetitions."
        )


class SolveError(RuntimeError):
    """What was asked for does not exist or was not found. The text says why and where, by one of `RESULTS`; with
    `throw=False` nothing is raised, and `result` tells."""


def promoted(result: Any) -> RESULTS:
    """One of diffrax's as one of ours. (`RESULTS.promote` compiles eight small programs for what is known.)"""
    return RESULTS.successful if result is dfx.RESULTS.successful else RESULTS.promote(result)


def raise_if(bad: Bool[Array, ""], result: RESULTS, tree: Any) -> Any:
    """`tree`, if not `bad`, else an error with the message of `result`. Derivatives raise it too: a program for these
    alone computes nothing else, and would return those of a solution that failed."""
    if not isinstance(bad, Tracer) and not isinstance(result._value, Tracer):
        if np.any(bad):
            raise SolveError(str(RESULTS[result]))
        return tree
    smooth, rest = eqx.partition(tree, eqx.is_inexact_array)
    return eqx.combine(_raise_if((smooth, (bad, result))), rest)


@eqx.filter_custom_jvp
def _raise_if(args: Any) -> Any:
    tree, (bad, result) = args
    return result.error_if(tree, bad)


@_raise_if.def_jvp
def _raise_if_jvp(primals: Any, tangents: Any) -> tuple[Any, Any]:
    ((tree, verdict),), ((moves, _),) = primals, tangents
    return _raise_if((tree, verdict)), _raise_if((moves, verdict)) if jax.tree.leaves(moves) else moves


def result_names(result: Any) -> np.ndarray:
    """The name of each; of `RESULTS`, or of the integers by which it is kept."""
    names = {int(item._value): name for name, item in RESULTS._name_to_item.items()}
    codes = np.asarray(getattr(result, "_value", result))
    return np.array([names[int(i)] for i in np.ravel(codes)], dtype=object).reshape(codes.shape)


def outcomes(result: RESULTS) -> str:
    """`60 successful, 4 max_steps_reached`; of one alone its name."""
    each = result_names(result)
    return counted(each.ravel()) if each.ndim else str(each)


def is_okay(result: RESULTS) -> Bool[Array, ""]:
    """Whether a solution reached its end: successfully, or through a tangential event."""
    return (result == RESULTS.successful) | (result == RESULTS.tangential_event)
