"""Scans stand upright in other programs, and where they are in g2ard: in every format and command."""

import json
import warnings
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any

import laspy
import numpy as np
import pytest

import g2ard
from g2ard.errors import InputError
from g2ard.io.scene_formats import FORMATS
from g2ard.io.scenes import read_back
from g2ard.jobs.viewer_frame import up_of
from g2ard.scene.splats import Splats
from g2ard.scene.transform import as_stored, change_of_axes, restored, up_in
from helpers.commands import CommandLine, refused, succeeds
from helpers.peers import adobe_spz, splat_transform

UTM = np.array([500_123.0, 6_600_456.0, 40.0])
NAMES = [
    "scene/meta.json" if name == "folder" else f"scene.{name}" for name in (*FORMATS, "folder")
]


def tower(count: int = 300) -> Splats:
    """A slab of ground and a mast on its east side, z up, with harmonics."""
    rng = np.random.default_rng(5)
    ground = np.column_stack([rng.uniform(-5, 5, (count, 2)), rng.normal(0, 0.02, count)])
    mast = np.column_stack([rng.normal(4, 0.1, (count, 2)), rng.uniform(0, 3, count)])
    means = np.concatenate([ground, mast]).astype(np.float32)
    n = len(means)
    return Splats.create(
        means,
        quats=rng.normal(size=(n, 4)),
        scales=np.exp(rng.normal(-2, 0.3, (n, 3))),
        sh0=rng.uniform(-1, 1, (n, 1, 3)),
        shN=rng.uniform(-0.2, 0.2, (n, 3, 3)),
    )


def scan(offset: Any = UTM) -> Splats:
    return replace(tower(), offset=np.array(offset, float), axes="RFU")


def saved(path: Path, splats: Splats, **options: Any) -> Path:
    if path.suffix in (".usdc", ".usda"):
        pytest.importorskip("pxr")
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        g2ard.save(path, splats, **options)
    return path


def worlds(splats: Splats) -> Any:
    world = splats.means.astype(float) + splats.offset
    return world[np.lexsort(np.round(world, 1).T)]


def spread(splats: Splats) -> Any:
    """Covariances of colours with heights tell a mirror or a turn that positions alone do not."""
    world = worlds(splats)
    return np.sort(world, axis=0)


def plain(path: Path) -> Splats:
    """Return the file as another program reads it, without g2ard's own statements."""
    data = path.read_bytes()
    if path.suffix == ".ply":
        for name in (b"g2ard axes", b"g2ard offset"):
            data = data.replace(b"comment " + name, b"comment " + b"x" * len(name))
    elif path.suffix == ".spz" and data[3] == 0x10:
        data = data[:3] + b"\0" + data[4:10] + data[data.index(b"\0", 10) + 1 :]
    elif path.name == "meta.json":
        meta = json.loads(data)
        meta.pop("g2ard", None)
        data = json.dumps(meta).encode()
    elif path.suffix in (".glb", ".usda"):
        data = data.replace(b'"g2ard":', b'"other":').replace(b"g2ardAxes", b"otherAxes")
    elif path.suffix != ".splat":
        pytest.skip("its text cannot be changed here")
    other = path.with_name(f"plain{path.suffix}") if path.name != "meta.json" else path
    other.write_bytes(data)
    return g2ard.load(other)


@pytest.mark.parametrize("name", NAMES)
def test_other_programs_see_a_scan_upright(tmp_path: Path, name: str) -> None:
    read = plain(saved(tmp_path / name, scan()))
    seen, expected = (
        worlds(one) - (worlds(one).min(axis=0) + worlds(one).max(axis=0)) / 2
        for one in (read, as_stored(replace(scan(), offset=np.zeros(3))))
    )
    assert np.abs(np.sort(seen, axis=0) - np.sort(expected, axis=0)).max() < 0.05
    # y is down in what a .ply holds, and every other format is read to it
    above = seen[:, 1] < -0.5
    assert 50 < above.sum() < 200  # of 300 of the mast
    assert seen[above, 0].min() > 2  # the mast is in the east: not mirrored
    assert seen[above, 2].min() > 2  # and in the north


