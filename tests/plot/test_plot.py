"""Pictures: what is drawn is the solution, cut at its events; nothing global changes."""

import dataclasses
import functools
import types
from typing import NamedTuple

import diffrax as dfx
import equinox as eqx
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
from nsjax.plot._style import declared


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
    ts, x, v = (np.concatenate([a[1:-1] for a in each]) for each in zip(*((p.t, p.y["x"], p.y["v"]) for p in pieces)))
    exact = jax.jit(jax.vmap(sol.evaluate))(jnp.asarray(ts))
    np.testing.assert_allclose(x, exact.x, atol=1e-12)
    np.testing.assert_allclose(v, exact.v, atol=1e-12)


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
    assert given is ax and (ax.get_xlabel(), ax.get_ylabel()) == ("v [m/s]", "x [m]")
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
    assert plot.time_series(stick_slip()).get_ylabel() == "x [m]"


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
    assert (ax.get_xlabel(), ax.get_ylabel()) == ("v [m/s]", "x [m]")


# Mistakes.


def test_mistakes_are_named():
    with pytest.raises(ValueError, match="no component 'z'.*x, v"):
        plot.phase_portrait(stick_slip(), "z")
    with pytest.raises(ValueError, match="SaveAt"):
        plot.time_series(nsjax.solve(Measured(), 0.0, 0.5, gallery.Motion(1.0, 0.0)))
    with pytest.raises(ValueError, match="at least 2 components"):
        plot.poincare_section(gallery.Line(np.zeros(3)))
    batch = jax.tree.map(lambda x: x[None] if isinstance(x, jax.Array) else x, ball())
    with pytest.raises(ValueError, match="batch"):
        plot.phase_portrait(batch)


# Orbits.


BELT = gallery.StickSlip(c=0.1, v_dr=0.5)
LOOSE = dict(
    solver=dfx.Tsit5(), stepsize_controller=dfx.PIDController(rtol=1e-9, atol=1e-9), max_steps=512, max_events=8
)


@functools.cache
def stable():
    return nsjax.find_orbit(BELT, gallery.Motion(1.0, -1.1), period=7.6, **LOOSE)


@functools.cache
def infinitely_unstable():
    segments = [nsjax.Segment(-1, 3.0), nsjax.Segment(0, 1.0, free=True), nsjax.Segment(-1, 2.5)]
    return nsjax.find_orbit(BELT, gallery.Motion(1.0, -0.575), segments=segments, **LOOSE)


def images(ax):
    """The corners of all images of which the tube is made."""
    return np.concatenate([[path.vertices for path in c.get_paths()] for c in ax.collections if c.get_zorder() == 0.5])


def drawn(ax, label):
    return next(line.get_xydata() for line in ax.get_lines() if line.get_label() == label)


def area(polygon):
    x, y = np.asarray(polygon).T
    return abs(x @ np.roll(y, -1) - y @ np.roll(x, -1)) / 2


@pytest.mark.slow
def test_perturbation_tube():
    orbit = stable()
    ax = plot.perturbation_tube(orbit, radius=(0.1, 0.05), labels={"x": "x [m]", "v": "v [m/s]"})
    assert (ax.get_xlabel(), ax.get_ylabel()) == ("x [m]", "v [m/s]")
    assert legend_names(ax)[:2] == ["perturbations (linear)", "one period later"]
    base, shape = np.array(orbit.y0), np.array([0.1, 0.05])
    first, last = drawn(ax, "perturbations (linear)") - base, drawn(ax, "one period later") - base
    np.testing.assert_allclose(np.linalg.norm(first / shape, axis=1), 1.0, atol=1e-12)
    np.testing.assert_allclose(last, first @ np.asarray(orbit.monodromy).T, atol=1e-8)
    # Liouville: up to the catch the area shrinks by exp(-c t / m); from then on there is none.
    polygons = images(ax)
    areas, middle = np.array([area(p[:-1]) for p in polygons]), polygons[:, :-1].mean(axis=1)
    stick, slip = orbit.events
    before = np.array([np.ptp(p[:, 1]) > 1e-9 and a > 1e-9 for p, a in zip(polygons, areas)])
    assert before[0] and not before[-1]
    assert np.all(np.diff(before.astype(int)) <= 0)
    np.testing.assert_allclose(areas[~before], 0, atol=1e-12)
    np.testing.assert_allclose(areas[before][-1] / area(first[:-1]), np.exp(-0.1 * stick.t), rtol=5e-3)
    # In stick the image moves with the belt: all of it, on it.
    on_belt = np.ptp(polygons[..., 1], axis=1) < 1e-9
    assert on_belt.any() and np.all((middle[on_belt, 0] > stick.y_after.x) & (middle[on_belt, 0] < slip.y_before.x))
    np.testing.assert_allclose(polygons[on_belt][..., 1], 0.5, atol=1e-9)


