"""`Sweep`: the same bits as `sweep`, in a folder that outlasts the process, is whole at any instant, and is refused to
another sweep."""

import json
import pathlib
import shutil
import threading

import diffrax as dfx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from models import CHEAP, Motion
from sweep_process import iterated, values

import nsjax
from nsjax import gallery, RESULTS, Sweep, sweep
from nsjax._numerics._progress import in_words
from nsjax.sweeps import _folder, Status
from nsjax.sweeps._claim import Claims, myself


X = values(1300)
SMALL = dict(block=256, chunk=64)


def same(found, want):
    assert jax.tree.structure(found) == jax.tree.structure(want)
    for a, b in zip(jax.tree.leaves(found), jax.tree.leaves(want)):
        assert a.dtype == b.dtype and np.asarray(a).tobytes() == np.asarray(b).tobytes()


def close(found, want):
    """But for rounding: the same lanes by two programs, which XLA need not compile alike."""
    assert jax.tree.structure(found) == jax.tree.structure(want)
    for a, b in zip(jax.tree.leaves(found), jax.tree.leaves(want)):
        assert a.dtype == b.dtype
        exact = a.dtype.kind != "f"
        np.testing.assert_allclose(a, b, rtol=0 if exact else 1e-14, atol=0 if exact else 1e-14)


@pytest.fixture(scope="module")
def want():
    return sweep(iterated, X, 1.5, chunk=64)


@pytest.fixture(scope="module")
def finished(tmp_path_factory):
    return Sweep(iterated, X, 1.5, path=tmp_path_factory.mktemp("sweep") / "new" / "run", **SMALL).run()


def again(runs, path=None, **options):
    """The same sweep, in a copy of the folder or in another one."""
    return Sweep(iterated, X, 1.5, path=path or runs._folder.path, **SMALL | options)


@pytest.mark.slow
def test_solutions(tmp_path):
    """What `solve` returns, with systems whose fields differ; those that fail are counted, and can be run again."""

    def run(system, x0, limits):
        return nsjax.solve(system, 0.0, 20.0, Motion(x0, -0.5), throw=False, **CHEAP | limits)

    system = gallery.StickSlip(v_dr=np.linspace(0.1, 1.0, 10))

    def few(system, x0):
        return run(system, x0, dict(max_events=4))

    runs = Sweep(few, system, 2.5, path=tmp_path, block=4, chunk=4).run()
    sol = runs.result()
    close(sol, sweep(few, system, 2.5, chunk=4))
    assert isinstance(sol, nsjax.Solution) and isinstance(sol.y1.x, np.memmap) and sol.y1.x.shape == (10,)
    assert sol.events.names == ("belt",) and "10 solutions of StickSlip" in str(sol)
    failed = np.flatnonzero(~np.asarray(nsjax.is_okay(sol.result)))
    assert 0 < len(failed) < 10
    assert runs.counts() == {"successful": 10 - len(failed), "max_events_reached": len(failed)}
    other, x0 = runs.failed()
    np.testing.assert_array_equal(other.v_dr, system.v_dr[failed])
    assert x0 == 2.5 and float(other.k) == 1.0


def test_the_same_bits_and_what_is_returned(finished, want):
    found = finished.result()
    same(found, want)
    assert all(isinstance(x, np.memmap) for x in jax.tree.leaves(found))
    assert finished.counts() == {"successful": int(np.sum(X <= 8)), "max_steps_reached": int(np.sum(X > 8))}
    x, k = finished.failed()
    assert np.array_equal(x, X[X > 8]) and k == 1.5
    assert len(finished) == 6 and finished.status[:5] == (1300, 1300, 6, 6, 0)
    assert str(finished).startswith("sweep of `iterated` in ") and "1,300 of 1,300 lanes (100.0 %)" in str(finished)


def test_blocks_are_yielded_as_they_are_done(tmp_path, finished, want):
    """And if the loop is left, it goes on there; by another object too."""
    runs = again(finished, tmp_path)
    for block in runs:
        same(block.result, jax.tree.map(lambda x: np.asarray(x)[block.start : block.stop], want))
        if block.number == 2:
            break
    assert 3 <= runs.status.blocks_done < 6 and runs.status.running == 0
    with pytest.raises(ValueError, match=r"of 6 blocks are missing: `run` computes them"):
        runs.result()
    assert sum(runs.counts().values()) == runs.status.lanes_done
    assert [block.number for block in again(finished, tmp_path)] == list(range(6))
    assert [block.stop for block in runs] == [256, 512, 768, 1024, 1280, 1300]
    same(runs.result(), want)


