"""Simplification of a scene in tiles, at one exact budget."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from g2ard import _core
from g2ard.errors import InputError
from g2ard.progress import Progress, Say, silent, unsaid
from g2ard.splats import Splats, unit_quats
from g2ard.stages.simplify import SimplifyConfig
from g2ard.stages.simplify.pairs import fit_opacities
from g2ard.tiles.cut import cheapest
from g2ard.tiles.executor import Executor
from g2ard.tiles.steps import COARSE, joined, scene_of
from g2ard.tiles.store import TileStore
from g2ard.tiles.task import Task, load

if TYPE_CHECKING:
    from g2ard.cameras import Cameras

__all__ = ["TiledScene", "simplify_tiles"]

_STEPS = "g2ard.tiles.steps"

_POOL, _POOL_ROWS = 96, 4_000_000
"""Poses to look from for so many Gaussians; more of these, more of those."""

_PLANNED_ON = 100_000
"""Gaussians of a fair sample that so many poses are planned on."""

_LOOKS = 96
"""The most views that look at one tile."""

_LONGEST = 300
"""Longer side of what they render, pixels."""

_IN_SIGHT = 0.01
"""Share of a view's light that comes from a tile that it has in sight."""

_GLANCED = 200_000
"""Coarse Gaussians of a scene up to which the nearer level tells which views have which tile in sight."""

_CHUNK = 64
"""Views a task that tells so."""


@dataclass(frozen=True, eq=False)
class TiledScene:
    """A simplified scene, in tiles.

    Args:
        counts: Gaussians of each tile.
        tiles: reads the Gaussians of a tile, opacities fitted.
        sh_degree: of all.
        offset: (3,) float64.
        views: that the tiles were looked at from; 0 without views.
        unseen: Gaussians of the dense scene that no view sees; None without views.
    """

    counts: tuple[int, ...]
    tiles: Callable[[int], Splats]
    sh_degree: int
    offset: NDArray[np.float64]
    views: int
    unseen: int | None

    def __len__(self) -> int:
        return sum(self.counts)

    def __iter__(self) -> Iterator[Splats]:
        return (self.tiles(tile) for tile in range(len(self.counts)))

    def whole(self) -> Splats:
        """All tiles as one scene in memory."""
        return joined(list(self))


def simplify_tiles(
    store: TileStore,
    budget: int,
    *,
    executor: Executor,
    work: Path,
    config: SimplifyConfig | None = None,
    views: Cameras | None = None,
    beside: Callable[[Splats], Cameras | None] = lambda sample: None,
    blind: bool = False,
    up: Any = None,
    seed: int = 0,
    progress: Progress = silent,
    say: Say = unsaid,
) -> TiledScene:
    """Reduce a scene in tiles to exactly `budget` Gaussians with the method `default`.

    1. Each tile is merged to a few coarse Gaussians, which stand for it where others are looked at.
    2. Poses are planned on those; each tile is looked at, by the views that have it in sight, where it stands
       in the whole scene: its own Gaussians, its halo's, coarse ones of all else.
    3. What merging along Morton order costs is found in every tile; of all gaps the cheapest close, down to
       three times the budget. Then each tile plans merges of pairs, farther than it will need; of all plans
       the cheapest merges are done, down to the budget.
    4. Opacities are fitted to what the same views see of the result.

    Every step is a task whose file stays in `work`: the same call goes on where it was interrupted. The
    result depends on the scene, the tiles and the seed alone, not on where, in which order or how often
    tasks ran.

    Args:
        store: the scene.
        budget: Gaussians to keep.
        executor: runs the tasks.
        work: a folder for their files.
        config: constants; None means the method's own.
        views: cameras to look from; None takes those that `beside` finds for a fair sample of the scene, else
            plans a pool.
        beside: finds cameras.
        blind: use no cameras at all.
        up: (3,) away from the ground, for poses that are made; None to estimate it.
        seed: of poses that are made.
        progress: told of tasks done, step by step.
        say: told in lines what was decided.

    Raises:
        InputError: a budget below 1 or above what a renderer draws of the scene.
    """
    if not 1 <= budget <= store.count:
        raise InputError(f"budget: expected 1 to the {store.count:,} Gaussians there are, got {budget:,}")
    work.mkdir(parents=True, exist_ok=True)
    run = _Run(store, executor, work, config or SimplifyConfig(), progress)
    coarse = run.each("coarse", "coarse")
    frame = run.sampled_frame(coarse)
    sights: _Sights | None = None
    if not blind:
        sample = joined([scene_of(path, "sample") for path in coarse])
        cameras = views or beside(sample) or _planned(run, sample, up, seed, say)
        sights = None if cameras is None else _Sights(run, coarse, cameras, frame)
        frame = frame if sights is None else sights.frame
    costs = run.each("run_costs", "costs", frame=frame, **_look_of(sights))
    runs = _runs(run, costs, budget)
    of_all = budget / sum(runs)
    plans = run.each(
        "pair_plan",
        "plans",
        frame=frame,
        per_tile=[{"runs": n, "expected": of_all * n} for n in runs],
        **_look_of(sights),
    )
    merges = cheapest([_reader(path) for path in plans], sum(runs) - budget)
    _check_reached(sum(runs) - sum(merges), budget)
    per_tile = [{"runs": n, "merges": m} for n, m in zip(runs, merges, strict=True)]
    merged = run.each(
        "merge",
        "merge",
        frame=frame,
        per_tile=per_tile,
        inputs=[
            {"plan": plan, **({"look": sights.looks[tile]} if sights else {})}
            for tile, plan in enumerate(plans)
        ],
    )
    counts = tuple(n - m for n, m in zip(runs, merges, strict=True))
    if sights is None:
        return run.scene(counts, lambda tile: scene_of(merged[tile], "scene"), 0, None)
    return sights.fitted(counts, merged)


