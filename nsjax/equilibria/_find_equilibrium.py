"""The search for equilibria."""

import itertools
from typing import Any

import equinox as eqx
import jax
import jax.core
import jax.numpy as jnp
import numpy as np

from .._numerics._compile import interactive, on_host
from .._numerics._jaxpr import is_constant
from .._numerics._root import Newton
from .._numerics._select import select
from .._types import StateT, Y
from ..flow._arguments import checked_start
from ..flow._results import raise_if, RESULTS
from ..orbits._orbit import ravel
from ..system._model import SwitchedSystem
from ..system._system import arrays_of, System
from ._equilibrium import Equilibrium, equilibrium_in


MODES = 729  # the largest number of modes that are tried one by one


def find_equilibrium(
    system: System,
    y0: StateT,
    *,
    mode: Any = None,
    t: Any = 0.0,
    tol: float | None = None,
    max_steps: int = 50,
    throw: bool = True,
) -> Equilibrium[StateT]:
    """Finds an equilibrium by optimistix's Newton method: f(t, y, s) = 0 in a mode, on surfaces that hold it with their
    multipliers λ as unknowns beside the state (2.19)-(2.20).

    Its state, multipliers and eigenvalues are differentiable with respect to the parameters of `system`, by implicit
    differentiation.

    **Arguments:**

    - `system`: an autonomous model (or one that time does not enter at the forces).
    - `y0`: a guess.
    - `mode`: where to look, as `{"name": value}`, one value for each switch, or for one switch its value: `sgn` +1, -1
        or 0 for a state on the surface that it holds; `relay` 0 or 1; `impact` 1 for a resting contact. By default the
        mode of `y0`; and, if what is found from there is virtual, the admissible one of another mode that is nearest
        to `y0` (this needs concrete values: not under `jit` or `vmap`).
    - `t`: the time at which forces are taken.
    - `tol`, `max_steps`: of Newton's method, by default 1e-12 (float32: 1e-5) and 50.
    - `throw`: whether a failure raises; if not, look at `Equilibrium.result`.

    **Returns:** an `Equilibrium`, which may be a virtual one: see `admissible`.

    **Raises:** `ValueError` for a model that time enters; a runtime error if Newton's method does not converge.
    """
    system, y0, t, given, tol = checked_equilibrium(system, y0, t, mode, tol)
    model = SwitchedSystem.forwards(system, t, y0)
    newton = Newton(tol, max_steps)
    found = equilibrium_in(system, t, y0, _chosen(system, t, y0, given), newton)
    concrete = not any(isinstance(x, jax.core.Tracer) for x in jax.tree.leaves((system, y0)))
    if concrete and len(given) < len(system.switches) and not (found.result == RESULTS.successful and found.admissible):
        others = _in_all_modes(system, model, t, jax.tree.map(lambda x: x[None], y0), given, newton)
        others = [other for other in others if other.admissible]
        if others:
            found = min(others, key=lambda other: float(jnp.linalg.norm(ravel(other.y) - ravel(y0))))
    if throw:
        found = raise_if(found.result != RESULTS.successful, found.result, found)
    return found


def find_equilibria(
    system: System,
    starts: StateT,
    *,
    mode: Any = None,
    virtual: bool = False,
    t: Any = 0.0,
    tol: float | None = None,
    max_steps: int = 50,
) -> list[Equilibrium[StateT]]:
    """The different equilibria that Newton's method finds from many starting points in every mode.

    **Arguments:**

    - `system`, `t`, `tol`, `max_steps`: as for `find_equilibrium`.
    - `starts`: states to start from, leaves with a leading axis.
    - `mode`: modes of some or all switches, if only these are wanted.
    - `virtual`: whether virtual ones are wanted too.

    **Returns:** the equilibria, admissible ones first; those that share a state (on a surface that does not hold it)
    are one. Of a continuum, as sticking friction makes, those nearest to the starts.

    **Raises:** `ValueError` for more than 729 modes: give some by `mode`.
    """
    first = jax.tree.map(lambda x: jnp.asarray(x)[0], starts)
    system, first, t, given, tol = checked_equilibrium(system, first, t, mode, tol)
    starts = jax.tree.map(lambda x, like: jnp.asarray(x, like.dtype), starts, first)
    model = SwitchedSystem.forwards(system, t, first)
    found = _in_all_modes(system, model, t, starts, given, Newton(tol, max_steps))
    distinct: list[Equilibrium] = []
    rows = [np.asarray(ravel(one.y)) for one in found] + list(np.asarray(jax.vmap(ravel)(starts)))
    size = np.max(np.abs(rows), axis=0)
    size = np.where(size > 1e-12 * size.max(), size, size.max())  # what is smaller is rounding
    for one in sorted(found, key=lambda one: (not one.admissible, bool(one.boundary))):
        same = any(np.all(np.abs(ravel(one.y) - ravel(other.y)) <= 1e-8 * size) for other in distinct)
        if not same and (virtual or one.admissible):
            distinct.append(one)
    return distinct


