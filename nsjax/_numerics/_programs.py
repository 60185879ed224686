"""Traced programs that are kept in a folder, so that another process need not trace them again."""

import contextlib
import functools as ft
import hashlib
import io
import os
import pathlib
import pickle
import platform
import sys
import zlib
from collections.abc import Callable
from typing import Any

import equinox as eqx
import jax
import jax.export as jexp
import jax.numpy as jnp
import numpy as np

from ._fingerprint import Fingerprint, KNOWN, stamp, UnknownError
from ._settings import settings


ROOM = 1 << 30  # bytes that the folder may take
FORMAT = 4  # of the files
# What results may be made of beside arrays: classes of these packages, and plain values.
PACKAGES = ("nsjax", "equinox", "diffrax", "optimistix", "lineax")
PLAIN = (
    "bool",
    "bytes",
    "complex",
    "dict",
    "float",
    "frozenset",
    "int",
    "list",
    "range",
    "set",
    "slice",
    "str",
    "tuple",
)


class _Place:
    """The folder of programs; `None`: none are kept."""

    folder: pathlib.Path | None = None


def cache_folder() -> pathlib.Path:
    """Where programs of this user keep what can be made again."""
    home = pathlib.Path.home()
    if sys.platform == "win32":
        base = pathlib.Path(os.environ.get("LOCALAPPDATA", home / "AppData" / "Local"))
    elif sys.platform == "darwin":
        base = home / "Library" / "Caches"
    else:
        base = pathlib.Path(os.environ.get("XDG_CACHE_HOME") or home / ".cache")
    return base / "nsjax"


def keep_programs(folder: str | os.PathLike | None = None) -> pathlib.Path:
    """From now on keeps traced programs in a folder, and looks there before it traces one: in another session, or when
    a notebook is run again, the first answer comes sooner. The command line does this by itself.

    Compiled code is kept by JAX, if you ask for it by `jax.config.update("jax_compilation_cache_dir", folder)`; the
    two together skip nearly all that precedes the first answer. Programs are kept of functions that are called
    directly, such as `solve`, `find_orbit` and `sweep`, on one CPU. One is found again only if all that it was made of
    is the same: the code of the model with whatever it refers to, the kinds of the arguments, nsjax, the libraries, the
    settings of JAX. If that cannot be told (of a model that uses a module of yours, for instance), nothing is kept, and
    all works as before. What a model reads while it is traced, files or the clock, is not looked at: read it before,
    into fields or constants.

    **Arguments:**

    - `folder`: by default that of nsjax in the cache of the user. The programs not used for longest are dropped from
        1 GiB on.

    **Returns:** the folder.

    **Raises:** `OSError` if there is no such folder and none can be made.
    """
    where = cache_folder() if folder is None else pathlib.Path(folder).expanduser()
    where.mkdir(parents=True, exist_ok=True)
    _Place.folder = where
    return where


def is_kept() -> bool:
    """Whether a program that is called now would be kept: on one device that is the processor."""
    if _Place.folder is None or getattr(jax.config, "jax_disable_jit", False):
        return False
    return jax.default_backend() == "cpu" and jax.local_device_count() == 1


class _Array:
    """Stands for an array in a tree."""


_ARRAY = _Array()


def kept(fn: Callable[..., Any]) -> Callable[..., Any]:
    """Returns `fn`, a function of pytrees, for a caller that traces it: its program comes from the folder, if it is
    there, and is written to it, if it can be."""

    @ft.wraps(fn)
    def call(*args: Any, **kwargs: Any) -> Any:
        found = _found(fn, (args, kwargs)) if is_kept() else None
        if found is None:
            return fn(*args, **kwargs)
        program, skeleton = found
        results = iter(program.call([x for x in jax.tree.leaves((args, kwargs)) if eqx.is_array(x)]))
        return jax.tree.map(lambda leaf: next(results) if leaf is _ARRAY else leaf, skeleton)

    return call


def uncommitted(tree: Any) -> Any:
    """The same arguments, none of which is committed to a device, as the results of a program from the folder are:
    `jax.jit` would compile once more for each combination of arguments that are and that are not."""

    def leaf(x: Any) -> Any:
        plain = isinstance(x, jax.Array) and not jnp.issubdtype(x.dtype, jax.dtypes.extended)  # no random key
        return np.asarray(x) if plain and x.committed else x

    return jax.tree.map(leaf, tree)


def _found(fn: Callable[..., Any], given: Any) -> tuple[jexp.Exported, Any] | None:
    """The program of `fn` for such arguments, and its result with placeholders for arrays; None if none is kept."""
    assert _Place.folder is not None
    fingerprint = Fingerprint()
    try:
        fingerprint.constant((_surroundings(), settings()))
        fingerprint.constant(fn)
        fingerprint.traced(given)
    except (UnknownError, RecursionError):
        return None
    file = _Place.folder / f"{fingerprint.digest}.program"
    found = _read(file, fingerprint)
    if found is None:
        found = _traced(fn, given)
        if found is not None:
            _write(file, *found, fingerprint)
    return found


