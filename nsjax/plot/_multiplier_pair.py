"""Pairs of multipliers between the computed points of a branch, where two that are complex become real."""

import itertools
from collections.abc import Iterator, Sequence

import numpy as np
from jaxtyping import Complex, Float, Int


SAMPLES = 16  # between two computed points, or one and the place where a pair splits
# Of the square of a multiplier: two that are zero, as where an orbit sticks, may be a pair by rounding.
ROUNDING = 1e-12
REAL = 1e-9  # is what has no larger imaginary part
CLOSE = 1e-6  # to each other are two of four points, over the others, through which no cubic is drawn


def with_splits(
    x: Float[np.ndarray, " points"], rows: Complex[np.ndarray, "points n"], kinds: Int[np.ndarray, " points"]
) -> tuple[Float[np.ndarray, " more"], Complex[np.ndarray, "more n"], Int[np.ndarray, " more"]]:
    """Puts points in where a complex pair becomes two real multipliers: as a square root does, with a vertical tangent,
    so that a straight line between computed points has an angle where there is none. Trace and determinant of the pair
    are smooth there, also where the parameter turns back at a fold: cubics through four points.

    **Arguments:**

    - `x`, `rows`, `kinds`: parameter, multipliers and line style of the points between two corners; each multiplier
        keeps its column.

    **Returns:** the same, with more points.
    """
    splits: dict[int, set[tuple[int, int]]] = {}
    for pair in itertools.combinations(range(rows.shape[1]), 2):
        for i in _splits(rows[:, pair]):
            for interval in range(max(i - 1, 0), min(i + 2, len(x) - 1)):  # beside it the line is steep too
                splits.setdefault(interval, set()).add(pair)
    for i in sorted(splits, reverse=True):
        new_x, new_rows = _between(x, rows, i, sorted(splits[i]))
        place = i + 1
        x, rows = np.insert(x, place, new_x), np.insert(rows, place, new_rows, axis=0)
        kinds = np.insert(kinds, place, np.full(len(new_x), kinds[i]))
    return x, rows, kinds


def _splits(pair: Complex[np.ndarray, "points 2"]) -> Iterator[int]:
    """After which points two multipliers change from complex to real, or back."""
    good = _conjugate(pair)
    a, b = np.where(good[:, None], pair, 0.0).T
    gap = np.real((a - b) ** 2)
    large = np.abs(gap) > ROUNDING * np.maximum(np.abs(a * b), 1.0)
    for i in range(len(pair) - 1):
        if good[i : i + 2].all() and large[i : i + 2].any() and (gap[i] < 0) != (gap[i + 1] < 0):
            yield i


def _conjugate(pair: Complex[np.ndarray, "points 2"]) -> np.ndarray:
    """Whether two are finite, and both real or conjugate to each other."""
    good = np.isfinite(pair[:, 0]) & np.isfinite(pair[:, 1])
    a, b = np.where(good[:, None], pair, 0.0).T
    return good & (np.abs(np.imag(a + b)) + np.abs(np.imag(a * b)) <= REAL * (1 + np.abs(a * b)))


def _between(
    x: np.ndarray, rows: np.ndarray, i: int, pairs: Sequence[tuple[int, int]]
) -> tuple[np.ndarray, np.ndarray]:
    """Parameter and multipliers between the points `i` and `i + 1`; none where these cannot be told."""
    nothing = x[:0], rows[:0]
    good = np.logical_and.reduce([_conjugate(rows[:, pair]) for pair in pairs])
    if not good[i : i + 2].all():
        return nothing
    near = _window(good, i)
    smooth = np.array(
        [x[near]] + [np.real(f(rows[near][:, pair], axis=1)) for pair in pairs for f in (np.sum, np.prod)]
    )
    # Over that of them that goes most evenly one way, which at a fold is not the parameter.
    steps = np.diff(smooth) * np.sign(smooth[:, -1:] - smooth[:, :1])
    steps = max(steps, key=lambda own: np.min(own) / max(np.max(own), np.finfo(float).tiny))
    if np.min(steps) <= CLOSE * np.max(steps):
        return nothing
    at = np.append(0.0, np.cumsum(steps))
    at = (at - at[i - near.start]) / steps[i - near.start]  # 0 and 1 at the two points
    parameter, *coefficients = np.polyfit(at, smooth.T, len(at) - 1).T
    traces, products = coefficients[::2], coefficients[1::2]
    gaps = [np.polysub(np.polymul(trace, trace), 4 * product) for trace, product in zip(traces, products)]
    roots = [[z.real for z in np.roots(gap) if abs(z.imag) < REAL and 0 < z.real < 1] for gap in gaps]
    ends = np.unique([0.0, 1.0, *itertools.chain(*roots)])
    # Closer towards both ends of each part, as a square root needs it.
    share = (1 - np.cos(np.pi * np.arange(SAMPLES) / SAMPLES)) / 2
    u = (ends[:-1, None] + np.diff(ends)[:, None] * share).ravel()[1:]
    begin, end = (np.where(np.isfinite(rows[i] + rows[i + 1]), row, 0.0) for row in rows[i : i + 2])
    out = np.where(np.isfinite(rows[i] + rows[i + 1]), begin + u[:, None] * (end - begin), rows[i])
    for (j, k), trace, gap, own in zip(pairs, traces, gaps, roots):
        before, after = (_sign(rows[row, j] - rows[row, k]) for row in (i, i + 1))
        if not own and before != after:
            return nothing
        # Up to a split each column is what it is at the point before, and then at the one after.
        half, root = np.polyval(trace, u) / 2, np.sqrt(np.polyval(gap, u).astype(complex)) / 2
        root = np.where(u < min(own, default=1.0), before, after) * root
        out[:, j], out[:, k] = half + root, half - root
    return np.polyval(parameter, u), out


def _window(good: np.ndarray, i: int) -> slice:
    """Four points around the interval after `i`, or as many as there are."""
    start, stop = i, i + 2
    while stop - start < 4:
        left, right = start > 0 and good[start - 1], stop < len(good) and good[stop]
        if left and (i - start <= stop - i - 2 or not right):
            start -= 1
        elif right:
            stop += 1
        else:
            break
    return slice(start, stop)


def _sign(difference: complex) -> int:
    """Of the square root that has half of it."""
    return 1 if (difference.real or difference.imag) >= 0 else -1
