"""The size of programs."""

import collections

import jax
from jax.extend.core import ClosedJaxpr, Jaxpr


def count(jaxpr, into=None):
    """How often each primitive occurs, in all nested jaxprs too."""
    into = collections.Counter() if into is None else into
    for eqn in jaxpr.eqns:
        into[eqn.primitive.name] += 1
        for value in jax.tree.leaves(eqn.params, is_leaf=lambda x: isinstance(x, (Jaxpr, ClosedJaxpr))):
            if isinstance(value, ClosedJaxpr):
                count(value.jaxpr, into)
            elif isinstance(value, Jaxpr):
                count(value, into)
    return into
