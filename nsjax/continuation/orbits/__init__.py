"""Branches of periodic orbits."""
