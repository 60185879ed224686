"""Results in a file: numbers and the names of a closed table of types, and so nothing that could be executed.

The file is an `.npz` without pickled objects: the arrays, end to end, one vector for each dtype; and a text in JSON
that says how the results are made of them. An object that occurs in several places is one object again. What belongs
to the user, a model and the structure of its states, is in the file by its numbers only: whoever reads it has the
model.
"""

import collections
import dataclasses
import json
import os
import re
from collections.abc import Mapping
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

from .._types import Y
from ..system._system import arrays_of, System


FORMAT = 2  # 1: with names of types that are no more
KINDS = "biufc"  # of the dtypes that may occur
KEYS = ("kind", "types", "model", "state", "system", "leaves", "parts", "objects")
ARRAYS = {"array": np.asarray, "scalar": lambda x: x[()], "jax": jnp.asarray}
SAME = ["same"]  # a leaf that is a function: the reader's
LEAF = jax.tree.structure(0)
Types = Mapping[str, type]


def table(*classes: type) -> Types:
    return {cls.__name__: cls for cls in classes}


def save(
    path: Any,
    kind: str,
    types: Types,
    system: System,
    y: Y,
    parts: Mapping[str, Any],
    without: tuple[type, ...] = (),
    **forms: Any,
) -> None:
    """Writes a file, in the place of an older one only when it is complete.

    **Arguments:**

    - `kind`: what it holds, a name.
    - `types`: of the objects that may occur, NamedTuples and dataclasses, by name.
    - `system`, `y`: the model, and a state of it.
    - `parts`: what to write, by name. `without`: types of objects that are left out, None taking their place.
    - `forms`: further objects of which the reader will have the like: only the leaves of such are written.
    """
    system = arrays_of(system, np.float64)
    encoder = _Encoder(types, without, dict(system=system, y=y, **forms))
    header = dict(
        format=FORMAT,
        kind=kind,
        types={name: _fields(cls) for name, cls in types.items()},
        model=signature(system),
        state=_described(y),
        system=encoder.encode(system),
        leaves=[encoder.encode(leaf) for leaf in jax.tree.leaves(y)],
        parts={name: encoder.encode(part) for name, part in parts.items()},
        objects=encoder.objects,
    )
    text = np.frombuffer(json.dumps(header, allow_nan=False).encode(), np.uint8)
    vectors = {name: np.concatenate(pieces) for name, pieces in encoder.arrays.items()}
    part = f"{os.fspath(path)}.part"
    with open(part, "wb") as file:
        np.savez_compressed(file, json=text, **vectors)
    os.replace(part, path)


