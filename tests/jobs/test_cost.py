"""`distill --dry-run`: exact counts and rough bytes."""

import json
import re
import subprocess
import sys
import time
from collections.abc import Sequence
from contextlib import suppress
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import g2ard
from g2ard.io import write_views
from g2ard.jobs.budget import Budget
from g2ard.jobs.cost import cost_of
from g2ard.jobs.distill import prepare
from g2ard.jobs.distill_options import DistillOptions
from g2ard.progress import silent
from g2ard.rendering.targets import Cached, _Chosen, fill
from helpers.commands import CommandLine, refused, succeeds
from helpers.photos import photographed, photos_of
from helpers.project import environment
from helpers.scenes import around, checkered_ball
from helpers.tiled_scenes import town_in


def test_a_dry_run_counts_and_writes_nothing(folder: Path, command_line: CommandLine) -> None:
    ask = (
        "distill",
        "ball.ply",
        "-r",
        "10",
        "-o",
        "run",
        "--steps",
        "12",
        "--size",
        "48",
        "--json",
        "-",
    )
    before = set(folder.iterdir())
    out, error = succeeds(command_line, folder, *ask, "--dry-run")
    assert set(folder.iterdir()) == before
    assert "nothing is written" in error
    told = json.loads(out)
    ran = json.loads(succeeds(command_line, folder, *ask).out)
    assert told["count"] == ran["output_count"] == 40
    assert told["steps"] == ran["rounds"][-1]["recover"][-1]["steps"] == 12
    views = len(g2ard.load_views(folder / "run" / "views.json"))
    assert views < told["views"] <= views + 72  # those of other kinds are in no file
    assert told["pixels"] == 48 * 36


@pytest.mark.parametrize("scene", ["town.ply", "tiles"])
def test_a_dry_run_plans_tiles_like_the_run(
    scene: str, tmp_path: Path, command_line: CommandLine
) -> None:
    folder = town_in(tmp_path, 3000, views=4)
    words = ("ingest", "town.ply", "-o", "tiles", "--tile-rows", 800)
    store = [] if scene == "town.ply" else succeeds(command_line, folder, *words)
    before = sorted(folder.rglob("*"))
    ask = (
        "distill",
        scene,
        "-r",
        10,
        "--views",
        "views.json",
        "--size",
        24,
        "--steps",
        2,
        "--json",
        "-",
    )
    ask += ("--focus", "far")
    ask += ("--workers", 1) if store else ("--workers", 1, "--tile-rows", 800)
    told = json.loads(succeeds(command_line, folder, *ask, "--dry-run").out)
    assert sorted(folder.rglob("*")) == before
    ran = json.loads(succeeds(command_line, folder, *ask, "-o", "run").out)
    assert (told["count"], told["tiles"], told["workers"]) == (ran["output_count"], ran["tiles"], 1)
    assert told["steps"] == 2
    assert told["views"] >= 4
    assert told["disk"] > 2 * 3000 * 56


@pytest.mark.parametrize("rows", [(), ("--tile-rows", 800, "--workers", 1)])
def test_a_dry_run_of_simplify(
    rows: tuple[object, ...], tmp_path: Path, command_line: CommandLine
) -> None:
    folder = town_in(tmp_path, 3000, views=4)
    ask = (
        "simplify",
        "town.ply",
        "-r",
        "10,20",
        "--views",
        "views.json",
        *rows,
        "--dry-run",
        "--json",
        "-",
    )
    plans = json.loads(succeeds(command_line, folder, *ask).out)["runs"]
    assert [plan["count"] for plan in plans] == [300, 150]
    assert {plan["views"] for plan in plans} == {2}
    assert [plan.get("tiles") for plan in plans] == [4 if rows else None] * 2
    assert all(plan["bytes"] > 1e7 for plan in plans)
    assert {path.name for path in folder.iterdir()} == {"town.ply", "views.json"}


def test_a_dry_run_of_levels_plans_tiles(tmp_path: Path, command_line: CommandLine) -> None:
    folder = town_in(tmp_path, 3000, views=4)
    ask = (
        "lod",
        "town.ply",
        "-r",
        "1,4,8",
        "--views",
        "views.json",
        "--size",
        24,
        "--tile-rows",
        800,
    )
    out, said = succeeds(command_line, folder, *ask, "--steps", 90, "--dry-run", "--json", "-")
    found = [(one["level"], one["count"], one["steps"]) for one in json.loads(out)["levels"]]
    assert found == [(1, 750, 90), (2, 375, 90)]
    assert "4 tiles of 3,000 Gaussians" in said
    assert "200 MB" in refused(
        command_line, folder, *ask, "--dry-run", "--memory", "200MB", status=1
    )
    assert {path.name for path in folder.iterdir()} == {"town.ply", "views.json"}


