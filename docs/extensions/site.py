"""What the site takes from outside of docs/: documents of the repository, and the notebooks as they were executed.

All pages link as files of the repository do, so that a link works in both places; here it becomes one of the site.
Formulas become MathML, which browsers draw without a script.
"""

import base64
import json
import pathlib
import posixpath
import re
from collections.abc import Callable, Iterator
from typing import Any

from latex2mathml.converter import convert


ROOT = pathlib.Path(__file__).parents[2]
# Documents that stand elsewhere, and their place in the site. (The notebooks are found by themselves.)
PLACES = {
    "README.md": "index.md",
    "KNOWN_GAPS.md": "KNOWN_GAPS.md",
    "CONTRIBUTING.md": "CONTRIBUTING.md",
    "CHANGELOG.md": "CHANGELOG.md",
    "benchmarks/README.md": "benchmarks/README.md",
}
FENCE = re.compile(r"(^```.*?^```[ ]*$|`[^`\n]+`)", re.DOTALL | re.MULTILINE)
LINK = re.compile(r"(\]\()([^)\s#:]+)(#[^)\s]*)?(\))")
FORMULA = re.compile(r"\$\$(.+?)\$\$|(?<![\\\w$])\$(?!\s)([^$\n]+(?:\n[^$\n]+)?)(?<!\s)\$(?!\d)", re.DOTALL)
WORD = "FORMULA{}NUMBER"


def notebooks() -> list[pathlib.Path]:
    return sorted(ROOT.glob("notebooks/*.ipynb"))


def place(path: str) -> str:
    """Where a file of the repository stands in the site."""
    if path.endswith(".ipynb"):
        return path.removesuffix(".ipynb") + ".md"
    return PLACES.get(path, path.removeprefix("docs/"))


def origin(page: str) -> str:
    """The file of the repository that became a page."""
    stem = page.removesuffix(".md")
    if (ROOT / f"{stem}.ipynb").exists():
        return f"{stem}.ipynb"
    return next((path for path, where in PLACES.items() if where == page), f"docs/{page}")


def outside_code(text: str, change: Callable[[str], str]) -> str:
    """The same text, changed where it is prose."""
    return "".join(part if i % 2 else change(part) for i, part in enumerate(FENCE.split(text)))


def targets(text: str, path: str) -> Iterator[str]:
    """The files of the repository to which a document at `path` links."""
    for part in FENCE.split(text)[::2]:
        for link in LINK.finditer(part):
            yield posixpath.normpath(posixpath.join(posixpath.dirname(path), link[2]))


def rewritten(text: str, path: str) -> str:
    """A document at `path` with the links and formulas of the site."""

    def moved(link: re.Match) -> str:
        target = posixpath.normpath(posixpath.join(posixpath.dirname(path), link[2]))
        found = posixpath.relpath(place(target), posixpath.dirname(place(path)) or ".")
        return f"{link[1]}{found}{link[3] or ''}{link[4]}"

    return outside_code(text, lambda part: LINK.sub(moved, part))


def without_formulas(text: str) -> tuple[str, list[str]]:
    """A document with a word for each formula, which Markdown leaves alone, and the formulas in MathML."""
    formulas: list[str] = []

    def kept(formula: re.Match) -> str:
        display = "block" if formula[1] else "inline"
        formulas.append(convert((formula[1] or formula[2]).strip(), display=display))
        return WORD.format(len(formulas) - 1)

    return outside_code(text, lambda part: FORMULA.sub(kept, part)), formulas


def as_markdown(path: pathlib.Path) -> tuple[str, dict[str, bytes]]:
    """A notebook as a page, and its pictures by name."""
    pictures: dict[str, bytes] = {}

    def shown(output: dict[str, Any]) -> str:
        if output["output_type"] == "stream":
            return fenced("".join(output["text"]))
        data = output.get("data", {})
        if "image/png" in data:
            name = f"{path.stem}_{len(pictures) + 1}.png"
            pictures[name] = base64.b64decode("".join(data["image/png"]))
            return f"![Picture {len(pictures)} of this notebook]({name})"
        return fenced("".join(data.get("text/plain", [])))

    parts = []
    for cell in json.loads(path.read_text(encoding="utf-8"))["cells"]:
        source = "".join(cell["source"])
        if cell["cell_type"] == "markdown":
            parts.append(source)
        elif cell["cell_type"] == "code":
            parts += [f"```python\n{source}\n```", *map(shown, cell["outputs"])]
    title, _, rest = "\n\n".join(parts).partition("\n")
    where = f'This page is <a href="{path.name}">{path.name}</a>, as it was executed last.'
    return f"{title}\n\n*{where}*\n{rest}", pictures


def fenced(text: str) -> str:
    return f"```{{ .text .no-copy }}\n{text.rstrip()}\n```" if text.strip() else ""


def taken_over() -> Iterator[tuple[str, str | bytes]]:
    """Name in the site and content of all that is not in docs/."""
    for path, where in PLACES.items():
        yield where, (ROOT / path).read_text(encoding="utf-8")
    for path in notebooks():
        page, pictures = as_markdown(path)
        yield place(path.relative_to(ROOT).as_posix()), page
        yield from ((f"notebooks/{name}", content) for name, content in pictures.items())


def files_linked(pages: dict[str, str]) -> set[str]:
    """Files of the repository to which pages link, and which are none themselves: tables, programs, pictures."""
    found = {target for page, text in pages.items() for target in targets(text, origin(page))}
    return {path for path in found if not path.startswith("docs/") and place(path) == path and (ROOT / path).is_file()}


# The hooks of mkdocs.


def on_files(files: Any, *, config: Any) -> Any:
    from mkdocs.structure.files import File

    pages = {file.src_uri: file.content_string for file in files if file.src_uri.endswith(".md")}
    for name, content in taken_over():
        files.append(File.generated(config, name, content=content))
        if isinstance(content, str):
            pages[name] = content
    known = {file.src_uri for file in files}
    for path in sorted(files_linked(pages) - known):
        files.append(File.generated(config, path, content=(ROOT / path).read_bytes()))
    for path in notebooks():  # to download
        name = path.relative_to(ROOT).as_posix()
        files.append(File.generated(config, name, content=path.read_bytes()))
    return files


_formulas: dict[str, list[str]] = {}  # of each page


def on_page_markdown(markdown: str, *, page: Any, config: Any, files: Any) -> str:
    text, _formulas[page.file.src_uri] = without_formulas(rewritten(markdown, origin(page.file.src_uri)))
    return text


def on_page_content(html: str, *, page: Any, config: Any, files: Any) -> str:
    formulas = _formulas[page.file.src_uri]
    return re.sub(WORD.format(r"(\d+)"), lambda word: formulas[int(word[1])], html)
