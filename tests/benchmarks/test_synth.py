"""The procedural city: exact rays against a naive caster, clouds and photos that agree, disjoint splits."""

import json
from dataclasses import replace

import numpy as np
import pytest

from benchmarks.synth import City, CityConfig, city, rings, write_city
from benchmarks.synth.layout import Material
from benchmarks.synth.rings import ring_scan
from benchmarks.synth.shapes import Kind, Shapes, cast
from g2ard.errors import InputError, OutputError
from g2ard.io import read_points, read_views
from helpers.interruptions import interrupt_at
from reference import synth as naive

SMALL = CityConfig(points=4_000, views=12, size=(96, 72), blocks=1, seed=3)
LARGE = replace(SMALL, points=8_000, size=(480, 360), blocks=2)


@pytest.fixture(scope="module")
def town() -> City:
    return city(SMALL)


@pytest.fixture(scope="module")
def large() -> City:
    return city(LARGE)


@pytest.fixture(scope="module")
def large_scan(large):
    return large.points()


@pytest.fixture(scope="module")
def scan(town):
    return town.points()


def one_of_each(rng: np.random.Generator, count: int) -> Shapes:
    lo = rng.uniform(-10, 10, (count, 3))
    return Shapes(np.arange(count) % len(Kind), lo, lo + rng.uniform(0.2, 6, (count, 3)))


@pytest.mark.parametrize("packet", [1, 64, 8192])
def test_first_hits_are_the_naive_casters(packet):
    rng = np.random.default_rng(0)
    shapes = one_of_each(rng, 60)
    origins = rng.uniform(-15, 15, (4000, 3))  # some of them within bodies
    directions = rng.standard_normal((4000, 3))
    directions[:300, rng.integers(3)] = 0.0  # parallel to faces
    want, body = naive.first_hits(shapes, origins, directions)
    t, hit = cast(
        shapes, np.ascontiguousarray(origins.T), np.ascontiguousarray(directions.T), packet=packet
    )
    assert (hit >= 0).mean() > 0.2
    np.testing.assert_array_equal(hit, body)
    np.testing.assert_allclose(t, want, rtol=1e-9, atol=1e-9)


def test_points_lie_on_surfaces_within_noise(town, scan):
    shapes, noise = town.layout.shapes, town.config.noise
    away = np.empty(len(scan.positions))
    for p in np.unique(scan.primitives):
        at = scan.primitives == p
        away[at] = naive.surface_distance(
            Kind(shapes.kinds[p]), shapes.lo[p], shapes.hi[p], scan.positions[at]
        )
    assert away.max() < 6 * noise
    # a half-normal's mean is 0.8 σ, less where beams graze
    assert 0.2 * noise < away.mean() < 0.8 * noise
    exact = City(replace(SMALL, noise=0.0)).points(1000)
    for p in np.unique(exact.primitives):
        at = exact.positions[exact.primitives == p]
        assert (
            naive.surface_distance(Kind(shapes.kinds[p]), shapes.lo[p], shapes.hi[p], at).max()
            < 1e-8
        )


def test_scan_is_exact_in_count_and_denser_near_scanners(large, large_scan):
    assert len(large_scan.positions) == LARGE.points
    materials = large.layout.materials[large_scan.primitives]
    # ground, blocks, facades, roofs, leaves, the rest
    assert set(Material) <= set(materials.tolist())
    ground = large_scan.positions[materials == Material.GROUND]
    beyond = (np.abs(ground[:, :2]) - large.layout.reach).max(1)
    street, edge = (beyond < 5).sum(), (beyond > 25).sum()
    outer = (2 * (large.layout.reach + 45)).prod() - (2 * (large.layout.reach + 25)).prod()
    carriageway = (2 * (large.layout.reach + 5)).prod() - 4 * 62 * 48
    assert street / carriageway > 3 * edge / outer


def test_cloud_and_photos_agree_in_colour(large, large_scan):
    difference = []
    for name in ("train", "adapt", "ood"):
        view = large.views[name].take([0])
        camera = large_scan.positions @ view.viewmats[0, :3, :3].T + view.viewmats[0, :3, 3]
        x, y = (camera @ view.Ks[0].T)[:, :2].T / np.where(camera[:, 2] > 0.5, camera[:, 2], np.nan)
        with np.errstate(invalid="ignore"):
            inside = (x > 0) & (x < 480) & (y > 0) & (y < 360)
        at = np.flatnonzero(inside)
        column, row = x[at].astype(int), y[at].astype(int)
        rays = np.linalg.solve(view.Ks[0], [column + 0.5, row + 0.5, np.ones(len(at))])
        depth, _ = cast(large.layout.shapes, view.positions.T, view.viewmats[0, :3, :3].T @ rays)
        visible = np.abs(depth - camera[at, 2]) < 0.02 * camera[at, 2]
        difference.append(
            np.abs(large.photo(view, 0)[row, column] - large_scan.colors[at])[visible].mean(1)
        )
    away = np.concatenate(difference)
    assert len(away) > 400
    assert np.median(away) < 0.035  # leaves, bricks and edges differ within a pixel
    assert away.mean() < 0.06


