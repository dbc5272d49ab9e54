"""Config files: written by `--print-config`, checked when they are read."""

import json
import tomllib
from pathlib import Path

import pytest

from helpers.commands import CommandLine, refused, succeeds


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ("[simplfy]\nratio = 10", "unknown command simplfy (did you mean simplify?)"),
        ("[simplify]\nrato = 10", "`simplify` has no option rato (did you mean ratio?)"),
        ("rato = 10", "`simplify` has no option rato (did you mean ratio?)"),
        ("simplify = 10", "simplify"),
        ("[simplify]\nratio = 0.5", "0.5"),
        ("ratio = 5\nstepz = 7\n[recover]\nsteps = 9", "none of its commands has an option stepz"),
        ("stepz = 7\n[recover]\nsteps = 9\n[simplify]\nratio = 4", "stepz (did you mean steps?)"),
        ("ratio = 5\n[distill]\nnonsense = 1", "`distill` has no option nonsense"),
        ("[simplify]\nratio = 4\n[distill]\nhold_out = 3", "held-out"),
        ("[simplify]\nn = 9", "`simplify` has no option n (write count)"),
        ("n = 9", "has no option n (write count)"),
        (
            "[simplify]\nmin-psnr = true",
            "'--min-psnr': expected a number of at least 1, got 'true'",
        ),
        ("[simplify\n", "c.toml: "),
        ('[simplify]\nratio = 4\noutput = "C:\\Users\\me\\s.ply"', "write paths in single quotes"),
        ('[simplify]\nratio = 4\noutput = "D:\\scans\\s.ply"', "write paths in single quotes"),
        ('[simplify]\nratio = 4\noutput = "C:\\temp\\new.ply"', "write paths in single quotes"),
    ],
)
def test_wrong_names_and_values_are_named(
    text: str, words: str, command_line: CommandLine, folder: Path
) -> None:
    (folder / "c.toml").write_text(text)
    ask = ("simplify", "ball.ply", "-o", "s.ply", "--config", "c.toml")
    assert words in refused(command_line, folder, *ask)


@pytest.mark.parametrize("encoding", ["utf-8", "utf-8-sig", "utf-16", "utf-16-le"])
@pytest.mark.parametrize("end", ["\n", "\r\n"])
def test_config_files_of_windows(
    command_line: CommandLine, folder: Path, encoding: str, end: str
) -> None:
    text = end.join(["[simplify]", "ratio = [10]", "output = 's.ply'", ""])
    mark = "\ufeff" if encoding == "utf-16-le" else ""
    (folder / "c.toml").write_bytes((mark + text).encode(encoding))
    succeeds(command_line, folder, "simplify", "ball.ply", "--config", "c.toml")
    assert (folder / "s.ply").is_file()


def test_keys_above_tables_apply_to_every_command(command_line: CommandLine, folder: Path) -> None:
    (folder / "c.toml").write_text(
        "seed = 5\nsize = 64\n[simplify]\nratio = [10]\n[render]\nsplit = 'test'"
    )
    ask = ("simplify", "ball.ply", "-o", "s.ply", "--config", "c.toml", "--json", "-")
    found = json.loads(succeeds(command_line, folder, *ask).out)
    assert (found["output_count"], found["config"]["seed"]) == (40, 5)


@pytest.mark.parametrize(
    ("arguments", "written"),
    [
        ("simplify ball.ply -o s{ratio}.ply -r 20,40.5", {"ratio": [20, 40.5]}),
        ("simplify ball.ply -o s.ply -r 20", {"ratio": 20}),
        ("simplify ball.ply -o s{count}.ply -n 50 -n 2k,10%", {"count": [50, "2k", "10%"]}),
        ("lod ball.ply -o lod", {"scene": "ball.ply", "ratios": [1, 2, 4, 8, 16]}),
        (
            "distill ball.ply -r 9 -o run --schedule fast --steps 4 --background 0.5,0,1",
            {"ratio": 9, "schedule": "fast", "steps": 4, "background": [0.5, 0, 1]},
        ),
        ("distill ball.ply -r 9 -o run --recovery-time 2m", {"recovery-time": 120}),
        ("info ball.ply views.json", {"paths": ["ball.ply", "views.json"]}),
        (
            "poses ball.ply -o p.json --size 320x240 --up 0,0,1",
            {"size": "320x240", "up": [0, 0, 1]},
        ),
        (
            "distill ball.ply -o run -n 50 --keep-region 0,0,.5,1 --keep-region 1,2,3,4",
            {"count": 50, "keep-region": ["0,0,0.5,1", "1,2,3,4"]},
        ),
    ],
)
def test_printed_configs(
    arguments: str, written: dict[str, object], command_line: CommandLine, folder: Path
) -> None:
    command, *options = arguments.split()
    out = succeeds(command_line, folder, command, *options, "--print-config").out
    found = tomllib.loads(out)[command]
    assert {name: found[name] for name in written} == written
    (folder / "c.toml").write_text(out)
    ask = (command, "--config", "c.toml", "--print-config")
    assert command_line(*ask, cwd=folder) == (0, out, "")


def test_settings_are_checked_without_running_the_command(
    command_line: CommandLine, folder: Path
) -> None:
    """`recover` says which background it takes from a run."""
    (folder / "run").mkdir()
    (folder / "ball.ply").rename(folder / "run" / "scene.ply")
    (folder / "run" / "report.json").write_text('{"settings": {"recover.background": [1, 1, 1]}}')
    ask = ("recover", "run", "--views", "views.json", "-o", "out.ply", "--print-config")
    assert succeeds(command_line, folder, *ask, "--set", "steps=3").err == ""
    assert "--set: recover.steps: expected" in refused(
        command_line, folder, *ask, "--set", "steps=-3"
    )
