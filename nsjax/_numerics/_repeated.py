"""Programs that are called for one point after the other.

A step along a branch takes a millisecond, and to hand a model to its program and its thirty results back takes as long
again. So what is the same at every point is given once, and the results come as one array of each kind.
"""

import functools as ft
import math
from collections.abc import Callable
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

from ._compile import on_host, options, without_collection
from ._products import full_products
from ._programs import kept, uncommitted


@jax.tree_util.register_static
class Same:
    """A thing as a key: itself, and nothing that is equal to it."""

    def __init__(self, it: Any) -> None:
        self.it = it

    def __hash__(self) -> int:
        return id(self.it)

    def __eq__(self, other: object) -> bool:
        return isinstance(other, Same) and other.it is self.it


class _Static:
    """All of a tree but its arrays, as a key."""

    def __init__(self, tree: Any) -> None:
        leaves, self._structure = jax.tree.flatten(tree)
        self.arrays = [leaf for leaf in leaves if eqx.is_array(leaf)]
        self._others = tuple(None if eqx.is_array(leaf) else (type(leaf), leaf) for leaf in leaves)
        self._hash = hash((self._structure, self._others))  # once: it takes as long as a step

    def __hash__(self) -> int:
        return self._hash

    def __eq__(self, other: object) -> bool:
        if not isinstance(other, _Static):
            return False
        return other is self or (other._structure, other._others) == (self._structure, self._others)

    def with_arrays(self, arrays: list[Any]) -> Any:
        rest = iter(arrays)
        return jax.tree.unflatten(self._structure, [next(rest) if x is None else x[1] for x in self._others])


class Repeated:
    """A function of pytrees that Python calls often, and not within other programs; it returns NumPy's arrays.

    **Arguments:**

    - `fn`: the function. All that it returns are arrays.
    """

    def __init__(self, fn: Callable[..., Any]) -> None:
        joined = ft.partial(_joined, fn)

        def run(static: _Static, arrays: list[Any], args: tuple[Any, ...]) -> tuple[list[Any], Same]:
            vectors, forms = kept(joined)(*static.with_arrays(arrays), *args)
            return vectors, Same(forms)

        @ft.cache  # not on import: which options there are is found out by compiling
        def program() -> Any:
            return jax.jit(run, static_argnums=0, compiler_options=options(often=True))

        self._program = program

    def at(self, *given: Any) -> Callable[..., Any]:
        """With its first arguments given: a function of the others, which are arrays, or tuples of them."""
        static = _Static(given)
        arrays = jax.device_put(uncommitted(static.arrays))

        @full_products
        def call(*args: Any) -> Any:
            with without_collection():
                vectors, forms = self._program()(static, arrays, uncommitted(args))
            return _apart(vectors, forms.it)

        return call


class _Form(NamedTuple):
    """An array among those of its kind."""

    dtype: str
    shape: tuple[int, ...]


def _joined(fn: Callable[..., Any], *args: Any) -> tuple[list[Any], Any]:
    """The arrays that a function returns as one of each kind, and their forms."""
    tree = jax.tree.map(jnp.asarray, fn(*args))
    leaves = jax.tree.leaves(tree)
    kinds = list(dict.fromkeys(leaf.dtype for leaf in leaves))
    vectors = [jnp.concatenate([jnp.ravel(x) for x in leaves if x.dtype == kind]) for kind in kinds]
    return vectors, jax.tree.map(lambda x: _Form(x.dtype.name, x.shape), tree)


def _apart(vectors: list[Any], forms: Any) -> Any:
    """Views of them."""
    places = {vector.dtype.name: [vector, 0] for vector in on_host(vectors)}

    def view(form: _Form) -> np.ndarray:
        place = places[form.dtype]
        vector, start = place
        place[1] = stop = start + math.prod(form.shape)
        return vector[start:stop].reshape(form.shape)

    return jax.tree.map(view, forms, is_leaf=lambda x: isinstance(x, _Form))