class Archive:
    """A file that `save` wrote. `system` and `y` are the model and the state with the numbers of the file.

    **Arguments:**

    - `system`: a model like that of the file; its parameters may have other values.
    - `y`: a state, whose numbers do not matter. Without it a state is what the model's vector field returns, or made
        of dictionaries, tuples and NamedTuples.

    **Raises:** `ValueError` for a file of another kind, one that is damaged, is of another format, or of another model.
    """

    system: System
    y: Y

    def __init__(self, path: Any, kind: str, types: Types, system: System, y: Y | None = None):
        self._path, self._types = os.fspath(path), types
        self._arrays, self._objects = {}, {}  # each once
        self._header, self._vectors = self._read()
        header = self._header
        if header["kind"] != kind:
            raise ValueError(
                f"The file {self._path} holds an `{header['kind']}`, but an `{kind}` was to be loaded. Use "
                f"`nsjax.{header['kind']}.load`."
            )
        if header["types"] != {name: _fields(cls) for name, cls in types.items()}:
            raise ValueError(f"Another version of nsjax wrote the file {self._path}: its types have other fields.")
        system = arrays_of(system, np.float64)
        if header["model"] != signature(system):
            raise ValueError(
                f"Argument `system` must be a model like that of the file, {header['model']}, but is "
                f"{signature(system)}. Make one of that class and those shapes; the numbers are taken from the file."
            )
        self.system = self._decoded(header["system"], dict(system=system))
        self.y = _like(header["state"], [self._decoded(leaf, {}) for leaf in header["leaves"]], self.system, y)

    def part(self, name: str, **forms: Any) -> Any:
        """One of the parts; `forms` as for `save`."""
        return self._decoded(self._header["parts"][name], dict(system=self.system, y=self.y, **forms))

    def check_integrator(self, integrator: Any, names: str, when: str) -> None:
        """That the part `integrator` tells of the same one as is given: its equations are solved by it.

        **Raises:** `ValueError` that names the arguments; `when` says of what they are to be those.
        """
        own, given = self.part("integrator"), plain(repr(integrator))
        if given != own:
            raise ValueError(f"Arguments {names} must be those with which the {when}, {own}, but are {given}.")

    def _read(self) -> tuple[Any, dict[str, np.ndarray]]:
        try:
            with open(self._path, "rb") as raw, np.load(raw, allow_pickle=False) as file:
                header = json.loads(file["json"].tobytes())
                vectors = {name: file[name] for name in file.files if name != "json"}
            other = header["format"] - FORMAT
            if not other:
                _ = [header[key] for key in KEYS]
        except FileNotFoundError:
            raise
        except Exception as error:  # by what it fails depends on where the file was cut off
            raise ValueError(f"The file {self._path} is damaged, or nsjax did not write it.") from error
        if other:
            age = "A newer" if other > 0 else "An older"
            raise ValueError(
                f"{age} version of nsjax wrote the file {self._path}, in format {header['format']}; this one reads "
                f"format {FORMAT}. Compute it anew, or read it with that version."
            )
        return header, vectors

    def _decoded(self, code: Any, forms: dict[str, Any]) -> Any:
        try:
            return self._decode(code, forms)
        except (LookupError, TypeError, ValueError, RecursionError) as error:
            raise ValueError(f"The file {self._path} is damaged.") from error

    def _decode(self, code: Any, forms: dict[str, Any]) -> Any:
        if not isinstance(code, list):
            return code
        tag, *rest = code
        if tag in ("float", "complex"):
            return {"float": float, "complex": complex}[tag](*map(float, rest))
        if tag in ARRAYS:
            key = json.dumps(code)
            return self._arrays[key] if key in self._arrays else self._array(key, *code)
        if tag in ("tuple", "list"):
            return {"tuple": tuple, "list": list}[tag](self._decode(x, forms) for x in rest)
        if tag == "dict":
            return {key: self._decode(x, forms) for key, x in rest}
        if tag == "form":
            name, *codes = rest
            own, structure = jax.tree.flatten(forms[name])
            leaves = [
                leaf if code == SAME else self._decode(code, forms) for leaf, code in zip(own, codes, strict=True)
            ]
            return jax.tree.unflatten(structure, leaves)
        (number,) = rest
        return self._objects[number] if number in self._objects else self._object(number, forms)

    def _array(self, key: str, tag: str, dtype: str, offset: int, shape: list[int]) -> Any:
        array = self._vectors[dtype][offset : offset + int(np.prod(shape, dtype=int))].reshape(shape)
        return self._arrays.setdefault(key, ARRAYS[tag](array))

    def _object(self, number: int, forms: dict[str, Any]) -> Any:
        name, *codes = self._header["objects"][number]
        cls = self._types[name]
        if issubclass(cls, tuple | eqx.Module):
            made = cls(*(self._decode(code, forms) for code in codes))
            return self._objects.setdefault(number, made)
        # It may hold something that holds it.
        made = self._objects[number] = object.__new__(cls)
        for field, code in zip(_fields(cls), codes, strict=True):
            object.__setattr__(made, field, self._decode(code, forms))
        return made


