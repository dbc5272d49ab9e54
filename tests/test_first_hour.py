"""What a newcomer meets in the first hour: outputs, names, pipes, signals, what is said and what is not."""

from __future__ import annotations

import json
import os
import signal
import subprocess
import sys
import time
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from PIL import Image
from scenes import around, checkered_ball
from systems import needs_signals
from view_files import transforms

import g2ard
from g2ard.cli.budget_options import Counts
from g2ard.io import Points, write_points, write_views
from g2ard.policy.photos import points_within_sight
from g2ard.scene.images import write_png
from g2ard.scene.splats import SH_C0

CommandLine = Callable[..., tuple[int, str, str]]
BALL = checkered_ball(1200)


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    g2ard.save(tmp_path / "ball.ply", BALL)
    write_views(tmp_path / "views.json", around(16, (48, 36)))
    return tmp_path


def test_folders_are_made_and_suffixes_are_of_any_case(command_line: CommandLine, folder: Path) -> None:
    g2ard.save(folder / "a" / "b" / "ball.PLY", BALL)
    assert len(g2ard.load(folder / "a" / "b" / "ball.PLY")) == 1200
    status, _, error = command_line(
        "simplify", "a/b/ball.PLY", "-r", 4, "-o", "c/d/small.Ply", "--json", "e/f.json", cwd=folder
    )
    assert status == 0, error
    assert json.loads((folder / "e" / "f.json").read_text())["output_count"] == 300
    assert len(g2ard.load(folder / "c" / "d" / "small.Ply")) == 300


def test_several_budgets_are_what_single_runs_give(command_line: CommandLine, folder: Path) -> None:
    several = ("simplify", "ball.ply", "-r", "4,6", "-r", 10, "-o", "s_{ratio}x_{count}.ply", "--json", "-")
    status, out, error = command_line(*several, cwd=folder)
    assert status == 0, error
    assert [run["output_count"] for run in json.loads(out)["runs"]] == [300, 200, 120]
    for ratio, count in ((4, 300), (6, 200), (10, 120)):
        command_line("simplify", "ball.ply", "-r", ratio, "-o", f"one_{ratio}.ply", cwd=folder)
        one = (folder / f"one_{ratio}.ply").read_bytes()
        assert (folder / f"s_{ratio}x_{count}.ply").read_bytes() == one
    ask = ("distill", "ball.ply", "--steps", 8, "--size", 48)
    status, _, error = command_line(*ask, "-n", "200,100", "-o", "runs/{count}", cwd=folder)
    assert status == 0, error
    command_line(*ask, "-n", "100", "-o", "alone", "--no-view", cwd=folder)
    assert (folder / "runs/100/scene.ply").read_bytes() == (folder / "alone/scene.ply").read_bytes()
    assert (folder / "runs/200/report.html").exists()
    assert (folder / "runs/100/view.html").exists()
    assert not (folder / "alone/view.html").exists()


def test_resuming_a_finished_run_says_so(command_line: CommandLine, folder: Path) -> None:
    ask = ("distill", "ball.ply", "-r", 10, "-o", "run", "--steps", 5, "--size", 48)
    assert command_line(*ask, cwd=folder)[0] == 0
    before = (folder / "run" / "scene.ply").stat().st_mtime_ns
    status, _, error = command_line(*ask, "--resume", cwd=folder)
    assert (status, error.count("\n")) == (0, 1), error
    assert "run: finished already" in error
    assert (folder / "run" / "scene.ply").stat().st_mtime_ns == before
    ask = (
        "recover",
        "ball.ply",
        "--views",
        "views.json",
        "--teacher",
        "ball.ply",
        "--steps",
        3,
        "-o",
        "b.ply",
    )
    assert command_line(*ask, cwd=folder)[0] == 0
    status, _, error = command_line(*ask, "--resume", cwd=folder)
    assert status == 0
    assert "b.ply: finished already" in error


SHORT = ("distill", "ball.ply", "--steps", 5, "--size", 48)


