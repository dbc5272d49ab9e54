"""Coloured clouds from .ply, .las and .laz."""

import struct
from pathlib import Path

import laspy
import numpy as np
import pye57
import pytest

from g2ard.errors import InputError, OutputError
from g2ard.io import kind, read_cloud, read_points, write_points
from g2ard.io.source import Source
from g2ard.io.types import Points
from helpers.cloud_files import FAR, columns, las, ply
from helpers.opened import stream_of

WIDE, FLOATS = ["u2", "i4", "u4", "f4", "f8"], ["f4", "f8"]


@pytest.mark.parametrize(
    ("color", "top"),
    [(c, 1) for c in FLOATS] + [(c, 255) for c in ("u1", "i2", *WIDE)] + [(c, 65535) for c in WIDE],
)
@pytest.mark.parametrize("position", ["f4", "f8"])
def test_colors_are_read_by_their_values_whatever_their_type(
    tmp_path: Path, position: str, color: str, top: int
) -> None:
    """Integers of 0 to 255 are 8-bit colours in any type, those up to 65,535 16-bit ones."""
    unit = np.random.default_rng(0).integers(0, 256, (50, 3)) / 255
    unit[0], unit[1] = 1, 0
    places = np.arange(150.0).reshape(50, 3) - 40.5
    path = ply(tmp_path / "a.ply", columns(position, color), np.c_[places, unit * top])
    assert kind(path) == "points"
    found = read_points(path)
    np.testing.assert_array_equal(found.positions, places)
    np.testing.assert_allclose(found.colors, unit, atol=1e-6)
    assert (found.positions.dtype, found.colors.dtype) == (np.float64, np.float32)
    both = stream_of([path, path])
    np.testing.assert_allclose(both.whole().points.colors, np.tile(unit, (2, 1)), atol=1e-6)


@pytest.mark.parametrize("color", ["u1", "i4", "f4", "las", "points3D"])
def test_all_zero_colors_are_told(tmp_path: Path, color: str) -> None:
    positions, rgb = np.arange(30.0).reshape(10, 3), np.zeros((10, 3), int)
    if color == "las":
        path = las(tmp_path / "a.las", positions, rgb)
    elif color == "points3D":
        path = tmp_path / "points3D.txt"
        path.write_text(
            "".join(f"{i} {x} {y} {z} 0 0 0 0.5\n" for i, (x, y, z) in enumerate(positions))
        )
    else:
        path = ply(tmp_path / "a.ply", columns("f4", color), np.c_[positions, rgb])
    found = read_cloud(path)
    assert [n.code for n in found.notes] == ["black"]
    assert "all colours are 0" in str(found.notes[0])


@pytest.mark.parametrize("kind_", ["ply", "las", "laz"])
@pytest.mark.parametrize(
    ("x", "y", "spread", "height", "expected"),
    [
        (10, 50, 1e-3, 30, True),
        (-122.4, 37.7, 1e-2, 200, True),
        (174.7, -36.8, 3e-4, 4, True),
        (0.1, 51.5, 1e-3, 20, True),
        (10, 50, 20, 3, False),  # metres near the origin
        (0, 0, 0.01, 3, False),  # a pole at the origin
        (587600, 3338100, 100, 20, False),
    ],
)
def test_degrees_beside_metres_are_told(
    tmp_path: Path, kind_: str, x: float, y: float, spread: float, height: float, expected: bool
) -> None:
    rng = np.random.default_rng(0)
    positions = rng.uniform(-1, 1, (500, 3)) * [spread, spread, height] + [x, y, 300]
    rgb = rng.integers(0, 256, (500, 3))
    if kind_ == "ply":
        path = ply(tmp_path / "a.ply", columns("f8", "u1"), np.c_[positions, rgb])
    else:
        path = las(
            tmp_path / f"a.{kind_}",
            positions,
            257 * rgb,
            scales=(spread * 1e-7, spread * 1e-7, 1e-3),
        )
    assert ["degrees" in n.code for n in read_cloud(path).notes] == [True] * expected


