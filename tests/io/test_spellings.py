"""Scenes as other programs spell them: groups of rows, numbers of other languages, archives, drafts."""

import json
from pathlib import Path

import numpy as np
import pytest
from plyfile import PlyData, PlyElement

from g2ard.io import write_splats
from g2ard.io.glb import EXTENSION
from helpers.glb_files import glb_parts, write_glb
from helpers.opened import read_scene
from helpers.ply_files import columns, save, scene
from helpers.sog_files import parts, zipped


def element(name: str, degree: int, seed: int) -> PlyElement:
    table = columns(scene(10, degree, seed))
    rows = np.empty(10, [(key, "f4") for key in table])
    for key, values in table.items():
        rows[key] = values
    return PlyElement.describe(rows, name)


@pytest.mark.parametrize("degrees", [(0, 1, 2, 3), (1, 3), (2,)])
@pytest.mark.parametrize("text", [False, True])
def test_groups_by_degree(tmp_path: Path, degrees: tuple[int, ...], text: bool) -> None:
    groups = [element(f"vertex_{degree}", degree, degree) for degree in degrees]
    PlyData(groups, text=text).write(str(tmp_path / "a.ply"))
    found = read_scene(tmp_path / "a.ply").splats
    for i, degree in enumerate(degrees):
        wanted, own = scene(10, degree, degree), found.take(slice(10 * i, 10 * i + 10))
        np.testing.assert_allclose(own.means, wanted.means, rtol=1e-5)
        rest = (degree + 1) ** 2 - 1
        np.testing.assert_allclose(own.shN[:, :rest], wanted.shN, rtol=1e-4, atol=1e-6)
        assert not own.shN[:, rest:].any()


@pytest.mark.parametrize(("old", "new"), [(".", ","), (" ", ", "), (" ", "; ")])
def test_text_of_other_languages(tmp_path: Path, old: str, new: str) -> None:
    wanted = scene(10, 0)
    save(tmp_path / "a.ply", columns(wanted), text=True)
    head, end, body = (tmp_path / "a.ply").read_text().partition("end_header\n")
    (tmp_path / "a.ply").write_text(head + end + body.replace(old, new))
    np.testing.assert_allclose(read_scene(tmp_path / "a.ply").splats.means, wanted.means, rtol=1e-5)


@pytest.mark.parametrize("word", ["-nan(ind)", "nan(snan)", "1.#QNAN", "-1.#IND"])
def test_what_windows_writes_for_no_number(tmp_path: Path, word: str) -> None:
    save(tmp_path / "a.ply", columns(scene(10, 0)), text=True)
    head, end, body = (tmp_path / "a.ply").read_text().partition("end_header\n")
    rows = [line.split() for line in body.splitlines()]
    rows[3][0] = word
    (tmp_path / "a.ply").write_text(head + end + "\n".join(map(" ".join, rows)) + "\n")
    found = read_scene(tmp_path / "a.ply")
    assert len(found.splats) == 9
    assert [note.code for note in found.notes] == ["dropped_rows"]


def test_chunks_of_streamed_sog_as_archives(tmp_path: Path) -> None:
    for name in ("0_0.sog", "env/sky.sog"):
        (tmp_path / name).parent.mkdir(exist_ok=True)
        zipped(tmp_path / name, parts())
    leaf = {"lods": {"0": {"file": 0, "offset": 0, "count": 10}}}
    content = {"filenames": ["0_0.sog"], "tree": leaf, "environment": "env/sky.sog"}
    (tmp_path / "lod-meta.json").write_text(json.dumps(content))
    for path in (tmp_path, tmp_path / "lod-meta.json"):
        assert len(read_scene(path).splats) == 20


@pytest.mark.parametrize("below", ["", "scene\\", "a b\\scene\\"])
def test_archives_with_backslashes(tmp_path: Path, below: str) -> None:
    files = {below + name: content for name, content in parts().items()}
    assert len(read_scene(zipped(tmp_path / "a.sog", files)).splats) == 10


@pytest.mark.parametrize("prefix", ["_", f"{EXTENSION}:"])
@pytest.mark.parametrize("opacity", [False, True])
def test_drafts_of_gltf(tmp_path: Path, prefix: str, opacity: bool) -> None:
    wanted = scene(10, 0)
    write_splats(tmp_path / "a.glb", wanted)
    document, binary = glb_parts(tmp_path / "a.glb")
    names = document["meshes"][0]["primitives"][0]["attributes"]
    kept = ["SCALE", "ROTATION", *(["OPACITY"] if opacity else [])]
    for name in list(names):
        if name.startswith(EXTENSION):
            plain, at = name.split(":")[1], names.pop(name)
            names |= {prefix + plain: at} if plain in kept else {}
    found = read_scene(write_glb(tmp_path / "b.glb", document, binary))
    np.testing.assert_allclose(found.splats.scales, wanted.scales, rtol=1e-5)
    np.testing.assert_allclose(found.splats.opacities, wanted.opacities, atol=1e-4)
    assert [note.code for note in found.notes] == ["first_draft"]
