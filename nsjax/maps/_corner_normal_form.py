"""The periodic orbits that meet at a corner of a branch of them: every cycle of the return map's normal form there.

Near an orbit that touches the tip of a surface, grazes one, or is about to stick, the return map is to leading order
affine on each side of a border, or a square root beyond it. It is homogeneous: cycles grow in proportion to the
parameter's deviation, and one solution of linear equations for each itinerary tells on which side it exists, if at all.
"""

from collections.abc import Iterator, Sequence
from typing import NamedTuple

import numpy as np


MOST_WORDS = 4096  # itineraries that are tried
CHUNK = 4_000_000  # entries of the matrices that are inverted together
SYMMETRIC = 1e-6  # relative: the maps come from integrations


class CornerMap(NamedTuple):
    """The normal form of a lap that visits m places, in cyclic order. Before place p the state's deviation from the
    orbit at the corner is x, the parameter's is ν. The border is g = n[p]·x + c[p] ν, and x before the next place is

    - a[p] x + b[p] ν where g >= 0: the event does not happen,
    - a[p] x + b[p] ν + e[p] g where g < 0: it does,
    - a[p] x + b[p] ν + e[p] √(-g) instead, where `square[p]`.

    **Attributes:**

    - `a`: (m, n, n).
    - `b`, `e`, `n`: (m, n).
    - `c`: (m,).
    - `square`: (m,), booleans.
    """

    a: np.ndarray
    b: np.ndarray
    e: np.ndarray
    n: np.ndarray
    c: np.ndarray
    square: np.ndarray


class Cycle(NamedTuple):
    """A periodic orbit that leaves the corner.

    **Attributes:**

    - `side`: -1 if it exists for ν < 0, +1 for ν > 0.
    - `laps`: after how many it closes, k.
    - `word`: (m k,) of 0 and 1: whether the event happens, place after place, lap after lap; that of its rotations by
        whole laps which comes first in the dictionary.
    - `points`: (m k, n), x before each place, at ν = `side`; dx/dν is `side` times that.
    - `borders`: (m k,), g at ν = `side`. Zero where a square root is taken: there g is of second order.
    - `durations`: (m k,), √(-g) at ν = `side` where a square root is taken, and else zero.
    - `multipliers`: (n,), at the corner, the largest first. With square roots one is infinite, of that sign: it grows
        as |ν| to the power of minus their number. All are nan if an event has no effect on g at the next one, to
        leading order.
    - `stable`: whether all are inside the unit circle.
    - `image`: which of the cycles the symmetry makes of it: its own number if it is symmetric, None if there is no
        symmetry (or the image is in doubt).
    """

    side: int
    laps: int
    word: tuple[int, ...]
    points: np.ndarray
    borders: np.ndarray
    durations: np.ndarray
    multipliers: np.ndarray
    stable: bool
    image: int | None = None

    @property
    def unstable(self) -> int:
        """How many multipliers are outside the unit circle."""
        return int(np.sum(np.abs(self.multipliers) > 1))


class Cycles(NamedTuple):
    """What `find_cycles` finds.

    **Attributes:**

    - `cycles`: sorted by their laps.
    - `doubtful`: those with a border, or a duration, whose sign is within the tolerance of zero: they touch a further
        corner. Their sides are those of the other signs (0 if there are none; then the points are at ν = 1), and one
        cycle may be there under several words.
    - `singular`: words whose equations are singular within the tolerance, a multiplier being 1: they may have no cycle,
        or a continuum at ν = 0.
    - `most`: the number of laps up to which the cycles are known: less than was asked for if there are too many words.
    - `words`: how many were tried.
    """

    cycles: tuple[Cycle, ...]
    doubtful: tuple[Cycle, ...]
    singular: tuple[tuple[int, ...], ...]
    most: int
    words: int

    def on(self, side: int, laps: int | None = None) -> tuple[Cycle, ...]:
        """Those on one side, -1 or +1, of `laps` laps."""
        return tuple(c for c in self.cycles if c.side == side and laps in (None, c.laps))


