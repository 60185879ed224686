"""What makes a sweep the one it is: its program, its arguments, and the versions of what computes it."""

import hashlib
from collections.abc import Callable
from importlib.metadata import version
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

from .._version import __version__
from ._lanes import Lanes
from ._piece import Piece


FORMAT = 1
PACKAGES = ("jax", "jaxlib", "equinox", "diffrax", "optimistix", "lineax")
ROWS = 1 << 20  # of an argument that are looked at together: it may lie on a disk, and be larger than the memory


def fingerprint(fn: Callable[..., Any], lanes: Lanes, piece: Piece, block: int, names: list[str]) -> dict[str, Any]:
    """In JSON, by the names under which the differences are told. The program is what is compiled: whatever in `fn`, in
    the model or in the options makes another one of it makes another sweep; a comment or a name does not."""
    program = hashlib.sha256()
    for each in piece.programs:
        program.update(each.text.encode())
        for const in each.consts:
            program.update(_digest(const).encode())
    own = jax.tree_util.tree_leaves_with_path(eqx.filter(fn, eqx.is_array))
    args = jax.tree_util.tree_leaves_with_path(eqx.filter((lanes.mapped, lanes.rest), _is_array))
    return {
        "format": FORMAT,
        "function": getattr(fn, "__qualname__", type(fn).__qualname__),
        "lanes": lanes.number,
        "block": block,
        "chunk": piece.chunk,
        "program": program.hexdigest(),
        "arguments": {
            **{f"`fn{jax.tree_util.keystr(path)}`": _digest(x) for path, x in own},
            # (The first key says in which of the two trees it is.)
            **{f"`args{jax.tree_util.keystr(path[1:])}`": _digest(x) for path, x in args},
        },
        "versions": {"nsjax": __version__, **{name: version(name) for name in PACKAGES}},
        "platform": piece.platform,
        "leaves": [[name, x.dtype.name, list(x.shape)] for name, x in zip(names, piece.program.forms)],
    }


def _is_array(x: Any) -> bool:
    return isinstance(x, jax.Array | np.ndarray)


def _digest(array: Any) -> str:
    if isinstance(array, jax.Array) and jnp.issubdtype(array.dtype, jax.dtypes.prng_key):
        array = jax.random.key_data(array)
    found = hashlib.blake2b(f"{array.dtype.name}{array.shape}".encode(), digest_size=16)
    for rows in [array] if array.ndim == 0 else (array[i : i + ROWS] for i in range(0, len(array), ROWS)):
        found.update(np.ascontiguousarray(rows).data)
    return found.hexdigest()


def differences(there: dict[str, Any], here: dict[str, Any]) -> list[str]:
    """In words; an empty list if it is the same sweep. (The function's name may be another one.)"""
    if there.get("format") != here["format"]:
        return [f"it is of format {there.get('format')}, and this version of nsjax writes format {here['format']}"]
    found = [f"{name} {there[name]} there, {here[name]} here" for name in ("lanes", "block", "chunk", "platform")
             if there[name] != here[name]]  # fmt: skip
    old, new = there["versions"], here["versions"]
    found += [f"{name} {old.get(name)} there, {new[name]} here" for name in new if old.get(name) != new[name]]
    old, new = there["arguments"], here["arguments"]
    changed = [name for name in {**old, **new} if old.get(name) != new.get(name)]
    if changed:
        found.append(f"other values of {', '.join(changed[:8])}" + ", ..." * (len(changed) > 8))
    if there["leaves"] != here["leaves"]:
        found.append("what the function returns has other names, types or shapes")
    if there["program"] != here["program"] and not found:
        found.append(f"another program: of `{there['function']}` there, of `{here['function']}` here")
    return found
