"""Diagrams of branches of periodic orbits: what is drawn of branches whose numbers are known."""

import dataclasses

import matplotlib.pyplot as plt
import numpy as np
import pytest
from branches import branch_of, special_at
from matplotlib.text import Text

from nsjax import gallery, plot
from nsjax.continuation import OrbitHalfBranch
from nsjax.maps._brute_force import BruteForce
from nsjax.plot._diagram import write_names
from nsjax.plot._multiplier_pair import with_splits
from nsjax.plot._style import legend


LABELS = {"omega": "ω [rad/s]", "v_dr": "v [m/s]", "x": "x [m]", "v": "x' [m/s]"}


@pytest.fixture(autouse=True)
def closed():
    yield
    plt.close("all")


@pytest.fixture(scope="module")
def forced():
    """A corner at 1.5 at which 0.8 jumps to 2, a second branch that begins there, and a flip at 1.9."""
    system = gallery.ForcedFriction()
    corner = special_at("symmetry breaking", 1.5, (0.8, 0.0), (2.0, 0.1))
    flip = special_at("flip", 1.9, (-1.0, 0.25))
    nothing = special_at("none", 1.3, (0.3, 0.0), (-0.5, 0.0))
    other = branch_of(
        system, "omega", [1.5, 1.3, 1.3, 1.2], [2.0, 1.9, 1.9, 1.5], [(0.4, 0), (0.3, 0), (-0.5, 0), (-0.6, 0)],
        [corner, nothing], [0, 1],
    )  # fmt: skip
    return branch_of(
        system, "omega", [1.0, 1.25, 1.5, 1.5, 1.75, 1.9, 2.0], [1.0, 1.5, 2.0, 2.0, 2.25, 2.5, 3.0],
        [(0.5, 0), (0.6, 0), (0.8, 0), (2, 0.1), (1.5, -0.9), (-1.0, 0.25), (-0.9, 0.25)],
        [corner, flip], [2, 5], [other],
    )  # fmt: skip


@pytest.fixture(scope="module")
def belt():
    """A fold at v_dr = 1 beyond which orbits are infinitely unstable."""
    fold = special_at(
        "infinitely unstable fold", 1.0, (1.0, 0.0), (np.inf, np.inf), parameter="v_dr",
        multipliers=(np.array([1, 0], complex), np.array([np.inf, 1], complex)),
        monodromies=(np.diag([1.0, 0.0]), np.full((2, 2), np.inf)),
    )  # fmt: skip
    inf = np.inf
    return branch_of(
        gallery.StickSlip(c=0.1), "v_dr", [0.2, 0.6, 1.0, 1.0, 0.6], [2.0, 2.1, 2.5, 2.5, 1.9],
        [(1, 0), (1, 0), (1, 0), (inf, 1), (inf, 1)], [fold], [2],
    )  # fmt: skip


def points(line):
    return np.column_stack(line.get_data())


def lines(ax, label):
    """All of this kind; those after the first have an underscore before the label, which legends leave out."""
    return [points(line) for line in ax.lines if line.get_label() in (label, f"_{label}")]


def texts(ax):
    return sorted(text.get_text() for text in ax.texts)


# The diagram.


@pytest.mark.parametrize("inside", [True, False])
def test_stretches_end_where_stability_changes(forced, inside):
    """At the flip whether a multiplier is in the circle or not is rounding."""
    stable = np.where(np.arange(7) == 5, inside, forced.stable)
    ax = plot.orbit_diagram(dataclasses.replace(forced, stable=stable), labels=LABELS)
    assert (ax.get_xlabel(), ax.get_ylabel()) == ("ω [rad/s]", "max |x| [m]")
    stable = lines(ax, "stable periodic orbit")
    assert [tuple(line[[0, -1], 0]) for line in stable] == [(1.0, 1.5), (1.9, 2.0), (1.5, 1.2)]
    (unstable,) = lines(ax, "unstable periodic orbit")
    np.testing.assert_allclose(unstable, [[1.5, 2.0], [1.75, 2.25], [1.9, 2.5]])
    styles = {line.get_label(): line.get_linestyle() for line in ax.lines}
    assert (styles["stable periodic orbit"], styles["unstable periodic orbit"]) == ("-", "--")
    assert texts(ax) == ["discontinuous\nsymmetry breaking", "flip", "no bifurcation"]


