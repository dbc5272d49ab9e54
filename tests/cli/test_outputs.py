"""Output paths: no two outputs of a command share one, no input is overwritten; folders, suffixes, names."""

import json
import shutil
from pathlib import Path

import pytest
from PIL import Image

import g2ard
from helpers.commands import CommandLine, refused, succeeds
from helpers.photos import BALL
from helpers.systems import needs_links


def contents(folder: Path) -> dict[Path, bytes]:
    return {
        path.relative_to(folder): path.read_bytes() for path in folder.rglob("*") if path.is_file()
    }


VIEWED = "--views views.json --steps 2 --size 24"
TRAIN = f"{VIEWED} --teacher ball.ply"
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
        "clean sky.ply --preview c.png --json c.png",
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


OTHER = "simplify c -r 8 --no-views -o a.ply --json"


@pytest.mark.parametrize(
    "commands",
    [
        "convert ball.ply c/meta.json && convert c -o c/meta.json",
        f"ingest ball.ply --tile-rows 150 -o c && {OTHER} c/tiles.json",
        f"ingest ball.ply --tile-rows 150 -o c && {OTHER} c/tile-00001.f32",
        "poses ball.ply -k 4 -o c && select ball.ply --views c -k 2 -o a.json --json c/sparse/0/images.txt",
        "poses ball.ply -k 4 -o c/transforms.json && render ball.ply --views c -o a --json c/transforms.json",
        "convert ball.ply c/meta.json && convert c a.ply --json c/means_l.webp",
        "render ball.ply --views photos.json -o photos",
        f"recover ball.ply {PHOTOS} -o a.ply --json photos/view_001.png",
        "render ball.ply --views views.json -o c && "
        "register ball.ply --images c --matcher direct -o a.json --report c/view_000.png",
        "distill ball.ply -r 8 --steps 2 --size 24 --views-format inria --focus far --no-page -o c && "
        "clean c/scene.ply -o a.ply --json c/cameras.json",
        "simplify ball.ply -r 2 -o photos/../ball.ply",
        pytest.param("simplify linked/link.ply -r 2 -o ball.ply", marks=needs_links),
        f"{REDUCE} -r 2 -o o.ply --json ball.ply",
        "recover ball.ply --views views.json -o ball.ply",
        "recover s.ply --views views.json --teacher ball.ply -o ball.ply",
        "adapt ball.ply --views views.json -o ball.ply",
        "lift cloud.ply -o cloud.ply",
        "select ball.ply --views views.json -k 2 -o views.json",
        "distill run/scene.ply -r 2 -o run",
        "distill run/scene.sog -r 2 -o run",
        "distill ball.ply --held-out run/views.json -r 2 -o run",
        "evaluate ball.ply --views views.json --json ball.ply",
        "convert ball.ply ./ball.ply",
        "convert ball.ply -o ball.ply",
    ],
)
def test_inputs_are_kept(
    commands: str, inputs: Path, tmp_path: Path, command_line: CommandLine
) -> None:
    """The last command is refused, also where its input is a folder that holds the output."""
    folder = shutil.copytree(inputs, tmp_path / "a")
    if "link" in commands:
        (folder / "link.ply").symlink_to("ball.ply")
        (folder / "linked").symlink_to(".")
    *made, command = commands.split(" && ")
    for words in made:
        succeeds(command_line, folder, *words.split())
    before = contents(folder)
    assert "is both an input and the output" in refused(
        command_line, folder, *command.split(), "-w"
    )
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


def test_folders_are_made_and_suffixes_are_of_any_case(
    command_line: CommandLine, folder: Path
) -> None:
    g2ard.save(folder / "a" / "b" / "ball.PLY", BALL)
    assert len(g2ard.load(folder / "a" / "b" / "ball.PLY")) == 1200
    succeeds(
        command_line,
        folder,
        "simplify",
        "a/b/ball.PLY",
        "-r",
        4,
        "-o",
        "c/d/small.Ply",
        "--json",
        "e/f.json",
    )
    assert json.loads((folder / "e" / "f.json").read_text())["output_count"] == 300
    assert len(g2ard.load(folder / "c" / "d" / "small.Ply")) == 300


SHORT = ("distill", "ball.ply", "--steps", 5, "--size", 48)


def test_a_folder_has_one_scene(command_line: CommandLine, folder: Path) -> None:
    """It may be called like the stand-in of dry runs."""
    ask = (*SHORT, "-r", 10, "--focus", "far", "-o", "dry-run")
    succeeds(command_line, folder, *ask)
    assert (folder / "dry-run" / "scene.ply").is_file()
    succeeds(command_line, folder, *ask, "-w", "--format", "sog")
    assert [path.name for path in (folder / "dry-run").glob("scene*")] == ["scene.sog"]


def test_a_pictures_suffix_is_of_any_case(command_line: CommandLine, folder: Path) -> None:
    succeeds(command_line, folder, "render", "ball.ply", "-k", 1, "--size", 32, "--sheet", "a.PNG")
    with Image.open(folder / "a.PNG") as picture:
        assert picture.format == "PNG"


@pytest.mark.parametrize(
    "name", ["{1A2B-3C}/s.ply", "{backup}/s.ply", "s{v2}.ply", "{A}_{ratio}x.ply"]
)
def test_braces_that_are_no_placeholders(
    command_line: CommandLine, folder: Path, name: str
) -> None:
    succeeds(command_line, folder, "simplify", "ball.ply", "-r", "4", "-o", name)
    assert (folder / name.replace("{ratio}", "4")).is_file()
