"""What is drawn: a solution cut into smooth arcs at its events."""

import dataclasses
import math
from collections.abc import Mapping
from typing import Any, NamedTuple

import diffrax as dfx
import equinox as eqx
import jax
import numpy as np
from jaxtyping import Float

from .._numerics._text import components
from .._types import Y
from ..flow._solution import Events, Solution
from ..orbits._orbit import Orbit
from ..orbits._passage import passage


DENSE = dfx.SaveAt(dense=True)
SAMPLES = 32  # points drawn for each step of dense output: its polynomial may turn by a radian or two

Values = dict[str, Float[np.ndarray, " times"]]


class Arc(NamedTuple):
    """A stretch of a solution between two events."""

    t: Float[np.ndarray, " times"]
    y: Values
    mode: tuple[int, ...]


def chosen(values: Mapping[str, Any], names: list[str | None]) -> list[str]:
    """The components asked for among `values`; `None` is the first one, second one and so on."""
    known = list(values)
    if len(known) < len(names):
        raise ValueError(f"The state must have at least {len(names)} components for this picture, but has: {known[0]}.")
    for name in names:
        if name is not None and name not in known:
            raise ValueError(f"There is no component {name!r} of the state; its components are: {', '.join(known)}.")
    return [known[i] if name is None else name for i, name in enumerate(names)]


def solved(of: Any) -> Solution:
    """A solution as it is, or one period of an orbit."""
    if isinstance(of, Solution):
        sol = of
    else:
        sol = of.solve(saveat=DENSE) if not isinstance(of, Orbit) else once_round(of)
    if np.ndim(sol.t1):
        raise ValueError("Argument `sol` must be one solution, but it is a batch of them (from `jax.vmap`).")
    # Taking rows out of NumPy's arrays compiles nothing.
    return eqx.tree_at(lambda sol: sol.events, sol, jax.tree.map(np.asarray, sol.events))


def once_round(orbit: Orbit) -> Solution:
    """One period of an orbit, or its arcs where its solution leaves it."""
    one = np.ndim(orbit.period) == 0
    sol = passage(orbit, orbit.t0, orbit.y0, orbit.mode) if one else None
    sol = orbit.solve(saveat=DENSE, throw=False) if sol is None else sol
    return sol if _returns(orbit, sol) else _arc_by_arc(orbit, sol)


def _returns(orbit: Orbit, sol: Solution) -> bool:
    if np.ndim(sol.t1):
        return True
    gap = jax.tree.map(lambda a, b: np.max(np.abs(np.asarray(a) - np.asarray(b)), initial=0.0), sol.y1, orbit.y0)
    size = jax.tree.map(lambda a: 1 + np.max(np.abs(np.asarray(a)), initial=0.0), orbit.y0)
    return all(a <= 1e-3 * b for a, b in zip(jax.tree.leaves(gap), jax.tree.leaves(size)))


def _arc_by_arc(orbit: Orbit, sol: Solution) -> Solution:
    """An orbit that its solution `sol` leaves, where a surface repels or the orbit is violently unstable: along its own
    arcs."""
    path = orbit.path(SAMPLES * 4)
    rows = np.flatnonzero(np.asarray(path.t[:, -1] != path.t[:, 0]))
    order = rows[np.argsort(np.asarray(path.t[rows, 0]))]
    ts, ys = jax.tree.map(lambda leaf: leaf[order].reshape(-1, *leaf.shape[2:]), (path.t, path.y))
    return dataclasses.replace(
        sol, t1=orbit.t0 + orbit.period, y1=orbit.y0, mode1=orbit.mode, ts=ts, ys=ys, events=orbit.events, dense=None
    )


def arcs(sol: Solution) -> list[Arc]:
    """The solution cut at its events, in the direction of integration. Arcs without duration are left out."""
    modes = mode_sequence(sol.events, sol.mode1)
    pieces = _from_dense(sol) if sol.dense is not None else _from_saved(sol)
    return [Arc(t, components(y, ndim=1), modes[i]) for i, t, y in pieces]


def mode_sequence(events: Events, mode1: Any) -> list[tuple[int, ...]]:
    """The mode before the first event, and after each: one more than there are events."""
    n = len(events)
    first = events.mode_before[0] if n else mode1
    return [tuple(map(int, mode)) for mode in [first, *events.mode_after[:n]]]


def _from_dense(sol: Solution) -> list[tuple[int, np.ndarray, Y]]:
    starts, stops, points, direction, steps = jax.tree.map(np.asarray, sol.dense)
    kept = np.flatnonzero(stops[:steps] > starts[:steps])
    starts, stops = starts[kept], stops[kept]
    which = np.searchsorted(_times(sol) * direction, (starts + stops) / 2)  # the arc of each step
    u = np.linspace(0, 1, SAMPLES)
    t = (starts[:, None] + (stops - starts)[:, None] * u) * direction

    def sample(control: np.ndarray) -> np.ndarray:
        n = control.shape[1] - 1  # control points of the Bernstein basis
        basis = np.stack([math.comb(n, k) * u**k * (1 - u) ** (n - k) for k in range(n + 1)], axis=-1)
        return np.einsum("uk,sk...->su...", basis, control[kept])

    y = jax.tree.map(sample, points)

    def joined(x: np.ndarray, i: int) -> np.ndarray:
        return x[which == i].reshape(-1, *x.shape[2:])

    return [(int(i), joined(t, i), jax.tree.map(lambda x, i=i: joined(x, i), y)) for i in np.unique(which)]


def _from_saved(sol: Solution) -> list[tuple[int, np.ndarray, Y]]:
    saved = np.isfinite(np.asarray(sol.ts)) if sol.ts is not None else np.zeros(0, bool)
    if saved.sum() < 2 or jax.tree.structure(sol.ys) != jax.tree.structure(sol.y1):
        raise ValueError(
            "Argument `sol` must hold the states along the way, but does not: call `solve` with "
            "`saveat=SaveAt(dense=True)` (or `steps=True`, or `ts=...`)."
        )
    events, direction = sol.events, 1 if sol.t1 >= sol.t0 else -1
    log = jax.tree.map(np.asarray, (events.t, events.y_before)), jax.tree.map(np.asarray, (events.t, events.y_after))
    end = jax.tree.map(lambda x: np.asarray(x)[None], (sol.t1, sol.y1))
    rows = jax.tree.map(lambda x: np.asarray(x)[saved], (sol.ts, sol.ys))
    cuts = np.array([-np.inf, *(_times(sol) * direction), np.inf])
    pieces = []
    for i in range(len(cuts) - 1):
        inside = (cuts[i] < rows[0] * direction) & (rows[0] * direction < cuts[i + 1])
        batches = [jax.tree.map(lambda x, inside=inside: x[inside], rows)]
        if i > 0:  # events are not among the saved times, but the log has the states on both sides
            batches.insert(0, jax.tree.map(lambda x, i=i: x[i - 1 : i], log[1]))
        batches.append(jax.tree.map(lambda x, i=i: x[i : i + 1], log[0]) if i < len(events) else end)
        t, y = jax.tree.map(lambda *x: np.concatenate(x), *batches)
        if t[-1] != t[0]:
            pieces.append((i, t, y))
    return pieces


def _times(sol: Solution) -> np.ndarray:
    return np.asarray(sol.events.t[: len(sol.events)])
