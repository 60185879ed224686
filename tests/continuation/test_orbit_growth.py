"""Continuations while they grow: interrupted, saved, loaded, gone on with; measured and watched."""

import json
from functools import partial
from typing import NamedTuple

import diffrax as dfx
import jax
import jax.numpy as jnp
import matplotlib.pyplot as plt
import numpy as np
import pytest
import scipy.interpolate
from branches import same
from models import Motion, pid

import nsjax
from nsjax import find_orbit, gallery, OrbitBranch, OrbitContinuation
from nsjax._numerics._progress import ProgressLine


METHOD = dict(solver=dfx.Tsit5(), stepsize_controller=pid(1e-12), max_steps=8192)
BELT = dict(solver=dfx.Tsit5())  # with which loading needs to be told


class Duffing(nsjax.System):
    """A hardening spring; its states are dictionaries."""

    c: float = 0.2
    f: float = 5.0
    omega: float = 1.0

    def vector_field(self, t, y, s):
        return {"x": y["v"], "v": self.f * jnp.cos(self.omega * t) - self.c * y["v"] - y["x"] - y["x"] ** 3}

    @property
    def period(self):
        return 2 * jnp.pi / self.omega


class Plane(NamedTuple):
    """A state that is not known to the library, with a leaf that is an array."""

    q: jax.Array


def mean(ts, values):
    """The mean of the spline through values at 41 times of a period, which the trapezoidal rule misses by 2e-3."""
    return scipy.interpolate.make_interp_spline(ts, values, k=5).integrate(ts[0], ts[-1]) / (ts[-1] - ts[0])


def sticking(ts, ys):
    """For how long the velocity stays what it is."""
    return np.sum(np.diff(ts)[np.abs(np.diff(ys.v)) < 1e-13])


def ends(ts, ys):
    return np.array([[ts[0], ys.x[0]], [ts[-1], ys.x[-1]]])


MEASURES = {
    "mean": lambda ts, ys: mean(ts, ys["x"]),
    "loss": lambda ts, ys: mean(ts, 0.2 * ys["v"] ** 2),
    "input": lambda ts, ys: mean(ts, 5.0 * np.cos(2 * np.pi * ts / (ts[-1] - ts[0])) * ys["v"]),
}


def grown(system, orbit, parameter, interval, **options):
    """A continuation that is done, and how many points it gave."""
    growth = OrbitContinuation(system, orbit, parameter, interval, **options)
    return growth, sum(1 for _ in growth)


@pytest.fixture(scope="module")
def belt():
    """Section 6.7, through the fold beyond which orbits are infinitely unstable."""
    system = gallery.StickSlip(c=0.1, v_dr=0.5)
    orbit = find_orbit(system, Motion(2.0, 0.0), period=8.0, **BELT)
    what, options = (system, orbit, "v_dr", (0.45, 1.3)), dict(record={"stick": sticking, "ends": ends}, **BELT)
    return what, options, *grown(*what, **options)


@pytest.fixture(scope="module")
def duffing():
    """Orbits that are not symmetric, up to where they meet the symmetric ones."""
    system = Duffing()
    orbit = find_orbit(system, {"x": jnp.asarray(1.5), "v": jnp.asarray(0.0)}, **METHOD)
    what, options = (system, orbit, "omega", (0.91, 1.02)), dict(max_step=0.1, max_laps=1, record=MEASURES)
    return what, options, *grown(*what, **options)


@pytest.mark.parametrize(
    "share",
    [pytest.param(x, marks=[pytest.mark.slow] * (x not in (0.2, 0.55))) for x in (0.0, 0.2, 0.5, 0.55, 0.8, 1.0)],
)
def test_gone_on_with(belt, tmp_path, share):
    what, options, whole, count = belt
    growth = OrbitContinuation(*what, **options)
    for _ in range(int(share * count)):
        next(growth)
    growth.save(tmp_path / "growth")
    part = growth.branch
    loaded = OrbitContinuation.load(tmp_path / "growth", gallery.StickSlip(), **options)
    same(loaded.branch, part)
    assert sum(1 for _ in loaded) == count - int(share * count)
    same(loaded.branch, whole.branch)
    assert list(loaded) == []


@pytest.mark.slow
def test_several_branches(duffing, tmp_path):
    """Saved and loaded again and again: nodes, and what meets there, are still one."""
    what, options, whole, count = duffing
    assert len(whole.branch.branches) == 2 and whole.branch.bifurcations
    growth = OrbitContinuation(*what, **options)
    for i in range(count):
        next(growth)
        if i % 7 == 0:
            growth.save(tmp_path / "growth")
            growth = OrbitContinuation.load(tmp_path / "growth", Duffing(omega=3.0), record=options["record"])
    with pytest.raises(StopIteration):
        next(growth)
    same(growth.branch, whole.branch)
    assert set(growth.branch.ys) == {"x", "v"}


