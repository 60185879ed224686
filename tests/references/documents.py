"""What the documents show: blocks of Python, and what is printed below them."""

import contextlib
import io
import pathlib
import re
from typing import NamedTuple

import numpy as np


ROOT = pathlib.Path(__file__).parents[2]
DOCUMENTS = {
    path.relative_to(ROOT).as_posix(): path
    for path in [ROOT / "README.md", ROOT / "CONTRIBUTING.md", *sorted((ROOT / "docs").rglob("*.md"))]
}
# A block of Python, and one without a language right after it: its output. `<!-- slow -->` stands before one that
# compiles for more than a few seconds; it and what needs it are run by the slow tests. `<!-- not run: why -->` is for what
# cannot run in a test (millions of lanes, several machines); it is still Python.
BLOCK = re.compile(
    r"(?:<!-- (slow|not run: [^>]+) -->\n+)?^```python\n(.*?)^```$(?:\n\n^```\n(.*?)^```$)?", re.DOTALL | re.MULTILINE
)
NUMBER = re.compile(r"(?<![\w.])[-+]?(?:\d+\.?\d*(?:e[-+]?\d+)?|inf|nan)j?")


class Block(NamedTuple):
    code: str
    output: str | None
    slow: bool
    excerpt: bool
    line: int


def blocks(path: pathlib.Path) -> list[Block]:
    text = path.read_text(encoding="utf-8")
    found = BLOCK.finditer(text)
    return [
        Block(b[2], b[3], b[1] == "slow", (b[1] or "").startswith("not run"), text[: b.start(2)].count("\n"))
        for b in found
    ]


def run(path: pathlib.Path, slow: bool) -> int:
    """Runs the blocks of a document one after the other, those that are slow only if asked to, and compares what they
    print. Returns how many there were."""
    import matplotlib.pyplot as plt

    namespace, count = {"__name__": "document"}, 0
    for block in blocks(path):
        if block.slow and not slow:
            continue
        code = compile("\n" * block.line + block.code, str(path), "exec")
        if block.excerpt:
            continue
        printed, count = io.StringIO(), count + 1
        with contextlib.redirect_stdout(printed):
            exec(code, namespace)
        if block.output is not None:
            compare(printed.getvalue(), block.output)
        plt.close("all")
    return count


def compare(printed: str, written: str) -> None:
    """The same words, and the same numbers but for the last digits; what is written as zero or less than 1e-9 is
    rounding."""
    assert NUMBER.sub("#", printed).split() == NUMBER.sub("#", written).split(), printed
    for ours, theirs in zip(NUMBER.findall(printed), NUMBER.findall(written)):
        np.testing.assert_allclose(complex(ours), complex(theirs), rtol=1e-6, atol=1e-8, err_msg=printed)
