"""The field of one mode as a system of its own, whatever its surfaces do to the flow."""

from typing import Any

import equinox as eqx
import jax
from jaxtyping import Array

from .._types import Scalar, Y
from ..system._mode import ModeState
from ..system._model import SwitchedSystem
from ..system._parameter import Path
from ..system._system import System


class ModeFlow(System):
    """y' = f(t, y) in one mode."""

    model: SwitchedSystem
    state: ModeState

    def vector_field(self, t: Scalar, y: Y, s: Any) -> Y:
        return self.model.flow(t, y, self.state)


class VariedModeFlow(ModeFlow):
    """A state with perturbations of it, Φ' = (∂f/∂y) Φ (3.5), which are columns of the structure of the state, with one
    leading axis. Some of them may be due to a parameter (or to several): `moved` is its change in each."""

    path: Path = eqx.field(static=True, default=())
    value: Array | None = None
    moved: Array | None = None

    def vector_field(self, t: Scalar, y: Y, s: Any) -> Y:
        y, columns = y

        def rhs(y: Y, value: Array | None) -> Y:
            model = self.model if value is None else self.model.with_parameter(self.path, value)
            return model.flow(t, y, self.state)

        def change(dy: Y, dv: Array | None) -> Y:
            return jax.jvp(rhs, (y, self.value), (dy, dv))[1]

        return rhs(y, self.value), jax.vmap(change)(columns, self.moved)
