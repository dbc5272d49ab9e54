"""Commands on scenes in tiles: files, images, options, and recovery."""

import json
import os
import re
import signal
import subprocess
import sys
import time
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import numpy as np
import pytest

from g2ard.errors import InputError
from g2ard.io import Source, read_splats, write_points, write_splats, write_views
from g2ard.io.types import Points
from g2ard.jobs.memory import plan_tiles
from g2ard.jobs.tile_options import Tiling, is_tiled
from g2ard.rendering.targets import TeacherRenders
from g2ard.scene.cameras import Cameras, look_at
from g2ard.stages.evaluate import evaluate
from g2ard.stages.recover.config import RecoverConfig, Schedule
from g2ard.stages.recover.optimize import recover
from g2ard.stages.simplify import SimplifyConfig, simplify
from g2ard.stages.simplify.gaps import opacity_lost
from g2ard.tiles.dense import InTiles
from g2ard.tiles.executor import Workers, executor
from g2ard.tiles.ingest import ingest
from helpers.cloud_files import columns, ply
from helpers.commands import CommandLine, refused, succeeds
from helpers.photos import photographed
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
        was, now = (
            np.asarray(getattr(s, name), np.float32).reshape(300, -1) for s in (small, done.splats)
        )
        np.testing.assert_allclose(now[frozen], was[frozen], rtol=2e-6, atol=1e-6)
        assert (np.abs(now - was)[~frozen] > 1e-5).any(axis=1).mean() > 0.9
    with pytest.raises(InputError, match=r"frozen: expected shape \(300,\)"):
        recover(small, TeacherRenders(dense, ring()), config, frozen=frozen[:5])


def test_simplify_removes_its_tiles(
    command_line: CommandLine, folder: Path, tmp_path: Path
) -> None:
    out, views = tmp_path / "small_{ratio}x.ply", folder / "views.json"
    args = ["simplify", folder / "town.ply", "-r", "10,20", "-o", out, "--tile-rows", "2500"]
    succeeds(
        command_line,
        tmp_path,
        *args,
        "--views",
        views,
        "--workers",
        "1",
        "--json",
        tmp_path / "told.json",
    )
    told = json.loads((tmp_path / "told.json").read_text())["runs"]
    for ratio, report in zip((10, 20), told, strict=True):
        small = read_splats(tmp_path / f"small_{ratio}x.ply")
        assert len(small) == 9000 // ratio == report["output_count"] == sum(report["tiles"])
    assert {path.name for path in tmp_path.iterdir()} == {
        "small_10x.ply",
        "small_20x.ply",
        "told.json",
    }


def test_files_of_another_run_are_replaced(
    command_line: CommandLine, folder: Path, tmp_path: Path
) -> None:
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


def test_a_device_that_all_rows_fit(
    command_line: CommandLine, folder: Path, tmp_path: Path
) -> None:
    args = ["simplify", folder / "town.ply", "--fit", "web", "-o", "all.ply", "--tile-rows", "2500"]
    succeeds(command_line, tmp_path, *args, "--workers", "1")
    assert len(read_splats(tmp_path / "all.ply")) == 9000


@pytest.mark.parametrize(
    ("words", "written"),
    [
        (("simplify", "-o", "small.ply", "--no-views"), "small.ply"),
        (
            (
                "distill",
                "-o",
                "run",
                "--sh-degree",
                0,
                "--steps",
                2,
                "--size",
                24,
                "--focus",
                "far",
            ),
            "run/scene.ply",
        ),
    ],
)
def test_tiles_fill_a_file(
    words: tuple[object, ...], written: str, command_line: CommandLine, folder: Path, tmp_path: Path
) -> None:
    rows = ("--fit", "40kB", "--tile-rows", 2500, "--workers", 1)
    command, *others = words
    seen = () if "--no-views" in words else ("--views", folder / "views.json")
    succeeds(command_line, tmp_path, command, folder / "town.ply", *others, *seen, *rows)
    count = len(read_splats(tmp_path / written))
    size = (tmp_path / written).stat().st_size
    assert size <= 40_000 < size + 2 * size / count


