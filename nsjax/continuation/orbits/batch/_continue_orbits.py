"""Many branches of periodic orbits at once: a fixed number of points each, in one compiled call."""

import dataclasses
import os
from collections.abc import Sequence
from typing import Any, NamedTuple

import diffrax as dfx
import equinox as eqx
import jax
import jax.flatten_util as jfu
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Complex, Float, Int

from ...._numerics._compile import on_host
from ...._numerics._progress import ProgressMeter, QUIET
from ...._numerics._tables import frame
from ...._numerics._text import components, shown
from ...._types import Y
from ....flow._integrator import Integrator
from ....flow._results import is_okay
from ....orbits._find_orbit import find_orbit
from ....orbits._orbit import Orbit
from ....orbits.segments._equations import OrbitCurve
from ....orbits.segments._guard_minima import extremes
from ....orbits.segments._itinerary import capacity_for, OrbitItinerary, Start, starts_of
from ....sweeps._devices import Devices
from ....sweeps._long_sweep import sweep_in
from ....sweeps._sweep import sweep
from ....system._parameter import get_parameter, parameter_path, put_parameter
from ....system._system import arrays_of, System
from ..._branch import named_apart
from ..._checks import check_precision
from .._start import curve_and_start, order_of, phase_of
from .._test_functions import BRANCH, complex_pair, PASSED, Test
from ._lane import EACH, ENDED, follow_lane, Lane, lane_tests, LOST, NO_ORBIT


@shown
class OrbitBranches(eqx.Module):
    """Branches of periodic orbits over a parameter, a lane each, in rows of `points`; rows past the last of a lane are
    NaN.

    **Attributes:**

    - `systems`: the models, their leaves with a leading axis for lanes. `parameter`: the name of the one that varies.
    - `values`: of the parameter, shape `(lanes, points)`, along each branch, upwards at the start.
    - `periods`, `ts`, `ys`: periods [time], a time and the state of each orbit then, away from events.
    - `orders`: of each lane the periods over that of the forcing; ones if there is none.
    - `low`, `high`: of each component of the state along the orbit.
    - `multipliers`: shape `(lanes, points, n)`, largest modulus first. `stable`: whether the orbits are.
    - `kinds`: what each point is, as text: "" for an ordinary one, "fold", "flip", "Neimark-Sacker", "branch point";
        or, where the branch ends, "end of the interval", or what vanishes at the corner, as "grazing of wall".
    - `start`: at which point each lane set out.
    - `num`: how many points each lane has.
    - `ends`: why each branch begins and ends where it does, shape `(lanes, 2)`, as text: the end of the interval; a
        corner, which `continue_orbit` tells more about; "more than n points" (or orbits computed, where steps
        have to be short); "lost", where Newton's method failed; or "no orbit", where there was none to start from.
    """

    systems: System
    parameter: str
    values: Float[np.ndarray, "lanes points"]
    periods: Float[np.ndarray, "lanes points"]
    ts: Float[np.ndarray, "lanes points"]
    ys: Y
    orders: Int[np.ndarray, " lanes"]
    low: Y
    high: Y
    multipliers: Complex[np.ndarray, "lanes points n"]
    stable: Bool[np.ndarray, "lanes points"]
    kinds: np.ndarray
    start: np.ndarray
    num: np.ndarray
    ends: np.ndarray

    def to_dataframe(self) -> Any:
        """A row for each point of each lane: `lane`, `point`, the parameter by its name, `period`, `order`, `t`, the
        components of the state, `low` and `high`, `multiplier`, `stable`, and what the point is (`kind`).

        **Returns:** a `pandas.DataFrame`: `pip install nsjax[data]`.
        """
        rows = np.arange(self.values.shape[1]) < np.asarray(self.num)[:, None]
        lane, point = np.indices(self.values.shape)
        columns: dict[str, Any] = dict(lane=lane, point=point) | {self.parameter: self.values}
        columns |= dict(period=self.periods, order=np.broadcast_to(self.orders[:, None], rows.shape), t=self.ts)
        columns |= named_apart(components(self.ys, 2), self.parameter)
        for name in ("low", "high"):
            columns |= {f"{name}.{part}": x for part, x in components(getattr(self, name), 2).items()}
        columns |= dict(multiplier=self.multipliers, stable=self.stable, kind=self.kinds)
        return frame("OrbitBranches.to_dataframe", [(name, np.asarray(x)[rows]) for name, x in columns.items()])

    def __len__(self) -> int:
        return len(self.values)

    def system_at(self, lane: int, point: int) -> System:
        """The model at a point of a branch."""
        system = jax.tree.map(lambda x: jnp.asarray(x[lane]), self.systems)
        return put_parameter(system, parameter_path(system, self.parameter), jnp.asarray(self.values[lane, point]))

    def orbit(self, lane: int, point: int, **options: Any) -> Orbit:
        """The orbit at a point of a branch, to go on with: by `find_orbit`, whose `options` these are."""
        if not 0 <= point < self.num[lane]:
            raise IndexError(f"Lane {lane} has {self.num[lane]} points, but point {point} was asked for.")
        system = self.system_at(lane, point)
        period = dict(period=self.periods[lane, point]) if system.period is None else {}
        y0 = jax.tree.map(lambda x: jnp.asarray(x[lane, point]), self.ys)
        order, t0 = int(self.orders[lane]), self.ts[lane, point]
        return find_orbit(system, y0, t0=t0, order=order, **period, **options)

    def __str__(self) -> str:
        words, counts = np.unique(self.ends, return_counts=True)
        lines = [f"{len(self)} branches of periodic orbits of {type(self.systems).__name__}: {self.num.sum()} points"]
        lines += [f"  {count} ends: {word}" for word, count in zip(words, counts)]
        kinds, counts = np.unique(self.kinds[self.kinds != ""], return_counts=True)
        return "\n".join(lines + [f"  {count} times: {kind}" for kind, count in zip(kinds, counts)])


