"""Study of view selection: policies with equal prior, student, K and steps, scored on held-out views."""

from __future__ import annotations

import math
import time
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, replace
from functools import cached_property, partial
from pathlib import Path
from typing import Any, ClassVar, cast, get_args

import numpy as np
from numpy.typing import NDArray

from benchmarks.policies import order_views
from benchmarks.rows import Row
from benchmarks.study import Cell, SceneSpec, Study, key
from benchmarks.workspace import Workspace
from g2ard.config.choices import Engine
from g2ard.io.splits import splits_of, states_splits
from g2ard.poses import make_pool, plan_pool
from g2ard.rendering.targets import Subset, Targets, TeacherRenders
from g2ard.scene.cameras import Cameras
from g2ard.scene.samples import evenly_spaced
from g2ard.scene.splats import Splats
from g2ard.stages.evaluate import evaluate
from g2ard.stages.recover.anchors import REGULARIZERS
from g2ard.stages.recover.config import RecoverConfig
from g2ard.stages.recover.optimize import recover
from g2ard.stages.select import CoverageOptions, select
from g2ard.stages.simplify import simplify

__all__ = ["ARMS", "Pool", "Select", "Universe", "pool_of"]

ARMS = (
    "random",
    "pose-diverse",
    "coverage",
    "directional",
    "auto",
    "auto+weights",
    "pool",
    "pool+weights",
)
_CELLS = 50_000
"""Surface cells of coverage and directional, matched to the resolution of a study's small images."""
_CROWD = 24
"""Held-out views in the crowded part of a pool."""

Rows = NDArray[np.int64]


