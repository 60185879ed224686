"""Programs that are compiled for a few calls, and so as fast as may be."""

import contextlib
import functools as ft
import gc
from collections.abc import Callable, Iterator
from typing import Any, cast, TypeVar

import equinox as eqx
import jax
import jax.core
import jax.extend.core as jex
import numpy as np
from jax.interpreters import ad

from ._products import full_products
from ._programs import is_kept, kept, uncommitted
from ._undocumented import AXIS, PARENT


MANY = 64  # lanes of a batch, from which on the faster program is worth the longer compilation


def _current_trace() -> Any:
    """The innermost transformation of JAX around what is called now."""
    with jex.take_current_trace() as trace:
        return trace


@ft.cache
def _evaluation() -> type:
    """The type of that trace where there is no transformation."""
    with jax.core.eval_context():
        return type(_current_trace())


def eager() -> bool:
    """Whether what is called now is executed at once, and no transformation of JAX is around it."""
    return type(_current_trace()) is _evaluation()


def outermost() -> bool:
    """Whether what is called now is compiled as a program of its own, and for one lane or few: nothing around it
    collects a larger program. `jax.jvp`, `jax.jacfwd` and `jax.vmap` by themselves do not, they execute at once.
    (`jax.linearize` keeps a program for later, which may become part of another one.)"""
    trace = _current_trace()
    while type(trace) is not _evaluation():
        axis = getattr(trace, AXIS, None)
        few = axis is not None and axis.size <= MANY
        if not (few or isinstance(trace, ad.JVPTrace)):
            return False
        trace = getattr(trace, PARENT, None)
    return True


F = TypeVar("F", bound=Callable[..., Any])

# The older emitters of XLA's CPU compiler take a third to a half off its time. In batches their programs are up to 1.4
# times slower: those are compiled by the user's own `jax.jit`, or by `nsjax.sweep`, without them.
KERNELS: dict[str, Any] = {"xla_cpu_use_fusion_emitters": False}
# Nothing of LLVM's optimisation takes off another third.
QUICK = {**KERNELS, "xla_cpu_experimental_ynn_fusion_type": "", "xla_backend_optimization_level": 0}


# Of sweeps: vectors as long as the processor's own, and without the library that makes a kernel of each sum of
# products. By that they take 0.97 to 0.74 of the time, with tangents 0.8 to 0.7, and are compiled as soon.
WIDE: dict[str, Any] = {"xla_cpu_prefer_vector_width": 512, "xla_cpu_experimental_ynn_fusion_type": ""}


def options(often: bool = False) -> dict[str, Any]:
    """Those of a program that is called a few times or `often`."""
    return _known_of(KERNELS if often else QUICK)


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


def _ways(fn: Callable[..., Any], options: Callable[[], dict[str, Any]]) -> tuple[Any, Callable[[bool], Any]]:
    """`fn` compiled as part of another program, and as one by itself (to which alone options can be given), which may
    be one that is kept."""
    jit: Any = eqx.filter_jit

    @ft.cache  # not on import: which options there are is found out by compiling
    def alone(is_kept: bool) -> Any:
        if not is_kept:
            return jit(fn, compiler_options=options())
        run = jit(kept(fn), compiler_options=options())
        return lambda *args, **kwargs: run(*uncommitted(args), **uncommitted(kwargs))

    return jit(fn), alone


def long_running(fn: F) -> F:
    """`equinox.filter_jit` for what is called directly and runs for long: with all of XLA's optimisation, and where it
    is not part of another program the options of sweeps."""
    within, alone = _ways(fn, swept)

    @full_products
    @ft.wraps(fn)
    def call(*args: Any, **kwargs: Any) -> Any:
        run = alone(is_kept()) if eager() else within
        return run(*args, **kwargs)

    return cast(F, call)


def interactive(fn: F, host: bool = False) -> F:
    """`equinox.filter_jit` for what a user calls and waits for: compiled quickly, where it is not part of another
    program. With `host` it returns NumPy's arrays, as every operation that Python applies to one of JAX's is compiled
    as a program of its own."""
    within, alone = _ways(fn, options)

    @full_products
    @ft.wraps(fn)
    def call(*args: Any, **kwargs: Any) -> Any:
        run = alone(eager() and is_kept()) if outermost() else within
        with without_collection():
            found = run(*args, **kwargs)
        return on_host(found) if host else found

    return cast(F, call)
