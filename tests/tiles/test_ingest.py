"""Scenes streamed into tiles: every row once, halos by their definition, whatever order and blocks."""

import json
import subprocess
import sys
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest

from g2ard.errors import InputError, OutputError
from g2ard.io import write_splats
from g2ard.io.tile_store import TileStore, packed
from g2ard.scene.kdtree import Sampler
from g2ard.tiles.executor import executor
from g2ard.tiles.ingest import ingest
from helpers.commands import succeeds
from helpers.ingested import as_set, assert_same_sets, halos_of, saved, tiles_of, town
from helpers.interruptions import interrupt_at
from helpers.level_files import files_of
from helpers.opened import read_scene
from helpers.ply_files import columns, save


@pytest.mark.parametrize("degree", [0, 3])
@pytest.mark.parametrize("offset", [(0, 0, 0), (636_337.8, 5_427_319.25, 0.1)])
def test_every_row_is_in_one_tile(tmp_path: Path, degree: int, offset: tuple[float, ...]) -> None:
    source = saved(tmp_path / "town.ply", town(degree=degree, offset=offset))
    store = ingest(source, tmp_path / "tiles", tile_rows=700)
    whole = read_scene(source)
    assert (store.count, store.sh_degree, store.notes) == (6000, degree, whole.notes)
    np.testing.assert_array_equal(store.offset, whole.splats.offset)
    assert 9 <= len(store.tiles) <= 12
    assert all(0 < tile.rows <= 700 for tile in store.tiles)
    assert_same_sets([np.concatenate(tiles_of(store))], [packed(whole.splats)])
    for tile in store.tiles:
        part = store.read(tile.index)
        np.testing.assert_array_equal(part.offset, whole.splats.offset)
        np.testing.assert_array_equal(part.means, store.rows(tile.index)[:, :3])
        assert all(
            getattr(part, n).flags.c_contiguous for n in ("means", "quats", "scales", "sh0", "shN")
        )
        assert (part.means >= np.float32(tile.low)).all()
        assert (part.means <= np.float32(tile.high)).all()


def test_rows_of_a_tile_keep_their_order(tmp_path: Path) -> None:
    source = saved(tmp_path / "town.ply", town())
    whole = packed(read_scene(source).splats)
    number = {row.tobytes(): i for i, row in enumerate(whole)}
    store = ingest(source, tmp_path / "tiles", tile_rows=900, block_rows=101)
    for rows in (*tiles_of(store), *halos_of(store)):
        assert (np.diff([number[row.tobytes()] for row in rows]) > 0).all()


def test_one_tile_is_the_scene_itself(tmp_path: Path) -> None:
    source = saved(tmp_path / "town.ply", town(degree=1))
    store = ingest(source, tmp_path / "tiles", block_rows=777)
    (tile,) = store.tiles
    assert (tile.rows, tile.halo, store.margin) == (6000, 0, 0)
    assert store.read(0).fingerprint() == read_scene(source).splats.fingerprint()
    assert tile.low == tuple(read_scene(source).splats.means.min(0).astype(float))


def test_bad_rows_are_treated_as_by_the_reader(tmp_path: Path) -> None:
    properties = {name: values.copy() for name, values in columns(town(degree=1)).items()}
    properties["x"][[2, 5999]] = np.nan
    properties["f_rest_7"][5] = np.inf
    properties["opacity"][6:9] = (np.nan, np.inf, 40)
    properties["scale_1"][9:12] = (np.inf, 90, -np.inf)
    for i in range(4):
        properties[f"rot_{i}"][4000] = 0
    source = save(tmp_path / "bad.ply", properties | {"label": properties["x"]})
    whole = read_scene(source)
    assert [note.code for note in whole.notes] == [
        "ignored_properties",
        "dropped_rows",
        "clamped_logits",
        "clamped_scales",
        "zero_quats",
    ]
    store = ingest(source, tmp_path / "tiles", tile_rows=1000, block_rows=333)
    assert store.notes == whole.notes
    assert store.count == len(whole.splats) == 5995
    assert_same_sets([np.concatenate(tiles_of(store))], [packed(whole.splats)])