@pytest.mark.parametrize("low", [0.0, -1e6, 1e9])
@pytest.mark.parametrize("name", ["a.las", "a.laz", "a.ply"])
def test_offset_is_that_of_most_points(tmp_path: Path, name: str, low: float) -> None:
    """A few stray points, or a header's wrong bounds, leave positions to a centimetre."""
    rng = np.random.default_rng(0)
    positions, rgb = FAR + rng.normal(0, 50, (2000, 3)), rng.integers(0, 256, (2000, 3))
    if name.endswith("ply"):
        positions[::401] = low
        path = ply(tmp_path / name, columns("f8", "u1"), np.c_[positions, rgb])
    else:
        path = las(tmp_path / name, positions, 257 * rgb)
        data = bytearray(path.read_bytes())
        struct.pack_into("<6d", data, 179, *[v for _ in range(3) for v in (1e7, low)])
        path.write_bytes(data)
    stream = stream_of(path)
    near = np.concatenate(list(stream.positions(700)))
    good = np.abs(positions - FAR).max(1) < 1e3
    np.testing.assert_allclose((near + stream.offset)[good], positions[good], atol=0.01, rtol=0)


@pytest.mark.parametrize("suffix", [".las", ".laz"])
@pytest.mark.parametrize("version", [3, 7])
def test_noise_is_dropped(tmp_path: Path, suffix: str, version: int) -> None:
    positions, rgb = (
        FAR + np.random.default_rng(0).normal(0, 50, (300, 3)),
        np.full((300, 3), 65535),
    )
    classes = np.tile([2, 7, 18, 6, 1], 60)
    withheld = np.arange(300) % 10 == 3
    path = las(
        tmp_path / f"a{suffix}", positions, rgb, version, classification=classes, withheld=withheld
    )
    found, kept = read_cloud(path), ~np.isin(classes, (7, 18)) & ~withheld
    np.testing.assert_allclose(found.points.positions, positions[kept], atol=0.00051, rtol=0)
    assert [(n.code, n.count) for n in found.notes] == [("noise", np.count_nonzero(~kept))]
    las(tmp_path / f"b{suffix}", positions, rgb, version, classification=np.full(300, 7))
    with pytest.raises(InputError, match=rf"b\{suffix}: .*300 points.*noise"):
        read_points(tmp_path / f"b{suffix}")


def test_ply_with_other_color_names(tmp_path: Path) -> None:
    names = ("diffuse_red", "diffuse_green", "diffuse_blue")
    rows = np.array([[0, 0, 0, 255, 0, 51.0]])
    points = read_points(ply(tmp_path / "a.ply", columns("f4", "u1", names), rows))
    np.testing.assert_allclose(points.colors, [[1, 0, 0.2]])


@pytest.mark.parametrize(
    "form", ["{}", "scalar_{}", "scal_{}", "scalar_scal_{}", "diffuse_{}", "Color_{}"]
)
@pytest.mark.parametrize("word", ["Red Green Blue", "red green blue", "R G B", "r g b", "Rf Gf Bf"])
def test_spellings_of_colours(tmp_path: Path, word: str, form: str) -> None:
    types = dict.fromkeys(map(form.format, word.split()), "f4")
    rows = np.array([[0, 0, 0, 255, 0, 51], [1, 1, 1, 0, 255, 51.0]])
    points = read_points(ply(tmp_path / "a.ply", dict.fromkeys("XYZ", "f4") | types, rows))
    np.testing.assert_allclose(points.colors, [[1, 0, 0.2], [0, 1, 0.2]])


@pytest.mark.parametrize("name", ["rgb", "RGBA", "scalar_rgb"])
@pytest.mark.parametrize("kind_", ["f4", "u4", "i4"])
def test_packed_colours(tmp_path: Path, kind_: str, name: str) -> None:
    bits = np.array([0xFF0033, 0x00FF33], "<u4")
    types = dict.fromkeys("xyz", "f4") | {name: kind_}
    rows = np.column_stack([np.eye(2, 3), bits.view(f"<{kind_}").astype(np.float64)])
    points = read_points(ply(tmp_path / "a.ply", types, rows))
    np.testing.assert_allclose(points.colors, [[1, 0, 0.2], [0, 1, 0.2]])