@pytest.mark.slow
def test_perturbation_tube_takes_axes_and_components():
    ax = plt.figure().add_subplot()
    given = plot.perturbation_tube(stable(), "v", "x", ellipses=5, samples=50, ax=ax, legend=False, surfaces=False)
    assert given is ax and (ax.get_xlabel(), ax.get_ylabel()) == ("v", "x") and ax.get_legend() is None
    assert 50 <= len(images(ax)) <= 53 and sum(line.get_linewidth() == 0.8 for line in ax.get_lines()) == 5
    # By default a twentieth of the extent, along both axes.
    extent = np.ptp(np.concatenate([[arc.y["v"], arc.y["x"]] for arc in arcs(stable().solve())], axis=1), axis=1)
    np.testing.assert_allclose(np.ptp(drawn(ax, "perturbations (linear)"), axis=0), extent / 10, rtol=1e-12)


@pytest.mark.slow
def test_mistakes_with_a_tube_are_named():
    with pytest.raises(ValueError, match="leaves a surface that repels"):
        plot.perturbation_tube(infinitely_unstable())
    with pytest.raises(ValueError, match="must be an `Orbit`, but is of type Solution"):
        plot.perturbation_tube(stick_slip())
    with pytest.raises(ValueError, match="no component 'z'"):
        plot.perturbation_tube(stable(), "z")
    for radius in (0.0, -1.0, np.nan, (0.1, 0.0)):
        with pytest.raises(ValueError, match="`radius` must be positive"):
            plot.perturbation_tube(stable(), radius=radius)
    with pytest.raises(ValueError, match="`samples` must be a positive integer"):
        plot.perturbation_tube(stable(), samples=0)


@pytest.mark.slow
def test_an_orbit_that_no_solution_follows_is_drawn_arc_by_arc():
    """It leaves the belt long before F_stick is reached: a solution does not."""
    orbit = infinitely_unstable()
    onto, off = orbit.events
    ax = plot.phase_portrait(orbit)
    (slides,) = [line for line in thick(ax) if len(line.get_xdata())]
    np.testing.assert_allclose(slides.get_xdata()[[0, -1]], [onto.y_after.x, off.y_before.x], atol=1e-4)
    ends = [line.get_xydata() for line in ax.get_lines() if line.get_label() == "belt < 0"]
    np.testing.assert_allclose(ends[-1][-1], orbit.y0, atol=1e-7)
    # Unstable orbits are dashed, and the legend says so; a stable one beside it is not.
    assert slides.is_dashed() and "unstable" in legend_names(ax)
    both = plot.phase_portrait(stable(), surfaces=False)
    plot.phase_portrait(orbit, ax=both)
    assert [line.is_dashed() for line in thick(both) if len(line.get_xdata())] == [False, True]
    handle = both.get_legend().legend_handles[legend_names(both).index("belt < 0")]
    assert not handle.is_dashed()
    assert plot.time_series(orbit).get_lines()[0].get_xdata()[0] == 0


def with_multipliers(*multipliers):
    """As much of an orbit as the picture of its multipliers needs."""
    system = types.SimpleNamespace(period=None)
    stable = max(abs(x) for x in multipliers) <= 1
    return types.SimpleNamespace(multipliers=jnp.array(multipliers, complex), stable=jnp.asarray(stable), system=system)


@pytest.mark.parametrize(
    "orbit",
    [
        pytest.param(lambda: with_multipliers(jnp.inf, 1.0), id="given"),
        pytest.param(lambda: infinitely_unstable(), id="found", marks=pytest.mark.slow),
    ],
)
def test_infinite_multipliers_stand_at_the_edge(orbit):
    ax = plot.multipliers(orbit())
    (arrow,) = [line for line in ax.get_lines() if line.get_marker() == ">"]
    assert arrow.get_transform() == ax.get_yaxis_transform() and arrow.get_xydata().tolist() == [[1.0, 0.0]]
    assert [text.get_text() for text in ax.texts] == ["∞"]
    (trivial,) = [line for line in ax.get_lines() if line.get_marker() == "o"]
    np.testing.assert_allclose(trivial.get_xydata(), [[1.0, 0.0]], atol=1e-8)
    assert trivial.get_markerfacecolor() == "white"


