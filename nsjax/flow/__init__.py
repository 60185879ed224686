"""One solution: steps, the events that end them, and what is kept of it."""

from ._method import method_for as method_for
from ._results import is_okay as is_okay, RESULTS as RESULTS, SolveError as SolveError
from ._solution import Event as Event, Events as Events, Itinerary as Itinerary, Solution as Solution
from ._solve import solve as solve
from .steppers._exponential import Affine as Affine, Exponential as Exponential
from .steppers._taylor import Taylor as Taylor
