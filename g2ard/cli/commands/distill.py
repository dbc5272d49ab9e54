"""`g2ard distill`: everything, from a dense scene or cloud to a compact one with its figures and pictures."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from g2ard.cli.found import as_pool, found_views
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
    Triple,
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
from g2ard.cli.scenes import (
    drop_held_out,
    load_for_training,
    load_held_out,
    load_scene,
    load_view_sets,
    make_targets,
    recovery_engine,
)

if TYPE_CHECKING:
    from g2ard.cameras import Cameras
    from g2ard.distill import Distilled
    from g2ard.io import ViewSet
    from g2ard.lift import LiftConfig
    from g2ard.poses import Pool
    from g2ard.splats import Splats
    from g2ard.targets import Targets

    Colour = tuple[float, float, float]

_WORK = ".unfinished"
"""In the folder of the run: finished rounds and checkpoints. Nobody else has a folder of this name."""
_POOL, _GROW = 160, 2.0
"""Poses of a pool made for a scene without views, and how many times as many there may be where a view holds
little of it; every 8th is held out for scoring."""
_APART = 24
"""Views of another kind: half of them validate recovery, half are scored."""
_ROWS = 200_000
"""Gaussians that poses are planned on."""
_LOSS = 0.05
"""dB under the simplified scene that the command speaks of."""
_KEPT = Path("simplified", "scene.ply")
"""In the folder of the run, with --keep: the anchors of the last recovery, for `evaluate --anchors`."""


@dataclass(frozen=True, eq=False)
class _Views:
    """What a run looks at.

    Args:
        train: to recover from.
        test: of their kind, for scoring.
        apart: of another kind, nearer; None where none can be made.
        pool: all of a pool made for the scene, to be written beside the result.
        unseen: share of a sample of the scene's matter that no view of that pool sees.
    """

    train: ViewSet
    test: Cameras
    apart: Cameras | None = None
    pool: ViewSet | None = None
    unseen: float | None = None


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
    one_horizon(steps, time_limit)
    can_judge(k, policy)
    if is_made(str(held_out)):
        raise typer.BadParameter("--held-out: a file of views; those that are made hold out every 8th anyway")
    given = views is not None and not is_made(views)
    run.spare_inputs(output / "scene.ply", output / _KEPT, *([output / "views.json"] if not given else []))
    import shutil
    import time

    from g2ard.constants import changed, listed
    from g2ard.distill import DistillConfig
    from g2ard.distill import distill as pipeline
    from g2ard.io import kind, write_views
    from g2ard.io.atomic import check_output
    from g2ard.lift import LiftConfig
    from g2ard.recover.presets import preset_for
    from g2ard.recover.schedule import schedule_named
    from g2ard.report.distilled import check_crops, distill_report

    began = time.monotonic()
    values = run.constants(recover=DistillConfig(), lift=LiftConfig())
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
    looks = _views(run, scene, prior, views, held_out, size, up, teach=not lifted and photos is not True)
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
        report["unseen"] = looks.unseen
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
            told=_told(report),
            crops=crop or [],
        )
        _write(run, output, result, unseen, colour, report)
        _keep(output / _KEPT, result.simplified if keep else None)
    if looks.pool is not None:
        write_views(output / "views.json", looks.pool.cameras, splits=looks.pool.splits, overwrite=True)
    shutil.rmtree(output / _WORK)
    _table(run, report)
    for line in _told(report):
        run.say(line)
    _say_views(run, report["views"], k is not None)
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
    from g2ard.lift import lift

    cloud = read_cloud(path)
    for note in cloud.notes:
        run.say(f"{path}: {note}")
    return lift(cloud.points.positions, cloud.points.colors, **vars(config), progress=run.progress)


def _views(
    run: Run,
    scene: Path,
    prior: Splats,
    views: Path | None,
    held_out: Path | None,
    size: int | None,
    up: Triple | None,
    *,
    teach: bool,
) -> _Views:
    """Views for recovery and for scoring; `teach`: the scene can be rendered into others than those given."""
    from g2ard.io import ViewSet
    from g2ard.splits import split_mask, splits_of

    found = None
    if views is None:
        found = views = found_views(run, scene, prior, ["train"] if held_out else ["train", "test"])
    if views is not None and not is_made(views):
        if held_out is None:
            train, test = load_view_sets(run, views, ["train", "test"], size)
        else:
            train, test = load_for_training(run, views, size), load_held_out(run, held_out, size)
            train = drop_held_out(run, train, test.cameras)
        if found and not size:
            train, test = (replace(part, cameras=as_pool(part.cameras)) for part in (train, test))
        return _Views(train, test.cameras, _near(run, prior, size, up) if teach else None)
    planned = _planned(run, prior, _POOL, up, _GROW)
    apart = planned.apart and planned.apart.resized(size)
    names = planned.cameras.names
    run.say(f"poses: {planned.kind} ({planned.why})")
    if held_out is not None:
        pool = ViewSet(planned.cameras, splits=("train",) * len(names))
        test = load_held_out(run, held_out, size)
        train = drop_held_out(run, pool.resized(size), test.cameras)
        return _Views(train, test.cameras, apart, pool, planned.unseen)
    pool = ViewSet(planned.cameras, splits=splits_of(None, names))
    mask = split_mask(None, names, "test")
    train = pool.take(~mask).resized(size)
    return _Views(train, pool.take(mask).resized(size).cameras, apart, pool, planned.unseen)


def _planned(run: Run, prior: Splats, count: int, up: Triple | None, grow: float = 1.0) -> Pool:
    """A pool of `count` views or up to `grow` times as many, and views of another kind."""
    from g2ard.poses import plan_pool

    return plan_pool(
        prior, count, up=up, seed=run.seed, rows=_ROWS, apart=_APART, grow=grow, progress=run.progress
    )


def _near(run: Run, prior: Splats, size: int | None, up: Triple | None) -> Cameras | None:
    """Views of another kind beside those that were given; None where the scene has no place for any."""
    from g2ard.errors import InputError

    try:
        apart = _planned(run, prior, _APART, up).apart
    except InputError:
        return None
    return apart and apart.resized(size)


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
    from g2ard.evaluate import evaluate

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


def _table(run: Run, report: dict[str, Any]) -> None:
    kinds = [report["scores"]] + ([report["apart"]] if report["apart"] else [])

    def row(name: str, count: int, size: int) -> list[str]:
        figures = []
        for scores in kinds:
            score = scores.get(name)
            figures += [f"{score['psnr']:.2f}", f"{score['ssim']:.4f}"] if score else ["–", "–"]
        return [name, f"{count:,}", f"{size / 1e6:.2f}", f"{size / count:.0f}", *figures]

    size = report["bytes"]
    times = ", ".join(f"{name} {value:.1f} s" for name, value in report["seconds"].items())
    counts = [str(len(scores["recovered"]["views"])) for scores in kinds]
    apart = f" and {counts[1]} of another kind (nearer)" if len(kinds) > 1 else ""
    run.console.table(
        f"{counts[0]} unseen views{apart} against {report['against']}; {times}",
        [
            "scene",
            "Gaussians",
            "MB",
            "bytes each",
            "PSNR",
            "SSIM",
            *["PSNR near", "SSIM near"][: 2 * (len(kinds) - 1)],
        ],
        [
            row("dense", report["input_count"], size["input"]),
            row("simplified", report["output_count"], size["output"]),
            row("recovered", report["output_count"], size["output"]),
        ],
    )


def _told(report: dict[str, Any]) -> list[str]:
    """What recovery kept, where it lost, and what no view saw, a line each."""
    from g2ard.recover.outcome import outcome

    lines = [outcome(done) for entry in report["rounds"] for done in entry.get("recover", [])]
    told = [line for line in lines if line is not None]
    for kind, what in (("scores", "unseen views"), ("apart", "views of another kind")):
        if not report[kind]:
            continue
        before, after = (report[kind][name]["psnr"] for name in ("simplified", "recovered"))
        if after < before - _LOSS:
            told.append(
                f"warning: recovery lost {before - after:.2f} dB in {what}: the simplified scene is better"
                " there (g2ard simplify makes it)"
            )
            continue
        pairs = zip(*(report[kind][name]["views"] for name in ("simplified", "recovered")), strict=True)
        lost = sum(b["psnr"] < a["psnr"] - _LOSS for a, b in pairs)
        if lost:
            told.append(
                f"{lost} of {len(report[kind]['recovered']['views'])} {what} lost, though all together gained"
            )
    if report["unseen"]:
        told.append(
            f"no view sees {report['unseen']:.0%} of the scene's matter: it is simplified, not recovered"
        )
    return told


def _say_views(run: Run, views: dict[str, Any] | None, chosen: bool) -> None:
    """What was made of the candidates, where it is not simply all of them."""
    if views is None:
        return
    if views["refused"]:
        run.say(f"{len(views['refused'])} views not used: they see nothing of the scene, or stand within it")
    if chosen:
        run.say(
            f"views: {len(views['chosen'])} of {views['candidates']} by {views['policy']};"
            f" those left out would have added {100 * views['left_out']:.1f} %"
        )
