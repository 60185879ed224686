"""Matrix pencils A + q B: every q at which an eigenvalue meets the imaginary axis, or the unit circle, by algebra."""

from collections.abc import Iterable
from typing import NamedTuple

import numpy as np

from ._crossing import EigenvalueCrossing
from ._matrix_polynomial import balanced, DOUBT, GENERIC, pencils, polished, regular, singular_places


BEYOND = 0.25  # roots this far outside [0, 1] are known too, so that an end point has a before and an after
NEARLY_REAL = 1e-3  # a root of multiplicity m comes out as m complex ones, about eps^(1/m) apart


class _Spectrum(NamedTuple):
    """Eigenvalues of A + q B, and for each how far it is on the unstable side, the first two derivatives of that with
    respect to q, and the radius within which rounding leaves it in doubt."""

    values: np.ndarray
    side: np.ndarray
    slope: np.ndarray
    bend: np.ndarray
    doubt: np.ndarray
    rate: np.ndarray  # dλ/dq


def _spectrum(a: np.ndarray, b: np.ndarray, q: float, circle: bool) -> _Spectrum:
    matrix = a + q * b
    values, right = np.linalg.eig(matrix)
    try:
        left = np.linalg.inv(right)
    except np.linalg.LinAlgError:  # defective to the last digit
        left = np.linalg.pinv(right, rcond=1e-300)
    with np.errstate(all="ignore"):
        # What relative errors of the entries do, to first order: it knows of scales, and of nearly defective ones. An
        # error of q, and cancellation, are smaller than those of the eigenvalue problem.
        errors = np.abs(matrix) + (np.abs(a) + np.abs(b)) / 20
        doubt = DOUBT * np.einsum("ij,jk,ki->i", np.abs(left), errors, np.abs(right))
        doubt = np.fmin(doubt, 1e-5 * np.linalg.norm(np.abs(a) + np.abs(b)))
        moves = left @ b @ right
        first = np.diag(moves)
        gaps = values[:, None] - values
        second = 2 * np.nansum(np.where(gaps == 0, 0, moves * moves.T / gaps), axis=1)
        if not circle:
            return _Spectrum(values, np.real(values), np.real(first), np.real(second), doubt, first)
        size = np.abs(values)
        side, slope = (size**2 - 1) / 2, np.real(np.conj(values) * first)
        bend = np.abs(first) ** 2 + np.real(np.conj(values) * second)
        return _Spectrum(values, side, slope, bend, doubt, first)


class _Candidate(NamedTuple):
    q: float
    root: float  # as the eigenvalue problem gave it
    point: complex | None  # the point of the axis it is for, None for a pair
    weight: int  # roots that are one


