"""No damaged file ends in a traceback: readers answer with sound data or one line of InputError."""

import gzip
import json
import math
import re
import struct
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from fuzz_readers import break_rules, fuzz, read_checked
from g2ard.io import kind, read_view_set
from helpers.faults import Fault, faulty
from helpers.glb_files import glb_parts, write_glb
from helpers.opened import read_scene
from helpers.project import ROOT
from helpers.reader_cases import MAKERS, READ
from helpers.view_files import orbit, transforms

SAMPLED = 5
"""Every fifth malformed file is read here, each one in `make fuzz`. No rule breaks 5, 10 or 15 things."""


@pytest.mark.filterwarnings("ignore")
@pytest.mark.parametrize("what", MAKERS)
def test_malformed_files_end_in_one_line_that_names_them(tmp_path: Path, what: str) -> None:
    tally = break_rules(what, MAKERS[what], tmp_path, SAMPLED)
    assert set(tally) <= {"read", "refused"}, tally
    assert tally["refused"] >= 8, tally


ABSENT = object()
MESH, NODE_FAR = {"mesh": 0}, {"translation": [1e308] * 3}
FAULTS: dict[str, list[tuple[str, Any, Fault]]] = {
    "transforms": [
        ("frames", [], "no views found"),
        ("frames.0", 7, (None, 0)),
        ("frames.1.file_path", ABSENT, ("file_path", 1)),
        ("frames.1.file_path", "images/000.png", "2 views are named '000.png'"),
        ("frames.1.transform_matrix", [[1, 2], [3, 4]], ("transform_matrix[2]", 1)),
        ("frames.0.transform_matrix", np.diag([1, 1, -1, 1]).tolist(), ("transform_matrix", 0)),
        ("frames.0.transform_matrix", np.diag([1, 2, 3, 1]).tolist(), ("transform_matrix", 0)),
        ("frames.0.transform_matrix", "x", ("transform_matrix", 0)),
        ("frames.0.transform_matrix.0.0", "x" * 999, ("transform_matrix[0][0]", 0)),
        ("frames.1.transform_matrix.1.1", {}, ("transform_matrix[1][1]", 1)),
        ("frames.1.transform_matrix.2.1", [], ("transform_matrix[2][1]", 1)),
        ("frames.1.transform_matrix.2.3", ABSENT, ("transform_matrix[2][3]", 1)),
        ("frames.0.k1", [], ("k1", 0)),
        ("frames.0.k1", "x", ("k1", 0)),
        ("frames.1.k4", 0.1, ("k4", 1)),
        ("frames.0.k5", 0.1, ("k5", 0)),
        ("k4", -2, ("k4", 0)),
        ("s3", 1e-3, ("s3", 0)),
        ("w", ABSENT, (None, 0)),
        ("w", 8.5, ("w", 0)),
        ("frames.1.h", 6.25, ("h", 1)),
        ("fl_x", ABSENT, (None, 0)),
        ("fl_x", -3, (None, 0)),
        ("camera_model", "ORTHOPHOTO", "ORTHOPHOTO"),
        ("camera_model", "EQUIRECTANGULAR", (None, 0)),
    ],
    "views": [
        ("version", 2, "version 2"),
        ("views", [], "no views found"),
        ("views.0.K", ABSENT, ("K", 0)),
        ("views.1.K", [1, 2], ("K[2]", 1)),
        ("views.0.K", [[1e308, 0, 1], [0, 9, 1], [0, 0, 1]], (None, 0)),
        ("views.1.weight", -1, ("weight", 1)),
        ("views.1.width", 80.5, ("width", 1)),
        ("views.0.height", math.inf, ("height", 0)),
        ("views.0.camera_from_world", np.zeros((4, 4)).tolist(), ("camera_from_world", 0)),
        ("views.0.split", 3, ("split", 0)),
        ("views.0.name", 3, ("name", 0)),
        ("views.0.distortion", [math.nan] * 5, ("distortion[0]", 0)),
        ("views.0.distortion", [1e300], (None, 0)),
    ],
    "cameras.json": [
        ("1.fx", ABSENT, ("fx", 1)),
        ("1.fx", "wide", ("fx", 1)),
        ("1.fx", 0, (None, 1)),
        ("1.rotation", np.zeros((3, 3)).tolist(), ("rotation", 1)),
        ("1.rotation", np.diag([1.0, 1, -1]).tolist(), ("rotation", 1)),
        ("1.position", [0, math.nan, 0], ("position[1]", 1)),
        ("1.position", [0, 1], ("position[2]", 1)),
        ("1.position", 3, ("position", 1)),
        ("1.width", 80.5, ("width", 1)),
    ],
    "dataparser_transforms.json": [
        ("transform", None, ("transform", None)),
        ("transform", [[1, 2], [3, 4]], ("transform[2]", None)),
        ("transform", (2 * np.eye(4)[:3]).tolist(), ("transform", None)),
        ("scale", 0, ("scale", None)),
        ("scale", "big", ("scale", None)),
    ],
    "transforms of a run": [
        ("applied_scale", 0, ("applied_scale", None)),
        ("applied_scale", "x", ("applied_scale", None)),
        ("applied_transform", [[1], [2, 3]], ("applied_transform[2]", None)),
        ("train_filenames", 5, ("train_filenames", None)),
    ],
    "meta.json": [
        ("version", 3, ("version", None)),
        ("count", "ten", ("count", None)),
        ("count", True, ("count", None)),
        ("count", 0, "has no Gaussians"),
        ("means", [], ("means", None)),
        ("means", {}, ("means.files", None)),
        ("means.mins", {}, ("means.mins", None)),
        ("means.mins", [0, 1], ("means.mins[2]", None)),
        ("means.mins", [0, None, 1], ("means.mins[1]", None)),
        ("means.maxs", [0, 1, 1e308], ("means.maxs[2]", None)),
        ("means.maxs", math.inf, ("means.maxs", None)),
        ("means.files", {}, ("means.files", None)),
        ("scales.files", [5], ("scales.files[0]", None)),
        ("scales.files", ["a\nb"], ("scales.files[0]", None)),
        ("scales.files", [""], ("scales.files[0]", None)),
        ("scales.codebook", 5, ("scales.codebook", None)),
        ("scales.codebook", [1.0], ("scales.codebook", None)),
        ("quats", "x", ("quats", None)),
        ("quats.files", [], ("quats.files[0]", None)),
        ("sh0.codebook", [0, -1e308] * 128, ("sh0.codebook[1]", None)),
        ("shN.codebook", ["x"] * 256, ("shN.codebook[0]", None)),
        ("shN.bands", {}, ("shN.bands", None)),
        ("g2ard", {"offset": [0, "x", 1]}, ("g2ard.offset[1]", None)),
    ],
    "lod-meta.json": [
        ("filenames", ["a" * 5000 + "/meta.json"], ("filenames[0]", None)),
        ("filenames", [5], ("filenames[0]", None)),
        ("filenames", ["a\n/meta.json"], ("filenames[0]", None)),
        ("tree", [], ("tree", None)),
        ("tree", {"lods": []}, ("tree.lods", None)),
        ("tree", {"lods": {"0": {"file": -1}}}, ("tree.lods.0.file", None)),
        ("tree", {"lods": {"0": {"file": 2}}}, ("tree.lods.0.file", None)),
        ("tree", {"lods": {"0": {"file": 0.5}}}, ("tree.lods.0.file", None)),
        ("tree", {"children": [{}, 5]}, ("tree.children[1]", None)),
        ("tree", {"children": {}}, ("tree.children", None)),
    ],
    "glb": [
        ("nodes", [MESH, {"children": [-2]}], ("nodes[1].children[0]", None)),
        ("nodes", [MESH, {"children": [0, 2]}], ("nodes[1].children[1]", None)),
        ("nodes", [MESH, {"children": [[]]}], ("nodes[1].children[0]", None)),
        ("nodes", [MESH, 5], ("nodes[1]", None)),
        ("nodes", [MESH | {"children": [1]}, {"children": [0]}], "node 0 is its own ancestor"),
        ("nodes", [MESH, {"children": [0]}, {"children": [0]}], "node 0 has 2 parents"),
        ("nodes", [MESH | {"translation": [[1], [2], [3]]}], ("nodes[0].translation[0]", None)),
        ("nodes", [MESH | {"translation": [1]}], ("nodes[0].translation[1]", None)),
        (
            "nodes",
            [MESH | NODE_FAR, NODE_FAR | {"children": [0]}],
            r"invalid translation \(inf, inf, inf\)",
        ),
        *(
            (place, index, (re.sub(r"\.(\d+)", r"[\1]", place), None))
            for place in (
                "meshes.0.primitives.0.attributes.POSITION",
                "accessors.0.bufferView",
                "bufferViews.0.buffer",
            )
            for index in (-1, 99, "x", True, None, [])
        ),
    ],
}
"""Kind of file → properties with another value or none, and what the error then names."""


