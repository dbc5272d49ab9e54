"""The study of simplifiers, and views of other kinds than any method's."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from benchmarks.rows import Row, read_rows
from benchmarks.study import DEFINITIONS, SceneSpec, read_study
from benchmarks.views import anywhere_views, given_views, hidden_targets, standing_views
from g2ard import io
from g2ard.poses import make_pool
from helpers.scenes import around, checkered_ball
from helpers.studies import ball_of, measured
from helpers.systems import needs_processes
from reference import poses as naive

METHODS = ("default", "fast", "paper", "nanogs", "lightgaussian")


def ask(scene: SceneSpec, out: Path, methods: str, protocol: str = "pool") -> list[Row]:
    return measured(
        "simplify", scene, out, ratios="4", methods=methods, protocol=protocol, size="64"
    )


@needs_processes
def test_measures_writes_and_resumes(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, programs: None
) -> None:
    scene = ball_of(tmp_path, 2000)
    rows = ask(scene, tmp_path / "out", ",".join(METHODS))
    assert [row["method"] for row in rows] == list(METHODS)
    for row in rows:
        assert "error" not in row
        assert (row["input_count"], row["budget"], row["count"], row["views"]) == (
            2000,
            500,
            500,
            2,
        )
        assert 8 < row["psnr"] < 60
        assert 0 < row["cpu_s"] < 60
        assert 20 < row["peak_mb"] < 2000
    monkeypatch.setenv("PATH", str(tmp_path))
    again = ask(scene, tmp_path / "out", "default,splat-transform")
    assert again[0] == rows[0]  # nothing was measured twice
    assert "not on PATH" in again[1]["error"]
    assert "splat-transform" not in read_study(DEFINITIONS / "simplify.toml").methods
    program = tmp_path / "splat-transform"
    program.write_text("#!/bin/sh\necho it broke 1.2 >&2\nexit 7\n")
    program.chmod(0o755)
    (failed,) = ask(scene, tmp_path / "out", "splat-transform")
    assert failed["error"] == "exit status 7: it broke 1.2"
    assert len(read_rows(tmp_path / "out" / "rows.csv")) == 6  # in the old failure's place
    made = read_study(DEFINITIONS / "simplify.toml").methods
    assert "splat-transform" in made
    assert "spark" not in made


@needs_processes
def test_every_kind_of_view_is_scored(tmp_path: Path) -> None:
    scene, path = ball_of(tmp_path, 1200, views=False), tmp_path / "ball.ply"
    rows = ask(scene, tmp_path / "out", "default,fast", protocol="all")
    kinds = ["pool", "near", "standing", "anywhere"]
    assert [(r["method"], r["views_kind"]) for r in rows] == [
        (method, kind) for method in ("default", "fast") for kind in kinds
    ]
    standing = standing_views(io.read_splats(path), path).values()
    assert [r["views"] for r in rows[:3]] == [16, *(len(v) for v in standing)]
    assert rows[0]["psnr"] != rows[2]["psnr"]
    assert len({r["cpu_s"] for r in rows[:4]}) == 2  # with the pool's views, and with its own
    assert len({r["cpu_s"] for r in rows[4:]}) == 1  # run alike for all, so run once
    text = (tmp_path / "out" / "rows.csv").read_text()
    ask(scene, tmp_path / "out", "default", protocol="standing")
    assert (tmp_path / "out" / "rows.csv").read_text() == text


@needs_processes
def test_a_scene_is_scored_at_every_size(tmp_path: Path) -> None:
    scene = ball_of(tmp_path, 1200, views=False)
    options = {"ratios": "4", "methods": "fast", "protocol": "pool", "size": "64"}
    rows = measured("sizes", scene, tmp_path / "out", **options)
    assert [row["scale"] for row in rows] == [0.5, 1, 2, 3]
    assert len({row["psnr"] for row in rows}) == 4
    assert len({row["cpu_s"] for row in rows}) == 1
    (alone,) = measured("simplify", scene, tmp_path / "alone", **options)
    assert alone["psnr"] == rows[1]["psnr"]


def test_a_standing_file_beside_the_scene_takes_precedence(tmp_path: Path) -> None:
    splats, folder = checkered_ball(1500), tmp_path / "ball"
    folder.mkdir()
    io.write_splats(folder / "ball.ply", splats)
    assert given_views(folder / "ball.ply") is None
    cameras = around(5)
    away = replace(cameras, viewmats=cameras.viewmats @ np.diag([-1.0, -1, 1, 1]))
    io.write_views(tmp_path / "standing.json", cameras, splits=["test"] * 4 + ["train"])
    for place in (folder / "ball.ply", folder):
        given = given_views(place)
        assert given.names == cameras.names[:4]
    found = standing_views(splats, folder / "ball.ply")
    np.testing.assert_array_equal(found["standing"].viewmats, cameras.viewmats[:4])
    turned = away.viewmats.copy()
    turned[0] = np.diag([-1.0, 1, -1, 1]) @ cameras.viewmats[0]  # looks the other way
    io.write_views(folder / "standing.json", replace(cameras, viewmats=turned))
    options = {"seed": 0, "size": 32, "background": (0.0, 0.0, 0.0)}
    targets = hidden_targets(splats, folder / "ball.ply", ("standing",), **options)
    assert len(targets["standing"].cameras) == 4  # what shows nothing is left out
    assert targets["near"].cameras.widths.max() == 32


@pytest.mark.parametrize("make", [naive.statue, naive.room, naive.town])
def test_made_standing_views_are_of_another_kind(make) -> None:
    splats, nowhere = make(), Path("nowhere.ply")
    found, pool = standing_views(splats, nowhere), make_pool(splats, 48)
    assert set(found) == {"near", "standing"}
    for kind, cameras in found.items():
        assert all(name.startswith(kind) for name in cameras.names)
        assert 8 <= len(cameras) <= 24
        gaps = np.linalg.norm(cameras.positions[:, None] - pool.positions, axis=2)
        assert gaps.min() > 1e-3
        nearest = np.linalg.norm(splats.means[:, None] - cameras.positions, axis=2).min(axis=0)
        assert nearest.min() > 0.05
    standing = found["standing"]
    assert standing.Ks[0, 0, 0] == pytest.approx(standing.widths[0] / 2 / np.tan(np.radians(35)))
    if make is naive.statue:
        middle = np.array([0, 0, 0.5])
        away = [
            np.linalg.norm(c.positions - middle, axis=1).mean() for c in (*found.values(), pool)
        ]
        assert away[0] < away[2]
        assert away[1] < 0.8 * away[2]
    if make is naive.room:
        assert ((standing.positions > 0) & (standing.positions < (6, 4, 2.7))).all()
    if make is naive.town:
        assert standing.positions[:, 2].max() < 9
    again = standing_views(splats, nowhere)
    np.testing.assert_array_equal(again["standing"].viewmats, standing.viewmats)


def test_views_from_anywhere_are_near_free_and_repeatable() -> None:
    splats = naive.statue()
    views = anywhere_views(splats, 6)
    assert len(views) == 6
    # within its hollow body
    assert not (np.linalg.norm(views.positions - (0, 0, 1.3), axis=1) < 1.0).any()
    gaps = np.linalg.norm(splats.means[:, None] - views.positions, axis=2).min(axis=0)
    diagonal = np.linalg.norm(np.ptp(splats.means, axis=0))
    assert (gaps < 0.4 * diagonal).all()
    np.testing.assert_array_equal(anywhere_views(splats, 6).viewmats, views.viewmats)
    assert np.abs(anywhere_views(splats, 6, seed=1).viewmats - views.viewmats).max() > 0.1


@needs_processes
def test_fixed_growths_are_compared_in_views_of_other_kinds(tmp_path: Path) -> None:
    scene = ball_of(tmp_path, 1200, views=False)
    rows = measured(
        "growth", scene, tmp_path / "out", ratios="10", methods="growth-1.25,growth-4", size="64"
    )
    first, last = (rows[i : i + 3] for i in (0, 3))
    assert [row["views_kind"] for row in first] == ["near", "standing", "anywhere"]
    assert all(
        a["count"] == b["count"] and a["psnr"] != b["psnr"]
        for a, b in zip(first, last, strict=True)
    )
