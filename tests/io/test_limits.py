"""Claims past the limits: one line that names the file, and nothing is written."""

import gzip
import json
import math
import struct
import sys
import zlib
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from g2ard.errors import InputError
from g2ard.io import kind, read_splats, read_view_set, write_splats, write_views
from g2ard.io.photos import load_photo
from g2ard.scene.splats import Splats, unit_quats
from g2ard.stages.simplify import simplify
from helpers.commands import CommandLine
from helpers.glb_files import glb_parts, write_glb
from helpers.opened import read_scene
from helpers.packed_files import truth
from helpers.sog_files import parts, zipped
from helpers.trainer_files import inria
from helpers.view_files import colmap, edit, orbit, transforms, views

ODD_QUATS = np.float32([[1e30, 1e30, 0, 0], [-2, 0, 0, 0], [3e-30, 0, 4e-30, 0], [0, 0, 0, 0]])
UNIT_QUATS = np.float32([[0.5**0.5, 0.5**0.5, 0, 0], [-1, 0, 0, 0], [0.6, 0, 0.8, 0], [1, 0, 0, 0]])


def odd_scene() -> Splats:
    return Splats.create(10 * np.eye(4, 3), quats=ODD_QUATS, scales=np.full((4, 3), 0.1))


@pytest.mark.parametrize("suffix", [".ply", ".splat"])
def test_written_quaternions_have_length_1(tmp_path: Path, suffix: str) -> None:
    path = tmp_path / f"a{suffix}"
    write_splats(path, odd_scene())
    found = read_splats(path)
    order = np.argsort(-found.means[:, :3] @ [4, 2, 1])  # .splat sorts its rows
    expected = UNIT_QUATS[np.argsort(-odd_scene().means @ [4, 2, 1])]
    np.testing.assert_allclose(
        found.quats[order], expected, atol=1e-7 if suffix == ".ply" else 1 / 64
    )


@pytest.mark.parametrize("method", ["default", "fast", "paper"])
def test_rows_that_stay_alone_leave_with_unit_quaternions(method: str) -> None:
    quats = simplify(odd_scene(), 4, method=method).splats.quats
    np.testing.assert_allclose(np.linalg.norm(quats.astype(np.float64), axis=1), 1, atol=1e-6)


def test_quaternions_of_length_1_keep_every_bit() -> None:
    rng = np.random.default_rng(0)
    wide = rng.normal(size=(5000, 4))
    quats = (wide / np.linalg.norm(wide, axis=1, keepdims=True)).astype(np.float32)
    assert unit_quats(quats) is quats
    broken = np.float32([[np.nan, 0, 0, 0], [np.inf, 0, 0, 0]])
    np.testing.assert_array_equal(unit_quats(broken), broken)


COMMENTS = ["comment", "comment end_header", "comment the end_header line", "comment\tx"]


@pytest.mark.parametrize("comment", COMMENTS)
@pytest.mark.parametrize(
    "after", ["ply", "element vertex 9", "property float y", "property float rot_3"]
)
def test_comments_anywhere_in_a_ply_header(tmp_path: Path, comment: str, after: str) -> None:
    path = tmp_path / "a.ply"
    write_splats(path, truth(9, 0))
    content = path.read_bytes()
    path.write_bytes(
        content.replace(f"\n{after}\n".encode(), f"\n{after}\n{comment}\n".encode(), 1)
    )
    if after == "ply":
        path.write_bytes(content.replace(b"ply\n", f"ply\n{comment}\n".encode(), 1))
    assert path.read_bytes() != content
    assert len(read_splats(path)) == 9


def header(path: Path, old: str, new: bytes) -> Path:
    write_splats(path, truth(9, 0))
    path.write_bytes(path.read_bytes().replace(old.encode(), new, 1))
    return path


def frames(path: Path, change: Callable[[dict], object]) -> Path:
    """A transforms.json with something changed."""
    transforms(path, orbit(2))
    edit(path, change)
    return path


def angle(path: Path, value: float) -> Path:
    def change(content: dict) -> None:
        for where in (content, *content["frames"]):
            for key in ("fl_x", "fl_y", "camera_angle_y"):
                where.pop(key, None)
        content["camera_angle_x"] = value

    return frames(path, change)


def written(path: Path, content: bytes) -> Path:
    path.write_bytes(content)
    return path


HUGE = {"width": 4_000_000_000, "height": 4_000_000_000}


def huge_views(path: Path) -> Path:
    write_views(path, views(2))
    edit(path, lambda content: [view.update(HUGE) for view in content["views"]])
    return path


def huge_colmap(folder: Path) -> Path:
    project = colmap(folder / "project", orbit(2), text=False)
    table = project / "sparse" / "0" / "cameras.bin"
    data = bytearray(table.read_bytes())
    struct.pack_into("<QQ", data, 16, 4_000_000_000, 4_000_000_000)
    table.write_bytes(data)
    return project