def test_a_finished_run_is_not_taken_for_another(command_line: CommandLine, folder: Path) -> None:
    begin = (*SHORT, "-o", "run")
    ask = (*begin, "-r", 10)
    status, out, error = command_line(*ask, "--json", "-", cwd=folder)
    assert status == 0, error
    (folder / "ball.ply").rename(folder / "away.ply")  # what is refused is refused before the scene is read
    status, again, error = command_line(*ask, "--resume", "--json", "-", cwd=folder)
    assert status == 0, error
    ran, told = json.loads(out), json.loads(again)
    assert told["scores"] == ran["scores"]
    others = (
        ((*ask, "--seed", 3), "seed"),
        ((*ask, "--sh-degree", 0), "sh-degree"),
        ((*begin, "-r", 5), "budget"),
    )
    for other, words in others:
        status, _, error = command_line(*other, "--resume", cwd=folder)
        assert status == 1, error
        assert f"run: finished with other options ({words}); -w without --resume starts anew" in error
    (folder / "away.ply").rename(folder / "ball.ply")
    assert command_line(*SHORT, "-o", "run", "-n", 120, "--resume", cwd=folder)[0] == 0
    (folder / "run" / "report.json").unlink()
    status, _, error = command_line(*ask, "--resume", cwd=folder)
    assert (status, error) == (1, "g2ard: run: exists; give -w (--overwrite) to replace it\n")


def test_finished_folders_among_several_budgets_are_told_and_checked(
    command_line: CommandLine, folder: Path
) -> None:
    status, _, error = command_line(*SHORT, "-r", 10, "-o", "{ratio}x", cwd=folder)
    assert status == 0, error
    before = (folder / "10x" / "scene.ply").stat().st_mtime_ns
    ask = (*SHORT, "-r", "5,10", "-o", "{ratio}x", "--resume")
    status, _, error = command_line(*ask, "--seed", 1, cwd=folder)
    assert (status, "10x: finished with other options (seed)" in error) == (1, True), error
    assert not (folder / "5x").exists()
    status, out, error = command_line(*ask, "--json", "-", cwd=folder)
    assert status == 0, error
    assert "10x: finished already" in error
    assert "5x: nothing to go on from" in error
    assert [run["output_count"] for run in json.loads(out)["runs"]] == [240, 120]
    assert (folder / "10x" / "scene.ply").stat().st_mtime_ns == before


@needs_signals
def test_a_stopped_run_refuses_other_options_before_any_promise(
    command_line: CommandLine, folder: Path
) -> None:
    ask = ("distill", "ball.ply", "-r", 4, "-o", "run", "--size", 48)
    running = program(*ask, "--steps", 100_000, folder=folder, stderr=subprocess.PIPE)
    work = interrupt_at_checkpoint(running, folder)
    running.communicate(timeout=120)
    assert running.returncode == 130
    (folder / "ball.ply").rename(folder / "away.ply")
    for other, words in ((("--steps", 7), "steps"), (("-n", 77, "--steps", 100_000), "budget")):
        asked = ask if words == "steps" else (*ask[:2], *ask[4:])
        status, _, error = command_line(*asked, *other, "--resume", cwd=folder)
        assert (status, error.count("\n")) == (1, 1), error
        assert f"run: begun with other options ({words}); -w without --resume starts anew" in error
    g2ard.save(folder / "ball.ply", checkered_ball(1300))
    status, out, error = command_line("info", "run", cwd=folder)
    assert status == 0, error
    for words in ("stopped run", "simplified-1", "1,200 → 300", "ball.ply", "with --resume (-o run)"):
        assert words in out
    assert json.loads(command_line("info", "run", "--json", "-", cwd=folder)[1])["kept"]
    status, _, error = command_line(*ask, "--steps", 100_000, "--resume", cwd=folder)
    assert status == 1
    assert "goes on in" not in error
    assert list(work.glob("*.npz"))


def test_a_folder_has_one_scene(command_line: CommandLine, folder: Path) -> None:
    assert command_line(*SHORT, "-r", 10, "-o", "run", cwd=folder)[0] == 0
    status, _, error = command_line(*SHORT, "-r", 10, "-o", "run", "-w", "--format", "sog", cwd=folder)
    assert status == 0, error
    assert [path.name for path in (folder / "run").glob("scene*")] == ["scene.sog"]
    again = ("distill", "run/scene.sog", "-r", 2, "-o", "run", "-w", "--steps", 3)
    status, _, error = command_line(*again, cwd=folder)
    assert (status, "run/scene.sog would be written over, and is an input" in error) == (2, True), error


