"""Where the command line keeps compiled programs."""

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
