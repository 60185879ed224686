"""Clicks on a diagram in a browser, as a user of a notebook makes them: matplotlib draws into a page.

Needs a Chromium of the system, `pip install playwright tornado`.
"""

import os
import shutil
import subprocess
import sys

import pytest


CHROMIUM = next(filter(None, map(shutil.which, ("chromium", "chromium-browser", "google-chrome"))), None)
SERVER = """
import jax
import matplotlib
import matplotlib.pyplot as plt

jax.config.update("jax_enable_x64", True)
matplotlib.use("webagg")
plt.rcParams["webagg.open_in_browser"] = False

import nsjax

branch = nsjax.continue_equilibrium(
    nsjax.gallery.DiscontinuousPitchfork(mu=-1.0), nsjax.gallery.Line(0.0), "mu", (-1.0, 1.0)
)
explorer = nsjax.plot.explore(branch)
canvas = explorer.figure.canvas
canvas.draw()
for i, one in enumerate(branch.branches):
    place = explorer.diagram.transData.transform((one.values[3], one.ys.x[3]))
    print("place", i, *place, canvas.get_width_height()[1], flush=True)
print("ready", flush=True)
canvas.mpl_connect("button_release_event", lambda event: print("selected", *explorer.selected, flush=True))
plt.show()
"""


@pytest.fixture
def server(tmp_path):
    pytest.importorskip("tornado")
    script = tmp_path / "server.py"
    script.write_text(SERVER)
    # Beside a server that runs already matplotlib takes another port, and says which.
    with subprocess.Popen(
        [sys.executable, script], stdout=subprocess.PIPE, text=True, env=os.environ | {"PYTHONUNBUFFERED": "1"}
    ) as process:
        yield process
        process.kill()


def said(server, word):
    """The next line of the server that begins with a word, and those before it."""
    lines = []
    for line in server.stdout:
        lines.append(line.split())
        if line.startswith(word):
            return lines
    raise AssertionError(f"the server ended: {lines}")


@pytest.mark.slow
@pytest.mark.skipif(CHROMIUM is None, reason="there is no Chromium")
def test_clicks_in_a_browser(server):
    sync_api = pytest.importorskip("playwright.sync_api")
    places = [line for line in said(server, "ready") if line[0] == "place"]
    assert len(places) > 1
    (address,) = [word for word in said(server, "To view figure")[-1] if word.startswith("http")]
    with sync_api.sync_playwright() as playwright:
        browser = playwright.chromium.launch(executable_path=CHROMIUM, args=["--no-sandbox"])
        page = browser.new_page(viewport=dict(width=1400, height=800))
        page.goto(address)
        canvas = page.locator("canvas.mpl-canvas").first
        canvas.wait_for()
        page.wait_for_timeout(1000)  # until the first picture has come
        before = canvas.screenshot()
        box = canvas.bounding_box()
        for _, number, x, y, height in places:
            page.mouse.click(box["x"] + float(x), box["y"] + float(height) - float(y))
            assert said(server, "selected")[-1] == ["selected", number, "3"]
        page.wait_for_timeout(500)
        assert canvas.screenshot() != before  # the point is marked, and its eigenvalues are drawn
        browser.close()
