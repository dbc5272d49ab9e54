"""Simplification of a tiled scene to one exact budget."""

from __future__ import annotations

import hashlib
import json
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from g2ard.config.choices import RenderModel
from g2ard.errors import InputError
from g2ard.io.stream import PartsStream
from g2ard.poses import plan_pool
from g2ard.progress import Say, unsaid
from g2ard.scene.cameras import Cameras
from g2ard.scene.regions import Region, in_any
from g2ard.scene.splats import Splats, unit_quats
from g2ard.scene.transform import join
from g2ard.stages.simplify import SimplifyConfig
from g2ard.tiles.executor import Workers
from g2ard.tiles.sights import Sights, Surroundings
from g2ard.tiles.steps import TiledRun
from g2ard.tiles.store import TileStore
from g2ard.tiles.tasks import load, scene_of, small_scene

_POOL, _POOL_ROWS = 96, 4_000_000
"""Number of poses per number of Gaussians; larger scenes get proportionally more."""

_PLANNED_ON = 100_000
"""Sampled Gaussians on which each `_POOL` poses are planned."""

_HALF = 1 << 16


@dataclass(frozen=True, eq=False)
class TiledScene:
    """A simplified scene in tiles.

    Args:
        counts: Gaussians per tile.
        tiles: reads the Gaussians of a tile, with fitted opacities.
        key: hash of the names of its files.
        views: number of views used; 0 without views.
        unseen: Gaussians of the dense scene that no view sees; None without views.
        surroundings: placement of the dense tiles, for recovery; None without views.
        render_model: see `Splats`.
    """

    counts: tuple[int, ...]
    tiles: Callable[[int], Splats]
    sh_degree: int
    offset: NDArray[np.float64]
    key: str
    views: int = 0
    unseen: int | None = None
    surroundings: Surroundings | None = None
    render_model: RenderModel = "classic"

    def __len__(self) -> int:
        return sum(self.counts)

    def __iter__(self) -> Iterator[Splats]:
        return (self.tiles(tile) for tile in range(len(self.counts)))

    def stream(self) -> PartsStream:
        """Return a stream over the tiles, as `g2ard.tiles.ingest.ingest` takes it."""
        name = Path(f"simplified-{self.key}")
        parts = self.counts, self.tiles, self.sh_degree, self.offset
        return PartsStream(name, *parts, [self.key], render_model=self.render_model)

    def whole(self) -> Splats:
        """Return all tiles as one scene in memory."""
        return join(list(self))


def simplify_tiles(
    store: TileStore,
    budget: int,
    *,
    workers: Workers,
    config: SimplifyConfig | None = None,
    views: Cameras | None = None,
    beside: Callable[[Splats], Cameras | None] = lambda sample: None,
    blind: bool = False,
    up: Any = None,
    seed: int = 0,
    say: Say = unsaid,
) -> TiledScene:
    """Reduce a tiled scene to exactly `budget` Gaussians with method `default`.

    If `budget` is the scene's count, the scene is returned unchanged. Otherwise:

    1. Each tile is merged to a few coarse Gaussians that represent it in views of other tiles.
    2. Poses are planned on these. Each tile is rendered from the views that see it, amid its halo and the
       coarse Gaussians of all other tiles (`Sights`).
    3. Each tile computes the costs of merging along Morton order. The cheapest merges of all tiles are done,
       down to three times the budget. Then each tile plans more merges of pairs than needed, and the cheapest
       of all plans are done, down to the budget (`_merged`).
    4. Opacities are fitted to what the same views see of the result (`_fitted`).

    Every step is a task with a file in the folder of `workers`, so the same call resumes. The result depends
    only on the scene, the tiles and the seed, not on where, in which order or how often tasks ran.

    Args:
        views: cameras to render from; None uses `beside`, or as a fallback a generated pool.
        beside: returns cameras found beside the scene for a sample of it, or None.
        blind: use no cameras at all.
    """
    if not 1 <= budget <= store.count:
        raise InputError(
            f"expected 1 to {store.count:,} (the scene's Gaussians), got {budget:,}", parameter="budget"
        )
    run = TiledRun(store, workers, config or SimplifyConfig())
    coarse = run.begin()
    frame = run.sampled_frame()  # units that tiles share, so that their costs compare
    unchanged = budget == store.count
    sights: Sights | None = None
    if not blind and (views is not None or not unchanged):  # recovery of an unchanged scene needs them too
        sample = join([scene_of(path, "sample") for path in coarse])
        _check_regions(sample, run.config["keep_region"])
        cameras = views or beside(sample) or _planned(run, sample, up, seed, say)
        sights = None if cameras is None else Sights(run, coarse, cameras, frame)
    if unchanged:
        return _as_it_is(store, sights)
    merged, counts = _merged(run, budget, frame if sights is None else sights.frame, sights)
    if sights is None:
        return _scene(store, counts, [{"merged": path} for path in merged], None)
    return _fitted(store, counts, merged, sights)


