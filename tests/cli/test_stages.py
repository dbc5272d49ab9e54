"""Stages of progress: kernels run within one, so that the live line says on what a command works."""

from collections.abc import Callable
from pathlib import Path
from types import BuiltinFunctionType
from typing import Any

import pytest

from g2ard import _core
from g2ard.cli.console import Console
from helpers.commands import CommandLine, succeeds
from helpers.writing_commands import COMMANDS, write_inputs

CHEAP = {"device_notes", "device_state", "set_device", "set_threads", "num_threads", "defaults", "worker"}
"""Functions of the core that only read or set its state."""

MORE = [
    "distill ball.ply -r 8 --views made --steps 2 --size 24 -o made",
    "distill cloud.ply -r 8 --views photos.json --steps 2 -o photos",
    "distill ball.ply -r 8 --views made --tile-rows 150 --workers 1 --steps 2 --size 24 -o parts",
    "simplify ball.ply -r 8 -o merged.ply",
    "simplify ball.ply --min-psnr 25 -o good.ply",
    "simplify cloud.ply -r 4 -o discs.ply",
    "simplify ball.ply -r 8 --tile-rows 150 --workers 1 -o parts.ply",
    "lod ball.ply -r 4 --steps 2 --size 24 -o streamed",
    "compare ball.ply other.ply -k 3 --size 24 -o compared.html",
    "evaluate other.ply --teacher ball.ply --views views.json",
    "info ball.ply",
]


@pytest.fixture(scope="module")
def inputs(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("stages")
    write_inputs(folder)
    return folder


@pytest.fixture
def seen(monkeypatch: pytest.MonkeyPatch) -> tuple[set[str], set[str]]:
    """Return the kernels that run within a stage, and those that run outside with the stage before, as found
    by the commands to come."""
    consoles: list[Console] = []
    inside: set[str] = set()
    outside: set[str] = set()

    def noted(name: str, kernel: Callable[..., Any]) -> Callable[..., Any]:
        def call(*arguments: Any, **named: Any) -> Any:
            stage = consoles[-1]._stage if consoles else None
            if stage is None or stage.ended is not None:
                outside.add(f"{name} after {stage and stage.name}")
            else:
                inside.add(name)
            return kernel(*arguments, **named)

        return call

    for name, kernel in list(vars(_core).items()):
        if isinstance(kernel, BuiltinFunctionType) and name not in CHEAP:
            monkeypatch.setattr(_core, name, noted(name, kernel))
    enter = Console.__enter__
    monkeypatch.setattr(Console, "__enter__", lambda self: consoles.append(self) or enter(self))
    return inside, outside


@pytest.mark.parametrize("command", [*COMMANDS.values(), *MORE])
def test_kernels_run_within_a_stage(
    command: str, inputs: Path, command_line: CommandLine, seen: tuple[set[str], set[str]]
) -> None:
    succeeds(command_line, inputs, *command.split(), "-w")
    inside, outside = seen
    assert outside == set()
    if command.startswith("simplify") and "--tile-rows" not in command:
        assert "simplify_pairwise" in inside
