"""Classes of itineraries: the events of one time around an attractor, whichever comes first."""

import dataclasses

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Int

from ..system._system import System


NONE = -1  # of an itinerary that is not known, or longer than what is kept of it

# A row is the switch whose event it is, and the modes of all switches after it; -1 instead of a switch where nothing
# happens all the time.
Rows = Int[np.ndarray, "events switches+1"]


def mode_row(system: System, mode: Int[Array, " more"]) -> Int[Array, " switches"]:
    """Without those that a section adds. Of a clock all ticks are alike: it never comes back to a mode."""
    still = [0 if s.ticking else 1 for s in system.switches]
    return mode[: len(still)].astype(jnp.int8) * jnp.asarray(still, jnp.int8)


@dataclasses.dataclass
class ItineraryClasses:
    """A table of those that were met."""

    system: System
    words: list[str] = dataclasses.field(default_factory=list)
    _seen: dict[bytes, int] = dataclasses.field(default_factory=dict)
    _known: dict[bytes, int] = dataclasses.field(default_factory=dict)

    def of(self, rows: Int[np.ndarray, "lanes most switches+1"], counts: Int[np.ndarray, " lanes"]) -> np.ndarray:
        """The class of each of many itineraries of so many events; `NONE` where there is no room for all of them."""
        lanes, most, _ = rows.shape
        if not lanes:
            return np.zeros(0, int)
        rows = np.where(np.arange(most)[:, None] < np.maximum(counts, 1)[:, None, None], rows, 0)
        text = np.concatenate([rows.reshape(lanes, -1), counts.astype(np.int32)[:, None].view(np.int8)], axis=1)
        _, first, which = np.unique(text, axis=0, return_index=True, return_inverse=True)
        found = [self._class(rows[i, : max(1, counts[i])]) if counts[i] <= most else NONE for i in first]
        return np.array(found, int)[np.ravel(which)]

    def _class(self, rows: Rows) -> int:
        key = rows.tobytes()
        if key not in self._seen:
            rows = _accumulated(self.system, rows)
            first = min(range(len(rows)), key=lambda i: np.roll(rows, -i, axis=0).tobytes())
            rows = np.roll(rows, -first, axis=0)
            least = rows.tobytes()
            if least not in self._known:
                self._known[least] = len(self.words)
                self.words.append(itinerary_words(self.system, rows))
            self._seen[key] = self._known[least]
        return self._seen[key]


def _accumulated(system: System, rows: Rows) -> Rows:
    """Impacts that lead to rest are infinitely many, of which as many were made as the tolerance wants: one stands for
    all of them."""
    before = np.roll(rows, 1, axis=0)
    resting = [s.unilateral for s in system.switches]
    keep, n = np.ones(len(rows), bool), len(rows)
    for i, row in enumerate(rows):
        k = row[0]
        if k >= 0 and resting[k] and row[1 + k] == 1 and before[i, 1 + k] == 0:
            j = i - 2
            # (The row of leaving the surface is that of an impact, but for what was before it.)
            while j > i - n and (rows[j % n] == rows[(j + 1) % n]).all() and before[j % n, 1 + k] == 0:
                keep[(j + 1) % n] = False
                j -= 1
    return rows[keep]


def itinerary_words(system: System, rows: Rows) -> str:
    """As they are printed: `belt0 belt+ belt-`, `(belt0 belt-)×2 belt+`."""
    switches = system.switches
    if rows[0, 0] < 0:
        words = ", ".join(filter(None, (s.symbol(int(m)) for s, m in zip(switches, rows[0, 1:]))))
        return f"no event: {words}" if words else "no event"
    words = []
    for before, row, after in zip(np.roll(rows, 1, axis=0), rows, np.roll(rows, -1, axis=0)):
        k = int(row[0])
        others = (j for j in range(len(switches)) if j != k and row[1 + j] != before[1 + j])
        word = switches[k].event_symbol(int(before[1 + k]), int(row[1 + k]))
        word = ",".join([word, *(switches[j].event_symbol(int(before[1 + j]), int(row[1 + j])) for j in others)])
        at_rest = switches[k].unilateral and before[1 + k] == row[1 + k] == 0
        words.append(word + "×∞" * bool(at_rest and after[0] == k and after[1 + k] == 1))
    return _shortened(words)


def _shortened(words: list[str]) -> str:
    """What is repeated at once is written once, with its number: from each place on that which is then the longest."""
    out, i = [], 0
    while i < len(words):
        best, times = 1, 1
        for size in range(1, (len(words) - i) // 2 + 1):
            number = 1
            while words[i + number * size : i + (number + 1) * size] == words[i : i + size]:
                number += 1
            if number > 1 and number * size > best * times:
                best, times = size, number
        part = " ".join(words[i : i + best])
        out.append(part if times == 1 else f"({part})×{times}" if best > 1 else f"{part}×{times}")
        i += best * times
    return " ".join(out)
