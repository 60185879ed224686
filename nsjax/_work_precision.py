"""What accuracy costs: time against the error that was measured, method by method, for any quantity of any system."""

import logging
import statistics
import time
from collections.abc import Callable, Mapping, Sequence
from typing import Any, NamedTuple

import diffrax as dfx
import equinox as eqx
import jax
import jax.flatten_util as jfu
import jax.numpy as jnp
import numpy as np

from ._numerics._progress import Counting, ProgressMeter, QUIET
from ._numerics._tables import frame
from ._numerics._text import shown
from ._types import Scalar, Y
from .flow._solution import Solution
from .flow._solve import solve
from .flow.steppers._taylor import Taylor
from .orbits._find_orbit import find_orbit
from .orbits._orbit import Orbit
from .regularise._regularise import banded, smoothed
from .system._checks import check_system
from .system._switch import AbstractSwitch, forwarded
from .system._system import SwitchValues, System


class Method(NamedTuple):
    """A way to solve: a solver, and what it is to solve instead of a system, if anything.

    Handed to a quantity it has a tolerance, and `solve` and `find_orbit` are `nsjax.solve` and `nsjax.find_orbit` with
    all of this.
    """

    solver: dfx.AbstractSolver
    change: Callable[[System], System] | None = None
    tolerance: Any = 1e-8
    max_steps: int = 4096

    def solve(self, system: System, t0: Any, t1: Any, y0: Any, **kwargs: Any) -> Solution:
        return solve(self._changed(system), t0, t1, y0, **self._how() | kwargs)

    def find_orbit(self, system: System, y0: Any, **kwargs: Any) -> Orbit:
        return find_orbit(self._changed(system), y0, **self._how() | kwargs)

    def _changed(self, system: System) -> System:
        return system if self.change is None else self.change(system)

    def _how(self) -> dict[str, Any]:
        control = dfx.PIDController(rtol=self.tolerance, atol=self.tolerance)
        return dict(solver=self.solver, stepsize_controller=control, max_steps=self.max_steps)


class Row(NamedTuple):
    """One method at one tolerance."""

    method: str
    tolerance: float
    seconds: float  # median of the repeats; not a number if it failed
    error: float  # largest deviation of an entry from the reference
    compile_seconds: float  # of the method, once for all tolerances
    evaluations: int | None  # of the vector field, at different times and states
    failure: str  # what stopped it, or ""


@shown
class WorkPrecision(NamedTuple):
    """The table made by `work_precision`. Prints as Markdown; `nsjax.plot.work_precision` draws it.

    **Attributes:**

    - `rows`: a `Row` for each method and tolerance.
    - `doubt`: by how much the reference itself may be off (0 for one that was given): smaller errors say nothing.
    """

    rows: tuple[Row, ...]
    doubt: float

    def to_dataframe(self) -> Any:
        """A row for each method and tolerance, with the fields of `rows`.

        **Returns:** a `pandas.DataFrame`: `pip install nsjax[data]`.
        """
        table = {name: np.array([getattr(row, name) for row in self.rows], dtype=object) for name in Row._fields}
        numbers = {name: x.astype(float) for name, x in table.items() if name not in ("method", "failure")}
        return frame("WorkPrecision.to_dataframe", (table | numbers).items())

    def __str__(self) -> str:
        counted = any(r.evaluations is not None for r in self.rows)
        lines = ["| method | tolerance | error | seconds |" + " evaluations |" * counted + " compile [s] |"]
        lines.append("|---|---|---|---|" + "---|" * counted + "---|")
        for r in self.rows:
            error = r.failure or (f"{r.error:.1e}" if r.error > self.doubt else f"< {self.doubt:.0e}")
            seconds = "" if r.failure else f"{r.seconds:.3g}"
            evaluations = f" {'' if r.evaluations is None else r.evaluations} |" * counted
            lines.append(
                f"| {r.method} | {r.tolerance:.0e} | {error} | {seconds} |{evaluations} {r.compile_seconds:.1f} |"
            )
        return "\n".join(lines)


def methods_for(system: System) -> dict[str, Method]:
    """The methods that `work_precision` compares by default: event-driven by Tsit5, Dopri8 and `Taylor`; and, as far as
    the system can have them, smoothing with an implicit solver and the switch model."""
    found = {
        "events, Tsit5": Method(dfx.Tsit5()),
        "events, Dopri8": Method(dfx.Dopri8()),
        "events, Taylor": Method(Taylor()),
    }
    frictions = [k for k in system.switches if k.signed and not k.jumps]
    if frictions:
        if all(k.bound(system) == 1 for k in frictions):
            found["arctan, ε = 1e4"] = Method(dfx.Kvaerno5(), lambda s: smoothed(s, 1e4))
            found["linear, ε = 1e4"] = Method(dfx.Kvaerno5(), lambda s: smoothed(s, 1e4, "linear"))
        found["band, η = 1e-4"] = Method(dfx.Tsit5(), lambda s: banded(s, 1e-4))
    return found


class _Counted(System):
    """A system that reports where its field is evaluated."""

    system: System
    report: Callable[..., None] = eqx.field(static=True)

    def vector_field(self, t: Scalar, y: Y, s: SwitchValues) -> Y:
        jax.debug.callback(self.report, t, y)
        return self.system.vector_field(t, y, s)

    @property
    def switches(self) -> tuple[AbstractSwitch, ...]:
        return tuple(map(forwarded, self.system.switches))

    @property
    def jumps_in_time(self) -> str:  # pyright: ignore[reportIncompatibleVariableOverride]
        return self.system.jumps_in_time


