"""`bench register` on a small scene: its starts are as far off as they say, its rows hold what it found."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest

from benchmarks import rows
from benchmarks.register import STARTS, Cell, bench_register, displaced
from g2ard.errors import InputError
from g2ard.io import write_splats, write_views
from g2ard.rendering.renderer import Renderer
from g2ard.scene.cameras import Cameras
from g2ard.scene.images import write_png
from g2ard.stages.register import RegisterConfig, pose_error
from helpers.commands import CommandLine
from helpers.scenes import around, checkered_ball


def _site(folder: Path) -> Cameras:
    ball = checkered_ball(1500)
    write_splats(folder / "ball.ply", ball)
    views = around(9, (128, 96), 2.5)
    names = tuple(f"{i}.png" for i in range(len(views)))
    for name, view in zip(names, views, strict=True):
        write_png(folder / name, np.clip(Renderer(ball).image(view), 0, 1))
    files = tuple(folder / name for name in names)
    return Cameras(views.viewmats, views.Ks, views.widths, views.heights, names, files)


def test_starts_are_as_far_off_as_they_say() -> None:
    pose = around(3)[2].viewmat
    for seed in range(5):
        distance, degrees = pose_error(displaced(pose, 0.3, 15, seed), pose)
        assert distance == pytest.approx(0.3)
        assert degrees == pytest.approx(15)


def test_rows_say_what_was_found_and_from_where(tmp_path: Path) -> None:
    views = _site(tmp_path).take([0, 4])
    config = RegisterConfig(size=128)
    cells = bench_register(
        [tmp_path / "ball.ply"],
        views,
        tmp_path / "rows.csv",
        ratios=[1, 3],
        matchers=["direct"],
        starts=["A"],
        metres_per_unit=2.0,
        config=config,
    )
    assert [(c.ratio, c.count) for c in cells] == [(1, 1500), (3, 500)]
    assert rows.read(tmp_path / "rows.csv", Cell)[0].count == 1500
    dense = cells[0]
    # the ball's surface is about 1.6 units from cameras 2.5 from its middle: 1 % are 3 cm at 2 m a unit
    assert dense.start_position == pytest.approx(3.3, abs=0.5)
    assert dense.start_rotation == pytest.approx(STARTS["A"][1] if STARTS["A"] else 0)
    assert dense.registered == 2
    assert dense.position is not None
    assert dense.position < 1
    assert dense.found_5 == 1
    assert dense.worst is not None
    assert dense.worst >= dense.position


def test_its_command(command_line: CommandLine, tmp_path: Path) -> None:
    write_views(tmp_path / "views.json", _site(tmp_path))
    call = ("bench", "register", "ball.ply", "--photos", "views.json", "--matchers", "direct")
    options = ("--starts", "A,D", "--ratios", "1", "--seeds", "1", "--size", "128", "--json", "-")
    status, out, err = command_line(*call, *options, cwd=tmp_path)
    assert status == 0, err
    found = json.loads(out)["rows"]
    assert [(row["start"], row["photos"]) for row in found] == [("A", 2), ("D", 2)]
    assert found[0]["found_10"] is None
    status, _, err = command_line(*call, "--starts", "Z", "-w", cwd=tmp_path)
    assert (status, "expected some of A, B, C, D, got Z" in err) == (1, True)


def test_what_cannot_be_is_refused(tmp_path: Path) -> None:
    views = around(2, (64, 48), 2.5)
    with pytest.raises(InputError, match="ratios: expected 1 or more"):
        bench_register([], views, tmp_path / "r.csv", ratios=[0.5])
    with pytest.raises(InputError, match="D looks for photos in a pool"):
        bench_register([], views, tmp_path / "r.csv", starts=["D"])
