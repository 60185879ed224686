"""Claims: one process at a time has a block, as long as it lives."""

import json
import os
import subprocess
import sys
import time

import pytest

from nsjax.sweeps._claim import Claims, myself, Owner


@pytest.fixture
def folder(tmp_path):
    return tmp_path


def claims(folder, stale=60.0, owner=None, gone=None):
    return Claims(folder, owner or myself(), stale, gone or (lambda token: None))


def age(folder, number, seconds):
    path = folder / f"{number:08d}"
    then = path.stat().st_mtime - seconds
    os.utime(path, (then, then))


def test_one_has_it_until_it_is_released(folder):
    with claims(folder) as a, claims(folder) as b:
        assert a.take(3) and not a.take(3) and not b.take(3) and b.take(4)
        assert a.living() == b.living() == {3, 4}
        b.release(3)  # which is not its own
        assert not b.take(3)
        a.release(3)
        assert b.take(3)
    assert not list(folder.iterdir())  # nothing is left, of clocks neither


def test_what_an_error_leaves_is_released(folder):
    with pytest.raises(KeyboardInterrupt), claims(folder) as a:
        assert a.take(0)
        raise KeyboardInterrupt
    with claims(folder) as b:
        assert b.take(0)


def test_a_dead_process_has_nothing(folder):
    """On this machine that is known at once, also where its number is another process's by now."""
    code = "from nsjax.sweeps._claim import myself; import json; print(json.dumps(myself()))"
    env = os.environ | {"PYTHONPATH": os.pathsep.join(filter(None, sys.path))}
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, env=env, check=True)
    dead = Owner(*json.loads(done.stdout))
    me = myself()
    assert dead.host == me.host and dead.dead and not me.dead
    assert me._replace(began="long ago").dead and not dead._replace(host="another machine").dead
    for i, owner in enumerate([dead, me._replace(began="long ago")]):
        gone = []
        lost = claims(folder, owner=owner)
        assert lost.take(i)
        with claims(folder, gone=gone.append) as b:
            assert b.living() == set() and b.take(i) and gone == [owner.token]
            lost.release(i)  # it is no more its own
            assert b.living() == {i}


def test_of_another_machine_the_time_decides(folder):
    other = myself()._replace(host="another machine")
    lost = claims(folder, owner=other)
    assert lost.take(0) and lost.take(1)
    (folder / "00000002").touch()  # made, and nothing written: whose it is cannot be known
    with claims(folder) as b:
        assert not any(map(b.take, range(3)))
        age(folder, 0, 59.0)
        age(folder, 1, 61.0)
        age(folder, 2, 61.0)
        assert b.living() == {0}
        assert not b.take(0) and b.take(1) and b.take(2)


def test_a_process_at_work_keeps_its_claim_fresh(folder):
    other = myself()._replace(host="another machine")
    with claims(folder, 0.25, owner=other) as a, claims(folder, 0.25) as b:
        assert a.take(0)
        end = time.monotonic() + 0.8
        while time.monotonic() < end:
            assert not b.take(0)
            time.sleep(0.02)


def test_a_fresh_claim_is_given_back(folder):
    """Two find a claim stale; one takes it over before the other one, which then moves a fresh claim aside."""
    dead = myself()._replace(began="long ago", token="dead")
    assert claims(folder, owner=dead).take(0)
    with claims(folder) as a, claims(folder) as b:
        found = b._look(0)
        assert a.take(0)
        assert b._is_stale(*found) and not b._remove(0, found[0])
        assert not b.take(0) and b.living() == {0}
        assert a._look(0)[0] == a.owner
