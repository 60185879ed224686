"""What the command line keeps, and where."""

import os
import pathlib
import subprocess
import sys

import jax
import pytest

from nsjax._cli._cache import keep_compiled
from nsjax._numerics import _programs


def test_another_place_is_left_as_it_is(monkeypatch):
    monkeypatch.setattr(_programs._Place, "folder", None)
    before = jax.config.values["jax_compilation_cache_dir"]
    assert before  # the tests have one
    keep_compiled()
    assert jax.config.values["jax_compilation_cache_dir"] == before
    assert _programs._Place.folder == pathlib.Path(before)


def test_a_place_that_is_no_folder_is_for_jax_alone(monkeypatch, tmp_path):
    monkeypatch.setattr(_programs._Place, "folder", None)
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path))
    monkeypatch.setattr("sys.platform", "linux")
    before = jax.config.values["jax_compilation_cache_dir"]
    try:
        jax.config.update("jax_compilation_cache_dir", "gs://bucket/programs")
        keep_compiled()
        assert jax.config.values["jax_compilation_cache_dir"] == "gs://bucket/programs"
    finally:
        jax.config.update("jax_compilation_cache_dir", before)
    assert _programs._Place.folder == tmp_path / "nsjax" and (tmp_path / "nsjax").is_dir()


@pytest.mark.slow
def test_two_commands_at_once(tmp_path):
    """Neither reads what the other one is writing (pitfall 59)."""
    environment = {k: v for k, v in os.environ.items() if not k.startswith(("JAX_", "XLA_"))}
    environment |= {"XDG_CACHE_HOME": str(tmp_path), "LOCALAPPDATA": str(tmp_path), "HOME": str(tmp_path)}
    command = [sys.executable, "-W", "always", "-m", "nsjax", "orbit", "3.4", "--quiet"]
    for _ in range(2):  # with nothing in the folder, and with all
        pair = [subprocess.Popen(command, env=environment, stdout=-1, stderr=-1, text=True) for _ in range(2)]
        told = [process.communicate(timeout=300) for process in pair]
        assert [process.returncode for process in pair] == [0, 0], told
        assert told[0][0] == told[1][0] and "cache" not in told[0][1] + told[1][1]