@pytest.mark.parametrize("offset", [UTM, (0, 0, 0)], ids=["map", "local"])
@pytest.mark.parametrize("name", NAMES)
def test_every_format_gives_a_scan_back_where_it_was(
    tmp_path: Path, name: str, offset: Any
) -> None:
    given = scan(offset)
    read = read_back(saved(tmp_path / name, given), given)
    assert read.axes == "RFU"
    assert up_of(read) == pytest.approx((0, 0, 1))
    assert np.abs(spread(read) - spread(given)).max() < 0.02
    if name.endswith((".ply", ".usda", ".glb")) and not name.endswith("compressed.ply"):
        rows, others = (np.lexsort(np.round(s.means, 3).T) for s in (read, given))
        np.testing.assert_allclose(read.shN[rows], given.shN[others], atol=1e-6)
        np.testing.assert_allclose(read.scales[rows], given.scales[others], rtol=1e-5)
        dots = np.abs((read.quats[rows] * given.quats[others]).sum(1))
        lengths = np.linalg.norm(read.quats[rows], axis=1) * np.linalg.norm(
            given.quats[others], axis=1
        )
        np.testing.assert_allclose(dots, lengths, rtol=1e-5)


def test_a_ply_gives_back_every_bit(tmp_path: Path) -> None:
    given = scan().with_sh_degree(0)
    # unit quaternions, scales of their logarithms
    given = g2ard.load(saved(tmp_path / "a.ply", given))
    read = g2ard.load(saved(tmp_path / "b.ply", given))
    for name in ("means", "quats", "scales", "logit_opacities", "sh0", "offset"):
        np.testing.assert_array_equal(getattr(read, name), getattr(given, name), err_msg=name)


@pytest.mark.parametrize("version", [2, 3, 4])
@pytest.mark.parametrize("axes", ["RUB", "RDF"])
def test_every_spz_gives_a_scan_back(tmp_path: Path, version: int, axes: str) -> None:
    given = scan()
    read = g2ard.load(saved(tmp_path / "a.spz", given, spz_version=version, axes=axes))
    assert read.axes == "RFU"
    assert np.abs(spread(read) - spread(given)).max() < 0.02


@pytest.mark.parametrize("name", ["scene.spz", "scene.splat"])
def test_positions_of_a_map_fit_half_floats(tmp_path: Path, name: str) -> None:
    """Also of a scene whose float32 means are far from the origin, without an offset."""
    for number, far in enumerate(
        (scan(), replace(tower(), means=tower().means + np.float32([7e4, 0, 0])))
    ):
        path = saved(tmp_path / f"{number}{name}", far)
        assert np.abs(plain(path).means).max() < 65_504
        assert np.abs(spread(read_back(path, far)) - spread(far)).max() < 0.02


@pytest.mark.parametrize("name", NAMES)
def test_trained_scenes_are_written_as_they_were(tmp_path: Path, name: str) -> None:
    given = replace(tower(), up=(0.0, 0.0, 1.0))  # as from nerfstudio
    path = saved(tmp_path / name, given)
    assert g2ard.load(path).axes == "RDF"
    assert b"g2ard axes" not in path.read_bytes()
    assert np.abs(spread(g2ard.load(path)) - spread(given)).max() < 0.02


def test_a_splat_of_a_map_says_how_to_put_it_back(
    command_line: CommandLine, tmp_path: Path
) -> None:
    g2ard.save(tmp_path / "a.ply", scan())
    _, said = succeeds(command_line, tmp_path, "convert", "a.ply", "a.splat")
    line = next(line for line in said.splitlines() if "cannot state map coordinates" in line)
    command = line.split("`g2ard ")[1].split("`")[0].replace("OUT.ply", "back.ply").split()
    succeeds(command_line, tmp_path, *command)
    # of float32
    assert np.abs(spread(g2ard.load(tmp_path / "back.ply")) - spread(scan())).max() < 0.5


