"""3DGS .ply: every layout that turns up in the wild is read, every broken file is named."""

from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from plyfile import PlyData, PlyElement

from g2ard.errors import InputError
from g2ard.io import Source, kind, read_splats, write_splats
from g2ard.io.sanitize import LOG_SCALE_LIMIT, LOGIT_LIMIT
from g2ard.jobs.convert import convert
from g2ard.jobs.viewer_frame import up_of
from g2ard.poses.site import Site
from g2ard.scene.splats import ARRAYS, DRAWN_LOGIT, Splats
from g2ard.stages.simplify import SimplifyConfig, simplify
from g2ard.tiles.ingest import ingest
from helpers.opened import read_scene, stream_of
from helpers.ply_files import columns, save, scene


def assert_same(a: Splats, b: Splats, rtol: float = 2e-6) -> None:
    for name in ARRAYS:
        np.testing.assert_allclose(
            getattr(a, name), getattr(b, name), rtol=rtol, atol=1e-7, err_msg=name
        )
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
@given(
    count=st.integers(1, 40),
    degree=st.integers(0, 3),
    seed=st.integers(0, 2**32),
    normals=st.booleans(),
)
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
    np.testing.assert_array_equal(
        found.splats.logit_opacities[:3], [LOGIT_LIMIT, -LOGIT_LIMIT, LOGIT_LIMIT]
    )
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


def test_missing_and_unknown_files(tmp_path: Path) -> None:
    with pytest.raises(InputError, match=r"gone\.ply: no such file"):
        read_splats(tmp_path / "gone.ply")
    (tmp_path / "a.obj").write_text("v 0 0 0")
    with pytest.raises(InputError, match="is a mesh"):
        kind(tmp_path / "a.obj")
    (tmp_path / "a.zip").write_bytes(b"PK\x03\x04")
    for path, advice in ((tmp_path / "a.zip", "unpack it"), ("https://a.org/a.ply", "download it")):
        with pytest.raises(InputError, match=advice):
            kind(path)


def test_cloud_is_not_a_scene(tmp_path: Path) -> None:
    path = save(
        tmp_path / "a.ply", {n: np.zeros(2) for n in ("x", "y", "z", "red", "green", "blue")}
    )
    assert kind(path) == "points"
    for read in (read_splats, lambda path: Source(path).scene):
        with pytest.raises(
            InputError, match="expected a Gaussian scene, found a coloured point cloud"
        ):
            read(path)


def test_broken_scene_is_not_written(tmp_path: Path) -> None:
    splats = scene()
    splats.sh0[3, 0, 1] = np.nan
    with pytest.raises(InputError, match="'f_dc_1' of Gaussian 3"):
        write_splats(tmp_path / "a.ply", splats)
    assert list(tmp_path.iterdir()) == []


# ── as other programs write it ───────────────────────────────────────────────────────────────────────


def with_header(path: Path, change: Any) -> Path:
    """Change the bytes of a file's header."""
    head, end, body = path.read_bytes().partition(b"end_header\n")
    path.write_bytes(change(head + end) + body)
    return path


REMARKS = [
    "Prüfstand – Büro",
    "导出",
    "\U0001f600 ok",
    "a\u2028b",
    "end_header é",
    "\x85 end_header",
    "µm²",
]


@pytest.mark.parametrize("keyword", ["comment", "obj_info"])
@pytest.mark.parametrize("encoding", ["utf-8", "utf-16-le", "latin-1", "gb18030"])
@pytest.mark.parametrize("options", [{"byte_order": "<"}, {"byte_order": ">"}, {"text": True}])
def test_remarks_in_any_language(
    tmp_path: Path, keyword: str, encoding: str, options: dict
) -> None:
    truth = scene(count=7)
    remarks = [
        r.encode(encoding, "replace").replace(b"\n", b"").replace(b"\r", b"") for r in REMARKS
    ]
    lines = b"".join(keyword.encode() + b" " + remark + b"\n" for remark in remarks)
    path = save(tmp_path / "a.ply", columns(truth), **options)
    with_header(path, lambda head: head.replace(b"element vertex", lines + b"element vertex"))
    assert_same(read_splats(path), truth)
    assert_same(next(iter(stream_of(path).blocks(99))), truth)


