"""Laser scans in .e57 files, written by pye57."""

from pathlib import Path

import numpy as np
import pye57
import pytest
from pye57 import libe57

from g2ard.errors import InputError, MissingDependencyError
from g2ard.io import kind, read_cloud
from g2ard.tiles.ingest import ingest
from helpers.opened import stream_of

TURN = np.array([np.sqrt(0.5), 0, 0, np.sqrt(0.5)])  # 90° about z
PLACE = np.array([500_000.0, 4_000_000.0, 30.0])


def scan(seed: int, count: int = 500) -> dict[str, np.ndarray]:
    rng = np.random.default_rng(seed)
    place = {
        f"cartesian{axis}": values
        for axis, values in zip("XYZ", rng.normal(0, 5, (3, count)), strict=True)
    }
    colors = {
        f"color{name}": values
        for name, values in zip(
            ("Red", "Green", "Blue"), rng.integers(0, 256, (3, count)), strict=True
        )
    }
    return place | colors


def written(path: Path, *scans: dict[str, np.ndarray], **pose: np.ndarray) -> Path:
    with pye57.E57(str(path), mode="w") as file:
        for fields in scans:
            file.write_scan_raw(fields, **pose)
    return path


def xyz(fields: dict[str, np.ndarray]) -> np.ndarray:
    return np.stack([fields[f"cartesian{axis}"] for axis in "XYZ"], 1)


@pytest.mark.parametrize("count", [1, 3])
def test_scans_are_joined_by_their_poses(tmp_path: Path, count: int) -> None:
    scans = [scan(seed, 300 + 100 * seed) for seed in range(count)]
    path = written(tmp_path / "a.e57", *scans, rotation=TURN, translation=PLACE)
    found, at = read_cloud(path), np.concatenate([xyz(s) for s in scans])
    turned = np.stack([-at[:, 1], at[:, 0], at[:, 2]], 1) + PLACE
    np.testing.assert_allclose(found.points.positions, turned, atol=1e-5, rtol=0)
    rgb = np.concatenate(
        [np.stack([s[f"color{c}"] for c in ("Red", "Green", "Blue")], 1) for s in scans]
    )
    np.testing.assert_allclose(found.points.colors, rgb / 255, atol=1e-6)
    assert (found.notes, kind(path)) == ((), "points")


@pytest.mark.parametrize(("rows", "start"), [(1000, 0), (7, 0), (300, 299), (256, 450), (64, 999)])
def test_blocks_begin_at_any_row(tmp_path: Path, rows: int, start: int) -> None:
    path = written(tmp_path / "a.e57", scan(0), scan(1))
    whole = read_cloud(path).points
    blocks = list(stream_of(path).blocks(rows, start))
    assert max(len(positions) for positions, _ in blocks) <= rows
    np.testing.assert_array_equal(np.concatenate([p for p, _ in blocks]), whole.positions[start:])
    np.testing.assert_allclose(
        np.concatenate([c for _, c in blocks]), whole.colors[start:], atol=1e-6
    )


def test_intensities_are_grey_between_their_limits(tmp_path: Path) -> None:
    fields = {name: values for name, values in scan(0).items() if name.startswith("cartesian")}
    values = np.random.default_rng(1).uniform(100, 900, 500)
    found = read_cloud(written(tmp_path / "a.e57", fields | {"intensity": values})).points
    grey = (values - values.min()) / np.ptp(values)
    np.testing.assert_allclose(found.colors, np.repeat(grey[:, None], 3, 1), atol=1e-5)


