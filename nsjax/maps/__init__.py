"""Poincaré maps, and what they are for: diagrams, basins, Lyapunov exponents, normal forms."""

from ._attractor_chart import attractor_chart as attractor_chart, AttractorChart as AttractorChart
from ._basins import Basins as Basins, basins as basins
from ._brute_force import brute_force as brute_force, BruteForce as BruteForce
from ._iterate import Iterate as Iterate
from ._lyapunov import lyapunov_spectrum as lyapunov_spectrum, LyapunovSpectrum as LyapunovSpectrum
from ._reduced import reduced_map as reduced_map, ReducedIterate as ReducedIterate
from ._section import poincare_map as poincare_map
from ._stroboscopic import stroboscopic_map as stroboscopic_map