def test_other_names_of_colours_are_told(tmp_path: Path) -> None:
    types = dict.fromkeys(["x", "y", "z", "Rouge"], "f4")
    with pytest.raises(InputError, match=r"found x y z Rouge\); rename"):
        Source(ply(tmp_path / "a.ply", types, np.ones((2, 4)))).cloud()


@pytest.mark.parametrize("faces", [3, 4])
@pytest.mark.parametrize("texture", [(), ("s", "t"), ("texture_u", "texture_v")])
@pytest.mark.parametrize("wanted", ["scene", "cloud"])
def test_a_mesh_without_colours_is_named(
    tmp_path: Path, wanted: str, texture: tuple, faces: int
) -> None:
    types = dict.fromkeys(["x", "y", "z", *texture], "f4")
    source = Source(ply(tmp_path / "a.ply", types, np.ones((4, len(types))), faces=faces))
    with pytest.raises(InputError, match=r"is a mesh.*sample points"):
        source.scene if wanted == "scene" else source.cloud()


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
        ("f4", 1e6, r"property 'green' has a value of 1e\+06"),
        ("f4", -1, r"property 'green' has a value of -1"),
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


STORED = ["las", "laz", "ply", "e57"]


def stored(
    path: Path, positions: np.ndarray, rgb: np.ndarray | None, intensity: np.ndarray
) -> Path:
    """Write 16-bit colours, if any, and intensities in the format of the name."""
    if path.suffix in (".las", ".laz"):
        return las(path, positions, rgb, 3, intensity=intensity)
    if path.suffix == ".ply":
        types = columns("f8", "u2") if rgb is not None else dict.fromkeys("xyz", "f8")
        cells = [positions, *([] if rgb is None else [rgb]), intensity]
        return ply(path, types | {"scalar_Intensity": "f4"}, np.column_stack(cells))
    fields = {f"cartesian{axis}": values for axis, values in zip("XYZ", positions.T, strict=True)}
    if rgb is not None:
        names = ("colorRed", "colorGreen", "colorBlue")
        fields |= {name: np.ascontiguousarray(v) for name, v in zip(names, rgb.T, strict=True)}
    with pye57.E57(str(path), mode="w") as file:
        file.write_scan_raw(fields | {"intensity": intensity.astype(float)})
    return path


@pytest.mark.parametrize("black", [False, True])
@pytest.mark.parametrize("suffix", STORED)
def test_intensities_are_grey_where_colors_are_missing_or_all_black(
    tmp_path: Path, suffix: str, black: bool
) -> None:
    """A stray changes nothing; intensities of one value are refused, or black with a note."""
    rng = np.random.default_rng(0)
    positions, intensity = rng.normal(0, 9, (3000, 3)), rng.integers(100, 900, 3000)
    intensity[5] = 60_000
    rgb = np.zeros((3000, 3)) if black else None
    found = read_cloud(stored(tmp_path / f"a.{suffix}", positions, rgb, intensity))
    assert [note.code for note in found.notes] == ["grey"]
    assert not found.colored.any()
    ranks = np.argsort(np.argsort(intensity, kind="stable")) / 3000
    np.testing.assert_allclose(found.points.colors[:, 1], ranks, atol=0.03)
    path = stored(tmp_path / f"b.{suffix}", positions, rgb, np.full(3000, 7))
    if black:
        assert [note.code for note in read_cloud(path).notes] == ["black"]
    else:
        with pytest.raises(InputError, match=rf"b\.{suffix}: .*colour"):
            read_cloud(path)
    assert len(read_cloud(path, bare=True).points) == 3000


