"""Pages in the browser: a folder served on 127.0.0.1 until Ctrl-C."""

import webbrowser
from collections.abc import Iterator
from contextlib import contextmanager
from functools import partial
from http.server import SimpleHTTPRequestHandler, ThreadingHTTPServer
from pathlib import Path
from threading import Event, Thread
from typing import Any

from g2ard.cli.frame import Run


class _Quiet(SimpleHTTPRequestHandler):
    def log_message(self, format: str, *args: Any) -> None:
        """Log nothing."""


@contextmanager
def served(folder: Path) -> Iterator[str]:
    """Serve a folder to this machine alone, and yield its address."""
    server = ThreadingHTTPServer(("127.0.0.1", 0), partial(_Quiet, directory=str(folder)))
    thread = Thread(target=server.serve_forever, daemon=True)
    thread.start()
    try:
        yield f"http://127.0.0.1:{server.server_address[1]}/"
    finally:
        server.shutdown()
        server.server_close()


def show(run: Run, folder: Path, page: str) -> None:
    """Open a page of a folder in the browser, and serve it until Ctrl-C."""
    with served(folder) as address:
        run.answer(f"{address}{page} (Ctrl-C ends)")
        try:
            webbrowser.open(address + page)
            Event().wait()
        except KeyboardInterrupt:
            run.say("stopped")