def test_memory_grows_with_views_and_gaussians(monkeypatch: pytest.MonkeyPatch) -> None:
    options = DistillOptions(size=48)
    job = prepare(checkered_ball(900), Budget(90), options)
    few, many = cost_of(job, 90), cost_of(job, 450)
    assert few.bytes > 12 * few.views * few.pixels
    assert many.bytes > few.bytes
    monkeypatch.setattr("g2ard.jobs.cost._LOOKS", (0, 0))  # packing takes less for a small scene
    both = cost_of(job, 450)  # its page holds the dense scene too
    monkeypatch.setattr("g2ard.jobs.cost.LARGEST_DENSE", 899)
    assert both.bytes > cost_of(job, 450).bytes > cost_of(job, 450, page=False).bytes


@pytest.mark.parametrize("pictured", [False, True])
def test_memory_limits_targets(pictured: bool, tmp_path: Path) -> None:
    views = around(24, (400, 300))
    if pictured:
        views = photographed(tmp_path, checkered_ball(200), views)
    free, limited = (
        prepare(
            checkered_ball(900),
            Budget(90),
            DistillOptions(views=views, memory=memory, settings={"focus": "far"}),
        )
        for memory in (None, 8_000_000)
    )
    bytes_of = 400 * 300 * (3 if pictured else 6)
    spared = cost_of(free, 90).bytes - cost_of(limited, 90).bytes
    assert spared > 20 * bytes_of - 2_000_000  # views of other kinds spare more
    assert cost_of(free, 90).disk == 0
    assert cost_of(limited, 90).disk == spared
    for job, most in ((free, 2_000_000_000), (limited, 2_000_000)):
        train = job.targets.train
        fill(train, silent)
        images = [train[view] for view in range(len(train.cameras))]
        targets = train._parts()[0][0] if isinstance(train, _Chosen) else train
        assert isinstance(targets, Cached)
        assert targets._bytes <= most
        assert all(map(targets._holds, range(len(images))))


_DISTIL = "--steps 4 --size 200"
_GIVEN = "--views views.json --focus far"
MEASURED = {
    "distil SH 3": f"distill 20000_3.ply -r 10 {_DISTIL}",
    "distil larger views": "distill 20000_0.ply -r 4 --steps 4 --size 500 --focus far --no-page",
    "distil with few steps of the paper": f"distill 60000_2.ply -r 10 {_DISTIL} {_GIVEN} --preset paper --no-page",
    "distil photos": "distill --views photos -n 500 --steps 12",
    "simplify": "simplify 60000_3.ply -r 10",
    "simplify without views": "simplify 60000_2.ply -r 10 --no-views",
    "clean nothing": "clean 60000_3.ply --only none",
    "recover": "recover 20000_2.ply --teacher 60000_3.ply --views views.json --steps 4",
}
"""Name → arguments; scenes are called by their count and SH degree."""