class _Run:
    """What all steps share."""

    def __init__(
        self, store: TileStore, executor: Executor, work: Path, config: SimplifyConfig, progress: Progress
    ):
        self.store, self.executor, self.work, self.progress = store, executor, work, progress
        self.config = asdict(config.resolved("default"))
        self.sizes = [tile.rows for tile in store.tiles]

    def each(
        self,
        function: str,
        stage: str,
        *,
        frame: tuple[float, ...] | None = None,
        per_tile: list[dict[str, Any]] | None = None,
        inputs: list[dict[str, Any]] | None = None,
    ) -> list[Path]:
        """One task a tile."""
        tasks = []
        for tile, rows in enumerate(self.sizes):
            arguments: dict[str, Any] = {"store": self.store.key, "tile": tile, "config": self.config}
            if frame is not None:
                arguments["frame"] = list(frame)
            arguments |= per_tile[tile] if per_tile else {}
            tasks.append(
                Task(
                    f"{_STEPS}:{function}",
                    f"{stage}-{tile:05}",
                    self.work,
                    arguments,
                    inputs[tile] if inputs else {},
                    {"store": self.store.folder},
                    rows,
                )
            )
        return self.executor.run(tasks, stage, self.progress)

    def sampled_frame(self, coarse: list[Path]) -> tuple[float, ...]:
        """The frame of a fair sample of the scene, without views."""
        from g2ard.prepared import finite_rows_of

        sample = joined([scene_of(path, "sample").with_sh_degree(0) for path in coarse])
        every = -(-len(sample) // 1_000_000)
        scene, _ = finite_rows_of(sample.take(slice(None, None, every)))
        return _core.TileFrame.of_sample(scene.core, self.config["pixel_scale"]).values()

    def scene(
        self, counts: tuple[int, ...], read: Callable[[int], Splats], views: int, unseen: int | None
    ) -> TiledScene:
        def tile(i: int) -> Splats:
            from dataclasses import replace

            small = read(i).with_sh_degree(self.store.sh_degree)
            return replace(small, quats=unit_quats(small.quats))

        return TiledScene(counts, tile, self.store.sh_degree, self.store.offset, views, unseen)


class _Sights:
    """Which views have which tile in sight, and what they see of it."""

    def __init__(self, run: _Run, coarse: list[Path], cameras: Cameras, frame: tuple[float, ...]):
        self.run, self.coarse, self.cameras = run, coarse, cameras.resized(_LONGEST)
        self.shrunk = float((self.cameras.widths / cameras.widths).mean())
        self.views = self._written()
        self.boxes = np.array(
            [np.percentile(scene_of(path, "near").means, (1, 99), axis=0) for path in coarse]
        )
        light = self._light()
        self.arguments = [
            {
                **self._chosen(light[:, tile], light.sum(axis=1)),
                "levels": self._levels(tile),
                "shrunk": self.shrunk,
            }
            for tile in range(len(coarse))
        ]
        self.looks = run.each("look", "look", frame=frame, per_tile=self.arguments, inputs=self._inputs())
        pixels = np.array([float(load(path, "pixel")[0]) for path in self.looks])
        sums = np.array([load(path, "sums")[0] for path in self.looks]).sum(axis=0)
        self.frame = frame
        if np.isfinite(pixels).any():
            known = np.isfinite(pixels)
            pixel = _weighted_median(pixels[known], np.array(run.sizes)[known])
            self.frame = _core.TileFrame(*frame).with_views(pixel, *map(float, sums)).values()

    def fitted(self, counts: tuple[int, ...], merged: list[Path]) -> TiledScene:
        """The merged tiles with opacities fitted to what the views see."""
        run = self.run
        inputs = [
            {**given, "merged": path, "look": look}
            for given, path, look in zip(self._inputs(), merged, self.looks, strict=True)
        ]
        again = run.each(
            "look_again",
            "look again",
            per_tile=[{"levels": a["levels"]} for a in self.arguments],
            inputs=inputs,
        )
        mean = sum(float(load(path, "wanted")[0].sum()) for path in merged) / sum(counts)
        unseen = sum(int(load(path, "unseen")[0]) for path in merged)

        def read(tile: int) -> Splats:
            members, wanted = load(merged[tile], "members", "wanted")
            (now,) = load(again[tile], "weight")
            return fit_opacities(scene_of(merged[tile], "scene"), members, wanted, now, mean)

        return run.scene(counts, read, len(self.cameras), unseen)

    def _inputs(self) -> list[dict[str, Any]]:
        return [{"coarse": self.coarse, "views": self.views} for _ in self.coarse]

    def _written(self) -> Path:
        """The cameras as a task's input, named by their content."""
        import hashlib

        from g2ard.io.atomic import atomic_output

        arrays = {name: getattr(self.cameras, name) for name in ("viewmats", "Ks", "widths", "heights")}
        content = b"".join(np.ascontiguousarray(array).tobytes() for array in arrays.values())
        path = self.run.work / f"views-{hashlib.sha256(content).hexdigest()[:16]}.npz"
        if not path.exists():
            with atomic_output(path) as temporary, temporary.open("wb") as file:
                np.savez(file, **arrays)
        return path

    def _light(self) -> NDArray[np.float64]:
        """(V, T) Σ αT that each view gets from each tile."""
        run = self.run
        level = "near" if run.store.count // COARSE[0] <= _GLANCED else "far"
        middles = self.boxes.mean(axis=1)
        here = self.cameras.recentred(run.store.offset)
        away = np.linalg.norm(here.positions[:, None] - middles, axis=2).min(axis=1)
        chunks = [range(i, min(i + _CHUNK, len(here))) for i in range(0, len(here), _CHUNK)]
        tasks = [
            Task(
                f"{_STEPS}:glance",
                f"glance-{number:05}",
                run.work,
                {"views": list(chunk), "level": level, "near": 1e-3 * float(np.median(away)) or None},
                {"coarse": self.coarse, "views": self.views},
                cost=len(chunk),
            )
            for number, chunk in enumerate(chunks)
        ]
        paths = run.executor.run(tasks, "glance", run.progress)
        return np.concatenate([load(path, "weights")[0] for path in paths])

    def _chosen(self, light: NDArray[np.float64], whole: NDArray[np.float64]) -> dict[str, Any]:
        """The views that look at a tile: evenly spaced among those that have it in sight."""
        sight = np.flatnonzero(light > _IN_SIGHT * whole)
        if len(sight) < _LOOKS:
            best = np.argsort(-light, kind="stable")[:_LOOKS]
            sight = np.sort(best[light[best] > 0])
        some = sight[np.unique(np.linspace(0, len(sight) - 1, min(_LOOKS, len(sight))).round().astype(int))]
        return {
            "views": some.tolist(),
            "light": light[some].tolist(),
            "all_light": float(light.sum()) or 1.0,
        }

    def _levels(self, tile: int) -> list[str | None]:
        """By which coarse level each tile stands beside `tile`, which has none itself."""
        low, high = self.boxes[:, 0], self.boxes[:, 1]
        gaps = np.maximum(0.0, np.maximum(low - high[tile], low[tile] - high))
        near = np.linalg.norm(gaps, axis=1) <= np.linalg.norm(high[tile] - low[tile])
        levels: list[str | None] = ["near" if is_near else "far" for is_near in near]
        levels[tile] = None
        return levels


def _look_of(sights: _Sights | None) -> dict[str, Any]:
    return {} if sights is None else {"inputs": [{"look": path} for path in sights.looks]}


def _planned(run: _Run, sample: Splats, up: Any, seed: int, say: Say) -> Cameras | None:
    """A pool that grows with the scene."""
    from g2ard.poses import plan_pool

    times = max(1.0, run.store.count / _POOL_ROWS)
    try:
        pool = plan_pool(
            sample,
            round(_POOL * times),
            up=up,
            seed=seed,
            rows=round(_PLANNED_ON * times),
            near=0.25,
            looks=True,
            represents=run.store.count / len(sample),
            progress=run.progress,
        )
    except InputError as e:
        say(f"goes on without views: {e}")
        return None
    say(f"poses: {len(pool.cameras)}, {pool.kind}")
    return pool.cameras


def _runs(run: _Run, costs: list[Path], budget: int) -> list[int]:
    """How many runs of Morton order each tile keeps."""
    kept = [_length(path) + 1 for path in costs]
    if sum(kept) < budget:
        raise InputError(
            f"budget: expected at most the {sum(kept):,} Gaussians that a renderer draws, got {budget:,}"
        )
    target = min(sum(kept), int(run.config["morton_premerge_ratio"] * budget))
    closed = cheapest([_reader(path) for path in costs], sum(kept) - max(target, len(kept)))
    return [n - c for n, c in zip(kept, closed, strict=True)]


def _length(path: Path) -> int:
    return len(load(path, "costs")[0])


def _reader(path: Path) -> Callable[[], NDArray[np.float32]]:
    return lambda: load(path, "costs")[0]


def _check_reached(count: int, budget: int) -> None:
    if count != budget:
        raise InputError(f"budget: {count:,} Gaussians is the fewest that the tiles come to, not {budget:,}")


def _weighted_median(values: NDArray[np.float64], weights: NDArray[Any]) -> float:
    order = np.argsort(values, kind="stable")
    sums = np.cumsum(weights[order])
    return float(values[order][np.searchsorted(sums, sums[-1] / 2)])
