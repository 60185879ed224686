"""Continuations of equilibria while they grow: interrupted, saved, loaded, gone on with, and watched."""

import diffrax as dfx
import jax.numpy as jnp
import numpy as np
import pytest
from branches import same

import nsjax
from nsjax import continue_equilibrium, EquilibriumContinuation, gallery
from nsjax.gallery import Line


class Everything(nsjax.System):
    """x = μ for x > 0 and μ = x + x² for x < 0: a corner at x = 0 and a fold at x = -1/2. On the way a pair of
    eigenvalues crosses the axis at x = 1/2, and w leaves zero at x = -6/5."""

    mu: float = 0.8

    def vector_field(self, t, y, s):
        below = y["x"] ** 2 * (1 - s.kink) / 2
        u, v, w, grow = y["u"], y["v"], y["w"], y["x"] - 0.5
        return {
            "x": self.mu - y["x"] - below,
            "u": grow * u - v - u * (u**2 + v**2),
            "v": u + grow * v - v * (u**2 + v**2),
            "w": -(y["x"] + 1.2) * w - w**3,
        }

    @nsjax.sgn
    def kink(self, t, y):
        return y["x"]


class Isola(nsjax.System):
    mu: float = 0.1

    def vector_field(self, t, y, s):
        return Line(0.25 - self.mu**2 - y.x**2)


START = dict(x=0.8, u=0.0, v=0.0, w=0.0)
WHAT, OPTIONS = (Everything(), START, "mu", (-1.0, 1.0)), dict(max_step=0.1)


@pytest.fixture(scope="module")
def grown():
    """The whole, and its points in the order in which they were found."""
    growth = EquilibriumContinuation(*WHAT, **OPTIONS)
    return growth, list(growth)


def test_whole(grown):
    """What there is to be interrupted; and the function gives the same."""
    branch = grown[0].branch
    found = [(b.kind, b.discontinuous) for b in branch.special_points]
    expected = [("saddle-node", False), ("none", True), ("pitchfork", False), ("Hopf", False)]
    assert found == expected and len(branch.branches) == 2
    values = [-0.25, 0, 0.24, 0.5]
    np.testing.assert_allclose([b.value for b in branch.special_points], values, atol=1e-10)
    same(continue_equilibrium(*WHAT, **OPTIONS), branch)
    assert str(grown[0]) == repr(grown[0]) and str(grown[0]).startswith("branch 2, ")


def test_points(grown):
    """Each that is found is one of the branch, and all of the branch are found: the start is there at once, and at a
    node there may be two."""
    growth, points = grown
    known = {(float(v), float(x)) for b in growth.branch.branches for v, x in zip(b.values, b.ys["x"])}
    seen = {(point.parameter, float(point.record.y["x"])) for point in points}
    assert seen <= known and len(known - seen) <= 1 + len(growth.branch.special_points)
    assert {bool(point.record.stable) for point in points} == {True, False}


@pytest.mark.parametrize("share", [0.0, 0.05, 0.2, 0.35, 0.5, 0.65, 0.8, 0.95, 1.0])
def test_gone_on_with(grown, tmp_path, share):
    whole, points = grown
    growth, done = EquilibriumContinuation(*WHAT, **OPTIONS), int(share * len(points))
    for _ in range(done):
        next(growth)
    growth.save(tmp_path / "growth")
    loaded = EquilibriumContinuation.load(tmp_path / "growth", Everything(mu=-3.0))
    same(loaded.branch, growth.branch)
    assert str(loaded) == str(growth)
    assert sum(1 for _ in loaded) == len(points) - done
    same(loaded.branch, whole.branch)
    assert list(loaded) == []


