"""Poincaré maps and what is made of them: brute-force diagrams, reduced maps, normal forms."""

from ._brute_force import brute_force as brute_force, BruteForce as BruteForce
from ._poincare import Iterate as Iterate, poincare_map as poincare_map, stroboscopic_map as stroboscopic_map
from ._reduced import reduced_map as reduced_map, ReducedIterate as ReducedIterate
