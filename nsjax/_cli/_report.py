"""What was computed, as text and as JSON."""

import dataclasses
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array

from .._numerics._compile import interactive
from .._numerics._units import Note, notes, ratio, time_unit
from .._types import Y
from .._version import __version__
from ..derivatives._saltation import saltation_matrices
from ..flow._results import RESULTS
from ..flow._solution import Event, Events, Solution
from ..mechanics import Scene, SceneModel
from ..orbits._orbit import Orbit
from ..plot import components
from ..system._mode import change_words
from ..system._system import System
from ._job import Job
from ._mistakes import advice


SHOWN = 24  # events of a simulation that are printed
GREEK = tuple(
    "alpha beta gamma delta epsilon zeta eta theta kappa lambda mu nu xi rho sigma tau phi chi psi omega".split()
)


class Units(NamedTuple):
    """What is known of the units of a job. A gallery system without units is dimensionless."""

    parameters: dict[str, Note]
    state: dict[str, str]
    time: str

    @classmethod
    def of(cls, job: Job) -> "Units":
        parameters = notes(type(job.system))
        fields = {} if job.y0 is None or isinstance(job.y0, dict) else notes(type(job.y0))
        of_scene = _units_of_scene(job.system)
        state = {
            name: of_scene.get(name, fields.get(name.partition("[")[0], Note()).unit) for name in components(job.y0)
        }
        used = [*state.values(), *(note.unit for note in parameters.values())]
        time = time_unit(used)
        if job.from_gallery:
            state = {name: unit or "-" for name, unit in state.items()}
            time = time or "-"
        return cls(parameters, state, time)

    def labels(self) -> dict[Any, str]:
        """For the axes of pictures: parameters, components, time, and entries of the fundamental matrix."""
        named = {name: _with_unit(_symbol(name), note.unit) for name, note in self.parameters.items()}
        named |= {name: _with_unit(name, unit) for name, unit in [*self.state.items(), ("t", self.time)]}
        entries = {
            (i, j): _with_unit(f"$\\Phi_{{{i}{',' * (len(self.state) > 9)}{j}}}$", ratio(above, below))
            for i, above in enumerate(self.state.values(), 1)
            for j, below in enumerate(self.state.values(), 1)
        }
        return named | entries


def _units_of_scene(system: System) -> dict[str, str]:
    """Of the state of a scene, whose class says none: `{"q.x": "m", "v.x": "m/s"}`."""
    scene = system.scene if isinstance(system, SceneModel) else system
    units = scene.units if isinstance(scene, Scene) else {}
    return {f"q.{name}": unit for name, unit in units.items()} | {f"v.{n}": ratio(u, "s") for n, u in units.items()}


def _symbol(name: str) -> str:
    """`alpha_0` as a formula, for pictures; a name that is no symbol as it is."""
    base, _, below = name.partition("_")
    if len(base) > 1 and base not in GREEK:
        return name
    letter = f"\\{base}" if len(base) > 1 else base
    return f"${letter}_{{\\mathrm{{{below}}}}}$" if below else f"${letter}$"


def _with_unit(name: str, unit: str) -> str:
    return f"{name} [{unit}]" if unit else name


# Text.


def _table(rows: list[list[str]]) -> str:
    widths = [max(map(len, column)) for column in zip(*rows)]
    return "\n".join("  " + "  ".join(word.ljust(w) for word, w in zip(row, widths)).rstrip() for row in rows)


def _number(x: Any) -> str:
    return f"{float(x):.10g}"


def _change(event: Event) -> str:
    return change_words(event.mode_before, event.mode_after) or "reset"


def _event_table(events: Events, units: Units, most: int) -> str:
    rows = [[_with_unit("t", units.time), "switch", "mode", *(_with_unit(*pair) for pair in units.state.items())]]
    for i in range(min(len(events), most)):
        e = events[i]
        values = [_number(x) for x in components(e.y_after).values()]
        rows.append([f"{float(e.t):.13g}", e.switch, _change(e), *values])
    left = len(events) - most
    return _table(rows) + (f"\n  ... and {left} more" if left > 0 else "")


def _matrix(matrix: Any) -> str:
    return _table([[_number(x).rjust(16) for x in row] for row in np.asarray(matrix)])


def _state_text(y: Y, units: Units) -> str:
    words = zip(units.state.items(), components(y).values())
    return ", ".join(f"{name} = {_number(x)}" + f" {unit}" * (unit not in ("", "-")) for (name, unit), x in words)


def report(job: Job, sol: Solution | None, orbit: Orbit | None, trouble: str | None) -> str:
    """Everything computed, as tables.

    **Arguments:**

    - `job`: the system and its start.
    - `sol`: its simulation, if there was one.
    - `orbit`: its periodic orbit, if one was found.
    - `trouble`: why none was found, if one was sought.
    """
    units = Units.of(job)
    parts = [f"{job.name}: {job.title}" if job.title else job.name]
    rows = [
        [name, _parameter_text(value), f"[{note.unit}]" if note.unit else "", note.meaning]
        for name, value in _parameters(job.system).items()
        for note in [units.parameters.get(name, Note())]
    ]
    parts.append("parameters\n" + _table(rows) if rows else "no parameters")
    if sol is not None:
        parts.append(_simulation_text(job, sol, units))
    if orbit is not None:
        parts.append(_orbit_text(job, orbit, units))
    if trouble is not None:
        parts.append(f"no periodic orbit: {trouble}")
    return "\n\n".join(parts)


