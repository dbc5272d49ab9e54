"""Calls that are refused: one line that names the cause, and nothing is written."""

from pathlib import Path

import pytest
from PIL import Image

from helpers.commands import CommandLine, refused


@pytest.fixture
def folder(folder: Path) -> Path:
    """ball.ply, views.json, an array, a folder with a photo, and a folder named like a scene."""
    (folder / "directory.ply").mkdir()
    (folder / "bare").mkdir()
    Image.new("RGB", (16, 16)).save(folder / "bare" / "a.png")
    return folder


USAGE = [
    ("nonsense", "nonsense"),
    ("render x.ply --views v.json -o out --threads -1", "--threads"),
    ("render x.ply --views v.json -o out --background 2,0,0", "--background"),
    ("render x.ply --views v.json -o out --device abacus", "abacus"),
    (
        "render ball.ply -k 4 --views views.json --sheet a.png",
        "-k generates views, so it excludes --views",
    ),
    ("render ball.ply --orbit 2 -k 3 -o a", "--orbit"),
    ("render ball.ply -k 1 -o ball.ply", "name another output"),
    (
        "render ball.ply -k 1 -o turn.avi",
        "expected a folder, .png, .gif, .webp or .mp4, got 'turn.avi'",
    ),
    ("render ball.ply -k 2 -o two.png", "-o: two.png holds one view, not 2; give -k 1 or a folder"),
    ("render ball.ply -o x --sheet a.jpg", "ends in .png, got 'a.jpg'"),
    ("clean ball.ply --dry-run --preview a.jpg", "ends in .png, got 'a.jpg'"),
    ("convert ball.ply", "SCENE… OUT, or SCENE… -o OUT"),
    ("convert ball.ply b.ply --box 1,2", "expected 6 comma-separated numbers"),
    ("convert ball.ply b.ply --transform 1,2,3", "expected 16 comma-separated numbers"),
    ("simplify ball.ply -ratio 5 -o o.ply", "-ratio: long options need two dashes; write "),
    ("simplify ball.ply -n 5 -o o.ply --up 0,0,0", "a direction such as 0,0,1"),
    ("simplify ball.ply -r 2 -o o.ply --views v --no-views", "; give one"),
    ("simplify ball.ply -r 2 -o o.ply --json o.ply", "is written by --json too"),
    (
        "simplify ball.ply -r 4 -o {foo}_{ratio}.ply",
        "unknown placeholder {foo}; use {ratio} or {count}",
    ),
    (
        "simplify ball.ply -n 200,100 -o s.ply",
        "such as s_{count}.ply; commas separate counts, so write a single one as 10_000",
    ),
    (
        "recover ball.ply --views made -o o.ply",
        "generated views have no photos; give --teacher SCENE",
    ),
    ("recover ball.ply -o o.ply --steps 3 --recovery-time 9", "; give one"),
    (
        "recover ball.ply -o o.ply --engine gsplat",
        "expected one of fused, torch (the device gpu runs fused",
    ),
    ("recover ball.ply -o o.ply --device cuda", "--device: expected auto, cpu or gpu, got 'cuda'"),
    (
        "select absent.ply --views v -k 3 -o out --policy random",
        "expected one of auto, directional, got",
    ),
    ("distill --views views.json --renders -n 9 -o run", "--renders needs a SCENE to render"),
    ("distill ball.ply -n 5 -o run --held-out made", "--held-out must be a file of views"),
    (
        "distill ball.ply -n 5 -o run --views made --photos",
        "--photos: generated views have no photos",
    ),
    (
        "distill ball.ply -n 5 -o run --steps 5 --set schedule.steps=9",
        "--steps and --set recover.schedule.steps exclude each other",
    ),
    ("distill ball.ply -n 0 -o run", "'0'"),
    ("distill ball.ply -n many -o run", "many"),
    ("distill ball.ply -r 0.5 -o run", "0.5"),
    ("distill ball.ply -r 2,5 -o run", "give one budget"),
    ("distill ball.ply -n 9,20 -o run", "give one budget"),
    ("distill ball.ply -r 4 -r 5 -o run", "give one budget"),
    ("simplify ball.ply -r 20,20 -o {ratio}.ply", "given twice"),
    ("simplify ball.ply -r 20,20.01 -o {count}.ply", "the same output"),
    ("simplify ball.ply --fit 5 -o b.ply", "--fit"),
    ("simplify ball.ply --fit 5MB -n 10 -o b.ply", "--fit"),
    ("simplify ball.ply --fit web --min-psnr 30 -o b.ply", "--fit"),
    ("simplify ball.ply --fit 20kB -o b_{count}.ply", "{count}"),
    ("simplify ball.ply --min-psnr 25 -o b_{count}.ply", "{count}"),
    ("simplify ball.ply -n 5 -o o.ply --memory much", "a size such as 4GB"),
    ("simplify ball.ply -n 5 -o o.ply --tile-rows 25%", "'--tile-rows': expected a positive count"),
    ("ingest ball.ply -o tiles --tile-rows 0", "'--tile-rows': expected a positive count"),
    ("simplify ball.ply -n 5 -o o.ply --config absent.toml", "absent.toml: No such file"),
    ("simplify ball.ply -n 5 -o o.ply --config ball.ply", "ball.ply: not a text file"),
    ("simplify ball.ply -n 5 -o o.ply --keep-region 0,0,1", "expected X,Y,Z,R or X,Y,Z,X,Y,Z"),
    ("simplify ball.ply -n 5 -o o.ply --keep-region 0,0,0,-1", "expected a radius > 0"),
    (
        "simplify ball.ply -n 5 -o o.ply --keep-region 0,0,0,1 --no-views",
        "--keep-region needs views",
    ),
    (
        "simplify ball.ply -n 5 -o o.ply --keep-region 0,0,0,1 --method paper",
        "--keep-region: has no effect",
    ),
    ("lod ball.ply -o x -r 2,1", "--ratios: expected rising numbers of at least 1"),
    ("lod ball.ply -o x --chunk-extent inf", "--chunk-extent: expected a finite number above 0"),
    (
        "lod ball.ply -o x --chunk-extent 0 --tile-rows 150",
        "--chunk-extent: expected a finite number above 0",
    ),
    ("distill ball.ply -r 2 -o run --schedule hasty", "hasty"),
    ("distill ball.ply -r 2 -o run --preset gentle", "gentle"),
]
"""Exit status 2."""

