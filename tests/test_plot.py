"""Pictures: what is drawn is the solution, cut at its events; nothing global changes."""

import functools
import types
from typing import NamedTuple

import diffrax as dfx
import jax
import jax.numpy as jnp
import matplotlib
import matplotlib.pyplot as plt
import numpy as np
import pytest
from jax import Array

import nsjax
from nsjax import gallery, plot
from nsjax.plot._path import arcs


DENSE = dfx.SaveAt(dense=True, t1=True)


@functools.cache
def stick_slip(saveat=DENSE):
    return nsjax.solve(gallery.thesis("3.4"), 0.0, 20.0, gallery.Motion(2.5, 0.0), saveat=saveat)


@functools.cache
def ball():
    return nsjax.solve(gallery.thesis("1.1(3)"), 0.0, 2.0, gallery.Motion(1.0, 0.0), saveat=DENSE)


@pytest.fixture(autouse=True)
def global_style():
    before = dict(matplotlib.rcParams)
    yield
    plt.close("all")
    assert dict(matplotlib.rcParams) == before


def thick(ax):
    return [line for line in ax.get_lines() if line.get_linewidth() == 3.5]


def legend_names(ax):
    return [text.get_text() for text in ax.get_legend().get_texts()]


# Arcs.


def test_arcs_are_the_solution_between_events():
    sol = stick_slip()
    pieces = arcs(sol)
    assert [arc.mode for arc in pieces] == [(-1,), (0,), (-1,), (0,)]
    cuts = [0.0, *sol.events.t[:3].tolist(), 20.0]
    for arc, start, stop in zip(pieces, cuts, cuts[1:]):
        np.testing.assert_allclose(arc.t[[0, -1]], [start, stop], atol=1e-12)
        exact = jax.vmap(sol.evaluate)(jnp.asarray(arc.t[1:-1]))
        np.testing.assert_allclose(arc.y["x"][1:-1], exact.x, atol=1e-12)
        np.testing.assert_allclose(arc.y["v"][1:-1], exact.v, atol=1e-12)


def test_arcs_have_both_sides_of_an_impact():
    sol = ball()
    first, second = arcs(sol)[:2]
    assert first.t[-1] == pytest.approx(np.sqrt(2 / 9.81), rel=1e-9)
    assert second.y["v"][0] == pytest.approx(-0.8 * first.y["v"][-1], rel=1e-9)


def test_saved_steps_give_the_same_arcs_as_dense_output():
    for dense, saved in zip(arcs(stick_slip()), arcs(stick_slip(dfx.SaveAt(steps=True))), strict=True):
        # Nothing was asked for at t0, so the first arc begins after the first step.
        assert saved.mode == dense.mode
        assert saved.t[-1] == pytest.approx(dense.t[-1], abs=1e-12)
        np.testing.assert_allclose(saved.y["x"], np.interp(saved.t, dense.t, dense.y["x"]), atol=1e-3)


def test_arcs_of_a_solution_in_backward_time():
    system = gallery.thesis("example 2.1")
    sol = nsjax.solve(system, 1.0, 0.0, gallery.Plane(3.0, -0.5), saveat=DENSE)
    below, above = arcs(sol)
    # x2 falls by 6 below 1 and by 2 above it: forward in time it came from above.
    assert (below.mode, above.mode) == ((-1,), (1,))
    assert below.t[0] == 1.0 and above.t[-1] == 0.0
    np.testing.assert_allclose(below.t[-1], 0.75, atol=1e-12)
    np.testing.assert_allclose(above.y["x2"][[0, -1]], [1.0, 2.5], atol=1e-12)


def test_components_are_named():
    class Nested(NamedTuple):
        q: Array
        rest: dict

    names = list(plot.components(Nested(jnp.zeros(2), {"w": jnp.zeros(())})))
    assert names == ["q[0]", "q[1]", "rest.w"]
    assert list(plot.components(jnp.zeros(2))) == ["y[0]", "y[1]"]
    assert plot.components({"a": np.arange(6.0).reshape(3, 2)}, ndim=1)["a[1]"].tolist() == [1.0, 3.0, 5.0]


# Pictures.


def test_phase_portrait():
    ax = plot.phase_portrait(stick_slip(), labels={"x": "x [m]", "v": "v [m/s]"})
    assert (ax.get_xlabel(), ax.get_ylabel()) == ("x [m]", "v [m/s]")
    assert legend_names(ax) == ["belt < 0", "belt = 0, slides", "event", "belt: h = 0"]
    sliding = [line for line in thick(ax) if len(line.get_xdata())]
    assert len(sliding) == 2
    for line in sliding:
        np.testing.assert_allclose(line.get_ydata(), 0.2, atol=1e-12)
    assert {text.get_text() for text in ax.texts} == {"+", "−"}
    plus = next(text for text in ax.texts if text.get_text() == "+")
    assert plus.xy[1] == pytest.approx(0.2, abs=1e-9) and plus.get_position()[1] > 0