def test_a_folder_of_tiles_is_a_scene(
    command_line: CommandLine, folder: Path, tmp_path: Path
) -> None:
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


def test_tiles_are_read_as_one_scene(
    command_line: CommandLine, folder: Path, tmp_path: Path
) -> None:
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
    words = [
        "simplify",
        folder / "town.ply",
        "-r",
        "10",
        "-o",
        tmp_path / "x.ply",
        "--tile-rows",
        "700",
    ]
    command = [sys.executable, "-m", "g2ard", *map(str, words), "--workers", "2", "--no-views"]
    steps = tmp_path / ".x.ply.tiles" / "steps"
    with subprocess.Popen(command, env=environment(), stderr=subprocess.DEVNULL) as running:
        until = time.monotonic() + 120
        while (
            running.poll() is None
            and time.monotonic() < until
            and len(list(steps.glob("[!.]*.npz"))) < 3
        ):
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
    words = [
        "simplify",
        folder / "town.ply",
        "-r",
        "10",
        "-o",
        tmp_path / "x.ply",
        "--tile-rows",
        "700",
    ]
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


def test_distill_in_one_piece_heeds_memory(
    command_line: CommandLine, folder: Path, tmp_path: Path
) -> None:
    call = ("distill", folder / "town.ply", "-r", 10, "-o", "run", "--views", folder / "views.json")
    status, _, said = command_line(*call, "--memory", "120MB", cwd=tmp_path)
    assert status == 1
    said = " ".join(said.split())
    assert re.search(
        r"9,000 Gaussians in one piece take about [\d.]+ [MG]B, more than 120 MB", said
    )
    assert "in tiles the least that tiles take is about 201 MB, with --tile-rows 1,000" in said
    assert not list(tmp_path.iterdir())


def test_more_memory_takes_more_workers(folder: Path, tmp_path: Path) -> None:
    store = ingest(folder / "town.ply", tmp_path / "tiles", tile_rows=2500)
    few, many = (
        plan_tiles(store, Tiling(memory=size, cores=64)).workers for size in (10**9, 4 * 10**9)
    )
    assert 1 < few < many


def test_tiles_draw_the_images_of_the_whole_scene(folder: Path, tmp_path: Path) -> None:
    """Also from within, from so far away that a pixel is wider than a halo, and of wide Gaussians."""
    scene = town(3000)
    scene.scales[::50] *= 30
    write_splats(tmp_path / "town.ply", scene)
    eyes = [
        ([0.1, 0.2, 0.5], [3, 0.1, 0.3]),
        ([300, 0, 90], [0, 0, 0]),
        ([-7, -3, 0.4], [7, 3, 0.4]),
    ]
    far = views_at([look_at(eye, target) for eye, target in eyes], (96, 72), 120)
    views = Cameras.of([*ring(), *far])
    store = ingest(tmp_path / "town.ply", tmp_path / "tiles", tile_rows=500)
    with executor(threads=1) as runs:
        tiles = InTiles(store, Workers(runs, tmp_path / "steps"), SimplifyConfig(), 500, tmp_path)
        settings = tiles.settings
        whole = TeacherRenders(scene, views, background=(0.2, 0.4, 0.6), settings=settings)
        drawn = tiles.images(views, (0.2, 0.4, 0.6))
        with ThreadPoolExecutor(8) as threads:  # which all find that nothing is drawn
            list(threads.map(drawn.__getitem__, range(len(views))))
        for view in range(len(views)):
            np.testing.assert_allclose(drawn[view], whole[view], atol=1 / 255)
            assert np.abs(drawn[view] - whole[view]).mean() < 2e-5
        small = simplify(scene, 300).splats
        assert tiles.opacity_lost(small, views) == pytest.approx(
            opacity_lost(scene, small, views), abs=1e-3
        )


