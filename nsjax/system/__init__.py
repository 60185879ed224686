"""What a user writes: the vector field and its switches; and what the library makes of it, the field in each mode."""

from ._system import clock as clock, impact as impact, relay as relay, sgn as sgn, System as System