def _heed_interrupts() -> None:
    """Shells have what they start in the background ignore them, tests too."""
    signal.signal(signal.SIGINT, signal.SIG_DFL)


def program(*arguments: object, folder: Path, **pipes: int) -> subprocess.Popen[bytes]:
    root = Path(__file__).resolve().parents[1]
    path = os.pathsep.join(filter(None, [str(root), os.environ.get("PYTHONPATH")]))
    return subprocess.Popen(
        [sys.executable, "-m", "g2ard", *map(str, arguments)],
        cwd=folder,
        env={**os.environ, "PYTHONPATH": path},
        preexec_fn=_heed_interrupts if os.name == "posix" else None,
        **pipes,  # type: ignore[arg-type]
    )


def interrupt_at_checkpoint(
    running: subprocess.Popen[bytes], folder: Path, by: signal.Signals = signal.SIGINT
) -> Path:
    """A signal as soon as a run in `folder`/run has kept something; where that lies."""
    work = folder / "run" / ".unfinished"
    until = time.monotonic() + 120
    while not list(work.glob("[!.]*.npz")) and time.monotonic() < until:
        time.sleep(0.05)
    running.send_signal(by)
    return work


@pytest.mark.parametrize("stream", ["stdout", "stderr"])
def test_a_closed_pipe_loses_no_result(stream: str, folder: Path) -> None:
    """As under `| head -0`: the reader is gone before anything is said."""
    reader, writer = os.pipe()
    os.close(reader)
    quiet = {"stdout": subprocess.DEVNULL, "stderr": subprocess.PIPE, stream: writer}
    running = program(
        "simplify", "ball.ply", "-r", 5, "-o", "s.ply", "--json", "-", "-v", folder=folder, **quiet
    )
    os.close(writer)
    _, error = running.communicate(timeout=120)
    assert running.returncode == 0, error
    assert b"roken" not in (error or b"")
    assert len(g2ard.load(folder / "s.ply")) == 240


@needs_signals
@pytest.mark.parametrize(("by", "status"), [(signal.SIGINT, 130), (signal.SIGTERM, 143)])
def test_an_interrupt_says_what_was_kept(by: signal.Signals, status: int, folder: Path) -> None:
    ask = ("distill", "ball.ply", "-r", 4, "-o", "run", "--size", 48, "--steps", 100_000)
    running = program(*ask, folder=folder, stderr=subprocess.PIPE)
    interrupt_at_checkpoint(running, folder, by)
    _, error = running.communicate(timeout=120)
    assert running.returncode == status, error
    assert b"g2ard: interrupted; the same command with --resume goes on in run" in error


@needs_signals
def test_stopped_workers_leave_one_line(folder: Path) -> None:
    """Semaphores among them, which Python would tell of when the program is gone."""
    g2ard.save(folder / "large.ply", checkered_ball(20_000))
    ask = ("simplify", "large.ply", "-r", 4, "--tile-rows", "3k", "--workers", 2, "-o", "s.ply")
    running = program(*ask, folder=folder, stderr=subprocess.PIPE)
    assert running.stderr is not None
    while not (line := running.stderr.readline()).startswith(b"poses: "):  # workers begin to look
        assert line
    time.sleep(0.3)
    running.send_signal(signal.SIGTERM)
    error = running.stderr.read()
    assert running.wait(timeout=120) == 143, error
    assert error.endswith(
        b"g2ard: interrupted; what is done stands in .s.ply.tiles, and the same command goes on\n"
    )


def test_version_has_a_letter(command_line: CommandLine, folder: Path) -> None:
    assert command_line("-V", cwd=folder) == command_line("--version", cwd=folder)
    assert "--install-completion" in command_line("--help", cwd=folder)[1]


def test_completion_is_of_the_shell_that_is_named(command_line: CommandLine, folder: Path) -> None:
    for shell, words in (
        ("zsh", "#compdef g2ard"),
        ("fish", "complete --command g2ard"),
        ("bash", "complete -o"),
    ):
        status, out, error = command_line("--show-completion", shell, cwd=folder, apart=True)
        assert (status, error) == (0, "")
        assert words in out
    status, _, error = command_line("--show-completion", "tcsh", cwd=folder, apart=True)
    assert (status, error.count("\n"), "zsh" in error) == (2, 1, True), error


