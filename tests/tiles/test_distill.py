"""Commands on scenes in tiles: files, rejected options, and recovery with frozen surroundings."""

import json
import os
import re
import signal
import subprocess
import sys
import time
from pathlib import Path

import numpy as np
import pytest

from g2ard.errors import InputError
from g2ard.io import Source, read_splats, write_splats, write_views
from g2ard.jobs.memory import plan_tiles
from g2ard.jobs.tile_options import Tiling, is_tiled
from g2ard.rendering.targets import TeacherRenders
from g2ard.scene.cameras import look_at
from g2ard.stages.evaluate import evaluate
from g2ard.stages.recover.config import RecoverConfig, Schedule
from g2ard.stages.recover.optimize import recover
from g2ard.stages.simplify import simplify
from g2ard.tiles.ingest import ingest
from helpers.cloud_files import columns, ply
from helpers.commands import CommandLine, succeeds
from helpers.project import environment
from helpers.scenes import views_at
from helpers.systems import is_worker, needs_proc, workers_of
from helpers.tiled_scenes import ring, town, town_in


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return town_in(tmp_path_factory.mktemp("town"))


def test_frozen_rows_stay_and_the_others_learn() -> None:
    dense = town(1500)
    small = simplify(dense, 300).splats
    frozen = np.arange(300) % 3 == 0
    config = RecoverConfig(schedule=Schedule.named("fast").scaled(40), steps=40)
    done = recover(small, TeacherRenders(dense, ring()), config, frozen=frozen)
    assert done.report.psnr.after > done.report.psnr.before
    for name in ("means", "scales", "logit_opacities", "sh0"):
        was, now = (np.asarray(getattr(s, name), np.float32).reshape(300, -1) for s in (small, done.splats))
        np.testing.assert_allclose(now[frozen], was[frozen], rtol=2e-6, atol=1e-6)
        assert (np.abs(now - was)[~frozen] > 1e-5).any(axis=1).mean() > 0.9
    with pytest.raises(InputError, match=r"frozen: expected shape \(300,\)"):
        recover(small, TeacherRenders(dense, ring()), config, frozen=frozen[:5])


def test_simplify_removes_its_tiles(command_line: CommandLine, folder: Path, tmp_path: Path) -> None:
    out, views = tmp_path / "small_{ratio}x.ply", folder / "views.json"
    args = ["simplify", folder / "town.ply", "-r", "10,20", "-o", out, "--tile-rows", "2500"]
    succeeds(
        command_line, tmp_path, *args, "--views", views, "--workers", "1", "--json", tmp_path / "told.json"
    )
    told = json.loads((tmp_path / "told.json").read_text())["runs"]
    for ratio, report in zip((10, 20), told, strict=True):
        small = read_splats(tmp_path / f"small_{ratio}x.ply")
        assert len(small) == 9000 // ratio == report["output_count"] == sum(report["tiles"])
    assert {path.name for path in tmp_path.iterdir()} == {"small_10x.ply", "small_20x.ply", "told.json"}


def test_files_of_another_run_are_replaced(command_line: CommandLine, folder: Path, tmp_path: Path) -> None:
    args = ["-n", "300", "--no-views", "--workers", "1", "--tile-rows", "700"]
    write_splats(tmp_path / "other.ply", town(1500, seed=4))
    write_splats(tmp_path / "own.ply", town(1600))
    succeeds(command_line, tmp_path, "simplify", "own.ply", "-o", "clean.ply", *args)
    stale = tmp_path / ".x.ply.tiles"
    ingest(tmp_path / "other.ply", stale / "tiles", tile_rows=700)
    (stale / "steps").mkdir()
    (stale / "steps" / "coarse-00000-0123456789abcdef.npz").write_bytes(b"of another run")
    (stale / "steps" / ".coarse-00000.0123.npz").write_bytes(b"begun")
    succeeds(command_line, tmp_path, "simplify", "own.ply", "-o", "x.ply", *args)
    assert (tmp_path / "x.ply").read_bytes() == (tmp_path / "clean.ply").read_bytes()
    assert not stale.exists()


def test_a_device_that_all_rows_fit(command_line: CommandLine, folder: Path, tmp_path: Path) -> None:
    args = ["simplify", folder / "town.ply", "--fit", "web", "-o", "all.ply", "--tile-rows", "2500"]
    succeeds(command_line, tmp_path, *args, "--workers", "1")
    assert len(read_splats(tmp_path / "all.ply")) == 9000


