"""`g2ard.recover`: views, targets and regularisers of a recovery, its scores; targets of other commands."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import Any

from numpy.typing import ArrayLike

from g2ard.arrays import Values
from g2ard.config.checks import AtLeastOne, checks_arguments
from g2ard.config.choices import Colour, RenderModel
from g2ard.config.schema import changed, full_paths, keywords
from g2ard.errors import InputError
from g2ard.jobs.cost import Cost, cost_of_recovery
from g2ard.jobs.inputs import GivenViews, Scene, Views, load_scene
from g2ard.jobs.run_views import find_or_plan_views
from g2ard.jobs.teaching import RunTargets, Teaching, check_teacher, read_views
from g2ard.pipeline.presets import PRESETS, configure
from g2ard.progress import Detail, Progress, Say, plural, silent, unsaid
from g2ard.rendering.targets import RENDERS, Exposed, Targets, checked_targets, fill, kinds_of
from g2ard.report.run import KindScore, summarize_by_kind
from g2ard.scene.cameras import USUAL
from g2ard.scene.splats import Splats
from g2ard.stages.evaluate import evaluate
from g2ard.stages.recover.anchors import Anchors, PriorMeasures, choose_regularizers
from g2ard.stages.recover.config import RecoverConfig, Schedule
from g2ard.stages.recover.optimize import Recovered, Watch
from g2ard.stages.recover.optimize import recover as optimize


@dataclass(frozen=True, eq=False)
class RecoverJob:
    """A prepared recovery: inputs are read and everything is decided.

    Args:
        teacher: the dense scene; None if all targets are photos.
        weights: sampling weight of each view; None draws all equally often.
        anchors: the student before any recovery, or None.
        preset: the regularisers chosen, and why.
    """

    student: Splats
    teacher: Splats | None
    targets: RunTargets
    config: RecoverConfig
    weights: Values | None
    anchors: Splats | None
    preset: str
    measures: PriorMeasures
    progress: Progress = silent

    def run(self, checkpoint: Path | None = None, watch: Watch | None = None) -> Recovered:
        """Recover the student; see `g2ard.recover`."""
        built = self.anchors
        in_plane = self.config.regularizers.in_plane
        train = self.targets.train
        if not self._same:
            for targets in filter(None, (train, self.targets.validation)):
                fill(targets, self.progress)
        return optimize(
            self.student,
            train,
            self.config,
            weights=self.weights,
            anchors=None if built is None else Anchors.of(built, in_plane),
            validation=self.targets.validation,
            checkpoint=checkpoint,
            progress=self.progress,
            watch=watch,
            skip_same=True,
        )

    @property
    def _same(self) -> bool:
        """Whether the student is the teacher, so that nothing is to be learned."""
        return self.teacher is not None and self.teacher.fingerprint() == self.student.fingerprint()

    @property
    def cost(self) -> Cost:
        """Rough memory."""
        steps: int | None = self.config.horizon if self.config.recovery_time is None else None
        views = self.targets.views
        used = [views.train.cameras, *views.untrained]
        return cost_of_recovery(self.student, used, 0 if self._same else steps, self.teacher)

    @property
    def held_out(self) -> Targets | None:
        """Held-out targets for scoring; None without such views."""
        return self.targets.held_out if len(self.targets.views.test) else None

    def score(self, result: Recovered) -> tuple[KindScore, ...]:
        """Score student and result in held-out views, by kind of view; empty without such views."""
        if self.held_out is None:
            return ()
        held_out = Exposed(self.held_out) if result.report.exposure else self.held_out
        score = partial(evaluate, background=self.config.background, progress=self.progress)
        before = score(self.student, held_out, stage="score simplified")
        after = score(result.splats, held_out, stage="score recovered")
        given = set(held_out.cameras.kinds) == {USUAL}
        return summarize_by_kind(before.views, after.views, "given" if given else USUAL)


@checks_arguments
def recover(
    student: Scene,
    targets: Targets | None = None,
    config: RecoverConfig | None = None,
    *,
    views: Views | None = None,
    teacher: Scene | None = None,
    photos: bool = False,
    preset: str = "auto",
    steps: AtLeastOne | None = None,
    schedule: str | Schedule | None = None,
    background: Colour | None = None,
    seed: int | None = None,
    settings: Mapping[str, Any] | None = None,
    split: str = "train",
    size: int | None = None,
    weighted: bool | None = None,
    render_model: RenderModel | None = None,
    weights: ArrayLike | None = None,
    anchors: Anchors | Scene | None = None,
    validation: Targets | None = None,
    frozen: Values | None = None,
    checkpoint: Path | None = None,
    progress: Progress = silent,
    say: Say = unsaid,
    watch: Watch | None = None,
    **fields: Any,
) -> Recovered:
    """Optimise every attribute of a fixed set of Gaussians against photos or a teacher's renders.

    With `views` or a `teacher`, targets and regularisers are decided exactly as by the command `g2ard
    recover`. With `targets` and a `config`, nothing is decided. No Gaussian is added or removed, and a
    student that only gets worse is returned unchanged; see `g2ard.stages.recover.optimize.recover`.

    Args:
        student: the scene to recover, or its path; cameras are in world coordinates, including its offset.
        targets: photos or teacher renders with their cameras, instead of `views` and `teacher`.
        config: options, with `targets`; None means the defaults.
        views: cameras with photos, or their path. With a teacher, None uses cameras found beside it, or
            generates views; "made" always generates them. Generated views include those of other kinds, as in
            `distill`, and more views get more steps.
        teacher: the dense scene that renders the targets, or its path; None takes the photos of the views.
        photos: with a teacher, use photos where views have them; also accept photos that show nothing of the
            student.
        preset: settings by name, without `targets`; see `g2ard.preset`.
        steps: steps to take; None takes the schedule's, and more where views or points need them.
        schedule: fast, default, best or paper. It, `steps`, `background` and `seed` override everything else.
        background: RGB in [0, 1] behind the scene.
        seed: seed of generated views, and of the order of views.
        settings: values of `RecoverConfig` by path, without `targets`, such as
            {"recover.schedule.rates.means": 1e-3}; they override the preset.
        split: split of the views to train on.
        size: longer side of the views in pixels; photos only shrink to it.
        weighted: draw views by the weights that they state; None asks the preset.
        render_model: overrides what the scenes' files say.
        weights: (C,) sampling weight of each view of `targets`; None draws all equally often.
        anchors: the student before any recovery, if it was recovered before, or its frozen geometry; None
            takes the student's own.
        validation: with `targets`: views of other kinds that are not trained on. If a kind loses quality,
            changes are scaled back per Gaussian, and a recovery that only harms a kind ends early.
        frozen: with `targets`: (N,) bool, Gaussians that stay unchanged; requires the engine `fused`.
        checkpoint: a file written every minute and at Ctrl-C. If it exists, recovery resumes from it, with a
            bitwise equal result.
        progress: called after every step with loss, PSNR of a few training views and steps/s.
        say: called with log messages.
        watch: called after every step; its time does not count.
        fields: other settings by field name, like the command's flags: `tolerance=0.1`, `sh_degree=0`. They
            override everything else; None keeps the other value.

    Returns:
        The recovered scene, its Gaussians in the student's order, and a report.

    Raises:
        InputError: no Gaussians, no views or targets, an argument that goes with the other kind of targets,
            an unknown setting, or a checkpoint of another run.
        KeyboardInterrupt: after Ctrl-C, when the checkpoint is written.

    >>> import g2ard
    >>> import numpy as np
    >>> rng = np.random.default_rng(0)
    >>> means, sh0 = rng.normal(size=(500, 3)), rng.normal(size=(500, 1, 3))
    >>> scene = Splats.create(means, scales=np.full((500, 3), 0.1), sh0=sh0)
    >>> small = g2ard.simplify(scene, ratio=5).splats
    >>> views = g2ard.make_pool(scene, 8, size=(64, 48))
    >>> better = g2ard.recover(small, views=views, teacher=scene, steps=30)
    >>> len(better.splats), better.report.psnr.after > better.report.psnr.before
    (100, True)
    """
    given = {"steps": steps, "schedule": schedule, "background": background, "seed": seed}
    named = keywords(recover, RecoverConfig(), fields | given)
    if targets is None:
        _refuse("targets", config=config, weights=weights, validation=validation, frozen=frozen)
        if isinstance(anchors, Anchors):
            raise InputError("expected the student before any recovery", parameter="anchors")
        job = prepare(
            student,
            views=views,
            teacher=teacher,
            photos=photos,
            preset=preset,
            settings=named | dict(settings or {}),
            split=split,
            size=size,
            weighted=weighted,
            render_model=render_model,
            anchors=anchors,
            progress=progress,
            say=say,
        )
        return job.run(checkpoint, watch)
    decided = {"preset": None if preset == "auto" else preset, "photos": photos or None}
    _refuse(
        "views or a teacher", views=views, teacher=teacher, settings=settings, size=size, **decided
    )
    targets = checked_targets(targets)
    if validation is not None:
        validation = checked_targets(validation, "validation")
    config = config or RecoverConfig()
    config = changed(config, full_paths(named, config))
    start = load_scene(student, say, render_model).narrowed()
    if not isinstance(anchors, Anchors | None):
        anchors = Anchors.of(
            _load_anchors(anchors, start, render_model, say), config.regularizers.in_plane
        )
    return optimize(
        start,
        targets,
        config,
        weights=weights,
        anchors=anchors,
        validation=validation,
        frozen=frozen,
        checkpoint=checkpoint,
        progress=progress,
        watch=watch,
    )


def _refuse(needed: str, **given: object) -> None:
    """Reject arguments that need another source of targets."""
    name = next((name for name, value in given.items() if value is not None), None)
    if name is not None:
        raise InputError(f"goes with {needed}", parameter=name)


def prepare(
    student: Scene,
    *,
    views: Views | None = None,
    teacher: Scene | None = None,
    photos: bool = False,
    preset: str = "auto",
    settings: Mapping[str, Any] | None = None,
    split: str = "train",
    size: int | None = None,
    weighted: bool | None = None,
    render_model: RenderModel | None = None,
    anchors: Scene | None = None,
    rough: bool = False,
    progress: Progress = silent,
    say: Say = unsaid,
) -> RecoverJob:
    """Read the inputs of `recover` without `targets`, and decide everything.

    A `rough` job has a cost, but cannot run.
    """
    check_teacher(views, teacher)
    given = full_paths(settings or {}, RecoverConfig())
    config = configure(RecoverConfig(), preset, given)
    named = {**PRESETS[preset], **given}
    start = load_scene(student, say, render_model).narrowed()
    dense = None if teacher is None else load_scene(teacher, say, render_model)
    teaching = Teaching.by(
        dense,
        config.background,
        chosen="recover.background" in given,
        insisted=photos,
        rough=rough,
        say=say,
    )
    if dense is not None:
        beside = None if isinstance(teacher, Splats) else teacher
        asked = GivenViews(views, beside, seed=config.seed, rough=rough, progress=progress, say=say)
        views = find_or_plan_views(dense, asked, student=start)
    assert views is not None  # `check_teacher`
    read = read_views(teaching, start, views, split, size)
    if not config.schedule.guarded:
        read = replace(read, validation=None)
    targets = RunTargets.of(teaching, read)
    chosen = read.train
    of_split = "training view" if split == "train" else f"{split} view"
    say(f"{plural(len(chosen.cameras), of_split)} against {kinds_of(targets.train)}")
    weighted = named.get("select.weighted", True) if weighted is None else weighted
    weights = chosen.weights if weighted else None
    if weights is not None:
        say(f"sampling {plural(len(weights), 'view')} by weight")
    built = None if anchors is None else _load_anchors(anchors, start, render_model, say)
    regularizers, why, measures = choose_regularizers(
        named.get("recover.regularizers"),
        dense or built or start,
        None if dense or rough else chosen.cameras,
        paper=named.get("recover.schedule") == "paper",
    )
    config = configure(RecoverConfig(), preset, {**given, "recover.regularizers": regularizers})
    if config.recovery_time is None:
        of_photos = kinds_of(targets.train) != RENDERS
        config = replace(
            config, steps=config.final_steps(start, chosen.cameras, of_photos=of_photos)
        )
    of_student = "" if dense else "; measured on the student, as there is no teacher"
    say(Detail(f"regularisers: {why}{of_student}"))
    return RecoverJob(start, dense, targets, config, weights, built, why, measures, progress)


def _load_anchors(
    anchors: Scene, student: Splats, render_model: RenderModel | None, say: Say
) -> Splats:
    """Return the student as it was built, in its present coordinates."""
    scene = load_scene(anchors, say, render_model)
    if len(scene) != len(student):
        raise InputError(
            f"has {plural(len(scene), 'Gaussian')}, the student has {len(student):,}",
            path=None if isinstance(anchors, Splats) else anchors,
            parameter="anchors" if isinstance(anchors, Splats) else None,
            hint="anchors are the student before any recovery",
        )
    return scene.narrowed(student.offset)
