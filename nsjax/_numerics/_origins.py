"""How single numbers of a program are made of others: whether one is a multiple of another, told by the operations."""

from typing import Any, NamedTuple

import jax.numpy as jnp
import numpy as np

from ._jaxpr import ELEMENTWISE, MOVING
from ._kinks import Seen


_MOVES = frozenset(MOVING) - {"reduce_sum"}
_NEGATIVE = -1
_LEADING = {"neg": {_NEGATIVE: 0}, "mul": {0: 0, 1: 1}, "div": {0: 0}}  # operations: the steps, and to which argument

Way = tuple[int, ...]
"""From a number to one of which it is a multiple: a product or quotient is told by the place of the factor that leads
there, a negative or the opposite difference by -1."""


class Entry(NamedTuple):
    """A number: an entry of an array."""

    array: Any
    at: int = 0

    @property
    def key(self) -> tuple[int, int]:
        return id(self.array), self.at


class Origins:
    """Of the numbers in a program that was evaluated (`_kinks.evaluate`). Those that the same operations make of the
    same numbers are one."""

    def __init__(self, seen: Seen):
        self._made: dict[int, tuple[str, tuple, Any, int]] = {}  # by what, of what, how, and which of the results
        for (name, *_), (out, x, params) in seen.items():
            for n, one in enumerate(out if isinstance(out, list) else [out]):
                self._made[id(one)] = (name[0] if isinstance(name, tuple) else name), x, params, n
        self._kept = seen  # as numbers are told apart by where they are kept
        self._name: dict[tuple[int, int], int] = {}
        self._names: dict[Any, int] = {}

    def _operation(self, entry: Entry) -> tuple[Any, list[Entry]]:
        """What made a number and of which numbers; with no name if it was only moved, from one."""
        array, at = entry
        name, x, params, which = self._made.get(id(array), ("", (), None, 0))
        if name in _MOVES:
            ends = np.cumsum([0, *[v.size for v in x]])
            places = [np.arange(a, b).reshape(v.shape) for a, b, v in zip(ends, ends[1:], x)]
            moved = MOVING[name](params, *places)
            place = int(np.ravel(moved[which] if isinstance(moved, list) else moved)[at])
            source = int(np.searchsorted(ends, place, side="right")) - 1
            return None, [Entry(x[source], int(place - ends[source]))]
        if name in ELEMENTWISE:
            return (name, str(params or {})), [Entry(v, at if np.ndim(v) else 0) for v in x]
        if isinstance(array, np.ndarray):
            return ("number", array.dtype.str, array.ravel()[at].tobytes()), []
        return entry.key, []

    def name(self, entry: Entry) -> int:
        """The same for numbers that are one."""
        todo = [entry]  # and not by recursion: programs may be deep
        while todo:
            operation, parts = self._operation(todo[-1])
            new = [part for part in parts if part.key not in self._name]
            if new:
                todo += new
                continue
            names = [self._name[part.key] for part in parts]
            named = self._names.setdefault((operation, *names), len(self._names)) if operation else names[0]
            self._name[todo.pop().key] = named
        return self._name[entry.key]

    def _unmoved(self, entry: Entry) -> tuple[Any, list[Entry]]:
        """What made a number and of which numbers, wherever it was moved since."""
        operation, parts = self._operation(entry)
        while operation is None:
            operation, parts = self._operation(parts[0])
        return operation, parts

    def _number(self, entry: Entry) -> float | None:
        """A number that is written in the program."""
        (name, *value), _ = self._unmoved(entry)
        return float(np.frombuffer(value[1], value[0])[0]) if name == "number" else None

    def way(self, entry: Entry, other: Entry) -> Way | None:
        """How a number was made of another one as its multiple; None if it was not."""
        goal, (made, parts) = self.name(other), self._unmoved(other)
        opposite = [self.name(part) for part in reversed(parts)] if made[0] == "sub" else None
        todo: list[tuple[Entry, Way]] = [(entry, ())]
        been: set[int] = set()
        while todo:
            here, way = todo.pop()
            if self.name(here) == goal:
                return way
            if self.name(here) in been:
                continue
            been.add(self.name(here))
            (name, *_), parts = self._unmoved(here)
            if name == "sub" and [self.name(part) for part in parts] == opposite:
                return *way, _NEGATIVE
            todo += [(parts[place], (*way, step)) for step, place in _LEADING.get(name, {}).items()]
        return None

    def core(self, entry: Entry) -> tuple[Entry, int]:
        """A number without the factors that are written in the program, and their sign."""
        (name, *_), parts = self._unmoved(entry)
        for step, place in _LEADING.get(name, {}).items():
            factor = -1.0 if step == _NEGATIVE else self._number(parts[1 - step])
            if factor is not None and factor != 0:
                core, sign = self.core(parts[place])
                return core, sign * int(np.sign(factor))
        return entry, 1

    def sign(self, entry: Entry, way: Way) -> Any:
        """The sign of a number, relative to the one to which that way leads."""
        sign: Any = 1
        for step in way:
            _, parts = self._unmoved(entry)
            if step == _NEGATIVE:
                sign = -sign
            else:
                factor, at = parts[1 - step]
                sign = sign * jnp.sign(jnp.ravel(factor)[at])
            entry = parts[max(step, 0)]
        return sign