@dataclass(frozen=True)
class Select(Study):
    """A study of selection policies. Each seed draws a pool; each arm chooses K of its views.

    Scenes are trained scenes, or point clouds with photos.

    Args:
        methods: arms: policies, with "+weights" to sample views by the selection's weights, or "pool" for
            all candidates.
        size: longer side of the views.
        pools: biased (a quarter drawn evenly, the rest from one sector), even.
        percents: K in percent of the pool.
        draws: random subsets per pool.
        steps: steps per recovery.
        engine: engine of recovery.
        count: Gaussians of the student.
        candidates: maximum views per pool; at least 420 in a generated city.
        tests: views per scored set.
    """

    METHODS: ClassVar[Mapping[str, Any]] = {name: name for name in ARMS}

    size: int | None = key(256, least=16)
    pools: tuple[str, ...] = key(("biased", "even"), choices=("biased", "even"), axis=True)
    percents: tuple[float, ...] = key((10.0, 25.0, 50.0), least=1e-3, axis=True)
    draws: int = key(3, least=1, axis=True)
    steps: tuple[int, ...] = key((250,), least=1, axis=True)
    engine: str = key("fused", choices=get_args(Engine))
    count: int = key(10_000, least=1)
    candidates: int = key(160, least=8)
    tests: int = key(24, least=1)

    def cells(self, scene: SceneSpec, work: Path) -> Iterator[Cell]:
        """Yield a cell per pool, arm, K and draw; deterministic policies draw once."""
        universe = Universe(work, self, scene)
        for seed in self.seeds:
            for kind in self.pools:
                for arm in self.methods:
                    for percent in (100.0,) if arm.startswith("pool") else self.percents:
                        for draw in range(self.draws if arm == "random" else 1):
                            names = {
                                "pool": kind,
                                "arm": arm,
                                "percent": percent,
                                "seed": seed,
                                "draw": draw,
                            }
                            trial = partial(self._trial, universe, kind, arm, percent, seed, draw)
                            yield Cell(names, trial, more=self.steps)

    def _trial(
        self, universe: Universe, kind: str, arm: str, percent: float, seed: int, draw: int
    ) -> list[Row]:
        pool = pool_of(universe, kind, seed)
        k = max(1, math.ceil(percent / 100 * len(pool.rows) - 1e-9))
        policy, _, weighted = arm.partition("+")
        rows, weights, select_s = np.arange(len(pool.rows)), None, 0.0
        if arm != "pool":
            policy = "auto" if policy == "pool" else policy
            cameras = universe.shown.cameras.take(pool.rows)
            began = time.process_time()
            if weighted:
                chosen = select(universe.splats, cameras, k, policy=policy)
                rows, weights, select_s = chosen.order, chosen.weights, time.process_time() - began
            elif policy == "random":
                rows = order_views(universe.splats, cameras, policy, seed=1000 * seed + draw)
                select_s = time.process_time() - began
            else:  # the order is the same for every K
                if (kind, seed, policy) not in universe.orders:
                    options = CoverageOptions(cells=_CELLS)
                    order = order_views(universe.splats, cameras, policy, options=options)
                    universe.orders[kind, seed, policy] = order, time.process_time() - began
                rows, select_s = universe.orders[kind, seed, policy]
            rows = rows[:k]
        background = universe.scene.background
        config = RecoverConfig(
            steps=self.steps[-1],
            regularizers=REGULARIZERS["lift" if universe.lifted else "trained"],
            sh_degree=3 if universe.lifted else None,
            background=background,
            seed=seed,
            engine=cast(Engine, self.engine),
        )
        began = time.process_time()
        result = recover(
            universe.student, Subset(universe.shown, pool.rows[rows]), config, weights=weights
        ).splats
        recover_s = time.process_time() - began
        inside = evaluate(result, Subset(universe.shown, universe.held), background=background)
        outside = evaluate(result, universe.outside, background=background)
        row: Row = {
            "candidates": len(pool.rows),
            "k": len(rows),
            "psnr_in": inside.psnr,
            "ssim_in": inside.ssim,
            "psnr_out": outside.psnr,
            "ssim_out": outside.ssim,
            "select_cpu_s": select_s,
            "recover_cpu_s": recover_s,
            "steps": self.steps[-1],
            "gaussians": len(result),
            "pixels": self.size,
        }
        if len(pool.crowd):
            crowd = Subset(universe.shown, pool.crowd)
            row["psnr_crowd"] = evaluate(result, crowd, background=background).psnr
        return [row]

    def summary(self, rows: list[Row]) -> tuple[str, list[str], list[list[str]]] | None:
        """Return gains over mean random on the same pool; values of random are absolute.

        Deviations are those of single trials over pools and draws.
        """
        rows = [row for row in rows if "psnr_in" in row]
        lines = []
        groups = dict.fromkeys(
            (r["scene"], r["pool"], r["percent"]) for r in rows if not r["arm"].startswith("pool")
        )
        for scene, pool, percent in groups:
            here = [r for r in rows if (r["scene"], r["pool"]) == (scene, pool)]
            here = [r for r in here if r["percent"] in (percent, 100.0)]
            random = [r for r in here if r["arm"] == "random"]
            base = {
                seed: np.mean([_both(r) for r in random if r["seed"] == seed], axis=0)
                for seed in {r["seed"] for r in random}
            }
            for arm in dict.fromkeys(r["arm"] for r in here):
                own = [r for r in here if r["arm"] == arm and r["seed"] in base]
                if not own:
                    continue
                gains = np.array([_both(r) - base[r["seed"]] for r in own])
                mean = np.mean(list(base.values()), axis=0) if arm == "random" else gains.mean(0)
                noise = gains.std(0, ddof=1) if len(gains) > 1 else np.full(2, np.nan)
                figures = [mean[0], noise[0], mean[1], noise[1]]
                lines.append(
                    [scene, pool, f"{percent:g}", arm, *(f"{figure:.2f}" for figure in figures)]
                )
        title = "dB over mean random (random: PSNR), ± over pools; in and out of distribution"
        return (
            (title, ["scene", "pool", "K %", "arm", "in", "±", "out", "±"], lines)
            if lines
            else None
        )


def _both(row: Row) -> NDArray[np.float64]:
    return np.array([row["psnr_in"], row["psnr_out"]])


@dataclass(frozen=True, eq=False)
class Pool:
    """Candidates as rows of the universe, and held-out rows in the crowded part, if any."""

    rows: Rows
    crowd: Rows


