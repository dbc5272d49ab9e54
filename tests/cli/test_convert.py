"""`g2ard convert`: its arguments and outputs."""

import csv
import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

import g2ard
from g2ard.io import read_splats, write_splats
from g2ard.scene.splats import Splats
from g2ard.scene.transform import in_box, in_sphere, join, transform
from helpers.commands import CommandLine, refused, succeeds
from helpers.similarities import directional, matrix, turn


def test_convert_merges_crops_moves(tmp_path: Path, command_line: CommandLine) -> None:
    a, b = directional(1), transform(directional(3), matrix(1, np.eye(3), [5, 0, 0]))
    write_splats(tmp_path / "a.ply", a)
    write_splats(tmp_path / "b.glb", b)
    (tmp_path / "m.json").write_text(
        json.dumps({"transform": matrix(1, turn(), [0, 0, 1]).tolist()})
    )
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


def test_convert_takes_its_output_with_or_without_o(
    command_line: CommandLine, folder: Path
) -> None:
    written = [
        ("ball.ply", "-o", "a.splat"),
        ("-o", "b.splat", "ball.ply"),
        ("ball.ply", "c.splat"),
    ]
    for arguments in written:
        out = succeeds(command_line, folder, "convert", *arguments, "--json", "-").out
        config = json.loads(out)["config"]
        assert config["scenes"] == ["ball.ply"]
        assert config["output"].endswith(".splat")
    one = {(folder / f"{name}.splat").read_bytes() for name in "abc"}
    assert len(one) == 1
    assert command_line("convert", "ball.ply", "ball.ply", "-o", "two.ply", cwd=folder)[0] == 0
    assert len(g2ard.load(folder / "two.ply")) == 800


def test_convert_keeps_what_fulfils_a_condition(tmp_path: Path, command_line: CommandLine) -> None:
    rng = np.random.default_rng(0)
    scene = Splats.create(
        rng.uniform(-5, 5, (300, 3)),
        scales=np.exp(rng.normal(0, 1, (300, 3))),
        logit_opacities=rng.normal(0, 3, 300),
        sh0=rng.normal(0, 1, (300, 1, 3)),
        offset=(1000, 0, 0),
    )
    write_splats(tmp_path / "a.ply", scene)
    scene = read_splats(tmp_path / "a.ply")
    largest = scene.scales.max(1)
    conditions = {
        "opacity > 0.05 and largest_scale < 2": (scene.opacities > 0.05) & (largest < 2),
        "not (red >= .5 or blue >= .5)": ~(
            (scene.colors[:, 0] >= 0.5) | (scene.colors[:, 2] >= 0.5)
        ),
        "999 < x <= 1001": (scene.means[:, 0] > -1) & (scene.means[:, 0] <= 1),
        "sqrt(y*y + z*z) < 3": np.hypot(scene.means[:, 1], scene.means[:, 2]) < 3,
        "largest_scale / max(smallest_scale, 1e-6) > 4 - -1": largest / scene.scales.min(1) > 5,
        "elongation > 2": largest / np.sort(scene.scales, axis=1)[:, 1] > 2,
    }
    for condition, mask in conditions.items():
        succeeds(command_line, tmp_path, "convert", "a.ply", "b.ply", "--where", condition, "-w")
        found = read_splats(tmp_path / "b.ply")
        assert 0 < len(found) < 300
        np.testing.assert_array_equal(found.means, scene.means[mask])
    assert "keep none" in refused(
        command_line, tmp_path, "convert", "a.ply", "c.ply", "--where", "x < 0", status=1
    )


@pytest.mark.parametrize(
    ("condition", "message"),
    [
        ("opacity", "is a number"),
        ("opacity > 0.5 and elongation", "'elongation' is a number"),
        ("(x > 1) + 1 > 1", "is a comparison"),
        ("brightness > 1", "unknown name 'brightness'"),
        ("__import__('os').system('true') == 0", "not supported"),
        ("x.real > 0", "not supported"),
        ("x[0] > 0", "not supported"),
        ("9 ** 9 ** 9 > 0", "not supported"),
        ("(lambda: x)() > 0", "not supported"),
        ("True", "not supported"),
        ("x > 1e400", "not supported"),
        ("'a' < 'b'", "not supported"),
        ("min(x) > 0", "min takes several numbers"),
        ("x > 1; y > 1", "is not a condition"),
        ("x >", "is not a condition"),
        ("class == 2", "such as 'opacity > 0.05' or, of points, 'classification == 2'"),
        ("-" * 900 + "x > 0", ""),
        ("(" * 900 + "x" + ")" * 90, ""),
        ("x > " + "1" * 2000, "at most 1000 characters"),
    ],
)
def test_convert_rejects_what_is_no_condition(
    command_line: CommandLine, folder: Path, condition: str, message: str
) -> None:
    line = refused(command_line, folder, "convert", "ball.ply", "b.ply", "--where", condition)
    assert "--where" in line
    assert message in line


