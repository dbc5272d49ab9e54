"""Simplification of a tiled scene to one exact budget."""

from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass, replace
from itertools import accumulate, pairwise
from pathlib import Path
from typing import Any

import numpy as np

from g2ard.arrays import Float32, Int, Mask, Values
from g2ard.errors import InputError
from g2ard.io.sanitize import BLOCK
from g2ard.io.stream import PartsStream, SceneStream
from g2ard.io.tile_store import TileStore
from g2ard.scene.cameras import Cameras
from g2ard.scene.splats import Splats, unit_quats
from g2ard.stages.simplify import Paper
from g2ard.stages.simplify.pairs import fit_opacities
from g2ard.stages.simplify.reduce import SimplifyReport, SimplifyRound
from g2ard.system.keys import key_of
from g2ard.tiles.sights import Sights
from g2ard.tiles.simplify import TiledRun, merge, pair_plan, reduce, run_costs
from g2ard.tiles.tasks import load, scene_of

_HALF = 1 << 16

_PLAN_DEPTH_SHARE = 0.6
"""Plans of merges go down to this share of the Gaussians that a tile is expected to keep."""


@dataclass(frozen=True, eq=False)
class Merged:
    """A scene merged in tiles.

    Args:
        splats: the scene, with fitted opacities; in tiles, its identity is a hash of the names of its files.
        files: results of `merge` or `reduce`; none if nothing was merged.
    """

    splats: Splats | PartsStream
    report: SimplifyReport
    store: TileStore
    files: Sequence[Path]

    @property
    def protected(self) -> Mask | None:
        """(M,) protection flags, if the method has them."""
        flags = [
            load(path, "protected")[0] for path in self.files if path.name.startswith("reduce")
        ]
        return np.concatenate(flags) if flags else None

    def parents(self, scene: SceneStream) -> Int:
        """Return (N,) the row in the result of each Gaussian, see `Simplified`.

        Args:
            scene: what was cut into the tiles, or they themselves: it gives the order of the rows.
        """
        rows = [tile.rows for tile in self.store.tiles]
        counts = self.report.tiles or rows
        parents = [load(path, "parents")[0] for path in self.files] or [np.arange(n) for n in rows]
        before = np.cumsum([0, *counts])[:-1]
        moved = [
            np.where(own < 0, -1, own + np.int64(n)) for own, n in zip(parents, before, strict=True)
        ]
        if scene.identity() == [self.store.key]:
            return np.concatenate(moved)
        out = np.empty(self.store.count, np.int64)
        done = [0] * len(rows)
        begin = 0
        for block in scene.blocks(BLOCK):
            for tile, (core, _) in enumerate(self.store.tree.route(block.means)):
                out[begin + core] = moved[tile][done[tile] : done[tile] + len(core)]
                done[tile] += len(core)
            begin += len(block)
        return out


def simplify_tiles(
    run: TiledRun, budget: int, views: Cameras | None = None, final_budget: int | None = None
) -> Merged:
    """Reduce a tiled scene to exactly `budget` Gaussians; `final_budget` is that of `simplify`.

    If `budget` is the scene's count, the scene is returned unchanged. Otherwise:

    1. Each tile is merged to a few coarse Gaussians that represent it in views of other tiles (`TiledRun`).
    2. Each tile is rendered from the views that see it, amid its halo and the coarse Gaussians of all other
       tiles (`Sights`).
    3. Each tile computes the costs of merging along Morton order. The cheapest merges of all tiles are done,
       down to three times the budget. Then each tile plans more merges of pairs than needed, and the cheapest
       of all plans are done, down to the budget (`_merged`). Where merging has several steps along Morton
       order, as in `fast`, the cheapest merges only decide the share that each tile keeps, with `paper` its
       rows do; then it is reduced by itself.
    4. Opacities are fitted to what the same views see of the result.

    Every step is a task with a file in the folder of the run's workers, so the same call resumes. The result
    depends only on the scene, the tiles and the views, not on where, in which order or how often tasks ran.
    """
    store = run.store
    if not 1 <= budget <= store.count:
        raise InputError(
            f"expected 1 to {store.count:,} (the scene's Gaussians), got {budget:,}",
            parameter="budget",
        )
    if budget == store.count:
        whole = scene_in_tiles(store, run.sizes, store.read, key_of(store.key), store.sh_degree)
        return Merged(whole, _report(run, run.sizes, []), store, ())
    frame = run.sampled_frame()  # units that tiles share, so that their costs compare
    sights = None if views is None else Sights(run, views, frame)
    if isinstance(run.method, Paper):
        counts = shares(run.sizes, budget)
        merged = _reduced(
            run, counts, shares(run.sizes, final_budget or budget), [{}] * len(counts)
        )
    else:
        merged, counts = _merged(run, budget, frame if sights is None else sights.frame, sights)
    if sights is None:
        files = [{"merged": path} for path in merged]
        mean = None
    else:
        seen = sights.again(merged)
        files = [
            {"merged": one, "visibility": other} for one, other in zip(merged, seen, strict=True)
        ]
        mean = sum(float(load(path, "wanted")[0].sum()) for path in merged) / budget

    def tile(i: int) -> Splats:
        small = scene_of(merged[i], "scene")
        if mean is not None:  # with views, opacities fit what these see
            members, wanted = load(merged[i], "members", "wanted")
            (weight,) = load(files[i]["visibility"], "weight")
            small = fit_opacities(small, members, wanted, weight, mean)
        return finished(small, store.sh_degree)

    scene = scene_in_tiles(store, counts, tile, key_of(files), store.sh_degree)
    return Merged(scene, _report(run, counts, merged, seen=sights is not None), store, merged)