def test_marks_tell_what_a_point_is(forced):
    ax = plot.orbit_diagram(forced, names=False)
    marks = {points(line)[0, 0]: line for line in ax.lines if line.get_marker() == "o"}
    assert {x: line.get_markerfacecolor() for x, line in marks.items()} == {1.5: "C3", 1.9: "C0", 1.3: "white"}
    assert [points(marks[x])[0, 1] for x in (1.3, 1.5, 1.9)] == [1.9, 2.0, 2.5]
    assert not texts(ax)


def test_names_of_ones_own(forced):
    ax = plot.orbit_diagram(forced, names=lambda special: {"flip": "A", "symmetry breaking": "B"}.get(special.kind, ""))
    assert texts(ax) == ["A", "B"]


@pytest.mark.parametrize(
    "measure, label, first",
    [
        ("v", "max |x'| [m/s]", 2.0),
        (lambda b: b.periods, "measure", 6.0),
        (lambda b: b.high.x - b.low.x, "measure", 1.5),
    ],
)
def test_measures(forced, measure, label, first):
    ax = plot.orbit_diagram(forced, measure, labels=LABELS, legend=False)
    assert ax.get_ylabel() == label and ax.get_legend() is None
    assert points(ax.lines[0])[0, 1] == first


def test_wrong_measures(forced):
    with pytest.raises(ValueError, match="no component 'w'"):
        plot.orbit_diagram(forced, "w")
    with pytest.raises(ValueError, match="a number for each point"):
        plot.orbit_diagram(forced, lambda b: 1.0)


def test_infinitely_unstable_orbits_are_dotted(belt):
    ax = plot.orbit_diagram(belt, labels=LABELS)
    (dotted,) = lines(ax, "infinitely unstable periodic orbit")
    np.testing.assert_allclose(dotted, [[1.0, 2.5], [0.6, 1.9]])
    assert texts(ax) == ["discontinuous\ninfinitely unstable fold"]


def test_an_axis_that_was_set_stays(forced):
    ax = plt.figure().add_subplot()
    ax.set(xlim=(1.4, 1.6), ylim=(1.9, 2.1))
    plot.orbit_diagram(forced, ax=ax)
    assert (ax.get_xlim(), ax.get_ylim()) == ((1.4, 1.6), (1.9, 2.1))


# Multipliers.


def test_multipliers_jump_along_their_path(forced):
    ax = plot.multiplier_diagram(forced, part="real", labels=LABELS)
    assert (ax.get_xlabel(), ax.get_ylabel()) == ("ω [rad/s]", "Re λ [-]")
    jumps = lines(ax, "jump of the multipliers")
    at = {(jump[0, 0], *np.round(jump[[0, -1], 1], 12)) for jump in jumps}
    assert at == {(1.5, 0.8, 2.0), (1.5, 0.0, 0.1), (1.3, 0.3, -0.5), (1.3, 0.0, 0.0)}
    assert all(np.ptp(jump[:, 0]) == 0 for jump in jumps)
    horizontal = {points(line)[0, 1] for line in ax.lines if points(line)[:, 0].tolist() == [0, 1]}
    assert horizontal == {-1.0, 1.0}


def test_multipliers_are_followed_not_sorted(forced):
    """1.5, -0.9, then -1, 0.25: by modulus the first would go from 1.5 to -1."""
    ax = plot.multiplier_diagram(forced, part="real")
    ends = [tuple(line[-1]) for line in lines(ax, "unstable periodic orbit")]
    assert ends == [(1.9, 0.25), (1.9, -1.0)]
    ax = plot.multiplier_diagram(forced, part="real", which="largest")
    assert [tuple(line[-1]) for line in lines(ax, "unstable periodic orbit")] == [(1.9, -1.0)]
    assert len(lines(ax, "jump of the multipliers")) == 2


