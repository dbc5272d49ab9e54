""".compressed.ply, .spz and .splat: their fields, damage, and a scene that others packed in both ways."""

import gzip
import struct
import sys
from dataclasses import replace
from pathlib import Path

import numpy as np
import numpy.lib.recfunctions as rfn
import pytest
from plyfile import PlyData, PlyElement

from g2ard.errors import InputError, MissingDependencyError
from g2ard.io import read_splats, write_splats
from g2ard.io.sanitize import LOGIT_LIMIT
from g2ard.scene.splats import SH_C0
from helpers.faults import faulty
from helpers.opened import read_scene
from helpers.packed_files import saved, truth
from helpers.realdata import real


def test_compressed_ply_of_other_chunks(tmp_path: Path) -> None:
    """Colours are between 0 and 1 if a chunk states no bounds, and each chunk holds 256 rows."""
    scene = truth(200, 0)
    colors = np.clip(scene.colors, 0, 1)
    colors[:2] = [[0], [1]]  # so the bounds are 0 and 1
    path = saved(tmp_path, "compressed.ply", replace(scene, sh0=((colors - 0.5) / SH_C0)[:, None]))
    want, ply = read_splats(path), PlyData.read(path, mmap=False)
    chunks = ply["chunk"].data
    names = [name for name in chunks.dtype.names if name[4:] not in ("r", "g", "b")]
    ply.elements = [PlyElement.describe(rfn.repack_fields(chunks[names]), "chunk"), ply["vertex"]]
    ply.write(str(path))
    np.testing.assert_allclose(read_splats(path).colors, want.colors, atol=1e-3)
    rows = PlyData.read(saved(tmp_path, "b.compressed.ply", truth(300, 0)), mmap=False)["vertex"]
    ply.elements = [PlyElement.describe(chunks, "chunk"), rows]
    ply.write(str(path))
    with pytest.raises(InputError, match="1 chunks and 300 Gaussians do not fit"):
        read_splats(path)


@pytest.mark.parametrize("version", [2, 3, 4])
@pytest.mark.parametrize("bits", [25, 64, 255])
def test_spz_of_more_fractional_bits_than_a_position_has(
    tmp_path: Path, version: int, bits: int
) -> None:
    path = saved(tmp_path, "spz", truth(3, 0), spz_version=version)
    data = path.read_bytes()
    head, means = (
        bytearray(data if version == 4 else gzip.decompress(data)),
        read_splats(path).means,
    )
    usual = head[13]
    for value in (24, bits):
        head[13] = value
        path.write_bytes(bytes(head) if version == 4 else gzip.compress(bytes(head)))
        if value == 24:
            np.testing.assert_allclose(
                read_splats(path).means, means / 2.0 ** (24 - usual), rtol=1e-6
            )
            continue
        with faulty(path, ("fractionalBits", None)):
            read_splats(path)


def test_spz_without_zstandard(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    path = saved(tmp_path, "spz", truth(3, 0), spz_version=4)
    for name in ("backports", "backports.zstd", "compression.zstd"):
        monkeypatch.setitem(sys.modules, name, None)
    with pytest.raises(MissingDependencyError, match=r"pip install backports.zstd"):
        read_splats(path)


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