@pytest.mark.parametrize("mark", [b"", b"\xef\xbb\xbf"])
@pytest.mark.parametrize("eol", [b"\n", b"\r\n", b"\r"])
def test_line_ends_and_byte_order_marks(tmp_path: Path, mark: bytes, eol: bytes) -> None:
    truth = scene(count=7)
    truth.means[0, 0] = np.frombuffer(b"\n\r\n\x3f", "<f4")[0]  # rows may begin like a line's end
    path = save(tmp_path / "a.ply", columns(truth), byte_order="<")
    with_header(path, lambda head: mark + head.replace(b"\n", eol))
    assert_same(read_splats(path), truth)


@pytest.mark.parametrize("dtype", ["u1", "u2", "i4", "f4", "f8"])
@pytest.mark.parametrize(
    "names", [("red", "green", "blue"), ("r", "g", "b"), ("Red", "Green", "Blue")]
)
@pytest.mark.parametrize("white", [1, 255, 65535])
def test_colours_in_place_of_harmonics(
    tmp_path: Path, dtype: str, names: tuple, white: int
) -> None:
    """Values tell what white is, not types; bytes hold no more than 255, fractions need a real type."""
    if (white == 1) == (dtype[0] != "f") or (white > 255 and dtype == "u1"):
        return
    truth, rng = scene(degree=0), np.random.default_rng(1)
    rgb = np.vstack([rng.uniform(0, 1, (19, 3)), np.ones((1, 3))])
    cols = {name: v for name, v in columns(truth).items() if not name.startswith("f_dc")}
    rows = np.empty(20, [(name, "f4") for name in cols] + [(name, dtype) for name in names])
    for name, values in cols.items():
        rows[name] = values
    for channel, name in enumerate(names):
        rows[name] = (
            np.rint(rgb[:, channel] * white) if dtype[0] != "f" else rgb[:, channel] * white
        )
    PlyData([PlyElement.describe(rows, "vertex")]).write(str(tmp_path / "a.ply"))
    found = read_splats(tmp_path / "a.ply")
    np.testing.assert_allclose(found.colors, rgb, atol=0.6 / white if dtype[0] != "f" else 1e-6)
    np.testing.assert_allclose(found.scales, truth.scales, rtol=1e-5)


@pytest.mark.parametrize("degree", [0, 2])
@pytest.mark.parametrize("prefix", ["scalar_", "Scalar_", "scal_", "scalar_scal_"])
def test_names_of_cloudcompare(tmp_path: Path, degree: int, prefix: str) -> None:
    truth = scene(degree=degree)
    cols = {name if name in "xyz" else prefix + name: v for name, v in columns(truth).items()}
    path = save(
        tmp_path / "a.ply",
        cols | {"red": np.zeros(20), "green": np.zeros(20), "blue": np.zeros(20)},
    )
    assert kind(path) == "splats"
    assert_same(read_splats(path), truth)


@pytest.mark.parametrize("name", ["scale_0", "scale"])
@pytest.mark.parametrize("turned", [True, False])
def test_one_scale_for_three(tmp_path: Path, name: str, turned: bool) -> None:
    truth = scene()
    cols = columns(truth)
    cols = {
        key: v
        for key, v in cols.items()
        if not key.startswith("scale") and (turned or "rot_" not in key)
    }
    read = read_scene(save(tmp_path / "a.ply", cols | {name: np.log(truth.scales[:, 1])}))
    assert not [note for note in read.notes if note.code == "ignored_properties"]
    found = read.splats
    np.testing.assert_allclose(found.scales, truth.scales[:, [1, 1, 1]], rtol=1e-5)
    np.testing.assert_allclose(
        found.quats, truth.quats if turned else [[1, 0, 0, 0]] * 20, atol=1e-6
    )