def test_interrupted(belt, tmp_path, monkeypatch):
    """By the user: between two points, or in the middle of the work on one."""
    what, options, whole, count = belt
    growth = OrbitContinuation(*what, **options)
    with pytest.raises(KeyboardInterrupt):
        for i, _ in enumerate(growth):
            if i == 5:
                raise KeyboardInterrupt
    tracer = type(growth._explorer.tracer)
    work, left = tracer.at, [0]

    def at(self, *args):
        left[0] -= 1
        if left[0] == 0:
            raise KeyboardInterrupt
        return work(self, *args)

    monkeypatch.setattr(tracer, "at", at)
    for every in (3, 17, 2, 40, 5):
        left[0] = every
        with pytest.raises(KeyboardInterrupt):
            for _ in growth:
                pass
        growth.save(tmp_path / "growth")
        growth = OrbitContinuation.load(tmp_path / "growth", what[0], **options)
    monkeypatch.undo()
    assert sum(1 for _ in growth) > 0
    same(growth.branch, whole.branch)


@pytest.mark.slow
def test_branches(belt, duffing, tmp_path):
    for whole, system in ((belt[2].branch, gallery.StickSlip()), (duffing[2].branch, Duffing())):
        whole.save(tmp_path / "branch.npz")
        same(OrbitBranch.load(tmp_path / "branch.npz", system), whole)
    assert [path.name for path in tmp_path.iterdir()] == ["branch.npz"]


class Pitchfork(nsjax.System):
    """x' = μ x - |x| x with a state the library has never seen."""

    mu: float = -0.5
    nothing: object = None

    def vector_field(self, t, y, s):
        return Plane(self.mu * y.q - jnp.abs(y.q) * y.q)


@pytest.mark.parametrize("y", [None, Plane(np.zeros(1))])
def test_equilibria(tmp_path, y):
    system = Pitchfork()
    start = nsjax.find_equilibrium(system, Plane(jnp.zeros(1)))
    branch = nsjax.continue_equilibrium(system, start, "mu", (-1.0, 1.0), max_step=0.1)
    assert len(branch.branches) > 1
    branch.save(tmp_path / "branch")
    loaded = nsjax.Branch.load(tmp_path / "branch", Pitchfork(mu=3.0), y)
    same(loaded, branch)
    assert type(loaded.ys) is Plane and type(loaded.special[0].halves[0].tangent[0]) is Plane


