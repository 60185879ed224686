"""How far a long sweep is."""

import time
from collections.abc import Callable
from typing import Any, NamedTuple, Self

from .._numerics._progress import a_second, in_words, pace, ProgressMeter, Told
from .._numerics._text import shown


@shown
class Status(NamedTuple):
    """How far a sweep is, with all that other processes did.

    **Attributes:**

    - `lanes`, `lanes_done`: how many there are, and how many of them are computed.
    - `blocks`, `blocks_done`: the same of blocks, which are on the disk.
    - `running`: how many blocks are being computed, by any process.
    - `rate`: lanes a second since `run` or an iteration began [1/s]; NaN before the first.
    - `remaining`: how long it takes at that rate [s].
    """

    lanes: int
    lanes_done: int
    blocks: int
    blocks_done: int
    running: int
    rate: float
    remaining: float

    def __str__(self) -> str:
        share = 100.0 * self.lanes_done / self.lanes if self.lanes else 100.0
        text = (
            f"{self.lanes_done:,} of {self.lanes:,} lanes ({share:.1f} %), {self.blocks_done} of {self.blocks} blocks, "
            f"{self.running} running"
        )
        if self.rate > 0 and self.lanes_done < self.lanes:
            text += f", {a_second(self.rate)} lanes/s, {in_words(self.remaining)} left"
        return text


class Meter:
    """Measures the rate, and tells how far a sweep is: on a line, or once a block to a function.

    **Arguments:**

    - `status`: of the blocks on the disk.
    """

    def __init__(self, progress_meter: ProgressMeter, status: Callable[[], Status]):
        self._told, self._status = Told(progress_meter), status
        self._last, self._began, self._before, self._own = status(), time.monotonic(), 0, 0

    def __enter__(self) -> Self:
        self._began, self._before, self._own = time.monotonic(), self._last.lanes_done, 0
        self._show()
        return self

    def __exit__(self, *failure: Any) -> None:
        self._show()
        self._told.__exit__(*failure)

    def _show(self) -> None:
        if self._told.line is not None:
            now = self.now()
            self._told.line.show(now, now.lanes_done / now.lanes if now.lanes else 1.0)

    def now(self) -> Status:
        """With the pieces of blocks that are not yet on the disk."""
        done = min(self._last.lanes, self._last.lanes_done + self._own)
        passed = time.monotonic() - self._began
        rate, remaining = pace(done - self._before, self._last.lanes - done, passed)
        return self._last._replace(lanes_done=done, rate=rate, remaining=remaining)

    def piece(self, lanes: int) -> None:
        """That many were computed."""
        self._own += lanes
        self._show()

    def block(self, lanes: int) -> None:
        """A block of that many lanes, whose pieces were counted, is on the disk."""
        self._own -= lanes
        if self._told:
            self._last = self._status()
            self._show()
            if self._told.function is not None:
                self._told.function(self.now())
