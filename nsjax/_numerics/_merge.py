"""What a program does to many numbers one by one, done once to an array of them.

A model of fifty blocks has fifty switches, each with its guards, its value, its law at an event. They are written for
one switch, in a loop of Python, and make a program of as many small operations, each of which costs XLA a kernel and
every run the start of that kernel. Here such a program is read as a graph, and operations of one kind at one depth,
whose results meet in an array, become one operation on arrays. What loops and conditionals are handed number by number
is handed over as arrays too. So a program grows little with the number of switches; the numbers stay the same, but for
the order in which long sums are taken.
"""

import heapq
from collections.abc import Callable
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.extend.core as jex
import jax.lax as lax
import jax.numpy as jnp
import numpy as np

from ._graph import Graph, Handlers, Node, Packing, Value
from ._inner import scan_counts
from ._lane_cond import compact_cond
from ._places import at_places
from ._rolled import bound


_REDUCED: dict[str, Callable[..., Any]] = {
    "add": lambda x: jnp.sum(x, dtype=x.dtype),
    "and": jnp.all,
    "max": jnp.max,
    "min": jnp.min,
    "or": jnp.any,
}


def merged(fn: Callable[..., Any]) -> Callable[..., Any]:
    """The same function, with what it does to numbers of one kind done to arrays of them. What is no array, among its
    arguments and results, stays as it is."""

    def call(*args: Any) -> Any:
        dynamic, static = eqx.partition(args, eqx.is_array)
        flat, tree = jax.tree.flatten(dynamic)
        rest: list[Any] = []

        def of_arrays(*xs: Any) -> Any:
            arrays, other = eqx.partition(fn(*eqx.combine(jax.tree.unflatten(tree, xs), static)), eqx.is_array)
            rest.append(other)
            return arrays

        closed, form = jax.make_jaxpr(of_arrays, return_shape=True)(*flat)
        graph = Graph(closed, [Value(a.shape, a.dtype) for a in closed.in_avals], _HANDLERS)
        own = Packing.of_scalars(graph.outs)
        out = own.apart(_worked_out(graph, own.packed(graph.outs), flat), lambda x, n: x[n])
        return eqx.combine(jax.tree.unflatten(jax.tree.structure(form), out), rest[0])

    return call


# Loops and conditionals, which are handed arrays.


def _like(values: list[Value]) -> list[Value]:
    """Arguments of the same shapes."""
    return [Value(v.shape, v.dtype) for v in values]


def _function(graph: Graph, results: list[Value]) -> Callable[..., list[Any]]:
    return lambda *xs: _worked_out(graph, results, list(xs))


def _inner(closed: jex.ClosedJaxpr, seen: list[Value], arguments: list[Value]) -> Graph:
    """The program of a loop whose arguments are found in `seen`."""
    graph = Graph(closed, arguments, _HANDLERS)
    graph.arguments = seen
    return graph


def _of_while(graph: Graph, e: Any, ins: list[Value]) -> list[Value] | None:
    p = e.params
    if p["cond_jaxpr"].out_avals[0].shape:  # a loop of many, each of which may have ended
        return None
    first, second = p["cond_nconsts"], p["cond_nconsts"] + p["body_nconsts"]
    test, consts, carry = ins[:first], ins[first:second], ins[second:]
    # What goes together is told by what becomes of it in a turn.
    plain = _like([*consts, *carry])
    after = Graph(p["body_jaxpr"], plain, _HANDLERS).outs
    own = Packing.of_scalars(after, [v not in plain or None for v in after])
    known = Packing.of_scalars(consts)
    asked, seen, had = _like(test), _like(known.packed(consts)), _like(own.packed(carry))
    body = _inner(p["body_jaxpr"], [*seen, *had], [*known.apart(seen), *own.apart(had)])
    cond = _inner(p["cond_jaxpr"], [*asked, *had], [*asked, *own.apart(had)])
    step, goes_on = _function(body, own.packed(body.outs)), _function(cond, cond.outs)

    def bind(*args: Any) -> list[Any]:
        asked_, seen_, had_ = args[:first], args[first : first + len(seen)], args[first + len(seen) :]
        return lax.while_loop(lambda c: goes_on(*asked_, *c)[0], lambda c: step(*seen_, *c), list(had_))

    node = graph.add([*test, *known.packed(consts), *own.packed(carry)], e, had, {})
    node.bind = bind
    return own.apart(node.outs)


def _of_scan(graph: Graph, e: Any, ins: list[Value]) -> list[Value]:
    p, (n, carried) = e.params, scan_counts(e.params)
    known = Packing.of_scalars(ins[:n])
    seen, others = _like(known.packed(ins[:n])), [Value(a.shape, a.dtype) for a in p["jaxpr"].in_avals[n:]]
    body = _inner(p["jaxpr"], [*seen, *others], [*known.apart(seen), *others])
    step, options = _function(body, body.outs), {name: p[name] for name in ("length", "reverse", "unroll")}

    def bind(*args: Any) -> list[Any]:
        seen_, first, rows = args[: len(seen)], args[len(seen) :][:carried], args[len(seen) :][carried:]

        def one(c: list[Any], x: list[Any]) -> tuple[list[Any], list[Any]]:
            out = step(*seen_, *c, *x)
            return out[:carried], out[carried:]

        last, found = lax.scan(one, list(first), list(rows), **options)
        return [*last, *found]

    node = graph.add([*known.packed(ins[:n]), *ins[n:]], e, [v.aval for v in e.outvars], {})
    node.bind = bind
    return node.outs


