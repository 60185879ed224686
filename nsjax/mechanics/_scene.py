"""A mechanical system from a list of what acts in it."""

from collections.abc import Mapping, Sequence
from typing import Any, cast, TYPE_CHECKING

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax.core import Tracer

from .._numerics._text import did_you_mean
from .._types import Scalar
from ..system._model import SwitchedSystem
from ..system._switch import AbstractSwitch, within
from ..system._system import arrays_of, SwitchValues, System
from ._direction import check_name, signed_sum
from ._effect import Effect, ForceElement
from ._instant import Instant, needed
from ._mass import accelerations, check_mass, Entries, entries, given_mass, MassFunction, reactions
from ._period import common, multiple_of
from ._sketch import sketch
from ._state import coordinates_type, State
from ._words import described


if TYPE_CHECKING:
    from matplotlib.axes import Axes


class Scene(System):
    """A mechanical system M(q) q'' = Σ forces, made of coordinates and effects: with just the switches and terms that
    the effects need, so that what is not listed costs nothing.

    ```python
    from nsjax.mechanics import Contact, Friction, Rigid, Scene, Spring

    scene = Scene(
        {"x": 1.0},
        spring=Spring("x", k=1.0),
        belt=Friction("x", v=0.2, slip=1.0, stick=2.0),
        stop=Contact(lambda q: 4.0 - q.x, Rigid(e=0.5)),
    )
    sol = nsjax.solve(scene, 0.0, 40.0, scene.state({"x": 2.5}))
    branch = nsjax.continue_orbit(scene.without("stop"), orbit, "belt.v", (0.1, 0.5))
    ```

    It is a `System` like any other. Its state is read by name, `y.q.x` and `y.v.x`. A switch is called as its effect:
    `belt`, or, of an effect with several, `stop.friction`. An effect is `scene.belt`, its parameters are
    `scene.belt.v`, to be replaced by `equinox.tree_at(lambda scene: scene.belt.v, scene, 0.3)`; a mass is
    `scene.mass.x`. In continuation and sweeps a parameter goes by such a path: "belt.v", "stop.e", "mass.x".

    **Arguments:**

    - `coordinates`: the masses by the names of the coordinates [kg], or, with `mass`, the names alone.
    - `mass`: a symmetric mass matrix in the order of the names, or a function of q that returns one (as rows, or as
        `{"x": m, ("x", "phi"): m_12}`); its Coriolis terms are added. Zeros that are numbers are left out.
    - `units`: of the coordinates by their names, as `{"x": "m", "phi": "rad"}`: for pictures and reports of the command
        line. Nothing is computed with them.
    - `effects`: what acts, by name.

    **Raises:** `TypeError` for what is no effect; `ValueError` for units of an unknown coordinate, for an effect that
        asks for an unknown coordinate or contact, or is named as something a scene has already, for a mass that is not
        positive, or for forces whose periods have no common one.
    """

    mass: Any
    effect_list: tuple[Effect, ...]
    names: tuple[str, ...] = eqx.field(static=True)
    coordinates: tuple[str, ...] = eqx.field(static=True)
    multiple: int = eqx.field(static=True)  # how many of the first period of an effect make the scene's
    unit_list: tuple[str, ...] = eqx.field(static=True)  # of the coordinates; empty where none is known

    def __init__(
        self,
        coordinates: Mapping[str, Any] | Sequence[str],
        /,
        *,
        mass: Any = None,
        units: Mapping[str, str] | None = None,
        **effects: Effect,
    ):
        by_name = isinstance(coordinates, Mapping)
        if isinstance(coordinates, str) or not (by_name or isinstance(coordinates, Sequence)):
            raise TypeError(
                f"Argument `coordinates` must give masses by name, as {{'x': 1.0}}, or names, but got {coordinates!r}."
            )
        if by_name == (mass is not None):
            have = "has masses of its own" if by_name else "has names alone"
            raise ValueError(f"Argument `mass` must give the mass matrix just if `coordinates` has not: this {have}.")
        kind = coordinates_type(coordinates)
        self.coordinates = kind._fields
        self.mass = given_mass(coordinates if by_name else mass, kind._fields)
        for name in units or {}:
            if name not in kind._fields:
                known = ", ".join(kind._fields)
                text = f"Argument `units` must name coordinates of the scene ({known}), but names `{name}`."
                raise ValueError(text + did_you_mean(str(name), kind._fields))
        self.unit_list = tuple((units or {}).get(name, "") for name in kind._fields)
        for name, effect in effects.items():
            _check_effect(name, effect)
        self.names, self.effect_list, self.multiple = tuple(effects), tuple(effects.values()), 1
        others = dict(self.placed)
        for name, effect in others.items():
            effect.check(name, self.coordinates, others)
        with jax.ensure_compile_time_eval():
            check_mass(self._entries, kind(*[np.zeros(())] * len(kind._fields)), not self._mass_varies)
        periods = self._periods
        self.multiple = multiple_of(periods) if periods else 1

    def __getattr__(self, name: str) -> Any:
        """An effect by its name."""
        names = self.__dict__.get("names", ())
        if name in names:
            return self.effect_list[names.index(name)]
        raise AttributeError(f"`Scene` has no attribute or effect `{name}`." + did_you_mean(name, names))

    @property
    def effects(self) -> dict[str, Effect]:
        """The effects by name."""
        return dict(zip(self.names, self.effect_list))

    @property
    def units(self) -> dict[str, str]:
        """The units of the coordinates that have one, by name."""
        return {name: unit for name, unit in zip(self.coordinates, self.unit_list) if unit}

    @property
    def placed(self) -> list[tuple[str, Effect]]:
        """All effects, those within others too, by the path that leads to them."""

        def unfolded(name: str, effect: Effect) -> list[tuple[str, Effect]]:
            inner = [unfolded(f"{name}.{part}", one) for part, one in effect.parts.items()]
            return [(name, effect), *[one for parts in inner for one in parts]]

        return [one for name, effect in zip(self.names, self.effect_list) for one in unfolded(name, effect)]

    @property
    def members(self) -> dict[str, Any]:
        return self.effects | {"mass": self.mass}

    @property
    def laws(self) -> list[tuple[str, str, Any, Any]]:
        found: list[tuple[str, str, Any, Any]] = []
        for name, effect in self.placed:
            found += [(f"{name}.{part}", law, good, value) for part, law, good, value in effect.laws()]
        if isinstance(self.mass, tuple):
            found += [(f"mass.{n}", "positive", jnp.asarray(m) > 0, m) for n, m in zip(self.coordinates, self.mass)]
        return found

    # The model.

    @property
    def switches(self) -> tuple[AbstractSwitch, ...]:
        found = self.switches_of_effects
        effects, names = dict(self.placed), [name for _, _, name in found]

        def condition(owner: str, switch: AbstractSwitch) -> str:
            if switch.condition:
                return f"{owner}.{switch.condition}"
            contact = needed(owner, effects[owner].needs.get("normal", ""))
            return contact if contact in names else ""  # a normal force may be there at all times

        return tuple(within(k, tuple(owner.split(".")), name, condition(owner, k)) for owner, k, name in found)

    @property
    def switches_of_effects(self) -> list[tuple[str, AbstractSwitch, str]]:
        """The path of an effect, a switch of it, and the name that this has in the scene."""
        found = []
        for owner, effect in self.placed:
            own = effect.switches
            found += [(owner, k, owner if len(own) == 1 else f"{owner}.{k.name}") for k in own]
        return found

    def vector_field(self, t: Scalar, y: State, s: SwitchValues) -> State:
        now, sums = Instant(self, t, y, s), {}
        for owner, effect in self.placed:
            for name, sign, value in now.terms(owner, effect):
                check_name(owner, name, self.coordinates)
                sums.setdefault(name, []).append((sign, value))
        forces = {name: signed_sum(terms) for name, terms in sums.items()}
        reaction = reactions(self.placed, y.q)
        return State(y.v, type(y.v)(*accelerations(self._entries, reaction, y, forces)))

    def _entries(self, q: Any) -> Entries:
        return entries(self.mass, self.placed, q)

    @property
    def _mass_varies(self) -> bool:
        """Whether the mass matrix may depend on q, so that it is looked at where a state is made."""
        return isinstance(self.mass, MassFunction) or any(effect.adds_mass for _, effect in self.placed)

    @property
    def _periods(self) -> dict[str, Any]:
        found = {name: effect.period for name, effect in self.placed}
        return {name: period for name, period in found.items() if period is not None}

    @property
    def period(self) -> Any:
        """The least common period of the forces of time [time]; None if there are none."""
        return common(self._periods, self.multiple) if self._periods else None

    # What one does with a scene.

    def state(self, q: Mapping[str, Any] | None = None, v: Mapping[str, Any] | None = None) -> State:
        """A state by the names of the coordinates; what is left out is zero.

        **Arguments:**

        - `q`: displacements [m].
        - `v`: velocities [m/s].

        **Raises:** `ValueError` for an unknown coordinate, or a state at which the mass matrix is not positive
            definite.
        """
        kind = coordinates_type(self.coordinates)

        def row(argument: str, given: Mapping[str, Any] | None) -> Any:
            given = given or {}
            for name in given:
                if name not in self.coordinates:
                    names = ", ".join(self.coordinates)
                    text = f"Argument `{argument}` must name coordinates of the scene ({names}), but names `{name}`."
                    raise ValueError(text + did_you_mean(str(name), self.coordinates))
            values = [given.get(name, 0.0) for name in self.coordinates]
            return kind(*[float(x) if isinstance(x, int) else x for x in values])

        y = State(row("q", q), row("v", v))
        if self._mass_varies and not any(isinstance(x, Tracer) or np.ndim(x) for x in y.q):
            with jax.ensure_compile_time_eval():
                check_mass(self._entries, kind(*map(jnp.asarray, y.q)), True)
        return y

    def without(self, *names: str) -> "Scene":
        """The scene without some of its effects, and without a trace of them.

        **Arguments:**

        - `names`: of the effects.

        **Raises:** `ValueError` for an unknown effect, or one that another needs.
        """
        for name in names:
            self._effect("names", name)
        left = {name: effect for name, effect in self.effects.items() if name not in names}
        if isinstance(self.mass, tuple):
            return Scene(dict(zip(self.coordinates, self.mass)), units=self.units, **left)
        new = Scene({name: 1.0 for name in self.coordinates}, units=self.units, **left)
        return eqx.tree_at(lambda scene: scene.mass, new, self.mass)

    def force(self, name: str, t: Any, y: State, mode: Any = ()) -> Any:
        """The force of an effect, in a mode: with the multiplier of what sticks or rests.

        **Arguments:**

        - `name`: of the effect; "stop.friction" for one within another.
        - `t`, `y`: time and state.
        - `mode`: of all switches, as in `Solution.mode1`, or by name, `{"belt": 0}`.

        **Returns:** the force along its direction [N], for a `Contact` the normal force N; of an effect that acts not
        along one direction the generalised forces by coordinate.

        **Raises:** `ValueError` for an unknown effect, or modes that are missing.
        """
        effect = self._effect("name", name)
        dtype = jnp.result_type(float, *jax.tree.leaves(y))
        t, y = jnp.asarray(t, dtype), jax.tree.map(lambda x: jnp.asarray(x, dtype), y)
        scene = cast(Scene, arrays_of(self, dtype))
        model = SwitchedSystem.forwards(scene, t, y)
        names = [k.name for k in model.switches]
        given = [mode[n] for n in names if n in mode] if isinstance(mode, Mapping) else list(mode)
        if len(given) != len(names):
            raise ValueError(
                f"Argument `mode` must give the mode of each switch ({', '.join(names)}), but got {mode!r}."
            )
        whole = tuple(jnp.asarray(m, jnp.int32) for m in given)
        values = model.values(t, y, model.state_at(t, y, whole))
        now = Instant(scene, t, y, scene.values(values))
        effect = dict(scene.placed)[name]
        if isinstance(effect, ForceElement):
            return now.force(name)
        return effect.forces(t, y, now.values(name, effect))

    def _effect(self, argument: str, name: str) -> Effect:
        known = dict(self.placed) if argument == "name" else self.effects
        if name not in known:
            text = f"Argument `{argument}` must name effects of the scene ({', '.join(known)}), but got {name!r}."
            raise ValueError(text + did_you_mean(str(name), known))
        return known[name]

    def sketch(self, *, ax: "Axes | None" = None) -> "Axes":
        """Draws the scene: masses, springs, dampers, belts, stops and forces; see `nsjax.plot.sketch`."""
        return sketch(self, ax=ax)

    def __str__(self) -> str:
        return described(self)


def _check_effect(name: str, effect: Any) -> None:
    if not isinstance(effect, Effect):
        hint = " Call it, with its parameters." if isinstance(effect, type) else ""
        raise TypeError(f"Effect `{name}` must be an instance of `nsjax.mechanics.Effect`, but got {effect!r}.{hint}")
    if name in dir(Scene) or name in Scene.__dataclass_fields__ or name.startswith("_"):
        raise ValueError(
            f"Effect `{name}` must have another name, as a scene has `{name}` already: call it by what it stands for, "
            "such as `belt`, `stop`, `drive`."
        )
