"""Matrix pencils A + q B: every q at which an eigenvalue meets the imaginary axis, or the unit circle, by algebra."""

from collections.abc import Iterable
from typing import Any, NamedTuple

import numpy as np

from .._numerics._text import shown


BEYOND = 0.25  # roots this far outside [0, 1] are known too, so that an end point has a before and an after
NEARLY_REAL = 1e-3  # a root of multiplicity m comes out as m complex ones, about eps^(1/m) apart
DOUBT = 1e3 * float(np.finfo(np.float64).eps)  # relative to the entries of the matrix
GENERIC = np.array([0.61803399, 0.14142136, -0.11803399, 0.90450850, 1.17320508, 0.38196601])


@shown
class EigenvalueCrossing(NamedTuple):
    """A place at which an eigenvalue meets the imaginary axis, or a multiplier the unit circle.

    - `q`: where: a number in [0, 1], or `(q1, q2)` where two surfaces meet.
    - `eigenvalue`: exactly on the axis or circle. Of a complex pair, which counts as one crossing, that with the
        positive imaginary part.
    - `multiplicity`: algebraic, of this eigenvalue at `q`.
    - `direction`: +1 if there are more unstable eigenvalues after `q` than before, -1 if fewer, 0 if as many: the path
        touches the axis, or one crosses each way.
    - `unstable`: how many eigenvalues (both of a pair) lie right of the axis, or outside the circle, before and after.
    - `until`: `q` itself; or, for an eigenvalue that stays on the axis (a free motion, an undamped oscillation, the
        trivial multiplier 1), where that ends. Then `eigenvalue` is one on the way, and `direction` and `unstable` tell
        what happens where it arrives on the axis and where it leaves.
    """

    q: Any
    eigenvalue: complex
    multiplicity: int
    direction: int
    unstable: tuple[int, int]
    until: Any

    @property
    def kind(self) -> str:
        """ "zero" or "pair", of multipliers "+1", "-1" or "pair"."""
        names: dict[complex, str] = {0j: "zero", 1 + 0j: "+1", -1 + 0j: "-1"}
        return names.get(self.eigenvalue, "pair")

    def __str__(self) -> str:
        def place(q: Any) -> str:
            return f"({q[0]:.10g}, {q[1]:.10g})" if isinstance(q, tuple) else f"{q:.10g}"

        where = place(self.q) + (f" to {place(self.until)}" if self.until != self.q else "")
        z, pair = self.eigenvalue, self.kind == "pair"
        value = f"{'' if z.real == 0 else f'{z.real:.10g} '}±{'' if z.real == 0 else ' '}{z.imag:.10g}i"
        times = f" ({self.multiplicity} times)" if self.multiplicity > 1 else ""
        value = value if pair else f"{z.real:.10g}"
        return f"q = {where}: eigenvalue {value}{times}, unstable {self.unstable[0]} -> {self.unstable[1]}"


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