def continue_orbits(
    orbits: Orbit | Sequence[Orbit],
    parameter: str,
    interval: tuple[float, float],
    *,
    points: int = 200,
    scale: Y | None = None,
    max_step: float = 0.02,
    solver: dfx.AbstractSolver = dfx.Dopri8(),
    stepsize_controller: dfx.AbstractStepSizeController | None = None,
    rtol: float | None = None,
    atol: float | None = None,
    max_steps: int = 4096,
    chunk: int | None = None,
    devices: Devices | None = None,
    path: str | os.PathLike | None = None,
    progress_meter: ProgressMeter = QUIET,
) -> OrbitBranches:
    """Follows many periodic orbits at once while a parameter varies, each both ways to its first corner.

    ```python
    def search(x_c):
        start = nsjax.gallery.Motion(-0.1, -0.7)
        return nsjax.find_orbit(nsjax.gallery.Trilinear(omega=1.15, x_c=x_c), start, order=1, throw=False)

    orbits = nsjax.sweep(search, jnp.linspace(0.9, 1.1, 1000))
    branches = nsjax.continue_orbits(orbits, "omega", (1.1, 1.3))
    print(branches)
    plt.plot(branches.values.T, branches.high.x.T)
    ```

    The equations are those of `continue_orbit`, in one compiled loop for all lanes. Folds, flips and Neimark-Sacker
    points are located and passed through; at a corner, where the itinerary changes, a branch ends. What is there, and
    the branches that are born on the way, `continue_orbit` finds, from `branches.orbit(lane, point)`.

    **Arguments:**

    - `orbits`: an `Orbit` whose leaves have a leading axis for lanes, as `jax.vmap` or `sweep` of `find_orbit` returns
        it; or a list of orbits. Their systems, `orbits.system`, may differ in other parameters.
    - `parameter`, `interval`: the name of the parameter that varies, and its interval.
    - `points`: the largest number of points each way.
    - `scale`: the typical size of each component of the state; by default what it has along the first orbit.
    - `max_step`, `solver`, `stepsize_controller`, `rtol`, `atol`, `max_steps`: as for `continue_orbit`.
    - `chunk`, `devices`: how many lanes go together, and on which devices, see `sweep`.
    - `path`: a folder that keeps the branches, a chunk of lanes at a time, and from which a call that was interrupted
        goes on; see `Sweep`.
    - `progress_meter`: `diffrax.TextProgressMeter()` writes to the standard error stream how many lanes are done, how
        many in a second, and how long the others will take; see `sweep`.

    **Returns:** `OrbitBranches`. Lanes without an orbit to start from, or outside the interval, have no points.

    **Raises:** `ValueError` for an unknown parameter, in single precision, or if no lane has an orbit to start from.
    """
    integrator = Integrator(solver, stepsize_controller, max_steps).checked(
        jnp.float64, (1e-12, 1e-6), rtol=rtol, atol=atol
    )
    each = list(orbits) if isinstance(orbits, Sequence) else _unstacked(orbits)
    for one in each:
        check_precision(jnp.result_type(one.t0), "find `orbit`")
    own, (low, high) = parameter_path(each[0].system, parameter), interval
    values = [float(get_parameter(one.system, own)) for one in each]
    good = [bool(is_okay(one.result) & one.admissible) and low <= v <= high for one, v in zip(each, values)]
    if not any(good):
        raise ValueError("Argument `orbits` must hold an orbit that was found, within `interval`, but none is.")
    first = good.index(True)
    curve, _ = curve_and_start(each[first].system, each[first], parameter, interval, scale, integrator)
    own = [i for i, one in enumerate(good) if one]
    starts = dict(zip(own, starts_of(curve.model, [each[i] for i in own])))
    # One program for all: with the flows of modes that surfaces hold, if there are any.
    curve = dataclasses.replace(curve.fixed, slides=any(curve.on(start.itinerary).slides for start in starts.values()))
    capacity = capacity_for(max(int(start.itinerary.num) for start in starts.values()))
    rows = [_lane_of(curve, each[i], starts[i], capacity) for i in (j if good[j] else first for j in range(len(each)))]
    lanes = jax.tree.map(lambda *xs: np.stack(xs), *rows)
    twice = jax.tree.map(lambda x: np.concatenate([x, x]), (lanes, np.array(good)))
    upwards = np.repeat([1.0, -1.0], len(each))
    follow = _Follow(curve, jnp.asarray(max_step), points)
    found = on_host(
        sweep_in(path, follow, *twice, upwards, chunk=chunk, devices=devices, progress_meter=progress_meter)
    )
    return _gathered(curve, parameter, lanes, found)


