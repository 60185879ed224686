"""Curves of special points in the plane of two parameters."""
