"""The continuation of periodic orbits over a parameter, through folds and corners, along every branch."""

import contextlib
import dataclasses
import inspect
import os
import warnings
from collections.abc import Callable
from typing import Any, Generic, ParamSpec

import diffrax as dfx
import jax.numpy as jnp

from ..._numerics._text import shown
from ..._types import StateT, Y
from ...flow._integrator import Integrator
from ...maps._corner_normal_form import Cycle
from ...orbits._orbit import Orbit
from ...orbits.segments._equations import OrbitCurve
from ...orbits.segments._itinerary import OrbitItinerary
from ...orbits.segments._point import PointData
from ...system._model import SwitchedSystem
from ...system._parameter import get_parameter, parameter_path
from ...system._system import System
from .._archive import Archive, plain, save, table
from .._progress import ProgressLine
from ._bifurcation import Origin
from ._branch import orbit_branch, OrbitBranch, OrbitBranchSegment, Point
from ._branch_switching import Departure, itinerary_text, Node
from ._explorer import Exit, Frontier, OrbitExplorer, OrbitTree
from ._record import Measures, Recorder
from ._start import curve_and_start
from ._test_functions import Test
from ._tracer import OrbitPoint, OrbitTracer, Trace, Zero


Arguments = ParamSpec("Arguments")
GIVEN = ("model", "path", "like", "integrator")  # what of a curve follows from the model, and is not saved
TYPES = {
    **OrbitBranch.saved,
    **table(
        OrbitTree,
        Frontier,
        Origin,
        Exit,
        Trace,
        Zero,
        Test,
        OrbitPoint,
        PointData,
        OrbitItinerary,
        Node,
        Departure,
        Cycle,
        OrbitBranchSegment,
        Point,
    ),
}


