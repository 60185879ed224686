"""The lanes of a sweep: what of its arguments is mapped, and what is the same in every lane."""

from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np


# Small enough for the working set of a step to stay in the cache and for lanes to wait for few others, large enough to
# fill the vector units and hide what every step costs once: `benchmarks/growth.py` measures it.
CHUNK = 256


class Lanes(NamedTuple):
    """Arguments of a function in two trees of their structure, None where the other one has it."""

    mapped: Any  # arrays of shape (lanes, ...)
    rest: Any
    number: int

    def rows(self, which: slice | np.ndarray) -> Any:
        """What is mapped, of some lanes."""
        return jax.tree.map(lambda x: x[which], self.mapped)

    def on_host(self) -> "Lanes":
        """To take rows from while devices are busy."""
        keys = jax.dtypes.extended
        there = jax.tree.map(lambda x: x if jnp.issubdtype(x.dtype, keys) else _array(x), self.mapped)
        return self._replace(mapped=there)


def _array(x: Any) -> np.ndarray:
    return x if isinstance(x, np.ndarray) else np.asarray(x)  # (what is on the disk stays a `numpy.memmap`)


def lanes_of(args: Any) -> Lanes:
    """Nothing is copied: an array on the disk stays there."""
    # Numbers are traced too: a new one is no new program.
    args = jax.tree.map(lambda x: jnp.asarray(x) if isinstance(x, float | np.ndarray) and np.ndim(x) == 0 else x, args)
    mapped, rest = eqx.partition(args, lambda x: isinstance(x, jax.Array | np.ndarray) and x.ndim > 0)
    lengths = {jax.tree_util.keystr(path): len(x) for path, x in jax.tree_util.tree_leaves_with_path(mapped)}
    if not lengths:
        raise ValueError(
            "`nsjax.sweep` needs an array with an axis to go along among its arguments, but got only scalars."
        )
    if len(set(lengths.values())) > 1:
        found = ", ".join(f"`args{path}` has {n}" for path, n in lengths.items())
        raise ValueError(
            f"Arguments of `nsjax.sweep` must have one length along their first axes, but {found}. "
            "What is the same in every lane is left to the function: `lambda p: fn(p, same)`."
        )
    return Lanes(mapped, rest, next(iter(lengths.values())))


def default_chunk(lanes: int, platform: str) -> int:
    return CHUNK if platform == "cpu" else max(1, lanes)


def even_chunks(lanes: int, chunk: int) -> tuple[int, int]:
    """How many chunks there are, and how many lanes go together: chunks of one length are one program. So they are made
    as even as can be, and the last is filled up with its last lane."""
    chunks = max(1, -(-lanes // chunk))
    return chunks, -(-lanes // chunks)
