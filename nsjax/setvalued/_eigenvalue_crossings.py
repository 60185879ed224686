"""Set-valued eigenvalues: every place of a generalized Jacobian at which one of them meets the imaginary axis, or of a
generalized monodromy matrix the unit circle; found by algebra, not by sampling."""

from collections.abc import Sequence
from typing import Any, NamedTuple

import numpy as np
from jaxtyping import ArrayLike, Complex, Float

from .._numerics._text import between, shown
from ._crossing import EigenvalueCrossing
from ._pencil import Pencil


@shown
class EigenvalueCurve(NamedTuple):
    """A curve in the square of (q1, q2) on which an eigenvalue is zero, or a pair imaginary: a polyline with exact
    vertices.

    - `kind`: as of `EigenvalueCrossing`.
    - `q`: of shape (points, 2).
    - `eigenvalues`: there, on the axis or circle.
    """

    kind: str
    q: Float[np.ndarray, "points 2"]
    eigenvalues: Complex[np.ndarray, " points"]

    def __str__(self) -> str:
        (a, b), (c, d) = self.q[0], self.q[-1]
        return f"curve, {self.kind}: ({a:.6g}, {b:.6g}) to ({c:.6g}, {d:.6g}), {len(self.q)} points"


@shown
class EigenvalueCurves(NamedTuple):
    """What `eigenvalue_crossings` finds over two surfaces.

    - `curves`: polylines, see `EigenvalueCurve`.
    - `edges`: where the curves meet the edges of the square.
    - `diagonals`: where they meet q1 = q2, and q1 + q2 = 1.
    - `stays`: lines across the square along which an eigenvalue stays on the axis, where that happens not on a curve
        but in an area.
    """

    curves: list[EigenvalueCurve]
    edges: list[EigenvalueCrossing]
    diagonals: tuple[list[EigenvalueCrossing], list[EigenvalueCrossing]]
    stays: list[EigenvalueCrossing]

    def __str__(self) -> str:
        parts = [("edge", self.edges), ("q1 = q2", self.diagonals[0]), ("q1 + q2 = 1", self.diagonals[1])]
        lines = [*map(str, self.curves)] + [f"{name}: {x}" for name, found in parts for x in found]
        lines += [f"eigenvalues stay in an area, along {len(self.stays)} lines"] * bool(self.stays)
        return "\n".join(lines) or "no eigenvalue crosses"


@shown
class EigenvaluePath(NamedTuple):
    """The path of set-valued eigenvalues, for drawing; Figs. 5.2, 5.3, 5.13.

    - `q`: from 0 to 1, closer where eigenvalues move fast, and with every crossing among them.
    - `eigenvalues`: of shape (points, n), a column for each branch.
    - `crossings`: a list of `EigenvalueCrossing`.
    - `multipliers`: whether they are multipliers.
    """

    q: Float[np.ndarray, " points"]
    eigenvalues: Complex[np.ndarray, "points n"]
    crossings: list[EigenvalueCrossing]
    multipliers: bool

    def __str__(self) -> str:
        name = "multipliers" if self.multipliers else "eigenvalues"
        head = f"path of {self.eigenvalues.shape[1]} {name}, q = {between(self.q)}: {len(self.q)} points"
        return "\n".join([head, *(f"  {crossing}" for crossing in self.crossings or ["no crossing"])])


