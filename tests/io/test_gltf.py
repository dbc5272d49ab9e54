""".glb and .gltf as other programs write them: parts, placements, drafts and logarithms."""

import base64
import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from g2ard.errors import InputError
from g2ard.io import read_splats, write_splats
from g2ard.io.glb import EXTENSION, SPZ_EXTENSION
from g2ard.io.source import Source
from g2ard.scene.splats import Splats
from g2ard.scene.transform import deformed, rotation_matrices
from helpers.glb_files import glb_parts, write_glb
from helpers.opened import read_scene
from helpers.ply_files import scene
from reference.rotations import covariances


def parts_of(folder: Path, truth: Splats, **options: object) -> tuple[dict, bytes]:
    write_splats(folder / "one.glb", truth, overwrite=True, **options)
    return glb_parts(folder / "one.glb")


@pytest.mark.parametrize("shift", [0.0, 7.0])
def test_any_negative_scale_means_logarithms(tmp_path: Path, shift: float) -> None:
    """Also if most logarithms are positive."""
    truth = scene()
    truth = replace(truth, scales=(truth.scales * np.exp(shift)).astype(np.float32))
    truth.scales[3] = 0.5
    document, binary = parts_of(tmp_path, truth)
    at = document["meshes"][0]["primitives"][0]["attributes"][f"{EXTENSION}:SCALE"]
    view = document["bufferViews"][document["accessors"][at]["bufferView"]]
    start, size = view["byteOffset"], view["byteLength"]
    logs = np.log(truth.scales).astype("<f4").tobytes()
    found = read_scene(
        write_glb(tmp_path / "a.glb", document, binary[:start] + logs + binary[start + size :])
    )
    assert len(found.splats) == 20
    np.testing.assert_allclose(found.splats.scales, truth.scales, rtol=1e-5)
    assert [note.code for note in found.notes] == ["log_scales"]


@pytest.mark.parametrize("nodes", [0, 1, 2, 3])
def test_a_mesh_is_read_as_often_as_nodes_show_it(tmp_path: Path, nodes: int) -> None:
    truth = scene()
    document, binary = parts_of(tmp_path, truth)
    shown = [{"mesh": 0, "translation": [-5.0 * k, 0, 0]} for k in range(nodes)]
    document |= {"nodes": shown, "scenes": [{"nodes": list(range(nodes))}]}
    found = read_splats(write_glb(tmp_path / "a.glb", document, binary))
    whole = np.concatenate([truth.means + np.array([5.0 * k, 0, 0]) for k in range(max(nodes, 1))])
    np.testing.assert_allclose(found.means + found.offset, whole, atol=1e-5)


@pytest.mark.parametrize("in_one_mesh", [True, False])
def test_several_primitives_are_joined(tmp_path: Path, in_one_mesh: bool) -> None:
    truth = scene()
    document, binary = parts_of(tmp_path, truth)
    (primitive,) = document["meshes"][0]["primitives"]
    plain = {"attributes": {"POSITION": 0}}
    if in_one_mesh:
        document["meshes"] = [{"primitives": [primitive, plain, primitive]}]
    else:
        document["meshes"] = [{"primitives": [primitive]}, {"primitives": [plain, primitive]}]
        document |= {"nodes": [{"mesh": 0}, {"mesh": 1}], "scenes": [{"nodes": [0, 1]}]}
    found = read_scene(write_glb(tmp_path / "a.glb", document, binary))
    np.testing.assert_allclose(found.splats.means, np.concatenate([truth.means] * 2), atol=1e-6)
    assert [note.code for note in found.notes] == ["ignored_meshes"]


INSIDE = (SPZ_EXTENSION, f"{EXTENSION}_compression_spz")
BESIDE = ("KHR_spz_gaussian_splats_compression", "KHR_spz_compression")


@pytest.mark.parametrize(
    ("name", "alone"),
    [*((name, False) for name in INSIDE + BESIDE), *((name, True) for name in BESIDE)],
)
@pytest.mark.parametrize("degree", [0, 3])
def test_earlier_names_of_an_spz(tmp_path: Path, name: str, alone: bool, degree: int) -> None:
    document, binary = parts_of(tmp_path, scene(degree=degree), compress="spz")
    wanted = read_splats(tmp_path / "one.glb")
    held = document["meshes"][0]["primitives"][0]["extensions"]
    inside = held[EXTENSION]["extensions"].pop(SPZ_EXTENSION)
    if alone:
        held.clear()
    (held if name in BESIDE else held[EXTENSION]["extensions"])[name] = inside
    found = read_splats(write_glb(tmp_path / "a.glb", document, binary))
    np.testing.assert_array_equal(found.means, wanted.means)
    np.testing.assert_array_equal(found.shN, wanted.shN)


@pytest.mark.parametrize(
    "name", ["CESIUM_gaussian_splatting", "EXT_spz_3", f"{EXTENSION}_of_tomorrow"]
)
@pytest.mark.parametrize("alone", [True, False])
def test_other_extensions_of_splats_are_named(tmp_path: Path, name: str, alone: bool) -> None:
    document, binary = parts_of(tmp_path, scene())
    held = document["meshes"][0]["primitives"][0]["extensions"]
    if alone:
        held.clear()
    held[name] = {}
    with pytest.raises(InputError, match=f"unsupported extension '{name}'"):
        read_splats(write_glb(tmp_path / "a.glb", document, binary))


