"""What operations that carry functions need of them: their jaxprs with all that they close over as arguments, which
results a batch of arguments reaches, and their derivatives."""

from collections.abc import Callable, Sequence
from typing import Any

import jax
import jax.core
import jax.extend.core as jex
import jax.numpy as jnp
from jax.interpreters import ad

from ._evaluation import Evaluation
from ._operation import REACHED


Flat = Callable[..., list[Any]]  # of arrays, to arrays


def opened(closed: jex.ClosedJaxpr) -> jex.ClosedJaxpr:
    """The jaxpr with its constants as its first arguments."""
    jaxpr = closed.jaxpr
    names = (*[""] * len(jaxpr.constvars), *jaxpr.debug_info.arg_names)
    free = jaxpr.replace(
        constvars=[], invars=[*jaxpr.constvars, *jaxpr.invars], debug_info=jaxpr.debug_info._replace(arg_names=names)
    )
    return jex.ClosedJaxpr(free, ())


def batched_outputs(closed: jex.ClosedJaxpr, batched: Sequence[bool]) -> list[bool]:
    """Which outputs depend on the inputs that are batched."""
    # Forwards, once. (To ask `dce_jaxpr` what each output needs took an eighth of all tracing of derivatives.)
    program = Evaluation(closed, batched, lambda x, aval: False)
    for e, have in program:
        count = len(e.outvars)
        program.put(e, _reached(e, have) if True in have else [False] * count)
    return program.results


def _reached(e: Any, have: list[bool]) -> list[bool]:
    name, count = e.primitive.name, len(e.outvars)
    return REACHED[name](have, **e.params) if name in REACHED else _OF_JAX.get(name, _all)(have, e.params, count)


def _all(have: list[bool], params: Any, outs: int) -> list[bool]:
    return [True] * outs


def _of_call(have: list[bool], params: Any, outs: int) -> list[bool]:
    return batched_outputs(params["jaxpr"], have)


def _of_cond(have: list[bool], params: Any, outs: int) -> list[bool]:
    if have[0]:
        return [True] * outs
    branches = [batched_outputs(branch, have[1:]) for branch in params["branches"]]
    return [any(each) for each in zip(*branches)]


def _of_while(have: list[bool], params: Any, outs: int) -> list[bool]:
    first, second = params["cond_nconsts"], params["cond_nconsts"] + params["body_nconsts"]
    carry = _until_it_stays(params["body_jaxpr"], have[first:second], have[second:], [])[0]
    stops = batched_outputs(params["cond_jaxpr"], [*have[:first], *carry])
    return [True] * outs if any(stops) else carry


def scan_counts(params: Any) -> tuple[int, int]:
    """How many constants a `scan` has, and how many arrays it carries: from JAX 0.11 on a tree says it."""
    if "ft_in" in params:
        consts, carry, _ = params["ft_in"].unpack()
        return len(consts), len(carry)
    return params["num_consts"], params["num_carry"]


def _of_scan(have: list[bool], params: Any, outs: int) -> list[bool]:
    first, carried = scan_counts(params)
    second = first + carried
    carry, rest = _until_it_stays(params["jaxpr"], have[:first], have[first:second], have[second:])
    return [*carry, *rest]


def _until_it_stays(
    body: jex.ClosedJaxpr, consts: list[bool], carry: list[bool], rest: list[bool]
) -> tuple[list[bool], list[bool]]:
    """What of the carry of a loop, and of its other results, is reached in the end."""
    while True:
        out = batched_outputs(body, [*consts, *carry, *rest])
        new = [a or b for a, b in zip(carry, out)]
        if new == carry:
            return carry, out[len(carry) :]
        carry = new


# Of primitives that have jaxprs: from what reaches their arguments, which results are reached.
_OF_JAX: dict[str, Callable[[list[bool], Any, int], list[bool]]] = {
    "jit": _of_call,
    "pjit": _of_call,
    "cond": _of_cond,
    "while": _of_while,
    "scan": _of_scan,
}


def spread(x: Any, size: int) -> Any:
    """The same for all lanes."""
    return jnp.broadcast_to(x, (size, *x.shape))


def mapped(fn: Flat, size: int, batched: Sequence[bool], wide: Sequence[bool]) -> Flat:
    """`fn` of batched arguments. Results that do not depend on these (the primals, under `jacfwd`) stay without the
    axis, where `wide` says so."""

    def many(*xs: Any) -> list[Any]:
        if not any(batched):
            return [spread(x, size) if w else x for x, w in zip(fn(*xs), wide)]
        results = jax.vmap(fn, in_axes=tuple(0 if b else None for b in batched))(*xs)
        return [x if w else x[0] for x, w in zip(results, wide)]

    return many


def moving(tangents: Sequence[Any]) -> list[int]:
    """Which arguments have a tangent. What has none must not get one: loops on it would have to carry it."""
    return [i for i, move in enumerate(tangents) if type(move) is not ad.Zero]


def pushed_forward(fn: Flat, count: int, smooth: Sequence[int], kept: Sequence[int]) -> Flat:
    """Of `count` arguments and the tangents of those in `smooth`: results, and tangents of those in `kept`."""

    def both(*xs: Any) -> list[Any]:
        inputs, moves = xs[:count], xs[count:]

        def inexact(*own: Any) -> list[Any]:
            full = list(inputs)
            for i, x in zip(smooth, own):
                full[i] = x
            return list(fn(*full))

        out, change = jax.jvp(inexact, tuple(inputs[i] for i in smooth), moves)
        return [*out, *[change[i] for i in kept]]

    return both


def with_zeros(out: Sequence[Any], kept: Sequence[int], change: Sequence[Any]) -> list[Any]:
    """Tangents of all results."""
    full: list[Any] = [ad.Zero(jax.core.ShapedArray(x.shape, jax.dtypes.float0)) for x in out]
    for i, c in zip(kept, change, strict=True):
        full[i] = c
    return full
