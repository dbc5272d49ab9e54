"""Policies of view selection against each other: equal prior, student, K, steps; scored on unseen views."""

from __future__ import annotations

import math
import time
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from benchmarks import rows as table
from benchmarks.select_workspaces import KINDS, Pool, Size, Workspace, label, pool_of, workspace_of
from benchmarks.simplify import machine
from g2ard.errors import InputError
from g2ard.progress import Progress, silent
from g2ard.scene.targets import Subset, Targets
from g2ard.stages.evaluate import evaluate
from g2ard.stages.recover import RecoverConfig, recover
from g2ard.stages.select import POLICIES, CoverageOptions, Selection, select

__all__ = ["ARMS", "Trial", "bench_select", "summary"]

ARMS = ("random", "pose-diverse", "coverage", "directional", "auto", "auto+weights", "pool", "pool+weights")
"""Policies, "+weights" where recovery draws by the selection's weights; pool is all candidates."""

_CELLS = 50_000
"""Surface cells of coverage and directional: as many as a study's small images can tell apart."""


@dataclass(frozen=True)
class Trial:
    """One recovery; a row of the CSV.

    Args:
        scene: its name.
        pool: biased or even.
        arm: of `ARMS`.
        percent: K as a share of the pool.
        seed: of the pool and of the recovery.
        draw: which of several random subsets; 0 for all other arms.
        candidates: views in the pool.
        k: views chosen.
        psnr_in: mean over unseen views spread evenly over the pool's extent, dB.
        ssim_in: the same.
        psnr_out: mean over views outside the pool's distribution.
        ssim_out: the same.
        psnr_crowd: mean over unseen views where a biased pool is crowded; None for an even one.
        select_cpu_s: user + system seconds of the selection: of the whole order where one trial's K is the
            start of it.
        recover_cpu_s: the same of the recovery.
        steps: of the recovery.
        gaussians: recovered.
        pixels: longer side of the views.
        machine: processor and cores.
    """

    scene: str
    pool: str
    arm: str
    percent: float
    seed: int
    draw: int
    candidates: int
    k: int
    psnr_in: float
    ssim_in: float
    psnr_out: float
    ssim_out: float
    psnr_crowd: float | None
    select_cpu_s: float
    recover_cpu_s: float
    steps: int
    gaussians: int
    pixels: int
    machine: str

    @property
    def key(self) -> tuple[str, str, str, float, int, int]:
        """What tells it from other rows."""
        return self.scene, self.pool, self.arm, self.percent, self.seed, self.draw


def bench_select(
    scenes: Sequence[Path],
    csv_path: Path,
    *,
    pools: Sequence[str] = KINDS,
    arms: Sequence[str] = ARMS,
    percents: Sequence[float] = (10, 25, 50),
    seeds: int = 3,
    draws: int = 3,
    steps: int = 250,
    size: Size | None = None,
    cache: Path | None = None,
    progress: Progress = silent,
) -> list[Trial]:
    """Run every trial that `csv_path` does not hold yet; append rows as they are done.

    Each seed draws a pool; each arm chooses from it and the same student recovers from what was chosen, for
    the same number of steps. Deterministic policies have one trial a pool, random has `draws`.

    Args:
        scenes: trained scenes, which teach themselves; COLMAP folders with photos; `city`.
        csv_path: where the rows go; those there are not done again.
        pools: of `KINDS`.
        arms: of `ARMS`.
        percents: K as shares of the pool.
        seeds: pools of each kind.
        draws: subsets of `random` a pool.
        steps: of each recovery.
        size: how small the trials are.
        cache: a folder for rendered targets; None keeps them in memory only.
        progress: told after each trial.

    Returns:
        The trials asked for.

    Raises:
        InputError: a scene or the CSV cannot be read, an unknown arm or pool, or the CSV holds these scenes'
            trials at another size or with other steps.
    """
    for name, given, known in (("arms", arms, ARMS), ("pools", pools, KINDS)):
        if unknown := [g for g in given if g not in known]:
            raise InputError(f"{name}: expected some of {', '.join(known)}, got {', '.join(unknown)}")
    size = size or Size()
    done = {trial.key: trial for trial in table.read(csv_path, Trial)}
    for trial in done.values():
        if trial.scene in map(label, scenes) and (trial.steps, trial.pixels) != (steps, size.pixels):
            raise InputError(
                f"{csv_path}: holds trials of {trial.scene} with {trial.steps} steps at {trial.pixels}"
                f" pixels, not {steps} at {size.pixels}"
            )
    wanted = [
        (label(scene), pool, arm, percent, seed, draw)
        for scene in scenes
        for seed in range(seeds)
        for pool in pools
        for arm, percent, draw in _plan(arms, percents, draws)
    ]
    table.rewrite(csv_path, done.values(), Trial)
    finished = sum(key in done for key in wanted)
    for scene in scenes:
        missing = [key for key in wanted if key[0] == label(scene) and key not in done]
        if not missing:
            continue
        own = f"{label(scene).replace('/', '_')}-{size.candidates}-{size.pixels}"
        folder = cache / own if cache else None
        bench = _Bench(workspace_of(scene, size, cache=folder, progress=progress), size, steps)
        for key in missing:
            trial = bench.run(*key)
            table.append(csv_path, [trial])
            done[key] = trial
            finished += 1
            progress("bench select", finished, len(wanted), {key[0]: f"{key[1]} {key[2]} {key[3]:g} %"})
    return [done[key] for key in wanted]


