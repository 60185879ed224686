"""The step length of pseudo-arclength continuation: by how much the tangent turned in the last step.

Written once, in the namespace of its arrays: NumPy's for a branch that Python follows, jax's within a program.
"""

from collections.abc import Callable
from typing import Any, TypeVar


R = TypeVar("R")
FIRST, SHORTEST = 1e-3, 1e-9  # in units of the curve
TURN, TURNED = 0.15, 0.5  # the angles between tangents that are aimed at, and allowed


def turn_between(tangent: Any, other: Any) -> Any:
    """The angle between two tangents of length one."""
    xp = tangent.__array_namespace__()
    return xp.arccos(xp.clip(tangent @ other, -1, 1))


def next_length(length: Any, turn: Any, tangent: Any, u: Any, longest: Any, aim: float = TURN) -> Any:
    """The length of the next step from `u`, after one in which the tangent turned by `turn`: at most twice the last, at
    least half of it, and so that no unknown changes by more than `longest`, relative to its size if that is above one.

    The angle is proportional to the length where the curvature is constant, so the quotient aims at `aim`. It costs
    nothing, where the distance between prediction and correction would depend on the units of single unknowns.
    """
    xp = tangent.__array_namespace__()
    speed = xp.max(xp.abs(tangent) / xp.maximum(1, xp.abs(u)))
    return xp.minimum(longest / speed, length * xp.clip(aim / xp.maximum(turn, 1e-9), 0.5, 2))


def shortened(length: float, attempt: Callable[[float], R | None]) -> tuple[float, R] | None:
    """The first of a length and its halves with which a step succeeds, and what it gives; None where even the shortest
    one does not."""
    while length >= SHORTEST:
        found = attempt(length)
        if found is not None:
            return length, found
        length /= 2
    return None
