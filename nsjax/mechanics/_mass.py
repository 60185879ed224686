"""The mass matrix: M(q) q'' = forces - Coriolis terms, solved for q'' with what is zero left out.

Lagrange's equations d/dt ∂T/∂v - ∂T/∂q = Q with T = ½ vᵀ M(q) v give M q'' = Q - M' v + ½ ∂(vᵀ M v)/∂q.
"""

from collections.abc import Callable, Mapping, Sequence
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax.core import Tracer

from .._numerics._jaxpr import dependence, touched
from .._numerics._linalg import solve_rows
from .._numerics._text import did_you_mean
from .._types import Scalar
from ._direction import check_name, function
from ._effect import Effect
from ._state import coordinates_type, State


Entries = dict[tuple[int, int], Any]
"""Of a symmetric matrix, by row and column, those on and above the diagonal that are not zero whatever the state."""

_DENSE = 64  # entries beside the diagonal from which on elimination is left to LAPACK


class MassMatrix(eqx.Module):
    """A constant symmetric mass matrix."""

    places: tuple[tuple[int, int], ...] = eqx.field(static=True)
    values: tuple[Any, ...]

    def __init__(self, matrix: Any, names: Sequence[str]):
        found = _of_table(matrix, names)
        self.places, self.values = tuple(found), tuple(found.values())

    def __call__(self, q: Any) -> Entries:
        return dict(zip(self.places, self.values))


class MassFunction(eqx.Module):
    """A mass matrix that is a function of q."""

    fn: Any

    def __call__(self, q: Any) -> Entries:
        return _of_table(self.fn(q), q._fields)


def given_mass(mass: Any, names: tuple[str, ...]) -> Any:
    """What a scene keeps of the masses that a user gives: by name, a matrix, or a function of q."""
    if isinstance(mass, Mapping):
        kind = coordinates_type(names)
        return kind(*[float(m) if isinstance(m, int) else m for m in (mass[name] for name in names)])
    if callable(mass):
        return MassFunction(function(mass))
    concrete = isinstance(mass, jax.Array) and not isinstance(mass, Tracer)
    return MassMatrix(np.asarray(mass) if concrete else mass, names)


def entries(mass: Any, effects: Sequence[tuple[str, Effect]], q: Any) -> Entries:
    """The mass matrix of the coordinates, and of the effects that add to it."""
    if isinstance(mass, MassMatrix | MassFunction):
        total = mass(q)
    else:
        total = {(i, i): m for i, m in enumerate(mass)}
    for owner, effect in effects:
        for place, m in _placed(effect.mass(q), q._fields, f"`mass` of effect `{owner}`").items():
            total[place] = total[place] + m if place in total else m
    return total


def reactions(effects: Sequence[tuple[str, Effect]], q: Any) -> Entries:
    """What is not symmetric in the inertia, by row and column."""
    total: Entries = {}
    for owner, effect in effects:
        for (row, column), m in effect.reaction(q).items():
            for name in (row, column):
                check_name(owner, name, q._fields)
            place = (q._fields.index(row), q._fields.index(column))
            total[place] = total[place] + m if place in total else m
    return total


def accelerations(mass: Callable[[Any], Entries], reaction: Entries, y: State, forces: dict[str, Any]) -> list[Any]:
    """q'' of each coordinate, for the generalised forces on those that have any."""
    right = [forces.get(name) for name in y.q._fields]
    matrix = mass(y.q)
    for i, term in _coriolis(mass, matrix, y).items():
        right[i] = term if right[i] is None else right[i] + term
    solved = _solved(matrix, reaction, right, jnp.asarray(y.v[0]))
    return [jnp.zeros_like(jnp.asarray(v)) if a is None else a for a, v in zip(solved, y.v)]


def check_mass(mass: Callable[[Any], Entries], q: Any, numbers: bool) -> None:
    """Checks that there is a mass for each coordinate, and, where `numbers` are known, that M is positive definite.

    **Raises:** `ValueError` that names the coordinate.
    """
    names = q._fields
    matrix = mass(q)
    for i, name in enumerate(names):
        if (i, i) not in matrix:
            raise ValueError(f"The mass of `{name}` must be positive, but it has none.")
        m = matrix[i, i]
        if numbers and not isinstance(m, Tracer) and not np.all(np.asarray(m) > 0):
            raise ValueError(f"The mass of `{name}` must be positive, but is {float(np.asarray(m)):g}.")
    if numbers and len(matrix) > len(names) and not any(isinstance(m, Tracer) for m in matrix.values()):
        least = np.linalg.eigvalsh(np.asarray(_table(matrix, len(names)), float))[0]
        if not least > 0:
            raise ValueError(f"The mass matrix must be positive definite, but has the eigenvalue {least:g}.")


