"""Processes that are killed at any instant, and those that go on: the same bits."""

import os
import pathlib
import shutil
import signal
import subprocess
import sys
import threading
import time

import numpy as np
import pytest
from sweep_process import BLOCK, digest, values, wide

from nsjax import Sweep, sweep


SCRIPT = pathlib.Path(__file__).parents[1] / "references" / "sweep_process.py"


def begin(folder, lanes):
    env = os.environ | {"PYTHONPATH": os.pathsep.join(filter(None, sys.path))}
    command = [sys.executable, str(SCRIPT), "work", str(folder), str(lanes)]
    return subprocess.Popen(command, stdout=subprocess.PIPE, text=True, env=env)


def said(process):
    return process.stdout.readline().split()


def done(folder):
    return len(list((folder / "blocks").glob("*.npz")))


def kill(process):
    process.send_signal(signal.SIGKILL)
    process.wait()
    process.stdout.close()


def finish(process):
    word, found = said(process)
    assert word == "done" and process.wait() == 0
    process.stdout.close()
    return found


def test_one_of_four_is_killed(tmp_path):
    """A process of its own, which has computed some blocks; three others, here threads, do the rest, at once."""
    lanes = 100 * BLOCK
    want = digest(sweep(wide, values(lanes)))
    lost = begin(tmp_path, lanes)
    assert said(lost) == ["ready"]
    others = [Sweep(wide, values(lanes), path=tmp_path, block=BLOCK, stale=5.0) for _ in range(3)]
    while done(tmp_path) < 3:
        time.sleep(0.001)
    kill(lost)
    assert 3 <= done(tmp_path) < 100
    threads = [threading.Thread(target=one.run) for one in others]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    assert digest(others[0].result()) == want
    assert not list(tmp_path.rglob("*.part"))


@pytest.mark.slow
def test_four_processes_one_killed(tmp_path):
    lanes = 400 * BLOCK
    want = digest(sweep(wide, values(lanes)))
    processes = [begin(tmp_path, lanes) for _ in range(4)]
    assert [said(one) for one in processes] == [["ready"]] * 4
    while done(tmp_path) < 40:
        time.sleep(0.001)
    kill(processes.pop(1))
    assert done(tmp_path) < 400
    assert [finish(one) for one in processes] == [want] * 3
    assert (
        not list(tmp_path.rglob("*.part"))
        and Sweep(wide, values(lanes), path=tmp_path, block=BLOCK).status.running == 0
    )
    shutil.rmtree(tmp_path)


@pytest.mark.slow
def test_killed_at_twenty_instants(tmp_path):
    """Within a write too: what was being written is there, half of it, under another name. Every other one has computed
    something before, however slow the machine is."""
    lanes, rng, halves, worked = 800 * BLOCK, np.random.default_rng(0), 0, []
    for turn in range(20):
        process, before = begin(tmp_path, lanes), done(tmp_path) if worked else 0
        assert said(process) == ["ready"]
        while turn % 2 and done(tmp_path) == before:
            time.sleep(0.001)
        time.sleep(rng.uniform(0.0, 0.06) if turn % 2 else rng.uniform(0.005, 0.12))
        kill(process)
        halves += bool(list((tmp_path / "blocks").glob("*.part")))
        worked.append(done(tmp_path) - before)
    assert halves >= 3 and sum(w > 0 for w in worked) >= 10 and done(tmp_path) < 800
    runs = Sweep(wide, values(lanes), path=tmp_path, block=BLOCK)
    parts = len(list(tmp_path.rglob("*.part")))
    for block in runs:
        assert digest(block.result) == digest(sweep(wide, values(lanes)[block.start : block.stop]))
    assert parts and not list(tmp_path.rglob("*.part"))
    assert digest(runs.result()) == digest(sweep(wide, values(lanes)))
    shutil.rmtree(tmp_path)
