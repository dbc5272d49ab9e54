"""Levels of detail in tiles: the same files as in one piece, exact counts, and no repeated work."""

import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from g2ard import io
from g2ard.errors import InputError
from g2ard.io import Source, sog
from g2ard.io.tile_store import TileStore
from g2ard.jobs.levels import Levels, open_levels
from g2ard.jobs.tile_options import Tiling
from g2ard.levels import Cut, cut, save_levels, tree
from g2ard.progress import Say, unsaid
from g2ard.scene.splats import Splats
from g2ard.system.peak_memory import peak_rss
from g2ard.tiles.ingest import ingest
from helpers.commands import refused, succeeds
from helpers.level_files import files_of, leaves_of, scattered
from helpers.tiled_scenes import town_in


def snapped(count: int, seed: int) -> Splats:
    """Positions on a grid: many rows share a coordinate, some all three."""
    scene = scattered(count, seed)
    return Splats.create(np.round(scene.means * 2) / 2, scales=scene.scales, quats=scene.quats)


@pytest.fixture(scope="module")
def place(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return town_in(tmp_path_factory.mktemp("lod"), 3000)


def sorted_cut(means: np.ndarray, rows: np.ndarray, most: int) -> list[set[int]]:
    """Naive: stable sorts of all rows, one cut after another."""
    if len(rows) <= most:
        return [set(rows.tolist())]
    axis = int(np.ptp(means[rows], axis=0).argmax())
    rows = rows[np.argsort(means[rows, axis], kind="stable")]
    middle = len(rows) // 2
    return [*sorted_cut(means, rows[:middle], most), *sorted_cut(means, rows[middle:], most)]


def test_ties_are_cut_as_by_stable_sorts(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(tree, "_ROWS_AT_ONCE", 70)  # so that arrays are files, and blocks many
    levels = [snapped(900, 0), snapped(300, 1)]
    leaves = leaves_of(cut(levels, Cut(most=40), tmp_path))
    means = np.concatenate([level.means for level in levels]).astype(float)
    naive = sorted_cut(means, np.arange(1200), 40)
    got = [{*leaf.rows[0].tolist(), *(leaf.rows[1] + 900).tolist()} for leaf in leaves]
    assert got == naive
    assert isinstance(leaves[0].rows[0].base, np.memmap) or isinstance(leaves[0].rows[0], np.memmap)
    assert not list(tmp_path.iterdir())


def test_means_that_are_not_finite_are_refused() -> None:
    broken = scattered(9)
    broken.means[3, 1] = np.nan
    with pytest.raises(InputError, match="row 3 of level 1"):
        cut([scattered(9), broken])


@pytest.mark.parametrize("degree", [0, 1])
def test_levels_on_disk_give_the_files_of_levels_in_memory(tmp_path: Path, degree: int) -> None:
    rng = np.random.default_rng(5)
    stored = []
    for number, count in enumerate((3000, 700)):
        shN = rng.normal(size=(count, (degree + 1) ** 2 - 1, 3))
        scene = Splats.create(
            rng.normal(size=(count, 3)), scales=rng.uniform(0.02, 0.1, (count, 3)), shN=shN
        )
        io.write_splats(tmp_path / f"{number}.ply", scene)
        stored.append(ingest(tmp_path / f"{number}.ply", tmp_path / f"{number}", tile_rows=800))
    held = [Splats(**vars(level.take(np.arange(len(level))))) for level in stored]
    (tmp_path / "work").mkdir()
    save_levels(tmp_path / "a", held, cut=Cut(most=300))
    save_levels(tmp_path / "b", stored, cut=Cut(most=300), work=tmp_path / "work")
    assert files_of(tmp_path / "a") == files_of(tmp_path / "b")


def levels_in_tiles(place: Path, folder: Path, say: Say = unsaid) -> Levels[Any]:
    options: dict[str, Any] = {
        "ratios": (1, 3, 12),
        "recover": True,
        "steps": 30,
        "background": (0, 0, 0),
    }
    options |= {
        "split_sky": False,
        "seed": 0,
        "views": place / "views.json",
        "size": 64,
        "say": say,
    }
    tiling = Tiling(tile_rows=850, workers=1, folder=folder)
    with open_levels(Source(place / "town.ply"), tiling, **options) as job:
        return job.run()


def test_levels_have_exact_counts_and_a_stopped_chain_goes_on(place: Path, tmp_path: Path) -> None:
    whole = levels_in_tiles(place, tmp_path / "whole")
    assert [len(level) for level in whole.splats] == [3000, 1000, 250]
    assert [isinstance(level, TileStore) for level in whole.splats] == [True, False, False]
    many, few = whole.reports[1:]
    assert many.recovered > many.simplified > 25
    # So few Gaussians gain .3 dB or lose .2, as their merges depend on the processor's rounding.
    assert min(few.recovered, few.simplified) > 20
    assert abs(few.recovered - few.simplified) < 1

    class StopError(Exception):
        pass

    def stop(line: str) -> None:
        if line.startswith("level 2"):
            raise StopError

    with pytest.raises(StopError):
        levels_in_tiles(place, tmp_path / "again", say=stop)
    steps = tmp_path / "again" / "steps"
    before = {path: path.stat().st_mtime_ns for path in steps.iterdir()}
    again = levels_in_tiles(place, tmp_path / "again")
    assert all(path.stat().st_mtime_ns == time for path, time in before.items())
    rows = np.arange(250)
    for one, other in zip(whole.splats, again.splats, strict=True):
        assert one.take(rows).fingerprint() == other.take(rows).fingerprint()


def test_the_command_in_tiles(place: Path, tmp_path: Path, command_line) -> None:
    given = [
        "lod",
        place / "town.ply",
        "-o",
        "out",
        "-r",
        "1,4,16",
        "--merge-only",
        "--chunk-count",
        "1",
    ]
    tiled = [*given, "--tile-rows", "850", "--views", place / "views.json"]
    succeeds(command_line, tmp_path, *tiled, "--workers", "2", "--json", "told.json")
    told = json.loads((tmp_path / "told.json").read_text())
    assert [level["count"] for level in told["levels"]] == [3000, 750, 188]
    own = peak_rss()
    assert own is None or told["peak_rss_bytes"] > own + 2e7  # the workers' too
    meta = json.loads((tmp_path / "out" / "lod-meta.json").read_text())
    files = [sog.Stream(tmp_path / "out" / name).whole() for name in meta["filenames"]]
    levels = [name.split("_")[0] for name in meta["filenames"]]
    counts = {
        at: sum(len(f) for f, of in zip(files, levels, strict=True) if of == at) for at in "012"
    }
    assert counts == {"0": 3000, "1": 750, "2": 188}
    assert len(io.read_splats(tmp_path / "out")) == 3000
    assert {path.name for path in tmp_path.iterdir()} == {"out", "told.json"}
    assert "already finished" in succeeds(command_line, tmp_path, *tiled, "--resume").err
    (tmp_path / ".z.tiles" / "steps").mkdir(parents=True)
    (tmp_path / ".z.tiles" / "steps" / "coarse-00000-0123456789abcdef.npz").write_bytes(
        b"of another run"
    )
    status, _, said = command_line(
        *tiled[:3], "z", *tiled[4:], "--resume", "--workers", "1", cwd=tmp_path
    )
    assert (status, "starting over" in said) == (0, False), said
    assert files_of(tmp_path / "z") == files_of(tmp_path / "out")  # one worker or two
    assert not (tmp_path / ".z.tiles").exists()
    more = [*given[:3], "y", *given[4:], "--tile-rows", "850", "--memory", "100MB"]
    assert "--tile-rows" in refused(command_line, tmp_path, *more, status=1)
    assert not (tmp_path / "y").exists()
