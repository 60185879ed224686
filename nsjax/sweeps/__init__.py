"""One function for many parameters, in batches."""

from ._long_sweep import Block as Block, Sweep as Sweep
from ._progress import Status as Status
from ._sweep import sweep as sweep