def _plan(arms: Sequence[str], percents: Sequence[float], draws: int) -> Iterator[tuple[str, float, int]]:
    for arm in arms:
        for percent in (100.0,) if arm.startswith("pool") else map(float, percents):
            for draw in range(draws if arm == "random" else 1):
                yield arm, percent, draw


class _Bench:
    """Trials in one workspace; a pool's orders are found once."""

    def __init__(self, scene: Workspace, size: Size, steps: int) -> None:
        self.workspace, self.size, self.steps = scene, size, steps
        self._orders: dict[tuple[str, int, str], tuple[Selection, float]] = {}

    def run(self, scene: str, kind: str, arm: str, percent: float, seed: int, draw: int) -> Trial:
        pool = pool_of(self.workspace, kind, seed)
        k = max(1, math.ceil(percent / 100 * len(pool.rows) - 1e-9))
        rows, weights, select_s = self._chosen(pool, kind, arm, k, seed, draw)
        began = time.process_time()
        result = recover(
            self.workspace.student,
            Subset(self.workspace.targets, pool.rows[rows]),
            RecoverConfig(
                steps=self.steps,
                regularizers=self.workspace.regularizers,
                sh_degree=self.workspace.sh_degree,
                background=self.workspace.background,
                seed=seed,
            ),
            weights=weights,
        )
        recover_s = time.process_time() - began

        def score(targets: Targets) -> tuple[float, float]:
            found = evaluate(result.splats, targets, background=self.workspace.background)
            return found.psnr, found.ssim

        inside, outside = (
            score(Subset(self.workspace.targets, self.workspace.tests)),
            score(self.workspace.outside),
        )
        crowd = score(Subset(self.workspace.targets, pool.crowd))[0] if len(pool.crowd) else None
        return Trial(
            scene, kind, arm, percent, seed, draw, len(pool.rows), len(rows), *inside, *outside, crowd,
            select_s, recover_s, self.steps, len(result.splats), self.size.pixels, machine(),
        )  # fmt: skip

    def _chosen(
        self, pool: Pool, kind: str, arm: str, k: int, seed: int, draw: int
    ) -> tuple[NDArray[np.int64], NDArray[np.float64] | None, float]:
        """Rows of the pool, weights, and the seconds the selection took."""
        policy, _, weighted = arm.partition("+")
        if policy == "pool":
            policy = "auto"
        if arm == "pool":
            return np.arange(len(pool.rows)), None, 0.0
        if weighted or policy == "random":
            chosen, seconds = self._select(pool, k, policy, 1000 * seed + draw)
            return chosen.order, chosen.weights if weighted else None, seconds
        key = kind, seed, policy
        if key not in self._orders:
            self._orders[key] = self._select(pool, len(pool.rows), policy, seed)
        chosen, seconds = self._orders[key]
        return chosen.order[:k], None, seconds

    def _select(self, pool: Pool, k: int, policy: str, seed: int) -> tuple[Selection, float]:
        assert policy in POLICIES
        began = time.process_time()
        cameras = self.workspace.targets.cameras.take(pool.rows)
        options = CoverageOptions(cells=_CELLS)
        chosen = select(self.workspace.prior, cameras, k, policy=policy, seed=seed, options=options)
        return chosen, time.process_time() - began


def summary(trials: Sequence[Trial]) -> list[dict[str, float | str]]:
    """Gains over mean random, scene by scene: one row a scene, pool, percent and arm.

    Each pool's trials are compared with the mean of random on that very pool, then averaged. The whole
    pool's are compared with random at every percentage.

    Returns:
        Rows with scene, pool, percent, arm, in, out (dB over mean random; for random itself absolute),
        noise_in and noise_out (standard deviations of single trials over pools and draws).
    """
    out: list[dict[str, float | str]] = []
    groups = dict.fromkeys((t.scene, t.pool, t.percent) for t in trials if not t.arm.startswith("pool"))
    for scene, kind, percent in groups:
        here = [t for t in trials if (t.scene, t.pool) == (scene, kind) and t.percent in (percent, 100.0)]
        base = {
            seed: np.mean([_both(t) for t in here if t.arm == "random" and t.seed == seed], axis=0)
            for seed in {t.seed for t in here if t.arm == "random"}
        }
        for arm in dict.fromkeys(t.arm for t in here):
            own = [t for t in here if t.arm == arm and t.seed in base]
            if not own:
                continue
            gains = np.array([_both(t) - base[t.seed] for t in own])
            shown = np.mean(list(base.values()), axis=0) if arm == "random" else gains.mean(0)
            noise = gains.std(0, ddof=1) if len(gains) > 1 else np.full(2, np.nan)
            out.append(
                {
                    "scene": scene,
                    "pool": kind,
                    "percent": percent,
                    "arm": arm,
                    "in": float(shown[0]),
                    "out": float(shown[1]),
                    "noise_in": float(noise[0]),
                    "noise_out": float(noise[1]),
                }
            )
    return out


def _both(trial: Trial) -> NDArray[np.float64]:
    return np.array([trial.psnr_in, trial.psnr_out])