@pytest.mark.parametrize(
    "orbits",
    [
        pytest.param(lambda: [with_multipliers(1.0, 0.0), with_multipliers(jnp.inf, 1.0)], id="given"),
        pytest.param(lambda: [stable(), infinitely_unstable()], id="found", marks=pytest.mark.slow),
    ],
)
def test_multipliers_of_several_orbits(orbits):
    ax = plot.multipliers(orbits())
    assert {"orbit 1, stable", "orbit 2, unstable", "along the orbit"} == set(legend_names(ax))
    assert sum(len(line.get_xdata()) == 361 for line in ax.get_lines()) == 1
    assert {line.get_marker() for line in ax.get_lines() if line.get_label() == "orbit 1, stable"} == {"o"}
    with pytest.raises(ValueError, match="empty"):
        plot.multipliers([])
    failed = types.SimpleNamespace(multipliers=np.full(2, np.nan), system=types.SimpleNamespace(period=None))
    with pytest.raises(ValueError, match="was found"):
        plot.multipliers(failed)


@pytest.mark.slow
def test_bifurcation_diagram():
    """Stable and unstable stretches end where they should; points are named; orbits are grey."""
    system = gallery.Hopf(-1.0)
    branch = nsjax.continue_equilibrium(system, gallery.Plane(0.0, 0.0), "mu", (-1.0, 1.0))
    _, above = nsjax.continuation.hopf_orbits(system, branch.bifurcations[0], [0.25, 0.5], sizes=[0.5])
    ax = plot.bifurcation_diagram(branch, orbits=above, labels={"mu": "μ [-]", "x1": "x [m]"})
    assert ax.get_xlabel() == "μ [-]" and ax.get_ylabel() == "x [m]"
    lines = {line.get_label(): line for line in ax.lines}
    stable, unstable = lines["stable equilibrium"], lines["unstable equilibrium"]
    assert stable.get_linestyle() == "-" and unstable.get_linestyle() == "--"
    np.testing.assert_allclose([stable.get_xdata().min(), unstable.get_xdata().max()], [-1, 1])
    assert abs(stable.get_xdata().max()) < 0.05 and abs(unstable.get_xdata().min()) < 0.05
    heights = sorted(y for line in ax.lines if "periodic" in str(line.get_label()) for y in line.get_ydata())
    np.testing.assert_allclose(heights, [-np.sqrt(0.5), -0.5, 0.5, np.sqrt(0.5)], rtol=2e-3)
    assert [text.get_text() for text in ax.texts] == ["Hopf,\nsupercritical"]


@pytest.mark.slow
def test_bifurcation_diagram_of_a_function():
    start = gallery.Line(0.0)
    branch = nsjax.continue_equilibrium(gallery.DiscontinuousPitchfork(-1.0), start, "mu", (-1.0, 1.0))
    ax = plot.bifurcation_diagram(branch, lambda y: y.x**2, labels={"measure": "x² [m²]"}, legend=False)
    assert ax.get_ylabel() == "x² [m²]" and ax.get_legend() is None
    assert min(np.min(line.get_ydata()) for line in ax.lines) >= 0
    assert [text.get_text() for text in ax.texts] == ["discontinuous\npitchfork,\nsupercritical"]
    with pytest.raises(ValueError, match="`measure` must be one of x, or a function, but got 'v'"):
        plot.bifurcation_diagram(branch, "v")


def test_bifurcation_diagram_with_words_and_lines_of_ones_own():
    branch = nsjax.continue_equilibrium(gallery.SaddleNode(1.0), gallery.Line(1.0), "mu", (-1.0, 1.0))
    (special,) = branch.special_points
    ax = plot.bifurcation_diagram(branch, names=lambda b: "f" if b is special else "", color="C1", linewidth=0.7)
    assert [text.get_text() for text in ax.texts] == ["f"]
    lines = [line for line in ax.lines if line.get_label().endswith("equilibrium")]
    assert {line.get_label() for line in lines} == {"stable equilibrium", "unstable equilibrium"}
    assert {(line.get_color(), line.get_linewidth()) for line in lines} == {("C1", 0.7)}
    assert not plot.bifurcation_diagram(branch, names=False).texts


