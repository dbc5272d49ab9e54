"""Point clouds in tables of text and in .pcd, and trajectories of SLAM programs."""

from pathlib import Path

import numpy as np
import pytest

from g2ard.errors import InputError
from g2ard.io import kind, read_cloud
from g2ard.io.source import Source
from g2ard.jobs.register import poses_for
from helpers.view_files import orbit

RNG = np.random.default_rng(3)
XYZ = RNG.uniform(-5, 5, (40, 3)).round(3)
RGB = RNG.integers(1, 256, (40, 3))
GREY = RNG.integers(-2000, 2000, (40, 1))


def written(
    path: Path, columns: list[np.ndarray], between: str = " ", point: str = ".", top: str = ""
) -> Path:
    rows = np.column_stack(columns)
    lines = [between.join(f"{value:.10g}".replace(".", point) for value in row) for row in rows]
    path.write_text(top + "\n".join(lines) + "\n")
    return path


def is_cloud(path: Path) -> None:
    assert kind(path) == "points"
    found = read_cloud(path).points
    np.testing.assert_array_equal(found.positions, XYZ)
    np.testing.assert_allclose(found.colors, RGB / 255, atol=1e-6)


@pytest.mark.parametrize("suffix", [".xyz", ".txt", ".csv", ".asc", ".pts"])
@pytest.mark.parametrize(
    ("between", "point"),
    [(" ", "."), ("\t", "."), (",", "."), (", ", "."), (";", "."), (" ", ","), (";", ",")],
)
@pytest.mark.parametrize(
    "top", ["", "x{0}y{0}z{0}r{0}g{0}b\n", "//X{0}Y{0}Z{0}R{0}G{0}B\n", "# a comment\n", "40\n"]
)
def test_six_columns(tmp_path: Path, suffix: str, between: str, point: str, top: str) -> None:
    is_cloud(written(tmp_path / f"a{suffix}", [XYZ, RGB], between, point, top.format(between)))


@pytest.mark.parametrize("intensity", ["before", "after"])
@pytest.mark.parametrize("normals", [0, 3])
def test_intensities_like_colours_beside_colours(
    tmp_path: Path, intensity: str, normals: int
) -> None:
    """Channels of colours vary together, and reflected light does not with them."""
    xyz, rng = RNG.uniform(-5, 5, (300, 3)).round(3), np.random.default_rng(5)
    rgb = np.clip(rng.integers(0, 256, (300, 1)) + rng.integers(-30, 31, (300, 3)), 1, 255)
    light = rng.integers(0, 256, (300, 1))
    shades = [light, rgb] if intensity == "before" else [rgb, light]
    path = written(tmp_path / "a.xyz", [xyz, *shades, xyz[:, :normals] / 9])
    np.testing.assert_allclose(read_cloud(path).points.colors, rgb / 255, atol=1e-6)


@pytest.mark.parametrize(
    ("columns", "top"),
    [
        ([XYZ, GREY, RGB], ""),
        ([XYZ, RGB, GREY], ""),
        ([XYZ, RGB, XYZ / 9], ""),
        ([XYZ, XYZ / 9, RGB], ""),
        ([RGB, XYZ], "red green blue x y z\n"),
        ([XYZ, GREY, RGB, GREY, GREY], "X Y Z Classification Red Green Blue Intensity GpsTime\n"),
    ],
)
def test_further_columns(tmp_path: Path, columns: list[np.ndarray], top: str) -> None:
    is_cloud(written(tmp_path / "a.txt", columns, top=top))


HEADED = {
    "units": ("X[m],Y[m],Z[m],Red[],Green[],Blue[],Reflectance[dB]", "{x},{y},{z},{r},{g},{b},-10"),
    "units in words": ("Easting (m);Northing (m);Elevation (m);R;G;B", "{x};{y};{z};{r};{g};{b}"),
    "CloudCompare": ("//X Y Z Rf Gf Bf", "{x} {y} {z} {rf} {gf} {bf}"),
    "Color_R": ("x,y,z,Color_R,Color_G,Color_B", "{x},{y},{z},{r},{g},{b}"),
    "quotes": ('"x","y","z","r","g","b"', '"{x}","{y}","{z}","{r}","{g}","{b}"'),
    "words": (
        "label,x,y,z,time,red,green,blue",
        "ground,{x},{y},{z},2024-05-01T12:00:00,{r},{g},{b}",
    ),
    "empty": ("x,y,z,intensity,red,green,blue,class", "{x},{y},{z},,{r},{g},{b},"),
    "empty, tabs": ("x\ty\tz\ti\tr\tg\tb", "{x}\t{y}\t{z}\t\t{r}\t{g}\t{b}"),
    "NULL": ("x,y,z,intensity,red,green,blue", "{x},{y},{z},NULL,{r},{g},{b}"),
    "last commas": ("x,y,z,r,g,b", "{x},{y},{z},{r},{g},{b},"),
    "a number of points": ("# X Y Z R G B\n# 40 points\n40", "{x} {y} {z} {r} {g} {b}"),
    "packed": ("x,y,z,rgb", "{x},{y},{z},{packed}"),
    "packed float": ("x,y,z,rgb", "{x},{y},{z},{bits}"),
    "grid of FARO": ("", "0 {i} {x}1 {y}1 {z}1 {r} {g} {b}"),
    "grid with intensity": ("", "0 {i} {x}1 {y}1 {z}1 0.5 {r} {g} {b}"),
    "zero normals": ("", "{x} {y} {z} 0 0 0 {r} {g} {b}"),
    "normals up": ("", "{x} {y} {z} 0 0 1 {r} {g} {b}"),
    "zero normals behind": ("", "{x} {y} {z} {r} {g} {b} 0 0 0"),
    "intensity of 16 bits behind": ("", "{x} {y} {z} {r} {g} {b} {wide}"),
}
"""Headings, and rows."""


