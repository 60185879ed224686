"""What `solve` returns: saved states, the event log, dense output, and why it ended."""

from collections.abc import Iterator
from typing import Any, NamedTuple

import diffrax as dfx
import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int

from ._step import bernstein
from ._system import System
from ._types import Scalar, Y


class RESULTS(dfx.RESULTS):  # pyright: ignore[reportGeneralTypeIssues]
    """Diffrax's results, and those of nonsmooth flows."""

    tangential_event = (
        "A surface was met tangentially (grazing): nᵀf⁻ + h_t vanishes there, see `sol.events.transversality`. The "
        "solution is right, but its derivatives through that event are not defined."
    )
    max_events_reached = (
        "The maximum number of events was reached. Increase `max_events`; if events crowd together, look at "
        "`sol.events`."
    )
    accumulation_reached = (
        "Impacts accumulated (Zeno): infinitely many in a finite time, on a surface that cannot hold the solution (its "
        "h is a tuple, or the contact force does not occur in `vector_field`). `sol.t1` and `sol.y1` hold the time "
        "and the state at the accumulation point."
    )
    repulsive_sliding = (
        "The start lies on a surface that repels (2.25) but can hold the solution too, which is therefore not unique. "
        "Choose one by `mode={'name': 0}` to stay on the surface, or +1 or -1 to leave it to that side."
    )
    ambiguous_event = (
        "Several switches met their surfaces at one instant, and no combination of sticking and slipping satisfies all "
        "of their laws (or was found to)."
    )
    stuck_in_events = (
        "Events followed one another without any progress in time: the model chatters. A relay whose two surfaces "
        "coincide, or a reset that does not leave its surface, does this."
    )
    mode_not_affine = (
        "`nsjax.Exponential` met a mode that it cannot step exactly: its forcing is neither constant, linear or "
        "quadratic in time, exponential, nor harmonic of one frequency; or it slides or rests where the field that "
        "does so is not affine in the state. Take `nsjax.Taylor()` or a Runge-Kutta solver."
    )
    nonfinite_field = "The vector field or an indicator function returned a value that is not finite (NaN or infinity)."
    wrong_mode = "Argument `mode` places the start on one side of a surface, but `y0` lies clearly on the other."
    start_penetrates = (
        "The start lies beyond an impact surface: h < 0 there. Put `y0` where h >= 0, or change the sign of h."
    )
    wrong_reset = (
        "A reset left the state on the wrong side of its surface (h < 0), or still approaching it (dh/dt < 0). Check "
        "the signs in the method decorated with `.reset` (or a coefficient of restitution below 0)."
    )
    equilibrium_not_found = (
        "No equilibrium was found: Newton's method did not converge. Start nearer to one, give another `mode`, or "
        "check that the field vanishes anywhere."
    )
    no_return = (
        "The solution did not come back to the section within `max_time`. Give it more time, check `direction`, or "
        "start where it does; a solution that comes to rest never returns."
    )
    reduced_map_not_found = (
        "No state with this value of the component was found whose other components are periodic: Newton's method did "
        "not converge. There may be none; or give another `guess`, such as the state found for a value nearby."
    )
    orbit_not_found = (
        "No periodic orbit was found: Newton's method did not converge. Start nearer to one "
        "(`y0`, `period`), or check that the system has one."
    )
    orbit_not_admissible = (
        "A periodic orbit was found in the segments given, but it is no solution: it does not keep to the modes of "
        "these segments. With `throw=False` look at `violation` and `violation_t`; start nearer to one that does."
    )
    orbit_is_equilibrium = (
        "The search for a periodic orbit ended in an equilibrium. Start farther away from it, near the orbit."
    )
    orbit_sticks_for_ever = (
        "Friction holds the solution for ever, and not at one place only: every state of a continuum repeats itself, "
        "and no orbit is isolated. Start where friction slips, with more energy, or make friction smaller, or larger "
        "what drives the system."
    )
    orbit_is_multiple_cover = (
        "The orbit found repeats itself within the period asked for. Divide `period` (or `order`) by the number of "
        "repetitions."
    )


