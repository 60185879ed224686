"""What the documents say can be relied on: pages are complete, links lead somewhere, blocks run and print what stands
below them. That the site builds is checked by `mkdocs build --strict` in `.ci/run`."""

import collections
import pathlib
import re
import types

import jax
import pytest
from documents import blocks, DOCUMENTS, ROOT, run

import nsjax


SUBMODULES = {
    name: o for name, o in vars(nsjax).items() if isinstance(o, types.ModuleType) and not name.startswith("_")
}
FENCE = re.compile(r"^```.*?^```|`[^`\n]*`", re.DOTALL | re.MULTILINE)
LINK = re.compile(r"\]\(([^)\s]+)\)")
LINKED = DOCUMENTS | {name: ROOT / name for name in ("KNOWN_GAPS.md", "CHANGELOG.md", "benchmarks/README.md")}


def text(name: str) -> str:
    return LINKED[name].read_text(encoding="utf-8")


def public_names() -> set[str]:
    """As one writes them: `nsjax.solve`, and `nsjax.flow.Event` for what `nsjax` does not export itself."""

    def names(module: types.ModuleType) -> dict[str, object]:
        found = {name: o for name, o in vars(module).items() if not name.startswith("_")}
        return {name: o for name, o in found.items() if not isinstance(o, types.ModuleType)}

    top = names(nsjax)
    deeper = {
        f"nsjax.{module}.{name}"
        for module, o in SUBMODULES.items()
        for name, value in names(o).items()
        if top.get(name) is not value
    }
    return {f"nsjax.{name}" for name in top} | deeper


def test_every_public_name_stands_on_exactly_one_page():
    found = [name for page in DOCUMENTS for name in re.findall(r"^::: ([\w.]+)$", text(page), re.MULTILINE)]
    twice = [name for name, count in collections.Counter(found).items() if count > 1]
    assert not twice
    missing = public_names() - set(found)
    assert not missing, f"write `::: name` into a page of docs/api/ for {sorted(missing)}"
    assert set(found) == public_names()


def test_every_result_stands_on_exactly_one_page():
    headings = [name for page in DOCUMENTS for name in re.findall(r"^### (\w+)$", text(page), re.MULTILINE)]
    results = list(nsjax.RESULTS._name_to_item)
    assert len(results) > 30
    assert {name: headings.count(name) for name in results} == dict.fromkeys(results, 1)
    # No heading of that page is left over from a result that is gone.
    assert set(re.findall(r"^### (\w+)$", text("docs/errors.md"), re.MULTILINE)) == set(results)


def test_every_page_is_in_the_navigation():
    config = (ROOT / "mkdocs.yml").read_text(encoding="utf-8")
    nav = re.findall(r"([\w./]+\.md)$", config[config.index("\nnav:") :], re.MULTILINE)
    assert len(nav) == len(set(nav))
    pages = {name.removeprefix("docs/") for name in DOCUMENTS if name.startswith("docs/")}
    notebooks = {path.relative_to(ROOT).with_suffix(".md").as_posix() for path in (ROOT / "notebooks").glob("*.ipynb")}
    assert pages | notebooks <= set(nav), sorted((pages | notebooks) - set(nav))


def anchors(path: pathlib.Path) -> set[str]:
    prose = re.sub(r"^```.*?^```", "", path.read_text(encoding="utf-8"), flags=re.DOTALL | re.MULTILINE)
    titles = re.findall(r"^#+ (.*)$", prose, re.MULTILINE)
    return {re.sub(r"[-\s]+", "-", re.sub(r"[^\w\s-]", "", title).strip().lower()) for title in titles}


@pytest.mark.parametrize("name", LINKED)
def test_links_lead_to_files_of_the_repository(name):
    for link in LINK.findall(FENCE.sub("", text(name))):
        if "://" in link:
            continue
        path, _, anchor = link.partition("#")
        target = (LINKED[name].parent / path).resolve() if path else LINKED[name]
        assert target.is_file(), link
        assert target.is_relative_to(ROOT), link
        assert not anchor or anchor in anchors(target), link


@pytest.mark.parametrize("name", DOCUMENTS)
def test_names_that_are_mentioned_exist(name):
    for path in re.findall(r"\bnsjax((?:\.[A-Za-z]\w*)+)", text(name)):
        found = nsjax
        for part in path[1:].split("."):
            assert hasattr(found, part), f"nsjax{path}"
            found = getattr(found, part)


def test_there_are_blocks():
    """Of both kinds, and with outputs; so that the tests below cannot pass because nothing was found."""
    found = [block for path in DOCUMENTS.values() for block in blocks(path)]
    assert sum(not block.slow for block in found) >= 15
    assert sum(block.slow for block in found) >= 15
    assert sum(block.output is not None for block in found) >= 20
    written = sum(path.read_text(encoding="utf-8").count("```python") for path in DOCUMENTS.values())
    assert len(found) == written
    # What a newcomer reads first runs, all of it.
    first = [path for name, path in DOCUMENTS.items() if name == "README.md" or name.startswith("docs/guide/")]
    assert len(first) > 10
    assert not any(block.excerpt for path in first for block in blocks(path))


@pytest.fixture
def as_a_user(tmp_path, monkeypatch):
    """Files go elsewhere; dtypes are promoted as JAX does by default."""
    monkeypatch.chdir(tmp_path)
    with jax.numpy_dtype_promotion("standard"):
        yield


QUICK = [name for name, path in DOCUMENTS.items() if any(not b.slow and not b.excerpt for b in blocks(path))]
SLOW = [name for name, path in DOCUMENTS.items() if any(block.slow for block in blocks(path))]


@pytest.mark.parametrize("name", QUICK)
def test_blocks_run(name, as_a_user):
    assert run(DOCUMENTS[name], slow=False)


@pytest.mark.slow
@pytest.mark.parametrize("name", SLOW)
def test_slow_blocks_run(name, as_a_user):
    assert run(DOCUMENTS[name], slow=True)
