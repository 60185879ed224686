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


def test_branches_of_many_lanes_as_a_table():
    """Rows past the end of a lane are left out."""
    pytest.importorskip("pandas")
    numbers = np.arange(6.0).reshape(2, 3)
    states = gallery.Motion(numbers, 10 + numbers)
    lanes = nsjax.continuation.OrbitBranches(
        systems=gallery.StickSlip(), parameter="v_dr", values=numbers / 10, periods=6 + numbers, ts=0 * numbers,
        ys=states, orders=np.array([1, 2]), low=states, high=states, multipliers=np.ones((2, 3, 2)),
        stable=numbers < 2, kinds=np.array([["", "fold", ""], ["", "", "flip"]]), start=np.zeros(2, int),
        num=np.array([2, 3]), ends=np.full((2, 2), "lost"),
    )  # fmt: skip
    rows = lanes.to_dataframe()
    assert list(zip(rows["lane"], rows["point"])) == [(0, 0), (0, 1), (1, 0), (1, 1), (1, 2)]
    np.testing.assert_array_equal(rows["v_dr"], [0.0, 0.1, 0.3, 0.4, 0.5])
    np.testing.assert_array_equal(rows["v"], [10, 11, 13, 14, 15])
    assert list(rows["order"]) == [1, 1, 2, 2, 2] and list(rows["kind"]) == ["", "fold", "", "", "flip"]
    assert {"multiplier[1]", "high.x", "low.v", "stable"} <= set(rows)


def test_curves_of_special_points_as_a_table():
    pytest.importorskip("pandas")
    cusp = nsjax.continuation.CodimensionTwo("cusp", np.array([0.2, 0.3]), 6.0, np.ones(2), 0.0, gallery.Motion(1, 0))
    curve = nsjax.continuation.BifurcationCurve(
        system=gallery.StickSlip(), kind="fold", surfaces=(), parameters=("c", "v_dr"),
        values=np.array([[0.1, 0.2], [0.2, 0.3], [0.3, 0.1]]), periods=np.array([5.0, 6.0, 7.0]),
        multipliers=np.ones((3, 2)), ts=np.zeros(3), ys=gallery.Motion(np.arange(3.0), np.ones(3)), special=(cusp,),
        indices=(1,), ends=("c = 0.1", "c = 0.3"),
    )  # fmt: skip
    rows = curve.to_dataframe()
    assert list(rows)[:5] == ["c", "v_dr", "period", "t", "x"] and list(rows["special"]) == ["", "cusp", ""]
    np.testing.assert_array_equal(rows["v_dr"], [0.2, 0.3, 0.1])
