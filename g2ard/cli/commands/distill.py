"""`g2ard distill`: everything, from a dense scene or cloud to a compact one with its figures and pictures."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from g2ard.cli.frame import Run, command
from g2ard.cli.options import (
    BackgroundOption,
    Count,
    CountOption,
    RatioOption,
    SizeOption,
    ViewsOption,
    budget_of,
    one_budget,
)
from g2ard.cli.scenes import load_scene, load_views, make_targets

if TYPE_CHECKING:
    from g2ard.cameras import Cameras
    from g2ard.distill import Distilled
    from g2ard.splats import Splats
    from g2ard.targets import Targets

    Colour = tuple[float, float, float]

_POOL = 128
"""Poses of a pool made for a scene without views; every 8th is held out for scoring."""


@command("distill", example="g2ard distill scene.ply -r 10 -o run/")
def distill(
    run: Run,
    scene: Annotated[
        Path, typer.Argument(metavar="SCENE|CLOUD", help="A trained scene, or a coloured cloud.")
    ],
    output: Annotated[Path, typer.Option("-o", "--output", metavar="RUN", help="Folder of the run.")],
    count: CountOption = None,
    ratio: RatioOption = None,
    views: ViewsOption = None,
    photos: Annotated[
        bool | None,
        typer.Option(
            "--photos/--renders",
            help="Targets: the views' photos, or the scene's renders; photos if there are.",
        ),
    ] = None,
    held_out: Annotated[
        Path | None,
        typer.Option(metavar="VIEWS", help="Score on these; --views is then all for recovery."),
    ] = None,
    method: Annotated[str, typer.Option(metavar="default|fast|paper", help="How to simplify.")] = "default",
    preset: Annotated[
        str, typer.Option(metavar="auto|trained|lift|noisy", help="Which regularisers hold the geometry.")
    ] = "auto",
    schedule: Annotated[
        str, typer.Option(metavar="fast|default|best|paper", help="Recovery; paper also goes round by round.")
    ] = "default",
    steps: Annotated[int | None, typer.Option(min=1, help="Overrides the final horizon.")] = None,
    sh_degree: Annotated[
        int | None,
        typer.Option("--sh-degree", min=0, max=3, help="Of the result; the scene's own, 3 from a cloud."),
    ] = None,
    resume: Annotated[bool, typer.Option("--resume", help="Go on with a stopped run.")] = False,
    size: SizeOption = None,
    background: BackgroundOption = None,
) -> None:
    """Distil a dense scene, or a coloured cloud with photos, into a compact one at an exact budget."""
    one_budget(count, ratio)
    import shutil
    import time

    from g2ard.distill import DistillConfig
    from g2ard.distill import distill as pipeline
    from g2ard.io import kind
    from g2ard.io.atomic import check_output
    from g2ard.recover.presets import preset_for
    from g2ard.recover.schedule import schedule_named

    began = time.monotonic()
    lifted = kind(scene) != "splats"
    if lifted and views is None:
        raise typer.BadParameter("a cloud is no teacher: give its photos with --views")
    work = check_output(output, run.overwrite or resume, folder=True) / "work"
    prior = _lift(run, scene) if lifted else load_scene(run, scene)
    budget = _budget(scene, count, ratio, len(prior))
    if not resume:
        shutil.rmtree(work, ignore_errors=True)
    work.mkdir(parents=True, exist_ok=True)
    train, test, use_photos = _views(run, views or _pool(run, prior, output), held_out, size, photos, lifted)
    teacher, against = (None, "photos") if use_photos else (prior, "teacher renders")
    colour = background or (0.0, 0.0, 0.0)
    regularizers, why = preset_for("lift" if preset == "auto" and lifted else preset, prior)
    run.say(f"{len(prior):,} → {budget:,} Gaussians; {len(train)} views against {against}")
    run.say(f"regularisers: {why}")
    config = DistillConfig(
        method=method,
        schedule=schedule_named(schedule),
        steps=steps,
        regularizers=regularizers,
        sh_degree=sh_degree if sh_degree is not None else (3 if lifted or schedule == "paper" else None),
        background=colour,
        seed=run.seed,
    )
    try:
        targets = make_targets(run, train, teacher, colour)
        result = pipeline(prior, budget, targets, config, work=work, progress=run.progress)
    except KeyboardInterrupt:
        run.say(f"stopped; the same command with --resume goes on in {output}")
        raise
    unseen = make_targets(run, test, teacher, colour)
    report = _score(run, prior, result, unseen, colour)
    report |= {"against": against, "preset": why, "rounds": result.report["rounds"]}
    report["seconds"] = {**result.report["seconds"], "total": time.monotonic() - began}
    _write(run, output, result, unseen, colour, report)
    shutil.rmtree(work)
    _table(run, report)
    run.say(
        f"scene: {output / 'scene.ply'}\npicture: {output / 'preview.png'}\nreport: {output / 'report.json'}"
    )
    run.result(report)


def _lift(run: Run, path: Path) -> Splats:
    from g2ard.io import read_cloud
    from g2ard.lift import lift

    cloud = read_cloud(path)
    for note in cloud.notes:
        run.say(f"{path}: {note}")
    return lift(cloud.points.positions, cloud.points.colors, progress=run.progress)


def _budget(scene: Path, count: Count | None, ratio: float | None, total: int) -> int:
    from g2ard.errors import InputError

    budget = budget_of(count, ratio, total)
    if budget > total:
        raise InputError(f"{scene}: the budget of {budget} is above its {total} Gaussians")
    return budget


def _pool(run: Run, prior: Splats, output: Path) -> Path:
    """Poses for a scene that comes without views, kept in the run's folder."""
    from g2ard.io import write_views
    from g2ard.poses import make_pool

    path = output / "views.json"
    write_views(path, make_pool(prior, _POOL, seed=run.seed, progress=run.progress), overwrite=True)
    return path


