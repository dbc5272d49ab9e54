"""Commands in a pseudo-terminal, and the screen that they leave.

A server process imports g2ard once and forks for each command: Python's start would take most of the time.
Run as a program, this module is the server.
"""

import json
import os
import subprocess
import sys
from dataclasses import dataclass
from pathlib import Path

from helpers.project import ROOT, environment

LINES = 200


@dataclass(frozen=True)
class Screen:
    """The end of a command in a terminal: its exit status, stdout if a pipe, what the terminal received, its
    lines at the end and whether its cursor is visible."""

    status: int
    out: str
    received: str
    lines: list[str]
    cursor: bool


class Terminal:
    """Runs `g2ard` in pseudo-terminals."""

    def __init__(self) -> None:
        self._server = subprocess.Popen(
            [sys.executable, "-m", "helpers.terminal"],
            env=environment(
                OPENBLAS_NUM_THREADS="1", PYTHONPATH=f"{ROOT}{os.pathsep}{ROOT / 'tests'}"
            ),
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            text=True,
        )

    def run(
        self,
        words: list[str],
        cwd: Path,
        columns: int = 80,
        *,
        piped: bool = True,
        stop_at: str = "",
        keys: str = "\x03",
        **variables: str,
    ) -> Screen:
        """Run a command with stderr on the terminal, and stdout too unless it is `piped`.

        Args:
            stop_at: text at which `keys` are typed; Ctrl-C by default.
            variables: of the environment.
        """
        import pyte

        asked = {"words": words, "cwd": str(cwd), "columns": columns, "piped": piped}
        asked |= {"stop_at": stop_at, "keys": keys, "variables": variables}
        assert self._server.stdin is not None
        assert self._server.stdout is not None
        self._server.stdin.write(json.dumps(asked) + "\n")
        self._server.stdin.flush()
        found = json.loads(self._server.stdout.readline())
        screen = pyte.Screen(columns, LINES)
        pyte.Stream(screen).feed(found["received"])
        lines = [line.rstrip() for line in screen.display]
        while lines and not lines[-1]:
            lines.pop()
        return Screen(
            found["status"], found["out"], found["received"], lines, not screen.cursor.hidden
        )

    def close(self) -> None:
        self._server.communicate()


def _serve() -> None:
    """Run the commands that stdin asks for, one JSON object per line."""
    from importlib import import_module

    import pytest

    from g2ard.cli import console
    from g2ard.cli.app import COMMANDS
    from helpers.plans import plan_small_scenes

    plan_small_scenes(pytest.MonkeyPatch())

    # Commands on tiny scenes end before the live line would appear.
    console._LIVE_LINE_DELAY, console._LIVE_LINE_PERIOD, console._SILENT_SECONDS = 0.0, 0.02, 0.04  # type: ignore[misc]
    for name in (
        "rich.live",
        "rich.progress_bar",
        "rich.table",
        "g2ard.pipeline",
        "g2ard.jobs.distill",
    ):
        import_module(name)
    for name in COMMANDS:
        import_module(f"g2ard.cli.commands.{name}")
    for line in sys.stdin:
        print(json.dumps(_run(**json.loads(line))), flush=True)


def _run(
    words: list[str],
    cwd: str,
    columns: int,
    piped: bool,
    stop_at: str,
    keys: str,
    variables: dict[str, str],
) -> dict[str, object]:
    import fcntl
    import pty
    import struct
    import termios
    import threading

    out_end, out_start = os.pipe()
    child, terminal = pty.fork()
    if not child:
        os.close(out_end)
        if piped:
            os.dup2(out_start, 1)
        fcntl.ioctl(2, termios.TIOCSWINSZ, struct.pack("HHHH", LINES, columns, 0, 0))
        _become(words, cwd, variables)
    os.close(out_start)
    out = [b""]
    reader = threading.Thread(target=lambda: out.append(_all_of(out_end)))
    reader.start()
    received = b""
    while True:
        try:
            piece = os.read(terminal, 1 << 16)
        except OSError:  # Linux reports the closed side as an error
            break
        if not piece:
            break
        received += piece
        if stop_at and stop_at.encode() in received:
            os.write(terminal, keys.encode())
            stop_at = ""
    _, status = os.waitpid(child, 0)
    reader.join()
    os.close(terminal)
    code = os.waitstatus_to_exitcode(status)
    return {"status": code, "out": out[-1].decode(), "received": received.decode(errors="replace")}


def _all_of(pipe: int) -> bytes:
    with open(pipe, "rb") as stream:
        return stream.read()


def _become(words: list[str], cwd: str, variables: dict[str, str]) -> None:
    """Run the program in this process, and end it."""
    import signal

    status: object = 70
    try:
        os.chdir(cwd)
        for name in ("COLUMNS", "LINES", "NO_COLOR", "FORCE_COLOR", "TERM"):
            os.environ.pop(name, None)
        os.environ.update({"TERM": "xterm-256color", **variables})
        sys.stdout, sys.stderr = os.fdopen(1, "w"), os.fdopen(2, "w")
        signal.signal(signal.SIGINT, signal.default_int_handler)
        sys.argv = ["g2ard", *words]
        from g2ard.__main__ import main

        main()
        status = 0
    except SystemExit as end:
        status = end.code
    except BaseException:
        import traceback

        traceback.print_exc()
    finally:
        sys.stdout.flush()
        sys.stderr.flush()
        os._exit(int(status or 0) if isinstance(status, int | None) else 1)


if __name__ == "__main__":
    _serve()