# Charts of attractors.


def chart():
    """Two columns of three: period 1, period 2, chaos; undecided, failed, a long itinerary."""
    periods, classes = np.array([[1, 2, 0], [0, -1, 4]]), np.array([[0, 1, -1], [-1, -1, -1]])
    chaotic, rates = np.array([[0, 0, 1], [0, 0, 0]], bool), np.array([[-0.3, -np.inf, 0.1], [0.0, np.nan, -0.1]])
    values = np.array([1.0, 2.0]), np.array([0.1, 0.2, 0.3])
    zero = np.zeros((2, 3), int)
    words = ("belt0 belt-", "belt+")
    return nsjax.maps.AttractorChart(
        ("omega", "a"), values, periods, classes, words, chaotic, rates, rates, zero, (), zero
    )


def test_attractor_chart():
    """The colours of the cells are those of the legend, chaos is dark and what is not known white."""
    found = chart()
    for by, names in (
        ("period", ["period 1", "period 2", "period 4", "chaos", "undecided", "failed"]),
        ("itinerary", ["belt0 belt-", "belt+", "others", "chaos", "undecided", "failed"]),
    ):
        ax = plot.attractor_chart(found, by, labels={"omega": "ω [rad/s]"})
        assert (ax.get_xlabel(), ax.get_ylabel()) == ("ω [rad/s]", "a") and legend_names(ax) == names
        ax.figure.canvas.draw()
        (mesh,) = ax.collections
        cells = mesh.get_facecolors().reshape(3, 2, 4)  # rows go along the second parameter
        colour = {line.get_label(): matplotlib.colors.to_rgba(line.get_markerfacecolor()) for line in ax.get_lines()}
        want = [[names[0], "undecided"], [names[1], "failed"], ["chaos", names[2]]]
        np.testing.assert_allclose(cells, [[colour[name] for name in row] for row in want], atol=1e-6)
        assert len({tuple(c) for c in colour.values()}) == 6
    ends = [f"belt0 {'belt- belt+ ' * 9}{end}" for end in ("belt0", "belt-", "belt- belt0")]
    many = dataclasses.replace(found, itineraries=tuple(ends), classes=np.array([[0, 1, -1], [-1, -1, 2]]))
    assert len(legend_names(plot.attractor_chart(many, "itinerary"))) == 6
    ax = plot.attractor_chart(found, "exponent", labels={"exponent": "λ₁ [1/s]"})
    (mesh,) = ax.collections
    low, high = mesh.get_clim()
    assert low == -high < 0 and mesh.get_array().mask.sum() == 1 and ax.figure.axes[1].get_ylabel() == "λ₁ [1/s]"
    with pytest.raises(ValueError, match="`by` must be"):
        plot.attractor_chart(found, "phase")


class Measured(nsjax.System):
    """Units in a comment, and in metadata; of one parameter none."""

    omega: float = 2.0  # frequency [rad/s]
    damping: float = eqx.field(default=0.1, metadata=dict(unit="1/s"))
    power: float = 1.0

    def vector_field(self, t, y, s):
        return gallery.Motion(y.v, -(self.omega**2) * y.x - self.damping * y.v)


def test_axes_have_the_units_that_classes_declare():
    """Where no label is given; of what declares none the name stands alone."""
    sol = nsjax.solve(Measured(), 0.0, 1.0, gallery.Motion(1.0, 0.0), saveat=dfx.SaveAt(dense=True))
    ax = plot.time_series(sol, "v", legend=False)
    assert (ax.get_xlabel(), ax.get_ylabel()) == ("t [s]", "v [m/s]")
    ax = plot.phase_portrait(sol, labels={"v": "velocity"}, legend=False)
    assert (ax.get_xlabel(), ax.get_ylabel()) == ("x [m]", "velocity")
    branch = nsjax.continue_equilibrium(Measured(), gallery.Motion(0.0, 0.0), "power", (0.5, 1.5))
    ax = plot.bifurcation_diagram(branch, legend=False)
    assert (ax.get_xlabel(), ax.get_ylabel()) == ("power", "x [m]")
    assert declared(None, Measured()) == {"omega": "omega [rad/s]", "damping": "damping [1/s]", "t": "t [s]"}
