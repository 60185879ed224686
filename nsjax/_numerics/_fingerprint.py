"""What a program is made of, as a number that is the same in another process.

A program depends on the shapes of its arrays, on everything in its arguments that is no array, and on code: that of
libraries, known by their files, and that of the user, known by its instructions and by whatever these refer to.
"""

import dis
import enum
import functools as ft
import hashlib
import inspect
import pathlib
import sys
import sysconfig
import types
from collections.abc import Iterable
from typing import Any

import jax
import numpy as np
from jax.tree_util import default_registry


KNOWN = ("jax", "jaxlib", "numpy", "scipy", "equinox", "diffrax", "optimistix", "lineax", "jaxtyping", "nsjax")
PLAIN = (type(None), bool, int, float, complex, str, bytes, type(Ellipsis), type(NotImplemented), range, slice)
OPAQUE = (types.BuiltinFunctionType, types.MethodDescriptorType, types.WrapperDescriptorType, np.ufunc)
SLOTS = (types.MemberDescriptorType, types.GetSetDescriptorType, type(inspect.Traceback.lineno))  # the last: of tuples
JITTED: Any = type(jax.jit(abs))
# Of a class: what says nothing of its behaviour, or what other entries make.
IGNORED = frozenset(
    "__dict__ __weakref__ __doc__ __module__ __qualname__ __annotations__ __annotate_func__ __annotations_cache__"
    " __firstlineno__ __static_attributes__ __abstractmethods__ _abc_impl __match_args__ __parameters__"
    " __orig_bases__ __slotnames__".split()
)


class UnknownError(Exception):
    """Something of which it cannot be said whether it is the same in another process."""


@ft.cache
def _folders() -> tuple[pathlib.Path, ...]:
    """Of the libraries that `KNOWN` names, and of Python's own."""
    files = (getattr(sys.modules.get(name), "__file__", None) for name in KNOWN)
    own = {sysconfig.get_paths()[name] for name in ("stdlib", "platstdlib")}
    return (*(pathlib.Path(file).resolve().parent for file in files if file), *(pathlib.Path(p).resolve() for p in own))


@ft.cache
def _within_library(file: str) -> bool:
    """Whether a file is one of theirs; what else is installed is not known by the version of anything."""
    if file.startswith("<frozen"):
        return True
    path = pathlib.Path(file).resolve()
    inside = [folder for folder in _folders() if path.is_relative_to(folder)]
    return any("-packages" not in path.relative_to(folder).as_posix() for folder in inside)


def _source(thing: Any) -> str | None:
    """The file that a class or function comes from, if it has one."""
    code = getattr(thing, "__code__", None)
    if isinstance(code, types.CodeType):
        return code.co_filename
    module = inspect.getmodule(thing)
    return None if module is None or module.__name__ == "__main__" else _file_of(module)


def _file_of(module: types.ModuleType) -> str | None:
    built_in = getattr(module.__spec__, "origin", None) in ("built-in", "frozen")
    return getattr(module, "__file__", None) or ("<frozen>" if built_in else None)


def _is_known(name: str) -> bool:
    return name in KNOWN or name in sys.stdlib_module_names


def is_library(thing: Any) -> bool:
    """Whether a class or function belongs to what is installed; its name then says what it is."""
    file = _source(thing)
    return file is not None and _within_library(file)


@ft.cache
def stamp(name: str) -> str:
    """The files of a library: their names, sizes and times, so that one that was edited is another one."""
    file, found = getattr(sys.modules.get(name), "__file__", None), hashlib.sha256()
    for path in sorted(pathlib.Path(file).parent.rglob("*.py")) if file else ():
        stat = path.stat()
        found.update(f"{path} {stat.st_size} {stat.st_mtime_ns}\n".encode())
    return found.hexdigest()


