"""Where the continuation of an orbit sets out: the curve of its orbits over a parameter, and its itinerary on it."""

import dataclasses

import jax.numpy as jnp
import numpy as np
from jaxtyping import Int

from ..._types import Y
from ...flow._integrator import Integrator
from ...flow._results import is_okay
from ...orbits._orbit import Orbit
from ...orbits.segments._equations import field_at, guard_sizes, OrbitCurve
from ...orbits.segments._itinerary import Start, starts_of
from ...orbits.segments._segment_flow import exactness, SegmentFlow, states_along
from ...system._model import SwitchedSystem
from ...system._parameter import FreeParameters, get_parameter, parameter_path
from ...system._system import arrays_of, System
from ...system._ticking import check_jumps_declared
from .._checks import check_interval, check_precision, checked_scale


AT_REST = 1e-9  # a state that varies less is known to few digits only


def curve_and_start(
    system: System, orbit: Orbit, parameter: str, interval: tuple[float, float], scale: Y | None, integrator: Integrator
) -> tuple[OrbitCurve, Start]:
    """The curve, in units of the orbit, and the orbit with its itinerary."""
    path = parameter_path(system, parameter)
    low, high = (float(x) for x in interval)
    check_precision(jnp.result_type(orbit.t0), "find `orbit`")
    if not bool(is_okay(orbit.result)) or not bool(orbit.admissible):
        raise ValueError("Argument `orbit` must be an orbit that was found, and is admissible, but is not.")
    system = arrays_of(system, jnp.float64)
    value = float(get_parameter(system, path))
    check_interval("interval", (low, high), value, f"of `{parameter}` in `system`")
    told = None if scale is None else checked_scale(orbit.y0, scale)
    check_jumps_declared(system, jnp.asarray(orbit.t0), orbit.y0)
    model = SwitchedSystem.forwards(system, orbit.t0, orbit.y0, smooth=True)
    (start,) = starts_of(model, [orbit])
    n = len(start.x[0])
    curve = OrbitCurve(
        model=model,
        free=FreeParameters.of(system, path),
        like=orbit.y0,
        low=np.asarray(low),
        width=np.asarray(high - low),
        sizes=np.ones(n),
        time=np.asarray(float(orbit.period)),
        guard_sizes=np.ones(len(model.slots)),
        order=order_of(system, orbit),
        normal=np.zeros(n),
        reference=np.zeros(n),
        integrator=integrator,
        exact=exactness(model, jnp.asarray(orbit.t0), orbit.y0),
    )
    curve = dataclasses.replace(curve, sizes=_sizes(curve, start, value) if told is None else told)
    normal, reference = phase_of(curve, start)
    curve = dataclasses.replace(curve, normal=normal, reference=reference)
    return dataclasses.replace(curve, guard_sizes=guard_sizes(curve, start)), start


def order_of(system: System, orbit: Orbit) -> Int[np.ndarray, ""]:
    """In how many periods of the forcing it closes."""
    order = 1 if system.period is None else round(float(orbit.period) / float(system.period))
    return np.asarray(order, np.int32)


def _segments(curve: OrbitCurve, start: Start, value: float) -> tuple[SegmentFlow, list[tuple]]:
    """The flow of the segments, and for each what there is to say of it: times, first state and mode."""
    itinerary = start.itinerary
    states = [curve.state(itinerary.mode[i], itinerary.part[i]) for i in itinerary.rows]
    rows = zip(start.begin, start.end, start.x, states)
    return curve.on(itinerary).flow(jnp.asarray(value)), list(rows)


def _sizes(curve: OrbitCurve, start: Start, value: float) -> np.ndarray:
    """The typical size of each component of the state: half its range along the orbit; of an orbit that is at rest its
    distance from zero, or one."""
    flow, segments = _segments(curve, start, value)
    rows = np.concatenate([np.asarray(states_along(flow, *segment)) for segment in segments])
    rows = rows[np.isfinite(rows).all(axis=1)]
    sizes = np.ptp(rows, axis=0) / 2
    largest, away = sizes.max(), np.abs(rows).max()
    at_rest = AT_REST * float(curve.integrator.smallest_size(np.float64))
    if largest <= at_rest:
        return np.full_like(sizes, away if away > at_rest else 1.0)
    return np.where(sizes > 1e-12 * largest, sizes, largest)


def phase_of(curve: OrbitCurve, start: Start) -> tuple[np.ndarray, np.ndarray]:
    """The plane through an autonomous orbit without events in which its beginning stays: normal, point."""
    x = np.asarray(start.x[0])
    if not curve.autonomous:
        return np.zeros_like(x), x
    at = np.asarray(start.begin[0]), x, start.itinerary.mode[0], start.itinerary.part[0]
    f = np.asarray(field_at(curve, jnp.asarray(curve.value), *at))
    return f / np.maximum(f @ f, 1e-300), x
