"""Files and folders of other programs are named for what they are."""

import gzip
import io
import json
import re
import zipfile
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from g2ard.errors import InputError
from g2ard.io import kind, write_points, write_splats
from g2ard.io.signs import SIGNS, Sign, sign_of
from g2ard.io.source import Source
from g2ard.io.types import Points
from g2ard.io.views import read_view_set
from helpers.cloud_files import las
from helpers.opened import read_scene
from helpers.ply_files import scene
from helpers.view_files import colmap, orbit

TILESET = {"asset": {"version": "1.1"}, "geometricError": 9, "root": {"children": []}}


@pytest.mark.parametrize("given", ["", "tileset.json"])
@pytest.mark.parametrize("tiles", [0, 2])
def test_tilesets(tmp_path: Path, given: str, tiles: int) -> None:
    (tmp_path / "tileset.json").write_text(json.dumps(TILESET))
    for i in range(tiles):
        (tmp_path / f"0_{i}.b3dm").write_bytes(b"x")
    with pytest.raises(InputError, match=r"tileset\.json: is a tileset of 3D Tiles"):
        read_scene(tmp_path / given)


def gsplat_pngs(folder: Path, names: list[str], extra: dict) -> None:
    folder.mkdir(parents=True)
    meta = {}
    for name in names:
        meta[name] = {"shape": [4, 3], "dtype": "float32", "mins": [0], "maxs": [1]} | extra
        Image.new("L", (2, 2)).save(folder / f"{name}.png")
    (folder / "meta.json").write_text(json.dumps(meta))


@pytest.mark.parametrize("given", ["", "meta.json"])
@pytest.mark.parametrize("name", ["scene", "compression/rank0"])
@pytest.mark.parametrize(
    ("names", "extra"),
    [
        (["means", "scales", "quats", "opacities", "sh0"], {}),
        (["means", "scales", "quats", "opacities", "sh0", "shN"], {"quantization": 6}),
    ],
)
def test_pngs_of_gsplat(
    tmp_path: Path, given: str, name: str, names: list[str], extra: dict
) -> None:
    gsplat_pngs(tmp_path / name, names, extra)
    with pytest.raises(InputError, match="gsplat"):
        read_scene(tmp_path / name / given)


def sample(sign: Sign) -> tuple[str, bytes]:
    """Return the name and the content of a file of this kind, made from its row."""
    name = sign.names.split()[0].replace("*", "a")
    content = (
        b"\0\7" if sign.names != "*" and not (sign.starts or sign.words) else b" ".join(sign.words)
    )
    if sign.words and sign.words[0].startswith(b"numbers:"):
        times = [
            f"{i} 2 3 4 0 0 0 1" if b"unit" in sign.words[0] else f"1 0 0 {i} 0 1 0 3 0 0 1 4"
            for i in range(4)
        ]
        return name, "\n".join(times).encode()
    if sign.starts[:1] == (b"PK\3\4",) and sign.words:
        packed = io.BytesIO()
        with zipfile.ZipFile(packed, "w") as bundle:
            for word in sign.words:
                bundle.writestr(word.decode(), b"")
        return name, packed.getvalue()
    if sign.starts == (b"\x1f\x8b",):
        return name, gzip.compress(content)
    return name, bytes(sign.at) + (sign.starts[0] if sign.starts else b"") + b" " * bool(
        content
    ) + content


@pytest.mark.parametrize("sign", SIGNS, ids=lambda sign: f"{sign.what} {sign.names}"[:60])
def test_every_kind_is_told_from_its_row(tmp_path: Path, sign: Sign) -> None:
    name, content = sample(sign)
    file = tmp_path / (name if name != "*" and "." in name else "thing.dat")
    file.write_bytes(content)
    assert sign_of(file) == sign
    if sign.reads:
        return
    for path in (file, tmp_path):  # itself, and in a folder
        with pytest.raises(InputError) as caught:
            kind(path)
        assert sign.what in str(caught.value)
        assert sign.todo in str(caught.value)
        assert "estimate them with" not in str(caught.value)


@pytest.mark.parametrize(
    "sign", [sign for sign in SIGNS if sign.poses], ids=lambda sign: sign.what[:60]
)
def test_poses_beside_photos_are_named(tmp_path: Path, sign: Sign) -> None:
    name, content = sample(sign)
    (tmp_path / "images").mkdir()
    Image.new("RGB", (8, 6)).save(tmp_path / "images" / "a.png")
    (tmp_path / "deep" / "er").mkdir(parents=True)
    (tmp_path / "deep" / "er" / (name if "." in name else "cameras.txt")).write_bytes(content)
    with pytest.raises(InputError, match=re.escape(sign.what)) as caught:
        kind(tmp_path)
    assert "estimate them" not in str(caught.value)


POINTER = b"version https://git-lfs.github.com/spec/v1\noid sha256:0123\nsize 15600213\n"
NAMES = "a.ply a.splat a.ksplat a.spz a.sog a.glb a.gltf a.usdc a.las a.laz a.e57 a.pcd a.xyz a.txt a.json"
TABLES = "meta.json cameras.bin images.bin points3D.bin cameras.json transforms.json poses_bounds.npy config.yml"


