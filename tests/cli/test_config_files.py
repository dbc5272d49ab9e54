"""Config files: written by `--print-config`, checked when they are read."""

from __future__ import annotations

import json
import tomllib
from pathlib import Path

import pytest

from g2ard.report.window import Crop
from helpers.commands import CommandLine, refused


def test_a_config_file_is_written_and_read_by_flags_names(command_line: CommandLine, folder: Path) -> None:
    ask = ("distill", "ball.ply", "-r", "5,10", "-o", "r{ratio}", "--schedule", "fast", "--steps", 4)
    ask = (*ask, "--size", 48, "--background", "0.5,0,1", "--set", "rates.means=1e-4")
    status, out, error = command_line(*ask, "--print-config", cwd=folder)
    assert status == 0, error
    assert not (folder / "r5").exists()
    for line in ("ratio = [5, 10]", 'schedule = "fast"', "steps = 4", "background = [0.5, 0, 1]"):
        assert line in out
    (folder / "c.toml").write_text(out)
    again = command_line("distill", "ball.ply", "--config", "c.toml", "--print-config", cwd=folder)
    assert again == (0, out, "")
    status, _, error = command_line("distill", "ball.ply", "--config", "c.toml", cwd=folder)
    assert status == 0, error
    assert (folder / "r10" / "scene.ply").exists()


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ("[simplfy]\nratio = 10", "unknown command simplfy"),
        ("[simplify]\nrato = 10", "`simplify` has no option rato"),
        ("rato = 10", "`simplify` has no option rato"),
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
        ("ratio = 5\nstepz = 7\n[recover]\nsteps = 9", "none of its commands has an option stepz"),
        ("ratio = 5\n[distill]\nnonsense = 1", "`distill` has no option nonsense"),
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
    assert (found["output_count"], found["config"]["seed"]) == (40, 5)


def test_a_letter_in_a_config_is_told_its_long_name(command_line: CommandLine, folder: Path) -> None:
    for text in ("n = 9", "[distill]\nn = 9", "[distill]\nn = 9\n[poses]\ncount = 4"):
        (folder / "c.toml").write_text(text)
        status, _, error = command_line("distill", "ball.ply", "--config", "c.toml", "-o", "r", cwd=folder)
        assert (status, "`distill` has no option n (write count)" in error) == (2, True), error


@pytest.mark.parametrize("inputs", [("distill", "ball.ply"), ("info", "ball.ply", "views.json")])
def test_a_printed_config_has_the_inputs(
    inputs: tuple[str, ...], command_line: CommandLine, folder: Path
) -> None:
    command, *paths = inputs
    options = ("-r", 5, "-o", "run") if command == "distill" else ()
    status, out, error = command_line(command, *paths, *options, "--print-config", cwd=folder)
    assert status == 0, error
    table = tomllib.loads(out)[command]
    assert table.get("scene", table.get("paths")) == (paths[0] if command == "distill" else paths)
    (folder / "c.toml").write_text(out)
    again = command_line(command, "--config", "c.toml", "--print-config", cwd=folder)
    assert again == (0, out, "")


@pytest.mark.parametrize(
    ("text", "near"),
    [
        ("[simplify]\nrato = 10", "rato (did you mean ratio?)"),
        ("rato = 10", "rato (did you mean ratio?)"),
        ("[simplfy]\nratio = 10", "simplfy (did you mean simplify?)"),
        ("[simplify]\nratio = 4\n[distill]\nhold_out = 3", "held-out"),
        ("stepz = 7\n[recover]\nsteps = 9\n[simplify]\nratio = 4", "stepz (did you mean steps?)"),
    ],
)
def test_unknown_keys_are_told_with_those_near(
    text: str, near: str, command_line: CommandLine, folder: Path
) -> None:
    (folder / "c.toml").write_text(text)
    assert near in refused(command_line, folder, "simplify", "ball.ply", "-o", "s.ply", "--config", "c.toml")


@pytest.mark.parametrize(
    ("arguments", "written"),
    [
        ("simplify ball.ply -o s{ratio}.ply -r 20,40.5", {"ratio": [20, 40.5]}),
        ("simplify ball.ply -o s.ply -r 20", {"ratio": 20}),
        ("simplify ball.ply -o s{count}.ply -n 50 -n 2k,10%", {"count": [50, "2k", "10%"]}),
        ("lod ball.ply -o lod", {"ratios": [1, 2, 4, 8, 16]}),
        ("poses ball.ply -o p.json --size 320x240 --up 0,0,1", {"size": "320x240", "up": [0, 0, 1]}),
        ("distill ball.ply -o run -n 50 --crop a:0,0,.5,1", {"count": 50, "crop": ["a:0.0,0.0,0.5,1.0"]}),
    ],
)
def test_a_printed_config_is_plain_and_reads_back(
    arguments: str, written: dict[str, object], command_line: CommandLine, folder: Path
) -> None:
    command, scene, *options = arguments.split()
    status, out, error = command_line(command, scene, *options, "--print-config", cwd=folder)
    assert status == 0, error
    found = tomllib.loads(out)[command]
    assert {name: found[name] for name in written} == written
    (folder / "c.toml").write_text(out)
    ask = (command, scene, "--config", "c.toml", "--print-config")
    assert command_line(*ask, cwd=folder) == (0, out, "")
    assert Crop.parse(str(Crop.parse("a:b:0,0,.5,1"))) == Crop.parse("a:b:0,0,.5,1")
