"""One function for many parameters, in batches."""

from ._sweep import sweep as sweep
