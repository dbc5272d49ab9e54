""".compressed.ply, .spz and .splat: packed here by plain loops, and real files held against each other."""

import gzip
import struct
import sys
from pathlib import Path

import numpy as np
import pytest
from plyfile import PlyData, PlyElement

from g2ard.errors import InputError, MissingDependencyError
from g2ard.io import kind, read_scene, read_splats, write_splats
from g2ard.io.sanitize import LOGIT_LIMIT
from helpers.faults import faulty
from helpers.packed_files import compressed, save_spz, truth
from helpers.realdata import real


@pytest.mark.parametrize("degree", [0, 1, 2, 3])
def test_compressed_ply(tmp_path: Path, degree: int) -> None:
    scene = truth(300, degree)
    path = compressed(tmp_path / "a.compressed.ply", scene)
    assert kind(path) == "splats"
    found = read_splats(path)
    np.testing.assert_allclose(found.means, scene.means, atol=4 / 1023 / 2 + 1e-6)
    np.testing.assert_allclose(found.log_scales, scene.log_scales, atol=6 / 1023 / 2 + 1e-5)
    np.testing.assert_allclose(found.quats, scene.quats, atol=2e-3)
    np.testing.assert_allclose(found.opacities, scene.opacities, atol=0.5 / 255 + 1e-6)
    np.testing.assert_allclose(found.colors, scene.colors, atol=0.7 / 255 / 2 + 1e-3)
    np.testing.assert_allclose(found.shN, scene.shN, atol=8 / 256 / 2 + 1e-6)


def test_compressed_ply_without_chunk_colors(tmp_path: Path) -> None:
    found = read_splats(compressed(tmp_path / "a.ply", truth(20, 0), chunk_colors=False))
    np.testing.assert_allclose(found.colors, truth(20, 0).colors, atol=0.5 / 255 + 1e-6)


def test_compressed_ply_with_too_few_chunks(tmp_path: Path) -> None:
    path = compressed(tmp_path / "a.ply", truth(300, 0))
    ply = PlyData.read(path, mmap=False)
    ply.elements = [PlyElement.describe(ply["chunk"].data[:1].copy(), "chunk"), ply["vertex"]]
    ply.write(str(path))
    with pytest.raises(InputError, match="1 chunks and 300 Gaussians do not fit"):
        read_splats(path)


@pytest.mark.parametrize("version", [2, 3, 4])
@pytest.mark.parametrize("degree", [0, 1, 2, 3])
def test_spz(tmp_path: Path, version: int, degree: int) -> None:
    scene = truth(50, degree, seed=version)
    found = read_splats(save_spz(tmp_path / "a.spz", scene, version))
    np.testing.assert_allclose(found.means, scene.means, atol=0.5 / 4096 + 1e-7)
    np.testing.assert_allclose(found.log_scales, scene.log_scales, atol=0.5 / 16 + 1e-5)
    np.testing.assert_allclose(found.opacities, scene.opacities, atol=0.5 / 255 + 1e-6)
    np.testing.assert_allclose(found.sh0, scene.sh0, atol=0.5 / 255 / 0.15 + 1e-6)
    np.testing.assert_allclose(found.shN, scene.shN, atol=0.5 / 128 + 1e-6)
    same = np.abs((found.quats * scene.quats).sum(1))
    assert same.min() > (0.99 if version == 2 else 0.99999)  # w is derived in version 2, coarse near 0


@pytest.mark.parametrize("version", [2, 3, 4])
@pytest.mark.parametrize("bits", [25, 63, 64, 200, 255])
def test_spz_of_more_fractional_bits_than_a_position_has(tmp_path: Path, version: int, bits: int) -> None:
    path = save_spz(tmp_path / "a.spz", truth(3, 0), version)
    data = path.read_bytes()
    head = bytearray(data if version == 4 else gzip.decompress(data))
    for allowed, value in ((True, 24), (False, bits)):
        head[13] = value
        path.write_bytes(bytes(head) if version == 4 else gzip.compress(bytes(head)))
        if allowed:
            np.testing.assert_allclose(read_splats(path).means, truth(3, 0).means / 4096, atol=1e-7)
            continue
        with faulty(path, ("fractionalBits", None)):
            read_splats(path)


def test_spz_without_zstandard(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    path = save_spz(tmp_path / "a.spz", truth(3, 0), 4)
    for name in ("backports", "backports.zstd", "compression.zstd"):
        monkeypatch.setitem(sys.modules, name, None)
    with pytest.raises(MissingDependencyError, match=r"pip install backports.zstd"):
        read_splats(path)


def test_spz_equals_compressed_ply_of_the_same_scene() -> None:
    a = read_scene(real("format_samples", "biker.spz"))
    b = read_scene(real("format_samples", "biker.compressed.ply"))
    assert len(a.splats) == len(b.splats) == 152_746
    for scene in (a, b):
        assert {n.code: n.count for n in scene.notes} == {"clamped_logits": 198}
    np.testing.assert_allclose(a.splats.means, b.splats.means, atol=0.5 / 4096 + 1e-6)
    coarse = np.maximum(b.splats.log_scales, -10)  # SPZ's floor
    np.testing.assert_allclose(a.splats.log_scales, coarse, atol=0.5 / 16 + 1e-5)
    np.testing.assert_allclose(a.splats.opacities, b.splats.opacities, atol=1e-6)
    np.testing.assert_allclose(a.splats.sh0, b.splats.sh0, atol=0.5 / 255 / 0.15 + 1e-6)
    assert np.abs((a.splats.quats * b.splats.quats).sum(1)).min() > 0.9999


# ── .splat ───────────────────────────────────────────────────────────────────────────────────────────


def test_splat_by_hand(tmp_path: Path) -> None:
    row = struct.pack("<6f8B", 1, 2, 3, 0.1, 0.2, 0.3, 255, 0, 128, 64, 255, 128, 0, 128)
    opaque = struct.pack("<6f8B", 0, 0, 0, 1, 1, 1, 9, 9, 9, 255, 255, 128, 128, 128)
    (tmp_path / "a.splat").write_bytes(row + opaque)
    splats = read_splats(tmp_path / "a.splat")
    np.testing.assert_allclose(splats.means[0], [1, 2, 3])
    np.testing.assert_allclose(splats.scales[0], [0.1, 0.2, 0.3], rtol=1e-6)
    np.testing.assert_allclose(splats.colors[0], [1, 0, 128 / 255], atol=1e-6)
    np.testing.assert_allclose(splats.opacities[0], 64 / 255, atol=1e-6)
    np.testing.assert_allclose(splats.quats[0], [127 / 128, 0, -1, 0])
    assert splats.logit_opacities[1] == LOGIT_LIMIT


def test_splat_round_trip(tmp_path: Path) -> None:
    scene = truth(40, 2)
    write_splats(tmp_path / "a.splat", scene)
    found = read_splats(tmp_path / "a.splat")
    order = np.argsort(-(scene.scales.astype(float).prod(1) * scene.opacities), kind="stable")
    expected = scene.take(order)
    np.testing.assert_array_equal(found.means, expected.means)
    np.testing.assert_allclose(found.scales, expected.scales, rtol=1e-6)
    np.testing.assert_allclose(found.opacities, expected.opacities, atol=0.5 / 255 + 1e-6)
    np.testing.assert_allclose(found.colors, np.clip(expected.colors, 0, 1), atol=0.5 / 255 + 1e-6)
    assert np.abs((found.quats * expected.quats).sum(1)).min() > 0.97
