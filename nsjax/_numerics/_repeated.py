"""Programs that are called for one point after the other.

A step along a branch takes a millisecond, and to hand a model to its program and its thirty results back takes as long
again. So what is the same at every point is given once, and the results come as one array of each kind.
"""

import functools as ft
import weakref
from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from ._compile import interactive, on_host, options, without_collection
from ._products import full_products
from ._programs import Programs, split, trace_context
from ._whole_loops import whole_loops


class Same:
    """A thing as a key: itself, and nothing that is equal to it."""

    def __init__(self, it: Any) -> None:
        self.it = it

    def __hash__(self) -> int:
        return id(self.it)

    def __eq__(self, other: object) -> bool:
        return isinstance(other, Same) and other.it is self.it


class Repeated:
    """A function of pytrees that Python calls often, and not within other programs; it returns NumPy's arrays.

    **Arguments:**

    - `fn`: the function. All that it returns are arrays.
    """

    def __init__(self, fn: Callable[..., Any]) -> None:
        joined = ft.partial(_joined, fn)
        self.programs = [Programs(joined, ft.partial(options, often=True, loops=loops)) for loops in (False, True)]
        self.plain = interactive(fn, host=True)

    def at(self, *given: Any, loops: bool = False) -> Callable[..., Any]:
        """With its first arguments given: a function of the others, which are arrays, or tuples of them.

        With its `loops` as one function each a program takes a fifth longer to compile: that pays where they have many
        turns.
        """
        return _At(self, given, loops)


class _At:
    def __init__(self, repeated: Repeated, given: Any, loops: bool) -> None:
        self._repeated, self._given, self._loops = repeated, given, loops
        self._arrays = jax.device_put(split(given)[0])
        self._ready: dict[Any, Callable[[], Any]] = {}  # weak references: `jax.clear_caches()` lets programs go

    @full_products
    def __call__(self, *args: Any) -> Any:
        programs, arrays = self._repeated.programs[self._loops], jax.tree.leaves(args)
        if trace_context is None or jax.config.values["jax_disable_jit"]:
            return self._repeated.plain(*self._given, *args)
        kind = (trace_context(), *((x.shape, x.dtype) for x in arrays))
        program = self._ready[kind]() if kind in self._ready else None
        if program is None:
            with without_collection(), whole_loops(self._loops):
                program = programs.ready(*self._given, *args)
            self._ready[kind] = weakref.ref(program)
        return _apart(*program([*self._arrays, *arrays]))


def _joined(fn: Callable[..., Any], *args: Any) -> tuple[list[Any], Any]:
    """The arrays that a function returns as one of each kind, and their forms."""
    tree = fn(*args)
    leaves = [jnp.asarray(leaf) for leaf in jax.tree.leaves(tree)]
    kinds = list(dict.fromkeys(leaf.dtype for leaf in leaves))
    vectors = [jnp.concatenate([jnp.ravel(x) for x in leaves if x.dtype == kind]) for kind in kinds]
    return vectors, jax.tree.map(lambda x: jax.ShapeDtypeStruct(jnp.shape(x), jnp.asarray(x).dtype), tree)


def _apart(vectors: list[Any], forms: Any) -> Any:
    """Views of them."""
    places = {vector.dtype: [vector, 0] for vector in on_host(vectors)}

    def view(form: Any) -> np.ndarray:
        place = places[form.dtype]
        vector, start = place
        place[1] = stop = start + form.size
        return vector[start:stop].reshape(form.shape)

    return jax.tree.map(view, forms)
