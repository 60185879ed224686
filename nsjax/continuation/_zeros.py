"""Zeros of test functions at which the equations of a curve are singular: known from points beside them."""

from collections.abc import Callable
from typing import Any, Generic, NamedTuple, TypeVar

import numpy as np


P = TypeVar("P")
FAILED = (ArithmeticError, KeyError, np.linalg.LinAlgError)  # where a point, or what is asked of it, is not found
SHARES = (-1.0, -0.75, -0.5, -0.25, 0.25, 0.5, 0.75, 1.0)
FEWEST = 4  # points for a polynomial: those of one side


class Interpolated(NamedTuple, Generic[P]):
    """A zero at the distance `s`: what there is at it is the sum of what the points have, with these weights."""

    s: float
    weights: np.ndarray
    points: list[P]

    def at(self, read: Callable[[P], Any]) -> np.ndarray:
        return np.tensordot(self.weights, np.stack([read(point) for point in self.points]), axes=1)


def interpolated(
    s: float, reach: float, at: Callable[[float], P | None], value: Callable[[P], float]
) -> Interpolated[P]:
    """The zero of a test function nearest to `s`, by the polynomial through points of the curve on both sides of it, no
    farther than `reach`.

    **Raises:** `ArithmeticError` where there are too few points, or nothing vanishes between them.
    """
    shares, values, points = [], [], []
    for share in SHARES:
        try:
            here = at(s + reach * share)
            if here is None:
                continue
            values.append(value(here))
        except FAILED:
            continue
        shares.append(share)
        points.append(here)
    if len(shares) < FEWEST:
        raise ArithmeticError("too few points beside a singular one")
    powers = np.vander(shares, increasing=True)
    roots = np.polynomial.Polynomial(np.linalg.solve(powers, values)).roots()
    real = [r.real for r in roots if abs(r.imag) < 1e-6 and abs(r) < 1]
    if not real:
        raise ArithmeticError("nothing vanishes there")
    root = min(real, key=abs)
    weights = np.linalg.solve(powers.T, root ** np.arange(len(shares)))
    return Interpolated(s + reach * root, weights, points)