def _unstacked(orbits: Orbit) -> list[Orbit]:
    whole, static = eqx.partition(on_host(orbits), eqx.is_array_like)
    return [eqx.combine(jax.tree.map(lambda x: x[i], whole), static) for i in range(len(whole.t0))]


class _Lane(NamedTuple):
    """What differs from lane to lane."""

    system: System
    order: Int[np.ndarray, ""]
    normal: Float[np.ndarray, " n"]
    reference: Float[np.ndarray, " n"]
    itinerary: OrbitItinerary
    u: Float[np.ndarray, " unknowns"]


def _lane_of(curve: OrbitCurve, orbit: Orbit, start: Start, capacity: int) -> _Lane:
    system = arrays_of(orbit.system, jnp.float64)
    own = dataclasses.replace(curve, model=curve.model.with_system(system))
    normal, reference = phase_of(own, start)
    start = start._replace(itinerary=start.itinerary.take(list(start.itinerary.rows), capacity))
    u = curve.pack(start, own.value)
    order, system = order_of(system, orbit), jax.tree.map(np.asarray, system)
    return _Lane(system, order, normal, reference, start.itinerary, u)


class _Follow(eqx.Module):
    """One lane."""

    curve: OrbitCurve
    max_step: Float[Array, ""]
    points: int = eqx.field(static=True)

    def __call__(self, lane: _Lane, good: Any, upwards: Any) -> Lane:
        curve = _curve_of(self.curve, lane)
        return follow_lane(curve, lane.itinerary, lane.u, good, upwards, self.max_step, self.points)


class _Extremes(eqx.Module):
    """One point of a lane."""

    curve: OrbitCurve

    def __call__(self, lane: _Lane, u: Any) -> tuple[Array, Array]:
        return extremes(_curve_of(self.curve, lane), lane.itinerary, u)


def _curve_of(curve: OrbitCurve, lane: _Lane) -> OrbitCurve:
    system = curve.model.with_system(lane.system)
    return dataclasses.replace(curve, model=system, order=lane.order, normal=lane.normal, reference=lane.reference)