def pair_over(c):
    """Multipliers of x'' + 2 c x' + x = 0 after three units of time, which are real for c >= 1."""
    root = np.sqrt(np.asarray(c)[..., None].astype(complex) ** 2 - 1) * [1, -1]
    return np.exp(3 * (root - np.asarray(c)[..., None]))


@pytest.mark.parametrize("way", [1, -1])
def test_a_pair_splits_as_a_square_root(way):
    """Of the closed form trace and determinant hold at each new point: straight lines are off by 2e-3. Beside the split
    there are new points in three intervals, in the others none."""
    c = np.linspace(0.9, 1.13, 12)[::way]
    x, rows, kinds = with_splits(c, pair_over(c)[:, ::way], np.arange(12))
    assert len(x) == 12 + 2 * 15 + 31 and np.isin(c, x).all() and np.all(way * np.diff(x) > 0)
    assert np.all(np.diff(kinds) >= 0) and (np.unique(kinds) == np.arange(12)).all()
    exact = pair_over(x)
    np.testing.assert_allclose(rows.sum(axis=1), exact.sum(axis=1), atol=2e-6)
    np.testing.assert_allclose(rows.prod(axis=1), exact.prod(axis=1), atol=2e-7)
    split = np.argmin(np.abs(rows[:, 0] - rows[:, 1]))
    assert abs(x[split] - 1) < 1e-5 and np.abs(rows[split, 0] - rows[split, 1]) < 1e-6
    assert np.abs(np.diff(rows, axis=0)).max() < 0.02  # each column goes on


def test_a_pair_splits_beside_a_fold_of_the_branch():
    """The parameter turns back, where trace and determinant go on. Where orbits stick there are two zeros, which are no
    pair though rounding makes them one; an infinite multiplier stays as it is."""
    trace = np.linspace(0.7, 1.7, 11)
    root = np.sqrt((trace**2 - 1.6 - 0.4 * (trace - 1.2)).astype(complex)) / 2
    zeros = 1e-17 * np.array([1j, -1j]) * (np.arange(11)[:, None] % 2)
    infinite = np.full(11, np.inf)
    rows = np.column_stack([trace / 2 + root, trace / 2 - root, 0.3 + 0.1 * trace, zeros, infinite])
    x, rows, _ = with_splits(2 - (trace - 1.32) ** 2, rows, np.arange(11))
    assert len(x) == 11 + 2 * 15 + 31
    trace = rows[:, :2].sum(axis=1).real
    np.testing.assert_allclose(x, 2 - (trace - 1.32) ** 2, atol=1e-4)
    np.testing.assert_allclose(rows[:, :2].prod(axis=1), 0.4 + 0.1 * (trace - 1.2), atol=1e-6)
    np.testing.assert_allclose(rows[:, 2], 0.3 + 0.1 * trace, atol=2e-3)
    assert np.abs(rows[:, 3:5]).max() < 1e-16 and np.isinf(rows[:, 5]).all()


def test_lines_of_a_pair_that_splits():
    c = np.linspace(0.9, 1.13, 12)
    branch = branch_of(gallery.ForcedFriction(), "omega", c, c, pair_over(c))
    lower, upper = sorted(lines(plot.multiplier_diagram(branch), "stable periodic orbit"), key=lambda line: line[-1, 1])
    (largest,) = lines(plot.multiplier_diagram(branch, part="real", which="largest"), "stable periodic orbit")
    for line, column in ((lower, 1), (upper, 0)):
        np.testing.assert_allclose(line[np.isin(line[:, 0], c), 1], np.abs(pair_over(c))[:, column])
        np.testing.assert_allclose(np.interp(1.015, *line.T), np.abs(pair_over(1.015))[column], atol=1e-4)
    np.testing.assert_allclose(
        np.interp([0.95, 1.015], *largest.T), pair_over(np.array([0.95, 1.015]))[:, 0].real, atol=1e-3
    )


