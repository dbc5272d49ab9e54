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
    assert done.returncode == (
        0 if "a.ply" in words or "help" in words else 2 if words == "ż→" else 1
    )
    assert "internal error" not in said
    assert "?" in said if "→" in words else said


@pytest.mark.skipif(os.name == "nt" or sys.platform == "darwin", reason="names are Unicode there")
@pytest.mark.parametrize(
    "command", ["convert {} {}.sog", "simplify {} -n 9 -o {}.ply", "view {} -o {}.html"]
)
def test_names_that_are_not_utf8(tmp_path: Path, command: str) -> None:
    name = os.fsdecode(b"M\xe4ller")
    save(tmp_path / f"{name}-in.ply", columns(scene()))
    words = command.replace("{}", f"{name}-in.ply", 1).replace("{}", name).split(" ")
    ask = [sys.executable, "-c", "from g2ard.cli.main import main; main()", *words]
    done = subprocess.run(ask, cwd=tmp_path, capture_output=True, check=False)
    assert (done.returncode, b"internal error" in done.stderr) == (0, False), done.stderr
    assert len(list(tmp_path.iterdir())) == 2


@pytest.mark.parametrize("stream", ["None", "type('Log', (), {'write': len, 'flush': bool})()"])
def test_progress_without_a_console(tmp_path: Path, stream: str) -> None:
    save(tmp_path / "a.ply", columns(scene()))
    code = (
        f"import sys, g2ard; sys.stderr = {stream}\n"
        "print(len(g2ard.simplify('a.ply', count=9, progress=g2ard.show_progress).splats))"
    )
    done = subprocess.run(
        [sys.executable, "-c", code], cwd=tmp_path, capture_output=True, check=False
    )
    assert done.stdout.split() == [b"9"]
