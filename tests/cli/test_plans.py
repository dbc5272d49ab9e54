"""The stages that commands expect, from which the time that the whole command needs is estimated."""

from itertools import groupby
from pathlib import Path

import pytest

import g2ard
from g2ard.cli.console import Console
from helpers.commands import CommandLine, succeeds
from helpers.scenes import around, checkered_ball

TRAIN = "--views views.json --size 24 --steps 3"
COMMANDS = [
    "simplify ball.ply -r 4,8 -o small_{ratio}.ply",
    "compare ball.ply ball.ply -o page.html --size 48 -k 4",
    f"lod ball.ply -r 1,2,4 {TRAIN} -o lod",
    "lod ball.ply -r 2,4 --views views.json --size 24 --merge-only -o lod",
    f"distill ball.ply -r 8 {TRAIN} -o run",
    f"recover small.ply {TRAIN} --teacher ball.ply -o better.ply",
    "simplify ball.ply -r 4 --views views.json --tile-rows 100 --workers 1 -o tiled.ply",
    f"distill ball.ply -r 8 {TRAIN} --focus far --tile-rows 100 --workers 1 -o run",
    "clean ball.ply --preview found.png -o clean.ply",
]


@pytest.mark.parametrize("command", COMMANDS)
def test_expected_stages_come_in_order(
    command: str, tmp_path: Path, command_line: CommandLine, monkeypatch: pytest.MonkeyPatch
) -> None:
    ball = checkered_ball(300)
    g2ard.save(tmp_path / "ball.ply", ball)
    g2ard.save(tmp_path / "small.ply", g2ard.simplify(ball, count=30).splats)
    g2ard.save_views(tmp_path / "views.json", around(16, (48, 36)))
    planned: list[str] = []
    met: list[str] = []
    tell = Console.__call__

    def told(self: Console, stage: str, *more: object) -> None:
        if met[-1:] != [stage]:
            met.append(stage)
        tell(self, stage, *more)  # type: ignore[arg-type]

    monkeypatch.setattr(Console, "__call__", told)
    monkeypatch.setattr(Console, "expect", lambda self, stages: planned.extend(name for name, _ in stages))
    succeeds(command_line, tmp_path, *command.split())
    optional = ["poses"] if "--views" in command else []
    rest = iter(met)
    stages = [name for name, _ in groupby(planned)]  # each run of a stage was met once
    missed = [name for name in stages if name not in optional and name not in rest]
    assert planned
    assert not missed, (planned, met)
