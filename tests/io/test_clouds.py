"""Coloured clouds from .ply, .las and .laz."""

import struct
import sys
from pathlib import Path

import laspy
import numpy as np
import pytest

from g2ard.errors import InputError, MissingDependencyError, OutputError
from g2ard.io import kind, read_cloud, read_points, write_points
from g2ard.io.types import Points
from helpers.cloud_files import FAR, columns, las, ply
from helpers.realdata import real


@pytest.mark.parametrize(("color", "top"), [("u1", 255), ("u2", 65535), ("f4", 1), ("f8", 1)])
@pytest.mark.parametrize("position", ["f4", "f8"])
def test_ply(tmp_path: Path, position: str, color: str, top: float) -> None:
    unit = np.array([[0, 0.5, 1], [1, 0.25, 0.125]])
    values = np.rint(unit * top) if top > 1 else unit
    rows = np.c_[[[1, 2, 3], [-4, 5.5, 6]], values]
    path = ply(tmp_path / "a.ply", columns(position, color), rows)
    points = read_points(path)
    np.testing.assert_array_equal(points.positions, rows[:, :3])
    np.testing.assert_allclose(points.colors, unit, atol=0.51 / 255)
    assert (points.positions.dtype, points.colors.dtype) == (np.float64, np.float32)
    assert kind(path) == "points"


@pytest.mark.parametrize("text", ["测试/Prüfstand", "naïve", "日本語.ply", "\x85 end_header", "µm²"])
@pytest.mark.parametrize("word", ["comment", "obj_info", "property float"])
@pytest.mark.parametrize("encoding", ["utf-8", "latin-1", "gb18030"])
def test_headers_of_other_character_sets(tmp_path: Path, text: str, word: str, encoding: str) -> None:
    raw = text.encode(encoding, "replace")
    if word.startswith("property"):
        raw = raw.replace(b" ", b"")
    rows = np.arange(12.0).reshape(2, 6)
    data = ply(tmp_path / "a.ply", columns("f4", "u1"), rows).read_bytes()
    head, body = data.split(b"end_header\n", 1)
    line = word.encode() + b" " + raw + b"\n"
    if word.startswith("property"):
        head, body = head + line, b"".join(body[at : at + 15] + bytes(4) for at in (0, 15))
    else:
        head = head.replace(b"element", line + b"element", 1)
    (tmp_path / "b.ply").write_bytes(head + b"end_header\n" + body)
    points = read_points(tmp_path / "b.ply")
    np.testing.assert_array_equal(points.positions, rows[:, :3])
    np.testing.assert_allclose(points.colors * 255, rows[:, 3:], atol=1e-4)


def test_ply_with_other_color_names(tmp_path: Path) -> None:
    names = ("diffuse_red", "diffuse_green", "diffuse_blue")
    rows = np.array([[0, 0, 0, 255, 0, 51.0]])
    points = read_points(ply(tmp_path / "a.ply", columns("f4", "u1", names), rows))
    np.testing.assert_allclose(points.colors, [[1, 0, 0.2]])


@pytest.mark.parametrize("corners", [3, 5])
def test_vertices_of_a_mesh(tmp_path: Path, corners: int) -> None:
    rows = np.arange(36.0).reshape(6, 6)
    points = read_points(ply(tmp_path / "a.ply", columns("f4", "u1"), rows, faces=corners))
    np.testing.assert_array_equal(points.positions, rows[:, :3])


@pytest.mark.parametrize("name", ["y", "green"])
def test_missing_property_is_named(tmp_path: Path, name: str) -> None:
    types = columns("f4", "u1")
    del types[name]
    with pytest.raises(InputError, match=rf"a\.ply: .*'{name}'"):
        read_points(ply(tmp_path / "a.ply", types, np.zeros((2, 5))))


@pytest.mark.parametrize(
    ("color", "value", "message"),
    [
        ("f4", 200, r"property 'green' has a value of 200, expected floats in \[0, 1\]"),
        ("f4", -1, r"property 'green' has a value of -1, expected floats in \[0, 1\]"),
        ("f8", -1e308, r"property 'green' has a value of -1e\+308"),
        ("i1", -5, r"property 'green' has a value of -5, expected \[0, 127\]"),
        ("i2", -5, r"property 'green' has a value of -5, expected \[0, 32767\]"),
        ("i4", -5, r"property 'green' has a value of -5"),
    ],
)
def test_colors_out_of_range(tmp_path: Path, color: str, value: float, message: str) -> None:
    rows = np.zeros((4, 6))
    rows[2, 4] = value
    if color[0] == "f":
        rows[3, 4] = np.inf  # hides no other value
    with pytest.raises(InputError, match=rf"a\.ply: {message}"):
        read_points(ply(tmp_path / "a.ply", columns("f4", color), rows))