def eigenvalue_crossings(
    j_minus: Float[ArrayLike, "n n"] | Float[ArrayLike, "2 2 n n"],
    j_plus: Float[ArrayLike, "n n"] | None = None,
    *,
    multipliers: bool = False,
    along: Sequence[Sequence[float]] | None = None,
    lines: int = 32,
) -> Any:
    """Every place of a generalized Jacobian at which an eigenvalue meets the imaginary axis: what classifies a
    discontinuous bifurcation (Definition 5.5).

    On one surface, J(q) = J₋ + q (J₊ - J₋) with q in [0, 1], (4.19). Where two meet, (4.21),
    J(q1, q2) = J₋₋ + q1 (J₊₋ - J₋₋) + q2 (J₋₊ - J₋₋).

    They are roots of polynomials in q, found as eigenvalues of matrix pencils and improved by Newton's method: det J(q)
    for an eigenvalue 0, the bialternate sum 2 J(q) ⊙ I for imaginary pairs; for multipliers det(M(q) ∓ 1) and the
    bialternate product M(q) ⊙ M(q) - 1, quadratic in q. Nothing is sampled; that the number of unstable eigenvalues
    changes at roots only is checked. Where a determinant vanishes for every q, the eigenvalues that stay on the axis
    are listed with the intervals on which they do, beside the other crossings.

    **Arguments:**

    - `j_minus`, `j_plus`: the Jacobians on both sides, or the monodromy matrices. Units, and entries of very different
        size, do no harm.
    - For two surfaces, `j_minus` alone: `[[J₋₋, J₋₊], [J₊₋, J₊₊]]`, indexed by the side of the first surface and that
        of the second.
    - `multipliers`: whether the unit circle is meant, not the axis.
    - `along`: two surfaces only: the ends `((q1, q2), (q1, q2))` of a line in the square, to find all crossings along
        it: `((0.3, 0), (0.3, 1))` for all q2 at q1 = 0.3.
    - `lines`: two surfaces only: the number of lines each way across the square with which the curves are drawn.

    **Returns:** for one surface, or along a line, a list of `EigenvalueCrossing` in the order of `q`. For two surfaces
    `EigenvalueCurves`: polylines whose vertices are exact, and exactly where they meet the edges and diagonals of the
    square. (A closed curve smaller than the meshes of the lines is not seen. A curve of pairs ends within a mesh of
    where the pair becomes two zeros.)

    Computed in double precision with NumPy, outside of `jit`. The work grows as n^6: some 10 ms for n = 6, seconds for
    n = 20. A path within rounding (about 1e-12 of the entries, more if ill-conditioned) of the axis touches it: of two
    crossings 1e-6 apart, between which it went no farther, one is reported, with direction 0. Where it crosses with
    speed and curvature zero, `q` is known to about 1e-6.

    **Raises:** `ValueError` where the shapes do not fit, entries are not finite, or J₊₊ ≠ J₊₋ + J₋₊ - J₋₋, which
    (4.20) excludes.
    """
    if j_plus is not None:
        if along is not None:
            raise ValueError("Argument `along` is for two surfaces, but `j_plus` was given: there is one.")
        a, b = _matrices(j_minus, j_plus)
        return Pencil(a, b - a, multipliers).crossings()
    corner, first, second = _vertices(j_minus)
    if along is None:
        return _curves(corner, first, second, multipliers, lines)
    ends = np.asarray(along, np.float64)
    if ends.shape != (2, 2) or ends.min() < 0 or ends.max() > 1:
        raise ValueError(f"Argument `along` must be two points (q1, q2) with both in [0, 1], but is {along}.")
    return _along(corner, first, second, multipliers, ends[0], ends[1])


def eigenvalue_path(
    j_minus: Float[ArrayLike, "n n"],
    j_plus: Float[ArrayLike, "n n"],
    *,
    multipliers: bool = False,
    points: int = 101,
) -> EigenvaluePath:
    """The eigenvalues of J(q) = J₋ + q (J₊ - J₋) for q from 0 to 1 (4.19), matched along q; `plot.eigenvalue_path`
    draws them.

    **Arguments:**

    - `j_minus`, `j_plus`, `multipliers`: as for `eigenvalue_crossings`.
    - `points`: the least number of values of q. There are more where eigenvalues move fast: where they collide and
        leave the real axis.

    **Returns:** an `EigenvaluePath`.

    **Raises:** `ValueError` where the shapes do not fit, or entries are not finite.
    """
    a, b = _matrices(j_minus, j_plus)
    if points < 2:
        raise ValueError(f"Argument `points` must be at least 2, but is {points}.")
    pencil = Pencil(a, b - a, multipliers)
    crossings = pencil.crossings()
    grid = sorted({*np.linspace(0, 1, points).tolist(), *(c.q for c in crossings), *(c.until for c in crossings)})
    seen = np.concatenate([pencil.at(q).values for q in grid])
    extent = max(float(np.ptp(np.real(seen)) + np.ptp(np.imag(seen))), 1e-300)
    qs, rows, rates = [grid[0]], [pencil.at(grid[0]).values], pencil.at(grid[0]).rate
    ahead = grid[:0:-1]
    while ahead:
        step = ahead[-1] - qs[-1]
        now = pencil.at(ahead[-1])
        order, clear = _matched(rows[-1], rates * step, now.values, _visible(rows[-1], extent, multipliers))
        if not clear and step > 1e-7:
            ahead.append(qs[-1] + step / 2)
            continue
        qs.append(ahead.pop())
        rows.append(now.values[order])
        # Where eigenvalues meet, their derivatives cannot be told apart: what they did so far can.
        met = _gaps(rows[-1]) < 1e-6 * extent
        rates = np.where(met, (rows[-1] - rows[-2]) / step, now.rate[order])
    return EigenvaluePath(np.array(qs), np.array(rows, complex), crossings, multipliers)


