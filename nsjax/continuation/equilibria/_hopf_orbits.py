"""Periodic orbits that are born at Hopf bifurcations, smooth and discontinuous."""

from typing import Any

import jax
import jax.flatten_util as jfu
import jax.numpy as jnp
import numpy as np

from ...equilibria._equilibrium import Equilibrium
from ...equilibria._find_equilibrium import find_equilibrium
from ...flow._results import is_okay
from ...orbits._find_orbit import distinct_orbits, find_orbit
from ...orbits._orbit import Orbit, ravel
from ...system._parameter import parameter_path, put_parameter
from ...system._system import arrays_of, System
from ._bifurcation import Bifurcation


Families = list[list[Orbit]]


def hopf_orbits(
    system: System, bifurcation: Bifurcation, distance: Any, *, sizes: Any = None, **options: Any
) -> tuple[Families, Families]:
    """The periodic orbits that are born at a Hopf bifurcation, below it and above it: the first ones of their branches.

    `find_orbit` starts by shooting from states at several distances to the equilibrium, in the plane of its least
    damped pair of eigenvalues. `Bifurcation.with_orbits` takes what is found for evidence, and
    `plot.bifurcation_diagram` draws it.

    ```python
    (hopf,) = [b for b in branch.bifurcations if "Hopf" in b.kind]
    below, above = nsjax.continuation.hopf_orbits(system, hopf, [0.1, 0.2, 0.4])
    print(hopf.with_orbits(below, above))
    ```

    **Arguments:**

    - `system`: the model; its value of the parameter does not matter.
    - `bifurcation`: from a `Branch`.
    - `distance`: of the parameter from its value there, to either side; or several, the orbits for each being found
        from those for the one before.
    - `sizes`: distances from the equilibrium to start from; by default nine from 0.03 to 3 times the first
        `distance`, which the orbits of a discontinuous bifurcation grow in proportion to, or its root, at a smooth one.
    - `options`: as for `find_orbit`, which is given one try from each state.

    **Returns:** two lists of families of orbits, each with one orbit for every distance (up to where it is lost).

    **Raises:** `ValueError` for a point that is no Hopf bifurcation, or a `distance` that is not positive.
    """
    if bifurcation.period is None:
        raise ValueError(f"Argument `bifurcation` must be a Hopf bifurcation, but is: {bifurcation.name}.")
    distances = np.atleast_1d(np.asarray(distance, float))
    if np.any(distances <= 0):
        raise ValueError(f"Argument `distance` must be positive, as both sides are looked at, but got {distance}.")
    path = parameter_path(system, bifurcation.parameter)
    power = 1.0 if bifurcation.discontinuous else 0.5
    sizes = np.geomspace(0.03, 3, 9) * distances[0] ** power if sizes is None else np.asarray(sizes)

    def beside(side: int, distance: float) -> tuple[System, Equilibrium]:
        model = put_parameter(system, path, bifurcation.value + side * distance)
        return model, find_equilibrium(model, _guess(bifurcation, side, distance))

    found: tuple[Families, Families] = ([], [])
    for side, families in zip((-1, 1), found):
        model, at = beside(side, distances[0])
        families += [[orbit] for orbit in _around(model, at, bifurcation.period, sizes, options)]
        for number, (last, distance) in enumerate(zip(distances[:-1], distances[1:]), 1):
            model, there = beside(side, distance)
            for family in families:
                if len(family) < number:
                    continue  # it was lost before
                orbit = family[-1]
                grown = ravel(there.y) + (distance / last) ** power * (ravel(orbit.y0) - ravel(at.y))
                orbit = _found(model, jfu.ravel_pytree(at.y)[1](grown), orbit.period, options)
                family += [orbit] if is_okay(orbit.result) else []
            at = there
    return found


def _found(system: System, y: Any, period: Any, options: dict[str, Any]) -> Orbit:
    """One try."""
    return find_orbit(system, y, period=period, **({"method": "shooting"} | options | {"throw": False}))


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
    plane = np.eye(len(x))[0]
    pairs = [i for i in range(len(roots)) if np.imag(roots[i]) > 0]
    if pairs:
        pair = min(pairs, key=lambda i: abs(np.real(roots[i])))
        period, plane = 2 * np.pi / np.imag(roots[pair]), np.real(vectors[:, pair])
        plane = plane / np.linalg.norm(plane)
    system, guess = arrays_of(system, x.dtype), jnp.asarray(period, x.dtype)
    found = [_found(system, unravel(x + size * jnp.asarray(plane)), guess, options) for size in sizes]
    return distinct_orbits([orbit for orbit in found if is_okay(orbit.result)])