def photos_of(folder: Path, points: bool = False) -> None:
    """Photos of the ball with a transforms.json, and COLMAP-like points beside them if asked for."""
    views = around(24)
    (folder / "images").mkdir(parents=True)
    K = views.Ks[0]
    size = {"fl_x": K[0, 0], "fl_y": K[1, 1], "cx": K[0, 2], "cy": K[1, 2], "w": 64, "h": 48}
    transforms(folder / "transforms.json", list(views.viewmats), **size)
    for i in range(24):
        write_png(folder / "images" / f"{i:03d}.png", g2ard.render(BALL, views[i]).image)
    if points:
        colors = np.clip(0.5 + SH_C0 * BALL.sh0[:, 0], 0, 1).astype(np.float32)
        write_points(folder / "sparse.ply", Points(BALL.means.astype(np.float64), colors))
        listed = json.loads((folder / "transforms.json").read_text())
        (folder / "transforms.json").write_text(json.dumps({**listed, "ply_file_path": "sparse.ply"}))


@pytest.mark.parametrize("points", [False, True])
def test_photos_alone_are_enough(points: bool, command_line: CommandLine, tmp_path: Path) -> None:
    photos_of(tmp_path / "photos", points)
    ask = ("distill", "--views", "photos", "-o", "run", "--json", "-")
    status, out, error = command_line(*ask, "-n", 500, "--steps", 150, cwd=tmp_path)
    assert status == 0, error
    found = json.loads(out)
    assert (found["output_count"], found["against"]) == (500, "photos")
    assert found["scores"]["recovered"]["psnr"] > max(17, found["scores"]["simplified"]["psnr"] + 1)
    said = (
        "starts from 1,200 sparse points\n"
        if points
        else "starts from 500 points within the cameras' sight\n"
    )
    assert said in error
    ours = g2ard.distill(None, views=tmp_path / "photos", count=500, steps=150).splats
    g2ard.save(tmp_path / "ours.ply", ours)
    assert (tmp_path / "ours.ply").read_bytes() == (tmp_path / "run" / "scene.ply").read_bytes()
    status, _, error = command_line(*ask, "-r", 4, "--steps", 5, "-w", cwd=tmp_path)
    assert status == (0 if points else 1)
    assert points or "give a count, -n COUNT" in error
    status, _, error = command_line("distill", "-n", 500, "-o", "run", cwd=tmp_path)
    assert (status, "give a SCENE, or photos" in error) == (2, True)


def test_a_result_that_outweighs_the_photos_points_says_so(command_line: CommandLine, tmp_path: Path) -> None:
    photos_of(tmp_path / "photos", points=True)
    ask = ("distill", "--views", "photos", "-n", 900, "--steps", 3)
    error = command_line(*ask, "-o", "run", cwd=tmp_path)[2]
    assert "MB, the points, lifted as they are, have 0." in error, error
    light = command_line(*ask, "--sh-degree", 0, "-n", 300, "-o", "light", cwd=tmp_path)[2]
    assert "lifted as they are" not in light, light


def test_points_within_sight_lie_on_what_is_seen(tmp_path: Path) -> None:
    photos_of(tmp_path / "photos")
    cameras = g2ard.load_views(tmp_path / "photos")
    found = points_within_sight(cameras, 600)
    assert found.positions.shape == (600, 3)
    bright = found.colors.max(1) > 0.1  # the background is black everywhere, and everywhere agrees
    away = np.abs(np.linalg.norm(found.positions[bright], axis=1) - 1)
    assert np.median(away) < 0.15
    np.testing.assert_array_equal(found.positions, points_within_sight(cameras, 600).positions)


def test_a_result_that_outweighs_its_input_says_so(command_line: CommandLine, tmp_path: Path) -> None:
    photos_of(tmp_path / "photos", points=True)
    ask = ("distill", "photos/sparse.ply", "--views", "photos", "-n", 1000, "--steps", 3)
    error = command_line(*ask, "-o", "run", cwd=tmp_path)[2]
    assert (
        "run/scene.ply: 0.24 MB, sparse.ply has 0.03 MB: 76% of it is SH above degree 0 (--sh-degree" in error
    )
    g2ard.save(tmp_path / "ball.ply", BALL)
    assert "MB" not in command_line("simplify", "ball.ply", "-r", 2, "-o", "s.ply", cwd=tmp_path)[2]