def huge_inria(path: Path) -> Path:
    return inria(path, orbit(3), **HUGE)


def node_tree(path: Path, nodes: list[dict], changed: dict[str, Any] | None = None) -> Path:
    """A .glb with these nodes, and other parts of its document changed."""
    write_splats(path, truth(9, 0), overwrite=True)
    document, binary = glb_parts(path)
    return write_glb(path, {**document, "nodes": nodes, **(changed or {})}, binary)


def png(width: int, height: int) -> bytes:
    """A whole PNG of zeros, a thousandth of its pixels large."""

    def chunk(kind: bytes, data: bytes) -> bytes:
        return (
            struct.pack(">I", len(data)) + kind + data + struct.pack(">I", zlib.crc32(kind + data))
        )

    packer = zlib.compressobj(9)
    rows = b"".join(packer.compress(bytes(1 + width)) for _ in range(height)) + packer.flush()
    head = chunk(b"IHDR", struct.pack(">IIBBBBB", width, height, 8, 0, 0, 0, 0))
    return b"\x89PNG\r\n\x1a\n" + head + chunk(b"IDAT", rows) + chunk(b"IEND", b"")


def sog(path: Path, changed: dict[str, bytes]) -> Path:
    return zipped(path, parts() | changed)


def sog_count(path: Path, count: int) -> Path:
    return sog(
        path,
        {"meta.json": json.dumps({**json.loads(parts()["meta.json"]), "count": count}).encode()},
    )


def spz_claim(path: Path, version: int, count: int) -> Path:
    """An .spz that says it holds `count` Gaussians, and does: all zeros."""
    write_splats(path, truth(9, 0), spz_version=version)
    if version == 4:
        data = bytearray(path.read_bytes())
        struct.pack_into("<I", data, 8, count)
        return written(path, bytes(data))
    head = bytearray(gzip.decompress(path.read_bytes())[:16])
    struct.pack_into("<I", head, 8, count)
    return written(path, gzip.compress(bytes(head) + bytes(20 * count)))


CLAIMS: dict[str, tuple[Callable[[Path], Path], str]] = {
    "ply of 2**63 rows": (
        lambda f: header(f / "a.ply", "vertex 9", b"vertex %d" % 2**63),
        "truncated",
    ),
    "ply of 2**62 rows": (
        lambda f: header(f / "a.ply", "vertex 9", b"vertex %d" % 2**62),
        "truncated",
    ),
    "ply of 10**30 rows": (
        lambda f: header(f / "a.ply", "vertex 9", b"vertex 1" + b"0" * 30),
        "truncated",
    ),
    "ply of 10**5000 rows": (
        lambda f: header(f / "a.ply", "vertex 9", b"vertex 1" + b"0" * 5000),
        "line 4",
    ),
    "ply not in ascii, another name": (
        lambda f: header(f / "a.ply", "float opacity", "float opacité".encode()),
        "'opacity'",
    ),
    "views of 4e9 pixels a side": (
        lambda f: huge_views(f / "a.json"),
        "4,000,000,000×4,000,000,000",
    ),
    "colmap of 4e9 pixels a side": (huge_colmap, "4,000,000,000×4,000,000,000"),
    "inria of 4e9 pixels a side": (
        lambda f: huge_inria(f / "cameras.json"),
        "4,000,000,000×4,000,000,000",
    ),
    "transforms of 4e9 pixels a side": (
        lambda f: frames(f / "a.json", lambda c: c.update(w=4e9, h=4e9)),
        "4,000,000,000×4,000,000,000",
    ),
    "transforms of 1e300 pixels a side": (
        lambda f: frames(f / "a.json", lambda c: c.update(w=1e300, h=1e300)),
        "the limit is 160,000,000",
    ),
    "nested": (lambda f: written(f / "a.json", b"[" * 100_000 + b"]" * 100_000), "nested"),
    "nested objects": (
        lambda f: written(f / "a.json", b'{"a":' * 100_000 + b"1" + b"}" * 100_000),
        "nested",
    ),
    "an integer of 5000 digits": (
        lambda f: written(f / "a.json", b"[1" + b"0" * 5000 + b"]"),
        "digits",
    ),
    "angle 0": (lambda f: angle(f / "a.json", 0.0), "camera_angle_x"),
    "angle pi": (lambda f: angle(f / "a.json", math.pi), "camera_angle_x"),
    "angle nan": (lambda f: angle(f / "a.json", math.nan), "camera_angle_x"),
    "gzip bomb": (lambda f: spz_claim(f / "a.spz", 3, 4_000_000), "would unpack to 80,000,000"),
    "zstd claim": (lambda f: spz_claim(f / "a.spz", 4, 4_000_000), "would unpack to"),
    "zip bomb": (
        lambda f: sog(f / "a.sog", {"low.webp": bytes(80_000_000)}),
        "would unpack to 80,000,000",
    ),
    "png bomb": (lambda f: sog(f / "a.sog", {"low.webp": png(20_000, 10_000)}), "160,000,000"),
    "sog of 10**15 rows": (lambda f: sog_count(f / "a.sog", 10**15), "pixels for"),
    "sog with nested meta": (lambda f: sog(f / "a.sog", {"meta.json": b"[" * 100_000}), "nested"),
}


