"""A program as a graph: operations, their results, and of which single numbers arrays are made."""

from collections.abc import Callable, Mapping, Sequence
from typing import Any, NamedTuple

import jax.extend.core as jex
import numpy as np

from ._evaluation import called, Evaluation, has_programs
from ._jaxpr import ELEMENTWISE, MOVING


FEW = 4  # numbers that are worth an array, at least
MANY = 4096  # numbers in an array that is taken apart, at most
_MOVES = frozenset(MOVING) - {"reduce_sum"}  # operations that only move numbers
_COLLECTS = ("concatenate", "split", "stack")  # of which arrays of single numbers are made


class Node:
    """An operation. `place`: its number in the program, in which operands come before results; `depth`: the length of
    the longest way to it, so that none of one depth needs another."""

    __slots__ = ("bind", "depth", "effects", "ins", "kind", "name", "outs", "place", "primitive")

    def __init__(self, ins: list["Value"], place: int, primitive: Any, params: Mapping[str, Any], effects: bool):
        self.ins, self.place, self.primitive, self.effects = ins, place, primitive, effects
        self.name: str = primitive.name
        self.depth = 1 + max((v.depth for v in ins), default=0)
        self.outs: list[Value] = []
        for v in ins:
            v.uses += 1
        self.kind: Any = id(self)
        if self.name in ELEMENTWISE:
            self.kind = (self.name, *((k, str(p)) for k, p in params.items()), self.depth)

        def bind(*args: Any) -> list[Any]:
            out = primitive.bind(*args, **params)
            return list(out) if primitive.multiple_results else [out]

        self.bind: Callable[..., list[Any]] = bind


class Value:
    """A result of an operation, an argument, a constant; or an element of one of these; or an array made of others."""

    __slots__ = ("base", "const", "depth", "dtype", "elements", "entries", "index", "node", "place", "shape", "uses")

    def __init__(self, shape: tuple[int, ...], dtype: Any, place: int = -1, depth: int = 0):
        self.shape, self.dtype, self.place, self.depth = shape, dtype, place, depth
        self.node: Node | None = None
        self.const: Any = None
        self.base: Value | None = None  # of an element
        self.index = 0  # of an element in its base
        self.entries: np.ndarray | None = None  # the numbers of which an array is made, if they are none of its own
        self.elements: dict[int, Value] = {}
        self.uses = 0  # how many operations it is an operand of

    @classmethod
    def constant(cls, x: Any, aval: Any) -> "Value":
        value = cls(aval.shape, aval.dtype)
        value.const = x
        return value

    @classmethod
    def made_of(cls, values: Sequence["Value"]) -> "Value":
        """An array of these numbers."""
        new = cls((len(values),), values[0].dtype, max(v.place for v in values), max(v.depth for v in values))
        new.entries = np.empty(len(values), object)
        new.entries[:] = values
        return new

    @property
    def size(self) -> int:
        return int(np.prod(self.shape, dtype=int))

    @property
    def elementwise(self) -> bool:
        return self.node is not None and self.node.name in ELEMENTWISE

    @property
    def collected(self) -> bool:
        """Whether it is an array of numbers that come from several places."""
        return bool(self.entries is not None and self.size and (self.node is None or self.node.name in _COLLECTS))

    @property
    def kind(self) -> Any:
        """What those have in common that may be worked out together."""
        if self.base is not None:
            return ("of", self.base.kind) if self.base.elementwise else id(self.base)
        form = str(self.dtype), self.shape
        if self.const is not None:
            return "constant", form
        if self.node is None:
            return id(self)
        return self.node.kind, form, *((str(v.dtype), v.shape) for v in self.node.ins if self.elementwise)

    def element(self, i: int) -> "Value":
        if i not in self.elements:
            new = Value((), self.dtype, self.place, self.depth)
            new.base, new.index = self, i
            self.elements[i] = new
        return self.elements[i]

    def numbers(self) -> np.ndarray | None:
        """Those of which it is made, in its shape; None if they are too many."""
        if self.entries is not None or self.size > MANY:
            return self.entries
        found = np.empty(self.size, object)
        found[:] = [self] if self.shape == () else [self.element(i) for i in range(self.size)]
        return found.reshape(self.shape)


