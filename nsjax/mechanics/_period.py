"""The period of a scene that is forced by several effects: the least in which all of them repeat."""

import math
from collections.abc import Mapping
from fractions import Fraction
from typing import Any

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jax.core import Tracer


_MOST = 1000  # periods of one forcing in that of the scene
_EXACT = 1e-9  # how well, relatively, periods must agree


def multiple_of(periods: Mapping[str, Any]) -> int:
    """How many of the first period make the period of all of them, which are given by the names of their effects.

    **Raises:** `ValueError` for periods without a common one, or that are not known.
    """
    (first, one), *others = periods.items()
    if not others:
        return 1
    if any(isinstance(period, Tracer) for period in periods.values()):
        raise ValueError(
            f"The periods of {_listed(periods)} must be known numbers where the scene is made, so that their common "
            "one can be found; make it outside `jit`, and put the traced values in by `equinox.tree_at`."
        )
    multiple = 1
    for name, period in others:
        ratio = float(np.asarray(period)) / float(np.asarray(one))
        near = Fraction(ratio).limit_denominator(_MOST)
        if near <= 0 or abs(float(near) - ratio) > _EXACT * ratio or near.numerator > _MOST:
            raise ValueError(_text({first: one, name: period}))
        multiple = math.lcm(multiple, near.numerator)
    return multiple


def common(periods: Mapping[str, Any], multiple: int) -> Any:
    """The period of the scene, `multiple` times the first, of which all must still be a part.

    **Raises:** `ValueError` if they are not, or, of values that are traced, a runtime error.
    """
    (first, one), *others = periods.items()
    period = one if multiple == 1 else multiple * one
    for name, other in others:
        if isinstance(period, Tracer) or isinstance(other, Tracer):
            ratio = period / other
            off = jnp.abs(ratio - jnp.round(ratio)) > _EXACT * ratio
            period = eqx.error_if(jnp.asarray(period), off, _text({first: None, name: None}))
            continue
        ratio = float(np.asarray(period)) / float(np.asarray(other))
        if abs(ratio - round(ratio)) > _EXACT * ratio:
            raise ValueError(_text({first: one, name: other}))
    return period


def _listed(periods: Mapping[str, Any]) -> str:
    return " and ".join(f"`{name}`" for name in periods)


def _text(periods: Mapping[str, Any]) -> str:
    values = [f"{float(np.asarray(p)):.10g}" for p in periods.values() if p is not None]
    got = f", but they are {' and '.join(values)}" if values else ""
    return (
        f"The periods of {_listed(periods)} must have a common multiple{got}: without one no motion repeats itself, "
        "and the scene has no period."
    )
