"""Many branches of periodic orbits in one call: against closed forms, references, and one branch after the other."""

import branch_reference
import diffrax as dfx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from models import Duffing, Motion, pid

import nsjax
from nsjax import continue_orbit, continue_orbits, find_orbit, gallery, sweep
from nsjax.continuation.orbits.batch._lane import _ahead, _on, Lane, Place


HOW = dict(solver=dfx.Tsit5(), stepsize_controller=pid(1e-12), max_events=4, method="shooting", throw=False)


class Wall(nsjax.System):
    """A linear oscillator that grazes a wall where its amplitude 1/√((1 - ω²)² + (2ζω)²) is the gap."""

    zeta: float = 0.05
    gap: float = 2.0
    omega: float = 0.3

    def vector_field(self, t, y, s):
        return Motion(y.v, jnp.cos(self.omega * t) - 2 * self.zeta * y.v - y.x - s.wall)

    @nsjax.impact
    def wall(self, t, y):
        return self.gap - y.x

    @wall.restitution
    def wall(self):
        return 0.8

    @property
    def period(self):
        return 2 * jnp.pi / self.omega


def grazing(gap, zeta=0.05):
    """The frequency below resonance."""
    return np.sqrt(1 - 2 * zeta**2 - np.sqrt((1 - 2 * zeta**2) ** 2 - 1 + 1 / gap**2))


GAPS = np.array([1.5, 2.0, 0.5, 5.0])  # at the third the wall is hit: no orbit without impacts


@pytest.fixture(scope="module")
def walls():
    """Searches one after the other are a smaller program than `sweep`, which `duffing` below has."""
    found = [find_orbit(Wall(gap=jnp.asarray(gap)), Motion(1.05, 0.0), order=1, **HOW) for gap in GAPS]
    orbits = jax.tree.map(lambda *each: jnp.stack(each), *found)
    return orbits, continue_orbits(orbits, "omega", (0.1, 1.5))


@pytest.fixture(scope="module")
def duffing():
    forces = jnp.array([0.2, 0.3, 0.4])
    orbits = sweep(lambda force: find_orbit(Duffing(c=0.1, F=force), Motion(0.3, 0.0), order=1, **HOW), forces)
    return orbits, continue_orbits(orbits, "omega", (0.9, 2.2), points=500)


def test_steps_are_predicted_to_second_order():
    """Round a circle: half the step, an eighth of what is missed."""

    def place(s):
        return Place(jnp.array([np.cos(s), np.sin(s)]), jnp.array([-np.sin(s), np.cos(s)]), None, None, None)

    missed, blank = [], Lane(**dict.fromkeys(Lane._fields))
    for h in (0.1, 0.05):
        before = blank._replace(at=place(-h), bend=jnp.zeros(2), length=jnp.asarray(h), arc=0.0)
        lane = _on(before, place(0.0), jnp.asarray(1.0), jnp.asarray(True))
        missed.append(np.linalg.norm(_ahead(lane, h) - place(h).u))
    np.testing.assert_allclose(missed[0] / missed[1], 8, rtol=0.05)


@pytest.mark.slow
def test_kept_in_a_folder(walls, tmp_path):
    """Two lanes a block, and both ways of each; the second call computes nothing."""
    orbits, want = walls
    calls = [
        continue_orbits(orbits, "omega", (0.1, 1.5), chunk=2, path=tmp_path, devices=devices) for devices in (None, 1)
    ]
    assert len(list((tmp_path / "blocks").iterdir())) == len(GAPS)
    for found in calls:
        np.testing.assert_allclose(found.values, want.values, rtol=1e-12)
        assert np.array_equal(found.kinds, want.kinds) and np.array_equal(found.ends, want.ends)


@pytest.mark.slow
def test_grazing(walls):
    _, branches = walls
    assert list(branches.ends[2]) == ["no orbit"] * 2 and branches.num[2] == 0
    for lane in (0, 1, 3):
        n = branches.num[lane]
        assert list(branches.ends[lane]) == ["end of the interval", "grazing of wall"]
        np.testing.assert_allclose(branches.values[lane, 0], 0.1, atol=1e-12)
        np.testing.assert_allclose(branches.values[lane, n - 1], grazing(GAPS[lane]), atol=1e-7)
        assert np.all(np.diff(branches.values[lane, :n]) > 0) and np.all(branches.stable[lane, :n])
        assert np.isnan(branches.values[lane, n:]).all() and not branches.stable[lane, n:].any()


