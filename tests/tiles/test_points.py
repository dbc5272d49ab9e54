"""Clouds in blocks, and lifted tile by tile: what `lift` gives of the whole cloud."""

import json
from contextlib import nullcontext
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest

from g2ard.errors import InputError, OutputError
from g2ard.io import Source, read_cloud, write_points
from g2ard.io.tile_store import packed
from g2ard.io.types import Points
from g2ard.jobs.chosen_points import PointChoice
from g2ard.progress import silent
from g2ard.stages.lift import LiftConfig, lift
from g2ard.tiles.executor import executor
from g2ard.tiles.ingest import ingest
from helpers import cloud_files
from helpers.ingested import as_set, halos_of, saved, tiles_of, town
from helpers.interruptions import interrupt_at
from helpers.level_files import files_of
from helpers.opened import stream_of
from helpers.ply_files import save

UTM = (636_337.8, 5_427_319.25, 40.0)


def streets(count: int = 8000, seed: int = 0, offset: tuple[float, ...] = (0, 0, 0)) -> Points:
    """A ground and two walls with a survey's noise."""
    rng = np.random.default_rng(seed)
    at = rng.uniform(0, 1, (count, 3)) * [60, 25, 0]
    wall = rng.integers(0, 4, count)
    height = rng.uniform(0, 12, count)
    at[wall == 0] = np.stack([at[:, 0], np.full(count, 25.0), height], 1)[wall == 0]
    at[wall == 1] = np.stack([np.full(count, 60.0), at[:, 1], height], 1)[wall == 1]
    return Points(
        at + rng.normal(0, 0.01, (count, 3)) + offset,
        rng.uniform(0, 1, (count, 3)).astype(np.float32),
    )


def las(path: Path, points: Points, top: int = 65535) -> Path:
    return cloud_files.las(path, points.positions, np.rint(points.colors * top).astype(np.uint16))


def ply(path: Path, points: Points) -> Path:
    write_points(path, points)
    return path


@pytest.mark.parametrize("name", ["a.ply", "a.las", "a.laz", "dim.las"])
def test_blocks_are_the_cloud(tmp_path: Path, name: str) -> None:
    points = streets(3000, offset=UTM)
    path = tmp_path / name
    if name.endswith("ply"):
        ply(path, points)
    else:
        las(path, points, 255 if name == "dim.las" else 65535)
    whole = read_cloud(path)
    for rows, start in ((100_000, 0), (700, 0), (64, 2990)):
        stream = stream_of(path)
        blocks = list(stream.blocks(rows, start))
        np.testing.assert_array_equal(
            np.concatenate([b[0] for b in blocks]), whole.points.positions[start:]
        )
        colors = np.concatenate([b[1] for b in blocks])
        np.testing.assert_array_equal(colors, whole.points.colors[start:])
        assert stream.count == 3000
        assert [n.code for n in stream.all_notes()] == [n.code for n in whole.notes]
        assert np.abs(whole.points.positions - stream.offset).max() < 100


def test_lifted_tiles_are_the_lifted_cloud(tmp_path: Path) -> None:
    """A halo of four spacings holds a point's ten neighbours, which lie within two.

    Neighbourhoods of points in lines are wider, so a few may end at the halo.
    """
    points = streets(60_000, offset=UTM)
    path = ply(tmp_path / "cloud.ply", points)
    store = ingest(path, tmp_path / "tiles", tile_rows=20_000)
    whole = lift(*vars(read_cloud(path).points).values())
    assert (store.count, store.sh_degree) == (60_000, 0)
    assert len(store.tiles) >= 3
    assert not (tmp_path / "tiles" / ".parts").exists()

    near = (points.positions - store.offset).astype(np.float32)
    # each tile's points, in order
    right = np.concatenate([core for core, _ in store.tree.route(near)])
    parts = [store.read(i) for i in range(len(store.tiles))]
    world = np.concatenate([p.means + p.offset for p in parts])
    np.testing.assert_allclose(world, (whole.means + whole.offset)[right], atol=2e-5, rtol=0)
    colors = np.concatenate([p.sh0 for p in parts])
    np.testing.assert_allclose(colors, whole.sh0[right], atol=1e-6, rtol=0)
    scales, quats = (np.concatenate([getattr(p, n) for p in parts]) for n in ("scales", "quats"))
    same = np.isclose(scales, whole.scales[right], rtol=1e-4).all(1)
    same &= np.abs((quats * whole.quats[right]).sum(1)) > 1 - 1e-6

    assert same.mean() > 0.999
    halos = np.concatenate(halos_of(store))
    # of the same discs
    assert np.isin(as_set(halos), as_set(np.concatenate(tiles_of(store)))).all()