@pytest.mark.filterwarnings("error")
@pytest.mark.parametrize(
    ("what", "place", "value", "fault"),
    [(what, *row) for what, rows in FAULTS.items() for row in rows],
)
def test_a_wrong_property_is_named(
    tmp_path: Path, what: str, place: str, value: Any, fault: Fault
) -> None:
    path = (
        transforms(tmp_path / "a.json", orbit(2), fl_y=None)
        if what == "transforms"
        else MAKERS[what](tmp_path)
    )
    document, binary = glb_parts(path) if what == "glb" else (json.loads(path.read_text()), b"")
    holder: Any = document
    *above, last = [int(key) if key.isdigit() else key for key in place.split(".")]
    for key in above:
        holder = holder[key]
    if value is ABSENT:
        del holder[last]
    else:
        holder[last] = value
    if what == "glb":
        write_glb(path, document, binary)
    else:
        path.write_text(json.dumps(document))
    asked = tmp_path / READ[what] if what in READ else path
    with faulty(path, fault):
        {"splats": read_scene, "views": read_view_set}[kind(asked)](asked)


def packed(head: bytes) -> bytes:
    """Return an .spz of version 3 that begins like this."""
    return gzip.compress(head + bytes(200))


PLY = b"ply\nformat ascii 1.0\n"
DAMAGES: list[tuple[str, Callable[[bytes], bytes], str]] = [
    ("ksplat", lambda data: data[:100], "cut off within its header"),
    ("ksplat", lambda data: data[:4200], "cut off within the headers of 1 sections"),
    ("ksplat", lambda data: data[:-1], "section 0 is cut off"),
    ("ksplat", lambda data: b"\1" + data[1:], "unsupported version 1.1"),
    ("ksplat", lambda data: data[:20] + b"\7" + data[21:], "unsupported compression level 7"),
    ("ksplat", lambda data: data[:4136] + b"\4" + data[4137:], "section 0 .*SH degree 4"),
    (
        "ksplat",
        lambda data: data[:4128] + b"\xff" + data[4129:],
        "section 0 has inconsistent buckets",
    ),
    ("ksplat", lambda data: data[:5120] + bytes(4) + data[5124:], "section 0 has more rows"),
    ("glb", lambda data: data[:10], "not a .glb"),
    ("glb", lambda data: data[: len(data) // 2], "truncated|broken"),
    ("glb", lambda data: data.replace(b'"ellipse"', b'"boxes!!"'), "kernel"),
    (
        "glb",
        lambda data: data.replace(b"splatting:SCALE", b"splatting:SCALY"),
        "SCALE.* is missing",
    ),
    (
        "glb",
        lambda data: data.replace(b'"count":9,', b'"count":99,', 1).replace(b"g2ard", b"g2ar"),
        "truncated",
    ),
    ("spz 3", lambda data: packed(b"NOPE"), "not an SPZ"),
    ("spz 3", lambda data: b"", "not an SPZ"),
    (
        "spz 3",
        lambda data: packed(b"NGSP" + struct.pack("<IIBBBB", 9, 1, 0, 12, 0, 0)),
        "version 9",
    ),
    *(("splat", lambda data, size=size: bytes(size), "multiple of 32") for size in (0, 33)),
    ("sog", lambda data: b"PK\x03\x04nonsense", "not a complete .sog archive"),
    ("poses_bounds.npy", lambda data: b"no array", "not a NumPy array"),
    *(
        (what, lambda data, keep=keep: data[:keep], "cannot be read as LAS|truncated|broken")
        for what in ("las", "laz")
        for keep in (0, 20, 300, -30)
    ),
    ("scene", lambda data: b"", "is empty"),
    ("scene", lambda data: b"PK\x03\x04 a zip", "an archive"),
    ("scene", lambda data: b"plywood\n", "not a PLY"),
    ("scene", lambda data: PLY + b"element vertex 3\n", "end_header"),
    ("scene", lambda data: PLY + b"element vertex many\nend_header\n", "line 3"),
    ("scene", lambda data: PLY + b"property float x\nend_header\n", "line 3"),
    ("scene", lambda data: PLY + b"element face 0\nend_header\n", "no 'vertex' element"),
]


@pytest.mark.parametrize(("what", "damage", "words"), DAMAGES)
def test_damage_is_named(
    tmp_path: Path, what: str, damage: Callable[[bytes], bytes], words: str
) -> None:
    path = MAKERS[what](tmp_path)
    path.write_bytes(damage(path.read_bytes()))
    line = read_checked(path)
    assert line is not None
    assert path.name in line
    assert re.search(words, line)


@pytest.mark.filterwarnings("ignore")
@pytest.mark.parametrize("what", MAKERS)
def test_mutated_files_give_sound_data_or_one_error_line(tmp_path: Path, what: str) -> None:
    tally = fuzz(what, MAKERS[what], tmp_path, runs=40, seed=0)
    assert set(tally) <= {"read", "refused"}, tally


ONCE_BROKEN = sorted((ROOT / "tests" / "fuzz_corpus").iterdir())
"""Files that a reader once answered otherwise, as CASE--WHAT."""


@pytest.mark.filterwarnings("ignore")
@pytest.mark.parametrize("file", ONCE_BROKEN, ids=lambda file: file.name)
def test_files_that_once_broke_a_reader_end_in_one_line(tmp_path: Path, file: Path) -> None:
    what = file.name.partition("--")[0]
    path = MAKERS[what](tmp_path)
    path.write_bytes(file.read_bytes())
    line = read_checked(tmp_path / READ[what] if what in READ else path)
    assert line is not None
    assert "\n" not in line
    assert str(tmp_path) in line
