"""The search for a periodic orbit, and for all that many starts lead to."""

import os
from collections.abc import Callable, Sequence
from typing import Any, Literal

import diffrax as dfx
import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

from .._numerics._autodiff import dense_jacobian, forward_only
from .._numerics._progress import ProgressMeter, QUIET
from .._numerics._root import Newton
from .._numerics._text import known, suggesting, written
from .._types import Scalar, StateT, Y
from ..flow._arguments import check_numbers, checked_start
from ..flow._integrator import Integrator
from ..flow._results import is_okay, raise_if, RESULTS, SolveError
from ..flow._solve import HINTS
from ..sweeps._devices import Devices
from ..sweeps._long_sweep import sweep_in
from ..system._checks import check_autonomous, check_clocks, check_direction, check_period
from ..system._system import arrays_of, System
from ._orbit import Orbit, ravel
from ._search import Search
from .segments._guess import Segment


def _inversion(y: Y) -> Y:
    return jax.tree.map(jnp.negative, y)


@suggesting(HINTS | {"T": "Write `period=...`.", "max_iterations": "Write `max_newton_steps=...`."})
def find_orbit(
    system: System,
    y0: StateT,
    *,
    period: Any = None,
    t0: Any = 0.0,
    order: int | None = 1,
    symmetry: Callable[[StateT], StateT] | Literal["inversion"] | None = None,
    backward: bool = False,
    mode: Any = None,
    method: Literal["shooting", "segments"] | None = None,
    segments: Sequence[Segment] | None = None,
    pieces: int = 1,
    solver: dfx.AbstractSolver = dfx.Dopri8(),
    stepsize_controller: dfx.AbstractStepSizeController | None = None,
    rtol: float | None = None,
    atol: float | None = None,
    tol: float | None = None,
    max_newton_steps: int = 30,
    max_steps: int = 4096,
    max_events: int = 64,
    adjoint: dfx.AbstractAdjoint = dfx.ForwardMode(),
    throw: bool = True,
) -> Orbit[StateT]:
    """Finds a periodic orbit by optimistix's Newton method, in one of two formulations.

    *Shooting*, y(t0 + period) = y0, goes through the event-driven flow, which finds the itinerary. With *segments* the
    itinerary is given, by `segments` or by the solution from the guess, and the states and times at all events are
    unknown; each segment is a smooth flow in its mode. That stays well-posed on surfaces that repel and, in `pieces`,
    for violently unstable orbits; `Orbit.admissible` tells whether what it found is a solution.

    For an autonomous system the period is unknown too and Poincaré's phase condition is added; the base point of the
    result is moved away from events. The orbit's period, states and multipliers are differentiable with respect to the
    parameters of `system`, twice too, by implicit differentiation.

    Where shooting does not converge from the guess, segments are tried, whole and in sixteen pieces (unless `method`
    is given; each is a program to be compiled); and then the same from where the solution settles. This needs concrete
    values: under `jit` or `vmap` there is one try.

    **Arguments:**

    - `system`: the model. It is forced if its `period` is not None.
    - `y0`: a guess of a state on the orbit, for a forced system at time `t0`.
    - `period`: autonomous systems: a guess of the period [time]; found by following the solution if None. For forced
        systems it is `order * system.period`, and must not be given.
    - `t0`: time of the base point.
    - `order`: subharmonic order of a forced orbit; if None, the solution is followed to where it settles, and the
        order is the number of periods of the forcing (up to 16) after which it repeats itself there.
    - `symmetry`: for an orbit with y(t + period/2) = `symmetry`(y(t)), a function of the state, or "inversion" for
        -y (6.24). Shooting takes half the period then, and finds no orbit that is less symmetric.
    - `backward`: whether to shoot in backward time: for an orbit that leaves a surface which repels (section 6.7), or
        whose multipliers all lie outside the unit circle. What is returned is the orbit as it runs forwards.
    - `mode`: as for `solve`, for a guess on a surface, or within the hysteresis of a relay. Without it
        both modes of up to four relays are tried, off first; under `jit` and `vmap` they are off. A state that comes
        back with the relay in the other mode is no orbit.
    - `method`: "shooting" or "segments"; by default segments if these or `pieces` are given, else shooting, and see
        above.
    - `segments`: the itinerary and its durations, from `y0` on, as a list of `Segment`; the last ends where the first
        begins, and so is in the same mode. `y0` lies on no surface.
    - `pieces`: into how many pieces of equal length each segment is divided: multiple shooting, for orbits so unstable
        that no single solution follows them.
    - `solver`, `stepsize_controller`, `rtol`, `atol`, `max_steps`, `max_events`: as for `solve`; by default Dopri8 with
        tolerances of 1e-12 (float32: 1e-6). States that are much smaller than 1 need an `atol` in their own unit: a
        search takes from it which states count as zero, too.
    - `tol`, `max_newton_steps`: of Newton's method, by default 1e-10 (float32: 1e-4) and 30. (`max_steps` are those of
        each solution.)
    - `adjoint`: `diffrax.ForwardMode()` for `jax.jvp` and `jax.jacfwd`; for `jax.grad` and `jax.linearize` (and so for
        optimistix's optimisers) `diffrax.DirectAdjoint()`, at the cost of a forward derivative for each parameter that
        is perturbed.
    - `throw`: whether a failure raises; if not, look at `Orbit.result`. Derivatives are NaN where there is no
        orbit.

    **Returns:** an `Orbit`. Its result is `RESULTS.tangential_event`, which is no failure, if it grazes a surface: the
    orbit is right, but its multipliers are not defined.

    **Raises:** `ValueError` for a model that depends on the time but has no `period`, and for arguments that do not fit
    together; a runtime error that says whether the search ended in an equilibrium, in a multiple cover of a shorter
    orbit, or nowhere.
    """
    t0, y0, given = checked_start(system, t0, y0, mode)
    integrator = Integrator(solver, stepsize_controller, max_steps, max_events).checked(
        t0.dtype, (1e-12, 1e-6), rtol=rtol, atol=atol
    )
    tol = (1e-10 if jnp.finfo(t0.dtype).eps < 1e-10 else 1e-4) if tol is None else tol
    symmetry = _inversion if symmetry == "inversion" else symmetry
    _check_method(method, symmetry, backward, segments, pieces, adjoint)
    check_direction(system, backward)
    if throw:
        check_numbers(system, t0, t0, y0)
    system = arrays_of(system, t0.dtype)
    concrete = known((system, t0, y0, period, jnp.zeros(())))  # (under `jit` not even a constant is)
    _check_period(system, t0, y0, period, order, concrete)
    search = Search(
        t0=t0,
        order=order,
        mode=given or None,
        method=method,
        symmetry=symmetry,
        backward=backward,
        segments=segments,
        pieces=pieces,
        concrete=concrete,
        integrator=integrator,
        newton=Newton(tol, max_newton_steps),
    )
    if isinstance(adjoint, dfx.DirectAdjoint) and not concrete:
        orbit = dense_jacobian(search.run, system, y0, period)
    else:
        system = forward_only(
            system,
            "`nsjax.find_orbit` was linearised or differentiated in reverse mode (`jax.grad`, `jax.vjp`, "
            "`jax.linearize`), which needs `adjoint=diffrax.DirectAdjoint()`. Or use `jax.jacfwd`.",
        )
        orbit = search.run(system, y0, period)
    if throw and known(orbit) and not is_okay(orbit.result):
        last = f"t = {float(orbit.t0):.6g}, {written(orbit.y0)}, period {float(orbit.period):.6g}"
        why = search.failure(system, y0) if concrete and orbit.result == RESULTS.orbit_not_found else None
        cause = f" The solution from the guess fails: {why}" if why else ""
        raise SolveError(f"{RESULTS[orbit.result]} (The search ended at {last}.){cause}")
    return raise_if(~is_okay(orbit.result), orbit.result, orbit) if throw else orbit