def test_convert_keeps_the_outside_of_a_box_or_sphere(
    tmp_path: Path, command_line: CommandLine
) -> None:
    scene = Splats.create(
        np.random.default_rng(0).uniform(-5, 5, (200, 3)), scales=np.ones((200, 3))
    )
    write_splats(tmp_path / "a.ply", scene)
    scene = read_splats(tmp_path / "a.ply")
    inside = in_box(scene, [-3, -3, -3], [3, 3, 3])
    round_ = in_sphere(scene, [1, 0, 0], 2)
    for words, dropped in (
        (["--box", "-3,-3,-3,3,3,3"], inside),
        (["--sphere", "1,0,0,2"], round_),
        (["--box", "-3,-3,-3,3,3,3", "--sphere", "1,0,0,2"], inside & round_),
    ):
        succeeds(command_line, tmp_path, "convert", "a.ply", "b.ply", *words, "--invert", "-w")
        np.testing.assert_array_equal(read_splats(tmp_path / "b.ply").means, scene.means[~dropped])
    line = refused(command_line, tmp_path, "convert", "a.ply", "c.ply", "--invert")
    assert "--invert: has nothing to invert; give --box or --sphere" in line


def test_convert_writes_a_table(tmp_path: Path, command_line: CommandLine) -> None:
    scene = replace(directional(1), offset=np.array([500_000.25, 0, 0]))
    write_splats(tmp_path / "a.ply", scene)
    succeeds(command_line, tmp_path, "convert", "a.ply", "b.csv")
    with (tmp_path / "b.csv").open(newline="") as file:
        rows = list(csv.DictReader(file))
    assert len(rows) == len(scene)

    def table(*names: str) -> np.ndarray:
        return np.array([[float(row[name]) for name in names] for row in rows])

    np.testing.assert_array_equal(table("x", "y", "z"), scene.means.astype(float) + scene.offset)
    read = read_splats(tmp_path / "a.ply")
    np.testing.assert_array_equal(
        table("scale_x", "scale_y", "scale_z").astype(np.float32), read.scales
    )
    np.testing.assert_array_equal(table("opacity")[:, 0].astype(np.float32), read.opacities)
    np.testing.assert_array_equal(table("green_2")[:, 0].astype(np.float32), read.shN[:, 1, 1])
    assert ".csv has no option" in refused(
        command_line, tmp_path, "convert", "a.ply", "c.csv", "--spz-version", "4", status=1
    )
    assert "exists" in refused(command_line, tmp_path, "convert", "a.ply", "b.csv", status=1)


def test_convert_writes_the_layout_of_inrias_trainer(
    tmp_path: Path, command_line: CommandLine
) -> None:
    write_splats(tmp_path / "a.ply", directional(1))
    succeeds(command_line, tmp_path, "convert", "a.ply", "b.ply", "--layout", "inria")
    header, _, body = (tmp_path / "b.ply").read_bytes().partition(b"end_header\n")
    names = ["x", "y", "z", "nx", "ny", "nz", "f_dc_0", "f_dc_1", "f_dc_2"]
    names += [f"f_rest_{k}" for k in range(45)]
    names += ["opacity", "scale_0", "scale_1", "scale_2", "rot_0", "rot_1", "rot_2", "rot_3"]
    count = len(directional(1))
    wanted = ["ply", "format binary_little_endian 1.0", f"element vertex {count}"]
    assert header.decode().splitlines() == wanted + [f"property float {name}" for name in names]
    assert len(body) == 248 * count
    rows = np.frombuffer(body, "<f4").reshape(count, 62)
    np.testing.assert_array_equal(rows[:, :3], directional(1).means)
    assert not rows[:, 3:6].any()
    np.testing.assert_array_equal(rows[:, 9:12], directional(1).shN[:, :, 0])
    assert not rows[:, 12:24].any()
    np.testing.assert_array_equal(read_splats(tmp_path / "b.ply").shN[:, :3], directional(1).shN)
    for words in (
        ("b.sog", "--layout", "inria"),
        ("c.ply", "--layout", "inria", "--sh-degree", "0"),
    ):
        assert command_line("convert", "a.ply", *words, cwd=tmp_path)[0] != 0


def test_convert_scales_then_rotates_then_translates(
    tmp_path: Path, command_line: CommandLine
) -> None:
    scene = directional()
    write_splats(tmp_path / "a.ply", scene)
    words = ("--scale", "2", "--rotate", "90,0,90", "--translate", "1,2,3")
    succeeds(command_line, tmp_path, "convert", "a.ply", "b.ply", *words)
    x, y, z = 2 * scene.means.astype(float).T
    # about x: y → z, z → −y; then about z: x → y, y → −x
    expected = np.stack([z + 1, x + 2, y + 3], 1)
    np.testing.assert_allclose(read_splats(tmp_path / "b.ply").means, expected, atol=1e-5)