def test_axes_of_a_scan_can_be_had_again(command_line: CommandLine, tmp_path: Path) -> None:
    """`--to-axes` counts from the map's axes, whatever the file holds."""
    g2ard.save(tmp_path / "a.ply", scan())
    local = replace(scan(), offset=np.zeros(3))
    for name, axes in (("z-up", "RFU"), ("y-up", "RUB"), ("RDF", "RDF")):
        succeeds(
            command_line,
            tmp_path,
            "convert",
            "a.ply",
            f"{axes}.ply",
            "--to-axes",
            name,
            "--recentre",
        )
        read = g2ard.load(tmp_path / f"{axes}.ply")
        expected = worlds(local) @ change_of_axes("RFU", axes).T
        assert read.axes == "RDF"
        assert np.abs(np.sort(worlds(read), axis=0) - np.sort(expected, axis=0)).max() < 1e-4
    line = refused(
        command_line, tmp_path, "convert", "a.ply", "b.ply", "--from-axes", "RFU", status=1
    )
    assert "names its axes" in line


def write_las(path: Path, shift: Any = (0.0, 0.0, 0.0)) -> None:
    header = laspy.LasHeader(point_format=3, version="1.4")
    header.scales, header.offsets = np.full(3, 0.001), np.array(shift)
    las = laspy.LasData(header)
    rng = np.random.default_rng(0)
    points = tower(1500).means + np.array(shift)
    las.x, las.y, las.z = points.T
    las.red, las.green, las.blue = rng.integers(0, 65_535, (3, len(points)))
    las.write(path)


def test_results_of_a_cloud_stand_upright_in_every_command(
    command_line: CommandLine, tmp_path: Path
) -> None:
    write_las(tmp_path / "map.las", UTM)
    run = partial(succeeds, command_line, tmp_path)
    run("lift", "map.las", "-o", "lift.ply")
    run("simplify", "map.las", "-r", "4", "--no-views", "-o", "small.ply")
    run("simplify", "lift.ply", "-r", "4", "--method", "fast", "-o", "fast.sog")
    run("simplify", "lift.ply", "-r", "4", "--method", "paper", "-o", "paper.ply")
    run("ingest", "map.las", "-o", "tiles", "--tile-rows", "800")
    run("simplify", "tiles", "-r", "4", "--no-views", "-o", "tiled.ply")
    small = ("--steps", "3", "--size", "64", "--focus", "far", "--no-page")
    run("distill", "map.las", "-r", "4", *small, "-o", "run")
    run("distill", "tiles", "-r", "4", *small, "-o", "tiled_run")
    run(
        "recover",
        "small.ply",
        "--teacher",
        "lift.ply",
        "--steps",
        "3",
        "--size",
        "64",
        "-o",
        "more.ply",
    )
    run("clean", "lift.ply", "-o", "clean.ply")
    box = ",".join(str(v) for corner in ((-6, -6, -1), (3, 3, 1)) for v in UTM + corner)
    run("convert", "lift.ply", f"--box={box}", "-o", "crop.spz")
    made = ["lift.ply", "small.ply", "fast.sog", "paper.ply", "tiled.ply", "run/scene.ply"]
    made += ["tiled_run/scene.ply", "more.ply", "clean.ply", "crop.spz"]
    for name in made:
        found = g2ard.load(tmp_path / name)
        assert (name, found.axes) == (name, "RFU")
        world = worlds(found) - UTM
        assert np.abs(world[:, :2]).max() < 6, name
        assert world[:, 2].min() > -0.5, name
        assert world[:, 2].max() < 3.5, name
    scenes = ["small.ply", "tiled.ply", "run/scene.ply"]
    run("evaluate", *scenes, "--teacher", "lift.ply", "--size", "64", "--json", "scores.json")
    scores = json.loads((tmp_path / "scores.json").read_text())
    assert min(row["psnr"] for row in scores["scenes"]) > 15


