"""What users of other packages write for the workloads S1, S2 and S3 (`workloads.py`), timed and checked.

Every peer integrates numerically in each mode, finds events by its own means and changes state and mode by the same
rules. One module a package says what its user must know: `peers_scipy`, `peers_diffrax`, `peers_heyoka`.

    python benchmarks/peers.py --workload S1 S2 --tol 1e-8 1e-10 --peer diffrax heyoka heyoka-batch
"""

import argparse
import ast
import inspect
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


SCIPY = ("RK45", "DOP853")
PEERS = (*SCIPY, "diffrax", "heyoka", "heyoka-batch")
WIDTH = 8  # lanes in a batch of heyoka's: numbers in one AVX-512 register; two registers without it
BASELINE = f"heyoka/{WIDTH}"  # of all ratios


class Code(NamedTuple):
    """One code at one tolerance, with its lanes."""

    name: str
    tol: float
    values: np.ndarray
    lines: int  # that its user writes
    prepare: Callable[[], Callable[[], Any]]  # compiles, and returns what runs all lanes
    unpack: Callable[[Any], np.ndarray]  # what that returns, as an array


class Measured(NamedTuple):
    """Seconds for all lanes (median, compile time apart); for a lane, their ratio to heyoka's batches at the same
    tolerance (median of those within a round, and of the least times); errors of what is wanted; a user's lines."""

    workload: str
    peer: str
    tol: float
    lanes: int
    seconds: float
    compile_seconds: float
    ratio: float | None
    ratio_of_least: float | None
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


def seconds_of(run: Callable[[], Any]) -> tuple[float, Any]:
    start = time.perf_counter()
    out = jax.block_until_ready(run())
    return time.perf_counter() - start, out


def in_turns(workload: str, codes: Sequence[Code], *, rounds: int, patience: float) -> list[Measured]:
    """Each code once, compilation included, and then once in every round, in the same order, so that a machine whose
    speed wanders does the same to all. What has taken longer than `patience` in three rounds sits the others out."""
    runs, first, errors, expected = [], [], [], {}
    for code in codes:
        start = time.perf_counter()
        runs.append(code.prepare())
        _, out = seconds_of(runs[-1])
        first.append(time.perf_counter() - start)
        if (lanes := len(code.values)) not in expected:
            expected[lanes] = WORKLOADS[workload].reference(code.values)
        errors.append(np.abs(code.unpack(out) - expected[lanes]).reshape(lanes, -1).max(1))
    seconds = np.full((rounds, len(codes)), np.nan)
    for i in range(rounds):
        for k, run in enumerate(runs):
            if i < 3 or np.nansum(seconds[:, k]) < patience:
                seconds[i, k] = seconds_of(run)[0]
    median, least = np.nanmedian(seconds, axis=0), np.nanmin(seconds, axis=0)
    peers = {code.tol: k for k, code in enumerate(codes) if code.name == BASELINE}
    rows = []
    for k, (code, error) in enumerate(zip(codes, errors)):
        ratio = of_least = None
        if (peer := peers.get(code.tol)) is not None:
            share = len(codes[peer].values) / len(code.values)
            ratio = share * float(np.nanmedian(seconds[:, k] / seconds[:, peer]))
            of_least = share * float(least[k] / least[peer])
        compiled = max(first[k] - median[k], 0.0)
        rows.append(
            Measured(
                workload, code.name, code.tol, len(code.values), float(median[k]), float(compiled), ratio, of_least,
                float(error.max()), float(np.median(error)), code.lines,
            )
        )  # fmt: skip
    return rows


def in_chunks(name: str, batch_size: int | None) -> str:
    return f"{name}/{batch_size}" if batch_size else name


def unpack_checked(out: tuple[Any, Any]) -> np.ndarray:
    """(what is wanted, success of each lane) as one array."""
    found, ok = out
    if not np.all(ok):
        raise RuntimeError(f"{np.sum(~np.asarray(ok))} lanes failed.")
    return np.stack(found, axis=-1) if isinstance(found, tuple) else np.asarray(found)


def code_of(peer: str, workload: str, tol: float, values: np.ndarray, batch_size: int | None = None) -> Code:
    """One of `PEERS`. `batch_size` is diffrax's."""
    unpack: Callable[[Any], np.ndarray] = np.asarray
    if peer == "diffrax":
        lanes = jnp.asarray(values)
        name, pieces, unpack = in_chunks(peer, batch_size), peers_diffrax.user_code(workload), unpack_checked

        def prepare() -> Callable[[], Any]:
            compiled = peers_diffrax.ensemble(workload, tol=tol, batch_size=batch_size).lower(lanes).compile()
            return lambda: compiled(lanes)

    elif peer in ("heyoka", "heyoka-batch"):
        import peers_heyoka

        width = WIDTH if peer == "heyoka-batch" else 1
        name, pieces = in_chunks("heyoka", width if width > 1 else None), peers_heyoka.user_code(workload, width=width)

        def prepare() -> Callable[[], Any]:
            run = peers_heyoka.ensemble(workload, tol=tol, width=width)
            return lambda: run(values)

    else:
        name, pieces = f"scipy {peer}", peers_scipy.user_code(workload)

        def prepare() -> Callable[[], Any]:
            run = peers_scipy.ensemble(workload, method=peer, tol=tol)
            return lambda: run(values)

    return Code(name, tol, values, count_lines(pieces), prepare, unpack)


HEAD = (
    "| code | its user's lines | tolerance | seconds | over heyoka's (of the least) | compile [s] | largest error |\n"
    "|---|---|---|---|---|---|---|"
)


def line(r: Measured, lanes: int) -> str:
    """Of a table; seconds for so many lanes."""
    over = "" if r.ratio is None else f"{r.ratio:.2f} ({r.ratio_of_least:.2f})"
    figures = f"{r.seconds * lanes / r.lanes:.3g} | {over} | {r.compile_seconds:.1f} | {r.max_error:.1e}"
    return f"| {r.peer} | {r.lines} | {r.tol:.0e} | {figures} |"


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--workload", nargs="+", default=["S1"], choices=WORKLOADS)
    parser.add_argument("--lanes", type=int, default=4096)
    parser.add_argument("--scipy-lanes", type=int, default=8, help="lanes given to scipy, whose time is scaled up")
    parser.add_argument("--tol", type=float, nargs="+", default=[1e-6, 1e-8, 1e-10])
    parser.add_argument("--peer", nargs="+", default=PEERS, choices=PEERS)
    parser.add_argument("--batch-size", type=int, default=256, help="chunks for diffrax; 0: one vmap")
    parser.add_argument("--repeats", type=int, default=3)
    options = parser.parse_args()
    jax.config.update("jax_enable_x64", True)
    for workload in options.workload:
        codes = []
        for peer in options.peer:
            values = WORKLOADS[workload].sweep(options.scipy_lanes if peer in SCIPY else options.lanes)
            codes += [code_of(peer, workload, tol, values, options.batch_size or None) for tol in options.tol]
        print(f"\n### {workload}, {options.lanes} lanes\n\n{HEAD}")
        rows = in_turns(workload, codes, rounds=options.repeats, patience=np.inf)
        print(*(line(row, options.lanes) for row in rows), sep="\n", flush=True)


if __name__ == "__main__":
    main()
