"""A function as a compiled program: how large it is, how long it compiles and runs, how much memory it works in."""

import time
from collections.abc import Callable
from typing import Any, NamedTuple

import jax
from jax.extend.core import ClosedJaxpr, Jaxpr


class Program(NamedTuple):
    compile_seconds: float  # tracing included
    seconds: float  # least of the repeats
    bytes: int  # working memory, without arguments and results
    out: Any  # what it returned


def measure(fn: Callable[..., Any], *args: Any, repeats: int) -> Program:
    start = time.perf_counter()
    compiled = jax.jit(fn).lower(*args).compile()
    compile_seconds = time.perf_counter() - start
    out, seconds = jax.block_until_ready(compiled(*args)), []
    for _ in range(repeats):
        start = time.perf_counter()
        jax.block_until_ready(compiled(*args))
        seconds.append(time.perf_counter() - start)
    return Program(compile_seconds, min(seconds), compiled.memory_analysis().temp_size_in_bytes, out)


def count_equations(fn: Callable[..., Any], *args: Any) -> int:
    """Of the jaxpr, those of all jaxprs within it included."""

    def count(jaxpr: Jaxpr) -> int:
        total = len(jaxpr.eqns)
        for eqn in jaxpr.eqns:
            inner = jax.tree.leaves(eqn.params, is_leaf=lambda x: isinstance(x, Jaxpr | ClosedJaxpr))
            total += sum(count(getattr(x, "jaxpr", x)) for x in inner if isinstance(x, Jaxpr | ClosedJaxpr))
        return total

    return count(jax.make_jaxpr(fn)(*args).jaxpr)
