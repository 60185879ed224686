"""Functions as compiled programs: how large they are, how long they compile and run, how much memory they work in."""

import statistics
import time
from collections.abc import Callable, Sequence
from typing import Any, NamedTuple

import jax
from jax.extend.core import ClosedJaxpr, Jaxpr


class Program(NamedTuple):
    compile_seconds: float  # tracing included
    seconds: float  # median of the repeats
    bytes: int  # working memory, without arguments and results
    out: Any  # what it returned


def measure(cases: Sequence[tuple[Callable[..., Any], tuple[Any, ...]]], repeats: int) -> list[Program]:
    """Functions with their arguments: all are compiled, and then run in turns, so that a machine that is slower for a
    while is so for all of them."""
    compiled, compile_seconds = [], []
    for fn, args in cases:
        start = time.perf_counter()
        compiled.append(jax.jit(fn).lower(*args).compile())
        compile_seconds.append(time.perf_counter() - start)
    out = [jax.block_until_ready(run(*args)) for run, (_, args) in zip(compiled, cases)]
    seconds: list[list[float]] = [[] for _ in cases]
    for _ in range(repeats):
        for row, run, (_, args) in zip(seconds, compiled, cases):
            start = time.perf_counter()
            jax.block_until_ready(run(*args))
            row.append(time.perf_counter() - start)
    memory = [run.memory_analysis().temp_size_in_bytes for run in compiled]
    return [Program(*each) for each in zip(compile_seconds, map(statistics.median, seconds), memory, out)]


def count_equations(fn: Callable[..., Any], *args: Any) -> int:
    """Of the jaxpr, those of all jaxprs within it included."""

    def count(jaxpr: Jaxpr) -> int:
        total = len(jaxpr.eqns)
        for eqn in jaxpr.eqns:
            inner = jax.tree.leaves(eqn.params, is_leaf=lambda x: isinstance(x, Jaxpr | ClosedJaxpr))
            total += sum(count(getattr(x, "jaxpr", x)) for x in inner if isinstance(x, Jaxpr | ClosedJaxpr))
        return total

    return count(jax.make_jaxpr(fn)(*args).jaxpr)
