"""Scores that say what they are: common views and sizes of several runs, and sizes beside every score."""

import json
import re
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

import g2ard
from g2ard.jobs.comparison import find_common
from helpers.commands import CommandLine, refused, succeeds
from helpers.photos import photographed
from helpers.scenes import around, checkered_ball

BALL = checkered_ball(300)


def run_folder(
    folder: Path,
    views: g2ard.Cameras,
    *,
    scene: g2ard.Splats = BALL,
    against: str = "the dense scene",
    teacher: str = "ball.ply",
    held_out: int = 4,
    background: tuple[float, float, float] = (0, 0, 0),
) -> Path:
    """Write what scores need of a run of `distill`; every `held_out`-th view is a test view."""
    folder.mkdir()
    g2ard.save(folder / "scene.ply", scene)
    splits = ["test" if i % held_out == 0 else "train" for i in range(len(views))]
    g2ard.save_views(folder / "views.json", views, splits=splits)
    config = {"scene": teacher, "size": int(views.widths[0])}
    settings = {"recover.background": background}
    report = {"against": against, "config": config, "settings": settings}
    (folder / "report.json").write_text(json.dumps(report))
    return folder


@pytest.fixture
def runs(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, request: pytest.FixtureRequest) -> Path:
    """Write ball.ply and two runs of it, at 64 and 32 pixels: rendered or, if requested, of photos."""
    monkeypatch.chdir(tmp_path)
    g2ard.save("ball.ply", BALL)
    photos = getattr(request, "param", "renders") == "photos"
    large = around(8, (64, 48))
    against = "the dense scene"
    if photos:
        large, against = photographed(tmp_path, BALL, large), "photos"
    run_folder(tmp_path / "worse", large.resized(32), scene=BALL.take(range(60)), against=against)
    run_folder(tmp_path / "better", large, scene=BALL.take(range(200)), against=against)
    return tmp_path


@pytest.mark.parametrize("runs", ["renders", "photos"], indirect=True)
def test_the_order_of_runs_has_no_effect(runs: Path, command_line: CommandLine) -> None:
    found, told = [], []
    for order in (("worse", "better"), ("better", "worse")):
        printed = succeeds(command_line, runs, "evaluate", *order, "--json", "-")
        result = json.loads(printed.out)
        found.append(sorted(result["scenes"], key=lambda row: row["scene"]))
        told.append(result["better"])
        assert "64×48 px" in printed.err
    for row in (row for rows in found for row in rows):
        assert row.pop("file_bytes") > 0
        assert [view["size"] for view in row["views"]] == [[64, 48]] * 2
    assert found[0] == found[1]
    assert told[0] == told[1]
    assert re.match(r"better is better: \+\d", told[0])
    assert "2 test " in told[0]


def test_no_common_view_has_trained_a_run(runs: Path) -> None:
    pool = around(8, (64, 48))
    run_folder(runs / "other", pool, held_out=2)
    common = find_common([Path("better"), Path("other")])
    assert common is not None
    assert common.views.cameras.names == ("view_000", "view_004")  # type: ignore[union-attr]
    elsewhere = replace(around(6, (40, 30), distance=4.0), names=pool.names[:6])
    run_folder(runs / "elsewhere", elsewhere)
    both = [
        find_common(paths)
        for paths in ([Path("better"), Path("elsewhere")], [Path("elsewhere"), Path("better")])
    ]
    names = [one.views.cameras.names for one in both if one]  # type: ignore[union-attr]
    assert names[0] == names[1]
    assert len(set(names[0])) == 4  # two of each pool, though they have equal names
    assert {one.views.cameras.size_text for one in both if one} == {"64×48 px"}  # type: ignore[union-attr]


@pytest.mark.parametrize(
    ("case", "words"),
    [
        ("teacher", ("ball.ply", "cube.ply")),
        ("photos", ("photos", "ball.ply")),
        ("background", ("background",)),
        ("trained", ("--views",)),
    ],
)
def test_two_worlds_are_refused(
    runs: Path, command_line: CommandLine, case: str, words: tuple[str, ...]
) -> None:
    pool, given = around(8, (64, 48)), dict[str, Any]()
    if case == "teacher":
        g2ard.save("cube.ply", BALL)
        given = {"teacher": "cube.ply"}
    elif case == "photos":
        given = {"against": "photos"}
        pool = photographed(runs, BALL, pool)
    elif case == "background":
        given = {"background": (1, 1, 1)}
    run_folder(runs / "other", pool, held_out=8, **given)
    if case == "trained":
        for name, splits in (("better", ["train", "test"]), ("other", ["test", "train"])):
            g2ard.save_views(runs / name / "views.json", pool, splits=splits * 4, overwrite=True)
    for order in (("better", "other"), ("other", "better")):
        error = refused(command_line, runs, "evaluate", *order, status=1)
        assert all(word in error for word in (*words, "better", "other")), error


@pytest.mark.parametrize("case", ["other photos", "moved"])
def test_photos_of_two_worlds_are_refused(
    tmp_path: Path, command_line: CommandLine, case: str
) -> None:
    first, second = tmp_path / "a", tmp_path / "b"
    first.mkdir()
    second.mkdir()
    views = photographed(first, BALL, around(8))
    other = photographed(second, BALL, around(8))
    if case == "moved":
        other = replace(views, viewmats=np.roll(views.viewmats, 1, axis=0))
    run_folder(tmp_path / "one", views, against="photos")
    run_folder(tmp_path / "two", other, against="photos")
    error = refused(command_line, tmp_path, "evaluate", "one", "two", status=1)
    assert "photo" in error
    assert "two" in error


