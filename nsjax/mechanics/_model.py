"""A model with parameters of its own that is built as a scene."""

import abc
from collections.abc import Mapping
from typing import Any

from .._types import Scalar
from ..system._switch import AbstractSwitch, within
from ..system._system import SwitchValues, System
from ._scene import Scene
from ._state import State


class SceneModel(System):
    """A system whose parameters are fields of its own, and which is a scene for each of their values: where one number
    enters several effects, or effects are the same many times.

    ```python
    class Blocks(nsjax.mechanics.SceneModel):
        v: float = 0.2
        n: int = 3

        @property
        def scene(self):
            belts = {f"belt{i}": Friction(f"x{i}", Coulomb(1.0), v=self.v) for i in range(self.n)}
            return Scene({f"x{i}": 1.0 for i in range(self.n)}, **belts)
    ```
    """

    @property
    @abc.abstractmethod
    def scene(self) -> Scene:
        """The scene. Which effects it has must not depend on the values of parameters that are numbers."""

    def vector_field(self, t: Scalar, y: State, s: SwitchValues) -> State:
        return self.scene.vector_field(t, y, s)

    @property
    def switches(self) -> tuple[AbstractSwitch, ...]:
        return tuple(within(k, ("scene",), k.name) for k in self.scene.switches)

    @property
    def period(self) -> Any:
        return self.scene.period

    @property
    def laws(self) -> list[tuple[str, str, Any, Any]]:
        return self.scene.laws

    def assembled(self) -> System:
        return _Assembled(self, self.scene)

    def state(self, q: Mapping[str, Any] | None = None, v: Mapping[str, Any] | None = None) -> State:
        """See `Scene.state`."""
        return self.scene.state(q, v)

    def __str__(self) -> str:
        return str(self.scene)


class _Assembled(SceneModel):
    """A scene model with its scene, which is not made anew for each of its switches wherever one of them is asked."""

    model: SceneModel
    built: Scene

    @property
    def owner(self) -> System:
        return self.model

    @property
    def scene(self) -> Scene:
        return self.built