def test_moduli(forced):
    ax = plot.multiplier_diagram(forced, labels={"multiplier": "modulus"})
    assert ax.get_ylabel() == "modulus"
    assert min(points(line)[:, 1].min() for line in ax.lines) >= 0


def test_infinite_multipliers_lie_on_the_edge(belt):
    ax = plot.multiplier_diagram(belt)
    top = ax.get_ylim()[1]
    (dotted,) = lines(ax, "infinitely unstable periodic orbit")  # the multiplier 1 of the shift is left out
    np.testing.assert_allclose(dotted[:, 1], top)
    (stable,) = lines(ax, "stable periodic orbit")
    np.testing.assert_allclose(stable[:, 1], 0)
    (jump,) = lines(ax, "jump of the multipliers")
    np.testing.assert_allclose(jump, [[1.0, 0.0], [1.0, top]])
    assert "∞" in texts(ax)


@pytest.mark.parametrize("words, named", [(dict(part="imag"), "part"), (dict(which="some"), "which")])
def test_wrong_words(forced, words, named):
    with pytest.raises(ValueError, match=f"`{named}` must be"):
        plot.multiplier_diagram(forced, **words)


def test_circle(forced, belt):
    corner, flip = forced.special
    ax = plot.multiplier_circle(corner)
    (circle,) = (points(line) for line in ax.lines if len(points(line)) == 361)
    np.testing.assert_allclose(np.hypot(*circle.T), 1)
    (q,) = (c.q for c in corner.crossings)
    assert q == pytest.approx(1 / 6) and texts(ax) == [f"q = {q:.4g}"]
    ends = [line.get_label() for line in ax.lines if line.get_marker() == "o"]
    assert ends == ["q = 0", "q = 1"]  # no half-branches are known, so their sides are not
    with pytest.raises(ValueError, match="but they do not at this flip"):
        plot.multiplier_circle(flip)
    with pytest.raises(ValueError, match="finite"):
        plot.multiplier_circle(belt.special[0])


def test_which_side_is_which():
    """The ends of a path are told apart by the half-branches that have their multipliers, in any order."""
    halves = [
        OrbitHalfBranch(-1, 1, np.array([0.0, 0.8], complex), True, ""),
        OrbitHalfBranch(-1, 1, np.array([0.1, 2.0], complex), False, ""),
        OrbitHalfBranch(1, 2, np.array([0.8, 0.0], complex), True, ""),  # of another period
    ]
    corner = special_at("fold", 1.5, (0.8, 0.0), (2.0, 0.1), halves=halves)
    ax = plot.multiplier_circle(corner, labels=LABELS)
    ends = {line.get_label(): np.real(points(line)[:, 0]) for line in ax.lines if line.get_marker() == "o"}
    assert list(ends) == ["q = 0: stable, ω below", "q = 1: unstable, ω below"]
    np.testing.assert_allclose([sorted(x) for x in ends.values()], [[0.0, 0.8], [0.1, 2.0]], atol=1e-12)


def test_a_legend_of_matplotlib_repeats_nothing(forced):
    ax = plt.figure().add_subplot()
    ax.plot([1, 2], [1, 2], label="before")
    plot.orbit_diagram(forced, ax=ax, legend=False)
    names = [text.get_text() for text in ax.legend().get_texts()]
    assert names == ["before", "stable periodic orbit", "unstable periodic orbit"]


def test_a_legend_is_no_wider_than_its_axes():
    """Of panels side by side; else matplotlib leaves no room for the axes."""
    axes = plt.subplots(1, 3, figsize=(9.0, 3.0), layout="constrained")[1]
    for ax in axes:
        for name in ("stable periodic orbit", "unstable periodic orbit", "jump of the multipliers"):
            ax.plot([0, 1], [0, 1], label=name)
        legend(ax)
    axes[0].figure.draw_without_rendering()
    for ax in axes:
        assert ax.get_legend().get_window_extent().width < 1.3 * ax.get_window_extent().width


