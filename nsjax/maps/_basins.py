"""Basins of attraction: to which attractor each start leads, decided only where it has come near one."""

import dataclasses
import functools as ft
from collections.abc import Sequence
from typing import Any

import diffrax as dfx
import equinox as eqx
import jax
import jax.flatten_util as jfu
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int

from .._numerics._progress import Counting, ProgressMeter, QUIET
from .._numerics._tables import frame
from .._numerics._text import components, positive, shown
from .._types import Scalar, Y
from ..flow._arguments import checked_start
from ..flow._integrator import Integrator
from ..flow._results import is_okay, result_names, RESULTS
from ..orbits._orbit import Orbit
from ..sweeps._lanes import CHUNK
from ..system._system import arrays_of, System
from ._iterate import Iterate, PoincareMap, Start
from ._map_of import map_of
from ._section import Section
from ._settled import settled


UNDECIDED, FAILED = -1, -2
FEW = 32  # starts, for which a batch is not that of a sweep


@shown
class Basins(eqx.Module):
    """Which attractor each start leads to.

    **Attributes:**

    - `labels`: the number of the attractor, -1 where none was reached within `max_iterates`, -2 where the solution
        failed; of the shape of the leaves of `starts`.
    - `attractors`: of each its points in their order, states with a leading axis: one point for each period of the
        forcing after which it repeats itself, or for each crossing of the section.
    - `iterates`: after how many of these each start was decided; 0 where it was filled in between neighbours.
    - `starts`: the states, refined ones included.
    - `result`: `RESULTS` of each, as integers.
    """

    labels: Int[np.ndarray, "..."]
    attractors: tuple[Y, ...]
    iterates: Int[np.ndarray, "..."]
    starts: Y
    result: Int[np.ndarray, "..."]

    def to_dataframe(self) -> Any:
        """A row for each start: the components of its state, the number of its attractor (`attractor`), `iterates`, and
        the name of its `result`.

        **Returns:** a `pandas.DataFrame`: `pip install nsjax[data]`.
        """
        results = np.ravel(result_names(self.result))
        columns = {name: np.ravel(x) for name, x in components(self.starts, np.ndim(self.labels)).items()}
        told = dict(attractor=np.ravel(self.labels), iterates=np.ravel(self.iterates), result=results)
        return frame("Basins.to_dataframe", [*columns.items(), *told.items()])

    def fractions(self) -> Float[np.ndarray, " attractors"]:
        """The part of the starts that leads to each attractor."""
        return np.array([np.mean(self.labels == k) for k in range(len(self.attractors))])

    def __str__(self) -> str:
        orders = [len(jax.tree.leaves(points)[0]) for points in self.attractors]
        lines = [f"basins of {len(orders)} attractors, {self.labels.size} starts"]
        for k, (order, part) in enumerate(zip(orders, self.fractions())):
            first = jax.tree.map(lambda x: x[0], self.attractors[k])
            at = ", ".join(f"{x:.6g}" for x in np.atleast_1d(jfu.ravel_pytree(first)[0]))
            lines.append(f"  {k}: {part:.2%}, {order} point{'s' * (order > 1)}, the first ({at})")
        rest = {"undecided": np.mean(self.labels == UNDECIDED), "failed": np.mean(self.labels == FAILED)}
        return "\n".join(lines + [f"  {word}: {part:.2%}" for word, part in rest.items() if part])


