"""`g2ard convert`: its arguments and outputs."""

import json
from pathlib import Path

import numpy as np

import g2ard
from g2ard.io import read_splats, write_splats
from g2ard.scene.transform import join, transform
from helpers.commands import CommandLine, refused, succeeds
from helpers.similarities import directional, matrix, turn


def test_convert_merges_crops_moves(tmp_path: Path, command_line: CommandLine) -> None:
    a, b = directional(1), transform(directional(3), matrix(1, np.eye(3), [5, 0, 0]))
    write_splats(tmp_path / "a.ply", a)
    write_splats(tmp_path / "b.glb", b)
    (tmp_path / "m.json").write_text(json.dumps({"transform": matrix(1, turn(), [0, 0, 1]).tolist()}))
    out = tmp_path / "c.ply"
    words = ["a.ply", "b.glb", "c.ply", "--box", "-9,-9,0,9,9,9", "--transform", "m.json"]
    succeeds(command_line, tmp_path, "convert", *words)
    whole = join([a, b])
    expected = transform(whole.take(whole.means[:, 2] >= 0), matrix(1, turn(), [0, 0, 1]))
    found = read_splats(out)
    np.testing.assert_allclose(found.means, expected.means, atol=1e-6)
    np.testing.assert_allclose(found.shN, expected.shN, atol=1e-5)


def test_convert_writes_a_version_and_a_degree(tmp_path: Path, command_line: CommandLine) -> None:
    write_splats(tmp_path / "a.ply", directional())
    words = ("a.ply", "b.spz", "--spz-version", "2", "--sh-degree", "1")
    succeeds(command_line, tmp_path, "convert", *words)
    assert read_splats(tmp_path / "b.spz").sh_degree == 1


def test_convert_takes_its_output_with_or_without_o(command_line: CommandLine, folder: Path) -> None:
    written = [("ball.ply", "-o", "a.splat"), ("-o", "b.splat", "ball.ply"), ("ball.ply", "c.splat")]
    for arguments in written:
        out = succeeds(command_line, folder, "convert", *arguments, "--json", "-").out
        config = json.loads(out)["config"]
        assert config["scenes"] == ["ball.ply"]
        assert config["output"].endswith(".splat")
    one = {(folder / f"{name}.splat").read_bytes() for name in "abc"}
    assert len(one) == 1
    assert command_line("convert", "ball.ply", "ball.ply", "-o", "two.ply", cwd=folder)[0] == 0
    assert len(g2ard.load(folder / "two.ply")) == 800
    for arguments in (("ball.ply", "./ball.ply"), ("ball.ply", "-o", "ball.ply")):
        assert "is both an input and the output" in refused(command_line, folder, "convert", *arguments, "-w")


def test_convert_scales_then_rotates_then_translates(tmp_path: Path, command_line: CommandLine) -> None:
    scene = directional()
    write_splats(tmp_path / "a.ply", scene)
    words = ("--scale", "2", "--rotate", "90,0,90", "--translate", "1,2,3")
    succeeds(command_line, tmp_path, "convert", "a.ply", "b.ply", *words)
    x, y, z = 2 * scene.means.astype(float).T
    expected = np.stack([z + 1, x + 2, y + 3], 1)  # about x: y → z, z → −y; then about z: x → y, y → −x
    np.testing.assert_allclose(read_splats(tmp_path / "b.ply").means, expected, atol=1e-5)
