"""Checkpoints of interrupted runs: resumed, rejected, or replaced with -w."""

import io
import json
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from g2ard.errors import InputError
from g2ard.io import write_splats, write_views
from g2ard.jobs import scoring
from g2ard.jobs.distill_job import DistillJob
from g2ard.pipeline.distill import Distilled
from g2ard.rendering.targets import TeacherRenders
from g2ard.stages.recover import checkpoint
from helpers.commands import CommandLine, refused, succeeds
from helpers.scenes import around, checkered_ball

LEFT = [
    ("recover a.ply --steps 3 -o out.ply", ".out.ply.checkpoint.npz"),
    ("adapt a.ply --steps 3 -o out.ply", ".out.ply.work/stretch-1-0123456789abcdef.npz"),
    (
        "distill a.ply -r 2 --steps 3 --focus far --no-page -o run",
        "run/.unfinished/simplified-1-0123456789abcdef.npz",
    ),
]


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    ball = checkered_ball(200)
    write_splats(tmp_path / "a.ply", ball)
    write_splats(tmp_path / "t.ply", replace(ball, sh0=ball.sh0 / 2))
    write_views(tmp_path / "views.json", around(16, (32, 24)))
    return tmp_path


@pytest.mark.parametrize(("command", "left"), LEFT)
def test_checkpoints_are_kept(
    folder: Path, command_line: CommandLine, command: str, left: str
) -> None:
    teacher = () if command.startswith("distill") else ("--teacher", "t.ply")
    ask = (*command.split(), "--views", "views.json", *teacher)
    place = folder / left
    place.parent.mkdir(parents=True, exist_ok=True)
    place.write_bytes(b"junk")
    words = "left by an interrupted run; --resume continues it, -w starts over"
    assert words in refused(command_line, folder, *ask, "-q", status=1)
    assert place.read_bytes() == b"junk"
    succeeds(command_line, folder, *ask, "-w")
    assert not place.exists()
    assert not list(folder.glob(".*"))


def bytes_of(save: Callable[[io.BytesIO], None]) -> bytes:
    buffer = io.BytesIO()
    save(buffer)
    return buffer.getvalue()


@pytest.mark.parametrize(
    "content",
    [
        b"",
        b"junk",
        b"PK\x03\x04 no zip",
        bytes_of(lambda file: np.save(file, np.arange(3))),
        bytes_of(lambda file: np.savez(file, a=np.arange(3))),
        bytes_of(lambda file: np.savez(file, meta=np.array("[1]"))),
        bytes_of(lambda file: np.savez(file, meta=np.array("{}"))),
        bytes_of(lambda file: np.savez(file, meta=np.array([{}], object))),
    ],
)
def test_a_file_that_is_not_a_checkpoint_is_named(tmp_path: Path, content: bytes) -> None:
    path = tmp_path / "c.npz"
    path.write_bytes(content)
    with pytest.raises(InputError) as caught:
        checkpoint.load(path, "key")
    assert str(caught.value).startswith(f"{path}: not a checkpoint of g2ard, or a damaged one; ")


@pytest.mark.parametrize("options", [("--set", "select.views_count=2"), ("--views", "v.json")])
def test_a_recovered_run_renders_only_views_that_are_scored(
    folder: Path,
    command_line: CommandLine,
    monkeypatch: pytest.MonkeyPatch,
    options: tuple[str, ...],
) -> None:
    rendered: list[str] = []
    make, score = TeacherRenders._make, scoring.describe_run

    def counting(self: TeacherRenders, view: int) -> Any:
        rendered.append(self.cameras.names[view])
        return make(self, view)

    def stopped(*given: Any) -> Any:
        raise KeyboardInterrupt

    monkeypatch.setattr(TeacherRenders, "_make", counting)
    write_views(folder / "v.json", around(8, (32, 24)))
    ask = ("distill", "a.ply", "-r", 2, "--steps", 3, "--size", 24, "--no-page", *options)
    succeeds(command_line, folder, *ask, "-o", "whole")
    every = set(rendered)
    monkeypatch.setattr(scoring, "describe_run", stopped)
    assert command_line(*ask, "-o", "run", cwd=folder)[0] == 130
    monkeypatch.setattr(scoring, "describe_run", score)
    rendered.clear()
    succeeds(command_line, folder, *ask, "-o", "run", "--resume")
    report = json.loads((folder / "run" / "report.json").read_text())
    scores = (report["scores"], report["apart"] or report["scores"])
    scored = {view["name"] for part in scores for view in part["recovered"]["views"]}
    # and those of preview.png
    assert set(rendered) - {"view_0000", "view_0001", "view_0002"} == scored
    assert scored < every
    assert (folder / "run" / "scene.ply").read_bytes() == (
        folder / "whole" / "scene.ply"
    ).read_bytes()


def test_the_total_of_a_resumed_run_holds_what_was_done_before(
    folder: Path, command_line: CommandLine, monkeypatch: pytest.MonkeyPatch
) -> None:
    real = DistillJob.run

    def resumed(self: DistillJob, *given: Any, **named: Any) -> Distilled:
        done = real(self, *given, **named)
        seconds = replace(
            done.report.seconds, recover=done.report.seconds.recover + 50, resumed=50.0
        )
        return replace(done, report=replace(done.report, seconds=seconds))

    monkeypatch.setattr(DistillJob, "run", resumed)
    ask = (
        "distill",
        "a.ply",
        "-r",
        2,
        "--views",
        "views.json",
        "--steps",
        2,
        "--focus",
        "far",
        "--no-page",
    )
    ask = (*ask, "-o", "run", "--json", "-")
    out, error = succeeds(command_line, folder, *ask)
    seconds = json.loads(out)["seconds"]
    assert seconds["total"] > seconds["resumed"] == 50.0
    stages = {name: value for name, value in seconds.items() if name not in ("resumed", "total")}
    assert seconds["total"] == pytest.approx(sum(stages.values()))
    assert min(stages.values()) >= 0
    told = ", ".join(
        f"{name} {value:.1f} s" for name, value in seconds.items() if name != "resumed"
    )
    assert f"; {told}" in " ".join((out + error).split())


def test_a_resumed_command_that_kept_nothing_says_so(
    command_line: CommandLine, folder: Path
) -> None:
    words = (
        "recover a.ply --views views.json --teacher t.ply --steps 2 --size 24 -o new.ply --resume"
    )
    assert (
        "new.ply: nothing to resume, starting over"
        in succeeds(command_line, folder, *words.split()).err
    )
