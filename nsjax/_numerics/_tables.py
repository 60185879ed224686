"""Results as tables of pandas and datasets of xarray (the extra `data`), which are imported when they are asked for."""

import importlib
from collections.abc import Iterable
from typing import Any

import numpy as np


def package(name: str, asked: str) -> Any:
    """pandas or xarray.

    **Raises:** `ImportError` that says how to install it, where `asked` is what needs it.
    """
    try:
        return importlib.import_module(name)
    except ImportError as error:
        raise ImportError(f"`{asked}` needs the package {name}: `pip install nsjax[data]`.") from error


def frame(asked: str, columns: Iterable[tuple[str, Any]]) -> Any:
    """A table of columns of one length, in this order.

    **Arguments:**

    - `asked`: what the user called.
    - `columns`: name and values; those of an array with more axes are columns `name[0]`, `name[1]`, .... A name that
        occurs again, as where a state and a parameter share one, is `name_`.
    """
    pandas, found = package("pandas", asked), {}
    for name, values in columns:
        values = np.asarray(values)
        for index in np.ndindex(values.shape[1:]):
            own = name + f"[{','.join(map(str, index))}]" * bool(index)
            while own in found:
                own += "_"
            found[own] = values[(slice(None), *index)]
    return pandas.DataFrame(found)


def lanes_of(shape: tuple[int, ...], last: int = 1) -> list[tuple[str, np.ndarray]]:
    """Columns that tell rows of a batch apart: of each of the leading axes its index, for rows that run over the last
    ones too."""
    names = lane_names(len(shape) - last)
    return list(zip(names, np.indices(shape).reshape(len(shape), -1))) if names else []


def lane_names(axes: int) -> list[str]:
    """Of the leading axes of a batch: `lane`, or of several `lane0`, `lane1`, ...."""
    return ["lane"] if axes == 1 else [f"lane{i}" for i in range(axes)]
