"""Products of matrices to the precision of their numbers.

Without being told otherwise, GPUs multiply matrices of single precision with ten bits of their numbers: a stick-slip
oscillator then had errors of 1e-2 where a CPU had 7e-4.
"""

import functools as ft
from collections.abc import Callable
from typing import Any, cast, TypeVar

import jax


F = TypeVar("F", bound=Callable[..., Any])


def full_products(fn: F) -> F:
    """A function that is traced with such products, its user's functions included. What `jax.default_matmul_precision`
    says, or a product itself, stands."""

    @ft.wraps(fn)
    def call(*args: Any, **kwargs: Any) -> Any:
        if getattr(jax.config, "jax_default_matmul_precision", None) is not None:
            return fn(*args, **kwargs)
        with jax.default_matmul_precision("highest"):
            return fn(*args, **kwargs)

    return cast(F, call)
