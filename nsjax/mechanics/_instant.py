"""The forces of a scene at one instant."""

from typing import Any, TYPE_CHECKING

from .._types import Number
from ..system._system import SwitchValues
from ._direction import Term
from ._effect import Effect, ForceElement
from ._state import State


if TYPE_CHECKING:
    from ._scene import Scene


def needed(owner: str, other: str) -> str:
    """The path of an effect that `owner` needs, see `Effect.needs`."""
    return owner.rpartition(".")[0] if other == ".." else other


class Instant:
    """The forces at one instant, each worked out once: friction asks for that of its contact."""

    def __init__(self, scene: "Scene", t: Any, y: State, s: SwitchValues):
        self._t, self._y, self._s = t, y, s
        self._effects = dict(scene.placed)
        self._names: dict[str, dict[str, str]] = {}
        for owner, switch, name in scene.switches_of_effects:
            self._names.setdefault(owner, {})[switch.name] = name
        self._found: dict[str, Number] = {}

    def values(self, owner: str, effect: Effect) -> SwitchValues:
        """The values of its own switches, and the forces that it needs."""
        own = {local: self._s[name] for local, name in self._names.get(owner, {}).items()}
        forces = {}
        for local, other in effect.needs.items():
            forces[local] = self.force(needed(owner, other))
        return SwitchValues(type(effect).__name__, own | forces)

    def _raw(self, owner: str) -> Number:
        if owner not in self._found:
            effect = self._effects[owner]
            assert isinstance(effect, ForceElement)
            self._found[owner] = effect.force(self._t, effect.at(self._y), self.values(owner, effect))
        return self._found[owner]

    def force(self, owner: str) -> Number:
        """The force of an effect along its direction."""
        effect = self._effects[owner]
        return -self._raw(owner) if isinstance(effect, ForceElement) and effect.resists else self._raw(owner)

    def terms(self, owner: str, effect: Effect) -> list[Term]:
        """The generalised forces of an effect, as the scene sums them."""
        if isinstance(effect, ForceElement):
            return effect.along.terms(self._y, self._raw(owner), -1 if effect.resists else 1)
        return effect.terms(self._t, self._y, self.values(owner, effect))
