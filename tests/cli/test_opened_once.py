"""Each scene or point cloud that a command is given is looked into once, and opened once."""

import shlex
from collections import Counter
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest

from g2ard.cli import app
from g2ard.io import detect
from g2ard.io.source import Source
from helpers.calls import CALLS
from helpers.commands import CommandLine, succeeds

READING = {
    **CALLS,
    "info": "info ball.ply cloud.ply",
    "lifted": "simplify cloud.ply -r 4 --no-views -o lifted.ply",
    **{
        f"{name}, planned": f"{CALLS[name]} --dry-run"
        for name in ("distill", "distill tiles", "simplify", "simplify tiles", "recover", "lod")
    },
}


def test_every_command_is_here() -> None:
    assert {words.split()[0] for words in READING.values()} == set(app.COMMANDS)


@pytest.mark.parametrize("words", READING.values(), ids=READING)
def test_an_input_is_opened_once(
    words: str, work: Path, inputs: Path, command_line: CommandLine, monkeypatch: pytest.MonkeyPatch
) -> None:
    looked, opened = Counter[str](), Counter[str]()

    def counted(read: Callable[..., Any], found: Counter[str], path_of: Callable[..., Path]) -> Any:
        def counting(*given: Any) -> Any:
            found[path_of(*given).resolve().name] += 1
            return read(*given)

        return counting

    uncached = detect._of_file.__wrapped__
    monkeypatch.setattr(detect, "_of_file", counted(uncached, looked, lambda path, *_: path))
    opening = Source._opened
    monkeypatch.setattr(Source, "_opened", counted(opening, opened, lambda source, _: source.file))
    succeeds(command_line, work, *shlex.split(words))
    given = Counter(word for word in shlex.split(words) if word.endswith(".ply") and (inputs / word).exists())
    assert given
    for name, times in given.items():  # a scene may be the teacher too
        assert (looked[name], opened[name]) == (times, times), name
