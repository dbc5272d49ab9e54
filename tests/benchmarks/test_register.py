"""The study of registration: distances of starts, and recorded results."""

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from benchmarks.kinds.register import STARTS, displaced
from g2ard.io import write_splats, write_views
from g2ard.scene.cameras import Cameras
from helpers.commands import CommandLine, refused, succeeds
from helpers.photos import photographed
from helpers.scenes import around, checkered_ball


def _site(folder: Path) -> Cameras:
    ball = checkered_ball(1500)
    write_splats(folder / "ball.ply", ball)
    return photographed(folder, ball, around(9, (128, 96), 2.5))


def test_rows_hold_starts_and_results(tmp_path: Path, command_line: CommandLine) -> None:
    write_views(tmp_path / "views.json", _site(tmp_path))
    call = ("benchmarks", "run", "register", "ball.ply", "--views", "views.json", "--methods", "direct")
    few = ("--size", "128", "--seeds", "0", "--set", "metres_per_unit=2", "--json", "-")
    ask = (*call, *few, "--ratios", "1,3", "--set", "starts=A,D")
    out = succeeds(command_line, tmp_path, *ask).out
    cells = json.loads(out)["rows"]
    assert [(c["ratio"], c["count"], c["start"]) for c in cells] == [
        (ratio, count, start) for ratio, count in ((1, 1500), (3, 500)) for start in ("A", "D")
    ]
    dense = cells[0]
    # the ball's surface is about 1.6 units from cameras 2.5 from its middle: 1 % are 3 cm at 2 m a unit
    assert dense["start_position"] == pytest.approx(3.3, abs=0.5)
    assert dense["start_rotation"] == pytest.approx(STARTS["A"][1] if STARTS["A"] else 0, rel=1e-4)
    assert dense["photos"] == dense["registered"] == 2
    assert dense["position"] < 1
    assert dense["found_5"] == 1
    assert dense["worst"] >= dense["position"]
    assert "starts: expected one of A, B, C, D, given, got 'Z'" in refused(
        command_line, tmp_path, *call, "--set", "starts=Z", status=1
    )
    assert "needs photos with true poses" in refused(
        command_line, tmp_path, "benchmarks", "run", "register", "ball.ply", status=1
    )


def test_given_starts_and_the_protocol_of_gs_cpr(tmp_path: Path, command_line: CommandLine) -> None:
    views = _site(tmp_path)
    write_views(tmp_path / "views.json", views)
    moved = np.stack([displaced(pose, 0.02, 1, i) for i, pose in enumerate(views.viewmats)])
    write_views(tmp_path / "starts.json", replace(views, viewmats=moved))
    text = 'kind = "register"\nratios = [1]\nstarts = ["given"]\nprotocol = "gs-cpr"\nmethods = ["sift"]\n'
    scene = '[[scene]]\nname = "ball"\nprior = "ball.ply"\ntrain = "views.json"\n'
    (tmp_path / "a.toml").write_text(f'size = 128\n{text}{scene}starts = "starts.json"\n')
    out = succeeds(command_line, tmp_path, "benchmarks", "run", "a.toml", "--json", "-").out
    (row,) = json.loads(out)["rows"]
    assert row["start_position"] == pytest.approx(0.02, rel=1e-4)
    assert row["start_rotation"] == pytest.approx(1, rel=1e-4)
    assert row["position"] < 0.1
    (tmp_path / "b.toml").write_text(text + scene)
    told = refused(command_line, tmp_path, "benchmarks", "run", "b.toml", status=1)
    assert "needs the scene's `starts`" in told
