"""Clicks on a diagram, by events as a mouse makes them."""

import matplotlib.pyplot as plt
import numpy as np
import pytest
from branches import branch_of, special_at
from matplotlib.backend_bases import MouseEvent

import nsjax
from nsjax import gallery, plot
from nsjax.gallery import Line
from nsjax.plot._orbit_branch import measured


@pytest.fixture(autouse=True)
def closed():
    yield
    plt.close("all")


@pytest.fixture(scope="module")
def pitchfork():
    return nsjax.continue_equilibrium(gallery.Pitchfork(mu=-1.0), Line(0.0), "mu", (-1.0, 1.0))


@pytest.fixture
def orbits():
    """Made by hand: two branches, one of them higher."""
    fold = special_at("fold", 1.0, (1.0, 0.0), (1.0, 0.0))
    two = [(0.5, 0)] * 3
    other = branch_of(gallery.StickSlip(), "v_dr", [0.4, 0.7, 1.0], [3.0, 3.1, 3.2], two, [fold], [2])
    return branch_of(gallery.StickSlip(), "v_dr", [0.4, 0.7, 1.0], [1.0, 1.5, 2.0], two, [fold], [2], [other])


def click(explorer, x, y, axes=None):
    """On a place of the diagram, in its numbers."""
    canvas = explorer.figure.canvas
    canvas.draw()
    place = (axes or explorer.diagram).transData.transform((x, y))
    canvas.callbacks.process("button_press_event", MouseEvent("button_press_event", canvas, *place, 1))
    canvas.draw()


def test_the_point_next_to_the_click_is_shown(pitchfork):
    explorer = plot.explore(pitchfork)
    assert explorer.selected is None and explorer.orbit is None
    for one in pitchfork.branches:
        i = len(one) // 3
        click(explorer, one.values[i], one.ys.x[i] + 1e-4)
        chosen, point = explorer.selected
        there = pitchfork.branches[chosen]
        np.testing.assert_allclose([there.values[point], there.ys.x[point]], [one.values[i], one.ys.x[i]], atol=1e-9)
        drawn = [line for line in explorer.detail.get_lines() if line.get_marker() == "x"]
        np.testing.assert_allclose(drawn[0].get_xdata(), there.eigenvalues[point].real)
        words = " ".join(text.get_text() for text in explorer.detail.texts)
        assert f"mu = {there.values[point]:.6g}" in words and ("unstable" in words) == (not there.stable[point])
        assert explorer.orbit is None


def test_clicks_elsewhere_are_none(pitchfork):
    explorer = plot.explore(pitchfork)
    click(explorer, 0.5, 0.5, axes=explorer.detail)
    assert explorer.selected is None


def test_orbits_are_found_where_they_are_clicked(orbits, monkeypatch):
    class Found:
        y0 = 1.0
        result = nsjax.RESULTS.successful

        def __init__(self, period):
            self.period = period

    asked = []

    def orbit(self, index, **how):
        asked.append((index, how.get("method")))
        found = Found(self.periods[index])
        if how.get("method") == "shooting" and index == 2:  # too unstable
            found.result = nsjax.RESULTS.orbit_not_found
        return found

    monkeypatch.setattr(type(orbits), "orbit", orbit)
    monkeypatch.setattr("nsjax.plot._explore.Explorer._show_orbit", lambda *args: None)
    explorer = plot.explore(orbits)
    heights = [measured(None, one) for one in orbits.branches]
    for _ in range(2):
        click(explorer, 0.7, heights[1][1])
        assert explorer.selected == (1, 1) and explorer.orbit.period == orbits.branches[1].periods[1]
    assert asked == [(1, "shooting")]  # what is known is not looked for again
    click(explorer, 1.0, heights[0][2])
    assert asked[1:] == [(2, "shooting"), (2, None)] and explorer.selected == (0, 2)


def test_what_is_no_branch():
    with pytest.raises(TypeError, match="`branch` must be a `Branch` or an `OrbitBranch`, but got StickSlip"):
        plot.explore(gallery.StickSlip())


@pytest.mark.slow
def test_an_orbit_is_drawn():
    start = nsjax.find_orbit(gallery.StickSlip(c=0.1, v_dr=0.5), gallery.Motion(2.0, 0.0), period=8.0)
    branch = nsjax.continue_orbit(start.system, start, "v_dr", (0.4, 1.3))
    explorer = plot.explore(branch)
    for i in (5, len(branch) - 3):  # a stable one, and one that no flow follows
        click(explorer, branch.values[i], measured(None, branch)[i])
        assert explorer.selected == (0, i)
        assert explorer.orbit.period == pytest.approx(branch.periods[i], abs=1e-9)
        drawn = np.concatenate([line.get_ydata() for line in explorer.detail.get_lines()[:4]])
        assert np.nanmax(np.abs(drawn)) == pytest.approx(max(abs(branch.low.v[i]), branch.high.v[i]), rel=1e-2)
