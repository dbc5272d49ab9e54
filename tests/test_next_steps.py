"""What is refused says what would do, and is refused before any work; options are what their names say."""

from __future__ import annotations

import json
import tomllib
from collections.abc import Callable
from pathlib import Path

import pytest
from PIL import Image
from scenes import around, checkered_ball

import g2ard
from g2ard import devices
from g2ard.cli.budget_options import Count, Counts
from g2ard.io import write_views
from g2ard.report.window import Crop

CommandLine = Callable[..., tuple[int, str, str]]
BALL = checkered_ball(400)


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    g2ard.save(tmp_path / "ball.ply", BALL)
    write_views(tmp_path / "views.json", around(16, (48, 36)))
    return tmp_path


def refused(command_line: CommandLine, folder: Path, *arguments: object, status: int = 2) -> str:
    """The one line that answers a call."""
    found, _, error = command_line(*arguments, cwd=folder)
    assert (found, error.count("\n")) == (status, 1), error
    return error


def test_the_time_of_recovery_is_called_so(command_line: CommandLine, folder: Path) -> None:
    shown = command_line("distill", "--help", cwd=folder)[1]
    assert "--recovery-time" in shown
    assert "--time-limit" not in shown
    ask = ("distill", "ball.ply", "-r", 10, "-o", "run")
    for name in ("--recovery-time", "--time-limit"):
        status, out, error = command_line(*ask, name, "90s", "--print-config", cwd=folder)
        assert status == 0, error
        assert "recovery-time = 90\n" in out
    for name in ("recovery-time", "time-limit", "time_limit"):
        (folder / "c.toml").write_text(f"[distill]\n{name} = '2m'\n")
        status, out, error = command_line(*ask, "--config", "c.toml", "--print-config", cwd=folder)
        assert (status, "recovery-time = 120\n" in out) == (0, True), error


def test_budgets_that_come_to_one_place_are_refused_before_any_work(
    command_line: CommandLine, folder: Path
) -> None:
    ask = ("distill", "ball.ply", "--json", "-")
    for budgets, name in (("20,20", "{ratio}"), ("20,20", "{count}"), ("20,20.01", "{count}")):
        error = refused(command_line, folder, *ask, "-r", budgets, "-o", name)
        assert "written to the same place" in error
    assert "poses" not in error


@pytest.mark.parametrize("command", ["simplify", "distill"])
def test_a_name_has_no_unknown_words(command: str, command_line: CommandLine, folder: Path) -> None:
    error = refused(command_line, folder, command, "ball.ply", "-r", 4, "-o", "{foo}_{ratio}.ply")
    assert "{foo} stands for nothing; {ratio} and {count}" in error
    assert sorted(path.name for path in folder.iterdir()) == ["ball.ply", "views.json"]


@pytest.mark.parametrize("option", ["render --sheet", "clean --dry-run --preview"])
def test_a_picture_is_what_its_name_says(option: str, command_line: CommandLine, folder: Path) -> None:
    command, *options = option.split()
    error = refused(command_line, folder, command, "ball.ply", *options, "a.jpg")
    assert "written as .png, not 'a.jpg'" in error
    if command == "render":
        ask = ("render", "ball.ply", "-n", 1, "--size", 32, "--sheet", "a.PNG")
        assert command_line(*ask, cwd=folder)[0] == 0
        with Image.open(folder / "a.PNG") as picture:
            assert picture.format == "PNG"


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ("9.000", "write 9000 or 9_000"),
        ("1.234.567", "write 1234567 or 1_234_567"),
        ("9.0", "without a dot"),
        ("0.500", "without a dot"),
        ("5,000,4,000", "5_000,4_000 or 5k,4k"),
        ("5,000,10k", "5_000,4_000 or 5k,4k"),
    ],
)
def test_counts_that_could_be_others_are_refused(text: str, words: str) -> None:
    with pytest.raises(Exception, match="not '") as refusal:
        Counts.parse(text)
    assert words in str(refusal.value)
    assert Count.parse("1.500M").of(2_000_000) == 1_500_000


@pytest.mark.parametrize(
    ("text", "near"),
    [
        ("[simplify]\nrato = 10", "rato (did you mean ratio?)"),
        ("rato = 10", "rato (did you mean ratio?)"),
        ("[simplfy]\nratio = 10", "simplfy (did you mean simplify?)"),
        ("[simplify]\nratio = 4\n[distill]\nview_count = 3", "views-count"),
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


def test_convert_takes_its_output_as_the_others_do(command_line: CommandLine, folder: Path) -> None:
    written = [("ball.ply", "-o", "a.splat"), ("-o", "b.splat", "ball.ply"), ("ball.ply", "c.splat")]
    for arguments in written:
        status, out, error = command_line("convert", *arguments, "--json", "-", cwd=folder)
        assert status == 0, error
        config = json.loads(out)["config"]
        assert config["scenes"] == ["ball.ply"]
        assert config["output"].endswith(".splat")
    one = {(folder / f"{name}.splat").read_bytes() for name in "abc"}
    assert len(one) == 1
    assert command_line("convert", "ball.ply", "ball.ply", "-o", "two.ply", cwd=folder)[0] == 0
    assert len(g2ard.load(folder / "two.ply")) == 800
    assert "SCENE… OUT, or SCENE… -o OUT" in refused(command_line, folder, "convert", "ball.ply")
    for arguments in (("ball.ply", "./ball.ply"), ("ball.ply", "-o", "ball.ply")):
        assert "is an input" in refused(command_line, folder, "convert", *arguments, "-w")


def test_a_dry_run_is_in_nobodys_way(command_line: CommandLine, folder: Path) -> None:
    (folder / "run").mkdir()
    (folder / "run" / "kept.txt").write_text("")
    ask = ("distill", "ball.ply", "-r", 10, "-o", "run", "--steps", 3, "--size", 32)
    assert "-w (--overwrite)" in refused(command_line, folder, *ask, status=1)
    status, _, error = command_line(*ask, "--dry-run", cwd=folder)
    assert (status, "nothing is written" in error) == (0, True), error
    status, _, error = command_line("clean", "ball.ply", "-o", "views.json", "--dry-run", cwd=folder)
    assert status == 0, error
    assert [path.name for path in (folder / "run").iterdir()] == ["kept.txt"]


def test_no_cuda_says_what_would_do(command_line: CommandLine, folder: Path) -> None:
    import torch

    if torch.cuda.is_available():
        pytest.skip("there is one")
    ask = ("recover", "ball.ply", "--teacher", "ball.ply", "-o", "o.ply", "--device", "cuda")
    error = refused(command_line, folder, *ask, status=1)
    assert "g2ard[cuda]; --device cpu needs none" in error


def test_a_gpu_in_software_is_told(command_line: CommandLine, folder: Path) -> None:
    found = devices.adapters()
    if not found or found[0].kind != "cpu":
        pytest.skip("no adapter in software comes first")
    ask = ("simplify", "ball.ply", "-r", 2, "--method", "paper", "-o", "s.ply", "--device", "gpu")
    status, _, error = command_line(*ask, cwd=folder)
    assert status == 0, error
    assert error.count(f"--device gpu: {found[0].name} is software on this CPU") == 1


def test_render_tells_what_its_count_is(command_line: CommandLine, folder: Path) -> None:
    shown = " ".join(command_line("render", "--help", cwd=folder)[1].replace("│", " ").split())
    assert "How many views to make of the scene; with --color flags, cells or parents the budget" in shown
    ask = ("render", "ball.ply", "-n", 2, "--views", "views.json", "-o", "out")
    assert "a number of views to make, where none are given" in refused(command_line, folder, *ask)
