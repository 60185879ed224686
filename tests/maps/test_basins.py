"""Basins of attraction against what is known of them, and against an independent simulation."""

import dataclasses
from typing import NamedTuple

import diffrax as dfx
import jax.numpy as jnp
import numpy as np
import pytest
from exponents import after, ImpactOscillator
from models import PeriodicHammer

import nsjax
from nsjax.gallery import Motion


class Pair(NamedTuple):
    x: float
    z: float


class Switch(nsjax.System):
    """x tends to 1 from above a threshold and to -1 from below; z tends to x²."""

    threshold: float = 0.3
    slow: float = 1.0

    def vector_field(self, t, y, s):
        return Pair(self.slow * (s.side - y.x), y.x**2 - y.z)

    @nsjax.sgn
    def side(self, t, y):
        return y.x - self.threshold


class Flip(nsjax.System):
    """At each beat x goes to -tanh(2 x): to and fro between the roots of x = tanh(2 x)."""

    def vector_field(self, t, y, s):
        return Pair(jnp.zeros_like(y.x), jnp.ones_like(y.z))

    @nsjax.impact
    def beat(self, t, y):
        return 1 - y.z

    @beat.reset
    def beat(self, t, y):
        return Pair(-jnp.tanh(2 * y.x), y.z - 1)


class Pushed(nsjax.System):
    """x' = cos t - x, whose orbit (cos t + sin t) / 2 is at 1/2 after whole periods."""

    period = 2 * np.pi

    def vector_field(self, t, y, s):
        return Pair(jnp.cos(t) - y.x, -y.z)


STOPPED = PeriodicHammer(
    c=0.1, x_w=0.0, f_0=-1.0, omega=2.6
)  # two orbits attract; the mirror image of `ImpactOscillator`


QUICK = dict(solver=dfx.Bosh3())  # of a quarter of the size of the default


def grid(nx, ny):
    x, z = np.meshgrid(np.linspace(-1.9, 2.1, nx), np.linspace(-1, 2, ny))
    return Pair(x, z)


def test_two_equilibria():
    """The boundary is where the field jumps; refined to half the distance of two points, twice."""
    found = nsjax.basins(Switch(), grid(20, 5), interval=2.0, refine=2, tol=1e-4, **QUICK)
    assert found.labels.shape == (17, 77) == found.starts.x.shape
    ends = [float(points.x[0]) for points in found.attractors]
    assert sorted(ends) == pytest.approx([-1, 1], abs=1e-4)
    assert all(len(points.x) == 1 for points in found.attractors)
    want = np.where(found.starts.x > 0.3, ends.index(max(ends)), ends.index(min(ends)))
    np.testing.assert_array_equal(found.labels, want)
    # Only what lies beside the boundary was followed: of each row of 77 the coarse ones and a few more.
    assert np.mean(found.iterates > 0) < 0.35
    assert found.fractions().sum() == 1 and (found.result == 0).all()
    text = str(found)
    assert text.startswith("basins of 2 attractors, 1309 starts") and "1 point, the first (" in text


def test_attractors_that_are_given():
    """In the order in which they are given; lanes that have no time to reach them are undecided, and not theirs."""
    given = [Pair(0.9, 0.0), Pair(-0.9, 1.0)]
    how = dict(interval=2.0, tol=1e-4, **QUICK)  # (as above, and as many lanes: one program)
    found = nsjax.basins(Switch(), grid(20, 5), given, **how)
    np.testing.assert_array_equal(found.labels, np.where(found.starts.x > 0.3, 0, 1))
    late = nsjax.basins(Switch(slow=0.01), grid(20, 5), max_iterates=16, **how)
    assert (late.labels == -1).all() and not late.attractors and "undecided: 100.00%" in str(late)


def test_an_orbit_of_two_laps():
    starts = Pair(np.array([-2.0, -0.1, 0.3, 1.5]), np.array([0.0, 0.2, 0.4, 0.9]))
    found = nsjax.basins(Flip(), starts, section="beat", max_time=3.0, tol=1e-6, **QUICK)
    (points,) = found.attractors
    root = 1.0
    for _ in range(200):
        root = np.tanh(2 * root)
    np.testing.assert_allclose(np.sort(points.x), [-root, root], atol=1e-6)
    assert (found.labels == 0).all()


def test_orbits_as_attractors():
    """They must be what they are said to be."""

    def orbit(**changes):
        nothing = dict.fromkeys(f.name for f in dataclasses.fields(nsjax.Orbit))
        return nsjax.Orbit(**nothing | dict(t0=jnp.zeros(()), y0=Pair(0.5, 0.0), stable=jnp.array(True)) | changes)

    starts = Pair(np.array([-0.5, 0.7]), np.ones(2))
    for given, words in (
        ([orbit(stable=jnp.array(False))], "attractor 0 is an orbit that is not stable"),
        ([orbit(t0=jnp.ones(()))], "begins at t = 1, another phase"),
        ([orbit(), orbit()], "attractors 0 and 1 are the same"),
    ):
        with pytest.raises(ValueError, match=words):
            nsjax.basins(Pushed(), starts, given, **QUICK)
    found = nsjax.basins(Pushed(), starts, [orbit()], **QUICK)
    assert len(found.attractors) == 1 and (found.labels == 0).all()


