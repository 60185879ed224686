"""How far something is: told by a progress meter, as diffrax has them, or on a line of our own."""

import sys
import time
from collections.abc import Callable
from typing import Any, NamedTuple, Self, TypeAlias

import diffrax as dfx
import jax

from ._text import shown


PAUSE = 0.1  # [s] between two writings

ProgressMeter: TypeAlias = dfx.AbstractProgressMeter | Callable[[Any], Any]
QUIET = dfx.NoProgressMeter()
RENAMED = {"progress": "Write `progress_meter=diffrax.TextProgressMeter()`."}  # of what one might call it otherwise


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

    def show(self, what: Any, share: float | None = None) -> None:
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


class _Bar:
    """A bar of the package tqdm; where the end is not known, its text alone."""

    def __init__(self):
        import tqdm  # pyright: ignore[reportMissingModuleSource]

        self._tqdm, self._bar = tqdm.tqdm, None

    def __enter__(self) -> Self:
        return self

    def show(self, what: Any, share: float | None = None) -> None:
        if self._bar is None:
            form = "{desc}" if share is None else "{percentage:3.0f}%|{bar}| {desc}"
            self._bar = self._tqdm(total=100.0, bar_format=form)
        self._bar.n = 100.0 * (share or 0.0)
        self._bar.set_description_str(str(what))

    def __exit__(self, *failure: Any) -> None:
        if self._bar is not None:
            self._bar.close()


class _Foreign:
    """A progress meter that the user wrote, driven from Python."""

    def __init__(self, meter: dfx.AbstractProgressMeter):
        self._meter, self._state = meter, None

    def __enter__(self) -> Self:
        return self

    def show(self, what: Any, share: float | None = None) -> None:
        if self._state is None:
            self._state = (self._meter.init(),)
        if share is not None:
            self._state = (self._meter.step(self._state[0], jax.numpy.asarray(share)),)

    def __exit__(self, *failure: Any) -> None:
        if self._state is not None:
            self._meter.close(self._state[0])


class Told:
    """What is shown of a work that Python does step by step.

    **Arguments:**

    - `progress_meter`: as the user gave it: of diffrax, or a function.
    - `ends`: whether it is known beforehand how much there is to do.
    """

    def __init__(self, progress_meter: ProgressMeter, ends: bool = True):
        meter, line = progress_meter, None
        if isinstance(meter, dfx.TextProgressMeter):
            line = ProgressLine()
        elif isinstance(meter, dfx.TqdmProgressMeter):
            line = _Bar()
        elif isinstance(meter, dfx.AbstractProgressMeter) and not isinstance(meter, dfx.NoProgressMeter):
            if not ends:
                raise ValueError(
                    "Argument `progress_meter` must be `diffrax.TextProgressMeter()`, `diffrax.TqdmProgressMeter()` or "
                    "a function, because how long a continuation is, is not known beforehand; but got "
                    f"{type(meter).__name__}."
                )
            line = _Foreign(meter)
        elif not isinstance(meter, dfx.AbstractProgressMeter) and (isinstance(meter, type) or not callable(meter)):
            raise TypeError(
                "Argument `progress_meter` must be a progress meter such as `diffrax.TextProgressMeter()`, or a "
                f"function, but got {meter!r}."
            )
        self.line, self.function = line, None if isinstance(meter, dfx.AbstractProgressMeter) else meter

    def __bool__(self) -> bool:
        return self.line is not None or self.function is not None

    def __enter__(self) -> Self:
        return self

    def show(self, what: Any, share: float | None = None) -> None:
        """To whoever listens: `what`, of which `str` says how far it is."""
        if self.line is not None:
            self.line.show(what, share)
        if self.function is not None:
            self.function(what)

    def __exit__(self, *failure: Any) -> None:
        if self.line is not None:
            self.line.__exit__(*failure)


@shown
class Count(NamedTuple):
    """How many of many things are done.

    **Attributes:**

    - `what`: what they are, in the plural.
    - `done`, `total`: how many.
    - `rate`: how many a second since it began [1/s]; NaN before the first.
    - `remaining`: how long it takes at that rate [s].
    - `stage`: what is done with them now; empty if there is one thing to do.
    """

    what: str
    done: int
    total: int
    rate: float
    remaining: float
    stage: str = ""

    def __str__(self) -> str:
        share = 100.0 * self.done / self.total if self.total else 100.0
        text = f"{self.done:,} of {self.total:,} {self.what} ({share:.1f} %)"
        if self.rate > 0 and self.done < self.total:
            text += f", {a_second(self.rate)} {self.what}/s, {in_words(self.remaining)} left"
        return f"{self.stage}: {text}" if self.stage else text


class Counting:
    """Counts, and tells a progress meter."""

    def __init__(self, progress_meter: ProgressMeter, total: int, what: str):
        self._told, self._what, self._total = Told(progress_meter), what, total
        self._began = time.monotonic()

    def __enter__(self) -> Self:
        self._began = time.monotonic()
        if self._told:
            self.at(0)
        return self

    def at(self, done: int, stage: str = "") -> None:
        """So many are done."""
        if not self._told:
            return
        rate, remaining = pace(done, self._total - done, time.monotonic() - self._began)
        count = Count(self._what, done, self._total, rate, remaining, stage)
        self._told.show(count, done / self._total if self._total else 1.0)

    def __exit__(self, *failure: Any) -> None:
        self._told.__exit__(*failure)


def pace(done: int, left: int, passed: float) -> tuple[float, float]:
    """How many a second, and how long the others take [s]; NaN where nothing is known of it."""
    rate = done / passed if passed > 0 and done > 0 else float("nan")
    return rate, left / rate


def a_second(rate: float) -> str:
    return f"{rate:,.0f}" if rate >= 10 else f"{rate:.2g}"


def in_words(seconds: float) -> str:
    """`2 d 3 h`, `4 min 38 s`."""
    if seconds < 1:
        return "less than 1 s"
    left = round(seconds)
    units = [(left // 86400, "d"), (left // 3600 % 24, "h"), (left // 60 % 60, "min"), (left % 60, "s")]
    first = next((i for i, (n, _) in enumerate(units) if n), 3)
    return " ".join(f"{n} {unit}" for n, unit in units[first : first + 2] if n)