def raise_if(bad: Bool[Array, ""], result: RESULTS, tree: Any) -> Any:
    """`tree`, if not `bad`, else an error with the message of `result`. Derivatives raise it too: whoever wants these
    alone computes nothing else, and would be given what belongs to a solution that failed."""
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


def is_okay(result: RESULTS) -> Bool[Array, ""]:
    """Whether a solution reached its end: successfully, or through a tangential event."""
    return (result == RESULTS.successful) | (result == RESULTS.tangential_event)


class Event(NamedTuple):
    """One event of a solution, as `for event in sol.events` yields it."""

    t: Any
    switch: str
    mode_before: dict[str, int]
    mode_after: dict[str, int]
    y_before: Any
    y_after: Any
    transversality: Any


class Events(eqx.Module):
    """The event log, in order of time, padded to `max_events` rows (time infinite, switch -1).

    **Attributes:**

    - `t`: times, shape `(max_events,)`.
    - `switch`: which switch, as its position in `names`.
    - `mode_before`, `mode_after`: shape `(max_events, number of switches)`; for `sgn` +1, -1, or 0
      while sliding; `relay` 0 or 1; `impact` 1 while resting in contact.
    - `y_before`, `y_after`: the state on either side, leaves with a leading axis of length `max_events`.
    - `transversality`: how squarely each met its surface: |nᵀf⁻ + h_t| / sqrt((|n|² + h_t²) (|f⁻|² + 1)), the cosine
      between the surface's normal and the trajectory in time and state (without the 1 where h_t = 0), from 0 (tangency,
      where derivatives do not exist) to 1. Where it is below eps^(1/3) (6e-6; for float32 5e-3) and h has a minimum,
      not the end of a short flight, the solution's result is `RESULTS.tangential_event`.
    - `num`: how many there were.
    """

    t: Float[Array, " events"]
    switch: Int[Array, " events"]
    mode_before: Int[Array, "events switches"]
    mode_after: Int[Array, "events switches"]
    y_before: Y
    y_after: Y
    transversality: Float[Array, " events"]
    num: Int[Array, ""]
    names: tuple[str, ...] = eqx.field(static=True)

    def __len__(self) -> int:
        return int(self.num)

    def __getitem__(self, i: int) -> Event:
        n = len(self)
        if not -n <= i < n:
            raise IndexError(f"There are {n} events.")
        i = i % n

        def named(mode: Array) -> dict[str, int]:
            return {name: int(m) for name, m in zip(self.names, mode)}

        t, *rest = jax.tree.map(lambda x: x[i], (self.t, self.y_before, self.y_after, self.transversality))
        modes = named(self.mode_before[i]), named(self.mode_after[i])
        return Event(t, self.names[int(self.switch[i])], *modes, *rest)

    def __iter__(self) -> Iterator[Event]:
        return (self[i] for i in range(len(self)))

    def __str__(self) -> str:
        lines = []
        for e in self:
            changes = [f"{n} {e.mode_before[n]:+d} -> {e.mode_after[n]:+d}" for n in self.names]
            changes = [c for n, c in zip(self.names, changes) if e.mode_before[n] != e.mode_after[n]] or ["reset"]
            state = ", ".join(f"{x:.6g}" for x in np.concatenate([np.ravel(l) for l in jax.tree.leaves(e.y_after)]))
            lines.append(f"t = {float(e.t):<18.12g} {e.switch}: {', '.join(changes)}   y = ({state})")
        return "\n".join(lines) or "no events"


