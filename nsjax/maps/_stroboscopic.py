"""The T-advance map (6.10) of a forced system: from one phase of the forcing to the same of a later period."""

from typing import Any

import diffrax as dfx
import equinox as eqx
import jax.numpy as jnp

from .._numerics._text import positive
from .._types import Scalar, Y
from ..flow._integrator import Integrator
from ..flow._results import RESULTS
from ..flow._solution import Solution
from ..flow._solve import integrate
from ..system._checks import check_system
from ..system._system import System
from ._iterate import Iterate, iterated, PoincareMap


class Advance(PoincareMap):
    """From one phase of the forcing to the same of a later period; or for an autonomous system over an interval."""

    order: int = eqx.field(static=True)
    interval: Scalar | None = None  # the period, if none is given

    def flow_of(self, system: System) -> System:
        return system

    def horizon(self, system: System, t: Scalar) -> Scalar:
        return jnp.asarray(system.period if self.interval is None else self.interval, t.dtype) * self.order

    def passage(
        self, system: System, here: tuple[Scalar, Scalar, Y], mode: Any, still: bool = False
    ) -> tuple[Scalar, Y, RESULTS, Solution]:
        # Each time from t0, so that time does not lose digits.
        t0, t, y = here
        period = self.horizon(system, t)
        sol = integrate(system, t0, t0 + period, y, self.integrator, mode=mode or None, still=still)
        return t + period, sol.y1, sol.result, sol


def phase_map(system: System, order: int, integrator: Integrator) -> Advance:
    """The map over periods of the forcing."""
    check_system(system)
    positive("order", order)
    if system.period is None:
        raise ValueError(
            f"Argument `system` must be forced for a map over its period, but `{type(system).__name__}.period` is "
            "None. For an autonomous system take `nsjax.poincare_map` with a section."
        )
    return Advance(integrator, order)


def stroboscopic_map(
    system: System,
    y0: Y,
    *,
    order: int = 1,
    iterates: int | None = None,
    t0: Any = 0.0,
    mode: Any = None,
    solver: dfx.AbstractSolver | None = None,
    stepsize_controller: dfx.AbstractStepSizeController | None = None,
    rtol: float | None = None,
    atol: float | None = None,
    max_steps: int = 4096,
    max_events: int = 256,
    adjoint: dfx.AbstractAdjoint = dfx.ForwardMode(),
    throw: bool = True,
) -> Iterate:
    """The T-advance map (6.10) of a forced system: the state `order` periods of the forcing later.

    Its derivative by `jax.jacfwd` is the fundamental solution matrix.

    **Arguments:**

    - `system`: the model, whose `period` is not None.
    - `y0`: the state at `t0`.
    - `order`: over how many periods of the forcing.
    - `iterates`: how many iterates, which then have a leading axis; by default one, without.
    - `t0`: the phase of the forcing [time].
    - `mode`, `solver`, `stepsize_controller`, `rtol`, `atol`, `adjoint`: as for `solve`. `max_steps`, `max_events`: for
        each iterate.
    - `throw`: whether a failure raises; if not, look at `Iterate.result`.

    **Returns:** an `Iterate`.

    **Raises:** `ValueError` for an autonomous system; a runtime error where `solve` fails.
    """
    integrator = Integrator(solver, stepsize_controller, max_steps, max_events, adjoint)

    def make(system: System, t: Scalar, y: Y) -> PoincareMap:
        return phase_map(system, order, integrator.checked(t.dtype, rtol=rtol, atol=atol))

    return iterated(make, system, (t0, y0, mode), iterates, 1, throw)
