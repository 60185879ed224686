"""Entries of an array at places that are known while a program is made."""

import itertools
from collections.abc import Callable
from typing import Any, NamedTuple

import jax.lax as lax
import jax.numpy as jnp
import numpy as np


_PARTS = 16  # that are cut out and put side by side, at most


class _Part(NamedTuple):
    """Places that lie evenly."""

    first: int
    count: int
    step: int  # 0: the same place again and again

    def of(self, x: Any) -> Any:
        if self.step == 0:
            return jnp.broadcast_to(x[self.first], (self.count, *x.shape[1:]))
        return lax.slice_in_dim(x, self.first, self.first + (self.count - 1) * self.step + 1, self.step)


def at_places(index: np.ndarray) -> Callable[[Any], Any]:
    """The function that makes `x[index]` of an array.

    What lies evenly is cut out and put side by side. In a batch of lanes an index array would be a gather, which XLA
    makes with the lanes last, in programs whose other arrays have them first: every kernel that met both changed the
    order of one (models with many switches took up to a fifth longer).
    """
    for period in range(1, _PARTS + 1):
        if len(index) % period:
            continue
        table = index.reshape(-1, period)
        steps = np.diff(table, axis=0)
        if len(table) > 1 and np.all(steps == steps[:1]) and np.all(steps >= 0):
            columns = [_Part(int(first), len(table), int(step)) for first, step in zip(table[0], steps[0])]
            return lambda x: _in_turn(x, columns)
    parts = _parts(index)
    if 0 < len(parts) <= _PARTS:
        return lambda x: jnp.concatenate([part.of(x) for part in parts])
    return lambda x: x[index]


def _in_turn(x: Any, columns: list[_Part]) -> Any:
    """The first entry of each of the columns, then the second of each."""
    if len(columns) == 1:
        return columns[0].of(x)
    blocks = []
    for column, same in itertools.groupby(columns):
        rows = column.of(x)[:, None]
        blocks.append(jnp.broadcast_to(rows, (len(rows), len(list(same)), *rows.shape[2:])))
    table = jnp.concatenate(blocks, axis=1) if len(blocks) > 1 else blocks[0]
    return table.reshape(-1, *x.shape[1:])


def _parts(index: np.ndarray) -> list[_Part]:
    """The places as parts that lie evenly, one after the other."""
    parts, i = [], 0
    while i < len(index):
        end, step = i + 1, 0
        if end < len(index) and index[end] >= index[i]:
            step = int(index[end] - index[i])
            while end < len(index) and index[end] - index[end - 1] == step:
                end += 1
        parts.append(_Part(int(index[i]), end - i, step))
        i = end
    return parts
