""".ksplat of GaussianSplats3D: files that it wrote (see `ksplat/README.md`), and damaged copies."""

import struct
from pathlib import Path

import numpy as np
import pytest

from g2ard.errors import InputError
from g2ard.io import kind
from helpers.opened import read_scene
from helpers.packed_files import truth, unpacked_ksplat
from helpers.scenes import assert_same_bits


@pytest.mark.parametrize(
    ("name", "degree", "place", "size", "harmonics"),
    [
        ("level0-sh2", 2, 0, 1e-6, 0),
        ("level1-sh1", 1, 2 / 32767, 1e-3, 1e-3),
        ("level2-sh2", 2, 2 / 32767, 1e-3, 2 / 255),
    ],
)
def test_ksplat(
    name: str, degree: int, place: float, size: float, harmonics: float, tmp_path: Path
) -> None:
    path, scene = unpacked_ksplat(name, tmp_path), truth(60, 3)
    assert kind(path) == "splats"
    found = read_scene(path).splats
    order = np.abs(scene.means[:, None] - found.means).max(2).argmin(1)
    assert sorted(order) == list(range(60))
    found = found.take(order)
    assert found.sh_degree == degree
    np.testing.assert_allclose(found.means, scene.means, atol=place)
    np.testing.assert_allclose(found.scales, scene.scales, rtol=size)
    np.testing.assert_allclose(np.abs((found.quats * scene.quats).sum(1)), 1, atol=2e-3)
    np.testing.assert_allclose(found.opacities, scene.opacities, atol=1 / 255)
    np.testing.assert_allclose(found.colors, scene.colors, atol=1 / 255)
    np.testing.assert_allclose(found.shN, scene.shN[:, : (degree + 1) ** 2 - 1], atol=harmonics)


@pytest.mark.parametrize("rows", [0, 1, 50, 60, 61, 2**32 - 1])
def test_a_section_may_have_room_for_more_rows(rows: int, tmp_path: Path) -> None:
    path = unpacked_ksplat("level0-sh2", tmp_path)
    whole, data = read_scene(path).splats, path.read_bytes()
    path.write_bytes(data[:4096] + struct.pack("<I", rows) + data[4100:])
    if rows:
        assert_same_bits(read_scene(path).splats, whole.take(range(min(rows, 60))))
    else:
        with pytest.raises(InputError, match="Gaussian"):
            read_scene(path)
