"""Where the command line keeps compiled programs."""

import pathlib

import jax
import pytest

from nsjax._cli._cache import cache_folder, keep_programs


@pytest.mark.parametrize(
    "platform, variables, where",
    [
        ("linux", {"XDG_CACHE_HOME": ""}, ".cache/nsjax"),
        ("linux", {"XDG_CACHE_HOME": "/elsewhere"}, "/elsewhere/nsjax"),
        ("darwin", {}, "Library/Caches/nsjax"),
        ("win32", {"LOCALAPPDATA": "/local"}, "/local/nsjax"),
    ],
)
def test_the_folder_is_that_of_the_platform(monkeypatch, tmp_path, platform, variables, where):
    monkeypatch.setattr("sys.platform", platform)
    monkeypatch.setattr(pathlib.Path, "home", lambda: tmp_path)
    for name, value in variables.items():
        monkeypatch.setenv(name, value)
    assert cache_folder() == tmp_path / where


def test_another_place_is_left_as_it_is():
    before = jax.config.values["jax_compilation_cache_dir"]
    assert before  # the tests have one
    keep_programs()
    assert jax.config.values["jax_compilation_cache_dir"] == before
