"""Shared type names. `Y` is the user's state: any pytree of floating point arrays."""

from typing import Any, TYPE_CHECKING, TypeAlias

from jaxtyping import Array, ArrayLike, Float, Int, PyTree


if TYPE_CHECKING:  # a type checker knows nothing of pytrees, but of defaults, as Python does from 3.13 on
    from typing_extensions import TypeVar

    Y: TypeAlias = Any
    StateT = TypeVar("StateT", default=Any)
else:
    from typing import TypeVar

    Y: TypeAlias = PyTree[Float[ArrayLike, "..."]]
    StateT = TypeVar("StateT")  # a `Y` that comes out as it went in

Mode: TypeAlias = tuple[Int[Array, ""], ...]  # one small integer per switch
Scalar: TypeAlias = Float[Array, ""]
Number: TypeAlias = Float[Array, ""] | float  # a component of a state: one writes floats, and is given arrays
Guard: TypeAlias = Any  # (system, t, y) -> scalar, or tuple of scalars meaning their minimum