def _of_compact_cond(graph: Graph, e: Any, ins: list[Value]) -> list[Value]:
    jaxpr = e.params["jaxpr"]
    pred, given, default = ins[0], ins[1 : 1 + len(jaxpr.in_avals)], ins[1 + len(jaxpr.in_avals) :]
    known = Packing.of_scalars(given)
    seen = _like(known.packed(given))
    branch = _inner(jaxpr, seen, known.apart(seen))
    own = Packing.of_scalars(branch.outs)
    results = own.packed(branch.outs)
    work = _function(branch, results)

    def bind(pred: Any, *args: Any) -> list[Any]:
        return compact_cond(pred, work, list(args[: len(seen)]), list(args[len(seen) :]), e.params["group"])

    node = graph.add([pred, *known.packed(given), *own.packed(default)], e, results, {})
    node.bind = bind
    return own.apart(node.outs)


def _of_rolled(graph: Graph, e: Any, ins: list[Value]) -> list[Value]:
    p = e.params
    known = Packing.of_scalars(ins, p["own"])
    seen = _like(known.packed(ins))
    own = tuple([p["own"][i] for i in known.rest] + [p["own"][group[0]] for group in known.groups])
    body = _inner(p["jaxpr"], seen, known.apart(seen))
    loop = _function(body, body.outs)
    written_out = merged(lambda *xs: p["written_out"](*known.apart(xs, lambda x, n: x[n])))

    def bind(*args: Any) -> list[Any]:
        return bound(list(args), loop, written_out, own)

    node = graph.add(known.packed(ins), e, [v.aval for v in e.outvars], {})
    node.bind = bind
    return node.outs


def _of_select(graph: Graph, e: Any, ins: list[Value]) -> list[Value]:
    """Equinox's choice between the carries of a loop, by one predicate for many of them."""
    predicate = ins[0]
    while predicate.node is not None and predicate.node.name == "copy":
        predicate = predicate.node.ins[0]
    ins = [predicate, *ins[1:]]
    node = graph.add(ins, e, [v.aval for v in e.outvars], e.params)
    node.kind, bind = (node.kind, id(predicate)), node.bind
    node.bind = lambda pred, *xs: bind(pred[0] if pred.ndim else pred, *xs)  # one and the same in all rows
    return node.outs


_HANDLERS: Handlers = {
    "compact_cond": _of_compact_cond,
    "rolled": _of_rolled,
    "scan": _of_scan,
    "select_if_vmap": _of_select,
    "while": _of_while,
}


# What has to be worked out, and how: the results of an operation, a value, or several as the rows of an array.

Wanted = Node | Value | tuple[Value, ...]


class _Step(NamedTuple):
    needs: list[Any]
    work: Callable[..., Any]


def _order(wanted: Wanted) -> tuple[int, int, int]:
    """What needs others comes after them: by place; at one place results, their elements, rows of arrays, of numbers,
    of arrays that are made of numbers, and such arrays; of rows the longer ones after the shorter ones."""
    if isinstance(wanted, tuple):
        single, made = wanted[0].shape == (), any(v.entries is not None for v in wanted)
        return max(v.place for v in wanted), 4 if made else 3 if single else 2, len(wanted)
    if isinstance(wanted, Node) or (wanted.base is None and wanted.entries is None):
        return wanted.place, 0, 0
    return wanted.place, 1 if wanted.base is not None else 5, 0


def _planned(wanted: Wanted) -> _Step:
    if isinstance(wanted, tuple):
        return _side_by_side(wanted)
    if isinstance(wanted, Node):
        return _Step(list(wanted.ins), wanted.bind)
    if wanted.base is not None:
        return _Step([wanted.base], lambda x: jnp.ravel(x)[wanted.index])
    if wanted.collected and wanted.entries is not None:
        return _Step([tuple(wanted.entries.flat)], lambda x: jnp.reshape(x, wanted.shape))
    node = wanted.node
    assert node is not None
    if node.name in _REDUCED and wanted.shape == ():
        leaves = _chain(wanted, node.name)
        found = Packing.of([leaf.kind for leaf in leaves])
        if found.groups:
            return _reduced(node, leaves, found)
    return _Step(list(node.ins), lambda *xs: node.bind(*xs)[0])


def _chain(v: Value, name: str) -> list[Value]:
    """What a chain of one associative operation is applied to; links that others need too are its ends."""
    out, todo = [], [v]
    while todo:
        x = todo.pop()
        if x.node is not None and x.node.name == name and x.shape == () and (x is v or x.uses == 1):
            todo += reversed(x.node.ins)
        else:
            out.append(x)
    return out


