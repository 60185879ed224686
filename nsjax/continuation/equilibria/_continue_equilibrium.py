"""The continuation of equilibria over a parameter, through folds and corners, along every branch."""

import dataclasses
import warnings
from collections.abc import Sequence
from typing import Any

import jax
import jax.flatten_util as jfu
import jax.numpy as jnp
import numpy as np

from ..._types import Y
from ...equilibria._equilibrium import Equilibrium
from ...equilibria._find_equilibrium import checked_equilibrium, find_equilibrium
from ...system._model import SwitchedSystem
from ...system._parameter import get_parameter, parameter_path
from ...system._system import System
from ._branch import Branch, branch_of, BranchSegment
from ._corner import active, Departure, directions, matching, Node, node_at, start_at
from ._corrector import kept, linearised
from ._equations import EquilibriumCurve, kinks
from ._tracer import Tracer


ALONE = (
    "Argument `start` must be an isolated equilibrium, or a simple branch point, but there are others next to it at "
    "the same value of the parameter (as sticking friction makes them)."
)
NOTHING = 1e-11  # a state below it is what Newton's method leaves of zero


def continue_equilibrium(
    system: System,
    start: Y | Equilibrium | Sequence[Equilibrium],
    parameter: str,
    interval: tuple[float, float],
    *,
    scale: Y | None = None,
    max_step: float = 0.02,
    max_points: int = 2000,
    max_branches: int = 50,
    t: Any = 0.0,
) -> Branch:
    """Follows equilibria while a parameter varies, and says where and how they bifurcate.

    ```python
    branch = nsjax.continue_equilibrium(nsjax.gallery.DiscontinuousPitchfork(mu=-1.0), Line(0.0), "mu", (-1.0, 1.0))
    print(branch)
    ```

    Pseudo-arclength continuation goes round folds. Where the branch reaches a surface (a kink of the field, or one that
    begins or ceases to hold the equilibrium) the piecewise-linear problem of every combination of sides is solved, and
    all branches that leave the corner are followed, as are those of smooth branch points. Each special point is located
    on the curve to rounding, and classified by the number of equilibria on both sides (Definition 5.1), and by where
    the set-valued eigenvalues cross the imaginary axis (Conjectures 5.1, 5.2): see `Bifurcation`.

    **Arguments:**

    - `system`: the model.
    - `start`: a guess of an equilibrium for the value of the parameter that `system` has (which must lie in the
        interval); or an `Equilibrium`; or several, as `find_equilibria` returns them: branches that no bifurcation
        connects are found from a start on each.
    - `parameter`: the name of the parameter, a field of `system` or of a system within: "mu" of `smoothed(system, eps)`
        is that of `system`.
    - `interval`: of the parameter.
    - `scale`: the typical size of each component of the state, like `start`; by default what it has at the start, or
        what it changes over the interval at the start's rate, or 1. Steps are measured in it, and in the interval.
    - `max_step`: the longest step.
    - `max_points`: of one branch; a branch that has more ends there, and says so in `Branch.ends`.
    - `max_branches`: the largest number of branches; a warning says if there are more.
    - `t`: the time at which forces are taken.

    **Returns:** the `Branch` through the (first) start, with the others in `Branch.others`.

    **Raises:** `ValueError` for an unknown parameter, a value outside the interval, a start that is virtual or one of a
    continuum of equilibria (as sticking friction makes), and in single precision; a runtime error where no equilibrium
    is found.
    """
    path = parameter_path(system, parameter)
    low, high = (float(x) for x in interval)
    several = isinstance(start, (list, tuple)) and all(isinstance(one, Equilibrium) for one in start)
    starts: list[Any] = list(start) if several else [start]  # type: ignore[call-overload]
    if not starts:
        raise ValueError("Argument `start` must hold at least one equilibrium, but is empty.")
    guess = starts[0].y if isinstance(starts[0], Equilibrium) else starts[0]
    checked, y, t, _, _ = checked_equilibrium(system, guess, t, None, None)
    if t.dtype != jnp.float64:
        raise ValueError(
            f"Continuation locates special points to more digits than {t.dtype} has: call "
            '`jax.config.update("jax_enable_x64", True)` first, and give `start` in double precision.'
        )
    value = float(get_parameter(checked, path))
    if not low < high or not low <= value <= high:
        raise ValueError(
            f"Argument `interval` must be (low, high) and hold {value:.6g}, the value of `{parameter}` in `system`, "
            f"but is ({low:.6g}, {high:.6g})."
        )
    model = SwitchedSystem.forwards(checked, t, y)
    size = len(jfu.ravel_pytree(y)[0]) + len(model.holdable) + 1
    mark = jnp.asarray((value - low) / (high - low), t.dtype)
    curve = EquilibriumCurve(model, path, t, y, jnp.asarray(low, t.dtype), mark, jnp.ones(size, t.dtype))
    found = [one if isinstance(one, Equilibrium) else find_equilibrium(system, y, t=t) for one in starts]
    places = [_place(curve, one, value) for one in found]
    curve = dataclasses.replace(curve, units=_units(curve, places, high - low, scale))
    tracer = Tracer(curve, parameter, max_step, max_points)
    return _Tree(tracer, max_branches).branches([(z / curve.units, mode) for z, mode in places])


