"""Loops that are compiled as one function, where that is asked for.

XLA's CPU compiler makes of each operation on a number or a small array a kernel of its own, some hundred for a turn of
a solution's loop, and starting them is most of what a single solution costs. Of a loop that touches few bytes it makes
one function: a solution takes a third of the time, and is compiled in less. In the lanes of a sweep a kernel is worth
its start. How few the bytes have to be is an option of XLA's that `jax.jit` cannot set for one program (a map among its
options), so that it is added to what JAX hands to the compiler.
"""

import contextlib
import os
import threading
from collections.abc import Iterator
from typing import Any


try:
    from jax._src import compiler
    from jaxlib.xla_client import CompileOptions
except ImportError:  # then loops are compiled as elsewhere
    compiler: Any = None

NAME, BYTES = "xla_cpu_small_while_loop_byte_threshold", "1000000000"


class _Here(threading.local):
    """Whether this thread asks for them."""

    wanted = False


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


def _field(number: int, content: bytes) -> bytes:
    """One of a message, as protocol buffers are written."""
    assert len(content) < 128
    return _number(number << 3 | 2) + _number(len(content)) + content


def _number(n: int) -> bytes:
    return bytes([n]) if n < 128 else bytes([n & 127 | 128]) + _number(n >> 7)


# executable_build_options { debug_options { xla_backend_extra_options { key: ... value: ... } } }: messages that follow
# one another are merged.
_ADDED = _field(3, _field(3, _field(500, _field(1, NAME.encode()) + _field(2, BYTES.encode()))))


def _install() -> None:
    given = compiler.get_compile_options

    def get_compile_options(*args: Any, **kwargs: Any) -> Any:
        options = given(*args, **kwargs)
        if _here.wanted:
            with contextlib.suppress(Exception):  # those of another version
                return CompileOptions.ParseFromString(options.SerializeAsString() + _ADDED)
        return options

    compiler.get_compile_options = get_compile_options


if hasattr(compiler, "get_compile_options"):
    _install()