def test_compare_says_which_run_is_closer_to_their_scene(
    runs: Path, command_line: CommandLine
) -> None:
    ask = ("compare", "-k", 2, "--size", 32)
    for order in (("worse", "better"), ("better", "worse")):
        assert (
            "against ball.ply, better is better: +"
            in succeeds(command_line, runs, *ask, *order).err
        )
    g2ard.save("plain.ply", BALL.take(range(100)))
    for order in (("plain.ply", "better"), ("better", "plain.ply")):
        assert "g2ard evaluate" in succeeds(command_line, runs, *ask, *order).err
    told = succeeds(command_line, runs, *ask, "ball.ply", "better", "--json", "-")
    assert json.loads(told.out)["closer"] is None


def test_every_score_has_its_size(runs: Path, command_line: CommandLine) -> None:
    g2ard.save_views("photos.json", photographed(runs / "better", BALL, around(8, (64, 48))))
    ask = (
        "distill",
        "ball.ply",
        "-n",
        40,
        "--views",
        "photos.json",
        "--photos",
        "--steps",
        2,
        "--no-page",
    )
    printed = succeeds(command_line, runs, *ask, "--size", 32, "-o", "run", "--format", "sog").err
    scored = [
        line for line in printed.splitlines() if "dB" in line or "held-out views against" in line
    ]
    assert any("1 photo, 64×48 px" in line for line in scored)  # the views' own size
    assert sum("32×24 px" in line for line in scored) == 2  # the table, and the file
    report = json.loads((runs / "run" / "report.json").read_text())
    assert report["size"] == "32×24 px"
    assert report["own_size"]["recovered"]["scored_in"] == "1 photo, 64×48 px"
    assert report["opacity_lost"] > 0.02
    assert f"gaps: surfaces let {100 * report['opacity_lost']:.1f} %" in printed
    assert "32×24 px" in (runs / "run" / "report.html").read_text()
    assert "32×24 px" in succeeds(command_line, runs, "info", "run").out
    ask = ("evaluate", "run/scene.sog", "--views", "photos.json", "--size", 32, "--json", "-")
    (row,) = json.loads(succeeds(command_line, runs, *ask).out)["scenes"]
    assert row["own_size"]["scored_in"] == report["own_size"]["recovered"]["scored_in"]
    ask = ("--views", "photos.json", "--size", 32, "--steps", 2)
    for command in ("recover", "adapt"):
        told = succeeds(command_line, runs, command, "ball.ply", *ask, "-o", f"{command}.ply").err
        (line,) = [line for line in told.splitlines() if line.startswith(f"{command}.ply")]
        assert "32×24 px" in line


def test_a_size_that_harms_is_a_warning_with_the_way_out() -> None:
    """A loss above 3 dB at the views' own size is reported; a smaller one is not."""
    from g2ard.report.run import list_remarks

    means = [
        SimpleNamespace(psnr=psnr, ssim=0.9, scored_in="8 photos, 800×600 px")
        for psnr in (20.0, 34.8, 27.3, 32)
    ]
    before, at_size, harmed, usual = means
    fields = dict.fromkeys(("unseen", "warnings", "packed", "opacity_lost", "photos"))
    for own, warned in ((harmed, True), (usual, False)):
        own_size = {"simplified": before, "recovered": own}
        scores = {"recovered": at_size}
        report: Any = SimpleNamespace(
            rounds=[], kinds=[], own_size=own_size, scores=scores, **fields
        )
        warnings = [line for line in list_remarks(report) if line.startswith("warning: ")]
        assert bool(warnings) == warned
        assert all("7.5 dB" in line and "leave --size out" in line for line in warnings)


def test_no_second_score_without_a_size(runs: Path, command_line: CommandLine) -> None:
    g2ard.save_views("photos.json", photographed(runs / "better", BALL, around(8, (64, 48))))
    ask = (
        "distill",
        "ball.ply",
        "-n",
        40,
        "--views",
        "photos.json",
        "--photos",
        "--steps",
        2,
        "--no-page",
    )
    assert "own size" not in succeeds(command_line, runs, *ask, "--size", 64, "-o", "run").err


@pytest.mark.parametrize("runs", ["renders", "photos"], indirect=True)
@pytest.mark.parametrize("scenes", [("better",), ("better", "worse")])
def test_evaluate_scores_once_more_at_the_views_own_size(
    runs: Path, command_line: CommandLine, scenes: tuple[str, ...]
) -> None:
    def rows(*size: object) -> tuple[list[dict[str, Any]], str]:
        printed = succeeds(command_line, runs, "evaluate", *scenes, *size, "--json", "-")
        return json.loads(printed.out)["scenes"], printed.err

    small, told = rows("--size", 32)
    large, plain = rows("--size", 64)
    assert "own size" not in plain
    (line,) = [line for line in told.splitlines() if "own size" in line]
    assert "64×48 px" in line
    for row, same in zip(small, large, strict=True):
        assert "32×24 px" in row["scored_in"]
        assert same["own_size"] is None
        assert row["own_size"] == {name: same[name] for name in row["own_size"]}
        assert f"{same['psnr']:.2f} dB, SSIM {same['ssim']:.4f}" in line
        assert len(scenes) == 1 or Path(row["scene"]).name in line


def test_only_some_large_views_are_scored_at_their_own_size(
    runs: Path, command_line: CommandLine, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("g2ard.jobs.run_views.FULL_PIXELS", 3 * 64 * 48)
    g2ard.save_views("views.json", around(8, (64, 48)))
    ask = (
        "evaluate",
        "better/scene.ply",
        "--teacher",
        "ball.ply",
        "--views",
        "views.json",
        "--split",
        "all",
    )
    (row,) = json.loads(succeeds(command_line, runs, *ask, "--size", 32, "--json", "-").out)[
        "scenes"
    ]
    assert row["own_size"]["scored_in"].startswith("3 views")
    assert row["scored_in"].startswith("8 views")
