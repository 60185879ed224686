"""The continuation of periodic orbits over a parameter, through folds and corners, along every branch."""

import os
from typing import Any, Generic

import diffrax as dfx
import jax.numpy as jnp

from ..._numerics._progress import ProgressMeter, QUIET, Told
from ..._numerics._text import shown
from ..._types import StateT, Y
from ...flow._archive import Archive, plain
from ...flow._integrator import Integrator
from ...maps._corner_normal_form import Cycle
from ...orbits._orbit import Orbit
from ...orbits.segments._equations import OrbitCurve
from ...orbits.segments._itinerary import OrbitItinerary
from ...orbits.segments._point import PointData
from ...system._parameter import FreeParameters, Path
from ...system._system import System
from .._continuation import AbstractContinuation, growth_types, with_arguments_of
from .._explorer import Tree
from ._bifurcation import Origin
from ._branch import orbit_branch, OrbitBranch, Point
from ._branch_switching import Departure, Node
from ._explorer import Exit, OrbitExplorer
from ._record import Measures, Recorder
from ._start import curve_and_start
from ._test_functions import Test
from ._tracer import OrbitPoint, OrbitTracer


@shown
class OrbitContinuation(AbstractContinuation[OrbitPoint, OrbitBranch[StateT]], Generic[StateT]):
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

    _parts = OrbitCurve, OrbitTracer, OrbitExplorer
    _types = growth_types(
        OrbitBranch,
        OrbitTracer,
        Origin,
        Exit,
        Test,
        OrbitPoint,
        PointData,
        OrbitItinerary,
        Node,
        Departure,
        Cycle,
        Point,
    )
    _join = staticmethod(orbit_branch)

    _explorer: OrbitExplorer

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
        progress_meter: ProgressMeter = QUIET,
        solver: dfx.AbstractSolver = dfx.Dopri8(),
        stepsize_controller: dfx.AbstractStepSizeController | None = None,
        rtol: float | None = None,
        atol: float | None = None,
        max_steps: int = 4096,
    ):
        told = Told(progress_meter, ends=False)
        integrator = Integrator(solver, stepsize_controller, max_steps).checked(
            jnp.float64, (1e-12, 1e-6), rtol=rtol, atol=atol
        )
        curve, start = curve_and_start(system, orbit, parameter, interval, scale, integrator)
        start, value = start.filled(), curve.value
        tracer = OrbitTracer(curve, max_step, max_points)
        spot = tracer.orbit_near(start.itinerary, curve.pack(start, value))
        if spot is None:
            raise ValueError("Argument `orbit` must be an orbit of `system`, but none was found next to it.")
        max_order = max_laps * int(curve.order)
        explorer = OrbitExplorer(tracer, parameter, max_branches, max_order, Recorder(record or {}), virtual)
        upwards = spot if spot.look.tangent[-1] >= 0 else spot.turned
        self._begin(explorer, explorer.begin(Tree(), upwards), told)

    def _more(self) -> dict[str, Any]:
        integrator = plain(repr(self._explorer.tracer.curve.integrator))
        return dict(integrator=integrator, record=sorted(self._explorer.recorder.measures))

    @classmethod
    def load(
        cls,
        path: str | os.PathLike,
        system: System,
        y: Y | None = None,
        *,
        record: Measures | None = None,
        progress_meter: ProgressMeter = QUIET,
        solver: dfx.AbstractSolver = dfx.Dopri8(),
        stepsize_controller: dfx.AbstractStepSizeController | None = None,
        rtol: float | None = None,
        atol: float | None = None,
        max_steps: int = 4096,
    ) -> "OrbitContinuation":
        """Reads what `save` wrote, to go on with it as if nothing had happened. Nothing in the file is executed.

        **Arguments:**

        - `path`: the file.
        - `system`: a model of the same class and shapes; the values of its parameters are taken from the file.
        - `y`: a state, to tell what states look like; needed where they are neither arrays, dictionaries, tuples nor
            NamedTuples.
        - `record`, `solver`, `stepsize_controller`, `rtol`, `atol`, `max_steps`: those with which it was begun.
        - `progress_meter`: as for `continue_orbit`.

        **Raises:** `ValueError` for a file that is damaged, was not written by `save`, or is of another model or solver
        or with other records.
        """
        archive = Archive(path, "OrbitContinuation", cls._types, system, y)
        integrator = Integrator(solver, stepsize_controller, max_steps).checked(
            jnp.float64, (1e-12, 1e-6), rtol=rtol, atol=atol
        )
        names = "`solver`, `stepsize_controller`, `rtol`, `atol` and `max_steps`"
        archive.check_integrator(integrator, names, "branch was begun")
        recorder = Recorder(record or {})
        if sorted(recorder.measures) != archive.part("record"):
            raise ValueError(
                "Argument `record` must hold functions of the names with which the branch was begun, "
                f"{archive.part('record')}, but has {sorted(recorder.measures)}."
            )

        def for_curve(path: Path) -> dict[str, Any]:
            return dict(free=FreeParameters.of(archive.system, path), integrator=integrator)

        growth = cls._loaded(archive, Told(progress_meter, ends=False), for_curve, dict(recorder=recorder), smooth=True)
        for name, value in growth._tree.branches[0][1].points[0].record.items():
            recorder.shapes[name] = value.shape
        return growth


@lambda fn: with_arguments_of(OrbitContinuation, fn, OrbitBranch)
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
    - `progress_meter`: `diffrax.TextProgressMeter()` writes to the standard error stream how far it is: how many
        branches and points there are, and where on the last one it is; how many are to come is not known. A function is
        called with the continuation at each point.
    - `solver`, `stepsize_controller`, `rtol`, `atol`, `max_steps`: as for `solve`, of each segment; by default Dopri8
        with tolerances of 1e-12. (Where the field is affine in the state between events, segments are matrix
        exponentials anyway.)

    **Returns:** the `OrbitBranch` through `orbit`, with the others in `OrbitBranch.others`.

    **Raises:** `ValueError` for an unknown parameter, a value outside the interval, an orbit that was not found or is
    not admissible, a function of `record` that fails or gives arrays of different shapes, and in single precision.
    """
    return OrbitContinuation(*args, **kwargs).run()