def work_precision(
    system: System,
    quantity: Callable[..., Any],
    methods: Mapping[str, Method | dfx.AbstractSolver] | None = None,
    tolerances: Sequence[float] = (1e-4, 1e-6, 1e-8, 1e-10),
    *,
    reference: Any = None,
    repeats: int = 5,
    max_steps: int = 100_000,
    count: bool = False,
    progress_meter: ProgressMeter = QUIET,
) -> WorkPrecision:
    """Time against error for a quantity of a system, by several methods.

    ```python
    def end(system, method):
        return method.solve(system, 0.0, 100.0, y0).y1

    def slope(system, method):
        return jax.jacfwd(lambda v: end(MySystem(v_dr=v), method))(system.v_dr)

    print(nsjax.work_precision(system, end))
    ```

    **Arguments:**

    - `system`: the model.
    - `quantity`: `quantity(system, method)`, a pytree of arrays: a state, an orbit, a derivative. It calls
        `method.solve` or `method.find_orbit` in place of nsjax's, which add solver and tolerance. It is compiled.
    - `methods`: by name a `Method`, or a solver; see `methods_for` for those by default.
    - `tolerances`: relative and absolute ones of the step size controller.
    - `reference`: the true value. By default it is found event by event with Dopri8 at a tolerance of 1e-13, and the
        difference from that with `Taylor` tells how far it is to be trusted (from Tsit5, where there is no series).
    - `repeats`: how often each is run; the time is the median. Compiling is timed apart.
    - `max_steps`: as for `solve`.
    - `count`: whether to count at how many different times and states the vector field is evaluated, Newton iterations
        of implicit solvers included. (An extra run of each, many times as slow.)
    - `progress_meter`: `diffrax.TextProgressMeter()` writes to the standard error stream how many rows of the table are
        done, and how long the others will take; a function is called with that.

    **Returns:** a `WorkPrecision`.

    **Raises:** `TypeError`, `ValueError` for mistakes in the arguments. What fails while it runs is a row of the table.
    """
    check_system(system)
    chosen = methods_for(system) if methods is None else methods
    rows: list[Row] = []
    doubt = 0.0
    with Counting(progress_meter, len(chosen) * len(tolerances), "rows") as counting:
        if reference is None:
            counting.at(0, "the reference")
            true, doubt = _reference(system, quantity, max_steps)
        else:
            true = _flat(reference)
        for name, method in chosen.items():
            if isinstance(method, dfx.AbstractSolver):
                method = Method(method)
            if not isinstance(method, Method):
                raise TypeError(
                    f"Argument `methods` must have a `Method` or a solver for {name!r}, but got {method!r}."
                )
            method = method._replace(max_steps=max_steps)
            counting.at(len(rows), name)
            run = jax.jit(lambda system, tol, method=method: quantity(system, method._replace(tolerance=tol)))
            begin = time.perf_counter()
            try:
                compiled = run.lower(system, jnp.asarray(tolerances[0])).compile()
            except TypeError as problem:  # a series that is not known
                rows += [Row(name, tol, np.nan, np.nan, 0.0, None, str(problem)) for tol in tolerances]
                continue
            compile_seconds = time.perf_counter() - begin
            for tol in tolerances:
                seconds, value, failure = _timed(lambda tol=tol: compiled(system, jnp.asarray(tol)), repeats)
                error, evaluations = np.nan, None
                if value is not None:
                    error = float(np.max(np.abs(_flat(value) - true)))
                    evaluations = _evaluations(quantity, system, method._replace(tolerance=tol)) if count else None
                rows.append(Row(name, float(tol), seconds, error, compile_seconds, evaluations, failure))
                counting.at(len(rows), name)
    return WorkPrecision(tuple(rows), doubt)


def _flat(value: Any) -> np.ndarray:
    return np.asarray(jfu.ravel_pytree(value)[0])


def _reference(system: System, quantity: Any, max_steps: int) -> tuple[np.ndarray, float]:
    """The value by Dopri8, and how much another method's differs."""

    def by(solver: dfx.AbstractSolver) -> np.ndarray:
        method = Method(solver, tolerance=1e-13, max_steps=max_steps)
        return _flat(jax.jit(lambda system: quantity(system, method))(system))

    true = by(dfx.Dopri8())
    try:
        other = by(Taylor())
    except TypeError:
        other = by(dfx.Tsit5())
    return true, float(np.max(np.abs(true - other)))


def _timed(run: Callable[[], Any], repeats: int) -> tuple[float, Any, str]:
    """Median seconds, the value, or why it is missing."""
    seconds, value = [], None
    log = logging.getLogger("jax._src.callback")
    level, failure = log.level, ""
    log.setLevel(logging.CRITICAL)  # what fails is told in the table
    try:
        jax.block_until_ready(run())
        for _ in range(repeats):
            begin = time.perf_counter()
            value = jax.block_until_ready(run())
            seconds.append(time.perf_counter() - begin)
    except RuntimeError as problem:  # equinox's errors at run time among them
        failure, value = _message(problem), None
    finally:
        log.setLevel(level)
    return (np.nan if failure else statistics.median(seconds)), value, failure


def _message(problem: Exception) -> str:
    """The first line of an error's text, without what is said of where it was raised."""
    lines = [line.strip() for line in str(problem).splitlines()]
    marked = [line.partition("RuntimeError: ")[2] for line in lines if "RuntimeError: " in line]
    return (marked or lines or [""])[0]


def _evaluations(quantity: Any, system: System, method: Method) -> int:
    seen: set[bytes] = set()

    def report(t: Any, y: Any) -> None:
        seen.add(b"".join(np.asarray(x).tobytes() for x in (t, *jax.tree.leaves(y))))

    def change(system: System) -> System:
        return _Counted(method._changed(system), report)

    jax.block_until_ready(jax.jit(lambda system: quantity(system, method._replace(change=change)))(system))
    jax.effects_barrier()
    return len(seen)
