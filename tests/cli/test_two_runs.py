"""Two runs with one output: one writes it, the other fails."""

from collections.abc import Callable
from pathlib import Path
from pkgutil import resolve_name
from typing import Any

import pytest

from helpers.commands import CommandLine

VIEWED = "--views views.json"
TRAIN = f"{VIEWED} --teacher ball.ply --steps 2"
COMMANDS = {
    f"distill ball.ply -r 8 {VIEWED} --steps 2 --no-page -o run": "g2ard.jobs.distill.DistillJob.run",
    f"recover ball.ply {TRAIN} -o out.ply": "g2ard.jobs.recover.RecoverJob.run",
    f"adapt ball.ply {TRAIN} -o out.ply": "g2ard.pipeline.adapt.adapt",
    "lod ball.ply -r 4,8 --merge-only --views views.json -o levels": "g2ard.jobs.levels.preparing_levels",
    "simplify ball.ply -r 8 --no-views -o out.ply": "g2ard.cli.run.write_scene",
    "select ball.ply --views views.json -k 3 -o out.json": "g2ard.cli.run.write_views",
    "render ball.ply --views views.json -o out": "g2ard.rendering.renderer.Renderer.image",
}
"""Command → the function in it that begins another run of the same command."""


@pytest.mark.parametrize("words", COMMANDS)
def test_one_of_two_runs_writes_the_output(
    words: str, folder: Path, command_line: CommandLine, monkeypatch: pytest.MonkeyPatch
) -> None:
    name, others = COMMANDS[words], []
    real: Callable[..., Any] = resolve_name(name)

    def interrupted(*given: Any, **named: Any) -> Any:
        if not others:
            others.append(None)
            others[0] = command_line(*words.split(), cwd=folder)
        return real(*given, **named)

    monkeypatch.setattr(name, interrupted)
    first = command_line(*words.split(), cwd=folder)
    done = [first, others[0]]
    assert sorted(status for status, _, _ in done) == [0, 1], done
    refused = next(error for status, _, error in done if status)
    output = words.split()[-1]
    assert f"{output}: in use by process" in refused or f"{output}: exists; -w" in refused, refused
    assert not list(folder.glob("**/*.lock"))