@shown
class OrbitContinuation(Generic[StateT]):
    """A continuation that is under way: iterate over it, and look at `branch` at any time.

    ```python
    growth = nsjax.OrbitContinuation(system, orbit, "omega", (0.5, 2.0))
    for point in tqdm(growth):
        if point.parameter > 1.9:
            break
    print(growth)  # how far it is
    print(growth.branch)  # what there is so far; go on iterating for more
    growth.save("growth.npz")
    growth = nsjax.OrbitContinuation.load("growth.npz", system)  # some other day
    ```

    An interrupt (Ctrl-C), wherever it comes, leaves a growth that can be gone on with. The arguments are those of
    `continue_orbit`.
    """

    def __init__(
        self,
        system: System,
        orbit: Orbit[StateT],
        parameter: str,
        interval: tuple[float, float],
        *,
        scale: Y | None = None,
        max_step: float = 0.02,
        max_points: int = 1000,
        max_branches: int = 20,
        max_laps: int = 4,
        virtual: bool = False,
        record: Measures | None = None,
        progress: bool = False,
        solver: dfx.AbstractSolver = dfx.Dopri8(),
        stepsize_controller: dfx.AbstractStepSizeController | None = None,
        max_steps: int = 4096,
    ):
        integrator = Integrator(solver, stepsize_controller, max_steps).checked(jnp.float64, (1e-12, 1e-6))
        curve, start = curve_and_start(system, orbit, parameter, interval, scale, integrator)
        start, value = start.filled(), get_parameter(curve.model.system, curve.path)
        tracer = OrbitTracer(curve, max_step, max_points)
        spot = tracer.orbit_near(start.itinerary, curve.pack(start, value))
        if spot is None:
            raise ValueError("Argument `orbit` must be an orbit of `system`, but none was found next to it.")
        self._explorer = OrbitExplorer(
            tracer, parameter, max_branches, max_laps * int(curve.order), Recorder(record or {}), virtual
        )
        self._tree = self._explorer.first_tree(spot)
        self._line = ProgressLine() if progress else None

    def __iter__(self) -> "OrbitContinuation[StateT]":
        return self

    def __next__(self) -> OrbitPoint:
        while self._tree.walk is not None:
            self._tree, point = self._explorer.further(self._tree)
            if self._tree.walk is None and next(self._tree.places(), None) is not None:
                warnings.warn(
                    f"There are more than `max_branches` = {self._explorer.max_branches} branches.", stacklevel=3
                )
            if point is not None:
                if self._line is not None:
                    self._line.show(self)
                return point
        raise StopIteration

    def run(self) -> OrbitBranch[StateT]:
        """Goes on to the end, and returns the branch."""
        with contextlib.nullcontext() if self._line is None else self._line:
            for _ in self:
                pass
        return self.branch

    @property
    def branch(self) -> OrbitBranch[StateT]:
        """What was found so far."""
        curve, name = self._explorer.tracer.curve, self._explorer.name
        found = [orbit_branch(curve, curve.model.system, name, *pair, itinerary_text) for pair in self._tree.branches]
        return dataclasses.replace(found[0], others=tuple(found[1:]))

    def __str__(self) -> str:
        pieces = [piece for pair in self._tree.branches for piece in pair]
        special = {id(found) for piece in pieces for _, found in piece.special}
        value = next(piece.points[-1].spot.parameter for piece in self._tree.branches[-1] if piece.points)
        return (
            f"branch {len(self._tree.branches)}, {sum(len(piece.points) for piece in pieces)} points, "
            f"{self._explorer.name} = {value:.6g}, {len(special)} special points"
        )

    def save(self, path: str | os.PathLike) -> None:
        """Writes all that is known so far to a file, an `.npz` of plain arrays with a description in JSON: at any time,
        also after an interrupt."""
        curve, explorer = self._explorer.tracer.curve, self._explorer
        parts = dict(
            integrator=plain(repr(curve.integrator)),
            curve={f.name: getattr(curve, f.name) for f in dataclasses.fields(curve) if f.name not in GIVEN},
            t0=self._tree.start.look.begin[0],
            tracer=dict(max_step=explorer.tracer.max_step, max_points=explorer.tracer.max_points),
            record=sorted(explorer.recorder.measures),
            explorer={name: getattr(explorer, name) for name in ("name", "max_branches", "max_order", "virtual")},
            tree=self._tree,
        )
        save(path, "OrbitContinuation", TYPES, curve.model.system, curve.like, parts, curve=curve)

    @classmethod
    def load(
        cls,
        path: str | os.PathLike,
        system: System,
        y: Y | None = None,
        *,
        record: Measures | None = None,
        progress: bool = False,
        solver: dfx.AbstractSolver = dfx.Dopri8(),
        stepsize_controller: dfx.AbstractStepSizeController | None = None,
        max_steps: int = 4096,
    ) -> "OrbitContinuation":
        """Reads what `save` wrote, to go on with it as if nothing had happened. Nothing in the file is executed.

        **Arguments:**

        - `path`: the file.
        - `system`: a model of the same class and shapes; the values of its parameters are taken from the file.
        - `y`: a state, to tell what states look like; needed where they are neither arrays, dictionaries, tuples nor
            NamedTuples.
        - `record`, `solver`, `stepsize_controller`, `max_steps`: those with which it was begun.
        - `progress`: as for `continue_orbit`.

        **Raises:** `ValueError` for a file that is damaged, was not written by `save`, or is of another model or solver
        or with other records.
        """
        archive = Archive(path, "OrbitContinuation", TYPES, system, y)
        integrator = Integrator(solver, stepsize_controller, max_steps).checked(jnp.float64, (1e-12, 1e-6))
        if plain(repr(integrator)) != archive.part("integrator"):
            raise ValueError(
                "Arguments `solver`, `stepsize_controller` and `max_steps` must be those with which the branch was "
                f"begun, {archive.part('integrator')}, but are {plain(repr(integrator))}."
            )
        recorder = Recorder(record or {})
        if sorted(recorder.measures) != archive.part("record"):
            raise ValueError(
                "Argument `record` must hold functions of the names with which the branch was begun, "
                f"{archive.part('record')}, but has {sorted(recorder.measures)}."
            )
        given = archive.part("explorer")
        curve = OrbitCurve(
            model=SwitchedSystem.forwards(archive.system, jnp.asarray(archive.part("t0")), archive.y),
            path=parameter_path(archive.system, given["name"]),
            like=archive.y,
            integrator=integrator,
            **archive.part("curve"),
        )
        growth = cls.__new__(cls)
        growth._explorer = OrbitExplorer(OrbitTracer(curve, **archive.part("tracer")), **given, recorder=recorder)
        growth._tree = archive.part("tree", curve=curve)
        growth._line = ProgressLine() if progress else None
        for name, value in growth._tree.branches[0][1].points[0].record.items():
            recorder.shapes[name] = value.shape
        return growth


