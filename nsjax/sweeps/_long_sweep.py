"""`Sweep`: a sweep that takes long, block by block, in a folder that outlasts the process."""

import collections
import os
from collections.abc import Callable, Iterator
from typing import Any, NamedTuple, Self

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

from .._numerics._compile import eager, on_host
from .._numerics._progress import ProgressMeter, QUIET, Told
from .._numerics._text import known, positive, shown
from ._claim import Claims, myself
from ._dataset import dataframe, dataset, leaf_names
from ._devices import DeviceQueue, Devices, devices_of
from ._fingerprint import differences, fingerprint
from ._folder import Folder
from ._lanes import CHUNK, default_chunk, lanes_of
from ._outcomes import Outcome, outcome_of
from ._piece import MOST, Piece
from ._progress import Meter, Status
from ._sweep import in_pieces, sweep
from ._work import Work


BLOCK = 65536


class Block(NamedTuple):
    """Some lanes of a sweep: from `start` to before `stop`, and what the function returned for them, as NumPy's
    arrays."""

    number: int
    start: int
    stop: int
    result: Any


@shown
class Sweep:
    """A sweep that takes long: `sweep(fn, *args)` in blocks of lanes, each kept in a folder as soon as it is done.

    ```python
    def final(v_dr):
        sol = nsjax.solve(StickSlip(v_dr=v_dr), 0.0, 100.0, State(2.5, 0.0), throw=False)
        return sol.y1, sol.result

    meter = diffrax.TextProgressMeter()
    runs = nsjax.Sweep(final, np.linspace(0.1, 1.0, 10_000_000), path="run/", progress_meter=meter)
    y1, _ = runs.run().result()  # y1.x has shape (10_000_000,), and is on the disk
    print(runs.counts())
    ```

    Interrupted, or killed at any instant, it goes on where it was when the same lines are run again, and its result is
    the same bit for bit. Several processes, on one machine or on many that share the folder, may run these lines at
    once: each takes blocks that no other one has, and those of a process that died are taken over.

    Iterating over it yields `Block`s as they are done, those first that are there already.

    **Arguments:**

    - `fn`, `args`: as for `sweep`. Arrays may lie on the disk (`numpy.load(..., mmap_mode="r")`): no more than a few
        blocks of them, and of what is returned, are in memory at any time.
    - `path`: the folder. It is made if it is not there; that of another sweep is refused.
    - `block`: how many lanes are computed and written together, a multiple of `chunk`; by default 65536. Where `fn`
        returns much, such as all events of a solution, take fewer.
    - `chunk`: how many lanes go together, by default 256 on a CPU and a block on other devices.
    - `devices`: a number of devices, a list of them, or a `jax.sharding.Mesh`, of this process; by default one. The
        result does not depend on it.
    - `order`: numbers, shape `(lanes,)`, by which the lanes of a block are sorted while they are computed: a guess of
        how long each takes, or a parameter that tells. Lanes of a chunk wait for the slowest of them, so that this pays
        where neighbours are not alike, as in a random sample (`benchmarks/sweep_scale.py`). What is returned is in its
        own order, and does not depend on it.
    - `progress_meter`: `diffrax.TextProgressMeter()` writes to the standard error stream how far it is, how many lanes
        it does in a second and how long it will take; `diffrax.TqdmProgressMeter()` draws a bar; a function is given a
        `Status` after each block.
    - `stale`: for how long a block is left to another process that gives no sign of life [s]. (Of a process on the same
        machine it is known at once that it is no more.)

    **Raises:** `ValueError` for mistakes in the arguments, and if the folder holds another sweep: other values of
    arguments, another function, model or options (whatever changes the compiled program), other versions of nsjax, JAX
    and what they use. The message says what differs.
    """

    def __init__(
        self,
        fn: Callable[..., Any],
        *args: Any,
        path: str | os.PathLike,
        block: int = BLOCK,
        chunk: int | None = None,
        devices: Devices | None = None,
        order: Any = None,
        progress_meter: ProgressMeter = QUIET,
        stale: float = 120.0,
    ):
        if not (eager() and known((fn, args))):
            raise ValueError("`nsjax.Sweep` is not for `jax.jit`, `jax.vmap` and derivatives: use `nsjax.sweep`.")
        positive("block", block)
        Told(progress_meter)  # which is checked before anything is compiled
        self._devices = devices_of(devices)
        if chunk is None:
            chunk = min(block, default_chunk(block, self._devices[0].platform))
        positive("chunk", chunk)
        if block % chunk:
            raise ValueError(f"Argument `block` must be a multiple of `chunk` = {chunk}, but is {block}.")
        if not (stale > 0):
            raise ValueError(f"Argument `stale` must be a positive time [s], but is {stale!r}.")
        lanes = lanes_of(args)
        if order is not None and np.shape(order) != (lanes.number,):
            raise ValueError(f"Argument `order` must have shape ({lanes.number},), but has {np.shape(order)}.")
        self._order = order if order is None or isinstance(order, np.ndarray) else np.asarray(order)
        self._fn, self._progress_meter, self._stale = fn, progress_meter, stale
        self._block, self._number = block, -(-lanes.number // block)
        chunk = max(1, min(chunk, lanes.number))  # of few lanes there are no more in a chunk
        chunks = -(-min(block, max(1, lanes.number)) // chunk)
        self._piece = Piece(fn, lanes, chunk, min(MOST, chunks), self._devices)
        self._lanes = lanes.on_host()
        self._owner = myself()
        self._folder = Folder(path, self._owner.token)
        strange = {form.dtype.name for form in self._piece.program.forms if form.dtype.kind not in "biufc"}
        if strange:
            raise TypeError(f"What `fn` returns must be numbers that NumPy knows, but there is {', '.join(strange)}.")
        names = leaf_names(self._tree(range(self._piece.program.tree.num_leaves)), "value")
        here = fingerprint(fn, self._lanes, self._piece, block, names)
        apart = differences(self._folder.open(here), here)
        if apart:
            raise ValueError(
                f"Argument `path`: the folder {os.fspath(path)} holds another sweep: {'; '.join(apart)}. Give another "
                "folder, or remove this one."
            )

    def _tree(self, leaves: Any) -> Any:
        return jax.tree.unflatten(self._piece.program.tree, leaves)

    def _span(self, number: int) -> tuple[int, int]:
        return number * self._block, min((number + 1) * self._block, self._lanes.number)

    def __len__(self) -> int:
        """The number of blocks."""
        return self._number

    def __str__(self) -> str:
        name = getattr(self._fn, "__name__", type(self._fn).__name__)
        return f"sweep of `{name}` in {self._folder.path}: {self.status}"

    @property
    def _claims(self) -> Claims:
        return Claims(self._folder.claims, self._owner, self._stale, self._folder.sweep_up)

    @property
    def status(self) -> Status:
        """How far it is, as the folder tells: whoever is working on it."""
        done = self._folder.done()
        lanes = sum(stop - start for start, stop in map(self._span, done))
        running, nan = len(self._claims.living() - done), float("nan")
        return Status(self._lanes.number, lanes, self._number, len(done), running, nan, nan)

    def run(self, wait: bool = True) -> Self:
        """Computes what is missing.

        **Arguments:**

        - `wait`: when all that is left is being computed by other processes, whether to wait for them (and to take over
            what they do not finish), so that all is done; or to return.

        **Returns:** itself.
        """
        for _ in self._completed(wait):
            pass
        return self

    def __iter__(self) -> Iterator[Block]:
        for number in self._completed(True):
            yield self._read(number)

    def _read(self, number: int) -> Block:
        leaves = [self._folder.read(number, i) for i in range(len(self._piece.program.forms))]
        return Block(number, *self._span(number), self._tree(leaves))

    def _completed(self, wait: bool) -> Iterator[int]:
        """Blocks that are there, and then others as they come to be."""
        done = self._folder.done()
        yield from sorted(done)
        if len(done) < self._number:
            todo = sorted(set(range(self._number)) - done)
            with Meter(self._progress_meter, lambda: self.status) as meter, self._claims as claims:
                with DeviceQueue(self._devices) as each:
                    work = Work(self._piece, self._lanes, self._block, self._folder, claims, each, order=self._order)
                    yield from work.completed(todo, meter, wait)

    # What was found.

    def result(self) -> Any:
        """What `fn` returned, with a first axis of length `lanes`: NumPy's arrays that are on the disk, where the first
        call puts them together (as large as the blocks once more).

        **Raises:** `ValueError` if blocks are missing.
        """
        missing = self._number - len(self._folder.done())
        if missing:
            raise ValueError(f"{missing} of {self._number} blocks are missing: `run` computes them, `status` tells.")
        count = self._lanes.number
        return self._tree(
            [
                self._folder.whole(i, (count, *form.shape), form.dtype, self._number)
                for i, form in enumerate(self._piece.program.forms)
            ]
        )

    def _codes(self, outcome: Outcome) -> Iterator[tuple[int, np.ndarray]]:
        for number in sorted(self._folder.done()):
            yield self._span(number)[0], self._folder.read(number, outcome.leaf)

    def counts(self) -> dict[str, int]:
        """How many of the lanes that are done ended with each of `RESULTS`, by name: most first.

        **Raises:** `ValueError` if `fn` returns none of `RESULTS`, or several.
        """
        outcome, found = outcome_of(self._piece.program.tree), collections.Counter()
        for _, codes in self._codes(outcome):
            found.update(outcome.names(codes))
        return dict(found.most_common())

    def failed(self) -> tuple[Any, ...]:
        """The arguments of those lanes that are done and failed, to try them in another way:
        `sweep(other, *runs.failed())`. There may be none of them.

        **Raises:** `ValueError` if `fn` returns none of `RESULTS`, or several.
        """
        outcome = outcome_of(self._piece.program.tree)
        rows = [start + np.flatnonzero(outcome.failed(codes)) for start, codes in self._codes(outcome)]
        at = np.concatenate([np.zeros(0, int), *rows])
        return eqx.combine(jax.tree.map(lambda x: x[at], self._lanes.mapped), self._lanes.rest)

    def to_dataframe(self) -> Any:
        """`result` as a `pandas.DataFrame` with a row for each lane: the arguments, and what was returned, `RESULTS` by
        their names. It is in memory as a whole. It needs the package pandas: `pip install nsjax[data]`."""
        return dataframe(self._fn, self._lanes, self.result())

    def to_xarray(self) -> Any:
        """`result` as an `xarray.Dataset` over the dimension `lane`, with the arguments as coordinates. It needs the
        package xarray: `pip install nsjax[data]`."""
        return dataset(self._fn, self._lanes, self.result())


def sweep_in(
    path: str | os.PathLike | None,
    fn: Callable[..., Any],
    *args: Any,
    chunk: int | None = None,
    devices: Devices | None = None,
    progress_meter: ProgressMeter = QUIET,
) -> Any:
    """`sweep`; with a `path` by a `Sweep` in that folder, a chunk at a time, as each lane is much work."""
    if path is None:
        return sweep(fn, *args, chunk=chunk, devices=devices, progress_meter=progress_meter)
    how: dict[str, Any] = dict(path=path, block=chunk or CHUNK, chunk=chunk, devices=devices)
    runs = Sweep(fn, *args, **how, progress_meter=progress_meter).run()
    return jax.tree.map(jnp.asarray, runs.result())


def sweep_again(
    path: str | os.PathLike | None,
    fn: Callable[..., Any],
    *args: Any,
    chunk: int,
    devices: Devices | None = None,
    tell: Callable[[int], Any],
) -> Any:
    """`sweep_in` for a function that is applied again and again, to fewer and fewer lanes: always in chunks of one
    length, so that all of it is one program. `tell` is called with the number of lanes that are done. Returns NumPy's
    arrays."""
    lanes = lanes_of(args)
    number = lanes.number
    if path is None:
        return on_host(in_pieces(fn, lanes, chunk, 1, devices_of(devices), tell))
    short = chunk - lanes.number
    if short > 0:
        lanes = jax.tree.map(lambda x: np.concatenate([x, *[x[-1:]] * short]), lanes.mapped), lanes.rest
        args = eqx.combine(*lanes)
    runs = Sweep(fn, *args, path=path, block=chunk, chunk=chunk, devices=devices)
    for block in runs:
        tell(min(block.stop, number))
    return jax.tree.map(lambda x: x[: min(len(x), len(x) - short)], runs.result())