def test_one_tile_is_the_lifted_cloud(tmp_path: Path) -> None:
    points = streets(1000)
    path = ply(tmp_path / "cloud.ply", points)
    config = LiftConfig(neighbors=6, opacity=0.3)
    store = ingest(path, tmp_path / "tiles", lift=config)
    whole = lift(points.positions, read_cloud(path).points.colors, **vars(config))
    np.testing.assert_array_equal(packed(store.read(0)), packed(whole))
    assert store.offset.tolist() == [0, 0, 0]
    with pytest.raises(OutputError, match="other settings"):
        ingest(path, tmp_path / "tiles")


def test_several_clouds_are_one(tmp_path: Path) -> None:
    whole = streets(4000, offset=UTM)
    parts = [
        Points(whole.positions[s], whole.colors[s]) for s in (slice(0, 2500), slice(2500, None))
    ]
    paths = [las(tmp_path / "a.laz", parts[0], 255), las(tmp_path / "b.las", parts[1])]
    store = ingest(paths, tmp_path / "tiles", tile_rows=1000, block_rows=333)
    assert store.count == 4000
    assert [n.code for n in store.notes] == ["eight_bit_colors"]
    rows = np.concatenate(tiles_of(store))
    colors = np.concatenate([read_cloud(path).points.colors for path in paths])
    expected = np.sort((colors - 0.5) / 0.28209479177387814, axis=0)
    np.testing.assert_allclose(np.sort(rows[:, 11:14], axis=0), expected, atol=1e-5)
    with pytest.raises(InputError, match="expected a Gaussian scene"):
        ingest([paths[0], saved(tmp_path / "scene.ply", town(50))], tmp_path / "both")


@pytest.mark.parametrize("name", ["a.laz", "a.xyz"])
def test_workers_change_no_bit(tmp_path: Path, name: str) -> None:
    """A file that can be read from any row, and one that only this process reads."""
    points, paths = streets(4000), [tmp_path / name, tmp_path / "b.ply"]
    if name.endswith("laz"):
        las(paths[0], points)
    else:
        np.savetxt(paths[0], np.hstack([points.positions, np.rint(255 * points.colors)]), "%.3f")
    ply(paths[1], streets(3000, 1))
    sources = [Source(path, others=paths[1:]) for path in [paths[0]] * 2]
    for source in sources:
        PointChoice(where="z > 0.1").narrow(source)
    first = ingest(sources[0], tmp_path / "one", tile_rows=900)
    with executor(2) as runs:
        ingest(sources[1], tmp_path / "two", tile_rows=900, block_rows=500, runs=runs)
    assert files_of(tmp_path / "two") == files_of(first.folder)
    assert [note.code for note in first.notes].count("chosen") == 2


@pytest.mark.parametrize("stage", ["sample", "tiles", "lift", "write"])
def test_an_interrupted_lift_continues_where_it_was(tmp_path: Path, stage: str) -> None:
    path, folder = ply(tmp_path / "cloud.ply", streets(3000)), tmp_path / "tiles"
    whole = ingest(path, tmp_path / "whole", tile_rows=800)
    with pytest.raises(KeyboardInterrupt):
        ingest(path, folder, tile_rows=800, block_rows=300, progress=interrupt_at(stage, 1200))
    stages = []
    store = ingest(
        path, folder, tile_rows=800, block_rows=300, progress=lambda *words: stages.append(words)
    )
    assert next(done for name, done, *_ in stages if name == stage) >= 300  # a tile, or four parts
    assert not list(folder.glob(".*"))
    assert files_of(folder) == files_of(whole.folder)
    assert (store.tiles, store.key) == (whole.tiles, whole.key)
    manifest = json.loads((folder / "tiles.json").read_text())
    assert manifest["settings"]["lift"]["neighbors"] == 10


