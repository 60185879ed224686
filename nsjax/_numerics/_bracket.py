"""Roots along a curve whose points are expensive: each is computed once and kept."""

from collections.abc import Callable
from typing import TypeVar

from scipy.optimize import toms748


P = TypeVar("P")


def bracketed(
    seen: dict[float, P], at: Callable[[float], P | None], value: Callable[[P], float], xtol: float = 1e-15
) -> float:
    """The distance at which a function of points vanishes, between the first and the last one in `seen`, to which
    `at` adds.

    **Raises:** `ArithmeticError` where there is no point, or no root is found; `ValueError` if the function has one
    sign at both ends.
    """

    def off(s: float) -> float:
        if s not in seen:
            here = at(s)
            if here is None:
                raise ArithmeticError("there is no point")
            seen[s] = here
        return value(seen[s])

    try:
        s = float(toms748(off, min(seen), max(seen), xtol=xtol, rtol=1e-14, maxiter=60))
    except RuntimeError as why:
        raise ArithmeticError("the root was not found") from why
    off(s)
    return s