@pytest.mark.parametrize(
    ("words", "written"),
    [
        (("simplify", "-o", "small.ply", "--no-views"), "small.ply"),
        (("distill", "-o", "run", "--sh-degree", 0, "--steps", 2, "--size", 24), "run/scene.ply"),
    ],
)
def test_tiles_fill_a_file(
    words: tuple[object, ...], written: str, command_line: CommandLine, folder: Path, tmp_path: Path
) -> None:
    rows = ("--fit", "40kB", "--tile-rows", 2500, "--workers", 1)
    command, *others = words
    succeeds(command_line, tmp_path, command, folder / "town.ply", *others, *rows)
    count = len(read_splats(tmp_path / written))
    size = (tmp_path / written).stat().st_size
    assert size <= 40_000 < size + 2 * size / count


def test_a_folder_of_tiles_is_a_scene(command_line: CommandLine, folder: Path, tmp_path: Path) -> None:
    store = ingest(folder / "town.ply", tmp_path / "tiles", tile_rows=2500)
    common = ["-n", "900", "--no-views", "--workers", "1"]
    work = ("--work", tmp_path / "work")
    left = tmp_path / "work" / "steps" / ".views-0.0123456789ab.npz"  # by a killed run
    left.parent.mkdir(parents=True)
    left.write_bytes(b"begun")
    succeeds(command_line, tmp_path, "simplify", store.folder, *common, "-o", "a.ply", *work)
    assert not left.exists()
    rows = ("--tile-rows", "2500")
    succeeds(command_line, tmp_path, "simplify", folder / "town.ply", *common, "-o", "b.ply", *rows)
    assert (tmp_path / "a.ply").read_bytes() == (tmp_path / "b.ply").read_bytes()
    assert (tmp_path / "work" / "steps").is_dir()  # named by the user, so it stays


def test_tiles_are_read_as_one_scene(command_line: CommandLine, folder: Path, tmp_path: Path) -> None:
    dense = read_splats(folder / "town.ply")
    for rows in (9000, 2500):
        store = ingest(folder / "town.ply", tmp_path / f"{rows}", tile_rows=rows)
        back = read_splats(store.folder)
        for name in ("means", "scales", "logit_opacities"):
            got, wanted = (np.sort(getattr(scene, name), axis=0) for scene in (back, dense))
            np.testing.assert_array_equal(got, wanted)
    again = ingest(tmp_path / "2500", tmp_path / "again", tile_rows=4000)
    whole = ingest(folder / "town.ply", tmp_path / "whole", tile_rows=4000)
    assert [tile.rows for tile in again.tiles] == [tile.rows for tile in whole.tiles]


def test_a_killed_command_resumes(folder: Path, tmp_path: Path) -> None:
    words = ["simplify", folder / "town.ply", "-r", "10", "-o", tmp_path / "x.ply", "--tile-rows", "700"]
    command = [sys.executable, "-m", "g2ard", *map(str, words), "--workers", "2", "--no-views"]
    steps = tmp_path / ".x.ply.tiles" / "steps"
    with subprocess.Popen(command, env=environment(), stderr=subprocess.DEVNULL) as running:
        until = time.monotonic() + 120
        while running.poll() is None and time.monotonic() < until and len(list(steps.glob("[!.]*.npz"))) < 3:
            time.sleep(0.01)
        running.kill()
    done = {path.name: path.stat().st_mtime_ns for path in steps.glob("[!.]*.npz")}
    assert done
    again = subprocess.run([*command, "--work", str(steps.parent)], env=environment(), check=False)
    assert again.returncode == 0
    assert len(read_splats(tmp_path / "x.ply")) == 900
    assert all((steps / name).stat().st_mtime_ns == at for name, at in done.items())


@needs_proc
@pytest.mark.parametrize("seconds", [0.0, 0.3])
def test_workers_end_with_a_killed_command(folder: Path, tmp_path: Path, seconds: float) -> None:
    words = ["simplify", folder / "town.ply", "-r", "10", "-o", tmp_path / "x.ply", "--tile-rows", "700"]
    command = [sys.executable, "-m", "g2ard", *map(str, words), "--workers", "2", "--no-views"]
    with subprocess.Popen(command, env=environment(), stderr=subprocess.DEVNULL) as running:
        until = time.monotonic() + 60
        while not (workers := workers_of(running.pid)) and time.monotonic() < until:
            time.sleep(0.005)
        time.sleep(seconds)
        workers |= workers_of(running.pid)
        running.kill()
    assert workers
    until = time.monotonic() + 30
    while (left := {pid for pid in workers if is_worker(pid)}) and time.monotonic() < until:
        time.sleep(0.1)
    for pid in left:
        os.kill(pid, signal.SIGKILL)
    assert not left


