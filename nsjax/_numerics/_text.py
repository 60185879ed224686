"""Numbers and names in messages and on paper."""

import difflib
import functools
import html
import inspect
from collections.abc import Callable, Iterable
from typing import Any, ParamSpec, TypeVar

import jax
import numpy as np
from jax.core import Tracer

from .._types import Y


P = ParamSpec("P")
R = TypeVar("R")
T = TypeVar("T")


def shown(cls: type[T]) -> type[T]:
    """Decorates a result with a `__str__`: as it is printed it is shown, in a list and in a notebook too. What holds no
    numbers, as while it is traced, is shown by its structure."""
    printed, structure = cls.__str__, cls.__repr__

    def text(self: T) -> str:
        try:
            return printed(self) if known(self) else structure(self)
        except Exception:  # its leaves are something else: shapes, axes, nothing at all; and no `repr` may fail
            return structure(self)

    def markup(self: T) -> str:
        return f"<pre>{html.escape(text(self))}</pre>"

    for name, method in dict(__str__=text, __repr__=text, _repr_html_=markup).items():
        setattr(cls, name, method)
    return cls


def known(tree: Any) -> bool:
    """Whether all numbers have values, which they do not under `jit`, `vmap` or differentiation."""
    return not any(isinstance(x, Tracer) for x in jax.tree.leaves(tree))


def outline(tree: Any) -> str:
    """Returns the structure of a pytree in words: `State(x, v)`, `{'x': *, 'v': *}`, `(*, [*, *])`; a leaf is `*`."""
    if isinstance(tree, dict):
        return "{" + ", ".join(f"{key!r}: {outline(value)}" for key, value in tree.items()) + "}"
    fields = getattr(tree, "_fields", None) or tuple(getattr(tree, "__dataclass_fields__", ()))
    if fields and not isinstance(tree, jax.ShapeDtypeStruct):
        parts = {name: outline(getattr(tree, name)) for name in fields}
        return f"{type(tree).__name__}({', '.join(n if text == '*' else f'{n}={text}' for n, text in parts.items())})"
    if isinstance(tree, (tuple, list)):
        inner = ", ".join(map(outline, tree))
        return f"[{inner}]" if isinstance(tree, list) else f"({inner}{',' * (len(tree) == 1)})"
    return "None" if tree is None else "*"


def components(y: Y, ndim: int = 0) -> dict[str, np.ndarray]:
    """The scalar components of a state by name.

    **Arguments:**

    - `y`: the state, or an array of states.
    - `ndim`: how many leading axes its leaves have that are not the state's own, such as one for time.

    **Returns:** a dictionary: `"x"` for a scalar leaf `y.x` or `y["x"]`, `"q[0]"`, `"q[1]"` for a vector. A state that
    is an array itself is called `y`.
    """
    named = {}
    for path, leaf in jax.tree_util.tree_flatten_with_path(y)[0]:
        name = jax.tree_util.keystr(path, simple=True, separator=".")
        name = f"y.{name}" if name.isdigit() else name or "y"
        leaf = np.asarray(leaf)
        for index in np.ndindex(leaf.shape[ndim:]):
            named[name + f"[{','.join(map(str, index))}]" * bool(index)] = leaf[(..., *index)]
    return named


def written(y: Y, axes: int = 0, most: int = 8) -> str:
    """`x = 1.5, v = 0.2`; of a long state the beginning; of many, which have leading axes, `x = 1.5 to 2, v = 0.2`."""
    parts = [f"{name} = {between(x) if axes else format(float(x), '.6g')}" for name, x in components(y, axes).items()]
    return ", ".join(parts[:most] + ["..."] * (len(parts) > most))


def listed(values: Any, digits: int = 6, most: int = 8) -> str:
    """`1+0j, 0.5+0j`; of many the beginning."""
    values = np.ravel(values).tolist()
    return ", ".join([f"{x:.{digits}g}" for x in values[:most]] + ["..."] * (len(values) > most)) or "none"


def nearest(name: str, names: Iterable[str]) -> str | None:
    """Which of the names may be meant, whatever their case."""
    plain = {one.lower(): one for one in reversed(list(names))}
    near = difflib.get_close_matches(name.lower(), plain, 1, 0.6)
    return plain[near[0]] if near else None


def did_you_mean(name: str, names: Iterable[str]) -> str:
    near = nearest(name, names)
    return "" if near is None else f" Did you mean `{near}`?"


def positive(name: str, value: Any) -> None:
    if not isinstance(value, int) or isinstance(value, bool) or value < 1:
        raise ValueError(f"Argument `{name}` must be a positive integer, but got {value!r}.")


def counted(names: Iterable[str]) -> str:
    """`60 stable, 4 unstable`."""
    values, numbers = np.unique(list(names), return_counts=True)
    order = np.argsort(-numbers, kind="stable")
    return ", ".join(f"{numbers[i]} {values[i]}" for i in order) or "none"


def between(x: Any) -> str:
    """`3.2 to 14.5`, of the numbers that are finite."""
    x = np.asarray(x, float)
    x = x[np.isfinite(x)]
    if not x.size:
        return "none"
    low, high = f"{x.min():.6g}", f"{x.max():.6g}"
    return low if low == high else f"{low} to {high}"


def suggesting(hints: dict[str, str]) -> Callable[[Callable[P, R]], Callable[P, R]]:
    """Decorates a public function: an argument that it does not have raises an error that names the one which may be
    meant, or gives the hint for it."""

    def decorate(fn: Callable[P, R]) -> Callable[P, R]:
        names = list(inspect.signature(fn).parameters)

        @functools.wraps(fn)
        def checked(*args: P.args, **kwargs: P.kwargs) -> R:
            for name in kwargs:
                if name not in names:
                    hint = f" {hints[name]}" if name in hints else did_you_mean(name, names)
                    raise TypeError(f"`{fn.__name__}` has no argument `{name}`.{hint}")
            return fn(*args, **kwargs)

        return checked

    return decorate