def test_interrupted(grown, tmp_path, monkeypatch):
    """By the user, in the middle of the work on a step, again and again."""
    whole, _ = grown
    growth = EquilibriumContinuation(*WHAT, **OPTIONS)
    tracer = type(growth._explorer.tracer)
    work, left = tracer.at, [0]

    def at(self, *args):
        left[0] -= 1
        if left[0] == 0:
            raise KeyboardInterrupt
        return work(self, *args)

    monkeypatch.setattr(tracer, "at", at)
    for every in (3, 17, 1, 40, 5, 30):
        left[0] = every
        with pytest.raises(KeyboardInterrupt):
            for _ in growth:
                pass
        growth.save(tmp_path / "growth")
        growth = EquilibriumContinuation.load(tmp_path / "growth", Everything())
    monkeypatch.undo()
    assert sum(1 for _ in growth) > 0
    same(growth.branch, whole.branch)


@pytest.mark.slow
def test_at_every_point(tmp_path):
    """Saved and loaded between any two, at a corner at which three branches meet: nodes are still one."""
    what = gallery.DiscontinuousPitchfork(-1.0), Line(0.0), "mu", (-1.0, 1.0)
    whole, growth = continue_equilibrium(*what, max_step=0.3), EquilibriumContinuation(*what, max_step=0.3)
    for _ in growth:
        growth.save(tmp_path / "growth")
        growth = EquilibriumContinuation.load(tmp_path / "growth", gallery.DiscontinuousPitchfork())
        if next(growth, None) is None:
            break
    assert list(growth) == [] and len(whole.branches) == 2
    same(growth.branch, whole)


def test_closed(tmp_path):
    what, options = (Isola(), Line(0.5), "mu", (-1.0, 1.0)), dict(max_step=0.1)
    whole, growth = continue_equilibrium(*what, **options), EquilibriumContinuation(*what, **options)
    for _ in range(30):
        next(growth)
    growth.save(tmp_path / "growth")
    same(EquilibriumContinuation.load(tmp_path / "growth", Isola()).run(), whole)
    assert whole.ends == ("the start", "the start: it is closed")


def test_starts_that_wait(tmp_path):
    """Branches that no bifurcation connects: the starts that were not yet passed are in the file."""
    system = gallery.ImperfectTranscritical(1.0)
    starts = nsjax.find_equilibria(system, Line(jnp.linspace(-2, 2, 9)))
    whole = continue_equilibrium(system, starts, "mu", (-1.0, 1.0))
    assert len(whole.branches) == 2
    growth = EquilibriumContinuation(system, starts, "mu", (-1.0, 1.0))
    for _ in range(5):
        next(growth)
    assert len(growth.branch.branches) == 1
    growth.save(tmp_path / "growth")
    same(EquilibriumContinuation.load(tmp_path / "growth", system).run(), whole)


def test_progress(grown, capsys):
    whole, points = grown
    same(continue_equilibrium(*WHAT, **OPTIONS, progress_meter=dfx.TextProgressMeter()), whole.branch)
    written = capsys.readouterr().err
    assert written.endswith("\n") and written.count("\n") == 1
    lines = written.strip("\n").split("\r")
    assert lines[0] == "" and 2 <= len(lines) <= len(points) + 2
    assert lines[1].startswith("branch 1, 2 points, mu = ") and lines[1].endswith(", 0 special points")
    assert lines[-1].rstrip() == str(whole) and lines[-1].rstrip().endswith(", 4 special points")


def test_mistakes(grown, tmp_path):
    path = tmp_path / "growth"
    grown[0].branch.save(path)
    with pytest.raises(ValueError, match="holds an `Branch`, but an `EquilibriumContinuation` was to be loaded"):
        EquilibriumContinuation.load(path, Everything())
    grown[0].save(path)
    with pytest.raises(ValueError, match="holds an `EquilibriumContinuation`, but an `OrbitContinuation`"):
        nsjax.OrbitContinuation.load(path, Everything())
    with pytest.raises(ValueError, match="must be a model like that of the file, Everything.*but is Isola"):
        EquilibriumContinuation.load(path, Isola())
    with pytest.raises(ValueError, match="must be a state like those of the file"):
        EquilibriumContinuation.load(path, Everything(), Line(0.0))
    path.write_bytes(path.read_bytes()[:-30])
    with pytest.raises(ValueError, match="damaged, or nsjax did not write it"):
        EquilibriumContinuation.load(path, Everything())
