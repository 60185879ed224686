"""Loops that go on while any lane of a batch does."""

from collections.abc import Callable
from typing import Any, TypeVar

import equinox as eqx
import equinox.internal as eqxi
import jax
import jax.lax as lax
from jaxtyping import Array, Bool


T = TypeVar("T")


def while_any(
    going: Callable[[T], Bool[Array, ""]], body: Callable[[T], T], carry: T, checkpointed: dict[str, Any] | None = None
) -> T:
    """`carry` once `going` is false in every lane. Lanes in which it is false go along, and `body` must leave them as
    they are. What is no array stays. `checkpointed`: options of a loop for reverse mode."""
    # One predicate for all lanes: JAX would otherwise select between old and new carries, and copy every buffer.
    arrays, rest = eqx.partition(carry, eqx.is_array)

    def some(arrays: Any) -> Bool[Array, ""]:
        return eqxi.unvmap_any(going(eqx.combine(arrays, rest)))

    def turn(arrays: Any) -> Any:
        new = eqx.filter(body(eqx.combine(arrays, rest)), eqx.is_array)
        return jax.tree.map(lambda old, x: x.astype(old.dtype), arrays, new)

    # (Equinox's loop would have three copies of each number of the carry in its program, and again in derivatives.)
    if checkpointed is None:
        arrays = lax.while_loop(some, turn, arrays)
    else:
        arrays = eqxi.while_loop(some, turn, arrays, kind="checkpointed", **checkpointed)
    return eqx.combine(arrays, rest)
