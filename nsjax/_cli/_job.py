"""Which system, with which parameters, from which state: reading the words of the command line."""

import dataclasses
import importlib.util
import math
import pathlib
import re
import sys
from collections.abc import Callable, Mapping
from types import ModuleType
from typing import Any

import jax.numpy as jnp

from .. import gallery
from .._system import System
from .._types import Y


class UsageError(Exception):
    """A word on the command line that means nothing; the message is one line."""


@dataclasses.dataclass(frozen=True)
class Job:
    """A system, and where to start."""

    name: str  # the key of the gallery, or model.py:ClassName
    title: str
    system: System
    y0: Y | None
    state: tuple[str, ...]  # names of its leaves, where they are known
    t0: float
    t1: float | None
    guess: gallery.OrbitGuess | None
    from_gallery: bool


Value = float | list[float]


def _number(text: str, what: str) -> float:
    try:
        value = float(text)
    except ValueError:
        value = math.nan
    if not math.isfinite(value):
        raise UsageError(f"{what} must be a number, but got {text.strip()!r}.")
    return value


def _value(text: str, what: str) -> Value:
    """A number, or numbers separated by commas."""
    values = numbers(text, what)
    return values if len(values) > 1 else values[0]


def numbers(text: str, what: str) -> list[float]:
    """Numbers separated by commas."""
    return [_number(part, what) for part in text.split(",")]


def options(texts: list[str], flag: str) -> dict[str, str]:
    """`["a=1,b=2", "c=3,4"]` as `{"a": "1", "b": "2", "c": "3,4"}`."""
    found = {}
    for text in texts:
        for pair in re.split(r",(?=\s*[^\W\d]\w*\s*=)", text):
            name, equals, value = pair.partition("=")
            if not equals or not name.strip():
                raise UsageError(f"{flag} must read name=value, but got {pair.strip()!r}.")
            found[name.strip()] = value.strip()
    return found


def _unknown(what: str, name: str, known: list[str]) -> UsageError:
    return UsageError(f"There is no {what} {name!r}; possible: {', '.join(known) or 'none'}.")


# The system.


def load(name: str, parameters: Mapping[str, str], y0: str | None) -> Job:
    """The system that `name` means, with the state that `y0` means.

    **Arguments:**

    - `name`: a key of the gallery, or `path/model.py:ClassName`.
    - `parameters`: values in words, by name.
    - `y0`: `"x=1,v=0"`, or `"1,0"`; `None` for the default.

    **Raises:** `UsageError`, naming what is possible.
    """
    if ".py" in name:
        return _load_file(name, parameters, y0)
    try:
        entry = gallery.entry(name)
    except ValueError:
        keys = ", ".join(gallery.THESIS)
        raise UsageError(
            f"There is no system {name!r}; possible: {keys}; or a file of yours, model.py:ClassName."
        ) from None
    system = _make(entry.system, dataclasses.fields(entry.system()), parameters)
    start = entry.y0 if y0 is None else _state(y0, type(entry.y0), entry.y0._asdict())
    return Job(entry.key, entry.title, system, _arrays(start), entry.y0._fields, entry.t0, entry.t1, entry.orbit, True)


def _load_file(name: str, parameters: Mapping[str, str], y0: str | None) -> Job:
    path, _, attribute = name.rpartition(":")
    if not path.endswith(".py") or not attribute:
        raise UsageError(f"A system of yours must read path/model.py:ClassName, but got {name!r}.")
    module = _module(pathlib.Path(path))
    names = [key for key, value in vars(module).items() if _is_model(value, module)]
    if attribute not in names:
        raise _unknown(f"system in {path}:", attribute, names)
    found = getattr(module, attribute)
    if isinstance(found, System):
        system = _make(lambda **changes: dataclasses.replace(found, **changes), dataclasses.fields(found), parameters)
    else:
        system = _make(found, dataclasses.fields(found), parameters)
    cls = _state_class(module, system)
    if y0 is not None:
        start = _arrays(_state(y0, cls, {} if cls is None else cls._field_defaults))
    else:
        start = _arrays(cls(**cls._field_defaults)) if cls and set(cls._fields) == set(cls._field_defaults) else None
    title = (type(system).__doc__ or "").strip().partition("\n")[0]
    return Job(name, title, system, start, cls._fields if cls else (), 0.0, None, None, False)


