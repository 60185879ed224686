"""Orbits as a boundary-value problem, from event to event."""
