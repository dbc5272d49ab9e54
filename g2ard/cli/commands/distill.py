"""`g2ard distill`: everything, from a dense scene or cloud to a compact one with its figures and pictures."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from g2ard.cli.frame import Run, command
from g2ard.cli.options import (
    BackgroundOption,
    CountOption,
    RatioOption,
    SizeOption,
    ViewsOption,
    budget_of,
    one_budget,
)

if TYPE_CHECKING:
    from g2ard.cameras import Cameras
    from g2ard.splats import Splats

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
    from g2ard.io import kind

    if kind(scene) == "points" and views is None:
        raise typer.BadParameter("a cloud is no teacher: give its photos with --views")
    _Distillation(run, output, resume).go(
        scene, count, ratio, views, photos, method, preset, schedule, steps, sh_degree, size, background
    )


class _Distillation:
    """One run of the command and its folder."""

    def __init__(self, run: Run, output: Path, resume: bool) -> None:
        import shutil
        import time

        from g2ard.io.atomic import check_output

        self.run, self.output = run, output
        self.work = output / "work"
        self.began = time.monotonic()
        check_output(output, run.overwrite or resume, folder=True)
        if not resume:
            shutil.rmtree(self.work, ignore_errors=True)

    def go(
        self,
        scene: Path,
        count: Any,
        ratio: float | None,
        views: Path | None,
        photos: bool | None,
        method: str,
        preset: str,
        schedule: str,
        steps: int | None,
        sh_degree: int | None,
        size: int | None,
        background: tuple[float, float, float] | None,
    ) -> None:
        import torch

        from g2ard.distill import DistillConfig
        from g2ard.distill import distill as pipeline
        from g2ard.errors import InputError
        from g2ard.evaluate import evaluate
        from g2ard.recover.presets import preset_for
        from g2ard.recover.schedule import schedule_named

        run = self.run
        if run.threads:
            torch.set_num_threads(run.threads)
        colour = background or (0.0, 0.0, 0.0)
        prior, lifted = self._prior(scene)
        budget = budget_of(count, ratio, len(prior))
        if budget > len(prior):
            raise InputError(f"{scene}: the budget {budget} is above its {len(prior)} Gaussians")
        train, test, use_photos = self._views(prior, views, photos, lifted, size)
        self.work.mkdir(parents=True, exist_ok=True)
        teacher = None if use_photos else prior
        against = "photos" if use_photos else "teacher renders"
        targets, held_out = self._targets(train, teacher, colour), self._targets(test, teacher, colour)
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
            result = pipeline(prior, budget, targets, config, work=self.work, progress=run.progress)
        except KeyboardInterrupt:
            run.say(f"stopped; the same command with --resume goes on in {self.output}")
            raise
        scores = {
            name: evaluate(s, held_out, background=colour, progress=run.progress, stage=f"score {name}")
            for name, s in (("simplified", result.simplified), ("recovered", result.splats))
        }
        self._write(prior, result, held_out, scores, against, why, colour)

    def _prior(self, scene: Path) -> tuple[Splats, bool]:
        from g2ard.cli.scenes import load_scene
        from g2ard.io import kind, read_cloud
        from g2ard.lift import lift

        if kind(scene) != "points":
            return load_scene(self.run, scene), False
        cloud = read_cloud(scene)
        for note in cloud.notes:
            self.run.say(f"{scene}: {note}")
        return lift(cloud.points.positions, cloud.points.colors, progress=self.run.progress), True

    def _views(
        self, prior: Splats, views: Path | None, photos: bool | None, lifted: bool, size: int | None
    ) -> tuple[Cameras, Cameras, bool]:
        """Training views, held-out views, and whether photos are the targets."""
        from g2ard.cli.scenes import load_views
        from g2ard.io import write_views
        from g2ard.poses import make_pool

        if views is None:
            pool = make_pool(prior, _POOL, seed=self.run.seed, progress=self.run.progress)
            self.output.mkdir(exist_ok=True)
            write_views(self.output / "views.json", pool, overwrite=True)
            views = self.output / "views.json"
        train = load_views(self.run, views, "train", size, prior.offset)
        test = load_views(self.run, views, "test", size, prior.offset)
        has_photos = all(p is not None for p in (*train.image_paths, *test.image_paths))
        return train, test, (has_photos if photos is None else photos) or lifted

    def _targets(self, cameras: Cameras, teacher: Splats | None, colour: tuple[float, float, float]) -> Any:
        from g2ard.cli.scenes import make_targets

        return make_targets(self.run, cameras, teacher, colour)

    def _write(
        self, prior: Splats, result: Any, held_out: Any, scores: Any, against: str, why: str, colour: Any
    ) -> None:
        import json
        import shutil
        import time

        from g2ard.io import write_splats
        from g2ard.io.atomic import atomic_output
        from g2ard.preview import preview

        run, out = self.run, self.output
        write_splats(out / "scene.ply", result.splats, overwrite=True)
        with atomic_output(out / "preview.png", overwrite=True) as temporary:
            preview(
                temporary, held_out, [("simplified", result.simplified), ("recovered", result.splats)], colour
            )
        seconds = {**result.report["seconds"], "total": time.monotonic() - self.began}
        report = {
            "input_count": len(prior),
            "output_count": len(result.splats),
            "bytes": {"input": prior.nbytes, "output": (out / "scene.ply").stat().st_size},
            "against": against,
            "preset": why,
            "seconds": seconds,
            "scores": {name: s.as_dict() for name, s in scores.items()},
            "rounds": result.report["rounds"],
        }
        with atomic_output(out / "report.json", overwrite=True) as temporary:
            temporary.write_text(json.dumps({**report, "config": run.config}, indent=2, default=str) + "\n")
        shutil.rmtree(self.work, ignore_errors=True)
        self._table(prior, result, scores, seconds)
        run.say(f"scene: {out / 'scene.ply'}\npicture: {out / 'preview.png'}\nreport: {out / 'report.json'}")
        run.result(report)

    def _table(self, prior: Splats, result: Any, scores: Any, seconds: dict[str, float]) -> None:
        compact = result.splats

        def row(name: str, splats: Splats, score: Any) -> list[str]:
            figures = [f"{score.psnr:.2f}", f"{score.ssim:.4f}"] if score else ["–", "–"]
            each = splats.nbytes / len(splats)
            return [name, f"{len(splats):,}", f"{splats.nbytes / 1e6:.2f}", f"{each:.0f}", *figures]

        self.run.console.table(
            f"unseen views: {len(scores['recovered'].views)}; "
            + ", ".join(f"{name} {value:.1f} s" for name, value in seconds.items()),
            ["scene", "Gaussians", "MB", "bytes each", "PSNR", "SSIM"],
            [
                row("dense", prior, None),
                row("simplified", result.simplified, scores["simplified"]),
                row("recovered", compact, scores["recovered"]),
            ],
        )
