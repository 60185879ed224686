"""Roots between points that are kept."""

import math

import pytest

from nsjax._numerics._bracket import bracketed


def test_what_vanishes_together_is_found_between_the_same_points():
    asked = []

    def at(s):
        asked.append(s)
        return s

    seen = {0.0: 0.0, 2.0: 2.0}
    first = bracketed(seen, at, lambda x: x**2 - 2.0, 1e-14)
    assert abs(first - math.sqrt(2)) < 1e-13
    before = len(asked)
    assert abs(bracketed(seen, at, lambda x: (x**2 - 2.0) * (3 + x), 1e-14) - math.sqrt(2)) < 1e-12
    assert len(asked) - before <= 2 < before
    # One that is not known at a point between, and vanishes elsewhere.
    with_gap = {first: None}

    def other(x):
        if x in with_gap:
            raise KeyError(x)
        return x - 1

    assert abs(bracketed(seen, at, other) - 1) < 1e-12


def test_no_root():
    with pytest.raises(ValueError):
        bracketed({0.0: 0.0, 1.0: 1.0}, float, lambda x: x + 1)
    with pytest.raises(ArithmeticError, match="no point"):
        bracketed({0.0: 0.0, 1.0: 1.0}, lambda s: None, lambda x: x - 0.3)
    with pytest.raises(KeyError):
        bracketed({0.0: 0.0, 1.0: 1.0}, float, lambda x: {0.0: -1.0}[x])
