"""What the command line keeps, and where."""

import pathlib

import jax

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