def _gaps(values: np.ndarray) -> np.ndarray:
    """How far the nearest of the others is."""
    return np.min(np.abs(values[:, None] - values) + np.diag(np.full(len(values), np.inf)), axis=1)


def _visible(values: np.ndarray, extent: float, multipliers: bool) -> np.ndarray:
    """Over which length the path of each is to be smooth: that of the whole, or for multipliers that of the unit
    circle, as they may go far beyond."""
    return np.minimum(extent, 2 + np.abs(values)) if multipliers else np.full(len(values), extent)


def _matched(before: np.ndarray, moves: np.ndarray, after: np.ndarray, extent: np.ndarray) -> tuple[np.ndarray, bool]:
    """Which eigenvalue `after` continues which one `before`, that is expected to move by `moves`; and whether that is
    beyond doubt, or too small to be visible."""
    # Nearest first, not the best assignment of all: where the two differ the match is in doubt, and the caller halves
    # the step. Near a collision derivatives grow without bounds, and the moves that they foretell are left out.
    left = np.abs(np.where(np.abs(moves) < 0.1 * extent, before + moves, before)[:, None] - after)
    order, missed = np.zeros(len(after), int), np.zeros(len(after))
    for _ in range(len(after)):
        i, j = np.unravel_index(np.argmin(left), left.shape)
        order[i], missed[i] = j, left[i, j]
        left[i], left[:, j] = np.inf, np.inf
    moved = np.abs(after[order] - before)
    clear = (missed <= 0.3 * _gaps(after)[order]) & (moved < 0.1 * extent)
    return order, bool(np.all(clear | (moved <= 2e-3 * extent)))


def _matrices(j_minus: ArrayLike, j_plus: ArrayLike) -> tuple[np.ndarray, np.ndarray]:
    a, b = np.asarray(j_minus, np.float64), np.asarray(j_plus, np.float64)
    if a.ndim != 2 or a.shape[0] != a.shape[1] or not len(a):
        raise ValueError(f"Argument `j_minus` must be a square matrix, but has the shape {a.shape}.")
    if b.shape != a.shape:
        raise ValueError(f"Argument `j_plus` must have the shape {a.shape} of `j_minus`, but has {b.shape}.")
    for name, matrix in (("j_minus", a), ("j_plus", b)):
        if not np.all(np.isfinite(matrix)):
            raise ValueError(f"Argument `{name}` must be finite, but is not: an infinite multiplier has no path.")
    return a, b


def _vertices(vertices: Any) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """J₋₋ and the jumps over the first and the second surface."""
    v = np.asarray([[np.asarray(j) for j in row] for row in vertices])
    digits = np.finfo(v.dtype).eps if np.issubdtype(v.dtype, np.floating) else 0.0
    v = v.astype(np.float64)
    if v.ndim != 4 or v.shape[:2] != (2, 2) or v.shape[2] != v.shape[3] or not v.shape[2]:
        raise ValueError(
            "Without `j_plus`, argument `j_minus` must be [[J₋₋, J₋₊], [J₊₋, J₊₊]], four square matrices, but has the "
            f"shape {v.shape}."
        )
    if not np.all(np.isfinite(v)):
        raise ValueError("Argument `j_minus` must be finite, but is not.")
    rest = np.abs(v[0, 0] + v[1, 1] - v[0, 1] - v[1, 0])
    if np.any(rest > 1e4 * digits * np.abs(v).max(axis=(0, 1)) + 1e-300):
        raise ValueError(
            "Argument `j_minus` must have J₊₋ - J₋₋ = J₊₊ - J₋₊, as the Jacobians of a continuous field have where two "
            f"surfaces meet (4.20), but an entry differs by {rest.max():.3g}."
        )
    return v[0, 0], v[1, 0] - v[0, 0], v[0, 1] - v[0, 0]


