"""`g2ard.view` in an exported notebook: the frame that IPython writes, from a file and over http."""

import sys
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest

import g2ard
from helpers.browser import Browser
from helpers.pages import served
from helpers.scenes import checkered_ball

NOTEBOOK = """<!doctype html><html><head><meta charset="utf-8"></head><body><main>
<div style="height: 300px">cells before</div>
<div class="output_html rendered_html output_subarea output_execute_result"><iframe width="100%" height="640"
 src="about:blank" frameborder="0" allowfullscreen {extras}></iframe></div></main></body></html>"""
"""HTML that nbconvert writes for a cell's IFrame, partly in sight on every screen."""

FRAME = "document.querySelector('iframe').contentWindow"


@pytest.mark.parametrize("size", [(1280, 800), (390, 844)], ids=["laptop", "phone"])
def test_view_draws_in_an_exported_notebook(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, size: tuple[int, int]
) -> None:
    shell = SimpleNamespace(kernel=object())
    frames = SimpleNamespace(HTML=None, IFrame=lambda src, width, height, extras: extras)
    monkeypatch.setitem(sys.modules, "IPython", SimpleNamespace(get_ipython=lambda: shell))
    monkeypatch.setitem(sys.modules, "IPython.display", frames)
    extras = " ".join(g2ard.view(checkered_ball(2000)))
    page = tmp_path / "notebook.html"
    page.write_text(NOTEBOOK.replace("{extras}", extras), encoding="utf-8")
    with served(tmp_path) as address, Browser(*size) as browser:
        for url in (page.as_uri(), f"{address}/notebook.html"):
            browser.open(url)
            browser.run(
                "new Promise(done => { const look = () => document.querySelector('iframe') &&"
                f" {FRAME}.g2ard ? done() : setTimeout(look, 50); look(); }})"
            )
            drawn = browser.run(
                f"Promise.race([{FRAME}.g2ard.ready.then(() => 'drawn'),"
                " new Promise(done => setTimeout(() => done('black'), 60000))])"
            )
            assert drawn == "drawn", url
            picture = browser.picture()[310:].astype(float)
            assert np.ptp(picture, axis=2).max() > 40, url  # colours of the ball, not grey controls
