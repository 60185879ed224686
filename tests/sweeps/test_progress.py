"""One convention for how far something is: `progress_meter=`."""

import inspect
import sys

import diffrax as dfx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

import nsjax
from nsjax._numerics._progress import Count, Counting, Told


X = np.linspace(0.0, 1.0, 1000)


def double(x):
    return 2 * x


class Shares(dfx.AbstractProgressMeter):
    """One that a user wrote: it keeps what it is told."""

    def init(self):
        return []

    def step(self, state, progress):
        return [*state, float(progress)]

    def close(self, state):
        CLOSED.append(state)


CLOSED: list = []


def test_a_function_is_told_after_each_piece():
    told: list[Count] = []
    y = nsjax.sweep(double, X, chunk=256, progress_meter=told.append)
    np.testing.assert_array_equal(y, 2 * X)
    assert [count.done for count in told] == [0, 250, 500, 750, 1000]  # chunks of one length
    assert {(count.what, count.total) for count in told} == {("lanes", 1000)}
    assert np.isnan(told[0].rate) and all(count.rate > 0 for count in told[1:]) and told[-1].remaining == 0
    assert str(told[0]) == "0 of 1,000 lanes (0.0 %)"
    assert str(told[-1]) == "1,000 of 1,000 lanes (100.0 %)"
    assert str(told[1]).startswith("250 of 1,000 lanes (25.0 %), ") and str(told[1]).endswith(" left")


def test_a_line(capsys):
    nsjax.sweep(double, X, chunk=256, progress_meter=dfx.TextProgressMeter())
    written = capsys.readouterr().err
    assert written.count("\n") == 1 and written.startswith("\r0 of 1,000 lanes")
    assert written.rpartition("\r")[2].rstrip() == "1,000 of 1,000 lanes (100.0 %)"
    nsjax.sweep(double, X, chunk=256)
    assert capsys.readouterr().err == ""


def test_a_bar(capsys):
    pytest.importorskip("tqdm")
    nsjax.sweep(double, X, chunk=256, progress_meter=dfx.TqdmProgressMeter())
    assert "100%|" in capsys.readouterr().err


def test_a_meter_of_the_user():
    CLOSED.clear()
    nsjax.sweep(double, X, chunk=256, progress_meter=Shares())
    assert CLOSED == [[0.0, 0.25, 0.5, 0.75, 1.0]]


def test_mistakes():
    for wrong in (True, dfx.TextProgressMeter, 3):
        with pytest.raises(TypeError, match=r"`progress_meter` must be a progress meter such as `diffrax.TextProg"):
            nsjax.sweep(double, X, progress_meter=wrong)
    with pytest.raises(ValueError, match="is for sweeps in pieces.*Leave it out"):
        jax.jit(lambda x: nsjax.sweep(double, x, progress_meter=print))(jnp.asarray(X))
    with pytest.raises(ValueError, match="how long a continuation is, is not known beforehand; but got Shares"):
        Told(Shares(), ends=False)


def test_every_function_of_many_things_has_it():
    named = (
        "solve find_orbits continue_equilibrium continue_orbit continue_orbits sweep Sweep brute_force attractor_chart "
        "basins work_precision EquilibriumContinuation OrbitContinuation"
    )
    for name in named.split():
        names = inspect.signature(getattr(nsjax, name)).parameters
        assert "progress_meter" in names and "progress" not in names, name
    for module in [m for name, m in sys.modules.items() if name.startswith("nsjax")]:
        for public in [f for name, f in vars(module).items() if inspect.isfunction(f) and not name.startswith("_")]:
            assert "progress" not in inspect.signature(public).parameters, public


def test_what_is_left_is_told_at_the_pace_so_far(monkeypatch):
    now = [100.0]
    monkeypatch.setattr("time.monotonic", lambda: now[0])
    told: list[Count] = []
    with Counting(told.append, 4, "starts") as counting:
        now[0] += 10
        counting.at(1, "first")
        now[0] += 10
        counting.at(4)
    assert [str(count) for count in told] == [
        "0 of 4 starts (0.0 %)",
        "first: 1 of 4 starts (25.0 %), 0.1 starts/s, 30 s left",
        "4 of 4 starts (100.0 %)",
    ]


def test_basins_tell():
    """They have a loop of their own."""
    told: list[Count] = []
    starts = nsjax.gallery.Line(np.array([2.0, -2.0, 0.5]))
    found = nsjax.basins(nsjax.gallery.Pitchfork(mu=1.0), starts, tol=0.05, interval=2.0, progress_meter=told.append)
    assert sorted(found.labels) == [0, 0, 1]
    assert told[0].done == 0 and (told[-1].done, told[-1].total) == (3, 3) and {c.what for c in told} == {"starts"}
    assert all(a.done <= b.done for a, b in zip(told, told[1:]))


@pytest.mark.slow
def test_charts_and_diagrams_tell():
    system, start = nsjax.gallery.ForcedFriction(omega=0.8), nsjax.gallery.Motion(5.4, 2.7)
    told: list[Count] = []
    nsjax.brute_force(system, "omega", [0.75, 0.8], start, transient=1, keep=1, progress_meter=told.append)
    assert [(count.done, count.total) for count in told] == [(0, 2), (2, 2)]
    told.clear()
    over = {"omega": np.array([0.75, 0.8]), "k": np.array([1.0])}
    nsjax.attractor_chart(system, over, start, max_period=1, max_iterates=8, progress_meter=told.append)
    assert told[0].done == 0 and {(count.what, count.total) for count in told} == {("solutions", 2)}
    assert "2 of 2 followed to iterate 8" in [count.stage for count in told]
