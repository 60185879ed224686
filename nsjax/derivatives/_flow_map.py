"""The flow map with its derivatives: one program for all purposes for which Python follows solutions.

The search for an orbit, the return map at a corner and the way to where a solution settles are many calls of it with
other numbers. The directions in which it is differentiated are numbers too, so that derivatives by the state, by the
time and by any parameter are no programs of their own.
"""

import math
from typing import Any, NamedTuple

import diffrax as dfx
import equinox as eqx
import jax
import jax.flatten_util as jfu
import numpy as np
from jaxtyping import Array, Float

from .._numerics._compile import interactive
from .._types import Scalar, Y
from ..flow._integrator import Integrator
from ..flow._solution import Solution
from ..flow._solve import integrate
from ..system._system import System


class Directions(NamedTuple):
    """In which directions the state at the end is differentiated: of the start's time and state, of the end's time, and
    of the model's parameters. Leaves have a leading axis, one entry for each direction."""

    t0: Array
    t1: Array
    y0: Y
    system: Any  # the model with its numbers only

    @classmethod
    def of_state(cls, system: System, t0: Scalar, y0: Y) -> "Directions":
        """Each component of the state in turn; and last nothing, to be replaced."""
        shapes = [np.shape(leaf) for leaf in jax.tree.leaves(y0)]
        ends = np.cumsum([math.prod(shape) for shape in shapes])
        rows = np.eye(ends[-1] + 1, ends[-1], dtype=t0.dtype)
        leaves = [x.reshape(len(rows), *shape) for x, shape in zip(np.split(rows, ends[:-1], axis=1), shapes)]
        none = np.zeros(len(rows), t0.dtype)
        numbers = eqx.filter(system, eqx.is_inexact_array)
        still = jax.tree.map(lambda a: np.zeros((len(rows), *a.shape), a.dtype), numbers)
        return cls(none, none, jax.tree.unflatten(jax.tree.structure(y0), leaves), still)


def with_room(integrator: Integrator, dtype: Any) -> Integrator:
    """The same with room for the events of several periods, where its bound is meant for one; and with tolerances that
    are numbers of the program."""
    return integrator._replace(max_events=3 * integrator.max_events).with_arrays(dtype)


def flow_map(
    system: System, t0: Scalar, t1: Scalar, y0: Y, mode: Any, integrator: Integrator, directions: Directions
) -> tuple[Solution, Float[Array, "directions n"]]:
    """The solution from t0 to t1, with dense output, and the derivatives of the state at its end. Nothing else of the
    solution has derivatives."""
    numbers, rest = eqx.partition(system, eqx.is_inexact_array)
    where = (t0, t1, y0, mode, integrator, directions)
    _FOLLOWED.add(_kind(system, y0, mode, integrator))
    sol, tangents = _flow_map(numbers, rest, *where)
    lost = ~np.isfinite(tangents).all() and all(np.isfinite(leaf).all() for leaf in jax.tree.leaves(sol.y1))
    if not lost:
        return sol, tangents
    # The derivative by a parameter may be infinite (of sqrt(c) at c = 0, of x**n by n at x < 0), and zero times it is
    # not a number. A program of its own leaves out the parameters that do not move.
    moves = jax.tree.map(
        lambda _, leaf: leaf is not None and bool(np.any(leaf)), system, directions.system, is_leaf=lambda x: x is None
    )
    numbers, rest = eqx.partition(system, moves)
    directions = directions._replace(system=eqx.filter(directions.system, moves))
    return _flow_map(numbers, rest, *where[:-1], directions)


_FOLLOWED: set[Any] = set()  # kinds of problems whose program was needed already


def _kind(system: System, y0: Y, mode: Any, integrator: Integrator) -> Any:
    return jax.tree.structure((system, y0, mode, integrator))


def is_followed(system: System, y0: Y, mode: Any, integrator: Integrator) -> bool:
    """Whether the program of the flow map is there, as far as can be told: it takes twice as long to compile as that of
    a solution alone."""
    return _kind(system, y0, mode, integrator) in _FOLLOWED


def solution(system: System, t0: Scalar, t1: Scalar, y0: Y, mode: Any, integrator: Integrator) -> Solution:
    """The solution alone, with dense output, by the same program: where a search is near, it is compiled anyway."""
    numbers, rest = eqx.partition(system, eqx.is_inexact_array)
    return _flow_map(numbers, rest, t0, t1, y0, mode, integrator, Directions.of_state(system, t0, y0))[0]


@interactive
def _flow_map(
    numbers: Any, rest: Any, t0: Scalar, t1: Scalar, y0: Y, mode: Any, integrator: Integrator, directions: Directions
) -> tuple[Solution, Float[Array, "directions n"]]:
    def flow(t0: Scalar, t1: Scalar, y0: Y, numbers: Any) -> tuple[Array, Solution]:
        saveat, model = dfx.SaveAt(dense=True), eqx.combine(numbers, rest)
        sol = integrate(model, t0, t1, y0, integrator, mode=mode, saveat=saveat, still=True)
        return jfu.ravel_pytree(sol.y1)[0], sol

    def along(direction: Directions) -> tuple[Array, Array, Solution]:
        return jax.jvp(flow, (t0, t1, y0, numbers), tuple(direction), has_aux=True)

    _, tangents, sol = jax.vmap(along, out_axes=(None, 0, None))(directions)
    return sol, tangents
