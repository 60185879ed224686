"""A line that tells how far something is."""

import sys
import time
from typing import Any, Self


PAUSE = 0.1  # [s] between two writings


class ProgressLine:
    """A line on the standard error stream, written over and over, which is ended where the `with` block is left.

    ```python
    with ProgressLine() as line:
        for step in work:
            line.show(work)  # what `str` says of it
    ```
    """

    def __init__(self):
        self._stream, self._at, self._width, self._last = sys.stderr, float("-inf"), 0, None

    def __enter__(self) -> Self:
        return self

    def show(self, what: Any) -> None:
        self._last = what
        if time.monotonic() - self._at >= PAUSE:
            self._write()

    def _write(self) -> None:
        text = str(self._last)
        self._stream.write("\r" + text.ljust(self._width))
        self._stream.flush()
        self._at, self._width = time.monotonic(), len(text)

    def __exit__(self, *failure: Any) -> None:
        if self._last is not None:
            self._write()
            self._stream.write("\n")
            self._stream.flush()