def _merged(
    run: TiledRun, budget: int, frame: tuple[float, ...], sights: Sights | None
) -> tuple[list[Path], tuple[int, ...]]:
    """Merge all tiles to exactly `budget` Gaussians; return the results of `merge` and their counts."""
    tiles = len(run.sizes)
    visibility: list[dict[str, Any]] = (
        [{"visibility": path} for path in sights.visibility] if sights else [{}] * tiles
    )
    costs = run.each("run_costs", "costs", frame=frame, inputs=visibility)
    runs_left = _runs(run, costs, budget)
    share_kept = budget / sum(runs_left)
    plans = run.each(
        "pair_plan",
        "plans",
        frame=frame,
        per_tile=[{"runs": n, "expected": share_kept * n} for n in runs_left],
        inputs=[{"costs": path, **seen} for path, seen in zip(costs, visibility, strict=True)],
    )
    merges = cheapest([_costs_of(path) for path in plans], sum(runs_left) - budget)
    counts = tuple(n - m for n, m in zip(runs_left, merges, strict=True))
    _check_reached(sum(counts), budget, tiles)
    merged = run.each(
        "merge",
        "merge",
        frame=frame,
        per_tile=[{"runs": n, "merges": m} for n, m in zip(runs_left, merges, strict=True)],
        inputs=[{"plan": path, **seen} for path, seen in zip(plans, visibility, strict=True)],
    )
    return merged, counts


def _fitted(store: TileStore, counts: tuple[int, ...], merged: list[Path], sights: Sights) -> TiledScene:
    """Return the scene with opacities fitted to what the views see of the merged tiles."""
    seen = sights.again(merged)
    mean = sum(float(load(path, "wanted")[0].sum()) for path in merged) / sum(counts)
    files = [{"merged": one, "visibility": other} for one, other in zip(merged, seen, strict=True)]
    return replace(
        _scene(store, counts, files, mean),
        views=len(sights.cameras),
        unseen=sum(int(load(path, "unseen")[0]) for path in merged),
        surroundings=sights.surroundings,
    )


def sample_of(store: TileStore, workers: Workers) -> Splats:
    """Return a representative sample of a tiled scene; `simplify_tiles` reuses its task."""
    run = TiledRun(store, workers, SimplifyConfig())
    return join([scene_of(path, "sample") for path in run.begin()])


def _scene(
    store: TileStore, counts: tuple[int, ...], files: list[dict[str, Path]], mean: float | None
) -> TiledScene:
    """Return the scene made of all tiles' merge results."""

    def tile(i: int) -> Splats:
        return finished(small_scene(files[i], mean), store.sh_degree)

    parts = counts, tile, store.sh_degree, store.offset
    return TiledScene(*parts, key_of(files), render_model=store.render_model)


def _as_it_is(store: TileStore, sights: Sights | None) -> TiledScene:
    return TiledScene(
        tuple(tile.rows for tile in store.tiles),
        store.read,
        store.sh_degree,
        store.offset,
        key_of(store.key),
        0 if sights is None else len(sights.cameras),
        surroundings=None if sights is None else sights.surroundings,
        render_model=store.render_model,
    )


def key_of(files: Any) -> str:
    """Return 16 hexadecimal digits of a hash of file names, which contain the hashes of their content."""
    names = json.dumps(files, default=lambda path: path.name)
    return hashlib.sha256(names.encode()).hexdigest()[:16]


