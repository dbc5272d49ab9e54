"""The study of registration: distances of starts, recorded results, and its data set."""

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from benchmarks.kinds.register import STARTS, displaced, figures
from g2ard.io import read_view_set, write_splats, write_views
from g2ard.scene.cameras import Cameras
from g2ard.stages.register import PoseError
from helpers.commands import CommandLine, refused, succeeds
from helpers.dataset_files import POSES, cambridge
from helpers.photos import photographed
from helpers.scenes import around, checkered_ball


def _site(folder: Path) -> Cameras:
    ball = checkered_ball(1500)
    write_splats(folder / "ball.ply", ball)
    return photographed(folder, ball, around(9, (128, 96), 2.5))


def test_rows_hold_starts_and_results(tmp_path: Path, command_line: CommandLine) -> None:
    write_views(tmp_path / "views.json", _site(tmp_path))
    call = (
        "benchmarks",
        "run",
        "register",
        "ball.ply",
        "--views",
        "views.json",
        "--methods",
        "direct",
    )
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


def test_recalls_count_every_photo() -> None:
    found = [PoseError(0.02, 1), PoseError(0.045, 1), PoseError(0.3, 1)]
    assert figures(found, 4, 1) == {
        "10": 0.5,
        "5": 0.5,
        "position": 4.5,
        "rotation": 1,
        "worst": 30,
    }
    assert figures(found, 4, 2)["5"] == 0.25
    assert figures(found, 4, None) == {
        "10": None,
        "5": None,
        "position": 0.045,
        "rotation": 1,
        "worst": 0.3,
    }
    assert figures([], 4, 1) == {"10": 0, "5": 0, "position": None, "rotation": None, "worst": None}


def test_views_of_cambridge_landmarks(tmp_path: Path, command_line: CommandLine) -> None:
    cambridge(tmp_path / "college")
    said = succeeds(
        command_line, tmp_path, "benchmarks", "cambridge", "college", "-o", "college.json"
    ).err
    assert "1 views are not in reconstruction.nvm; they get the median focal length, 1674.0" in said
    found = read_view_set(tmp_path / "college.json")
    assert found.splits == ("train",) * 6 + ("test",) * 3
    np.testing.assert_allclose(found.cameras.viewmats, POSES, atol=1e-7)
    np.testing.assert_allclose(found.cameras.Ks[0], [[167, 0, 96], [0, 167, 54], [0, 0, 1]])
    np.testing.assert_allclose(found.cameras.distortions[0], [0.05, 0, 0, 0, 0])
    assert found.cameras.Ks[4, 0, 0] == pytest.approx(167.4)  # the median, for it is not listed
    assert all(path.is_file() for path in found.cameras.image_paths)