def _check_method(
    method: Any, symmetry: Any, backward: bool, segments: Sequence[Segment] | None, pieces: Any, adjoint: Any
) -> None:
    """Checks what belongs to one of the two formulations only."""
    if method not in (None, "shooting", "segments"):
        raise ValueError(f"Argument `method` must be 'shooting' or 'segments', but got {method!r}.")
    in_segments = method == "segments" or segments is not None or pieces != 1
    if symmetry is not None and in_segments:
        raise ValueError("Argument `symmetry` is for `method='shooting'`, but segments are asked for.")
    if symmetry is not None and not callable(symmetry):
        raise ValueError(f"Argument `symmetry` must be a function or 'inversion', but got {symmetry!r}.")
    if backward and in_segments:
        raise ValueError("Argument `backward` is for `method='shooting'`, but segments are asked for.")
    if method == "shooting" and in_segments:
        raise ValueError("Arguments `segments` and `pieces` are for `method='segments'`, but it is 'shooting'.")
    if not isinstance(pieces, int) or not 1 <= pieces <= 64:
        raise ValueError(f"Argument `pieces` must be an integer from 1 to 64, but got {pieces!r}.")
    if not isinstance(adjoint, dfx.ForwardMode | dfx.DirectAdjoint):
        raise ValueError(
            "Argument `adjoint` must be `diffrax.ForwardMode()` or `diffrax.DirectAdjoint()`, but got "
            f"{type(adjoint).__name__}."
        )


