"""Lanes in chunks, one after the other, as part of one program: through which derivatives go."""

from collections.abc import Callable
from typing import Any

import equinox as eqx
import jax
import jax.lax as lax
import jax.numpy as jnp

from ._lanes import even_chunks


def in_chunks(fn: Callable[..., Any], mapped: Any, rest: Any, chunk: int) -> Any:
    def lane(mapped: Any) -> Any:
        return fn(*eqx.combine(mapped, rest))

    lanes = len(jax.tree.leaves(mapped)[0])
    chunks, chunk = even_chunks(lanes, chunk)
    if chunks == 1:
        return jax.vmap(lane)(mapped)
    place = jnp.minimum(jnp.arange(chunks * chunk), lanes - 1).reshape(chunks, chunk)
    out = lax.map(jax.vmap(lane), jax.tree.map(lambda x: x[place], mapped))
    return jax.tree.map(lambda x: x.reshape(-1, *x.shape[2:])[:lanes], out)
