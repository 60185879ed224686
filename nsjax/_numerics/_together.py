"""Values of which a batch has all or none.

`vmap` finds out which values of a loop differ from lane to lane by tracing the body again and again, each time with the
loops within it, until no further value does. If all of them do from the beginning, it traces the body once.
"""

from typing import Any, TypeVar

import jax
import jax.extend.core as jex
import jax.numpy as jnp
from jax.interpreters import ad, batching, mlir


T = TypeVar("T")

together_p = jex.Primitive("together")
together_p.multiple_results = True


def together(tree: T) -> T:
    """The same arrays; under `vmap` each has a value for every lane, if any of them has. What is so of the values need
    not be of their derivatives: a batch of directions gives lanes to the derivatives alone."""
    flat, form = jax.tree.flatten(tree)
    return jax.tree.unflatten(form, together_p.bind(*map(jnp.asarray, flat)) if flat else [])


def _batch(args: Any, dims: Any) -> tuple[list[Any], list[int]]:
    size = next(x.shape[dim] for x, dim in zip(args, dims) if dim is not None)
    each = [batching.bdim_at_front(x, dim, size) for x, dim in zip(args, dims)]
    return together_p.bind(*each), [0] * len(each)


def _jvp(primals: Any, tangents: Any) -> tuple[list[Any], list[Any]]:
    there = [i for i, tangent in enumerate(tangents) if not isinstance(tangent, ad.Zero)]
    out = list(tangents)
    for i, tangent in zip(there, together_p.bind(*[tangents[i] for i in there])):
        out[i] = tangent
    return together_p.bind(*primals), out


together_p.def_impl(lambda *xs: list(xs))
together_p.def_abstract_eval(lambda *xs: list(xs))
batching.primitive_batchers[together_p] = _batch
ad.primitive_jvps[together_p] = _jvp
ad.primitive_transposes[together_p] = lambda cotangents, *_: cotangents
mlir.register_lowering(together_p, lambda ctx, *xs: list(xs))
