"""Branches as tables of pandas."""

import numpy as np
import pytest
from branches import branch_of, special_at

import nsjax
from nsjax import gallery


def test_branches_as_a_table():
    pytest.importorskip("pandas")
    branch = nsjax.continue_equilibrium(gallery.DiscontinuousPitchfork(mu=-1.0), gallery.Line(0.0), "mu", (-1.0, 1.0))
    rows = branch.to_dataframe()
    assert len(rows) == sum(map(len, branch.branches)) and list(rows)[:4] == ["branch", "point", "mu", "x"]
    for k, one in enumerate(branch.branches):
        own = rows[rows.branch == k]
        np.testing.assert_array_equal(own["mu"], one.values)
        np.testing.assert_array_equal(own["x"], one.ys.x)
        np.testing.assert_array_equal(own["stable"], one.stable)
        np.testing.assert_array_equal(own["eigenvalue[0]"], one.eigenvalues[:, 0])
        np.testing.assert_array_equal(own["mode.left"], one.modes[:, 0])
        special = own[own.special != ""]
        assert list(special["special"]) == [point.name for point in one.special]
        np.testing.assert_allclose(special["mu"], [point.value for point in one.special], atol=1e-9)


def test_branches_of_orbits_as_a_table():
    pytest.importorskip("pandas")
    fold = special_at("fold", 1.0, (1.0, 0.0), (1.0, 0.0))
    pair = [(0.5, 0), (0.6, 0), (0.7, 0)]
    branch = branch_of(gallery.StickSlip(), "v_dr", [0.4, 0.7, 1.0], [1.0, 1.5, 2.0], pair, [fold], [2])
    rows = branch.to_dataframe()
    for name, values in dict(v_dr=branch.values, period=branch.periods, order=branch.orders, x=branch.ys.x).items():
        np.testing.assert_array_equal(rows[name], values)
    np.testing.assert_array_equal(rows["multiplier[0]"], branch.multipliers[:, 0])
    np.testing.assert_array_equal(rows["high.x"], branch.high.x)
    assert list(rows["special"]) == ["", "", fold.name] and list(rows["itinerary"]) == list(branch.itineraries)