def _of_table(matrix: Any, names: Sequence[str]) -> Entries:
    """Of a matrix, rows of numbers, or entries by name. Zeros that are written as numbers are left out."""
    if isinstance(matrix, Mapping):
        return _placed(matrix, names, "The mass matrix")
    n = len(names)
    table: Any = matrix if isinstance(matrix, list | tuple | np.ndarray) else jnp.asarray(matrix)
    rows = [len(row) if isinstance(row, list | tuple) else jnp.shape(row) for row in table]
    if not all(row in (n, (n,)) for row in rows) or len(rows) != n:
        raise ValueError(
            f"The mass matrix must be {n} by {n}, for {', '.join(names)}, but has {len(rows)} rows: {rows}."
        )
    found: Entries = {}
    for i in range(n):
        for j in range(i, n):
            m, mirrored = table[i][j], table[j][i]
            known = not isinstance(m, jax.Array) and not isinstance(mirrored, jax.Array)
            if known and abs(m - mirrored) > 1e-12 * (abs(m) + abs(mirrored)):
                raise ValueError(
                    f"The mass matrix must be symmetric, but has {m:g} for ({names[i]}, {names[j]}) and {mirrored:g} "
                    f"for ({names[j]}, {names[i]})."
                )
            if not (known and m == 0):
                found[i, j] = float(m) if known else m
    return found


def _placed(given: Mapping[Any, Any], names: Sequence[str], owner: str) -> Entries:
    """Entries by name as entries by place."""
    found: Entries = {}
    for key, m in given.items():
        pair = (key, key) if isinstance(key, str) else tuple(key)
        for name in pair:
            if name not in names:
                text = f"{owner} must name coordinates of the scene ({', '.join(names)}), but names `{name}`."
                raise ValueError(text + did_you_mean(str(name), names))
        i, j = sorted(names.index(name) for name in pair)
        found[i, j] = found[i, j] + m if (i, j) in found else m
    return found


def _coriolis(mass: Callable[[Any], Entries], matrix: Entries, y: State) -> dict[int, Any]:
    """-M' v + ½ ∂(vᵀ M v)/∂q, of the coordinates where it is not zero."""
    moving = [place for place in matrix if touched(lambda q, place=place: mass(q)[place], y.q).count(True)]
    if not moving:
        return {}
    found: dict[int, Any] = {}

    def add(i: int, term: Any) -> None:
        found[i] = found[i] + term if i in found else term

    def changing(q: Any) -> list[Any]:
        whole = mass(q)
        return [whole[place] for place in moving]

    rates = jax.jvp(changing, (y.q,), (y.v,))[1]
    for (i, j), rate in zip(moving, rates):
        add(i, -rate * y.v[j])
        if i != j:
            add(j, -rate * y.v[i])
    felt: Any = dependence(changing, y.q).any(axis=0)
    for k, name in enumerate(y.q._fields):
        if not felt[k]:
            continue

        def along(x: Any, name: str = name) -> list[Any]:
            return changing(y.q._replace(**{name: x}))

        x = jnp.asarray(y.q[k])
        slopes = jax.jvp(along, (x,), (jnp.ones_like(x),))[1]
        for n, (i, j) in enumerate(moving):
            if dependence(lambda x, n=n: along(x)[n], x).any():
                add(k, slopes[n] * y.v[i] * y.v[j] * (0.5 if i == j else 1.0))
    return found


def _table(matrix: Entries, n: int) -> Any:
    return [[matrix.get((min(i, j), max(i, j)), 0.0) for j in range(n)] for i in range(n)]


def _solved(matrix: Entries, reaction: Entries, right: list[Any], like: Scalar) -> list[Any]:
    """x with M x = right, where None stands for zero; `like` is a number of the state.

    By elimination without pivots, which a positive definite matrix does not need, written out for the entries that are
    there: a diagonal matrix costs one division for each force, a chain as much as it is long.
    """
    n, a, x = len(right), dict(matrix), list(right)
    if reaction:
        a |= {(j, i): m for (i, j), m in matrix.items()}
        for place, m in reaction.items():
            a[place] = a[place] + m if place in a else m
    if len(matrix) - n > _DENSE:
        table = [[a.get((i, j), a.get((j, i), 0.0) if not reaction else 0.0) for j in range(n)] for i in range(n)]
        rows = [jnp.stack([jnp.asarray(m, like.dtype) for m in row]) for row in table]
        return list(solve_rows(rows, jnp.stack([jnp.asarray(0.0 if v is None else v, like.dtype) for v in x])))
    for k in range(n):
        beside = [j for j in range(k + 1, n) if (k, j) in a]
        below = [i for i in range(k + 1, n) if (i, k) in a] if reaction else beside
        for i in below:
            factor = a[(i, k) if reaction else (k, i)] / a[k, k]
            for j in (j for j in beside if reaction or j >= i):
                a[i, j] = _less(a.get((i, j)), factor * a[k, j])
            if x[k] is not None:
                x[i] = _less(x[i], factor * x[k])
    for k in reversed(range(n)):
        for j in (j for j in range(k + 1, n) if (k, j) in a and x[j] is not None):
            x[k] = _less(x[k], a[k, j] * x[j])
        x[k] = None if x[k] is None else x[k] / a[k, k]
    return x


def _less(x: Any, y: Any) -> Any:
    return -y if x is None else x - y
