"""What does not fit together is refused, or told, before any work."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import pytest
from scenes import around, checkered_ball

import g2ard
from g2ard.errors import InputError
from g2ard.io import write_views

CommandLine = Callable[..., tuple[int, str, str]]
BALL = checkered_ball(400)


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    g2ard.save(tmp_path / "ball.ply", BALL)
    write_views(tmp_path / "views.json", around(16, (48, 36)))
    return tmp_path


@pytest.mark.parametrize(
    ("arguments", "status", "words"),
    [
        (
            ("distill", "--views", "views.json", "--renders", "-n", 9, "-o", "run"),
            2,
            "--renders: there is no scene to render; leave it out, or give a SCENE",
        ),
        (
            ("distill", "ball.ply", "--photos", "-n", 9, "-o", "run"),
            1,
            "--photos: a pool of made views has no photos; give views that have them",
        ),
        (("distill", "--views", "views.json", "--fit", "1kB", "-o", "run"), 1, "--fit could be measured on"),
        (
            ("distill", "--views", "views.json", "--min-psnr", 30, "-o", "run"),
            1,
            "--min-psnr could be measured on: give -n COUNT",
        ),
        (
            ("render", "ball.ply", "-n", 4, "--views", "views.json", "--sheet", "a.png"),
            2,
            "-n makes views, and --views gives them: leave -n out",
        ),
        (
            ("recover", "ball.ply", "--views", "made", "-o", "o.ply"),
            2,
            "--teacher is missing: views that are made have no photos",
        ),
    ],
)
def test_what_is_missing_is_named_before_any_work(
    arguments: tuple[object, ...], status: int, words: str, command_line: CommandLine, folder: Path
) -> None:
    found, _, error = command_line(*arguments, cwd=folder)
    assert (found, error.count("\n")) == (status, 1), error
    assert words in error
    assert sorted(path.name for path in folder.iterdir()) == ["ball.ply", "views.json"]


@pytest.mark.parametrize(("name", "value"), [("ratio", [5, 10]), ("count", (9, 8)), ("min_psnr", "high")])
def test_a_budget_is_one_number(name: str, value: object) -> None:
    words = f"{name}: expected a number, got 'high'" if value == "high" else f"{name}: one a call, got "
    with pytest.raises(InputError, match=f"^{words}"):
        g2ard.distill(BALL, **{name: value})  # type: ignore[arg-type]
