"""Which system, with which parameters, from which state: reading the words of the command line."""

import dataclasses
import importlib.util
import inspect
import math
import pathlib
import re
import sys
from collections.abc import Callable, Iterable, Mapping
from types import ModuleType
from typing import Any

import jax
import jax.numpy as jnp

from .. import gallery
from .._numerics._text import components, nearest
from .._types import Y
from ..system._checks import check_parameters
from ..system._system import System


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


def unknown(what: str, name: str, known: Iterable[str]) -> UsageError:
    """That a name means nothing, with the one that may have been meant, and all that there are."""
    known = list(known)
    return UsageError(f"There is no {what} {name!r}.{_meant(name, known)} Possible: {', '.join(known) or 'none'}.")


def _meant(name: str, known: Iterable[str]) -> str:
    """The name that may be meant, in the quotes of the command line."""
    near = nearest(name, known)
    return "" if near is None else f" Did you mean {near!r}?"


# The system.


def load(name: str, parameters: Mapping[str, str], y0: str | None) -> Job:
    """The system that `name` means, with the state that `y0` means.

    **Arguments:**

    - `name`: a key of the gallery, or `path/model.py:ClassName`, or `path/model.py` of a file with one model.
    - `parameters`: values in words, by name.
    - `y0`: `"x=1,v=0"`, or `"1,0"`; `None` for the default.

    **Raises:** `UsageError`, naming what is possible; `ValueError` for a value that the model forbids.
    """
    parts = _file_and_name(name)
    job = _load_entry(name, parameters, y0) if parts is None else _load_file(*parts, parameters, y0)
    check_parameters(job.system)
    return job


def _load_entry(name: str, parameters: Mapping[str, str], y0: str | None) -> Job:
    """A system of the gallery."""
    try:
        entry = gallery.entry(name)
    except ValueError:
        raise _unknown_system(name) from None
    system = _make(entry.system, dataclasses.fields(entry.system()), parameters)
    if y0 is None:
        start = entry.y0
    elif any(isinstance(part, tuple) for part in entry.y0):  # that of a scene: q.x, v.x
        start = _part_of(entry.y0, y0)
    else:
        start = _state(y0, type(entry.y0), entry.y0._asdict())
    names = tuple(components(entry.y0))
    return Job(entry.key, entry.title, system, _arrays(start), names, entry.t0, entry.t1, entry.orbit, True)


def _unknown_system(name: str) -> UsageError:
    """Keys may be meant, or what the gallery calls its systems; or a file."""
    if pathlib.Path(f"{name}.py").is_file():
        return UsageError(f"There is no system {name!r}. Did you mean {name}.py?")
    called = {key: key for key in gallery.SYSTEMS}
    for key, entry in gallery.SYSTEMS.items():
        for words in (type(entry.system()).__name__, entry.title):
            called.setdefault(words, key)
    near = nearest(name, called)
    meant = "" if near is None else f" Did you mean {called[near]} ({gallery.entry(called[near]).title})?"
    keys = ", ".join(gallery.SYSTEMS)
    return UsageError(f"There is no system {name!r}.{meant} Possible: {keys}; or a file of yours, model.py:ClassName.")


def _file_and_name(name: str) -> tuple[str, str] | None:
    """`path/model.py` and `ClassName`, which may be missing; `None` for a key of the gallery."""
    found = re.fullmatch(r"(.*\.py)(?::(.*))?", name)
    return None if found is None else (found[1], found[2] or "")


def model_file(name: str) -> pathlib.Path | None:
    """The file of the model that is meant; `None` for one of the gallery."""
    parts = _file_and_name(name)
    return None if parts is None else pathlib.Path(parts[0])


def _load_file(path: str, attribute: str, parameters: Mapping[str, str], y0: str | None) -> Job:
    module = _module(pathlib.Path(path))
    models = {key: value for key, value in vars(module).items() if _is_model(value, module)}
    attribute = attribute or _only(path, models)
    if attribute not in models:
        raise unknown(f"system in {path}:", attribute, models)
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
    if title.startswith(f"{type(system).__name__}("):  # the signature, which is there where nothing was written
        title = ""
    state = cls._fields if cls else ()
    return Job(f"{path}:{attribute}", title, system, start, state, 0.0, None, None, False)


def _only(path: str, models: Mapping[str, Any]) -> str:
    """The one that is meant where none is named: the only class, or if there is none the only instance."""
    classes = [key for key, value in models.items() if isinstance(value, type) and not inspect.isabstract(value)]
    choice = classes or list(models)
    if len(choice) != 1:
        many = f"{len(choice)} systems; name one: {', '.join(f'{path}:{key}' for key in choice)}"
        raise UsageError(f"{path} has {many}." if choice else f"There is no class of nsjax.System in {path}.")
    return choice[0]


def _module(path: pathlib.Path) -> ModuleType:
    if not path.is_file():
        beside = [str(other) for other in sorted(path.parent.glob("*.py"))] if path.parent.is_dir() else []
        raise UsageError(f"There is no file {str(path)!r}.{_meant(str(path), beside)}")
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
            raise unknown("parameter", name, list(known))
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
            raise unknown("state", name, list(cls._fields))
    values = {**defaults, **named}
    missing = [name for name in cls._fields if name not in values]
    if missing:
        raise UsageError(f"--y0 must give {', '.join(cls._fields)}, but {', '.join(missing)} is missing.")
    return cls(**values)


def _part_of(default: Any, text: str) -> Any:
    """A nested state with some of its numbers replaced, by names such as `q.x`."""
    names, (leaves, tree) = list(components(default)), jax.tree.flatten(default)
    for pair in text.split(","):
        name, equals, value = (part.strip() for part in pair.partition("="))
        if not equals or name not in names:
            raise unknown("state", name, names)
        leaves[names.index(name)] = _number(value, f"Component {name}")
    return jax.tree.unflatten(tree, leaves)


def _arrays(state: Any) -> Any:
    """The leaves as arrays, lists of numbers too."""
    return jax.tree.map(lambda x: jnp.asarray(x, float), state, is_leaf=lambda x: isinstance(x, list))
