"""The continuation of periodic orbits over a parameter, through folds and corners, along every branch."""

import dataclasses
import warnings
from collections.abc import Iterator
from typing import Any

import diffrax as dfx
import jax
import jax.flatten_util as jfu
import jax.numpy as jnp
import numpy as np

from ._arcs import model_of
from ._course import start_of
from ._orbit import Orbit
from ._orbit_bifurcation import OrbitBifurcation
from ._orbit_branch import CLOSED, orbit_branch, OrbitBranch, OrbitStrand
from ._orbit_corner import node_at
from ._orbit_curve import guard_sizes, OrbitCurve
from ._orbit_grazing import grazing_at
from ._orbit_node import Half, itinerary, Node, tracer_for
from ._orbit_trace import alike, Arc, OrbitTracer, SAME, Spot, turned, Zero
from ._parameter import get_parameter, parameter_path
from ._segment_flow import exactness
from ._solution import is_okay
from ._system import arrays_of, System
from ._types import Y


def continue_orbit(
    system: System,
    orbit: Orbit,
    parameter: str,
    interval: tuple[float, float],
    *,
    scale: Y | None = None,
    max_step: float = 0.02,
    max_points: int = 1000,
    max_branches: int = 20,
    max_laps: int = 4,
    solver: dfx.AbstractSolver = dfx.Dopri8(),
    stepsize_controller: dfx.AbstractStepSizeController | None = None,
    max_steps: int = 4096,
) -> OrbitBranch:
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
    - `scale`: the typical size of each component of the state, like the state; by default what it has along the orbit.
    - `max_step`: the longest step, in units of `scale`, of the orbit's period, and of the interval.
    - `max_points`: of each arc between two special points.
    - `max_branches`: so many at most; if there are more a warning says so.
    - `max_laps`: the longest period that is followed, over that of `orbit`.
    - `solver`, `stepsize_controller`, `max_steps`: as for `solve`, of each segment; by default Dopri8 with tolerances
        of 1e-12.

    **Returns:** the `OrbitBranch` through `orbit`, with the others in `OrbitBranch.others`.

    **Raises:** `ValueError` for an unknown parameter, a value outside the interval, an orbit that was not found or is
    not admissible, and in single precision.
    """
    growth = OrbitGrowth(
        system, orbit, parameter, interval, scale=scale, max_step=max_step, max_points=max_points,
        max_branches=max_branches, max_laps=max_laps, solver=solver, stepsize_controller=stepsize_controller,
        max_steps=max_steps,
    )  # fmt: skip
    for _ in growth:
        pass
    return growth.branch


class OrbitGrowth:
    """A continuation that is under way: iterate over it, and look at `branch` at any time.

    ```python
    growth = nsjax.OrbitGrowth(system, orbit, "omega", (0.5, 2.0))
    for point in tqdm(growth):
        if point.parameter > 1.9:
            break
    print(growth.branch)  # what there is so far; go on iterating for more
    ```

    The arguments are those of `continue_orbit`.
    """

    def __init__(
        self,
        system: System,
        orbit: Orbit,
        parameter: str,
        interval: tuple[float, float],
        *,
        scale: Y | None = None,
        max_step: float = 0.02,
        max_points: int = 1000,
        max_branches: int = 20,
        max_laps: int = 4,
        solver: dfx.AbstractSolver = dfx.Dopri8(),
        stepsize_controller: dfx.AbstractStepSizeController | None = None,
        max_steps: int = 4096,
    ):
        path = parameter_path(system, parameter)
        low, high = (float(x) for x in interval)
        dtype = jnp.result_type(orbit.t0)
        if dtype != jnp.float64:
            raise ValueError(
                f"Continuation locates special points to more digits than {dtype} has: call "
                '`jax.config.update("jax_enable_x64", True)` first, and find `orbit` in double precision.'
            )
        if not bool(is_okay(orbit.result)) or not bool(orbit.admissible):
            raise ValueError("Argument `orbit` must be an orbit that was found, and is admissible, but is not.")
        system = arrays_of(system, dtype)
        value = float(get_parameter(system, path))
        if not low < high or not low <= value <= high:
            raise ValueError(
                f"Argument `interval` must be (low, high) and hold {value:.6g}, the value of `{parameter}` in "
                f"`system`, but is ({low:.6g}, {high:.6g})."
            )
        if stepsize_controller is None:
            stepsize_controller = dfx.PIDController(rtol=1e-12, atol=1e-12)
        how = (("solver", solver), ("stepsize_controller", stepsize_controller), ("max_steps", max_steps))
        order = 1
        if system.period is not None:
            order = int(round(float(orbit.period) / float(system.period)))
        start = start_of(system, orbit)
        rows = np.concatenate([np.asarray(jfu.ravel_pytree(y)[0])[None] for y in _points(orbit)])
        sizes = np.ptp(rows, axis=0) / 2
        sizes = np.where(sizes > 1e-12 * max(1e-300, sizes.max()), sizes, max(sizes.max(), 1e-300))
        if scale is not None:
            sizes = np.abs(np.asarray(jfu.ravel_pytree(scale)[0], np.float64))
            if sizes.shape != rows.shape[1:] or not np.all(sizes > 0):
                raise ValueError("Argument `scale` must hold a positive number for each component of the state.")
        model = model_of(system, orbit.t0, orbit.y0)
        flat = jfu.ravel_pytree(orbit.y0)[0]
        curve = OrbitCurve(
            model=model,
            path=path,
            like=orbit.y0,
            low=np.asarray(low),
            width=np.asarray(high - low),
            sizes=sizes,
            time=np.asarray(float(orbit.period)),
            guard_sizes=np.ones(len(model.slots)),
            order=np.asarray(order, np.int32),
            normal=np.zeros_like(sizes),
            reference=np.asarray(flat),
            how=how,
            exact=exactness(model, jnp.asarray(orbit.t0), orbit.y0),
        )
        if system.period is None:
            state = curve.state(jnp.asarray(start.course.mode[0]), jnp.asarray(start.course.part[0]))
            f = np.asarray(jfu.ravel_pytree(model.flow(jnp.asarray(start.begin[0]), orbit.y0, state))[0])
            curve = dataclasses.replace(curve, normal=f / np.maximum(f @ f, 1e-300))
        curve = dataclasses.replace(curve, guard_sizes=guard_sizes(curve, start))
        tracer = OrbitTracer(curve, max_step, max_points)
        start = start.filled()
        spot = tracer.corrected(start.course, np.asarray(curve.pack(start, value)))
        if spot is None:
            raise ValueError("Argument `orbit` must be an orbit of `system`, but none was found next to it.")
        self._tree = _Tree(tracer, system, parameter, max_branches, max_laps * order, spot)
        self._points = self._tree.grow()

    def __iter__(self) -> Iterator[Spot]:
        return self._points

    @property
    def branch(self) -> OrbitBranch:
        """What was found so far."""
        return self._tree.result()


def _points(orbit: Orbit) -> list[Any]:
    path = orbit.path(33)
    rows = jax.vmap(jax.vmap(lambda y: jfu.ravel_pytree(y)[0]))(path.y)
    rows = np.asarray(rows).reshape(-1, rows.shape[-1])
    return list(rows[np.isfinite(rows).all(axis=1)])


@dataclasses.dataclass
class _Tree:
    """The branches that hang together, found by following every half-branch of every node once."""

    tracer: OrbitTracer
    system: System
    name: str
    max_branches: int
    max_order: int
    start: Spot
    nodes: list[Node] = dataclasses.field(default_factory=list)
    found: list[tuple[OrbitStrand, OrbitStrand]] = dataclasses.field(default_factory=list)

    def grow(self) -> Iterator[Spot]:
        back, ahead = OrbitStrand(end="the start"), OrbitStrand()
        self.found.append((back, ahead))
        order = int(self.tracer.curve.order)
        spot = self.start if self.start.look.tangent[-1] >= 0 else turned(self.start)
        for strand, outset in ((ahead, spot), (back, turned(spot))):
            if strand is back:
                if ahead.end == CLOSED:
                    break
                back.end = ""
            strand.spots.append((outset, order))
            yield from self.walk(strand, outset, self.tracer.curve, outset)
        for node in self.nodes:  # which grow in number meanwhile
            for half in node.halves:
                if half.used or len(self.found) >= self.max_branches:
                    continue
                half.used = True
                back, ahead = OrbitStrand(end=self.named(node)), OrbitStrand()
                self.found.append((back, ahead))
                partner = half.partner
                yield from self.leave(ahead, node, half)
                if partner is not None and not partner.used:
                    partner.used = True
                    back.end = ""
                    yield from self.leave(back, node, partner)
        if any(not half.used for node in self.nodes for half in node.halves):
            warnings.warn(f"There are more than `max_branches` = {self.max_branches} branches.", stacklevel=4)

    def named(self, node: Node) -> str:
        return f"{node.bifurcation.name} at {self.name} = {node.bifurcation.value:.6g}"

    def leave(self, strand: OrbitStrand, node: Node, half: Half) -> Iterator[Spot]:
        self.depart(strand, node, half)
        strand.special.append((0, node.bifurcation))
        yield from self.walk(strand, half.spot, half.curve, None)

    def depart(self, strand: OrbitStrand, node: Node, half: Half) -> None:
        """The point itself, with the multipliers that the half-branch has there."""
        order = int(half.curve.order)
        spot = node.spot
        if node.bifurcation.discontinuous:
            spot = dataclasses.replace(spot, multipliers=half.multipliers, stable=half.spot.stable)
        strand.spots += [(spot, order), (half.spot, order)]

    def walk(self, strand: OrbitStrand, spot: Spot, curve: OrbitCurve, begin: Spot | None) -> Iterator[Spot]:
        """Along a branch, through corners and branch points, to its end."""
        while True:
            tracer, order = tracer_for(self.tracer, curve), int(curve.order)
            arc = Arc([spot])
            seen, noted = 1, 0
            for point in tracer.arc(arc, begin):
                strand.spots += [(s, order) for s in arc.spots[seen:]]
                for index, zero in arc.passed[noted:]:
                    made = self.passed(tracer, arc, index, zero)
                    if made is not None:
                        strand.special.append((len(strand.spots) - (len(arc.spots) - index), made))
                seen, noted = len(arc.spots), len(arc.passed)
                yield point
            if arc.closed or arc.end is None:
                strand.end = CLOSED if arc.closed else arc.why
                return
            zero = arc.end
            if zero.test.kind in ("low", "high"):
                strand.end = f"{self.name} = {zero.spot.parameter:.6g}"
                return
            if zero.test.kind == "guard":
                zero = grazing_at(tracer, zero) or zero
                strand.spots[-1] = (zero.spot, order)
            node = next((n for n in self.nodes if n.is_at(zero, curve)), None)
            if node is None:
                laps = max(1, self.max_order // order)
                node = node_at(tracer, self.name, zero, laps)
                if node is None:
                    strand.end = f"{zero.test.kind} at {self.name} = {zero.spot.parameter:.10g}"
                    return
                self.nodes.append(node)
            strand.special.append((len(strand.spots) - 1, node.bifurcation))
            arrived = self.arrived(tracer, node, arc)
            ahead = None if arrived is None else arrived.partner
            last = dataclasses.replace(strand.spots[-1][0], stable=strand.spots[-2][0].stable)
            if arrived is not None:
                arrived.used = True
                if node.bifurcation.discontinuous:
                    last = dataclasses.replace(last, multipliers=arrived.multipliers)
            strand.spots[-1] = (last, order)
            if ahead is None or ahead.used:
                strand.end = self.named(node)
                return
            ahead.used = True
            self.depart(strand, node, ahead)
            spot, curve = ahead.spot, ahead.curve

    def passed(self, tracer: OrbitTracer, arc: Arc, index: int, zero: Zero) -> OrbitBifurcation | None:
        """A bifurcation through which the branch goes on as it is."""
        curve, spot = tracer.curve, zero.spot
        if zero.test.kind == "flip":
            node = next((n for n in self.nodes if n.is_at(zero, curve)), None)
            if node is None:
                node = node_at(tracer, self.name, zero, 2)
                if node is None:
                    return None
                if 2 * int(curve.order) <= self.max_order:
                    self.nodes.append(node)
            return node.bifurcation
        side = 0
        if zero.test.kind == "fold":
            side = 1 if arc.spots[index - 1].parameter > spot.parameter else -1
        return OrbitBifurcation.smooth(zero.test.kind, self.name, spot, curve, [], side)

    def arrived(self, tracer: OrbitTracer, node: Node, arc: Arc) -> Half | None:
        """On which half-branch the branch came: that which has the same orbit at the same parameter."""
        curve, order = tracer.curve, int(tracer.curve.order)
        for half in node.halves:
            if int(half.curve.order) != order:
                continue
            target = half.spot.parameter
            for a, b in zip(arc.spots[-2::-1], arc.spots[:0:-1]):
                if not min(a.parameter, b.parameter) <= target <= max(a.parameter, b.parameter):
                    continue
                here = tracer.between(a, b, target) if len(a.look.u) == len(b.look.u) else None
                if here is not None and alike(here, half.spot, curve, SAME):
                    return half
                break
            # Beside a branch point the way from the other side is safer.
            last = arc.spots[-2] if len(arc.spots) > 1 else arc.spots[-1]
            step = tracer.at(half.spot, 1.5 * float(np.linalg.norm(last.look.u - arc.spots[-1].look.u)))
            here = None if step is None else tracer.between(half.spot, step, last.parameter)
            if here is not None and alike(here, last, curve, SAME):
                return half
        # Through a corner there is one curve in each course.
        key = arc.spots[-1].course.key()
        same = [h for h in node.halves if int(h.curve.order) == order and h.spot.course.key() == key]
        return same[0] if len(same) == 1 and node.bifurcation.discontinuous else None

    def result(self) -> OrbitBranch:
        made = [
            orbit_branch(self.tracer.curve, self.system, self.name, back, ahead, itinerary)
            for back, ahead in self.found
            if back.spots or ahead.spots
        ]
        first, *others = made
        return dataclasses.replace(first, others=tuple(others))
