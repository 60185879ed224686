"""What a user writes: the vector field and its switches; and what the library makes of it, the field in each mode."""

from ._clock import clock as clock
from ._impact import impact as impact
from ._level_switch import LevelSwitch as LevelSwitch
from ._relay import relay as relay
from ._sgn import sgn as sgn
from ._system import System as System