class Itinerary(eqx.Module):
    """The modes that a solution passes through, with the switches whose events lead from one to the next.

    Iterating yields each mode as a dictionary. (A reset leads from a mode to itself.)
    """

    first: Int[Array, " switches"]
    switch: Int[Array, " events"]
    modes: Int[Array, "events switches"]  # after each event
    num: Int[Array, ""]
    names: tuple[str, ...] = eqx.field(static=True)

    def same_as(self, other: "Itinerary") -> Bool[Array, ""]:
        """Whether two solutions have the same events in the same order (for batches lane by lane)."""
        if self.names != other.names:
            raise ValueError(f"Itineraries of different systems: switches {self.names} and {other.names}.")
        n = min(self.switch.shape[-1], other.switch.shape[-1])
        equal = (self.switch[..., :n] == other.switch[..., :n]) & jnp.all(
            self.modes[..., :n, :] == other.modes[..., :n, :], axis=-1
        )
        padding = jnp.arange(n, dtype=self.num.dtype) >= self.num[..., None]
        same = (self.num == other.num) & jnp.all(self.first == other.first, axis=-1)
        return same & jnp.all(equal | padding, axis=-1)

    def __iter__(self) -> Iterator[dict[str, int]]:
        for row in [self.first, *self.modes[: int(self.num)]]:
            yield {n: int(m) for n, m in zip(self.names, row)}

    def __str__(self) -> str:
        return " -> ".join(", ".join(f"{n} {m:+d}" for n, m in row.items()) for row in self)


class Solution(eqx.Module):
    """The solution of a piecewise-smooth system.

    **Attributes:**

    - `t0`, `t1`: where it starts and where it ended (before the requested end if it failed or accumulated).
    - `mode0`: the mode in which it sets out.
    - `y1`, `mode1`: the state and the mode at `t1`.
    - `ts`, `ys`, `modes`: what `saveat` asked for, in order of time, padded with infinities (modes with -128).
    - `events`: the event log.
    - `stats`: `num_steps`, `num_accepted_steps`, `num_rejected_steps`, `num_events`.
    - `result`: `RESULTS`; why it ended.
    - `unique`: False where it is known not to be the only solution of the inclusion: its start, or an arrival at a
        surface, lies where a surface may hold the solution as well as let it go (repulsion sliding, chosen by `mode`;
        example 2.5; static friction that holds with |λ| > 1), or it runs backwards and slides or rests. Derivatives are
        those among solutions of the same choice.

    With `SaveAt(dense=True)`, `sol(t)` is the state at any time; at the instant of an event it is the state before
    with `left=True` (the default) and the state after with `left=False`.
    """

    system: System
    t0: Scalar
    t1: Scalar
    mode0: Int[Array, " switches"]
    y1: Y
    mode1: Int[Array, " switches"]
    ts: Float[Array, " times"] | None
    ys: Any
    modes: Int[Array, "times switches"] | None
    events: Events
    stats: dict[str, Any]
    result: RESULTS
    unique: Bool[Array, ""]
    dense: Any = None  # (end times of steps, control points) in internal time, and its direction

    @property
    def itinerary(self) -> Itinerary:
        """The modes it passes through."""
        e = self.events
        return Itinerary(self.mode0, e.switch, e.mode_after, e.num, e.names)

    def evaluate(self, t: Any, left: bool = True) -> Y:
        """The state at time `t` (scalar); at an event the one before it, or after it with `left=False`."""
        if self.dense is None:
            raise ValueError("Dense output was not kept; call `solve` with `saveat=SaveAt(dense=True)`.")
        starts, stops, points, direction, steps = self.dense
        s = jnp.asarray(t, starts.dtype) * direction
        i = jnp.searchsorted(stops, s, side="left" if left else "right")
        i = jnp.clip(i, 0, jnp.maximum(steps - 1, 0))
        length = stops[i] - starts[i]
        u = jnp.where(length > 0, (s - starts[i]) / jnp.where(length > 0, length, 1), 1.0)
        return bernstein(jax.tree.map(lambda p: p[i], points), u)

    def __call__(self, t: Any, left: bool = True) -> Y:
        return self.evaluate(t, left)