def _parameter_text(value: Any) -> str:
    return np.array2string(np.asarray(value), separator=", ", precision=10) if np.ndim(value) else str(value)


def _simulation_text(job: Job, sol: Solution, units: Units) -> str:
    unit = f" {units.time}" * (units.time not in ("", "-"))
    text = f"simulation from t = {_number(sol.t0)}{unit}, {_state_text(job.y0, units)}\n"
    text += _event_table(sol.events, units, SHOWN) if len(sol.events) else "  no events"
    text += f"\n  at t = {_number(sol.t1)}{unit}: {_state_text(sol.y1, units)}"
    if sol.result != RESULTS.successful:
        text += f"\n  ended there: {advice(sol.result)}"
    return text


def _orbit_text(job: Job, orbit: Orbit, units: Units) -> str:
    parts = [str(orbit).rstrip()]
    if len(orbit.events):
        parts.append("events of the orbit\n" + _event_table(orbit.events, units, len(orbit.events)))
        matrices = _linearised(job.system, orbit.events)
        for i, e in enumerate(orbit.events):
            change = _change(e)
            parts.append(f"saltation matrix at t = {_number(e.t)}, {e.switch}: {change}\n" + _matrix(matrices[i]))
    parts.append("monodromy matrix\n" + _matrix(orbit.monodromy))
    return "\n\n".join(parts)


# JSON.


def _plain(x: Any) -> Any:
    """Numbers and nested lists; what is not finite becomes null, as JSON has no word for it."""
    if isinstance(x, dict):
        return {k: _plain(v) for k, v in x.items()}
    if isinstance(x, (list, tuple)):
        return [_plain(v) for v in x]
    if isinstance(x, (jax.Array, np.ndarray, np.generic)):
        return _plain(np.asarray(x).tolist())
    return None if isinstance(x, float) and not np.isfinite(x) else x


def _parameters(system: System) -> dict[str, Any]:
    return {
        field.name: getattr(system, field.name)
        for field in dataclasses.fields(system)
        if eqx.is_array_like(getattr(system, field.name))
    }


def by_name(y: Y) -> dict[str, Any]:
    """The leaves of a state by name."""
    leaves = jax.tree_util.tree_flatten_with_path(y)[0]
    return {jax.tree_util.keystr(path, simple=True, separator=".") or "y": leaf for path, leaf in leaves}


@interactive
def _linearised(system: System, events: Events) -> Array:
    return saltation_matrices(system, events)


def _events(system: System, events: Events) -> list[dict[str, Any]]:
    if not len(events):
        return []
    matrices = _linearised(system, events)
    return [
        {
            "t": e.t,
            "switch": e.switch,
            "from": e.mode_before,
            "to": e.mode_after,
            "y": by_name(e.y_before),
            "y_after": by_name(e.y_after),
            "saltation": matrices[i],
            "transversality": e.transversality,
        }
        for i, e in enumerate(events)
    ]


def orbit_record(orbit: Orbit) -> dict[str, Any]:
    """An orbit in numbers."""
    return {
        "period": orbit.period,
        "t0": orbit.t0,
        "y0": by_name(orbit.y0),
        "itinerary": list(orbit.itinerary),
        "events": _events(orbit.system, orbit.events),
        "monodromy": orbit.monodromy,
        "multipliers": [[m.real, m.imag] for m in np.asarray(orbit.multipliers)],
        "stable": bool(orbit.stable),
        "residual": orbit.residual,
    }


def simulation_record(sol: Solution) -> dict[str, Any]:
    """A simulation in numbers."""
    return {
        "t0": sol.t0,
        "t1": sol.t1,
        "y1": by_name(sol.y1),
        "mode1": dict(zip(sol.events.names, jnp.asarray(sol.mode1).tolist())),
        "events": _events(sol.system, sol.events),
        "result": "successful" if sol.result == RESULTS.successful else advice(sol.result),
    }


def record(job: Job, tolerances: dict[str, float], **parts: Any) -> dict[str, Any]:
    """Everything computed, ready for `json.dump`.

    **Arguments:**

    - `job`: the system.
    - `tolerances`: with which it was computed.
    - `parts`: what was.
    """
    units = Units.of(job)
    known = {name: note.unit for name, note in units.parameters.items() if name in _parameters(job.system)}
    return _plain(
        {
            "nsjax": __version__,
            "system": job.name,
            "parameters": _parameters(job.system),
            "units": {"parameters": known, "state": units.state, "time": units.time},
            "tolerances": tolerances,
            **parts,
        }
    )
