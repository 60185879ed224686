"""The continuation of equilibria over a parameter, through folds and corners, along every branch."""

import dataclasses
import functools as ft
import os
from collections.abc import Sequence
from typing import Any

import jax
import numpy as np

from ..._numerics._compile import interactive
from ..._numerics._progress import ProgressMeter, QUIET, Told
from ..._numerics._text import shown
from ..._types import Y
from ...equilibria._equilibrium import Equilibrium
from ...equilibria._find_equilibrium import checked_equilibrium, find_equilibrium
from ...flow._archive import Archive
from ...system._model import SwitchedSystem
from ...system._parameter import get_parameter, parameter_path
from ...system._system import System
from .._checks import check_interval, check_precision, checked_scale
from .._continuation import AbstractContinuation, growth_types, with_arguments_of
from .._explorer import Tree
from ._branch import Branch, branch_of
from ._corner import Departure, EquilibriumPoint, Node
from ._corrector import linearised, Probe, Step
from ._equations import EquilibriumCurve, kinks, Record
from ._explorer import EquilibriumExplorer
from ._tracer import EquilibriumTracer


NOTHING = 1e-11  # a state below it is what Newton's method leaves of zero


@shown
class EquilibriumContinuation(AbstractContinuation[EquilibriumPoint, Branch]):
    """A continuation of equilibria that is under way: iterate over it, and look at `branch` at any time.

    ```python
    growth = nsjax.EquilibriumContinuation(system, start, "mu", (-1.0, 1.0))
    for point in growth:
        if point.parameter > 0.5:
            break
    print(growth)  # how far it is
    print(growth.branch)  # what there is so far; go on iterating for more
    growth.save("growth.npz")
    growth = nsjax.EquilibriumContinuation.load("growth.npz", system)  # some other day
    ```

    An interrupt (Ctrl-C), wherever it comes, leaves a growth that can be gone on with. The arguments are those of
    `continue_equilibrium`.
    """

    _parts = EquilibriumCurve, EquilibriumTracer, EquilibriumExplorer
    _types = growth_types(Branch, EquilibriumTracer, EquilibriumPoint, Record, Step, Probe, Node, Departure)
    _join = staticmethod(branch_of)

    def __init__(
        self,
        system: System,
        start: Y | Equilibrium | Sequence[Equilibrium],
        parameter: str,
        interval: tuple[float, float],
        *,
        scale: Y | None = None,
        max_step: float = 0.02,
        max_points: int = 2000,
        max_branches: int = 50,
        progress_meter: ProgressMeter = QUIET,
        t: Any = 0.0,
    ):
        told = Told(progress_meter, ends=False)
        curve, starts = _curve_and_starts(system, start, parameter, interval, scale, t)
        tracer = EquilibriumTracer(curve, max_step, max_points, parameter)
        explorer = EquilibriumExplorer(tracer, parameter, max_branches)
        self._begin(explorer, explorer.rest(Tree(waiting=tuple(starts))), told)

    @classmethod
    def load(
        cls, path: str | os.PathLike, system: System, y: Y | None = None, *, progress_meter: ProgressMeter = QUIET
    ) -> "EquilibriumContinuation":
        """Reads what `save` wrote, to go on with it as if nothing had happened. Nothing in the file is executed.

        **Arguments:**

        - `path`: the file.
        - `system`: a model of the same class and shapes; the values of its parameters are taken from the file.
        - `y`: a state, to tell what states look like; needed where they are neither arrays, dictionaries, tuples nor
            NamedTuples.
        - `progress_meter`: as for `continue_equilibrium`.

        **Returns:** the `EquilibriumContinuation`.

        **Raises:** `ValueError` for a file that is damaged, was not written by `save`, or is of another model.
        """
        archive = Archive(path, "EquilibriumContinuation", cls._types, system, y)
        return cls._loaded(archive, Told(progress_meter, ends=False), lambda path: dict(path=path), {})