def rows_of(form: str) -> list[str]:
    rows = []
    for i, ((x, y, z), (r, g, b)) in enumerate(zip(XYZ.tolist(), RGB.tolist(), strict=True)):
        packed = r << 16 | g << 8 | b
        values = {"x": f"{x:.3f}", "y": f"{y:.3f}", "z": f"{z:.3f}", "r": r, "g": g, "b": b, "i": i}
        values |= {
            "rf": r / 255,
            "gf": g / 255,
            "bf": b / 255,
            "wide": 300 + 50 * i,
            "packed": packed,
        }
        rows.append(form.format(**values, bits=f"{np.uint32(packed).view(np.float32):.9g}"))
    return rows


@pytest.mark.parametrize("suffix", [".csv", ".txt", ".asc", ".tsv"])
@pytest.mark.parametrize("end", ["\n", "\r\n", "\r"])
@pytest.mark.parametrize("case", HEADED)
def test_tables_as_programs_write_them(tmp_path: Path, case: str, end: str, suffix: str) -> None:
    heading, form = HEADED[case]
    text = end.join([*heading.split("\n"), *rows_of(form), ""])
    (tmp_path / f"a{suffix}").write_bytes(text.encode())
    found = read_cloud(tmp_path / f"a{suffix}").points
    np.testing.assert_allclose(found.positions, XYZ, atol=2e-4)
    np.testing.assert_allclose(found.colors, RGB / 255, atol=1e-6)


@pytest.mark.parametrize("between", ["20", "x y z r g b", "x y z r g b\n20", ""])
def test_several_scans_in_a_table(tmp_path: Path, between: str) -> None:
    rows = rows_of("{x} {y} {z} {r} {g} {b}")
    lines = [between, *rows[:20], between, *rows[20:], ""]
    (tmp_path / "a.pts").write_text("\n".join(lines))
    is_cloud(tmp_path / "a.pts")


@pytest.mark.parametrize(
    "suffix", ["xyz", "xyzrgb", "xyzi", "xyzn", "neu", "pts", "csv", "tsv", "dat"]
)
def test_suffixes_of_tables(tmp_path: Path, suffix: str) -> None:
    is_cloud(written(tmp_path / f"a.{suffix}", [XYZ, RGB]))


@pytest.mark.parametrize(
    ("text", "says"),
    [
        (
            "Rouge,Vert,Bleu,X,Y,Z\n1,2,3,4,5,6\n7,8,9,1,2,3\n",
            "found columns x y z rouge vert bleu",
        ),
        ("x,y,z,r,g,b\n1,2,3,4,5,6\n1,2,3,4,5,six\n", "'six'"),
        ("a,b\n1,2\n3,4\n", "no table of points: has 2 columns without a heading of x, y and z"),
    ],
)
def test_tables_that_cannot_be_read_say_why(tmp_path: Path, text: str, says: str) -> None:
    (tmp_path / "a.csv").write_text(text)
    with pytest.raises(InputError, match=says):
        Source(tmp_path / "a.csv").cloud()


def test_intensities_are_grey(tmp_path: Path) -> None:
    found = read_cloud(written(tmp_path / "a.pts", [XYZ, GREY], top="40\n"))
    assert [note.code for note in found.notes] == ["grey"]
    assert (
        np.argsort(found.points.colors[:, 0], kind="stable")
        == np.argsort(GREY[:, 0], kind="stable")
    )[2:-2].all()


@pytest.mark.parametrize(
    ("columns", "says"),
    [([XYZ], "no colours"), ([XYZ, GREY, GREY], "columns"), ([XYZ, XYZ - 9], "columns")],
)
def test_columns_that_are_not_colours_are_named(
    tmp_path: Path, columns: list[np.ndarray], says: str
) -> None:
    with pytest.raises(InputError, match=says):
        read_cloud(written(tmp_path / "a.xyz", columns))


