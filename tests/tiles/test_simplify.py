"""Simplification in tiles: one exact budget, the same bits wherever tasks run, and one tile is the whole."""

import os
import random
import signal
import threading
import time
from contextlib import suppress
from dataclasses import replace
from pathlib import Path
from typing import get_type_hints

import numpy as np
import pytest

import g2ard._core as _core
from g2ard.errors import InputError
from g2ard.io import read_splats, write_splats
from g2ard.io.tile_store import TileStore
from g2ard.pipeline.dense import load_whole as in_memory
from g2ard.progress import silent
from g2ard.rendering.renderer import RasterSettings
from g2ard.rendering.targets import TeacherRenders
from g2ard.rendering.visibility import visibility_source
from g2ard.scene.cameras import Cameras, look_at
from g2ard.scene.prepared import finite_rows_of
from g2ard.scene.splats import Splats
from g2ard.stages.evaluate import evaluate
from g2ard.stages.lift import lift
from g2ard.stages.simplify import Pairs, SimplifyConfig, simplify
from g2ard.stages.simplify.gaps import opacity_lost
from g2ard.tiles.dense import InTiles
from g2ard.tiles.executor import Workers, executor
from g2ard.tiles.ingest import ingest
from g2ard.tiles.merging import cheapest, plan_ends, simplify_tiles
from g2ard.tiles.simplify import GONE, TiledRun, _add_until_converged
from g2ard.tiles.tasks import Task, far_around, scene_of
from helpers.systems import needs_proc, workers_of
from helpers.tiled_scenes import reduced, ring, town