def checked_equilibrium(system: System, y0: Y, t: Any, mode: Any, tol: float | None) -> tuple:
    t, y0, given = checked_start(system, t, y0, mode)
    system = arrays_of(system, t.dtype)
    values = system.values(tuple(jnp.zeros((), t.dtype) for _ in system.switches))
    ticks = any(switch.ticking for switch in system.switches)
    if ticks or not is_constant(lambda t: system.vector_field(t, y0, values), t):
        raise ValueError(
            f"`{type(system).__name__}` has no equilibrium, because time enters its vector field: look for a periodic "
            "orbit by `find_orbit`, or leave the forcing out of the model."
        )
    return system, y0, t, given, (1e-12 if jnp.finfo(t.dtype).eps < 1e-10 else 1e-5) if tol is None else tol


def _options(model: SwitchedSystem, given: dict[str, Any]) -> list[tuple[int, ...]]:
    """The modes that each switch may have."""
    options = []
    for k, switch in enumerate(model.switches):
        free = switch.modes
        if switch.signed:
            free = (-1, 0, 1) if k in model.holdable else (-1, 1)
        elif switch.unilateral and k not in model.contacts:
            free = (0,)
        options.append((int(given[switch.name]),) if switch.name in given else free)
    return options


@interactive
def _chosen(system: System, t: Any, y: Y, given: dict[str, Any]) -> tuple:
    """The mode that is given, and what is not given of it by the state."""
    model = SwitchedSystem.forwards(system, t, y)
    modes = zip([k.name for k in system.switches], _mode_of(model, t, y))
    return model.present(tuple(jnp.asarray(given.get(name, mode), jnp.int32) for name, mode in modes))


def _mode_of(model: SwitchedSystem, t: Any, y: Y) -> list[Any]:
    """By the signs of h; what lies on a surface that can hold it counts as held."""
    modes = []
    for k, switch in enumerate(model.switches):
        if switch.signed:
            h = model.least(k, t, y)
            noise = jnp.max(model.rounding(lambda t, y, k=k: model.h(k, t, y), t, y))
            on = 0 if k in model.holdable else 1
            modes.append(select(jnp.abs(h) <= noise, on, jnp.sign(h)).astype(jnp.int32))
        elif switch.levels:
            modes.append(model.level_at(k, t, y, jnp.asarray(switch.modes[0], jnp.int32)))
        else:
            modes.append(jnp.zeros((), jnp.int32))
    return modes


def _in_all_modes(
    system: System, model: SwitchedSystem, t: Any, starts: Y, given: dict[str, Any], newton: Newton
) -> list[Equilibrium]:
    """What Newton's method finds from every start in every mode."""
    table = list(itertools.product(*_options(model, given)))
    if table and any(map(model.conditional, range(len(table[0])))):
        columns = model.present(tuple(np.array(table, np.int32).T))
        table = list(dict.fromkeys(map(tuple, np.stack(columns, axis=1).tolist())))
    if len(table) > MODES:
        raise ValueError(f"Argument `mode` must leave at most {MODES} modes to be tried, but leaves {len(table)}.")
    number = len(jax.tree.leaves(starts)[0])
    # With NumPy, as JAX compiles a program for each operation.
    modes = tuple(np.tile(np.array(column, np.int32), number) for column in zip(*table))
    lanes = jax.tree.map(lambda x: np.repeat(np.asarray(x), len(table), axis=0), starts)
    batch = _batch(system, t, lanes, modes, newton)
    arrays, static = eqx.partition(batch, eqx.is_array)
    good = np.flatnonzero(np.asarray(batch.result == RESULTS.successful))
    each = on_host(arrays)
    return [eqx.combine(jax.tree.map(lambda x, i=i: jnp.asarray(x[i]), each), static) for i in good]


@interactive
def _batch(system: System, t: Any, starts: Y, modes: tuple, newton: Newton) -> Equilibrium:
    return jax.vmap(lambda y, mode: equilibrium_in(system, t, y, mode, newton))(starts, modes)