def test_blocks_that_others_do_meanwhile(finished, tmp_path, monkeypatch):
    """They are yielded too: all of them at the beginning, or one while its process is waited for."""
    shutil.copytree(finished._folder.path, tmp_path / "run")
    runs = again(finished, tmp_path / "run")
    with monkeypatch.context() as patched:
        patched.setattr(runs._folder, "done", set)
        assert sorted(block.number for block in runs) == list(range(6))
    last = runs._folder.block(5)
    aside = last.rename(tmp_path / "aside.npz")
    other = Claims(runs._folder.claims, myself()._replace(host="another machine"), 60.0, None)
    assert other.take(5)
    timer = threading.Timer(0.3, lambda: aside.rename(last))
    timer.start()
    assert [block.number for block in runs] == list(range(6))
    timer.join()
    assert other.take(5) is False  # it was left to it


def test_arguments_on_the_disk(tmp_path, finished):
    """Only what is computed is read; and they count by their values."""
    np.save(tmp_path / "x.npy", X)
    x = np.load(tmp_path / "x.npy", mmap_mode="r")
    there = finished._folder.path
    assert isinstance(Sweep(iterated, x, 1.5, path=there, **SMALL)._lanes.mapped[0], np.memmap)
    Sweep(iterated, jnp.asarray(X), 1.5, path=there, **SMALL)


def test_another_sweep_is_refused(finished, tmp_path):
    there = finished._folder.path
    model = Sweep(lambda s, x: s.k * x, gallery.StickSlip(), X, path=tmp_path / "model").run()

    def refused(*what, path=there, **options):
        with pytest.raises(ValueError, match="`path`: the folder .* holds another sweep") as caught:
            Sweep(*what, path=path, **SMALL | options)
        return str(caught.value).partition("another sweep: ")[2]

    assert refused(iterated, X, 2.5) == "other values of `args[1]`. Give another folder, or remove this one."
    assert "other values of `args[0]`." in refused(iterated, np.nextafter(X, 9), 1.5)
    assert "lanes 1300 there, 1299 here" in refused(iterated, X[1:], 1.5)
    assert "block 256 there, 512 here" in refused(iterated, X, 1.5, block=512)
    assert "chunk 64 there, 32 here" in refused(iterated, X, 1.5, chunk=32)
    assert "other names, types or shapes" in refused(lambda x, k: x, X, 1.5)

    def other(x, k):
        return iterated(x + 1e-9, k)

    assert "another program: of `iterated` there, of `test_another" in refused(other, X, 1.5)
    path = tmp_path / "model"
    assert "other values of `args[0].k`." in refused(
        lambda s, x: s.k * x, gallery.StickSlip(k=2.0), X, path=path, block=65536, chunk=256
    )
    same(model.result(), sweep(lambda s, x: s.k * x, gallery.StickSlip(), X))


def test_what_a_function_holds_belongs_to_it(tmp_path):
    """Arrays that it closes over, large ones too, and those of a module that is called."""
    table = np.linspace(0.0, 1.0, 5000)
    changed = table.copy()
    changed[2500] += 1e-12

    def reading(table):
        return lambda x: jnp.interp(x, jnp.asarray(table), jnp.asarray(table) ** 2)

    Sweep(reading(table), X, path=tmp_path / "closed")
    Sweep(reading(table.copy()), X, path=tmp_path / "closed")
    with pytest.raises(ValueError, match="another program"):
        Sweep(reading(changed), X, path=tmp_path / "closed")
    held = jax.tree_util.Partial(lambda table, x: jnp.interp(x, table, table**2), jnp.asarray(table))
    Sweep(held, X, path=tmp_path / "held")
    with pytest.raises(ValueError, match=r"other values of `fn\[.*0.*\]`"):
        Sweep(jax.tree_util.Partial(held.func, jnp.asarray(changed)), X, path=tmp_path / "held")