@lambda fn: with_arguments_of(EquilibriumContinuation, fn, Branch)
def continue_equilibrium(*args: Any, **kwargs: Any) -> Branch:
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
    - `progress_meter`: `diffrax.TextProgressMeter()` writes to the standard error stream how far it is: how many
        branches and points there are, and where on the last one it is; how many are to come is not known. A function is
        called with the continuation at each point.
    - `t`: the time at which forces are taken.

    **Returns:** the `Branch` through the (first) start, with the others in `Branch.others`.

    **Raises:** `ValueError` for an unknown parameter, a value outside the interval, a start that is virtual or one of a
    continuum of equilibria (as sticking friction makes), and in single precision; a runtime error where no equilibrium
    is found.
    """
    return EquilibriumContinuation(*args, **kwargs).run()


def _curve_and_starts(
    system: System, start: Any, parameter: str, interval: tuple[float, float], scale: Y | None, t: Any
) -> tuple[EquilibriumCurve, list[tuple[Any, np.ndarray]]]:
    """The checked arguments: the curve in its units, and unknowns and mode of each start."""
    path = parameter_path(system, parameter)
    low, high = (float(x) for x in interval)
    several = isinstance(start, (list, tuple)) and all(isinstance(one, Equilibrium) for one in start)
    starts: list[Any] = list(start) if several else [start]  # type: ignore[call-overload]
    if not starts:
        raise ValueError("Argument `start` must hold at least one equilibrium, but is empty.")
    guess = starts[0].y if isinstance(starts[0], Equilibrium) else starts[0]
    checked, y, t, _, _ = checked_equilibrium(system, guess, t, None, None)
    check_precision(t.dtype, "give `start`")
    value = float(get_parameter(checked, path))
    check_interval("interval", (low, high), value, f"of `{parameter}` in `system`")
    model = SwitchedSystem.forwards(checked, t, y)
    size = sum(np.size(leaf) for leaf in jax.tree.leaves(y)) + len(model.holdable) + 1
    mark = np.asarray((value - low) / (high - low))
    curve = EquilibriumCurve(model, path, t, y, np.asarray(low), mark, np.ones(size))
    found = [one if isinstance(one, Equilibrium) else find_equilibrium(system, y, t=t) for one in starts]
    places = [_place(curve, one, value) for one in found]
    curve = dataclasses.replace(curve, units=_units(curve, places, high - low, scale))
    return curve, [(z / curve.units, mode) for z, mode in places]


def _place(curve: EquilibriumCurve, found: Equilibrium, value: float) -> tuple[Any, np.ndarray]:
    """The unknowns (in units of one), and the mode."""
    if not found.admissible:
        raise ValueError("Argument `start` must lead to an equilibrium, but what was found is virtual:\n" + str(found))
    model, own = curve.model, np.asarray(found.mode)
    y = jax.tree.map(lambda x, like: np.asarray(x, like.dtype), found.y, curve.like)
    part = [0 if p is None else int(p) for p in _parts(model, curve.t, y, tuple(own))]
    mode = np.array([own, part], np.int32).reshape(2, -1)
    sigma = np.asarray(found.multipliers)[list(model.holdable)]
    z = np.concatenate([*map(np.ravel, jax.tree.leaves(y)), sigma, [value - curve.low]])
    # At a kink the value of the switch is not determined: any side will do, as the others are looked at too.
    mode[0] = np.where(np.asarray(kinks(curve, z)) & (mode[0] == 0), 1, mode[0])
    return curve.entered(z, mode), mode


@ft.partial(interactive, host=True)
def _parts(model: SwitchedSystem, t: Any, y: Y, mode: tuple) -> tuple:
    return model.state_at(t, y, mode).part


def _units(curve: EquilibriumCurve, places: list[tuple[Any, np.ndarray]], width: float, scale: Y | None) -> Any:
    """The size of each unknown: what is given; or what it has, or how it varies; or, for want of both, one."""
    n = len(places[0][0]) - 1 - len(curve.model.holdable)
    sigma = np.max([np.abs(z[n:-1]) for z, _ in places], axis=0)
    if scale is not None:
        own = np.asarray(checked_scale(curve.like, scale))
    else:
        sizes = []
        for z, mode in places:
            df = linearised(curve, z, mode)[1]
            rates = np.linalg.lstsq(df[:, :-1], -df[:, -1], rcond=1e-9)[0][:n]
            x = np.abs(z[:n])
            sizes.append(np.maximum(x, np.minimum(np.abs(rates) * width, 1e3 * np.maximum(x, 1))))
        own = np.max(sizes, axis=0)
        largest = own.max() if own.max() > NOTHING else 1.0
        own = np.where(own > max(1e-12 * largest, NOTHING), own, largest)
    return np.concatenate([own, np.maximum(sigma, 1), [width]])
