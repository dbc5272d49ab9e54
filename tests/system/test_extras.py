"""Optional packages that are not installed."""

import shutil
import subprocess
import sys
from pathlib import Path

import pytest

import g2ard
from g2ard import errors
from g2ard.errors import InputError, MissingDependencyError
from g2ard.rendering.metrics import load_lpips
from helpers.commands import CommandLine, refused
from helpers.project import ROOT
from helpers.scenes import around, checkered_ball


def test_features_need_torch(
    command_line: CommandLine, folder: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(errors, "find_spec", lambda name: None)
    ball = checkered_ball(400)
    targets = g2ard.TeacherRenders(ball, around(4, (32, 24)))
    with pytest.raises(MissingDependencyError, match=r"'torch' needs torch; pip install torch$"):
        g2ard.recover(ball, targets, g2ard.RecoverConfig(steps=1, engine="torch"))
    with pytest.raises(
        InputError, match=r"engine: expected one of fused, torch \(the device gpu runs fused"
    ):
        g2ard.RecoverConfig(engine="gsplat")
    with pytest.raises(MissingDependencyError, match=r"^LPIPS needs torch"):
        load_lpips(folder)
    views = ("--views", "views.json", "-o", "x.ply")
    for ask in (
        ("recover", "ball.ply", "--teacher", "ball.ply", *views),
        ("distill", "ball.ply", "-r", "10", *views),
        ("adapt", "ball.ply", *views),
    ):
        error = refused(command_line, folder, *ask, "--engine", "torch", status=1)
        assert error == "g2ard: --engine torch needs torch; pip install torch\n"
        assert not (folder / "x.ply").exists()
    ask = ("evaluate", "ball.ply", "--teacher", "ball.ply", "--views", "views.json", "--lpips", ".")
    assert "LPIPS needs torch" in refused(command_line, folder, *ask, status=1)
    g2ard.recover(ball, targets, g2ard.RecoverConfig(steps=1))


def test_a_checkout_without_its_extension_says_what_to_do(tmp_path: Path) -> None:
    """After `pip install .`, Python run in the checkout finds the sources, which have no extension."""
    for folder in ("g2ard", "benchmarks"):
        shutil.copytree(
            ROOT / folder, tmp_path / folder, ignore=shutil.ignore_patterns("_core.*", "record")
        )
    for words in (
        ["-m", "g2ard", "--version"],
        ["-m", "benchmarks", "--help"],
        ["-c", "import g2ard; g2ard.simplify"],
    ):
        done = subprocess.run(
            [sys.executable, *words], cwd=tmp_path, capture_output=True, text=True
        )
        assert done.returncode == 1
        said = done.stderr.splitlines()
        assert f"{tmp_path}: this checkout has no Rust extension" in said[-1]
        assert "`pip install -e .` or `make setup`" in said[-1]
        assert len(said) == 1 or words[0] == "-c"