@pytest.fixture(scope="module")
def measured(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder with scenes of random harmonics, 24 views and some photos."""
    folder, rng = tmp_path_factory.mktemp("measured"), np.random.default_rng(0)
    for name in {
        word for ask in MEASURED.values() for word in ask.split() if word.endswith(".ply")
    }:
        count, degree = map(int, name.removesuffix(".ply").split("_"))
        harmonics = rng.normal(0, 0.15, (count, (degree + 1) ** 2 - 1, 3)).astype(np.float32)
        g2ard.save(folder / name, replace(checkered_ball(count), shN=harmonics))
    splits = ["train"] * 20 + ["test"] * 4
    write_views(folder / "views.json", around(24, (400, 300)), splits=splits)
    photos_of(folder / "photos")
    return folder


@pytest.mark.skipif(
    not Path("/proc/self/status").exists(), reason="memory cannot be read on this system"
)
@pytest.mark.parametrize("name", MEASURED)
def test_memory_is_close(
    name: str, measured: Path, tmp_path: Path, command_line: CommandLine
) -> None:
    ask = [
        *MEASURED[name].split(),
        "-o",
        tmp_path / ("run" if "distill" in MEASURED[name] else "out.ply"),
    ]
    ask += ["--device", "cpu", "--threads", "2"]  # a software adapter takes memory
    told = json.loads(succeeds(command_line, measured, *ask, "--dry-run", "--json", "-").out)
    (told,) = told.get("runs", [told])
    taken = peak_of(ask, measured)
    # Fewer arenas of malloc, as beside other work, take up to a quarter less than a run alone.
    assert 0.75 * taken < told["bytes"] < 1.5 * taken, (told["bytes"], taken)


def peak_of(ask: Sequence[object], folder: Path) -> int:
    """Return the peak of a program's own pages plus that of mapped files.

    Their sum has another peak: a system that saves memory takes pages of libraries back from a slow program.
    """
    program = [sys.executable, "-m", "g2ard", *map(str, ask), "-q"]
    streams = {"stdout": subprocess.DEVNULL, "stderr": subprocess.PIPE}
    running = subprocess.Popen(program, cwd=folder, env=environment(), text=True, **streams)
    status, most = Path(f"/proc/{running.pid}/status"), {"RssAnon": 0, "RssFile": 0}
    while running.poll() is None:
        with suppress(OSError):
            for name, value in re.findall(r"(RssAnon|RssFile):\s+(\d+)", status.read_text()):
                most[name] = max(most[name], int(value) * 1024)
        time.sleep(0.002)
    assert running.returncode == 0, running.stderr and running.stderr.read()
    return sum(most.values())


def test_a_dry_run_is_in_nobodys_way(command_line: CommandLine, folder: Path) -> None:
    (folder / "run").mkdir()
    (folder / "run" / "kept.txt").write_text("")
    ask = ("distill", "ball.ply", "-r", 10, "-o", "run", "--steps", 3, "--size", 32)
    assert "-w (--overwrite)" in refused(command_line, folder, *ask, status=1)
    assert "nothing is written" in succeeds(command_line, folder, *ask, "--dry-run").err
    succeeds(command_line, folder, "clean", "ball.ply", "-o", "views.json", "--dry-run")
    assert [path.name for path in (folder / "run").iterdir()] == ["kept.txt"]


@pytest.mark.parametrize("budget", ["-r 10", "--fit 20kB", "--min-psnr 20"])
def test_a_dry_run_needs_no_output(budget: str, folder: Path, command_line: CommandLine) -> None:
    before = set(folder.iterdir())
    ask = (*budget.split(), "--steps", 4, "--size", 48, "--dry-run")
    succeeds(command_line, folder, "distill", "ball.ply", *ask)
    if budget == "-r 10":
        ask = ("--ratios", "1,2", *ask[2:])
        succeeds(command_line, folder, "lod", "ball.ply", *ask)
    assert set(folder.iterdir()) == before


def test_a_dry_run_of_clean_is_of_the_kinds_requested(
    folder: Path, command_line: CommandLine
) -> None:
    def planned(*only: str) -> dict[str, Any]:
        ask = ("clean", "ball.ply", *only, "--dry-run", "--json", "-")
        told: dict[str, Any] = json.loads(succeeds(command_line, folder, *ask).out)
        return told

    nothing, giants, whole = (
        planned(*only) for only in (["--only", "none"], ["--only", "giant"], [])
    )
    assert nothing["views"] == 0
    assert nothing["bytes"] < giants["bytes"]
    assert giants["views"] == whole["views"] > 0
    told = succeeds(command_line, folder, "clean", "ball.ply", "--only", "none", "--dry-run").err
    assert re.search(r"^400 Gaussians: roughly \d+ MB$", told, re.MULTILINE)
    assert "--preview" not in told
    whole_told = succeeds(command_line, folder, "clean", "ball.ply", "--dry-run").err
    for text in (whole_told, succeeds(command_line, folder, "clean", "--help").out):
        assert "--preview FILE.png without -o shows what would go" in " ".join(text.split())


@pytest.mark.parametrize("command", ["recover", "adapt"])
def test_a_dry_run_of_a_fit(command: str, folder: Path, command_line: CommandLine) -> None:
    before = set(folder.iterdir())
    ask = (
        command,
        "ball.ply",
        "--views",
        "views.json",
        "--teacher",
        "ball.ply",
        "--steps",
        4,
        "--json",
        "-",
    )
    told = json.loads(succeeds(command_line, folder, *ask, "--dry-run").out)
    assert set(folder.iterdir()) == before
    ran = json.loads(succeeds(command_line, folder, *ask, "-o", "fit.ply").out)
    assert told["count"] == len(g2ard.load(folder / "fit.ply"))
    # it is its teacher
    assert (told["steps"], ran["steps"]) == ((4, 4) if command == "adapt" else (0, 0))
