"""Roots along a curve whose points are expensive: each is computed once and kept."""

from collections.abc import Callable
from typing import TypeVar

import numpy as np


P = TypeVar("P")
KNOWN = 1e-12  # between points that are nearer to each other a function of them changes its sign by rounding


def bracketed(
    seen: dict[float, P], at: Callable[[float], P | None], value: Callable[[P], float], xtol: float = 1e-15
) -> float:
    """The distance at which a function of points vanishes, between two of those `seen`, to which `at` adds. (Several
    functions that vanish together have their zeros between the points that the first one has asked for.)

    **Raises:** `ArithmeticError` where there is no point, or no root is found; `ValueError` if the function has one
    sign at all of them; what `value` raises for the first or the last.
    """

    def off(s: float) -> float:
        if s not in seen:
            here = at(s)
            if here is None:
                raise ArithmeticError("there is no point")
            seen[s] = here
        return value(seen[s])

    from scipy.optimize import toms748  # slow to import

    a, b = _narrowest(seen, value)
    if b - a < KNOWN:
        return min(a, b, key=lambda s: abs(value(seen[s])))
    try:
        s = float(toms748(off, a, b, xtol=xtol, rtol=1e-14, maxiter=60))
    except RuntimeError as why:
        raise ArithmeticError("the root was not found") from why
    off(s)
    return s


def _narrowest(seen: dict[float, P], value: Callable[[P], float]) -> tuple[float, float]:
    """The first two neighbours between which the sign changes; or the ends."""
    first, last = min(seen), max(seen)
    at, sign = first, np.sign(value(seen[first]))
    for s in sorted(seen)[1:]:
        try:
            new = np.sign(value(seen[s]))
        except KeyError:  # the function is not one of this point's
            if s == last:
                raise
            continue
        if sign * new <= 0:
            return at, s
        if new == sign:
            at = s
    return first, last
