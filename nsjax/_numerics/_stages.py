"""What a command is doing, one line for each stage, on the standard error stream: nobody waits for long without a word.

This is imported before JAX, which takes a second or two itself.
"""

import os
import sys
import threading
import time
from typing import Any, Self


TICK = 1.4  # [s] of silence, after which it is said that the stage goes on
LOOK = 0.1  # [s] between two looks at the time


class Stages:
    """A thread that says how long the stage takes, where nothing else is said.

    Lines are written once, and the one that goes on is written anew; on a terminal over itself.
    """

    def __init__(self):
        self._lock, self._thread, self._over = threading.RLock(), None, threading.Event()
        self._text, self._began, self._said, self._progress = "", 0.0, 0.0, None
        self._open = 0  # width of a line on a terminal that can be written over

    @property
    def on(self) -> bool:
        return self._thread is not None

    def start(self, text: str) -> Self:
        """Begins to tick; the first stage is named only if it takes long."""
        if not self.on:
            self._over.clear()
            self._begin(text)
            self._thread = threading.Thread(target=self._tick, daemon=True)
            self._thread.start()
        return self

    def _begin(self, text: str) -> None:
        self._text, self._began, self._said, self._progress = text, time.monotonic(), time.monotonic(), None

    def stage(self, text: str) -> None:
        """Another stage begins."""
        if self.on:
            with self._lock:
                self._end_line()
                self._begin(text)
                self._write(f"{text} ...")

    def progress(self, what: Any) -> None:
        """How far the stage is: `str` says it when it is asked. A terminal shows it at once."""
        with self._lock:
            self._progress = what
            if self.on and sys.stderr.isatty() and time.monotonic() - self._said >= LOOK:
                self._write(self._now())

    def _now(self) -> str:
        passed = f"{time.monotonic() - self._began:.0f} s"
        return f"{self._text}: {passed}" if self._progress is None else f"{self._text}: {self._progress}, {passed}"

    def _write(self, text: str) -> None:
        line, terminal = f"nsjax: {text}", sys.stderr.isatty()
        if terminal:
            sys.stderr.write("\r" + line.ljust(self._open))
            self._open = len(line)
        else:
            sys.stderr.write(line + "\n")
        sys.stderr.flush()
        self._said = time.monotonic()

    def _end_line(self) -> None:
        if self._open:
            sys.stderr.write("\n")
            sys.stderr.flush()
            self._open = 0

    def _tick(self) -> None:
        while not self._over.wait(LOOK):
            with self._lock:
                if time.monotonic() - self._said >= TICK:
                    self._write(self._now())

    def say(self, text: str) -> None:
        """A line of its own, whether stages are told or not."""
        with self._lock:
            self._end_line()
            print(text, file=sys.stderr, flush=True)
            self._said = time.monotonic()

    def answer(self, text: str) -> None:
        """Lines on the standard output, while stages go on."""
        with self._lock:
            self._end_line()
            print(text, flush=True)

    def stop(self) -> None:
        """The command is over, or what follows is its answer."""
        if self._thread is not None:
            self._over.set()
            self._thread.join()
            self._thread = None
            with self._lock:
                self._end_line()


STAGES = Stages()


def is_quiet(words: list[str]) -> bool:
    return bool({"-q", "--quiet"} & set(words))


def is_command() -> bool:
    """Whether this process is `python -m nsjax`, or the script `nsjax`, that is about to import JAX."""
    first = sys.argv[0] if sys.argv else ""
    if first == "-m":  # which it is only until the module is found
        after = sys.orig_argv[sys.orig_argv.index("-m") + 1 :] if "-m" in sys.orig_argv else []
        return after[:1] == ["nsjax"]
    return os.path.splitext(os.path.basename(first))[0] == "nsjax"


if is_command() and not is_quiet(sys.argv):
    STAGES.start("starting")