def _along(
    corner: np.ndarray, first: np.ndarray, second: np.ndarray, circle: bool, start: np.ndarray, stop: np.ndarray
) -> list[EigenvalueCrossing]:
    def place(x: float) -> tuple[float, float]:
        return tuple(((1 - x) * start + x * stop).tolist())

    way = stop - start
    found = Pencil(corner + start[0] * first + start[1] * second, way[0] * first + way[1] * second, circle)
    return [c._replace(q=place(c.q), until=place(c.until)) for c in found.crossings()]


def _curves(corner: np.ndarray, first: np.ndarray, second: np.ndarray, circle: bool, lines: int) -> EigenvalueCurves:
    """Crossings along lines both ways, joined mesh by mesh."""
    if lines < 2:
        raise ValueError(f"Argument `lines` must be at least 2, but is {lines}.")

    def along(*ends: tuple[float, float]) -> list[EigenvalueCrossing]:
        return _along(corner, first, second, circle, *np.array(ends))

    # The inner lines avoid simple fractions: a curve may be a straight line that would coincide with one.
    x = np.array([0.0, *((np.arange(1, lines - 1) + 0.0618034) / (lines - 1)), 1.0])
    rows = [[along((u, 0.0), (u, 1.0)) for u in x], [along((0.0, u), (1.0, u)) for u in x]]
    stays = [c for row in rows for line in row[1:-1] for c in line if c.until != c.q]
    points = [[[c for c in line if c.until == c.q] for line in row] for row in rows]
    pieces: list[tuple[EigenvalueCrossing, EigenvalueCrossing]] = []
    for i in range(len(x) - 1):
        for j in range(len(x) - 1):
            # The four sides of a mesh.
            sides = [c for line in points[0][i : i + 2] for c in line if x[j] <= c.q[1] <= x[j + 1]]
            sides += [c for line in points[1][j : j + 2] for c in line if x[i] <= c.q[0] <= x[i + 1]]
            pieces += _joined(sides)
    edges = [c for row in rows for line in (row[0], row[-1]) for c in line]
    filled = {c.kind for c in stays}
    for c in edges:
        if c.until != c.q and c.kind not in filled:
            pieces.append((c, c._replace(q=c.until)))
    unique = {tuple(np.round([*c.q, *c.until], 12)) + (c.kind,): c for c in edges}
    diagonals = along((0.0, 0.0), (1.0, 1.0)), along((0.0, 1.0), (1.0, 0.0))
    return EigenvalueCurves(_chained(pieces), list(unique.values()), diagonals, stays)


def _joined(sides: list[EigenvalueCrossing]) -> list[tuple[EigenvalueCrossing, EigenvalueCrossing]]:
    """The points at which curves enter and leave a mesh, in pairs: those that are nearest, their eigenvalues too."""
    out = []
    for kind in dict.fromkeys(c.kind for c in sides):
        left = list({(*np.round(c.q, 12), np.round(c.eigenvalue, 9)): c for c in sides if c.kind == kind}.values())
        size = max([abs(c.eigenvalue) for c in left] + [1e-300])
        while len(left) > 1:
            costs = {
                (i, j): np.hypot(*np.subtract(left[i].q, left[j].q))
                + abs(left[i].eigenvalue - left[j].eigenvalue) / size
                for i in range(len(left))
                for j in range(i)
            }
            i, j = min(costs, key=lambda pair: costs[pair])
            out.append((left.pop(i), left.pop(j)))
    return out


def _chained(pieces: list[tuple[EigenvalueCrossing, EigenvalueCrossing]]) -> list[EigenvalueCurve]:
    """Polylines from their pieces."""

    def key(c: EigenvalueCrossing) -> tuple:
        return (c.kind, *np.round(c.q, 9))

    at: dict[tuple, EigenvalueCrossing] = {}
    joins: dict[tuple, list[tuple]] = {}
    for a, b in pieces:
        if key(a) != key(b) and key(b) not in joins.get(key(a), []):
            at |= {key(a): a, key(b): b}
            joins.setdefault(key(a), []).append(key(b))
            joins.setdefault(key(b), []).append(key(a))
    curves = []
    # From the ends of curves first; what is left then is closed.
    for start in sorted(joins, key=lambda k: len(joins[k]) != 1):
        while joins[start]:
            chain = [start]
            while joins[chain[-1]]:
                here, there = chain[-1], joins[chain[-1]].pop()
                joins[there].remove(here)
                chain.append(there)
            q = np.array([at[k].q for k in chain])
            curves.append(EigenvalueCurve(chain[0][0], q, np.array([at[k].eigenvalue for k in chain])))
    return curves
