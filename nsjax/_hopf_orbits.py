"""Periodic orbits that are born at Hopf bifurcations, smooth and discontinuous."""

from typing import Any

import jax
import jax.flatten_util as jfu
import jax.numpy as jnp
import numpy as np

from ._bifurcation import Bifurcation
from ._equilibrium import Equilibrium
from ._find_equilibrium import find_equilibrium
from ._find_orbit import distinct_orbits, find_orbit
from ._orbit import Orbit
from ._parameter import parameter_path, put_parameter
from ._solution import is_okay
from ._system import System


def hopf_orbits(
    system: System, bifurcation: Bifurcation, distance: Any, *, sizes: Any = None, **options: Any
) -> tuple[list[Orbit], list[Orbit]]:
    """The periodic orbits below and above a Hopf bifurcation: the first ones of the branches that are born there.

    Where the equilibrium repels, what leaves it is followed to where it settles; else `find_orbit` starts from states
    at several distances, in the plane of the pair of eigenvalues. `Bifurcation.with_orbits` takes what is found for
    evidence.

    ```python
    (hopf,) = [b for b in branch.bifurcations if "Hopf" in b.kind]
    below, above = nsjax.hopf_orbits(system, hopf, 0.1)
    print(hopf.with_orbits(below, above))
    ```

    **Arguments:**

    - `system`: the model; its value of the parameter does not matter.
    - `bifurcation`: from a `Branch`.
    - `distance`: of the parameter from its value there, to either side.
    - `sizes`: distances from the equilibrium to start from; by default nine from 0.03 to 3 times `distance`, which the
        orbits of a discontinuous bifurcation grow in proportion to, or its root, at a smooth one.
    - `options`: as for `find_orbit`.

    **Returns:** two lists of orbits.

    **Raises:** `ValueError` for a point that is no Hopf bifurcation.
    """
    if bifurcation.period is None:
        raise ValueError(f"Argument `bifurcation` must be a Hopf bifurcation, but is: {bifurcation.name}.")
    path = parameter_path(system, bifurcation.parameter)
    if sizes is None:
        sizes = np.geomspace(0.03, 3, 9) * (distance if bifurcation.discontinuous else np.sqrt(distance))
    found = []
    for side in (-1, 1):
        value = bifurcation.value + side * float(distance)
        beside = put_parameter(system, path, value)
        at = find_equilibrium(beside, _guess(bifurcation, side, float(distance)))
        found.append(_around(beside, at, bifurcation.period, np.asarray(sizes), options))
    return found[0], found[1]


def _guess(bifurcation: Bifurcation, side: int, distance: float) -> Any:
    """Along the branch with fewest unstable eigenvalues in the static sense: the one that goes on through the point."""
    halves = [half for half in bifurcation.halves if half.side == side]
    if not halves:
        return bifurcation.y
    middle = halves[0] if len(halves) < 3 else min(halves, key=lambda h: sum(h.index == o.index for o in halves))
    y, rate = middle.tangent
    return jax.tree.map(lambda a, d: a + d * side * distance / abs(rate), bifurcation.y, y)


def _around(system: System, at: Equilibrium, period: float, sizes: np.ndarray, options: dict[str, Any]) -> list[Orbit]:
    x, unravel = jfu.ravel_pytree(at.y)
    roots, vectors = np.linalg.eig(np.asarray(at.jacobian))
    pairs = [i for i in range(len(roots)) if roots[i].imag > 0]
    plane = np.eye(len(x))[0]
    if pairs:
        pair = min(pairs, key=lambda i: abs(np.real(roots[i])))
        period, plane = 2 * np.pi / roots[pair].imag, np.real(vectors[:, pair])
        plane = plane / np.linalg.norm(plane)
    tries: list[dict[str, Any]] = [dict(size=size, period=period) for size in sizes]
    if np.any(np.real(roots) > 0):
        tries.insert(0, dict(size=sizes[0], period=None))
    found = []
    for one in tries:
        y = unravel(x + one["size"] * jnp.asarray(plane))
        orbit = find_orbit(system, y, period=one["period"], **({"method": "shooting", "throw": False} | options))
        found += [orbit] if is_okay(orbit.result) else []
        if found and one["period"] is None:
            break  # what attracts
    return distinct_orbits(found)