class Packing(NamedTuple):
    """Numbers that are handed over as arrays: those which are not, and the members of each array."""

    rest: list[int]
    groups: list[list[int]]

    @classmethod
    def of(cls, kinds: Sequence[Any]) -> "Packing":
        """`kinds`: what those have in common that go together; None for what stays as it is."""
        found: dict[Any, list[int]] = {}
        for i, kind in enumerate(kinds):
            if kind is not None:
                found.setdefault(kind, []).append(i)
        groups = [group for group in found.values() if len(group) >= FEW]
        gone = {i for group in groups for i in group}
        return cls([i for i in range(len(kinds)) if i not in gone], groups)

    @classmethod
    def of_scalars(cls, values: Sequence[Value], *more: Sequence[Any]) -> "Packing":
        """Of those among the values that are single numbers, of one kind and with the same in `more`."""
        single = [v.shape == () and v.const is None for v in values]
        kinds = [(v.kind, str(v.dtype), *also) for v, *also in zip(values, *more)]
        return cls.of([kind if one else None for kind, one in zip(kinds, single)])

    def packed(self, values: Sequence[Value]) -> list[Value]:
        return [values[i] for i in self.rest] + [Value.made_of([values[i] for i in group]) for group in self.groups]

    def apart(self, packed: Sequence[Any], element: Callable[[Any, int], Any] = Value.element) -> list[Any]:
        """The same one by one again."""
        out: dict[int, Any] = dict(zip(self.rest, packed))
        for group, array in zip(self.groups, packed[len(self.rest) :]):
            out.update((i, element(array, n)) for n, i in enumerate(group))
        return [out[i] for i in range(len(out))]


Handlers = Mapping[str, Callable[["Graph", Any, list[Value]], list[Value] | None]]


class Graph:
    """A program, with what it calls written out. `handlers` read operations that have programs of their own."""

    def __init__(self, closed: jex.ClosedJaxpr, arguments: list[Value], handlers: Handlers):
        self.nodes: list[Node] = []
        self.arguments, self.handlers = arguments, handlers
        self.outs = self._read(closed, arguments)

    def _read(self, closed: jex.ClosedJaxpr, arguments: list[Value]) -> list[Value]:
        program = Evaluation(closed, arguments, Value.constant)
        for e, ins in program:
            inner, handler = called(e, with_rules=False), self.handlers.get(e.primitive.name)
            outs = self._read(inner, ins) if inner is not None else handler(self, e, ins) if handler else None
            if outs is None:
                node = self.add(ins, e, [v.aval for v in e.outvars], e.params)
                if has_programs(e):
                    node.bind = _alone(closed.jaxpr, e)
                outs = _moved(node, e.params) or node.outs
            program.put(e, outs)
        return program.results

    def add(self, ins: list[Value], e: Any, avals: Sequence[Any], params: Mapping[str, Any]) -> Node:
        """An operation with these operands and results in place of the equation `e`."""
        node = Node(ins, len(self.nodes), e.primitive, params, bool(e.effects))
        self.nodes.append(node)
        for aval in avals:
            out = Value(aval.shape, aval.dtype, node.place, node.depth)
            out.node = node
            node.outs.append(out)
        return node


def _alone(jaxpr: jex.Jaxpr, e: Any) -> Callable[..., list[Any]]:
    """An operation that carries functions, as a function."""
    taken = {v: i for i, v in enumerate(e.invars) if not isinstance(v, jex.Literal)}
    info = jaxpr.debug_info._replace(arg_names=("",) * len(taken), result_paths=("",) * len(e.outvars))
    fields = dict(constvars=[], invars=list(taken), outvars=e.outvars, eqns=[e], effects=e.effects, debug_info=info)
    call = jex.jaxpr_as_fun(jex.ClosedJaxpr(jaxpr.replace(**fields), ()))
    return lambda *args: call(*(args[i] for i in taken.values()))


def _moved(node: Node, params: Mapping[str, Any]) -> list[Value] | None:
    """The results of an operation that only moves numbers, which are known one by one."""
    if node.name not in _MOVES or sum(v.size for v in node.outs) > MANY:
        return None
    parts = [v.numbers() for v in node.ins]
    if any(part is None for part in parts):
        return None
    moved = MOVING[node.name](params, *parts)
    out: list[Value] = []
    for v, entries in zip(node.outs, moved if isinstance(moved, list) else [moved], strict=True):
        v.entries = np.asarray(entries, object)
        out.append(v.entries[()] if v.shape == () else v)
    return out