@pytest.mark.parametrize("stage", ["tiles", "lift", "done"])
def test_a_damaged_tile_is_lifted_again(tmp_path: Path, stage: str) -> None:
    """The same with its halo of discs around it, and in a call that continues an interrupted one."""
    path, folder = ply(tmp_path / "cloud.ply", streets(3000)), tmp_path / "tiles"
    ingest(path, folder, tile_rows=300)
    before = files_of(folder)
    (folder / "halo-00002.f32").unlink()
    with (folder / "tile-00005.f32").open("r+b") as file:
        file.truncate(100)
    with nullcontext() if stage == "done" else pytest.raises(KeyboardInterrupt):
        ingest(path, folder, tile_rows=300, overwrite=True, progress=interrupt_at(stage, 100))
    ingest(path, folder, tile_rows=300, overwrite=True)
    assert files_of(folder) == before


def test_points_of_another_cloud_are_not_continued(tmp_path: Path) -> None:
    folder = tmp_path / "tiles"
    for seed, progress in ((0, interrupt_at("lift", 1200)), (1, silent)):
        path = ply(tmp_path / f"{seed}.ply", streets(3000, seed))
        with nullcontext() if seed else pytest.raises(KeyboardInterrupt):
            ingest(path, folder, tile_rows=800, progress=progress)
    assert files_of(folder) == files_of(ingest(path, tmp_path / "whole", tile_rows=800).folder)


@pytest.mark.parametrize("workers", [1, 2])
def test_progress_moves_within_a_tile(tmp_path: Path, workers: int) -> None:
    path, seen = ply(tmp_path / "cloud.ply", streets(120_000)), list[int]()

    def told(stage: str, done: int, total: int, info: object = None) -> None:
        if stage == "lift":
            seen.append(done)

    with executor(workers) as runs:
        store = ingest(path, tmp_path / "tiles", tile_rows=70_000, runs=runs, progress=told)
    assert {0, 120_000} < set(seen)
    if workers == 1:  # a worker tells twice a second
        assert len(set(seen)) > 2 * len(store.tiles)


def test_bad_points_are_dropped_and_noted(tmp_path: Path) -> None:

    points = streets(500)
    properties = {axis: points.positions[:, i].copy() for i, axis in enumerate("xyz")}
    properties |= {
        n: points.colors[:, i].astype(float) for i, n in enumerate(("red", "green", "blue"))
    }
    properties["y"][[7, 400]] = np.nan
    path = save(tmp_path / "a.ply", properties, dtype="f8")
    store = ingest(path, tmp_path / "tiles", tile_rows=100, block_rows=64)
    assert store.notes == read_cloud(path).notes
    assert store.count == 498
    for i in range(3):
        properties["xyz"[i]][:] = np.nan
    with pytest.raises(InputError, match="none of its 500 points is finite"):
        ingest(save(tmp_path / "b.ply", properties, dtype="f8"), tmp_path / "b", tile_rows=100)
    assert not (tmp_path / "b").exists()


@pytest.mark.parametrize(("free", "fits"), [(100, False), (200, True)])
def test_a_disk_without_room_for_points_and_tiles_is_refused(
    free: int, fits: bool, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A point takes 48 bytes until it is lifted, its Gaussian 56."""
    path = ply(tmp_path / "cloud.ply", streets(4000))
    monkeypatch.setattr("shutil.disk_usage", lambda _: SimpleNamespace(free=4000 * free))
    if fits:
        assert ingest(path, tmp_path / "tiles", tile_rows=4000).count == 4000
    else:
        with pytest.raises(OutputError, match="the disk has"):
            ingest(path, tmp_path / "tiles", tile_rows=4000)
        assert [file.name for file in tmp_path.iterdir()] == ["cloud.ply"]
