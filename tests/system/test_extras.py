"""Optional packages that are not installed."""

from pathlib import Path

import pytest

import g2ard
from g2ard import errors
from g2ard.errors import MissingDependencyError
from g2ard.rendering.lpips import load_lpips
from helpers.commands import CommandLine, refused
from helpers.scenes import around, checkered_ball


def test_features_need_torch(
    command_line: CommandLine, folder: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(errors, "find_spec", lambda name: None)
    ball = checkered_ball(400)
    targets = g2ard.TeacherRenders(ball, around(4, (32, 24)))
    for engine in ("torch", "gsplat"):
        with pytest.raises(MissingDependencyError, match=rf"'{engine}' needs torch; .*'g2ard\[torch\]'"):
            g2ard.recover(ball, targets, g2ard.RecoverConfig(steps=1, engine=engine))
    with pytest.raises(MissingDependencyError, match=r"^LPIPS needs torch"):
        load_lpips(folder)
    ask = ("evaluate", "ball.ply", "--teacher", "ball.ply", "--views", "views.json", "--lpips", ".")
    assert "LPIPS needs torch" in refused(command_line, folder, *ask, status=1)
    g2ard.recover(ball, targets, g2ard.RecoverConfig(steps=1))
