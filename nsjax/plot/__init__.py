"""Pictures of solutions and orbits. Each function draws into `ax` (a new figure by default), returns the axes and
changes no global style. Matplotlib is imported by the first picture, not with nsjax."""

from .._numerics._text import components as components
from ..mechanics._sketch import sketch as sketch
from ._attractor_chart import attractor_chart as attractor_chart
from ._basins import basins as basins
from ._branch import bifurcation_diagram as bifurcation_diagram
from ._eigenvalues import eigenvalue_path as eigenvalue_path
from ._explore import explore as explore, Explorer as Explorer
from ._matrix import fundamental_matrix as fundamental_matrix, multipliers as multipliers
from ._orbit_branch import (
    multiplier_circle as multiplier_circle,
    multiplier_diagram as multiplier_diagram,
    orbit_diagram as orbit_diagram,
)
from ._parameter_plane import parameter_plane as parameter_plane
from ._phase import phase_portrait as phase_portrait, poincare_section as poincare_section
from ._poincare import brute_force as brute_force, poincare_map as poincare_map
from ._time import time_series as time_series
from ._tube import perturbation_tube as perturbation_tube
from ._work_precision import work_precision as work_precision