def test_a_run_in_tiles_has_all_its_parts(
    command_line: CommandLine, folder: Path, tmp_path: Path
) -> None:
    succeeds(
        command_line,
        tmp_path,
        *(
            "distill",
            folder / "town.ply",
            "-r",
            10,
            "-o",
            tmp_path / "run",
            "--views",
            folder / "views.json",
        ),
        *("--tile-rows", 4000, "--steps", 60, "--size", 120, "--workers", 1, "--keep"),
    )
    report = json.loads((tmp_path / "run" / "report.json").read_text())
    scores = {name: score["psnr"] for name, score in report["scores"].items()}
    assert scores["recovered"] > scores["simplified"] + 0.2
    assert (report["tiles"], report["input_count"], report["output_count"]) == (3, 9000, 900)
    small = read_splats(tmp_path / "run" / "scene.ply")
    assert len(small) == len(read_splats(tmp_path / "run" / "simplified" / "scene.ply")) == 900
    assert set(report["inputs"]) == {str(folder / "town.ply"), str(folder / "views.json")}
    held_out = TeacherRenders(
        read_splats(folder / "town.ply"), ring(8).take([6, 7])
    ).cameras.fitted(120)
    against = TeacherRenders(read_splats(folder / "town.ply"), held_out)
    assert evaluate(small, against).psnr == pytest.approx(scores["recovered"], abs=0.02)
    names = {path.name for path in (tmp_path / "run").iterdir()}
    assert {"preview.png", "report.html", "view.html", "views.json", "scene.ply"} <= names
    assert not list(tmp_path.glob("run/.*"))


@pytest.mark.parametrize(
    "options",
    [
        ("--fit", "20kB", "--format", "sog"),
        ("--fit", "quest3"),
        ("--min-psnr", 18),
        ("--time", "5s", "-r", 20),
        ("--recovery-time", "1s", "-r", 20),
        ("--set", "select.views_count=3", "-r", 20),
        ("-r", 90),
    ],
)
def test_options_work_at_any_size(
    options: tuple[object, ...], command_line: CommandLine, folder: Path, tmp_path: Path
) -> None:
    timed = {"--time", "--recovery-time"} & set(options)
    call = (
        "distill",
        folder / "town.ply",
        "--views",
        folder / "views.json",
        "--size",
        64,
        "--no-page",
    )
    steps = () if timed else ("--steps", 4)
    rows = ("--tile-rows", 4000, "--workers", 1)
    succeeds(command_line, tmp_path, *call, *rows, *steps, *options, "-o", "run")
    made = json.loads((tmp_path / "run" / "report.json").read_text())
    assert 0 < made["output_count"] <= 9000
    if "sog" in options:
        assert (tmp_path / "run" / "scene.sog").stat().st_size <= 20_000


@pytest.mark.parametrize("options", [("--fit", "20kB"), ("--fit", "quest3"), ("--min-psnr", 18)])
def test_budgets_of_simplify_work_in_tiles(
    options: tuple[object, ...], command_line: CommandLine, folder: Path, tmp_path: Path
) -> None:
    call = ("simplify", folder / "town.ply", "--views", folder / "views.json", *options)
    rows = ("--tile-rows", 4000, "--workers", 1, "--json", "-")
    made = json.loads(succeeds(command_line, tmp_path, *call, *rows, "-o", "small.ply").out)
    assert len(read_splats(tmp_path / "small.ply")) == made["output_count"] <= 9000
    assert [path.name for path in tmp_path.iterdir()] == ["small.ply"]


