"""`g2ard lod`: a scene → levels of detail as streamed SOG."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from g2ard.cli.budget_options import Ratios
from g2ard.cli.frame import Run, command
from g2ard.cli.options import BackgroundOption, ResumeOption, SizeOption, UpOption, ViewsOrMadeOption
from g2ard.progress import plural

if TYPE_CHECKING:
    from g2ard.policy.levels import Levels


@command("lod", example="g2ard lod scene.ply -r 1,2,4,8,16 -o streamed/")
def lod(
    run: Run,
    scene: Annotated[Path, typer.Argument(metavar="SCENE", help="A trained scene.")],
    output: Annotated[
        Path, typer.Option("-o", "--output", metavar="DIR", help="Folder of lod-meta.json and its files.")
    ],
    ratios: Annotated[
        Ratios,
        typer.Option(
            "-r",
            "--ratios",
            parser=Ratios.parse,
            metavar="RATIOS",
            help="How many times fewer Gaussians each level has, rising.",
        ),
    ] = "1,2,4,8,16",  # type: ignore[assignment]
    recover: Annotated[
        bool, typer.Option("--recover/--merge-only", help="Optimise each level, or only merge.")
    ] = True,
    errors: Annotated[
        bool,
        typer.Option(
            "--errors/--no-errors", help="Measure what each leaf's levels lose: viewers load by it."
        ),
    ] = True,
    most: Annotated[
        int,
        typer.Option("--chunk-count", min=1, metavar="K", help="About the most thousands of a file, ×1024."),
    ] = 512,
    extent: Annotated[
        float, typer.Option("--chunk-extent", min=1e-9, metavar="UNITS", help="About the widest leaf.")
    ] = 16.0,
    least: Annotated[
        int,
        typer.Option("--chunk-min", min=1, metavar="K", help="Wide leaves under so many stay whole, ×1024."),
    ] = 8,
    views: ViewsOrMadeOption = None,
    steps: Annotated[int | None, typer.Option(min=1, help="Of each recovery; by need if not given.")] = None,
    size: SizeOption = None,
    background: BackgroundOption = None,
    up: UpOption = None,
    resume: ResumeOption = False,
) -> None:
    """Write levels of detail that viewers stream: each merged from the one before, and recovered."""
    from g2ard.cli.resume import check_stopped, left_at, stoppable
    from g2ard.io import kind
    from g2ard.io.atomic import check_output
    from g2ard.levels import Cut, save_levels
    from g2ard.policy.levels import lod as levels_of

    if kind(scene) == "points":
        raise typer.BadParameter(
            "a cloud has no renders to learn from: distil it first, then `lod` its scene"
        )
    meta, work = output / "lod-meta.json", output.with_name(f".{output.name}.unfinished")
    run.spare_inputs(meta)
    if left_at(work) or not (resume and meta.exists()):
        check_output(output, run.overwrite, folder=True)
    if resume and meta.exists() and not left_at(work) and not run.overwrite:
        _check_same(meta, ratios)
    check_stopped(run, work, resume, meta)
    rule = Cut(most * 1024, extent, least * 1024)
    with stoppable(run, work, resume):
        levels = levels_of(
            scene,
            ratios=ratios,
            recover=recover,
            views=views,
            steps=steps,
            size=size,
            background=background or (0.0, 0.0, 0.0),
            up=up,
            seed=run.seed,
            work=work,
            progress=run.progress,
            say=run.say,
        )
        size_of_all = save_levels(
            output, levels.splats, cut=rule, errors=errors, overwrite=run.overwrite, progress=run.progress
        )
    _tell(run, output, levels, size_of_all)


def _check_same(meta: Path, ratios: Sequence[float]) -> None:
    """Refuse to call a folder finished that holds levels of other ratios."""
    import json

    from g2ard.errors import OutputError

    counts = json.loads(meta.read_text(encoding="utf-8")).get("counts") or [0]
    wanted = [counts[0] * ratios[0] / ratio for ratio in ratios]
    if len(counts) != len(wanted) or any(abs(c - w) > ratios[0] for c, w in zip(counts, wanted, strict=True)):
        levels = ", ".join(f"{count:,}" for count in counts)
        raise OutputError(f"{meta}: levels of {levels} Gaussians, made with other -r; -w makes them anew")


def _tell(run: Run, output: Path, levels: Levels, size: int) -> None:
    for number, report in enumerate(levels.reports):
        figures = [
            f"{psnr:.2f} dB {what}"
            for what, psnr in (("merged", report.simplified), ("recovered", report.recovered))
            if psnr is not None
        ]
        told = f" ({', '.join(figures)}, in unseen views of {report.size} pixels)" if figures else ""
        run.say(f"level {number}: {plural(report.count, 'Gaussian')}{told}")
    run.say(f"{output}: {plural(len(levels.reports), 'level')}, {size / 1e6:.2f} MB")
    result: dict[str, Any] = {"output": str(output), "bytes": size}
    run.result({**result, "levels": [report.as_dict() for report in levels.reports]})