class Fingerprint:
    """Takes in values one after the other. `seen` are those classes, functions and other objects that are not plain, in
    an order that is the same wherever the fingerprint is."""

    def __init__(self) -> None:
        self._hash = hashlib.sha256()
        self._number: dict[int, int] = {}
        self.seen: list[Any] = []

    @property
    def digest(self) -> str:
        return self._hash.hexdigest()

    def _write(self, *words: Any) -> None:
        for word in words:
            text = str(word).encode()
            self._hash.update(b"%d:" % len(text) + text)

    def number(self, thing: Any) -> int | None:
        """The place of an object among those `seen`."""
        at = self._number.get(id(thing))
        return at if at is not None and self.seen[at] is thing else None

    def _is_new(self, thing: Any) -> bool:
        """Whether an object comes for the first time; a second time its number says all."""
        number = self._number.setdefault(id(thing), len(self.seen))
        if number < len(self.seen):
            self._write("again", number)
            return False
        self.seen.append(thing)  # kept alive, so that its id is not given to another
        return True

    def traced(self, tree: Any) -> None:
        """A pytree whose arrays are arguments of the program: their kinds, and all the rest."""
        level = default_registry.flatten_one_level(tree)
        if level is None:
            if isinstance(tree, np.ndarray | np.generic | jax.Array):
                self._write("argument", jax.typeof(tree), jax.typeof(tree).weak_type)
            else:
                self.constant(tree)
            return
        children, rest = level
        children = list(children)
        self._write("node", len(children))
        self.constant(type(tree))
        self.constant(rest)
        for child in children:
            self.traced(child)

    def constant(self, value: Any) -> None:
        """Something that the program takes as it is."""
        if isinstance(value, PLAIN):
            self._write(type(value).__name__, repr(value))
        elif isinstance(value, np.ndarray | np.generic | jax.Array):
            array = np.asarray(value)
            if array.dtype.hasobject:
                raise UnknownError(f"an array of objects, {value!r}")
            self._write("array", array.shape, array.dtype.str, array.dtype.name, getattr(value, "weak_type", ""))
            self._hash.update(np.ascontiguousarray(array).tobytes())
        elif isinstance(value, np.dtype):
            self._write("dtype", value.name)
        elif isinstance(value, tuple | list):
            self._write(type(value).__name__, len(value))
            if type(value) not in (tuple, list):
                self.constant(type(value))
            self._all(value)
        elif isinstance(value, set | frozenset):
            self._write("set", *sorted(_digest_of(part) for part in value))
        elif isinstance(value, dict | types.MappingProxyType):
            self._write("dict", len(value))
            for key, part in value.items():
                self.constant(key)
                self.constant(part)
        elif isinstance(value, types.ModuleType):
            self._module(value)
        elif self._is_new(value):
            self._object(value)

    def _all(self, values: Iterable[Any]) -> None:
        for value in values:
            self.constant(value)

    def _module(self, module: types.ModuleType) -> None:
        file = _file_of(module)
        if file is None or not _within_library(file):
            raise UnknownError(f"module {module.__name__}, of which anything may be used")
        self._write("module", module.__name__)

    def _object(self, value: Any) -> None:
        if isinstance(value, type):
            self._class(value)
        elif isinstance(value, types.FunctionType):
            self._function(value)
        elif isinstance(value, types.CodeType):
            self._code(value)
        elif isinstance(value, types.MethodType):
            self._write("method")
            self._all((value.__func__, value.__self__))
        elif isinstance(value, staticmethod | classmethod):
            self._write(type(value).__name__)
            self.constant(value.__func__)
        elif isinstance(value, property):
            self._write("property")
            self._all((value.fget, value.fset, value.fdel))
        elif isinstance(value, ft.partial):
            self._write("partial")
            self._all((value.func, value.args, value.keywords))
        elif isinstance(value, enum.Enum):
            self._write("enum", value.name)
            self.constant(type(value))
        elif isinstance(value, OPAQUE):
            self._write("builtin", getattr(value, "__module__", ""), getattr(value, "__qualname__", value.__name__))
        elif isinstance(value, SLOTS):
            self._write("slot", type(value).__name__)
        elif isinstance(value, types.CellType):
            self._write("cell")
            self._all(_content(value))
        elif isinstance(value, JITTED):
            self._write("jitted")  # how it is compiled on its own says nothing of a program of which it is a part
            self.constant(value.__wrapped__)
        elif type(value).__module__ in ("typing", "types", "jaxtyping"):
            self._write("type", repr(value))
        else:
            self._instance(value)

    def _class(self, value: type) -> None:
        self._write("class", value.__module__, value.__qualname__)
        if is_library(value):
            if "<locals>" in value.__qualname__:
                raise UnknownError(f"class {value.__qualname__}, made by a function")
            return
        self._all(value.__bases__)
        self.constant(type(value))
        for name, part in sorted(vars(value).items()):
            if name not in IGNORED:
                self._write(name)
                self.constant(part)

    def _function(self, value: types.FunctionType) -> None:
        code = value.__code__
        self._write("function", value.__qualname__)
        if is_library(value):
            self._write(code.co_filename, code.co_name, code.co_firstlineno)
        else:
            self.constant(code)
            for name in sorted(_names(code)):
                if name in value.__globals__:
                    self._write(name)
                    self.constant(value.__globals__[name])
        self._all((value.__defaults__, value.__kwdefaults__, value.__closure__))
        self.constant({k: v for k, v in sorted(vars(value).items()) if k not in IGNORED})

    def _code(self, code: types.CodeType) -> None:
        for step in dis.get_instructions(code):
            if step.opname == "IMPORT_NAME" and not _is_known(str(step.argval).partition(".")[0]):
                raise UnknownError(f"module {step.argval}, of which anything may be used")
        names = (code.co_names, code.co_varnames, code.co_freevars, code.co_cellvars)
        self._write("code", code.co_flags, code.co_argcount, code.co_posonlyargcount, code.co_kwonlyargcount)
        self._all((code.co_code, code.co_exceptiontable, names, code.co_consts))

    def _instance(self, value: Any) -> None:
        state = getattr(value, "__dict__", None)
        if state is None and hasattr(type(value), "__dataclass_fields__"):  # with slots
            state = {name: getattr(value, name, None) for name in type(value).__dataclass_fields__}
        held = [n for kind in type(value).__mro__[:-1] for n in np.atleast_1d(vars(kind).get("__slots__", ()))]
        if state is None and not held:
            raise UnknownError(f"an instance of {type(value).__qualname__}, {value!r}")
        self._write("instance")
        self.constant(type(value))
        self.constant(dict(sorted((state or {}).items())))
        self._all(getattr(value, name, None) for name in held if name not in ("__dict__", "__weakref__"))


def _content(cell: types.CellType) -> tuple[Any, ...]:
    try:
        return (cell.cell_contents,)
    except ValueError:  # not filled yet
        return ()


def _names(code: types.CodeType) -> set[str]:
    """Those that a function may look up among the globals, those of functions within it included."""
    inner = (part for part in code.co_consts if isinstance(part, types.CodeType))
    return set(code.co_names).union(*map(_names, inner))


def _digest_of(value: Any) -> str:
    alone = Fingerprint()
    alone.constant(value)
    return alone.digest
