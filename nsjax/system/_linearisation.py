"""How the field of a mode, and the rates at which it moves along surfaces, change with the values of switches."""

from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp

from .._numerics._linalg import Row, row, WRITTEN_OUT
from .._types import Scalar, Y
from ._coupling import Coupling


class Linearisation(NamedTuple):
    """The field for given switch values, and what changes with those that can hold the solution on a surface."""

    field: Y
    push: Callable[..., list[Any]]  # what changes of those numbers make of the leaves of the field
    rates: Row  # of `SwitchedSystem.level`, for each surface that can be slid on
    slope: list[Any]  # of each its derivatives by the values of each colour, a row: see `Coupling`

    def pulled(self, tree: Y, by: Row) -> Y:
        """`tree` moved by the numbers `by` along the derivatives. For the field, if it is affine in the values, that is
        the field for values which differ by these numbers."""
        leaves, structure = jax.tree.flatten(tree)
        return jax.tree.unflatten(structure, [x if d is None else x + d for x, d in zip(leaves, self.push(*by))])


def linearise(
    field: Callable[..., list[Any]],
    values: tuple[Scalar, ...],
    levels: Callable[..., list[Scalar]],
    t: Scalar,
    y: Y,
    acts: tuple[tuple[bool, ...], ...],
    coupling: Coupling,
) -> Linearisation:
    """Of `field(*values)`, the leaves of y', and `levels(t, *leaves)`; each value acts on the leaves that `acts` tells.

    The derivatives by few values are worked out one by one, so that what is zero is left out; by many as a batch.
    """
    # The multipliers, the field for them, and the projection onto the surfaces need the same derivatives, and share
    # this result: worked out for each of them anew they made larger programs.
    leaves, tree = jax.tree.flatten(y)
    if len(values) > WRITTEN_OUT:
        at, push = jax.linearize(field, *values)
        still = jnp.zeros_like(t)
        pulls = jax.vmap(push)(*jnp.asarray(coupling.seeds, t.dtype))
        columns = jax.vmap(lambda *pull: jax.jvp(levels, (t, *leaves), (still, *pull))[1])(*pulls)
        slope = list(jnp.stack(columns))
    else:
        at, columns, slopes = leaves, [], []
        for j, moves in enumerate(acts):

            def by_one(value: Scalar, j: int = j) -> list[Any]:
                return field(*values[:j], value, *values[j + 1 :])

            at, pull = jax.jvp(by_one, (values[j],), (jnp.ones_like(values[j]),))
            columns.append([p if moved else None for p, moved in zip(pull, moves)])
            moved = [i for i, moved in enumerate(moves) if moved]

            def of_moved(*xs: Any, moved: list[int] = moved) -> list[Scalar]:
                full = dict(zip(moved, xs))
                return levels(t, *[full.get(i, leaf) for i, leaf in enumerate(leaves)])

            slopes.append(jax.jvp(of_moved, tuple(leaves[i] for i in moved), tuple(pull[i] for i in moved))[1])
        slope = [list(column) for column in zip(*slopes)]

        def push(*by: Scalar) -> list[Any]:
            terms = [[d * p for d, p in zip(by, pull) if p is not None] for pull in zip(*columns)]
            return [sum(row[1:], row[0]) if row else None for row in terms]

    rates = jax.jvp(levels, (t, *leaves), (jnp.ones_like(t), *at))[1]
    return Linearisation(jax.tree.unflatten(tree, at), push, row(rates), slope)
