"""Loops that are compiled as one function, where that is asked for.

XLA's CPU compiler makes of each operation on a number or a small array a kernel of its own, some hundred for a turn of
a solution's loop, and starting them is most of what a single solution costs. Of a loop that touches few bytes it makes
one function: a solution takes a third of the time, and is compiled in less. In the lanes of a sweep a kernel is worth
its start, but with the older emitters the loop of a Runge-Kutta method is faster as one function there too; that of a
series takes twice as long to compile. So it is what is traced that asks. How few the bytes have to be is an option of
XLA's that `jax.jit` cannot set for one program (a map among its options), so that it is added to what JAX hands to the
compiler.
"""

import contextlib
import functools as ft
import os
import threading
from collections.abc import Iterator
from typing import Any

import jax


try:
    from jax._src import compiler
    from jaxlib.xla_client import CompileOptions
except ImportError:  # then loops are compiled as elsewhere
    compiler: Any = None

NAME, BYTES = "xla_cpu_small_while_loop_byte_threshold", "1000000000"

# What goes with loops as one function: without the newer emitters, without the library that would keep products out of
# them, and with as much of LLVM's optimisation as changes anything.
LOOPS: dict[str, Any] = {
    "xla_cpu_use_fusion_emitters": False,
    "xla_cpu_experimental_ynn_fusion_type": "",
    "xla_backend_optimization_level": 1,
}


class Request:
    """Whether what was traced has asked for them."""

    made = False


class _Here(threading.local):
    """Whether this thread wants them, and where what is traced can ask for them."""

    wanted = False
    request: Request | None = None


_here = _Here()


@contextlib.contextmanager
def whole_loops(wanted: bool = True) -> Iterator[None]:
    """What is compiled within has each loop as one function, where XLA finds that it can: not if it sorts, calls LAPACK
    or Python. What `XLA_FLAGS` say of it stands."""
    before, _here.wanted = _here.wanted, wanted and NAME not in os.environ.get("XLA_FLAGS", "")
    try:
        yield
    finally:
        _here.wanted = before


@contextlib.contextmanager
def on_request(request: Request | None = None) -> Iterator[Request]:
    """What is traced within can ask for them, and is compiled so within; or elsewhere, within `on_request(request)`."""
    before, _here.request = _here.request, request or Request()
    try:
        yield _here.request
    finally:
        _here.request = before


def ask_for_whole_loops() -> None:
    """By what is being traced, for when it is part of a sweep."""
    if _here.request is not None:
        _here.request.made = True


def _field(number: int, content: bytes) -> bytes:
    """One of a message, as protocol buffers are written."""
    assert len(content) < 128
    return _number(number << 3 | 2) + _number(len(content)) + content


def _number(n: int) -> bytes:
    return bytes([n]) if n < 128 else bytes([n & 127 | 128]) + _number(n >> 7)


# executable_build_options { debug_options { xla_backend_extra_options { key: ... value: ... } } }: messages that follow
# one another are merged.
_ADDED = _field(3, _field(3, _field(500, _field(1, NAME.encode()) + _field(2, BYTES.encode()))))


@ft.cache
def _all_known() -> bool:
    """Whether this is a CPU, and XLA's compiler knows these options."""
    if jax.default_backend() != "cpu":
        return False
    with on_request(), contextlib.suppress(Exception):
        jax.jit(lambda x: x).lower(0.0).compile(dict(LOOPS))
        return True
    return False


def _install() -> None:
    given = compiler.get_compile_options

    def get_compile_options(*args: Any, **kwargs: Any) -> Any:
        options = given(*args, **kwargs)
        flags = os.environ.get("XLA_FLAGS", "")
        made = _here.request is not None and _here.request.made
        asked = made and NAME not in flags and _all_known()
        if _here.wanted or asked:
            with contextlib.suppress(Exception):  # those of another version
                options = CompileOptions.ParseFromString(options.SerializeAsString() + _ADDED)
                if asked:
                    new = [(name, value) for name, value in LOOPS.items() if name not in flags]
                    options.env_option_overrides = [*options.env_option_overrides, *new]
        return options

    compiler.get_compile_options = get_compile_options


if hasattr(compiler, "get_compile_options"):
    _install()