def test_invalid_points_are_dropped(tmp_path: Path) -> None:
    fields = scan(0) | {"cartesianInvalidState": np.arange(500) % 4 // 2}
    found = read_cloud(written(tmp_path / "a.e57", fields))
    np.testing.assert_allclose(
        found.points.positions, xyz(fields)[fields["cartesianInvalidState"] == 0], atol=1e-5
    )
    assert [(n.code, n.count) for n in found.notes] == [("noise", 250)]


def raw_scans(path: Path, *scans: dict[str, np.ndarray]) -> Path:
    """Write scans of float fields by the lower interface, which changes no values."""
    with pye57.E57(str(path), mode="w") as file:
        image = file.image_file
        for fields in scans:
            count = len(next(iter(fields.values())))
            node, prototype = libe57.StructureNode(image), libe57.StructureNode(image)
            for name in fields:
                prototype.set(name, libe57.FloatNode(image, 0.0, libe57.E57_DOUBLE, -1e9, 1e9))
            points = libe57.CompressedVectorNode(image, prototype, libe57.VectorNode(image, True))
            node.set("points", points)
            file.data3d.append(node)
            buffers = libe57.VectorSourceDestBuffer()
            kept = {
                name: np.ascontiguousarray(values, np.float64) for name, values in fields.items()
            }
            for name, column in kept.items():
                buffers.append(libe57.SourceDestBuffer(image, name, column, count, True, True))
            writer = points.writer(buffers)
            writer.write(count)
            writer.close()
    return path


def spherical(path: Path, count: int = 200) -> np.ndarray:
    """Write a scan of ranges and angles; return its positions."""
    rng = np.random.default_rng(0)
    names = ("sphericalRange", "sphericalAzimuth", "sphericalElevation", "intensity")
    values = [
        rng.uniform(1, 9, count),
        rng.uniform(-3, 3, count),
        rng.uniform(-1, 1, count),
        rng.random(count),
    ]
    raw_scans(path, dict(zip(names, values, strict=True)))
    far, around, up, _ = values
    return np.stack(
        [far * np.cos(up) * np.cos(around), far * np.cos(up) * np.sin(around), far * np.sin(up)], 1
    )


def test_ranges_and_angles(tmp_path: Path) -> None:
    want = spherical(tmp_path / "a.e57")
    np.testing.assert_allclose(read_cloud(tmp_path / "a.e57").points.positions, want, atol=1e-9)


def test_ingest(tmp_path: Path) -> None:
    path = written(tmp_path / "a.e57", scan(0), scan(1), rotation=TURN, translation=PLACE)
    store = ingest(path, tmp_path / "tiles", tile_rows=300, block_rows=130)
    assert (store.count, len(store.tiles)) == (1000, 4)
    np.testing.assert_allclose(store.offset, PLACE, atol=10)


@pytest.mark.parametrize("keep", [0, 40, 2000])
def test_damaged(tmp_path: Path, keep: int) -> None:
    path = written(tmp_path / "a.e57", scan(0))
    path.write_bytes(path.read_bytes()[:keep])
    with pytest.raises(InputError, match=r"a\.e57: cannot be read as E57"):
        read_cloud(path)


def test_no_colors(tmp_path: Path) -> None:
    fields = {name: values for name, values in scan(0).items() if name.startswith("cartesian")}
    found = read_cloud(written(tmp_path / "a.e57", scan(0), fields))
    assert [(note.code, note.count) for note in found.notes] == [("black", 500)]
    assert found.colored[:500].mean() > 0.99 > 0.01 > found.colored[500:].mean()
    with pytest.raises(InputError, match=r"b\.e57: .*colours"):
        read_cloud(written(tmp_path / "b.e57", fields))


def test_each_scan_has_its_own_range(tmp_path: Path) -> None:
    """Also with strays, without stated limits, or with intensities instead of colours."""
    byte, word, grey = scan(0, 2000), scan(1, 2000), scan(2, 2000)
    deep = {name: 257 * values for name, values in word.items() if name.startswith("color")}
    place = {name: values for name, values in grey.items() if name.startswith("cartesian")}
    values = np.random.default_rng(3).uniform(50, 1000, 2000)
    values[7] = 1e6
    found = read_cloud(
        raw_scans(tmp_path / "a.e57", byte, word | deep, place | {"intensity": values})
    )
    rgb = [np.stack([s[f"color{c}"] for c in ("Red", "Green", "Blue")], 1) for s in (byte, word)]
    np.testing.assert_allclose(found.points.colors[:4000], np.concatenate(rgb) / 255, atol=1e-6)
    shades = found.points.colors[4000:, 0]
    assert shades.std() > 0.25
    assert 0.4 < shades.mean() < 0.6
    assert [note.code for note in found.notes] == ["grey"]


def test_needs_pye57(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    path = written(tmp_path / "a.e57", scan(0))
    monkeypatch.setitem(__import__("sys").modules, "pye57", None)
    with pytest.raises(MissingDependencyError, match="pip install pye57"):
        read_cloud(path)
