"""The field of one mode as a system of its own, whatever its surfaces do to the flow."""

from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp

from .._types import Scalar, Y
from ..system._mode import ModeState
from ..system._model import SwitchedSystem
from ..system._system import System


class ModeFlow(System):
    """y' = f(t, y) in one mode; with `sizes`, of the structure of the state, that of the state measured in these."""

    model: SwitchedSystem
    state: ModeState
    sizes: Any = None

    @property
    def jumps_in_time(self) -> str:  # pyright: ignore[reportIncompatibleVariableOverride]
        return "ignored" if self.model.clocks else "missed"  # ticks are events, at which its arcs end

    def vector_field(self, t: Scalar, y: Y, s: Any) -> Y:
        return self.field(self.model, t, y)

    def field(self, model: SwitchedSystem, t: Scalar, y: Y) -> Y:
        """The field of a model in this mode."""
        if self.sizes is None:
            return model.flow(t, y, self.state)
        return jax.tree.map(
            jnp.divide, model.flow(t, jax.tree.map(jnp.multiply, y, self.sizes), self.state), self.sizes
        )


class VariedModeFlow(ModeFlow):
    """A state with perturbations of it, Φ' = (∂f/∂y) Φ (3.5), which are columns of the structure of the state, with one
    leading axis. Some of them may be due to changes of the model: `moved` are those of its arrays, in each column, of
    the structure of the model with None for every array that stays as it is."""

    moved: Any = None

    def vector_field(self, t: Scalar, y: Y, s: Any) -> Y:
        y, columns = y
        moved = jax.tree.map(lambda _: None, self.model) if self.moved is None else self.moved
        changed, still = eqx.partition(self.model, jax.tree.map(_is_array, moved, is_leaf=_is_none))

        def rhs(y: Y, changed: Any) -> Y:
            return self.field(eqx.combine(changed, still), t, y)

        def change(dy: Y, moved: Any) -> Y:
            return jax.jvp(rhs, (y, changed), (dy, moved))[1]

        return rhs(y, changed), jax.vmap(change)(columns, moved)


def _is_none(x: Any) -> bool:
    return x is None


def _is_array(x: Any) -> bool:
    return x is not None