class CornerKind(NamedTuple):
    """The bifurcation of periodic orbits at a corner, by their number on each side (Definition 5.1).

    **Attributes:**

    - `kind`: "none", "fold", "flip", "fold-flip", "symmetry breaking", "transcritical"; "multiple crossing" if there
        are longer cycles, but not by a flip; or "3 to 1": the numbers of orbits of one lap below and above.
    - `criticality`: of what is born at a flip or where a symmetry breaks: "supercritical" if any of it is stable, or
        less unstable than the orbit of one lap beside it, "subcritical" if all is more unstable; None if neither is so,
        as when all are unstable alike. At a fold-flip "supercritical" if a longer cycle is stable, or None.
    - `below`, `above`: the laps of the cycles for ν < 0 and for ν > 0.
    - `certain`: whether no word was singular or in doubt.
    """

    kind: str
    criticality: str | None
    below: tuple[int, ...]
    above: tuple[int, ...]
    certain: bool


def find_cycles(corner: CornerMap, most: int = 8, *, symmetry: np.ndarray | None = None, rtol: float = 1e-9) -> Cycles:
    """Finds every cycle of a corner's normal form.

    **Arguments:**

    - `corner`: the normal form; see `CornerMap`.
    - `most`: the largest number of laps of a cycle; fewer if that were more than about 4000 words (7 laps for m = 2, 4
        for m = 3, 3 for m = 4).
    - `symmetry`: J, (n, n), an involution: if x is before place p then J x is before place p + m/2, on an orbit of the
        same system. None if there is none.
    - `rtol`: to how many digits the normal form is known: what an error of this size could undo is reported as
        `doubtful` or `singular`.

    **Returns:**

    `Cycles`.
    """
    corner = _checked(corner, symmetry)
    places, size = corner.b.shape
    letters = 2**places
    tried = np.cumsum([float(letters) ** k / k for k in range(1, most + 1)])
    most = max(int(np.sum(tried <= MOST_WORDS)), min(most, 1))
    by_laps: list[list[list[int]]] = [[] for _ in range(most)]
    for letter in _lyndon(letters, most):
        word = [(x >> p) & 1 for x in letter for p in reversed(range(places))]
        by_laps[len(letter) - 1].append(word)

    found: list[Cycle] = []
    doubtful: list[Cycle] = []
    singular: list[tuple[int, ...]] = []
    for laps, words in enumerate(map(np.array, by_laps), 1):
        length = places * laps
        step = max(1, CHUNK // (length * (size + 1)) ** 2)
        for part in (words[i : i + step] for i in range(0, len(words), step)):
            points, claims, doubt, bad = _solved(corner, part, rtol)
            clear = np.where(np.abs(claims) > doubt, np.sign(claims), 0)
            agree = ~bad & (clear.max(axis=1) - clear.min(axis=1) <= 1)  # not -1 and 1
            singular += [tuple(word) for word in part[bad].tolist()]
            for i in np.flatnonzero(agree):
                cycle = _cycle(corner, part[i], points[i], claims[i], int(np.sign(clear[i].sum())), rtol)
                (found if clear[i].all() else doubtful).append(cycle)
    if symmetry is not None:
        found = _with_images(found, places)
    return Cycles(tuple(found), tuple(doubtful), tuple(singular), most, sum(map(len, by_laps)))


def corner_kind(cycles: Cycles) -> CornerKind:
    """Names the bifurcation by the number of cycles on each side.

    A Neimark-Sacker bifurcation does not change the numbers of cycles: it is "none", or "multiple crossing".

    **Arguments:**

    - `cycles`: of `find_cycles`.

    **Returns:**

    `CornerKind`.
    """
    below, above = (tuple(c.laps for c in cycles.on(side)) for side in (-1, 1))
    numbers = below.count(1), above.count(1)
    doubles = below.count(2), above.count(2)
    longer = len(below) + len(above) > sum(numbers)
    criticality = None
    if numbers == (1, 1):
        kind = "none"
        if longer:
            kind = "flip" if min(doubles) == 0 < max(doubles) else "multiple crossing"
        if kind == "flip":
            there = cycles.on(1 if doubles[1] else -1)
            criticality = _criticality([c for c in there if c.laps > 1], [c for c in there if c.laps == 1])
    elif sorted(numbers) == [0, 2]:
        kind = "fold-flip" if longer else "fold"
        if any(c.stable for c in cycles.cycles if c.laps > 1):
            criticality = "supercritical"
    else:
        kind = "transcritical" if numbers == (2, 2) else f"{numbers[0]} to {numbers[1]}"
        if sorted(numbers) == [1, 3]:
            three = cycles.on(1 if numbers[1] > numbers[0] else -1, 1)
            pair = [c for c in three if c.image is not None and cycles.cycles[c.image] is not c]
            if len(pair) == 2:
                kind = "symmetry breaking"
                criticality = _criticality(pair, [c for c in three if not any(c is other for other in pair)])
        if any(doubles):
            kind += "-flip"
        elif longer:
            kind += "-multiple crossing"
    return CornerKind(kind, criticality, below, above, not (cycles.doubtful or cycles.singular))


def _criticality(born: Sequence[Cycle], beside: Sequence[Cycle]) -> str | None:
    if any(c.stable for c in born):
        return "supercritical"
    if any(np.isnan(c.multipliers).any() for c in [*born, *beside]):
        return None
    new, old = min(c.unstable for c in born), min(c.unstable for c in beside)
    return None if new == old else "supercritical" if new < old else "subcritical"


def _checked(corner: CornerMap, symmetry: np.ndarray | None) -> CornerMap:
    a, b, e, n, c = (np.asarray(x, np.float64) for x in corner[:5])
    square = np.asarray(corner.square, bool)
    places, size = b.shape
    shapes = [(places, size, size), *[(places, size)] * 3, *[(places,)] * 2]
    if [x.shape for x in (a, b, e, n, c, square)] != shapes:
        raise ValueError("The arrays of a `CornerMap` of m places in n dimensions are (m, n, n), (m, n) and (m,).")
    if not all(np.isfinite(x).all() for x in (a, b, e, n, c)):
        raise ValueError("The arrays of a `CornerMap` must be finite.")
    if symmetry is not None:
        if places % 2 or np.shape(symmetry) != (size, size):
            raise ValueError("`symmetry` is an (n, n) matrix which exchanges an even number of places.")
        j = np.asarray(symmetry, np.float64)
        images = ((j @ a @ j, a), (b @ j.T, b), (e @ j.T, e), (n @ j, n), (c, c), (square * 1.0, square * 1.0))
        far = [
            np.abs(image - np.roll(x, -places // 2, axis=0)).max() > SYMMETRIC * np.abs(x).max() for image, x in images
        ]
        if any(far) or np.abs(j @ j - np.eye(size)).max() > SYMMETRIC:
            raise ValueError("The normal form does not have this symmetry.")
    return CornerMap(a, b, e, n, c, square)


def _lyndon(letters: int, most: int) -> Iterator[tuple[int, ...]]:
    """Words that are no repetition of shorter ones, each the first of its rotations; Duval (1988)."""
    word = [-1]
    while word and most > 0:
        word[-1] += 1
        yield tuple(word)
        size = len(word)
        while len(word) < most:
            word.append(word[-size])
        while word and word[-1] == letters - 1:
            word.pop()


def _solved(corner: CornerMap, words: np.ndarray, rtol: float) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """Of each word the points at ν = 1, what it claims to be positive, the errors of that, and whether it is singular.

    Claims t are g without an event, -g with one, and the duration where a square root is taken: they must all have the
    sign of ν. All points are solved for at once: the product of the maps would lose what contracts to what expands.
    """
    # Linear equations for each itinerary, instead of iterating the map, which would find what is stable only. The signs
    # of t tell whether the itinerary is admissible, for ν > 0 and for ν < 0 by one solution.
    a, b, e, n, c, square = corner
    (count, length), (places, size) = words.shape, b.shape
    unit = size + 1  # unknowns of a place: x, then t
    m, sizes = np.zeros((2, count, length, unit, length, unit))
    r = np.zeros((count, length, unit))
    for i in range(length):
        p, after, event = i % places, (i + 1) % length, words[:, i]
        m[:, i, :size, after, :size] += np.eye(size)
        m[:, i, :size, i, :size] -= a[p]
        m[:, i, :size, i, size] = event[:, None] * (-e[p] if square[p] else e[p])
        m[:, i, size, i, :size] = n[p]
        m[:, i, size, i, size] = event - 1 if square[p] else 2 * event - 1
        sizes[:, i, :, i] = np.abs(m[:, i, :, i])
        sizes[:, i, :size, i, :size] = np.abs(a[p])
        sizes[:, i, :size, after, :size] += np.eye(size)  # after one lap too, where 1 - a may cancel
        r[:, i, :size], r[:, i, size] = b[p], -c[p]
    shape = count, length * unit, length * unit
    m, sizes, r = m.reshape(shape), sizes.reshape(shape), r.reshape(*shape[:2], 1)
    rows = np.maximum(sizes.max(axis=2, keepdims=True), 1e-300)
    columns = np.maximum((sizes / rows).max(axis=1, keepdims=True), 1e-300)
    m, sizes, r = m / rows / columns, sizes / rows / columns, r / rows

    singular = np.linalg.slogdet(m)[0] == 0
    inverse = np.linalg.inv(np.where(singular[:, None, None], np.eye(length * unit), m))
    z = inverse @ r
    z = z + inverse @ (r - m @ z)
    spread = np.abs(inverse)
    # Rounding each entry by less than 1/ρ(|M⁻¹||M|) of it leaves M regular, in whatever units; Rohn (1989).
    v, growth = np.ones_like(z), np.ones((count, 1, 1))
    for _ in range(10):
        v = spread @ (sizes @ v)
        growth = v.max(axis=1, keepdims=True)
        v = v / growth
    singular |= rtol * growth[:, 0, 0] >= 1
    doubt = rtol * spread @ (sizes @ np.abs(z) + np.abs(r))
    z, doubt = ((x / columns.swapaxes(1, 2)).reshape(count, length, unit) for x in (z, doubt))
    return z[..., :size], z[..., size], doubt[..., size], singular


def _cycle(corner: CornerMap, word: np.ndarray, x: np.ndarray, t: np.ndarray, side: int, rtol: float) -> Cycle:
    laps = len(word) // len(corner.c)
    root = np.tile(corner.square, laps) & (word == 1)
    sign = side or 1
    borders = np.where(root, 0.0, sign * np.where(word == 1, -t, t))
    multipliers = _multipliers(corner, word, root, rtol)
    multipliers = multipliers[np.argsort(-np.abs(multipliers), kind="stable")]
    stable = bool(np.all(np.abs(multipliers) < 1))
    durations = np.where(root, sign * t, 0.0)
    return Cycle(side, laps, tuple(word.tolist()), sign * x, borders, durations, multipliers, stable)


def _multipliers(corner: CornerMap, word: np.ndarray, root: np.ndarray, rtol: float) -> np.ndarray:
    a, b, e, n, _, square = corner
    (places, size), length = b.shape, len(word)
    linear = a + (~square)[:, None, None] * e[:, :, None] * n[:, None, :]
    steps = [(linear if event else a)[i % places] for i, event in enumerate(word)]
    events = np.flatnonzero(root)
    total = np.eye(size)
    if len(events) == 0:
        for step in steps:
            total = step @ total
        return np.linalg.eigvals(total).astype(complex)
    # The map of a root is a - e n / (2 √(-g)): next to the corner that holds n·x at zero, at each event by what happens
    # at the one before. What is left of the monodromy has n - 1 dimensions; the last one grows without bounds.
    sign = 1.0
    for here, later in zip(events, [*events[1:], events[0] + length]):
        p, reach = here % places, n[later % places]
        for i in reversed(range(here + 1, later)):
            reach = reach @ steps[i % length]
        effect = reach @ e[p]
        if abs(effect) <= rtol * (np.abs(reach) @ np.abs(e[p])):
            return np.full(size, np.nan, complex)
        sign *= -np.sign(effect)
        total = (a[p] - np.outer(e[p], reach @ a[p]) / effect) @ total
        for i in range(here + 1, later):
            total = steps[i % length] @ total
    free = np.linalg.svd(n[None, events[0] % places])[2][1:]  # orthogonal to n
    return np.append(complex(sign * np.inf, 0.0), np.linalg.eigvals(free @ total @ free.T))


def _with_images(cycles: list[Cycle], places: int) -> list[Cycle]:
    """The symmetry exchanges the halves of laps."""
    numbers = {cycle.word: i for i, cycle in enumerate(cycles)}

    def image(word: tuple[int, ...]) -> tuple[int, ...]:
        starts = range(places // 2, len(word), places)
        return min(word[i:] + word[:i] for i in starts)

    return [cycle._replace(image=numbers.get(image(cycle.word))) for cycle in cycles]