def _module(path: pathlib.Path) -> ModuleType:
    if not path.is_file():
        raise UsageError(f"There is no file {str(path)!r}.")
    spec = importlib.util.spec_from_file_location(path.stem, path)
    assert spec is not None and spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    # As for a script: its neighbours can be imported, and it can be found by its name.
    sys.path.insert(0, str(path.parent.resolve()))
    sys.modules[path.stem] = module
    spec.loader.exec_module(module)
    return module


def _is_model(value: Any, module: ModuleType) -> bool:
    if isinstance(value, type):
        return issubclass(value, System) and value.__module__ == module.__name__
    return isinstance(value, System)


def _make(make: Callable[..., System], fields: tuple[Any, ...], parameters: Mapping[str, str]) -> System:
    known = {field.name: field for field in fields if field.init}
    values = {}
    for name, text in parameters.items():
        if name not in known:
            raise _unknown("parameter", name, list(known))
        values[name] = _parameter(known[name], text)
    try:
        return make(**values)
    except TypeError:
        needed = [
            name
            for name, field in known.items()
            if name not in values and field.default is field.default_factory is dataclasses.MISSING
        ]
        if not needed or not isinstance(make, type):
            raise
        raise UsageError(f"The parameters {', '.join(needed)} have no default; give --set {needed[0]}=value.") from None


def _parameter(field: Any, text: str) -> Any:
    what = f"Parameter {field.name}"
    if field.type in (bool, "bool"):
        if text.lower() not in ("true", "false"):
            raise UsageError(f"{what} must be true or false, but got {text!r}.")
        return text.lower() == "true"
    value = _value(text, what)
    if field.type in (int, "int"):
        if isinstance(value, list) or value != int(value):
            raise UsageError(f"{what} must be an integer, but got {text!r}.")
        return int(value)
    return jnp.asarray(value) if isinstance(value, list) else value


# The state.


def _state_class(module: ModuleType, system: System) -> Any:
    """The `NamedTuple` of the file that `vector_field` names, or that is called `State`, or that is the only one;
    `None` where that does not say."""
    tuples = {
        name: value
        for name, value in vars(module).items()
        if isinstance(value, type) and issubclass(value, tuple) and "_fields" in vars(value)
    }
    words = type(system).vector_field.__code__.co_names
    named = [value for name, value in tuples.items() if name in words]
    if len(named) == 1:
        return named[0]
    return tuples.get("State", next(iter(tuples.values())) if len(tuples) == 1 else None)


def _state(text: str, cls: Any, defaults: Mapping[str, Any]) -> Any:
    """A state from its words: of class `cls`; if that is `None`, a dictionary of named components, or an array."""
    if "=" not in text:
        values = numbers(text, "A component of --y0")
        if cls is None:
            return jnp.asarray(values)
        if len(values) != len(cls._fields):
            raise UsageError(f"--y0 must give {', '.join(cls._fields)}, but got {len(values)} numbers.")
        return cls(*values)
    named = {name: _value(value, f"Component {name}") for name, value in options([text], "--y0").items()}
    if cls is None:
        return named
    for name in named:
        if name not in cls._fields:
            raise _unknown("state", name, list(cls._fields))
    values = {**defaults, **named}
    missing = [name for name in cls._fields if name not in values]
    if missing:
        raise UsageError(f"--y0 must give {', '.join(cls._fields)}, but {', '.join(missing)} is missing.")
    return cls(**values)


def _arrays(state: Any) -> Any:
    """The leaves as arrays, lists of numbers too."""
    if isinstance(state, dict):
        return {name: jnp.asarray(value, float) for name, value in state.items()}
    if isinstance(state, tuple):
        return type(state)(*(jnp.asarray(value, float) for value in state))
    return state