def test_a_cloud_streams_into_tiles(command_line: CommandLine, tmp_path: Path) -> None:
    scene = town(3000)
    colors = np.clip(0.5 + 0.28 * scene.sh0[:, 0], 0, 1)
    write_points(tmp_path / "cloud.ply", Points(scene.means.astype(float), colors))
    rows = ("--tile-rows", 1000, "--workers", 1)
    succeeds(command_line, tmp_path, "simplify", "cloud.ply", "-n", 300, "-o", "small.ply", *rows)
    assert len(read_splats(tmp_path / "small.ply")) == 300
    succeeds(
        command_line,
        tmp_path,
        "lod",
        "cloud.ply",
        "-r",
        "2,8",
        "--merge-only",
        "-o",
        "levels",
        *rows,
    )
    distilled = ("distill", "cloud.ply", "-n", 300, "--steps", 4, "--size", 64, "--no-page")
    distilled = (*distilled, "--focus", "far")
    succeeds(command_line, tmp_path, *distilled, *rows, "-o", "run")
    report = json.loads((tmp_path / "run" / "report.json").read_text())
    assert (report["tiles"], report["lifted"], report["output_count"]) == (3, True, 300)
    (tmp_path / "images").mkdir()
    pictured = photographed(tmp_path / "images", scene, ring(8))
    write_views(tmp_path / "pictured.json", pictured, splits=["train"] * 6 + ["test"] * 2)
    succeeds(
        command_line, tmp_path, *distilled, "--views", "pictured.json", *rows, "-o", "photographed"
    )
    report = json.loads((tmp_path / "photographed" / "report.json").read_text())
    assert (report["against"], report["tiles"]) == ("photos", 3)


@pytest.mark.parametrize(
    ("command", "said"),
    [
        ("simplify town.ply -n 3001", "expected a budget of at most 3,000, got 3,001"),
        ("distill town.ply -n 3001", "expected a budget of at most 3,000, got 3,001"),
        ("simplify town.ply -n 3", "the 4 tiles keep at least 4 Gaussians"),
        ("distill town.ply -r 1000", "the 4 tiles keep at least 4 Gaussians"),
        ("distill cloud.ply -n 300 --views views.json", "view 0 has no photo"),
    ],
)
def test_requests_out_of_reach_are_refused_before_tiles_are_written(
    command_line: CommandLine,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    command: str,
    said: str,
) -> None:
    town_in(tmp_path, 3000)
    points = np.random.default_rng(0).uniform(size=(3000, 3))
    write_points(tmp_path / "cloud.ply", Points(points, np.full((3000, 3), 0.5)))
    before = sorted(tmp_path.iterdir())

    def write_nothing(*_: object, **__: object) -> None:
        raise AssertionError("tiles are written")

    monkeypatch.setattr("g2ard.tiles.ingest.ingest", write_nothing)
    words = [
        *command.split(),
        "--tile-rows",
        800,
        "-o",
        "out.ply" if "simplify" in command else "run",
    ]
    assert said in refused(command_line, tmp_path, *words, status=1)
    assert sorted(tmp_path.iterdir()) == before


def test_tiles_make_a_folder_of_sog(
    command_line: CommandLine, folder: Path, tmp_path: Path
) -> None:
    call = (
        "simplify",
        folder / "town.ply",
        "-r",
        "10",
        "--tile-rows",
        "2500",
        "--workers",
        "1",
        "--no-views",
    )
    succeeds(command_line, tmp_path, *call, "-o", "small/meta.json")
    assert len(read_splats(tmp_path / "small" / "meta.json")) == 900
    assert not list(tmp_path.glob(".*"))


def test_clouds_and_scenes_are_tiled_by_their_rows(folder: Path, tmp_path: Path) -> None:
    ply(tmp_path / "cloud.ply", columns("f4", "u1"), np.arange(240).reshape(40, 6))
    for path, count in ((tmp_path / "cloud.ply", 40), (folder / "town.ply", 9000)):
        assert is_tiled(Source(path), Tiling(tile_rows=10))
        assert not is_tiled(Source(path), Tiling(tile_rows=count))