@pytest.mark.filterwarnings("error")
@pytest.mark.parametrize("column", [0, 4])
def test_a_signalling_nan_drops_its_point(tmp_path: Path, column: int) -> None:
    path = ply(tmp_path / "a.ply", columns("f4", "f4"), np.zeros((3, 6)))
    data = bytearray(path.read_bytes())
    struct.pack_into("<I", data, len(data) - 24 + 4 * column, 0x7F800001)
    path.write_bytes(data)
    assert len(read_points(path)) == 2


def test_non_finite_points_are_dropped_and_counted(tmp_path: Path) -> None:
    rows = np.full((4, 6), 0.5)
    rows[1, 0], rows[3, 4] = np.nan, np.inf
    types = columns("f4", "f4")
    with pytest.raises(InputError, match="none of its 2 points is finite"):
        read_points(ply(tmp_path / "bad.ply", types, np.full((2, 6), np.nan)))
    found = read_cloud(ply(tmp_path / "a.ply", types, rows))
    assert len(found.points) == 2
    assert [(n.code, n.count) for n in found.notes] == [("dropped_rows", 2)]
    with pytest.raises(InputError, match="has no points"):
        read_points(ply(tmp_path / "empty.ply", types, rows[:0]))


def test_written_cloud_comes_back(tmp_path: Path) -> None:
    rng = np.random.default_rng(0)
    truth = Points(FAR + rng.normal(size=(30, 3)), rng.random((30, 3)).astype(np.float32))
    write_points(tmp_path / "a.ply", truth)
    found = read_points(tmp_path / "a.ply")
    np.testing.assert_array_equal(found.positions, truth.positions)
    np.testing.assert_allclose(found.colors, truth.colors, atol=0.5 / 255 + 1e-6)
    with pytest.raises(OutputError, match="written as"):
        write_points(tmp_path / "a.las", truth)
    with pytest.raises(InputError, match="not written"):
        write_points(tmp_path / "b.ply", Points(truth.positions * np.nan, truth.colors))
    assert [p.name for p in tmp_path.iterdir()] == ["a.ply"]


@pytest.mark.parametrize("suffix", [".las", ".laz"])
@pytest.mark.parametrize("top", [255, 65535])
def test_las(tmp_path: Path, suffix: str, top: int) -> None:
    rng = np.random.default_rng(1)
    positions, rgb = FAR + rng.normal(0, 50, (200, 3)), rng.integers(0, top + 1, (200, 3))
    rgb[0] = top
    found = read_cloud(las(tmp_path / f"a{suffix}", positions, rgb))
    np.testing.assert_allclose(found.points.positions, positions, atol=0.00051, rtol=0)
    np.testing.assert_allclose(found.points.colors, rgb / top, atol=1e-6)
    assert [n.code for n in found.notes] == (["eight_bit_colors"] if top == 255 else [])
    assert kind(tmp_path / f"a{suffix}") == "points"


def test_las_without_color(tmp_path: Path) -> None:
    with pytest.raises(InputError, match=r"a\.las: point format 1 has no colours"):
        read_points(las(tmp_path / "a.las", np.zeros((3, 3)), None))


@pytest.mark.parametrize("suffix", [".las", ".laz"])
@pytest.mark.parametrize("keep", [0, 20, 300, -30])
def test_broken_las(tmp_path: Path, suffix: str, keep: int) -> None:
    path = las(tmp_path / f"a{suffix}", FAR + np.arange(600.0).reshape(200, 3), np.ones((200, 3), int))
    path.write_bytes(path.read_bytes()[:keep])
    with pytest.raises(InputError, match=rf"a\{suffix}: (cannot be read as LAS|truncated|broken)"):
        read_points(path)


@pytest.fixture
def laz(tmp_path: Path) -> Path:
    return las(tmp_path / "a.laz", np.arange(30.0).reshape(10, 3), np.ones((10, 3), int))