def test_mistakes(belt, tmp_path):
    path, (_, options, growth, _) = tmp_path / "growth", belt
    growth.save(path)
    whole = path.read_bytes()
    load, model = partial(OrbitContinuation.load, **options), gallery.StickSlip()
    for size in (0, 10, len(whole) // 2, len(whole) - 30):
        path.write_bytes(whole[:size])
        with pytest.raises(ValueError, match="damaged, or nsjax did not write it"):
            load(path, model)
    np.savez(tmp_path / "other.npz", a=np.zeros(3))
    np.save(tmp_path / "pickled.npy", np.array([dict()]), allow_pickle=True)
    for name in ("other.npz", "pickled.npy"):
        with pytest.raises(ValueError, match="did not write it"):
            load(tmp_path / name, model)
    with pytest.raises(FileNotFoundError):
        load(tmp_path / "nowhere", model)

    def changed(**changes):
        path.write_bytes(whole)
        with np.load(path) as file:
            parts = dict(file)
        header = json.loads(parts.pop("json").tobytes())
        with open(path, "wb") as file:
            np.savez(file, json=np.frombuffer(json.dumps(header | changes).encode(), np.uint8), **parts)

    for changes, message in (
        (dict(format=3), "A newer version of nsjax"),
        (dict(format=1), "An older version of nsjax.*Compute it anew"),
        (dict(kind="OrbitBranch"), "holds an `OrbitBranch`"),
        (dict(types={}), "Another version of nsjax"),
        (dict(objects=[]), "is damaged"),
        (dict(state=None), "Argument `y` must be given"),
    ):
        changed(**changes)
        with pytest.raises(ValueError, match=message):
            load(path, model)
    path.write_bytes(whole)
    with pytest.raises(ValueError, match="must be a model like that of the file, StickSlip.*but is Duffing"):
        load(path, Duffing())
    with pytest.raises(ValueError, match="must be a model like that of the file"):
        load(path, gallery.StickSlip(c=jnp.zeros(2)))
    with pytest.raises(ValueError, match="must be a state like those of the file"):
        load(path, model, {"x": 0.0, "v": 0.0})
    with pytest.raises(ValueError, match="must be those with which the branch was begun"):
        load(path, model, solver=dfx.Dopri8())
    with pytest.raises(ValueError, match="must be those with which the branch was begun"):
        load(path, model, stepsize_controller=pid(1e-11))
    with pytest.raises(ValueError, match="must hold functions of the names"):
        load(path, model, record={"ends": ends})


@pytest.mark.slow
def test_records_of_several_branches(duffing):
    """Against what else is known of the orbits, and a balance of power."""
    for part in duffing[2].branch.branches:
        np.testing.assert_allclose(part.records["mean"], part.mean["x"], atol=1e-5)
        np.testing.assert_allclose(part.records["input"], part.records["loss"], rtol=1e-3)
        np.testing.assert_array_less(0.1, part.records["loss"])


def test_records(belt):
    """Also arrays."""
    part = belt[2].branch
    bounds, stick = part.records["ends"], part.records["stick"]
    assert bounds.shape == (len(part), 2, 2)
    np.testing.assert_allclose(bounds[:, 1, 0] - bounds[:, 0, 0], part.periods, rtol=1e-12)
    np.testing.assert_allclose(bounds[:, 0, 1], bounds[:, 1, 1], atol=1e-9)
    np.testing.assert_array_less(0.5, stick[part.values < 0.6])
    np.testing.assert_array_less(stick, part.periods)


def test_records_are_drawn(belt):
    branch = belt[2].branch
    ax = nsjax.plot.orbit_diagram(branch, "stick", labels={"stick": "t [s]"}, names=False)
    assert ax.get_ylabel() == "t [s]"
    drawn = np.concatenate([line.get_ydata() for line in ax.lines])
    assert np.isin(branch.records["stick"], drawn).all()
    with pytest.raises(ValueError, match="one number for each|a number for each"):
        nsjax.plot.orbit_diagram(branch, "ends")
    plt.close("all")


@pytest.mark.parametrize(
    "record, message",
    [
        ({"speed": lambda ts, ys: {"x": ys.x}["u"]}, "`record\\['speed'\\]` failed .* KeyError"),
        ({"ys": lambda ts, ys: ys._asdict()}, "`record\\['ys'\\]` must return a number or an array"),
        ({"sum": 3.0}, "must map names to functions, but maps 'sum' to 3.0"),
        ({3: np.mean}, "must map names to functions"),
    ],
)
def test_mistaken_records(belt, record, message):
    with pytest.raises(ValueError, match=message):
        OrbitContinuation(*belt[0], record=record, **BELT)


def test_records_of_changing_shape(belt):
    counter = iter(range(1, 100))
    growth = OrbitContinuation(*belt[0], record={"more": lambda ts, ys: np.zeros(next(counter))}, **BELT)
    with pytest.raises(ValueError, match="`record\\['more'\\]` must return arrays of one shape, but gave \\(2,\\)"):
        next(growth)


@pytest.mark.parametrize(
    "name, parameter, last", [("belt", "v_dr", 1), pytest.param("duffing", "omega", 2, marks=pytest.mark.slow)]
)
def test_progress(name, parameter, last, request, capsys):
    what, options, whole, count = request.getfixturevalue(name)
    branch = nsjax.continue_orbit(*what, **options, progress_meter=dfx.TextProgressMeter())
    same(branch, whole.branch)
    written = capsys.readouterr().err
    assert written.endswith("\n") and written.count("\n") == 1
    lines = written.strip("\n").split("\r")
    assert lines[0] == "" and 2 <= len(lines) < count
    assert lines[1].startswith(f"branch 1, 2 points, {parameter} = ") and lines[1].endswith(", 0 special points")
    assert lines[-1].startswith(f"branch {last}, ") and lines[-1].rstrip() == str(whole) == repr(whole)
    assert sum(len(part) for part in branch.branches) == pytest.approx(int(lines[-1].split()[2]), abs=1)


def test_progress_line(capsys, monkeypatch):
    """At most ten times a second; what is longer is covered; and an error ends the line."""
    now = [100.0]
    monkeypatch.setattr("time.monotonic", lambda: now[0])
    with pytest.raises(KeyboardInterrupt), ProgressLine() as line:
        for text in ("first", "second", "third", "4", "fifth"):
            line.show(text)
            now[0] += 0.06
        raise KeyboardInterrupt
    assert capsys.readouterr().err == "\rfirst\rthird\rfifth\rfifth\n"


def is_point(orbit, branch, index):
    """Whether it is the orbit at a point of a branch."""
    np.testing.assert_allclose(orbit.period, branch.periods[index], rtol=1e-9)
    np.testing.assert_allclose(getattr(orbit.system, branch.parameter), branch.values[index], rtol=1e-14)
    for leaf, leaves in zip(jax.tree.leaves(orbit.y0), jax.tree.leaves(branch.ys)):
        np.testing.assert_allclose(leaf, leaves[index], atol=1e-8)
    assert orbit.admissible and bool(orbit.stable) == branch.stable[index]
    want = branch.multipliers[index]
    known = np.isfinite(want)
    order = np.argsort(-np.abs(np.asarray(orbit.multipliers)), kind="stable")
    np.testing.assert_allclose(np.abs(orbit.multipliers)[order][known], np.abs(want)[known], atol=1e-6)
    assert np.isinf(orbit.multipliers).sum() == np.isinf(want).sum()


@pytest.mark.slow
def test_orbit_at_a_point(belt, duffing):
    """Stable, unstable, and infinitely unstable orbits."""
    part = belt[2].branch
    for index in (3, len(part) - 2):
        is_point(part.orbit(index), part, index)
    assert part.stable[3] and np.isinf(part.multipliers[-2, 0])
    first, other = duffing[2].branch.branches
    stable, unstable = np.flatnonzero(first.stable)[0], np.flatnonzero(~other.stable)[3]
    is_point(first.orbit(stable), first, stable)
    is_point(other.orbit(unstable, method="shooting"), other, unstable)