@pytest.mark.parametrize("name", f"{NAMES} {TABLES}".split())
@pytest.mark.parametrize("content", [POINTER, b"\n<!DOCTYPE html>\n<html>"], ids=["lfs", "html"])
def test_pointers_and_pages_in_place_of_any_file(tmp_path: Path, name: str, content: bytes) -> None:
    (tmp_path / name).write_bytes(content)
    with pytest.raises(InputError, match=r"LFS|HTML"):
        kind(tmp_path / name)


def test_pointers_beside_the_given_file(tmp_path: Path) -> None:
    colmap(tmp_path, orbit(4), text=False)
    (tmp_path / "sparse" / "0" / "images.bin").write_bytes(POINTER)
    with pytest.raises(InputError, match=r"images\.bin: is a pointer of Git LFS"):
        read_view_set(tmp_path)


@pytest.mark.parametrize(
    "sign", [sign for sign in SIGNS if sign.reads], ids=lambda sign: sign.reads
)
def test_a_splat_of_another_format_is_named(tmp_path: Path, sign: Sign) -> None:
    content = sample(sign)[1]
    (tmp_path / "a.splat").write_bytes(content + bytes(-len(content) % 32))
    with pytest.raises(InputError, match=re.escape(sign.what)):
        read_scene(tmp_path / "a.splat")


@pytest.mark.parametrize("what", ["text", "noise"])
def test_a_splat_of_impossible_values_is_refused(tmp_path: Path, what: str) -> None:
    noise = np.random.default_rng(0).integers(0, 256, 3200, dtype=np.uint8).tobytes()
    (tmp_path / "a.splat").write_bytes(
        noise if what == "noise" else b"a row of a table of words, and 1" * 100
    )
    with pytest.raises(InputError, match=r"is not a \.splat"):
        read_scene(tmp_path / "a.splat")


BINARY = ["ply", "compressed.ply", "splat", "spz", "sog", "glb", "las", "laz", "pcd"]


def as_text(data: bytes) -> bytes:
    """Return what FTP's text mode and git's autocrlf make of a file."""
    return data.replace(b"\r\n", b"\n").replace(b"\n", b"\r\n")


@pytest.mark.parametrize(
    "name",
    ["a.ply", "a.compressed.ply", "a.splat", "a.spz", "a.sog", "a.glb", "a.las", "a.laz", "a.pcd"],
)
def test_files_that_a_transfer_changed_are_refused(tmp_path: Path, name: str) -> None:
    truth, path = scene(3000, 0), tmp_path / name
    if path.suffix in (".las", ".laz"):
        las(path, truth.means, np.full((3000, 3), 7))
    elif path.suffix == ".pcd":
        head = b"FIELDS x y z r g b\nSIZE 4 4 4 4 4 4\nTYPE F F F F F F\nPOINTS 3000\nDATA binary\n"
        path.write_bytes(head + np.hstack([truth.means, truth.means]).astype("<f4").tobytes())
    else:
        write_splats(path, truth)
    source = Source(path)
    assert source.count == 3000
    (tmp_path / "b").mkdir()
    changed = tmp_path / "b" / name
    changed.write_bytes(as_text(path.read_bytes()))
    with pytest.raises(InputError, match=r"transfer as text|damaged"):
        Source(changed).count


@pytest.mark.parametrize("name", ["a.ply", "a.compressed.ply", "cloud.ply"])
def test_bytes_after_the_last_row_are_refused(tmp_path: Path, name: str) -> None:
    truth, path = scene(3000, 0), tmp_path / name
    if name == "cloud.ply":
        write_points(path, Points(truth.means.astype(float), np.full((3000, 3), 0.5, np.float32)))
    else:
        write_splats(path, truth)
    head, end, rows = path.read_bytes().partition(b"end_header\n")
    for changed in (rows.replace(b"\n", b"\n\n"), rows + rows[-200:]):
        path.write_bytes(head + end + changed + b"\1")
        with pytest.raises(InputError, match=r"bytes after its last row: a transfer as text"):
            Source(path).count
    path.write_bytes(head + end + rows + b"\r\n\0\0")
    assert Source(path).count == 3000


@pytest.mark.parametrize("suffix", [" (1)", "", "_1", ".ply (2)", ".download2", ".bak", ".ply.txt"])
def test_unknown_suffixes_of_known_content(tmp_path: Path, suffix: str) -> None:
    write_splats(tmp_path / "a.ply", scene())
    path = (tmp_path / "a.ply").rename(tmp_path / f"b{suffix}")
    with pytest.raises(InputError, match=r"is a \.ply file.*rename it to b.*\.ply$"):
        kind(path)


def test_a_photo_is_not_to_be_renamed_to_its_own_name(tmp_path: Path) -> None:
    Image.new("RGB", (8, 6)).save(tmp_path / "a.jpg")
    with pytest.raises(
        InputError, match=r"unknown format '\.jpg' \(scenes: \.ply, \.compressed\.ply, "
    ):
        kind(tmp_path / "a.jpg")


@pytest.mark.parametrize("suffix", ["crdownload", "part", "partial", "download", "opdownload"])
def test_unfinished_downloads(tmp_path: Path, suffix: str) -> None:
    write_splats(tmp_path / "a.ply", scene())
    path = (tmp_path / "a.ply").rename(tmp_path / f"a.ply.{suffix}")
    with pytest.raises(InputError, match="is an unfinished download"):
        kind(path)
