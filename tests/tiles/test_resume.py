"""Runs in tiles that are stopped, gone on with, or asked for what tiles do not have."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import pytest

from g2ard.io import read_splats, write_splats, write_views
from g2ard.policy.tiling import Tiling, is_tiled
from helpers.commands import CommandLine
from helpers.tiled_scenes import ring, town

QUICK = "--tile-rows", "1500", "--workers", "1", "--size", "48", "--steps", "10"


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    write_splats(tmp_path / "town.ply", town(3000))
    write_views(tmp_path / "views.json", ring(6), splits=["train"] * 4 + ["test"] * 2)
    return tmp_path


def test_a_stopped_distill_goes_on_beside_its_output(
    command_line: CommandLine, folder: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def stopped(*_: Any, **__: Any) -> None:
        raise KeyboardInterrupt

    call = "distill", "town.ply", "-r", "10", "--views", "views.json", "-o", "run", *QUICK
    with monkeypatch.context() as patch:
        patch.setattr("g2ard.tiles.recover.recover_tiles", stopped)
        status, _, said = command_line(*call, cwd=folder)
    assert status == 130
    assert "run the same command with --resume to continue" in " ".join(said.split())
    assert (folder / ".run.tiles").is_dir()
    assert not (folder / "run").exists()
    status, _, said = command_line(*call, "--resume", cwd=folder)
    assert status == 0, said
    assert len(read_splats(folder / "run" / "scene.ply")) == 300
    assert not (folder / ".run.tiles").exists()


def test_resuming_several_budgets_makes_those_that_are_not_there(
    command_line: CommandLine, folder: Path
) -> None:
    call = "distill", "town.ply", "--views", "views.json", "-o", "runs/{ratio}x", *QUICK
    assert command_line(*call, "-r", "10", cwd=folder)[0] == 0
    first = (folder / "runs" / "10x" / "scene.ply").stat().st_mtime_ns
    assert command_line(*call, "-r", "10,20", cwd=folder)[0] == 1
    status, _, said = command_line(*call, "-r", "10,20", "--resume", cwd=folder)
    assert status == 0, said
    assert "10x: already finished" in said
    assert (folder / "runs" / "10x" / "scene.ply").stat().st_mtime_ns == first
    assert len(read_splats(folder / "runs" / "20x" / "scene.ply")) == 150
    assert {path.name for path in (folder / "runs").iterdir()} == {"10x", "20x"}
    status, told, said = command_line("info", "runs/10x", cwd=folder)
    assert status == 0, said
    assert "dB against the scene's renders" in " ".join((told + said).split())


def test_tiles_make_a_folder_of_sog(command_line: CommandLine, folder: Path) -> None:
    call = "simplify", "town.ply", "-r", "10", "--tile-rows", "1500", "--workers", "1", "--no-views"
    status, _, said = command_line(*call, "-o", "small/meta.json", cwd=folder)
    assert status == 0, said
    assert len(read_splats(folder / "small" / "meta.json")) == 300
    assert not list(folder.glob(".*"))


def test_a_cloud_is_never_in_tiles(folder: Path) -> None:
    rows = "".join(f"{i} {i % 7} {i % 5} 200 100 50\n" for i in range(40))
    header = "ply\nformat ascii 1.0\nelement vertex 40\n"
    fields = [f"property float {c}" for c in "xyz"] + [
        f"property uchar {c}" for c in ("red", "green", "blue")
    ]
    (folder / "cloud.ply").write_text(header + "\n".join(fields) + "\nend_header\n" + rows)
    assert not is_tiled(folder / "cloud.ply", Tiling(tile_rows=10))
    assert is_tiled(folder / "town.ply", Tiling(tile_rows=10))
