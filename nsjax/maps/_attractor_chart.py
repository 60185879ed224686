"""Charts of attractors over two parameters: their periods, what happens in each, and where there is chaos."""

import os
from collections.abc import Mapping
from typing import Any

import diffrax as dfx
import equinox as eqx
import jax
import jax.flatten_util as jfu
import jax.numpy as jnp
import numpy as np
from jaxtyping import Bool, Float, Int

from .._numerics._progress import Counting, ProgressMeter, QUIET
from .._numerics._tables import frame
from .._numerics._text import between, components, counted, positive, shown
from .._types import Y
from ..flow._arguments import checked_start
from ..flow._integrator import Integrator
from ..flow._results import result_names
from ..sweeps._devices import Devices, devices_of
from ..sweeps._lanes import default_chunk, even_chunks
from ..system._parameter import parameter_path
from ..system._system import arrays_of, System
from ._map_of import map_of
from ._pursuit import Pursuit, Window
from ._section import Section


TWO_PROGRAMS = 2048  # solutions, from which on the exact flow gains more than it takes to compile


@shown
class AttractorChart(eqx.Module):
    """What solutions settle on, over two parameters.

    **Attributes:**

    - `parameters`: their names.
    - `values`: the values of each, of shapes `(first,)` and `(second,)`.
    - `periods`: after how many iterates of the map the attractor repeats itself, shape `(first, second)`; 0 where none
        was found that does, -1 where the solution failed.
    - `classes`: the number of its itinerary in `itineraries`; -1 where there is no period, or more than 128 events.
    - `itineraries`: in words, the most frequent first: the events of one time around, whichever comes first.
    - `chaotic`: whether the largest Lyapunov exponent is positive by more than three of its standard errors.
    - `exponents`: the largest Lyapunov exponents λ₁ [1/time]: of those that settled over the last iterates that were
        made, of the others over the second half of all. -inf where sticking, or an impact into rest, forgets
        everything. NaN where the solution failed.
    - `errors`: their standard errors [1/time], where nothing has settled; NaN elsewhere.
    - `iterates`: how many were made.
    - `ys`: the states at the end, leaves with these two leading axes.
    - `result`: `RESULTS` of each, as integers.
    """

    parameters: tuple[str, str] = eqx.field(static=True)
    values: tuple[Float[np.ndarray, " first"], Float[np.ndarray, " second"]]
    periods: Int[np.ndarray, "first second"]
    classes: Int[np.ndarray, "first second"]
    itineraries: tuple[str, ...] = eqx.field(static=True)
    chaotic: Bool[np.ndarray, "first second"]
    exponents: Float[np.ndarray, "first second"]
    errors: Float[np.ndarray, "first second"]
    iterates: Int[np.ndarray, "first second"]
    ys: Y
    result: Int[np.ndarray, "first second"]

    def to_dataframe(self) -> Any:
        """A row for each solution: the two parameters by their names, what it settled on as a word (`attractor`), the
        `period`, the `itinerary` in words, `exponent`, `error`, `iterates`, and the components of the state at the end.

        **Returns:** a `pandas.DataFrame`: `pip install nsjax[data]`.
        """
        words = np.array([*self.itineraries, ""], dtype=object)  # -1 is the last
        columns = dict(zip(self.parameters, np.meshgrid(*self.values, indexing="ij")))
        columns |= dict(attractor=self.kinds(), period=self.periods, itinerary=words[self.classes])
        columns |= dict(exponent=self.exponents, error=self.errors, iterates=self.iterates)
        rows = [*columns.items(), *components(self.ys, 2).items()]
        return frame("AttractorChart.to_dataframe", [(name, np.ravel(x)) for name, x in rows])

    @property
    def failed(self) -> Bool[np.ndarray, "first second"]:
        """Where the solution failed; `result` says why."""
        return self.periods < 0

    @property
    def undecided(self) -> Bool[np.ndarray, "first second"]:
        """Where nothing is known: it has not settled, and is not clearly chaotic."""
        return (self.periods == 0) & ~self.chaotic

    def kinds(self) -> np.ndarray:
        """In words, of each: `period 2`, `chaos`, `undecided`, or the name of its result."""
        rest = np.where(self.chaotic, "chaos", np.where(self.failed, "", "undecided")).astype(object)
        rest[self.failed] = result_names(self.result[self.failed])
        return np.where(self.periods > 0, [[f"period {p}" for p in row] for row in self.periods], rest)

    def __str__(self) -> str:
        over = ", ".join(f"{name} = {between(x)}" for name, x in zip(self.parameters, self.values))
        most = [f"{n} ({np.mean(self.classes == k):.1%})" for k, n in enumerate(self.itineraries[:3])]
        more = [f"{len(self.itineraries) - 3} more"] * (len(self.itineraries) > 3)
        return (
            f"attractor chart over {over}: {' x '.join(map(str, self.periods.shape))} solutions\n"
            f"  attractors   {counted(self.kinds().ravel())}\n"
            f"  itineraries  {'; '.join(most + more) or 'none'}\n"
            f"  iterates     {between(self.iterates)}"
        )