def test_versions_and_files_of_others(finished, tmp_path):
    shutil.copytree(finished._folder.path, tmp_path / "run")
    place = tmp_path / "run" / "sweep.json"
    header = json.loads(place.read_text())
    place.write_text(json.dumps(header | {"versions": header["versions"] | {"jaxlib": "0.1"}}))
    with pytest.raises(ValueError, match=r"another sweep: jaxlib 0.1 there, \d+\.\d+[.\d]* here"):
        again(finished, tmp_path / "run")
    place.write_text(json.dumps(header | {"format": 99}))
    with pytest.raises(ValueError, match="it is of format 99"):
        again(finished, tmp_path / "run")
    for text in ("{", "{}", "[]"):
        place.write_text(text)
        with pytest.raises(ValueError, match=r"sweep.json is damaged, or nsjax did not write it"):
            again(finished, tmp_path / "run")


@pytest.mark.parametrize("where", ["writing", "named", "claimed"])
def test_what_a_killed_process_leaves(finished, want, tmp_path, monkeypatch, where):
    """A file half written, a block that is there and still claimed, a claim alone: of a process that is no more."""
    runs = again(finished, tmp_path)
    dead = myself()._replace(began="long ago", token="dead")
    lost = Claims(runs._folder.claims, dead, 60.0, None)
    assert lost.take(0) and lost.take(1)
    whole = finished._folder.block(0)
    if where == "writing":
        (runs._folder.blocks / "00000000.npz.dead.part").write_bytes(whole.read_bytes()[:100])
    if where == "named":
        shutil.copy(whole, runs._folder.block(0))
    assert runs.status.running == 0 and runs.status.blocks_done == (where == "named")
    same(runs.run().result(), want)
    assert not list(pathlib.Path(tmp_path).rglob("*.part"))


def test_nothing_is_there_before_it_is_whole(tmp_path, monkeypatch):
    folder = _folder.Folder(tmp_path, "me")
    assert folder.open({"a": 1}) == {"a": 1} == _folder.Folder(tmp_path, "other").open({"a": 2})
    leaf = np.arange(5.0)

    def full(*_):
        raise OSError("No space left on device")

    with monkeypatch.context() as patched:
        patched.setattr("os.fsync", full)
        with pytest.raises(OSError, match="No space"):
            folder.write(0, [leaf])
    assert not folder.has(0) and folder.done() == set() and not list(folder.blocks.iterdir())
    folder.write(0, [leaf])
    before = folder.block(0).read_bytes()
    folder.write(0, [leaf])  # by another process, at the same time
    assert folder.block(0).read_bytes() == before and np.array_equal(folder.read(0, 0), leaf)


def test_several_at_once(finished, want, tmp_path):
    """Each block is computed once, by whoever comes first; all of them end when all is done."""
    workers = [again(finished, tmp_path) for _ in range(3)]
    written = []
    for one in workers:
        write = one._folder.write
        one._folder.write = lambda number, leaves, write=write: (written.append(number), write(number, leaves))
    threads = [threading.Thread(target=one.run) for one in workers]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    assert sorted(written) == list(range(6))
    same(workers[0].result(), want)


@pytest.mark.parametrize("order", [X, -np.asarray(X), np.zeros(len(X))])
def test_in_another_order(finished, want, tmp_path, order):
    """Which is a matter of speed only."""
    same(again(finished, tmp_path, order=order).run().result(), want)
    again(finished, tmp_path)  # the same sweep
    if order is X:
        with pytest.raises(ValueError, match=r"`order` must have shape \(1300,\), but has \(1299,\)"):
            again(finished, tmp_path, order=order[1:])


def test_without_waiting_for_others(finished, tmp_path):
    runs = again(finished, tmp_path)
    with Claims(runs._folder.claims, myself()._replace(host="another machine"), 60.0, None) as others:
        assert others.take(4)
        assert runs.run(wait=False).status[:5] == (1300, 1300 - 256, 6, 5, 1)
    assert runs.run(wait=False).status.blocks_done == 6