class Pencil:
    """A + q B, and its crossings for q in [0, 1]."""

    def __init__(self, a: np.ndarray, b: np.ndarray, circle: bool):
        self.a, self.b = balanced(a, b)
        self.circle, self.stays = circle, False
        self.known: dict[float, _Spectrum] = {}

    def at(self, q: float) -> _Spectrum:
        if q not in self.known:
            self.known[q] = _spectrum(self.a, self.b, q, self.circle)
        return self.known[q]

    def points(self) -> list[complex | None]:
        return [1 + 0j, -1 + 0j, None] if self.circle else [0j, None]

    def on(self, q: float, point: complex | None) -> np.ndarray:
        """Which eigenvalues are at `point`; for None, on the axis elsewhere, with a positive imaginary part."""
        s = self.at(q)
        if point is not None:
            return np.abs(s.values - point) <= s.doubt
        return (np.abs(s.side) <= s.doubt) & (np.imag(s.values) > s.doubt)

    def counts(self, q: float) -> tuple[int, ...]:
        """Unstable eigenvalues, and those on the axis if some are there for a while."""
        s = self.at(q)
        if not self.stays:
            return (int(np.sum(s.side > 0)),)
        return (int(np.sum(s.side > s.doubt)), *(int(self.on(q, p).sum()) for p in self.points()))

    def candidates(self) -> list[_Candidate]:
        found = []
        for point, polynomial in pencils(self.a, self.b, self.circle):
            if not len(polynomial[0]):
                continue
            polynomial, singular = regular(polynomial)
            self.stays |= singular
            roots = singular_places(polynomial)
            if singular and point is None:
                roots = np.append(roots, self._collisions())
            with np.errstate(invalid="ignore"):
                roots = roots[(np.abs(np.imag(roots)) < NEARLY_REAL) & (np.abs(np.real(roots) - 0.5) < 0.5 + BEYOND)]
            for root in roots[np.imag(roots) >= 0]:
                real = root.imag == 0
                others = np.abs(root - roots[roots != root])
                reach = min(NEARLY_REAL, 0.3 * others.min(initial=1.0))  # not to another root
                q = polished(polynomial, root.real, reach) if real else float(root.real)
                found.append(_Candidate(q, float(root.real), point, 1 if real else 2))
        return sorted(found, key=lambda c: c.q)

    def _collisions(self) -> np.ndarray:
        """Where eigenvalues that stay on the axis meet others, to leave it in a quadruple: there the first coefficient
        of the characteristic polynomial of the sums (products) that is not zero for every q has a root."""

        def terms(q: float) -> tuple[np.ndarray, int]:
            s, (i, j) = self.at(q), np.triu_indices(len(self.a), 1)
            size = np.abs(s.values)
            if self.circle:
                value, doubt = s.values[i] * s.values[j] - 1, size[i] * s.doubt[j] + size[j] * s.doubt[i]
            else:
                value, doubt = s.values[i] + s.values[j], s.doubt[i] + s.doubt[j]
            return value[np.argsort(np.abs(value))], int(np.sum(np.abs(value) <= doubt))

        zeros = min(terms(q)[1] for q in GENERIC)
        degree = (len(self.a) * (len(self.a) - 1) // 2 - zeros) * (2 if self.circle else 1)
        if degree == 0:
            return np.zeros(0, complex)
        grid = np.cos(np.pi * (np.arange(degree + 1) + 0.5) / (degree + 1))
        with np.errstate(all="ignore"):
            rest = [terms(0.5 + (0.5 + BEYOND) * x)[0][zeros:] for x in grid]
            size = max(np.sum(np.log(np.abs(r))) for r in rest)
            values = [np.real(np.prod(r / np.exp(size / len(r)))) for r in rest]
        if not np.all(np.isfinite(values)):
            return np.zeros(0, complex)
        fit = np.polynomial.chebyshev.chebfit(grid, values, degree)
        fit = np.polynomial.chebyshev.chebtrim(fit, 1e-13 * np.abs(fit).max())
        return 0.5 + (0.5 + BEYOND) * np.polynomial.chebyshev.chebroots(fit).astype(complex)

    def together(self, p: float, q: float) -> bool:
        """Whether two roots cannot be told apart: halfway an eigenvalue is on the axis as well (one more than at some
        distance, where some stay on it)."""
        if q - p < 1e-13 or q - p > NEARLY_REAL:
            return q - p < 1e-13

        def on(q: float) -> int:
            s = self.at(q)
            # One as near to a defective eigenvalue as the root of rounding, which parts that, belongs to it: the roots
            # of sums with it are as far from the crossing.
            cloud = np.minimum(s.doubt, np.sqrt(DOUBT) * np.linalg.norm(np.abs(self.a) + np.abs(self.b)))
            near = np.abs(s.values[:, None] - s.values) <= cloud
            doubt = np.maximum(s.doubt, np.max(np.where(near, cloud, 0), axis=1))
            return int(np.sum(np.abs(s.side) <= doubt))

        return on((p + q) / 2) > (max(on(p - NEARLY_REAL), on(q + NEARLY_REAL)) if self.stays else 0)

    def groups(self) -> list[list[_Candidate]]:
        groups: list[list[_Candidate]] = []
        for c in self.candidates():
            if groups and self.together(groups[-1][-1].q, c.q):
                groups[-1].append(c)
            else:
                groups.append([c])
        firsts, lasts = [g[0].q for g in groups], [g[-1].q for g in groups]
        rooms = [
            min(p - before, after - q) for before, p, q, after in zip([-1.0, *lasts], firsts, lasts, [*firsts[1:], 2.0])
        ]
        return [list(self._merged(group, min(1e-5, 0.3 * room))) for group, room in zip(groups, rooms)]

    def _merged(self, group: list[_Candidate], reach: float) -> Iterable[_Candidate]:
        """One candidate for each point of the axis, at the mean, which rounding moves far less than it parts them."""
        for point in dict.fromkeys(c.point for c in group):
            same = [c for c in group if c.point == point]
            weight = sum(c.weight for c in same)
            q = same[0].q if weight == 1 else sum(c.root * c.weight for c in same) / weight
            yield _Candidate(self._refined(q, point, weight, reach), q, point, weight)

    def _refined(self, q: float, point: complex | None, weight: int, reach: float) -> float:
        """Newton's method on the eigenvalue, if it is simple: to where it is on the axis, or where it touches it."""
        # The eigenvalue has more digits than the root of a determinant. Not where several meet: their derivatives are
        # infinite there, and the mean of the roots is better.
        for _ in range(0 if self.stays else 3):  # one that stays there has no such place
            s = self.at(q)
            i = int(np.argmin(self._away(q, point)))
            top, bottom = (s.slope[i], s.bend[i]) if weight == 2 else (s.side[i], s.slope[i])
            alone = np.sum(np.abs(s.values - s.values[i]) <= 1e-6 * np.abs(s.values).max()) == 1
            crowd = np.sum(self.on(q, point)) > 1
            with np.errstate(all="ignore"):
                step = top / bottom
            if weight > 2 or not alone or crowd or not abs(step) < reach:
                break
            q = float(q - step)
        return q

    def crossings(self) -> list[EigenvalueCrossing]:
        groups = self._complete(self.groups())
        ends = [-BEYOND, *(g[0].q for g in groups), 1 + BEYOND]
        starts = [-BEYOND, *(g[-1].q for g in groups), 1 + BEYOND]
        middles = [(p + q) / 2 for p, q in zip(starts, ends[1:])]
        out = self._stretches(starts, ends, middles) if self.stays else []
        for k, group in enumerate(groups):
            out += self._at_group(group, self.counts(middles[k]), self.counts(middles[k + 1]))
        return sorted(out, key=lambda c: (c.q, abs(c.eigenvalue)))

    def _complete(self, groups: list[list[_Candidate]]) -> list[list[_Candidate]]:
        """Between two roots nothing changes. Where rounding lost one and something does, bisection finds it."""
        # The matrices for pairs have n (n - 1) / 2 rows and are worse conditioned than A + q B: a root of theirs may
        # leave the real axis by more than `NEARLY_REAL`. How many eigenvalues are unstable does not depend on them.
        for _ in range(4 * len(self.a) ** 2):
            places = [-BEYOND, *(g[0].q for g in groups), 1 + BEYOND]
            lost = None
            for left, right in zip([-BEYOND, *(g[-1].q for g in groups)], places[1:]):
                probes = [left + x * (right - left) for x in (0.25, 0.5, 0.75)]
                for p, q in zip(probes, probes[1:]):
                    if self.counts(p) != self.counts(q) and right - left > 1e-12:
                        lost = p, q
            if lost is None:
                break
            p, q = lost
            before = self.counts(p)
            while p < (p + q) / 2 < q and q - p > 1e-16:
                middle = (p + q) / 2
                p, q = (middle, q) if self.counts(middle) == before else (p, middle)
            s = self.at(q)
            value = s.values[np.argmin(np.abs(s.side) / np.maximum(s.doubt, 1e-300))]
            point = min((x for x in self.points() if x is not None), key=lambda x: abs(x - value))
            point = point if abs(np.imag(value)) <= 1e-6 * np.abs(s.values).max() else None
            groups = sorted([*groups, [_Candidate(q, q, point, 1)]], key=lambda g: g[0].q)
        return groups

    def _at_group(self, group: list[_Candidate], before: tuple, after: tuple) -> list[EigenvalueCrossing]:
        seen = []
        for c in group:
            # Rounding may put a crossing at an end point outside.
            q = min(max(c.q, 0.0), 1.0)
            if abs(q - c.q) < 1e-9:
                mask = self.on(q, c.point)
                k = self.points().index(c.point) + 1
                staying = max(before[k], after[k]) if self.stays else 0
                if mask.sum() > staying or (self.stays and before != after and mask.any()):
                    seen.append((q, c.point, mask))
        if not seen and before[0] != after[0]:
            # It crosses, and the root is not known well enough to see it on the axis: the nearest is the one.
            best = min(group, key=lambda c: self._away(c.q, c.point).min())
            if 0 <= best.q <= 1:
                away = self._away(best.q, best.point)
                seen.append((best.q, best.point, away <= 2 * away.min()))
        out = []
        for q, point, mask in seen:
            s = self.at(q)
            for those in self._distinct(s, mask):
                change = after[0] - before[0]
                if len(seen) > 1 or len(those) < mask.sum():
                    slope = s.slope[those]
                    change = int(np.sum(np.where(np.abs(slope) > DOUBT * np.abs(self.b).max(), np.sign(slope), 0)))
                value = self._onto(np.mean(s.values[those]), point)
                unstable = before[0], after[0]
                out.append(EigenvalueCrossing(q, value, len(those), int(np.sign(change)), unstable, q))
        return out

    def _away(self, q: float, point: complex | None) -> np.ndarray:
        s = self.at(q)
        return (
            np.abs(s.values - point) if point is not None else np.where(np.imag(s.values) > 0, np.abs(s.side), np.inf)
        )

    def _onto(self, value: complex, point: complex | None) -> complex:
        if point is not None:
            return point
        return complex(value / abs(value)) if self.circle else complex(0, value.imag)

    def _distinct(self, s: _Spectrum, mask: np.ndarray) -> list[np.ndarray]:
        """The eigenvalues of a mask, those together that are one."""
        left, out = list(np.flatnonzero(mask)), []
        while left:
            i = left[0]
            same = [j for j in left if abs(s.values[i] - s.values[j]) <= s.doubt[i] + s.doubt[j] or len(left) == 1]
            out.append(np.array(same))
            left = [j for j in left if j not in same]
        return out

    def _stretches(self, starts: list[float], ends: list[float], middles: list[float]) -> list[EigenvalueCrossing]:
        """Intervals on which an eigenvalue stays on the axis."""
        pieces = [(max(p, 0.0), min(q, 1.0), self.counts(m), m) for p, q, m in zip(starts, ends[1:], middles)]
        runs: list[list] = []
        for p, q, counts, m in pieces:
            if q - p <= 1e-9:
                continue
            if runs and runs[-1][2][1:] == counts[1:]:
                runs[-1][1] = q
                runs[-1][3].append((q - p, m))
            else:
                runs.append([p, q, counts, [(q - p, m)]])
        out = []
        for k, (p, q, _, inside) in enumerate(runs):
            probe = max(inside)[1]
            first, last = self.counts(inside[0][1])[0], self.counts(inside[-1][1])[0]
            before = self.counts(runs[k - 1][3][-1][1])[0] if k > 0 else first
            after = self.counts(runs[k + 1][3][0][1])[0] if k + 1 < len(runs) else last
            sign = int(np.sign(first - before + after - last))  # by what happens at its ends
            half = self.at(probe)
            for point in self.points():
                for those in self._distinct(half, self.on(probe, point)):
                    value = self._onto(np.mean(half.values[those]), point)
                    out.append(EigenvalueCrossing(p, value, len(those), sign, (before, after), q))
        return out
