"""Shared type names. `Y` is the user's state: any pytree of floating point arrays."""

from typing import Any, TypeAlias

from jaxtyping import Array, ArrayLike, Float, Int, PyTree


Y: TypeAlias = PyTree[Float[ArrayLike, "..."]]
Mode: TypeAlias = tuple[Int[Array, ""], ...]  # one small integer per switch
Scalar: TypeAlias = Float[Array, ""]
Guard: TypeAlias = Any  # (system, t, y) -> scalar, or tuple of scalars meaning their minimum
