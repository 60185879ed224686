"""The settings of JAX that a traced program depends on."""

from typing import Any

import jax


NAMES = (
    "jax_enable_x64",
    "jax_default_matmul_precision",
    "jax_default_prng_impl",
    "jax_threefry_partitionable",
    "jax_numpy_dtype_promotion",
    "jax_numpy_rank_promotion",
    "jax_debug_nans",
    "jax_debug_infs",
    "jax_enable_checks",
)


def settings() -> tuple[Any, ...]:
    """Returns their values in this thread. `jax.jit` knows them by itself; what is kept elsewhere has them as part of
    its key."""
    return tuple(getattr(jax.config, name, None) for name in NAMES)