def test_mistakes():
    y = grid(3, 3)
    for system, starts, options, words in (
        (Switch(), y, {}, "autonomous: give a `section`"),
        (STOPPED, Motion(*y), dict(interval=1.0), "`interval` is for autonomous"),
        (Switch(), Pair(1.0, 0.0), dict(interval=1.0), "leaves of one shape"),
        (Switch(), Pair(y.x, y.z[0]), dict(interval=1.0), "leaves of one shape"),
        (Switch(), Pair(y.x[0], y.z[0]), dict(interval=1.0, refine=1), "grids with two axes"),
        (Switch(), y, dict(interval=1.0, max_iterates=0), "`max_iterates` must be"),
    ):
        with pytest.raises(ValueError, match=words):
            nsjax.basins(system, starts, **options)


@pytest.mark.slow
def test_an_impact_oscillator():
    """Orbits of one and of three periods, against solutions in closed form between impacts, which are followed for 400
    periods: no start is on another side, and all but those at the boundary are decided."""
    x, v = np.meshgrid(np.linspace(0.05, 1.5, 24), np.linspace(-1, 1, 21))
    found = nsjax.basins(STOPPED, Motion(x, v), refine=1, tol=1e-4)
    orders = [len(points.x) for points in found.attractors]
    assert sorted(orders) == [1, 3] and (found.result == 0).all()
    x, v = found.starts.x.ravel(), found.starts.v.ravel()
    ends = -np.stack(after(ImpactOscillator(1.0, 2.6, 0.1, 0.8), -x, -v, 400, steps=32), axis=-1)
    known = np.isfinite(ends).all(axis=1)  # those that never come to rest
    assert known.mean() > 0.9
    far = [np.abs(ends[:, None] - np.stack(points, axis=-1)).max(axis=2).min(axis=1) for points in found.attractors]
    want = np.argmin(np.nan_to_num(far, nan=np.inf), axis=0)
    assert np.nanmax(np.min(far, axis=0)) < 1e-3
    decided = found.labels.ravel() >= 0
    assert decided.mean() > 0.999
    asked = known & decided & (found.iterates.ravel() > 0)
    np.testing.assert_array_equal(found.labels.ravel()[asked], want[asked])


def test_picture():
    labels = np.repeat([[-2, -1, 0, 1]], 3, axis=0)
    x, z = np.meshgrid(np.linspace(0, 3, 4), np.linspace(-1, 1, 3))
    points = (Pair(np.zeros(1), np.zeros(1)), Pair(np.array([2.0, 3.0]), np.array([0.5, 0.0])))
    found = nsjax.maps.Basins(labels, points, np.ones((3, 4), int), Pair(x, z), np.zeros((3, 4), int))
    ax = nsjax.plot.basins(found, labels={"x": "x [m]"})
    assert (ax.get_xlabel(), ax.get_ylabel()) == ("x [m]", "z")
    words = [text.get_text() for text in ax.get_legend().get_texts()]
    assert words == ["attractor 0: a point", "attractor 1: 2 points", "failed", "undecided"]
    with pytest.raises(ValueError, match="grid with two axes"):
        nsjax.plot.basins(nsjax.maps.Basins(labels[0], points, labels[0], Pair(x[0], z[0]), labels[0]))
    with pytest.raises(ValueError, match="second axis"):
        nsjax.plot.basins(nsjax.maps.Basins(labels, points, labels, Pair(z, x), labels))


def test_basins_as_a_table():
    pytest.importorskip("pandas")
    labels, failed = np.array([[0, 1], [-1, -2]]), int(nsjax.RESULTS.max_steps_reached._value)
    x, z = np.array([[0.0, 1.0], [2.0, 3.0]]), np.array([[4.0, 5.0], [6.0, 7.0]])
    points = (Pair(np.zeros(1), np.zeros(1)), Pair(np.ones(1), np.ones(1)))
    found = nsjax.maps.Basins(labels, points, 3 + labels, Pair(x, z), np.array([[0, 0], [0, failed]]))
    rows = found.to_dataframe()
    assert list(rows) == ["x", "z", "attractor", "iterates", "result"]
    np.testing.assert_array_equal(rows[["x", "z", "attractor"]], [[0, 4, 0], [1, 5, 1], [2, 6, -1], [3, 7, -2]])
    assert list(rows["result"]) == ["successful"] * 3 + ["max_steps_reached"]
