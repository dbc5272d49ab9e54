"""`g2ard.distill`: what a scene, its views and a few options come to, and the pipeline on it."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal

from g2ard.choices import Engine
from g2ard.errors import InputError
from g2ard.policy.budget import Budget
from g2ard.policy.inputs import load_scene
from g2ard.policy.job import DistillJob
from g2ard.policy.views import is_made, views_of
from g2ard.progress import Progress, Say, plural, silent, unsaid
from g2ard.splats import Splats

if TYPE_CHECKING:
    from g2ard.io.types import Points
    from g2ard.pipeline import Distilled
    from g2ard.policy.inputs import Views
    from g2ard.stages.lift import LiftConfig

    Scene = Splats | Points | str | Path | None
    Colour = tuple[float, float, float]

__all__ = ["distill", "prepare"]

_DEFAULT: dict[str, Any] = {
    "method": "default",
    "schedule": "default",
    "policy": "auto",
    "views_count": None,
    "weighted": True,
}
_PAPER: dict[str, Any] = {
    "method": "paper",
    "schedule": "paper",
    "policy": "directional",
    "views_count": 0.5,
    "weighted": False,
}
"""What an option that is not given means, under the paper's presets and else."""


def distill(
    scene: Scene,
    *,
    count: int | None = None,
    ratio: float | None = None,
    fit: str | None = None,
    min_psnr: float | None = None,
    min_ssim: float | None = None,
    format: str = "ply",
    clean: bool = False,
    views: Views | None = None,
    photos: bool | None = None,
    held_out: Views | None = None,
    views_count: int | float | Literal["auto"] | None = None,
    policy: str | None = None,
    weighted: bool | None = None,
    reselect: bool = False,
    method: str | None = None,
    preset: str = "auto",
    schedule: str | None = None,
    steps: int | None = None,
    recovery_time: float | None = None,
    sh_degree: int | None = None,
    size: int | None = None,
    background: Colour = (0.0, 0.0, 0.0),
    constants: Mapping[str, Any] | None = None,
    beside: str | Path | None = None,
    up: Sequence[float] | None = None,
    seed: int = 0,
    engine: Engine = "fused",
    work: Path | None = None,
    progress: Progress = silent,
    say: Say = unsaid,
) -> Distilled:
    """Distil a dense scene, or a coloured cloud with photos, as `g2ard distill` does, to the bit.

    Views are chosen or made, the scene is simplified, its geometry frozen as anchors, and what is left is
    recovered against the views' photos or the dense scene's own renders. `g2ard.pipeline.distill` is the same
    for a caller who has targets and a `DistillConfig` of their own.

    Args:
        scene: the dense scene, a coloured cloud, or the path of either; None where `views` hold photos and
            there is nothing else: the start is then COLMAP's sparse points, else points within the cameras'
            sight (`g2ard.policy.photos`).
        count: Gaussians of the result, at most as many as there are.
        ratio: how many times fewer there are to be, at least 1.
        fit: instead, about the most whose file has these bytes at most, such as "5MB"; or a device: quest3,
            mobile or web.
        min_psnr: instead, about the fewest that simplification alone keeps this PSNR with, dB, against the
            scene in views of its own.
        min_ssim: the same of SSIM; with `min_psnr` both hold. `say` tells what the result has.
        format: of the file that `fit` speaks of: ply, compressed.ply, sog, spz, glb or splat.
        clean: first take out what no picture of the scene needs (`g2ard.clean`).
        views: cameras in world coordinates, or where they lie; None takes those beside the scene, else makes
            a pool of poses; "made" always makes one. Their test split is held out.
        photos: True for the views' photos as targets, and no view without one; False for the scene's renders;
            None for the photo of each view that has one, and the scene's render of the others (sec. 3.1). A
            cloud has no renders to learn from: its lift is no picture of the place.
        held_out: views to score on instead.
        views_count: how many views recovery looks at: a count, a share in (0, 1] or "auto"; None for all, or
            for what the preset says.
        policy: how those are chosen, see `g2ard.select`; "auto" if None.
        weighted: draw views by weights, their own or the selection's; True if None.
        reselect: choose views again from every round's scene.
        method: of simplification: default, fast or paper; "default" if None.
        preset: which regularisers hold the geometry: auto (measured), trained, lift, noisy; paper,
            paper-trained, paper-lift and paper-noisy are the paper's, and turn all that is None here to
            what the paper has.
        schedule: of recovery: fast, default, best or paper; "default" if None.
        steps: the final horizon.
        recovery_time: seconds that all recovery is fitted into; the result then depends on the machine.
        sh_degree: of the result; None keeps the scene's, and takes 3 from a cloud or for the paper's.
        size: pixels that the longer side of views is shrunk to.
        background: RGB in [0, 1] behind the scene.
        constants: by full name, as `--set` has them, such as {"rates.means": 1e-3}.
        beside: where to look for cameras, if `scene` is no path.
        up: (3,) away from the ground, for poses that are made; None to estimate it.
        seed: of all that is random.
        engine: what takes recovery's steps, see `RecoverConfig`.
        work: a folder for finished rounds and checkpoints; the same call goes on there after a Ctrl-C.
        progress: told of all stages.
        say: told in lines what was noticed and decided.

    Returns:
        The compact scene, the same before recovery, a report, and the targets that were held out.

    Raises:
        InputError: not exactly one kind of budget, one that does not fit, a cloud without views,
            files that cannot be read, or a value out of its range.
        KeyboardInterrupt: after Ctrl-C; what is in `work` can be gone on from.

    >>> import numpy as np
    >>> ball = np.random.default_rng(0).normal(size=(900, 3))
    >>> ball /= np.linalg.norm(ball, axis=1, keepdims=True)
    >>> scene = Splats.create(ball, scales=np.full((900, 3), 0.05), logit_opacities=np.full(900, 4))
    >>> small = distill(scene, ratio=10, steps=5, size=48)
    >>> len(small.splats), len(small.simplified), len(small.report.rounds)
    (90, 90, 1)
    """
    job = prepare(
        scene,
        [Budget(count, ratio, fit=fit, min_psnr=min_psnr, min_ssim=min_ssim)],
        format=format,
        clean=clean,
        views=views,
        photos=photos,
        held_out=held_out,
        views_count=views_count,
        policy=policy,
        weighted=weighted,
        reselect=reselect,
        method=method,
        preset=preset,
        schedule=schedule,
        steps=steps,
        recovery_time=recovery_time,
        sh_degree=sh_degree,
        size=size,
        background=background,
        constants=constants,
        beside=beside,
        up=up,
        seed=seed,
        engine=engine,
        progress=progress,
        say=say,
    )
    done = job.run(work=work)
    if judgement := job.aims[0].judge(done.splats):
        say(judgement[1])
    return done


