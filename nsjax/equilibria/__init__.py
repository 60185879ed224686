"""Equilibria: in regions, on surfaces that hold them, virtual ones."""

from ._equilibrium import Equilibrium as Equilibrium
from ._find_equilibrium import find_equilibria as find_equilibria, find_equilibrium as find_equilibrium