class Universe(Workspace):
    """A scene with all views for pools and tests, `shown`, and `outside` views.

    `held` are the rows of `shown` that are scored, every 8th view of a generated pool.
    """

    study: Select

    @cached_property
    def orders(self) -> dict[tuple[str, int, str], tuple[Rows, float]]:
        """Kind of pool, seed and policy → the order of all candidates, and its seconds."""
        return {}

    @cached_property
    def student(self) -> Splats:
        """The student, simplified without views so that it does not depend on a pool."""
        return simplify(self.splats, min(self.study.count, len(self.splats))).splats

    @property
    def candidates(self) -> int:
        """The number of views per pool."""
        return max(420, self.study.candidates) if self.scene.synth else self.study.candidates

    @property
    def shown(self) -> Targets:
        """The targets of the universe."""
        return self._sets[0]

    @property
    def held(self) -> Rows:
        """The rows held out evenly over the universe."""
        return self._sets[1]

    @property
    def outside(self) -> Targets:
        """The targets of views outside the universe's distribution."""
        return self._sets[2]

    @cached_property
    def _sets(self) -> tuple[Targets, Rows, Targets]:
        return self._photos() if self.lifted else self._trained()

    def _trained(self) -> tuple[Targets, Rows, Targets]:
        """Return renders: outside are nearer views of an object, or an orbit around other scenes."""
        tests, size = self.study.tests, self.study.size
        planned = plan_pool(self.splats, 7 * self.candidates, seed=1)
        universe = planned.cameras.resized(size)
        rows = np.arange(len(universe))
        if planned.kind == "orbit":
            outside = _nearer(self.splats, universe.take(_evenly(rows[4::8], tests)))
        else:
            outside = make_pool(self.splats, tests, kind="orbit", seed=2).resized(size)
        shown, far = (
            TeacherRenders(self.splats, views, lazy=True) for views in (universe, outside)
        )
        return shown, _evenly(rows[::8], tests), far

    def _photos(self) -> tuple[Targets, Rows, Targets]:
        """Return photos: outside are the scene's views to score, or the eighth at one end of the site.

        With views to score, the held-out ones are spread evenly; otherwise they are the stated tests, or
        every 8th.
        """
        path = self.place / (self.scene.train or self.scene.prior)
        found = self.read(path)
        stated = states_splits(path, found.splits)
        words = np.array(splits_of(path, found.cameras.names, found.splits))
        known = np.isin(words, ("train", "test"))
        cameras = found.cameras.take(known).resized(self.study.size)
        rows = np.arange(len(cameras))
        if self.scene.score:
            tests = self.study.tests
            (outside,) = self.scored.values()
            outside = outside.take(_evenly(np.arange(len(outside)), tests))
            return self.targets(cameras), _evenly(rows, tests), self.targets(outside)
        centred = cameras.positions - cameras.positions.mean(0)
        along = np.argsort(centred @ np.linalg.svd(centred, full_matrices=False)[2][0])
        far, rest = along[: len(along) // 8], np.sort(along[len(along) // 8 :])
        held = (
            np.flatnonzero(words[known][rest] == "test") if stated else np.arange(0, len(rest), 8)
        )
        return self.targets(cameras.take(rest)), held, self.targets(cameras.take(far))


def pool_of(universe: Universe, kind: str, seed: int) -> Pool:
    """Draw candidates from the universe.

    even: uniformly. biased: a quarter uniformly, the rest from the sixth of the universe (a third of a small
    one) nearest to one of its views, since real trajectories are crowded somewhere.
    """
    rng = np.random.default_rng([seed, 11])
    free = np.setdiff1d(np.arange(len(universe.shown.cameras)), universe.held)
    count = min(universe.candidates, len(free) * 4 // 5)
    if kind == "even":
        return Pool(np.sort(rng.choice(free, count, replace=False)), np.zeros(0, np.int64))
    positions = universe.shown.cameras.positions
    near = free[np.argsort(np.linalg.norm(positions[free] - positions[rng.choice(free)], axis=1))]
    crowded = near[: len(near) // 6] if len(near) >= 6 * count else near[: len(near) // 3]
    crowded = rng.permutation(crowded)
    crowd, rest = crowded[: min(_CROWD, len(crowded) // 6)], crowded[len(crowded) // 6 :]
    many = rest[: min(len(rest), 3 * count // 4)]
    others = np.setdiff1d(free, crowded)
    few = rng.choice(others, min(len(many) // 3, len(others)), replace=False)
    return Pool(np.sort(np.concatenate([many, few])), np.sort(crowd))


def _nearer(prior: Splats, cameras: Cameras) -> Cameras:
    """Move views along their direction by 40 % of the distance to the scene's centre."""
    middle = np.median(prior.means, axis=0) + prior.offset
    steps = 0.4 * np.einsum("ci,ci->c", middle - cameras.positions, cameras.forwards)
    viewmats = cameras.viewmats.copy()
    viewmats[:, 2, 3] -= steps
    return replace(cameras, viewmats=viewmats)


def _evenly(rows: Rows, count: int) -> Rows:
    return rows[evenly_spaced(len(rows), count)]
