"""The map by which the attractors of a system are looked at."""

from typing import Any

import jax.numpy as jnp

from .._types import Scalar, Y
from ..flow._integrator import Integrator
from ..system._system import System
from ._iterate import PoincareMap
from ._section import section_map
from ._stroboscopic import Advance, phase_map


def map_of(
    system: System, section: Any, how: tuple[int, Any], interval: Any, start: tuple[Scalar, Y], integrator: Integrator
) -> PoincareMap:
    """That of a section, or of the period of the forcing, or over an `interval`."""
    t0, y0 = start
    if interval is not None:
        if system.period is not None or section is not None:
            raise ValueError("Argument `interval` is for autonomous systems without `section`.")
        return Advance(integrator, 1, jnp.asarray(interval, t0.dtype))
    if section is not None:
        return section_map(system, section, *how, t0, y0, integrator)
    if system.period is None:
        raise ValueError(
            f"`{type(system).__name__}` is autonomous: give a `section` that its periodic orbits cross, or an "
            "`interval` if its solutions come to rest."
        )
    return phase_map(system, 1, integrator)