def test_distill_in_one_piece_heeds_memory(command_line: CommandLine, folder: Path, tmp_path: Path) -> None:
    call = ("distill", folder / "town.ply", "-r", 10, "-o", "run", "--views", folder / "views.json")
    status, _, said = command_line(*call, "--memory", "120MB", cwd=tmp_path)
    assert status == 1
    said = " ".join(said.split())
    assert re.search(r"9,000 Gaussians in one piece take about [\d.]+ [MG]B, more than 120 MB", said)
    assert "in tiles the least that tiles take is about 201 MB, with --tile-rows 1,000" in said
    assert not list(tmp_path.iterdir())


def test_more_memory_takes_more_workers(folder: Path, tmp_path: Path) -> None:
    store = ingest(folder / "town.ply", tmp_path / "tiles", tile_rows=2500)
    few, many = (plan_tiles(store, Tiling(memory=size, cores=64)).workers for size in (10**9, 4 * 10**9))
    assert 1 < few < many


def test_distill_in_tiles_recovers(command_line: CommandLine, folder: Path, tmp_path: Path) -> None:
    succeeds(
        command_line,
        tmp_path,
        *("distill", folder / "town.ply", "-r", 10, "-o", tmp_path / "run", "--views", folder / "views.json"),
        *("--tile-rows", 4000, "--steps", 60, "--size", 120, "--workers", 1, "--keep"),
    )
    report = json.loads((tmp_path / "run" / "report.json").read_text())
    assert report["scores"]["recovered"] > report["scores"]["simplified"] + 0.2
    assert report["config"]["ratio"] == [10.0]
    small = read_splats(tmp_path / "run" / "scene.ply")
    assert len(small) == len(read_splats(tmp_path / "run" / "simplified" / "scene.ply")) == 900
    assert set(report["inputs"]) == {str(folder / "town.ply"), str(folder / "views.json")}
    held_out = TeacherRenders(read_splats(folder / "town.ply"), ring(8).take([6, 7]))
    assert evaluate(small, held_out).psnr > report["scores"]["simplified"]
    tiles = report["scores"]["tiles"]
    assert [tile["count"] for tile in tiles] == report["tiles"]
    assert sum(tile["pixels"] for tile in tiles) == report["scores"]["pixels"]
    (kind,) = report["scores"]["kinds"]
    assert (kind["kind"], kind["views"], kind["ssim"]) == ("given", 2, None)
    assert kind["worst_psnr"]["after"] <= report["scores"]["recovered"] <= kind["psnr"]["after"] + 0.2
    page = (tmp_path / "run" / "report.html").read_text()
    assert f"the worst view is {kind['worst']}" in page
    assert "town.ply: 9,000 → 900" in page
    assert f"{sum(tile['steps'] for tile in tiles):,} recovery steps of all tiles together" in page
    assert all(f"{tile['recovered']:.2f}" in page for tile in tiles)
    assert not list(tmp_path.glob("run/.*"))


def test_a_tile_takes_steps_for_the_views_that_see_it(command_line: CommandLine, tmp_path: Path) -> None:
    write_splats(tmp_path / "town.ply", town(4000))
    ends = [-6.0, 6.0] * 5  # no view shows both ends, which are two tiles
    eyes = [([x, 0.1 * i - 0.4, 5], [x, 0, 0]) for i, x in enumerate(ends)]
    poses = [look_at(eye, target) for eye, target in eyes]
    write_views(tmp_path / "ends.json", views_at(poses, (64, 48), 300), splits=["train"] * 8 + ["test"] * 2)
    ask = ("distill", "town.ply", "-r", 10, "--views", "ends.json", "--focus", "far", "-o", "run")
    ask += ("--tile-rows", 2500, "--workers", 1, "--steps", 40, "--json", "-")
    told = json.loads(succeeds(command_line, tmp_path, *ask).out)
    steps = [tile["steps"] for tile in told["scores"]["tiles"]]
    assert sum(steps) == 40
    assert max(steps) < 25


def test_tiles_make_a_folder_of_sog(command_line: CommandLine, folder: Path, tmp_path: Path) -> None:
    call = "simplify", folder / "town.ply", "-r", "10", "--tile-rows", "2500", "--workers", "1", "--no-views"
    succeeds(command_line, tmp_path, *call, "-o", "small/meta.json")
    assert len(read_splats(tmp_path / "small" / "meta.json")) == 900
    assert not list(tmp_path.glob(".*"))


def test_a_cloud_is_never_in_tiles(folder: Path, tmp_path: Path) -> None:
    ply(tmp_path / "cloud.ply", columns("f4", "u1"), np.arange(240).reshape(40, 6))
    assert not is_tiled(Source(tmp_path / "cloud.ply"), Tiling(tile_rows=10))
    assert is_tiled(Source(folder / "town.ply"), Tiling(tile_rows=10))
