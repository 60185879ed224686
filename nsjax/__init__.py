"""nsjax: differentiable piecewise-smooth dynamics in JAX."""

from ._numerics import _stages as _stages  # first: a command tells that it is about to import JAX


# isort: split

from . import (
    continuation as continuation,
    derivatives as derivatives,
    equilibria as equilibria,
    flow as flow,
    gallery as gallery,
    maps as maps,
    mechanics as mechanics,
    orbits as orbits,
    plot as plot,
    regularise as regularise,
    setvalued as setvalued,
    sweeps as sweeps,
    system as system,
)
from ._numerics._programs import keep_programs as keep_programs
from ._version import __version__ as __version__
from ._work_precision import (
    Method as Method,
    methods_for as methods_for,
    work_precision as work_precision,
    WorkPrecision as WorkPrecision,
)
from .continuation import (
    Branch as Branch,
    continue_bifurcation as continue_bifurcation,
    continue_equilibrium as continue_equilibrium,
    continue_orbit as continue_orbit,
    continue_orbits as continue_orbits,
    EquilibriumContinuation as EquilibriumContinuation,
    OrbitBranch as OrbitBranch,
    OrbitContinuation as OrbitContinuation,
)
from .derivatives import (
    fundamental_matrix as fundamental_matrix,
    saltation_matrices as saltation_matrices,
    saltation_matrix as saltation_matrix,
    sensitivity as sensitivity,
)
from .equilibria import (
    Equilibrium as Equilibrium,
    find_equilibria as find_equilibria,
    find_equilibrium as find_equilibrium,
)
from .flow import (
    Affine as Affine,
    Exponential as Exponential,
    is_okay as is_okay,
    method_for as method_for,
    RESULTS as RESULTS,
    Solution as Solution,
    solve as solve,
    SolveError as SolveError,
    Taylor as Taylor,
)
from .maps import (
    attractor_chart as attractor_chart,
    basins as basins,
    brute_force as brute_force,
    lyapunov_spectrum as lyapunov_spectrum,
    poincare_map as poincare_map,
    reduced_map as reduced_map,
    stroboscopic_map as stroboscopic_map,
)
from .orbits import find_orbit as find_orbit, find_orbits as find_orbits, Orbit as Orbit, Segment as Segment
from .regularise import banded as banded, mark_kinks as mark_kinks, smoothed as smoothed
from .sweeps import Sweep as Sweep, sweep as sweep
from .system import (
    clock as clock,
    impact as impact,
    LevelSwitch as LevelSwitch,
    relay as relay,
    sgn as sgn,
    System as System,
)
