"""What tests of several stages share: the program as a user types it."""

from __future__ import annotations

import os
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[1]


@pytest.fixture(scope="session")
def command_line() -> Callable[..., tuple[int, str, str]]:
    """Runs `g2ard …` as a program in a folder: (exit status, stdout, stderr)."""

    def run(*arguments: object, cwd: Path) -> tuple[int, str, str]:
        path = os.pathsep.join(filter(None, [str(ROOT), os.environ.get("PYTHONPATH")]))
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