@pytest.mark.parametrize("how", ["ascii", "binary"])
@pytest.mark.parametrize("rgb", ["F", "U", "apart"])
def test_pcd(tmp_path: Path, how: str, rgb: str) -> None:
    packed = (RGB[:, 0] << 16 | RGB[:, 1] << 8 | RGB[:, 2]).astype("<u4")
    names = ["r", "g", "b"] if rgb == "apart" else ["rgb"]
    kinds = {"F": "<f4", "U": "<u4", "apart": "u1"}[rgb]
    rows = np.zeros(
        40, [(n, "<f8") for n in "xyz"] + [("normal", "<f4", 3)] + [(n, kinds) for n in names]
    )
    for i, axis in enumerate("xyz"):
        rows[axis] = XYZ[:, i]
    for i, name in enumerate(names):
        rows[name] = RGB[:, i] if rgb == "apart" else packed.view(kinds)
    size, letter = np.dtype(kinds).itemsize, "U" if rgb == "apart" else rgb
    head = f"# .PCD v0.7\nVERSION 0.7\nFIELDS x y z normal {' '.join(names)}\n"
    head += f"SIZE 8 8 8 4{f' {size}' * len(names)}\nTYPE F F F F{f' {letter}' * len(names)}\n"
    head += f"COUNT 1 1 1 3{' 1' * len(names)}\nWIDTH 40\nHEIGHT 1\n"
    head += f"VIEWPOINT 0 0 0 1 0 0 0\nPOINTS 40\nDATA {how}\n"
    text = "\n".join(" ".join(f"{v:.9g}" for v in np.hstack([*row.item()])) for row in rows)
    (tmp_path / "a.pcd").write_bytes(
        head.encode() + (rows.tobytes() if how == "binary" else text.encode())
    )
    is_cloud(tmp_path / "a.pcd")
    (tmp_path / "a.pcd").write_bytes((head + "1 2").encode())
    with pytest.raises(InputError, match=r"a\.pcd: "):
        read_cloud(tmp_path / "a.pcd")


def test_packed_pcd_says_what_unpacks_it(tmp_path: Path) -> None:
    (tmp_path / "a.pcd").write_text(
        "FIELDS x y z rgb\nSIZE 4 4 4 4\nTYPE F F F F\nPOINTS 1\nDATA binary_compressed\n"
    )
    with pytest.raises(InputError, match="pcl_convert_pcd_ascii_binary"):
        read_cloud(tmp_path / "a.pcd")


def trajectory(path: Path, times: list[str]) -> Path:
    lines = ["# timestamp tx ty tz qx qy qz qw"]
    for time, view in zip(times, orbit(len(times)), strict=True):
        world = np.linalg.inv(view)
        if path.name == "kitti.txt":
            lines.append(" ".join(map(repr, world[:3].ravel().tolist())))
            continue
        w = np.sqrt(max(1e-12, 1 + np.trace(world[:3, :3]))) / 2
        R = world[:3, :3]
        xyz = np.array([R[2, 1] - R[1, 2], R[0, 2] - R[2, 0], R[1, 0] - R[0, 1]]) / (4 * w)
        lines.append(
            " ".join([time, *map(repr, [*world[:3, 3].tolist(), *xyz.tolist(), float(w)])])
        )
    path.write_text("\n".join(lines) + "\n")
    return path


@pytest.mark.parametrize("file", ["CameraTrajectory.txt", "traj.tum", "kitti.txt"])
@pytest.mark.parametrize(
    ("times", "names"),
    [
        ("1403636579.{}00000", "1403636579{}00000000.png"),
        ("1403636579{}00000000", "cam0/1403636579{}00000000.png"),
        ("1403636579.{}01", "1403636579.{}.png"),
        ("{}", "frame_{}.png"),
        ("17.{}", "photo {}.jpg"),
    ],
)
def test_trajectories(tmp_path: Path, file: str, times: str, names: str) -> None:
    path = trajectory(tmp_path / file, [times.format(i) for i in range(1, 7)])
    photos = [names.format(i) for i in range(1, 7)]
    found = poses_for(path, photos)
    for name, view in zip(photos, orbit(6), strict=True):
        np.testing.assert_allclose(found[name], view, atol=1e-5)


def test_matrices_go_with_photos_by_their_numbers(tmp_path: Path) -> None:
    path = trajectory(tmp_path / "kitti.txt", [str(i) for i in range(12)])
    found = poses_for(path, [f"{i}.png" for i in (11, *range(11))])
    for i, view in enumerate(orbit(12)):
        np.testing.assert_allclose(found[f"{i}.png"], view, atol=1e-5)


def test_trajectories_of_other_photos_are_refused(tmp_path: Path) -> None:
    path = trajectory(tmp_path / "a.txt", [f"14{i}.5" for i in range(6)])
    with pytest.raises(InputError, match="trajectory of 6 poses"):
        poses_for(path, ["a.png", "b.png"])
