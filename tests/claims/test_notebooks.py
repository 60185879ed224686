"""Every notebook runs from top to bottom; what it claims it asserts itself."""

import pathlib

import jax
import pytest


NOTEBOOKS = sorted((pathlib.Path(__file__).parents[2] / "notebooks").glob("*.ipynb"))


@pytest.mark.notebook
@pytest.mark.filterwarnings("default")  # those of the machinery around the kernel are not ours
@pytest.mark.parametrize("path", NOTEBOOKS, ids=lambda path: path.stem)
def test_notebook_runs(path, monkeypatch):
    import nbformat
    from nbclient import NotebookClient

    # What the tests have compiled, or another notebook, is not compiled again.
    folder = jax.config.jax_compilation_cache_dir  # pyright: ignore[reportAttributeAccessIssue]
    monkeypatch.setenv("JAX_COMPILATION_CACHE_DIR", str(folder))
    monkeypatch.setenv("JAX_PERSISTENT_CACHE_MIN_COMPILE_TIME_SECS", "0.2")
    notebook = nbformat.read(path, as_version=4)
    # The kernel inherits the quick compiler flags of `conftest`, and looks for garbage as seldom as the tests do.
    rarely = ["--IPKernelApp.exec_lines=import gc; gc.set_threshold(100_000, 20, 20)"]
    where = {"metadata": {"path": str(path.parent)}}
    NotebookClient(notebook, timeout=600, resources=where, extra_arguments=rarely).execute()
    codes = [cell for cell in notebook.cells if cell.cell_type == "code"]
    assert all(cell.execution_count for cell in codes)
    assert any("image/png" in output.get("data", {}) for cell in codes for output in cell.outputs)
