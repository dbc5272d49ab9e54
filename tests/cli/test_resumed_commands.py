"""Every command with --resume: which outputs it finds finished, and what it does with half-written files."""

import os
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
from typer.main import get_command

import g2ard
from g2ard.cli.app import app, register_commands
from g2ard.io import write_views
from g2ard.stages.recover import checkpoint
from g2ard.tiles import tasks
from helpers.commands import CommandLine, refused, succeeds
from helpers.scenes import around, checkered_ball

_VIEWED = "--views views.json --size 24 --steps 4"
_TILED = "--tile-rows 100 --workers 1"
COMMANDS = {
    "recover": f"recover small.ply {_VIEWED} --teacher ball.ply -o out.ply",
    "recover a folder": f"recover small.ply {_VIEWED} --teacher ball.ply -o out/meta.json",
    "adapt": f"adapt small.ply {_VIEWED} --teacher ball.ply -o out.ply",
    "distill": f"distill ball.ply -n 60 {_VIEWED} --no-page -o out",
    "distill tiles": f"distill ball.ply -n 60 {_VIEWED} --no-page --focus far {_TILED} -o out",
    "lod": f"lod ball.ply -r 1,4 {_VIEWED} -o out",
    "lod tiles": f"lod ball.ply -r 1,4 {_VIEWED} {_TILED} -o out",
}
"""Name, which begins with the command → arguments."""


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    g2ard.save(tmp_path / "ball.ply", checkered_ball(200))
    g2ard.save(tmp_path / "small.ply", checkered_ball(60, seed=7))
    write_views(tmp_path / "views.json", around(8, (32, 24)))
    return tmp_path


def scenes(folder: Path) -> dict[str, bytes]:
    """Return the output's files without reports, pages and pictures, which hold times."""
    apart = (".json", ".html", ".png")
    files = [path for path in folder.glob("out*/**/*") if path.is_file()] + list(folder.glob("out.*"))
    return {
        path.relative_to(folder).as_posix(): path.read_bytes() for path in files if path.suffix not in apart
    }


def test_no_command_is_missing() -> None:
    register_commands()
    every = get_command(app).commands  # type: ignore[attr-defined]
    resuming = {name for name, one in every.items() if "resume" in {param.name for param in one.params}}
    assert resuming == {name.split()[0] for name in COMMANDS}


@pytest.mark.parametrize("name", COMMANDS)
def test_only_the_same_command_on_the_same_files_is_finished(
    name: str, folder: Path, command_line: CommandLine
) -> None:
    ask = COMMANDS[name].split()
    succeeds(command_line, folder, *ask)
    made = scenes(folder)
    assert made
    assert "already finished" in succeeds(command_line, folder, *ask, "--resume").err
    for option, value in (("background", "white"), ("seed", "5"), ("size", "20")):
        line = refused(command_line, folder, *ask, f"--{option}", value, "--resume", status=1)
        assert f"finished with other options ({option})" in line
    read = [path for path in ("ball.ply", "small.ply", "views.json") if path in ask]
    assert len(read) > 1
    for path in map(folder.joinpath, read):
        content, times = path.read_bytes(), path.stat()
        at = len(content) // 2
        other = content[:at] + bytes([content[at] ^ 1]) + content[at + 1 :]
        for new, later in ((other, -(10**12)), (other, 0), (other, 10**12), (content + b"\n", 0)):
            path.write_bytes(new)
            os.utime(path, ns=(times.st_atime_ns, times.st_mtime_ns + later))
            line = refused(command_line, folder, *ask, "--resume", status=1)
            assert f"finished before {path.name} changed" in line
        path.write_bytes(content)
        os.utime(path, ns=(times.st_atime_ns, times.st_mtime_ns))
    assert "already finished" in succeeds(command_line, folder, *ask, "--resume").err
    assert scenes(folder) == made


@pytest.mark.parametrize("name", COMMANDS)
def test_half_written_files_are_written_again(
    name: str, folder: Path, command_line: CommandLine, monkeypatch: pytest.MonkeyPatch
) -> None:
    ask = COMMANDS[name].split()
    succeeds(command_line, folder, *ask)
    made = scenes(folder)
    saved: list[Path] = []

    def stopping(save: Callable[..., None]) -> Callable[..., None]:
        def stopped(path: Path, *content: Any) -> None:
            save(path, *content)
            saved.append(folder / path)
            if len(saved) == 2:
                raise KeyboardInterrupt

        return stopped

    with monkeypatch.context() as patched:
        patched.setattr(checkpoint, "PERIOD", -1.0)
        for module in (checkpoint, tasks):
            patched.setattr(module, "save", stopping(module.save))
        assert command_line(*ask, "-w", cwd=folder)[0] == 130
    left = [path for path in saved if path.exists()]
    assert left
    for path in left:
        path.write_bytes(path.read_bytes()[: path.stat().st_size // 2])
    succeeds(command_line, folder, *ask, "--resume", "-w")
    assert scenes(folder) == made
    assert not any(path.exists() for path in saved)


def test_another_file_at_the_output_is_not_the_finished_one(folder: Path, command_line: CommandLine) -> None:
    ask = COMMANDS["recover"].split()
    succeeds(command_line, folder, *ask)
    (folder / "out.ply").write_bytes((folder / "small.ply").read_bytes())
    assert "out.ply: exists" in refused(command_line, folder, *ask, "--resume", status=1)