@pytest.mark.parametrize("options", [{"text": True}, {"byte_order": ">"}, {"dtype": "f8"}])
def test_other_encodings(tmp_path: Path, options: dict[str, object]) -> None:
    far = 5_427_319.25 if "dtype" in options else 0  # what float32 cannot hold is recentred
    properties = columns(town(600))
    source = save(
        tmp_path / "odd.ply", properties | {"y": properties["y"] + np.float64(far)}, **options
    )
    whole = read_scene(source).splats
    store = ingest(source, tmp_path / "tiles", tile_rows=200, block_rows=47)
    assert whole.offset.any() == bool(far)
    np.testing.assert_array_equal(store.offset, whole.offset)
    assert_same_sets([np.concatenate(tiles_of(store))], [packed(whole)])


def test_neither_blocks_nor_order_decide(tmp_path: Path) -> None:
    scene = town(degree=1)
    source = saved(tmp_path / "town.ply", scene)
    shuffled = saved(
        tmp_path / "mixed.ply", scene.take(np.random.default_rng(1).permutation(len(scene)))
    )
    first = ingest(source, tmp_path / "a", tile_rows=500, block_rows=6000)
    for name, path, rows in (("b", source, 64), ("c", source, 4999), ("d", shuffled, 1000)):
        store = ingest(path, tmp_path / name, tile_rows=500, block_rows=rows)
        assert (store.margin, store.tree) == (first.margin, first.tree)
        assert [t.low for t in store.tiles] == [t.low for t in first.tiles]
        if path == source:
            assert store.tiles == first.tiles  # bit by bit: checksums are part of them
        assert_same_sets(tiles_of(store), tiles_of(first))
        assert_same_sets(halos_of(store), halos_of(first))


