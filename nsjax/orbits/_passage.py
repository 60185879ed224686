"""Once round an orbit, by the program that found it."""

from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from .._types import Scalar, Y
from ..derivatives._flow_map import is_followed, solution, with_room
from ..flow._solution import Solution
from ..system._system import arrays_of
from ._guess import of_relays
from ._orbit import Orbit


def passage(orbit: Orbit, t0: Scalar, y0: Y, mode: Any) -> Solution | None:
    """The solution over one period from a point of an orbit, with dense output, by the flow map.

    `Orbit.solve` compiles a program of its own; that of the flow map is there where shooting found such an orbit in the
    same session. It is told of no modes but those of relays: off all surfaces h says the others.

    **Arguments:**

    - `orbit`: one orbit, whose numbers are known.
    - `t0`, `y0`, `mode`: a point on it, with the mode there.

    **Returns:** the solution; `None` if it begins in another mode, as it may on a surface, or if the program is not
    there.
    """
    system, t0 = arrays_of(orbit.system, np.asarray(orbit.t0).dtype), jnp.asarray(t0)
    given = of_relays(system, [jnp.asarray(m, jnp.int32) for m in mode])
    y0, integrator = jax.tree.map(jnp.asarray, y0), with_room(orbit.integrator, t0.dtype)
    if not is_followed(system, y0, given, integrator):
        return None
    sol = solution(system, t0, jnp.asarray(np.asarray(t0) + np.asarray(orbit.period)), y0, given, integrator)
    return sol if np.array_equal(sol.mode0, mode) else None