def test_phase_portrait_draws_where_it_is_told():
    ax = plt.figure().add_subplot()
    given = plot.phase_portrait(
        stick_slip(), "v", "x", ax=ax, surfaces=False, events=False, legend=False, color="0.7", linewidth=0.5
    )
    assert given is ax and (ax.get_xlabel(), ax.get_ylabel()) == ("v", "x")
    assert len(ax.get_lines()) == 4 and {line.get_color() for line in ax.get_lines()} == {"0.7"}
    assert ax.get_legend() is None and not ax.collections


def test_surface_is_drawn_along_either_axis():
    ax = plot.phase_portrait(stick_slip(), "v", "x")
    surface = ax.collections[0].get_paths()[0].vertices
    np.testing.assert_allclose(surface[:, 0], 0.2, atol=1e-9)


def test_impacts_jump_and_their_far_side_is_hatched():
    sol = ball()
    ax = plot.phase_portrait(sol)
    jumps = [line for line in ax.get_lines() if line.get_linestyle() == ":" and len(line.get_xdata()) == 2]
    assert len(jumps) == len(sol.events) == 3
    assert any(hatch for collection in ax.collections for hatch in getattr(collection, "hatches", []) if hatch)


def test_an_orbit_is_drawn_over_one_period():
    orbit = types.SimpleNamespace(solve=lambda saveat: stick_slip(DENSE) if saveat.dense else None)
    assert plot.time_series(orbit).get_xlim()[1] > 20.0


def test_time_series():
    ax = plot.time_series(ball(), "v", labels={"t": "t [s]", "v": "v [m/s]"})
    assert (ax.get_xlabel(), ax.get_ylabel()) == ("t [s]", "v [m/s]")
    events = next(line for line in ax.get_lines() if line.get_label() == "event")
    np.testing.assert_allclose(events.get_xdata(), ball().events.t[:3])
    assert plot.time_series(stick_slip()).get_ylabel() == "x"


def test_fundamental_matrix_is_cut_at_events():
    ts = np.linspace(0.0, 1.0, 11)
    phi = np.where(ts[:, None, None] < 0.55, np.eye(2), 2 * np.eye(2))
    axes = plot.fundamental_matrix(ts, phi, [0.55], labels={"t": "t [s]", (2, 2): "last [-]"})
    assert axes.shape == (2, 2)
    assert [len(line.get_xdata()) for line in axes[0, 0].get_lines()] == [6, 5, 2]  # two pieces, one event
    assert axes[1, 1].get_ylabel() == "last [-]" and axes[1, 1].get_xlabel() == "t [s]"
    assert axes[0, 1].get_ylabel() == r"$\Phi_{12}$"
    with pytest.raises(ValueError, match="shape"):
        plot.fundamental_matrix(ts[1:], phi)
    with pytest.raises(ValueError, match="axes"):
        plot.fundamental_matrix(ts, phi, axes=axes[:1])
    whole = plot.fundamental_matrix(ts, phi, stick_slip().events)  # a log, whose events all come later
    assert len(whole[0, 0].get_lines()[0].get_xdata()) == 11


@pytest.mark.parametrize("period, hollow", [(None, 1), (6.0, 0)])
def test_multipliers(period, hollow):
    orbit = types.SimpleNamespace(multipliers=jnp.array([1.0, -0.5 + 0j]), system=types.SimpleNamespace(period=period))
    ax = plot.multipliers(orbit)
    dots = [line for line in ax.get_lines() if line.get_marker() == "o"]
    assert sum(line.get_markerfacecolor() == "white" for line in dots) == hollow
    assert sorted(x for line in dots for x in line.get_xdata()) == [-0.5, 1.0]
    assert (ax.get_xlabel(), ax.get_aspect()) == ("Re λ [-]", 1.0)


def test_poincare_section():
    ax = plot.poincare_section(gallery.Motion(np.arange(5.0), np.arange(5.0) ** 2), "v", "x", labels={"v": "v [m/s]"})
    (dots,) = ax.get_lines()
    assert dots.get_xdata().tolist() == [0, 1, 4, 9, 16] and dots.get_linestyle() == "None"
    assert (ax.get_xlabel(), ax.get_ylabel()) == ("v [m/s]", "x")


# Mistakes.


def test_mistakes_are_named():
    with pytest.raises(ValueError, match="no component 'z'.*x, v"):
        plot.phase_portrait(stick_slip(), "z")
    with pytest.raises(ValueError, match="SaveAt"):
        plot.time_series(nsjax.solve(gallery.thesis("(2.3)"), 0.0, 0.5, gallery.Line(1.0)))
    with pytest.raises(ValueError, match="at least 2 components"):
        plot.poincare_section(gallery.Line(np.zeros(3)))
    batch = jax.tree.map(lambda x: x[None] if isinstance(x, jax.Array) else x, ball())
    with pytest.raises(ValueError, match="batch"):
        plot.phase_portrait(batch)
