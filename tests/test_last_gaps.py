"""What does not fit together is refused, or told, before any work."""

from __future__ import annotations

import json
import tomllib
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import TYPE_CHECKING, Any, cast

import numpy as np
import pytest
from PIL import Image
from scenes import around, checkered_ball
from test_first_hour import photos_of

import g2ard
from g2ard.cli.run_result import told, write_table
from g2ard.errors import InputError
from g2ard.io import write_views

if TYPE_CHECKING:
    from g2ard.cli.frame import Run

CommandLine = Callable[..., tuple[int, str, str]]
BALL = checkered_ball(400)


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
        (
            ("simplify", "ball.ply", "-ratio", 5, "-o", "o.ply"),
            2,
            "-ratio: long options have two dashes: ",
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


def test_views_of_another_world_are_told(command_line: CommandLine, folder: Path) -> None:
    cameras = around(16, (48, 36))
    far = np.where(np.arange(16)[:, None] < 10, [[1e3, 0, 0]], 0)
    for count, name in ((10, "some.json"), (16, "none.json")):
        viewmats = cameras.viewmats.copy()
        viewmats[:count, :3, 3] += 1e3 if count == 16 else far[:count]
        write_views(folder / name, replace(cameras, viewmats=viewmats))
    for ask in (("distill", "-n", 9, "-o", "run", "--dry-run"), ("evaluate", "--teacher", "ball.ply")):
        split = ("--split", "all") if ask[0] == "evaluate" else ()
        for name, status, words in (
            ("some.json", 0, "views have nothing of the scene in sight"),
            ("none.json", int(not split), "16 of 16 views" if split else "the scene must be of one world"),
            ("views.json", 0, ""),
        ):
            call = (ask[0], "ball.ply", *ask[1:], "--views", name, "--size", 32, *split)
            found, _, error = command_line(*call, cwd=folder)
            assert (found, words in error) == (status, True), error
            assert ("of one world" in error or "warning" in error) == bool(words)


@pytest.mark.parametrize(
    "ask",
    [
        ("simplify", "ball.ply", "-r", 4, "-o", "s.ply"),
        ("recover", "ball.ply", "--teacher", "ball.ply", "--steps", 2, "-o", "r.ply"),
        ("adapt", "ball.ply", "--teacher", "ball.ply", "--steps", 2, "-o", "a.ply"),
        ("select", "ball.ply", "-k", 3, "-o", "v.json"),
        ("render", "ball.ply", "-o", "looks"),
    ],
)
def test_every_command_tells_of_views_of_another_world(
    ask: tuple[object, ...], command_line: CommandLine, folder: Path
) -> None:
    viewmats = around(16, (48, 36)).viewmats.copy()
    viewmats[1:9, :3, 3] += 1e3
    write_views(folder / "some.json", replace(around(16, (48, 36)), viewmats=viewmats))
    for views, warned in (("some.json", True), ("views.json", False)):
        status, _, error = command_line(*ask, "--views", views, "-w", cwd=folder)
        assert status == 0, error
        assert ("views have nothing of the scene in sight: are both of one world?" in error) == warned, error


def test_photos_of_another_world_are_told(command_line: CommandLine, folder: Path) -> None:
    """Whose views may see much of the scene: both stand about the origin."""
    photos_of(folder / "photos")
    ask = ("-n", 50, "--views", "photos", "--steps", 2, "--dry-run")
    own = checkered_ball(1200)
    g2ard.save(folder / "own.ply", own)
    g2ard.save(folder / "other.ply", replace(own, means=6 * own.means, scales=6 * own.scales))
    for scene, warned in (("other.ply", True), ("own.ply", False)):
        status, _, error = command_line("distill", scene, *ask, "-o", "run", cwd=folder)
        assert status == 0, error
        assert ("warning: the scene looks like none of the photos (correlation" in error) == warned, error


def test_a_letter_in_a_config_is_told_its_long_name(command_line: CommandLine, folder: Path) -> None:
    for text in ("n = 9", "[distill]\nn = 9", "[distill]\nn = 9\n[poses]\ncount = 4"):
        (folder / "c.toml").write_text(text)
        status, _, error = command_line("distill", "ball.ply", "--config", "c.toml", "-o", "r", cwd=folder)
        assert (status, "no option of `distill` is called n (write count)" in error) == (2, True), error


@pytest.mark.parametrize("inputs", [("distill", "ball.ply"), ("info", "ball.ply", "views.json")])
def test_a_printed_config_has_the_inputs(
    inputs: tuple[str, ...], command_line: CommandLine, folder: Path
) -> None:
    command, *paths = inputs
    options = ("-r", 5, "-o", "run") if command == "distill" else ()
    status, out, error = command_line(command, *paths, *options, "--print-config", cwd=folder)
    assert status == 0, error
    table = tomllib.loads(out)[command]
    assert table.get("scene", table.get("paths")) == (paths[0] if command == "distill" else paths)
    (folder / "c.toml").write_text(out)
    again = command_line(command, "--config", "c.toml", "--print-config", cwd=folder)
    assert again == (0, out, "")


def test_photos_below_their_poses_are_told_of_them(folder: Path) -> None:
    (folder / "scan" / "shots").mkdir(parents=True)
    Image.new("RGB", (8, 8)).save(folder / "scan" / "shots" / "a.png")
    shots = folder / "scan" / "shots"
    with pytest.raises(InputError, match="COLMAP finds them"):
        g2ard.load_views(shots)
    (folder / "scan" / "transforms.json").write_text("{}")
    with pytest.raises(InputError, match=r"their poses lie in .*scan/transforms\.json: give that$"):
        g2ard.load_views(shots)
    (folder / "scan" / "transforms.json").unlink()
    (folder / "scan" / "sparse" / "0").mkdir(parents=True)
    for name in ("cameras.bin", "images.bin"):
        (folder / "scan" / "sparse" / "0" / name).touch()
    with pytest.raises(InputError, match=r"their poses lie in .*scan: give that$"):
        g2ard.load_views(shots)


def test_info_goes_on_after_what_it_cannot_read(command_line: CommandLine, folder: Path) -> None:
    (folder / "text.ply").write_text("hello")
    ask = ("info", "ball.ply", "gone.ply", "text.ply", "views.json")
    status, out, error = command_line(*ask, cwd=folder)
    assert (status, error.count("\n")) == (1, 2), error
    assert "gone.ply: no such file" in error
    assert "give the file the suffix of what it is" in error
    assert "ball.ply" in out
    assert "views.json" in out
    status, out, _ = command_line(*ask, "--json", "-", cwd=folder)
    result = json.loads(out)
    assert (status, result["failed"]) == (1, ["gone.ply", "text.ply"])
    assert [figures["kind"] for figures in result["files"]] == ["splats", "views"]


def test_the_table_has_a_start_where_there_are_photos_alone() -> None:
    rows: list[list[str]] = []
    report: dict[str, Any] = {
        "scores": {"recovered": {"views": [], "psnr": 30.0, "ssim": 0.9}},
        "apart": None,
        "bytes": {"input": 9, "output": 9},
        "seconds": {},
        "input_count": 9,
        "output_count": 9,
        "against": "photos",
    }
    console = SimpleNamespace(table=lambda title, head, found: rows.extend(found))
    for scene in (None, Path("a.ply")):
        write_table(cast("Run", SimpleNamespace(config={"scene": scene}, console=console)), report)
    others = ["simplified", "recovered"]
    assert [row[0] for row in rows] == ["start", *others, "dense", *others]


@pytest.mark.parametrize(("unseen", "lines"), [(0.004, 0), (0.005, 0), (0.02, 1)])
def test_what_no_view_sees_is_told_if_it_is_not_nothing(unseen: float, lines: int) -> None:
    found = told({"rounds": [], "scores": None, "apart": None, "unseen": unseen})
    assert (len(found), any("0%" in line for line in found)) == (lines, False)
