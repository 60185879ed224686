"""Chaos beside point B of section 6.9 in closed form, up to sums that converge like a geometric series.

Beside B one lap (two periods of the forcing) takes a deviation y = (x, v) from the touching orbit to M y + b ν, where M
belongs to the orbit without stick; a lap that arrives with v > 0 ends in stick, which sets v to 0. All that matters of
M is x's factor with stick, M_11, and the trace and determinant without: v has no unit of its own, and a shift of x makes
b = (0, 1). So the solutions that stick are a map of x alone, piecewise linear: its pieces are the numbers of laps k from
one stick to the next, their slopes (M^k)_11. (With determinant 0 it would be the first return of a tent map.)
"""

from typing import NamedTuple

import numpy as np


class Pieces(NamedTuple):
    """Laps from stick to stick: how many, what small differences grow by, and how often; and the exponent of a lap."""

    laps: np.ndarray
    growths: np.ndarray
    shares: np.ndarray
    exponent: float


class Corner(NamedTuple):
    """The multiplier of the orbit with stick, and the two of that without."""

    stick: float
    slip: tuple[float, float]

    @property
    def matrix(self):
        """M, where v is in units of its own."""
        a, trace, det = self.stick, sum(self.slip), self.slip[0] * self.slip[1]
        return np.array([[a, 1.0], [a * (trace - a) - det, trace - a]])

    def iterated(self, x, v, laps):
        """Lanes of the map itself: whether each lap ends in stick, (laps, lanes)."""
        m, stuck = self.matrix, []
        for _ in range(laps):
            x, v = m[0, 0] * x + m[0, 1] * v, m[1, 0] * x + m[1, 1] * v + 1
            stuck.append(v > 0)
            v = np.minimum(v, 0)
        return np.array(stuck)

    def pieces(self, steps=40) -> Pieces:
        """The invariant measure of the map from stick to stick is constant between the images of the pieces' ends: of
        these so many are taken, of each of which the measure depends by the reciprocal of all the slopes before."""
        m, point, line = self.matrix, np.zeros(2), np.array([1.0, 0.0])
        slopes, shifts, borders = np.zeros((3, 64))
        sides = np.zeros(64)
        for k in range(64):  # after k + 1 laps without stick in between, y = line x + point
            line, point = m @ line, m @ point + [0, 1]
            slopes[k], shifts[k], borders[k], sides[k] = line[0], point[0], -point[1] / line[1], np.sign(line[1])

        def laps(x):
            """The first lap that arrives with v > 0."""
            return np.argmax(sides[:, None] * (np.atleast_1d(x) - borders[:, None]) > 0, axis=0)

        def after(k, x):
            return slopes[k] * x + shifts[k]

        some = [np.array([0.25])]
        for _ in range(1000):
            some.append(after(laps(some[-1]), some[-1]))
        low, high = np.min(some[100:]), np.max(some[100:])
        while True:  # until the ends of the interval are mapped into it
            inner = borders[(borders > low) & (borders < high)]
            ends = np.unique([low, *inner, high])
            k = laps((ends[1:] + ends[:-1]) / 2)
            images = np.concatenate([after(k, ends[1:]), after(k, ends[:-1])])
            if images.min() >= low - 1e-15 and images.max() <= high + 1e-15:
                break
            low, high = min(low, images.min()), max(high, images.max())
        points = [ends, images]
        for _ in range(steps):
            points.append(np.clip(after(laps(points[-1]), points[-1]), low, high))
        ends = np.unique(np.concatenate(points))
        ends = ends[np.append(True, np.diff(ends) > 1e-14)]
        begin, end = ends[:-1], ends[1:]
        k = laps((begin + end) / 2)
        first, last = np.sort([after(k, begin), after(k, end)], axis=0)
        common = np.minimum(last[:, None], end) - np.maximum(first[:, None], begin)
        passed = np.maximum(common, 0) / (last - first)[:, None]
        # What is invariant: mass = mass @ passed.
        equations = np.vstack([passed.T - np.eye(len(k)), np.ones(len(k))])
        mass = np.linalg.lstsq(equations, np.append(np.zeros(len(k)), 1.0))[0]
        found = np.unique(k)
        shares = np.array([mass[k == i].sum() for i in found])
        growths = np.abs(slopes[found])
        return Pieces(found + 1, growths, shares, shares @ np.log(growths) / (shares @ (found + 1)))