@pytest.mark.parametrize("bits", [8, 10, 12, 16])
@pytest.mark.parametrize("strays", [0, 20])
@pytest.mark.parametrize("suffix", STORED[:3])
def test_the_range_of_colors_is_that_of_most(
    tmp_path: Path, suffix: str, strays: int, bits: int
) -> None:
    """Black points do not count, and a note reports them."""
    rng = np.random.default_rng(1)
    unit = rng.uniform(0.02, 1, (3000, 3))
    unit[100:1600] = 0
    rgb = np.rint(unit * (2**bits - 1))
    rgb[:strays] = 65535
    path = stored(tmp_path / f"a.{suffix}", rng.normal(0, 9, (3000, 3)), rgb, np.full(3000, 7))
    found = read_cloud(path)
    np.testing.assert_allclose(found.points.colors[strays:], unit[strays:], atol=1 / 255)
    codes = {note.code for note in found.notes}
    assert ("black_points" in codes, "bright_points" in codes) == (True, strays > 0 and bits < 16)
    assert np.count_nonzero(~found.colored) == 1500


@pytest.mark.parametrize("rest", ["empty", "noise", "strays"])
@pytest.mark.parametrize("suffix", ["las", "laz"])
def test_a_cloud_of_nothing_moves_no_other(tmp_path: Path, rest: str, suffix: str) -> None:
    rng = np.random.default_rng(2)
    positions, rgb = FAR + rng.normal(0, 20, (2000, 3)), rng.integers(1, 65535, (2000, 3))
    las(tmp_path / "b.las", positions, rgb)
    count = {"empty": 0, "noise": 300, "strays": 3}[rest]
    places = np.zeros((count, 3)) if count else np.zeros((1, 3))
    path = las(tmp_path / f"a.{suffix}", places, np.full(places.shape, 65535))
    if rest == "noise":
        las(path, places, np.full(places.shape, 65535), classification=np.full(count, 7))
    if rest == "empty":
        with laspy.open(path, mode="w", header=laspy.LasHeader(point_format=2, version="1.2")):
            pass
    stream = stream_of([path, tmp_path / "b.las"])
    near = np.concatenate(list(stream.positions(500)))[-2000:]
    np.testing.assert_allclose(near + stream.offset, positions, atol=0.005, rtol=0)
    assert ("map_systems" in [note.code for note in stream.header_notes()]) == (rest == "strays")


@pytest.mark.parametrize("suffix", ["ply", "e57", "xyz", "pcd"])  # .las stores differences from FAR
@pytest.mark.parametrize("at", [FAR, np.zeros(3)], ids=["far", "near"])
@pytest.mark.parametrize("zeros", [1, 900])
def test_points_without_a_return_are_dropped(
    tmp_path: Path, suffix: str, at: np.ndarray, zeros: int
) -> None:
    """One point at 0 0 0 of a cloud about the origin may be a point."""
    rng = np.random.default_rng(0)
    positions, rgb = (
        at.round() + rng.normal(0, 9, (3000, 3)).round(3),
        rng.integers(1, 65535, (3000, 3)),
    )
    lost = rng.permutation(3000) < zeros
    positions[lost] = 0
    path = tmp_path / f"a.{suffix}"
    if suffix in STORED:
        stored(path, positions, rgb, np.full(3000, 7))
    else:
        head = "FIELDS x y z r g b\nSIZE 8 8 8 2 2 2\nTYPE F F F U U U\nPOINTS 3000\nDATA ascii\n"
        rows = "\n".join(" ".join(f"{v:.9g}" for v in row) for row in np.hstack([positions, rgb]))
        path.write_text(head * (suffix == "pcd") + rows + "\n")
    found = read_cloud(path)
    dropped = zeros if zeros > 1 or at.any() or suffix == "e57" else 0
    assert len(found.points) == 3000 - dropped
    assert sum(note.count for note in found.notes if note.code == "noise") == dropped
    near = np.concatenate(list(stream_of([path, path]).positions(500)))
    assert np.count_nonzero(np.isnan(near[:, 0])) == 2 * dropped


