"""Compiled programs, kept from one command to the next; and what else a command does to start quickly."""

import gc
import os
import pathlib
import sys

import jax


def cache_folder() -> pathlib.Path:
    """Where programs of this user keep what can be made again."""
    home = pathlib.Path.home()
    if sys.platform == "win32":
        base = pathlib.Path(os.environ.get("LOCALAPPDATA", home / "AppData" / "Local"))
    elif sys.platform == "darwin":
        base = home / "Library" / "Caches"
    else:
        base = pathlib.Path(os.environ.get("XDG_CACHE_HOME") or home / ".cache")
    return base / "nsjax"


def keep_programs(keep: bool = True) -> None:
    """Compiled programs are written to the user's cache, or where JAX was told to keep them; small ones too, of which a
    command has several dozen. If they are not to be kept, none is read either."""
    if not keep:
        jax.config.update("jax_enable_compilation_cache", False)
        return
    if not jax.config.values.get("jax_compilation_cache_dir"):
        folder = cache_folder()
        try:
            folder.mkdir(parents=True, exist_ok=True)
        except OSError:  # a home that cannot be written to: every command compiles for itself
            return
        jax.config.update("jax_compilation_cache_dir", str(folder))
    if "JAX_PERSISTENT_CACHE_MIN_COMPILE_TIME_SECS" not in os.environ:
        jax.config.update("jax_persistent_cache_min_compile_time_secs", 0.0)


def collect_rarely() -> None:
    """Tracing makes many objects that stay, and looking through them for garbage took a tenth of a command's time."""
    gc.freeze()
    gc.set_threshold(100_000, 20, 20)
