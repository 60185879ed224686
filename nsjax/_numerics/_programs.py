"""Finished programs, kept in a folder from one process to the next: neither traced nor compiled again."""

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
from collections.abc import Callable, Iterator
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

from ._fingerprint import Fingerprint, KNOWN, UnknownError


try:
    from jax._src.config import trace_context
    from jax._src.util import cache
    from jax.experimental import serialize_executable
    from jaxlib.lapack import prepare_lapack_call
except ImportError:  # then none is kept
    trace_context: Any = None

ROOM = 1 << 30  # bytes that the folder may take
FORMAT = 3  # of the files


class _Place:
    """Where programs are kept; `None`: nowhere."""

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
    """From now on keeps finished programs in a folder, and looks there before it makes one: in another session, or when
    a notebook is run again, the first answer comes without tracing and compiling. The command line does this by itself.

    What is kept are the programs of functions that are called directly, such as `solve`, `find_orbit` and `sweep`, on
    one CPU; within your own `jax.jit` they are part of a program that JAX keeps (`jax_compilation_cache_dir`). One is
    found again only if all that it was made of is the same: the code of the model with whatever it refers to, the kinds
    of the arguments, nsjax, the libraries, the settings of JAX, the machine. If that cannot be told (of a model that
    uses a module of yours, for instance), nothing is kept, and all works as before. What a model reads while it is
    traced, files or the clock, is not looked at: read it before, into fields or constants.

    **Arguments:**

    - `folder`: by default that of nsjax in the cache of the user. It holds executable code: use none that others can
        write to. The programs not used for longest are dropped from 1 GiB on.

    **Returns:** the folder.

    **Raises:** `OSError` if there is no such folder and none can be made.
    """
    where = cache_folder() if folder is None else pathlib.Path(folder).expanduser()
    where.mkdir(parents=True, exist_ok=True)
    _Place.folder = where
    return where


def is_kept() -> bool:
    """Whether a program that is called now would be kept: on one device that is the processor."""
    if _Place.folder is None or trace_context is None or jax.config.values["jax_disable_jit"]:
        return False
    return jax.default_backend() == "cpu" and jax.local_device_count() == 1


class _Array:
    """Stands in a tree for an array."""


_ARRAY = _Array()


def split(tree: Any) -> tuple[list[Any], tuple[Any, ...], Any]:
    """The arrays of a tree, its other leaves with placeholders for these, and its structure."""
    leaves, structure = jax.tree.flatten(tree)
    arrays = [leaf for leaf in leaves if eqx.is_array(leaf)]
    return arrays, tuple(_ARRAY if eqx.is_array(leaf) else leaf for leaf in leaves), structure


def _joined(arrays: Any, others: tuple[Any, ...], structure: Any) -> Any:
    given = iter(arrays)
    return jax.tree.unflatten(structure, [next(given) if leaf is _ARRAY else leaf for leaf in others])


class _Program:
    """Compiled code, and of what it returns all that is no array. `again` compiles it, if it was read from a file."""

    def __init__(self, compiled: Any, others: tuple[Any, ...], structure: Any, again: Any = None) -> None:
        self.compiled, self.others, self.structure, self._again = compiled, others, structure, again

    def __call__(self, arrays: list[Any]) -> Any:
        try:
            found = self.compiled(arrays)[:-1]
        except jax.errors.JaxRuntimeError:
            if self._again is None:
                raise
            self.compiled = self._again().compiled  # this machine cannot use the file
            found = self.compiled(arrays)[:-1]
        self._again = None  # it works
        return _joined(found, self.others, self.structure)


class Programs:
    """A function as programs, one for each kind of arguments.

    **Arguments:**

    - `fn`: the function, of pytrees.
    - `options`: gives the options of the compiler.
    """

    def __init__(self, fn: Callable[..., Any], options: Callable[[], dict[str, Any]]) -> None:
        self._fn, self._options = fn, options
        # With those of JAX: `jax.clear_caches()` forgets them too.
        self._known = dict if trace_context is None else cache(max_size=None, trace_context_in_key=False)(dict)

    def __call__(self, *args: Any, **kwargs: Any) -> Any:
        arrays, *rest = split((args, kwargs))
        return self._ready((args, kwargs), arrays, *rest)(arrays)

    def ready(self, *args: Any) -> _Program:
        """The program for such arguments, which is called with their arrays."""
        return self._ready((args, {}), *split((args, {})))

    def _ready(self, given: Any, arrays: list[Any], others: tuple[Any, ...], structure: Any) -> _Program:
        kinds = tuple(jax.typeof(array) for array in arrays)
        signature = (structure, others, tuple(map(type, others)), kinds, trace_context())
        known = self._known()
        program = known.get(signature)
        if program is None:
            program = known[signature] = self._made(given, arrays, others, structure)
        return program

    def _made(self, given: Any, arrays: list[Any], others: tuple[Any, ...], structure: Any) -> _Program:
        """Read from the folder, if there is one; or compiled, and written there."""
        again = ft.partial(self._compiled, arrays, others, structure)
        if not is_kept():
            return again()
        assert _Place.folder is not None
        fingerprint = Fingerprint()
        try:
            fingerprint.constant((_surroundings(), _settings(), self._options()))
            fingerprint.constant(self._fn)
            fingerprint.traced(given)
        except (UnknownError, RecursionError):
            return again()
        file = _Place.folder / f"{fingerprint.digest}.program"
        program = _read(file, arrays, fingerprint, again)
        if program is None:
            program = again()
            _write(file, program, fingerprint)
        return program

    def _compiled(self, arrays: list[Any], others: tuple[Any, ...], structure: Any) -> _Program:
        returned: list[Any] = []

        def kept_by_nsjax(arrays: list[Any]) -> list[Any]:
            args, kwargs = _joined(arrays, others, structure)
            found, *rest = split(self._fn(*args, **kwargs))
            returned[:] = rest
            # With this besides, as `equinox.filter_jit` has it by chance, XLA's executor hands fewer tasks to other
            # threads: sweeps take half of the processor's time, and two thirds of the clock's.
            return [*found, jnp.zeros((), jnp.int32)]

        lowered = jax.jit(kept_by_nsjax).lower(arrays)
        with _not_kept_by_jax() if is_kept() else contextlib.nullcontext():
            compiled = lowered.compile(self._options() or None)
        return _Program(compiled, *returned)


