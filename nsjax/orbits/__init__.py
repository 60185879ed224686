"""Periodic orbits: shooting, segments, searches."""

from ._find_orbit import find_orbit as find_orbit, find_orbits as find_orbits
from ._orbit import Orbit as Orbit
from .segments._guess import Segment as Segment