def _views(
    run: Run, path: Path, held_out: Path | None, size: int | None, photos: bool | None, lifted: bool
) -> tuple[Cameras, Cameras, bool]:
    """Training views, held-out views, and whether their photos are the targets."""
    train = load_views(run, path, "all" if held_out else "train", size)
    test = load_views(run, held_out or path, "all" if held_out else "test", size)
    pictured = all(p is not None for p in (*train.image_paths, *test.image_paths))
    return train, test, lifted or (pictured if photos is None else photos)


def _score(run: Run, prior: Splats, result: Distilled, unseen: Targets, colour: Colour) -> dict[str, Any]:
    from g2ard.evaluate import evaluate

    scenes = {"simplified": result.simplified, "recovered": result.splats}
    scores = {
        name: evaluate(splats, unseen, background=colour, progress=run.progress, stage=f"score {name}")
        for name, splats in scenes.items()
    }
    return {
        "input_count": len(prior),
        "output_count": len(result.splats),
        "bytes": {"input": prior.nbytes, "output": result.splats.nbytes},
        "scores": {name: score.as_dict() for name, score in scores.items()},
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


def _table(run: Run, report: dict[str, Any]) -> None:
    def row(name: str, count: int, size: int, score: dict[str, Any] | None) -> list[str]:
        figures = [f"{score['psnr']:.2f}", f"{score['ssim']:.4f}"] if score else ["–", "–"]
        return [name, f"{count:,}", f"{size / 1e6:.2f}", f"{size / count:.0f}", *figures]

    scores, size = report["scores"], report["bytes"]
    times = ", ".join(f"{name} {value:.1f} s" for name, value in report["seconds"].items())
    run.console.table(
        f"{len(scores['recovered']['views'])} unseen views against {report['against']}; {times}",
        ["scene", "Gaussians", "MB", "bytes each", "PSNR", "SSIM"],
        [
            row("dense", report["input_count"], size["input"], None),
            row("simplified", report["output_count"], size["output"], scores["simplified"]),
            row("recovered", report["output_count"], size["output"], scores["recovered"]),
        ],
    )