INPUT = [
    ("simplify absent.ply -r 2 -o out.obj", "out.obj: scenes are written as"),
    ("simplify ball.ply -r 2 -o directory.ply", "give the name of a file"),
    ("simplify bal.ply -r 2 -o o.ply", "bal.ply: no such file or folder; did you mean ball.ply?\n"),
    ("lift absent.ply -o out.gltf", "out.gltf: scenes are written as"),
    ("lift ball.ply -o o.ply", "run `simplify` or `distill`"),
    ("convert ball.ply b.ksplat", "scenes are written as"),
    ("convert ball.ply b.ply --spz-version 3", "no option 'spz_version'"),
    ("convert ball.ply b.ply --box 8,8,8,9,9,9", "keep none of 400 Gaussians"),
    ("convert ball.ply o.ply --box 1,1,1,0,0,0", "the lower corner comes first"),
    ("recover absent.ply --views v.json -o out.obj", "out.obj: scenes are written as"),
    ("recover ball.ply --views none.json -o out.ply", "none.json"),
    ("recover ball.ply --views views.json -o no/out.ply", "--teacher"),
    ("recover ball.ply --views views.json -o ball.ply/out.ply", "ball.ply is a file"),
    ("adapt absent.ply --views v.json -o out.obj", "out.obj: scenes are written as"),
    ("select absent.ply --views v.json -k 2 -o out.txt", "out.txt: views are written"),
    ("poses absent.ply -k 2 -o out.txt", "out.txt: views are written"),
    ("register ball.ply --images bare -o o.json --pool 8", "--focal PIXELS"),
    ("render ball.ply -k 1 -o views.json", "give the name of a folder"),
    ("render ball.ply --views none.json -o out", "none.json"),
    ("render views.json --views views.json -o out", "views.json"),
    ("evaluate ball.ply --views views.json --split val", "there are test, train"),
    ("evaluate ball.ply --views views.json --teacher absent.ply", "absent.ply"),
    ("distill absent.ply -r 10 -o run", "absent.ply"),
    ("distill absent.ply -n 9 --format SOG -o run", "absent.ply: no such file"),
    ("distill ball.ply -n 401 -o run", "401"),
    (
        "distill ball.ply -n 9 -o run --set lift.spread=2",
        "lift.spread: has no effect on a trained scene",
    ),
    (
        "distill ball.ply -n 9 -o run --set lift.spread=2 --tile-rows 150",
        "lift.spread: has no effect",
    ),
    (
        "simplify ball.ply -n 5 -o o.ply --keep-region 0,0,90,1",
        "contains none of the 400 Gaussians",
    ),
    ("distill ball.ply -r 2 -o run --views none.json", "none.json"),
    ("distill ball.ply -r 2 -o ball.ply/run", "ball.ply is a file"),
    ("distill ball.ply -r 2 -o run --json ball.ply/where.json", "where.json"),
    (
        "distill ball.ply --photos -n 9 -o run",
        "--photos: generated views have no photos; give --views that have them",
    ),
    ("distill --views views.json --fit 1kB -o run", "--fit: views.json: "),
    (
        "distill --views views.json --min-psnr 30 -o run",
        "--min-psnr: views.json: needs sparse points, and there are none; give --count COUNT",
    ),
]
"""Exit status 1."""


@pytest.mark.parametrize(
    ("command", "words", "status"), [(*case, 2) for case in USAGE] + [(*case, 1) for case in INPUT]
)
def test_refused_in_one_line(
    command: str, words: str, status: int, command_line: CommandLine, folder: Path
) -> None:
    before = sorted(folder.rglob("*"))
    assert words in refused(command_line, folder, *command.split(), status=status)
    assert sorted(folder.rglob("*")) == before


def test_all_missing_options_are_named_at_once(command_line: CommandLine, folder: Path) -> None:
    for ask, missing in (
        ("simplify ball.ply", ("-o OUT", "a budget (-n COUNT")),
        ("distill ball.ply -n 9", ("-o RUN",)),
        ("register ball.ply", ("--images", "-o OUT")),
    ):
        error = refused(command_line, folder, *ask.split())
        assert all(f"{option}" in error for option in missing), error
        assert ("a budget" in error) == ("a budget (-n COUNT" in missing), error
