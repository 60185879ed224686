"""The pictures of the guide: `python docs/pictures/guide.py` runs the blocks of Python of each page that shows some.

A block that is followed by a picture of this folder has drawn it.
"""

import argparse
import contextlib
import io
import pathlib
import re
import tempfile

import matplotlib


HERE = pathlib.Path(__file__).parent
STEP = re.compile(
    r"^```python\n(?P<code>.*?)^```$|^!\[[^]]*\]\((?P<picture>[^)]*pictures/[\w.]+)\)", re.DOTALL | re.MULTILINE
)


def pages():
    """Those that show pictures of this folder."""
    for path in sorted(HERE.parent.rglob("*.md")):
        steps = list(STEP.finditer(path.read_text(encoding="utf-8")))
        if any(step["picture"] for step in steps):
            yield path, steps


def main():
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("pages", nargs="*", help="names of pages, such as branches; by default all")
    args = parser.parse_args()
    matplotlib.use("Agg")
    import matplotlib.pyplot as plt

    for path, steps in pages():
        if args.pages and path.stem not in args.pages:
            continue
        namespace = {"__name__": "page"}
        for step in steps:
            if step["picture"]:
                picture = (path.parent / step["picture"]).resolve()
                plt.savefig(picture, dpi=90)
                print(f"{path.name}: {picture.name}")
            else:
                plt.close("all")
                plt.rcParams["figure.figsize"] = (6.4, 3.8)
                with (
                    contextlib.redirect_stdout(io.StringIO()),
                    tempfile.TemporaryDirectory() as folder,
                    contextlib.chdir(folder),
                ):
                    exec(step["code"], namespace)


if __name__ == "__main__":
    main()