def table_of(data: bytes) -> tuple[int, int]:
    """Return where the points and the chunk table of a .laz begin."""
    (points_at,) = struct.unpack_from("<I", data, 96)
    return points_at, *struct.unpack_from("<q", data, points_at)


def test_absurd_chunk_table(laz: Path) -> None:
    """lazrs would abort the process on this one."""
    data = bytearray(laz.read_bytes())
    points_at, table = table_of(data)
    struct.pack_into("<I", data, table + 4, 3_000_000_000)
    laz.write_bytes(data)
    with pytest.raises(InputError, match="3,000,000,000 chunks for 10 points"):
        read_points(laz)
    struct.pack_into("<I", data, 107, 4_000_000_000)
    laz.write_bytes(data)
    with pytest.raises(InputError, match=rf"3,000,000,000 chunks in {table - points_at} bytes"):
        read_points(laz)


def test_more_points_than_its_chunks_hold(laz: Path) -> None:
    """Allocating room for 4·10⁹ points would end the process."""
    data = bytearray(laz.read_bytes())
    struct.pack_into("<I", data, 107, 0xFFFF_FF00)
    laz.write_bytes(data)
    with pytest.raises(InputError, match="at most 50,000 of 4,294,967,040 points"):
        read_points(laz)
    struct.pack_into("<I", data, 107, 10_000_000)
    struct.pack_into("<I", data, data.find(b"laszip encoded") - 2 + 54 + 12, 10_000_000)
    laz.write_bytes(data)
    with pytest.raises(InputError, match=r"bytes would unpack to 260,000,000; the limit is 67,108,864"):
        read_points(laz)


@pytest.mark.parametrize(
    ("at", "content", "message"),
    [
        (2, b"\0", "the LASzip record is missing"),
        (54 + 12, struct.pack("<I", 0), "cannot be read as LAS: "),
        (54 + 12, struct.pack("<I", 0xFFFF_FF50), "broken header: chunks of 4,294,967,120 points"),
        (54 + 32, b"\0\0", "broken header: compressed points of 0 bytes, not 26"),
        (54 + 36, b"\x07", "broken header: compressed points of 13 bytes, not 26"),
        (None, b"\xff", "broken chunk table: chunks of"),
    ],
)
def test_absurd_chunks(laz: Path, at: int | None, content: bytes, message: str) -> None:
    """lazrs would abort or panic on some of these."""
    data = bytearray(laz.read_bytes())
    start = table_of(data)[1] + 8 if at is None else data.find(b"laszip encoded") - 2 + at
    data[start : start + len(content)] = content
    laz.write_bytes(data)
    with pytest.raises(InputError, match=rf"a\.laz: .*{message}"):
        read_points(laz)


def test_a_panic_in_lazrs_is_one_line(laz: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def fall(*_: object) -> None:
        raise type("PanicException", (BaseException,), {})("divisor of zero")

    monkeypatch.setattr(laspy.LasReader, "read_points", fall)
    with pytest.raises(InputError, match=r"a\.laz: cannot be read as LAS: divisor of zero"):
        read_points(laz)
    monkeypatch.setattr(laspy.LasReader, "read_points", lambda *_: (_ for _ in ()).throw(KeyboardInterrupt))
    with pytest.raises(KeyboardInterrupt):
        read_points(laz)


def test_las_needs_laspy(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    path = las(tmp_path / "a.las", np.zeros((3, 3)), np.ones((3, 3), int))
    monkeypatch.setitem(sys.modules, "laspy", None)
    with pytest.raises(MissingDependencyError, match=r"pip install 'laspy\[lazrs\]'"):
        read_points(path)


def test_autzen() -> None:
    found = read_cloud(real("autzen_lidar", "autzen_stadium.laz"))
    assert len(found.points) == 2_447_700
    assert [n.code for n in found.notes] == ["eight_bit_colors"]
    np.testing.assert_allclose(found.points.positions.min(0), [636337.80, 850737.66, 411.01], atol=0.005)
    np.testing.assert_allclose(found.points.positions.max(0), [638337.75, 852577.61, 598.15], atol=0.005)
    assert found.points.colors.max() == 1


def test_scene_is_not_a_cloud(tmp_path: Path) -> None:
    types = columns("f4", "f4", ("f_dc_0", "f_dc_1", "f_dc_2"))
    with pytest.raises(InputError, match="expected a coloured point cloud, found a Gaussian scene"):
        read_points(ply(tmp_path / "a.ply", types, np.zeros((2, 6))))