def prepare(
    scene: Scene,
    budgets: Sequence[Budget],
    *,
    format: str = "ply",
    clean: bool = False,
    views: Views | None = None,
    photos: bool | None = None,
    held_out: Views | None = None,
    views_count: int | float | Literal["auto"] | None = None,
    policy: str | None = None,
    weighted: bool | None = None,
    reselect: bool = False,
    method: str | None = None,
    preset: str = "auto",
    schedule: str | None = None,
    steps: int | None = None,
    recovery_time: float | None = None,
    sh_degree: int | None = None,
    size: int | None = None,
    background: Colour = (0.0, 0.0, 0.0),
    constants: Mapping[str, Any] | None = None,
    beside: str | Path | None = None,
    up: Sequence[float] | None = None,
    seed: int = 0,
    engine: Engine = "fused",
    counted: Callable[[int], object] | None = None,
    progress: Progress = silent,
    say: Say = unsaid,
) -> DistillJob:
    """Read and decide all that a distillation needs, at one budget or several; arguments as for `distill`.

    `counted` is told how many Gaussians the dense scene has before anything else is done with it; what it
    raises ends the preparation.

    Raises:
        InputError: as `distill`.
    """
    from g2ard.constants import changed, full_names
    from g2ard.pipeline import DistillConfig
    from g2ard.policy.clean import clutter_seen
    from g2ard.policy.fit import aim_of
    from g2ard.stages.lift import LiftConfig
    from g2ard.stages.recover.presets import preset_for
    from g2ard.stages.recover.schedule import schedule_named
    from g2ard.targets import kinds_told

    usual = _PAPER if preset.startswith("paper") else _DEFAULT
    schedule, method = schedule or usual["schedule"], method or usual["method"]
    weighted = usual["weighted"] if weighted is None else weighted
    paper = schedule == "paper"
    values = full_names(constants or {}, {"recover": DistillConfig(), "lift": LiftConfig()})
    lifting = changed(LiftConfig(), "lift", values)
    if scene is None:
        if views is None or is_made(views):
            raise InputError("scene: without one, photos with poses are needed as views")
        from g2ard.policy.photos import points_of_photos

        wanted = max((budget.count for budget in budgets if budget.count is not None), default=None)
        scene = points_of_photos(
            views, held_out, wanted, background=background, seed=seed, progress=progress, say=say
        )
    prior, lifted, beside, name = _prior(scene, beside, lifting, progress, say)
    if lifted and (views is None or is_made(views)):
        raise InputError(f"{name}: a cloud is no teacher: its photos are needed as views")
    cleaned = None
    if clean:
        found, _ = clutter_seen(prior, seed=seed, progress=progress, say=say)
        prior, cleaned = prior.take(found.keep), found.counts
    if counted is not None:
        counted(len(prior))
    file = f"scene.{format}"
    aims = tuple(
        aim_of(budget, prior, name, file=file, seed=seed, progress=progress, say=say) for budget in budgets
    )
    looks = views_of(
        prior,
        views,
        held_out,
        beside=beside,
        size=size,
        up=up,
        seed=seed,
        teach=not lifted and photos is not True,
        progress=progress,
        say=say,
    )
    train = looks.train.cameras
    pictured = [path is not None for path in (*train.image_paths, *looks.test.image_paths)]
    use_photos = lifted or (any(pictured) if photos is None else photos)
    taught = not (lifted or photos or (use_photos and all(pictured)))
    if (lifted or photos) and not all(pictured):
        bare = (*train.names, *looks.test.names)[pictured.index(False)]
        instead = (
            "give views with photos, or a trained scene" if lifted else "photos=None takes renders there"
        )
        raise InputError(f"view {bare} has no photo; {instead}")
    kind = "paper-lift" if lifted and preset == "paper" else preset
    regularizers, why, measured = preset_for(kind, prior, train if use_photos else None, paper=paper)
    counts = ", ".join([*(f"{aim.count:,}" for aim in aims[:-1]), plural(aims[-1].count, "Gaussian")])
    shown = len(train) if not taught else sum(pictured[: len(train)]) if use_photos else 0
    against = kinds_told(shown, len(train) - shown)
    say(f"{len(prior):,} → {counts}; {plural(len(train), 'view')} against {against}")
    say(f"regularisers: {why}")
    config = DistillConfig(
        method=method,
        schedule=schedule_named(schedule, steps),
        steps=steps,
        recovery_time=recovery_time,
        regularizers=regularizers,
        sh_degree=3 if sh_degree is None and (lifted or paper or usual is _PAPER) else sh_degree,
        background=background,
        views=usual["views_count"] if views_count is None else views_count,
        policy=policy or usual["policy"],
        weighted=weighted,
        reselect=reselect,
        seed=seed,
        engine=engine,
    )
    return DistillJob(
        prior=prior,
        aims=aims,
        views=replace(looks, apart=None) if use_photos else looks,  # photos are only where they were taken
        teacher=prior if taught else None,
        photos=use_photos and taught,
        config=changed(config, "recover", values),
        weights=looks.train.weights if weighted else None,
        lifting=lifting if lifted else None,
        preset=why,
        measured=measured,
        cleaned=cleaned,
        progress=progress,
        say=say,
    )


def _prior(
    scene: Splats | Points | str | Path,
    beside: str | Path | None,
    lifting: LiftConfig,
    progress: Progress,
    say: Say,
) -> tuple[Splats, bool, str | Path | None, str]:
    """The dense scene, whether it is a lift, where cameras may lie beside it, and what errors call it."""
    from g2ard.io import kind, read_cloud
    from g2ard.stages.lift import lift

    if isinstance(scene, Splats):
        return scene, False, beside, "scene"
    name = "cloud"
    if isinstance(scene, str | Path):
        if kind(scene) == "splats":
            return load_scene(scene, say), False, beside or scene, str(scene)
        name, cloud = str(scene), read_cloud(scene)
        for note in cloud.notes:
            say(f"{scene}: {note}")
        scene = cloud.points
    lifted = lift(scene.positions, scene.colors, **vars(lifting), progress=progress)
    return lifted, True, beside, name