def _reduced(node: Node, leaves: list[Value], found: Packing) -> _Step:
    few, reduce = len(found.rest), _REDUCED[node.name]

    def work(*xs: Any) -> Any:
        out, *parts = [*xs[:few], *map(reduce, xs[few:])]
        for part in parts:
            out = node.bind(out, part)[0]
        return out

    return _Step([leaves[i] for i in found.rest] + [tuple(leaves[i] for i in g) for g in found.groups], work)


def _side_by_side(members: tuple[Value, ...]) -> _Step:
    """How values of one shape become the rows of an array: by one operation on arrays, if they can."""
    first, count = members[0], len(members)
    shape = first.shape
    if any(v.entries is not None for v in members):
        flat = [x for v in members for x in np.ravel(v.numbers())]  # pyright: ignore[reportArgumentType, reportCallIssue]
        return _Step([tuple(flat)], lambda x: jnp.reshape(x, (count, *shape)))
    if all(v is first for v in members):
        return _Step([first], lambda x: jnp.broadcast_to(x, (count, *shape)))
    different = {id(v): v for v in members}
    if len(different) < count:
        places = {key: i for i, key in enumerate(different)}
        return _Step([tuple(different.values())], at_places(np.array([places[id(v)] for v in members])))
    if all(isinstance(v.const, bool | int | float | np.generic | np.ndarray) for v in members):
        row = np.array([v.const for v in members]).astype(first.dtype)
        return _Step([], lambda: jnp.asarray(row))
    kinds = [v.kind for v in members]
    if all(kind == kinds[0] for kind in kinds):
        bases = {id(v.base): v.base for v in members if v.base is not None}
        if first.base is not None:
            places, size = {key: i for i, key in enumerate(bases)}, first.base.size
            put = at_places(np.array([places[id(v.base)] * size + v.index for v in members]))
            return _Step([first.base if len(bases) == 1 else tuple(bases.values())], lambda x: put(jnp.ravel(x)))
        if first.elementwise:
            operands = zip(*(v.node.ins for v in members if v.node is not None))
            return _Step([tuple(each) for each in operands], _on_rows(first))
    found = Packing.of([kind if _merges(v) else None for v, kind in zip(members, kinds)])
    if not found.groups or (len(found.groups) == 1 and not found.rest):
        return _Step(list(members), lambda *xs: jnp.stack(xs))
    needs = [tuple(members[i] for i in group) for group in found.groups] + [members[i] for i in found.rest]
    order = np.argsort([*(i for group in found.groups for i in group), *found.rest])
    arrays, put = len(found.groups), at_places(order)

    def joined(*xs: Any) -> Any:
        parts = [*xs[:arrays], *([jnp.stack(xs[arrays:])] if len(xs) > arrays else [])]
        return put(jnp.concatenate(parts))

    return _Step(needs, joined)


def _merges(v: Value) -> bool:
    return v.base is not None or v.const is not None or v.elementwise


def _on_rows(v: Value) -> Callable[..., Any]:
    """The operation that makes `v`, on as many rows as its operands have."""
    shape, node = v.shape, v.node
    assert node is not None

    def work(*xs: Any) -> Any:
        full = (len(xs[0]), *shape)

        def spread(x: Any) -> Any:  # a number for a row
            return jnp.broadcast_to(x.reshape(len(x), *[1] * (len(full) - x.ndim), *x.shape[1:]), full)

        return node.bind(*map(spread, xs))[0]

    return work


def _worked_out(graph: Graph, results: list[Value], xs: list[Any]) -> list[Any]:
    """The results of a program for these arguments."""
    done: dict[Any, Any] = {id(v): x for v, x in zip(graph.arguments, xs, strict=True)}
    wanted: dict[Any, Wanted] = {}
    heap: list[tuple[int, ...]] = []
    keys: list[Any] = []

    def name(what: Wanted) -> Any:
        return tuple(map(id, what)) if isinstance(what, tuple) else id(what)

    def want(what: Wanted) -> None:
        if isinstance(what, Value) and what.node is not None and what.entries is None:
            if what.node.effects or len(what.node.outs) > 1:
                what = what.node  # which is done once
        key = name(what)
        if key in wanted or key in done:
            return
        if isinstance(what, Value) and what.const is not None:
            number = isinstance(what.const, bool | int | float | np.generic)
            done[key] = np.asarray(what.const, what.dtype) if number else what.const
            return
        wanted[key] = what
        heapq.heappush(heap, (*(-x for x in _order(what)), len(keys)))
        keys.append(key)

    for what in [*results, *(node for node in graph.nodes if node.effects)]:
        want(what)
    steps = []
    while heap:
        key = keys[heapq.heappop(heap)[-1]]
        step = _planned(wanted[key])
        steps.append((key, step))
        for need in step.needs:
            want(need)
    for key, step in reversed(steps):
        what, out = wanted[key], step.work(*(done[name(need)] for need in step.needs))
        if isinstance(what, Node):
            done.update((id(v), x) for v, x in zip(what.outs, out, strict=True))
        else:
            done[key] = out
    return [done[id(v)] for v in results]
