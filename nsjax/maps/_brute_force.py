"""Brute-force bifurcation diagrams: where solutions settle, for many values of a parameter."""

import os
from typing import Any

import diffrax as dfx
import equinox as eqx
import jax
import jax.lax as lax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from .._numerics._progress import ProgressMeter, QUIET
from .._numerics._select import select
from .._numerics._tables import frame
from .._numerics._text import between, components, positive, shown, written
from .._types import Scalar, Y
from ..flow._arguments import checked_start
from ..flow._integrator import Integrator
from ..flow._results import outcomes, result_names, RESULTS
from ..orbits._orbit import ravel
from ..sweeps._devices import Devices
from ..sweeps._long_sweep import sweep_in
from ..system._parameter import parameter_path, put_parameter
from ..system._system import arrays_of, System
from ._iterate import Iterate, PoincareMap
from ._section import Section, section_map
from ._stroboscopic import phase_map


@shown
class BruteForce(eqx.Module):
    """A brute-force bifurcation diagram: points of solutions on a section, after a transient.

    **Attributes:**

    - `parameter`: its name.
    - `values`: its values, shape `(values,)`.
    - `ts`: times of the points [time], shape `(values, starts, keep)`.
    - `ys`: the points, states whose leaves have these three leading axes; NaN from where a solution fails.
    - `result`: `RESULTS`, shape `(values, starts)`.
    """

    parameter: str = eqx.field(static=True)
    values: Float[Array, " values"]
    ts: Float[Array, "values starts keep"]
    ys: Y
    result: RESULTS

    def __str__(self) -> str:
        *many, values, starts, keep = self.ts.shape
        head = f"{np.prod(many)} brute-force diagrams" if many else "brute-force diagram"
        return (
            f"{head} over {self.parameter} = {between(self.values)}\n"
            f"  values {values}, starts {starts}, points kept of each {keep}\n"
            f"  points  {written(self.ys, self.ts.ndim)}\n"
            f"  result  {outcomes(self.result)}"
        )

    def to_dataframe(self) -> Any:
        """A row for each point: the parameter by its name, `start`, `point`, `t`, the components of the state, and the
        `result` of its solution.

        **Returns:** a `pandas.DataFrame`: `pip install nsjax[data]`.
        """
        shape = self.ts.shape
        _, start, point = np.indices(shape)
        values = np.broadcast_to(np.asarray(self.values)[:, None, None], shape)
        result = np.broadcast_to(result_names(self.result)[:, :, None], shape)
        columns = {self.parameter: values, "start": start, "point": point, "t": np.asarray(self.ts)}
        rows = [*columns.items(), *components(self.ys, 3).items(), ("result", result)]
        return frame("BruteForce.to_dataframe", [(name, x.ravel()) for name, x in rows])

    def periods(self, tol: float = 1e-4) -> np.ndarray:
        """After how many points each solution repeats itself: 0 where it does not within half of those kept, as in
        chaos, -1 where a solution failed.

        **Arguments:**

        - `tol`: what counts as the same, relative to how far a solution's points lie apart or from zero.

        **Returns:** integers of shape `(values, starts)`.
        """
        points = np.asarray(jax.vmap(jax.vmap(jax.vmap(ravel)))(self.ys))
        keep = points.shape[2]
        size = tol * np.abs(points).max(axis=(2, 3))
        out = np.where(np.isfinite(points).all(axis=(2, 3)), 0, -1)
        for period in range(keep // 2, 0, -1):
            gap = np.abs(points[:, :, period:] - points[:, :, :-period]).max(axis=(2, 3))
            out = np.where(gap <= size, period, out)
        return out


class _Lane(eqx.Module):
    """One solution for each value, or one for all of them, one after the other."""

    system: System
    path: tuple[str, ...] = eqx.field(static=True)
    step: PoincareMap
    t0: Scalar
    values: Float[Array, " values"]
    transient: int = eqx.field(static=True)
    keep: int = eqx.field(static=True)

    def points(self, value: Scalar, y: Y) -> Iterate:
        system = put_parameter(self.system, self.path, value)
        start = self.step.start(system, self.t0, y, {})
        if self.transient:
            start = self.step.skip(system, start, self.transient)
        return self.step.iterates(system, start, self.keep)


class _Apart(_Lane):
    def __call__(self, value: Scalar, y: Y) -> tuple[Scalar, Y, RESULTS]:
        found = self.points(value, y)
        return found.t, found.y, jax.tree.map(lambda x: x[-1], found.result)


class _Carried(_Lane):
    def __call__(self, first: Y) -> tuple[Scalar, Y, RESULTS]:
        def at(y: Y, value: Scalar) -> tuple[Y, Any]:
            found = self.points(value, y)
            last, result = jax.tree.map(lambda x: x[-1], (found.y, found.result))
            # Where the solution fails, the next value begins anew.
            lost = ~jnp.isfinite(ravel(last)).all()
            return jax.tree.map(lambda a, b: select(lost, a, b), first, last), (found.t, found.y, result)

        return lax.scan(at, first, self.values)[1]


def brute_force(
    system: System,
    parameter: str,
    values: Any,
    starts: Y,
    *,
    section: Section | None = None,
    direction: int = 1,
    max_time: Any = None,
    transient: int = 200,
    keep: int = 50,
    carry: bool = False,
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
) -> BruteForce:
    """A brute-force bifurcation diagram: for each value of a parameter, the points at which solutions pierce a Poincaré
    section after a transient.

    ```python
    found = nsjax.brute_force(system, "omega", jnp.linspace(1.5, 1.9, 400), State(1.0, 0.0))
    ax = nsjax.plot.brute_force(found, "x")
    ```

    It shows what attracts: chaos and all that is stable, if `starts` lie in every basin; nothing unstable.

    **Arguments:**

    - `system`: the model.
    - `parameter`: the name of a field.
    - `values`: its values, shape `(values,)` [unit of the parameter].
    - `starts`: states at `t0`, leaves with a leading axis; each is followed for every value. Or one state of scalars.
    - `section`, `direction`, `max_time`: as for `poincare_map`; by default points are taken once in each period of the
        forcing, at the phase of `t0` (6.9).
    - `transient`: how many points are left out.
    - `keep`: how many are kept.
    - `carry`: whether each value begins where the solution for the one before it ended, in the order of `values`, which
        follows a branch to where it ends: with `values` rising and falling it shows hysteresis. `starts` are for the
        first. By default every value has all of them.
    - `solver`, `stepsize_controller`, `rtol`, `atol`: as for `solve` within `sweep`; by default Tsit5, and `Affine` for
        what that can do. `max_steps`, `max_events`: for each point.
    - `chunk`, `devices`: how many solutions go together, and on which devices, see `sweep`.
    - `path`: a folder that keeps what is done, a chunk of solutions at a time, and from which a call that was
        interrupted goes on; see `Sweep`.
    - `progress_meter`: `diffrax.TextProgressMeter()` writes to the standard error stream how many lanes are done, how
        many in a second, and how long the others will take; see `sweep`.

    **Returns:** a `BruteForce`. Solutions that fail, or return no more, have a `result` that says why.

    **Raises:** `TypeError`, `ValueError` for mistakes in the arguments.
    """
    for name, number in (("transient", transient + 1 if isinstance(transient, int) else transient), ("keep", keep)):
        positive(name, number)
    if all(jnp.ndim(leaf) == 0 for leaf in jax.tree.leaves(starts)):
        starts = jax.tree.map(lambda x: jnp.asarray(x)[None], starts)
    lengths = {jnp.shape(leaf)[:1] for leaf in jax.tree.leaves(starts)}
    if len(lengths) != 1 or () in lengths:
        raise ValueError(
            "Argument `starts` must hold states whose leaves have one leading axis of the same length, but the shapes "
            f"are {', '.join(str(jnp.shape(leaf)) for leaf in jax.tree.leaves(starts))}."
        )
    one = jax.tree.map(lambda x: x[0], starts)
    t0, y0, _ = checked_start(system, t0, one, None)
    integrator = Integrator(solver, stepsize_controller, max_steps, max_events).checked(t0.dtype, rtol=rtol, atol=atol)
    place = parameter_path(system, parameter)
    system = arrays_of(system, t0.dtype)
    values = jnp.asarray(values, t0.dtype)
    if values.ndim != 1 or not len(values):
        raise ValueError(f"Argument `values` must be a vector, but its shape is {values.shape}.")
    if section is None:
        step = phase_map(system, 1, integrator)
    else:
        step = section_map(system, section, direction, max_time, t0, y0, integrator)
    starts = jax.tree.map(lambda x: jnp.asarray(x, t0.dtype), starts)
    number = len(jax.tree.leaves(starts)[0])
    args = (system, place, step, t0, values, transient, keep)
    if carry:
        found = sweep_in(path, _Carried(*args), starts, chunk=chunk, devices=devices, progress_meter=progress_meter)
        found = jax.tree.map(lambda x: jnp.swapaxes(x, 0, 1), found)
    else:
        each = jax.tree.map(lambda x: jnp.tile(x, (len(values),) + (1,) * (x.ndim - 1)), starts)
        found = sweep_in(
            path,
            _Apart(*args),
            jnp.repeat(values, number),
            each,
            chunk=chunk,
            devices=devices,
            progress_meter=progress_meter,
        )
        found = jax.tree.map(lambda x: x.reshape(len(values), number, *x.shape[1:]), found)
    return BruteForce(parameter, values, *found)