def _report(
    run: TiledRun, counts: Sequence[int], merged: list[Path], *, seen: bool = False
) -> SimplifyReport:
    """Describe a merge; `merged` are the results of `merge`, none if nothing was merged."""
    total = run.store.count
    left = sum(counts)
    kept = alone = clamped = unseen = 0
    for path in merged:
        members, limited = load(path, "members", "clamped")
        kept += int(members.sum())
        alone += int(np.count_nonzero(members == 1))
        clamped += int(limited)
        unseen += int(load(path, "unseen")[0]) if seen else 0
    step = SimplifyRound(total, total - kept, kept - left, 0, left)
    return SimplifyReport(
        input_count=total,
        output_count=left,
        merged_members=kept - alone,
        rounds=(step,) if merged else (),
        protected=0,
        nonfinite_rows=0,  # dropped when tiles are written
        infinite_logits=0,
        clamped_opacities=clamped,
        fitted=0,
        unseen=unseen if seen else None,
        faded=0,
        skipped={"alone": alone},
        tiles=list(counts),
    )


def _merged(
    run: TiledRun, budget: int, frame: tuple[float, ...], sights: Sights | None
) -> tuple[list[Path], list[int]]:
    """Merge all tiles to exactly `budget` Gaussians; return the results and their counts."""
    tiles = len(run.sizes)
    check_reachable(budget, tiles)
    seen = [{"visibility": path} for path in sights.visibility] if sights else [{}] * tiles
    mean_run = max(1.0, sum(run.sizes) / (run.config["morton_premerge_ratio"] * budget))
    given: list[dict[str, Any]] = [{"frame": frame, "mean_run": mean_run, **one} for one in seen]
    costs = run.each(run_costs, "costs", given)
    runs_left, faint = _runs(run, costs, budget)
    if run.has_own_steps:
        counts = shares([n + f for n, f in zip(runs_left, faint, strict=True)], budget)
        return _reduced(run, counts, counts, seen), counts
    for one, path, runs, end in zip(
        given, costs, runs_left, plan_ends(runs_left, budget), strict=True
    ):
        one |= {"costs": path, "runs": runs, "last": end}
    plans = run.each(pair_plan, "plans", given)
    merges = cheapest([_costs_of(path) for path in plans], sum(runs_left) + sum(faint) - budget)
    counts = [n - m + f for n, m, f in zip(runs_left, merges, faint, strict=True)]
    if sum(counts) != budget:
        raise _unreached(sum(counts), budget, tiles, "what merging leaves of them")
    for one, path, number, rows in zip(given, plans, merges, faint, strict=True):
        one |= {"plan": path, "merges": number, "faint": rows}
    return run.each(merge, "merge", given), counts


def _reduced(
    run: TiledRun, counts: Sequence[int], final: Sequence[int], seen: list[dict[str, Path]]
) -> list[Path]:
    """Reduce each tile alone to its count; return the results of `reduce`."""
    method = asdict(run.method)
    given = (
        {"method": method, "count": count, "final": end, **one}
        for count, end, one in zip(counts, final, seen, strict=True)
    )
    return run.each(reduce, "reduce", given)


