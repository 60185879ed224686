"""What users of other packages write for the workloads S1, S2 and S3 (`workloads.py`), timed and checked.

Every peer integrates numerically in each mode, finds events by its own means and changes state and mode by the same
rules. One module a package says what its user must know: `peers_scipy`, `peers_diffrax`, `peers_heyoka`.

    python benchmarks/peers.py --workload S1 S2 --tol 1e-8 1e-10 --peer diffrax heyoka heyoka-batch
"""

import argparse
import ast
import inspect
import statistics
import textwrap
import time
from collections.abc import Callable, Sequence
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
import peers_diffrax
import peers_scipy
from workloads import WORKLOADS


PEERS = ("RK45", "DOP853", "diffrax", "heyoka", "heyoka-batch")  # the first two are scipy's
WIDTH = 8  # lanes in a batch of heyoka's: numbers in one AVX-512 register; two registers without it


class Measured(NamedTuple):
    """One code at one tolerance: median seconds for all lanes (compile apart), largest error of what is wanted, and
    the number of lines that its user writes."""

    workload: str
    peer: str
    tol: float
    lanes: int
    seconds: float
    compile_seconds: float
    max_error: float
    median_error: float
    lines: int


def count_lines(pieces: Sequence[Any]) -> int:
    """Lines of these functions and classes as they are formatted here, without blank lines, comments, docstrings."""
    total = 0
    for piece in pieces:
        source = textwrap.dedent(inspect.getsource(piece))
        lines = {i for i, line in enumerate(source.splitlines(), 1) if line.strip() and line.lstrip()[0] != "#"}
        for node in ast.walk(ast.parse(source)):
            if isinstance(node, ast.FunctionDef | ast.ClassDef) and ast.get_docstring(node):
                lines -= set(range(node.body[0].lineno, node.body[0].end_lineno + 1))
        total += len(lines)
    return total


def timed(
    workload: str,
    name: str,
    tol: float,
    values: np.ndarray,
    prepare: Callable[[], Callable[[], Any]],
    unpack: Callable[[Any], np.ndarray],
    *,
    lines: int,
    repeats: int,
    expected: np.ndarray | None = None,
) -> Measured:
    """Times `prepare` (compilation), then `repeats` runs of what it returns. `expected` saves computing it again."""
    start = time.perf_counter()
    run = prepare()
    compile_seconds, seconds = time.perf_counter() - start, []
    for _ in range(repeats):
        start = time.perf_counter()
        out = jax.block_until_ready(run())
        seconds.append(time.perf_counter() - start)
    expected = WORKLOADS[workload].reference(values) if expected is None else expected
    error = np.abs(unpack(out) - expected).reshape(len(values), -1).max(1)
    worst, median = float(error.max()), float(np.median(error))
    return Measured(workload, name, tol, len(values), statistics.median(seconds), compile_seconds, worst, median, lines)


def in_chunks(name: str, batch_size: int | None) -> str:
    return f"{name}/{batch_size}" if batch_size else name


def unpack_checked(out: tuple[Any, Any]) -> np.ndarray:
    """(what is wanted, success of each lane) as one array."""
    found, ok = out
    if not np.all(ok):
        raise RuntimeError(f"{np.sum(~np.asarray(ok))} lanes failed.")
    return np.stack(found, axis=-1) if isinstance(found, tuple) else np.asarray(found)


def measure(
    peer: str,
    tol: float,
    values: np.ndarray,
    *,
    workload: str = "S1",
    repeats: int = 3,
    batch_size: int | None = None,
    expected: np.ndarray | None = None,
) -> Measured:
    """Runs one of `PEERS` and compares it with the reference. `batch_size` is diffrax's."""
    if peer == "diffrax":
        lanes = jnp.asarray(values)
        ensemble, name = peers_diffrax.ensemble(workload, tol=tol, batch_size=batch_size), in_chunks(peer, batch_size)
        code = peers_diffrax.user_code(workload)

        def prepare() -> Callable[[], Any]:
            compiled = ensemble.lower(lanes).compile()
            return lambda: compiled(lanes)

    elif peer in ("heyoka", "heyoka-batch"):
        import peers_heyoka

        width = WIDTH if peer == "heyoka-batch" else 1
        name, code = in_chunks(peer, width if width > 1 else None), peers_heyoka.user_code(workload, width=width)

        def prepare() -> Callable[[], Any]:
            run = peers_heyoka.ensemble(workload, tol=tol, width=width)
            return lambda: run(values)

    else:
        name, code = f"scipy {peer}", peers_scipy.user_code(workload)

        def prepare() -> Callable[[], Any]:
            run = peers_scipy.ensemble(workload, method=peer, tol=tol)
            return lambda: run(values)

    unpack = unpack_checked if peer == "diffrax" else np.asarray
    lines = count_lines(code)
    return timed(workload, name, tol, values, prepare, unpack, lines=lines, repeats=repeats, expected=expected)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--workload", nargs="+", default=["S1"], choices=WORKLOADS)
    parser.add_argument("--lanes", type=int, default=4096)
    parser.add_argument("--scipy-lanes", type=int, default=8, help="lanes given to scipy, whose time is scaled up")
    parser.add_argument("--tol", type=float, nargs="+", default=[1e-6, 1e-8, 1e-10])
    parser.add_argument("--peer", nargs="+", default=PEERS, choices=PEERS)
    parser.add_argument("--batch-size", type=int, nargs="*", default=[0, 256], help="chunks for diffrax; 0: one vmap")
    parser.add_argument("--repeats", type=int, default=3)
    options = parser.parse_args()
    jax.config.update("jax_enable_x64", True)
    print(
        f"{'':<3} {'peer':<14} {'lines':>5} {'tol':>7} {f's per {options.lanes} lanes':>17} {'compile s':>10} "
        f"{'max error':>10} {'median':>10}"
    )
    for workload in options.workload:
        for peer in options.peer:
            lanes = options.scipy_lanes if peer in ("RK45", "DOP853") else options.lanes
            values = WORKLOADS[workload].sweep(lanes)
            expected = WORKLOADS[workload].reference(values)
            for tol in options.tol:
                for batch_size in options.batch_size if peer == "diffrax" else [0]:
                    m = measure(
                        peer, tol, values, workload=workload, repeats=options.repeats, batch_size=batch_size or None,
                        expected=expected,
                    )  # fmt: skip
                    print(
                        f"{workload:<3} {m.peer:<14} {m.lines:>5} {tol:>7.0e} "
                        f"{m.seconds * options.lanes / m.lanes:>17.3f} "
                        f"{m.compile_seconds:>10.2f} {m.max_error:>10.1e} {m.median_error:>10.1e}",
                        flush=True,
                    )


if __name__ == "__main__":
    main()
