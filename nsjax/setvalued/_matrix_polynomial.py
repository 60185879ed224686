"""Matrix polynomials in q: where they are singular."""

import numpy as np

from .._numerics._linalg import bialternate


DOUBT = 1e3 * float(np.finfo(np.float64).eps)  # relative to the entries of the matrix
GENERIC = np.array([0.61803399, 0.14142136, -0.11803399, 0.90450850, 1.17320508, 0.38196601])


def pencils(a: np.ndarray, b: np.ndarray, circle: bool) -> list[tuple[complex | None, list[np.ndarray]]]:
    """Polynomials in q, as lists of their coefficients, which are singular where an eigenvalue is at the point named
    first, or (at None) where a pair may be on the axis or circle."""
    eye = np.eye(len(a))
    if not circle:
        return [(0j, [a, b]), (None, [2 * bialternate(a, eye), 2 * bialternate(b, eye)])]
    products = [bialternate(a, a) - np.eye(len(a) * (len(a) - 1) // 2), 2 * bialternate(a, b), bialternate(b, b)]
    return [(1 + 0j, [a - eye, b]), (-1 + 0j, [a + eye, b]), (None, products)]


def balanced(a: np.ndarray, b: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
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


def regular(coefficients: list[np.ndarray]) -> tuple[list[np.ndarray], bool]:
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


def singular_places(coefficients: list[np.ndarray]) -> np.ndarray:
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


def polished(coefficients: list[np.ndarray], start: float, reach: float) -> float:
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
