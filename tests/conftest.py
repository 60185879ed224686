"""How the tests run: double precision, strict promotion of dtypes, compiled programs kept between runs."""

import ctypes
import gc
import os
import pathlib
import sys
import zlib

import jax
import jaxlib
import matplotlib
import pytest


# The tests compile much and compute little: XLA's older code generator compiles twice as fast, for slower programs, and
# leaving out LLVM's optimisation takes another fifth off the time of all tests. To split a program's code among threads
# costs a tenth of its compile time, and the other processors have tests of their own. (Results must not depend on
# rounding: `XLA_FLAGS=--xla_backend_optimization_level=3`, with fused multiplication and addition, is a second setting.)
flags = []
if jaxlib.__version__.startswith(("0.10.", "0.12.")):  # an unknown flag ends the process
    flags += ["--xla_backend_optimization_level=0", "--xla_cpu_parallel_codegen_split_count=1"]
if jaxlib.__version__.startswith("0.10."):
    flags.append("--xla_cpu_use_fusion_emitters=false")
os.environ["XLA_FLAGS"] = " ".join([*flags, os.environ.get("XLA_FLAGS", "")])
# JAX writes the entries of its cache in place, and a second process that reads one meanwhile reports that it is cut off.
# Each worker of pytest therefore has a folder of its own (pitfall 59).
programs = os.environ.get("JAX_COMPILATION_CACHE_DIR") or pathlib.Path(__file__).parents[1] / ".jax_cache"
jax.config.update(
    "jax_compilation_cache_dir", str(pathlib.Path(programs, os.environ.get("PYTEST_XDIST_WORKER", "main")))
)
jax.config.update("jax_persistent_cache_min_compile_time_secs", 0.0)  # half of 5,500 small programs are read then
jax.config.update("jax_enable_x64", True)
jax.config.update("jax_numpy_dtype_promotion", "strict")
matplotlib.use("Agg")
gc.set_threshold(100_000, 20, 20)  # tracing makes many objects, and looking through them takes a fifth of its time


MUCH = 1.2e9  # bytes of a process from which on it forgets between two files
MOST, MORE = 1.6e9, 6e8  # and between two tests of a file too, if it has grown
kept = [0]  # bytes that were left then, of which the system gets nothing back


def forget():
    """Drops compiled programs: all of them together take some ten gigabytes."""
    jax.clear_caches()
    gc.collect()
    if sys.platform == "linux":  # which keeps what was freed, until it is told not to
        ctypes.CDLL("libc.so.6").malloc_trim(0)
    kept[0] = size()


def size():
    """Of this process, in bytes, where that is cheap to know."""
    if sys.platform != "linux":
        return 0
    return int(pathlib.Path("/proc/self/statm").read_text().split()[1]) * os.sysconf("SC_PAGE_SIZE")


def pytest_addoption(parser):
    parser.addoption("--part", metavar="K/N", help="run the K-th of N parts of the selected tests; -m slow --part 3/24")


def pytest_collection_modifyitems(config, items):
    """Keeps one part of the tests. A test is always in the same part, whatever else there is."""
    part = config.getoption("part")
    if part is None:
        return
    try:
        k, n = map(int, part.split("/"))
    except ValueError:
        k, n = 0, 0
    if not 1 <= k <= n:
        raise pytest.UsageError(f"Option --part must be K/N with 1 <= K <= N, such as 3/8, but is {part!r}.")
    parts = {item: zlib.crc32(item.nodeid.encode()) % n + 1 for item in items}
    config.hook.pytest_deselected(items=[item for item in items if parts[item] != k])
    items[:] = [item for item in items if parts[item] == k]


class Compilations:
    """Listens to what is compiled while a file of tests is imported: a file that fails then would hide all others."""

    def __init__(self):
        self.file, self.files = None, set()

    def heard(self, event, seconds, **_):
        if event == "/jax/core/compile/backend_compile_duration":
            self.files.add(self.file)


collecting = Compilations()
jax.monitoring.register_event_duration_secs_listener(collecting.heard)


def pytest_make_collect_report(collector):
    if isinstance(collector, pytest.Module):
        collecting.file = collector.nodeid
        jax.clear_caches()  # so that one file's program is not there for the next


def pytest_collection_finish():
    jax.monitoring.unregister_event_duration_listener(collecting.heard)
    if collecting.files:
        raise pytest.UsageError(
            f"These files compile while tests are collected: {', '.join(sorted(collecting.files))}."
        )
    # What is imported by then stays, and need not be looked through again.
    gc.collect()
    gc.freeze()


@pytest.fixture(autouse=True, scope="module")
def forgotten():
    """Programs of one file are of little use to the next; but to drop them takes most of a second."""
    yield
    if not 0 < size() < MUCH:
        forget()


@pytest.fixture(autouse=True)
def bounded():
    """Some files have more programs than fit."""
    yield
    if size() > max(MOST, kept[0] + MORE):
        forget()