def attractor_chart(
    system: System,
    parameters: Mapping[str, Any],
    start: Y,
    *,
    tol: float = 1e-5,
    max_iterates: int = 1024,
    max_period: int = 16,
    section: Section | None = None,
    direction: int = 1,
    max_time: Any = None,
    interval: Any = None,
    t0: Any = 0.0,
    solver: dfx.AbstractSolver | None = None,
    stepsize_controller: dfx.AbstractStepSizeController | None = None,
    rtol: float | None = None,
    atol: float | None = None,
    max_steps: int = 4096,
    max_events: int = 256,
    chunk: int | None = None,
    devices: Devices | None = None,
    path: str | os.PathLike | None = None,
    progress_meter: ProgressMeter = QUIET,
) -> AttractorChart:
    """On what solutions settle, over two parameters: the period of the attractor, its itinerary, or chaos.

    ```python
    over = {"omega": jnp.linspace(1.5, 1.9, 100), "v_dr": jnp.linspace(0.5, 1.5, 80)}
    found = nsjax.attractor_chart(system, over, State(1.0, 0.0))
    nsjax.plot.attractor_chart(found)
    ```

    Each solution is followed by itself, `4 * max_period` iterates at a time, until it is known to have settled: it
    comes nearer to what repeats itself by the same factor each time, what is left of its way is less than a twentieth
    of `tol`, and small perturbations do not grow. Only those that have not are followed further. After `max_iterates`
    they are chaotic if the largest Lyapunov exponent of the second half is positive by more than three of its standard
    errors, and undecided otherwise, as quasi-periodic ones and those of a longer period are. Chaos that ends later than
    `max_iterates` is not told from chaos that does not.

    **Arguments:**

    - `system`: the model.
    - `parameters`: the names of two fields (that of an effect or of a wrapped system as `"belt.v"`), with the values of
        each, vectors [unit of the parameter].
    - `start`: the state at `t0` from which all solutions set out.
    - `tol`: points of an attractor that are nearer to each other than this, in each component of the state, are one.
    - `max_iterates`: after how many iterates to give up; it is rounded up to a multiple of `4 * max_period` (of an
        odd `max_period`, of 4 more).
    - `max_period`: the longest period that is looked for, in iterates.
    - `section`, `direction`, `max_time`: as for `poincare_map`; by default an iterate is a period of the forcing.
    - `interval`: instead of these, for an autonomous system whose solutions come to rest: how often to look [time].
    - `t0`: the phase of the forcing [time].
    - `solver`, `stepsize_controller`, `rtol`, `atol`: as for `solve`; by default Dopri8, and `Affine` for what that can
        do, if there are 2,048 solutions or more. `max_steps`, `max_events`: for each iterate.
    - `chunk`, `devices`: how many solutions go together, and on which devices, see `sweep`.
    - `path`: a folder that keeps what is done, a chunk at a time, and from which a call that was interrupted goes on,
        with a larger `max_iterates` too. See `Sweep`.
    - `progress_meter`: `diffrax.TextProgressMeter()` writes to the standard error stream how many solutions are done,
        how many in a second, and how long the others will take; see `sweep`.

    **Returns:** an `AttractorChart`.

    **Raises:** `TypeError`, `ValueError` for mistakes in the arguments.
    """
    for name, number in (("max_iterates", max_iterates), ("max_period", max_period)):
        positive(name, number)
    if not isinstance(parameters, Mapping) or len(parameters) != 2:
        raise ValueError(
            "Argument `parameters` must be a dictionary of two names and their values, such as "
            f'`{{"omega": omega, "v_dr": v_dr}}`, but got {_brief(parameters)}.'
        )
    names = tuple(parameters)
    paths = tuple(parameter_path(system, name) for name in names)
    if paths[0] == paths[1]:
        raise ValueError(f"Argument `parameters` must name two parameters, but {names[0]!r} and {names[1]!r} are one.")
    t0, start, _ = checked_start(system, t0, start, None)
    integrator = Integrator(solver, stepsize_controller, max_steps, max_events).checked(
        t0.dtype, rtol=rtol, atol=atol, default=dfx.Dopri8()
    )
    system = arrays_of(system, t0.dtype)
    values = [np.asarray(parameters[name], t0.dtype) for name in names]
    for name, value in zip(names, values):
        if value.ndim != 1 or not len(value):
            text = f"Argument `parameters` must hold vectors, but the shape of `{name}` is {value.shape}."
            raise ValueError(text)
    shape = len(values[0]), len(values[1])
    if shape[0] * shape[1] < TWO_PROGRAMS:
        integrator = integrator._replace(open=False)
    step = map_of(system, section, (direction, max_time), interval, (t0, start), integrator)
    if chunk is None:
        chunk = default_chunk(min(shape[0] * shape[1], 65536), devices_of(devices)[0].platform)
    positive("chunk", chunk)
    _, chunk = even_chunks(shape[0] * shape[1], chunk)
    ahead = 8 * -(-max_period // 2)  # in eight parts of one length, by which exponents have their errors
    window = Window(system, paths, step, t0, start, ahead, jnp.asarray(tol, t0.dtype))
    pairs = np.stack([a.ravel() for a in np.meshgrid(*values, indexing="ij")], axis=-1)
    with Counting(progress_meter, len(pairs), "solutions") as counting:
        found = Pursuit(window, pairs, chunk, devices, path, counting).followed(-(-max_iterates // window.iterates))
    grid = jax.tree.map(lambda a: a.reshape(*shape, *a.shape[1:]), found.lanes)
    ys = jax.vmap(jax.vmap(jfu.ravel_pytree(start)[1]))(grid.x)
    return AttractorChart(
        names, (values[0], values[1]), grid.periods, grid.classes, found.itineraries, grid.chaotic, grid.exponents,
        grid.errors, grid.iterates, jax.tree.map(np.asarray, ys), grid.result,
    )  # fmt: skip


def _brief(given: Any) -> str:
    return f"the names {', '.join(map(repr, given))}" if isinstance(given, Mapping) else type(given).__name__