@pytest.mark.parametrize("seed", range(3))
@pytest.mark.parametrize("name", ["filter_3D", "filter_3d"])
def test_the_mip_filter_is_applied(tmp_path: Path, seed: int, name: str) -> None:
    truth, f = scene(seed=seed), np.random.default_rng(seed).uniform(0, 0.3, 20).astype(np.float32)
    truth.logit_opacities[:2] = 15, -9
    f[3] = 0
    found = read_scene(save(tmp_path / "a.ply", columns(truth) | {name: f}))
    before = truth.scales.astype(float) ** 2
    after = before + f[:, None].astype(float) ** 2
    alphas = 1 / (1 + np.exp(-truth.logit_opacities.astype(float)))
    np.testing.assert_allclose(found.splats.scales, np.sqrt(after), rtol=1e-5)
    faded = alphas * np.sqrt(before.prod(1) / after.prod(1))
    np.testing.assert_allclose(found.splats.opacities, faded, rtol=2e-5)
    assert [note.code for note in found.notes] == ["mip_filter"]


@pytest.mark.parametrize(
    "names", [["delta_vertex_0"], ["frame_1", "frame_2", "frame_3", "frame_4"]]
)
def test_animated_scenes_are_read_at_frame_0(tmp_path: Path, names: list[str]) -> None:
    truth = scene()
    rows = (
        save(tmp_path / "a.ply", columns(truth))
        and PlyData.read(str(tmp_path / "a.ply"))["vertex"].data
    )
    moves = np.zeros(20, [(axis, "f4") for axis in "xyz"])
    other = np.zeros(1, [("time", "f4")])
    elements = [
        PlyElement.describe(np.array(rows), "vertex"),
        *(PlyElement.describe(moves, n) for n in names),
    ]
    PlyData([PlyElement.describe(other, "clock"), *elements]).write(str(tmp_path / "b.ply"))
    found = read_scene(tmp_path / "b.ply")
    assert_same(found.splats, truth)
    assert [(note.code, note.count) for note in found.notes] == [("ignored_frames", len(names))]
    assert "frame 0" in found.notes[0].text


@pytest.mark.parametrize("sizes", [(0.01, 0.01, 0.01), (0.02, 0.02, 0.001)])
@pytest.mark.parametrize("logs", [True, False])
def test_equal_scales_that_look_linear_are_noted(
    tmp_path: Path, sizes: tuple[float, float, float], logs: bool
) -> None:
    truth = scene(count=200, seed=4)
    stored = np.log(sizes) if logs else sizes
    cols = columns(truth) | {f"scale_{i}": np.full(200, stored[i]) for i in range(3)}
    cols |= {axis: 0.1 * truth.means[:, i] for i, axis in enumerate("xyz")}
    notes = read_scene(save(tmp_path / "a.ply", cols)).notes
    assert [note.code for note in notes] == ["activated"] * (not logs)


@pytest.mark.parametrize("unit", [0.05, 1.0])
@pytest.mark.parametrize("what", ["scales", "opacities", "both", "neither"])
def test_activated_values_are_noted(tmp_path: Path, what: str, unit: float) -> None:
    truth = scene(count=60, seed=4)
    cols = columns(truth)
    if what in ("scales", "both"):
        cols |= {f"scale_{i}": truth.scales[:, i] * unit for i in range(3)}
    if what in ("opacities", "both"):
        cols |= {"opacity": truth.opacities}
    notes = read_scene(save(tmp_path / "a.ply", cols)).notes
    assert [note.code for note in notes] == ["activated"] * (what != "neither")
    assert all(
        (word in notes[0].text) == (what in (word, "both"))
        for word in ("scales", "opacities")
        if notes
    )