def shares(sizes: Sequence[int], budget: int) -> list[int]:
    """Return counts in proportion to tiles' rows, at least 1 each, `budget` in all.

    >>> shares([100, 200, 1], 30)
    [9, 20, 1]
    """
    tiles = len(sizes)
    total = sum(sizes)
    check_reachable(budget, tiles)
    ends = [
        rows * (budget - tiles) // max(1, total - tiles)
        for rows in accumulate(n - 1 for n in sizes)
    ]
    return [1 + end - begin for begin, end in pairwise([0, *ends])]


def scene_in_tiles(
    store: TileStore, counts: Sequence[int], tile: Callable[[int], Splats], key: str, sh_degree: int
) -> PartsStream:
    """Return a scene whose Gaussians `tile` reads by the number of a tile of `store`."""
    parts = counts, tile, sh_degree, store.offset
    scene = PartsStream(Path(f"simplified-{key}"), *parts, [key], render_model=store.render_model)
    scene.up = store.up
    scene.axes = store.axes
    return scene


def finished(small: Splats, sh_degree: int) -> Splats:
    """Return a tile's Gaussians as they are written to files."""
    return replace(small.with_sh_degree(sh_degree), quats=unit_quats(small.quats))


def plan_ends(runs: Sequence[int], budget: int) -> list[int]:
    """Return the counts down to which tiles plan merges: at least 1 each, and at most `budget` in all.

    >>> plan_ends([100, 200], 100), plan_ends([8, 1, 1], 4)
    ([20, 40], [2, 1, 1])
    """
    share = _PLAN_DEPTH_SHARE * min(1.0, budget / sum(runs))
    ends = [max(1, round(share * n)) for n in runs]
    # few Gaussians per tile: all have one, and shares of the rest are rounded down
    if sum(ends) > budget:
        share = _PLAN_DEPTH_SHARE * (budget - len(runs)) / max(1, sum(runs) - len(runs))
        ends = [1 + int(share * (n - 1)) for n in runs]
    return ends


def _runs(run: TiledRun, costs: list[Path], budget: int) -> tuple[list[int], list[int]]:
    """Return the number of Morton runs that each tile keeps, and of its rows that no renderer draws.

    Such rows are kept only if the others are fewer than the budget.
    """
    kept = [len(load(path, "costs")[0]) + 1 for path in costs]
    if sum(kept) <= budget:
        missing = budget - sum(kept)
        faint = []
        for size, drawn in zip(run.sizes, kept, strict=True):
            faint.append(min(missing, size - drawn))
            missing -= faint[-1]
        return kept, faint
    target = int(min(sum(kept), run.pairs_per_row(budget) * budget))
    closed = cheapest([_costs_of(path) for path in costs], sum(kept) - max(target, len(kept)))
    return [n - c for n, c in zip(kept, closed, strict=True)], [0] * len(kept)


def _costs_of(path: Path) -> Callable[[], Float32]:
    return lambda: load(path, "costs")[0]


def check_reachable(budget: int, tiles: int) -> None:
    """Reject a budget of less than one Gaussian per tile."""
    if budget < tiles:
        raise _unreached(tiles, budget, tiles, "one per tile")


def _unreached(count: int, budget: int, tiles: int, why: str) -> InputError:
    return InputError(
        f"the {tiles:,} tiles keep at least {count:,} Gaussians ({why}), got "
        f"{budget:,}; raise --tile-rows to get fewer tiles",
        parameter="budget",
    )


def cheapest(costs: Sequence[Callable[[], Float32]], count: int) -> list[int]:
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


def _bits(make: Callable[[], Float32]) -> Values:
    return np.ascontiguousarray(make(), np.float32).view(np.uint32)


def _histogram(values: Values) -> Int:
    return np.bincount(values, minlength=_HALF)


def _rank(histogram: Int, count: int) -> tuple[int, int]:
    """Return the bin of the count-th value, and the number of values in earlier bins."""
    sums = np.cumsum(histogram)
    at = min(int(np.searchsorted(sums, count)), len(sums) - 1)
    return at, int(sums[at - 1]) if at else 0
