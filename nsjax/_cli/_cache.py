"""What a command does to be quick: it keeps programs from one call to the next."""

import gc
import os

import jax

from .._numerics._programs import keep_programs, ROOM


BYTES = 1000000000  # that the variables of a loop may have, to be compiled as one function


def keep_compiled(keep: bool = True) -> None:
    """Programs are written to the user's cache, or where JAX was told to keep them: those of nsjax traced, and all of
    them compiled, small ones too, of which a command has several dozen. If they are not to be kept, none is read
    either."""
    if not keep:
        jax.config.update("jax_enable_compilation_cache", False)
        return
    given = jax.config.values.get("jax_compilation_cache_dir")
    try:
        folder = keep_programs(None if given and "://" in given else given)  # JAX may keep its own in a bucket
    except OSError:  # a home that cannot be written to: every command compiles for itself
        return
    if not given:
        jax.config.update("jax_compilation_cache_dir", str(folder))
        # JAX then locks the folder, so that no other command reads what this one is writing.
        jax.config.update("jax_compilation_cache_max_size", ROOM)
    if "JAX_PERSISTENT_CACHE_MIN_COMPILE_TIME_SECS" not in os.environ:
        jax.config.update("jax_persistent_cache_min_compile_time_secs", 0.0)


def compile_loops_whole() -> None:
    """XLA makes one function of each loop, as of small ones otherwise: a solution takes a third of the time. To be
    called before anything is computed, as XLA reads its flags once; what is set there already stands. (An unknown flag
    would end the process.)"""
    flags = os.environ.get("XLA_FLAGS", "")
    if "xla_backend_extra_options" not in flags and jax.__version__.startswith(("0.10.", "0.11.", "0.12.")):
        os.environ["XLA_FLAGS"] = f"{flags} --xla_backend_extra_options=xla_cpu_small_while_loop_byte_threshold={BYTES}"


def collect_rarely() -> None:
    """Tracing makes many objects that stay, and looking through them for garbage took a tenth of a command's time."""
    gc.freeze()
    gc.set_threshold(100_000, 20, 20)