@pytest.mark.parametrize("power", [1, 2])
@pytest.mark.parametrize("turned", [False, True])
def test_orbits_begin_at_their_hopf_point(power, turned):
    """x = μ^(1/power) beside the Hopf point at 0: between it and the first orbit the line is as curved as it is to be."""
    system, size = gallery.ForcedFriction(), np.array([0.0, 0.5, 0.55, 0.65])[:: -1 if turned else 1]
    hopf = special_at("Hopf", 0.0, (1.0, 0.5))
    branch = branch_of(system, "omega", size**power, size, [(0.5, 0)] * 4, [hopf], [3 if turned else 0])
    # The mean of the orbits moves too, but not their least extent.
    ax = plot.orbit_diagram(branch, lambda b: b.high.x - b.low.x)
    (line,) = lines(ax, "stable periodic orbit")
    assert len(line) > 20 and np.all(np.diff(line[:, 0]) * (-1 if turned else 1) > 0)
    np.testing.assert_allclose(line[:, 0], (line[:, 1] / 1.5) ** power, atol=1e-12)


def test_names_cover_no_line():
    """Two lines that leave a point at a narrow angle, and a long name."""
    fig, ax = plt.subplots(layout="constrained")
    ax.set(xlim=(0, 1), ylim=(-1, 1))
    x = np.linspace(0, 1, 11)
    for slope in (0.9, -0.9, 0.0):
        ax.plot(x, slope * x)
    ax.plot([0.1, 0.1], [-1, 1])
    write_names(ax, [(0.02, 0.0, "discontinuous\nHopf-pitchfork,\nsupercritical")])
    fig.canvas.draw()
    box = Text.get_window_extent(ax.texts[0])
    for line in ax.lines:
        ends = line.get_xdata(), line.get_ydata()
        dense = [np.interp(np.linspace(0, 1, 2000), np.linspace(0, 1, len(e)), e) for e in ends]
        assert not any(box.contains(*place) for place in ax.transData.transform(np.column_stack(dense)))


def test_names_find_room_farther_away():
    """Of points in a crowd, each with a line to its name; what has room keeps its place beside the point."""
    fig, ax = plt.subplots()
    ax.set(xlim=(0, 1), ylim=(0, 1))
    crowd = [(0.5 + 0.02 * i, 0.5 + 0.01 * (i % 2), f"P{i} | P{i + 1}") for i in range(6)]
    ax.plot(*np.transpose([point[:2] for point in crowd]), "o")
    write_names(ax, [*crowd, (0.1, 0.9, "alone")])
    fig.canvas.draw()
    boxes = [Text.get_window_extent(text) for text in ax.texts]
    assert not any(a.overlaps(b) for i, a in enumerate(boxes) for b in boxes[:i])
    leaders = {text.get_text() for text in ax.texts if text.arrow_patch is not None}
    assert leaders and "alone" not in leaders


def test_axes_of_diagrams_have_the_units_that_are_declared(forced, belt):
    ax = plot.orbit_diagram(forced)
    assert (ax.get_xlabel(), ax.get_ylabel()) == ("omega [rad/s]", "max |x| [m]")
    assert plot.multiplier_diagram(belt).get_xlabel() == "v_dr [m/s]"
    assert plot.orbit_diagram(belt, labels=LABELS).get_xlabel() == "v [m/s]"
    shape = (2, 1, 3)
    dots = BruteForce(
        "omega", np.array([1.0, 2.0]), np.zeros(shape), gallery.Motion(np.zeros(shape), np.ones(shape)), None
    )
    ax = plot.brute_force(dots, "v")
    assert (ax.get_xlabel(), ax.get_ylabel()) == ("omega", "v [m/s]")