class _Lanes(eqx.Module):
    """The map, for many solutions at once: one program for their start, and one for the iterates that follow."""

    step: PoincareMap
    system: System
    t0: Scalar
    like: Y
    ahead: int = eqx.field(static=True)

    @eqx.filter_jit
    def begin(self, x: Float[Array, "lanes n"]) -> tuple:
        return jax.vmap(lambda x: self._start(x)[1:5])(x)

    def _start(self, x: Array) -> Start:
        return self.step.start(self.system, self.t0, jfu.ravel_pytree(self.like)[1](x), {})

    @eqx.filter_jit
    def go_on(self, here: tuple) -> tuple[tuple, Float[Array, "lanes ahead n"]]:
        """`ahead` iterates later, with these."""

        def lane(t: Scalar, y: Y, mode: Array, result: RESULTS) -> tuple[tuple, Array]:
            named = self.step.named(self.system, t, y)
            rows: Iterate = self.step.iterates(self.system, Start(self.t0, t, y, mode, result, named), self.ahead)
            last = jax.tree.map(lambda x: x[-1], (rows.t, rows.y, rows.mode, rows.result))
            return last, jax.vmap(lambda y: jfu.ravel_pytree(y)[0])(rows.y)

        return jax.vmap(lane)(*here)


@dataclasses.dataclass
class _Search:
    """Attractors that are known, and the solutions that are on their way."""

    lanes: _Lanes
    tol: float
    most: int  # iterates
    size: int  # of a batch: another would be another program
    finds: bool  # whether attractors are added
    progress_meter: ProgressMeter = QUIET
    known: list[np.ndarray] = dataclasses.field(default_factory=list)

    def follow(self, x: np.ndarray, what: str = "starts") -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Labels, iterates and results of starts of shape `(lanes, n)`; `what` they are called."""
        with Counting(self.progress_meter, len(x), what) as counting:
            return self._followed(x, counting)

    def _followed(self, x: np.ndarray, counting: Counting) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        labels, counts = np.full(len(x), UNDECIDED), np.zeros(len(x), int)
        results = np.zeros(len(x), int)
        parts = []  # solutions on their way, in batches of one size
        for i in range(0, len(x), self.size):
            rows = np.arange(i, min(i + self.size, len(x)))
            batch = _padded(x[rows], self.size)
            parts.append((rows, self.lanes.begin(jnp.asarray(batch)), None))
        for done in range(self.lanes.ahead, self.most + self.lanes.ahead, self.lanes.ahead):
            later = []
            for rows, here, before in parts:
                here, points = self.lanes.go_on(here)
                points, failed = np.asarray(points), ~np.asarray(is_okay(here[3]))
                seen = points if before is None else np.concatenate([before, points], axis=1)[:, -self.memory :]
                for lane, row in enumerate(rows):
                    if failed[lane]:
                        labels[row], results[row] = FAILED, int(here[3]._value[lane])
                    else:
                        labels[row] = self._label(seen[lane])
                    counts[row] = done
                counting.at(int(np.sum(labels != UNDECIDED)))
                going = labels[rows] == UNDECIDED
                if going.any():
                    later.append((rows[going], *_taken((here, seen), np.flatnonzero(going))))
            parts = self._joined(later)
            if not parts:
                break
        return labels, counts, results

    def _joined(self, parts: list[tuple]) -> list[tuple]:
        """Fewer batches, and full ones."""
        if not parts:
            return []
        rows = np.concatenate([part[0] for part in parts])
        lanes = jax.tree.map(lambda *a: np.concatenate(a), *[part[1:] for part in parts])
        out = []
        for i in range(0, len(rows), self.size):
            some = slice(i, i + self.size)
            here, seen = _padded(jax.tree.map(lambda a: a[some], lanes), self.size)
            out.append((rows[some], jax.tree.map(jnp.asarray, here), seen))
        return out

    @property
    def memory(self) -> int:
        """How many iterates of a solution are looked at together."""
        return 4 * self.lanes.ahead

    def _label(self, points: np.ndarray) -> int:
        """The attractor whose points a solution has followed, once around, within `tol`."""
        for k, cycle in enumerate(self.known):
            order = len(cycle)
            if len(points) < order:
                continue
            end = points[-order:]
            shifts = (np.abs(end - np.roll(cycle, shift, axis=0)).max() for shift in range(order))
            if min(shifts) <= self.tol:
                return k
        order = int(settled(points, self.tol)) if self.finds and len(points) >= self.memory else 0
        if not order:
            return UNDECIDED
        self.known.append(points[-order:])
        return len(self.known) - 1

    def add(self, x: np.ndarray) -> None:
        """The attractors to which states lead, in this order."""
        finding = dataclasses.replace(self, finds=True, progress_meter=QUIET)  # of the same list
        for k, row in enumerate(x):
            label = finding.follow(row[None])[0][0]
            if label < 0:
                raise ValueError(
                    f"Argument `attractors`: the solution from attractor {k}, ({', '.join(f'{v:.6g}' for v in row)}), "
                    f"does not settle on a periodic orbit within {self.most} iterates."
                )
            if label < k:
                raise ValueError(f"Argument `attractors`: attractors {label} and {k} are the same within `tol`.")


def _padded(x: Any, size: int) -> Any:
    """Filled up with the last lane: batches of one size are one program."""
    return jax.tree.map(lambda a: np.concatenate([a, np.repeat(np.asarray(a)[-1:], size - len(a), axis=0)]), x)


def _taken(tree: Any, lanes: np.ndarray) -> Any:
    return jax.tree.map(lambda a: np.asarray(a)[lanes], tree)


def basins(
    system: System,
    starts: Y,
    attractors: Sequence[Orbit | Y] | None = None,
    *,
    tol: float = 1e-3,
    max_iterates: int = 1000,
    refine: int = 0,
    section: Section | None = None,
    direction: int = 1,
    max_time: Any = None,
    interval: Any = None,
    t0: Any = 0.0,
    solver: dfx.AbstractSolver = dfx.Dopri8(),
    stepsize_controller: dfx.AbstractStepSizeController | None = None,
    rtol: float | None = None,
    atol: float | None = None,
    max_steps: int = 4096,
    max_events: int = 256,
    progress_meter: ProgressMeter = QUIET,
) -> Basins:
    """To which attractor each of many starts leads.

    ```python
    x, v = jnp.meshgrid(jnp.linspace(-2, 2, 100), jnp.linspace(-2, 2, 100))
    found = nsjax.basins(system, State(x, v), refine=2)
    nsjax.plot.basins(found, "x", "v")
    ```

    A start is decided when its solution has kept within `tol` of all points of an attractor, once around. What has not
    is followed further, and stays undecided after `max_iterates`; it is never given to the nearest one. Chaos stays
    undecided, and so does what repeats itself after more than 8 iterates. A start exactly on the way into an unstable
    orbit makes that an attractor.

    **Arguments:**

    - `system`: the model.
    - `starts`: states at `t0`, leaves of one shape: a list of them, or a grid.
    - `attractors`: `Orbit`s, or states on or near attractors; by default those that the starts settle on.
    - `tol`: how near is near, in each component of the state. Attractors nearer to each other than this are one.
    - `max_iterates`: after how many periods (or crossings) to give up; eight are made at a time.
    - `refine`: of a grid with two axes: how many times it is made twice as fine where neighbours differ. Points whose
        neighbours are all alike are filled in.
    - `section`, `direction`, `max_time`: as for `poincare_map`, for an autonomous system with periodic orbits; a forced
        one is looked at once in each period, at the phase of `t0` [time].
    - `interval`: instead of these, for an autonomous system whose solutions come to rest: how often to look [time].
    - `solver`, `stepsize_controller`, `rtol`, `atol`: as for `solve`. `max_steps`, `max_events`: for each iterate.
    - `progress_meter`: `diffrax.TextProgressMeter()` writes to the standard error stream how many starts are decided,
        how many in a second, and how long the others will take; a function is called with that.

    **Returns:** `Basins`.

    **Raises:** `ValueError` for mistakes in the arguments, and for `attractors` from which a solution does not settle.
    """
    positive("max_iterates", max_iterates)
    positive("refine", refine + 1 if isinstance(refine, int) else refine)
    shapes = {jnp.shape(leaf) for leaf in jax.tree.leaves(starts)}
    if len(shapes) != 1 or () in shapes:
        raise ValueError(f"Argument `starts` must hold leaves of one shape, but they have {sorted(shapes)}.")
    (shape,) = shapes
    if refine and len(shape) != 2:
        raise ValueError(f"Argument `refine` is for grids with two axes, but `starts` have {len(shape)}.")
    t0, like, _ = checked_start(system, t0, jax.tree.map(lambda x: jnp.ravel(x)[0], starts), None)
    integrator = Integrator(solver, stepsize_controller, max_steps, max_events).checked(t0.dtype, rtol=rtol, atol=atol)
    system = arrays_of(system, t0.dtype)
    step = map_of(system, section, (direction, max_time), interval, (t0, like), integrator)
    lanes = _Lanes(step, system, t0, like, min(8, max_iterates))
    size = FEW if np.prod(shape) <= FEW else CHUNK
    search = _Search(lanes, float(tol), max_iterates, size, attractors is None, progress_meter)
    if attractors is not None:
        given = [_state_of(k, a, system, t0) for k, a in enumerate(attractors)]
        search.add(np.stack([np.asarray(jfu.ravel_pytree(y)[0], t0.dtype) for y in given]))
    x = np.stack([np.asarray(leaf, t0.dtype) for leaf in jax.tree.leaves(starts)], axis=-1)
    found = [a.reshape(shape) for a in search.follow(x.reshape(-1, x.shape[-1]))]
    for _ in range(refine):
        x, *found = _finer(search, x, *found)
    back = ft.partial(jax.tree.unflatten, jax.tree.structure(starts))

    def states(x: np.ndarray) -> Y:
        return back(list(np.moveaxis(x, -1, 0)))

    labels, counts, results = found
    return Basins(labels, tuple(map(states, search.known)), counts, states(x), results)


def _state_of(k: int, attractor: Orbit | Y, system: System, t0: Scalar) -> Y:
    """A state on it, at the phase of `t0`."""
    if not isinstance(attractor, Orbit):
        return attractor
    if not attractor.stable:
        raise ValueError(f"Argument `attractors`: attractor {k} is an orbit that is not stable.")
    if system.period is not None:
        turns = float((attractor.t0 - t0) / system.period)
        if abs(turns - round(turns)) > 1e-9:
            raise ValueError(
                f"Argument `attractors`: orbit {k} begins at t = {float(attractor.t0):.6g}, another phase of the "
                f"forcing than `t0` = {float(t0):.6g}."
            )
    return attractor.y0


def _finer(search: _Search, x: np.ndarray, *found: np.ndarray) -> tuple[np.ndarray, ...]:
    """A grid twice as fine. Points beside one with another label are followed, those that were filled in before too,
    until there are none left: so a basin that is thinner than the grid is followed along its length."""
    rows, columns = (2 * n - 1 for n in x.shape[:2])
    fine = np.zeros((rows, columns, x.shape[2]), x.dtype)
    fine[::2, ::2] = x
    fine[1::2, ::2] = (x[:-1] + x[1:]) / 2
    fine[:, 1::2] = (fine[:, :-1:2] + fine[:, 2::2]) / 2
    # Filled in as one of the neighbours; nothing but 0 is known of the iterates and the result there.
    label = np.repeat(np.repeat(found[0], 2, axis=0), 2, axis=1)[:rows, :columns]
    new = [label, *(np.zeros((rows, columns), a.dtype) for a in found[1:])]
    for a, old in zip(new, found):
        a[::2, ::2] = old
    while (ask := (new[1] == 0) & _beside_another(label)).any():
        for a, value in zip(new, search.follow(fine[ask], "points of the finer grid")):
            a[ask] = value
    return fine, *new


def _beside_another(label: np.ndarray) -> np.ndarray:
    """Which points have one of another label among their eight neighbours."""
    rows, columns = label.shape
    around = np.pad(label, 1, mode="edge")
    shifted = (around[i : i + rows, j : j + columns] for i in range(3) for j in range(3))
    return np.any([part != label for part in shifted], axis=0)
