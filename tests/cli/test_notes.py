"""Notes and warnings that commands print."""

import re
from dataclasses import replace
from pathlib import Path

import pytest

import g2ard
from g2ard.io import write_views
from helpers.commands import CommandLine, refused, succeeds
from helpers.photos import BALL, cloud_of, photos_of
from helpers.scenes import around, checkered_ball


def test_a_result_larger_than_its_input_is_noted(command_line: CommandLine, tmp_path: Path) -> None:
    photos_of(tmp_path / "photos")
    cloud_of(tmp_path / "scan.ply", BALL)
    ask = ("distill", "scan.ply", "--views", "photos", "-n", 1000, "--steps", 3)
    error = command_line(*ask, "-o", "run", cwd=tmp_path)[2]
    assert "run/scene.ply: 0.24 MB, scan.ply has 0.03 MB; 76% of it is SH above degree 0, " in error
    assert error.count("smaller: g2ard convert run/scene.ply run/scene.sog") == 1
    g2ard.save(tmp_path / "ball.ply", BALL)
    assert "MB" not in command_line("simplify", "ball.ply", "-r", 2, "-o", "s.ply", cwd=tmp_path)[2]


def test_a_lift_larger_than_its_cloud_is_noted(command_line: CommandLine, folder: Path) -> None:
    cloud_of(folder / "cloud.ply", BALL)
    assert (
        "lift.ply: 0.07 MB, cloud.ply has 0.03 MB; smaller: g2ard convert lift.ply lift.sog"
        in succeeds(command_line, folder, "lift", "cloud.ply", "-o", "lift.ply").err
    )


SHORT = ("distill", "ball.ply", "--steps", 5, "--size", 48)


def test_a_short_run_has_no_needless_notes(command_line: CommandLine, folder: Path) -> None:
    error = succeeds(command_line, folder, *SHORT, "-r", 10, "-o", "run").err
    assert "views: 17 train, 18 score, 12 validate; orbit; the up direction is a guess\n" in error
    for needless in ("never acted", "of its box", "times as high", "regularisers"):
        assert needless not in error
    assert "regularisers: " in command_line(*SHORT, "-r", 10, "-o", "run", "-wv", cwd=folder)[2]


def test_a_run_that_time_ends_says_so(command_line: CommandLine, tmp_path: Path) -> None:
    """No machine takes a million steps in 0.2 s."""
    photos_of(tmp_path / "photos", points=True)
    ask = ("--views", "photos", "--set", "schedule.steps=1000000", "--recovery-time", "0.2s")
    told = succeeds(
        command_line, tmp_path, "distill", *ask, "-n", 300, "--keep", "--no-page", "-o", "run"
    ).err
    told += succeeds(
        command_line, tmp_path, "recover", "run/simplified/scene.ply", *ask, "-o", "better.ply"
    ).err
    assert len(re.findall(r"(?m)^time ended recovery at step \d+ of 1,000,000\b", told)) == 2


def test_one_is_one(command_line: CommandLine, folder: Path) -> None:
    ask = (
        "distill",
        "ball.ply",
        "-n",
        1,
        "-o",
        "run",
        "--steps",
        2,
        "--size",
        32,
        "--format",
        "splat",
    )
    error = succeeds(command_line, folder, *ask).err
    assert "400 → 1 Gaussian;" in error
    assert "MB as .ply" in error
    for ask in (("simplify", "ball.ply", "-n", 1, "-o", "s.ply"), ("convert", "s.ply", "t.splat")):
        error += command_line(*ask, cwd=folder)[2]
    error += "".join(command_line("info", "run", cwd=folder)[1:])
    ask = ("evaluate", "s.ply", "--teacher", "s.ply", "--views", "views.json", "--size", 16)
    error += command_line(*ask, cwd=folder)[2]
    assert (
        re.findall(r"(?<![\d.,])1 [A-Za-z]*(?:Gaussian|view|step|point|photo|disc)s\b", error) == []
    )


@pytest.mark.parametrize(
    ("ask", "fails"),
    [
        ("simplify ball.ply -r 4 -o s.ply", False),
        ("recover ball.ply --teacher ball.ply --steps 2 -o r.ply", False),
        ("adapt ball.ply --teacher ball.ply --steps 2 -o a.ply", False),
        ("select ball.ply -k 3 -o v.json", False),
        ("render ball.ply -o looks", False),
        ("distill ball.ply -n 9 -o run --dry-run --size 32", True),
        ("evaluate ball.ply --teacher ball.ply --size 32 --split all", True),
    ],
)
def test_views_of_another_world_are_noted(
    ask: str, fails: bool, command_line: CommandLine, folder: Path
) -> None:
    """Some views that see nothing are a warning; if none sees anything, distill and evaluate fail."""
    views = around(16, (48, 36))
    for name, blind in (("some.json", slice(1, 9)), ("none.json", slice(None))):
        viewmats = views.viewmats.copy()
        viewmats[blind, :3, 3] += 1e3
        write_views(folder / name, replace(views, viewmats=viewmats))
    for name, warned in (("some.json", True), ("views.json", False)):
        error = succeeds(command_line, folder, *ask.split(), "--views", name, "-w").err
        assert ("views see nothing of the scene; check" in error) == warned, error
        assert warned or "warning" not in error
    if fails:
        status, _, error = command_line(*ask.split(), "--views", "none.json", cwd=folder)
        assert (status, "the scene must use the same coordinates" in error) == (1, True), error


@pytest.mark.parametrize(
    ("command", "more"),
    [
        ("distill", "-n 50 --steps 2 --dry-run -o run"),
        ("recover", "--steps 2 -o out.ply"),
        ("adapt", "--steps 2 -o out.ply"),
        ("evaluate", ""),
    ],
)
def test_photos_of_another_world_are_refused(
    command: str, more: str, command_line: CommandLine, folder: Path
) -> None:
    """The views may still see much of the scene, because both lie around the origin."""
    photos_of(folder / "photos")
    ask = ("--views", "photos", *more.split())
    own = checkered_ball(1200)
    g2ard.save(folder / "own.ply", own)
    g2ard.save(folder / "other.ply", replace(own, means=6 * own.means, scales=6 * own.scales))
    before = sorted(folder.iterdir())
    error = refused(command_line, folder, command, "other.ply", *ask, status=1)
    assert "the photos do not show the scene (correlation" in error
    assert "they probably show another scene" in error
    assert sorted(folder.iterdir()) == before
    for scene, warned in (("other.ply", True), ("own.ply", False)):
        error = succeeds(command_line, folder, command, scene, *ask, "--photos", "-w").err
        assert (
            "warning: the scene does not look like the photos (correlation" in error
        ) == warned, error
