"""What the command line tells while it works: a line for each stage, and never a long silence."""

import io
import os
import subprocess
import sys
import time

import pytest

from nsjax._numerics import _stages
from nsjax._numerics._stages import is_command, is_quiet, Stages


class Terminal(io.StringIO):
    def isatty(self):
        return True


@pytest.fixture
def quick(monkeypatch):
    """Ticks twenty times as fast."""
    monkeypatch.setattr(_stages, "TICK", 0.07)
    monkeypatch.setattr(_stages, "LOOK", 0.01)


def test_a_stage_that_is_long_ticks(quick, monkeypatch):
    out = io.StringIO()
    monkeypatch.setattr(sys, "stderr", out)
    stages = Stages().start("starting")
    stages.stage("first")  # so soon that it was not said that it starts
    time.sleep(0.3)
    stages.stage("second")
    stages.progress("7 of 9")
    time.sleep(0.3)
    stages.stop()
    told = out.getvalue()
    time.sleep(0.1)
    assert out.getvalue() == told and not stages.on
    lines = told.splitlines()
    assert lines[0] == "nsjax: first ..." and "nsjax: second ..." in lines
    assert 1 <= lines.count("nsjax: first: 0 s") <= 4
    assert 1 <= lines.count("nsjax: second: 7 of 9, 0 s") <= 4
    stages.stage("nothing")  # of those that are over nothing is told
    assert out.getvalue() == told


def test_a_terminal_has_one_line_for_each_stage(quick, monkeypatch):
    out = Terminal()
    monkeypatch.setattr(sys, "stderr", out)
    stages = Stages().start("starting")
    stages.stage("first")
    time.sleep(0.2)
    stages.say("nsjax: by the way")
    stages.stage("second")
    stages.stop()
    lines = out.getvalue().split("\n")
    assert [line.rpartition("\r")[2].rstrip() for line in lines] == [
        "nsjax: first: 0 s",
        "nsjax: by the way",
        "nsjax: second ...",
        "",
    ]


def test_what_is_said_without_stages(capsys):
    Stages().say("alone")
    assert capsys.readouterr().err == "alone\n"


@pytest.mark.parametrize(
    "argv, orig, is_ours",
    [
        (["-m", "run", "3.4"], ["python", "-m", "nsjax", "run", "3.4"], True),
        (["-m", "x"], ["python", "-X", "dev", "-m", "pytest", "x"], False),
        (["/usr/bin/nsjax", "list"], ["python", "/usr/bin/nsjax", "list"], True),
        (["script.py"], ["python", "script.py"], False),
        (["-c"], ["python", "-c", "import nsjax"], False),
        ([], [], False),
    ],
)
def test_only_a_command_tells_that_it_starts(monkeypatch, argv, orig, is_ours):
    monkeypatch.setattr(sys, "argv", argv)
    monkeypatch.setattr(sys, "orig_argv", orig)
    assert is_command() is is_ours


def test_quiet_words():
    assert is_quiet(["run", "3.4", "-q"]) and is_quiet(["--quiet"]) and not is_quiet(["run", "quiet"])


def timed(*words, **environment):
    """The lines on standard error with the time between each and the one before [s]; the end of the process last."""
    began = time.monotonic()
    argv = [sys.executable, "-m", "nsjax", *map(str, words)]
    with subprocess.Popen(
        argv, stdout=subprocess.DEVNULL, stderr=subprocess.PIPE, text=True, env=os.environ | environment
    ) as process:
        found, last = [], began
        for line in process.stderr:
            now = time.monotonic()
            found.append((now - last, line.rstrip()))
            last = now
        assert process.wait() == 0, found
    return [*found, (time.monotonic() - last, "")]


@pytest.mark.slow
def test_never_silent_for_more_than_two_seconds(tmp_path):
    """The progress lines go on while programs are compiled, in a cache that is empty. (Where other processes take all cores, a thread may be late.)"""
    cache = tmp_path / "cache"
    found = timed("run", "3.4", "--out", tmp_path, JAX_COMPILATION_CACHE_DIR=str(cache))
    assert max(gap for gap, _ in found) < 2.0, found
    lines = [line for _, line in found]
    for stage in ("following the solution", "looking for a periodic orbit", "drawing"):
        assert sum(line.startswith(f"nsjax: {stage}") and line.endswith(" ...") for line in lines) == 1, lines
    kept = len(list(cache.iterdir()))
    assert kept > 10
    # And again: what was compiled is there, nothing is added but by other options.
    quiet = timed("run", "3.4", "--out", tmp_path, "--quiet", JAX_COMPILATION_CACHE_DIR=str(cache))
    assert [line for _, line in quiet] == [""]


@pytest.mark.slow
def test_no_cache(tmp_path):
    cache = tmp_path / "cache"
    timed("orbit", "3.4", "--no-cache", JAX_COMPILATION_CACHE_DIR=str(cache))
    assert not cache.exists() or not list(cache.iterdir())


def test_help_tells_of_the_cache(capsys):
    from nsjax import __main__ as command

    for words in (["--help"], ["run", "--help"]):
        with pytest.raises(SystemExit):
            command.main(words)
        assert "--no-cache" in capsys.readouterr().out
    with pytest.raises(SystemExit):
        command.main(["--help"])
    told = " ".join(capsys.readouterr().out.split())
    assert "JAX_COMPILATION_CACHE_DIR" in told and "nsjax" in told
