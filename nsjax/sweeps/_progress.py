"""How far a long sweep is."""

import contextlib
import time
from collections.abc import Callable
from typing import Any, NamedTuple, Self

from .._numerics._progress import ProgressLine
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
            text += f", {self.rate:,.0f} lanes/s, {in_words(self.remaining)} left"
        return text


def in_words(seconds: float) -> str:
    """`2 d 3 h`, `4 min 38 s`."""
    if seconds < 1:
        return "less than 1 s"
    left = round(seconds)
    units = [(left // 86400, "d"), (left // 3600 % 24, "h"), (left // 60 % 60, "min"), (left % 60, "s")]
    first = next((i for i, (n, _) in enumerate(units) if n), 3)
    return " ".join(f"{n} {unit}" for n, unit in units[first : first + 2] if n)


Progress = bool | Callable[[Status], Any]


class Meter:
    """Measures the rate, and tells how far a sweep is: on a line, or once a block to a function.

    **Arguments:**

    - `status`: of the blocks on the disk.
    """

    def __init__(self, progress: Progress, status: Callable[[], Status]):
        self._progress, self._status = progress, status
        self._line = ProgressLine() if progress is True else None
        self._last, self._began, self._before, self._own = status(), time.monotonic(), 0, 0

    def __enter__(self) -> Self:
        self._began, self._before, self._own = time.monotonic(), self._last.lanes_done, 0
        if self._line is not None:
            self._line.show(self.now())
        return self

    def __exit__(self, *failure: Any) -> None:
        with contextlib.nullcontext() if self._line is None else self._line:
            if self._line is not None:
                self._line.show(self.now())

    def now(self) -> Status:
        """With the pieces of blocks that are not yet on the disk."""
        done = min(self._last.lanes, self._last.lanes_done + self._own)
        passed = time.monotonic() - self._began
        rate = (done - self._before) / passed if passed > 0 and done > self._before else float("nan")
        return self._last._replace(lanes_done=done, rate=rate, remaining=(self._last.lanes - done) / rate)

    def piece(self, lanes: int) -> None:
        """That many were computed."""
        self._own += lanes
        if self._line is not None:
            self._line.show(self.now())

    def block(self, lanes: int) -> None:
        """A block of that many lanes, whose pieces were counted, is on the disk."""
        self._own -= lanes
        if self._progress:
            self._last = self._status()
            if self._line is not None:
                self._line.show(self.now())
            elif callable(self._progress):
                self._progress(self.now())