def _traced(fn: Callable[..., Any], given: Any) -> tuple[jexp.Exported, Any] | None:
    leaves, structure = jax.tree.flatten(given)
    skeleton: list[Any] = []

    def listed(arrays: list[Any]) -> list[Any]:
        rest = iter(arrays)
        args, kwargs = jax.tree.unflatten(structure, [next(rest) if eqx.is_array(x) else x for x in leaves])
        out = fn(*args, **kwargs)
        skeleton[:] = [jax.tree.map(lambda x: _ARRAY if eqx.is_array(x) else x, out)]
        return [x for x in jax.tree.leaves(out) if eqx.is_array(x)]

    def form(x: Any) -> jax.ShapeDtypeStruct:
        aval = jax.typeof(x)
        return jax.ShapeDtypeStruct(aval.shape, aval.dtype, weak_type=aval.weak_type)

    forms = [form(x) for x in leaves if eqx.is_array(x)]
    try:
        return jexp.export(jax.jit(listed))(forms), skeleton[0]
    except (ValueError, NotImplementedError):
        # `jax.export` refuses programs that call Python; a mistake in the model is raised when `kept` calls `fn`.
        return None


@ft.cache
def _surroundings() -> tuple[Any, ...]:
    """What a program depends on beside its arguments, and what does not change while a process runs: the files of this
    package and of the libraries, Python and the machine."""
    ours = hashlib.sha256()
    for path in sorted(pathlib.Path(__file__).parents[1].rglob("*.py")):
        ours.update(str(path).encode() + path.read_bytes())
    libraries = [stamp(name) for name in KNOWN if name != "nsjax"]
    given = sorted((k, v) for k, v in os.environ.items() if k.startswith("EQX_"))
    return (FORMAT, ours.hexdigest(), libraries, sys.version, platform.platform(), given)


class _Writer(pickle.Pickler):
    """Of classes and functions that came with the arguments it writes the number only: those of another process have
    the same, and a user's may not be found by name."""

    def __init__(self, file: Any, fingerprint: Fingerprint) -> None:
        super().__init__(file)
        self._number = fingerprint.number

    def persistent_id(self, obj: Any) -> Any:
        return "array" if obj is _ARRAY else self._number(obj)


class _Reader(pickle.Unpickler):
    def __init__(self, file: Any, fingerprint: Fingerprint) -> None:
        super().__init__(file)
        self._seen = fingerprint.seen

    def persistent_load(self, pid: Any) -> Any:
        return _ARRAY if pid == "array" else self._seen[pid]

    def find_class(self, module_name: str, global_name: str) -> Any:
        """Classes of results alone, so that a file of someone else's can run nothing."""
        plain = module_name == "builtins" and global_name in PLAIN
        if plain or module_name.partition(".")[0] in PACKAGES:
            found = super().find_class(module_name, global_name)
            if isinstance(found, type):
                return found
        raise pickle.UnpicklingError(f"{module_name}.{global_name} is no class of a result")


def _write(file: pathlib.Path, program: jexp.Exported, skeleton: Any, fingerprint: Fingerprint) -> None:
    """Some results cannot be written: those that hold functions of this process, for instance."""
    form = io.BytesIO()
    try:
        _Writer(form, fingerprint).dump(skeleton)
        parts = form.getvalue(), bytes(program.serialize())
        whole = zlib.compress(b"".join(len(part).to_bytes(8, "big") + part for part in parts), 1)
    except Exception:  # of every kind, by what is within; ImportError without flatbuffers
        return
    with contextlib.suppress(OSError):
        _make_room(file.parent, len(whole))
        part = file.with_suffix(f".{os.getpid()}")
        part.write_bytes(whole)
        part.replace(file)


def _read(file: pathlib.Path, fingerprint: Fingerprint) -> tuple[jexp.Exported, Any] | None:
    """Nothing if there is none, or if it cannot be used."""
    try:
        whole = zlib.decompress(file.read_bytes())
        size = int.from_bytes(whole[:8], "big")
        skeleton = _Reader(io.BytesIO(whole[8 : 8 + size]), fingerprint).load()
        program = jexp.deserialize(bytearray(whole[16 + size :]))
        os.utime(file)
    except Exception:  # of every kind, by what is wrong with it
        return None
    return program, skeleton


def _make_room(folder: pathlib.Path, size: int) -> None:
    """Drops those that were not used for longest."""
    found = sorted((entry.stat().st_mtime, entry.stat().st_size, entry) for entry in folder.glob("*.program"))
    total = size + sum(row[1] for row in found)
    for _, bytes_, entry in found:
        if total <= ROOM:
            break
        entry.unlink(missing_ok=True)
        total -= bytes_
