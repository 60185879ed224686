"""nsjax: differentiable piecewise-smooth dynamics in JAX."""

from . import gallery as gallery, plot as plot
from ._bifurcation import Bifurcation as Bifurcation, HalfBranch as HalfBranch
from ._branch import Branch as Branch
from ._brute_force import brute_force as brute_force, BruteForce as BruteForce
from ._continue_bifurcation import (
    BifurcationCurve as BifurcationCurve,
    CodimensionTwo as CodimensionTwo,
    continue_bifurcation as continue_bifurcation,
)
from ._continue_equilibrium import continue_equilibrium as continue_equilibrium
from ._continue_orbit import continue_orbit as continue_orbit, OrbitGrowth as OrbitGrowth
from ._continue_orbits import continue_orbits as continue_orbits, OrbitBranches as OrbitBranches
from ._crossings import (
    eigenvalue_crossings as eigenvalue_crossings,
    eigenvalue_path as eigenvalue_path,
    EigenvalueCurve as EigenvalueCurve,
    EigenvalueCurves as EigenvalueCurves,
    EigenvaluePath as EigenvaluePath,
)
from ._cuts import Segment as Segment
from ._equilibrium import Equilibrium as Equilibrium
from ._exponential import Exponential as Exponential
from ._find_equilibrium import find_equilibria as find_equilibria, find_equilibrium as find_equilibrium
from ._find_orbit import find_orbit as find_orbit, find_orbits as find_orbits
from ._generalized import (
    generalized_jacobian as generalized_jacobian,
    GeneralizedJacobian as GeneralizedJacobian,
)
from ._hopf_orbits import hopf_orbits as hopf_orbits
from ._kinks import mark_kinks as mark_kinks
from ._orbit import Orbit as Orbit
from ._orbit_bifurcation import OrbitBifurcation as OrbitBifurcation, OrbitHalf as OrbitHalf
from ._orbit_branch import OrbitBranch as OrbitBranch
from ._pencil import EigenvalueCrossing as EigenvalueCrossing
from ._poincare import (
    Iterate as Iterate,
    poincare_map as poincare_map,
    stroboscopic_map as stroboscopic_map,
)
from ._reduced_map import reduced_map as reduced_map, ReducedIterate as ReducedIterate
from ._regularise import banded as banded, smoothed as smoothed
from ._results import is_okay as is_okay, RESULTS as RESULTS, SolveError as SolveError
from ._saltation import (
    saltation_matrices as saltation_matrices,
    saltation_matrix as saltation_matrix,
)
from ._sensitivity import Sensitivity as Sensitivity, sensitivity as sensitivity
from ._solution import Event as Event, Events as Events, Itinerary as Itinerary, Solution as Solution
from ._solve import solve as solve
from ._sweep import sweep as sweep
from ._system import (
    clock as clock,
    impact as impact,
    relay as relay,
    sgn as sgn,
    System as System,
)
from ._taylor import Taylor as Taylor
from ._variational import fundamental_matrix as fundamental_matrix
from ._version import __version__ as __version__
from ._work_precision import (
    Method as Method,
    methods_for as methods_for,
    work_precision as work_precision,
    WorkPrecision as WorkPrecision,
)
