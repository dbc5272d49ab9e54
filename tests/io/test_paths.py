"""Paths that are no files, and names of views that lead out of their folder."""

import os
import struct
from pathlib import Path

import numpy as np
import pytest

from g2ard.errors import InputError
from g2ard.io import read_splats, read_views, write_splats, write_views
from g2ard.io.paths import output_names, real_path
from g2ard.scene.splats import Splats
from helpers.commands import CommandLine, succeeds
from helpers.opened import read_scene
from helpers.systems import needs_links
from helpers.view_files import colmap, edit, orbit, views


@pytest.fixture
def scene(tmp_path: Path) -> Path:
    ball = np.random.default_rng(0).normal(size=(200, 3))
    path = tmp_path / "ball.ply"
    write_splats(path, Splats.create(ball, scales=np.full((200, 3), 0.1)))
    return path


@pytest.mark.skipif(not hasattr(os, "mkfifo"), reason="named pipes need POSIX")
def test_a_pipe_is_rejected_as_a_file(
    tmp_path: Path, scene: Path, command_line: CommandLine
) -> None:
    for name in ("a.ply", "a.spz", "a.las", "a.json"):
        os.mkfifo(tmp_path / name)
        with pytest.raises(InputError, match=rf"{name}: not a regular file$"):
            read_scene(tmp_path / name)
    status, _, said = command_line("info", tmp_path / "a.ply", cwd=tmp_path)
    assert (status, said) == (1, f"g2ard: {tmp_path / 'a.ply'}: not a regular file\n")
    views_file = tmp_path / "v.json"
    write_views(views_file, views(1))
    os.mkfifo(tmp_path / "photo.png")
    edit(views_file, lambda content: content["views"][0].update(image="photo.png"))
    status, _, said = command_line(
        "evaluate", scene, "--views", views_file, "--split", "all", cwd=tmp_path
    )
    assert (status, "none of 1 photo found" in said) == (1, True)


@needs_links
def test_links_in_a_circle(tmp_path: Path, scene: Path, command_line: CommandLine) -> None:
    loop = tmp_path / "loop.ply"
    loop.symlink_to(loop)
    assert real_path(loop) == loop
    for words in (("info", loop), ("simplify", loop, "-r", 3, "-o", tmp_path / "x.ply")):
        status, _, said = command_line(*words, cwd=tmp_path)
        assert (status, said) == (1, f"g2ard: {loop}: is a broken link\n")
    status, _, said = command_line("convert", scene, loop, "-w", cwd=tmp_path)
    assert status == 1
    assert said.startswith(f"g2ard: {loop}: ")
    assert loop.is_symlink()


def test_no_view_is_written_outside_its_dir(
    tmp_path: Path, scene: Path, command_line: CommandLine
) -> None:
    names = ["../precious.png", f"{tmp_path}/evil", "a.png", "a.jpg", "plain.png"]
    write_views(tmp_path / "v.json", views(5))
    edit(
        tmp_path / "v.json",
        lambda c: [v.update(name=n) for v, n in zip(c["views"], names, strict=True)],
    )
    precious = tmp_path / "precious.depth.npy"
    precious.write_text("mine")
    words = (
        "render",
        scene,
        "--views",
        tmp_path / "v.json",
        "-o",
        tmp_path / "out",
        "--depth",
        "--size",
        32,
    )
    succeeds(command_line, tmp_path, *words)
    assert precious.read_text() == "mine"
    assert not (tmp_path / "evil.png").exists()
    made = {
        path.relative_to(tmp_path / "out").as_posix() for path in (tmp_path / "out").rglob("*.png")
    }
    inside = (tmp_path / "evil.png").relative_to(tmp_path.anchor).as_posix()
    assert made == {"precious.png", inside, "a.png.png", "a.jpg.png", "plain.png"}


@pytest.mark.parametrize("name", ["", "/", "..", "\0", "x" * 300, "C:"])
def test_invalid_file_names(name: str) -> None:
    with pytest.raises(InputError, match="has the invalid file name") as caught:
        output_names("v.json", ["a.png", name])
    assert (caught.value.path, caught.value.index) == (Path("v.json"), 1)


def test_names_of_one_file() -> None:
    assert output_names("v.json", ["C:\\photos\\a.png", "b"]) == ["photos/a", "b"]
    with pytest.raises(
        InputError, match=r"'\.\./a\.png' and another view would both be written as 'a\.png'"
    ):
        output_names("v.json", ["../a.png", "a.png"])


@pytest.mark.parametrize("offset", ["nan 0 0", "0 1e999 0", "0 0 -inf"])
def test_an_offset_that_is_not_finite(scene: Path, offset: str) -> None:
    head, rest = scene.read_bytes().split(b"\n", 1)
    scene.write_bytes(head + b"\ncomment g2ard offset " + offset.encode() + b"\n" + rest)
    lines = scene.read_bytes().split(b"\n", 3)
    scene.write_bytes(b"\n".join([lines[0], lines[2], lines[1], lines[3]]))  # after the format
    with pytest.raises(InputError, match=rf"ball\.ply: broken comment 'g2ard offset {offset}'"):
        read_splats(scene)


def test_an_absurd_number_of_a_coefficient(scene: Path) -> None:
    content = scene.read_bytes().replace(
        b"property float opacity", b"property float f_rest_" + b"9" * 5000
    )
    scene.write_bytes(content)
    with pytest.raises(InputError, match="'opacity'"):
        read_splats(scene)


def test_quaternions_of_any_length_turn_views_alike(tmp_path: Path) -> None:
    project = colmap(tmp_path / "project", orbit(2), text=False)
    want = read_views(project).viewmats
    images = project / "sparse" / "0" / "images.bin"
    data = bytearray(images.read_bytes())
    quat = np.frombuffer(data, "<f8", 4, 8 + 4)
    struct.pack_into("<4d", data, 8 + 4, *(quat * 1e308))
    images.write_bytes(data)
    np.testing.assert_allclose(read_views(project).viewmats, want, atol=1e-12)


def test_long_values_are_cut(tmp_path: Path, command_line: CommandLine) -> None:
    path = tmp_path / "v.json"
    write_views(path, views(1))
    edit(path, lambda content: content["views"][0].update(weight="x" * 5000))
    status, _, said = command_line("info", path, cwd=tmp_path)
    assert status == 1
    assert len(said) < 600 + len(str(path))
