"""Streamed levels loaded by the viewer that they are for; see `browser.py`."""

import json
import re
import threading
from collections.abc import Iterator
from functools import partial
from http.server import SimpleHTTPRequestHandler, ThreadingHTTPServer
from pathlib import Path

import pytest

from g2ard.jobs.levels import lod
from g2ard.jobs.viewer_frame import frame_with
from g2ard.levels import Cut, save_levels
from g2ard.scene.cameras import Camera, Cameras
from g2ard.scene.splats import Splats
from g2ard.viewer import write_page
from helpers.browser import Browser
from helpers.pages import FRONT, GREY, HEIGHT, WIDTH, assert_shows, rendered, show
from helpers.scenes import checkered_ball

RATIOS = (1.0, 4.0, 16.0)


class _Quiet(SimpleHTTPRequestHandler):
    def log_message(self, *_: object) -> None:
        pass


@pytest.fixture(scope="module")
def served(tmp_path_factory: pytest.TempPathFactory) -> Iterator[tuple[Path, str]]:
    """A folder and its address: pages may not read the files beside them."""
    folder = tmp_path_factory.mktemp("served")
    server = ThreadingHTTPServer(("127.0.0.1", 0), partial(_Quiet, directory=str(folder)))
    threading.Thread(target=server.serve_forever, daemon=True).start()
    yield folder, f"http://127.0.0.1:{server.server_port}"
    server.shutdown()
    server.server_close()


@pytest.fixture(scope="module")
def levels() -> tuple[Splats, ...]:
    return lod(checkered_ball(20_000), ratios=RATIOS, recover=False, size=160).splats


@pytest.fixture(scope="module")
def browser() -> Iterator[Browser]:
    with Browser(WIDTH, HEIGHT) as page:
        yield page


def streaming(folder: Path, name: str, levels: tuple[Splats, ...], camera: Camera) -> None:
    """A page beside streamed levels, which it loads as they are needed."""
    stand = frame_with(levels[0], Cameras.of([camera]), up=(0, 0, 1))
    save_levels(folder / name, [stand.of(level) for level in levels], cut=Cut(4096, 1.0, 512), overwrite=True)
    page = folder / f"{name}.html"
    write_page(page, [("scene", stand.of(levels[0]))], start=stand.start, background=GREY, overwrite=True)
    text, count = re.subn(
        r"contentUrl: files\[index\],\s*contents: [^\n]*\n",
        f"contentUrl: '{name}/lod-meta.json',\n",
        page.read_text(),
    )
    assert count == 1
    page.write_text(text)


@pytest.mark.parametrize("finest", [0, 1, 2])
def test_each_level(
    browser: Browser, served: tuple[Path, str], levels: tuple[Splats, ...], finest: int
) -> None:
    folder, address = served
    name = f"from{finest}"
    streaming(folder, name, levels[finest:], FRONT)
    meta = json.loads((folder / name / "lod-meta.json").read_text())
    assert meta["lodLevels"] == len(RATIOS) - finest
    browser.requests.clear()
    show(browser, f"{address}/{name}.html")
    assert_shows(browser, rendered(levels[finest]), 35)
    fetched = {url.removeprefix(f"{address}/{name}/") for url in browser.requests if f"/{name}/" in url}
    assert "lod-meta.json" in fetched
    assert any(re.match(r"0_\d+/", file) for file in fetched)
