"""Nothing finished is lost: whatever fails after a result is written, the result stays and is named."""

import json
import re
import shutil
from collections.abc import Callable
from pathlib import Path
from pkgutil import resolve_name
from typing import Any

import numpy as np
import pytest
from PIL import Image

import g2ard
from g2ard.io import write_views
from helpers.calls import CALLS, WRITING, output_of
from helpers.commands import CommandLine, refused, succeeds
from helpers.faults import INJECTED, stages_after
from helpers.photos import photographed
from helpers.scenes import around, checkered_ball

SLOW = {
    "distill": ("g2ard.jobs.distill.prepare", "g2ard.jobs.distill_job.DistillJob.run"),
    "clean": ("g2ard.jobs.clean.clean",),
    "lod": ("g2ard.jobs.levels.lod",),
    "register": ("g2ard.stages.register.register",),
}
"""Functions before the first output; they are called once, because only what follows is tested."""
SAME_ENDS = (
    "distill tiles",
    "recover a folder",
    "ingest a cloud",
    "lod with recovery",
    "lod tiles",
)
"""Calls that end like another one of their command."""


def _once(function: Callable[..., Any]) -> Callable[..., Any]:
    made: list[Any] = []

    def remembered(*given: Any, **named: Any) -> Any:
        made.extend([] if made else [function(*given, **named)])
        return made[0]

    return remembered


@pytest.mark.parametrize("name", [name for name in WRITING if name not in SAME_ENDS])
def test_a_failure_after_the_result_loses_nothing(
    name: str,
    inputs: Path,
    tmp_path: Path,
    command_line: CommandLine,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    words, output = [*CALLS[name].split(), "--json", "told.json"], output_of(name)
    # all imported unpatched
    slow = {path: resolve_name(path) for paths in SLOW.values() for path in paths}
    for path in SLOW.get(words[0], ()):
        monkeypatch.setattr(path, _once(slow[path]))
    shutil.copytree(inputs, tmp_path / "0")
    with stages_after(tmp_path / "0" / output) as stages:
        succeeds(command_line, tmp_path / "0", *words)
    assert "g2ard.io.atomic.atomic_output" in stages  # --json comes last
    for number, stage in enumerate(stages, 1):
        folder = shutil.copytree(inputs, tmp_path / str(number))
        with stages_after(folder / output, failing=stage):
            status, _, error = command_line(*words, cwd=folder)
        *_, line = error.splitlines()
        assert (status, line[:7]) == (1, "g2ard: "), (stage, error)
        assert INJECTED in line, (stage, error)
        place = re.escape(re.sub("/(lod-meta|tiles|tileset).json", "", output))
        assert re.search(rf"{place} is written|{place.partition('/')[0]} is finished", line), (
            stage,
            error,
        )
        for path in [folder / output, *(folder / output).glob("*")][-1:]:
            assert path.read_bytes() == (tmp_path / "0" / path.relative_to(folder)).read_bytes(), (
                stage
            )


def test_a_run_whose_scores_failed_is_resumed(
    inputs: Path, tmp_path: Path, command_line: CommandLine, monkeypatch: pytest.MonkeyPatch
) -> None:
    folder = shutil.copytree(inputs, tmp_path / "inputs")
    ask = (
        "distill",
        "ball.ply",
        "-r",
        8,
        "--steps",
        2,
        "--views",
        "views.json",
        "--no-page",
        "-o",
        "run",
    )
    ask = (*ask, "--focus", "far")
    with stages_after(folder / "run" / "scene.ply", failing="g2ard.jobs.scoring.describe_run"):
        line = refused(command_line, folder, *ask, "-q", status=1)
    assert line == (
        f"g2ard: scoring failed: {INJECTED}; run/scene.ply is written; "
        "run the same command with --resume to continue in run\n"
    )
    monkeypatch.setattr("g2ard.pipeline.steps.recover", None)  # it is not run again
    succeeds(command_line, folder, *ask, "--resume")
    assert sorted(path.name for path in (folder / "run").iterdir()) == [
        *("preview.png", "report.html", "report.json", "scene.ply", "scored.json", "views.json"),
    ]


@pytest.mark.parametrize(
    "command", ["distill ball.ply -r 8 --no-page", "recover ball.ply", "evaluate ball.ply"]
)
def test_a_photo_without_valid_pixels_is_not_scored(
    command: str, tmp_path: Path, command_line: CommandLine
) -> None:
    ball = checkered_ball(400)
    g2ard.save(tmp_path / "ball.ply", ball)
    views = photographed(tmp_path, ball, around(16, (48, 36)))
    for path, transparent in zip(views.image_paths, TRANSPARENT, strict=True):
        assert path is not None
        with Image.open(path) as photo:
            photo.putalpha(0 if transparent else 255)
            photo.save(path)
    write_views(tmp_path / "photos.json", views)
    words = [*command.split(), "--views", "photos.json", "--alpha", "mask"]
    if "evaluate" not in command:
        output = "out" if command.startswith("distill") else "out.ply"
        words += ["--steps", "3", "-o", output, "--json", "told.json"]
    error = succeeds(command_line, tmp_path, *words).err
    assert "1 photo not scored: the mask leaves no pixel" in error
    if "evaluate" not in command:
        told = json.loads((tmp_path / "told.json").read_text())
        assert [kind["views"] for kind in told["kinds"]] == [1]


TRANSPARENT = np.isin(np.arange(16), [1, 8])  # a view for training, and one of two held-out ones
