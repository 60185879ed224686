"""Every notebook runs from top to bottom; what it claims it asserts itself."""

import pathlib
import shutil

import jax
import pytest


NOTEBOOKS = sorted((pathlib.Path(__file__).parents[2] / "notebooks").glob("*.ipynb"))


def execute(path, monkeypatch, timeout=600):
    """Runs a notebook in its folder, with what stands beside it there."""
    import nbformat
    from nbclient import NotebookClient

    # What the tests have compiled, or another notebook, is not compiled again.
    folder = jax.config.jax_compilation_cache_dir  # pyright: ignore[reportAttributeAccessIssue]
    monkeypatch.setenv("JAX_COMPILATION_CACHE_DIR", str(folder))
    monkeypatch.setenv("JAX_PERSISTENT_CACHE_MIN_COMPILE_TIME_SECS", "0")
    notebook = nbformat.read(path, as_version=4)
    # The kernel inherits the quick compiler flags of `conftest`, and looks for garbage as seldom as the tests do.
    rarely = ["--IPKernelApp.exec_lines=import gc; gc.set_threshold(100_000, 20, 20)"]
    where = {"metadata": {"path": str(path.parent)}}
    NotebookClient(notebook, timeout=timeout, resources=where, extra_arguments=rarely).execute()
    return [cell for cell in notebook.cells if cell.cell_type == "code"]


@pytest.mark.notebook
@pytest.mark.filterwarnings("default")  # those of the machinery around the kernel are not ours
@pytest.mark.parametrize("path", NOTEBOOKS, ids=lambda path: path.stem)
def test_notebook_runs(path, monkeypatch):
    codes = execute(path, monkeypatch)
    assert all(cell.execution_count for cell in codes)
    assert any("image/png" in output.get("data", {}) for cell in codes for output in cell.outputs)


@pytest.mark.slow
@pytest.mark.filterwarnings("default")
@pytest.mark.parametrize("name", ["03_equilibria", "04_branches", "08_chaos", "09_your_own_model", "13_two_parameters"])
def test_results_in_files_are_made_anew(name, tmp_path, monkeypatch):
    """Where a notebook finds no files beside it, it computes what they hold, and asserts the same of it."""
    (path,) = [one for one in NOTEBOOKS if one.stem == name]
    execute(pathlib.Path(shutil.copy(path, tmp_path)), monkeypatch, timeout=3600)
    made = {one.relative_to(tmp_path) for one in tmp_path.glob("*/*.npz")}
    assert made and all((path.parent / one).exists() for one in made)