def test_levels_of_a_scan_stand_upright(tmp_path: Path) -> None:
    levels = [scan(), scan().take(slice(0, 600, 4))]
    g2ard.save_levels(tmp_path / "sog", levels)
    whole = g2ard.load(tmp_path / "sog")
    assert whole.axes == "RFU"
    assert np.abs(spread(whole) - spread(levels[0])).max() < 0.02
    bound = json.loads((tmp_path / "sog" / "lod-meta.json").read_text())["tree"]["bound"]
    stored = as_stored(replace(levels[0], offset=np.zeros(3))).means
    assert (np.array(bound["min"]) <= stored.min(axis=0)).all()
    assert (np.array(bound["max"]) >= stored.max(axis=0)).all()
    assert np.ptp([bound["min"], bound["max"]], axis=0).max() < 15
    g2ard.save_tileset(tmp_path / "tiles", levels)
    tile = g2ard.load(sorted((tmp_path / "tiles").glob("*.glb"))[0])
    assert tile.axes == "RDF"


def test_a_guess_of_up_is_told(command_line: CommandLine, tmp_path: Path) -> None:
    rng = np.random.default_rng(1)
    for axes in ("RFU", "RDF", "RUB"):
        points = tower(1500).means.astype(float) @ change_of_axes("RFU", axes).T
        rows = np.column_stack([points, rng.integers(0, 255, points.shape)])
        np.savetxt(tmp_path / "cloud.xyz", rows, fmt=["%.4f"] * 3 + ["%d"] * 3)
        _, said = succeeds(command_line, tmp_path, "lift", "cloud.xyz", "-o", "lift.ply", "-w")
        assert "is taken for up, a guess" in said
        found = g2ard.load(tmp_path / "lift.ply")
        assert found.axes == axes
        np.testing.assert_allclose(np.ptp(found.means, axis=0), np.ptp(points, axis=0), rtol=1e-3)


def test_damaged_statements_are_refused(tmp_path: Path) -> None:
    path = saved(tmp_path / "a.ply", scan())
    path.write_bytes(path.read_bytes().replace(b"axes RFU", b"axes RFX"))
    with pytest.raises(InputError, match="broken comment 'g2ard axes RFX'"):
        g2ard.load(path)
    path = saved(tmp_path / "a.spz", scan())
    path.write_bytes(path.read_bytes().replace(b"RFU", b"RFX"))
    with pytest.raises(InputError, match="axes"):
        g2ard.load(path)
    path = saved(tmp_path / "b.spz", scan(), spz_version=4)
    path.write_bytes(path.read_bytes().replace(b'"offset":[', b'"offset":{'))
    with pytest.raises(InputError, match=r"b\.spz"):
        g2ard.load(path)


def test_up_of_axes() -> None:
    assert up_in("RDF") == (0, -1, 0)
    for axes in ("RFU", "RUB", "RDF"):
        found = restored(as_stored(replace(tower(), axes=axes)), axes)
        np.testing.assert_array_equal(found.means, tower().means)


@pytest.mark.parametrize("version", [3, 4])
def test_other_readers_of_spz_skip_what_g2ard_states(tmp_path: Path, version: int) -> None:
    path = saved(tmp_path / "a.spz", scan(), spz_version=version)
    stored = as_stored(replace(scan(), offset=np.zeros(3))).means
    found = adobe_spz(path)["positions"].reshape(-1, 3)
    if version == 3:  # as in its own axes, right, up, back
        splat_transform(path, tmp_path / "theirs.ply")
        found = g2ard.load(tmp_path / "theirs.ply").means
        stored = stored * np.float32([1, -1, -1])
    assert np.abs(np.sort(found, axis=0) - np.sort(stored, axis=0)).max() < 1e-3