def test_progress(finished, tmp_path, capsys):
    told = []
    again(finished, tmp_path / "a", progress_meter=told.append).run()
    assert [status.blocks_done for status in told] == [1, 2, 3, 4, 5, 6]
    assert all(isinstance(status, Status) and status.rate > 0 for status in told)
    assert told[-1].remaining == 0 and told[0].remaining > 0 and "lanes/s" in str(told[0])
    assert all(a.lanes_done <= b.lanes_done for a, b in zip(told, told[1:]))
    again(finished, tmp_path / "b", progress_meter=dfx.TextProgressMeter()).run()
    lines = capsys.readouterr().err
    assert lines.count("\n") == 1 and "\r0 of 1,300 lanes (0.0 %), 0 of 6 blocks" in lines
    assert lines.rstrip().endswith("1,300 of 1,300 lanes (100.0 %), 6 of 6 blocks, 0 running")
    again(finished, tmp_path / "c").run()
    assert capsys.readouterr().err == ""
    words = {
        0.2: "less than 1 s",
        59: "59 s",
        60: "1 min",
        3725: "1 h 2 min",
        200_000: "2 d 7 h",
        86_399: "23 h 59 min",
    }
    assert {seconds: in_words(seconds) for seconds in words} == words


def test_errors_of_the_function_are_told(tmp_path):
    def host(x):
        raise RuntimeError("of the host")

    def fn(x):
        return jax.pure_callback(host, jax.ShapeDtypeStruct((), x.dtype), x, vmap_method="sequential")

    runs = Sweep(fn, X[:10], path=tmp_path)
    with pytest.raises(Exception, match="of the host"):
        runs.run()
    assert runs.status.running == 0  # nothing is claimed any more


def test_mistakes_are_told(tmp_path):
    for options, text in {
        "block": (dict(block=0), "`block` must be a positive integer"),
        "chunk": (dict(chunk=0), "`chunk` must be a positive integer"),
        "both": (dict(block=100, chunk=64), "`block` must be a multiple of `chunk` = 64, but is 100"),
        "stale": (dict(stale=0), "`stale` must be a positive time"),
        "devices": (dict(devices=7), "`devices` must be a number from 1 to 1"),
    }.values():
        with pytest.raises(ValueError, match=text):
            Sweep(jnp.sin, X, path=tmp_path / "none", **options)
    with pytest.raises(ValueError, match="only scalars"):
        Sweep(jnp.sin, 1.0, path=tmp_path / "none")
    with pytest.raises(ValueError, match="is not for `jax.jit`"):
        jax.jit(lambda x: Sweep(jnp.sin, x, path=tmp_path / "none"))(X)
    with pytest.raises(TypeError, match="there is bfloat16"):
        Sweep(lambda x: x.astype(jnp.bfloat16), X, path=tmp_path / "none")
    assert not (tmp_path / "none").exists()
    for fn in (jnp.sin, lambda x: (RESULTS.where(x > 0, RESULTS.successful, RESULTS.no_return),) * 2):
        with pytest.raises(ValueError, match="How a lane ended is known if the function returns"):
            Sweep(fn, X, path=tmp_path / fn.__name__).counts()


def test_no_lanes(tmp_path):
    runs = Sweep(iterated, X[:0], 1.5, path=tmp_path).run()
    assert len(runs) == 0 and list(runs) == [] and runs.result().values.shape == (0, 2)
    assert runs.counts() == {} and runs.failed()[0].shape == (0,)


def test_xarray(finished):
    xarray = pytest.importorskip("xarray")
    data = finished.to_xarray()
    assert isinstance(data, xarray.Dataset) and set(data.variables) == {"x", "turns", "values", "result"}
    assert data["values"].dims == ("lane", "values_dim1") and data.x.dims == ("lane",) and "x" in data.coords
    found = finished.result()
    assert np.array_equal(data["turns"], found.turns) and np.array_equal(data.x, X)
    meanings = dict(zip(data.result.attrs["flag_meanings"].split(), data.result.attrs["flag_values"]))
    assert int(np.sum(data.result == meanings["max_steps_reached"])) == finished.counts()["max_steps_reached"]


def test_dataframe(finished):
    pytest.importorskip("pandas")
    rows, found = finished.to_dataframe(), finished.result()
    assert len(rows) == 1300
    np.testing.assert_array_equal(rows["x"], X)
    np.testing.assert_array_equal(rows["turns"], found.turns)
    np.testing.assert_array_equal(rows["values[0]"], found.values[:, 0])
    assert rows["result"].value_counts().to_dict() == finished.counts()


def test_without_xarray(finished, monkeypatch):
    monkeypatch.setitem(__import__("sys").modules, "xarray", None)
    with pytest.raises(ImportError, match=r"pip install nsjax\[data\]"):
        finished.to_xarray()
