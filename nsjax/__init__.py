"""nsjax: differentiable piecewise-smooth dynamics in JAX."""

from ._filippov import Model as _Model  # noqa: F401
from ._solution import Event as Event, Events as Events, RESULTS as RESULTS, Solution as Solution
from ._solve import solve as solve
from ._system import impact as impact, relay as relay, sgn as sgn, System as System