UP = [
    (["Generated by Nerstudio 1.1.5", "Vertical Axis: z"], (0, 0, 1)),
    (["Vertical Axis: y"], (0, 1, 0)),
    (["vertical axis: X", "written by nerfstudio"], (1, 0, 0)),
    (["Exported from Brush", "Vertical axis: 1 0 0"], (1, 0, 0)),
    (["Vertical axis: 0, -2.0, 0"], (0, -1, 0)),
    (["Exported from Brush", "Vertical axis: y"], (0, -1, 0)),
    (["Exported from Brush", "Vertical Axis: Z"], (0, 0, -1)),
    (["Exported from Brush", "Vertical axis: x"], (1, 0, 0)),
    (["Vertical axis: z"], (0, 0, -1)),
    (["Exported from Brush", "Vertical axis: 0.6 -0.8 0"], (0.6, -0.8, 0)),
    (["Vertical axis: up"], None),
    (["Vertical axis: 0 0 0"], None),
    (["Vertical axis: nan 0 1"], None),
    ([], None),
]


@pytest.mark.parametrize(("comments", "up"), UP)
@pytest.mark.parametrize("name", ["b.ply", "b.compressed.ply"])
def test_the_up_direction_of_comments(
    tmp_path: Path, comments: list[str], up: Any, name: str
) -> None:
    """It is read, used, turned with the scene, and written."""
    path = save(tmp_path / "a.ply", columns(scene(200)), comments=comments)
    found = read_splats(path)
    assert found.up == (up if up is None else pytest.approx(up))
    write_splats(tmp_path / name, found)
    again = read_splats(tmp_path / name)
    assert again.up == found.up
    if up is None:
        return
    np.testing.assert_allclose(up_of(again), up, atol=1e-12)
    np.testing.assert_allclose(Site.of(again).vertical.axis, up, atol=1e-12)
    turned = convert(path, rotate=(90, 0, 0))
    np.testing.assert_allclose(up_of(turned), (up[0], -up[2], up[1]), atol=1e-12)
    mirrored = convert(path, to_axes="LDF")
    np.testing.assert_allclose(up_of(mirrored), (-up[0], *up[1:]), atol=1e-12)
    assert simplify(found, 50, config=SimplifyConfig(method="fast")).splats.up == found.up
    ingest(path, tmp_path / "tiles")
    assert read_splats(tmp_path / "tiles").up == pytest.approx(up)


@pytest.mark.parametrize(
    "names", [["t", "scale_t"], ["motion_0"], ["trbf_center"], ["rot_r_0"], ["time"]]
)
def test_scenes_that_move_are_told(tmp_path: Path, names: list[str]) -> None:
    path = save(tmp_path / "a.ply", columns(scene()) | {name: np.ones(20) for name in names})
    assert [note.code for note in read_scene(path).notes] == ["ignored_properties", "moving"]


@pytest.mark.parametrize("beside", ["deformation.pth", "../../deform/iteration_7/deform.pth"])
def test_networks_that_move_a_scene_are_told(tmp_path: Path, beside: str) -> None:
    folder = tmp_path / "point_cloud" / "iteration_7"
    folder.mkdir(parents=True)
    path = save(folder / "point_cloud.ply", columns(scene()))
    assert "moving" not in [note.code for note in read_scene(path).notes]
    (folder / beside).parent.mkdir(parents=True, exist_ok=True)
    (folder / beside).write_bytes(b"x")
    path.touch()
    assert "moving" in [note.code for note in read_scene(path).notes]


@pytest.mark.parametrize("far", [0.0, 5.4e6])
def test_scenes_of_coordinates_that_float32_rounds_are_told(tmp_path: Path, far: float) -> None:
    cols = columns(scene()) | {"y": scene().means[:, 1] + far}
    found = read_scene(save(tmp_path / "a.ply", cols))
    assert ("coarse_positions" in [note.code for note in found.notes]) == (far > 0)
