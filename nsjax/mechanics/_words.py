"""How a scene prints: its equations of motion, and what its effects are."""

import dataclasses
from typing import Any, TYPE_CHECKING

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

from ._direction import Direction
from ._instant import Instant
from ._mass import MassMatrix


if TYPE_CHECKING:
    from ._scene import Scene


def described(scene: "Scene") -> str:
    """The equations and effects of a scene, a line for each."""
    placed = scene.placed
    acting = {name: [] for name in scene.coordinates}
    for name, effect in placed:
        for coordinate in felt(scene, name, effect):
            acting[coordinate].append(name)
    lines = [f"scene of {', '.join(scene.coordinates)}"]
    for i, names in enumerate(acting.values()):
        lines.append(f"  {_inertia(scene, i)} = {' + '.join(names) or '0'}")
    width = max([len(name) for name, _ in placed], default=0)
    for name, effect in placed:
        along = ", ".join(str(d) for d in effect.directions)
        where = f"{type(effect).__name__}" + (f" along {along}" if along else "")
        formula = f": {effect.formula}" if effect.formula else ""
        values = ", ".join(numbers(effect))
        lines.append(f"  {name:<{width}}  {where}{formula}" + (f",  {values}" if values else ""))
    switches = ", ".join(f"{k.name} ({type(k).__name__})" for k in scene.switches)
    lines.append(f"  switches: {switches or 'none'}")
    return "\n".join(lines)


def numbers(module: Any) -> list[str]:
    """The parameters of an effect, as `k = 1`."""
    found = []
    for field in dataclasses.fields(module):
        value = getattr(module, field.name)
        if isinstance(value, Direction) or value is None:
            continue
        if isinstance(value, int | float | jax.Array | np.ndarray | np.generic):
            found.append(f"{field.name} = {number(value)}")
        elif isinstance(value, eqx.Module) and field.name == "law":
            found += numbers(value)
    return found


def number(value: Any) -> str:
    try:
        return f"{float(np.asarray(value)):g}"
    except Exception:  # a value that is traced, or one of many
        return "?"


def _inertia(scene: "Scene", i: int) -> str:
    """The left side of the equation of a coordinate."""
    name = scene.coordinates[i]
    if isinstance(scene.mass, tuple):
        own = number(scene.mass[i])
        added = any(effect.adds_mass for _, effect in scene.placed)
        return f"({own} + added mass) {name}''" if added else f"{own} {name}''"
    if not isinstance(scene.mass, MassMatrix):
        return f"(M(q) q'' + Coriolis)_{name}"
    row = [(j, v) for (a, b), v in scene.mass(None).items() for j in {a, b} if i in (a, b) and (a == b or j != i)]
    return " + ".join(f"{number(v)} {scene.coordinates[j]}''" for j, v in sorted(row))


def felt(scene: "Scene", name: str, effect: Any) -> list[str]:
    """The coordinates on which an effect acts."""

    def forces(y: Any, values: tuple) -> dict[str, Any]:
        now = Instant(scene, jnp.zeros(()), y, scene.values(values))
        return {coordinate: jnp.asarray(value) for coordinate, _, value in now.terms(name, effect)}

    y = jax.tree.map(jnp.asarray, scene.state())
    found = jax.eval_shape(forces, y, tuple(jnp.zeros(()) for _ in scene.switches))
    return [coordinate for coordinate in scene.coordinates if coordinate in found]