@contextlib.contextmanager
def _not_kept_by_jax() -> Iterator[None]:
    """Code that comes out of JAX's own cache cannot be written again (its functions are not found when it is run)."""
    name = "jax_persistent_cache_min_compile_time_secs"
    before = getattr(jax.config, name)
    jax.config.update(name, float("inf"))
    try:
        yield
    finally:
        jax.config.update(name, before)


@ft.cache
def _surroundings() -> tuple[Any, ...]:
    """What a program depends on beside its arguments, and what does not change while a process runs: this package, the
    libraries, Python and the machine."""
    ours = hashlib.sha256()
    for path in sorted(pathlib.Path(__file__).parents[1].rglob("*.py")):
        ours.update(str(path).encode() + path.read_bytes())
    versions = [getattr(sys.modules.get(name), "__version__", "") for name in KNOWN]
    with contextlib.suppress(OSError):
        lines = pathlib.Path("/proc/cpuinfo").read_text().partition("\n\n")[0].splitlines()
        versions += [line for line in lines if line.startswith(("model name", "flags", "Features"))]
    given = sorted((k, v) for k, v in os.environ.items() if k.startswith(("XLA_", "EQX_")))
    return (FORMAT, ours.hexdigest(), versions, sys.version, platform.platform(), platform.processor(), given)


def _settings() -> list[Any]:
    """Those of JAX that are not about caches or what it writes of its own work."""
    names = (name for name in sorted(jax.config.values) if not any(word in name for word in ("cache", "log", "dump")))
    return [(name, str(getattr(jax.config, name, None))) for name in names]


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


def _write(file: pathlib.Path, program: _Program, fingerprint: Fingerprint) -> None:
    """Some cannot be written: those that call Python, for instance."""
    try:
        code = serialize_executable.serialize(program.compiled)[0]
        skeleton, count = io.BytesIO(), 1 + sum(leaf is _ARRAY for leaf in program.others)
        _Writer(skeleton, fingerprint).dump(jax.tree.unflatten(program.structure, program.others))
        whole = zlib.compress(pickle.dumps((skeleton.getvalue(), count, code)), 1)
    except Exception:  # of every kind, by what is within
        return
    with contextlib.suppress(OSError):
        _make_room(file.parent, len(whole))
        part = file.with_suffix(f".{os.getpid()}")
        part.write_bytes(whole)
        part.replace(file)


def _read(
    file: pathlib.Path, arrays: list[Any], fingerprint: Fingerprint, again: Callable[[], _Program]
) -> _Program | None:
    """Nothing if there is none, or if it cannot be used."""
    try:
        skeleton, count, code = pickle.loads(zlib.decompress(file.read_bytes()))
        tree = _Reader(io.BytesIO(skeleton), fingerprint).load()
        _, others, structure = split(tree)
        wanted = jax.tree.structure(((arrays,), {})), jax.tree.structure([0] * count)
        _give_lapack()
        compiled = serialize_executable.deserialize_and_load(code, *wanted)
        os.utime(file)
    except Exception:  # of every kind, by what is wrong with it
        return None
    return _Program(compiled, others, structure, again)


@ft.cache
def _give_lapack() -> None:
    """Tracing looks up the functions of LAPACK; without it finished code would call nothing, which ends the process."""
    prepare_lapack_call("getrf", np.dtype("float64"))


def _make_room(folder: pathlib.Path, size: int) -> None:
    """Drops those that were not used for longest."""
    found = sorted((entry.stat().st_mtime, entry.stat().st_size, entry) for entry in folder.glob("*.program"))
    total = size + sum(row[1] for row in found)
    for _, bytes_, entry in found:
        if total <= ROOM:
            break
        entry.unlink(missing_ok=True)
        total -= bytes_
