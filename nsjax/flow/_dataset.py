"""A solution as an `xarray.Dataset`."""

from typing import Any

import jax
import numpy as np

from .._numerics._tables import lane_names, package
from .._numerics._text import components
from ._results import result_names


def dataset_of(sol: Any) -> Any:
    """Of a `Solution`, or of a batch."""
    xarray = package("xarray", "Solution.to_xarray")
    batch = np.shape(sol.t1)
    lanes = lane_names(len(batch))
    variables: dict[str, Any] = {}
    coordinates: dict[str, Any] = {}

    def rows(number: np.ndarray) -> slice:
        """All of a batch; of one solution those that are no padding."""
        return slice(None) if lanes else slice(int(number))

    def put(name: str, axis: str, values: Any, some: slice) -> None:
        variables[name] = ([*lanes, axis], _blank(np.asarray(values) if lanes else np.asarray(values)[some]))

    if sol.ts is not None:
        ts = np.asarray(sol.ts)
        some = rows(np.sum(np.isfinite(ts)))
        coordinates["t"] = ([*lanes, "time"], _blank(ts if lanes else ts[some]))
        for name, values in components(sol.ys, ts.ndim).items():
            put(name, "time", values, some)
        modes = np.asarray(sol.modes)
        for k, switch in enumerate(sol.events.names):
            put(f"mode_{switch}", "time", modes[..., k], some)
    log = jax.tree.map(np.asarray, sol.events)
    some = rows(log.num)
    coordinates["t_event"] = ([*lanes, "event"], _blank(log.t if lanes else log.t[some]))
    names = np.array([*log.names, ""], dtype=str)
    put("switch", "event", names[log.switch], some)
    for when in ("before", "after"):
        for name, values in components(getattr(log, f"y_{when}"), log.t.ndim).items():
            put(f"{name}_{when}", "event", values, some)
        for k, switch in enumerate(log.names):
            put(f"mode_{switch}_{when}", "event", getattr(log, f"mode_{when}")[..., k], some)
    for name in ("t0", "t1", "margin", "unique"):
        variables[f"{name}_" if name in variables else name] = (lanes, np.asarray(getattr(sol, name)))
    variables["result"] = (lanes, result_names(sol.result).astype(str))
    return xarray.Dataset(variables, coordinates, {"system": type(sol.system).__name__})


def _blank(values: np.ndarray) -> np.ndarray:
    """With NaN for the infinities that fill up."""
    return np.where(np.isfinite(values), values, np.nan) if values.dtype.kind == "f" else values