def finished(small: Splats, sh_degree: int) -> Splats:
    """Return a tile's Gaussians as they are written to files."""
    return replace(small.with_sh_degree(sh_degree), quats=unit_quats(small.quats))


def _check_regions(sample: Splats, regions: Sequence[Region]) -> None:
    if regions and not in_any(sample, regions).any():
        raise InputError(
            f"contains none of {len(sample):,} sampled Gaussians",
            parameter="keep_region",
        )


def _planned(run: TiledRun, sample: Splats, up: Any, seed: int, say: Say) -> Cameras | None:
    """Plan a view pool that grows with the scene."""
    times = max(1.0, run.store.count / _POOL_ROWS)
    try:
        pool = plan_pool(
            sample,
            round(_POOL * times),
            up=up,
            seed=seed,
            rows=round(_PLANNED_ON * times),
            near=0.25,
            for_weights=True,
            represents=run.store.count / len(sample),
            progress=run.workers.progress,
        )
    except InputError as e:
        say(f"continuing without views: {e}")
        return None
    say(f"poses: {len(pool.cameras)}, {pool.kind}")
    return pool.cameras


def _runs(run: TiledRun, costs: list[Path], budget: int) -> list[int]:
    """Return the number of Morton runs that each tile keeps."""
    kept = [_length(path) + 1 for path in costs]
    if sum(kept) < budget:
        raise InputError(
            f"expected at most {sum(kept):,} (the visible Gaussians), got {budget:,}",
            parameter="budget",
        )
    target = min(sum(kept), int(run.config["morton_premerge_ratio"] * budget))
    closed = cheapest([_costs_of(path) for path in costs], sum(kept) - max(target, len(kept)))
    return [n - c for n, c in zip(kept, closed, strict=True)]


def _length(path: Path) -> int:
    return len(load(path, "costs")[0])


def _costs_of(path: Path) -> Callable[[], NDArray[np.float32]]:
    return lambda: load(path, "costs")[0]


def _check_reached(count: int, budget: int, tiles: int) -> None:
    if count != budget:
        each = "one per tile" if count == tiles else "at least one per tile"
        raise InputError(
            f"the {tiles:,} tiles keep at least {count:,} Gaussians ({each}), got "
            f"{budget:,}; raise --tile-rows to get fewer tiles",
            parameter="budget",
        )


def cheapest(costs: Sequence[Callable[[], NDArray[np.float32]]], count: int) -> list[int]:
    """Return how many of the `count` smallest costs lie in each array; ties go to earlier ones.

    Non-negative floats sort like their bits. Two histograms, of the upper and lower 16 bits, find the
    count-th value with one array in memory at a time.

    Args:
        costs: functions that return arrays of float32 ≥ 0, called three times each.

    >>> few = [np.array([3, 1, 1], np.float32), np.array([1, 0, 2], np.float32)]
    >>> cheapest([lambda a=a: a for a in few], 3)
    [2, 1]
    """
    if count <= 0:
        return [0] * len(costs)
    upper = sum((_histogram(_bits(make) >> 16) for make in costs), np.zeros(_HALF, np.int64))
    first, below = _rank(upper, count)
    lower = sum(
        (_histogram(bits[bits >> 16 == first] & np.uint32(0xFFFF)) for bits in map(_bits, costs)),
        np.zeros(_HALF, np.int64),
    )
    second, under = _rank(lower, count - below)
    limit = np.uint32(first << 16 | second)
    ties = count - below - under
    counts = []
    for bits in map(_bits, costs):
        equal = min(ties, int(np.count_nonzero(bits == limit)))
        ties -= equal
        counts.append(int(np.count_nonzero(bits < limit)) + equal)
    return counts


def _bits(make: Callable[[], NDArray[np.float32]]) -> NDArray[np.uint32]:
    return np.ascontiguousarray(make(), np.float32).view(np.uint32)


def _histogram(values: NDArray[Any]) -> NDArray[np.int64]:
    return np.bincount(values, minlength=_HALF)


def _rank(histogram: NDArray[np.int64], count: int) -> tuple[int, int]:
    """Return the bin of the count-th value, and the number of values in earlier bins."""
    sums = np.cumsum(histogram)
    at = min(int(np.searchsorted(sums, count)), len(sums) - 1)
    return at, int(sums[at - 1]) if at else 0
