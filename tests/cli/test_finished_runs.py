"""--resume of a finished output: inputs are all files that were read, and requested files are written."""

import json
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

import g2ard
from g2ard.io import write_views
from g2ard.io.images import write_png
from helpers.commands import CommandLine, refused, succeeds
from helpers.photos import photographed, photos_of
from helpers.scenes import around, checkered_ball

BALL = checkered_ball(200)
COMMANDS = {
    "distill": "distill scene.ply -r 2 --steps 2 --views project/views/views.json --no-page -o run",
    "recover": "recover scene.ply --steps 2 --views project/views/views.json -o out.ply",
    "adapt": "adapt scene.ply --steps 2 --views project/views/views.json -o out.ply",
    "lod": "lod scene.ply -r 1,2 --steps 2 --views project/views/views.json -o levels",
}
NAMES = [f"view_{row:03d}.png" for row in range(9)]
FOUND: dict[str, bytes] = {
    "project/views/split.json": json.dumps({"train": NAMES[:5], "test": NAMES[5:]}).encode(),
    "project/views/test.txt": b"view_002\nview_003\n",
    "project/views/train.txt": b"view_002\nview_003\nview_004\n",
    "project/photos/exposure.json": json.dumps({"view_001": np.eye(3, 4).tolist()}).encode(),
    "project/photos/masks/view_001.png": b"a mask",
}
"""Files that are read where they are beside views or photos."""


@pytest.fixture
def project(tmp_path: Path) -> Path:
    """A scene, and views in a folder of their own with photos in another."""
    g2ard.save(tmp_path / "scene.ply", replace(BALL, sh0=0.9 * BALL.sh0))
    (tmp_path / "project/photos/images").mkdir(parents=True)
    (tmp_path / "project/views").mkdir()
    views = photographed(tmp_path / "project/photos/images", BALL, around(9, (32, 24)))
    write_views(tmp_path / "project/views/views.json", replace(views, names=tuple(NAMES)))
    return tmp_path


def put(path: Path, content: bytes) -> None:
    path.parent.mkdir(exist_ok=True)
    if content == b"a mask":
        write_png(path, np.ones((24, 32)), overwrite=True)
    else:
        path.write_bytes(content)


@pytest.mark.parametrize("name", COMMANDS)
def test_what_is_found_beside_views_is_an_input(
    name: str, project: Path, command_line: CommandLine
) -> None:
    """It counts if it is new, changed or gone since."""
    words = COMMANDS[name].split()
    succeeds(command_line, project, *words)
    assert not list(project.rglob(".*"))
    for file, content in FOUND.items():
        put(project / file, content)
        line = refused(command_line, project, *words, "--resume", status=1)
        assert f"finished before {file} changed" in line
        (project / file).unlink()
        assert "already finished" in succeeds(command_line, project, *words, "--resume").err
    there = "project/views/split.json", "project/photos/exposure.json"
    for file in there:
        put(project / file, FOUND[file])
    succeeds(command_line, project, *words, "-w")
    for file in there:
        changes: tuple[Callable[[Path], object], ...] = (
            lambda path: path.write_bytes(path.read_bytes() + b"\n"),
            Path.unlink,
        )
        for change in changes:
            change(project / file)
            line = refused(command_line, project, *words, "--resume", status=1)
            assert f"finished before {file} changed" in line
            put(project / file, FOUND[file])
    assert "already finished" in succeeds(command_line, project, *words, "--resume").err


@pytest.mark.parametrize(
    ("option", "file"),
    [
        ("--keep", "simplified/scene.ply"),
        ("--page", "view.html"),
        ("--views-format inria", "cameras.json"),
    ],
)
def test_a_finished_run_writes_what_it_was_not_asked_for_before(
    option: str, file: str, project: Path, command_line: CommandLine
) -> None:
    words = ["distill", "scene.ply", "-r", "2", "--steps", "2", "--size", "24", "-o", "run"]
    succeeds(command_line, project, *words, "--no-page")
    before = (project / "run/scene.ply").read_bytes()
    page = [] if option == "--page" else ["--no-page"]
    more = (*words, *page, *option.split(), "--resume")
    assert not (project / "run" / file).exists()
    assert "finished without" in succeeds(command_line, project, *more).err
    assert (project / "run" / file).exists()
    assert (project / "run/scene.ply").read_bytes() == before
    assert "already finished" in succeeds(command_line, project, *more).err
    assert "seed" in refused(command_line, project, *more, "--keep", "--seed", 4, status=1)


def test_a_run_among_its_inputs_is_no_input(tmp_path: Path, command_line: CommandLine) -> None:
    photos_of(tmp_path / "photos", scene=BALL, count=9)
    words = "distill --views photos -n 60 --steps 2 --no-page -o photos/run".split()  # noqa: SIM905
    succeeds(command_line, tmp_path, *words)
    assert "already finished" in succeeds(command_line, tmp_path, *words, "--resume").err
