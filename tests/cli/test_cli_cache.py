"""What the command line keeps, and where; and how it has loops compiled."""

import os
import pathlib

import jax
import pytest

from nsjax._cli._cache import compile_loops_whole, keep_compiled
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


@pytest.mark.parametrize("flags", [None, "", "--xla_cpu_enable_fast_math=false"])
def test_loops_are_compiled_whole(monkeypatch, flags):
    monkeypatch.delenv("XLA_FLAGS", raising=False)
    if flags is not None:
        monkeypatch.setenv("XLA_FLAGS", flags)
    compile_loops_whole()
    found = os.environ["XLA_FLAGS"].split()
    assert found[:-1] == (flags or "").split() and "xla_cpu_small_while_loop_byte_threshold" in found[-1]
    compile_loops_whole()  # what is said stands
    assert os.environ["XLA_FLAGS"].split() == found