def test_closed_forms(walls):
    _, branches = walls
    omega, real = branches.values, ~np.isnan(branches.values)
    np.testing.assert_allclose(branches.periods[real], 2 * np.pi / omega[real], rtol=1e-13)
    amplitude = 1 / np.sqrt((1 - omega**2) ** 2 + (0.1 * omega) ** 2)
    np.testing.assert_allclose(branches.high.x[real], amplitude[real], rtol=1e-10)
    product = np.exp(-0.1 * branches.periods)
    np.testing.assert_allclose(np.prod(branches.multipliers, axis=-1)[real], product[real], rtol=1e-10)
    phase = np.arctan2(0.1 * omega, 1 - omega**2)
    np.testing.assert_allclose(branches.ys.x[real], (amplitude * np.cos(omega * branches.ts - phase))[real], atol=1e-10)


@pytest.mark.slow  # (by default folds are passed one branch after the other, test_continue_orbit)
def test_folds_are_passed(duffing):
    """As one branch after the other has them."""
    orbits, branches = duffing
    for lane in (0, 2):
        orbit = jax.tree.map(lambda x: x[lane], orbits)
        alone = continue_orbit(orbit.system, orbit, "omega", (0.9, 2.2))
        found = branches.values[lane][branches.kinds[lane] == "fold"]
        np.testing.assert_allclose(sorted(found), sorted(b.value for b in alone.bifurcations), atol=1e-10)
        assert len(found) == 2 and list(branches.ends[lane]) == ["end of the interval"] * 2
        between = np.flatnonzero(branches.kinds[lane] == "fold")
        stable = branches.stable[lane, : branches.num[lane]]
        assert stable[: between[0]].all() and not stable[between[0] + 1 : between[1]].any()
        assert stable[between[1] + 1 :].all()


@pytest.mark.slow
def test_two_zeros_in_one_step(duffing):
    """Long steps skip none of the folds, and order them along the branch."""
    orbits, branches = duffing
    long = continue_orbits(orbits, "omega", (0.9, 2.2), max_step=0.4)
    assert np.all(long.num < branches.num / 3)
    for lane in range(3):
        want, found = (b.values[lane][b.kinds[lane] == "fold"] for b in (branches, long))
        np.testing.assert_allclose(found, want, atol=1e-10)


@pytest.mark.slow
def test_from_several_orbits(duffing):
    """At nearly one parameter: the lower, the unstable and the upper orbit lie on one branch."""
    _, branches = duffing
    lane, values = 1, branches.values[1, : branches.num[1]]
    omega = 1.6
    places = np.flatnonzero((values[:-1] - omega) * (values[1:] - omega) < 0)
    assert len(places) == 3
    each = [branches.orbit(lane, i, **HOW) for i in places]
    assert [bool(orbit.stable) for orbit in each] == [True, False, True]
    again = continue_orbits(each, "omega", (0.9, 2.2), points=500)
    folds = sorted(branches.values[lane][branches.kinds[lane] == "fold"])
    for i in range(3):
        np.testing.assert_allclose(sorted(again.values[i][again.kinds[i] == "fold"]), folds, atol=1e-10)


@pytest.mark.slow
def test_budget(walls):
    orbits, branches = walls
    few = continue_orbits(orbits, "omega", (0.1, 1.5), points=5)
    assert few.num.tolist() == [9, 9, 0, 9] and few.values.shape[1] <= 9
    assert list(few.ends[0]) == ["more than 5 points"] * 2
    start = branches.start[0]
    np.testing.assert_allclose(few.values[0], branches.values[0, start - 4 : start + 5], atol=1e-12)


@pytest.mark.slow
def test_infinitely_unstable_fold():
    """Section 6.7, for several dampings; the one of the thesis against its reference."""

    def search(c):
        return find_orbit(gallery.StickSlip(c=c, v_dr=0.5), Motion(2.0, 0.0), period=8.0, **HOW)

    dampings = jnp.array([0.08, 0.1, 0.12])
    branches = continue_orbits(sweep(search, dampings), "v_dr", (0.1, 1.3))
    assert set(branches.ends[:, 1]) == {"tangency of belt"}
    ends = [branches.values[i, n - 1] for i, n in enumerate(branches.num)]
    (name,) = [n for n in branch_reference.POINTS if n.startswith("6.7")]
    np.testing.assert_allclose(ends[1], branch_reference.POINTS[name].at, atol=1e-11)
    assert ends[0] > ends[1] > ends[2]


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (dict(parameter="speed"), "must be one of"),
        (dict(interval=(3.0, 4.0)), "within `interval`"),
    ],
)
def test_mistakes(walls, change, message):
    arguments = dict(parameter="omega", interval=(0.1, 1.5)) | change
    with pytest.raises(ValueError, match=message):
        continue_orbits(walls[0], **arguments)


def test_printed(walls):
    text = str(walls[1])
    assert "4 branches of periodic orbits of Wall" in text and "3 ends: grazing of wall" in text
