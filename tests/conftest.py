"""Where real data is, and what tests share."""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path

import pytest

_ROOT = Path(__file__).resolve().parents[1]
_DATA = Path(os.environ.get("G2ARD_DATA", Path(__file__).parents[2] / "shared" / "data"))


@pytest.fixture(scope="session")
def data() -> Path:
    """The folder of real scenes; a test that needs it is skipped where there is none."""
    if not _DATA.is_dir():
        pytest.skip(f"no real data at {_DATA} (set G2ARD_DATA)")
    return _DATA


@pytest.fixture
def command_line():
    """Runs `g2ard …` as a program: (exit status, stdout, stderr)."""

    def run(*arguments, cwd):
        path = os.pathsep.join(filter(None, [str(_ROOT), os.environ.get("PYTHONPATH")]))
        done = subprocess.run(
            [sys.executable, "-m", "g2ard", *map(str, arguments)],
            cwd=cwd,
            env={**os.environ, "PYTHONPATH": path, "COLUMNS": "200"},
            capture_output=True,
            text=True,
            timeout=300,
        )
        return done.returncode, done.stdout, done.stderr

    return run