class _Encoder:
    """Makes JSON of objects, and collects their arrays."""

    def __init__(self, types: Types, without: tuple[type, ...], forms: Mapping[str, Any]):
        self.without = without
        self.names = {cls: name for name, cls in types.items()}
        self.forms = {name: form for name, tree in forms.items() if (form := jax.tree.structure(tree)) != LEAF}
        self.objects: list[Any] = []
        self.arrays: dict[str, list[np.ndarray]] = {}
        self.sizes: dict[str, int] = collections.defaultdict(int)
        self.known: dict[int, tuple[Any, Any]] = {}  # with what it is, which must live as long as its id is used

    def encode(self, value: Any) -> Any:
        if value is None or isinstance(value, self.without):
            return None
        if type(value) in (bool, int, str):
            return value
        if type(value) is float:
            return value if np.isfinite(value) else ["float", str(value)]
        if type(value) is complex:
            return ["complex", str(value.real), str(value.imag)]
        if id(value) in self.known:
            return self.known[id(value)][1]
        if isinstance(value, np.ndarray | np.generic | jax.Array):
            tag = "scalar" if isinstance(value, np.generic) else "jax" if isinstance(value, jax.Array) else "array"
            return self._known(value, [tag, *self._array(np.asarray(value))])
        if type(value) in self.names:
            code = self._known(value, ["object", len(self.objects)])
            self.objects.append(None)
            fields = [self.encode(getattr(value, name)) for name in _fields(type(value))]
            self.objects[code[1]] = [self.names[type(value)], *fields]
            return code
        structure = jax.tree.structure(value)
        for name, form in self.forms.items():
            if structure == form:
                leaves = jax.tree.leaves(value)
                return self._known(value, ["form", name, *(SAME if callable(x) else self.encode(x) for x in leaves)])
        if type(value) in (tuple, list):
            return ["tuple" if type(value) is tuple else "list", *map(self.encode, value)]
        if type(value) is dict and all(type(key) is str for key in value):
            return ["dict", *([key, self.encode(x)] for key, x in value.items())]
        raise TypeError(f"An object of type `{type(value).__name__}` cannot be saved.")

    def _known(self, value: Any, code: Any) -> Any:
        self.known[id(value)] = value, code
        return code

    def _array(self, array: np.ndarray) -> list[Any]:
        if array.dtype.kind not in KINDS:
            raise TypeError(f"An array of dtype {array.dtype} cannot be saved.")
        name = array.dtype.name
        offset = self.sizes[name]
        self.arrays.setdefault(name, []).append(array.ravel())
        self.sizes[name] += array.size
        return [name, offset, list(array.shape)]


def plain(text: str) -> str:
    """A representation in one line, without the places in memory that some hold."""
    return " ".join(re.sub(r" at 0x[0-9a-f]+", "", text).split())


def signature(system: System) -> str:
    """What a model is, apart from the numbers: its class, its parameters and their shapes, what is static in it."""
    return plain(eqx.tree_pformat(system))


def _fields(cls: type) -> list[str]:
    names: Any = getattr(cls, "_fields", None)
    return [field.name for field in dataclasses.fields(cls)] if names is None else list(names)


# The structure of a state.


def _described(y: Y) -> Any:
    """In JSON; None where a state alone can tell."""
    if isinstance(y, tuple) and type(y) is not tuple:
        return {"name": type(y).__name__, "fields": [[name, _described(x)] for name, x in zip(_fields(type(y)), y)]}
    if type(y) in (tuple, list):
        return {"kind": type(y).__name__, "items": [_described(x) for x in y]}
    if type(y) is dict and all(type(key) is str for key in y):
        return {"keys": [[key, _described(y[key])] for key in sorted(y)]}
    return "leaf" if jax.tree.structure(y) == LEAF else None


def _built(state: Any) -> Any:
    """A state of that description."""
    if state == "leaf":
        return 0.0
    if "keys" in state:
        return {key: _built(x) for key, x in state["keys"]}
    if "items" in state:
        return {"tuple": tuple, "list": list}[state["kind"]](_built(x) for x in state["items"])
    names, values = zip(*((name, _built(x)) for name, x in state["fields"]))
    return collections.namedtuple(state["name"], names)(*values)  # which takes identifiers only


def _like(state: Any, leaves: list[Any], system: System, y: Y | None) -> Y:
    """The leaves as a state."""
    if y is not None:
        if _described(y) != state or [np.shape(x) for x in jax.tree.leaves(y)] != [np.shape(x) for x in leaves]:
            raise ValueError("Argument `y` must be a state like those of the file, but has another structure.")
        return jax.tree.unflatten(jax.tree.structure(y), leaves)
    try:  # which NamedTuple it is, the vector field may say
        y = jax.tree.unflatten(jax.tree.structure(_built(state)), leaves)
        none = tuple(jnp.zeros(()) for _ in system.switches)
        field = jax.eval_shape(lambda: system.vector_field(jnp.zeros(()), y, system.values(none)))
        return jax.tree.unflatten(jax.tree.structure(field), leaves)
    except Exception as error:  # whatever a state that is not the user's own makes the model do
        raise ValueError(
            "Argument `y` must be given, a state of the model: the file cannot tell what it is."
        ) from error
