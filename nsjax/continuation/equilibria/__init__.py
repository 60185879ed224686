"""Branches of equilibria."""
