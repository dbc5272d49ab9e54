"""3DGS .ply: every layout that turns up in the wild is read, every broken file is named."""

from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from plyfile import PlyData

from g2ard.errors import InputError
from g2ard.io import kind, open_stream, read_scene, read_splats, write_splats
from g2ard.io.sanitize import LOG_SCALE_LIMIT, LOGIT_LIMIT
from g2ard.scene.splats import ARRAYS, DRAWN_LOGIT, Splats
from helpers.ply_files import columns, save, scene


def assert_same(a: Splats, b: Splats, rtol: float = 2e-6) -> None:
    for name in ARRAYS:
        np.testing.assert_allclose(getattr(a, name), getattr(b, name), rtol=rtol, atol=1e-7, err_msg=name)
        assert getattr(a, name).dtype == np.float32
        assert getattr(a, name).flags.c_contiguous


@pytest.mark.parametrize("degree", [0, 1, 2, 3])
def test_reads_any_degree_in_any_order(tmp_path: Path, degree: int) -> None:
    truth = scene(degree=degree)
    names = np.random.default_rng(degree).permutation(list(columns(truth)))
    path = save(tmp_path / "odd.ply", {str(name): columns(truth)[name] for name in names})
    found = read_scene(path)
    assert_same(found.splats, truth)
    assert found.notes == ()


ENCODINGS: list[dict[str, object]] = [
    {"byte_order": "<"},
    {"byte_order": ">"},
    {"text": True},
    {"dtype": "f8"},
    {"dtype": "f8", "text": True},
]


@pytest.mark.parametrize("options", ENCODINGS)
def test_reads_any_encoding(tmp_path: Path, options: dict[str, object]) -> None:
    truth = scene(count=7)
    assert_same(read_splats(save(tmp_path / "a.ply", columns(truth), **options)), truth)


@settings(max_examples=25, deadline=None)
@given(count=st.integers(1, 40), degree=st.integers(0, 3), seed=st.integers(0, 2**32), normals=st.booleans())
def test_round_trip(tmp_path_factory, count: int, degree: int, seed: int, normals: bool) -> None:
    path = tmp_path_factory.mktemp("ply") / "a.ply"
    truth = scene(count, degree, seed)
    write_splats(path, truth, normals=normals)
    found = read_scene(path)
    assert_same(found.splats, truth)
    nothing_shows = truth.logit_opacities.max() < DRAWN_LOGIT
    assert [note.code for note in found.notes] == (["invisible"] if nothing_shows else [])


def test_layout_is_the_standard_one(tmp_path: Path) -> None:
    truth = scene(count=20_000, degree=2)  # more than one block
    write_splats(tmp_path / "a.ply", truth)
    assert_same(read_splats(tmp_path / "a.ply"), truth)
    ply = PlyData.read(tmp_path / "a.ply")
    expected = columns(truth)
    assert [p.name for p in ply["vertex"].properties] == list(expected)
    assert (ply.text, ply.byte_order) == (False, "<")
    for name, values in expected.items():
        np.testing.assert_allclose(ply["vertex"][name], values, rtol=1e-6, atol=1e-7)
    size = (tmp_path / "a.ply").stat().st_size
    assert size - len(ply.header) - 1 == truth.nbytes


def test_far_float64_positions_are_recentred(tmp_path: Path) -> None:
    truth = scene()
    far = columns(truth)
    for axis, shift in zip("xyz", (636337.8, 5_427_319.25, 40.0), strict=True):
        far[axis] = far[axis].astype(np.float64) + shift
    found = read_splats(save(tmp_path / "far.ply", far, dtype="f8"))
    assert found.means.dtype == np.float32
    assert np.abs(found.means).max() < 10
    world = found.means + found.offset
    np.testing.assert_allclose(world, np.stack([far[a] for a in "xyz"], 1), atol=1e-6, rtol=0)


def test_extra_properties_are_counted(tmp_path: Path) -> None:
    truth = columns(scene())
    extra = truth | {"nx": truth["x"], "confidence": truth["x"], "label": truth["y"]}
    (note,) = read_scene(save(tmp_path / "a.ply", extra)).notes
    assert (note.code, note.count) == ("ignored_properties", 2)
    assert "confidence" in note.text


def test_degree_four_is_cut(tmp_path: Path) -> None:
    truth = scene(degree=3)
    properties = columns(scene(degree=0))
    for channel in range(3):
        for k in range(24):
            values = truth.shN[:, k, channel] if k < 15 else np.ones(len(truth))
            properties[f"f_rest_{channel * 24 + k}"] = values
    found = read_scene(save(tmp_path / "a.ply", properties))
    np.testing.assert_array_equal(found.splats.shN, truth.shN)
    assert [n.code for n in found.notes] == ["ignored_bands"]


def test_non_finite_rows_are_dropped_and_counted(tmp_path: Path) -> None:
    properties = columns(scene(count=12))
    properties["x"][2] = np.nan
    properties["f_rest_7"][5] = np.inf
    properties["opacity"][6] = np.nan
    properties["scale_1"][9] = np.inf
    properties["rot_3"][11] = -np.inf
    found = read_scene(save(tmp_path / "a.ply", properties))
    keep = np.setdiff1d(np.arange(12), [2, 5, 6, 9, 11])
    assert_same(found.splats, scene(count=12).take(keep))
    assert [(n.code, n.count) for n in found.notes] == [("dropped_rows", 5)]
    assert "row 2" in found.notes[0].text