def test_views_are_made_where_none_are_given(command_line: CommandLine, folder: Path) -> None:
    ask = ("render", "ball.ply", "--size", 64)
    status, _, error = command_line(*ask, "-n", 4, "--sheet", "a/look.png", cwd=folder)
    assert status == 0, error
    assert "4 images in a/look.png" in error
    with Image.open(folder / "a" / "look.png") as picture:
        assert picture.width > 128
    assert not (folder / "renders").exists()
    status, _, error = command_line("render", "ball.ply", "-n", 1, "-o", "renders", "--size", 32, cwd=folder)
    assert (status, "1 image in renders" in error) == (0, True), error
    assert len(list((folder / "renders").iterdir())) == 1
    command_line("simplify", "ball.ply", "-r", 5, "-o", "small.ply", cwd=folder)
    given = ("--teacher", "ball.ply", "--size", 48)
    status, out, error = command_line("evaluate", "small.ply", *given, "--json", "-", cwd=folder)
    assert status == 0, error
    before = json.loads(out)["scenes"][0]
    ask = ("recover", "small.ply", *given, "--steps", 60, "-o", "better.ply")
    status, _, error = command_line(*ask, cwd=folder)
    assert status == 0, error
    out = command_line("evaluate", "better.ply", *given, "--json", "-", cwd=folder)[1]
    after = json.loads(out)["scenes"][0]
    assert len(before["views"]) >= 20
    assert after["psnr"] > before["psnr"] + 1
    for command in (("evaluate", "small.ply"), ("recover", "small.ply", "-o", "x.ply")):
        status, _, error = command_line(*command, cwd=folder)
        assert (status, "--views, or a --teacher" in error) == (2, True)


def test_a_config_file_is_written_and_read_by_flags_names(command_line: CommandLine, folder: Path) -> None:
    ask = ("distill", "ball.ply", "-r", "5,10", "-o", "r{ratio}", "--views-count", "50%", "--steps", 4)
    ask = (*ask, "--size", 48, "--background", "0.5,0,1", "--set", "rates.means=1e-4")
    status, out, error = command_line(*ask, "--print-config", cwd=folder)
    assert status == 0, error
    assert not (folder / "r5").exists()
    for line in ("ratio = [5, 10]", 'views-count = "50%"', "steps = 4", "background = [0.5, 0, 1]"):
        assert line in out
    (folder / "c.toml").write_text(out)
    again = command_line("distill", "ball.ply", "--config", "c.toml", "--print-config", cwd=folder)
    assert again == (0, out, "")
    status, _, error = command_line("distill", "ball.ply", "--config", "c.toml", cwd=folder)
    assert status == 0, error
    assert "views: 70 of 140" in error or "views: " in error
    assert (folder / "r10" / "scene.ply").exists()


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ("[simplfy]\nratio = 10", "no command is called simplfy"),
        ("[simplify]\nrato = 10", "no option of `simplify` is called rato"),
        ("rato = 10", "no option of `simplify` is called rato"),
        ("simplify = 10", "simplify"),
        ("[simplify]\nratio = 0.5", "0.5"),
    ],
)
def test_a_config_file_is_never_ignored(
    text: str, words: str, command_line: CommandLine, folder: Path
) -> None:
    (folder / "c.toml").write_text(text)
    ask = ("simplify", "ball.ply", "-o", "s.ply", "--config", "c.toml")
    status, _, error = command_line(*ask, cwd=folder)
    assert (status, words in error, error.count("\n")) == (2, True, 1), error


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ("ratio = 5\nstepz = 7\n[recover]\nsteps = 9", "no command it is for has an option stepz"),
        ("ratio = 5\n[distill]\nnonsense = 1", "no option of `distill` is called nonsense"),
    ],
)
def test_other_commands_tables_are_checked_too(
    text: str, words: str, command_line: CommandLine, folder: Path
) -> None:
    (folder / "c.toml").write_text(text)
    status, _, error = command_line("simplify", "ball.ply", "-o", "s.ply", "--config", "c.toml", cwd=folder)
    assert (status, words in error, error.count("\n")) == (2, True, 1), error


