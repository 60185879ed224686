"""`sweep`: a function of one lane applied to many, in chunks of a size at which a processor is fastest."""

from collections.abc import Callable
from typing import Any

import equinox as eqx
import jax
import jax.lax as lax
import jax.numpy as jnp
import numpy as np


# Small enough for the working set of a step to stay in the cache and for lanes to wait for few others, large enough to
# fill the vector units and hide what every step costs once: `benchmarks/growth.py` measures it.
CHUNK = 256


def _has_lanes(leaf: Any) -> bool:
    return eqx.is_array(leaf) and leaf.ndim > 0


def _number_of_lanes(mapped: Any) -> int:
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
    return next(iter(lengths.values()))


@eqx.filter_jit
def _run(fn: Callable[..., Any], mapped: Any, rest: Any, lanes: int, chunk: int) -> Any:
    def lane(mapped: Any) -> Any:
        return fn(*eqx.combine(mapped, rest))

    if lanes <= chunk:
        return jax.vmap(lane)(mapped)
    # Chunks of one length are one program; a shorter last one would be compiled apart. So they are made as even as can
    # be, and the last is filled up with its last lane.
    chunks = -(-lanes // chunk)
    chunk = -(-lanes // chunks)
    place = jnp.minimum(jnp.arange(chunks * chunk), lanes - 1).reshape(chunks, chunk)
    out = lax.map(jax.vmap(lane), jax.tree.map(lambda x: x[place], mapped))
    return jax.tree.map(lambda x: x.reshape(-1, *x.shape[2:])[:lanes], out)


def sweep(fn: Callable[..., Any], *args: Any, chunk: int | None = None) -> Any:
    """Applies `fn` to every lane: `jax.vmap(fn)(*args)`, but compiled, and in chunks, which on a CPU is faster for
    thousands of lanes, and works in the memory of one chunk.

    ```python
    def final(v_dr):
        return nsjax.solve(StickSlip(v_dr=v_dr), 0.0, 100.0, State(2.5, 0.0), throw=False).y1

    y1 = nsjax.sweep(final, jnp.linspace(0.1, 1.0, 4096))  # y1.x has shape (4096,)
    ```

    Derivatives go through it (`jax.jacfwd`, and `jax.grad` if `fn` allows it), and it may stand within `jax.jit`.

    **Arguments:**

    - `fn`: a function of one lane, returning any pytree of arrays and numbers.
    - `args`: its arguments, any pytrees, such as a state or a `System`. Arrays of shape `(lanes, ...)` are mapped over
        their first axis; numbers and arrays of shape `()` are the same in every lane, and so is everything else.
        A parameter that is itself an array, the same in every lane, belongs into `fn`.
    - `chunk`: how many lanes go together; by default 256 on a CPU, and all on other devices.

    **Returns:** what `fn` returned, with a first axis of length `lanes`.

    **Raises:** `ValueError` if the arrays are of different lengths along their first axes, or if there are none.
    """
    if chunk is not None and (not isinstance(chunk, int) or chunk < 1):
        raise ValueError(f"Argument `chunk` must be a positive integer, but got {chunk!r}.")
    # Numbers are traced too: a new one is no new program.
    args = jax.tree.map(lambda x: jnp.asarray(x) if isinstance(x, (float, np.ndarray)) else x, args)
    mapped, rest = eqx.partition(args, _has_lanes)
    lanes = _number_of_lanes(mapped)
    if chunk is None:
        chunk = CHUNK if jax.default_backend() == "cpu" else lanes
    return _run(fn, mapped, rest, lanes, chunk)
