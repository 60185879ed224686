"""Measures of the user's own of each orbit on a branch."""

import dataclasses
from collections.abc import Callable, Mapping
from typing import Any

import jax
import numpy as np

from ..._types import Y
from ...orbits.segments._equations import OrbitCurve
from ._tracer import OrbitPoint


Measures = Mapping[str, Callable[[np.ndarray, Y], Any]]


def states_of(like: Y, rows: np.ndarray) -> Y:
    """States from rows in which they are flattened; leaves with a leading axis."""
    leaves, structure = jax.tree.flatten(like)
    parts = np.split(rows, np.cumsum([np.size(leaf) for leaf in leaves])[:-1], axis=1)
    return jax.tree.unflatten(structure, [x.reshape(len(rows), *np.shape(leaf)) for x, leaf in zip(parts, leaves)])


@dataclasses.dataclass
class Recorder:
    """Measures orbits, and sees to it that the results can be put into arrays."""

    measures: Measures = dataclasses.field(default_factory=dict)
    shapes: dict[str, tuple[int, ...]] = dataclasses.field(default_factory=dict)  # of what each gave first

    def __post_init__(self):
        for name, measure in self.measures.items():
            if not isinstance(name, str) or not callable(measure):
                raise ValueError(f"Argument `record` must map names to functions, but maps {name!r} to {measure!r}.")

    def __call__(self, curve: OrbitCurve, spot: OrbitPoint) -> dict[str, np.ndarray]:
        if not self.measures:
            return {}
        n, look = int(spot.itinerary.num), spot.look
        # The largest and the least components are not left to the samples.
        ts = np.concatenate([look.ts[:n], look.turns_t[:n]], axis=1)
        xs = np.concatenate([look.xs[:n], look.turns_x[:n]], axis=1)
        order = np.argsort(ts, axis=1, kind="stable")
        ts, xs = np.take_along_axis(ts, order, 1).ravel(), np.take_along_axis(xs, order[..., None], 1)
        ys = states_of(curve.like, xs.reshape(-1, xs.shape[-1]))
        return {name: self.measured(name, ts, ys, spot.parameter) for name in self.measures}

    def measured(self, name: str, ts: np.ndarray, ys: Y, parameter: float) -> np.ndarray:
        try:
            value = np.asarray(self.measures[name](ts, ys))
        except Exception as error:
            raise ValueError(
                f"The function `record[{name!r}]` failed for the orbit at the parameter's value {parameter:.10g}: "
                f"{type(error).__name__}: {error}"
            ) from error
        if value.dtype.kind not in "biufc":
            raise ValueError(f"The function `record[{name!r}]` must return a number or an array, but gave {value!r}.")
        shape = self.shapes.setdefault(name, value.shape)
        if value.shape != shape:
            raise ValueError(
                f"The function `record[{name!r}]` must return arrays of one shape, but gave {value.shape} at the "
                f"parameter's value {parameter:.10g}, after {shape}."
            )
        return value
