"""Programs that are compiled for a few calls, and so as fast as may be."""

import contextlib
import functools as ft
import gc
from collections.abc import Callable, Iterator
from typing import Any, cast, TypeVar

import equinox as eqx
import jax
import numpy as np

from ._products import full_products
from ._programs import is_kept, Programs
from ._whole_loops import LOOPS, whole_loops


try:
    from jax._src.core import EvalTrace, trace_ctx
    from jax._src.interpreters.ad import JVPTrace
    from jax._src.interpreters.batching import BatchTrace
except ImportError:  # then nothing is known of the calls around this one
    trace_ctx = None

MANY = 64  # lanes of a batch, from which on the faster program is worth the longer compilation


def outermost() -> bool:
    """Whether what is called now is compiled as a program of its own, and for one lane or few: nothing around it
    collects a larger program. `jax.jvp`, `jax.jacfwd` and `jax.vmap` by themselves do not, they execute at once.
    (`jax.linearize` keeps a program for later, which may become part of another one.)"""
    if trace_ctx is None:
        return False
    trace = trace_ctx.trace
    while not isinstance(trace, EvalTrace):
        few = isinstance(trace, BatchTrace) and trace.axis_data.size <= MANY
        if not (few or isinstance(trace, JVPTrace)):
            return False
        trace = trace.parent_trace
    return True


def eager() -> bool:
    """Whether what is called now is executed at once, and no transformation of JAX is around it."""
    return trace_ctx is None or isinstance(trace_ctx.trace, EvalTrace)


F = TypeVar("F", bound=Callable[..., Any])

# The older emitters of XLA's CPU compiler take a third to a half off its time. In batches their programs are up to 1.4
# times slower: those are compiled by the user's own `jax.jit`, or by `nsjax.sweep`, without them.
KERNELS: dict[str, Any] = {"xla_cpu_use_fusion_emitters": False}
# Nothing of LLVM's optimisation takes off another third. With its loop as one function a solution runs two to five
# times as fast all the same.
QUICK = {**LOOPS, "xla_backend_optimization_level": 0}


# Of sweeps: vectors as long as the processor's own, and without the library that makes a kernel of each sum of
# products. By that they take 0.97 to 0.74 of the time, with tangents 0.8 to 0.7, and are compiled as soon.
WIDE: dict[str, Any] = {"xla_cpu_prefer_vector_width": 512, "xla_cpu_experimental_ynn_fusion_type": ""}


def options(often: bool = False, loops: bool = True) -> dict[str, Any]:
    """Those of a program that is called a few times or `often`, with its `loops` as one function each or not."""
    return _known_of((LOOPS if often else QUICK) if loops else KERNELS)


def swept() -> dict[str, Any]:
    """Those of a sweep."""
    return _known_of(WIDE)


def _known_of(wanted: dict[str, Any]) -> dict[str, Any]:
    """Those that this version of XLA knows; on other devices than a CPU none of them are of use."""
    return dict(_known(tuple(wanted.items()))) if jax.default_backend() == "cpu" else {}


@ft.cache
def _known(wanted: tuple[tuple[str, Any], ...]) -> tuple[tuple[str, Any], ...]:
    trivial = jax.jit(lambda x: x).lower(0.0)
    with contextlib.suppress(Exception):  # nearly always all of them
        trivial.compile(dict(wanted))
        return wanted
    known = []
    for name, value in wanted:
        with contextlib.suppress(Exception):
            trivial.compile({name: value})
            known.append((name, value))
    return tuple(known)


@contextlib.contextmanager
def without_collection() -> Iterator[None]:
    """Tracing makes millions of small objects that live on: looking for garbage among them takes a third of its
    time."""
    was = gc.isenabled()
    gc.disable()
    try:
        yield
    finally:
        if was:
            gc.enable()


def on_host(tree: Any) -> Any:
    """With NumPy's arrays. (`jax.device_get` announces each copy first, which takes eight times as long.)"""
    return jax.tree.map(lambda x: np.asarray(x) if isinstance(x, jax.Array) else x, tree)


def _ways(fn: Callable[..., Any], options: Callable[[], dict[str, Any]]) -> tuple[Any, Callable[[], Any], Programs]:
    """`fn` as part of another program, as one by itself (to which alone options can be given), and as one kept."""
    jit: Any = eqx.filter_jit

    @ft.cache  # not on import: which options there are is found out by compiling
    def alone() -> Any:
        return jit(fn, compiler_options=options())

    return jit(fn), alone, Programs(fn, options)


def long_running(fn: F) -> F:
    """`equinox.filter_jit` for what is called directly and runs for long: with all of XLA's optimisation, and where it
    is not part of another program the options of sweeps."""
    within, alone, kept = _ways(fn, swept)

    @full_products
    @ft.wraps(fn)
    def call(*args: Any, **kwargs: Any) -> Any:
        run = within if not eager() else kept if is_kept() else alone()
        return run(*args, **kwargs)

    return cast(F, call)


def interactive(fn: F, host: bool = False) -> F:
    """`equinox.filter_jit` for what a user calls and waits for: compiled quickly, where it is not part of another
    program. With `host` it returns NumPy's arrays, as every operation that Python applies to one of JAX's is compiled
    as a program of its own."""
    within, alone, kept = _ways(fn, options)

    @full_products
    @ft.wraps(fn)
    def call(*args: Any, **kwargs: Any) -> Any:
        mine = outermost()
        run = kept if eager() and is_kept() else alone() if mine else within
        with without_collection(), whole_loops(mine):
            found = run(*args, **kwargs)
        return on_host(found) if host else found

    return cast(F, call)
