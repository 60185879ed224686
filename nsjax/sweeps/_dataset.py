"""The result of a long sweep as an `xarray.Dataset`."""

import inspect
from collections.abc import Callable
from typing import Any

import jax
import numpy as np

from .._numerics._tables import frame, package
from ._lanes import Lanes
from ._outcomes import Item


def leaf_names(tree: Any, root: str) -> list[str]:
    """`y1.x` and the like, of each leaf; `root` if there is only one."""
    paths = [path for path, _ in jax.tree_util.tree_leaves_with_path(tree)]
    names = [jax.tree_util.keystr(path, simple=True, separator=".").removesuffix("._value") for path in paths]
    return [f"{root}.{name}" if name[:1].isdigit() else name or root for name in names]


def argument_names(fn: Callable[..., Any], count: int) -> list[str]:
    try:
        names = list(inspect.signature(fn).parameters)
    except (TypeError, ValueError):
        names = []
    return names[:count] if len(names) >= count else [f"args{i}" for i in range(count)]


def dataset(fn: Callable[..., Any], lanes: Lanes, result: Any) -> Any:
    xarray = package("xarray", "Sweep.to_xarray")
    arguments, results = _named(fn, lanes, result)
    return xarray.Dataset(
        {name: (_dimensions(name, leaf), leaf, _attributes(kind)) for name, (leaf, kind) in results.items()},
        {name: (_dimensions(name, leaf), leaf) for name, leaf in arguments.items()},
    )


def dataframe(fn: Callable[..., Any], lanes: Lanes, result: Any) -> Any:
    arguments, results = _named(fn, lanes, result)
    told = {name: leaf if kind is None else _words(leaf, kind) for name, (leaf, kind) in results.items()}
    return frame("Sweep.to_dataframe", (arguments | told).items())


def _named(
    fn: Callable[..., Any], lanes: Lanes, result: Any
) -> tuple[dict[str, np.ndarray], dict[str, tuple[np.ndarray, Any]]]:
    """Arguments, and what was returned, by name; of the latter which enumeration it is of, if of one."""
    arguments: dict[str, Any] = {}
    for name, value in zip(argument_names(fn, len(lanes.mapped)), lanes.mapped):
        for own, leaf in zip(leaf_names(value, ""), jax.tree.leaves(value)):
            arguments[f"{name}.{own}".rstrip(".")] = leaf
    results = {}
    items = jax.tree.leaves(result, is_leaf=lambda x: isinstance(x, Item))
    kinds = {id(x._value): x._enumeration for x in items if isinstance(x, Item)}
    for name, leaf in zip(leaf_names(result, "value"), jax.tree.leaves(result)):
        name = f"{name}_" if name in arguments else name  # that of an argument is taken
        results[name] = leaf, kinds.get(id(leaf))
    return arguments, results


def _words(codes: np.ndarray, kind: Any) -> np.ndarray:
    names = {int(item._value): name for name, item in kind._name_to_item.items()}
    return np.array([names[int(i)] for i in codes.ravel()], dtype=object).reshape(codes.shape)


def _dimensions(name: str, leaf: Any) -> list[str]:
    return ["lane", *(f"{name}_dim{i}" for i in range(1, leaf.ndim))]


def _attributes(kind: Any) -> dict[str, Any]:
    """What the numbers of `RESULTS` mean, as the conventions for climate and forecast data write it."""
    if kind is None:
        return {}
    items = kind._name_to_item.items()
    return dict(flag_values=np.array([int(x._value) for _, x in items]), flag_meanings=" ".join(n for n, _ in items))
