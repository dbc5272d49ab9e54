"""A headless Chromium for tests, over its DevTools pipe: no driver and no further package is needed.

Looked for in $G2ARD_CHROMIUM, then among what is installed (Debian's chromium, Chrome, playwright's own);
tests that need one skip where there is none. It draws on the CPU (SwiftShader, its own Vulkan driver, which
variables such as VK_DRIVER_FILES would hide) and finds no other host.
"""

import atexit
import base64
import io
import json
import os
import shutil
import subprocess
import sys
import tempfile
import time
from functools import cache
from pathlib import Path
from typing import Any, Self

import numpy as np
import pytest
from PIL import Image

_NAMES = ("chromium", "chromium-browser", "google-chrome", "google-chrome-stable", "chrome")
_PLAYWRIGHT = ("chromium*/chrome-linux*/chrome", "chromium*/chrome-linux*/headless_shell")
_FLAGS = [
    *(
        "--headless=new",
        "--no-sandbox",
        "--remote-debugging-pipe",
        "--no-first-run",
        "--mute-audio",
    ),
    *("--use-gl=angle", "--use-angle=swiftshader", "--enable-unsafe-swiftshader"),
    *(
        "--disable-dev-shm-usage",
        "--disable-background-networking",
        "--host-resolver-rules=MAP * ~NOTFOUND, EXCLUDE 127.0.0.1",
    ),
    *("--force-device-scale-factor=1", "--force-color-profile=srgb"),
]
_SECONDS = 240


def chromium() -> str:
    """Return the browser's path; skip the test if none is installed."""
    if sys.platform == "win32":
        pytest.skip(
            "the browser is spoken to by file descriptors 3 and 4, which Windows does not pass on"
        )
    given = os.environ.get("G2ARD_CHROMIUM")
    found = [given] if given else [shutil.which(name) for name in _NAMES]
    cache = Path(
        os.environ.get("PLAYWRIGHT_BROWSERS_PATH", Path.home() / ".cache" / "ms-playwright")
    )
    found += [str(path) for pattern in _PLAYWRIGHT for path in sorted(cache.glob(pattern))]
    path = next((name for name in found if name and Path(name).is_file()), None)
    if path is None:
        pytest.skip("no Chromium or Chrome (install one, or set G2ARD_CHROMIUM)")
    return path


class _Chromium:
    """A process that all pages of the tests share: it starts in seconds, and keeps compiled shaders."""

    def __init__(self) -> None:
        self._profile = tempfile.TemporaryDirectory(ignore_cleanup_errors=True)
        ours, theirs = os.pipe(), os.pipe()  # what it reads, what it writes

        def place() -> None:
            for source, target in ((os.dup(ours[0]), 3), (os.dup(theirs[1]), 4)):
                os.dup2(source, target)

        self._process = subprocess.Popen(
            [chromium(), *_FLAGS, f"--user-data-dir={self._profile.name}"],
            env={name: value for name, value in os.environ.items() if not name.startswith("VK_")},
            stdout=subprocess.DEVNULL,
            stderr=subprocess.DEVNULL,
            preexec_fn=place,
            close_fds=False,
        )
        os.close(ours[0])
        os.close(theirs[1])
        self._to, self._from = ours[1], theirs[0]
        self._rest, self._number = b"", 0
        atexit.register(self._end)

    def _end(self) -> None:
        self._process.kill()
        self._process.wait()
        self._profile.cleanup()

    def write(self, method: str, parameters: dict[str, Any], session: str | None) -> int:
        """Write a call and return its number."""
        self._number += 1
        call = {"id": self._number, "method": method, "params": parameters}
        if session is not None:
            call["sessionId"] = session
        os.write(self._to, json.dumps(call).encode() + b"\0")
        return self._number

    def read(self, until: float) -> dict[str, Any]:
        """Return the next message, of any page."""
        import select

        while b"\0" not in self._rest:
            ready, _, _ = select.select([self._from], [], [], max(0, until - time.monotonic()))
            assert ready, f"the browser has not answered for {_SECONDS} s"
            piece = os.read(self._from, 1 << 20)
            assert piece, "the browser has ended"
            self._rest += piece
        message, self._rest = self._rest.split(b"\0", 1)
        return json.loads(message)


