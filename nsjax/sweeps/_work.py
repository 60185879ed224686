"""What one process does of a long sweep."""

import time
from collections.abc import Callable, Iterator
from concurrent.futures import Future
from typing import Any, NamedTuple

import numpy as np

from ._claim import Claims
from ._devices import Device, DeviceQueue
from ._folder import Folder
from ._lanes import Lanes
from ._piece import Piece
from ._progress import Meter


PAUSE = 0.2  # [s] between two looks at what other processes do


class _Job(NamedTuple):
    """A block that is being computed."""

    number: int
    rows: np.ndarray | None  # in which order its lanes are computed; None for their own
    pieces: list[tuple[int, Future]]  # of so many lanes

    @property
    def lanes(self) -> int:
        return sum(lanes for lanes, _ in self.pieces)

    @property
    def leaves(self) -> list[np.ndarray]:
        found = [np.concatenate(parts) for parts in zip(*(future.result() for _, future in self.pieces))]
        if self.rows is not None:
            back = np.argsort(self.rows)
            found = [leaf[back] for leaf in found]
        return found


class Work:
    """Computes the blocks that no other process does. While one is written the next one is under way, so that no device
    has to wait.

    **Arguments:**

    - `order`: numbers, one a lane, by which the lanes of a block are sorted while they are computed; or None.
    """

    def __init__(
        self,
        piece: Piece,
        lanes: Lanes,
        block: int,
        folder: Folder,
        claims: Claims,
        devices: DeviceQueue,
        *,
        order: np.ndarray | None = None,
    ):
        self.piece, self.lanes, self.block, self.order = piece, lanes, block, order
        self.folder, self.claims, self.devices = folder, claims, devices

    def completed(self, todo: list[int], meter: Meter, wait: bool) -> Iterator[int]:
        """Computes what is `todo`, and yields these blocks as they are there, those of other processes too.

        **Arguments:**

        - `wait`: whether to wait for blocks that others compute.
        """
        others, last = [], len(self.devices)
        job = self._begin(todo, others)
        while True:
            if others:
                meter.block(0)
                yield from others
                others.clear()
            if job is not None:
                self._wait(job.pieces[:-last], meter)
                # Each device has a last piece of this block, and the next one has to be there when they are done. It is
                # not taken sooner, as other processes may have nothing left to do.
                ahead = self._begin(todo, others)
                self._wait(job.pieces[-last:], meter)
                self.folder.write(job.number, job.leaves)
                self.claims.release(job.number)
                meter.block(job.lanes)
                yield job.number
                job = ahead
            elif todo and wait:
                time.sleep(PAUSE)
                job = self._begin(todo, others)
            elif not others:
                return

    def _wait(self, pieces: list[tuple[int, Future]], meter: Meter) -> None:
        for lanes, future in pieces:
            future.result()
            meter.piece(lanes)

    def _begin(self, todo: list[int], others: list[int]) -> _Job | None:
        """The first block that is to be had; None if there is none. Those that `others` did are put there."""
        job = None
        while todo and job is None:
            number = next((n for n in todo if self.folder.has(n) or self.claims.take(n)), None)
            if number is None:
                break
            todo.remove(number)
            if self.folder.has(number):  # before, or in the very moment in which it was taken
                self.claims.release(number)
                others.append(number)
            else:
                job = self._job(number)
        return job

    def _job(self, number: int) -> _Job:
        start, stop = number * self.block, min((number + 1) * self.block, self.lanes.number)
        rows = None if self.order is None else np.argsort(self.order[start:stop], kind="stable")
        cuts = [(i, min(i + self.piece.size, stop)) for i in range(start, stop, self.piece.size)]
        each = [slice(*cut) if rows is None else start + rows[cut[0] - start : cut[1] - start] for cut in cuts]
        return _Job(number, rows, [(j - i, self.devices.submit(self._piece(own))) for (i, j), own in zip(cuts, each)])

    def _piece(self, rows: slice | np.ndarray) -> Callable[[Device], Any]:
        return lambda device: self.piece.run(self.lanes.rows(rows), device)