def _place(curve: EquilibriumCurve, found: Equilibrium, value: float) -> tuple[Any, np.ndarray]:
    """The unknowns (in units of one), and the mode."""
    if not found.admissible:
        raise ValueError("Argument `start` must lead to an equilibrium, but what was found is virtual:\n" + str(found))
    model, y = curve.model, jax.tree.map(lambda x, like: jnp.asarray(x, like.dtype), found.y, curve.like)
    state = model.state_at(curve.t, y, tuple(found.mode))
    part = [0 if p is None else int(p) for p in state.part]
    mode = np.array([[int(m) for m in found.mode], part], np.int32).reshape(2, -1)
    sigma = jnp.asarray([found.multipliers[k] for k in model.holdable], curve.t.dtype)
    z = jnp.concatenate([jfu.ravel_pytree(y)[0], sigma, jnp.asarray([value - curve.low], curve.t.dtype)])
    # At a kink the value of the switch is not determined: any side will do, as the others are looked at too.
    mode[0] = np.where(np.asarray(kinks(curve, z)) & (mode[0] == 0), 1, mode[0])
    return curve.entered(z, mode), mode


def _units(curve: EquilibriumCurve, places: list[tuple[Any, np.ndarray]], width: float, scale: Y | None) -> Any:
    """The size of each unknown: what is given; or what it has, or how it varies; or, for want of both, one."""
    n = len(places[0][0]) - 1 - len(curve.model.holdable)
    sigma = jnp.max(jnp.stack([jnp.abs(z[n:-1]) for z, _ in places]), axis=0)
    if scale is not None:
        given = jax.tree.map(lambda s, like: jnp.asarray(s, like.dtype), scale, curve.like)
        own = jnp.abs(jfu.ravel_pytree(given)[0])
        if own.shape != (n,) or not bool(jnp.all(own > 0)):
            raise ValueError("Argument `scale` must hold a positive number for each component of the state.")
    else:
        sizes = []
        for z, mode in places:
            df = np.asarray(linearised(curve, z, jnp.asarray(mode))[1])
            rates = np.linalg.lstsq(df[:, :-1], -df[:, -1], rcond=1e-9)[0][:n]
            x = np.abs(np.asarray(z[:n]))
            sizes.append(np.maximum(x, np.minimum(np.abs(rates) * width, 1e3 * np.maximum(x, 1))))
        own = np.max(sizes, axis=0)
        largest = own.max() if own.max() > NOTHING else 1.0
        own = jnp.asarray(np.where(own > max(1e-12 * largest, NOTHING), own, largest))
    return jnp.concatenate([own, jnp.maximum(sigma, 1), jnp.asarray([width], own.dtype)])