_start = cache(_Chromium)


class Browser:
    """One page of `width` × `height` pixels, which shares no storage with others."""

    def __init__(self, width: int, height: int) -> None:
        self._chromium = _start()
        self._session: str | None = None
        self.messages: list[str] = []
        self.requests: list[str] = []
        self._context = self.send("Target.createBrowserContext")["browserContextId"]
        where = {"browserContextId": self._context, "width": width, "height": height}
        target = self.send("Target.createTarget", url="about:blank", **where)["targetId"]
        self._session = self.send("Target.attachToTarget", targetId=target, flatten=True)[
            "sessionId"
        ]
        for domain in ("Page", "Runtime", "Network"):
            self.send(f"{domain}.enable")
        self.send("Emulation.setFocusEmulationEnabled", enabled=True)
        self.resize(width, height)

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self._session = None
        self.send("Target.disposeBrowserContext", browserContextId=self._context)

    def send(self, method: str, **parameters: Any) -> dict[str, Any]:
        """Call a method of the protocol; fail with the browser's error."""
        number = self._chromium.write(method, parameters, self._session)
        until = time.monotonic() + _SECONDS
        while True:
            answer = self._chromium.read(until)
            if answer.get("id") == number:
                assert "error" not in answer, f"{method}: {answer['error']}"
                return answer["result"]
            if answer.get("sessionId") == self._session:
                self._note(answer)

    def resize(self, width: int, height: int) -> None:
        size = {"width": width, "height": height, "deviceScaleFactor": 1, "mobile": False}
        self.send("Emulation.setDeviceMetricsOverride", **size)

    def open(self, url: str) -> None:
        self.send("Page.navigate", url=url)

    def run(self, expression: str) -> Any:
        """Return the awaited value of a JavaScript expression; fail with the exception it throws."""
        done = self.send(
            "Runtime.evaluate", expression=expression, awaitPromise=True, returnByValue=True
        )
        assert "exceptionDetails" not in done, (done["exceptionDetails"], self.messages)
        return done["result"].get("value")

    def picture(self) -> np.ndarray:
        """Return what the page shows as (H, W, 3) uint8."""
        shot = self.send("Page.captureScreenshot", format="png")["data"]
        return np.asarray(Image.open(io.BytesIO(base64.b64decode(shot))).convert("RGB"))

    def press(self, key: str, code: int) -> None:
        """Press and release a key, by its name and Windows' code."""
        for kind in ("rawKeyDown", "keyUp"):
            self.send(
                "Input.dispatchKeyEvent", type=kind, key=key, code=key, windowsVirtualKeyCode=code
            )

    def drag(self, start: tuple[float, float], end: tuple[float, float]) -> None:
        """Press the left button at a point, move, and let go at another."""
        for kind, (x, y) in (("mousePressed", start), ("mouseMoved", end), ("mouseReleased", end)):
            self.send(
                "Input.dispatchMouseEvent",
                type=kind,
                x=x,
                y=y,
                button="left",
                buttons=1,
                clickCount=1,
            )

    def _note(self, event: dict[str, Any]) -> None:
        found = event.get("params", {})
        if event.get("method") == "Runtime.consoleAPICalled":
            self.messages.append(
                " ".join(str(a.get("value", a.get("description"))) for a in found["args"])
            )
        elif event.get("method") == "Runtime.exceptionThrown":
            self.messages.append(str(found["exceptionDetails"]))
        elif event.get("method") == "Network.requestWillBeSent":
            self.requests.append(found["request"]["url"])
