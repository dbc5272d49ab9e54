"""No two outputs of a command share a path: nothing is read before that is clear, and nothing is lost."""

import shutil
from pathlib import Path

import pytest

from helpers.commands import CommandLine, refused, succeeds
from helpers.systems import needs_links
from helpers.writing_commands import COMMANDS, TRAIN, VIEWED, write_inputs


@pytest.fixture(scope="module")
def inputs(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("inputs")
    write_inputs(folder)
    return folder


def contents(folder: Path) -> dict[Path, bytes]:
    return {path.relative_to(folder): path.read_bytes() for path in folder.rglob("*") if path.is_file()}


@pytest.mark.parametrize("output", COMMANDS)
def test_json_replaces_nothing_that_the_command_writes(
    output: str, inputs: Path, tmp_path: Path, command_line: CommandLine
) -> None:
    folder = shutil.copytree(inputs, tmp_path / "a")
    words = COMMANDS[output].split()
    given = contents(folder)
    succeeds(command_line, folder, *words)
    after = contents(folder)
    made = after.keys() - given.keys()
    assert made
    for path in sorted(made):
        assert "--json" in refused(command_line, folder, *words, "-w", "--json", path), path
    assert contents(folder) == after


PHOTOS = "--views photos.json --steps 2 --size 24 --photos"
REDUCE = "simplify ball.ply --no-views"


@pytest.mark.parametrize(
    "command",
    [
        f"{REDUCE} -n 50 -o c_{{count}}.ply --json c_50.ply",
        f"{REDUCE} -r 8 -o c_{{count}}.ply --json c_50.ply",
        f"{REDUCE} -n 50 -o c_{{ratio}}.ply --json c_8.ply",
        f"{REDUCE} -r 8 -o c_{{count}}.ply --parents c_50.ply",
        f"{REDUCE} -r 8 -o c_50.ply --parents c_{{count}}.ply",
        f"{REDUCE} -r 8 -o c.npy.ply --parents rows_{{count}}.npy --json rows_50.npy",
        f"{REDUCE} -r 8 -o c_{{count}}.ply --json c_50.ply --tile-rows 150",
        f"{REDUCE} -r 8 -o c/meta.json --json c/shN_labels.webp",
        f"{REDUCE} -r 8 -o c.ply --work w --json w/tiles/tiles.json",
        f"{REDUCE} -r 8 -o c.ply --work c.ply",
        f"{REDUCE} -r 8 -o c.ply --json .c.ply.tiles",
        f"distill ball.ply -r 8 {VIEWED} -o c --json c/a.json",
        f"distill ball.ply -r 8 {VIEWED} -o run --dry-run --json run/a.json",
        f"recover ball.ply {TRAIN} -o c.ply --json .c.ply.checkpoint.npz",
        f"adapt ball.ply {TRAIN} -o c.ply --json .c.ply.work/steps.npz",
        "lod ball.ply -r 4,8 --merge-only --views views.json -o c --json .c.unfinished/level.npz",
        "clean sky.ply -o c.ply --split-sky c.ply",
        "clean sky.ply --dry-run --preview c.png --json c.png",
        "render ball.ply --views views.json -o c --sheet c/view_003.png",
        "render ball.ply --views views.json -o c --depth --json c/view_003.depth.npy",
        "poses ball.ply -k 4 -o model --json model/sparse/0/cameras.txt",
        "register ball.ply --images photos.json --matcher direct -o poses.json --report a.html --json a.html",
        pytest.param(f"{REDUCE} -r 8 -o c.ply --json link", marks=needs_links),
        pytest.param(f"{REDUCE} -r 8 -o linked/c.ply --json c.ply", marks=needs_links),
    ],
)
def test_two_options_with_one_path_are_refused(
    command: str, inputs: Path, tmp_path: Path, command_line: CommandLine
) -> None:
    folder = shutil.copytree(inputs, tmp_path / "a")
    if "link" in command:
        (folder / "link").symlink_to("c.ply")
        (folder / "linked").symlink_to(".")
    before = contents(folder)
    status, _, error = command_line(*command.split(), "-w", cwd=folder)
    assert (status, " is written by " in error.splitlines()[-1]) == (2, True), error
    assert contents(folder) == before


@pytest.mark.parametrize(
    ("made", "command"),
    [
        ("convert ball.ply c/meta.json", "convert c -o c/meta.json"),
        (
            "ingest ball.ply --tile-rows 150 -o c",
            f"{REDUCE.replace('ball.ply', 'c')} -r 8 -o a.ply --json c/tiles.json",
        ),
        ("poses ball.ply -k 4 -o c", "select ball.ply --views c -k 2 -o a.json --json c/sparse/0/images.txt"),
        (
            "poses ball.ply -k 4 -o c/transforms.json",
            "render ball.ply --views c -o a --json c/transforms.json",
        ),
        (
            "ingest ball.ply --tile-rows 150 -o c",
            f"{REDUCE.replace('ball.ply', 'c')} -r 8 -o a.ply --json c/tile-00001.f32",
        ),
        ("convert ball.ply c/meta.json", "convert c a.ply --json c/means_l.webp"),
        ("info ball.ply", "render ball.ply --views photos.json -o ."),
        ("info ball.ply", f"recover ball.ply {PHOTOS} -o a.ply --json view_001.png"),
        (
            "render ball.ply --views views.json -o c",
            "register ball.ply --images c --matcher direct -o a.json --report c/view_000.png",
        ),
        (
            "distill ball.ply -r 8 --steps 2 --size 24 --views-format inria --no-page -o c",
            "clean c/scene.ply -o a.ply --json c/cameras.json",
        ),
    ],
)
def test_a_file_in_an_input_folder_is_kept(
    made: str, command: str, inputs: Path, tmp_path: Path, command_line: CommandLine
) -> None:
    folder = shutil.copytree(inputs, tmp_path / "a")
    succeeds(command_line, folder, *made.split())
    before = contents(folder)
    assert "is both an input and the output" in refused(command_line, folder, *command.split(), "-w")
    assert contents(folder) == before


@pytest.mark.parametrize(
    "command",
    [
        f"{REDUCE} -r 8 -o c/meta.json --json c/told.json",
        "render ball.ply --views views.json --size 16 -o c --sheet c/sheet.png --json c/told.json",
        "render ball.ply --views photos.json -o pictures --json images.json",
        f"{REDUCE} -r 8,16 -o c_{{count}}.ply --parents c_{{count}}.npy --json c.json",
    ],
)
def test_outputs_may_share_a_folder(
    command: str, inputs: Path, tmp_path: Path, command_line: CommandLine
) -> None:
    folder = shutil.copytree(inputs, tmp_path / "a")
    for words in ((), ("-w",)):  # those of the first time are no inputs
        succeeds(command_line, folder, *command.split(), *words)