def _with_arguments_of(
    begin: Callable[Arguments, OrbitContinuation[StateT]], fn: Callable[..., Any]
) -> Callable[Arguments, OrbitBranch[StateT]]:
    """A function that hands its arguments on shows them to people and to type checkers: with both given at once, as
    otherwise those lose the type of the state."""
    vars(fn)["__signature__"] = inspect.signature(begin).replace(return_annotation=OrbitBranch)
    return fn


@lambda fn: _with_arguments_of(OrbitContinuation, fn)
def continue_orbit(*args: Any, **kwargs: Any) -> OrbitBranch:
    """Follows a periodic orbit while a parameter varies, through smooth and discontinuous bifurcations, and along the
    branches that are born there.

    ```python
    orbit = nsjax.find_orbit(nsjax.gallery.Trilinear(omega=1.0), Motion(0.0, 0.5))
    branch = nsjax.continue_orbit(orbit.system, orbit, "omega", (0.5, 2.0))
    print(branch)
    ```

    Pseudo-arclength continuation of the orbit in segments: states and times of its events are unknown, so that the
    curve is smooth at grazing and where the orbit is infinitely unstable. Where the itinerary changes (a *corner*: the
    orbit touches the tip of a surface, grazes one, a stick phase begins or ends) the normal form of the return map is
    found, as a limit from both sides; all orbits that it foretells, of up to `max_laps` times the period, are entered
    and followed. Each special point is classified by their number on both sides (Definition 5.1), and by where the
    set-valued multipliers (6.13) cross the unit circle (Conjectures 6.1, 6.2): see `OrbitBifurcation`.

    **Arguments:**

    - `system`: the model.
    - `orbit`: an `Orbit` of it, from `find_orbit`.
    - `parameter`: the name of the parameter, a field of `system` or of a system within.
    - `interval`: of the parameter.
    - `scale`: the typical size of each component of the state, like the state; by default what it has along the orbit
        (1 where that is less than 1e-9, as along x = 0).
    - `max_step`: the longest step, in units of `scale`, of the orbit's period, and of the interval.
    - `max_points`: of each trace between two special points.
    - `max_branches`: the largest number of branches; a warning says if there are more.
    - `max_laps`: the longest period that is followed, over that of `orbit`.
    - `virtual`: whether to follow the segments of the orbits at each corner beyond it too, though the system has no
        such orbits there (to see what a corner cuts off, or Feigin's classification): as branches of their own in
        `OrbitBranch.others`, with `OrbitBranch.admissible` false.
    - `record`: measures of each orbit for `OrbitBranch.records`: functions, by name, of times along one period, shape
        `(samples,)`, and of the states there, leaves with the same leading axis; NumPy arrays. They return a number, or
        an array of one shape. The samples of each segment between two events lie closer towards its ends (Chebyshev
        points, both ends included: there is one before and one after each event): weigh them by their distances, as
        the trapezoid rule does.

        ```python
        def power(ts, ys):  # the mean of what is dissipated in c = 0.2
            return np.trapezoid(0.2 * ys.v**2, ts) / (ts[-1] - ts[0])

        def sticking(ts, ys):  # for how long
            return np.sum(np.diff(ts)[np.abs(ys.v - 0.5)[1:] < 1e-9])

        branch = nsjax.continue_orbit(system, orbit, "omega", (0.5, 2.0), record={"P": power, "stick": sticking})
        nsjax.plot.orbit_diagram(branch, "P")
        ```
    - `progress`: whether to write to the standard error stream how far it is.
    - `solver`, `stepsize_controller`, `max_steps`: as for `solve`, of each segment; by default Dopri8 with tolerances
        of 1e-12. (Where the field is affine in the state between events, segments are matrix exponentials anyway.)

    **Returns:** the `OrbitBranch` through `orbit`, with the others in `OrbitBranch.others`.

    **Raises:** `ValueError` for an unknown parameter, a value outside the interval, an orbit that was not found or is
    not admissible, a function of `record` that fails or gives arrays of different shapes, and in single precision.
    """
    return OrbitContinuation(*args, **kwargs).run()
