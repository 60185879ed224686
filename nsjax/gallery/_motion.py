"""The state of every system with one degree of freedom."""

from typing import NamedTuple

from .._types import Number


class Motion(NamedTuple):
    """Displacement and velocity of one mass."""

    x: Number  # displacement [m]
    v: Number  # velocity [m/s]