def _check_period(system: System, t0: Scalar, y0: Y, period: Any, order: Any, concrete: bool) -> None:
    """Checks period and order, which mean one thing for forced systems and another for autonomous ones."""
    if order is not None and (not isinstance(order, int) or order < 1):
        raise ValueError(f"Argument `order` must be a positive integer or None, but got {order!r}.")
    if system.period is None:
        check_autonomous(system, t0, y0)
        if order not in (1, None):
            raise ValueError("Argument `order` must be 1 for an autonomous system; pass the longer `period` instead.")
        return
    check_clocks(system)
    if concrete:
        check_period(system, t0, y0)
    if period is not None:
        raise ValueError("Argument `period` must not be given for a forced system; use `order` for a subharmonic.")
    if order is None and not concrete:
        raise ValueError("Argument `order` must be given under `jit` and `vmap`: finding it out needs concrete values.")


def find_orbits(
    system: System,
    starts: StateT,
    *,
    period: Any = None,
    order: int = 1,
    devices: Devices | None = None,
    path: str | os.PathLike | None = None,
    progress_meter: ProgressMeter = QUIET,
    **options: Any,
) -> list[Orbit[StateT]]:
    """The different periodic orbits that `find_orbit` finds from many starting points, unstable ones included.

    **Arguments:**

    - `system`: the model.
    - `starts`: states to start from, leaves with a leading axis.
    - `period`: autonomous systems: one guess of the period for all, or one each [time]; by default each start is
        followed to where it settles, which finds what attracts and little else.
    - `order`, `options`: as for `find_orbit`.
    - `devices`: on which devices, see `sweep`.
    - `path`: a folder that keeps what was found, 256 starts at a time, and from which a search that was interrupted
        goes on; see `Sweep`.
    - `progress_meter`: `diffrax.TextProgressMeter()` writes to the standard error stream how many lanes are done, how
        many in a second, and how long the others will take; see `sweep`.

    **Returns:** the orbits, those to which most starts led first; an empty list if there are none. Subharmonics that
    differ by periods of the forcing only are one orbit.
    """
    for name in ("throw", "segments"):
        if name in options:
            raise ValueError(f"Argument `{name}` is not for `find_orbits`, but got {options[name]!r}.")
    count = len(jax.tree.leaves(starts)[0])
    guesses = None if period is None else jnp.broadcast_to(jnp.asarray(period), (count,))

    def one(start: tuple[Y, Any]) -> Orbit:
        return find_orbit(system, start[0], period=start[1], order=order, throw=False, **options)

    batch = sweep_in(path, one, (starts, guesses), devices=devices, progress_meter=progress_meter)
    arrays, static = eqx.partition(batch, eqx.is_array)
    good = np.flatnonzero(np.asarray(is_okay(batch.result)))
    return distinct_orbits([eqx.combine(jax.tree.map(lambda x, i=i: x[i], arrays), static) for i in good], order)


def distinct_orbits(orbits: Sequence[Orbit], order: int = 1) -> list[Orbit]:
    """Each once, those first that are there most often."""
    found: list[list[Any]] = []
    for orbit in orbits:
        known = next((entry for entry in found if _same(entry[1], entry[2], orbit)), None)
        if known is None:
            found.append([1, orbit, _points(orbit, order)])
        else:
            known[0] += 1
    return [orbit for _, orbit, _ in sorted(found, key=lambda entry: -entry[0])]


def _points(orbit: Orbit, order: int) -> tuple[np.ndarray, float]:
    """States of which one is the base point of every orbit that is the same: those a period of the forcing apart, or
    if there is none many along the way; and how far apart they lie."""
    if orbit.system.period is not None:
        ts = orbit.t0 + orbit.period * jnp.arange(order, dtype=orbit.t0.dtype) / order
        points = np.asarray(jax.vmap(ravel)(orbit.solve(saveat=dfx.SaveAt(ts=ts), throw=False).ys))
        return points, 1e-6 * (1 + np.abs(points).max())
    rows = np.asarray(jax.vmap(jax.vmap(ravel))(orbit.path().y))
    return rows.reshape(-1, rows.shape[-1]), np.linalg.norm(np.diff(rows, axis=1), axis=-1).max()


def _same(known: Orbit, along: tuple[np.ndarray, float], orbit: Orbit) -> bool:
    points, apart = along
    gap = np.linalg.norm(points - np.asarray(ravel(orbit.y0)), axis=1).min()
    return bool(abs(known.period - orbit.period) <= 1e-6 * abs(known.period) and gap <= apart)