def test_a_sample_does_not_depend_on_the_order(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("g2ard.tiles.writer._TREE_SAMPLE", 400)
    scene = town(20_000)
    source = saved(tmp_path / "town.ply", scene)
    mixed = saved(
        tmp_path / "mixed.ply", scene.take(np.random.default_rng(1).permutation(len(scene)))
    )
    said: list[str] = []
    first = ingest(source, tmp_path / "a", tile_rows=2000, block_rows=5000, say=said.append)
    assert len(first.tiles) < 30  # the sample's uncertainty costs tiles, but not many
    second = ingest(mixed, tmp_path / "b", tile_rows=2000, block_rows=333)
    assert max(t.rows for t in first.tiles) <= 2000
    assert first.tree == second.tree
    assert_same_sets(tiles_of(first), tiles_of(second))
    assert_same_sets(halos_of(first), halos_of(second))


def test_overfull_tiles_of_a_sample_are_split(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("g2ard.tiles.writer._TREE_SAMPLE", 60)
    monkeypatch.setattr("g2ard.scene.kdtree._SAMPLE_SIGMAS", 0.0)
    source = saved(tmp_path / "town.ply", town(20_000))
    said: list[str] = []
    store = ingest(source, tmp_path / "a", tile_rows=2000, say=said.append)
    assert any("cutting again" in line for line in said)
    assert max(t.rows for t in store.tiles) <= 2000
    assert_same_sets([np.concatenate(tiles_of(store))], [packed(read_scene(source).splats)])


def test_halos_against_a_naive_twin(tmp_path: Path) -> None:
    store = ingest(saved(tmp_path / "town.ply", town()), tmp_path / "tiles", tile_rows=700)
    tiles, boxes = tiles_of(store), store.tree.boxes()
    assert store.margin > 0
    sides = []
    for rows in tiles:
        low, high = np.percentile(rows[:, :3], (1, 99), axis=0)
        long, longer = sorted((high - low).astype(float))[1:]
        sides.append((long * longer) ** 0.5)
    assert store.margin == pytest.approx(0.03 * np.median(sides), rel=1e-6)
    for index, (low, high) in enumerate(boxes):
        expected = []
        for other, rows in enumerate(tiles):
            for row in rows:
                near = (row[:3] >= np.float32(low - store.margin)) & (
                    row[:3] <= np.float32(high + store.margin)
                )
                if other != index and near.all():
                    expected.append(row)
                inside = (row[:3] >= low) & (row[:3] < high)
                assert inside.all() == (other == index)
        found = packed(store.read_halo(index))
        assert len(found) == store.tiles[index].halo > 0
        assert np.array_equal(as_set(found), as_set(np.array(expected)))


def test_equal_positions_stay_together(tmp_path: Path) -> None:
    scene = town(1000)
    scene.means[:600] = 1.5
    store = ingest(saved(tmp_path / "a.ply", scene), tmp_path / "tiles", tile_rows=100)
    assert sorted(t.rows for t in store.tiles)[-1] == 600
    assert sorted(t.rows for t in store.tiles)[-2] <= 100
    assert [note.code for note in store.notes] == ["overfull_tiles"]


def test_a_sample_keeps_its_size_though_points_repeat() -> None:
    rng = np.random.default_rng(0)
    points = rng.normal(size=(50_000, 3)).astype(np.float32)
    for blocks in (1, 7):
        sampler = Sampler(10_000, 500)  # five times as many come as were foretold
        for part in np.array_split(points, blocks):
            sampler.add(part)
        found, each = sampler.result()
        assert 250 <= len(found) <= 1000
        assert each * len(found) == pytest.approx(50_000, rel=0.2)


def test_the_same_again_is_skipped_and_another_refused(tmp_path: Path) -> None:
    source, folder = saved(tmp_path / "town.ply", town()), tmp_path / "tiles"
    store = ingest(source, folder, tile_rows=900)
    before = (folder / "tile-00000.f32").stat().st_mtime_ns
    said: list[str] = []
    assert ingest(source, folder, tile_rows=900, say=said.append).tiles == store.tiles
    assert (folder / "tile-00000.f32").stat().st_mtime_ns == before
    assert "skipped" in said[0]
    with pytest.raises(OutputError, match="other settings"):
        ingest(source, folder, tile_rows=901)
    other = saved(tmp_path / "other.ply", town(seed=1))
    with pytest.raises(OutputError, match="another scene"):
        ingest(other, folder, tile_rows=900)
    assert ingest(source, folder, tile_rows=3000, overwrite=True).key != store.key
    assert len(list(folder.glob("tile-*.f32"))) == len(TileStore.open(folder).tiles)


def test_foreign_folders_are_not_touched(tmp_path: Path) -> None:
    source = saved(tmp_path / "town.ply", town(100))
    (tmp_path / "letters").mkdir()
    (tmp_path / "letters" / "dear.txt").write_text("keep me")
    for overwrite in (False, True):
        with pytest.raises(OutputError, match=r"holds dear\.txt"):
            ingest(source, tmp_path / "letters", overwrite=overwrite)
    assert [p.name for p in (tmp_path / "letters").iterdir()] == ["dear.txt"]
    with pytest.raises(InputError, match="no finished tiles"):
        TileStore.open(tmp_path / "letters")


def test_damage_is_named(tmp_path: Path) -> None:
    folder = tmp_path / "tiles"
    ingest(saved(tmp_path / "town.ply", town()), folder, tile_rows=2000)
    path, halo, manifest = (
        folder / "tile-00001.f32",
        folder / "halo-00000.f32",
        folder / "tiles.json",
    )
    whole, text = path.read_bytes(), manifest.read_text()

    path.write_bytes(whole[:100] + bytes([whole[100] ^ 1]) + whole[101:])
    store = TileStore.open(folder)
    store.read(0)
    with pytest.raises(InputError, match=r"tile-00001\.f32: its contents changed"):
        store.read(1)
    path.write_bytes(whole[:-8])
    for act in (lambda: TileStore.open(folder), lambda: store.read(1), lambda: store.rows(1)):
        with pytest.raises(
            InputError, match=r"tile-00001\.f32: [\d,]+ bytes, but the manifest says"
        ):
            act()
    path.write_bytes(whole)
    halo.unlink()
    with pytest.raises(InputError, match=r"halo-00000\.f32: No such file"):
        TileStore.open(folder)

    for change, name in (({"count": 3}, "count"), ({"cells": [4, 0, None, None]}, "cells")):
        manifest.write_text(json.dumps(json.loads(text) | change))
        with pytest.raises(InputError, match=f"property '{name}'"):
            TileStore.open(folder)
    manifest.write_text(text[:50])
    with pytest.raises(InputError, match="not JSON"):
        TileStore.open(folder)


def test_nothing_finite_leaves_nothing(tmp_path: Path) -> None:
    source = save(tmp_path / "a.ply", columns(town(50)) | {"y": np.full(50, np.nan)})
    with pytest.raises(InputError, match=r"none of its 50 Gaussians is finite"):
        ingest(source, tmp_path / "tiles", tile_rows=10)
    assert not (tmp_path / "tiles").exists()


def test_too_little_disk_space_is_reported_first(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:

    source = saved(tmp_path / "town.ply", town())
    monkeypatch.setattr("shutil.disk_usage", lambda path: SimpleNamespace(free=300_000))
    with pytest.raises(OutputError, match=r"need 0\.0 GB, the disk has 0\.0 GB free"):
        ingest(source, tmp_path / "tiles", tile_rows=2000)


def test_an_ingest_that_has_done_nothing_leaves_nothing(tmp_path: Path) -> None:
    source = saved(tmp_path / "town.ply", town())
    with pytest.raises(KeyboardInterrupt):
        ingest(
            source, tmp_path / "deep" / "tiles", tile_rows=900, progress=interrupt_at("sample", 0)
        )
    assert [path.name for path in tmp_path.iterdir()] == ["town.ply"]


KILLED = """
import os, sys
from g2ard.tiles.executor import executor
from g2ard.tiles.ingest import ingest

def die(stage, done, total, info=None):
    if stage == sys.argv[3] and done >= 2500:
        os._exit(9)

if __name__ == "__main__":
    with executor(int(sys.argv[4])) as runs:
        ingest(sys.argv[1], sys.argv[2], tile_rows=900, block_rows=500, runs=runs, progress=die)
"""


@pytest.mark.parametrize(("stage", "workers"), [("sample", 1), ("tiles", 2), ("write", 1)])
def test_a_killed_ingest_continues(tmp_path: Path, stage: str, workers: int) -> None:
    source, folder, script = (
        saved(tmp_path / "town.ply", town()),
        tmp_path / "tiles",
        tmp_path / "killed.py",
    )
    whole = ingest(source, tmp_path / "whole", tile_rows=900)
    script.write_text(KILLED)
    words = [sys.executable, script, source, folder, stage, str(workers)]
    assert subprocess.run(words, check=False).returncode == 9
    told = list[tuple[str, int]]()
    ingest(
        source,
        folder,
        tile_rows=900,
        block_rows=500,
        progress=lambda *words: told.append(words[:2]),
    )
    assert next(done for name, done in told if name == stage) >= 2500
    assert files_of(folder) == files_of(whole.folder)


def test_workers_change_no_bit(tmp_path: Path) -> None:
    paths = [saved(tmp_path / "a.ply", town()), saved(tmp_path / "b.splat", town(2000, seed=1))]
    first = ingest(paths, tmp_path / "one", tile_rows=900)
    with executor(2) as runs:
        ingest(paths, tmp_path / "two", tile_rows=900, block_rows=500, runs=runs)
    assert files_of(tmp_path / "two") == files_of(first.folder)


def test_the_command(tmp_path: Path, command_line) -> None:
    write_splats(tmp_path / "a.ply", town(3000))
    write_splats(tmp_path / "b.splat", town(1000, seed=1))
    given = ("ingest", "a.ply", "b.splat", "-o", "deep/tiles", "--tile-rows", "1k", "--json")
    out, said = succeeds(command_line, tmp_path, *given, "-")
    report = json.loads(out)
    store = TileStore.open(tmp_path / "deep" / "tiles")
    assert (report["rows"], report["tiles"], report["key"]) == (4000, len(store.tiles), store.key)
    assert report["bytes"] == sum(f.stat().st_size for f in store.folder.glob("*.f32"))
    assert report["halo_rows"] == sum(tile.halo for tile in store.tiles) > 0
    assert 0 < report["seconds"] < 60
    assert report["peak_rss"] is None or report["peak_rss"] > 1e6
    assert f"4,000 Gaussians in {len(store.tiles)} tiles" in said

    assert "skipped" in succeeds(command_line, tmp_path, *given, "again.json").err
    dry = ("ingest", "a.ply", "--tile-rows", "1k", "--workers", 2, "--dry-run")
    assert "3,000 rows in 3 tiles, 2 at a time" in succeeds(command_line, tmp_path, *dry).err
    status, _, said = command_line("ingest", "a.ply", "-o", "deep/tiles", cwd=tmp_path)
    assert status == 1
    assert "another scene" in said
    assert "-w (--overwrite) replaces it" in said
    assert said.count("\n") == 1
    for wrong in (("--tile-rows", "10%"), ("--set", "lift.neighbours=3")):
        assert command_line("ingest", "a.ply", "-o", "x", *wrong, cwd=tmp_path)[0] == 2
