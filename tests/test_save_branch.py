"""Branches in files: interrupted, saved, loaded, gone on with."""

import dataclasses
import json
from typing import NamedTuple

import diffrax as dfx
import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from models import Motion, pid

import nsjax
from nsjax import find_orbit, gallery, OrbitBranch, OrbitGrowth


METHOD = dict(solver=dfx.Tsit5(), stepsize_controller=pid(1e-12), max_steps=8192)


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


def grown(system, orbit, parameter, interval, **options):
    """A continuation that is done, and how many points it gave."""
    growth = OrbitGrowth(system, orbit, parameter, interval, **options)
    return growth, sum(1 for _ in growth)


@pytest.fixture(scope="module")
def belt():
    """Section 6.7, through the fold beyond which orbits are infinitely unstable."""
    system = gallery.StickSlip(c=0.1, v_dr=0.5)
    orbit = find_orbit(system, Motion(2.0, 0.0), period=8.0, **METHOD, max_events=16)
    what = (system, orbit, "v_dr", (0.45, 1.3))
    return what, *grown(*what)


@pytest.fixture(scope="module")
def duffing():
    """Orbits that are not symmetric, up to where they meet the symmetric ones."""
    system = Duffing()
    orbit = find_orbit(system, {"x": jnp.asarray(1.5), "v": jnp.asarray(0.0)}, **METHOD)
    what, options = (system, orbit, "omega", (0.91, 1.02)), dict(max_step=0.1, max_laps=1)
    return what, options, *grown(*what, **options)


def same(found, want):
    """Number for number, and the same special points in both."""
    assert type(found) is type(want) and len(found.branches) == len(want.branches)
    named = {}
    for one, other in zip(found.branches, want.branches):
        fields = {field.name for field in dataclasses.fields(other)} - {"system", "special", "others"}
        assert jax.tree.structure(one.ys) == jax.tree.structure(other.ys)
        for name in fields:
            jax.tree.map(np.testing.assert_array_equal, getattr(one, name), getattr(other, name))
        assert len(one.special) == len(other.special)
        for a, b in zip(one.special, other.special):
            assert named.setdefault(id(b), a) is a
            assert str(a) == str(b)
    assert str(found) == str(want)
    assert eqx.tree_equal(found.system, want.system)


@pytest.mark.parametrize("share", [0.0, 0.2, 0.5, 0.55, 0.8, 1.0])
def test_gone_on_with(belt, tmp_path, share):
    what, whole, count = belt
    growth = OrbitGrowth(*what)
    for _ in range(int(share * count)):
        next(growth)
    growth.save(tmp_path / "growth")
    part = growth.branch
    loaded = OrbitGrowth.load(tmp_path / "growth", gallery.StickSlip())
    same(loaded.branch, part)
    assert sum(1 for _ in loaded) == count - int(share * count)
    same(loaded.branch, whole.branch)
    assert list(loaded) == []


def test_several_branches(duffing, tmp_path):
    """Saved and loaded again and again: nodes, and what meets there, are still one."""
    what, options, whole, count = duffing
    assert len(whole.branch.branches) == 2 and whole.branch.bifurcations
    growth = OrbitGrowth(*what, **options)
    for i in range(count):
        next(growth)
        if i % 7 == 0:
            growth.save(tmp_path / "growth")
            growth = OrbitGrowth.load(tmp_path / "growth", Duffing(omega=3.0))
    with pytest.raises(StopIteration):
        next(growth)
    same(growth.branch, whole.branch)
    assert set(growth.branch.ys) == {"x", "v"}


def test_interrupted(belt, tmp_path, monkeypatch):
    """By the user: between two points, or in the middle of the work on one."""
    what, whole, count = belt
    growth = OrbitGrowth(*what)
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
        growth = OrbitGrowth.load(tmp_path / "growth", what[0])
    monkeypatch.undo()
    assert sum(1 for _ in growth) > 0
    same(growth.branch, whole.branch)


def test_branches(belt, duffing, tmp_path):
    for whole, system in ((belt[1].branch, gallery.StickSlip()), (duffing[2].branch, Duffing())):
        whole.save(tmp_path / "branch.npz")
        same(OrbitBranch.load(tmp_path / "branch.npz", system), whole)
    assert [path.name for path in tmp_path.iterdir()] == ["branch.npz"]


class Pitchfork(nsjax.System):
    """x' = μ x - |x| x with a state the library has never seen."""

    mu: float = -0.5
    nothing: object = None

    def vector_field(self, t, y, s):
        return Plane(self.mu * y.q - jnp.abs(y.q) * y.q)


@pytest.mark.parametrize("y", [None, Plane(jnp.zeros(1))])
def test_equilibria(tmp_path, y):
    system = Pitchfork()
    start = nsjax.find_equilibrium(system, Plane(jnp.zeros(1)))
    branch = nsjax.continue_equilibrium(system, start, "mu", (-1.0, 1.0), max_step=0.1)
    assert len(branch.branches) > 1
    branch.save(tmp_path / "branch")
    loaded = nsjax.Branch.load(tmp_path / "branch", Pitchfork(mu=3.0), y)
    same(loaded, branch)
    assert type(loaded.ys) is Plane and type(loaded.special[0].halves[0].tangent[0]) is Plane


def test_mistakes(belt, duffing, tmp_path):
    path = tmp_path / "growth"
    duffing[2].save(path)
    whole = path.read_bytes()
    load, model = OrbitGrowth.load, Duffing()
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
        (dict(format=2), "A newer version of nsjax"),
        (dict(kind="OrbitBranch"), "holds an `OrbitBranch`"),
        (dict(types={}), "Another version of nsjax"),
        (dict(objects=[]), "is damaged"),
        (dict(state=None), "Argument `y` must be given"),
    ):
        changed(**changes)
        with pytest.raises(ValueError, match=message):
            load(path, model)
    path.write_bytes(whole)
    with pytest.raises(ValueError, match="must be a model like that of the file, Duffing.*but is StickSlip"):
        load(path, gallery.StickSlip())
    with pytest.raises(ValueError, match="must be a model like that of the file"):
        load(path, Duffing(c=jnp.zeros(2)))
    with pytest.raises(ValueError, match="must be a state like those of the file"):
        load(path, model, Motion(0.0, 0.0))
    with pytest.raises(ValueError, match="must be those with which the branch was begun"):
        load(path, model, solver=dfx.Tsit5())
    with pytest.raises(ValueError, match="must be those with which the branch was begun"):
        load(path, model, stepsize_controller=pid(1e-11))