@pytest.fixture(scope="module")
def scene(tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("town") / "town.ply"
    write_splats(path, town())
    return path


@pytest.fixture(scope="module")
def store(scene: Path) -> TileStore:
    return ingest(scene, scene.parent / "tiles", tile_rows=2500)


@pytest.fixture(scope="module")
def work(store: TileStore, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The work folder of a reduction on one thread."""
    return tmp_path_factory.mktemp("work")


@pytest.fixture(scope="module")
def fingerprint(store: TileStore, work: Path) -> str:
    """The hash of what that reduction gives."""
    return reduced(store, work, views=ring(), threads=1).fingerprint()


def clusters(of: np.ndarray, a: np.ndarray, b: np.ndarray, runs: int) -> np.ndarray:
    """Naive: one merge after another."""
    into = list(range(runs))
    for x, y in zip(a, b, strict=True):
        into = [int(x) if i == y else i for i in into]
    names = {root: name for name, root in enumerate(sorted(set(into)))}
    return np.array([GONE if run == GONE else names[into[run]] for run in of], np.uint32)


@pytest.mark.parametrize("seen", [True, False])
def test_one_tile_is_the_whole_to_the_bit(seen: bool) -> None:
    prepared, _ = finite_rows_of(town(2500))
    rng = np.random.default_rng(1)
    budget, config = 250, SimplifyConfig().resolved()

    class Seen:
        weight = rng.gamma(1, 1, len(prepared)).astype(np.float32)
        pixel_size = np.where(rng.random(len(prepared)) < 0.9, 0.01, np.inf).astype(np.float32)

    whole = simplify(prepared, budget, visibility=Seen() if seen else None).splats
    frame = _core.TileFrame.of_sample(prepared.core, config)

    def tile(frame: _core.TileFrame) -> _core.TileMerging:
        return _core.TileMerging(prepared.core, frame, config, Seen() if seen else None)

    if seen:
        frame = frame.with_views(0.01, 1, 1, 1)
        frame = frame.with_views(0.01, *tile(frame).sums())
    here = tile(frame)
    assert len(here.run_costs(2.0)) < len(prepared)  # the transparent are not among them
    rounds = config.rounds(len(prepared), budget)
    counts = [n for n in rounds if n < 3 * budget]
    of, a, b, costs = here.plan(3 * budget, counts, here.run_costs(2.0))
    assert len(a) == 2 * budget
    assert (costs >= 0).all()
    out = here.assemble(clusters(of, a, b, 3 * budget), budget)
    both = [
        (np.float32(out["means"]), out["logit_opacities"]),
        (np.float32(whole.means), whole.logit_opacities),
    ]
    rows = [np.column_stack(pair)[np.lexsort(np.column_stack(pair).T)] for pair in both]
    np.testing.assert_array_equal(*rows)


def test_the_cheapest_of_several_arrays_are_those_of_all() -> None:
    rng = np.random.default_rng(0)
    for _ in range(30):
        arrays = [
            rng.integers(0, 6, rng.integers(0, 40)).astype(np.float32) * 0.3 for _ in range(4)
        ]
        tagged = sorted(
            (float(v), t, i) for t, array in enumerate(arrays) for i, v in enumerate(array)
        )
        count = int(rng.integers(0, len(tagged) + 1))
        naive = [sum(t == tile for _, t, _ in tagged[:count]) for tile in range(4)]
        assert cheapest([lambda a=a: a for a in arrays], count) == naive


@pytest.mark.parametrize("blind", [False, True])
def test_exact_count_and_quality(
    store: TileStore, scene: Path, tmp_path: Path, blind: bool
) -> None:
    views = ring(8)
    small = reduced(store, tmp_path, views=None if blind else views)
    assert len(store.tiles) >= 4
    assert len(small) == 900
    assert small.finite_rows().all()
    dense = read_splats(scene)
    whole = simplify(dense, 900, visibility=None if blind else visibility_source(views)).splats
    targets = TeacherRenders(dense, ring(5))
    tiled_db, whole_db = (evaluate(splats, targets).psnr for splats in (small, whole))
    assert tiled_db > whole_db - 0.4  # tiles of 2,300 rows have many borders


@pytest.mark.parametrize(
    ("log_scale", "share", "spread"), [(-np.inf, 1, 1), (-30, 1, 1), (-30, 0.6, 1), (0, 0, 1e11)]
)
@pytest.mark.parametrize("blind", [False, True])
def test_sizes_and_spreads_of_any_magnitude(
    tmp_path: Path, log_scale: float, share: float, spread: float, blind: bool
) -> None:
    scene = town(3000)
    scales = scene.scales.copy()
    scales[np.random.default_rng(5).random(len(scene)) < share] = np.exp(log_scale)
    scene = replace(scene, scales=scales, means=(spread * scene.means).astype(np.float32))
    write_splats(tmp_path / "scene.ply", scene)
    tiles = ingest(tmp_path / "scene.ply", tmp_path / "tiles", tile_rows=1000)
    small = reduced(tiles, tmp_path / "work", 300, views=None if blind else ring())
    assert len(small) == 300
    assert small.finite_rows().all()


def test_tiles_that_no_view_sees_keep_their_share(store: TileStore, tmp_path: Path) -> None:
    K = [[300, 0, 40], [0, 300, 30], [0, 0, 1]]
    corner = Cameras.from_lists(
        [look_at([-7.5, -3.5, 1.5], [-7.6, -3.4, 0])], [K], [(80, 60)], ["corner"]
    )
    small = reduced(store, tmp_path, views=corner)
    assert len(small) == 900
    rows = [len(core) for core, _ in store.tree.route(small.means)]
    assert min(rows) > 20


def test_rows_that_no_view_sees_are_counted(tmp_path: Path) -> None:
    """All rows here are opaque enough to be drawn; fainter ones would not count."""
    scene = town()
    scene.logit_opacities[:] = 1
    write_splats(tmp_path / "a.ply", scene)
    tiles = ingest(tmp_path / "a.ply", tmp_path / "tiles", tile_rows=3000)
    K = [[300, 0, 40], [0, 300, 30], [0, 0, 1]]
    west = [(-4, 0, 9), (-6, 2, 9), (-5, -2, 9)]  # straight down on the western half
    down = [look_at(eye, [eye[0], eye[1] + 1e-3, 0]) for eye in west]
    views = Cameras.from_lists(down, [K] * 3, [(80, 60)] * 3, ["a", "b", "c"])
    with executor() as runs:
        done = simplify_tiles(
            TiledRun(tiles, Workers(runs, tmp_path), SimplifyConfig()), 900, views
        )
    unseen = np.count_nonzero(visibility_source(views)(scene).weight == 0)
    assert done.report.unseen == pytest.approx(unseen, rel=0.02)
    assert len(scene) / 2 < unseen < len(scene)


@pytest.mark.parametrize(("found", "rounds"), [(5, 2), (9, 2), (10, 4), (20, 4)])
def test_views_are_added_until_a_round_finds_under_a_hundredth_more(
    found: int, rounds: int
) -> None:
    class Sums:
        weight = np.zeros(1000)

        def add(self, views: list[object], *_: object) -> None:
            at = np.count_nonzero(self.weight)
            self.weight[at : at + found] = 1

        def by_row(self) -> tuple[np.ndarray]:
            return (self.weight,)

    used = _add_until_converged(Sums(), ring(64), RasterSettings(), 1000)
    assert len(used) == len(set(used)) == rounds * 16


def test_workers_and_row_order_change_no_bit(
    store: TileStore, scene: Path, tmp_path: Path, fingerprint: str
) -> None:
    assert reduced(store, tmp_path / "two", views=ring(), workers=2).fingerprint() == fingerprint
    rows = np.random.default_rng(3).permutation(9000)
    write_splats(tmp_path / "shuffled.ply", read_splats(scene).take(rows))
    other = ingest(tmp_path / "shuffled.ply", tmp_path / "tiles", tile_rows=2500)
    assert reduced(other, tmp_path / "shuffled", views=ring()).fingerprint() == fingerprint


@needs_proc
@pytest.mark.parametrize("scheduler", [None, "local"])
def test_workers_killed_at_random_cost_time_alone(
    store: TileStore, tmp_path: Path, scheduler: str | None, fingerprint: str, work: Path
) -> None:
    if scheduler:
        pytest.importorskip("distributed")
    stop, killed, draw = threading.Event(), [], random.Random(0)

    def kill() -> None:
        done = 0
        while not stop.is_set() and len(killed) < 5:
            time.sleep(0.02)
            files = len(list(tmp_path.glob("[!.]*.npz")))
            if files >= done + 3 and (children := workers_of(os.getpid())):
                time.sleep(draw.uniform(0, 0.05))
                with suppress(ProcessLookupError):
                    os.kill(draw.choice(sorted(children)), signal.SIGKILL)
                    killed.append(files)
                done = files

    killer = threading.Thread(target=kill)
    killer.start()
    try:
        small = reduced(store, tmp_path, views=ring(), workers=2, scheduler=scheduler)
    finally:
        stop.set()
        killer.join()
    assert len(killed) >= 3
    assert small.fingerprint() == fingerprint
    assert len(list(tmp_path.glob("[!.]*.npz"))) == len(list(work.glob("[!.]*.npz")))


def test_finished_work_is_not_repeated(store: TileStore, tmp_path: Path, fingerprint: str) -> None:
    class StopError(Exception):
        pass

    def stop(stage: str, done: int, total: int, info: object = None) -> None:
        if stage == "plans" and done:
            raise StopError

    with pytest.raises(StopError):
        reduced(store, tmp_path, views=ring(), progress=stop)
    before = {path: path.stat().st_mtime_ns for path in tmp_path.iterdir()}
    assert sum(path.name.startswith("plans") for path in before) == 1
    again = reduced(store, tmp_path, views=ring())
    assert all(path.stat().st_mtime_ns == time for path, time in before.items())
    assert again.fingerprint() == fingerprint
    seen = {path for path in before if path.name.startswith("visibility-")}
    reduced(store, tmp_path, budget=450, views=ring())  # another budget needs the same
    assert seen == {path for path in tmp_path.iterdir() if path.name.startswith("visibility-")}


def test_all_there_are_stay_as_they_are(store: TileStore, scene: Path, tmp_path: Path) -> None:
    dense = read_splats(scene)
    every = [np.sort(s.means, axis=0) for s in (dense, reduced(store, tmp_path, budget=9000))]
    np.testing.assert_array_equal(*every)


def test_an_order_found_before_is_checked(scene: Path) -> None:
    dense = finite_rows_of(read_splats(scene))[0]
    order, bounds = dense.core.order, np.array(dense.core.bounds)
    again = finite_rows_of(read_splats(scene))[0]
    again.restore(order, bounds)
    np.testing.assert_array_equal(again.core.order, order)
    assert again.core.origin == dense.core.origin
    for broken in (
        order[:-1],
        np.where(order == 7, 8, order).astype(np.uint32),
        order + np.uint32(1),
    ):
        with pytest.raises(InputError, match="order: expected each of 9000 rows once"):
            again.restore(broken, bounds)


def test_budgets_out_of_reach_are_refused(store: TileStore, tmp_path: Path) -> None:
    with pytest.raises(InputError, match=r"expected 1 to 9,000"):
        reduced(store, tmp_path, budget=9001)
    with pytest.raises(
        InputError, match=r"the 4 tiles keep at least 4 Gaussians \(one per tile\), got 2"
    ):
        reduced(store, tmp_path, budget=2)


def _unbounded_settings() -> list[str]:
    """Return the names of the default method's settings that may be infinite."""
    hints = get_type_hints(Pairs, include_extras=True)
    return [name for name, hint in hints.items() if "inf]" in str(hint)]


@pytest.mark.parametrize("name", _unbounded_settings())
def test_settings_may_be_infinite(name: str, store: TileStore, tmp_path: Path) -> None:
    config = SimplifyConfig(method="default", **{name: np.inf})
    assert len(reduced(store, tmp_path, 900, config=config)) == 900


@pytest.mark.parametrize("uneven", [False, True])
def test_every_count_from_one_per_tile_to_all_is_met(tmp_path: Path, uneven: bool) -> None:
    """Also where tiles differ in what their Gaussians are worth, and where some are not drawn."""
    small = town(120)
    faint = np.arange(120) % 6 == 0
    small.logit_opacities[:] = np.where(faint, -9, 2 + 0.2 * small.means[:, 0] * uneven)
    if uneven:
        small.scales[:] *= np.exp(0.3 * small.means[:, :1])
    write_splats(tmp_path / "a.ply", small)
    tiles = ingest(tmp_path / "a.ply", tmp_path / "tiles", tile_rows=20)
    count = len(tiles.tiles)
    assert count >= 6
    with executor() as runs:
        run = TiledRun(tiles, Workers(runs, tmp_path), SimplifyConfig())
        for budget in range(1, count):
            with pytest.raises(
                InputError, match=rf"at least {count} Gaussians \(one per tile\), got {budget};"
            ):
                simplify_tiles(run, budget)
        for budget in [*range(count, count + 3), 3 * count - 1, 99, 100, 101, 120]:
            result = simplify_tiles(run, budget)
            made = result.splats.whole()
            assert len(made) == len(result.splats) == budget
            drawn = (made.logit_opacities > -8).sum()
            assert drawn == min(budget, 100)


@pytest.mark.parametrize("tiles", range(1, 9))
def test_plans_reach_every_budget(tiles: int) -> None:
    rng = np.random.default_rng(tiles)
    for _ in range(50):
        runs = rng.integers(1, 40, tiles).tolist()
        for budget in range(tiles, sum(runs) + 3):
            ends = plan_ends(runs, budget)
            assert sum(ends) <= budget
            assert all(1 <= end <= n for end, n in zip(ends, runs, strict=True))


@pytest.mark.parametrize("workers", [1, 2])
def test_progress_moves_within_a_task(tmp_path: Path, workers: int) -> None:
    seen: list[int] = []
    tasks = [
        Task("helpers.tiled_scenes:half_told", f"half-{i}", tmp_path, {"number": i}, cost=100)
        for i in range(2)
    ]
    with executor(workers) as runs:
        Workers(runs, tmp_path, lambda stage, done, total, info=None: seen.append(done)).run(
            tasks, "half"
        )
    assert 50 in seen
    assert seen == sorted(seen)
    assert seen[-1] == 200
    assert sorted(tmp_path.iterdir()) == sorted(task.output for task in tasks)


def test_coarse_surroundings_begin_where_the_halo_ends(store: TileStore, tmp_path: Path) -> None:
    with executor(threads=1) as runs:
        coarse = TiledRun(store, Workers(runs, tmp_path), SimplifyConfig()).coarse
    everything = [scene_of(path, "near").means for path in coarse]
    for tile in store.tiles:
        levels = [None if other is tile else "near" for other in store.tiles]
        far = far_around(store, {"tile": tile.index, "levels": levels, "coarse": coarse})
        found = np.concatenate([part.means for part in far])
        others = np.concatenate(
            [part for part, level in zip(everything, levels, strict=True) if level]
        )
        # How far each lies outside the tile, along the axis where it is farthest.
        away = np.maximum(np.array(tile.low) - others, others - np.array(tile.high)).max(axis=1)
        assert ((away > 0) & (away <= store.margin)).any()
        np.testing.assert_array_equal(found, others[away > store.margin])


def test_a_sample_for_views_has_enough_rows(store: TileStore, tmp_path: Path) -> None:
    with executor() as runs:
        assert (
            len(TiledRun(store, Workers(runs, tmp_path), SimplifyConfig()).sample()) == store.count
        )


@pytest.mark.parametrize("seen", [True, False])
def test_a_floor_in_tiles_stays_as_closed_as_in_one_piece(tmp_path: Path, seen: bool) -> None:
    rng = np.random.default_rng(5)
    points = rng.uniform([-8, -4, 0], [8, 4, 0], (4000, 3))
    lifted = lift(points, 0.5 + 0.4 * np.sin(points @ rng.normal(size=(3, 3))))
    write_splats(tmp_path / "floor.ply", lifted)
    store = ingest(tmp_path / "floor.ply", tmp_path / "tiles", tile_rows=1500)
    assert len(store.tiles) > 2
    views = ring() if seen else None

    def tiled(config: SimplifyConfig, *, gaps: bool) -> tuple[Splats, float | None]:
        with executor(threads=1) as runs:
            tiles = InTiles(store, Workers(runs, tmp_path / "work", silent), config, 1500, tmp_path)
            done = tiles.merge(250, views, config, gaps=gaps)
            return in_memory(done.splats), done.report.opacity_lost

    source = None if views is None else visibility_source(views)
    whole = simplify(lifted, 250, visibility=source, gaps=True)
    small, measured = tiled(SimplifyConfig(), gaps=True)
    lost = [opacity_lost(lifted, each, ring()) for each in (whole.splats, small)]
    assert lost[1] == pytest.approx(lost[0], abs=0.02)
    assert measured == (pytest.approx(lost[1], abs=1e-3) if seen else None)
    assert tiled(SimplifyConfig(), gaps=False)[1] is None
    assert (
        opacity_lost(lifted, tiled(SimplifyConfig(max_growth=1), gaps=False)[0], ring())
        > lost[1] + 0.02
    )