def test_tables_and_what_stands_above_them(command_line: CommandLine, folder: Path) -> None:
    (folder / "c.toml").write_text("seed = 5\nsize = 64\n[simplify]\nratio = [10]\n[render]\nsplit = 'test'")
    status, out, error = command_line(
        "simplify", "ball.ply", "-o", "s.ply", "--config", "c.toml", "--json", "-", cwd=folder
    )
    assert status == 0, error
    found = json.loads(out)
    assert (found["output_count"], found["config"]["seed"]) == (120, 5)


def test_info_of_several_files_and_of_a_run(command_line: CommandLine, folder: Path) -> None:
    command_line("distill", "ball.ply", "-r", 10, "-o", "run", "--steps", 4, "--size", 48, cwd=folder)
    status, out, error = command_line("info", "ball.ply", "views.json", "run", "--json", "-", cwd=folder)
    assert status == 0, error
    scene, views, made = json.loads(out)["files"]
    assert (scene["kind"], views["kind"], made["count"]) == ("splats", "views", 120)
    assert made["run"]["input_count"] == 1200
    assert made["run"]["scores"]["recovered"]["psnr"] > 10
    assert "made from" in command_line("info", "run", cwd=folder)[1]


@pytest.mark.parametrize(
    ("text", "counts"),
    [("1,000", [1000]), ("1_100", [1100]), ("300", [300]), ("0.2k,10%", [200, 120]), ("200,100", [200, 100])],
)
def test_counts_take_separators(text: str, counts: list[int]) -> None:
    assert [count.of(1200) for count in Counts.parse(text)] == counts


def test_several_counts_are_named_by_count(command_line: CommandLine, folder: Path) -> None:
    status, _, error = command_line("simplify", "ball.ply", "-n", "200,100", "-o", "s.ply", cwd=folder)
    assert (status, "such as s_{count}.ply; one number has no commas, or reads 10_000" in error) == (2, True)
    status, _, error = command_line("simplify", "ball.ply", "-n", "1,000", "-o", "s.ply", cwd=folder)
    assert (status, "1,000 of 1,200 Gaussians" in error) == (0, True), error


def test_a_lift_that_outweighs_its_cloud_says_so(command_line: CommandLine, folder: Path) -> None:
    colors = np.full((1200, 3), 0.5, np.float32)
    write_points(folder / "cloud.ply", Points(BALL.means.astype(np.float64), colors))
    status, _, error = command_line("lift", "cloud.ply", "-o", "lift.ply", cwd=folder)
    assert (status, "lift.ply: 0.07 MB, cloud.ply has 0.03 MB: packed formats" in error) == (0, True), error


def test_a_short_run_has_no_needless_notes(command_line: CommandLine, folder: Path) -> None:
    status, _, error = command_line(*SHORT, "-r", 10, "-o", "run", cwd=folder)
    assert status == 0, error
    assert "poses: 160, orbit; which way is up is a guess\n" in error
    for needless in ("never acted", "of its box", "times as high"):
        assert needless not in error
    assert "never acted" in command_line(*SHORT, "-r", 10, "-o", "run", "-wv", cwd=folder)[2]


def test_a_run_killed_before_it_kept_anything_is_in_nobodys_way(
    command_line: CommandLine, folder: Path
) -> None:
    work = folder / "run" / ".unfinished"
    work.mkdir(parents=True)
    (work / "options.json").write_text("{}")
    status, _, error = command_line(*SHORT, "-r", 10, "-o", "run", "--resume", cwd=folder)
    assert (status, "nothing to go on from: starts anew" in error) == (0, True), error


def test_the_wrong_kind_of_input_is_told_what_takes_it(command_line: CommandLine, folder: Path) -> None:
    photos_of(folder / "photos", points=True)
    for ask, words in (
        (("distill", "photos", "-n", 100, "-o", "x"), "photos holds views, no scene: give it as --views"),
        (("simplify", "photos/sparse.ply", "-r", 2, "-o", "x.ply"), "`g2ard lift` makes a scene of it"),
    ):
        status, _, error = command_line(*ask, cwd=folder)
        assert (status != 0, words in error, error.count("\n")) == (True, True, 1), error