def test_zeros_of_a_scan_with_a_pose_are_at_the_scanner(tmp_path: Path) -> None:
    fields = {f"cartesian{axis}": np.arange(9.0) // 3 for axis in "XYZ"}
    fields |= {f"color{name}": np.arange(9.0) for name in ("Red", "Green", "Blue")}
    with pye57.E57(str(tmp_path / "a.e57"), mode="w") as file:
        file.write_scan_raw(fields, translation=np.array([100.0, 200, 300]))
    assert len(read_cloud(tmp_path / "a.e57").points) == 6


GRID = np.stack(np.meshgrid(np.arange(50.0), np.arange(50.0)), -1).reshape(-1, 2)
HEIGHT = np.sin(GRID.sum(axis=1))[:, None]


@pytest.mark.parametrize("type_", ["f4", "f8"])
@pytest.mark.parametrize(
    ("positions", "coarse"),
    [
        (np.hstack([0.2 * GRID, HEIGHT]) + FAR, True),  # 0.2 m apart, half a metre of float32
        (np.hstack([0.2 * GRID, HEIGHT]) + np.array([4e6, 5e5, 4.8e6]), True),  # ECEF
        (np.hstack([GRID, HEIGHT]), False),
        (np.hstack([100 * GRID, HEIGHT]) + FAR, False),  # float32 suffices
        (np.hstack([0.001 * GRID, HEIGHT / 1000]), False),
    ],
)
def test_coordinates_that_float32_rounds_are_told(
    tmp_path: Path, positions: np.ndarray, coarse: bool, type_: str
) -> None:
    rows = np.hstack([positions, np.full((2500, 3), 7)])
    found = read_cloud(ply(tmp_path / "a.ply", columns(type_, "u1"), rows))
    assert ("coarse_positions" in [note.code for note in found.notes]) == (coarse and type_ == "f4")


def test_whole_metres_are_not_those_of_float32(tmp_path: Path) -> None:
    """A grid of heights: x and y are whole, z has millimetres."""
    rows = np.hstack([GRID + FAR[:2].round(), (HEIGHT + FAR[2]).round(3), np.full((2500, 3), 7)])
    np.savetxt(tmp_path / "a.xyz", rows, fmt="%.3f")
    found = read_cloud(tmp_path / "a.xyz")
    assert "coarse_positions" not in [note.code for note in found.notes]


def systems(path: Path, code: int | None, wkt: str | None, key: int = 3072) -> Path:
    header = laspy.LasHeader(point_format=7, version="1.4")
    if code:
        record = laspy.vlrs.known.GeoKeyDirectoryVlr()
        record.parse_record_data(struct.pack("<8H", 1, 1, 0, 1, key, 0, 1, code))
        header.vlrs.append(record)
    if wkt:
        header.vlrs.append(laspy.vlrs.known.WktCoordinateSystemVlr(wkt))
    data = laspy.LasData(header)
    data.x = data.y = data.z = np.arange(50.0)
    data.red = data.green = data.blue = np.arange(50) * 999
    data.write(str(path))
    return path


UTM = 'PROJCS["UTM {0}N",GEOGCS["W",AUTHORITY["EPSG","4326"]],UNIT["metre",1],AUTHORITY["EPSG","326{0}"]]'


@pytest.mark.parametrize(
    ("a", "b", "several"),
    [
        ((32632, None), (32633, None), True),
        ((None, UTM.format(32)), (None, UTM.format(33)), True),
        ((32632, None), (None, UTM.format(32)), False),
        (
            (32632, None),
            (None, f'COMPD_CS["x",{UTM.format(32)},VERT_CS["h",AUTHORITY["EPSG","5773"]]]'),
            False,
        ),
        ((None, 'PROJCRS["A",ID["EPSG",2056]]'), (None, 'PROJCRS["B"]'), True),
        ((32632, None), (None, None), False),
    ],
)
def test_several_map_systems_are_refused(tmp_path: Path, a: tuple, b: tuple, several: bool) -> None:
    paths = [systems(tmp_path / "a.las", *a), systems(tmp_path / "b.las", *b)]
    if several:
        with pytest.raises(
            InputError, match=r"a\.las: several map systems: a\.las in .*, b\.las in "
        ):
            stream_of(paths)
        return
    stream = stream_of(paths)
    assert not stream.header_notes()
    assert stream.system == "EPSG:32632"


FEET = 'PROJCS["Oregon",GEOGCS["G",UNIT["degree",0.01745]],UNIT["{}",{}],AXIS["X",EAST]]'


@pytest.mark.parametrize(
    ("code", "wkt", "metres"),
    [
        (None, FEET.format("US survey foot", 0.3048006096), 1200 / 3937),
        (None, f'COMPD_CS["x",{FEET.format("foot", 0.3048)},VERT_CS["h",UNIT["metre",1]]]', 0.3048),
        (
            None,
            'PROJCRS["A",CS[Cartesian,2],AXIS["(E)",east],LENGTHUNIT["metre",1],ID["EPSG",2056]]',
            1.0,
        ),
        (9002, None, 0.3048),
        (None, None, None),
    ],
)
def test_the_unit_of_a_scan_is_its_map_system_s(
    code: int | None, wkt: str | None, metres: float | None, tmp_path: Path
) -> None:
    path = systems(tmp_path / "a.las", code, wkt, key=3076)
    several = stream_of([path, systems(tmp_path / "b.las", None, None)])
    for found in (Source(path).metres_per_unit, several.metres_per_unit):
        assert found == (metres and pytest.approx(metres, rel=1e-6))


@pytest.mark.parametrize("value", [0.0, np.nan, np.inf])
@pytest.mark.parametrize("at", [131, 139, 147, 155])
@pytest.mark.parametrize("suffix", ["las", "laz"])
def test_a_broken_scale_or_offset_is_named(
    tmp_path: Path, suffix: str, at: int, value: float
) -> None:
    path = las(tmp_path / f"a.{suffix}", np.arange(30.0).reshape(10, 3), np.ones((10, 3), int))
    data = bytearray(path.read_bytes())
    struct.pack_into("<d", data, at, value)
    path.write_bytes(data)
    if at == 155 and value == 0:  # an offset of 0 is one
        assert len(read_points(path)) == 10
        return
    with pytest.raises(InputError, match=rf"a\.{suffix}: .*{'offset' if at == 155 else 'scale'}"):
        read_points(path)


@pytest.mark.parametrize("point_format", [2, 7])
def test_points_after_a_count_of_0(tmp_path: Path, point_format: int) -> None:
    positions = np.arange(30.0).reshape(10, 3)
    path = las(tmp_path / "a.las", positions, np.arange(30).reshape(10, 3), point_format)
    data = bytearray(path.read_bytes())
    data[107:111] = bytes(4)
    if point_format == 7:
        data[247:255] = bytes(8)
    path.write_bytes(data)
    found = read_cloud(path)
    np.testing.assert_allclose(found.points.positions, positions)
    assert "header_count" in [note.code for note in found.notes]


def test_las_without_color(tmp_path: Path) -> None:
    with pytest.raises(InputError, match=r"a\.las: point format 1 has no colours"):
        read_points(las(tmp_path / "a.las", np.zeros((3, 3)), None))


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
    with pytest.raises(
        InputError, match=r"bytes would unpack to 260,000,000; the limit is 67,108,864"
    ):
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
    monkeypatch.setattr(
        laspy.LasReader, "read_points", lambda *_: (_ for _ in ()).throw(KeyboardInterrupt)
    )
    with pytest.raises(KeyboardInterrupt):
        read_points(laz)


def test_scene_is_not_a_cloud(tmp_path: Path) -> None:
    types = columns("f4", "f4", ("f_dc_0", "f_dc_1", "f_dc_2"))
    with pytest.raises(InputError, match="expected a coloured point cloud, found a Gaussian scene"):
        read_points(ply(tmp_path / "a.ply", types, np.zeros((2, 6))))
