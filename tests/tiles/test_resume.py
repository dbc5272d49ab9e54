"""Interrupted and resumed runs in tiles, and options that tiles do not support."""

from pathlib import Path
from typing import Any

import numpy as np
import pytest

from g2ard.io import read_splats
from g2ard.jobs.tiling import Tiling, is_tiled
from helpers.cloud_files import columns, ply
from helpers.commands import CommandLine, succeeds
from helpers.tiled_scenes import town_in

QUICK = "--tile-rows", "1500", "--workers", "1", "--size", "48", "--steps", "10"


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    return town_in(tmp_path, 3000, views=6)


def test_a_stopped_distill_resumes(
    command_line: CommandLine, folder: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def stopped(*_: Any, **__: Any) -> None:
        raise KeyboardInterrupt

    call = "distill", "town.ply", "-r", "10", "--views", "views.json", "-o", "run", *QUICK
    with monkeypatch.context() as patch:
        patch.setattr("g2ard.jobs.tiled.recover_tiles", stopped)
        status, _, said = command_line(*call, cwd=folder)
    assert status == 130
    assert "run the same command with --resume to continue" in " ".join(said.split())
    assert (folder / ".run.tiles").is_dir()
    assert not (folder / "run").exists()
    succeeds(command_line, folder, *call, "--resume")
    assert len(read_splats(folder / "run" / "scene.ply")) == 300
    assert not (folder / ".run.tiles").exists()


def test_a_finished_run_is_not_made_again(command_line: CommandLine, folder: Path) -> None:
    call = "distill", "town.ply", "--views", "views.json", "-r", "10", "-o", "runs/10x", *QUICK
    succeeds(command_line, folder, *call)
    first = (folder / "runs" / "10x" / "scene.ply").stat().st_mtime_ns
    assert "10x: already finished" in succeeds(command_line, folder, *call, "--resume").err
    assert (folder / "runs" / "10x" / "scene.ply").stat().st_mtime_ns == first
    assert [path.name for path in (folder / "runs").iterdir()] == ["10x"]
    told, said = succeeds(command_line, folder, "info", "runs/10x")
    assert "dB against the scene's renders" in " ".join((told + said).split())


def test_tiles_make_a_folder_of_sog(command_line: CommandLine, folder: Path) -> None:
    call = "simplify", "town.ply", "-r", "10", "--tile-rows", "1500", "--workers", "1", "--no-views"
    succeeds(command_line, folder, *call, "-o", "small/meta.json")
    assert len(read_splats(folder / "small" / "meta.json")) == 300
    assert not list(folder.glob(".*"))


def test_a_cloud_is_never_in_tiles(folder: Path) -> None:
    ply(folder / "cloud.ply", columns("f4", "u1"), np.arange(240).reshape(40, 6))
    assert not is_tiled(folder / "cloud.ply", Tiling(tile_rows=10))
    assert is_tiled(folder / "town.ply", Tiling(tile_rows=10))