def test_splits_are_disjoint(town):
    views = town.views
    assert sum(len(v) for v in views.values()) == SMALL.views
    names = [name for v in views.values() for name in v.names]
    assert len(set(names)) == SMALL.views

    def nearest(a: str, b: str) -> float:
        return float(np.linalg.norm(views[a].positions[:, None] - views[b].positions, axis=2).min())

    assert nearest("train", "val") > 0.1
    for own in ("adapt", "ood"):
        for other in ({"train", "val", "adapt", "ood"}) - {own}:
            assert nearest(own, other) > 0.5
    # val lies on the train trajectories: between its neighbours
    many = city(replace(LARGE, views=100)).views
    gaps = np.linalg.norm(many["val"].positions[:, None] - many["train"].positions, axis=2).min(1)
    assert np.median(gaps) < 20


@pytest.mark.parametrize(("blocks", "seed"), [(1, 0), (2, 3)])
def test_cameras_have_room_and_something_to_see(blocks, seed):
    town = city(blocks=blocks, seed=seed, views=16, size=(16, 12))
    rays = np.random.default_rng(0).standard_normal((3, 100))
    rays /= np.linalg.norm(rays, axis=0)
    for cameras in town.views.values():
        for i, at in enumerate(cameras.positions[:, :, None]):
            t, hit = cast(town.layout.shapes, at, rays)
            assert t.min() > 0.3, cameras.names[i]
            found = hit >= 0
            normals = town.layout.shapes.normals(at + rays[:, found] * t[found], hit[found])
            assert (normals * rays[:, found]).sum(0).max() < 1e-9, (
                f"{cameras.names[i]} is within matter"
            )
            seen = (town.photo(cameras, i) != np.float32(town.config.sky)).any(2)
            assert seen.mean() > 0.2, f"{cameras.names[i]} sees nothing"


def test_writes_a_data_set(tmp_path, town, scan):
    out = tmp_path / "city"
    manifest = write_city(out, SMALL, threads=2)
    assert [p.name for p in tmp_path.iterdir()] == ["city"]
    cloud = read_points(out / "cloud.ply")
    np.testing.assert_array_equal(cloud.positions, scan.positions)
    assert np.abs(cloud.colors - scan.colors).max() <= 0.5 / 255 + 1e-6
    for name, cameras in town.views.items():
        back = read_views(out / f"{name}.json")
        np.testing.assert_array_equal(back.viewmats, cameras.viewmats)
        assert back.names == cameras.names
        assert all(path is not None and path.is_file() for path in back.image_paths)
        assert manifest["views"][name] == len(cameras)
    assert json.loads((out / "manifest.json").read_text())["options"]["seed"] == 3
    again = tmp_path / "again"
    write_city(again, SMALL, threads=1)
    files = sorted(p.relative_to(out) for p in out.rglob("*") if p.is_file())
    assert len(files) == SMALL.views + 6
    assert all((out / f).read_bytes() == (again / f).read_bytes() for f in files)
    with pytest.raises(OutputError, match="exists"):
        write_city(out, SMALL)


def test_interrupted_leaves_nothing(tmp_path):
    with pytest.raises(KeyboardInterrupt):
        write_city(tmp_path / "city", replace(SMALL, points=500), progress=interrupt_at("photos"))
    assert not list(tmp_path.iterdir())


def test_invalid_cities_are_rejected():
    for name, value in (
        *(
            ("views", 7),
            ("points", 0),
            ("blocks", 0),
            ("size", (0, 5)),
            ("noise", np.nan),
            ("seed", -1),
        ),
        *(("sky", (2.0, 0, 0)), ("offset", (np.inf, 0, 0))),
    ):
        with pytest.raises(InputError, match=name.replace("size", "width")):
            CityConfig(**{name: value})


def test_a_ring_scan_lies_on_a_room_and_its_furniture(tmp_path, command_line):
    status, _, err = command_line("benchmarks", "synth", "rings", "-o", "rings.ply", cwd=tmp_path)
    assert (status, "115,200 points" in err) == (0, True)
    cloud = read_points(tmp_path / "rings.ply")
    room = np.array([10.0, 7.0, 3.0])
    off = [np.minimum(np.abs(cloud.positions), np.abs(cloud.positions - room)).min(axis=1)]
    # the largest of six signed distances of a box is that of its surface
    for lo, hi in rings._FURNITURE:
        far = np.maximum(np.array(lo) - cloud.positions, cloud.positions - np.array(hi)).max(axis=1)
        off.append(np.abs(far))
    assert np.min(off, axis=0).max() < 0.06  # six times the noise
    assert (off[0] > 0.06).mean() > 0.01  # some are on furniture
    assert 0.05 < cloud.colors.min() < cloud.colors.max() < 1
    assert ring_scan(4, 10).positions.tobytes() == ring_scan(4, 10).positions.tobytes()