def test_meaningful_infinities_are_clamped(tmp_path: Path) -> None:
    properties = columns(scene(count=8))
    properties["opacity"][:3] = (np.inf, -np.inf, 40)
    properties["scale_0"][:3] = (90, -np.inf, -80)
    for i in range(4):
        properties[f"rot_{i}"][7] = 0
    found = read_scene(save(tmp_path / "a.ply", properties))
    assert len(found.splats) == 8
    assert {n.code: n.count for n in found.notes} == {
        "clamped_logits": 3,
        "clamped_scales": 3,
        "zero_quats": 1,
    }
    np.testing.assert_array_equal(found.splats.logit_opacities[:3], [LOGIT_LIMIT, -LOGIT_LIMIT, LOGIT_LIMIT])
    assert found.splats.opacities[0] > 0.9999998
    squares = found.splats.scales.astype(np.float32) ** 2
    assert np.isfinite(squares).all()
    assert (squares >= np.finfo(np.float32).tiny).all()
    np.testing.assert_allclose(np.log(found.splats.scales[0, 0]), LOG_SCALE_LIMIT)
    np.testing.assert_array_equal(found.splats.quats[7], [1, 0, 0, 0])


def test_an_invisible_scene_is_noted(tmp_path: Path) -> None:
    properties = columns(scene(count=8))
    for faintest, codes in ((-6, ["invisible"]), (-5, [])):
        properties["opacity"][:] = -7
        properties["opacity"][3] = faintest
        assert [n.code for n in read_scene(save(tmp_path / "a.ply", properties)).notes] == codes


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (lambda p: p | {"y": np.full(3, np.nan)}, "none of its 3 Gaussians is finite"),
        (lambda p: {name: values[:0] for name, values in p.items()}, "has no Gaussians"),
        *[
            (lambda p, name=name: {n: values for n, values in p.items() if n != name}, message)
            for name, message in (
                *((name, f".*'{name}'") for name in ("z", "f_dc_1", "opacity", "scale_1", "rot_0")),
                ("f_rest_4", "expected f_rest_0 to f_rest_n"),
            )
        ],
    ],
)
def test_unusable_rows_and_properties(tmp_path: Path, change: Any, message: str) -> None:
    path = save(tmp_path / "a.ply", change(columns(scene(count=3, degree=1))))
    with pytest.raises(InputError, match=rf"a\.ply: {message}"):
        read_splats(path)


@pytest.mark.parametrize("text", [False, True])
def test_truncated(tmp_path: Path, text: bool) -> None:
    path = save(tmp_path / "a.ply", columns(scene(count=100, degree=0)), text=text)
    path.write_bytes(path.read_bytes()[:-200])
    with pytest.raises(InputError, match=r"a\.ply: .*vertex row \d+ of 100 cannot be read"):
        read_splats(path)


@pytest.mark.parametrize(
    ("content", "message"),
    [
        (b"", "is empty"),
        (b"PK\x03\x04 a zip", "not a PLY"),
        (b"plywood\n", "not a PLY"),
        (b"ply\nformat binary_little_endian 1.0\nelement vertex 3\n", "end_header"),
        (b"ply\nformat ascii 1.0\nelement vertex many\nend_header\n", "line 3"),
        (b"ply\nformat ascii 1.0\nproperty float x\nend_header\n", "line 3"),
        (b"ply\nformat ascii 1.0\nelement face 0\nend_header\n", "no 'vertex' element"),
    ],
)
def test_not_a_ply(tmp_path: Path, content: bytes, message: str) -> None:
    path = tmp_path / "a.ply"
    path.write_bytes(content)
    with pytest.raises(InputError, match=message) as caught:
        read_splats(path)
    assert "a.ply" in str(caught.value)
    assert "\n" not in str(caught.value)


def test_missing_and_unknown_files(tmp_path: Path) -> None:
    with pytest.raises(InputError, match=r"gone\.ply: no such file"):
        read_splats(tmp_path / "gone.ply")
    (tmp_path / "a.obj").write_text("v 0 0 0")
    with pytest.raises(InputError, match=r"unknown format '\.obj'"):
        kind(tmp_path / "a.obj")
    (tmp_path / "a.zip").write_bytes(b"PK\x03\x04")
    for path, advice in ((tmp_path / "a.zip", "unpack the archive"), ("https://a.org/a.ply", "download it")):
        with pytest.raises(InputError, match=advice):
            kind(path)


def test_cloud_is_not_a_scene(tmp_path: Path) -> None:
    path = save(tmp_path / "a.ply", {n: np.zeros(2) for n in ("x", "y", "z", "red", "green", "blue")})
    assert kind(path) == "points"
    for read in (read_splats, open_stream):
        with pytest.raises(InputError, match="expected a Gaussian scene, found a coloured point cloud"):
            read(path)


def test_broken_scene_is_not_written(tmp_path: Path) -> None:
    splats = scene()
    splats.sh0[3, 0, 1] = np.nan
    with pytest.raises(InputError, match="'f_dc_1' of Gaussian 3"):
        write_splats(tmp_path / "a.ply", splats)
    assert list(tmp_path.iterdir()) == []
