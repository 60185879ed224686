"""The size of programs, and how many there are."""

import collections
import contextlib

import jax
from jax.extend.core import ClosedJaxpr, Jaxpr


def equations_of(jaxpr):
    """All of them, those of nested jaxprs too."""
    for eqn in jaxpr.eqns:
        yield eqn
        for value in jax.tree.leaves(eqn.params, is_leaf=lambda x: isinstance(x, (Jaxpr, ClosedJaxpr))):
            if isinstance(value, (Jaxpr, ClosedJaxpr)):
                yield from equations_of(getattr(value, "jaxpr", value))


def count(jaxpr):
    """How often each primitive occurs."""
    return collections.Counter(eqn.primitive.name for eqn in equations_of(jaxpr))


@contextlib.contextmanager
def compilations():
    """Of which programs are compiled: a list of seconds."""
    compiled = []

    def heard(event, seconds, **_):
        if event == "/jax/core/compile/backend_compile_duration":
            compiled.append(seconds)

    jax.monitoring.register_event_duration_secs_listener(heard)
    try:
        yield compiled
    finally:
        jax.monitoring.unregister_event_duration_listener(heard)
