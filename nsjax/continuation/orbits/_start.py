"""Where the continuation of an orbit sets out: the curve of its orbits over a parameter, and its itinerary on it."""

import dataclasses

import jax
import jax.flatten_util as jfu
import jax.numpy as jnp
import numpy as np
from jaxtyping import Int

from ..._types import Y
from ...flow._integrator import Integrator
from ...flow._results import is_okay
from ...orbits._orbit import Orbit
from ...orbits.segments._equations import guard_sizes, OrbitCurve
from ...orbits.segments._itinerary import Start, starts_of
from ...orbits.segments._segment_flow import exactness, fits, NEVER
from ...system._model import SwitchedSystem
from ...system._parameter import get_parameter, parameter_path
from ...system._system import arrays_of, System


AT_REST = 1e-9  # a state that varies less is known to few digits only


def check_precision(orbit: Orbit) -> None:
    dtype = jnp.result_type(orbit.t0)
    if dtype != jnp.float64:
        raise ValueError(
            f"Continuation locates special points to more digits than {dtype} has: call "
            '`jax.config.update("jax_enable_x64", True)` first, and find `orbit` in double precision.'
        )


def curve_and_start(
    system: System, orbit: Orbit, parameter: str, interval: tuple[float, float], scale: Y | None, integrator: Integrator
) -> tuple[OrbitCurve, Start]:
    """The curve, in units of the orbit, and the orbit with its itinerary."""
    path = parameter_path(system, parameter)
    low, high = (float(x) for x in interval)
    check_precision(orbit)
    if not bool(is_okay(orbit.result)) or not bool(orbit.admissible):
        raise ValueError("Argument `orbit` must be an orbit that was found, and is admissible, but is not.")
    system = arrays_of(system, jnp.float64)
    value = float(get_parameter(system, path))
    if not low < high or not low <= value <= high:
        raise ValueError(
            f"Argument `interval` must be (low, high) and hold {value:.6g}, the value of `{parameter}` in "
            f"`system`, but is ({low:.6g}, {high:.6g})."
        )
    model = SwitchedSystem.forwards(system, orbit.t0, orbit.y0)
    (start,) = starts_of(model, [orbit])
    sizes = sizes_of(orbit, scale)
    curve = OrbitCurve(
        model=model,
        path=path,
        like=orbit.y0,
        low=np.asarray(low),
        width=np.asarray(high - low),
        sizes=sizes,
        time=np.asarray(float(orbit.period)),
        guard_sizes=np.ones(len(model.slots)),
        order=order_of(system, orbit),
        normal=np.zeros_like(sizes),
        reference=np.zeros_like(sizes),
        integrator=integrator,
        exact=exactness(model, jnp.asarray(orbit.t0), orbit.y0),
    )
    normal, reference = phase_of(curve, start)
    curve = dataclasses.replace(curve, normal=normal, reference=reference)
    curve = dataclasses.replace(curve, guard_sizes=guard_sizes(curve, start))
    return dataclasses.replace(curve, exact=_exact(curve, start, value)), start


def order_of(system: System, orbit: Orbit) -> Int[np.ndarray, ""]:
    """In how many periods of the forcing it closes."""
    order = 1 if system.period is None else round(float(orbit.period) / float(system.period))
    return np.asarray(order, np.int32)


def _exact(curve: OrbitCurve, start: Start, value: float) -> int:
    """Which flows are known by their exponentials, given the forcing along the orbit."""
    if curve.exact == NEVER:
        return NEVER
    flow, itinerary = curve.on(start.itinerary).flow, start.itinerary
    states = [curve.state(jnp.asarray(itinerary.mode[i]), jnp.asarray(itinerary.part[i])) for i in itinerary.rows]
    rows = zip(start.begin, start.end, start.x, states)
    known = all(bool(fits(flow, a, b, x, jnp.asarray(value), state)) for a, b, x, state in rows)
    return curve.exact if known else NEVER


def sizes_of(orbit: Orbit, scale: Y | None) -> np.ndarray:
    """The typical size of each component of the state: half its range along the orbit, unless told; of an orbit that is
    at rest its distance from zero, or one."""
    path = orbit.path(33)
    rows = jax.vmap(jax.vmap(lambda y: jfu.ravel_pytree(y)[0]))(path.y)
    rows = np.asarray(rows).reshape(-1, rows.shape[-1])
    if scale is not None:
        sizes = np.abs(np.asarray(jfu.ravel_pytree(scale)[0], np.float64))
        if sizes.shape != rows.shape[1:] or not np.all(sizes > 0):
            raise ValueError("Argument `scale` must hold a positive number for each component of the state.")
        return sizes
    rows = rows[np.isfinite(rows).all(axis=1)]
    sizes = np.ptp(rows, axis=0) / 2
    largest, away = sizes.max(), np.abs(rows).max()
    if largest <= AT_REST:
        return np.full_like(sizes, away if away > AT_REST else 1.0)
    return np.where(sizes > 1e-12 * largest, sizes, largest)


def phase_of(curve: OrbitCurve, start: Start) -> tuple[np.ndarray, np.ndarray]:
    """The plane through an autonomous orbit without events in which its beginning stays: normal, point."""
    x = np.asarray(start.x[0])
    if not curve.autonomous:
        return np.zeros_like(x), x
    state = curve.state(jnp.asarray(start.itinerary.mode[0]), jnp.asarray(start.itinerary.part[0]))
    f = np.asarray(jfu.ravel_pytree(curve.model.flow(jnp.asarray(start.begin[0]), curve.unravel(x), state))[0])
    return f / np.maximum(f @ f, 1e-300), x