@dataclasses.dataclass
class _Tree:
    """Branches that meet one another, found by following every half-branch of every node once."""

    tracer: Tracer
    max_branches: int
    nodes: list[Node] = dataclasses.field(default_factory=list)
    found: list[Branch] = dataclasses.field(default_factory=list)

    def branches(self, starts: list[tuple[Any, np.ndarray]]) -> Branch:
        for u, mode in starts:
            x = self.tracer.curve.parts(u)[0]
            sizes = self.tracer.curve.units[: len(x)]
            if not any(bool(jnp.max(jnp.abs(x - other) / sizes) < 1e-6) for other in self.tracer.marks):
                self.set_out(u, mode)
            self.follow_all()
        if not self.found:
            raise ValueError(ALONE)
        if any(half.side and not half.used for node in self.nodes for half in node.halves):
            warnings.warn(f"There are more than `max_branches` = {self.max_branches} branches.", stacklevel=3)
        first, *others = self.found
        return dataclasses.replace(first, others=tuple(others))

    def keep(self, back: BranchSegment, ahead: BranchSegment) -> None:
        self.found.append(branch_of(self.tracer.curve.model.system, self.tracer.name, back, ahead))

    def set_out(self, u: Any, mode: np.ndarray) -> None:
        curve = self.tracer.curve
        self.tracer.marks.append(curve.parts(u)[0])
        tangents, regular = directions(curve, u, mode)
        if np.any(active(curve, u, mode)) or not regular:
            if not any(node.is_at(curve, u) for node in self.nodes):
                self.nodes.append(node_at(curve, self.tracer.name, u, mode))
            return
        if len(tangents) != 2:
            raise ValueError(ALONE)
        tangent = jnp.asarray(max(tangents, key=lambda d: d[-1]))  # upwards first
        self.tracer.begin = (u, tangent, mode)
        segment = BranchSegment()
        segment.add(kept(curve, u, jnp.asarray(mode)), mode)
        special = start_at(curve, self.tracer.name, u, mode, tangent)
        if special is not None:
            segment.note(special)
        ahead = self.walk(segment, u, tangent, mode)
        back = BranchSegment(end="the start") if ahead.closed() else self.walk(BranchSegment(), u, -tangent, mode)
        self.tracer.begin = None
        self.keep(back, ahead)

    def follow_all(self) -> None:
        for node in self.nodes:  # which grow in number meanwhile
            for half in node.halves:
                if half.used or not half.side or len(self.found) >= self.max_branches:
                    continue
                ahead = self.leave(node, half)
                partner = half.partner
                back = BranchSegment(end=self.label(node))
                if partner is not None and not partner.used:
                    back = self.leave(node, partner)
                self.keep(back, ahead)

    def label(self, node: Node) -> str:
        return f"{node.bifurcation.name} at {self.tracer.name} = {node.bifurcation.value:.6g}"

    def leave(self, node: Node, half: Departure) -> BranchSegment:
        half.used = True
        segment = BranchSegment()
        self.depart(segment, half)
        _note(segment, node)
        return self.walk(segment, *_outset(half))

    def depart(self, segment: BranchSegment, half: Departure) -> None:
        record = kept(self.tracer.curve, half.u, jnp.asarray(half.mode))
        if not half.regular:  # an eigenvalue is zero there, whose sign would be that of rounding
            record = record._replace(eigenvalues=half.step.record.eigenvalues, stable=half.step.record.stable)
        segment.add(record, half.mode)

    def walk(self, segment: BranchSegment, u: Any, tangent: Any, mode: np.ndarray) -> BranchSegment:
        """Along a branch, through corners and branch points, to its end."""
        curve = self.tracer.curve
        if not segment.records:
            segment.add(kept(curve, u, jnp.asarray(mode)), mode)
        while True:
            u, tangent = self.tracer.arc(segment, u, tangent, mode)
            if segment.end:
                return segment
            node = next((node for node in self.nodes if node.is_at(curve, u)), None)
            if node is None:
                node = node_at(curve, self.tracer.name, u, mode, tangent)
                self.nodes.append(node)
            _note(segment, node)
            arrived = matching(node.halves, mode, -tangent)
            ahead = None if arrived is None else arrived.partner
            if arrived is not None:
                arrived.used = True
            if ahead is None or ahead.used:
                segment.end = self.label(node)
                return segment
            ahead.used = True
            if node.bifurcation.discontinuous:
                self.depart(segment, ahead)
            u, tangent, mode = _outset(ahead)


def _note(segment: BranchSegment, node: Node) -> None:
    """Unless it is a point like any other, as where the branch runs along a surface."""
    if node.bifurcation.kind != "none" or node.bifurcation.discontinuous:
        segment.note(node.bifurcation)


def _outset(half: Departure) -> tuple[Any, Any, np.ndarray]:
    """Where the equations are singular, a branch is entered by its first step."""
    return (half.u, half.tangent, half.mode) if half.regular else (half.step.u, half.step.tangent, half.mode)