def _gathered(curve: OrbitCurve, parameter: str, lanes: _Lane, found: Lane) -> OrbitBranches:
    """Both ways of each lane as one branch."""
    number = len(found.count) // 2
    ways = [_way(curve, lanes.itinerary, found, i) for i in range(2 * number)]
    places, kinds, ends, starts = [], [], [], []
    for i in range(number):
        (up, above, top), (down, below, bottom) = ways[i], ways[i + number]
        places.append([(i + number, j) for j in down[:0:-1]] + [(i, j) for j in up])
        kinds.append([*below[:0:-1], *above])
        ends.append((bottom, top))
        starts.append(max(0, len(down) - 1))
    width = max(map(len, places))
    lane, row = np.zeros((2, number, width), int)
    real = np.zeros((number, width), bool)
    words = np.full((number, width), "", f"<U{max(len(w) for row in kinds for w in ('-', *row))}")
    for i, (place, kind) in enumerate(zip(places, kinds)):
        n = len(place)
        real[i, :n], words[i, :n] = True, kind
        if n:
            lane[i, :n], row[i, :n] = np.array(place).T

    def taken(leaf: np.ndarray) -> np.ndarray:
        out = leaf[lane, row]
        return out if out.dtype == bool else np.where(real.reshape(real.shape + (1,) * (out.ndim - 2)), out, np.nan)

    rows = jax.tree.map(taken, found.rows)
    low, high = (np.full((*real.shape, len(curve.sizes)), np.nan) for _ in range(2))
    if real.any():
        each = jax.tree.map(lambda leaf: leaf[np.nonzero(real)[0]], lanes)
        low[real], high[real] = sweep(_Extremes(curve), each, rows.u[real])

    def as_states(x: np.ndarray) -> Any:
        return jax.tree.map(np.asarray, jax.vmap(jax.vmap(jfu.ravel_pytree(curve.like)[1]))(x))

    return OrbitBranches(
        systems=lanes.system,
        parameter=parameter,
        values=rows.parameter,
        periods=rows.period,
        ts=rows.t,
        ys=as_states(rows.x),
        orders=lanes.order,
        low=as_states(low),
        high=as_states(high),
        multipliers=rows.multipliers,
        stable=rows.stable & real,
        kinds=words,
        start=np.array(starts),
        num=real.sum(axis=1),
        ends=np.array(ends),
    )


def _way(curve: OrbitCurve, itineraries: OrbitItinerary, found: Lane, i: int) -> tuple[list[int], list[str], str]:
    """One way of a lane: its rows in their order, what each of them is, and why it ends."""
    doing = int(found.doing[i])
    if doing == NO_ORBIT:
        return [], [], "no orbit"
    arcs, kinds = found.arcs[i, : found.count[i]], found.kinds[i, : found.count[i]]
    order = [int(j) for j in np.argsort(arcs, kind="stable")]
    if doing == ENDED:
        order = [j for j in order if arcs[j] <= found.arc[i] + found.end[i]]
    itinerary = jax.tree.map(lambda x: x[i % len(itineraries.num)], itineraries)
    tests = lane_tests(len(itinerary.slot), len(curve.model.slots))
    words = [_word(curve, itinerary, tests[k]) if k >= 0 else "" for k in kinds[order]]
    for j, word in enumerate(words):
        rho = found.rows.multipliers[i, order[j]]
        # A product of multipliers is 1, as at a Neimark-Sacker point, but they are real.
        if word == "Neimark-Sacker" and not complex_pair(rho):
            words[j] = ""
        if word == "fold" and "branch point" in words[max(0, j - 1) : j + 2]:
            words[j] = ""
    if doing == ENDED:
        return order, words, _word(curve, itinerary, tests[found.last[i]])
    points = len(found.arcs[i])
    enough = f"more than {points} points" if len(arcs) == points else f"more than {EACH * points} orbits computed"
    return order, words, "lost" if doing == LOST else enough


def _word(curve: OrbitCurve, itinerary: OrbitItinerary, test: Test) -> str:
    if test.kind in ("low", "high"):
        return "end of the interval"
    if test == BRANCH:
        return "branch point"
    if test.kind in PASSED:
        return test.kind
    slot = test.slot if test.kind == "guard" else int(itinerary.slot[test.row])
    kind = {"rate": "tangency", "guard": "grazing"}.get(test.kind, test.kind)
    return f"{kind} of {curve.model.switches[curve.model.slots[slot].switch].name}"
