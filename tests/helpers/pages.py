"""Viewer pages opened in a browser."""

import base64
import json
import re
import threading
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import replace
from functools import partial
from http.server import SimpleHTTPRequestHandler, ThreadingHTTPServer
from pathlib import Path

import numpy as np

from g2ard.rendering.metrics import psnr
from g2ard.rendering.renderer import Renderer
from g2ard.scene.cameras import Camera
from g2ard.scene.splats import Splats
from helpers.browser import Browser

WIDTH, HEIGHT = 480, 360
GREY = (0.2, 0.3, 0.4)
FRONT = Camera.facing([1.8, -1.6, 0.9], [0, 0, 0], width=WIDTH, height=HEIGHT, fov=55, name="front")


class _Quiet(SimpleHTTPRequestHandler):
    def log_message(self, *_: object) -> None:
        pass


@contextmanager
def served(folder: Path) -> Iterator[str]:
    """Serve a folder, whose pages may not read the files beside them otherwise; give its address."""
    server = ThreadingHTTPServer(("127.0.0.1", 0), partial(_Quiet, directory=str(folder)))
    threading.Thread(target=server.serve_forever, daemon=True).start()
    yield f"http://127.0.0.1:{server.server_port}"
    server.shutdown()
    server.server_close()


def half_height(fields: Sequence[Sequence[float]], aspect: float) -> float:
    """Twin of halfHeight in fit.js."""
    wide, degrees = np.transpose(fields)
    halves = np.log(np.tan(np.radians(degrees) / 2))
    return float(np.exp(np.interp(np.log(aspect), np.log(wide), halves)))


def opened(page: Path, camera: Camera) -> Camera:
    """Return a view as near as the page opens at it."""
    found = re.search(r'"fov": (\[\[.*?\]\])', page.read_text(encoding="utf-8"))
    assert found
    half = half_height(json.loads(found[1]), camera.width / camera.height)
    focal = camera.height / 2 / half
    return replace(
        camera, K=np.array([[focal, 0, camera.K[0, 2]], [0, focal, camera.K[1, 2]], [0, 0, 1]])
    )


def show(browser: Browser, page: Path | str) -> None:
    browser.open(page if isinstance(page, str) else page.absolute().as_uri())
    browser.run(
        "new Promise(done => { const look = () => window.g2ard ? done() : setTimeout(look, 20); look(); })"
    )
    browser.run("g2ard.ready.then(() => null)")


def drawn(
    browser: Browser,
    accept: Callable[[np.ndarray], bool],
    index: int = 0,
    size: tuple[int, int] = (WIDTH, HEIGHT),
) -> np.ndarray:
    """(H, W, 3) in [0, 1]: what a viewer draws, without the controls above it. Sorting runs beside drawing:
    frames are asked for until one is accepted; the last one is given after a minute."""
    width, height = size
    wanted = f"{{width: {width}, height: {height}, supersample: 1}}"
    until = time.monotonic() + 60
    while True:
        shot = browser.run(f"g2ard.ready.then(viewers => viewers[{index}].captureFrame({wanted}))")[
            "data"
        ]
        pixels = np.frombuffer(base64.b64decode(shot), np.uint8).reshape(height, width, 4)
        picture = pixels[..., :3] / np.float32(255)
        if accept(picture) or time.monotonic() > until:
            return picture
        browser.run("new Promise(done => setTimeout(done, 300))")


def like(expected: np.ndarray, decibels: float) -> Callable[[np.ndarray], bool]:
    """Return a check that a picture is within some decibels of an expected one."""
    return lambda picture: psnr(picture, expected) > decibels


def assert_shows(
    browser: Browser, expected: np.ndarray, decibels: float, index: int = 0
) -> np.ndarray:
    """Check that a viewer draws an expected picture; return what it draws."""
    height, width = expected.shape[:2]
    picture = drawn(browser, like(expected, decibels), index, (width, height))
    assert psnr(picture, expected) > decibels, psnr(picture, expected)
    return picture


def rendered(scene: Splats, camera: Camera = FRONT) -> np.ndarray:
    return np.clip(Renderer(scene, background=GREY).image(camera), 0, 1)
