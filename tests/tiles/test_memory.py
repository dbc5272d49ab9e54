"""Memory of tiles: an error states the memory needed and a tile size that is then accepted."""

import re
from pathlib import Path

import pytest

from g2ard.errors import InputError
from g2ard.io import Source, write_splats
from g2ard.io.tile_store import TileStore
from g2ard.jobs import tile_options as policy
from g2ard.jobs.memory import (
    LEVELS_TIMES,
    RECOVERY_TIMES,
    TileMemory,
    check_whole_memory,
    parse_bytes,
    plan_tiles,
)
from g2ard.jobs.tile_options import Tiling
from g2ard.tiles.ingest import ingest
from helpers.tiled_scenes import town


@pytest.fixture(scope="module")
def scene(tmp_path_factory: pytest.TempPathFactory) -> Path:
    place = tmp_path_factory.mktemp("town") / "town.ply"
    write_splats(place, town(12_000))
    return place


def advised(told: str) -> int:
    found = re.search(r"--tile-rows ([\d,]+)", told)
    assert found, told
    return int(found[1].replace(",", ""))


def tiles(scene: Path, folder: Path, rows: int) -> TileStore:
    return ingest(scene, folder / "tiles", tile_rows=rows)


@pytest.mark.parametrize("memory", ["201600kB", "202MB", "203MB"])
def test_tiles_that_are_advised_fit(scene: Path, tmp_path: Path, memory: str) -> None:
    size = parse_bytes(memory)
    with pytest.raises(
        InputError, match=r"in one piece take about 20[4-9] MB, 200 MB of it the program"
    ) as e:
        check_whole_memory(Source(scene), Tiling(memory=size), LEVELS_TIMES, RECOVERY_TIMES)
    store = tiles(scene, tmp_path / "a", advised(str(e.value)))
    assert len(store.tiles) > 1
    assert (
        plan_tiles(store, Tiling(memory=size, folder=tmp_path / "a"), RECOVERY_TIMES).workers == 1
    )
    store = tiles(scene, tmp_path / "b", 11_000)
    with pytest.raises(
        InputError, match=r"a tile of [\d,]+ Gaussians and [\d,]+ around it takes about"
    ) as e:
        plan_tiles(store, Tiling(memory=size, folder=tmp_path / "b"), RECOVERY_TIMES).workers
    again = tiles(scene, tmp_path / "c", advised(str(e.value)))
    assert plan_tiles(again, Tiling(memory=size), RECOVERY_TIMES).workers == 1


def test_an_error_names_the_least_memory_that_works(scene: Path, tmp_path: Path) -> None:
    store = tiles(scene, tmp_path / "a", 6000)
    for refuse in (
        lambda: check_whole_memory(
            Source(scene), Tiling(memory=200_000_000), LEVELS_TIMES, RECOVERY_TIMES
        ),
        lambda: (
            plan_tiles(
                store, Tiling(memory=200_000_000, folder=tmp_path / "a"), RECOVERY_TIMES
            ).workers
        ),
    ):
        with pytest.raises(
            InputError, match="more than --memory 200 MB; the least that tiles take is"
        ) as e:
            refuse()
        told = re.search(r"tiles take is about (\d+) MB, with --tile-rows 1,000$", str(e.value))
        assert told, e.value
        least = tiles(scene, tmp_path / told[1], 1000)
        assert (
            plan_tiles(least, Tiling(memory=parse_bytes(f"{told[1]}MB")), RECOVERY_TIMES).workers
            == 1
        )


def test_tiles_of_a_folder_are_not_cut_anew(scene: Path, tmp_path: Path) -> None:
    store = tiles(scene, tmp_path, 6000)
    with pytest.raises(
        InputError, match=r"; `g2ard ingest \S+tiles -o DIR --tile-rows [\d,]+` takes less"
    ):
        plan_tiles(store, Tiling(memory=parse_bytes("202MB"), folder=tmp_path / ".x.tiles"))


def test_the_machines_memory_is_the_default(
    scene: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    store = tiles(scene, tmp_path, 6000)
    monkeypatch.setattr(policy, "usable_memory", lambda: 4_000_000_000)
    told = r"--workers 1000 take about 20\d[\d.]* GB, more than the 3\.2 GB used of the machine's"
    with pytest.raises(InputError, match=told + r" memory; --workers 1\d fit$"):
        plan_tiles(store, Tiling(folder=tmp_path, workers=1000)).workers


def test_no_more_tiles_are_advised_than_are_made() -> None:
    told = TileMemory(100_000_000, 56).advice(200_000_000, 50_000_000)
    assert told == "the least that tiles take is about 207 MB, with --tile-rows 10,000"
