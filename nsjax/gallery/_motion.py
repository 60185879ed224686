"""The state of every system with one degree of freedom."""

from typing import NamedTuple

from jaxtyping import Array, Float


class Motion(NamedTuple):
    """Displacement and velocity of one mass."""

    x: Float[Array, ""]  # displacement [m]
    v: Float[Array, ""]  # velocity [m/s]
