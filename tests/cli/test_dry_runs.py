"""Dry runs look at sizes and counts alone: they draw, merge and train nothing."""

import shlex
from pathlib import Path
from typing import Any

import pytest

import g2ard._core as _core
from g2ard.cli import app
from helpers.calls import CALLS, ON, options_of
from helpers.commands import CommandLine, succeeds

KERNELS = ("Trainer", "VisibilityAccumulator", "TileMerging", "accumulate", "accumulate_each")
KERNELS += ("cast_rays", "simplify_flags", "simplify_paper", "simplify_pairwise")
"""Kernels that measure coverage, plan poses, merge or train."""

FEW = 15
"""Images of 160 pixels that tell whether photos show the scene."""

PLANNED = {name: words for name, words in CALLS.items() if "dry_run" in options_of(name)}
"""Calls of commands with a dry run."""

CASES = {
    **PLANNED,
    "generated views": "distill ball.ply -r 8 -o out",
    "a quality": "distill ball.ply --min-psnr 25 -o out",
    "bytes": "distill ball.ply --fit 9kB --format sog -o out",
    "a page": "distill ball.ply --fit page:3MB -o out",
    "a device": "distill ball.ply --fit quest3 -o out",
    "nothing to do": "distill ball.ply --fit web -o out",
    "removing clutter": "distill stray.ply -r 2 --clean -o out",
    "a cloud": "distill scan.las -r 4 -o out",
    "points with photos": "distill cloud.ply -r 4 --views photos.json -o out",
    "photos alone": "distill --views photos.json -o out",
    "photos of a scene": "distill ball.ply -r 4 --views photos.json --photos -o out",
    "weighing in generated views": "simplify ball.ply -r 8 -o out.ply",
    "merging bytes": "simplify ball.ply --fit 9kB -o out.spz",
    "merging to a quality": "simplify ball.ply --min-ssim 0.9 -o out.ply",
    "generated views of levels": "lod ball.ply -r 1,4 -o out",
    "levels that are merged": "lod ball.ply -r 1,4 --merge-only -o out",
    "a teacher's views": "recover small.ply --teacher ball.ply -o out.ply",
    "photos to recover in": "recover small.ply --views photos.json -o out.ply",
    "photos to adapt to": ON["adapt"]["alpha"],
}


@pytest.mark.parametrize("words", CASES.values(), ids=CASES)
def test_a_dry_run_runs_no_kernel(
    words: str, work: Path, command_line: CommandLine, monkeypatch: pytest.MonkeyPatch
) -> None:
    before = sorted(work.rglob("*"))
    for name in KERNELS:

        def kernel(*_: Any, name: str = name, **__: Any) -> None:
            pytest.fail(f"a dry run calls {name}")

        monkeypatch.setattr(_core, name, kernel)
    drawn = []

    class Counted:
        def __init__(self, *given: Any) -> None:
            self._own = rasterizer(*given)

        def __getattr__(self, name: str) -> Any:
            drawn.append(name)
            return getattr(self._own, name)

    rasterizer = _core.Rasterizer
    monkeypatch.setattr(_core, "Rasterizer", Counted)
    told = succeeds(command_line, work, *shlex.split(words), "--dry-run", "--json", "-")
    assert "nothing is written" in told.err
    assert sorted(work.rglob("*")) == before
    assert len(drawn) <= FEW * ("photos" in words)


def test_every_command_with_a_dry_run_is_here() -> None:
    planned = {name for name in app.COMMANDS if "dry_run" in options_of(name)}
    assert planned == {name.split()[0] for name in PLANNED}


def test_a_dry_run_is_close_to_its_run(work: Path, command_line: CommandLine) -> None:
    """The views of a dry run are stand-ins of as many that are generated."""
    import json

    ask = (
        "distill",
        "ball.ply",
        "-r",
        8,
        "--steps",
        60,
        "--size",
        32,
        "--no-page",
        "-o",
        "run",
        "--json",
        "-",
    )
    told = json.loads(succeeds(command_line, work, *ask, "--dry-run").out)
    ran = json.loads(succeeds(command_line, work, *ask).out)
    assert (told["count"], told["steps"]) == (ran["output_count"], 60)
    scored = sum(kind["views"] for kind in ran["kinds"] if "2×" not in kind["kind"])
    assert scored <= told["views"] <= 6 * scored
