"""Programs whose stdout or stderr is closed (`>&-`, `2>&-`) do their work all the same."""

import os
import shutil
import subprocess
import sys
import warnings
from pathlib import Path

import pytest

from helpers.calls import CALLS, FIRST, output_of
from helpers.killed import command, forked
from helpers.project import environment

pytestmark = pytest.mark.skipif(os.name == "nt", reason="needs a POSIX shell")

APART = ("--version", "info ball.ply --json -", "info missing.ply")
"""Commands that are started as programs."""
NUMBERS = {"<&-": 0, ">&-": 1, "2>&-": 2}


def run_apart(folder: Path, words: str, closed: str) -> tuple[int, str]:
    """Return the exit status of a new program, and all that the open streams get."""
    line = f'exec "$0" -m g2ard {words} {closed}'
    done = subprocess.run(
        ["sh", "-c", line, sys.executable],
        cwd=folder,
        env=environment(),
        capture_output=True,
        text=True,
    )
    return done.returncode, done.stdout + done.stderr


def run(folder: Path, words: str, closed: str) -> tuple[int, str]:
    """Do as `run_apart`, in a forked process, which Python's start leaves in the same state."""

    def work() -> None:
        for stream in closed.split():
            os.close(NUMBERS[stream])
            setattr(sys, ("stdin", "stdout", "stderr")[NUMBERS[stream]], None)
        command(words.split())()

    with warnings.catch_warnings():
        warnings.simplefilter("ignore", DeprecationWarning)  # forking with threads
        status = forked(work, folder / "streams", folder / "streams", folder)
    return status, (folder / "streams").read_text()


@pytest.mark.parametrize("name", [*FIRST, "simplify tiles"])
def test_every_command_writes_its_result(name: str, inputs: Path, tmp_path: Path) -> None:
    folder = shutil.copytree(inputs, tmp_path / "a")
    words = CALLS[name].replace("--workers 1", "--workers 2")  # processes that inherit the streams
    assert run(folder, f"{words} --json told.json", ">&- 2>&-") == (0, "")
    assert (folder / output_of(name)).exists()
    assert (folder / "told.json").read_text()[0] == "{"


@pytest.mark.parametrize("closed", [">&-", "<&- 2>&-"])
@pytest.mark.parametrize(
    ("words", "status"),
    [
        ("--version", 0),
        ("simplify --help", 0),
        ("simplify ball.ply -r 8 --no-views -o small.ply -w", 0),
        ("info ball.ply", 0),
        ("info ball.ply --json -", 0),
        (f"{CALLS['evaluate']} --teacher ball.ply", 0),
        ("info missing.ply", 1),
        ("simplify missing.ply -r 8 -o small.ply", 1),
        ("simplify", 2),
        ("unknown", 2),
    ],
)
def test_the_status_does_not_depend_on_the_streams(
    words: str, status: int, closed: str, inputs: Path, tmp_path: Path
) -> None:
    folder = shutil.copytree(inputs, tmp_path / "a")
    found, said = (run_apart if words in APART else run)(folder, words, closed)
    assert found == status, said
    assert "Traceback" not in said
