"""`--resume` on a run that has finished, or that was interrupted with other options."""

from __future__ import annotations

import json
import subprocess
from pathlib import Path

import g2ard
from helpers.commands import CommandLine, interrupt_at_checkpoint, program
from helpers.scenes import checkered_ball
from helpers.systems import needs_signals


def test_resuming_a_finished_run_says_so(command_line: CommandLine, folder: Path) -> None:
    ask = ("distill", "ball.ply", "-r", 10, "-o", "run", "--steps", 5, "--size", 48)
    assert command_line(*ask, cwd=folder)[0] == 0
    before = (folder / "run" / "scene.ply").stat().st_mtime_ns
    status, _, error = command_line(*ask, "--resume", cwd=folder)
    assert (status, error.count("\n")) == (0, 1), error
    assert "run: already finished" in error
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
    assert "b.ply: already finished" in error


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
        ((*ask, "--set", "sh_degree=0"), "set"),
        ((*begin, "-r", 5), "budget"),
    )
    for other, words in others:
        status, _, error = command_line(*other, "--resume", cwd=folder)
        assert status == 1, error
        assert f"run: finished with other options ({words}); -w without --resume starts over" in error
    (folder / "away.ply").rename(folder / "ball.ply")
    assert command_line(*SHORT, "-o", "run", "-n", 40, "--resume", cwd=folder)[0] == 0
    (folder / "run" / "report.json").unlink()
    status, _, error = command_line(*ask, "--resume", cwd=folder)
    assert (status, error) == (1, "g2ard: run: exists; -w (--overwrite) replaces it\n")


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
    assert "10x: already finished" in error
    assert "5x: nothing to resume" in error
    assert [run["output_count"] for run in json.loads(out)["runs"]] == [80, 40]
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
        assert f"run: begun with other options ({words}); -w without --resume starts over" in error
    g2ard.save(folder / "ball.ply", checkered_ball(1300))
    status, out, error = command_line("info", "run", cwd=folder)
    assert status == 0, error
    for words in ("stopped run", "simplified-1", "400 → 100", "ball.ply", "with --resume (-o run)"):
        assert words in out
    assert json.loads(command_line("info", "run", "--json", "-", cwd=folder)[1])["kept"]
    status, _, error = command_line(*ask, "--steps", 100_000, "--resume", cwd=folder)
    assert status == 1
    assert "--resume to continue" not in error
    assert list(work.glob("*.npz"))


def test_a_run_killed_before_it_kept_anything_is_in_nobodys_way(
    command_line: CommandLine, folder: Path
) -> None:
    work = folder / "run" / ".unfinished"
    work.mkdir(parents=True)
    (work / "options.json").write_text("{}")
    status, _, error = command_line(*SHORT, "-r", 10, "-o", "run", "--resume", cwd=folder)
    assert (status, "nothing to resume, starting over" in error) == (0, True), error
