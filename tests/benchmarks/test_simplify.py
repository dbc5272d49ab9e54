"""The simplifiers' benchmark: rows, resuming, failures."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from benchmarks import rows as table
from benchmarks.recover import Look
from benchmarks.simplify import Cell, bench_simplify, find_splat_transform
from benchmarks.standing import given_views, standing_targets, standing_views
from g2ard import io
from g2ard.errors import InputError
from g2ard.poses import make_pool
from helpers.commands import CommandLine
from helpers.project import ROOT
from helpers.scenes import around, checkered_ball
from helpers.systems import needs_processes
from reference import poses as naive

METHODS = ("default", "fast", "paper", "nanogs", "lightgaussian")


@needs_processes
def test_measures_writes_and_resumes(tmp_path: Path) -> None:
    scene, views, csv = tmp_path / "ball.ply", tmp_path / "views.json", tmp_path / "figures.csv"
    io.write_splats(scene, checkered_ball(2000))
    io.write_views(views, around(16))
    cells = bench_simplify([scene], csv, ratios=[4], methods=METHODS, views=views)
    assert table.read(csv, Cell) == [_rounded(c) for c in cells]
    assert [c.key for c in cells] == [("ball", 4.0, m, "pool") for m in METHODS]
    for c in cells:
        assert (c.error, c.input_count, c.budget, c.count, c.views) == ("", 2000, 500, 500, 2)
        assert 8 < c.psnr < 60
        assert 0 < c.cpu_s < 60
        assert 20 < c.peak_mb < 2000

    lines = csv.read_text().splitlines()
    again = bench_simplify([scene], csv, ratios=[4], methods=[*METHODS, "splat-transform"], views=views)
    assert csv.read_text().splitlines()[: len(lines)] == lines  # nothing was measured twice
    assert again[:5] == [_rounded(c) for c in cells]
    assert again[5].error == "splat-transform: not found"
    assert again[5].psnr is None

    program = tmp_path / "broken"
    program.write_text("#!/bin/sh\necho it broke 1.2 >&2\nexit 7\n")
    program.chmod(0o755)
    (failed,) = bench_simplify(
        [scene], csv, ratios=[4], methods=["splat-transform"], views=views, splat_transform=program
    )
    assert failed.error == "exit status 7: it broke 1.2"
    assert failed.version == "it broke 1.2"
    assert len(table.read(csv, Cell)) == 6  # in the old failure's place


@needs_processes
def test_standing_views_are_no_ones_own(tmp_path: Path, command_line: CommandLine) -> None:
    scene, csv = tmp_path / "ball.ply", tmp_path / "figures.csv"
    io.write_splats(scene, checkered_ball(3000))
    chosen = ["default", "fast"]
    (pool,) = bench_simplify([scene], csv, ratios=[4], methods=["default"])
    cells = bench_simplify([scene], csv, ratios=[4], methods=chosen, protocol="both")
    kinds = ["pool", "near", "standing"]
    assert [c.key for c in cells] == [("ball", 4.0, m, kind) for m in chosen for kind in kinds]
    assert cells[0] == _rounded(pool)  # not measured again
    assert {c.error for c in cells} == {""}
    assert [c.views for c in cells[:3]] == [
        16,
        *(len(v) for v in standing_views(io.read_splats(scene), scene).values()),
    ]
    assert cells[0].psnr != cells[2].psnr
    assert len({c.cpu_s for c in cells[:3]}) == 2  # with the pool's views, and with its own
    assert len({c.cpu_s for c in cells[3:]}) == 1  # run alike for all, so run once
    text = csv.read_text()
    status, out, told = command_line(
        "bench",
        "simplify",
        scene,
        "--ratios",
        "4",
        "--methods",
        "default",
        "--protocol",
        "standing",
        "--csv",
        csv,
        "--json",
        "-",
        cwd=tmp_path,
    )
    assert status == 0, told
    assert csv.read_text() == text
    assert "standing" in told
    assert [row["views_kind"] for row in json.loads(out)["rows"]] == ["near", "standing"]
    with pytest.raises(InputError, match="protocol: expected one of pool, standing, both"):
        bench_simplify([scene], csv, protocol="sitting")


def test_a_standing_file_beside_the_scene_is_what_counts(tmp_path: Path) -> None:
    splats, folder = checkered_ball(1500), tmp_path / "ball"
    folder.mkdir()
    io.write_splats(folder / "ball.ply", splats)
    assert given_views(folder / "ball.ply") is None
    cameras = around(5)
    away = replace(cameras, viewmats=cameras.viewmats @ np.diag([-1.0, -1, 1, 1]))
    io.write_views(tmp_path / "standing.json", cameras, splits=["test"] * 4 + ["train"])
    for place in (folder / "ball.ply", folder):
        given = given_views(place)
        assert given is not None
        assert given.names == cameras.names[:4]
    found = standing_views(splats, folder / "ball.ply")
    np.testing.assert_array_equal(found["standing"].viewmats, cameras.viewmats[:4])
    turned = away.viewmats.copy()
    turned[0] = np.diag([-1.0, 1, -1, 1]) @ cameras.viewmats[0]  # looks the other way
    io.write_views(folder / "standing.json", replace(cameras, viewmats=turned))
    targets = standing_targets(splats, folder / "ball.ply", size=32)
    assert len(targets["standing"].cameras) == 4  # what shows nothing is left out
    assert targets["near"].cameras.widths.max() == 32


@pytest.mark.parametrize("make", [naive.statue, naive.room, naive.town])
def test_made_standing_views_are_of_another_kind(make) -> None:
    splats, nowhere = make(), Path("nowhere.ply")
    found, pool = standing_views(splats, nowhere), make_pool(splats, 128)
    assert set(found) == {"near", "standing"}
    for kind, cameras in found.items():
        assert all(name.startswith(kind) for name in cameras.names)
        assert 8 <= len(cameras) <= 24
        gaps = np.linalg.norm(cameras.positions[:, None] - pool.positions, axis=2)
        assert gaps.min() > 1e-3
        nearest = np.linalg.norm(splats.means[:, None] - cameras.positions, axis=2).min(axis=0)
        assert nearest.min() > 0.05
    standing = found["standing"]
    assert standing.Ks[0, 0, 0] == pytest.approx(400 / np.tan(np.radians(35)))
    if make is naive.statue:
        middle = np.array([0, 0, 0.5])
        away = [np.linalg.norm(c.positions - middle, axis=1).mean() for c in (*found.values(), pool)]
        assert away[0] < away[2]
        assert away[1] < 0.8 * away[2]
    if make is naive.room:
        assert ((standing.positions > 0) & (standing.positions < (6, 4, 2.7))).all()
    if make is naive.town:
        assert standing.positions[:, 2].max() < 9
    again = standing_views(splats, nowhere)
    np.testing.assert_array_equal(again["standing"].viewmats, standing.viewmats)


def test_rows_from_before_the_last_column_are_read(tmp_path: Path) -> None:
    csv = tmp_path / "old.csv"
    csv.write_text(
        "scene,ratio,method,input_count,budget,count,cpu_s,wall_s,peak_mb,psnr,ssim,views,version,machine,error\n"
        "ball,4.0,fast,2000,500,500,1.5,1.5,90.0,30.25,0.9,2,g2ard 1,a machine,\n"
    )
    (cell,) = table.read(csv, Cell)
    assert (cell.key, cell.psnr) == (("ball", 4.0, "fast", "pool"), 30.25)
    csv.write_text("scene,ratio,method\nball,4.0,fast\n")
    with pytest.raises(InputError, match="other columns"):
        table.read(csv, Cell)


@pytest.mark.parametrize(("name", "kind"), [("simplify", Cell), ("recover", Look)])
def test_recorded_rows_are_read(name, kind) -> None:
    paths = sorted((ROOT / "benchmarks" / "record").rglob(f"{name}-*.csv"))
    assert paths
    for path in paths:
        stated = "views_kind" in path.read_text(encoding="utf-8").splitlines()[0]
        kinds = {row.views_kind for row in table.read(path, kind)}
        assert kinds == ({"pool", "near", "standing"} if stated else {"pool"})


def _rounded(cell: Cell) -> Cell:
    return Cell(**{k: round(v, 6) if isinstance(v, float) else v for k, v in vars(cell).items()})


@needs_processes
def test_refuses_a_foreign_file_an_unknown_method_and_an_absent_program(tmp_path: Path) -> None:
    csv = tmp_path / "mine.csv"
    csv.write_text("a,b\n1,2\n")
    with pytest.raises(InputError, match="other columns"):
        bench_simplify([], csv)
    assert csv.read_text() == "a,b\n1,2\n"
    with pytest.raises(InputError, match="magic"):
        bench_simplify([], csv, methods=["magic"])
    with pytest.raises(InputError, match="no such program"):
        find_splat_transform(tmp_path / "nothing")
