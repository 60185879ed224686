"""Which method a sweep takes for a model."""

from typing import Any

import diffrax as dfx
import equinox as eqx
import jax.numpy as jnp

from .._numerics._products import full_products
from .._types import Scalar, Y
from ..system._mode import ModeState
from ..system._model import SwitchedSystem
from ..system._system import arrays_of, System
from ..system._ticking import ticking
from ._arguments import checked_start
from .affine._plan import planned
from .steppers._exponential import Affine


@full_products
def method_for(system: System, t0: Any, y0: Any) -> dfx.AbstractSolver:
    """Returns the solver that `nsjax.sweep` takes for a model if no solver and no step size controller are named.

    It depends on the model alone: not on the values of its parameters, nor on whether the sweep is called directly,
    within `jax.jit` or within a derivative. `nsjax.solve` outside of a sweep takes `diffrax.Tsit5()` for every model,
    whose program is compiled in a fifth of the time; with `solver=nsjax.method_for(system, t0, y0)` it solves as a
    sweep does.

    **Arguments:**

    - `system`: the model.
    - `t0`, `y0`: the start [time] and the state there, as for `solve`. Their values do not matter.

    **Returns:** `nsjax.Affine()` if the model is affine in the state in every mode, with switches and forcing that this
    solver steps from event to event; otherwise `diffrax.Tsit5()`.

    **Raises:** `TypeError`, `ValueError` for mistakes in the model or the arguments, as `solve` does.
    """
    t0, y0, _ = checked_start(system, t0, y0, None)
    plans: list[Any] = []

    def plan(system: System, t: Scalar, y: Y) -> None:
        model = SwitchedSystem(ticking(system.assembled(), t, y), jnp.ones_like(t), t, y, smooth=True).at(t)
        zero = jnp.zeros((), jnp.int32)
        none, parts = (zero,) * len(model.switches), tuple(zero if n > 1 else None for n in model.parts)
        plans.append(planned(model, dfx.NoProgressMeter(), ModeState(none, parts, none), t, y))

    eqx.filter_eval_shape(plan, arrays_of(system, t0.dtype), t0, y0)  # computes nothing
    return dfx.Tsit5() if plans[-1] is None else Affine()
