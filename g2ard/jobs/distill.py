"""`g2ard.distill`: reading inputs, deciding options, and running the pipeline."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from g2ard.config.checks import AtLeastOne, Positive, checks_arguments
from g2ard.config.choices import Colour, FormatName, PointColor, RenderModel, is_made
from g2ard.config.schema import keywords, listed
from g2ard.errors import InputError
from g2ard.io import Source, read_splats
from g2ard.io.types import Cloud, Points, ViewSet
from g2ard.jobs.budget import Budget, count_of
from g2ard.jobs.budget_search import ResolvedBudget
from g2ard.jobs.chosen_points import PointChoice
from g2ard.jobs.clean import without_clutter
from g2ard.jobs.distill_options import LEAST_RECOVERY_SHARE, DistillOptions
from g2ard.jobs.doubts import doubts_of_merging, doubts_of_views
from g2ard.jobs.inputs import GivenViews, Views, axes_of, load_scene, make_targets, scorable, split_views
from g2ard.jobs.memory import RECOVERY_TIMES, TilePlan
from g2ard.jobs.run_views import Use, is_untouched, pool_times, views_of, within_pixels
from g2ard.jobs.simplify import Reduction
from g2ard.jobs.start_points import (
    colored_source,
    is_sparse_file,
    placed_source,
    rough_points,
    sparse_file,
    sparse_points,
    topped_up,
    usual_count,
)
from g2ard.jobs.view_checks import check_photos, propose_background
from g2ard.jobs.viewer_frame import best_level
from g2ard.pipeline.config import DistillConfig
from g2ard.pipeline.dense import Dense, InMemory
from g2ard.pipeline.distill import Distilled, RunViews, round_counts
from g2ard.pipeline.distill import distill as pipeline
from g2ard.poses import best_views
from g2ard.progress import Detail, Progress, Say, plural, silent, unsaid
from g2ard.rendering.metrics import psnr
from g2ard.rendering.targets import Subset, Targets, fill, kinds_of, kinds_told, scored_in
from g2ard.rendering.visibility import overdraw
from g2ard.report.distilled import Drawn
from g2ard.report.labels import RESULT
from g2ard.report.run import Packed, RunReport, summarize_by_kind
from g2ard.scene.cameras import USUAL, Cameras
from g2ard.scene.samples import evenly_spaced
from g2ard.scene.splats import Splats
from g2ard.stages.evaluate import Evaluation, evaluate
from g2ard.stages.lift import in_axes, lift, lift_rows
from g2ard.stages.photo_points.colors import colored
from g2ard.stages.photo_points.rays import distinct
from g2ard.stages.recover.anchors import FREE, PriorMeasures, Regularizers, choose_regularizers, measure_prior
from g2ard.stages.recover.config import RecoverConfig, Schedule
from g2ard.stages.simplify.gaps import say_gaps
from g2ard.system.cached import cached_property
from g2ard.system.peak_memory import peak_rss_of_all

if TYPE_CHECKING:
    from g2ard.jobs.dense import Opened
    from g2ard.jobs.tile_options import Tiling


@dataclass(frozen=True, eq=False)
class RunTargets:
    """Targets of a run.

    Args:
        held_out: those for scoring that have a valid pixel.
        validation: every second view of another kind; None without such views or a teacher to render them.
        apart: the others of these views, for scoring.
        full: held-out targets at the views' own size, of large views only some (`within_pixels`); None if no
            size shrank them.
        twice: some of the held-out targets at twice their size, see `RunViews`.
    """

    train: Targets
    held_out: Targets
    validation: Targets | None
    apart: Targets | None
    full: Targets | None
    twice: Targets | None


@dataclass(frozen=True, eq=False)
class DistillJob:
    """A prepared distillation: everything is decided, nothing rendered yet.

    Args:
        dense: the dense scene, or a lifted point cloud.
        budget: the resolved budget.
        renders: whether renders of the dense scene are targets; otherwise all are photos.
        photos_over_renders: use photos where views have them and renders for the rest; always False without
            renders.
        preset: the regularisers chosen, and why.
        recovers: whether the scene is recovered, or only merged.
        cleaned: number of Gaussians removed by kind of clutter; None without cleaning.
        began, prepared: when the preparation began and ended.
        time: limit of the whole run in seconds; None without one.
        plan: of the dense scene's tiles; None if it is in memory.
    """

    dense: Dense
    budget: ResolvedBudget
    views: RunViews
    renders: bool
    photos_over_renders: bool
    config: DistillConfig
    lifted: bool
    preset: str
    measured: PriorMeasures
    recovers: bool = True
    cleaned: dict[str, int] | None = None
    began: float = 0.0
    prepared: float = 0.0
    time: float | None = None
    progress: Progress = silent
    say: Say = unsaid
    plan: TilePlan | None = None

    @property
    def prior(self) -> Splats:
        """The dense scene, or a sample of one in tiles."""
        return self.dense.sample

    @property
    def total(self) -> int:
        """Gaussians of the dense scene."""
        return self.dense.total

    @property
    def reads_photos(self) -> bool:
        """Whether any target may be a photo."""
        return not self.renders or self.photos_over_renders

    @property
    def photos(self) -> list[Path]:
        """The photos and masks that targets may be."""
        views = (self.views.train.cameras, self.views.test)
        paths = (path for cameras in views for path in (*cameras.image_paths, *cameras.mask_paths))
        return list(dict.fromkeys(path for path in paths if path is not None)) if self.reads_photos else []

    @property
    def weights(self) -> NDArray[np.float64] | None:
        """(C,) sampling weight per training view, if the views state them."""
        return self.views.train.weights if self.config.select.weighted else None

    def is_kept(self, count: int) -> bool:
        """Return whether the scene already is the result: it fits, and its renders are the targets."""
        untouched = is_untouched(self.config.recover, self.prior, count, self.total)
        return not self.reads_photos and untouched

    def steps(self, count: int) -> int:
        """Return the steps of all recoveries: after each round, if there are rounds, and of the last."""
        recover = self.config.recover
        like = self.prior.take(np.array(evenly_spaced(len(self.prior), min(count, len(self.prior)))))
        last = recover.final_steps(like, self.views.train.cameras, of_photos=self.reads_photos)
        rounds = round_counts(self.dense, count, self.config)
        return last + len(rounds) * recover.schedule.round_steps

    @property
    def render(self) -> Callable[[Cameras], Targets] | None:
        """Function that renders the dense scene for targets, if any are renders."""
        background = self.config.recover.background
        return partial(self.dense.images, background=background) if self.renders else None

    @cached_property
    def targets(self) -> RunTargets:
        """Targets of the views, made on access; see `make_targets`."""
        views, say = self.views, self.say

        made = self._made
        train, held_out = made(views.train.cameras, say), scorable(made(views.test, say), say)
        validation = apart = None
        if self.renders and views.apart is not None and len(views.apart) > 1:
            validation, apart = (made(views.apart.take(range(i, len(views.apart), 2))) for i in (0, 1))
        full = None if views.full is None else scorable(made(within_pixels(views.full)))
        twice = None if views.twice is None or not self.renders else made(views.twice)
        return RunTargets(train, held_out, validation, apart, full, twice)

    def _made(self, cameras: Cameras, say: Say = unsaid) -> Targets:
        background, mixed = self.config.recover.background, self.photos_over_renders
        return make_targets(cameras, self.render, background, mixed=mixed, say=say)

    def best(self, done: Distilled) -> Targets:
        """Return targets of the views that show the result best: placed ones, or some of the scored ones."""
        held_out, full = self.targets.held_out, self.views.full
        cameras, pool = held_out.cameras, self.views.pool
        if not self.renders or pool is None:
            names = best_views(done.splats, _SHOWN, cameras).names
            if full is not None:
                larger = full.take([full.names.index(name) for name in names]).resized(_PICTURE)
                return done.scored_on(self._made(larger))
            return done.scored_on(Subset(held_out, [cameras.names.index(name) for name in names]))
        found = best_level(self.prior, _SHOWN, pool.cameras)
        longest = max(_PICTURE, int(np.maximum(cameras.widths, cameras.heights).max()))
        return self.dense.images(found.scaled(longest), self.config.recover.background)

    def run(self, work: Path | None = None) -> Distilled:
        """Distil the scene; `work` is the folder for resuming, see `g2ard.pipeline.distill`."""
        for scored in filter(None, (self.targets.held_out, self.targets.apart)):
            fill(scored, self.progress)
        limited = None if self.time is None else partial(self.time_left, self.time)
        done = self._reduced(self.dense, self.budget.count, work, time_left=limited)
        splats = self.budget.shrink(done.splats, self.say)
        return replace(done, splats=splats, held_out=done.scored_on(self.targets.held_out))

    def scored(self, done: Distilled) -> Distilled:
        """Return a result with its scores in held-out views, at their own size."""
        targets = done.scored_on(self.targets.full or self.targets.held_out)
        if not len(targets.cameras):
            return done
        background = self.config.recover.background
        found = evaluate(done.splats, targets, background=background, progress=self.progress, stage="scoring")
        return replace(done, scores=replace(found, scored_in=scored_in(targets, "held-out")))

    def time_left(self, limit: float) -> float:
        """Return the seconds for recovery, of a limit for the whole run, after all that comes before it.

        Scoring comes after it. Recovery gets at least a twentieth.
        """
        scoring = self._scoring_seconds()
        spent = time.monotonic() - self.began
        left, least = limit - spent - scoring, LEAST_RECOVERY_SHARE * limit
        if left < least:
            self.say(f"warning: {limit:g} s are short; after {spent:.1f} s recovery still gets {least:.1f} s")
        return max(left, least)

    def _scoring_seconds(self) -> float:
        """Measure how long scoring takes: of the scene before and after recovery, in all views for scores.

        The dense scene is rendered in some of them. A result takes less, which leaves time for the pages.
        """
        held_out = self.targets.held_out
        others = (self.targets.apart, self.targets.twice)
        if not len(held_out.cameras):
            return 0.0
        some = Subset(held_out, evenly_spaced(len(held_out.cameras), _TIMED))
        began = time.monotonic()
        evaluate(self.prior, some, background=self.config.recover.background)
        seconds = time.monotonic() - began
        scored = sum(_count_pixels(targets) for targets in (held_out, *others) if targets is not None)
        return 2 * seconds * scored / _count_pixels(some)

    def _reduced(
        self,
        scene: Dense,
        count: int,
        work: Path | None,
        time_left: Callable[[], float] | None = None,
    ) -> Distilled:
        """Simplify and recover the dense scene, or one derived from it."""
        return pipeline(
            scene,
            count,
            self.targets.train,
            self.config,
            weights=self.weights,
            merging=self.views.merging,
            validation=self.targets.validation,
            work=work,
            progress=self.progress,
            time_left=time_left,
        )

    def level(
        self, finer: Dense, count: int, views: RunViews, work: Path | None = None
    ) -> tuple[Dense, Dense, float, float | None]:
        """Make a level of detail, see `g2ard.jobs.levels.LevelsJob`."""
        job = replace(self, views=replace(views, full=None))
        held_out = job.targets.held_out
        fill(held_out, self.progress)
        if self.recovers and self._fits(count):
            done = job._reduced(finer, count, work)
            lost = self.dense.opacity_lost(done.splats, held_out.cameras)
            say_gaps(lost, self.say, f"give levels more Gaussians (--ratios), here {count:,}")
            on = done.scored_on(held_out)
            level, merged = InMemory(done.splats), InMemory(done.simplified)
            return level, merged, job._score(merged, on), job._score(level, on)
        if self.recovers:
            self.say(f"{plural(count, 'Gaussian')} are too many for the memory to recover: merged only")
        cameras, config = self.views.merging or self.views.train.cameras, self.config.simplify
        small = finer.merged(count, cameras, config, gaps=True, progress=self.progress)
        say_gaps(small.report.opacity_lost, self.say)
        derived = finer.derived(small.splats, "merged")
        return derived, derived, job._score(derived, held_out), None

    def _fits(self, count: int) -> bool:
        """Return whether memory holds the recovery of a level."""
        from g2ard.jobs.cost import TRAINER_BYTES

        return self.plan is None or TRAINER_BYTES * count <= self.plan.memory

    def _score(self, scene: Dense, on: Targets) -> float:
        """Return the mean PSNR of a level in some views."""
        background = self.config.recover.background
        if isinstance(scene, InMemory):
            return evaluate(
                scene.splats, on, stage="scoring", background=background, progress=self.progress
            ).psnr
        drawn = scene.images(on.cameras, background)
        return float(np.mean([psnr(drawn[view], on[view]) for view in range(len(on.cameras))]))

    def report(self, done: Distilled, file: Path, drawn: Drawn | None = None) -> RunReport:
        """Score the simplified and the recovered scene in held-out views, and describe the run.

        Args:
            file: the written result; its scores are those of the file read back if it is packed.
            drawn: keeps the pictures that the page shows.
        """
        scenes = {"simplified": done.simplified, "recovered": done.splats}
        from_points, background = self.config.recover.from_points, self.config.recover.background
        score = partial(evaluate, background=background, progress=self.progress)

        def scored(targets: Targets) -> dict[str, Evaluation]:
            def score_one(name: str, label: str) -> Evaluation:
                watch = None if drawn is None else partial(drawn.keep, label, targets)
                return score(scenes[name], targets, stage=f"score {name}", watch=watch)

            after = score_one("recovered", RESULT)
            return {"simplified": score_one("simplified", "simplified"), "recovered": after}

        held_out, targets = done.scored_on(self.targets.held_out), self.targets
        cameras = held_out.cameras
        scores, apart = scored(held_out), None if targets.apart is None else scored(targets.apart)
        twice = None if targets.twice is None else scored(targets.twice)
        before, after = (
            [view for part in (scores, apart, twice) if part for view in part[name].views] for name in scenes
        )
        full = None if targets.full is None else scored(done.scored_on(targets.full))
        made = self.views.pool is not None and "test" in self.views.pool.splits
        config = replace(
            self.config, simplify=self.config.simplify.resolved(antialiased=self.prior.antialiased)
        )
        packed = None
        if file.name != "scene.ply":
            found = score(read_splats(file), held_out, stage="score file")
            packed = Packed(file.name, found.psnr, found.ssim)
        self.progress("gaps", 0, 0)
        return RunReport(
            input_count=self.total,
            output_count=len(done.splats),
            lifted=self.lifted,
            photos=len(self.views.train.cameras) if from_points else None,
            cleaned=self.cleaned,
            bytes={"input": self._dense_bytes, "output": done.splats.nbytes, "file": file.stat().st_size},
            scores=scores,
            apart=apart,
            size=cameras.size_text,
            own_size=None if full is None else {name: found.means for name, found in full.items()},
            kinds=summarize_by_kind(before, after, USUAL if made else "given"),
            unseen=self._unseen(done),
            warnings=self._warnings(done),
            opacity_lost=None if from_points else self.dense.opacity_lost(done.splats, cameras),
            overdraw=overdraw(done.splats, cameras, self.progress),
            against=kinds_of(targets.held_out),
            preset=self.preset,
            prior=self.measured,
            rounds=done.report.rounds,
            views=done.report.views,
            settings=listed(config),
            seconds=self._seconds(done.report.seconds.as_dict()),
            packed=packed,
            tiles=None if self.plan is None else self.plan.tiles,
            peak_rss_bytes=None if self.plan is None else peak_rss_of_all(),
        )

    @property
    def _dense_bytes(self) -> int:
        return self.prior.nbytes * self.total // len(self.prior)

    def _seconds(self, stages: dict[str, float]) -> dict[str, float]:
        """Return the seconds by stage, with the scores as the rest until now, and their total."""
        now, resumed = time.monotonic(), stages.get("resumed", 0.0)
        score = now - self.prepared + 2 * resumed - sum(stages.values())
        total = now - self.began + resumed
        return {"prepare": self.prepared - self.began, **stages, "score": score, "total": total}

    def _warnings(self, done: Distilled) -> tuple[str, ...]:
        """Return warnings about the views, and about regions of the result."""
        told = doubts_of_views(self.prior, self.views.train.cameras)
        if not self.config.recover.from_points:
            told += doubts_of_merging(self.prior, done.splats, blind=False)
        if self.views.guess is not None:
            told.append(f"warning: the up direction is a guess ({self.views.guess}); --up X,Y,Z sets it")
        return tuple(told)

    def _unseen(self, done: Distilled) -> float | None:
        """Return the share of the scene that no view sees, or None for the paper's method.

        For a generated pool it is the share of the matter, otherwise of the Gaussians in simplification's
        views.
        """
        if self.views.unseen is not None:
            return self.views.unseen
        unseen = done.report.rounds[0].simplify.unseen
        return None if unseen is None else unseen / self.total


def _count_pixels(targets: Targets) -> int:
    return int(targets.cameras.widths @ targets.cameras.heights)


Given = Splats | Points | Source | None
"""Input of a distillation; None starts from photos alone."""

_NO_PHOTOS = "no photos: the lifted points render the training images; photos, given as views, show more"

_SHOWN = 3
"""Views in pictures of a run."""

_TIMED = 8
"""Views in which scoring is timed."""

_PICTURE = 800
"""Longer side in pixels of a view in these pictures, at least, also after --size."""

_USUAL_RATIO = 10
"""Reduction for which views are chosen if the count is measured later, in these views."""


@checks_arguments
def distill(
    scene: Splats | Points | str | Path | None,
    *,
    count: int | str | None = None,
    ratio: float | None = None,
    fit: str | None = None,
    min_psnr: float | None = None,
    min_ssim: float | None = None,
    views: Views | None = None,
    photos: bool | None = None,
    held_out: Views | None = None,
    beside: str | Path | None = None,
    up: Sequence[float] | None = None,
    size: AtLeastOne | None = None,
    clean: bool = False,
    render_model: RenderModel | None = None,
    box: Sequence[float] | None = None,
    where: str | None = None,
    color: PointColor | None = None,
    format: FormatName = "ply",
    preset: str = "auto",
    time: Positive | None = None,
    steps: AtLeastOne | None = None,
    schedule: str | Schedule | None = None,
    background: Colour | None = None,
    seed: int | None = None,
    settings: Mapping[str, Any] | None = None,
    work: Path | None = None,
    progress: Progress = silent,
    say: Say = unsaid,
    **fields: Any,
) -> Distilled:
    """Distil a dense scene, or a coloured point cloud, exactly like the command `g2ard distill`.

    The scene is simplified and then recovered against photos or renders of the dense scene, in given, found
    or generated views; the simplified geometry serves as anchors. `g2ard.pipeline.distill` is the lower-level
    version for given targets and a `DistillConfig`.

    Args:
        scene: the dense scene, a coloured point cloud, or the path of either. None starts from photos alone:
            from COLMAP's sparse points, or as a fallback from points along camera rays
            (`g2ard.stages.photo_points`).
        count: Gaussians of the result, at most those of the scene. Photos alone need no budget: see
            `g2ard.jobs.start_points.usual_count`.
        ratio: reduction factor, at least 1.
        fit: largest file, such as "5MB", or a device (see `Budget`).
        min_psnr: PSNR (dB) that simplification alone must keep against the scene, in generated views.
        min_ssim: SSIM that it must keep; with `min_psnr` both hold. `say` receives the result's quality.
        views: cameras in world coordinates with or without photos, or the path of either. None uses cameras
            found beside the scene, or generates views; "made" always generates them. Every 8th view, or the
            test split of the views, is held out for scoring.
        photos: training images. True takes photos and skips views without one, False renders the scene, None
            takes the photo of each view and a render if it has none. A point cloud given with views needs
            photos; without views it is lifted, and the lift renders the training images.
        size: longer side of the views in pixels; photos only shrink to it.
        preset: settings by name: "auto" measures the scene; "trained", "lift" or "noisy" names its kind;
            "paper" is the method of the paper, see `g2ard.preset`.
        format: file format that `fit`, `min_psnr` and `min_ssim` are meant for, a name in
            `g2ard.io.scene_formats.FORMATS`.
        held_out: views to score on instead of the test split; `views` are then used for training only.
        up: (3,) direction away from the ground for generated views; None estimates it.
        clean: remove invisible and stray Gaussians first, like `g2ard clean`.
        render_model: "classic" or "antialiased": overrides what the scene's file says.
        box: of a point cloud's file, keep points between two corners (x, y, z, x, y, z).
        where: keep points for which this holds, such as "classification == 2".
        color: "intensity" or "class" to colour points by.
        beside: a path to look for cameras beside, if `scene` is not a path.
        time: seconds that the whole call may take, roughly: recovery gets what the rest leaves.
        steps: steps of the final recovery; None takes the schedule's, and more where views or points need
            them.
        schedule: fast, default, best or paper.
        background: RGB in [0, 1] behind the scene.
        seed: seed of generated views, and of the order of views in recovery.
        settings: values of `g2ard.DistillConfig` by path, such as {"recover.schedule.rates.means": 1e-3};
            they override the preset.
        work: folder for finished rounds and checkpoints; the same call resumes from it after Ctrl-C.
        progress: called by all stages.
        say: called with log messages.
        fields: other settings by field name, like the command's flags: `method="fast"`, `sh_degree=0`. None
            keeps the preset's value.

    Returns:
        The compact scene, its unrecovered version, a report, and the held-out targets.

    Raises:
        InputError: no budget or several, a budget that does not fit, a point cloud with views but no photos,
            an unreadable file, an unknown setting, or a value out of range.
        KeyboardInterrupt: after Ctrl-C; the same call resumes from `work`.

    >>> import numpy as np
    >>> ball = np.random.default_rng(0).normal(size=(900, 3))
    >>> ball /= np.linalg.norm(ball, axis=1, keepdims=True)
    >>> scene = Splats.create(ball, scales=np.full((900, 3), 0.05), logit_opacities=np.full(900, 4))
    >>> small = distill(scene, ratio=10, steps=5, size=48)
    >>> len(small.splats), len(small.simplified), len(small.report.rounds)
    (90, 90, 1)

    With views of your own and a budget in bytes:

    >>> from g2ard.scene.cameras import Camera
    >>> views = Cameras.of(
    ...     Camera.facing([3 * np.cos(a), 3 * np.sin(a), 0], [0, 0, 0], width=64, height=48, name=f"{a}")
    ...     for a in range(8)
    ... )
    >>> small = distill(scene, fit="20kB", views=views, steps=5)
    >>> 0 < small.splats.nbytes < 20_000
    True

    From files: a scene, a point cloud, and one with photos:

    >>> small = distill("scene.ply", ratio=10)  # doctest: +SKIP
    >>> small = distill("cloud.laz", ratio=10)  # doctest: +SKIP
    >>> small = distill("cloud.ply", count=100_000, views="photos/", size=1600)  # doctest: +SKIP
    """
    named = {"steps": steps, "schedule": schedule, "background": background, "seed": seed}
    changed = keywords(distill, DistillConfig(), fields | named)
    budget = None
    if scene is not None or {count, ratio, fit, min_psnr, min_ssim} != {None}:
        budget = Budget(count_of(count), ratio, fit=fit, min_psnr=min_psnr, min_ssim=min_ssim)
    options = DistillOptions(
        views=views,
        photos=photos,
        held_out=held_out,
        beside=beside,
        up=up,
        size=size,
        clean=clean,
        format=format,
        preset=preset,
        time=time,
        settings=changed | dict(settings or {}),
    )
    source = Source(scene, render_model) if isinstance(scene, str | Path) else scene
    PointChoice(box, where, color).narrow(source, progress)
    job = prepare(source, budget, options, progress=progress, say=say)
    done = job.run(work)
    if judgement := job.budget.judge(done.splats):
        say(judgement[1])
    return job.scored(done)


@contextmanager
def preparing(
    scene: Given,
    budget: Budget | None,
    options: DistillOptions,
    tiling: Tiling | None = None,
    *,
    use: Use = "distil",
    planned: bool = False,
    progress: Progress = silent,
    say: Say = unsaid,
) -> Iterator[DistillJob]:
    """Prepare a distillation of a scene in memory, or in tiles.

    Args:
        tiling: how to process the scene, a file, in tiles; None reads it into memory.
        planned: whether this is a dry run: the job has a cost, but cannot run. Views are stand-ins, and tiles
            are only planned.
    """
    callbacks: dict[str, Any] = {"progress": progress, "say": say}
    if tiling is None:
        yield prepare(scene, budget, options, use=use, planned=planned, **callbacks)
        return
    from g2ard.jobs.dense import opened

    assert isinstance(scene, Source)
    began = time.monotonic()
    if scene.kind == "splats":
        options.check_trained()
    config, source, parts = options.config, scene.drawn_as(options.render_model), None
    views = None if is_made(options.views) or options.photos is False else options.views
    if scene.kind == "points" and views is not None:
        parts = split_views(views, options.held_out, say)
        if not scene.others and is_sparse_file(scene, views):
            source = placed_source(scene, parts[0].cameras)
        source = colored_source(source, parts[0].cameras, planned=planned)
    with opened(
        source, tiling, RECOVERY_TIMES, config.simplify, config.lift, planned=planned, **callbacks
    ) as tiles:
        given = replace(tiles, views=parts)
        yield prepare(scene, budget, options, given, use=use, planned=planned, began=began, **callbacks)


def prepare(
    scene: Given,
    budget: Budget | None,
    options: DistillOptions,
    tiles: Opened | None = None,
    *,
    use: Use = "distil",
    planned: bool = False,
    began: float | None = None,
    progress: Progress = silent,
    say: Say = unsaid,
) -> DistillJob:
    """Read inputs and decide everything that a distillation needs.

    With the use `merging`, messages leave out what only recovery uses. Other arguments and errors are those
    of `distill`.

    Args:
        budget: None chooses a count for photos alone.
        tiles: the scene, if it is in tiles.
        planned: see `preparing`.
        began: when the preparation began; None means now.
    """
    began, recovers = began or time.monotonic(), use != "merging"
    recover = options.config.recover  # rejects invalid settings before anything is read
    if tiles is None and not isinstance(scene, Splats):
        progress("read", 0, 0)
    if tiles is None:
        read = _read(scene, budget, options, progress, say, planned=planned)
    else:
        read = _in_tiles(scene, options, tiles)
    if read.cloud and not read.needs_photos:
        say(_NO_PHOTOS)
    budget = budget or Budget(count=read.usual)
    dense, cleaned = read.dense, None
    if options.clean and planned:
        say("--clean: only the run finds what to remove; counts are of the whole scene")
    elif options.clean:
        dense, cleaned = without_clutter(dense, seed=recover.seed, progress=progress, say=say)
    prior, total = dense.sample, dense.total
    default_degree = 3 if read.needs_photos else None  # points have one colour each, photos show more
    degree = options.configured(sh_degree=default_degree).recover.sh_degree
    usual = max(1, total // _USUAL_RATIO)
    views = views_of(
        prior,
        options,
        usual if budget.is_measured else budget.of(total, read.name),
        given=read.views,
        represents=total / len(prior),
        beside=read.beside,
        teach=not read.needs_photos and options.photos is not True,
        use=use,
        rough=planned,
        progress=progress,
        say=say,
    )
    cameras = views.train.cameras
    reduce = Reduction(
        dense,
        cameras=cameras,
        blind=options.config.simplify.method == "paper",
        given=GivenViews(seed=recover.seed, rough=planned),
        config=options.config.simplify,
        recovered=recovers,
        plan=None if tiles is None else tiles.plan,
        progress=progress,
        say=say,
    )
    wanted = reduce.resolved(budget, read.name, f"scene.{options.format}", degree)
    photos, renders = _sources(views, options.photos, read.needs_photos)
    choice = _regularizers(options, read, prior, cameras if photos and not planned else None)
    regularizers, preset_label, measured = choice
    if photos:
        if not planned:
            given = options.named("recover.background") is not None
            propose_background(cameras, recover.background, given, say)
        if read.given:
            shown = prior
            if read.needs_photos and tiles is None:
                shown = read.dense.sample.take(np.arange(read.given))
            insisted, renders_too = options.photos is True, not read.needs_photos
            check_photos(shown, cameras, recover.background, say, insisted=insisted, renders=renders_too)
    source = plural(total, "point") if read.cloud else f"{total:,}"
    say(_task(source, wanted.count, cameras if recovers else None, photos, alone=read.from_photos))
    if not read.from_photos and wanted.count == total:
        one = "point" if read.cloud else "Gaussian"
        say(f"nothing to simplify: the scene has {plural(total, one)}")
    if recovers:
        say(Detail(f"regularisers: {preset_label}"))
    config = options.configured(regularizers, default_degree)
    if read.from_photos:
        schedule = config.recover.schedule
        asked = isinstance(options.named("recover.schedule"), Schedule)
        if not asked and options.named("recover.schedule.finest") is None:
            schedule = replace(schedule, finest=0.0)
        config = replace(config, recover=replace(config.recover, schedule=schedule, from_points=True))
    else:
        config = replace(config, recover=_grown(config.recover, dense, cameras, of_photos=not renders))
    return DistillJob(
        dense=dense,
        budget=wanted,
        views=replace(views, apart=None) if photos else views,  # photos exist only for given poses
        renders=renders,
        photos_over_renders=photos and renders,
        config=config,
        lifted=read.cloud,
        preset=preset_label,
        measured=measured,
        recovers=recovers,
        cleaned=cleaned,
        began=began,
        prepared=time.monotonic(),
        time=options.time,
        progress=progress,
        say=say,
        plan=None if tiles is None else tiles.plan,
    )


def _grown(recover: RecoverConfig, dense: Dense, cameras: Cameras, *, of_photos: bool) -> RecoverConfig:
    """Return the settings with more steps for a large scene, whose pool of views grows with it."""
    times = pool_times(dense.total)
    if recover.steps is not None or recover.recovery_time is not None or of_photos or times == 1:
        return recover
    needed = recover.final_steps(dense.sample, cameras, of_photos=of_photos)
    return replace(recover, steps=round(needed * times))


def _sources(views: RunViews, photos: bool | None, lifted: bool) -> tuple[bool, bool]:
    """Return whether photos are targets, and whether renders of the dense scene are, at least elsewhere.

    Args:
        photos: the option: True allows only photos, False only renders, None both.
        lifted: whether the scene is a lifted point cloud, which cannot be rendered for targets.
    """
    train = views.train.cameras
    pictured = [path is not None for path in (*train.image_paths, *views.test.image_paths)]
    if (lifted or photos) and not all(pictured):
        name = (*train.names, *views.test.names)[pictured.index(False)]
        scene = "a trained scene" if lifted else "leave out {photos} to render the scene there"
        raise InputError(
            f"view {name} has no photo", hint=f"give views with photos, their {{images=DIR}}, or {scene}"
        )
    use_photos = lifted or (any(pictured) if photos is None else photos)
    return use_photos, not (use_photos and all(pictured))


def _regularizers(
    options: DistillOptions, read: _Read, prior: Splats, photos: Cameras | None
) -> tuple[Regularizers, str, PriorMeasures]:
    """Choose regularisers with `choose_regularizers`, or none for points of photos.

    Args:
        photos: training views, if they have photos; only then is their consistency measured.
    """
    kind = options.named("recover.regularizers") or "auto"
    paper = options.named("recover.schedule") == "paper"
    if read.from_photos and kind == "auto" and not paper:
        return (
            FREE,
            "none; points from photos are rough, and move freely",
            measure_prior(prior),
        )
    if read.needs_photos and kind == "paper":
        kind = "paper-lift"
    return choose_regularizers(kind, prior, photos, paper=paper)


def _task(source: str, count: int, train: Cameras | None, photos: bool, *, alone: bool) -> str:
    """Describe the task in one line; `train` are the views of recovery, `alone` starts from photos."""
    counts = f"{source} → {plural(count, 'Gaussian')}"
    if train is None:
        return counts
    pictured = sum(path is not None for path in train.image_paths) if photos else 0
    against = kinds_told(pictured, len(train) - pictured)
    if alone:
        return f"{plural(pictured, 'photo')} → {plural(count, 'Gaussian')}"
    return f"{counts}; {plural(len(train), 'training view')} against {against}"


@dataclass(frozen=True, eq=False)
class _Read:
    """The dense scene as read or lifted.

    Args:
        dense: the scene.
        cloud: whether it was lifted from a point cloud.
        needs_photos: whether only photos can be its targets, as for points that go with photos.
        given: number of Gaussians, the first ones, from points that were not found in the photos.
        from_photos: whether the points, or some of them, were found in the photos, by COLMAP or here.
        usual: count of the result, if no budget is given.
        views: the views to learn from and those to score, if the points needed them, see `split_views`.
    """

    dense: Dense
    cloud: bool
    needs_photos: bool
    beside: str | Path | None
    name: str
    given: int
    from_photos: bool = False
    usual: int | None = None
    views: tuple[ViewSet, Cameras] | None = None


def _read(
    scene: Given,
    budget: Budget | None,
    options: DistillOptions,
    progress: Progress,
    say: Say,
    *,
    planned: bool = False,
) -> _Read:
    """Read the dense scene, or lift points; with photos they are topped up to the budget."""
    if isinstance(scene, Splats):
        options.check_trained()
        return _Read(InMemory(scene.narrowed()), False, False, options.beside, "scene", len(scene))
    if isinstance(scene, Source) and scene.kind == "splats":
        options.check_trained()
        splats = load_scene(scene.drawn_as(options.render_model), say)
        return _Read(InMemory(splats), False, False, options.beside or scene.path, str(scene), len(splats))
    views, recover = options.views, options.config.recover
    if views is None or is_made(views) or (options.photos is False and scene is not None):
        if scene is None:
            raise InputError("missing; without a scene, pass photos with poses as views", parameter="scene")
        cloud, name, _ = _points(scene, None, say)
        assert cloud is not None
        xyz, rgb = cloud.points.positions, cloud.points.colors
        axes = axes_of(cloud, name, say, progress)
        lifted = lift(xyz, rgb, axes=axes, **vars(options.config.lift), progress=progress)
        return _Read(InMemory(lifted), True, False, options.beside, name, len(lifted))
    parts = split_views(views, options.held_out, say)
    train = parts[0].cameras
    cloud, name, of_photos = _points(scene, views, say, train)
    points: Points | None = None
    if cloud is not None:
        own = cloud.points if planned else colored(cloud, train, name, progress=progress, say=say)
        points = distinct(own)
    given = 0 if points is None or scene is None else len(points)
    usual = None
    if budget is None:
        sparse = 0 if points is None else len(points)
        usual = usual_count(train, options.size, sparse, say)
    wanted = usual or (budget and budget.count) or 0
    if points is None and budget is not None and not wanted:
        raise InputError(
            "needs sparse points, and there are none",
            parameter=budget.kind,
            path=str(views),
            hint="give {count=COUNT}",
        )
    if points is None or scene is None or len(points) < wanted:
        of_photos = True
        if planned:
            points = rough_points(points, train, wanted)
        else:
            points = topped_up(
                points,
                train,
                wanted,
                background=recover.background,
                seed=recover.seed,
                progress=progress,
                say=say,
            )
    # Each point has its disc, for as many are needed, also where positions are equal about another middle.
    config = options.config.lift
    lifted, _ = lift_rows(points.positions, points.colors, config, progress, merge=False)
    lifted = in_axes(lifted, (cloud and cloud.axes) or "RDF")
    return _Read(InMemory(lifted), True, True, options.beside, name, given, of_photos, usual, parts)


def _in_tiles(scene: Given, options: DistillOptions, tiles: Opened) -> _Read:
    """Describe a scene in tiles, or the lift of a point cloud."""
    assert isinstance(scene, Source)
    cloud, given = scene.kind == "points", len(tiles.dense.sample)
    beside = options.beside or (None if cloud else scene.path)
    of_photos = tiles.views is not None
    return _Read(tiles.dense, cloud, of_photos, beside, str(scene), given, views=tiles.views)


def _points(
    scene: Points | Source | None, views: Views | None, say: Say, train: Cameras | None = None
) -> tuple[Cloud | None, str, bool]:
    """Return a cloud, or that stored with the views, its name in errors, and whether it was found in photos.

    With views, the cloud may be without colours, and points found in photos are those of training views.
    """
    if isinstance(scene, Points):
        return Cloud(scene, (), np.any(scene.colors, axis=1)), "cloud", False
    sparse = None if views is None else sparse_file(views)
    if scene is None:
        return sparse_points(sparse, say, train), "cloud" if sparse is None else str(sparse), True
    of_photos = views is not None and is_sparse_file(scene, views)
    if sparse is not None and of_photos and train is not None:
        chosen = Source(sparse)
        chosen.through = scene.through
        cloud = placed_source(chosen, train).cloud(bare=True).whole()
    else:
        cloud = scene.cloud(bare=views is not None).whole()
    for note in cloud.notes:
        say(f"{scene}: {note}")
    return cloud, str(scene), of_photos
