"""Branches of equilibria and of periodic orbits, and curves of their bifurcations."""

from .bifurcations._continue_bifurcation import (
    BifurcationCurve as BifurcationCurve,
    CodimensionTwo as CodimensionTwo,
    continue_bifurcation as continue_bifurcation,
)
from .equilibria._bifurcation import Bifurcation as Bifurcation, HalfBranch as HalfBranch
from .equilibria._branch import Branch as Branch
from .equilibria._continue_equilibrium import (
    continue_equilibrium as continue_equilibrium,
    EquilibriumContinuation as EquilibriumContinuation,
)
from .equilibria._hopf_orbits import hopf_orbits as hopf_orbits
from .orbits._bifurcation import OrbitBifurcation as OrbitBifurcation, OrbitHalfBranch as OrbitHalfBranch
from .orbits._branch import OrbitBranch as OrbitBranch
from .orbits._continue_orbit import continue_orbit as continue_orbit, OrbitContinuation as OrbitContinuation
from .orbits.batch._continue_orbits import continue_orbits as continue_orbits, OrbitBranches as OrbitBranches
