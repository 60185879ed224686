"""Arguments that all continuations have."""

from typing import Any

import jax
import numpy as np

from .._types import Y


def check_interval(name: str, interval: Any, value: float, where: str) -> None:
    low, high = interval
    if not low < high or not low <= value <= high:
        raise ValueError(
            f"Argument `{name}` must be (low, high) and hold {value:.6g}, the value {where}, but is "
            f"({low:.6g}, {high:.6g})."
        )


def checked_scale(like: Y, scale: Y) -> np.ndarray:
    sizes, x = (np.concatenate([np.ravel(leaf) for leaf in jax.tree.leaves(y)]) for y in (scale, like))
    if sizes.shape != x.shape or not np.all(np.abs(sizes) > 0):
        raise ValueError("Argument `scale` must hold a positive number for each component of the state.")
    return np.abs(sizes).astype(np.float64)


def check_precision(dtype: Any, advice: str) -> None:
    if dtype != "float64":
        raise ValueError(
            f"Continuation locates special points to more digits than {dtype} has: call "
            f'`jax.config.update("jax_enable_x64", True)` first, and {advice} in double precision.'
        )
