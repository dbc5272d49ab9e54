"""Terminals of any character set: what it lacks is replaced."""

import os
import subprocess
import sys
from pathlib import Path

import pytest

from helpers.ply_files import columns, save, scene


@pytest.mark.parametrize("encoding", ["latin-1", "cp437", "ascii"])
@pytest.mark.parametrize("words", ["info a.ply", "--help", "distill --help", "info ż→.ply", "ż→"])
def test_any_character_set(tmp_path: Path, words: str, encoding: str) -> None:
    save(tmp_path / "a.ply", columns(scene()))
    command = [sys.executable, "-c", "from g2ard.cli.main import main; main()", *words.split()]
    env = os.environ | {"PYTHONIOENCODING": encoding}
    done = subprocess.run(command, env=env, cwd=tmp_path, capture_output=True, check=False)
    said = (done.stdout + done.stderr).decode(encoding)
    assert done.returncode == (0 if "a.ply" in words or "help" in words else 2 if words == "ż→" else 1)
    assert "internal error" not in said
    assert "?" in said if "→" in words else said
