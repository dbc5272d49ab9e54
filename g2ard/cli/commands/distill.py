"""`g2ard distill`: everything, from a dense scene or cloud to a compact one with its figures and pictures."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from g2ard.cli.frame import Run, command
from g2ard.cli.options import (
    BackgroundOption,
    Count,
    CountOption,
    CropOption,
    Method,
    PolicyOption,
    PresetOption,
    RatioOption,
    ResumeOption,
    ScheduleName,
    SizeOption,
    TimeLimitOption,
    UpOption,
    ViewsOrMadeOption,
    budget_of,
    can_judge,
    is_made,
    one_budget,
    one_horizon,
    views_count,
)
from g2ard.cli.resume import check_stopped, left_at
from g2ard.cli.run_result import say_views, told, write_table
from g2ard.cli.run_views import views_of
from g2ard.cli.scenes import (
    load_scene,
    make_targets,
    recovery_engine,
)

if TYPE_CHECKING:
    from g2ard.cameras import Cameras
    from g2ard.pipeline import Distilled
    from g2ard.splats import Splats
    from g2ard.stages.lift import LiftConfig
    from g2ard.targets import Targets

    Colour = tuple[float, float, float]

_WORK = ".unfinished"
"""In the folder of the run: finished rounds and checkpoints. Nobody else has a folder of this name."""
_KEPT = Path("simplified", "scene.ply")
"""In the folder of the run, with --keep: the anchors of the last recovery, for `evaluate --anchors`."""


@command("distill", example="g2ard distill scene.ply -r 10 -o run/", cuda=True, constants=True)
def distill(
    run: Run,
    scene: Annotated[
        Path, typer.Argument(metavar="SCENE|CLOUD", help="A trained scene, or a coloured cloud.")
    ],
    output: Annotated[Path, typer.Option("-o", "--output", metavar="RUN", help="Folder of the run.")],
    count: CountOption = None,
    ratio: RatioOption = None,
    views: ViewsOrMadeOption = None,
    photos: Annotated[
        bool | None,
        typer.Option(
            "--photos/--renders",
            help="Targets: the views' photos, or the scene's renders; photos if there are.",
        ),
    ] = None,
    held_out: Annotated[
        Path | None,
        typer.Option(
            metavar="VIEWS",
            help="Score on these; --views is then for recovery, but for what it holds out itself.",
        ),
    ] = None,
    k: Annotated[
        Count | None,
        typer.Option(
            "-k",
            "--views-count",
            parser=views_count,
            metavar="K",
            help="Views that recovery looks at: 100, 25% or auto; all if not given.",
        ),
    ] = None,
    policy: PolicyOption = "auto",
    weighted: Annotated[
        bool,
        typer.Option("--weights/--no-weights", help="Draw views by weight: their own, or the selection's."),
    ] = True,
    reselect: Annotated[
        bool,
        typer.Option("--reselect", help="Choose views again from every round's scene, not just the first."),
    ] = False,
    method: Annotated[Method, typer.Option(help="How to simplify.")] = "default",
    preset: PresetOption = "auto",
    schedule: Annotated[
        ScheduleName, typer.Option(help="Recovery; paper also goes round by round.")
    ] = "default",
    steps: Annotated[int | None, typer.Option(min=1, help="Overrides the final horizon.")] = None,
    time_limit: TimeLimitOption = None,
    sh_degree: Annotated[
        int | None,
        typer.Option("--sh-degree", min=0, max=3, help="Of the result; the scene's own, 3 from a cloud."),
    ] = None,
    keep: Annotated[
        bool,
        typer.Option(
            "--keep", help="Keep the simplified scene too, in RUN/simplified: it takes as many bytes again."
        ),
    ] = False,
    resume: ResumeOption = False,
    crop: CropOption = None,
    size: SizeOption = None,
    background: BackgroundOption = None,
    up: UpOption = None,
) -> None:
    """Distil a dense scene, or a coloured cloud with photos, into a compact one at an exact budget.

    Views are those of --views, else the cameras that lie beside the scene, else a pool of poses of its own.
    """
    one_budget(count, ratio)
    can_judge(k, policy)
    if is_made(str(held_out)):
        raise typer.BadParameter("--held-out: a file of views; those that are made hold out every 8th anyway")
    given = views is not None and not is_made(views)
    run.spare_inputs(output / "scene.ply", output / _KEPT, *([output / "views.json"] if not given else []))
    import shutil
    import time

    from g2ard.constants import changed, listed
    from g2ard.io import kind, write_views
    from g2ard.io.atomic import check_output
    from g2ard.pipeline import DistillConfig
    from g2ard.pipeline import distill as pipeline
    from g2ard.report.distilled import check_crops, distill_report
    from g2ard.stages.lift import LiftConfig
    from g2ard.stages.recover.presets import preset_for
    from g2ard.stages.recover.schedule import schedule_named

    began = time.monotonic()
    values = run.constants(recover=DistillConfig(), lift=LiftConfig())
    one_horizon(steps, time_limit, values)
    engine = recovery_engine(run)
    lifted = kind(scene) != "splats"
    if lifted and not given:
        raise typer.BadParameter("a cloud is no teacher: give its photos with --views")
    if photos and is_made(views):
        raise typer.BadParameter("--photos: views that are made have none")
    if not left_at(output / _WORK):
        check_output(output, run.overwrite, folder=True)
    check_stopped(run, output / _WORK, resume)
    lifting = changed(LiftConfig(), "lift", values)
    prior = _lift(run, scene, lifting) if lifted else load_scene(run, scene)
    budget = budget_of(scene, count, ratio, len(prior))
    looks = views_of(run, scene, prior, views, held_out, size, up, teach=not lifted and photos is not True)
    train, test = looks.train.cameras, looks.test
    check_crops(crop or [], test.names)
    pictured = all(p is not None for p in (*train.image_paths, *test.image_paths))
    use_photos = lifted or (pictured if photos is None else photos)
    teacher, against = (None, "photos") if use_photos else (prior, "teacher renders")
    colour = background or (0.0, 0.0, 0.0)
    kind_of = "paper-lift" if lifted and preset == "paper" else preset
    regularizers, why, measured = preset_for(
        kind_of, prior, train if use_photos else None, paper=schedule == "paper"
    )
    run.say(f"{len(prior):,} → {budget:,} Gaussians; {len(train)} views against {against}")
    run.say(f"regularisers: {why}")
    config = DistillConfig(
        method=method,
        schedule=schedule_named(schedule, steps),
        steps=steps,
        time_limit=time_limit,
        regularizers=regularizers,
        sh_degree=sh_degree if sh_degree is not None else (3 if lifted or schedule == "paper" else None),
        background=colour,
        views=k.of(len(train)) if isinstance(k, Count) else "auto" if k else None,
        policy=policy,
        weighted=weighted,
        reselect=reselect,
        seed=run.seed,
        engine=engine,
    )
    config = changed(config, "recover", values)
    used: dict[str, Any] = {"recover": replace(config, simplify=config.simplify.resolved(method))}
    used |= {"lift": lifting} if lifted else {}
    targets = make_targets(run, train, teacher, colour, lazy=k is not None)
    unseen = make_targets(run, test, teacher, colour)
    validation, apart = _apart_targets(run, looks.apart, teacher, colour)
    with _work_folder(run, output, resume) as work:
        result = pipeline(
            prior,
            budget,
            targets,
            config,
            weights=looks.train.weights if weighted else None,
            validation=validation,
            work=work,
            progress=run.progress,
        )
        report = _score(run, prior, result, {"scores": unseen, "apart": apart}, colour)
        report["unseen"] = looks.unseen if looks.unseen is not None else _unseen(result, len(prior))
        report |= {"against": against, "preset": why, "prior": measured.as_dict()}
        report |= {key: result.report[key] for key in ("rounds", "views")}
        report["constants"] = listed(used, run.config)
        report["seconds"] = {**result.report["seconds"], "total": time.monotonic() - began}
        distill_report(
            output / "report.html",
            f"{scene.name}: {len(prior):,} → {budget:,}",
            [("simplified", result.simplified), ("recovered", result.splats)],
            unseen,
            report,
            colour,
            told=told(report),
            crops=crop or [],
        )
        _write(run, output, result, unseen, colour, report)
        _keep(output / _KEPT, result.simplified if keep else None)
    if looks.pool is not None:
        write_views(output / "views.json", looks.pool.cameras, splits=looks.pool.splits, overwrite=True)
    shutil.rmtree(output / _WORK)
    write_table(run, report)
    for line in told(report):
        run.say(line)
    say_views(run, report["views"], k is not None)
    run.say(
        f"scene: {output / 'scene.ply'}\npicture: {output / 'preview.png'}\n"
        f"report: {output / 'report.html'}, {output / 'report.json'}"
    )
    run.result(report)


@contextmanager
def _work_folder(run: Run, output: Path, resume: bool) -> Iterator[Path]:
    """Where finished rounds and checkpoints wait for --resume; an error leaves nothing behind, nor does a
    Ctrl-C before the first of them."""
    import shutil

    work, made = output / _WORK, not output.exists()
    if not resume:
        shutil.rmtree(work, ignore_errors=True)
    work.mkdir(parents=True, exist_ok=True)
    try:
        yield work
    except (Exception, KeyboardInterrupt) as error:
        if left_at(work) and (resume or isinstance(error, KeyboardInterrupt)):
            run.say(f"stopped; the same command with --resume goes on in {output}")
        else:
            shutil.rmtree(output if made else work, ignore_errors=True)
        raise


def _lift(run: Run, path: Path, config: LiftConfig) -> Splats:
    from g2ard.io import read_cloud
    from g2ard.stages.lift import lift

    cloud = read_cloud(path)
    for note in cloud.notes:
        run.say(f"{path}: {note}")
    return lift(cloud.points.positions, cloud.points.colors, **vars(config), progress=run.progress)


def _apart_targets(
    run: Run, cameras: Cameras | None, teacher: Splats | None, colour: Colour
) -> tuple[Targets | None, Targets | None]:
    """Every second view of another kind to validate with, the others to score; None without a teacher."""
    if cameras is None or teacher is None or len(cameras) < 2:
        return None, None
    validation, scored = (
        make_targets(run, cameras.take(range(first, len(cameras), 2)), teacher, colour) for first in (0, 1)
    )
    return validation, scored


def _score(
    run: Run, prior: Splats, result: Distilled, views: dict[str, Targets | None], colour: Colour
) -> dict[str, Any]:
    """Both scenes' figures in each kind of views; None for a kind without any."""
    from g2ard.stages.evaluate import evaluate

    scenes = {"simplified": result.simplified, "recovered": result.splats}
    scores: dict[str, Any] = {
        kind: targets
        and {
            name: evaluate(
                splats, targets, background=colour, progress=run.progress, stage=f"score {name}"
            ).as_dict()
            for name, splats in scenes.items()
        }
        for kind, targets in views.items()
    }
    return {
        "input_count": len(prior),
        "output_count": len(result.splats),
        "bytes": {"input": prior.nbytes, "output": result.splats.nbytes},
        **scores,
    }


def _unseen(result: Distilled, count: int) -> float | None:
    """Share of the Gaussians that no view sees that simplification looked from; None for `paper`."""
    unseen = result.report["rounds"][0]["simplify"].get("unseen")
    return None if unseen is None else unseen / count


def _write(
    run: Run, output: Path, result: Distilled, unseen: Targets, colour: Colour, report: dict[str, Any]
) -> None:
    import json

    from g2ard.io import write_splats
    from g2ard.io.atomic import atomic_output
    from g2ard.preview import preview

    scenes = [("simplified", result.simplified), ("recovered", result.splats)]
    preview(output / "preview.png", unseen, scenes, colour)
    with atomic_output(output / "report.json", overwrite=True) as temporary:
        temporary.write_text(json.dumps({**report, "config": run.config}, indent=2, default=str) + "\n")
    write_splats(output / "scene.ply", result.splats, overwrite=True)


def _keep(path: Path, scene: Splats | None) -> None:
    """Write the simplified scene; without one, what an earlier run kept there is no longer of this one."""
    from g2ard.io import write_splats

    if scene is None:
        path.unlink(missing_ok=True)
        return
    path.parent.mkdir(exist_ok=True)
    write_splats(path, scene, overwrite=True)
