"""Points of clouds that are chosen before the lift, and their colours."""

import shlex
from pathlib import Path

import numpy as np
import pytest

import g2ard
from g2ard.io import Source
from g2ard.jobs.chosen_points import PointChoice
from g2ard.tiles.ingest import ingest
from helpers.cloud_files import columns, las, ply
from helpers.commands import CommandLine, succeeds

COUNT = 600


def _cloud(path: Path) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Write coloured points of classes 2, 5 and 6; return positions, classes and intensities."""
    rng = np.random.default_rng(3)
    xyz = np.round(rng.uniform((4000, 9000, 0), (4100, 9100, 10), (COUNT, 3)), 3)
    classes, intensities = rng.choice([2, 5, 6], COUNT), rng.integers(1, 200, COUNT)
    rgb = rng.integers(1, 65535, (COUNT, 3)).astype(np.uint16)
    if path.suffix in (".las", ".laz"):
        las(path, xyz, rgb, classification=classes.astype("u1"), intensity=intensities.astype("u2"))
    elif path.suffix == ".ply":
        types = columns("<f8", "<u2") | {"scalar_Classification": "<f4", "scalar_Intensity": "<f4"}
        ply(path, types, np.column_stack([xyz, rgb, classes, intensities]))
    elif path.suffix == ".e57":
        _e57(path, xyz, rgb, classes, intensities)
    else:
        head = "x y z red green blue classification intensity"
        table = np.column_stack([xyz, rgb, classes, intensities])
        np.savetxt(path, table, "%.3f", header=head, comments="")
    return xyz, classes, intensities


def _e57(path: Path, xyz: np.ndarray, rgb: np.ndarray, *_: np.ndarray) -> None:
    pye57 = pytest.importorskip("pye57")
    fields = dict(zip(("cartesianX", "cartesianY", "cartesianZ"), xyz.T, strict=True))
    colors = (rgb >> 8).astype("u1").T
    fields |= dict(zip(("colorRed", "colorGreen", "colorBlue"), colors, strict=True))
    fields["intensity"] = _[1].astype(float)
    file = pye57.E57(str(path), mode="w")
    file.write_scan_raw(fields)
    file.close()


def _chosen(path: Path, **choice: object) -> g2ard.Points:
    source = Source(path)
    PointChoice(**choice).narrow(source)
    return source.cloud().whole().points


@pytest.mark.parametrize("suffix", [".las", ".laz", ".ply", ".xyz", ".e57"])
def test_a_box_and_a_condition_keep_points(tmp_path: Path, suffix: str) -> None:
    path = tmp_path / f"cloud{suffix}"
    xyz, classes, intensities = _cloud(path)
    box = (4010, 9010, -1, 4070, 9090, 8)
    inside = np.all((xyz >= box[:3]) & (xyz <= box[3:]), axis=1)
    np.testing.assert_allclose(_chosen(path, box=box).positions, xyz[inside], atol=1e-3)
    keep = (intensities > 50) & (xyz[:, 0] < 4050)
    where = "intensity > 50 and x < 4050"
    if suffix != ".e57":
        keep, where = keep & (classes == 2), f"{where} and classification == 2"
    np.testing.assert_allclose(_chosen(path, where=where).positions, xyz[keep], atol=1e-3)


@pytest.mark.parametrize("suffix", [".las", ".ply", ".xyz", ".e57"])
def test_points_are_grey_by_their_intensity(tmp_path: Path, suffix: str) -> None:
    path = tmp_path / f"cloud{suffix}"
    _, _, intensities = _cloud(path)
    colors = _chosen(path, color="intensity").colors
    assert (colors == colors[:, :1]).all()
    order = np.argsort(intensities, kind="stable")
    assert (np.diff(colors[order, 0]) >= 0).all()
    assert np.ptp(colors) > 0.9


@pytest.mark.parametrize("suffix", [".las", ".ply", ".xyz"])
def test_each_class_has_its_colour(tmp_path: Path, suffix: str) -> None:
    path = tmp_path / f"cloud{suffix}"
    _, classes, _ = _cloud(path)
    colors = _chosen(path, color="class").colors
    of_class = {kind: np.unique(colors[classes == kind], axis=0) for kind in (2, 5, 6)}
    assert [len(found) for found in of_class.values()] == [1, 1, 1]
    assert len(np.unique(np.concatenate(list(of_class.values())), axis=0)) == 3
    red, green, _ = of_class[5][0]
    assert green > red  # vegetation


def test_colours_are_those_of_the_whole_cloud(tmp_path: Path) -> None:
    """A crop of dark points is as dark as it is in the cloud."""
    path = tmp_path / "cloud.las"
    _cloud(path)
    whole = _chosen(path)
    dark = _chosen(path, where="red < 0.2")
    np.testing.assert_array_equal(dark.colors, whole.colors[whole.colors[:, 0] < np.float32(0.2)])


def test_clouds_in_which_no_point_is_chosen_count_for_nothing(tmp_path: Path) -> None:
    first, second = tmp_path / "a.las", tmp_path / "b.las"
    xyz, *_ = _cloud(first)
    moved = xyz + np.array([300, 0, 0])
    las(second, moved, np.full((COUNT, 3), 40_000, np.uint16))
    source = Source(first, None, [second])
    PointChoice(box=(4300, 9000, -1, 4400, 9100, 11)).narrow(source)
    assert source.count == COUNT
    np.testing.assert_allclose(source.cloud().whole().points.positions, moved, atol=1e-3)


def test_tiles_hold_the_chosen_points(tmp_path: Path) -> None:
    path = tmp_path / "cloud.las"
    _, classes, _ = _cloud(path)
    stores = []
    for kind in (2, 5):
        source = Source(path)
        PointChoice(where=f"classification == {kind}").narrow(source)
        stores.append(ingest(source, tmp_path / f"tiles{kind}", tile_rows=80))
    assert [store.count for store in stores] == [int((classes == kind).sum()) for kind in (2, 5)]
    assert stores[0].key != stores[1].key


def test_every_command_that_lifts_takes_the_choice(
    tmp_path: Path, command_line: CommandLine
) -> None:
    path = tmp_path / "cloud.las"
    _, classes, _ = _cloud(path)
    ground, choice = (
        int((classes == 2).sum()),
        ("--where", "classification == 2", "--color", "intensity"),
    )
    succeeds(command_line, tmp_path, "lift", path, "-o", "a.ply", *choice)
    succeeds(command_line, tmp_path, "convert", path, "b.ply", *choice)
    succeeds(
        command_line, tmp_path, "simplify", path, "-n", ground, "--no-views", "-o", "c.ply", *choice
    )
    scenes = [g2ard.load(tmp_path / f"{name}.ply") for name in "abc"]
    assert [len(scene) for scene in scenes] == [ground] * 3
    larger = succeeds(command_line, tmp_path, "convert", path, "larger.ply").err
    assert "smaller: g2ard convert larger.ply larger.sog" in larger
    np.testing.assert_array_equal(scenes[0].means, scenes[1].means)
    words = ("-n", 20, "--steps", 1, "--size", 32, "--no-page", "-o", "run")
    assert (
        f"{ground:,} points → 20"
        in succeeds(command_line, tmp_path, "distill", path, *words, *choice).err
    )
    words = ("-r", "1,4", "--merge-only", "--size", 32, "--dry-run")
    assert (
        f"{round(ground / 4)} Gaussians"
        in succeeds(command_line, tmp_path, "lod", path, *words, *choice).err
    )
    assert (
        f"{ground:,} rows"
        in succeeds(command_line, tmp_path, "ingest", path, "--dry-run", *choice).err
    )
    np.testing.assert_array_equal(
        g2ard.convert(path, where="classification == 2").means, scenes[0].means
    )


@pytest.mark.parametrize(
    ("words", "told"),
    [
        ("lift cloud.las -o a.ply --where 'classification == 9'", "classification is 2 to 6"),
        ("lift cloud.las -o a.ply --box 0,0,0,1,1,1", "none of 600 points is kept: x is 4"),
        (
            "lift cloud.las -o a.ply --where 'class_ == 2'",
            "unknown name 'class_'; names are x, y, z",
        ),
        ("lift bare.las -o a.ply --color class", "colours nothing: it is 0 at all points"),
        ("lift cloud.xyz -o a.ply --color class", "has no column 'classification'"),
        ("simplify ball.ply -r 2 -o a.ply --box 0,0,0,1,1,1", "`g2ard convert` crops scenes"),
        ("convert ball.ply a.ply --color class", "is for point clouds alone"),
    ],
)
def test_choices_that_choose_nothing_say_why(
    words: str, told: str, folder: Path, command_line: CommandLine
) -> None:
    xyz, *_ = _cloud(folder / "cloud.las")
    las(folder / "bare.las", xyz, np.full((COUNT, 3), 40_000, np.uint16))
    (folder / "cloud.xyz").write_text("x y z red green blue\n" + "1 2 3 4 5 6\n2 3 4 9 8 7\n" * 9)
    status, out, error = command_line(*shlex.split(words), cwd=folder)
    assert status in (1, 2)
    assert told in error
    assert not out
    assert not (folder / "a.ply").exists()