@pytest.mark.parametrize("what", CLAIMS)
@pytest.mark.filterwarnings("ignore::PIL.Image.DecompressionBombWarning")
def test_a_claim_past_the_limits_is_one_line(what: str, tmp_path: Path) -> None:
    make, words = CLAIMS[what]
    path = make(tmp_path)
    with pytest.raises(InputError) as caught:
        {"splats": read_scene, "views": read_view_set}[kind(path)](path)
    line = str(caught.value)
    assert str(path) in line
    assert words in line
    assert "\n" not in line


MESH = {"mesh": 0}


def test_a_long_chain_of_nodes_is_followed_once(tmp_path: Path) -> None:
    """Each node is visited a few times, not once per descendant."""
    count = 20_000
    nodes: list[dict[str, Any]] = [
        MESH,
        *({"children": [i], "translation": [0, 0, 1]} for i in range(count)),
    ]
    path = node_tree(tmp_path / "a.glb", nodes)
    assert read_scene(path).splats.offset.tolist() == [0, 0, count]


@pytest.mark.filterwarnings("error")
def test_a_signalling_nan_in_a_glb_drops_its_row(tmp_path: Path) -> None:
    for at in range(6):
        path = tmp_path / f"{at}.glb"
        write_splats(path, truth(9, 0))
        document, binary = glb_parts(path)
        start = len(path.read_bytes()) - len(binary) + document["bufferViews"][at]["byteOffset"]
        data = bytearray(path.read_bytes())
        struct.pack_into("<I", data, start, 0x7F800001)
        found = read_scene(written(path, bytes(data)))
        dropped = "COLOR_0" not in list(document["meshes"][0]["primitives"][0]["attributes"])[at]
        assert len(found.splats) == 9 - dropped


def test_nothing_is_written_after_such_a_claim(command_line: CommandLine, tmp_path: Path) -> None:
    path = CLAIMS["gzip bomb"][0](tmp_path)
    before = sorted(tmp_path.rglob("*"))
    status, _, told = command_line("simplify", str(path), "-r", "2", "-o", "out.ply", cwd=tmp_path)
    assert (status, sorted(tmp_path.rglob("*"))) == (1, before)
    assert str(path.name) in told


def test_zstd_frames_are_unpacked_up_to_their_size() -> None:
    from g2ard.io.spz import _unpacked

    if sys.version_info >= (3, 14):
        from compression import zstd
    else:
        from backports import zstd
    assert len(_unpacked(zstd.compress(bytes(80_000_000)), 1000)) == 1001


def test_huge_photos_are_rejected_before_decoding(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    monkeypatch.setattr(
        "g2ard.scene.cameras.LARGEST_IMAGE", 1_000_000
    )  # Pillow warns of what is near the true limit
    side = 1001
    head = png(1, 1).replace(struct.pack(">II", 1, 1), struct.pack(">II", side, side))
    crc = struct.pack(">I", zlib.crc32(head[12:29]))
    image = tmp_path / "images" / "0.png"
    image.parent.mkdir()
    image.write_bytes(head[:29] + crc + head[33:])
    cameras = views(1).take([0])
    with pytest.raises(InputError, match=r"0\.png.*1,001×1,001 pixels; the limit is 1,000,000"):
        load_photo(replace(cameras, image_paths=(image,)), 0)


@pytest.mark.parametrize("place", ["images", "elsewhere"])
@pytest.mark.parametrize("sized", [True, False])
def test_a_broken_photo_is_named_with_its_list(tmp_path: Path, place: str, sized: bool) -> None:
    folder = tmp_path / place
    folder.mkdir()
    (folder / "notes.png").write_text("no image")

    def change(content: dict) -> None:
        content["frames"] = content["frames"][:1]
        content["frames"][0]["file_path"] = f"{place}/notes.png"
        if not sized:
            for where in (content, content["frames"][0]):
                where.pop("w", None)
                where.pop("h", None)

    path = frames(tmp_path / "a.json", change)
    with pytest.raises(InputError, match="not an image") as caught:
        load_photo(read_view_set(path).cameras, 0)
    assert str(path) in str(caught.value)
    assert str(folder / "notes.png") in str(caught.value)