@pytest.mark.parametrize("inside", [True, False])
def test_gltf_with_its_buffer(tmp_path: Path, inside: bool) -> None:
    truth = scene()
    document, binary = parts_of(tmp_path, truth)
    coded = "data:application/octet-stream;base64," + base64.b64encode(binary).decode()
    document["buffers"][0]["uri"] = coded if inside else "the%20data.bin"
    (tmp_path / "the data.bin").write_bytes(binary)
    (tmp_path / "a.gltf").write_text(json.dumps(document))
    np.testing.assert_allclose(read_splats(tmp_path / "a.gltf").means, truth.means, atol=1e-6)
    document["buffers"][0]["uri"] = "data:;base64,@@"
    (tmp_path / "a.gltf").write_text(json.dumps(document))
    with pytest.raises(InputError, match="broken base64"):
        read_splats(tmp_path / "a.gltf")


@pytest.mark.parametrize("seed", range(6))
@pytest.mark.parametrize("kind", ["mirror", "uneven", "shear", "turn"])
def test_any_affine_placement(seed: int, kind: str) -> None:
    """Covariances become MΣMᵀ; the colour of a direction moves with it if lengths stay in proportion."""
    rng, truth = np.random.default_rng(seed), scene(30, 3, seed, offset=(100, -20, 3))
    turn = rotation_matrices(rng.normal(size=(1, 4)))[0]
    linear = {
        "mirror": 1.5 * turn @ np.diag([1, 1, -1]),
        "turn": 0.4 * turn,
        "uneven": turn @ np.diag(rng.uniform(0.5, 2, 3)),
        "shear": turn @ (np.eye(3) + np.triu(rng.normal(0, 0.5, (3, 3)), 1)),
    }[kind]
    matrix = np.eye(4)
    matrix[:3, :3], matrix[:3, 3] = linear, rng.normal(size=3)
    found, exact = deformed(truth, matrix)
    assert exact == (kind in ("mirror", "turn"))
    world = (truth.means.astype(float) + truth.offset) @ linear.T + matrix[:3, 3]
    np.testing.assert_allclose(found.means + found.offset, world, atol=1e-4)
    wanted = linear @ covariances(truth.quats, truth.scales) @ linear.T
    np.testing.assert_allclose(
        covariances(found.quats, found.scales), wanted, atol=1e-6 + 1e-5 * wanted.max()
    )
    np.testing.assert_allclose(found.sh0, truth.sh0, atol=1e-6)


def test_a_placement_that_flattens_is_refused() -> None:
    with pytest.raises(InputError, match="flattens"):
        deformed(scene(), np.diag([1.0, 0, 1, 1]))


@pytest.mark.parametrize("scene_index", [None, 0, 1])
def test_only_the_shown_scene_is_read(tmp_path: Path, scene_index: int | None) -> None:
    """Also where nodes below those of the scene show the mesh; without a `scene`, the first is shown."""
    document, binary = parts_of(tmp_path, scene())
    nodes = [{"mesh": 0}, {"mesh": 0, "translation": [-9.0, 0, 0]}, {"children": [1]}, {"mesh": 0}]
    document |= {"nodes": nodes, "scenes": [{"nodes": [0]}, {"nodes": [2]}]}
    document.pop("scene")
    if scene_index is not None:
        document["scene"] = scene_index
    found = read_splats(write_glb(tmp_path / "a.glb", document, binary))
    assert len(found) == len(scene())
    shift = 9.0 if scene_index else 0.0
    np.testing.assert_allclose(
        (found.means + found.offset)[:, 0], scene().means[:, 0] + shift, atol=1e-5
    )


@pytest.mark.parametrize("space", ["BT.709-linear", "lin_rec709_display", "srgb_rec709_display"])
def test_linear_colours_are_noted(tmp_path: Path, space: str) -> None:
    document, binary = parts_of(tmp_path, scene())
    document["meshes"][0]["primitives"][0]["extensions"][EXTENSION]["colorSpace"] = space
    notes = read_scene(write_glb(tmp_path / "a.glb", document, binary)).notes
    assert [note.code for note in notes] == ["linear_colors"] * ("lin" in space)


@pytest.mark.parametrize(
    ("mode", "says"), [(0, "holds points"), (4, "holds a mesh"), (None, "holds a mesh")]
)
@pytest.mark.parametrize("wanted", ["scene", "cloud"])
def test_meshes_and_points_are_named(
    tmp_path: Path, wanted: str, mode: int | None, says: str
) -> None:
    document, binary = parts_of(tmp_path, scene(4, 0))
    (primitive,) = document["meshes"][0]["primitives"]
    del primitive["extensions"], primitive["mode"]
    primitive.update({} if mode is None else {"mode": mode})
    write_glb(tmp_path / "a.glb", document, binary)
    source = Source(tmp_path / "a.glb")
    with pytest.raises(InputError, match=says):
        source.scene if wanted == "scene" else source.cloud()
