"""Which multipliers belong together: what the value of each switch acts on, read off the model while it is traced."""

from typing import Any, NamedTuple

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from .._numerics._linalg import coloured, Row, WRITTEN_OUT
from .._numerics._select import select


Block = tuple[int, ...]
"""Positions in `SwitchedSystem.holdable`."""


class Coupling(NamedTuple):
    """The structure of the matrix of multipliers, the rates of surfaces by the values of switches: entries that are
    zero whatever the state are neither computed nor solved for. A chain of blocks, each on its own friction, costs what
    its blocks cost, and not the square or the cube of their number.

    - `colours`: values no two of which act on one surface, so that one derivative gives the columns of all of them
        (Curtis, Powell & Reid 1974). `slope[surface][colour]` is how the matrix is handed on.
    - `groups`: of blocks of one size that are solved at once, as arrays; the blocks are coupled to no others.
    """

    touches: tuple[tuple[bool, ...], ...]  # [surface][value]
    colours: tuple[Block, ...]
    groups: tuple[tuple[Block, ...], ...]

    @classmethod
    def of(cls, touches: np.ndarray, pairs: tuple[Block, ...]) -> "Coupling":
        """`touches[i, j]`: whether value j may act on surface i; `pairs`: of surfaces that may coincide, which the
        solution of their block looks at one by one."""
        m = len(touches)
        touches = touches | np.eye(m, dtype=bool)
        colours = coloured(touches) if m > WRITTEN_OUT else [[j] for j in range(m)]
        linked = touches | touches.T
        for _ in range(m.bit_length()):  # twice as far each time
            linked = linked @ linked
        first = linked.argmax(axis=1) if m else np.zeros(0, int)  # of those that each is coupled to
        groups: dict[Any, list[Block]] = {}
        for n in np.unique(first):
            block = tuple(map(int, np.flatnonzero(first == n)))
            single = m <= WRITTEN_OUT or len(block) > WRITTEN_OUT or any(i in block for i, _ in pairs)
            groups.setdefault(block if single else len(block), []).append(block)
        tables = (touches.tolist(), colours, groups.values())
        return cls(*(tuple(map(tuple, table)) for table in tables))

    @property
    def colour(self) -> np.ndarray:
        """Of each value."""
        found = {j: n for n, colour in enumerate(self.colours) for j in colour}
        return np.array([found[j] for j in range(len(found))], int)

    @property
    def seeds(self) -> np.ndarray:
        """`[value][colour]`: directions that give the columns of the matrix."""
        return self.colour[:, None] == np.arange(len(self.colours))

    @property
    def block_of(self) -> list[Block]:
        """That to which each value belongs."""
        found = {i: block for group in self.groups for block in group for i in block}
        return [found[i] for i in range(len(found))]

    def entries(self, slope: list[Any], i: Any, j: Any) -> Array:
        """Of the matrix, of surfaces i and values j: numbers, or arrays of them."""
        if isinstance(slope[0], list):
            return slope[i][j]
        there, colour = np.array(self.touches)[i, j], self.colour[j]
        if np.ndim(i):
            found = jnp.stack(slope)[i, colour] if len(self.colours) > 1 else taken(jnp.stack(slope)[:, 0], i)
        else:
            found = taken(slope[i], colour)
        # Of a colour only one value acts on a surface, and the others of a block need not.
        return found if np.all(there) else select(there, found, 0)

    def matrix(self, slope: list[Any]) -> Float[Array, "m m"]:
        """With all of its zeros."""
        if len(slope) <= WRITTEN_OUT:
            return jnp.stack([jnp.stack(entries) for entries in slope])
        return select(np.array(self.touches), taken(jnp.stack(slope, axis=1), self.colour).T, 0)

    def joined(self, parts: list[Any]) -> Row:
        """One row of the results for the members of the blocks of each group: `[group][member]`."""
        order = np.concatenate([np.ravel(np.transpose(group)) for group in self.groups])
        if len(order) <= WRITTEN_OUT:
            flat = [x for part in parts for x in part]
            return [flat[i] for i in np.argsort(order)]
        flat = jnp.concatenate([jnp.ravel(jnp.asarray(x)) for part in parts for x in part])
        return taken(flat, np.argsort(order))


def members(group: tuple[Block, ...]) -> list[Any]:
    """Of blocks of one size their first members, their second ones, and so on; of a single block numbers."""
    return list(group[0]) if len(group) == 1 else [np.array(column) for column in zip(*group)]


def taken(x: Any, index: Any) -> Any:
    """Members of a row: one, or several."""
    return x if np.ndim(index) and np.array_equal(index, np.arange(len(x))) else x[index]