def bialternate(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    """The bialternate product A ⊙ B. Sums of two eigenvalues of A are the eigenvalues of 2 A ⊙ I, their products those
    of A ⊙ A (half the Kronecker sum and product, without what is there twice); Guckenheimer, Myers & Sturmfels (1997).
    """
    i, j = np.triu_indices(len(a), 1)

    def minors(a: np.ndarray, b: np.ndarray) -> np.ndarray:
        return a[np.ix_(i, i)] * b[np.ix_(j, j)] - a[np.ix_(i, j)] * b[np.ix_(j, i)]

    return (minors(a, b) + minors(b, a)) / 2


def _pencils(a: np.ndarray, b: np.ndarray, circle: bool) -> list[tuple[complex | None, list[np.ndarray]]]:
    """Polynomials in q, as lists of their coefficients, which are singular where an eigenvalue is at the point named
    first, or (at None) where a pair may be on the axis or circle."""
    eye = np.eye(len(a))
    if not circle:
        return [(0j, [a, b]), (None, [2 * bialternate(a, eye), 2 * bialternate(b, eye)])]
    products = [bialternate(a, a) - np.eye(len(a) * (len(a) - 1) // 2), 2 * bialternate(a, b), bialternate(b, b)]
    return [(1 + 0j, [a - eye, b]), (-1 + 0j, [a + eye, b]), (None, products)]


def _balanced(a: np.ndarray, b: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Both in units (powers of two, for no rounding) in which rows are as large as columns; Osborne's iteration."""
    a, b = a.copy(), b.copy()
    for _ in range(20):
        still = True
        for i in range(len(a)):
            size = np.abs(a) + np.abs(b)
            row, column = size[i].sum() - size[i, i], size[:, i].sum() - size[i, i]
            power = np.round(0.5 * np.log2(row / column)) if row > 0 and column > 0 else 0.0
            if power:
                still = False
                for matrix in (a, b):
                    matrix[i] *= 2.0**-power
                    matrix[:, i] *= 2.0**power
        if still:
            break
    return a, b


def _polynomial(coefficients: list[np.ndarray], q: float) -> np.ndarray:
    return sum((c * q**k for k, c in enumerate(coefficients)), np.zeros_like(coefficients[0]))


def _scaled(coefficients: list[np.ndarray]) -> list[np.ndarray]:
    """The same with rows and columns of one size, which leaves its roots where they are."""
    for _ in range(3):
        for axis in (0, 1):
            size = np.abs(coefficients).sum(axis=0).max(axis=axis, keepdims=True)
            size = 2.0 ** -np.round(np.log2(np.where(size > 0, size, 1)))
            coefficients = [c * size for c in coefficients]
    return coefficients


def _regular(coefficients: list[np.ndarray]) -> tuple[list[np.ndarray], bool]:
    """A polynomial that is not singular for every q, and whether it was.

    Where it was, it loses rank at the roots that are left, and so does its projection to random subspaces, whose other
    roots mean nothing; Hochstenbach, Mehl & Plestenjak (2023).
    """
    coefficients = _scaled(coefficients)
    n = len(coefficients[0])
    rank = 0
    for q in GENERIC:
        sizes = np.linalg.svd(_polynomial(coefficients, q), compute_uv=False)
        rank = max(rank, int(np.sum(sizes > DOUBT * sizes[0])))
        if rank == n:
            return coefficients, False
    rng = np.random.default_rng(0)
    u, v = (np.linalg.qr(rng.standard_normal((n, n)))[0][:, :rank] for _ in "uv")
    return [u.T @ c @ v for c in coefficients], True


def _roots(coefficients: list[np.ndarray]) -> np.ndarray:
    """Every q, complex too, at which the polynomial is singular: a generalized eigenvalue problem, of the companion
    form if it is quadratic, shifted to where it is best conditioned."""
    n = len(coefficients[0])
    if n == 0:
        return np.zeros(0, complex)
    if len(coefficients) == 2:
        constant, linear = coefficients
    else:
        zero, eye = np.zeros((n, n)), np.eye(n)
        constant = np.block([[coefficients[0], coefficients[1]], [zero, -eye]])
        linear = np.block([[zero, coefficients[2]], [eye, zero]])
    with np.errstate(all="ignore"):
        shift = min(GENERIC[:3], key=lambda q: np.nan_to_num(np.linalg.cond(constant + q * linear), nan=np.inf))
        try:
            return shift - 1 / np.linalg.eigvals(np.linalg.solve(constant + shift * linear, linear)).astype(complex)
        except np.linalg.LinAlgError:
            return np.zeros(0, complex)


def _polished(coefficients: list[np.ndarray], start: float, reach: float) -> float:
    """Newton's method on the determinant, from a root that is known to some digits: q - 1 / tr(P⁻¹ P')."""
    slope = [k * c for k, c in enumerate(coefficients)][1:]
    q = start
    for _ in range(6):
        try:
            trace = np.trace(np.linalg.solve(_polynomial(coefficients, q), _polynomial(slope, q)))
        except np.linalg.LinAlgError:  # a root to the last digit
            return q
        if not np.isfinite(trace) or trace == 0 or abs(q - 1 / trace - start) > reach:
            return start
        q -= 1 / trace
        if abs(trace) > 1e16:
            break
    return float(q)


class _Candidate(NamedTuple):
    q: float
    root: float  # as the eigenvalue problem gave it
    point: complex | None  # the point of the axis it is for, None for a pair
    weight: int  # roots that are one


class Pencil:
    """A + q B, and its crossings for q in [0, 1]."""

    def __init__(self, a: np.ndarray, b: np.ndarray, circle: bool):
        self.a, self.b = _balanced(a, b)
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
        for point, polynomial in _pencils(self.a, self.b, self.circle):
            if not len(polynomial[0]):
                continue
            polynomial, singular = _regular(polynomial)
            self.stays |= singular
            roots = _roots(polynomial)
            if singular and point is None:
                roots = np.append(roots, self._collisions())
            with np.errstate(invalid="ignore"):
                roots = roots[(np.abs(np.imag(roots)) < NEARLY_REAL) & (np.abs(np.real(roots) - 0.5) < 0.5 + BEYOND)]
            for root in roots[np.imag(roots) >= 0]:
                real = root.imag == 0
                others = np.abs(root - roots[roots != root])
                reach = min(NEARLY_REAL, 0.3 * others.min(initial=1.0))  # not to another root
                q = _polished(polynomial, root.real, reach) if real else float(root.real)
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
