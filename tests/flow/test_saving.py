"""Solutions in files and as tables."""

import sys

import diffrax as dfx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from models import Motion

import nsjax
from nsjax import gallery, Solution


SYSTEM = gallery.StickSlip()
TS = np.linspace(0.0, 20.0, 5)


@pytest.fixture(scope="module")
def sol():
    saveat = dfx.SaveAt(ts=TS, dense=True)
    return nsjax.solve(SYSTEM, 0.0, 20.0, Motion(1.0, 0.5), saveat=saveat, max_steps=256, max_events=8)


@pytest.fixture(scope="module")
def batch():
    """Of 3, 4 and 5 events, and there is no room for more."""

    def one(v_dr):
        system, saveat = gallery.StickSlip(v_dr=v_dr), dfx.SaveAt(ts=TS)
        return nsjax.solve(system, 0.0, 20.0, Motion(1.0, 0.5), saveat=saveat, max_events=5, throw=False)

    return jax.vmap(one)(jnp.array([0.1, 0.2, 0.3]))


def same(a, b):
    assert jax.tree.structure(a) == jax.tree.structure(b)
    for x, y in zip(jax.tree.leaves(a), jax.tree.leaves(b), strict=True):
        np.testing.assert_array_equal(x, y)
        assert jnp.result_type(x) == jnp.result_type(y)


def test_a_solution_comes_back_from_a_file(sol, tmp_path):
    sol.save(tmp_path / "sol.npz")
    again = Solution.load(tmp_path / "sol.npz", gallery.StickSlip(v_dr=7.0), Motion(0.0, 0.0))
    same(again, sol)
    same(again(3.3), sol(3.3))
    assert str(again) == str(sol) and again.system.v_dr == SYSTEM.v_dr
    assert again.result == nsjax.RESULTS.successful


def test_a_batch_comes_back_from_a_file(batch, tmp_path):
    batch.save(tmp_path / "batch.npz")
    same(Solution.load(tmp_path / "batch.npz", batch.system, batch.y1), batch)
    with pytest.raises(ValueError, match=r"v_dr=f64\[3\].*but is StickSlip.*v_dr=f64\[\].*Make one of that class"):
        Solution.load(tmp_path / "batch.npz", SYSTEM)


def test_files_that_are_refused(sol, tmp_path):
    path = tmp_path / "sol.npz"
    sol.save(path)
    with pytest.raises(ValueError, match=r"holds an `Solution`, but an `Orbit` was.*Use `nsjax.Solution.load`"):
        nsjax.Orbit.load(path, SYSTEM)
    with pytest.raises(ValueError, match="must be a model like that of the file, StickSlip.*but is ForcedFriction"):
        Solution.load(path, gallery.ForcedFriction())
    with pytest.raises(ValueError, match="`y` must be a state like those of the file"):
        Solution.load(path, SYSTEM, Motion(np.zeros(2), 0.0))
    path.write_bytes(path.read_bytes()[:-100])
    with pytest.raises(ValueError, match="is damaged, or nsjax did not write it"):
        Solution.load(path, SYSTEM)


def test_a_state_that_is_an_array(tmp_path):
    class Decay(nsjax.System):
        def vector_field(self, t, y, s):
            return -y

    found = nsjax.solve(Decay(), 0.0, 1.0, np.array([1, 2]), max_steps=64)
    found.save(tmp_path / "sol.npz")
    again = Solution.load(tmp_path / "sol.npz", Decay())
    np.testing.assert_allclose(again.y1, np.array([1, 2]) * np.exp(-1), rtol=1e-6)
    same(again, found)


def test_events_as_a_table(sol):
    pytest.importorskip("pandas")
    rows = sol.events.to_dataframe()
    assert len(rows) == len(sol.events) == 4
    for i, event in enumerate(sol.events):
        row = rows.iloc[i]
        assert (row["t"], row["switch"]) == (event.t, event.switch)
        assert {"belt": row["mode_before.belt"]} == event.mode_before
        assert {"belt": row["mode_after.belt"]} == event.mode_after
        assert (row["y_before.x"], row["y_after.v"]) == (event.y_before.x, event.y_after.v)
        assert row["transversality"] == event.transversality


def test_events_of_a_batch_as_a_table(batch):
    pytest.importorskip("pandas")
    rows = batch.events.to_dataframe()
    assert rows["lane"].value_counts(sort=False).to_dict() == {i: int(n) for i, n in enumerate(batch.events.num)}
    for lane in range(3):
        n = int(batch.events.num[lane])
        np.testing.assert_array_equal(rows[rows.lane == lane]["t"], batch.events.t[lane, :n])
        np.testing.assert_array_equal(rows[rows.lane == lane]["y_after.x"], batch.events.y_after.x[lane, :n])


def test_a_system_without_switches_has_no_events():
    pytest.importorskip("pandas")

    class Decay(nsjax.System):
        def vector_field(self, t, y, s):
            return -y

    rows = nsjax.solve(Decay(), 0.0, 1.0, 1.0, max_steps=64).events.to_dataframe()
    assert list(rows) == ["t", "switch", "y_before.y", "y_after.y", "transversality"] and not len(rows)


def test_xarray(sol, batch):
    xarray = pytest.importorskip("xarray")
    data = sol.to_xarray()
    assert isinstance(data, xarray.Dataset) and dict(data.sizes) == {"time": 5, "event": 4}
    np.testing.assert_array_equal(data.x, sol.ys.x)
    np.testing.assert_array_equal(data.t, TS)
    np.testing.assert_array_equal(data.mode_belt, sol.modes[:, 0])
    np.testing.assert_array_equal(data.v_after, sol.events.y_after.v[:4])
    assert data.result == "successful" and set(data.switch.values) == {"belt"} and data.attrs["system"] == "StickSlip"
    data = batch.to_xarray()
    assert dict(data.sizes) == {"lane": 3, "time": 5, "event": 5}
    np.testing.assert_array_equal(np.isfinite(data.t_event).sum("event"), batch.events.num)
    assert list(data.result.values) == ["successful", "successful", "max_events_reached"]
    assert data.x_after.dims == ("lane", "event") and np.isnan(data.x_after[0, -1])


@pytest.mark.parametrize("missing", ["pandas", "xarray"])
def test_without_the_packages(sol, monkeypatch, missing):
    monkeypatch.setitem(sys.modules, missing, None)
    with pytest.raises(ImportError, match=rf"needs the package {missing}: `pip install nsjax\[data\]`"):
        sol.events.to_dataframe() if missing == "pandas" else sol.to_xarray()
